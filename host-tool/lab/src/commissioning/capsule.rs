//! The commissioning steps of the capsule.

use client::Unobserved;
use client::decimal;
use protocol::capsule::{
    ActuationAccepted, ActuationOutcome, ActuationRecord, CapsuleFault, CapsuleState,
    CapsuleStatus, TracePoint,
};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{BuildProfile, Urgent};

use crate::commissioning::device;
use crate::commissioning::halt::Halt;
use crate::commissioning::operator::{Part, Reading};
use crate::commissioning::step::ProcedureStep;
use crate::commissioning::work::{POLL_US, Work};

const PLAIN: ProcedureStep = ProcedureStep {
    name: "",
    shows: "",
    observe: "",
    of_image: true,
    settings: &[],
    needs_operator: false,
    check: image,
};

pub const STEPS: &[ProcedureStep] = &[
    ProcedureStep {
        name: "image",
        shows: "the image is the optimised one; its last start did not fail",
        check: image,
        ..PLAIN
    },
    ProcedureStep {
        name: "clock",
        shows: "the capsule's clock goes as the host's, within its 1 %",
        check: clock,
        ..PLAIN
    },
    ProcedureStep {
        name: "battery",
        shows: "the battery voltage is the one that a meter shows, within 3 %",
        needs_operator: true,
        check: battery,
        ..PLAIN
    },
    ProcedureStep {
        name: "rest",
        shows: "no current is measured while the motor is off",
        check: rest,
        ..PLAIN
    },
    ProcedureStep {
        name: "held",
        shows: "with the motor held, the current measured is the one ordered, at three duties",
        observe: "the shaft must not turn",
        needs_operator: true,
        check: held,
        ..PLAIN
    },
    ProcedureStep {
        name: "reference",
        shows: "the thread's zero is found",
        observe: "begin unfolded: the crescents meet slowly, then the thread is paid out again",
        check: reference,
        ..PLAIN
    },
    ProcedureStep {
        name: "fold",
        shows: "the motor's current ends the fold at its calibrated end",
        observe: "the crescents meet",
        check: fold,
        ..PLAIN
    },
    ProcedureStep {
        name: "unfold",
        shows: "the thread is paid out to its zero",
        observe: "the origami springs back",
        check: unfold,
        ..PLAIN
    },
    ProcedureStep {
        name: "stop",
        shows: "a stop in a fold turns the motor off and keeps the thread",
        check: stop,
        ..PLAIN
    },
    ProcedureStep {
        name: "e-stop",
        shows: "an emergency stop by command is latched, and the motor is off",
        check: e_stop,
        ..PLAIN
    },
    ProcedureStep {
        name: "silence",
        shows: "a host that falls silent ends a motion, as a pulled cable does",
        check: silence,
        ..PLAIN
    },
];

/// Allowed deviation of the current from proportionality, at a third of the duty, percent. It covers offset, ripple and
/// resolution of the duty.
const HELD_PERCENT: u32 = 25;
/// Least ratio of the largest to the smallest duty, percent. With a shunt below the bridge, the measured resistance
/// follows the duty, so the duty has to vary enough to show it. The model's motor goes from 21 to 38 %.
const HELD_SPAN_PERCENT: u32 = 150;
/// Least current for a comparison, mA: a smaller one does not show proportionality.
const HELD_LEAST_MA: u16 = 15;
/// Allowed error of the capsule's clock, parts per million. The chip's internal oscillator is within 1 % at 25 C, less
/// accurate in the cold.
const CLOCK_PPM: i64 = 20_000;
/// Largest current reading while the motor is off, mA: the amplifier's offset.
const REST_MA: u16 = 10;
/// Least current of a turning motor, in either direction, mA.
const LEAST_DRIVE_MA: u16 = 10;
/// Allowed difference between the capsule's battery voltage and the meter's, percent.
const BATTERY_PERCENT: i64 = 3;
/// Silence of the host beyond the capsule's time-out, us.
const SILENT_LONGER_US: u64 = 500_000;
/// Longest delay until the capsule notices its time-out, ms: it checks at each reading.
const NOTICES_MS: u32 = 50;
/// Thread remaining after unfolding, um.
const UNFOLDED_UM: i32 = 300;
/// Thread on the spool when a fold is well in progress, um.
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
    work.unless_aborted()?;
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

/// Checks the shunt with a stalled motor. It has no back-EMF, so its current is the voltage divided by the loop's
/// resistance, at any duty, if the shunt measures the motor's current. A shunt below the bridge sees only the pulses:
/// the current times the duty.
fn held(work: &mut Work<'_>) -> Result<(), Halt> {
    clear(work)?;
    work.hand(Part::Rotor, true)?;
    let accepted = work.device.reference();
    let trace = accepted.and_then(|accepted| {
        work.device.wait_actuation(&accepted, &mut Unobserved)?;
        work.device.trace()
    });
    work.hand(Part::Rotor, false)?;
    clear(work)?;
    let trace = trace?;
    let thirds = thirds(&trace.points)?;
    for (name, third) in ["low", "middle", "high"].into_iter().zip(thirds) {
        work.note(&format!("{name}_duty_percent"), third.duty_percent);
        work.note(&format!("{name}_drive_mv"), third.drive_mv);
        work.note(&format!("{name}_current_ma"), third.current_ma);
    }
    work.note("loop_milliohm", thirds[2].milliohm());
    in_proportion(thirds)
}

/// Averages the readings of a stalled motor, for each third of the duty range.
fn thirds(points: &[TracePoint]) -> Result<[StalledReading; 3], Halt> {
    let readings = stalled_readings(points);
    let duties = || readings.iter().map(|point| point.duty_percent);
    let (Some(least), Some(most)) = (duties().min(), duties().max()) else {
        return Err(Halt::NotShown(
            "the motor was not seen standing under voltage: hold its shaft, and see that the bridge drives it"
                .to_owned(),
        ));
    };
    let of = |third| {
        let is_in = |point: &&StalledReading| {
            (point.duty_percent - least) * 3 / (most - least + 1) == third
        };
        mean(&readings.iter().filter(is_in).copied().collect::<Vec<_>>())
    };
    match (of(0), of(1), of(2)) {
        (Some(low), Some(middle), Some(high)) => Ok([low, middle, high]),
        _ => Err(too_narrow(least, most)),
    }
}

fn too_narrow(least: u32, most: u32) -> Halt {
    Halt::NotShown(format!("the duty went from {least} to {most} % only"))
}

/// Checks that voltage and current have the same ratio at all three duties.
fn in_proportion([low, middle, high]: [StalledReading; 3]) -> Result<(), Halt> {
    if high.duty_percent * 100 < HELD_SPAN_PERCENT * low.duty_percent {
        return Err(too_narrow(low.duty_percent, high.duty_percent));
    }
    for other in [low, middle] {
        let most = u64::from(high.milliohm().max(other.milliohm()));
        let least = u64::from(high.milliohm().min(other.milliohm()));
        if most * 100 > least * u64::from(100 + HELD_PERCENT) {
            return Err(Halt::Defect(format!(
                "held, the motor draws {} mA with {} mV and {} mA with {} mV: not in proportion. The shunt does not see what flows between the pulses: it has to be in series with the motor (docs/capsule.md)",
                other.current_ma, other.drive_mv, high.current_ma, high.drive_mv
            )));
        }
    }
    Ok(())
}

/// A reading of a stalled motor under voltage.
#[derive(Clone, Copy, Debug)]
struct StalledReading {
    duty_percent: u32,
    drive_mv: u32,
    current_ma: u32,
}

impl StalledReading {
    fn milliohm(self) -> u32 {
        self.drive_mv * 1_000 / self.current_ma.max(1)
    }
}

/// The readings of a stalled motor under voltage. A drive applies until the next reading. Only readings whose drive is
/// within 1/8 of the previous one count, so that the current has settled.
fn stalled_readings(points: &[TracePoint]) -> Vec<StalledReading> {
    let stands = |window: &&[TracePoint]| {
        let [before, now, after] = window else {
            return false;
        };
        let still = before.thread_um == now.thread_um && now.thread_um == after.thread_um;
        let near = before.drive_mv.abs_diff(now.drive_mv) <= before.drive_mv.unsigned_abs() / 8;
        still && near && now.drive_mv > 0 && now.battery_mv > 0 && after.current_ma >= HELD_LEAST_MA
    };
    let reading = |window: &[TracePoint]| StalledReading {
        duty_percent: u32::from(window[1].drive_mv.unsigned_abs()) * 100
            / u32::from(window[1].battery_mv),
        drive_mv: window[1].drive_mv.unsigned_abs().into(),
        current_ma: window[2].current_ma.into(),
    };
    points.windows(3).filter(stands).map(reading).collect()
}

fn mean(points: &[StalledReading]) -> Option<StalledReading> {
    let count = u32::try_from(points.len())
        .ok()
        .filter(|count| *count > 0)?;
    let of = |value: fn(&StalledReading) -> u32| points.iter().map(value).sum::<u32>() / count;
    Some(StalledReading {
        duty_percent: of(|point| point.duty_percent),
        drive_mv: of(|point| point.drive_mv),
        current_ma: of(|point| point.current_ma),
    })
}

/// Waits for an actuation that must end by itself, and keeps its numbers.
fn complete(work: &mut Work<'_>, accepted: &ActuationAccepted) -> Result<ActuationRecord, Halt> {
    let record = work.device.wait_actuation(accepted, &mut Unobserved)?;
    work.unless_aborted()?;
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

/// Pays the thread out to a known zero. Measurements made here are not part of a step's result.
fn unfolded(work: &mut Work<'_>) -> Result<(), Halt> {
    let kept = work.take_measured();
    let done = pay_out(work);
    work.measured = kept;
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
            "the thread is paid out to {} mm, not to its zero",
            decimal::write_signed(record.thread_um.into(), 3)
        )));
    }
    Ok(())
}

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
        work.pause(POLL_US)?;
    }
}

/// Checks that the motor is off and the thread at rest; returns how far it ran on.
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
    let key = SettingKey::LinkTimeoutMs;
    let timeout_ms = work.device.call(GetSetting { key })?.value;
    // Test it in a fold, which keeps the thread's position: the capsule ends unfolded.
    folding(work)?;
    let heard_ms = work.device.actuation_record()?.duration_ms;
    let silent_us = u64::from(timeout_ms) * 1_000 + SILENT_LONGER_US;
    work.device.fall_silent(silent_us)?;
    let record = work.device.actuation_record()?;
    stands(work)?;
    match ended_silent(&record, heard_ms, timeout_ms) {
        Err(defect @ Halt::Defect(_)) => Err(defect),
        shown => unfolded(work).and(shown),
    }
}

/// Checks how a fold ended if the host was last heard `heard_ms` after its start.
fn ended_silent(record: &ActuationRecord, heard_ms: u32, timeout_ms: u32) -> Result<(), Halt> {
    let silent_ms = record.duration_ms.saturating_sub(heard_ms);
    match record.outcome {
        ActuationOutcome::LinkLost => Ok(()),
        ActuationOutcome::Faulted(fault) => Err(Halt::Defect(fault.to_string())),
        ActuationOutcome::Complete if silent_ms <= timeout_ms.saturating_add(NOTICES_MS) => {
            Err(Halt::NotShown(format!(
                "the fold was over before link_timeout_ms, {timeout_ms} ms, had passed: set it to {} for this step",
                SettingKey::LinkTimeoutMs.range().default
            )))
        }
        other => Err(Halt::Defect(format!(
            "the motor did not stop when the host was silent: {other:?}"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::capsule::ActuationKind;

    /// Whoever keeps quiet for 1.6 s of a fold of 2 s shows nothing to a capsule that waits for longer.
    #[test]
    fn a_fold_that_was_over_before_the_time_out_shows_nothing() {
        let ended = |outcome, duration_ms, timeout_ms| {
            let record = ActuationRecord {
                actuation: 1,
                kind: ActuationKind::Fold,
                outcome,
                duration_ms,
                thread_um: 21_700,
                end_current_ma: 148,
                peak_current_ma: 148,
                engaged_um: 1_000,
                energy_mj: 200,
                min_battery_mv: 3_600,
            };
            ended_silent(&record, 400, timeout_ms)
        };
        let lost = ActuationOutcome::LinkLost;
        assert!(ended(lost, 1_402, 1_000).is_ok());
        let complete = ActuationOutcome::Complete;
        for timeout_ms in [1_600, 3_000, 60_000, u32::MAX] {
            match ended(complete, 2_000, timeout_ms) {
                Err(Halt::NotShown(why)) => assert!(why.contains("link_timeout_ms"), "{why}"),
                other => panic!("{timeout_ms} ms: {other:?}"),
            }
        }
        let running = ActuationOutcome::Running;
        for (outcome, timeout_ms) in [(complete, 1_000), (complete, 1_500), (running, 3_000)] {
            let judged = ended(outcome, 2_000, timeout_ms);
            assert!(matches!(judged, Err(Halt::Defect(_))), "{judged:?}");
        }
    }

    /// A held motor whose drive rises from 0.1 to 1.5 V within 300 ms, with the current that `sensed` makes of duty and
    /// mA.
    fn ramp(sensed: impl Fn(f64, f64) -> f64) -> Vec<TracePoint> {
        let drive = |n: i32| (100 + n * 1_400 / 300) / 40 * 40;
        let point = |n: i32| {
            let before = f64::from(drive((n - 1).max(0)));
            TracePoint {
                thread_um: 77,
                current_ma: sensed(before / 3_700.0, before / 6.0).round() as u16,
                battery_mv: 3_700,
                drive_mv: drive(n) as i16,
            }
        };
        (0..300).map(point).collect()
    }

    fn verdict(points: &[TracePoint]) -> Result<(), Halt> {
        thirds(points).and_then(in_proportion)
    }

    #[test]
    fn a_shunt_in_series_sees_the_current_at_any_duty() {
        assert!(verdict(&ramp(|_, ma| ma)).is_ok());
        // An amplifier that is 5 % off, and its offset.
        assert!(verdict(&ramp(|_, ma| ma * 1.05 + 2.0)).is_ok());
    }

    #[test]
    fn a_shunt_below_the_bridge_is_named() {
        // It sees the pulses: a share as large as the duty.
        match verdict(&ramp(|duty, ma| ma * duty * 3.0)) {
            Err(Halt::Defect(why)) => assert!(why.contains("in series with the motor"), "{why}"),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_shaft_that_turns_shows_nothing() {
        let mut points = ramp(|_, ma| ma);
        for (n, point) in (0..).zip(&mut points) {
            point.thread_um = n;
        }
        assert!(matches!(verdict(&points), Err(Halt::NotShown(_))));
        assert!(matches!(verdict(&[]), Err(Halt::NotShown(_))));
        let flat: Vec<_> = ramp(|_, ma| ma)[200..210].to_vec();
        assert!(matches!(verdict(&flat), Err(Halt::NotShown(why)) if why.contains("duty went")));
    }
}
