//! `plan-experiment` as a researcher runs it: from the prior, from a posterior, and its refusals.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use crate::support::offline::{self, retrograde, text};
use calibration::chance::{normal, stream};
use calibration::prior::{Point, Values};

fn folder(name: &str) -> PathBuf {
    offline::folder("plan-experiment", name)
}

/// Writes a small plan into a folder.
fn plan(out: &Path, more: &[&str]) -> String {
    let args = [
        "plan-experiment",
        "--uncertainty-mm",
        "0.5",
        "--trials",
        "2",
        "--kinds",
        "returning_pass,net",
        "--indentations-mm",
        "5.05",
        "--histories",
        "16",
        "--out",
        text(out),
    ];
    let (code, said, err) = retrograde(&[&args, more].concat());
    // With `--json` the text goes to standard error.
    assert_eq!(
        (code, err.is_empty()),
        (0, !more.contains(&"--json")),
        "{err}"
    );
    said
}

const FILES: [&str; 3] = ["plan-experiment.csv", "displacements.csv", "plan.svg"];

#[test]
fn a_plan_from_the_prior_is_the_same_on_any_number_of_threads() {
    let (first, again) = (folder("first"), folder("again"));
    let said = plan(&first, &["--threads", "2"]);
    for line in said.lines() {
        assert!(
            line.chars().count() <= 80 || line.starts_with("files"),
            "{line}"
        );
    }
    for says in [
        "body from the prior, not validated against a rig",
        "returning pass",
        "paper, whole    100 displacements",
        "body.friction_ratio",
        "nats",
    ] {
        assert!(said.contains(says), "{says}: {said}");
    }
    plan(&again, &["--threads", "1"]);
    for name in FILES {
        let read = |out: &Path| fs::read(out.join(name)).expect("a file");
        assert!(read(&first) == read(&again), "{name}");
    }
    let svg = fs::read_to_string(first.join("plan.svg")).expect("a figure");
    for says in [
        "not validated against a rig",
        "joint gain / nats",
        "procedure (model)",
    ] {
        assert!(svg.contains(says), "{says}");
    }
    let csv = fs::read_to_string(first.join("plan-experiment.csv")).expect("a table");
    for row in csv.lines().skip(1) {
        assert!(row.contains("not validated against a rig"), "{row}");
    }
    // The two kinds tell different things, so neither is chosen twice.
    let kinds: Vec<&str> = (csv.lines())
        .filter(|row| row.starts_with("recommended"))
        .filter_map(|row| row.split(',').nth(2))
        .collect();
    assert_eq!(kinds, ["net", "returning_pass"]);
    // `fit` reads the rows once they are filled in, and says what is missing before.
    let empty = first.join("displacements.csv");
    let (code, _, err) = retrograde(&["fit", text(&empty)]);
    assert!(
        code == 2 && err.contains("displacement_mm is empty"),
        "{err}"
    );
}

/// A model file with a posterior of a narrow body, without a fit.
fn posterior_file(folder: &Path) -> PathBuf {
    posterior_with(folder, 0.05, "reliable = true")
}

/// The same with this discrepancy and these lines of a verdict.
pub fn posterior_with(folder: &Path, tau_mm: f64, verdict: &str) -> PathBuf {
    let mut random = stream(1, 1);
    let middle = Values([0.15, 40.0, 0.0007, tau_mm]).point();
    let mut samples = String::new();
    for _ in 0..60 {
        let near: Point = std::array::from_fn(|axis| middle[axis] + 0.1 * normal(&mut random));
        let _ = writeln!(samples, "    {:?},", Values::at(&near).0);
    }
    let path = folder.join("model.toml");
    let model = format!(
        "from_body = \"one\"\n[posterior]\nformat = 1\norigin = \"virtual\"\nmade_by = \"a test\"\nseed = 1\nsampler = \"none\"\n\
         r_hat = 1.0\ness = 1000.0\n{verdict}\npoint = 1\n\
         parameters = [\"body.coupling\", \"body.friction_ratio\", \"body.preload_mm\", \"fit.discrepancy_mm\"]\n\
         samples = [\n{samples}]\nsource = []\n"
    );
    fs::write(&path, model).expect("written");
    path
}

#[test]
fn a_posterior_is_planned_from_and_tells_less_than_the_prior() {
    let folder = folder("posterior");
    let model = posterior_file(&folder);
    let said = plan(&folder, &["--model", text(&model), "--json"]);
    let said: serde_json::Value = serde_json::from_str(&said).expect("JSON");
    let origin = said["origin"].as_str().expect("an origin");
    assert!(origin.contains("posterior of origin virtual"), "{origin}");
    let trials = said["trials"].as_array().expect("trials");
    let first = trials[0]["gain_nats"].as_f64().expect("a gain");
    // The prior spans a hundred millimetres, this body only a few.
    assert!(first > 0.3 && first < 2.5, "{first}");
    let width = said["widths"][0]["before"]["mean"]
        .as_f64()
        .expect("a width");
    assert!(width < 0.5, "{width}");
}

/// From a posterior as from the prior, the choice among the paper's own conditions tells at least as much as the
/// paper's procedure. It once told less with dry candidates only, because the paper's second wall was not among them.
#[test]
fn what_is_recommended_tells_no_less_than_the_papers_procedure() {
    let folder = folder("no-less");
    let model = posterior_file(&folder);
    let (code, said, err) = retrograde(&[
        "plan-experiment",
        "--uncertainty-mm",
        "0.5",
        "--trials",
        "10",
        "--kinds",
        "net",
        "--histories",
        "16",
        "--json",
        "--model",
        text(&model),
        "--out",
        text(&folder),
    ]);
    assert_eq!(code, 0, "{err}");
    let said: serde_json::Value = serde_json::from_str(&said).expect("JSON");
    let of = |series: usize, what: &str| said["series"][series][what].as_f64().expect("a number");
    let (ours, papers) = (of(0, "sum_nats"), of(1, "sum_nats"));
    let error = of(0, "sum_error_nats").hypot(of(1, "sum_error_nats"));
    assert!(ours > papers - 2.0 * error, "{ours} {papers} +- {error}");
    let trials = said["trials"].as_array().expect("trials");
    let recommended = trials.iter().filter(|row| row["series"] == "recommended");
    let lubricated = recommended.filter(|row| row["lubrication"] == "lubricated");
    assert!(lubricated.count() > 0, "{said}");
}

#[test]
fn what_cannot_be_planned_is_refused() {
    let folder = folder("refused");
    let bare = folder.join("bare.toml");
    fs::write(&bare, "from_body = \"one\"\n").expect("written");
    let fitted = posterior_file(&folder);
    let outside = folder.join("outside.toml");
    let whole = fs::read_to_string(&fitted).expect("a model");
    let row = whole
        .lines()
        .find(|line| line.starts_with("    ["))
        .expect("a sample");
    fs::write(&outside, whole.replace(row, "    [0.15, 40.0, 0.5, 0.05],")).expect("written");
    let good = ["--uncertainty-mm", "0.5"];
    for (args, says) in [
        (vec!["--uncertainty-mm", "0"], "no measurement is exact"),
        (vec!["--uncertainty-mm", "-1"], "no measurement is exact"),
        (
            vec!["--uncertainty-mm", "0.5", "--repeats", "1000"],
            "ripples",
        ),
        (vec![], "--uncertainty-mm"),
        ([&good[..], &["--trials", "0"]].concat(), "1 to 40"),
        (
            [&good[..], &["--indentations-mm", "0,2"]].concat(),
            "does not reach the wall",
        ),
        (
            [&good[..], &["--indentations-mm", "2,2"]].concat(),
            "is there twice",
        ),
        (
            [&good[..], &["--indentations-mm", "11"]].concat(),
            "a = 11 mm is not usable",
        ),
        (
            [&good[..], &["--model", text(&bare)]].concat(),
            "has no [posterior]",
        ),
        (
            [&good[..], &["--from", "posterior"]].concat(),
            "without a file",
        ),
        (
            [&good[..], &["--coupling", "0.2"]].concat(),
            "what trials are to find",
        ),
        (
            [&good[..], &["--model", text(&outside)]].concat(),
            "sample 1: body.preload_mm = 0.5 is not within its prior",
        ),
        ([&good[..], &["--kinds", "fold"]].concat(), "antegrade_pass"),
        (
            [&good[..], &["--lubrication", "wet"]].concat(),
            "lubricated",
        ),
    ] {
        let out = ["--out", text(&folder)];
        let (code, _, err) = retrograde(&[&["plan-experiment"], &args[..], &out].concat());
        assert_eq!(code, 2, "{args:?}: {err}");
        assert!(err.contains(says), "{args:?}: {err}");
    }
    for name in FILES {
        assert!(!folder.join(name).exists(), "{name}");
    }
}
