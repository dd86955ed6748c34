//! A campaign on both images: the paper's plan with few and short runs, interrupted and resumed, without questions.

use std::ffi::OsString;
use std::fs;
use std::path::Path;

use host_tool::cli;
use lab::campaign::contents::Campaign;
use lab::campaign::form::Form;
use lab::campaign::ledger::{Source, TrialStatus};
use lab::campaign::verify::verify;
use report::html::evaluation::evaluate;
use virtual_bench::connector::BenchPorts;

const PAPER: &str = include_str!("../../../examples/paper.toml");

/// One dry trial, and the fold test with a fold in a run: four runs of 8 s.
fn short_plan() -> String {
    [
        ("repeats = 10", "repeats = 1"),
        ("duration_s = 40", "duration_s = 8"),
        ("cycles = 5", "cycles = 1"),
        (r#"["dry", "lubricated"]"#, r#"["dry"]"#),
        (r#"["a1", "a2", "a3", "a4", "a5"]"#, r#"["a5"]"#),
        ("# fold_at_cycle = 3", "fold_at_cycle = 1"),
    ]
    .iter()
    .fold(PAPER.to_owned(), |plan, (long, short)| {
        assert!(plan.contains(long), "{long}");
        plan.replace(long, short)
    })
}

fn retrograde(args: &[&str]) -> String {
    let (mut out, mut err) = (vec![], vec![]);
    let line = ["retrograde", "--rig", "virtual", "--capsule", "virtual"]
        .iter()
        .chain(args)
        .map(OsString::from);
    let code = cli::run_on(line, &BenchPorts::default(), &mut out, &mut err, None);
    out.extend(err);
    let text = String::from_utf8_lossy(&out).into_owned();
    assert_eq!(code, 0, "{args:?}: {text}");
    text
}

#[test]
fn a_short_campaign_is_left_and_resumed_and_reported() {
    let place = tempfile::tempdir().expect("a folder");
    let path = |name: &str| place.path().join(name).display().to_string();
    let (plan, folder) = (path("plan.toml"), path("short"));
    fs::write(&plan, short_plan()).expect("written");
    retrograde(&[
        "campaign", "run", &plan, "--out", &folder, "--yes", "--trials", "1",
    ]);
    // Use new machines: those of the first command are gone, as after a crash.
    retrograde(&["campaign", "run", &folder, "--yes"]);
    retrograde(&["verify", &folder]);
    let verified = verify(Path::new(&folder)).expect("a folder");
    assert_eq!(verified.findings, vec![]);
    let campaign = Campaign::read(Path::new(&folder)).expect("a campaign");
    assert_eq!(campaign.state.trials.len(), 4);
    for trial in &campaign.state.trials {
        assert_eq!(trial.status(), TrialStatus::Done, "{trial:?}");
        assert_eq!(trial.attempts.len(), 1, "{trial:?}");
    }
    let sources: Vec<_> = campaign.rows.iter().filter_map(|row| row.source).collect();
    assert_eq!(sources, [Source::Model; 4]);
    let page = fs::read_to_string(path("short/report/report.html")).expect("a report");
    assert!(page.contains("not a measurement"));
    // A record that contradicts itself is left out of the report together with its trial.
    let evaluation = evaluate(Path::new(&folder)).expect("a campaign");
    let folding = evaluation
        .trials
        .iter()
        .filter(|trial| trial.shape == Form::Folding);
    assert_eq!(folding.count(), 1);
    for part in evaluation.parts.iter().flatten() {
        assert!(part.defects.all().is_empty(), "{part:?}");
    }
}
