//! Homing and travel: pulses without motor power, direction, scale, repetition, the whole stroke.

use client::decimal;
use protocol::rig::RigFault;
use protocol::settings::SettingKey as Key;
use serde_json::json;

use super::depends::SCREW;
use crate::commissioning::halt::{Halt, fault_text, homing_text};
use crate::commissioning::operator::Reading;
use crate::commissioning::work::Work;
use crate::commissioning::work::rig::HomeEnd;

/// Longest travel measured by hand, um.
const TRAVEL_UM: u32 = 40_000;
/// Largest difference between two homings, steps.
const REPEAT_STEPS: i32 = 2;

pub(super) fn pulses(work: &mut Work<'_>) -> Result<(), Halt> {
    work.to_the_middle()?;
    work.clear()?;
    let end = work.home()?;
    let status = work.status()?;
    work.note("position_steps", status.position_steps);
    match end {
        HomeEnd::Fault(RigFault::FlagNotFound(_), false) => work.clear(),
        HomeEnd::Homed(_) | HomeEnd::Fault(_, true) => Err(Halt::Defect(
            "the carriage moved: the motor supply is on, or somebody touched a switch".to_owned(),
        )),
        HomeEnd::Fault(fault, false) => Err(Halt::Defect(fault_text(fault))),
    }
}

pub(super) fn home(work: &mut Work<'_>) -> Result<(), Halt> {
    work.to_the_middle()?;
    work.clear()?;
    work.supply(true)?;
    match work.home()? {
        HomeEnd::Homed(homed) => {
            work.note("duration_us", homed.duration_us);
            work.note("repeat_steps", homed.repeat_steps);
            Ok(())
        }
        HomeEnd::Fault(fault, far) => Err(Halt::Defect(homing_text(fault, far))),
    }
}

pub(super) fn travel(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    let wanted = TRAVEL_UM.min(work.setting(Key::StrokeUm) / 3);
    let before = work.read(Reading::Carriage)?;
    let status = work.try_to_go_to(wanted)?;
    if let Some(fault @ (RigFault::FarLimit | RigFault::EStopLoop)) = status.fault {
        return Err(Halt::Defect(format!(
            "wrong microsteps: the carriage was at the end of its travel when the steps said {} mm; it goes much farther than the settings say ({fault})",
            decimal::write_signed(status.position_um.into(), 3)
        )));
    }
    if let Some(fault) = status.fault {
        return Err(Halt::Defect(fault_text(fault)));
    }
    let measured = (work.read(Reading::Carriage)? - before).abs();
    let commanded = i64::from(status.position_um);
    work.note("commanded_um", commanded);
    work.note("measured_um", measured);
    let settings = SCREW.map(|key| work.setting(key));
    if let Some(defect) = wrong_travel(commanded, measured, settings) {
        return Err(Halt::Defect(defect));
    }
    work.go_to(0).map(|_| ())
}

/// Diagnosis of screw and driver from a measured travel, with the settings lead, full steps and microsteps. None if the
/// travel is within 1.5 % of the commanded one, which is more than a caliper's error.
pub fn wrong_travel(
    commanded_um: i64,
    measured_um: i64,
    [lead_um, full_steps, microsteps]: [u32; 3],
) -> Option<String> {
    let near = |ratio: f64, expected: f64| (ratio / expected - 1.0).abs() <= 0.015;
    let ratio = measured_um as f64 / commanded_um.max(1) as f64;
    if near(ratio, 1.0) {
        return None;
    }
    let (moved, sent) = (
        decimal::write_signed(measured_um, 3),
        decimal::write_signed(commanded_um, 3),
    );
    if ratio < 0.01 {
        return Some(format!(
            "the carriage did not move ({moved} mm of {sent}): supply, driver current, coupling"
        ));
    }
    let lead = (f64::from(lead_um) * ratio / 10.0).round() * 10.0;
    let power = ratio.log2().round();
    if !near(ratio, power.exp2()) {
        return Some(format!(
            "wrong lead: {moved} mm instead of {sent}, so the screw has a lead of about {lead} um, and lead_um is {lead_um}"
        ));
    }
    let strapped = f64::from(microsteps) / power.exp2();
    let motor = match power as i32 {
        1 if full_steps == 400 => ", or the motor has 200 steps per turn",
        -1 if full_steps == 200 => ", or the motor has 400 steps per turn",
        _ => "",
    };
    Some(format!(
        "wrong microsteps: {moved} mm instead of {sent}. The driver is strapped for {strapped}, and microsteps is {microsteps}; or the screw has a lead of {lead} um{motor}"
    ))
}

pub(super) fn repeat(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    let mut all = vec![];
    for _ in 0..3 {
        match work.home()? {
            HomeEnd::Homed(homed) => all.push((homed.repeat_steps, homed.shift_steps)),
            HomeEnd::Fault(fault, far) => return Err(Halt::Defect(homing_text(fault, far))),
        }
    }
    let of = |pick: fn(&(i32, i32)) -> i32| all.iter().map(pick).collect::<Vec<_>>();
    work.note("repeat_steps", json!(of(|homed| homed.0)));
    work.note("shift_steps", json!(of(|homed| homed.1)));
    let worst = all.iter().flat_map(|(a, b)| [a.abs(), b.abs()]).max();
    if worst.is_some_and(|worst| worst > REPEAT_STEPS) {
        return Err(Halt::Defect(format!(
            "homing does not repeat: passes and references differ by {all:?} steps. The flag or the screw is loose"
        )));
    }
    Ok(())
}

pub(super) fn stroke(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    let status = work.try_to_go_to(work.setting(Key::StrokeUm))?;
    work.note("reached_um", status.position_um);
    let place = decimal::write_signed(status.position_um.into(), 3);
    match status.fault {
        Some(RigFault::FarLimit) => {
            return Err(Halt::Defect(format!(
                "the far limit opened at {place} mm: it lies within the stroke"
            )));
        }
        Some(RigFault::EStopLoop) => {
            return Err(Halt::Defect(format!(
                "the E-stop loop opened at {place} mm: an end-of-travel switch lies within the stroke"
            )));
        }
        Some(fault) => return Err(Halt::Defect(fault_text(fault))),
        None if status.inputs.far_limit => {
            return Err(Halt::Defect(
                "the far limit is open at the end of the stroke: it has to lie beyond it"
                    .to_owned(),
            ));
        }
        None => {}
    }
    work.go_to(0).map(|_| ())
}
