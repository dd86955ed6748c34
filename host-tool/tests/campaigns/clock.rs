//! Campaigns on a computer whose clock was set back meanwhile: nothing honest is condemned, and what was forged is
//! found even so.

use std::fs;
use std::path::Path;

use crate::campaign::{SMALL, accepted, at, findings, mm, reading};
use crate::support::tool::ready;
use client::identity::Origin;
use client::{Device, Unobserved};
use lab::campaign::contents::Campaign;
use lab::campaign::folder::Folder;
use lab::campaign::ledger::{AttemptOutcome, LedgerEvent, LedgerRow, Source};
use lab::campaign::manifest;
use lab::trials::experiment;
use lab::trials::trial::Recording;
use protocol::capsule::ActuationKind;
use protocol::system::DeviceKind;
use simulated_machines::machine::link;

fn append(folder: &mut Folder, row: LedgerRow, time_s: i64) {
    let written = folder.append(row, at(time_s), Origin::Board);
    written.expect("written");
}

/// A campaign with one attempt at each of its first trials. By the computer's clock it began, its record started and
/// it ended at these times, s.
fn attempted(path: &Path, attempts: &[[i64; 3]]) {
    let mut folder = Folder::create(path, SMALL, Path::new("small.toml")).expect("made");
    let link = link(ready(DeviceKind::Rig)).0;
    let mut rig = Device::connect(link, DeviceKind::Rig, 5).expect("there");
    for (trial, [began_s, started_s, ended_s]) in (1..).zip(attempts) {
        let row = |event| LedgerRow::of(event, trial, Some(1));
        append(&mut folder, row(LedgerEvent::Began), *began_s);
        let recording = Recording {
            folder: folder.campaign().attempt_folder(trial, 1),
            stem: "run".to_owned(),
            now: at(*started_s),
            note: None,
            telemetry_ms: 100,
        };
        let run = folder.campaign().plan.run;
        experiment::run(&mut rig, run, &recording, &mut Unobserved).expect("run");
        let mut ended = row(LedgerEvent::Ended);
        ended.outcome = Some(AttemptOutcome::Complete);
        append(&mut folder, ended, *ended_s);
        folder.seal_attempt(trial, 1).expect("written");
        let mut measured = row(LedgerEvent::Displacement);
        measured.displacement_mm = Some(mm("4.2"));
        measured.source = Some(Source::Measured);
        append(&mut folder, measured, *ended_s);
    }
}

#[test]
fn a_clock_that_is_set_back_within_an_attempt_condemns_no_record() {
    let cases: [(&str, &[[i64; 3]]); 5] = [
        ("by 10 s before the record", &[[100, 93, 133]]),
        ("by 40 s after its start", &[[100, 130, 120]]),
        ("by 2 h before it", &[[9_000, 1_805, 1_840]]),
        ("by 2 h after its start", &[[9_000, 9_005, 1_840]]),
        (
            "into the attempt before, which has a record of its own",
            &[[100, 105, 140], [150, 135, 170]],
        ),
    ];
    for (set_back, attempts) in cases {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("small");
        attempted(&path, attempts);
        assert_eq!(findings(&path), Vec::<String>::new(), "{set_back}");
    }
}

/// A run of some hours later, or before, takes the place of one that went badly. Up to an hour may be the clock.
#[test]
fn a_record_of_hours_later_is_found() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    attempted(&path, &[[100, 100 + 3_600, 140]]);
    assert_eq!(findings(&path), [""; 0]);
    for attempt in [
        [100, 3 * 3_600, 140],
        [100, 140 + 3_700, 140],
        [100, 100 + 3_601, 140],
        [100, -2 * 3_600, 140],
    ] {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("small");
        attempted(&path, &[attempt]);
        let found = findings(&path);
        assert!(
            found
                .iter()
                .any(|one| one.starts_with("trials/001-1: run-")),
            "{found:?}"
        );
    }
}

/// Exchanged attempts are among the forged folders; here one record takes the place of another.
#[test]
fn a_record_of_another_attempt_is_found() {
    for (keeps, unfolds) in [(true, false), (false, false), (false, true)] {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("small");
        attempted(&path, &[[100, 105, 140], [200, 205, 240]]);
        assert_eq!(findings(&path), Vec::<String>::new());
        let campaign = Campaign::read(&path).expect("read");
        let [one, other] = [1, 2].map(|trial| campaign.attempt_folder(trial, 1));
        for entry in fs::read_dir(&one).expect("there").flatten() {
            fs::remove_file(entry.path()).expect("removed");
        }
        for entry in fs::read_dir(&other).expect("there").flatten() {
            let copy = one.join(entry.file_name());
            fs::copy(entry.path(), copy).expect("copied");
            if !keeps {
                fs::remove_file(entry.path()).expect("removed");
            }
        }
        if unfolds {
            // Another record is none of the run.
            unfolding(&other, 205);
        }
        let forged = manifest::of_folder(&path).expect("read").text();
        fs::write(path.join(manifest::NAME), forged).expect("written");
        let found = findings(&path);
        assert!(
            found
                .iter()
                .any(|one| one.starts_with("trials/001-1: run-")),
            "{found:?}"
        );
    }
}

/// A row of this kind, and its value, mm.
#[derive(Clone, Copy)]
enum Row {
    Width(&'static str),
    BetweenCrests(&'static str),
    /// An attempt with this a_n, from the last readings between the crests.
    Attempt(&'static str),
}

/// Findings in a campaign with these rows at these times, s.
fn with_rows(rows: &[(i64, Row)]) -> Vec<String> {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let mut folder = Folder::create(&path, SMALL, Path::new("small.toml")).expect("made");
    let name = folder.campaign().order[0].indentation.clone();
    for (time_s, row) in rows {
        let set = folder.campaign().readings.sets.len() as u32 + 1;
        let first = match row {
            Row::Width(value) => reading(set, None, 1, value),
            Row::BetweenCrests(value) => reading(set, Some(&name), 1, value),
            Row::Attempt(a_mm) => {
                let mut began = LedgerRow::of(LedgerEvent::Began, 1, Some(1));
                let clamped = folder.campaign().readings.clamped();
                began.readings_set = clamped.map(|set| set.number);
                began.indentation_mm = Some(mm(a_mm));
                append(&mut folder, began, *time_s);
                let mut ended = LedgerRow::of(LedgerEvent::Ended, 1, Some(1));
                ended.outcome = Some(AttemptOutcome::Stopped);
                append(&mut folder, ended, time_s + 30);
                continue;
            }
        };
        for row in [first.clone(), accepted(&first)] {
            let written = folder.append_reading(row, at(*time_s), Origin::Board);
            written.expect("written");
        }
    }
    drop(folder);
    findings(&path)
}

#[test]
fn a_clock_that_is_set_back_among_the_readings_condemns_no_indentation() {
    use Row::{Attempt, BetweenCrests, Width};
    let (first, i, again) = (Width("24.4"), BetweenCrests("22.4"), Width("24.402"));
    let cases: [(&str, &[(i64, Row)]); 4] = [
        (
            "by 2 h after the attempt",
            &[(0, first), (300, i), (600, Attempt("1")), (-4_800, again)],
        ),
        (
            "by 5 min before D was measured again, and that before the attempt",
            &[
                (0, first),
                (300, i),
                (120, again),
                (1_200, Attempt("1.001")),
            ],
        ),
        (
            "by 2 h between D and i",
            &[
                (0, first),
                (-6_900, i),
                (-6_600, Attempt("1")),
                (-6_000, again),
            ],
        ),
        (
            "not at all",
            &[(0, first), (300, i), (600, Attempt("1")), (900, again)],
        ),
    ];
    for (set_back, rows) in cases {
        assert_eq!(with_rows(rows), Vec::<String>::new(), "{set_back}");
    }
    let forged: [(&str, &[(i64, Row)]); 4] = [
        (
            "an a_n by a D that was measured again before the attempt",
            &[(0, first), (300, i), (400, again), (600, Attempt("1"))],
        ),
        (
            "an a_n by a later D",
            &[(0, first), (300, i), (600, Attempt("1.001")), (900, again)],
        ),
        (
            "an a_n by no D",
            &[(0, first), (300, i), (600, Attempt("1.5")), (-4_800, again)],
        ),
        (
            "an a_n by another D, after the clock was set back",
            &[
                (0, first),
                (-6_900, again),
                (-6_600, i),
                (-6_000, Attempt("1")),
            ],
        ),
    ];
    for (forgery, rows) in forged {
        let found = with_rows(rows);
        assert!(
            found.iter().any(|one| one.contains(": a_n is ")),
            "{forgery}: {found:?}"
        );
    }
}

#[test]
fn an_indentation_of_readings_at_another_place_is_found() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let mut folder = Folder::create(&path, SMALL, Path::new("small.toml")).expect("made");
    let other = match &*folder.campaign().order[0].indentation {
        "a1" => "a2",
        _ => "a1",
    };
    for first in [
        reading(1, None, 1, "24.4"),
        reading(2, Some(other), 1, "22.4"),
    ] {
        for row in [first.clone(), accepted(&first)] {
            folder
                .append_reading(row, at(0), Origin::Board)
                .expect("written");
        }
    }
    let mut began = LedgerRow::of(LedgerEvent::Began, 1, Some(1));
    (began.readings_set, began.indentation_mm) = (Some(2), Some(mm("1")));
    append(&mut folder, began, 10);
    let mut ended = LedgerRow::of(LedgerEvent::Ended, 1, Some(1));
    ended.outcome = Some(AttemptOutcome::Stopped);
    append(&mut folder, ended, 40);
    drop(folder);
    let found = findings(&path);
    assert!(
        found.iter().any(|one| one.contains("which are not of")),
        "{found:?}"
    );
}

/// Puts the record of an unfolding that started at this time, s, into a folder.
fn unfolding(folder: &Path, started_s: i64) {
    let link = link(ready(DeviceKind::Capsule)).0;
    let mut capsule = Device::connect(link, DeviceKind::Capsule, 5).expect("there");
    let fold = capsule.fold().expect("accepted");
    let folded = capsule.wait_actuation(&fold, &mut Unobserved);
    folded.expect("to its end");
    let recording = Recording {
        folder: folder.to_owned(),
        stem: "unfold".to_owned(),
        now: at(started_s),
        note: None,
        telemetry_ms: 100,
    };
    let kind = ActuationKind::Unfold;
    experiment::actuate(&mut capsule, kind, &recording, &mut Unobserved).expect("done");
}

/// A clock that is set from local time to UTC steps by less than a day, so an unfolding of more than a day before its
/// attempt was put there.
#[test]
fn an_unfolding_of_more_than_a_day_before_its_attempt_is_found() {
    for (before_s, found) in [(86_400, false), (86_401, true)] {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("small");
        attempted(&path, &[[100, 105, 140]]);
        let attempt = Campaign::read(&path).expect("read").attempt_folder(1, 1);
        unfolding(&attempt, 100 - before_s);
        let sealed = manifest::of_folder(&path).expect("read").text();
        fs::write(path.join(manifest::NAME), sealed).expect("written");
        let all = findings(&path);
        let is_found = all.iter().any(|one| one.contains("unfold-"));
        assert_eq!(
            (is_found, all.len()),
            (found, usize::from(found)),
            "{all:?}"
        );
    }
}

/// A clock that is set from local time to UTC steps by less than a day: no more is between two rows.
#[test]
fn rows_may_lie_a_day_before_the_row_above_and_no_more() {
    for (back_s, found) in [(86_400, 0), (86_401, 2)] {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("small");
        let mut folder = Folder::create(&path, SMALL, Path::new("small.toml")).expect("made");
        for (number, time_s) in [(1, 0), (2, -back_s)] {
            let note = LedgerRow::of(LedgerEvent::Note, 1, None).saying(Some("dry".to_owned()));
            append(&mut folder, note, time_s);
            let row = reading(1, None, number, "24.4");
            let written = folder.append_reading(row, at(time_s), Origin::Board);
            written.expect("written");
        }
        drop(folder);
        let all = findings(&path);
        let rows = all.iter().filter(|one| one.contains("row 2 is of"));
        assert_eq!((rows.count(), all.len()), (found, found), "{all:?}");
        // The next session takes the same step back, and no more.
        for (more_s, refused) in [(0, false), (1, true)] {
            let resumed = Folder::resume(&path, at(-86_400 - more_s), &mut |_| true);
            assert_eq!(resumed.is_err(), refused, "{back_s} {more_s}");
        }
    }
}
