//! What a capsule keeps in flash, also when the power is cut while it is written.

#[path = "../../device/tests/chip/mod.rs"]
mod chip;

use chip::{Cut, Flash};
use firmware_capsule::{
    calibration::Calibration,
    kept::{Kept, Totals},
    mechanics::Thread,
};

const CALIBRATION: Calibration = Calibration {
    folded: Thread(21_727),
    no_load_ma: 15,
    rise: Thread(1_538),
    tension_ma: 54,
};

fn totals(actuations: u32) -> Totals {
    Totals {
        actuations,
        energy_mj: u64::from(actuations) * 250,
        folded: actuations % 2 == 1,
    }
}

#[test]
fn both_records_come_back() {
    let flash = Flash::blank();
    let mut kept = Kept::load(flash.clone());
    assert_eq!(
        (kept.calibration(), *kept.totals()),
        (None, Totals::default())
    );
    kept.keep_calibration(CALIBRATION).unwrap();
    kept.keep_totals(totals(7)).unwrap();
    let later = Kept::load(flash);
    assert_eq!(
        (later.calibration(), *later.totals()),
        (Some(CALIBRATION), totals(7))
    );
}

/// The log drops its oldest sector; a calibration from years ago must not be in it.
#[test]
fn a_calibration_survives_thousands_of_motions() {
    let flash = Flash::blank();
    let mut kept = Kept::load(flash.clone());
    kept.keep_calibration(CALIBRATION).unwrap();
    for actuations in 1..=5_000 {
        kept.keep_totals(totals(actuations)).unwrap();
    }
    let later = Kept::load(flash);
    assert_eq!(
        (later.calibration(), *later.totals()),
        (Some(CALIBRATION), totals(5_000))
    );
}

#[test]
fn a_cut_leaves_the_old_totals_or_the_new_ones() {
    for (seed, cut) in (0..).zip(Cut::ALL) {
        for after in 0..4 {
            let flash = Flash::blank();
            let mut kept = Kept::load(flash.clone());
            kept.keep_calibration(CALIBRATION).unwrap();
            kept.keep_totals(totals(1)).unwrap();
            let flash = Flash::holding(flash.bytes());
            let mut kept = Kept::load(flash.clone());
            flash.cut(after, cut, seed);
            let _ = kept.keep_totals(totals(2));
            let later = Kept::load(Flash::holding(flash.bytes()));
            assert_eq!(later.calibration(), Some(CALIBRATION), "{cut:?} {after}");
            assert!(
                [totals(1), totals(2)].contains(later.totals()),
                "{cut:?} {after}"
            );
        }
    }
}

#[test]
fn records_of_another_layout_are_left_out() {
    let record = CALIBRATION.record();
    assert_eq!(Calibration::from_record(&record), Some(CALIBRATION));
    assert_eq!(Calibration::from_record(&record[..10]), None);
    let mut other = record;
    other[0] = 2;
    assert_eq!(Calibration::from_record(&other), None);
    // No capsule folds within 12 mm, or only after 30.
    for um in [12_000_i32, 30_000, -1, i32::MAX] {
        let mut impossible = record;
        impossible[1..5].copy_from_slice(&um.to_le_bytes());
        assert_eq!(Calibration::from_record(&impossible), None, "{um}");
    }
}
