//! `capsule cycle`: what is counted, what drifts, how it ends, and what it says first.

use crate::cli::rows;
use crate::support::tool::{Memory, ready};
use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::trials::endurance::Run;
use protocol::system::DeviceKind;
use serde_json::Value;
use simulated_machines::machine::capsule::FOLDED_UM;
use simulated_machines::machine::{Script, World, link};

/// Runs `capsule cycle`. Returns exit code, rows, summary and text.
fn cycle(script: Script, pairs: &str) -> (u8, Vec<Vec<Option<f64>>>, Value, String) {
    let folder = tempfile::tempdir().expect("folder");
    let out_dir = folder.path().to_str().expect("UTF-8");
    let args = ["capsule", "cycle", pairs, "--out", out_dir];
    let (code, out, err) = Memory::with(vec![script]).run(&args);
    let file = |extension: &str| {
        let files = std::fs::read_dir(folder.path()).expect("a folder");
        files
            .map(|file| file.expect("a file").path())
            .find(|path| path.extension().is_some_and(|found| found == extension))
    };
    let (Some(csv), Some(json)) = (file("csv"), file("json")) else {
        return (code, vec![], Value::Null, out + &err);
    };
    let text = std::fs::read_to_string(json).expect("a file");
    let summary = serde_json::from_str(&text).expect("JSON");
    let rows = match std::fs::metadata(&csv).expect("a file").len() {
        0 => vec![],
        _ => rows(&csv).1,
    };
    (code, rows, summary, out + &err)
}

#[test]
fn endurance_counts_what_was_done_and_says_what_drifts() {
    let (code, rows, summary, text) = cycle(ready(DeviceKind::Capsule), "3");
    assert_eq!(code, 0, "{text}");
    assert_eq!(rows.len(), 3);
    for (pair, row) in (1..).zip(&rows) {
        assert_eq!(row[0], Some(f64::from(pair)));
        let folded_um = row[2].expect("a number");
        assert!(
            (folded_um - f64::from(FOLDED_UM)).abs() < 100.0,
            "{folded_um}"
        );
        // The model's no-load current is 16 mA.
        let no_load_ma = row[5].expect("heard");
        assert!((no_load_ma - 16.0).abs() < 1.5, "{no_load_ma}");
        let unfolded_um = row[9].expect("a number");
        assert!((-200.0..300.0).contains(&unfolded_um), "{unfolded_um}");
    }
    assert_eq!(
        (&summary["status"], &summary["done"]),
        (&"complete".into(), &3.into())
    );
    let folded = &summary["drift"]["folded_um"];
    assert_eq!(folded["first"].as_f64(), rows[0][2]);
    assert_eq!(folded["last"].as_f64(), rows[2][2]);
    assert!(folded["per_100_pairs"].is_number());
    assert!(
        text.contains("3 of 3 pairs.") && text.contains("no-load current"),
        "{text}"
    );
}

#[test]
fn endurance_ends_with_the_first_thing_that_is_wrong() {
    let at = |at_us, world| Script {
        world: vec![(at_us, world)],
        ..ready(DeviceKind::Capsule)
    };
    // A pair takes 3.7 s.
    let second = 6_000_000;
    let (code, rows, summary, text) = cycle(at(second, World::StopFrame), "5");
    assert_eq!((code, rows.len()), (130, 1), "{text}");
    assert_eq!(
        (&summary["status"], &summary["done"]),
        (&"stopped".into(), &1.into())
    );
    assert!(text.contains("1 of 5 pairs"), "{text}");

    let (code, rows, summary, text) = cycle(at(second, World::Battery { mv: 2_900 }), "5");
    assert_eq!(
        rows.len(),
        summary["done"].as_u64().expect("a number") as usize
    );
    assert!(rows.len() < 5 && (code == 3 || code == 6), "{code} {text}");
    assert!(text.contains("battery"), "{text}");
    assert_ne!(summary["status"], "refused", "a pair was carried out");

    let (code, rows, summary, text) = cycle(at(second, World::Reset), "5");
    assert_eq!((code, rows.len()), (4, 1), "{text}");
    assert_eq!(summary["status"], "unknown");

    // The cell is too low before anything moves.
    let (code, rows, summary, text) = cycle(at(0, World::Battery { mv: 2_900 }), "5");
    assert_eq!((code, rows.len()), (3, 0), "{text}");
    assert_eq!(summary["status"], "refused");
    assert!(text.contains("0 of 5 pairs"), "{text}");
    let (code, _, summary, text) = cycle(Script::new(DeviceKind::Capsule), "5");
    assert_eq!((code, summary), (3, Value::Null), "{text}");
    assert!(text.contains("retrograde capsule reference"), "{text}");
}

/// Regression: a capsule that may be moving was hidden behind a summary whose folder was gone.
#[test]
fn a_capsule_that_is_lost_is_told_although_the_summary_cannot_be_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("usb-stick");
    let script = Script {
        // In the second pair; one takes 3.7 s.
        world: vec![(6_000_000, World::Reset)],
        ..ready(DeviceKind::Capsule)
    };
    let (link, _) = link(script);
    let mut capsule = Device::connect(link, DeviceKind::Capsule, 5).expect("there");
    let origin = capsule.origin();
    let mut run = Run::create(&out, Timestamp::UNIX_EPOCH, 5, origin).expect("created");
    let ended = run.carry_out(&mut capsule, &mut Unobserved, &mut |_| {
        std::fs::remove_dir_all(&out).expect("removed");
    });
    let told = ended.expect_err("lost").to_string();
    assert!(told.contains("it was reset"), "{told}");
    assert_eq!(run.endurance.done, 1);
}
