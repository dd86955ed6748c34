//! `design` and `simulate` as a researcher runs them: the files, the same bytes on any number of threads, drawings to
//! scale, refusals. The models' values are tested in `locomotion`.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use crate::support::offline::{self, retrograde, text};
use assert_cmd::Command;
use locomotion::model::Value::Number;
use locomotion::model::{Model, SETTINGS, Setting};
use locomotion::paper::{INDENTATIONS_MM, frictions, pressures_pa};
use locomotion::{roller, tube};
use report::science::series::{self, Case};
use serde_json::Value;

fn json(args: &[&str]) -> Value {
    let (code, out, err) = retrograde(&[&["--json"], args].concat());
    assert_eq!(code, 0, "{args:?}: {err}");
    serde_json::from_str(&out).expect("one object")
}

/// Runs `simulate` into a folder.
fn simulate(folder: &Path, args: &[&str]) {
    let out = folder.to_str().expect("UTF-8");
    let (code, _, err) = retrograde(&[&["simulate", "--out", out], args].concat());
    assert_eq!((code, err.as_str()), (0, ""), "{args:?}");
}

/// A folder with every series of the default model, calculated once for all tests that only read it.
fn everything() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let folder = offline::folder("science", "default");
        simulate(&folder, &["all"]);
        folder
    })
}

/// Options for a short calculation, where a test is about files and not about their numbers.
const SHORT: [&str; 6] = [
    "--set=rig.cycles=1",
    "--set=tube.duration_s=4",
    "--set",
    "tube.placements=2",
    "--set",
    "tube.wall_step_mm=0.1",
];

/// One column of a CSV file, as printed.
fn column(file: &Path, name: &str) -> Vec<String> {
    let mut reader = csv::Reader::from_path(file).expect("a CSV file");
    let headers = reader.headers().expect("a header").clone();
    let index = headers
        .iter()
        .position(|header| header == name)
        .unwrap_or_else(|| panic!("{name} in {headers:?}"));
    reader
        .records()
        .map(|record| record.expect("a row")[index].to_owned())
        .collect()
}

fn numbers(file: &Path, name: &str) -> Vec<f64> {
    column(file, name)
        .iter()
        .map(|text| text.parse().expect("a number"))
        .collect()
}

/// The `points="x,y x,y"` of all elements of a class within a part of a drawing.
fn shapes(svg: &str, class: &str) -> Vec<Vec<(f64, f64)>> {
    let opening = format!("class=\"{class}\" points=\"");
    svg.split(&opening)
        .skip(1)
        .map(|rest| {
            let (points, _) = rest.split_once('"').expect("closed");
            points
                .split(' ')
                .map(|point| {
                    let (x, y) = point.split_once(',').expect("a pair");
                    (x.parse().expect("x"), y.parse().expect("y"))
                })
                .collect()
        })
        .collect()
}

/// The files have the paper's cases in order, and the values that the models give.
#[test]
fn the_series_have_the_papers_cases() {
    let file = |name: &str| everything().join(name);
    let rounded = |name: &str| -> Vec<String> {
        let all = numbers(&file(name), "displacement_mm").into_iter();
        all.map(|mm| format!("{mm:.1}")).collect()
    };
    let published = ["13.0", "22.0", "31.0", "38.9", "46.3"];
    assert_eq!(rounded("roller.csv"), [published, published].concat());
    assert_eq!(
        numbers(&file("roller.csv"), "indentation_mm"),
        INDENTATIONS_MM.repeat(2)
    );
    let lubrication = column(&file("roller.csv"), "lubrication");
    assert_eq!(lubrication[..5], ["with"; 5]);
    assert_eq!(lubrication[5..], ["without"; 5]);

    let pressures: Vec<_> = pressures_pa().collect();
    assert_eq!(numbers(&file("pressure.csv"), "pressure_pa"), pressures);
    let about = column(&file("pressure.csv"), "paper_about_mm");
    assert_eq!((about[0].as_str(), about[10].as_str()), ("1.0", "15.0"));
    assert!(about[1..10].iter().all(String::is_empty));

    let all: Vec<_> = frictions().collect();
    assert_eq!(numbers(&file("friction.csv"), "friction"), all);
    assert_eq!(rounded("friction.csv"), ["15.2"; 25]);
    // A single sentence of the paper does not give 25 values.
    let about = column(&file("friction.csv"), "paper_about_mm");
    assert!(about.iter().all(String::is_empty));
    let moments = numbers(&file("friction-time.csv"), "displacement_mm");
    assert_eq!(moments.len(), 25 * 401);

    let end = |name| *numbers(&file("fold.csv"), name).last().expect("rows");
    assert_eq!(end("travel_mm"), 1300.0);
    assert_eq!(format!("{:.1}", end("folded_mm")), "-96.8");
    assert_eq!(format!("{:.1}", end("unfolded_mm")), "46.3");
}

/// Every file says which model it shows.
#[test]
fn every_file_names_its_model() {
    let folder = tempfile::tempdir().expect("folder");
    simulate(
        folder.path(),
        &[&["all", "--set", "body.coupling=0.2"], &SHORT[..]].concat(),
    );
    for entry in fs::read_dir(folder.path()).expect("listed") {
        let path = entry.expect("entry").path();
        let text = fs::read_to_string(&path).expect("read");
        let file = path.display();
        match path.extension().and_then(|ending| ending.to_str()) {
            Some("csv") => {
                let origin = column(&path, "origin");
                let wanted = "model one, 5 values changed";
                assert!(origin.iter().all(|origin| origin == wanted), "{file}");
            }
            Some("svg" | "toml") => {
                for says in [
                    "model: body one, calibrated to words",
                    "body.coupling = 0.2",
                    "not a measurement",
                ] {
                    assert!(text.contains(says), "{says} in {file}");
                }
            }
            other => panic!("{other:?}: {file}"),
        }
    }
}

/// Options and a file set the same model, and so does the model file written.
#[test]
fn options_and_files_are_the_same_model() {
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("mine.toml");
    fs::write(
        &file,
        "from_body = \"rig\"\n[body]\ncoupling = 0.25\nfriction_ratio = \"facets\"\n[design]\nbeta_deg = 40\n[rig]\ncycles = 2\n",
    )
    .expect("written");
    let [one, two, three] = ["1", "2", "3"].map(|name| folder.path().join(name));
    let file = file.to_str().expect("UTF-8");
    simulate(&one, &["roller", "--model", file]);
    let body = ["roller", "--body", "rig", "--set", "body.coupling=0.25"];
    let ratio = ["--set", "body.friction_ratio=facets"];
    let rest = ["--set=design.beta_deg = 40", "--set", "rig.cycles=2"];
    simulate(&two, &[&body[..], &ratio, &rest].concat());
    let written = one.join("model.toml");
    let written = written.to_str().expect("UTF-8");
    simulate(&three, &["roller", "--model", written]);
    for name in ["roller.csv", "roller.svg", "model.toml", "parameters.csv"] {
        let bytes = |folder: &Path| fs::read(folder.join(name)).expect(name);
        assert!(
            bytes(&one) == bytes(&two) && bytes(&two) == bytes(&three),
            "{name}"
        );
    }
    // An option overrides the file, also by the other key for the same.
    let options = ["--set=body.coupling=0.15", "--set=design.tan_beta=0.6"];
    simulate(&two, &[&["roller", "--model", file][..], &options].concat());
    let parameters = two.join("parameters.csv");
    let (names, values) = (column(&parameters, "name"), numbers(&parameters, "value"));
    assert_eq!(names.len(), SETTINGS.len());
    let of = |key: &str| values[names.iter().position(|name| name == key).expect(key)];
    assert_eq!(
        (of("body.coupling"), of("design.tan_beta"), of("rig.cycles")),
        (0.15, 0.6, 2.0)
    );
}

/// The long help names every parameter, and a command does not show an option for each.
#[test]
fn the_help_lists_every_parameter_in_one_option() {
    let (_, help, _) = retrograde(&["simulate", "pressure", "--help"]);
    for setting in Setting::all() {
        let first = setting.meaning.split_once(' ').expect("words").0;
        let listed = |line: &str| {
            let line = line.trim_start();
            line.starts_with(&format!("{} ", setting.key)) && line.contains(first)
        };
        assert!(help.lines().any(listed), "{}", setting.key);
    }
    let (_, short, _) = retrograde(&["simulate", "pressure", "-h"]);
    assert!(
        short.contains("--set <KEY=VALUE>") && !short.contains("tube.poisson"),
        "{short}"
    );
}

/// `design` uses the design of a model file, unless an option overrides it.
#[test]
fn a_design_can_come_from_a_model_file() {
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("mine.toml");
    fs::write(
        &file,
        "[design]\nwidth_mm = 20\ncore_ratio = 0.25\ntan_beta = 1.0\ncrescents = 6\n",
    )
    .expect("written");
    let file = file.to_str().expect("UTF-8");
    let value = json(&["design", "--model", file, "--crescents", "5"]);
    let design = &value["design"];
    assert_eq!(
        (&design["width_mm"], &design["half_gap_mm"]),
        (&20.0.into(), &7.5.into())
    );
    assert_eq!(design["crescents"], 5);
    let beta = design["beta_deg"].as_f64().expect("a number");
    assert!((beta - 45.0).abs() < 1e-12, "{beta}");
    let alpha = design["alpha_deg"].as_f64().expect("a number");
    let of_body = (2.0_f64 / 9.0).atan().to_degrees();
    assert!((alpha - of_body).abs() < 1e-12, "{alpha}");
}

#[test]
fn every_file_is_the_same_on_every_run_and_on_any_number_of_threads() {
    let files = |threads: &str, args: &[&str]| {
        let folder = tempfile::tempdir().expect("folder");
        let line = [&["--threads", threads], args, &SHORT].concat();
        simulate(folder.path(), &line);
        let mut files: Vec<_> = fs::read_dir(folder.path())
            .expect("listed")
            .map(|entry| {
                let path = entry.expect("entry").path();
                (
                    path.file_name().expect("name").to_owned(),
                    fs::read(&path).expect("read"),
                )
            })
            .collect();
        files.sort();
        files
    };
    let sweep = "sweep --frictions 0.05:0.25:0.05 --pressures-pa 3000:7000:1000";
    let rig = "sweep --frictions 0.08,0.2 --indentations-mm 0.5:9.5:0.5";
    for (line, count) in [("all", 15), (sweep, 4), (rig, 4)] {
        let args = &*line.split(' ').collect::<Vec<_>>();
        let one = files("1", args);
        assert_eq!(one.len(), count, "{args:?}");
        for threads in ["1", "2", "7"] {
            assert!(files(threads, args) == one, "{threads} threads, {args:?}");
        }
    }
}

/// Any parameter is an axis; the load varies fastest. A row of the table is that of the same model alone.
#[test]
fn a_sweep_has_every_combination_in_order() {
    let folder = tempfile::tempdir().expect("folder");
    let line = ["sweep", "--frictions", "0.1,0.2", "--pressures-pa"];
    simulate(folder.path(), &[&line[..], &["3000:5000:1000"]].concat());
    let file = folder.path().join("sweep-tube.csv");
    assert_eq!(numbers(&file, "friction"), [0.1, 0.1, 0.1, 0.2, 0.2, 0.2]);
    let pressures = [3000.0, 4000.0, 5000.0].repeat(2);
    assert_eq!(numbers(&file, "pressure_pa"), pressures);
    let mm = numbers(&file, "displacement_mm");
    assert_eq!(mm[..3], mm[3..], "friction cancels");

    let out = folder.path().to_str().expect("UTF-8");
    let axes = ["--vary=rig.cycles=1,2", "--vary", "design.beta_deg=30:40:5"];
    let loads = ["--indentations-mm", "2,5.05"];
    let line = [&["simulate", "--out", out, "sweep"], &axes[..], &loads].concat();
    let (code, text, err) = retrograde(&line);
    assert_eq!((code, err.as_str()), (0, ""));
    let file = folder.path().join("sweep-roller.csv");
    assert_eq!(numbers(&file, "rig.cycles"), [[1.0; 6], [2.0; 6]].concat());
    let beta = [30.0, 30.0, 35.0, 35.0, 40.0, 40.0].repeat(2);
    assert_eq!(numbers(&file, "design.beta_deg"), beta);
    assert_eq!(numbers(&file, "indentation_mm"), [2.0, 5.05].repeat(6));
    let mut model = Model::ONE;
    for (key, value) in [("rig.cycles", 2.0), ("design.beta_deg", 40.0)] {
        let setting = Setting::named(key).expect(key);
        model.set(setting, Number(value)).expect(key);
    }
    let alone = roller::run(model.rig().expect("a model"), 5.05).expect("a run");
    let last = numbers(&file, "displacement_mm")[11];
    assert_eq!(last.to_bits(), alone.to_bits());
    let shown = text
        .lines()
        .find(|line| line.contains("40.0") && line.contains("5.05"));
    assert!(
        text.contains("design.beta_deg") && shown.is_some(),
        "{text}"
    );
    let svg = fs::read_to_string(folder.path().join("sweep-roller.svg")).expect("drawn");
    assert!(svg.contains("rig.cycles 2.0, design.beta_deg 40.0 (model)"));
}

/// Reports the error of the first failing case in order, whichever thread fails first.
#[test]
fn the_first_error_in_order_is_reported() {
    let workers = series::Workers::new(Some(7)).expect("threads");
    let cases: Vec<_> = (0..40)
        .map(|index| Case {
            friction: 0.15,
            load: if index < 20 { 100.0 } else { -f64::from(index) },
        })
        .collect();
    for _ in 0..5 {
        let error = workers
            .map(&cases, &|| {}, |case| {
                series::tube_run(tube::Params::PAPER, case)
            })
            .expect_err("negative pressure");
        assert_eq!(error.value, -20.0);
    }
}

/// One value of each kind; the crate `locomotion` tests them all.
#[test]
fn the_paper_design_has_the_reference_values() {
    let value = json(&["design"]);
    let design = &value["design"];
    let squeezed = design["squeezed"].as_array().expect("rows");
    let row = squeezed.iter().find(|row| row["indentation_mm"] == 3.0);
    let row = row.expect("a row for 3 mm");
    for (of, name, wanted) in [
        (design, "long_side_mm", 11.7300509332113),
        (design, "short_side_mm", 9.99813000365036),
        (design, "spacing_mm", 4.33754803248897),
        (design, "half_gap_mm", 9.76),
        (design, "largest_shortening_mm", 23.4506439263519),
        (row, "spacing_mm", 2.21978758204095),
        (row, "shortening_per_crescent_mm", 2.11776045044803),
        (row, "shortening_mm", 19.0598440540322),
        (row, "length_mm", 27.3445666079759),
        (row, "slope_by_indentation", 0.212495003176995),
        (row, "slope_by_alpha_mm", -7.22623347587000),
        (row, "slope_by_beta_mm", 4.52894511726358),
    ] {
        let got = of[name].as_f64().expect(name);
        let close = (got - wanted).abs() <= 1e-12 * f64::abs(wanted);
        assert!(close, "{name}: {got} {wanted}");
    }
    let capsule = design["thread_to_capsule_mm"].as_f64().expect("a number");
    assert_eq!(format!("{capsule:.2}"), "22.22");
    // The paper's own design meets the paper's own requirements.
    let rules = design["rules"].as_array().expect("rules");
    assert_eq!(rules.len(), 5);
    assert!(rules.iter().all(|rule| rule["objection"].is_null()));
    assert_eq!(design["best_alpha"]["alpha_deg"], 12.53);
    // The repaired Eq. (6) is far from zero everywhere.
    assert!(design["equation_6"]["repaired_residual"].as_f64() > Some(0.5));
    let value = json(&["design", "--exact-slopes"]);
    let phi = value["design"]["spacing_mm"].as_f64().expect("a number");
    assert!((phi - 4.0 * 9.76 / 9.0).abs() < 1e-12, "{phi}");
}

#[test]
fn another_design_is_judged_by_the_papers_requirements() {
    let line = "design --width-mm 20 --core-ratio 0.25 --alpha-deg 20 --beta-deg 50 --crescents 6 --indentation-mm 2.5";
    let value = json(&line.split(' ').collect::<Vec<_>>());
    let design = &value["design"];
    assert_eq!(design["half_gap_mm"], 7.5);
    assert_eq!(design["indentation_mm"], 2.5);
    let rules = design["rules"].as_array().expect("rules").iter();
    let objections: Vec<_> = rules.map(|rule| rule["objection"].as_str()).collect();
    let expected = [
        "less forward deformation",
        "fewer crescents under one wave",
        "no hold on the intestine",
        "less forward deformation",
        "too few contacts",
    ];
    assert_eq!(objections, expected.map(Some));
    // The smaller alpha shortens more.
    let d = |row: &Value| row["shortening_mm"].as_f64().expect("a number");
    let mut rows = design["squeezed"].as_array().expect("rows").iter();
    let here = rows.find(|row| row["indentation_mm"] == 2.5);
    let here = here.expect("the drawn one joins the table");
    assert!(d(&design["best_alpha"]) > d(here));
    // No working alpha is known below 10 deg.
    let narrow = json(&["design", "--alpha-deg", "5", "--beta-deg", "10"]);
    assert!(narrow["design"]["best_alpha"].is_null());
    // A gap smaller than the paper's indentation.
    let small = json(&["design", "--width-mm", "10"]);
    assert_eq!(small["design"]["indentation_mm"], 2.0);
}

/// A command line, and what its refusal says. `SWEEP` is a whole one, `RIG` a file of the rig's body.
const REFUSED: &str = "\
design --width-mm NaN => above 0, at most 1000 mm
design --core-ratio -0.2 => above 0 and below 1
design --alpha-deg 33.69 => above 0 and below 33.69 deg
design --beta-deg 90 => above 0 and below 90 deg
design --indentation-mm 9.77 => from 0 to 9.76 mm
design --least-alpha-deg 50 => at most 33.6
design --crescents 33 => 1 to 32
design --exact-slopes --alpha-deg 12 => --alpha-deg
design --model /nowhere/model.toml => /nowhere/model.toml
simulate => friction
simulate friction --threads 0 => 1 to 256
simulate sweep => --pressures-pa
simulate sweep --pressures-pa -5 => negative
simulate sweep --pressures-pa 2000000 => use at most 1000000
simulate sweep --pressures-pa 1 --indentations-mm 1 => cannot be used with
simulate sweep --frictions 1:1000:1 --pressures-pa 1:1000:1 => 1000000 runs are too many
simulate sweep --frictions 0 --pressures-pa 5000 => above 0, at most 10
simulate sweep --indentations-mm 5:15:5 => from 0 to 9.76 mm
SWEEP --vary body.cupling=1 => choose body.coupling
SWEEP --vary body.coupling => KEY=VALUE
SWEEP --vary rig.cycles=1.5 => whole number
SWEEP --vary body.coupling=1.5 => coupling chi = 1.5 is not usable
SWEEP --vary design.beta_deg=40 --vary design.tan_beta=1 => varied twice
SWEEP --vary rig.cycles=1 --set rig.cycles=2 => has no effect
simulate fold --thread-mm 30 => 23.45
simulate fold --indentation-mm NaN => from 0 to 12.2 mm
simulate pressure --set body.coupling=-1 => choose a value from 0 to 1
simulate pressure --set body.cupling=1 => no parameter body.cupling: choose body.coupling
simulate pressure --set body.coupling => KEY=VALUE
simulate pressure --set rig.cycles=1 --set rig.cycles=2 => rig.cycles is set twice
simulate pressure --body two => choose one, rig, tube
simulate pressure --model RIG --body tube => --body says tube
simulate roller --set body.friction=0.1 => --set body.friction has no effect";

/// Refused by the command line or by a model; nothing is written then.
#[test]
fn what_cannot_be_is_refused_with_what_can_be_and_leaves_no_file() {
    let folder = tempfile::tempdir().expect("folder");
    let (out, rig) = (folder.path().join("new"), folder.path().join("rig.toml"));
    fs::write(&rig, "from_body = \"rig\"\n").expect("written");
    let sweep = "simulate sweep --indentations-mm 1".split(' ');
    for case in REFUSED.lines() {
        let (line, says) = case.split_once(" => ").expect("a case");
        let mut words: Vec<_> = line.split(' ').collect();
        if words[0] == "SWEEP" {
            words.splice(..1, sweep.clone());
        }
        if words[0] == "simulate" && words.len() > 1 {
            words.extend(["--out", text(&out)]);
        }
        let rigs = words.iter_mut().filter(|word| **word == "RIG");
        rigs.for_each(|word| *word = text(&rig));
        let (code, said, err) = retrograde(&words);
        assert_eq!(code, 2, "{line}: {err}");
        let flat = err.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(flat.contains(says), "{line}: {err}");
        assert!(said.is_empty() && !out.exists(), "{line}: {said}");
    }
}

#[test]
fn the_structure_is_drawn_to_scale() {
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("structure.svg");
    let value = json(&["design", "--svg", file.to_str().expect("UTF-8")]);
    let design = &value["design"];
    let svg = fs::read_to_string(&file).expect("drawn");
    let (free, squeezed) = svg.split_once("<g class=\"squeezed\"").expect("two parts");
    let number = |name: &str| design[name].as_f64().expect("a number");
    let near = |got: f64, wanted: f64| assert!((got - wanted).abs() < 2e-3, "{got} {wanted}");
    let side = |from: (f64, f64), to: (f64, f64)| (from.0 - to.0).hypot(from.1 - to.1);
    let mut rows = design["squeezed"].as_array().expect("rows").iter();
    let row = rows.find(|row| row["indentation_mm"] == 5.05);
    for (part, of) in [(free, design), (squeezed, row.expect("there"))] {
        let sizes = ["spacing_mm", "width_mm", "length_mm"];
        let [spacing, width, length] = sizes.map(|name| of[name].as_f64().expect(name));
        let crescents = shapes(part, "crescent");
        assert_eq!(crescents.len(), 18, "nine on either side");
        for crescent in &crescents {
            let [short_root, tip, long_root] = crescent[..] else {
                panic!("a triangle")
            };
            // The sides keep their lengths at any indentation: Eqs. (1) and (2).
            near(side(short_root, tip), number("short_side_mm"));
            near(side(long_root, tip), number("long_side_mm"));
            near(long_root.0 - short_root.0, spacing);
            near(tip.1.abs(), width / 2.0);
            assert!(tip.0 < short_root.0, "the wings lean back to the tail");
        }
        let core = &shapes(part, "core")[0];
        near(core[1].0 - core[0].0, 9.0 * spacing);
        near(core[2].1 - core[1].1, number("core_mm"));
        near(core[1].0 - crescents[0][1].0, length);
    }
    for label in [
        "W = 24.40",
        "c = 4.88",
        "L = 41.21",
        "m ϕ = 9 x 4.338 = 39.04",
        "α = 12.53°, β = 33.69°",
        "l1 = 11.730, l2 = 9.998",
        "a = 5.05",
        "d = m d0 = 9 x 2.414 = 21.72",
        "L(a) = 26.13",
        "ψ = 1.924",
    ] {
        assert!(svg.contains(label), "{label}");
    }
}

/// A file of a drawing, and the labels in it.
const LABELS: &str = "\
map.svg: alpha / deg | beta / deg | this design | beta 33.69 deg | d at a = 5.05 mm / mm
friction.svg: time / s | friction coefficient | displacement at the end / mm | sentence (about 14 mm)
pressure.svg: peristaltic pressure / Pa | 6200 Pa | tail (model) | head (model) | text (about)
roller.svg: peristaltic indentation / mm | lubricated (model) | displacement at the end / mm
fold.svg: travel of the carriage / mm | unfolded (model)
snapshots-tube.svg: 3000 Pa | 7000 Pa | 20 s | parameters.csv
snapshots-roller.svg: a = 5.05 mm | 1300 mm of travel | 0.15 of the wall";

#[test]
fn the_charts_have_their_axes_units_and_origins() {
    let folder = tempfile::tempdir().expect("folder");
    json(&["design", "--map", text(&folder.path().join("map.svg"))]);
    for line in LABELS.lines() {
        let (file, labels) = line.split_once(": ").expect("a file");
        let of = match file {
            "map.svg" => folder.path(),
            _ => everything(),
        };
        let svg = fs::read_to_string(of.join(file)).expect(file);
        let is_whole = svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>");
        assert!(is_whole, "{file}");
        for label in labels.split(" | ") {
            assert!(svg.contains(label), "{label} in {file}");
        }
        let is_on_white = svg.contains("fill=\"#fff\"/>");
        assert!(is_on_white, "{file} is read on a dark page, too");
    }
}

/// The last snapshots match the ends of the series. A body keeps its number of crescents and the lengths of its
/// sides.
#[test]
fn the_snapshots_show_the_runs() {
    let file = everything().join("snapshots.csv");
    let (cases, moments) = (column(&file, "case"), column(&file, "moment"));
    let (crescents, roots) = (numbers(&file, "crescent"), numbers(&file, "tail_root_mm"));
    assert_eq!(cases.len(), 2 * 3 * 6 * 9);
    let tail = |case: &str, moment: &str| {
        let is_it =
            |&row: &usize| (&*cases[row], &*moments[row], crescents[row]) == (case, moment, 1.0);
        let row = (0..cases.len()).find(is_it);
        roots[row.unwrap_or_else(|| panic!("{case}, {moment}"))]
    };
    let model = Model::ONE;
    let mut pipe = model.tube().expect("a model");
    pipe.body.tail_mm = 4.2;
    let rig = model.rig().expect("a model");
    let (whole_s, whole_mm) = (["0 s", "20 s"], ["0 mm of travel", "1300 mm of travel"]);
    for (case, [start, end], mm) in [
        ("7000 Pa", whole_s, tube::run(pipe, 7000.0)),
        ("3000 Pa", whole_s, tube::run(pipe, 3000.0)),
        ("a = 5.05 mm", whole_mm, roller::run(rig, 5.05)),
        ("a = 1 mm", whole_mm, roller::run(rig, 1.0)),
    ] {
        let moved = tail(case, end) - tail(case, start);
        assert!((moved - mm.expect("a run")).abs() < 1e-9, "{case}: {moved}");
    }
}

#[test]
fn the_program_itself_knows_both_commands() {
    let folder = tempfile::tempdir().expect("folder");
    let output = Command::cargo_bin("retrograde")
        .expect("built")
        .current_dir(folder.path())
        .args(["--json", "simulate", "roller", "--threads", "2"])
        .output()
        .expect("starts");
    assert!(output.status.success());
    let value: Value = serde_json::from_slice(&output.stdout).expect("one object");
    assert_eq!(value["ok"], true);
    assert_eq!(value["series"]["roller"].as_array().map(Vec::len), Some(10));
    assert!(folder.path().join("retrograde-science/roller.csv").exists());
}
