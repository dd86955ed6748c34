//! `design --optimise` as a researcher runs it. Every listed design keeps the limits, none beats another listed one,
//! the compared design is included, and the seed determines the result.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use crate::support::offline::{self, retrograde};
use locomotion::beam::crescent::{Shape, Wing};
use locomotion::kinematics::Design;
use serde_json::Value;

fn optimise(folder: &Path, args: &[&str]) -> String {
    let out = folder.to_str().expect("UTF-8");
    let line = ["design", "--optimise", "--tries", "300", "--out", out];
    let (code, text, err) = retrograde(&[&line[..], args].concat());
    assert_eq!((code, err.as_str()), (0, ""), "{args:?}");
    text
}

#[derive(Clone, Debug, PartialEq, serde::Deserialize)]
struct Row {
    design: String,
    alpha_deg: f64,
    beta_deg: f64,
    core_ratio: f64,
    crescents: u8,
    length_mm: f64,
    thread_mm: f64,
    folded_mm: f64,
    spacing_mm: f64,
    force_n: f64,
    displacement_mm: f64,
    prior_5_mm: Option<f64>,
    prior_95_mm: Option<f64>,
    posterior_5_mm: Option<f64>,
    posterior_95_mm: Option<f64>,
    beats: Option<f64>,
    dominated_by: usize,
    breaks: String,
    at_bound: String,
    origin: String,
}

fn rows(folder: &Path) -> Vec<Row> {
    let mut reader = csv::Reader::from_path(folder.join("optimise.csv")).expect("a table");
    reader
        .deserialize()
        .map(|row| row.expect("a row"))
        .collect()
}

/// The front, and the compared design after it.
fn split(rows: &[Row]) -> (&[Row], &Row) {
    let (own, front) = rows.split_last().expect("rows");
    assert!(front.iter().all(|row| row.design == "front"));
    assert_ne!(own.design, "front");
    (front, own)
}

/// A model file for a table that is quick to calculate and hardly less exact.
fn quick(folder: &Path) -> String {
    fs::create_dir_all(folder).expect("made");
    let file = folder.join("quick.toml");
    fs::write(
        &file,
        "[design]\nalpha_deg = 12.53\nbeta_deg = 33.69\n[rig]\nstep_mm = 0.5\n",
    )
    .expect("written");
    format!("--model={}", file.display())
}

/// A search with the default limits, made once for all tests that only read it.
fn default_run() -> &'static (PathBuf, String) {
    static RUN: OnceLock<(PathBuf, String)> = OnceLock::new();
    RUN.get_or_init(|| {
        let folder = offline::folder("optimise", "default");
        let text = optimise(&folder, &[]);
        (folder, text)
    })
}

struct Limits {
    length_mm: f64,
    folded_mm: f64,
    thread_mm: f64,
    spacing_mm: f64,
    force_n: f64,
    indentation_mm: f64,
    alpha_deg: f64,
    core_ratio: f64,
}

const DEFAULT: Limits = Limits {
    length_mm: 42.0,
    folded_mm: 15.77,
    thread_mm: 23.0,
    spacing_mm: 1.6,
    force_n: 0.55,
    indentation_mm: 5.05,
    alpha_deg: 12.53,
    core_ratio: 0.2,
};

/// Recalculates each property from the printed geometry and checks it against the table and the limits.
fn keeps(row: &Row, limits: &Limits) {
    let design = Design::new(
        24.4,
        row.core_ratio * 24.4,
        row.alpha_deg,
        row.beta_deg,
        row.crescents,
    )
    .expect("a design");
    let drawn_mm = (24.4 - limits.folded_mm) / 2.0;
    let squeezed_mm = drawn_mm.max(limits.indentation_mm);
    let wing = Wing {
        design,
        ..Wing::PAPER
    };
    let roller = Shape::Roller {
        radius_mm: 20.0,
        behind_mm: 0.0,
    };
    let force = wing.squeezed(0.0, limits.indentation_mm, roller, 0.0);
    for (written, again) in [
        (row.length_mm, design.length_mm(0.0).expect("a length")),
        (
            row.thread_mm,
            design.shortening_mm(drawn_mm).expect("a thread"),
        ),
        (
            row.spacing_mm,
            design.squeezed_spacing_mm(squeezed_mm).expect("a spacing"),
        ),
        (row.force_n, force.expect("a force").value.inward_n),
    ] {
        assert!((written - again).abs() < 1e-6, "{written} {again}: {row:?}");
    }
    let tiny = 1e-9;
    assert!(row.length_mm <= limits.length_mm, "{row:?}");
    assert!(row.thread_mm <= limits.thread_mm, "{row:?}");
    assert!(row.folded_mm < 0.0, "the wave pushes it back: {row:?}");
    assert!(row.spacing_mm >= limits.spacing_mm, "{row:?}");
    assert!(row.force_n <= limits.force_n, "{row:?}");
    assert!(row.alpha_deg >= limits.alpha_deg - tiny, "{row:?}");
    assert!(row.core_ratio >= limits.core_ratio - tiny, "{row:?}");
    assert_eq!(row.breaks, "");
}

fn dominates(one: &Row, other: &Row) -> bool {
    let (one, other) = (
        (one.length_mm, one.displacement_mm),
        (other.length_mm, other.displacement_mm),
    );
    one.0 <= other.0 && one.1 >= other.1 && one != other
}

#[test]
fn every_listed_design_keeps_the_limits() {
    let all = rows(&default_run().0);
    let (front, _) = split(&all);
    assert!((8..=21).contains(&front.len()), "{}", front.len());
    for row in front {
        keeps(row, &DEFAULT);
    }
    // Set other limits, each of which the paper's design breaks.
    let folder = tempfile::tempdir().expect("folder");
    optimise(
        folder.path(),
        &[
            "--most-length-mm=35",
            "--folded-width-mm=17",
            "--most-thread-mm=18",
            "--least-spacing-mm=2.3",
            "--most-force-n=0.45",
            "--indentation-mm=4",
            "--least-alpha-deg=14",
            "--least-core-ratio=0.25",
            &quick(folder.path()),
        ],
    );
    let all = rows(folder.path());
    let (front, own) = split(&all);
    assert!(front.len() > 3, "{}", front.len());
    for row in front {
        keeps(
            row,
            &Limits {
                length_mm: 35.0,
                folded_mm: 17.0,
                thread_mm: 18.0,
                spacing_mm: 2.3,
                force_n: 0.45,
                indentation_mm: 4.0,
                alpha_deg: 14.0,
                core_ratio: 0.25,
            },
        );
    }
    for limit in [
        "most-length-mm",
        "most-thread-mm",
        "least-spacing-mm",
        "least-alpha-deg",
        "least-core-ratio",
    ] {
        assert!(own.breaks.contains(limit), "{limit}: {}", own.breaks);
    }
}

#[test]
fn no_listed_design_is_dominated_by_another() {
    let all = rows(&default_run().0);
    let (front, own) = split(&all);
    for row in front {
        assert!(!front.iter().any(|other| dominates(other, row)), "{row:?}");
        assert!(row.displacement_mm > 0.05, "it goes somewhere: {row:?}");
        assert_eq!(row.dominated_by, usize::from(dominates(own, row)));
        assert!(
            row.prior_5_mm < Some(row.displacement_mm)
                && Some(row.displacement_mm) < row.prior_95_mm
        );
    }
    let over_it = front.iter().filter(|other| dominates(other, own)).count();
    assert_eq!(own.dominated_by, over_it);
}

/// The paper's design stands beside the front with its own numbers and the probability that another one goes farther.
#[test]
fn the_papers_design_stands_beside_them() {
    let (folder, text) = default_run();
    let all = rows(folder);
    let (front, paper) = split(&all);
    assert_eq!(paper.design, "paper");
    keeps(paper, &DEFAULT);
    let near = |got: f64, wanted: f64| assert!((got - wanted).abs() < 5e-3, "{got} {wanted}");
    near(paper.alpha_deg, 12.53);
    near(paper.beta_deg, 33.69);
    near(paper.core_ratio, 0.2);
    near(paper.length_mm, 41.21);
    near(paper.thread_mm, 21.00);
    assert_eq!(format!("{:.1}", paper.displacement_mm), "11.7");
    assert_eq!((paper.crescents, paper.beats), (9, None));
    // A share of bodies lies between 0 and 1, and grows where the mean is much larger.
    for row in front {
        let share = row.beats.expect("compared");
        assert!((0.0..=1.0).contains(&share));
        if row.displacement_mm > 1.05 * paper.displacement_mm {
            assert!(share > 0.5, "{row:?}");
        }
        if row.displacement_mm < 0.5 * paper.displacement_mm {
            assert!(share < 0.5, "{row:?}");
        }
    }
    assert!(text.contains("the paper's design"), "{text}");
    assert!(text.contains("434 bodies"), "{text}");
}

/// The recommended design and the longest one go headward unfolded and tailward folded in `simulate fold`.
#[test]
fn a_listed_design_moves_both_ways_in_simulate() {
    let (folder, _) = default_run();
    let all = rows(folder);
    let (front, own) = split(&all);
    let recommended = (front.iter())
        .filter(|row| row.length_mm <= own.length_mm)
        .max_by(|one, other| one.displacement_mm.total_cmp(&other.displacement_mm));
    for row in [
        recommended.expect("one is no longer"),
        front.last().expect("designs"),
    ] {
        let scratch = tempfile::tempdir().expect("folder");
        let file = scratch.path().join("design.toml");
        let design = format!(
            "[design]\nalpha_deg = {}\nbeta_deg = {}\ncore_ratio = {}\ncrescents = {}\n",
            row.alpha_deg, row.beta_deg, row.core_ratio, row.crescents
        );
        fs::write(&file, design).expect("written");
        let text = |path: &Path| path.to_str().expect("UTF-8").to_owned();
        let (code, said, err) = retrograde(&[
            "--json",
            "simulate",
            "fold",
            "--thread-mm",
            &row.thread_mm.to_string(),
            "--model",
            &text(&file),
            "--out",
            &text(scratch.path()),
        ]);
        assert_eq!(code, 0, "{err}");
        let value: Value = serde_json::from_str(&said).expect("one object");
        let of = |key: &str| {
            value["series"]["fold"][key]
                .as_f64()
                .unwrap_or_else(|| panic!("{said}"))
        };
        assert!(of("unfolded_mm") > 20.0, "{said}");
        assert!(of("folded_mm") < -20.0, "{said}");
        assert!(
            (of("folded_mm") - row.folded_mm).abs() < 0.01,
            "{row:?}: {said}"
        );
    }
}

#[test]
fn another_design_can_be_compared() {
    let folder = tempfile::tempdir().expect("folder");
    let text = optimise(
        folder.path(),
        &[
            "--beta-deg",
            "45",
            "--crescents",
            "5",
            &quick(folder.path()),
        ],
    );
    let all = rows(folder.path());
    let (_, own) = split(&all);
    assert_eq!((own.design.as_str(), own.crescents), ("yours", 5));
    assert!((own.beta_deg - 45.0).abs() < 1e-9);
    assert!(text.contains("your design"), "{text}");
}

#[test]
fn the_seed_decides_and_the_threads_do_not() {
    let folder = tempfile::tempdir().expect("folder");
    let run = |name: &str, args: &[&str]| {
        let out = folder.path().join(name);
        optimise(&out, &[args, &[&quick(folder.path())]].concat());
        let read = |file: &str| fs::read(out.join(file)).expect("written");
        (read("optimise.csv"), read("optimise.svg"))
    };
    let one = run("1", &["--threads", "1"]);
    assert!(one == run("7", &["--threads", "7"]));
    let other = run("seed", &["--seed", "2"]);
    assert!(one.0 != other.0);
    // Another seed gives about the same answer: equal lengths go about as far.
    let (first, second) = (
        rows(&folder.path().join("1")),
        rows(&folder.path().join("seed")),
    );
    let farthest = |rows: &[Row]| {
        let (front, _) = split(rows);
        front
            .iter()
            .map(|row| row.displacement_mm)
            .fold(0.0, f64::max)
    };
    let (one, two) = (farthest(&first), farthest(&second));
    assert!((one - two).abs() < 0.1 * one, "{one} {two}");
}

/// A posterior's bodies replace the prior's, and every output says so.
#[test]
fn a_posterior_judges_the_designs() {
    let folder = tempfile::tempdir().expect("folder");
    let coarse = "[design]\nalpha_deg = 12.53\nbeta_deg = 33.69\n[rig]\nstep_mm = 0.5\n";
    let run = |name: &str, samples: &[[f64; 4]], args: &[&str]| {
        let out = folder.path().join(name);
        let file = crate::support::made_up::posterior(
            &folder.path().join("made-up.toml"),
            coarse,
            samples,
        );
        let text = optimise(&out, &[&["--model", &*file], args].concat());
        let read = |file: &str| fs::read(out.join(file)).expect("written");
        (text, read("optimise.csv"), read("optimise.svg"), rows(&out))
    };
    let hooked = [[0.1, 100.0, 0.0005, 0.1], [0.12, 60.0, 0.0007, 0.1]];
    let loose = [
        [0.1, 100.0, 0.0005, 0.1],
        [0.8, 100.0, 0.0005, 0.1],
        [0.9, 60.0, 0.0007, 0.1],
    ];
    let (text, csv, svg, all) = run("1", &hooked, &["--threads", "1"]);
    let (_, csv_7, svg_7, _) = run("7", &hooked, &["--threads", "7"]);
    assert!(
        (&csv, &svg) == (&csv_7, &svg_7),
        "the threads change a byte"
    );

    let says = "2 bodies of the posterior of 2 displacements; their origin: virtual";
    assert!(
        text.contains(says) && text.contains("posterior band/mm"),
        "{text}"
    );
    assert!(!text.contains("434"), "{text}");
    let svg = String::from_utf8(svg).expect("UTF-8");
    for part in [
        says,
        "model fitted to trials of origin virtual",
        "of the posterior's bodies",
    ] {
        let escaped = part.replace('\'', "&apos;");
        assert!(svg.contains(part) || svg.contains(&escaped), "{part}");
    }
    for row in &all {
        assert!(row.origin.contains(says), "{}", row.origin);
        assert_eq!((row.prior_5_mm, row.prior_95_mm), (None, None));
        let (low, high) = (
            row.posterior_5_mm.expect("a band"),
            row.posterior_95_mm.expect("a band"),
        );
        assert!(low <= row.displacement_mm && row.displacement_mm <= high);
        // With two bodies, the probability of the ranking is 0, a half or 1.
        let share = row.beats.unwrap_or(0.0);
        assert!([0.0, 0.5, 1.0].contains(&share), "{share}");
    }

    let (_, _, _, others) = run("loose", &loose, &[]);
    let (own, other) = (split(&all).1, split(&others).1);
    assert!(
        (own.displacement_mm - other.displacement_mm).abs() > 0.5,
        "{own:?} {other:?}"
    );
    assert_ne!(
        csv,
        fs::read(folder.path().join("loose/optimise.csv")).expect("written")
    );

    let out = folder.path().join("json");
    let file = folder.path().join("made-up.toml");
    let line = [
        "--json",
        "design",
        "--optimise",
        "--tries=100",
        "--model",
        file.to_str().expect("UTF-8"),
        "--out",
        out.to_str().expect("UTF-8"),
    ];
    let (code, text, err) = retrograde(&line);
    assert_eq!(code, 0, "{err}");
    let value: Value = serde_json::from_str(&text).expect("one object");
    let origin = value["origin"].as_str().expect("named");
    assert!(origin.contains("3 bodies of the posterior"), "{origin}");
    assert!(value["designs"][0]["posterior_5_mm"].is_number(), "{value}");
}

/// Per crescent, other designs win, and the number is that of one crescent.
#[test]
fn per_crescent_is_another_question() {
    let folder = tempfile::tempdir().expect("folder");
    let quick = quick(folder.path());
    optimise(folder.path(), &["--per", "wave", &quick]);
    let wave = rows(folder.path());
    let (_, of_wave) = split(&wave);
    optimise(folder.path(), &["--per", "crescent", &quick]);
    let all = rows(folder.path());
    let (front, paper) = split(&all);
    assert!((9.0 * paper.displacement_mm - of_wave.displacement_mm).abs() < 1e-9);
    for row in front {
        keeps(row, &DEFAULT);
        assert!(!front.iter().any(|other| dominates(other, row)));
    }
    let text = fs::read_to_string(folder.path().join("optimise.svg")).expect("drawn");
    assert!(text.contains("per wave and crescent"));
}

#[test]
fn the_figure_and_the_table_name_the_model() {
    let (folder, _) = default_run();
    let svg = fs::read_to_string(folder.join("optimise.svg")).expect("drawn");
    for says in [
        "<desc>Origin: model: body one, calibrated to words",
        "seed 1, 300 tries",
        "force: beam model, not validated against a rig",
        "model: 434 bodies that fit the words, no measurement",
        "overall length / mm",
        "how far for their length, per wave",
        "the paper&apos;s design (model)",
        "fill=\"#fff\"/>",
    ] {
        let plain = says.replace("&apos;", "'");
        assert!(svg.contains(says) || svg.contains(&plain), "{says}");
    }
    for row in rows(folder) {
        assert!(
            row.origin.starts_with("model one, 434 bodies"),
            "{}",
            row.origin
        );
    }
    let out = tempfile::tempdir().expect("folder");
    let quick = quick(out.path());
    let line = [
        "--json",
        "design",
        "--optimise",
        "--tries=100",
        &quick,
        "--out",
        out.path().to_str().expect("UTF-8"),
    ];
    let (code, text, err) = retrograde(&line);
    assert_eq!(code, 0, "{err}");
    let value: Value = serde_json::from_str(&text).expect("one object");
    assert!(
        value["origin"]
            .as_str()
            .is_some_and(|origin| origin.contains("434 bodies"))
    );
    let designs = value["designs"].as_array().expect("rows");
    assert_eq!(
        designs.last().map(|row| &row["design"]),
        Some(&"paper".into())
    );
}

#[test]
fn what_cannot_be_asked_is_refused_with_what_to_do() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().join("new");
    let quick = quick(folder.path());
    for (args, says) in [
        (&["--most-length-mm", "0"][..], "longest structure = 0 mm"),
        (&["--most-length-mm", "NaN"], "above 0, at most 200 mm"),
        (&["--folded-width-mm", "25"], "at most 24.4 mm"),
        (
            &["--folded-width-mm", "13"],
            "does not push a narrower one back",
        ),
        (&["--most-thread-mm", "-1"], "longest thread = -1 mm"),
        (
            &["--least-spacing-mm", "0"],
            "least distance between crescents",
        ),
        (&["--most-force-n", "0"], "greatest force = 0 N"),
        (&["--indentation-mm", "0"], "without a wave nothing moves"),
        (&["--indentation-mm", "9.9"], "from 0 to 9.76 mm"),
        (&["--least-alpha-deg", "41"], "at most 40 deg"),
        (&["--least-core-ratio", "0.7"], "at most 0.6"),
        (&["--tries", "99"], "100 to 100000"),
        (&["--per", "hour"], "wave, crescent"),
        (&["--svg", "a.svg"], "cannot be used with"),
        (&["--most-thread-mm", "1"], "--most-thread-mm by"),
        (&["--most-thread-mm", "1"], "loosen the first of them"),
        (
            &["--most-thread-mm", "1", "--least-core-ratio", "0.55"],
            "--folded-width-mm by",
        ),
    ] {
        let out = out.to_str().expect("UTF-8");
        let line = [
            &["design", "--optimise", "--out", out, &quick][..],
            if args[0] == "--tries" {
                &[][..]
            } else {
                &["--tries", "150"][..]
            },
            args,
        ]
        .concat();
        let (code, text, err) = retrograde(&line);
        assert_eq!(code, 2, "{args:?}: {err}");
        let flat = err.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(flat.contains(says), "{args:?}: {err}");
        assert!(text.is_empty() && !Path::new(out).exists(), "{args:?}");
    }
    // Options that only the search reads are refused without it.
    let (code, _, err) = retrograde(&["design", "--most-thread-mm", "20"]);
    assert!(code == 2 && err.contains("--optimise"), "{err}");
}
