//! Data that a capsule keeps in flash, also over a power cut during a write.

use device::{settings::SettingsStore, store::StorageFailed};
use firmware_capsule::{
    calibration::Calibration,
    kept::{CALIBRATION as CALIBRATION_NUMBER, Kept, TOTALS as TOTALS_NUMBER, Totals},
    mechanics::Thread,
    settings::Settings,
};
use protocol::{
    settings::{MAX_NAME, SettingKey as Key},
    system::DeviceKind,
};
use simulated_machines::chip::{Cut, Flash};
use simulated_machines::dice::Dice;

type Store = SettingsStore<Flash, Kept>;

/// Starts on a flash; the second value tells whether its content is usable.
fn load(flash: &Flash) -> (Store, bool) {
    Store::load_with(flash.clone(), |values| Settings::new(values).is_ok())
}

/// Starts on a usable log.
fn start(flash: &Flash) -> Store {
    let (store, usable) = load(flash);
    assert!(usable);
    store
}

fn keep_totals(store: &mut Store, totals: Totals) -> Result<(), StorageFailed> {
    let kept = Kept {
        totals,
        ..*store.records()
    };
    store.keep(TOTALS_NUMBER, kept)
}

fn keep_calibration(store: &mut Store) {
    let kept = Kept {
        calibration: Some(CALIBRATION),
        ..*store.records()
    };
    store.keep(CALIBRATION_NUMBER, kept).unwrap();
}

fn kept(totals: Totals) -> Kept {
    Kept {
        calibration: Some(CALIBRATION),
        totals,
    }
}

fn name(text: &str) -> heapless::String<MAX_NAME> {
    text.try_into().unwrap()
}

const CALIBRATION: Calibration = Calibration {
    folded: Thread(21_727),
    no_load_ma: 15,
    rise: Thread(1_538),
    long_rise: Thread(3_402),
    tension_ma: 54,
    back_emf_uv_cps: 207,
};

fn totals(actuations: u32) -> Totals {
    Totals {
        actuations,
        energy_mj: u64::from(actuations) * 250,
        folded: (actuations % 2 == 1).then_some(Thread(1_300)),
    }
}

/// A margin that is not a whole number of its units comes back longer, never shorter.
#[test]
fn the_margin_of_a_folded_end_is_rounded_up() {
    for (margin_um, kept_um) in [(0, 10), (100, 100), (101, 110), (1_300, 1_300)] {
        let flash = Flash::blank();
        let mut store = start(&flash);
        let totals = Totals {
            folded: Some(Thread(margin_um)),
            ..totals(1)
        };
        store.keep(TOTALS_NUMBER, kept(totals)).unwrap();
        let folded = start(&flash).records().totals.folded;
        assert_eq!(folded, Some(Thread(kept_um)), "{margin_um} um");
    }
}

#[test]
fn both_records_come_back() {
    let flash = Flash::blank();
    let mut store = start(&flash);
    assert_eq!(*store.records(), Kept::default());
    keep_calibration(&mut store);
    keep_totals(&mut store, totals(7)).unwrap();
    assert_eq!(*start(&flash).records(), kept(totals(7)));
}

/// The log drops its oldest sector; a calibration from years ago must not be in it.
#[test]
fn a_calibration_survives_thousands_of_motions() {
    let flash = Flash::blank();
    let mut store = start(&flash);
    keep_calibration(&mut store);
    for actuations in 1..=5_000 {
        keep_totals(&mut store, totals(actuations)).unwrap();
    }
    assert_eq!(*start(&flash).records(), kept(totals(5_000)));
}

#[test]
fn a_cut_leaves_the_old_totals_or_the_new_ones() {
    for (seed, cut) in (0..).zip(Cut::ALL) {
        for after in 0..4 {
            let flash = Flash::blank();
            let mut store = start(&flash);
            keep_calibration(&mut store);
            keep_totals(&mut store, totals(1)).unwrap();
            let flash = Flash::holding(flash.bytes());
            let mut store = start(&flash);
            flash.cut(after, cut, seed);
            let _ = keep_totals(&mut store, totals(2));
            let later = start(&Flash::holding(flash.bytes()));
            assert!(
                [kept(totals(1)), kept(totals(2))].contains(later.records()),
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
    other[0] = 1;
    assert_eq!(Calibration::from_record(&other), None);
    // No setting allows a fold within 7 mm, or one of 30.
    for um in [7_000_i32, 30_000, -1, i32::MAX] {
        let mut impossible = record;
        impossible[1..5].copy_from_slice(&um.to_le_bytes());
        assert_eq!(Calibration::from_record(&impossible), None, "{um}");
    }
}

/// A capsule keeps its calibration over an update from the firmware that did not measure the back-EMF yet.
#[test]
fn a_record_of_the_layout_before_is_read_without_the_back_emf() {
    // Version 2: 21,727 um, 15 mA, 1,538 um, 54 mA, 3,402 um.
    let older = [2, 0xDF, 0x54, 0, 0, 15, 0, 0x02, 0x06, 54, 0, 0x4A, 0x0D];
    let expected = Calibration {
        back_emf_uv_cps: 0,
        ..CALIBRATION
    };
    assert_eq!(Calibration::from_record(&older), Some(expected));
    // Only in its own length, and no other version in this one.
    assert_eq!(Calibration::from_record(&older[..12]), None);
    let longer = [&older[..], &[207, 0]].concat();
    assert_eq!(Calibration::from_record(&longer), None);
    for version in [0, 1, 3, 4] {
        let other = [&[version], &older[1..]].concat();
        assert_eq!(Calibration::from_record(&other), None, "{version}");
    }
}

#[test]
fn settings_and_name_outlive_thousands_of_motions_and_a_reset_leaves_the_calibration() {
    let flash = Flash::blank();
    let mut store = start(&flash);
    keep_calibration(&mut store);
    store.set(Key::EndForceMa, 120).unwrap();
    store.set(Key::LinkTimeoutMs, 2_500).unwrap();
    store.set_name(name("c-1")).unwrap();
    for actuations in 1..=2_000 {
        keep_totals(&mut store, totals(actuations)).unwrap();
    }
    let mut later = start(&flash);
    assert_eq!(later.values().get(Key::EndForceMa), 120);
    assert_eq!(later.values().get(Key::LinkTimeoutMs), 2_500);
    assert_eq!(later.name(), "c-1");
    later.reset().unwrap();
    let reset = start(&flash);
    for key in Key::of(DeviceKind::Capsule) {
        assert_eq!(reset.values().get(key), key.range().default);
    }
    assert_eq!((reset.name(), *reset.records()), ("", kept(totals(2_000))));
}

#[test]
fn a_cut_leaves_the_old_setting_or_the_new_one() {
    for (seed, cut) in (0..).zip(Cut::ALL) {
        for after in 0..4 {
            let flash = Flash::blank();
            let mut store = start(&flash);
            keep_calibration(&mut store);
            store.set(Key::EndForceMa, 100).unwrap();
            let flash = Flash::holding(flash.bytes());
            let mut store = start(&flash);
            flash.cut(after, cut, seed);
            let _ = store.set(Key::EndForceMa, 120);
            let later = start(&Flash::holding(flash.bytes()));
            assert_eq!(later.records().calibration, Some(CALIBRATION), "{cut:?}");
            let end_force_ma = later.values().get(Key::EndForceMa);
            assert!([100, 120].contains(&end_force_ma), "{cut:?} {after}");
        }
    }
}

/// Values of another firmware may break a rule together.
#[test]
fn settings_that_do_not_go_together_are_the_defaults() {
    let flash = Flash::blank();
    let mut store = start(&flash);
    keep_calibration(&mut store);
    // Write values that no request could: `Settings::new` checks the rules.
    store.set(Key::LoadedBatteryMv, 3_400).unwrap();
    let (mut later, usable) = load(&flash);
    assert!(!usable);
    assert_eq!(later.values().get(Key::LoadedBatteryMv), 2_700);
    assert_eq!(later.records().calibration, Some(CALIBRATION));
    later.reset().unwrap();
    let later = start(&flash);
    assert_eq!(later.records().calibration, Some(CALIBRATION));
}

/// Noise after the records that looks like one that is too long.
fn unreadable_after_what_is_there(flash: &Flash) -> Vec<u8> {
    let bytes = flash.bytes();
    let written = bytes.iter().rposition(|byte| *byte != 0xFF).unwrap();
    let next = (written + 1).next_multiple_of(4);
    let noisy = |seed| {
        let mut dice = Dice(seed);
        let mut bytes = bytes.clone();
        bytes[next..next + 64].fill_with(|| dice.bits() as u8);
        bytes
    };
    let mut noises = (0..10_000).map(noisy);
    noises
        .find(|bytes| !load(&Flash::holding(bytes.clone())).1)
        .expect("one of them looks like a record")
}

/// If a log cannot be read to its end, its later records are unknown. So none of it is in force until a motion or a
/// reset starts a new log.
#[test]
fn of_a_log_that_is_no_log_nothing_is_in_force() {
    let flash = Flash::blank();
    let mut store = start(&flash);
    keep_calibration(&mut store);
    store.set(Key::EndForceMa, 120).unwrap();
    store.set_name(name("c-1")).unwrap();
    keep_totals(&mut store, totals(1)).unwrap();
    let bytes = unreadable_after_what_is_there(&flash);
    type Change = fn(&mut Store) -> Result<(), StorageFailed>;
    let changes: [Change; 2] = [|store| keep_totals(store, totals(1)), Store::reset];
    for (change, totals) in changes.into_iter().zip([totals(1), Totals::default()]) {
        let flash = Flash::holding(bytes.clone());
        let (mut store, usable) = load(&flash);
        assert!(!usable);
        assert_eq!(store.values().get(Key::EndForceMa), 132);
        assert_eq!((store.name(), *store.records()), ("", Kept::default()));
        assert_eq!(store.set(Key::EndForceMa, 100), Err(StorageFailed));
        assert_eq!(store.set_name(name("c-2")), Err(StorageFailed));
        change(&mut store).unwrap();
        store.set(Key::EndForceMa, 100).unwrap();
        let later = start(&flash);
        assert_eq!(later.values().get(Key::EndForceMa), 100);
        assert_eq!(later.records().totals, totals);
    }
}

/// If the flash was a rig's before, its records are not taken for settings of a capsule.
#[test]
fn a_key_of_the_rig_is_no_setting() {
    let flash = Flash::blank();
    let mut rig = SettingsStore::load(flash.clone(), |_| true).0;
    rig.set(Key::StrokeUm, 100_000).unwrap();
    rig.set(Key::LeadUm, 5_000).unwrap();
    let store = start(&flash);
    assert_eq!(store.values().get(Key::StrokeUm), 130_000);
    assert_eq!(*store.records(), Kept::default());
}
