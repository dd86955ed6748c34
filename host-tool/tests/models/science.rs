//! `design` and `simulate` as a researcher runs them: published values, the same bytes on any number of threads,
//! drawings to scale, refusals.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use crate::support::offline::{self, retrograde};
use assert_cmd::Command;
use locomotion::comparison;
use locomotion::comparison::frictions;
use locomotion::model::{Model, SETTINGS, Setting};
use locomotion::paper::{INDENTATIONS_MM, pressures_pa};
use locomotion::range::OutOfRange;
use locomotion::{roller, tube};
use report::science::series::{self, TubeCase};
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
const SHORT: [&str; 3] = [
    "--rig-cycles=1",
    "--tube-duration-s=4",
    "--tube-placements=2",
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

/// The published values of the model, to their significant digits.
#[test]
fn the_series_give_the_published_values() {
    let file = |name: &str| everything().join(name);

    let rounded = |name: &str, column: &str| -> Vec<String> {
        numbers(&file(name), column)
            .iter()
            .map(|mm| format!("{mm:.1}"))
            .collect()
    };
    let published = ["13.0", "22.0", "31.0", "38.9", "46.3"];
    assert_eq!(
        rounded("roller.csv", "displacement_mm"),
        [published, published].concat()
    );
    assert_eq!(
        numbers(&file("roller.csv"), "indentation_mm"),
        INDENTATIONS_MM.repeat(2)
    );
    let lubrication = column(&file("roller.csv"), "lubrication");
    assert_eq!(lubrication[..5], ["with"; 5]);
    assert_eq!(lubrication[5..], ["without"; 5]);

    let pressures: Vec<_> = pressures_pa().collect();
    assert_eq!(numbers(&file("pressure.csv"), "pressure_pa"), pressures);
    let tail = rounded("pressure.csv", "displacement_mm");
    let head = rounded("pressure.csv", "head_displacement_mm");
    for (pascals, tail_mm, head_mm) in [
        (3000.0, "1.0", "0.9"),
        (4200.0, "1.5", "1.4"),
        (5000.0, "2.0", "1.8"),
        (6200.0, "3.6", "3.4"),
        (7000.0, "15.2", "15.2"),
    ] {
        let index = pressures.iter().position(|p| *p == pascals).expect("there");
        assert_eq!(
            (tail[index].as_str(), head[index].as_str()),
            (tail_mm, head_mm),
            "{pascals} Pa"
        );
    }
    let about = column(&file("pressure.csv"), "paper_about_mm");
    assert_eq!((about[0].as_str(), about[10].as_str()), ("1.0", "15.0"));
    assert!(about[1..10].iter().all(String::is_empty));

    assert_eq!(
        numbers(&file("friction.csv"), "friction"),
        frictions().collect::<Vec<_>>()
    );
    assert_eq!(rounded("friction.csv", "displacement_mm"), ["15.2"; 25]);
    // A single sentence of the paper does not give 25 values.
    let about = column(&file("friction.csv"), "paper_about_mm");
    assert!(about.iter().all(String::is_empty));
    assert_eq!(
        numbers(&file("friction-time.csv"), "displacement_mm").len(),
        25 * 401
    );

    let passes = file("isolated.csv");
    let last = |name| numbers(&passes, name)[4];
    assert_eq!(format!("{:.2}", last("antegrade_mm")), "9.27");
    assert!(last("returning_mm").abs() < 0.1);

    let fold = file("fold.csv");
    let end = |name| *numbers(&fold, name).last().expect("rows");
    assert_eq!(end("travel_mm"), 1300.0);
    assert_eq!(format!("{:.1}", end("folded_mm")), "-96.8");
    assert_eq!(format!("{:.1}", end("unfolded_mm")), "46.3");
}

/// Where the model did not change, the older body with its older steps reproduces the older values.
#[test]
fn the_older_bodies_give_their_older_values() {
    let folder = tempfile::tempdir().expect("folder");
    simulate(
        folder.path(),
        &["roller", "--body", "rig", "--rig-step-mm", "0.5"],
    );
    let roller: Vec<_> = numbers(&folder.path().join("roller.csv"), "displacement_mm")
        .iter()
        .map(|mm| format!("{mm:.6}"))
        .collect();
    let published = [
        "17.861454",
        "25.538617",
        "33.702460",
        "40.247951",
        "46.560299",
    ];
    assert_eq!(roller, [published, published].concat());
    // One place, at 0 mm, with undivided steps and the friction ratio rounded to three decimals.
    simulate(
        folder.path(),
        &[
            "pressure",
            "--body=tube",
            "--friction-ratio=1.222",
            "--tube-wall-step-mm=1000",
            "--tube-placements=1",
            "--tube-tail-mm=-4.2",
        ],
    );
    let mm = numbers(&folder.path().join("pressure.csv"), "displacement_mm");
    assert_eq!(format!("{:.3} {:.3}", mm[0], mm[10]), "1.542 14.452");
}

/// Each run on the rig and in the tube has a wide band: a number without it would look like knowledge.
#[test]
fn each_displacement_stands_beside_its_prior_band() {
    let file = |name: &str| everything().join(name);
    let (low, high) = (
        numbers(&file("roller.csv"), "prior_5_mm"),
        numbers(&file("roller.csv"), "prior_95_mm"),
    );
    assert_eq!(low.len(), 10);
    assert!(high[4] > 4.0 * low[4], "{low:?} {high:?}");
    let mm = numbers(&file("roller.csv"), "displacement_mm");
    for ((low, mm), high) in low.iter().zip(&mm).zip(&high) {
        assert!(low < mm && mm < high, "{low} {mm} {high}");
    }
    let (low, high) = (
        numbers(&file("pressure.csv"), "prior_5_mm"),
        numbers(&file("pressure.csv"), "prior_95_mm"),
    );
    for (low, high) in low.iter().zip(&high) {
        assert!(low < high, "{low} {high}");
    }
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().to_str().expect("UTF-8");
    let (_, text, _) = retrograde(&["simulate", "roller", "--out", out]);
    for says in ["prior band/mm", "434 bodies, of 4000 drawn", "46.3"] {
        assert!(text.contains(says), "{says}: {text}");
    }
    assert!(!text.contains("46.29"), "no more digits than it deserves");
}

/// Every file says which model it shows.
#[test]
fn every_file_names_its_model() {
    let folder = tempfile::tempdir().expect("folder");
    simulate(
        folder.path(),
        &[&["all", "--coupling", "0.2"], &SHORT[..]].concat(),
    );
    for entry in fs::read_dir(folder.path()).expect("listed") {
        let path = entry.expect("entry").path();
        let text = fs::read_to_string(&path).expect("read");
        let file = path.display();
        match path.extension().and_then(|ending| ending.to_str()) {
            Some("csv") => {
                let origin = column(&path, "origin");
                assert!(
                    origin
                        .iter()
                        .all(|origin| origin == "model one, 4 values changed"),
                    "{file}"
                );
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
    simulate(folder.path(), &["fold", "--coupling", "0.2"]);
    let origin = column(&folder.path().join("fold.csv"), "origin");
    assert_eq!(origin[0], "model one, 1 value changed");
    let value = json(&[
        "simulate",
        "fold",
        "--out",
        folder.path().to_str().expect("UTF-8"),
    ]);
    assert!(
        value["origin"]
            .as_str()
            .expect("text")
            .starts_with("model: body one")
    );
}

/// Each parameter has an option and a key. Both give the same files, and so does the model file written.
#[test]
fn options_and_files_are_the_same_model() {
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("mine.toml");
    fs::write(
        &file,
        "from_body = \"rig\"\n[body]\ncoupling = 0.25\nfriction_ratio = \"facets\"\n[design]\nbeta_deg = 40\n[rig]\ncycles = 2\n",
    )
    .expect("written");
    let (one, two, three) = (
        folder.path().join("1"),
        folder.path().join("2"),
        folder.path().join("3"),
    );
    let file = file.to_str().expect("UTF-8");
    simulate(&one, &["roller", "--model", file]);
    simulate(
        &two,
        &[
            "roller",
            "--body",
            "rig",
            "--coupling",
            "0.25",
            "--friction-ratio",
            "facets",
            "--beta-deg",
            "40",
            "--rig-cycles",
            "2",
        ],
    );
    let written = one.join("model.toml");
    simulate(
        &three,
        &["roller", "--model", written.to_str().expect("UTF-8")],
    );
    for name in ["roller.csv", "roller.svg", "model.toml", "parameters.csv"] {
        let bytes = |folder: &Path| fs::read(folder.join(name)).expect(name);
        assert!(
            bytes(&one) == bytes(&two) && bytes(&two) == bytes(&three),
            "{name}"
        );
    }
    // An option overrides the file.
    simulate(
        &two,
        &[
            "roller",
            "--model",
            file,
            "--coupling",
            "0.15",
            "--tan-beta",
            "0.6",
        ],
    );
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
    assert!(!help.contains("--tube-poisson"), "{help}");
    let (_, short, _) = retrograde(&["simulate", "pressure", "-h"]);
    assert!(
        short.contains("--set <KEY=VALUE>") && !short.contains("tube.poisson"),
        "{short}"
    );
}

/// `--set` and the hidden option of the same parameter give the same model, whichever of the two names it has.
#[test]
fn a_hidden_option_sets_what_set_sets() {
    let folder = tempfile::tempdir().expect("folder");
    let (one, two) = (folder.path().join("set"), folder.path().join("hidden"));
    simulate(
        &one,
        &[
            "roller",
            "--set",
            "body.coupling=0.25",
            "--set=design.beta_deg = 40",
            "--set",
            "body.friction_ratio=facets",
            "--set",
            "rig.cycles=2",
        ],
    );
    simulate(
        &two,
        &[
            "roller",
            "--coupling=0.25",
            "--beta-deg=40",
            "--friction-ratio=facets",
            "--rig-cycles=2",
        ],
    );
    for name in ["roller.csv", "model.toml", "parameters.csv"] {
        let bytes = |folder: &Path| fs::read(folder.join(name)).expect(name);
        assert!(bytes(&one) == bytes(&two), "{name}");
    }
}

#[test]
fn a_model_that_cannot_be_is_refused_and_leaves_no_file() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().join("new");
    let file = folder.path().join("bad.toml");
    fs::write(&file, "[body]\ncupling = 0.2\n").expect("written");
    let bad = file.to_str().expect("UTF-8");
    let other = folder.path().join("rig.toml");
    fs::write(&other, "from_body = \"rig\"\n").expect("written");
    let rig = other.to_str().expect("UTF-8");
    for (args, says) in [
        (
            &["pressure", "--coupling", "1.5"][..],
            "coupling chi = 1.5 is not usable",
        ),
        (
            &["pressure", "--coupling", "-1"],
            "choose a value from 0 to 1",
        ),
        (
            &["pressure", "--coupling", "much"],
            "body.coupling: it has to be a number",
        ),
        (&["pressure", "--crescents", "9.5"], "whole number"),
        (
            &["pressure", "--tube-critical-pa", "0"],
            "critical pressure = 0 Pa",
        ),
        (
            &["pressure", "--friction-ratio", "facets", "--friction", "2"],
            "the facets lock",
        ),
        (
            &["pressure", "--alpha-deg", "12", "--tan-alpha", "0.2"],
            "set the same",
        ),
        (&["pressure", "--body", "two"], "choose one, rig, tube"),
        (
            &["pressure", "--model", bad],
            "no parameter body.cupling: choose body.coupling",
        ),
        (
            &["pressure", "--model", rig, "--body", "tube"],
            "--body says tube",
        ),
        (
            &["pressure", "--model", "/nowhere/model.toml"],
            "/nowhere/model.toml",
        ),
        (&["pressure", "--rig-stroke-mm", "0"], "stroke = 0 mm"),
        (
            &["roller", "--set", "body.friction=0.1"],
            "--set body.friction would do nothing",
        ),
        (
            &["pressure", "--set", "body.cupling=1"],
            "no parameter body.cupling: choose body.coupling",
        ),
        (&["pressure", "--set", "body.coupling"], "KEY=VALUE"),
        (
            &[
                "pressure",
                "--set",
                "body.coupling=0.1",
                "--coupling",
                "0.2",
            ],
            "body.coupling is set twice",
        ),
        (&["compare", "--coupling", "1.5"], "coupling chi = 1.5"),
    ] {
        let line = [&["simulate", "--out", out.to_str().expect("UTF-8")], args].concat();
        let (code, text, err) = retrograde(&line);
        assert!(code == 2 || code == 1, "{args:?}: {code}");
        let flat = err.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(flat.contains(says), "{args:?}: {err}");
        assert!(text.is_empty() && !out.exists(), "{args:?}");
    }
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
    assert!((alpha - 12.53).abs() < 1e-12, "{alpha}");
    let (code, _, err) = retrograde(&["design", "--model", "/nowhere/model.toml"]);
    assert!(code != 0 && err.contains("/nowhere/model.toml"), "{err}");
}

/// Every number of a CSV file parses back to the model's exact bits.
#[test]
fn the_numbers_round_trip() -> Result<(), OutOfRange> {
    let ends = numbers(&everything().join("pressure.csv"), "displacement_mm");
    for (pressure, end) in pressures_pa().zip(ends) {
        assert_eq!(
            end.to_bits(),
            tube::averaged(tube::Params::PAPER, pressure)?
                .tail_mm
                .to_bits()
        );
    }
    Ok(())
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
    let sweep = &[
        "sweep",
        "--frictions",
        "0.05:0.25:0.05",
        "--pressures-pa",
        "3000:7000:1000",
    ][..];
    let rig = &[
        "sweep",
        "--frictions",
        "0.08,0.2",
        "--indentations-mm",
        "0.5:9.5:0.5",
    ][..];
    for (args, count) in [(&["all"][..], 17), (sweep, 4), (rig, 4)] {
        let one = files("1", args);
        assert_eq!(one.len(), count, "{args:?}");
        for threads in ["1", "2", "7"] {
            assert!(files(threads, args) == one, "{threads} threads, {args:?}");
        }
    }
}

#[test]
fn a_sweep_has_every_pair_in_order() {
    let folder = tempfile::tempdir().expect("folder");
    simulate(
        folder.path(),
        &[
            "sweep",
            "--frictions",
            "0.1,0.2",
            "--pressures-pa",
            "3000:5000:1000",
        ],
    );
    let file = folder.path().join("sweep-tube.csv");
    assert_eq!(numbers(&file, "friction"), [0.1, 0.1, 0.1, 0.2, 0.2, 0.2]);
    assert_eq!(
        numbers(&file, "pressure_pa"),
        [3000.0, 4000.0, 5000.0].repeat(2)
    );
    let mm = numbers(&file, "displacement_mm");
    assert_eq!(format!("{:.1}", mm[2]), "2.0");
    assert_eq!(mm[..3], mm[3..], "friction cancels");
}

/// Reports the error of the first failing case in order, whichever thread fails first.
#[test]
fn the_first_error_in_order_is_reported() {
    let workers = series::Workers::new(Some(7)).expect("threads");
    let cases: Vec<_> = (0..40)
        .map(|index| TubeCase {
            friction: 0.15,
            pressure_pa: if index < 20 { 100.0 } else { -f64::from(index) },
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

#[test]
fn the_paper_design_has_the_reference_values() {
    let value = json(&["design"]);
    let design = &value["design"];
    let close = |got: &Value, wanted: f64| {
        let got = got.as_f64().expect("a number");
        assert!(
            (got - wanted).abs() <= 1e-12 * wanted.abs(),
            "{got} {wanted}"
        );
    };
    close(&design["long_side_mm"], 11.7300509332113);
    close(&design["short_side_mm"], 9.99813000365036);
    close(&design["spacing_mm"], 4.33754803248897);
    close(&design["half_gap_mm"], 9.76);
    close(&design["largest_shortening_mm"], 23.4506439263519);
    let rows = design["squeezed"].as_array().expect("rows");
    // Columns: a, psi, d0, d, L(a), dd0/da. The crate `locomotion` tests more of them.
    for [a, psi, d0, d, length, slope] in [
        [
            0.0,
            4.33754803248897,
            0.0,
            0.0,
            41.2070343116459,
            2.99955401133805,
        ],
        [
            3.0,
            2.21978758204095,
            2.11776045044803,
            19.0598440540322,
            27.3445666079759,
            0.212495003176995,
        ],
        [
            9.76,
            1.73192092956098,
            2.60562710292799,
            23.4506439263519,
            25.5854183696992,
            0.0,
        ],
    ] {
        let row = rows
            .iter()
            .find(|row| row["indentation_mm"] == a)
            .unwrap_or_else(|| panic!("no row for {a} mm"));
        close(&row["spacing_mm"], psi);
        close(&row["shortening_per_crescent_mm"], d0);
        close(&row["shortening_mm"], d);
        close(&row["length_mm"], length);
        close(&row["slope_by_indentation"], slope);
        if a == 3.0 {
            close(&row["slope_by_alpha_mm"], -7.22623347587000);
            close(&row["slope_by_beta_mm"], 4.52894511726358);
        }
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
}

#[test]
fn another_design_is_judged_by_the_papers_requirements() {
    let value = json(&[
        "design",
        "--width-mm",
        "20",
        "--core-ratio",
        "0.25",
        "--alpha-deg",
        "20",
        "--beta-deg",
        "50",
        "--crescents",
        "6",
        "--indentation-mm",
        "2.5",
    ]);
    let design = &value["design"];
    assert_eq!(design["half_gap_mm"], 7.5);
    assert_eq!(design["indentation_mm"], 2.5);
    let objections: Vec<_> = design["rules"]
        .as_array()
        .expect("rules")
        .iter()
        .map(|rule| rule["objection"].as_str())
        .collect();
    assert_eq!(
        objections,
        [
            Some("less forward deformation"),
            Some("fewer crescents under one wave"),
            Some("no hold on the intestine"),
            Some("less forward deformation"),
            Some("too few contacts"),
        ]
    );
    // The smaller alpha shortens more.
    let d = |row: &Value| row["shortening_mm"].as_f64().expect("a number");
    let rows = design["squeezed"].as_array().expect("rows");
    let here = rows
        .iter()
        .find(|row| row["indentation_mm"] == 2.5)
        .expect("the drawn one joins the table");
    assert!(d(&design["best_alpha"]) > d(here));
    // No working alpha is known below 10 deg.
    let narrow = json(&["design", "--alpha-deg", "5", "--beta-deg", "10"]);
    assert!(narrow["design"]["best_alpha"].is_null());
    // A gap smaller than the paper's indentation.
    let small = json(&["design", "--width-mm", "10"]);
    assert_eq!(small["design"]["indentation_mm"], 2.0);
}

#[test]
fn exact_slopes_are_the_papers_ratios() {
    let value = json(&["design", "--exact-slopes"]);
    let phi = value["design"]["spacing_mm"].as_f64().expect("a number");
    assert!((phi - 4.0 * 9.76 / 9.0).abs() < 1e-12, "{phi}");
}

#[test]
fn what_cannot_be_is_refused_with_the_admissible_range() {
    for (args, says) in [
        (
            &["design", "--width-mm", "0"][..],
            "above 0, at most 1000 mm",
        ),
        (&["design", "--width-mm", "NaN"], "above 0, at most 1000 mm"),
        (&["design", "--core-ratio", "1"], "above 0 and below 1"),
        (&["design", "--core-ratio", "-0.2"], "above 0 and below 1"),
        (
            &["design", "--alpha-deg", "33.69"],
            "above 0 and below 33.69 deg",
        ),
        (
            &["design", "--alpha-deg", "0"],
            "above 0 and below 33.69 deg",
        ),
        (&["design", "--beta-deg", "90"], "above 0 and below 90 deg"),
        (&["design", "--indentation-mm", "9.77"], "from 0 to 9.76 mm"),
        (&["design", "--indentation-mm", "-1"], "from 0 to 9.76 mm"),
        (&["design", "--least-alpha-deg", "50"], "at most 33.6"),
        (&["design", "--crescents", "0"], "1 to 32"),
        (&["design", "--crescents", "33"], "1 to 32"),
        (
            &["design", "--exact-slopes", "--alpha-deg", "12"],
            "--alpha-deg",
        ),
        (&["simulate"], "friction"),
        (&["simulate", "friction", "--threads", "0"], "1 to 256"),
        (&["simulate", "sweep"], "--pressures-pa"),
        (
            &["simulate", "sweep", "--pressures-pa", "1:2:3"],
            "lead to 1 or 4",
        ),
        (&["simulate", "sweep", "--pressures-pa", "-5"], "negative"),
        (
            &["simulate", "sweep", "--pressures-pa", "2000000"],
            "use at most 1000000",
        ),
        (
            &[
                "simulate",
                "sweep",
                "--pressures-pa",
                "1",
                "--indentations-mm",
                "1",
            ],
            "cannot be used with",
        ),
        (
            &[
                "simulate",
                "sweep",
                "--frictions",
                "1:1000:1",
                "--pressures-pa",
                "1:1000:1",
            ],
            "1000000 runs are too many",
        ),
    ] {
        let (code, out, err) = retrograde(args);
        assert_eq!(code, 2, "{args:?}: {err}");
        assert!(err.contains(says), "{args:?}: {err}");
        assert!(out.is_empty(), "{args:?}: {out}");
    }
}

/// Only a model can refuse these numbers. Nothing may be written then.
#[test]
fn what_a_model_does_not_cover_is_refused_and_leaves_no_file() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().join("new");
    for (args, says) in [
        (
            &["sweep", "--frictions", "0", "--pressures-pa", "5000"][..],
            "above 0, at most 10",
        ),
        (
            &["sweep", "--indentations-mm", "5:15:5"],
            "from 0 to 9.76 mm",
        ),
        (&["fold", "--thread-mm", "30"], "23.45"),
        (&["fold", "--indentation-mm", "NaN"], "from 0 to 12.2 mm"),
    ] {
        let line = [&["simulate", "--out", out.to_str().expect("UTF-8")], args].concat();
        let (code, _, err) = retrograde(&line);
        assert_eq!(code, 2, "{args:?}: {err}");
        assert!(err.contains(says), "{args:?}: {err}");
        assert!(!out.exists(), "{args:?}");
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
    let row = design["squeezed"]
        .as_array()
        .expect("rows")
        .iter()
        .find(|row| row["indentation_mm"] == 5.05)
        .expect("there");
    for (part, spacing, width, length) in [
        (
            free,
            number("spacing_mm"),
            number("width_mm"),
            number("length_mm"),
        ),
        (
            squeezed,
            row["spacing_mm"].as_f64().expect("psi"),
            row["width_mm"].as_f64().expect("W - 2a"),
            row["length_mm"].as_f64().expect("L(a)"),
        ),
    ] {
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

#[test]
fn the_charts_have_their_axes_units_and_origins() {
    let folder = tempfile::tempdir().expect("folder");
    let map = folder.path().join("map.svg");
    json(&["design", "--map", map.to_str().expect("UTF-8")]);
    for (file, labels) in [
        (
            "map.svg",
            &[
                "alpha / deg",
                "beta / deg",
                "this design",
                "beta 33.69 deg",
                "d at a = 5.05 mm / mm",
            ][..],
        ),
        (
            "friction.svg",
            &[
                "time / s",
                "friction coefficient",
                "displacement at the end / mm",
                "sentence (about 14 mm)",
            ],
        ),
        (
            "pressure.svg",
            &[
                "peristaltic pressure / Pa",
                "6200 Pa",
                "tail (model)",
                "head (model)",
                "prior band",
                "text (about)",
            ],
        ),
        (
            "roller.svg",
            &[
                "peristaltic indentation / mm",
                "lubricated (model)",
                "prior band",
                "displacement at the end / mm",
            ],
        ),
        ("isolated.svg", &["antegrade (model)", "returning (model)"]),
        (
            "fold.svg",
            &["travel of the carriage / mm", "unfolded (model)"],
        ),
        (
            "snapshots-tube.svg",
            &["3000 Pa", "7000 Pa", "20 s", "parameters.csv"],
        ),
        (
            "snapshots-roller.svg",
            &["a = 5.05 mm", "1300 mm of travel", "0.15 of the wall"],
        ),
    ] {
        let of = if file == "map.svg" {
            folder.path()
        } else {
            everything()
        };
        let svg = fs::read_to_string(of.join(file)).expect(file);
        assert!(
            svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"),
            "{file}"
        );
        for label in labels {
            assert!(svg.contains(label), "{label} in {file}");
        }
        assert!(
            svg.contains("fill=\"#fff\"/>"),
            "{file} is read on a dark page, too"
        );
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
        (0..cases.len())
            .find(|&row| cases[row] == case && moments[row] == moment && crescents[row] == 1.0)
            .map(|row| roots[row])
            .unwrap_or_else(|| panic!("{case}, {moment}"))
    };
    let model = Model::ONE;
    let mut pipe = model.tube().expect("a model");
    pipe.body.tail_mm = 4.2;
    let rig = model.rig().expect("a model");
    for (case, start, end, mm) in [
        ("7000 Pa", "0 s", "20 s", tube::run(pipe, 7000.0)),
        ("3000 Pa", "0 s", "20 s", tube::run(pipe, 3000.0)),
        (
            "a = 5.05 mm",
            "0 mm of travel",
            "1300 mm of travel",
            roller::run(rig, 5.05),
        ),
        (
            "a = 1 mm",
            "0 mm of travel",
            "1300 mm of travel",
            roller::run(rig, 1.0),
        ),
    ] {
        let moved = tail(case, end) - tail(case, start);
        assert!((moved - mm.expect("a run")).abs() < 1e-9, "{case}: {moved}");
    }
}

#[test]
fn compare_prints_the_table_of_the_manual() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().to_str().expect("UTF-8");
    let (code, said, err) = retrograde(&["simulate", "compare", "--out", out]);
    assert_eq!((code, err.as_str()), (0, ""));
    let manual = include_str!("../../../docs/paper-comparison.md").replace("\r\n", "\n");
    let (_, rest) = manual
        .split_once("comparison: begin -->\n")
        .expect("a table");
    let (table, _) = rest.split_once("<!-- comparison: end").expect("a table");
    let rest = said.strip_prefix(table).expect("the table of the manual");
    let lines: Vec<_> = rest.lines().collect();
    assert_eq!(lines.len(), 2, "{rest}");
    for says in [
        "first 200 of 4000",
        "seed 2022",
        "434 on the rig, 165 in the tube",
        "Wilson",
    ] {
        assert!(lines[0].contains(says), "{says}: {rest}");
    }
    assert!(lines[1].ends_with("comparison.csv"), "{rest}");
}

/// Output of `simulate compare` with few bodies: JSON and CSV.
fn compared(folder: &Path, args: &[&str]) -> (Value, Vec<u8>) {
    let out = folder.to_str().expect("UTF-8");
    let line = ["simulate", "compare", "--bodies", "20", "--out", out];
    let value = json(&[&line[..], args].concat());
    let csv = fs::read(folder.join("comparison.csv")).expect("a table");
    (value, csv)
}

/// Text, JSON and CSV give the same shares, whatever the number of threads. A posterior is named and determines its
/// column.
#[test]
fn compare_says_how_probable_each_sentence_is() {
    let folder = tempfile::tempdir().expect("folder");
    let (plain, bytes) = compared(&folder.path().join("plain"), &["--threads", "1"]);
    let rows = plain["comparison"].as_array().expect("rows");
    assert_eq!(rows.len(), comparison::ROWS);
    assert_eq!(
        (&plain["bodies"]["prior"], &plain["seed"]),
        (&20.into(), &2022.into())
    );
    assert_eq!(plain["posterior"], Value::Null);
    let (_, again) = compared(&folder.path().join("again"), &["--threads", "3"]);
    assert!(bytes == again, "the threads change the table");
    let mut reader = csv::Reader::from_reader(bytes.as_slice());
    let header = reader.headers().expect("a header").clone();
    for (record, row) in reader.records().zip(rows) {
        let record = record.expect("a row");
        for (name, cell) in header.iter().zip(&record) {
            let expected = match (name, &row[name]) {
                ("origin", _) => {
                    assert!(
                        cell.contains("20 of 4000") && cell.contains("seed 2022"),
                        "{cell}"
                    );
                    continue;
                }
                (_, Value::Null) => String::new(),
                (_, Value::String(text)) => text.clone(),
                (_, Value::Number(number)) => {
                    let (number, cell) = (number.as_f64(), cell.parse::<f64>().ok());
                    assert_eq!(cell, number, "{name}");
                    continue;
                }
                (_, other) => other.to_string(),
            };
            assert_eq!(cell, expected, "{name}: {row}");
        }
    }
    let of = |value: &Value, quantity: &str| -> Value {
        let rows = value["comparison"].as_array().expect("rows");
        let found = rows.iter().find(|row| row["quantity"] == quantity);
        found.unwrap_or_else(|| panic!("{quantity}")).clone()
    };
    let sure = of(&plain, "phi at beta = 45 deg less phi");
    assert_eq!(
        (&sure["prior_share"], &sure["body_decides"]),
        (&1.0.into(), &false.into())
    );
    assert_eq!(sure["prior_low"], Value::Null);
    assert_eq!(sure["kind"], "arithmetic");
    assert_eq!(
        of(&plain, "bend of the two lines nearest to the series")["kind"],
        "miss"
    );

    let hardly = "greatest share of an antegrade pass, a_1 to a_5";
    let (hooked, slippery) = ([0.15, 40.0, 0.0007, 0.1], [0.15, 1.3, 0.0007, 0.1]);
    let samples = [hooked, slippery, slippery, slippery];
    let file =
        crate::support::made_up::posterior(&folder.path().join("made-up.toml"), "", &samples);
    let (value, csv) = compared(&folder.path().join("fitted"), &["--model", &file]);
    let said = value["posterior"].as_str().expect("named");
    for says in [
        "4 bodies of the posterior of 2 displacements",
        "origin: virtual",
        "worth 4",
    ] {
        assert!(said.contains(says), "{says}: {said}");
    }
    assert!(String::from_utf8_lossy(&csv).contains(said));
    assert_eq!(
        of(&value, "upward bends of 9")["posterior_share"],
        Value::Null
    );
    let (found, before) = (of(&value, hardly), of(&plain, hardly));
    assert_eq!(found["prior_share"], before["prior_share"]);
    // The sentence holds for one of the four bodies.
    assert_eq!(found["posterior_share"], 0.25);
    assert_ne!(found["prior_share"], 0.25);
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
