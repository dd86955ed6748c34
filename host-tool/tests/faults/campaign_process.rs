//! Campaigns in separate processes at a machine on TCP: killed at random instants and resumed, and left at a prompt.

use std::collections::BTreeMap;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use crate::support::bench::{Bench, ready};
use crate::support::plan::{ONE_CONDITION, PAPER, changed};
use crate::support::terminal::Terminal;
use lab::campaign::chance::Chance;
use lab::campaign::contents::Campaign;
use lab::campaign::ledger::{LedgerEvent, TrialStatus};
use lab::campaign::verify::verify;
use protocol::system::DeviceKind;
use simulated_machines::machine::VIRTUAL_UID;

/// Speed of the machine's clock relative to real time.
const SPEED: u32 = 12;

/// A plan of ten short trials in one block, with these changes.
fn plan(changes: &[(&str, &str)]) -> String {
    let short = [
        ("duration_s = 40", "duration_s = 1"),
        ("telemetry_ms = 10 ", "telemetry_ms = 50 "),
        ("stroke_mm = 130", "stroke_mm = 5"),
    ];
    changed(&changed(PAPER, &ONE_CONDITION), &[&short, changes].concat())
}

/// The displacements that count, with the attempts that they belong to.
fn done(campaign: &Campaign) -> BTreeMap<u32, (u32, i64)> {
    let of = |trial: &lab::campaign::ledger::TrialState| {
        let mm = trial.counted()?;
        Some((trial.planned.trial, (trial.attempt()?.number, mm.value.um)))
    };
    campaign.state.trials.iter().filter_map(of).collect()
}

/// Number of kills: all if RETROGRADE_CAMPAIGN is set, else only the first.
fn kills() -> u32 {
    match std::env::var_os("RETROGRADE_CAMPAIGN") {
        Some(_) => 50,
        None => 6,
    }
}

/// No finished trial is lost, and none counts twice. Every second kill hits a run.
#[test]
fn a_campaign_survives_being_killed_at_any_instant() {
    let kills = kills();
    let text = plan(&[("repeats = 10", &format!("repeats = {}", kills + 2))]);
    let mut script = ready(DeviceKind::Rig);
    script.uid = VIRTUAL_UID;
    let bench = Bench::on_tcp_as(&script, SPEED);
    let place = bench.folder.path();
    std::fs::write(place.join("plan.toml"), text).expect("written");
    let folder = place.join("c");
    let mut chance = Chance::new(50);
    let mut before = BTreeMap::new();
    let mut killed = 0;
    loop {
        let args: &[&str] = match folder.exists() {
            true => &["campaign", "run", "c", "--yes"],
            false => &["campaign", "run", "plan.toml", "--out", "c", "--yes"],
        };
        let mut child = bench.command(args).spawn().expect("starts");
        if killed < kills {
            // Kill anywhere from before the first byte to within a trial; every second time within a run.
            let (runs, mut over) = (bench.count("Run"), killed % 2 == 0);
            while !over && bench.count("Run") == runs {
                over = child.try_wait().expect("a child").is_some();
                thread::sleep(Duration::from_millis(1));
            }
            let at_most_ms = if killed % 2 == 0 { 500 } else { 60 };
            thread::sleep(Duration::from_millis(chance.below(at_most_ms) as u64));
            // Sends SIGKILL; fails if the process has already ended by itself.
            let _ = child.kill();
            killed += 1;
        }
        let (code, out, err) = crate::support::bench::read(child.wait_with_output().expect("ends"));
        if folder.exists() {
            let now = done(&Campaign::read(Path::new(&folder)).expect("readable at any instant"));
            for (trial, value) in &before {
                assert_eq!(
                    now.get(trial),
                    Some(value),
                    "trial {trial} after kill {killed}"
                );
            }
            before = now;
        }
        if killed == kills && code.is_some() {
            assert_eq!(code, Some(0), "{out}{err}");
            break;
        }
        assert!(code.is_none() || code == Some(0), "{out}{err}");
    }
    assert_eq!(verify(&folder).expect("a folder").findings, vec![]);
    let campaign = Campaign::read(&folder).expect("a campaign");
    let repeats = campaign.order.len() as u32;
    assert_eq!(before.len() as u32, repeats);
    for trial in 1..=repeats {
        let measured = campaign
            .rows
            .iter()
            .filter(|row| row.event == LedgerEvent::Displacement && row.trial == Some(trial));
        assert_eq!(measured.count(), 1, "trial {trial}");
        let state = campaign.state.trial(trial).expect("there");
        let status = state.attempts.iter().filter(|attempt| attempt.stands());
        assert_eq!(status.count(), 1, "trial {trial}");
    }
    // Some kills must have hit a trial.
    let attempts = |campaign: &Campaign| -> usize {
        campaign
            .state
            .trials
            .iter()
            .map(|trial| trial.attempts.len())
            .sum()
    };
    assert!(
        attempts(&campaign) > repeats as usize,
        "no kill has hit an attempt"
    );
}

/// While a question waits, the tool keeps the link alive, others use its broker, and Ctrl-C leaves.
#[test]
fn a_prompt_keeps_the_link_alive_and_takes_ctrl_c() {
    let bench = Bench::on_tcp_as(&ready(DeviceKind::Rig), SPEED);
    let text = plan(&[("count = 5", "count = 1")]);
    std::fs::write(bench.folder.path().join("plan.toml"), text).expect("written");
    let at_terminal = |args: &[&str]| Terminal::start(bench.command(args), 100, 40);
    let mut session = at_terminal(&["campaign", "run", "plan.toml", "--out", "c"]);
    session.wait_for("rollers OFF");
    let (before, begin) = (bench.count("KeepAlive"), Instant::now());
    while bench.count("KeepAlive") < before + 3 {
        assert!(
            begin.elapsed() < Duration::from_secs(30),
            "the rig hears nothing"
        );
        thread::sleep(Duration::from_millis(5));
    }
    let (code, out, err) = bench.retrograde(&["info"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("Ready, homed"), "{out}");
    for (wanted, line) in [
        ("Enter when it is done", "\n"),
        ("Reading 1 of 1: D", "24.4\n"),
        ("Clamp both rollers", "\n"),
        ("Reading 1 of 1: i", "14.3\n"),
        ("Trial 1 of 10", "\n"),
    ] {
        session.wait_for(wanted);
        session.press(line);
    }
    session.wait_for("Displacement of the tail");
    session.press("\x03");
    assert_eq!(session.ends_restored(), Some(130));
    let folder = bench.folder.path().join("c");
    assert_eq!(verify(&folder).expect("a folder").findings, vec![]);
    let status = || {
        let campaign = Campaign::read(&folder).expect("a campaign");
        campaign.state.trial(1).expect("there").status()
    };
    assert_eq!(status(), TrialStatus::Unmeasured);
    let mut session = at_terminal(&["campaign", "run", "c"]);
    session.wait_for("Displacement of the tail");
    // The key bounces. The hands are at the body now, and the rig must wait for an Enter of its own.
    session.press("4.5\n\n");
    session.wait_for("Press it again");
    session.press("q\n");
    assert_eq!(session.ends_restored(), Some(130));
    assert_eq!(status(), TrialStatus::Done);
    let campaign = Campaign::read(&folder).expect("a campaign");
    assert_eq!(campaign.state.trial(2).expect("there").attempts, vec![]);
}

/// Waits until a session has shown a text so many times.
fn shows(session: &Terminal, text: &str, times: usize) {
    let begin = Instant::now();
    while session.text().matches(text).count() < times {
        let shown = session.text();
        assert!(begin.elapsed() < Duration::from_secs(60), "{text}: {shown}");
        thread::sleep(Duration::from_millis(5));
    }
}

/// Regression: an attempt began and was stopped by a stop that was older than Enter, and the session ended.
#[test]
fn a_stop_while_a_question_waits_is_told_and_stops_no_later_attempt() {
    let bench = Bench::on_tcp_as(&ready(DeviceKind::Rig), SPEED);
    let text = plan(&[("count = 5", "count = 1")]);
    std::fs::write(bench.folder.path().join("plan.toml"), text).expect("written");
    let run = ["campaign", "run", "plan.toml", "--out", "c"];
    let session = Terminal::start(bench.command(&run), 120, 60);
    let answer = |wanted: &str, times: usize, line: &str| {
        shows(&session, wanted, times);
        session.press(line);
    };
    let stop = || {
        let (code, _, err) = bench.retrograde(&["stop", "rig"]);
        assert_eq!(code, Some(0), "{err}");
    };
    answer("rollers OFF", 1, "\n");
    answer("Reading 1 of 1: D", 1, "24.4\n");
    answer("Clamp both rollers", 1, "\n");
    answer("Reading 1 of 1: i", 1, "14.3\n");
    // While the checklist waits: it is shown again, and its Enter counts.
    shows(&session, "Enter begins", 1);
    stop();
    session.press("\n");
    let told = "a stop was requested: nothing begins before Enter at a checklist";
    shows(&session, told, 1);
    answer("Enter begins", 2, "\n");
    // While the displacement waits: its answer counts, and so does Enter at the checklist that follows.
    shows(&session, "Displacement of the tail", 1);
    stop();
    session.press("4.5\n");
    shows(&session, told, 2);
    answer("Enter begins", 3, "\n");
    answer("Displacement of the tail", 2, "q\n");
    assert_eq!(session.ends_restored(), Some(130));
    let folder = bench.folder.path().join("c");
    assert_eq!(verify(&folder).expect("a folder").findings, vec![]);
    let campaign = Campaign::read(&folder).expect("a campaign");
    for (trial, status) in [(1, TrialStatus::Done), (2, TrialStatus::Unmeasured)] {
        let state = campaign.state.trial(trial).expect("there");
        assert_eq!((state.attempts.len(), state.status()), (1, status));
    }
}
