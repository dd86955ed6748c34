//! `simulate crescent` as a researcher runs it. Its files contain the manual's numbers, name the beam model, and do
//! not depend on threads. Options without effect are refused.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use crate::support::offline::{self, retrograde};
use serde_json::Value;

const MODEL: &str = "beam model, not validated against a rig";

fn crescent(folder: &Path, args: &[&str]) -> String {
    let out = folder.to_str().expect("UTF-8");
    let (code, text, err) =
        retrograde(&[&["simulate", "crescent", "--out", out][..], args].concat());
    assert_eq!((code, err.as_str()), (0, ""), "{args:?}");
    text
}

/// The command without options, run once for all tests that only read its files.
fn default_run() -> &'static (PathBuf, String) {
    static RUN: OnceLock<(PathBuf, String)> = OnceLock::new();
    RUN.get_or_init(|| {
        let folder = offline::folder("crescent", "default");
        let text = crescent(&folder, &[]);
        (folder, text)
    })
}

/// Header and rows of a CSV file from the run without options.
fn rows(name: &str) -> (Vec<String>, Vec<Vec<String>>) {
    let mut reader = csv::Reader::from_path(default_run().0.join(name)).expect(name);
    let texts = |record: &csv::StringRecord| record.iter().map(str::to_owned).collect();
    let header = texts(reader.headers().expect("a header"));
    let rows = reader
        .records()
        .map(|row| texts(&row.expect("a row")))
        .collect();
    (header, rows)
}

fn number(text: &str) -> f64 {
    text.parse().unwrap_or_else(|_| panic!("{text}"))
}

/// Numbers after a label in a table of `docs/science.md`.
fn manual(label: &str) -> Vec<f64> {
    let manual = include_str!("../../../docs/science.md");
    let (_, section) = manual
        .split_once("## The crescent as a beam")
        .expect("section");
    let start = format!("| {label} | ");
    let line = section.lines().find(|line| line.starts_with(&start));
    let line = line.unwrap_or_else(|| panic!("no row {label}"));
    line[start.len()..]
        .trim_end_matches(" |")
        .split(" | ")
        .map(number)
        .collect()
}

#[test]
fn the_curve_over_thread_is_that_of_the_manual() {
    let (header, rows) = rows("crescent-thread.csv");
    assert_eq!(
        header,
        [
            "thread_mm",
            "low_mm",
            "median_mm",
            "high_mm",
            "reversed",
            "origin"
        ]
    );
    assert_eq!(rows.len(), 23);
    let at = manual("thread, mm");
    assert_eq!(at.len(), 12, "from 0 to 22 mm by 2");
    for (column, label, half_digit) in [
        (1, "5 %, mm", 0.05),
        (2, "median, mm", 0.05),
        (3, "95 %, mm", 0.05),
        (4, "share reversed", 0.005),
    ] {
        for (thread_mm, written) in at.iter().zip(manual(label)) {
            let row = rows.iter().find(|row| number(&row[0]) == *thread_mm);
            let got = number(&row.expect("a row for each")[column]);
            assert!(
                (got - written).abs() <= half_digit + 1e-9,
                "{label} at {thread_mm} mm: {got}, in the manual {written}"
            );
        }
    }
}

#[test]
fn the_least_alpha_is_that_of_the_manual() {
    let (_, rows) = rows("crescent-alpha.csv");
    for (column, label) in [
        (0, "friction"),
        (1, "least alpha, deg"),
        (2, "printed 0.15 mm off, deg"),
    ] {
        for (row, written) in rows.iter().zip(manual(label)) {
            let got = number(&row[column]);
            assert!((got - written).abs() <= 0.05, "{label}: {got}, {written}");
        }
    }
    assert_eq!(rows.len(), 3);
}

/// Golden forces without friction, the easy and the hard way. Their order makes the wing a pawl.
#[test]
fn the_forces_are_these() {
    let (header, rows) = rows("crescent-force.csv");
    assert_eq!(
        header[..5],
        [
            "indentation_mm",
            "force_n",
            "easy_n",
            "hard_n",
            "energy_n_mm"
        ]
    );
    assert_eq!(rows.len(), 51);
    let near = |index: usize| -> Vec<String> {
        let numbers = rows[index][..5].iter().map(|text| number(text));
        numbers.map(|number| format!("{number:.3}")).collect()
    };
    assert_eq!(near(34), ["3.450", "0.393", "0.354", "0.438", "1.012"]);
    assert_eq!(near(50), ["5.050", "0.498", "0.462", "0.536", "1.704"]);
    for row in &rows {
        let [free, easy, hard] = [1, 2, 3].map(|column| number(&row[column]));
        assert!(easy < free && free < hard, "{row:?}");
    }
}

#[test]
fn every_file_names_the_beam_and_how_far_it_was_validated() {
    let (folder, text) = default_run();
    assert!(text.contains(MODEL), "{text}");
    assert!(text.contains("68 of 2000 draws kept, 0 without an answer"));
    let mut files = vec![];
    for entry in fs::read_dir(folder).expect("listed") {
        let path = entry.expect("entry").path();
        let name = path
            .file_name()
            .expect("name")
            .to_string_lossy()
            .into_owned();
        if name.ends_with(".csv") {
            let (header, rows) = rows(&name);
            assert_eq!(header.last().map(String::as_str), Some("origin"), "{name}");
            assert!(
                rows.iter()
                    .all(|row| row.last().map(String::as_str) == Some(MODEL)),
                "{name}"
            );
        }
        files.push(name);
    }
    files.sort();
    assert_eq!(
        files,
        [
            "crescent-alpha.csv",
            "crescent-force.csv",
            "crescent-inputs.csv",
            "crescent-parameters.csv",
            "crescent-thread.csv",
            "crescent.svg"
        ]
    );
    let svg = fs::read_to_string(folder.join("crescent.svg")).expect("drawn");
    let (_, head) = svg.split_once("<desc>Origin: ").expect("a description");
    let (description, drawn) = head.split_once("</desc>").expect("closed");
    assert!(
        description.starts_with(MODEL) && description.contains("68 of 2000"),
        "{description}"
    );
    for label in [
        MODEL,
        "force on one wing / N",
        "indentation of the wing / mm",
        "thread drawn in / mm",
        "displacement in 40 s / mm",
        "share that goes tailward",
        "5 to 95 % of the kept draws (model)",
        "median (model)",
        "fill=\"#fff\"/>",
    ] {
        assert!(drawn.contains(label), "{label}");
    }
}

/// Assumed inputs are called assumed. Drawn inputs come with their ranges and reasons.
#[test]
fn inputs_and_parameters_carry_their_sources() {
    let (header, inputs) = rows("crescent-inputs.csv");
    assert_eq!(
        header[..6],
        ["name", "low", "high", "unit", "logarithmic", "source"]
    );
    assert_eq!(inputs.len(), 7);
    for row in &inputs {
        assert!(
            number(&row[1]) < number(&row[2]) && !row[5].is_empty(),
            "{row:?}"
        );
    }
    let (_, parameters) = rows("crescent-parameters.csv");
    assert_eq!(parameters.len(), 10);
    for row in &parameters {
        assert!(
            ["paper", "assumed"].contains(&row[4].as_str()) && !row[5].is_empty(),
            "{row:?}"
        );
    }
}

#[test]
fn the_seed_decides_and_the_threads_do_not() {
    let folder = tempfile::tempdir().expect("folder");
    let run = |name: &str, args: &[&str]| -> Vec<u8> {
        let out = folder.path().join(name);
        crescent(&out, &[&["--draws", "400"], args].concat());
        fs::read(out.join("crescent-thread.csv")).expect("written")
    };
    let one = run("1", &["--threads", "1"]);
    assert!(one == run("7", &["--threads", "7"]));
    assert!(one != run("seed", &["--seed", "2"]));
}

#[test]
fn what_would_do_nothing_or_too_little_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().join("new");
    for (args, says) in [
        (
            &["--set", "body.coupling=0.2"][..],
            "--set body.coupling would do nothing",
        ),
        (&["--body", "rig"], "--body would do nothing"),
        (&["--model", "model.toml"], "--model would do nothing"),
        (&["--tube-poisson", "0.4"], "crescent-inputs.csv"),
        (&["--draws", "20"], "of 20 draws do as the paper says"),
        (&["--draws", "20"], "draw more: of 2000 about 60 are kept"),
        (&["--draws", "19"], "20 to 20000"),
        (&["--draws", "20001"], "20 to 20000"),
        (&["--seed", "-1"], "--seed"),
        (&["--threads", "0"], "1 to 256"),
    ] {
        let out = out.to_str().expect("UTF-8");
        let line = [&["simulate", "crescent", "--out", out], args].concat();
        let (code, text, err) = retrograde(&line);
        assert_eq!(code, 2, "{args:?}: {err}");
        let flat = err.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(flat.contains(says), "{args:?}: {err}");
        assert!(text.is_empty() && !Path::new(out).exists(), "{args:?}");
    }
}

#[test]
fn json_has_what_the_screen_has() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().to_str().expect("UTF-8");
    let (code, text, err) = retrograde(&[
        "--json", "simulate", "crescent", "--draws", "400", "--out", out,
    ]);
    assert_eq!(code, 0, "{err}");
    let value: Value = serde_json::from_str(&text).expect("one object");
    assert_eq!(value["origin"], MODEL);
    let crescent = &value["series"]["crescent"];
    assert_eq!(crescent["thread"].as_array().map(Vec::len), Some(23));
    assert_eq!(
        (&crescent["seed"], &crescent["draws"]),
        (&1.into(), &400.into())
    );
    assert!(crescent["kept"].as_u64() >= Some(10));
    assert_eq!(value["files"].as_array().map(Vec::len), Some(6));
}
