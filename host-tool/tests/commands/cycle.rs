//! `capsule cycle`: its rows, the records of its motions, and how it ends.

use crate::cli::rows;
use crate::support::tool::{Memory, ready};
use protocol::system::DeviceKind;
use simulated_machines::machine::capsule::FOLDED_UM;
use simulated_machines::machine::{Script, World};

/// Runs `capsule cycle`. Returns exit code, rows, the number of motions' records, and the text.
fn cycle(script: Script, count: &str) -> (u8, Vec<Vec<Option<f64>>>, usize, String) {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().to_str().expect("UTF-8");
    let args = ["capsule", "cycle", "--count", count, "--out", out];
    let (code, out, err) = Memory::with(vec![script]).run(&args);
    let files = std::fs::read_dir(folder.path()).expect("a folder");
    let paths: Vec<_> = files.map(|file| file.expect("a file").path()).collect();
    let text = |path: &std::path::Path| std::fs::read_to_string(path).expect("text");
    let own = |path: &&std::path::PathBuf| path.to_string_lossy().contains("cycle-");
    let rows = match paths.iter().find(own) {
        Some(csv) if !text(csv).is_empty() => rows(csv).1,
        _ => vec![],
    };
    let records = paths
        .iter()
        .filter(|path| path.extension().is_some_and(|it| it == "json"));
    (code, rows, records.count(), out + &err)
}

#[test]
fn each_cycle_is_a_row_and_each_motion_a_record() {
    let (code, rows, records, text) = cycle(ready(DeviceKind::Capsule), "3");
    assert_eq!((code, rows.len(), records), (0, 3, 6), "{text}");
    for (number, row) in (1..).zip(&rows) {
        assert_eq!(row[0], Some(f64::from(number)));
        let folded_um = row[2].expect("a number");
        assert!(
            (folded_um - f64::from(FOLDED_UM)).abs() < 100.0,
            "{folded_um}"
        );
        let unfolded_um = row[7].expect("a number");
        assert!((-200.0..300.0).contains(&unfolded_um), "{unfolded_um}");
    }
}

#[test]
fn it_ends_with_the_first_thing_that_is_wrong() {
    let at = |at_us, world| Script {
        world: vec![(at_us, world)],
        ..ready(DeviceKind::Capsule)
    };
    // A cycle takes 6.7 s, so this is in the second one.
    let second = 9_000_000;
    let unreferenced = Script::new(DeviceKind::Capsule);
    for (script, codes, done, says) in [
        (at(second, World::StopFrame), &[130][..], 1, "1 of 5 cycles"),
        // The fold under way still ends; the next one is refused.
        (at(second, World::Battery { mv: 2_900 }), &[3], 2, "battery"),
        (at(second, World::Reset), &[4], 1, "it was reset"),
        (at(0, World::Battery { mv: 2_900 }), &[3], 0, "battery"),
        (unreferenced, &[3], 0, "retrograde capsule reference"),
    ] {
        let (code, rows, _, text) = cycle(script, "5");
        assert!(codes.contains(&code), "{code} {text}");
        assert_eq!(rows.len(), done, "{text}");
        assert!(text.contains(says), "{text}");
    }
}
