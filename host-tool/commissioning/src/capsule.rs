//! The capsule's steps.

use client::Unobserved;
use client::decimal;
use protocol::capsule::{
    ActuationAccepted, ActuationOutcome, ActuationRecord, CapsuleFault, CapsuleState, CapsuleStatus,
};
use protocol::system::{BuildProfile, Urgent};

use crate::device;
use crate::halt::Halt;
use crate::hands::Reading;
use crate::step::Step;
use crate::work::{LOOK_US, Work};

const PLAIN: Step = Step {
    name: "",
    shows: "",
    look: "",
    of_image: true,
    settings: &[],
    needs_hands: false,
    check: image,
};

/// The steps in their order.
pub const STEPS: &[Step] = &[
    Step {
        name: "image",
        shows: "the image is the optimised one; its last start was no failure",
        check: image,
        ..PLAIN
    },
    Step {
        name: "clock",
        shows: "the capsule's clock goes as the host's, within its 1 %",
        check: clock,
        ..PLAIN
    },
    Step {
        name: "battery",
        shows: "the battery voltage is the one that a meter shows, within 3 %",
        needs_hands: true,
        check: battery,
        ..PLAIN
    },
    Step {
        name: "rest",
        shows: "no current is measured while the motor is off",
        check: rest,
        ..PLAIN
    },
    Step {
        name: "reference",
        shows: "the thread's zero is found",
        look: "begin unfolded: the crescents meet slowly, then the thread is paid out again",
        check: reference,
        ..PLAIN
    },
    Step {
        name: "fold",
        shows: "the motor's current ends the fold at its calibrated end",
        look: "the crescents meet",
        check: fold,
        ..PLAIN
    },
    Step {
        name: "unfold",
        shows: "the thread is paid out to its zero",
        look: "the origami springs back",
        check: unfold,
        ..PLAIN
    },
    Step {
        name: "stop",
        shows: "a stop in a fold turns the motor off and keeps the thread",
        check: stop,
        ..PLAIN
    },
    Step {
        name: "e-stop",
        shows: "an emergency stop by command is latched, and the motor is off",
        check: e_stop,
        ..PLAIN
    },
    Step {
        name: "silence",
        shows: "a host that falls silent ends a motion, as a pulled cable does",
        check: silence,
        ..PLAIN
    },
];

/// The capsule's clock is the chip's own: 1 % at 25 C, more in the cold, parts per million.
const CLOCK_PPM: i64 = 20_000;
/// Most current that may be measured while the motor is off, mA: the amplifier's offset.
const REST_MA: u16 = 10;
/// A motor that turns draws more, in either direction, mA.
const LEAST_DRIVE_MA: u16 = 10;
/// Allowed difference between the capsule's battery voltage and the meter's, parts per hundred.
const BATTERY_PERCENT: i64 = 3;
/// Longer than the capsule waits for its host, us, and shorter than the motion.
const SILENCE_US: u64 = 1_500_000;
/// Thread left at the end of unfolding, um.
const UNFOLDED_UM: i32 = 300;
/// Thread on the spool when a fold is well under way, um.
const UNDER_WAY_UM: i32 = 3_000;

fn image(work: &mut Work<'_>) -> Result<(), Halt> {
    let identity = device::started_well(work)?;
    if identity.profile == BuildProfile::Debug {
        return Err(Halt::Defect(
            "the image was built without optimisation: `cargo capsule` flashes the optimised one"
                .to_owned(),
        ));
    }
    Ok(())
}

fn clock(work: &mut Work<'_>) -> Result<(), Halt> {
    device::compare_clocks(work, CLOCK_PPM, |work| Ok(status(work)?.time_us))
}

fn status(work: &mut Work<'_>) -> Result<CapsuleStatus, Halt> {
    let status = work.device.capsule_status()?;
    work.unless_left()?;
    Ok(status)
}

fn clear(work: &mut Work<'_>) -> Result<(), Halt> {
    let status = status(work)?;
    if status.fault.is_some() || status.needs_acknowledge {
        work.device.acknowledge()?;
    }
    Ok(())
}

fn battery(work: &mut Work<'_>) -> Result<(), Halt> {
    let meter = work.read(Reading::Battery)?;
    let capsule = i64::from(status(work)?.battery_mv);
    work.note("meter_mv", meter);
    work.note("capsule_mv", capsule);
    if (capsule - meter).abs() * 100 > meter.abs() * BATTERY_PERCENT {
        return Err(Halt::Defect(format!(
            "the capsule measures {} V, the meter {} V: the divider, or the reference of its converter",
            decimal::write_signed(capsule, 3),
            decimal::write_signed(meter, 3)
        )));
    }
    Ok(())
}

fn rest(work: &mut Work<'_>) -> Result<(), Halt> {
    clear(work)?;
    let mut worst = 0;
    for _ in 0..5 {
        worst = worst.max(status(work)?.current_ma);
        work.pause(200_000)?;
    }
    work.note("current_ma", worst);
    if worst > REST_MA {
        return Err(Halt::Defect(format!(
            "{worst} mA are measured with the motor off: the amplifier's offset, or a current that flows"
        )));
    }
    Ok(())
}

/// Waits for an actuation that has to end by itself; its numbers are kept.
fn complete(work: &mut Work<'_>, accepted: &ActuationAccepted) -> Result<ActuationRecord, Halt> {
    let record = work.device.wait_actuation(accepted, &mut Unobserved)?;
    work.unless_left()?;
    work.note("duration_ms", record.duration_ms);
    work.note("thread_um", record.thread_um);
    work.note("end_current_ma", record.end_current_ma);
    work.note("peak_current_ma", record.peak_current_ma);
    work.note("min_battery_mv", record.min_battery_mv);
    match record.outcome {
        ActuationOutcome::Complete => Ok(record),
        ActuationOutcome::Faulted(fault) => Err(Halt::Defect(fault.to_string())),
        other => Err(Halt::Defect(format!("it did not end by itself: {other:?}"))),
    }
}

fn reference(work: &mut Work<'_>) -> Result<(), Halt> {
    clear(work)?;
    let accepted = work.device.reference()?;
    complete(work, &accepted).map(|_| ())
}

/// The thread paid out to a zero that is known. What that measures is no result of a step.
fn unfolded(work: &mut Work<'_>) -> Result<(), Halt> {
    let kept = work.take_measured();
    let done = pay_out(work);
    work.set_measured(kept);
    done
}

fn pay_out(work: &mut Work<'_>) -> Result<(), Halt> {
    clear(work)?;
    let status = status(work)?;
    if !status.referenced {
        let accepted = work.device.reference()?;
        complete(work, &accepted)?;
    } else if status.state != CapsuleState::Unfolded {
        let accepted = work.device.unfold()?;
        complete(work, &accepted)?;
    }
    Ok(())
}

fn fold(work: &mut Work<'_>) -> Result<(), Halt> {
    unfolded(work)?;
    let accepted = work.device.fold()?;
    complete(work, &accepted).map(|_| ())
}

fn unfold(work: &mut Work<'_>) -> Result<(), Halt> {
    clear(work)?;
    let now = status(work)?;
    if !now.referenced || now.state == CapsuleState::Unfolded {
        unfolded(work)?;
        let accepted = work.device.fold()?;
        complete(work, &accepted)?;
        work.take_measured();
    }
    let accepted = work.device.unfold()?;
    let record = complete(work, &accepted)?;
    if record.peak_current_ma < LEAST_DRIVE_MA {
        return Err(Halt::Defect(format!(
            "{} mA at most while the thread was paid out: the current amplifier is blind in this direction",
            record.peak_current_ma
        )));
    }
    if record.thread_um.abs() > UNFOLDED_UM {
        return Err(Halt::Defect(format!(
            "the thread is paid out to {} um, not to its zero",
            record.thread_um
        )));
    }
    Ok(())
}

/// A fold that is under way.
fn folding(work: &mut Work<'_>) -> Result<(), Halt> {
    unfolded(work)?;
    work.device.fold()?;
    let begin_us = work.device.now_us();
    loop {
        let status = status(work)?;
        if status.state != CapsuleState::Folding {
            return Err(Halt::Defect(format!(
                "the fold ended early: {:?}",
                status.state
            )));
        }
        if status.thread_um > UNDER_WAY_UM {
            return Ok(());
        }
        if work.device.now_us() - begin_us > 10_000_000 {
            return Err(Halt::Defect("the thread does not move".to_owned()));
        }
        work.pause(LOOK_US)?;
    }
}

/// The motor is off and the thread stands; returns how far it ran on.
fn stands(work: &mut Work<'_>) -> Result<CapsuleStatus, Halt> {
    work.pause(500_000)?;
    let first = status(work)?;
    work.pause(500_000)?;
    let later = status(work)?;
    work.note("thread_um", later.thread_um);
    work.note("current_ma", later.current_ma);
    if later.thread_um != first.thread_um || later.current_ma > REST_MA {
        return Err(Halt::Defect(
            "the thread still moves, or the motor still draws current".to_owned(),
        ));
    }
    Ok(later)
}

fn stop(work: &mut Work<'_>) -> Result<(), Halt> {
    folding(work)?;
    work.device.urgent(Urgent::Stop)?;
    let status = stands(work)?;
    if status.state != CapsuleState::Stopped {
        return Err(Halt::Defect(format!(
            "after a stop the capsule is {:?}",
            status.state
        )));
    }
    unfolded(work)
}

fn e_stop(work: &mut Work<'_>) -> Result<(), Halt> {
    folding(work)?;
    work.device.urgent(Urgent::EStop)?;
    let status = stands(work)?;
    if status.fault != Some(CapsuleFault::EStopFrame) {
        return Err(Halt::Defect(format!(
            "an emergency stop was not latched: {:?}",
            status.fault
        )));
    }
    clear(work)
}

fn silence(work: &mut Work<'_>) -> Result<(), Halt> {
    // Folding is over before the silence counts; a reference run from the folded end takes longer.
    unfolded(work)?;
    let accepted = work.device.fold()?;
    complete(work, &accepted)?;
    work.take_measured();
    work.device.reference()?;
    work.device.fall_silent(SILENCE_US)?;
    let outcome = work.device.actuation_record()?.outcome;
    stands(work)?;
    match outcome {
        ActuationOutcome::LinkLost => Ok(()),
        ActuationOutcome::Faulted(fault) => Err(Halt::Defect(fault.to_string())),
        other => Err(Halt::Defect(format!(
            "the motor did not stop when the host was silent: {other:?}"
        ))),
    }
}
