//! `fit` as a researcher runs it: turns a file of passes into a model with its uncertainty, which `simulate` shows.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use crate::support::offline::retrograde;
use calibration::chance::stream;
use calibration::observation::Kind;
use calibration::prior::Values;
use calibration::synthetic::{Planned, observations};
use locomotion::model::Model;

/// Isolated passes of the default body, with errors from a seed.
fn passes(path: &Path) {
    let both = [Kind::AntegradePass, Kind::ReturningPass];
    let at = |a: f64| both.map(|kind| Planned::dry(kind, a, 3, 0.2));
    let planned: Vec<Planned> = [2.0, 5.05].into_iter().flat_map(at).collect();
    let truth = Values([0.15, 40.0, 0.0007, 0.02]).point();
    let mut text =
        "kind,indentation_mm,lubrication,displacement_mm,uncertainty_mm,origin,excluded\n"
            .to_owned();
    for one in observations(&Model::ONE, &truth, &planned, &mut stream(1, 2)).expect("covered") {
        let kind = match one.kind {
            Kind::AntegradePass => "antegrade_pass",
            _ => "returning_pass",
        };
        text += &format!(
            "{kind},{},{},{:.2},{},virtual,\n",
            one.indentation_mm, one.lubrication, one.displacement_mm, one.uncertainty_mm
        );
    }
    text += "antegrade_pass,2,dry,40,0.2,virtual,the camera fell\n";
    fs::write(path, text).expect("written");
}

/// Folder of the file and its fit, and the command's output; made once.
fn fitted() -> (&'static Path, &'static str) {
    static FITTED: OnceLock<(PathBuf, String)> = OnceLock::new();
    let (folder, said) = FITTED.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fit");
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("a folder");
        let csv = folder.join("passes.csv");
        passes(&csv);
        let said = fit(&folder, "out", "2");
        (folder, said)
    });
    (folder, said)
}

fn fit(folder: &Path, out: &str, threads: &str) -> String {
    let (csv, out) = (folder.join("passes.csv"), folder.join(out));
    let (csv, out) = (csv.to_str().expect("UTF-8"), out.to_str().expect("UTF-8"));
    let (code, said, err) = retrograde(&[
        "fit",
        csv,
        "--seed",
        "7",
        "--threads",
        threads,
        "--out",
        out,
    ]);
    assert_eq!((code, err.as_str()), (0, ""));
    said
}

/// Regression: a source that was named twice, or beside its copy, counted as twice the trials.
#[test]
fn the_same_displacements_are_not_counted_twice() {
    let place = tempfile::tempdir().expect("a folder");
    let at = |name: &str| place.path().join(name).to_str().expect("UTF-8").to_owned();
    let (csv, copy, out) = (at("passes.csv"), at("copy.csv"), at("out"));
    passes(Path::new(&csv));
    fs::copy(&csv, &copy).expect("copied");
    for twin in [&csv, &copy] {
        let (code, _, err) = retrograde(&["fit", &csv, twin, "--out", &out]);
        assert_eq!(code, 2, "{err}");
        assert!(err.contains("are the same displacements"), "{err}");
        assert!(!Path::new(&out).exists());
    }
}

#[test]
fn a_file_of_passes_becomes_a_model_with_its_uncertainty() {
    let (folder, said) = fitted();
    for line in said.lines() {
        assert!(
            line.chars().count() <= 80 || line.starts_with("origin") || line.contains('/'),
            "{line}"
        );
    }
    for says in [
        "body.coupling",
        "body.friction_ratio",
        "left out: row 13: excluded: the camera fell",
        "virtual: simulated",
    ] {
        assert!(said.contains(says), "{says}: {said}");
    }
    let model = folder.join("out/model.toml");
    let text = fs::read_to_string(&model).expect("a model");
    for says in [
        "[posterior]",
        "seed = 7",
        "origin = \"virtual\"",
        "passes.csv",
        "row 12",
        "the camera fell",
    ] {
        assert!(text.contains(says), "{says}");
    }
    let svg = fs::read_to_string(folder.join("out/posterior.svg")).expect("a figure");
    for says in [
        "posterior, 5 to 95 %",
        "origin virtual",
        "antegrade pass / mm",
        "returning pass / mm",
        "trials, dry: means of ",
        "bars 95 %, p from 0.",
    ] {
        assert!(svg.contains(says), "{says}");
    }
    // `simulate` with the file reproduces the numbers of the figure and the file.
    let out = folder.join("simulated");
    let out = out.to_str().expect("UTF-8");
    let model = model.to_str().expect("UTF-8");
    let (code, said, err) = retrograde(&["simulate", "roller", "--model", model, "--out", out]);
    assert_eq!((code, err.as_str()), (0, ""));
    assert!(
        said.contains("posterior band/mm") && said.contains("origin: virtual"),
        "{said}"
    );
    let csv = fs::read_to_string(Path::new(out).join("roller.csv")).expect("a table");
    let row: Vec<&str> = csv.lines().nth(5).expect("a row").split(',').collect();
    let of = |name: &str| {
        let header = csv.lines().next().expect("a header");
        row[header
            .split(',')
            .position(|column| column == name)
            .expect(name)]
    };
    assert_eq!(of("prior_5_mm"), "");
    let number = |name: &str| of(name).parse::<f64>().expect("a number");
    let (low, mid, high) = (
        number("posterior_5_mm"),
        number("displacement_mm"),
        number("posterior_95_mm"),
    );
    assert!(
        low < mid && mid < high && high - low < 25.0,
        "{low} {mid} {high}"
    );
    let svg = fs::read_to_string(Path::new(out).join("roller.svg")).expect("a figure");
    assert!(svg.contains("posterior band: 90 %, with discrepancy"));
    // `simulate` writes the same model file again.
    let again = fs::read_to_string(Path::new(out).join("model.toml")).expect("a model");
    assert_eq!(again, text);
}

#[test]
fn the_same_seed_makes_the_same_bytes_on_any_number_of_threads() {
    let (folder, _) = fitted();
    fit(folder, "again", "1");
    for name in [
        "model.toml",
        "posterior.svg",
        "draws.csv",
        "predictions.csv",
        "conditions.csv",
    ] {
        let read = |out: &str| fs::read(folder.join(out).join(name)).expect("a file");
        assert!(read("out") == read("again"), "{name}");
    }
}

#[test]
fn a_fitted_parameter_is_not_set_to_something_else() {
    let (folder, _) = fitted();
    let model = folder.join("out/model.toml");
    let model = model.to_str().expect("UTF-8");
    let (code, _, err) = retrograde(&["simulate", "roller", "--model", model, "--coupling", "0.3"]);
    assert_eq!(code, 2, "{err}");
    assert!(err.contains("body.coupling is fitted"), "{err}");
    let text = fs::read_to_string(model).expect("a model");
    let broken = folder.join("broken.toml");
    fs::write(&broken, text.replace("point = ", "point = 9")).expect("written");
    let broken = broken.to_str().expect("UTF-8");
    let (code, _, err) = retrograde(&["simulate", "roller", "--model", broken]);
    assert_eq!(code, 2, "{err}");
    assert!(err.contains("[posterior]: there is no sample 9"), "{err}");
}

#[test]
fn sources_that_cannot_be_fitted_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        fs::write(&path, text).expect("written");
        path.to_str().expect("UTF-8").to_owned()
    };
    let header = "kind,cycles,indentation_mm,lubrication,displacement_mm,uncertainty_mm,origin\n";
    let bad = file("bad.csv", &format!("{header}net,5,3,dry,far,1,virtual\n"));
    let one = file("one.csv", &format!("{header}net,5,3,dry,31,1,virtual\n"));
    let other = file("other.csv", &format!("{header}net,5,3,dry,31,1,board\n"));
    let empty = file("empty.csv", header);
    let deep = file("deep.csv", &format!("{header}net,5,11,dry,31,1,virtual\n"));
    for (args, says) in [
        (vec![&*bad], "row 1: displacement_mm: \"far\" is no number"),
        (vec![&*one, &*other], "origin board"),
        (vec![&*empty], "nothing to fit"),
        (vec![&*deep], "indentation a = 11 mm is not usable"),
        (vec![folder.path().to_str().expect("UTF-8")], "campaign new"),
        (vec!["nowhere.csv"], "nowhere.csv"),
    ] {
        let (code, _, err) = retrograde(&[&["fit"], &args[..]].concat());
        assert_ne!(code, 0, "{args:?}");
        assert!(err.contains(says), "{args:?}: {err}");
    }
    let (code, _, err) = retrograde(&["fit", &one, "--uncertainty-mm", "0"]);
    assert!(code == 2 && err.contains("above 0"), "{err}");
}
