//! The capsule's settings on the image, and how soon a duty follows its reading.

use protocol::{
    capsule::{Calibrate, CheckFolded, Fold, GetCapsuleTotals, Unfold},
    error::Refusal,
    settings::{FactoryReset, GetName, GetSetting, Name, Setting, SettingKey},
};
use virtual_bench::{emulator::CutAt, plants::capsule::Defect};

use crate::capsule::{CapsuleRun, referenced};
use crate::common::{flash_operations, refusal};

fn get(capsule: &mut CapsuleRun, key: SettingKey) -> u32 {
    let got = capsule.device.call(GetSetting { key }).expect("it answers");
    assert_eq!(got.key, key);
    got.value
}

fn set(capsule: &mut CapsuleRun, key: SettingKey, value: u32) {
    let set = capsule.device.call(Setting { key, value });
    assert_eq!(set.expect("accepted"), Setting { key, value });
    assert_eq!(get(capsule, key), value);
}

/// An empty cell takes the chip's supply below the 2.7 V that writing the flash needs (docs/silicon.md, item 10).
#[test]
fn an_empty_cell_stores_nothing() {
    let mut capsule = referenced();
    capsule.rest();
    let key = SettingKey::EndForceMa;
    let before = get(&mut capsule, key);
    capsule.inject(Defect::Battery(2_600.0));
    capsule.idle(200_000);
    let stored = flash_operations(&capsule.bench);
    let refused = refusal(capsule.device.call(Setting { key, value: 110 }));
    assert_eq!(refused, Refusal::SupplyLow);
    assert_eq!(flash_operations(&capsule.bench), stored);
    assert_eq!(get(&mut capsule, key), before);
    capsule.inject(Defect::Battery(3_700.0));
    capsule.idle(200_000);
    set(&mut capsule, key, 110);
}

/// What is refused is a matter of the library (`firmware-capsule/tests/control.rs`).
#[test]
fn settings_count_at_once_and_after_the_next_start() {
    let mut capsule = referenced();
    let usual = capsule.completes(Fold);
    capsule.completes(Unfold);
    capsule.rest();
    let (end, speed) = (SettingKey::EndForceMa, SettingKey::FoldUmS);
    let changes = [(end, 80), (speed, 5_500)];
    for (key, value) in changes {
        set(&mut capsule, key, value);
    }
    let name = "c-1".try_into().expect("short");
    capsule.device.call(Name { name }).expect("a name");
    // The calibration belongs to the old end force.
    capsule.completes(Calibrate);
    let slower = capsule.completes(Fold);
    let what = format!("{slower:?} {usual:?}");
    assert!(slower.end_current_ma + 15 < usual.end_current_ma, "{what}");
    assert!(slower.duration_ms > usual.duration_ms + 400, "{what}");
    // With little force the motor is braked now and then, and has fewer readings: that is no slip.
    capsule.completes(CheckFolded);
    capsule.completes(Unfold);
    capsule.rest();

    let kept = capsule.device.call(GetCapsuleTotals).expect("an answer");
    let observe = |capsule: &mut CapsuleRun| {
        let name = capsule.device.call(GetName).expect("it answers").name;
        let values = changes.map(|(key, _)| (key, get(capsule, key)));
        (values, name.as_str().to_owned())
    };
    capsule.power_cycle(2);
    assert_eq!(observe(&mut capsule), (changes, "c-1".to_owned()));
    capsule.rest();
    capsule.device.call(FactoryReset).expect("a reset");
    capsule.power_cycle(3);
    let defaults = changes.map(|(key, _)| (key, key.range().default));
    assert_eq!(observe(&mut capsule), (defaults, String::new()));
    let later = capsule.device.call(GetCapsuleTotals).expect("an answer");
    assert_eq!(later, kept, "calibration and totals stay");
    capsule.check_clean();
}

/// A host test tries every operation (`firmware-capsule/tests/known.rs`).
#[test]
fn a_cut_within_a_change_leaves_the_old_setting_or_the_new_one() {
    let mut capsule = referenced();
    capsule.rest();
    let key = SettingKey::EndForceMa;
    let mut before = get(&mut capsule, key);
    for (nonce, at) in (2..).zip([CutAt::Before, CutAt::Within, CutAt::After]) {
        let wanted = before - 1;
        let planned = capsule.bench.visit(move |visit| {
            let done = visit.flash_operations();
            visit.cut_flash(at, done);
        });
        planned.expect("the bench runs");
        // Ignore the answer: after the cut nothing reaches the flash.
        let _ = capsule.device.call(Setting { key, value: wanted });
        let cut = capsule.bench.visit(|visit| visit.flash_is_cut());
        assert!(cut.expect("the bench runs"), "{at:?}: never reached");
        capsule.power_cycle(nonce);
        let after = get(&mut capsule, key);
        assert!([before, wanted].contains(&after), "{at:?}: {after}");
        let totals = capsule.device.call(GetCapsuleTotals).expect("an answer");
        assert!(totals.calibration.is_some(), "{at:?}");
        before = after;
        capsule.rest();
    }
}

/// The library is tested with this latency (`simulated-machines/src/plant.rs`). With more, a jam near the end pulls
/// harder.
#[test]
fn a_duty_follows_its_reading_as_soon_as_the_library_is_tried_with() {
    let mut capsule = referenced();
    capsule.begin(Fold);
    capsule.idle(400_000);
    // TIM3's compare register of the second input: it sets the pauses while the motor winds.
    let observe = |capsule: &CapsuleRun| {
        let seen = capsule
            .bench
            .visit(|visit| (visit.instructions(), visit.register(0x4000_0438)));
        seen.expect("the bench runs")
    };
    let (mut before, mut duty) = observe(&capsule);
    let (mut awake_us, mut took_us) = (0, vec![]);
    for _ in 0..10_000 {
        capsule.bench.advance_us(20).expect("the bench runs");
        let (now, ordered) = observe(&capsule);
        awake_us = if now > before { awake_us + 20 } else { 0 };
        if ordered != duty && awake_us > 0 {
            took_us.push(awake_us);
        }
        (before, duty) = (now, ordered);
    }
    let mean_us = took_us.iter().sum::<u64>() / took_us.len() as u64;
    assert!((300..600).contains(&mean_us), "{took_us:?}");
    // The processor may have been awake for another reason just before a reading.
    assert!(took_us.iter().all(|us| *us < 800), "{took_us:?}");
}
