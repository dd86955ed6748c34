//! Values exactly at a bound, and cases in which a campaign says the one thing and not the other.

use std::fs;
use std::path::Path;

use client::identity::Origin;
use jiff::civil::date;
use jiff::{SignedDuration, Timestamp};
use lab::campaign::catalogue::{Wanted, list};
use lab::campaign::contents::Campaign;
use lab::campaign::files::TRIALS;
use lab::campaign::folder::Folder;
use lab::campaign::form::Form;
use lab::campaign::ledger::{AttemptOutcome, CampaignState, LedgerEvent, LedgerRow, Source};
use lab::campaign::manifest::{self, Manifest, contents};
use lab::campaign::order::{Planned, order};
use lab::campaign::plan::{CampaignPlan, Lubrication, Millimetres, Purpose};
use lab::campaign::prompts::clearing;
use lab::campaign::readings::{Kind, Quantity, Readings, questions, refusal};
use lab::campaign::remaining::remaining_s;
use lab::campaign::verify::verify;
use simulated_machines::machine::VIRTUAL_UID;

use crate::campaign::{
    SMALL, accepted, apply, at, campaign, findings, measured, mm, plan, reading,
};
use crate::campaign_run::{
    WIDTH, clamped, converse, machines, path, place, plan_of_passes, small_plan,
};
use crate::support::plan::{ONE_CONDITION, PAPER, changed};

/// The reason why a plan with this text in place of another one is refused; none if it is not.
fn refused(from: &str, to: &str) -> Option<String> {
    assert_eq!(SMALL.matches(from).count(), 1, "{from}");
    let parsed = CampaignPlan::parse(&SMALL.replace(from, to), Path::new("plan.toml"));
    parsed.err().map(|error| error.why)
}

/// Writes the manifest anew, as somebody does who forges a folder.
fn seal(folder: &Path) {
    let forged = manifest::of_folder(folder).expect("read").text();
    fs::write(folder.join(manifest::NAME), forged).expect("written");
}

// The catalogue.

/// A search by day leaves it out, any other search lists it.
#[test]
fn a_campaign_that_has_not_begun_is_of_no_day() {
    let place = tempfile::tempdir().expect("a folder");
    let new = place.path().join("new");
    drop(Folder::create(&new, SMALL, Path::new("small.toml")).expect("made"));
    let folders = [place.path().to_owned()];
    let count = |since, until| {
        let wanted = Wanted {
            since,
            until,
            ..Wanted::default()
        };
        list(&folders, false, &wanted).entries.len()
    };
    let day = Some(date(2026, 1, 21));
    assert_eq!(count(None, None), 1);
    assert_eq!(
        [count(day, None), count(None, day), count(day, day)],
        [0; 3]
    );
}

#[test]
fn campaigns_are_found_three_folders_deep_and_no_deeper() {
    for (levels, found) in [(1, 1), (3, 1), (4, 0), (5, 0)] {
        let place = tempfile::tempdir().expect("a folder");
        let within = (1..levels).fold(place.path().to_owned(), |path, _| path.join("in"));
        fs::create_dir_all(&within).expect("made");
        let path = within.join("small");
        drop(Folder::create(&path, SMALL, Path::new("small.toml")).expect("made"));
        let all = list(&[place.path().to_owned()], false, &Wanted::default());
        assert_eq!(all.entries.len(), found, "{levels}: {all:?}");
        assert_eq!(all.unreadable, [""; 0]);
    }
}

// Plans.

#[test]
fn a_length_that_is_no_number_is_told_with_an_example() {
    let why = refused("stroke_mm = 1\n", "stroke_mm = true\n").expect("no number");
    assert!(why.contains("a number, for example 130 or 12.5"), "{why}");
}

/// The rollers of 38 mm neither touch the body before the pass nor after it.
#[test]
fn a_body_may_lie_exactly_where_the_rollers_no_longer_reach() {
    let passes = plan_of_passes();
    let refused = |tail: &str, body: &str| {
        let text = passes
            .replacen("tail_mm = 40", &format!("tail_mm = {tail}"), 1)
            .replacen("body_mm = 41.2", &format!("body_mm = {body}"), 1);
        let parsed = CampaignPlan::parse(&text, Path::new("plan.toml"));
        parsed.err().map(|error| error.why)
    };
    let why = refused("0", "41.2").expect("under the rollers");
    let reach = why.split("rollers reach ").nth(1).expect("the reach");
    let reach = mm(reach.split(' ').next().expect("a number"));
    let below = Millimetres::from_um(reach.um - 1);
    assert_eq!(refused(&reach.to_string(), "41.2"), None);
    assert!(refused(&below.to_string(), "41.2").is_some());
    // From the other end, of the stroke of 130 mm.
    let most = Millimetres::from_um(130_000 - reach.um - 41_200);
    let above = Millimetres::from_um(most.um + 1);
    assert_eq!(refused(&most.to_string(), "41.2"), None);
    assert!(refused(&above.to_string(), "41.2").is_some());
}

/// A person enters the displacement after each stroke of 50 cycles, and no more.
#[test]
fn strokes_are_asked_for_in_runs_of_up_to_50_cycles() {
    let text = SMALL.replace("duration_s = 1\n", "duration_s = 200\n");
    for (cycles, fits) in [(50, true), (51, false)] {
        let text = text.replace("cycles = 1\n", &format!("cycles = {cycles}\n"));
        let text = format!("{text}[displacement]\nper_stroke = true\n");
        let parsed = CampaignPlan::parse(&text, Path::new("plan.toml"));
        assert_eq!(parsed.is_ok(), fits, "{cycles}: {parsed:?}");
    }
}

// Questions.

#[test]
fn the_rollers_go_to_the_end_at_which_the_trial_begins() {
    for (purpose, says) in [
        (
            Purpose::Series,
            "Trial 7, unfolded: the rollers go home before",
        ),
        (
            Purpose::AntegradePass,
            "Trial 7, antegrade pass: the rollers go home before",
        ),
        (
            Purpose::ReturningPass,
            "Trial 7, returning pass: the rollers go to the far end before",
        ),
    ] {
        let lines = clearing(&Planned {
            trial: 7,
            block: 1,
            purpose,
            lubrication: Lubrication::Dry,
            indentation: "a1".to_owned(),
            shape: Form::Unfolded,
            repeat: 1,
        });
        assert!(lines[1].starts_with(says), "{lines:?}");
    }
}

/// There is nothing to take back yet, so the question stays.
#[test]
fn an_undo_before_the_first_reading_asks_for_the_reading() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let lines = vec![
        ("rollers OFF", ""),
        ("Reading 1 of 2: D", "undo"),
        ("a number is needed here", "24.4"),
        ("Reading 2 of 2: D", "q"),
    ];
    let (code, shown) = converse(&machines(None), &["run", &plan, "--out", &out], lines);
    assert_eq!(code, 130, "{shown}");
    let campaign = Campaign::read(Path::new(&out)).expect("a campaign");
    assert_eq!(campaign.readings.sets[0].values, [mm("24.4")]);
}

/// A number typed there would be taken for a measurement.
#[test]
fn a_number_at_the_virtual_bench_is_no_displacement() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let trial = [
        ("Trial 1 of 6", ""),
        ("Displacement by the model", "12.5"),
        ("nothing can be measured on the virtual bench", ""),
        ("Clamp both rollers", "q"),
    ];
    let lines = [&WIDTH[..], &clamped("20.4"), &trial].concat();
    let memory = machines(Some(VIRTUAL_UID));
    let (code, shown) = converse(&memory, &["run", &plan, "--out", &out], lines);
    assert_eq!(code, 130, "{shown}");
    let campaign = Campaign::read(Path::new(&out)).expect("a campaign");
    let counted = campaign.state.trials[0].counted().expect("counts");
    assert_eq!(counted.source, Source::Model);
    assert_ne!(counted.value, mm("12.5"));
}

// Displacements.

/// With an uncertainty of 0.1 mm the net displacement may lie 0.3 mm from that after the last stroke.
#[test]
fn the_net_displacement_may_differ_by_three_deviations_and_no_more() {
    let place = tempfile::tempdir().expect("a folder");
    let text = format!("{SMALL}[displacement]\nper_stroke = true\nuncertainty_mm = 0.1\n");
    let path = place.path().join("strokes");
    let folder = Folder::create(&path, &text, Path::new("small.toml")).expect("made");
    let mut campaign = folder.campaign().clone();
    let begun = crate::campaign::campaign(&place.path().join("begun"));
    let mut attempt = begun.campaign().state.trials[0].attempts[0].clone();
    attempt.strokes = vec![mm("9"), mm("4")];
    let mut trials = campaign.state.trials.iter_mut();
    let series = trials.find(|trial| trial.planned.purpose == Purpose::Series);
    let series = series.expect("there");
    series.attempts = vec![attempt];
    let trial = series.planned.trial;
    for (net, fits) in [
        ("4.3", true),
        ("3.7", true),
        ("4.301", false),
        ("3.699", false),
    ] {
        let why = campaign.disagreement(trial, mm(net));
        assert_eq!(why.is_none(), fits, "{net}: {why:?}");
    }
}

/// Strokes that are left out are left out once.
#[test]
fn strokes_are_neither_entered_nor_left_out_after_they_were_left_out() {
    let text = format!("{SMALL}[displacement]\nper_stroke = true\n");
    let mut state = CampaignState::new(&order(&plan(&text)));
    let mut step = |event| {
        let mut row = LedgerRow::of(event, 1, Some(1));
        row.row = state.sequence.next_row();
        row.outcome = (event == LedgerEvent::Ended).then_some(AttemptOutcome::Complete);
        row.displacement_mm = (event == LedgerEvent::Stroke).then(|| mm("4"));
        row.source = (event == LedgerEvent::Stroke).then_some(Source::Measured);
        state.apply(&row).map_err(|contradiction| contradiction.why)
    };
    for event in [
        LedgerEvent::Began,
        LedgerEvent::Ended,
        LedgerEvent::Stroke,
        LedgerEvent::StrokesLeftOut,
    ] {
        assert_eq!(step(event), Ok(()), "{event:?}");
    }
    for event in [LedgerEvent::Stroke, LedgerEvent::StrokesLeftOut] {
        let why = step(event).expect_err("left out");
        assert!(why.contains("trial 1 is not measured yet"), "{why}");
    }
    assert_eq!(step(LedgerEvent::Undone), Ok(()));
    assert_eq!(step(LedgerEvent::Stroke), Ok(()));
}

/// A pass takes the time of one stroke to its start and one over the body: that of a cycle.
#[test]
fn a_pass_takes_the_time_of_a_cycle() {
    let place = tempfile::tempdir().expect("a folder");
    let longer = [
        ("cycles = 1", "cycles = 4"),
        ("duration_s = 8", "duration_s = 32"),
    ];
    let passes = changed(&plan_of_passes(), &longer);
    let path = place.path().join("passes");
    let folder = Folder::create(&path, &passes, Path::new("passes.toml")).expect("made");
    let trials = folder.campaign().order.iter();
    let count = trials
        .filter(|trial| trial.purpose.pass().is_some())
        .count();
    assert_eq!((count, folder.campaign().order.len()), (2, 3));
    // A run of 32 s and two cycles of it; 60 s for each trial, and a clamping of 300 s for each of two blocks.
    let expected = 32.0 + 2.0 * 8.0 + 3.0 * 60.0 + 2.0 * 300.0;
    assert_eq!(remaining_s(folder.campaign()), expected);
}

/// The pause between two blocks is the clamping, and no handling.
#[test]
fn the_pause_between_two_blocks_is_no_pace() {
    let place = tempfile::tempdir().expect("a folder");
    let mut campaign = campaign(&place.path().join("begun")).campaign().clone();
    let blocks: Vec<u32> = campaign.order[..3]
        .iter()
        .map(|trial| trial.block)
        .collect();
    assert_eq!(blocks, [1, 1, 2]);
    let pace = remaining_s(&campaign);
    let third = campaign.rows.iter_mut().filter(|row| row.trial == Some(3));
    third.for_each(|row| row.time_utc += SignedDuration::from_secs(100));
    assert_eq!(remaining_s(&campaign), pace);
}

/// Each stroke of the run has the time of its pulse to the camera.
#[test]
fn every_stroke_of_a_run_has_its_pulse() {
    let longer = [
        ("cycles = 1", "cycles = 3"),
        ("duration_s = 8", "duration_s = 24"),
    ];
    let place = place(&changed(&small_plan(&[]), &longer));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let args = [
        "campaign", "run", &plan, "--out", &out, "--yes", "--trials", "1",
    ];
    let at = ["--rig", "0", "--capsule", "1"];
    let (code, said, err) = machines(Some(VIRTUAL_UID)).run(&[&args[..], &at].concat());
    assert_eq!(code, 0, "{said}{err}");
    let pulses = Path::new(&out).join("trials/001-1/sync.csv");
    let pulses = fs::read_to_string(pulses).expect("there");
    let mut rows = pulses.lines().map(|row| row.split(',').collect::<Vec<_>>());
    assert_eq!(
        rows.next().expect("a header"),
        ["stroke", "time_us", "origin"]
    );
    let rows: Vec<_> = rows.collect();
    let strokes: Vec<&str> = rows.iter().map(|row| row[0]).collect();
    assert_eq!(strokes, ["0", "1", "2", "3", "4", "5"]);
    let times: Vec<u64> = rows.iter().map(|row| row[1].parse().expect("us")).collect();
    assert!(times.is_sorted_by(|one, next| one < next), "{times:?}");
}

// Folders.

/// A clock that is set from local time to UTC steps by less than a day. A row may lie a day from its neighbours, and no
/// second more.
#[test]
fn a_row_after_a_crash_may_lie_a_day_from_its_neighbours() {
    let day = SignedDuration::from_hours(24);
    let second = SignedDuration::from_secs(1);
    let (before, after) = (at(0), at(1_000));
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let rows = campaign(&path).campaign().rows.clone();
    let sealed = fs::read_to_string(path.join(TRIALS)).expect("there");
    let last = rows.iter().map(|row| row.time_utc).max().expect("rows");
    assert!(before < last && last < after);
    let resumed = |time: Timestamp| {
        let row = format!("{},{time},note,3,,,,,,,,said,board\n", rows.len() + 1);
        fs::write(path.join(TRIALS), format!("{sealed}{row}")).expect("written");
        let manifest = fs::read(path.join(manifest::NAME)).expect("there");
        let resumed = Folder::resume(&path, after, &mut |_| true);
        let result = resumed.map(drop).map_err(|error| error.why);
        fs::write(path.join(TRIALS), &sealed).expect("written");
        fs::write(path.join(manifest::NAME), manifest).expect("written");
        result
    };
    assert_eq!(resumed(last - day), Ok(()));
    assert_eq!(resumed(after + day), Ok(()));
    let why = resumed(last - day - second).expect_err("earlier");
    assert!(
        why.contains("a row that is not in SHA256SUMS is of"),
        "{why}"
    );
    let why = resumed(after + day + second).expect_err("later");
    assert!(why.contains("this computer's clock says"), "{why}");
}

#[test]
fn a_file_with_another_name_is_told_with_that_name() {
    let place = tempfile::tempdir().expect("a folder");
    for (name, text) in [("a.txt", "one"), ("b.txt", "two")] {
        fs::write(place.path().join(name), text).expect("written");
    }
    seal(place.path());
    fs::rename(place.path().join("a.txt"), place.path().join("c.txt")).expect("renamed");
    fs::remove_file(place.path().join("b.txt")).expect("removed");
    assert_eq!(
        findings(place.path()),
        [
            "a.txt: is missing, and c.txt has its contents: was it renamed?",
            "b.txt: is missing",
            "c.txt: is not in SHA256SUMS",
        ]
    );
}

/// A manifest that cannot be read is none that is missing.
#[test]
fn a_manifest_that_cannot_be_read_is_told_so() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    drop(campaign(&path));
    let list = path.join(manifest::NAME);
    fs::remove_file(&list).expect("removed");
    assert_eq!(findings(&path), ["SHA256SUMS: is missing"]);
    fs::create_dir(&list).expect("made");
    let found = findings(&path);
    assert!(
        !found.contains(&"SHA256SUMS: is missing".to_owned()),
        "{found:?}"
    );
    assert!(found[0].starts_with("SHA256SUMS: "), "{found:?}");
}

/// Only a campaign has to have a manifest.
#[test]
fn an_ordinary_folder_needs_no_manifest_and_may_hold_other_summaries() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    drop(campaign(&path));
    let records = path.join("trials/001-1");
    for (name, text) in [
        ("summary.json", "{\"mean\": 4.2}"),
        ("summary.csv", "mean\n4.2\n"),
    ] {
        fs::write(records.join(name), text).expect("written");
    }
    let verified = verify(&records).expect("a folder");
    assert_eq!((verified.campaign, verified.records), (false, 1));
    assert_eq!(verified.findings, []);
}

/// Files of an attempt that has not ended reach the manifest as it ends: other files stay what they are.
#[test]
fn files_of_an_attempt_under_way_are_left_to_the_session() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let mut folder = campaign(&path);
    let began = LedgerRow::of(LedgerEvent::Began, 4, Some(1));
    folder
        .append(began, at(100), Origin::Board)
        .expect("written");
    let inside = folder.campaign().attempt_folder(4, 1);
    drop(folder);
    fs::create_dir_all(&inside).expect("made");
    fs::write(inside.join("run.part"), "x").expect("written");
    fs::write(path.join("stray.txt"), "x").expect("written");
    let found = verify(&path).expect("a folder").findings;
    let remedy = |of: &str| {
        let finding = found.iter().find(|finding| finding.path == of);
        finding.expect(of).remedy.clone()
    };
    assert!(
        remedy("trials/004-1/run.part").contains("takes this up"),
        "{found:?}"
    );
    assert!(
        remedy("trials/004-1").contains("takes this up"),
        "{found:?}"
    );
    assert!(
        remedy("stray.txt").contains("put there by hand"),
        "{found:?}"
    );
}

/// A finding on one file says nothing of another one that is gone.
#[test]
fn a_changed_plan_is_told_beside_what_it_leads_to() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    drop(campaign(&path));
    let plan = path.join("plan.toml");
    let text = fs::read_to_string(&plan).expect("there");
    fs::write(&plan, text.replace("format = 1", "format = 2")).expect("written");
    assert_eq!(
        findings(&path),
        [
            "plan.toml: was changed",
            "plan.toml: format 2, this tool reads 1",
        ]
    );
}

/// Every a_n needs its readings in the folder. They may be later by a clock that was set back since.
#[test]
fn an_indentation_of_readings_that_are_not_there_is_found() {
    for (set, discarded, found) in [(2, false, false), (3, false, true), (2, true, true)] {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("small");
        let mut folder = Folder::create(&path, SMALL, Path::new("small.toml")).expect("made");
        let name = folder.campaign().order[0].indentation.clone();
        let mut began = LedgerRow::of(LedgerEvent::Began, 1, Some(1));
        (began.readings_set, began.indentation_mm) = (Some(set), Some(mm("1")));
        folder.append(began, at(0), Origin::Board).expect("written");
        let mut ended = LedgerRow::of(LedgerEvent::Ended, 1, Some(1));
        ended.outcome = Some(AttemptOutcome::Stopped);
        folder
            .append(ended, at(30), Origin::Board)
            .expect("written");
        for first in [
            reading(1, None, 1, "24.4"),
            reading(2, Some(&name), 1, "22.4"),
        ] {
            let mut last = accepted(&first);
            if discarded && first.readings_set == 2 {
                last.event = Kind::Discarded;
            }
            for row in [first.clone(), last] {
                folder
                    .append_reading(row, at(600), Origin::Board)
                    .expect("written");
            }
        }
        drop(folder);
        let says = format!("a_n is of the readings {set}, and readings.csv has none accepted");
        let all = findings(&path);
        assert_eq!(all.iter().any(|one| one.contains(&says)), found, "{all:?}");
    }
}

/// An attempt at a fold has more records than that of its run.
#[test]
fn the_record_of_a_run_is_found_among_others() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let folder = campaign(&path);
    let records = folder.campaign().attempt_folder(1, 1);
    for name in [
        "unfold-20260131T120000Z.json",
        "unfold-20260131T120000Z.csv",
        "sync.csv",
    ] {
        fs::write(records.join(name), "").expect("written");
    }
    let run = folder.campaign().run_sidecar(1, 1).expect("there");
    let name = run.file_name().expect("a name").to_string_lossy();
    assert!(
        name.starts_with("run-") && name.ends_with(".json"),
        "{name}"
    );
}

/// A path that leaves the folder, or that `sha256sum` would read otherwise, is in no manifest.
#[test]
fn a_manifest_has_whole_hashes_and_paths_within_the_folder() {
    let parsed = |hash: &str, path: &str| Manifest::parse(&format!("{hash}  {path}\n"));
    let hash = "0123456789abcdef".repeat(4);
    for path in ["a", "a/b.csv", ".a", "a..b", "..a/b", "a b"] {
        assert!(parsed(&hash, path).is_ok(), "{path}");
    }
    for path in [
        "", ".", "..", "/a", "a/", "a//b", "a/./b", "a/../b", "../a", "a/..", "a\\b", "a\tb",
    ] {
        assert!(parsed(&hash, path).is_err(), "{path:?}");
    }
    for length in [0, 2, 62, 63, 65, 66, 128] {
        let digits = hash.repeat(2)[..length].to_owned();
        assert!(parsed(&digits, "a").is_err(), "{length}");
    }
}

/// The lock is empty and lies at the top: any other file of its name is one of the folder's.
#[test]
fn only_the_lock_itself_is_left_out_of_the_manifest() {
    let place = tempfile::tempdir().expect("a folder");
    let files = || contents(place.path()).expect("read").files;
    for name in [".lock", "empty"] {
        fs::write(place.path().join(name), "").expect("written");
    }
    fs::create_dir(place.path().join("in")).expect("made");
    fs::write(place.path().join("in/.lock"), "").expect("written");
    assert_eq!(files(), ["empty", "in/.lock"]);
    fs::write(place.path().join(".lock"), "x").expect("written");
    assert_eq!(files(), [".lock", "empty", "in/.lock"]);
    fs::remove_file(place.path().join(".lock")).expect("removed");
    fs::create_dir(place.path().join(".lock")).expect("made");
    assert_eq!(files(), ["empty", "in/.lock"]);
    fs::write(place.path().join(".lock/a"), "").expect("written");
    assert_eq!(files(), [".lock/a", "empty", "in/.lock"]);
}

/// No manifest can list them, so they are told one by one.
#[cfg(unix)]
#[test]
fn links_and_names_that_cannot_be_listed_are_told() {
    use std::os::unix::ffi::OsStrExt as _;

    let place = tempfile::tempdir().expect("a folder");
    fs::write(place.path().join("a.txt"), "one").expect("written");
    seal(place.path());
    std::os::unix::fs::symlink("a.txt", place.path().join("b.txt")).expect("linked");
    let names: [&[u8]; 2] = [b"c\\d.txt", b"e\xff.txt"];
    for name in names.map(std::ffi::OsStr::from_bytes) {
        fs::write(place.path().join(name), "one").expect("written");
    }
    let says = "is neither a file nor a folder, or has a name that cannot be listed";
    let expected = ["b.txt", "c\\d.txt", "e\u{fffd}.txt"].map(|name| format!("{name}: {says}"));
    assert_eq!(findings(place.path()), expected);
}

// Readings.

/// The reason for which somebody confirmed an odd reading stays on record, also when the rollers are clamped anew.
#[test]
fn a_confirmation_stays_with_readings_that_no_longer_hold() {
    let mut readings = Readings::default();
    for (set, is_accepted, kept) in [(1, true, "confirmed"), (2, false, "clamped anew")] {
        let first = reading(set, None, 1, "24.4");
        apply(&mut readings, first.clone());
        let mut row = accepted(&first);
        row.text = Some("confirmed".to_owned());
        if is_accepted {
            apply(&mut readings, row.clone());
        }
        (row.event, row.text) = (Kind::Discarded, Some("clamped anew".to_owned()));
        apply(&mut readings, row);
        let set = readings.sets.last().expect("there");
        assert_eq!((set.text.as_deref(), set.discarded), (Some(kept), true));
    }
}

/// Rollers that just reach the wall do not press it in.
#[test]
fn crests_as_far_apart_as_the_walls_give_no_indentation() {
    for (between, a_mm) in [("24.4", false), ("24.398", true)] {
        let mut readings = Readings::default();
        measured(&mut readings, None, &["24.4"]);
        measured(&mut readings, Some("a1"), &[between]);
        let set = readings.clamped().expect("clamped");
        let a = readings.indentation_mm(set);
        assert_eq!(a.is_some(), a_mm, "{a:?}");
    }
}

#[test]
fn a_width_is_questioned_from_more_than_a_fifth_off() {
    let text = SMALL.replace("width_about_mm = 24.4", "width_about_mm = 25");
    for (value, asked) in [("30", 0), ("30.001", 1), ("20", 0), ("19.999", 1)] {
        let mut readings = Readings::default();
        measured(&mut readings, None, &[value]);
        let set = readings.sets.last().expect("one");
        let asks = questions(&plan(&text), &readings, set);
        assert_eq!(asks.len(), asked, "{value}: {asks:?}");
    }
}

/// No resolution is none that a reading could miss.
#[test]
fn without_a_resolution_every_reading_is_taken() {
    for value in ["24.4", "24.401"] {
        let why = refusal(Quantity::Width, mm(value), None, mm("0"));
        assert_eq!(why, None, "{value}");
    }
}

// Motions.

/// The rollers stay as they are within a block, and homing takes half a minute.
#[test]
fn a_rig_is_homed_once_in_a_block() {
    let short = [
        ("duration_s = 40", "duration_s = 8"),
        ("count = 5", "count = 1"),
    ];
    let place = place(&changed(PAPER, &[&ONE_CONDITION[..], &short].concat()));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(Some(VIRTUAL_UID));
    let args = [
        "campaign", "run", &plan, "--out", &out, "--yes", "--trials", "3",
    ];
    let at = ["--rig", "0", "--capsule", "1"];
    let (code, said, err) = memory.run(&[&args[..], &at].concat());
    assert_eq!(code, 0, "{said}{err}");
    let heard = memory.heard();
    let count = |name| heard.iter().filter(|heard| **heard == name).count();
    assert_eq!((count("Home"), count("Run")), (1, 3), "{heard:?}");
}
