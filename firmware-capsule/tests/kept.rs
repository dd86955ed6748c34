//! What a capsule keeps in flash, also when the power is cut while it is written.

#[path = "../../device/tests/chip/mod.rs"]
mod chip;

use chip::{Cut, Flash};
use firmware_capsule::{
    calibration::Calibration,
    kept::{Kept, Totals},
    mechanics::Thread,
    settings::Settings,
};
use protocol::settings::SettingKey as Key;

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
    let mut kept = Kept::load(flash.clone()).0;
    assert_eq!(
        (kept.calibration(), *kept.totals()),
        (None, Totals::default())
    );
    kept.keep_calibration(CALIBRATION).unwrap();
    kept.keep_totals(totals(7)).unwrap();
    let later = Kept::load(flash).0;
    assert_eq!(
        (later.calibration(), *later.totals()),
        (Some(CALIBRATION), totals(7))
    );
}

/// The log drops its oldest sector; a calibration from years ago must not be in it.
#[test]
fn a_calibration_survives_thousands_of_motions() {
    let flash = Flash::blank();
    let mut kept = Kept::load(flash.clone()).0;
    kept.keep_calibration(CALIBRATION).unwrap();
    for actuations in 1..=5_000 {
        kept.keep_totals(totals(actuations)).unwrap();
    }
    let later = Kept::load(flash).0;
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
            let mut kept = Kept::load(flash.clone()).0;
            kept.keep_calibration(CALIBRATION).unwrap();
            kept.keep_totals(totals(1)).unwrap();
            let flash = Flash::holding(flash.bytes());
            let mut kept = Kept::load(flash.clone()).0;
            flash.cut(after, cut, seed);
            let _ = kept.keep_totals(totals(2));
            let later = Kept::load(Flash::holding(flash.bytes())).0;
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
    // No setting allows a fold within 7 mm, or one of 30.
    for um in [7_000_i32, 30_000, -1, i32::MAX] {
        let mut impossible = record;
        impossible[1..5].copy_from_slice(&um.to_le_bytes());
        assert_eq!(Calibration::from_record(&impossible), None, "{um}");
    }
}

/// Sets a value as control does.
fn set(kept: &mut Kept<Flash>, key: Key, value: u32) -> bool {
    let values = kept.values().with(key, value).expect("within its range");
    let settings = Settings::new(&values).expect("they go together");
    kept.set(key, value, settings).is_ok()
}

#[test]
fn settings_and_name_outlive_thousands_of_motions_and_a_reset_leaves_the_calibration() {
    let flash = Flash::blank();
    let mut kept = Kept::load(flash.clone()).0;
    kept.keep_calibration(CALIBRATION).unwrap();
    assert!(set(&mut kept, Key::EndForceMa, 120));
    assert!(set(&mut kept, Key::LinkTimeoutMs, 2_500));
    kept.set_name("c-1".try_into().unwrap()).unwrap();
    for actuations in 1..=2_000 {
        kept.keep_totals(totals(actuations)).unwrap();
    }
    let (mut later, usable) = Kept::load(flash.clone());
    assert!(usable);
    assert_eq!(later.values().get(Key::EndForceMa), 120);
    assert_eq!(later.settings().force_ma, 120);
    assert_eq!(later.settings().link_timeout_us, 2_500_000);
    assert_eq!(later.name(), "c-1");
    later.reset().unwrap();
    let (reset, usable) = Kept::load(flash);
    assert!(usable);
    assert_eq!(*reset.settings(), Settings::default());
    assert_eq!((reset.name(), reset.calibration()), ("", Some(CALIBRATION)));
    assert_eq!(*reset.totals(), totals(2_000));
}

#[test]
fn a_cut_leaves_the_old_setting_or_the_new_one() {
    for (seed, cut) in (0..).zip(Cut::ALL) {
        for after in 0..4 {
            let flash = Flash::blank();
            let mut kept = Kept::load(flash.clone()).0;
            kept.keep_calibration(CALIBRATION).unwrap();
            assert!(set(&mut kept, Key::EndForceMa, 100));
            let flash = Flash::holding(flash.bytes());
            let mut kept = Kept::load(flash.clone()).0;
            flash.cut(after, cut, seed);
            let _ = set(&mut kept, Key::EndForceMa, 120);
            let (later, usable) = Kept::load(Flash::holding(flash.bytes()));
            assert!(usable);
            assert_eq!(later.calibration(), Some(CALIBRATION), "{cut:?} {after}");
            assert!(
                [100, 120].contains(&later.settings().force_ma),
                "{cut:?} {after}"
            );
        }
    }
}

/// A cut of the power within a reset may leave values that do not go together.
#[test]
fn settings_that_do_not_go_together_are_the_defaults() {
    let flash = Flash::blank();
    let mut kept = Kept::load(flash.clone()).0;
    kept.keep_calibration(CALIBRATION).unwrap();
    // As no request could: the rules are what `Settings::new` checks.
    let defaults = Settings::default();
    kept.set(Key::LoadedBatteryMv, 3_400, defaults).unwrap();
    let (mut later, usable) = Kept::load(flash.clone());
    assert!(!usable);
    assert_eq!(*later.settings(), defaults);
    assert_eq!(later.values().get(Key::LoadedBatteryMv), 2_700);
    assert_eq!(later.calibration(), Some(CALIBRATION));
    later.reset().unwrap();
    assert!(Kept::load(flash).1);
}

/// A rig's records, should the flash have been a rig's, are no settings of a capsule.
#[test]
fn a_key_of_the_rig_is_no_setting() {
    let flash = Flash::blank();
    let mut rig = device::settings::SettingsStore::load(flash.clone(), |_| true).0;
    rig.set(Key::StrokeUm, 100_000).unwrap();
    rig.set(Key::LeadUm, 5_000).unwrap();
    let (kept, usable) = Kept::load(flash);
    assert!(usable);
    assert_eq!(kept.values().get(Key::StrokeUm), 130_000);
    assert_eq!(
        (kept.calibration(), *kept.totals()),
        (None, Totals::default())
    );
}
