//! The capsule's settings, partial folds, and threads that slip, on the image.

use client::Unobserved;
use client::error::ClientError;

use crate::capsule::{CapsuleRun, referenced};
use protocol::{
    capsule::{
        ActuationOutcome, ActuationRecord, CapsuleFault, CapsuleState, FoldTo, GetCapsuleTotals,
    },
    error::{Field, Refusal},
    settings::{FactoryReset, GetName, GetSetting, Name, Setting, SettingKey, SettingRule},
};
use virtual_bench::{emulator::CutAt, plants::capsule::Defect};

fn get(capsule: &mut CapsuleRun, key: SettingKey) -> u32 {
    let got = capsule.device.call(GetSetting { key }).expect("it answers");
    assert_eq!(got.key, key);
    got.value
}

pub(crate) fn set(
    capsule: &mut CapsuleRun,
    key: SettingKey,
    value: u32,
) -> Result<Setting, Refusal> {
    match capsule.device.call(Setting { key, value }) {
        Ok(setting) => Ok(setting),
        Err(ClientError::Refused { refusal, .. }) => Err(refusal),
        Err(other) => panic!("{other}"),
    }
}

fn name(capsule: &mut CapsuleRun) -> String {
    let got = capsule.device.call(GetName).expect("it answers");
    got.name.as_str().to_owned()
}

pub(crate) fn fold_to(
    capsule: &mut CapsuleRun,
    thread_um: i32,
) -> Result<ActuationRecord, Refusal> {
    match capsule.device.call(FoldTo { thread_um }) {
        Ok(accepted) => Ok(capsule
            .device
            .wait_actuation(&accepted, &mut Unobserved)
            .expect("it ends")),
        Err(ClientError::Refused { refusal, .. }) => Err(refusal),
        Err(other) => panic!("{other}"),
    }
}

/// An empty cell takes the chip's supply below the 2.7 V that writing the flash needs (docs/silicon.md, item 10).
#[test]
fn an_empty_cell_stores_nothing() {
    let mut capsule = referenced();
    capsule.rest();
    let key = SettingKey::EndForceMa;
    let before = get(&mut capsule, key);
    let operations = |capsule: &CapsuleRun| {
        let counted = capsule.bench.visit(|visit| visit.flash_operations());
        counted.expect("the bench runs")
    };
    capsule.look(|capsule| capsule.suffer(Defect::Battery(2_600.0)));
    capsule.idle(200_000);
    let stored = operations(&capsule);
    assert_eq!(set(&mut capsule, key, 110), Err(Refusal::SupplyLow));
    assert_eq!(operations(&capsule), stored);
    assert_eq!(get(&mut capsule, key), before);
    capsule.look(|capsule| capsule.suffer(Defect::Battery(3_700.0)));
    capsule.idle(200_000);
    assert_eq!(set(&mut capsule, key, 110), Ok(Setting { key, value: 110 }));
}

#[test]
fn settings_count_at_once_and_after_the_next_start() {
    let mut capsule = referenced();
    capsule.rest();
    let usual = capsule.fold();
    assert_eq!(capsule.unfold().outcome, ActuationOutcome::Complete);
    capsule.rest();
    let (end, speed) = (SettingKey::EndForceMa, SettingKey::FoldUmS);
    for (key, value) in [(end, 110), (speed, 5_500)] {
        assert_eq!(set(&mut capsule, key, value), Ok(Setting { key, value }));
        assert_eq!(get(&mut capsule, key), value);
    }
    let range = Refusal::SettingRange {
        key: end,
        requested: 161,
    };
    assert_eq!(set(&mut capsule, end, 161), Err(range));
    let key = SettingKey::LoadedBatteryMv;
    let rule = Refusal::SettingRule {
        key,
        rule: SettingRule::LoadedBelowRest,
    };
    assert_eq!(set(&mut capsule, key, 2_900), Err(rule));
    let rigs = set(&mut capsule, SettingKey::StrokeUm, 1_000);
    assert_eq!(rigs, Err(Refusal::WrongDevice));
    let called = Name {
        name: "c-1".try_into().expect("short"),
    };
    capsule.device.call(called).expect("a name");

    // The calibration belongs to the old end force.
    let accepted = capsule.device.reference().expect("it is accepted");
    capsule
        .device
        .wait_actuation(&accepted, &mut Unobserved)
        .expect("it ends");
    let calibrated = capsule
        .device
        .call(protocol::capsule::Calibrate)
        .expect("it is accepted");
    capsule
        .device
        .wait_actuation(&calibrated, &mut Unobserved)
        .expect("it ends");
    capsule.rest();
    let accepted = capsule.device.fold().expect("it is accepted");
    capsule.idle(300_000);
    let moving = set(&mut capsule, end, 130);
    assert_eq!(moving, Err(Refusal::CapsuleBusy(CapsuleState::Folding)));
    let slower = capsule
        .device
        .wait_actuation(&accepted, &mut Unobserved)
        .expect("it ends");
    assert_eq!(
        slower.outcome,
        ActuationOutcome::Complete,
        "{}",
        capsule.log()
    );
    assert!(
        slower.end_current_ma + 15 < usual.end_current_ma,
        "{slower:?} {usual:?}"
    );
    assert!(
        slower.duration_ms > usual.duration_ms + 400,
        "{slower:?} {usual:?}"
    );
    assert_eq!(capsule.unfold().outcome, ActuationOutcome::Complete);
    capsule.rest();

    let kept = capsule.device.call(GetCapsuleTotals).expect("an answer");
    capsule.power_cycle(2);
    assert_eq!(
        (get(&mut capsule, end), get(&mut capsule, speed)),
        (110, 5_500)
    );
    assert_eq!(name(&mut capsule), "c-1");
    capsule.rest();
    capsule.device.call(FactoryReset).expect("a reset");
    assert_eq!(
        (get(&mut capsule, end), get(&mut capsule, speed)),
        (132, 7_000)
    );
    capsule.power_cycle(3);
    assert_eq!(
        (get(&mut capsule, end), name(&mut capsule)),
        (132, String::new())
    );
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
    let mut before = 132;
    for (nonce, at) in (2..).zip([CutAt::Before, CutAt::Within, CutAt::After]) {
        let wanted = before - 1;
        capsule
            .bench
            .visit(move |visit| {
                let done = visit.flash_operations();
                visit.cut_flash(at, done);
            })
            .expect("the bench runs");
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

#[test]
fn a_partial_fold_stops_where_it_was_told() {
    let mut capsule = referenced();
    for thread_um in [5_000, 14_000, 3_000] {
        let record = fold_to(&mut capsule, thread_um).expect("it is accepted");
        assert_eq!(
            record.outcome,
            ActuationOutcome::Complete,
            "{}",
            capsule.log()
        );
        assert_eq!(capsule.state(), (CapsuleState::Stopped, None, true));
        capsule.rest();
        let wound_mm = capsule.look(|capsule| capsule.wound_mm());
        let short_mm = wound_mm - f64::from(thread_um) * 1e-3;
        assert!(short_mm.abs() < 0.1, "{short_mm:.3} mm off {thread_um} um");
    }
    let end_um = capsule
        .device
        .call(GetCapsuleTotals)
        .expect("an answer")
        .calibration
        .expect("one")
        .folded_um;
    for (thread_um, requested) in [(-5, 0), (499, 499), (end_um, end_um as u64)] {
        let refused = fold_to(&mut capsule, thread_um).expect_err("at an end");
        let Refusal::OutOfRange {
            field: Field::ThreadUm,
            requested: told,
            min: 500,
            ..
        } = refused
        else {
            panic!("{thread_um}: {refused:?}");
        };
        assert_eq!(told, requested);
    }
    let there = fold_to(&mut capsule, 3_050).expect_err("it is there");
    assert_eq!(there, Refusal::AlreadyThere);
    assert_eq!(capsule.fold().outcome, ActuationOutcome::Complete);
    // The thread pulls there.
    for thread_um in [end_um - 600, end_um - 1_500] {
        let record = fold_to(&mut capsule, thread_um).expect("it is accepted");
        assert_eq!(record.outcome, ActuationOutcome::Complete, "{thread_um}");
        capsule.rest();
    }
    assert_eq!(capsule.unfold().outcome, ActuationOutcome::Complete);
    let (least_mm, _) = capsule.look(|capsule| capsule.extremes_mm());
    assert!(least_mm >= 0.0, "{least_mm} mm");
    capsule.check_clean();
}

/// A thread that slips a little in each cycle looks like falling friction or creep, until it pulls too little.
#[test]
fn a_thread_that_slips_little_by_little_is_named_in_the_end() {
    let mut capsule = referenced();
    let mut cycles = 0;
    let named = loop {
        cycles += 1;
        assert!(cycles < 9, "not noticed\n{}", capsule.log());
        // A fold that pulls too little is felt and named; else the unfolding behind it finds the thread slack.
        let motions = [CapsuleRun::fold, CapsuleRun::unfold];
        let named = motions.into_iter().find_map(|motion| {
            let outcome = motion(&mut capsule).outcome;
            (outcome != ActuationOutcome::Complete).then_some(outcome)
        });
        if let Some(named) = named {
            break named;
        }
        capsule.look(|capsule| capsule.plant_mut().suffer(Defect::Slip(0.25)));
    };
    assert_eq!(named, ActuationOutcome::Faulted(CapsuleFault::SlipOrBreak));
    assert!(cycles > 2, "of {cycles} cycles");
    let (least_mm, _) = capsule.look(|capsule| capsule.extremes_mm());
    assert!(least_mm >= 0.0, "{least_mm} mm");
    capsule.check_clean();
}

/// The library is tested with this latency (`simulated-machines/src/plant.rs`). With more, a jam near the end pulls
/// harder.
#[test]
fn a_duty_follows_its_reading_as_soon_as_the_library_is_tried_with() {
    let mut capsule = referenced();
    capsule.device.fold().expect("it is accepted");
    capsule.idle(400_000);
    // TIM3's compare register of the second input: it sets the pauses while the motor winds.
    let look = |capsule: &CapsuleRun| {
        let seen = capsule
            .bench
            .visit(|visit| (visit.instructions(), visit.register(0x4000_0438)));
        seen.expect("the bench runs")
    };
    let (mut before, mut duty) = look(&capsule);
    let (mut awake_us, mut took_us) = (0, vec![]);
    for _ in 0..10_000 {
        capsule.bench.advance_us(20).expect("the bench runs");
        let (now, ordered) = look(&capsule);
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
