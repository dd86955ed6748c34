//! Values exactly at a bound, and cases in which a campaign says the one thing and not the other.

use std::fs;

use jiff::SignedDuration;
use lab::campaign::ledger::{LedgerEvent, LedgerRow, Source};
use lab::campaign::manifest::{self, Manifest, contents};
use lab::campaign::readings::{Kind, Quantity, Readings, refusal};
use lab::campaign::remaining::remaining_s;
use lab::campaign::verify::verify;
use simulated_machines::machine::VIRTUAL_UID;

use crate::campaign::{
    accepted, append, apply, campaign, findings, measured, mm, reading, relist, small,
};
use crate::campaign_run::{Place, WIDTH, clamped, machines, small_plan};
use crate::support::plan::{ONE_CONDITION, PAPER, changed};

// Questions.

/// There is nothing to take back yet, so the question stays.
#[test]
fn an_undo_before_the_first_reading_asks_for_the_reading() {
    let at = Place::of(&small_plan(&[]));
    let lines = vec![
        ("rollers OFF", ""),
        ("Reading 1 of 2: D", "undo"),
        ("a number is needed here", "24.4"),
        ("Reading 2 of 2: D", "q"),
    ];
    at.answered(&machines(None), 130, lines);
    let campaign = at.read();
    assert_eq!(campaign.readings.sets[0].values, [mm("24.4")]);
}

/// A number typed there would be taken for a measurement.
#[test]
fn a_number_at_the_virtual_bench_is_no_displacement() {
    let at = Place::of(&small_plan(&[]));
    let trial = [
        ("Trial 1 of 6", ""),
        ("Displacement by the model", "12.5"),
        ("nothing can be measured on the virtual bench", ""),
        ("Clamp both rollers", "q"),
    ];
    let lines = [&WIDTH[..], &clamped("20.4"), &trial].concat();
    let memory = machines(Some(VIRTUAL_UID));
    at.answered(&memory, 130, lines);
    let campaign = at.read();
    let counted = campaign.state.trials[0].counted().expect("counts");
    assert_eq!(counted.source, Source::Model);
    assert_ne!(counted.value, mm("12.5"));
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

// Folders.

/// A manifest that cannot be read is none that is missing.
#[test]
fn a_manifest_that_cannot_be_read_is_told_so() {
    let (_place, path) = small();
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

/// Files of an attempt that has not ended reach the manifest as it ends: other files stay what they are.
#[test]
fn files_of_an_attempt_under_way_are_left_to_the_session() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let mut folder = campaign(&path);
    let began = LedgerRow::of(LedgerEvent::Began, 4, Some(1));
    append(&mut folder, began, 100);
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
    let (_place, path) = small();
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
    relist(place.path());
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

/// The reason for which somebody confirmed an odd reading stays on record, also when the rollers are clamped again.
#[test]
fn a_confirmation_stays_with_readings_that_no_longer_hold() {
    let mut readings = Readings::default();
    for (set, is_accepted, kept) in [(1, true, "confirmed"), (2, false, "clamped again")] {
        let first = reading(set, None, 1, "24.4");
        apply(&mut readings, first.clone());
        let mut row = accepted(&first);
        row.text = Some("confirmed".to_owned());
        if is_accepted {
            apply(&mut readings, row.clone());
        }
        (row.event, row.text) = (Kind::Discarded, Some("clamped again".to_owned()));
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
    let at = Place::of(&changed(PAPER, &[&ONE_CONDITION[..], &short].concat()));
    let memory = machines(Some(VIRTUAL_UID));
    at.unattended(&memory, 0, &["--yes", "--trials", "3"]);
    let heard = memory.heard();
    let count = |name| heard.iter().filter(|heard| **heard == name).count();
    assert_eq!((count("Home"), count("Run")), (1, 3), "{heard:?}");
}
