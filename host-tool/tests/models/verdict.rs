//! The verdict on a fit stands in its file, and on each band, plan and design made from it.

use std::fs;
use std::path::{Path, PathBuf};

use crate::plan_experiment::posterior_with;
use crate::support::offline::{self, retrograde, text};

const REASON: &str = "the readings at 3 mm do not fit";
const DOUBT: &str = "the net at 2 mm is odd";

fn folder(name: &str) -> PathBuf {
    offline::folder("verdict", name)
}

/// The text of a command on both outputs.
fn said(args: &[&str], out: &Path) -> String {
    let (code, said, err) = retrograde(&[args, &["--out", text(out)]].concat());
    assert_eq!(code, 0, "{args:?}: {err}");
    said + &err
}

fn every_use(model: &Path, folder: &Path) -> Vec<String> {
    let model = ["--model", text(model)];
    let plan = [
        "plan-experiment",
        "--uncertainty-mm",
        "0.5",
        "--trials",
        "1",
        "--kinds",
        "net",
        "--indentations-mm",
        "5.05",
        "--histories",
        "16",
        "--json",
    ];
    let commands: [&[&str]; 3] = [
        &["simulate", "roller"],
        &plan,
        &["design", "--optimise", "--tries", "200"],
    ];
    let one = |(number, command): (usize, &&[&str])| {
        let out = folder.join(number.to_string());
        said(&[*command, &model].concat(), &out).replace('\n', " ")
    };
    commands.iter().enumerate().map(one).collect()
}

#[test]
fn what_makes_a_fit_unreliable_stands_on_all_that_is_made_from_it() {
    let folder = folder("unreliable");
    let verdict = format!("reliable = false\nreasons = [\"{REASON}\"]\ndoubts = [\"{DOUBT}\"]");
    let model = posterior_with(&folder, 0.05, &verdict);
    for said in every_use(&model, &folder) {
        assert!(said.contains("NOT RELIABLE"), "{said}");
        assert!(said.contains(REASON), "{said}");
    }
    // The figure says it, and the file that `simulate` writes keeps every sentence.
    let svg = fs::read_to_string(folder.join("0/roller.svg")).expect("a figure");
    assert!(svg.contains("NOT RELIABLE"));
    let again = fs::read_to_string(folder.join("0/model.toml")).expect("a model");
    assert!(again.contains(REASON) && again.contains(DOUBT), "{again}");
}

#[test]
fn a_doubt_stands_on_all_that_is_made_from_it() {
    let folder = folder("doubted");
    let verdict = format!("reliable = true\ndoubts = [\"{DOUBT}\"]");
    let model = posterior_with(&folder, 0.05, &verdict);
    for said in every_use(&model, &folder) {
        assert!(said.contains("DOUBTED") && said.contains(DOUBT), "{said}");
    }
}

#[test]
fn a_reliable_posterior_with_a_reason_against_it_is_refused() {
    let folder = folder("contradiction");
    let verdict = format!("reliable = true\nreasons = [\"{REASON}\"]");
    let model = posterior_with(&folder, 0.05, &verdict);
    let (code, _, err) = retrograde(&["simulate", "roller", "--model", text(&model)]);
    assert!(code == 2 && err.contains("reliable"), "{code} {err}");
}

/// Five cycles repeat the error of a pass in each direction: a normal discrepancy of 2 mm alone spans
/// 2 x 1.645 x 5 sqrt(2) x 2 mm from 5 to 95 %.
#[test]
fn the_discrepancy_widens_the_band() {
    let width = |tau_mm: f64| {
        let folder = folder(&format!("tau-{tau_mm}"));
        let model = posterior_with(&folder, tau_mm, "reliable = true");
        said(&["simulate", "roller", "--model", text(&model)], &folder);
        let mut reader = csv::Reader::from_path(folder.join("roller.csv")).expect("a table");
        let header = reader.headers().expect("a header").clone();
        let row = reader.records().nth(4).expect("a row").expect("a row");
        let of = |name: &str| {
            let place = header.iter().position(|column| column == name).expect(name);
            row[place].parse::<f64>().expect("a number")
        };
        of("posterior_95_mm") - of("posterior_5_mm")
    };
    let (narrow, wide) = (width(0.001), width(2.0));
    let expected = f64::hypot(narrow, 2.0 * 1.645 * 5.0 * 2.0_f64.sqrt() * 2.0);
    assert!(
        (wide / expected - 1.0).abs() < 0.15,
        "{narrow} {wide} {expected}"
    );
}
