//! Motions of the capsule that begin near its folded end, and calibrations that were cut short, on the image.

use client::Unobserved;
use client::error::ClientError;

use crate::capsule::{CapsuleRun, referenced, referenced_with, start, start_with};
use crate::capsule_settings::{fold_to, set};
use protocol::{
    capsule::{
        ActuationOutcome, ActuationRecord, Calibrate, CapsuleState, CheckFolded, Fold,
        GetCapsuleTotals,
    },
    error::Refusal,
    settings::SettingKey,
    system::{Acknowledge, Urgent},
};
use virtual_bench::plants::capsule::{Defect, Parameters};

impl CapsuleRun {
    fn folded_um(&mut self) -> i32 {
        let totals = self.device.call(GetCapsuleTotals).expect("an answer");
        totals.calibration.expect("calibrated").folded_um
    }

    fn check(&mut self) -> ActuationRecord {
        let accepted = self.device.call(CheckFolded).expect("accepted");
        let ended = self.device.wait_actuation(&accepted, &mut Unobserved);
        ended.expect("it ends")
    }

    fn calibrate(&mut self) -> Result<ActuationRecord, Refusal> {
        match self.device.call(Calibrate) {
            Ok(accepted) => {
                let ended = self.device.wait_actuation(&accepted, &mut Unobserved);
                Ok(ended.expect("it ends"))
            }
            Err(ClientError::Refused { refusal, .. }) => Err(refusal),
            Err(other) => panic!("{other}"),
        }
    }
}

#[test]
fn more_friction_is_no_jam_where_a_fold_begins_near_the_end() {
    for (seed, less_um, times) in [(0, 501, 1.2), (2, 501, 1.4)] {
        let mut capsule = referenced_with(Parameters::lifelike(seed));
        let end_um = capsule.folded_um();
        capsule.look(move |capsule| capsule.suffer(Defect::Friction(times)));
        let there = fold_to(&mut capsule, end_um - less_um).expect("accepted");
        assert_eq!(there.outcome, ActuationOutcome::Complete, "{seed}");
        let folded = capsule.fold();
        assert_eq!(
            folded.outcome,
            ActuationOutcome::Complete,
            "{seed}\n{}",
            capsule.log()
        );
        assert_eq!(capsule.state(), (CapsuleState::Folded, None, true));
    }
}

/// The thread that it has wound is paid out; the next calibration would take it for part of the unfolded end.
#[test]
fn a_calibration_that_was_stopped_is_unfolded_before_the_next() {
    let mut capsule = start();
    capsule.device.call(Calibrate).expect("accepted");
    while capsule.look(|capsule| capsule.wound_mm()) < 4.0 {
        capsule.idle(10_000);
    }
    capsule.device.urgent(Urgent::Stop).expect("confirmed");
    capsule.rest();
    assert_eq!(capsule.state(), (CapsuleState::Unreferenced, None, false));
    let refused = capsule.calibrate().expect_err("thread is wound");
    assert!(matches!(refused, Refusal::OutOfRange { .. }), "{refused:?}");
    assert_eq!(capsule.unfold().outcome, ActuationOutcome::Complete);
    let wound_mm = capsule.look(|capsule| capsule.wound_mm());
    assert!((0.0..0.2).contains(&wound_mm), "{wound_mm} mm");
    let calibrated = capsule.calibrate().expect("accepted");
    assert_eq!(calibrated.outcome, ActuationOutcome::Complete);
    let end_um = capsule.folded_um();
    assert!(end_um.abs_diff(21_400) < 200, "{end_um} um");
}

/// An emergency stop keeps the count, and the calibration would take what is wound for part of the unfolded end.
#[test]
fn a_calibration_after_an_emergency_stop_is_refused_while_thread_is_wound() {
    let mut capsule = referenced();
    capsule.rest();
    capsule.device.call(Fold).expect("accepted");
    while capsule.look(|capsule| capsule.wound_mm()) < 4.0 {
        capsule.idle(10_000);
    }
    capsule.device.urgent(Urgent::EStop).expect("confirmed");
    capsule.rest();
    capsule.device.call(Acknowledge).expect("accepted");
    assert_eq!(capsule.state(), (CapsuleState::Stopped, None, true));
    let refused = capsule.calibrate().expect_err("thread is wound");
    assert!(matches!(refused, Refusal::OutOfRange { .. }), "{refused:?}");
    assert_eq!(capsule.unfold().outcome, ActuationOutcome::Complete);
    assert_eq!(capsule.state(), (CapsuleState::Unfolded, None, true));
}

/// The setting is about calibrations, not about the one in force.
#[test]
fn a_reference_run_finds_an_end_beyond_the_longest_fold() {
    let mut capsule = referenced();
    capsule.rest();
    assert!(capsule.folded_um() > 21_000);
    set(&mut capsule, SettingKey::LongestFoldUm, 20_000).expect("accepted");
    let accepted = capsule.device.reference().expect("accepted");
    let ended = capsule.device.wait_actuation(&accepted, &mut Unobserved);
    let record = ended.expect("it ends");
    assert_eq!(
        record.outcome,
        ActuationOutcome::Complete,
        "{}",
        capsule.log()
    );
}

/// An unfolding that is stopped at once has paid out a little; a fold from there takes its run-up.
#[test]
fn a_folded_thread_is_not_tightened_again_and_again() {
    let mut capsule = referenced();
    let end_mm = f64::from(capsule.folded_um()) * 1e-3;
    assert_eq!(capsule.fold().outcome, ActuationOutcome::Complete);
    for time in 0..2 {
        capsule.rest();
        capsule.device.unfold().expect("accepted");
        capsule.idle(80_000);
        capsule.device.urgent(Urgent::Stop).expect("confirmed");
        capsule.rest();
        capsule.device.forget_stop();
        let folded = capsule.fold();
        assert_eq!(
            folded.outcome,
            ActuationOutcome::Complete,
            "{time}\n{}",
            capsule.log()
        );
        let off_mm = capsule.look(|capsule| capsule.wound_mm()) - end_mm;
        assert!(off_mm.abs() < 0.3, "{time}: {off_mm} mm");
    }
}

/// With little force the motor is braked now and then, and has fewer readings.
#[test]
fn a_check_with_little_force_is_no_slip() {
    for seed in 0..2 {
        let mut capsule = start_with(Parameters::lifelike(seed));
        capsule.rest();
        set(&mut capsule, SettingKey::EndForceMa, 80).expect("accepted");
        let calibrated = capsule.calibrate().expect("accepted");
        assert_eq!(calibrated.outcome, ActuationOutcome::Complete, "{seed}");
        assert_eq!(capsule.fold().outcome, ActuationOutcome::Complete, "{seed}");
        for _ in 0..2 {
            let checked = capsule.check();
            assert_eq!(
                checked.outcome,
                ActuationOutcome::Complete,
                "{seed}\n{}",
                capsule.log()
            );
        }
    }
}
