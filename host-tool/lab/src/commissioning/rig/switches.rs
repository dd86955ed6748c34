//! Switches and E-stop loop, actuated by hand while the motor has no supply.

use protocol::rig::{GetRigHealth, RigFault, RigInputs};

use crate::commissioning::halt::{Halt, fault_text};
use crate::commissioning::operator::Part;
use crate::commissioning::work::Work;

/// Time for which the lines are observed, us.
const QUIET_US: u64 = 3_000_000;

pub(super) fn quiet(work: &mut Work<'_>) -> Result<(), Halt> {
    work.clear()?;
    let before = work.device.call(GetRigHealth)?;
    let status = work.until(QUIET_US, |status| status.fault.is_some())?;
    let after = work.device.call(GetRigHealth)?;
    let home = after.home_flag.count.wrapping_sub(before.home_flag.count);
    let far = after.far_limit.count.wrapping_sub(before.far_limit.count);
    work.note("watched_us", QUIET_US);
    work.note("home_flag_false_pulses", home);
    work.note("far_limit_false_pulses", far);
    if let Some(fault) = status.fault {
        return Err(Halt::Defect(fault_text(fault)));
    }
    for (name, count) in [("home flag", home), ("far limit", far)] {
        if count > 0 {
            return Err(Halt::Defect(format!(
                "the line of the {name} is noisy: {count} false pulses in 3 s at rest"
            )));
        }
    }
    Ok(())
}

pub(super) fn e_stop(work: &mut Work<'_>) -> Result<(), Halt> {
    opens_the_loop(work, Part::EStop, "the E-stop button")
}

pub(super) fn home_end(work: &mut Work<'_>) -> Result<(), Halt> {
    opens_the_loop(work, Part::HomeEnd, "the end-of-travel switch beyond home")
}

pub(super) fn far_end(work: &mut Work<'_>) -> Result<(), Halt> {
    opens_the_loop(
        work,
        Part::FarEnd,
        "the end-of-travel switch beyond the far end",
    )
}

fn opens_the_loop(work: &mut Work<'_>, part: Part, what: &str) -> Result<(), Halt> {
    work.supply(false)?;
    work.clear()?;
    let rest = work.status()?.inputs;
    let status = work.ask(part, true, |status| {
        status.inputs.estop_loop || status.inputs != rest
    })?;
    let seen = status.inputs;
    work.note("opened", seen.estop_loop);
    if !seen.estop_loop {
        return Err(Halt::Defect(match changed(rest, seen) {
            "" => format!(
                "{what} does not open the E-stop loop: it is bridged, welded, or not in series"
            ),
            other => format!("swapped wires: {what} opens the {other} instead of the E-stop loop"),
        }));
    }
    let latched = work.until(500_000, |status| status.fault.is_some())?;
    work.note("latched", latched.fault == Some(RigFault::EStopLoop));
    if latched.fault != Some(RigFault::EStopLoop) {
        return Err(Halt::Defect(format!(
            "{what} opens the loop, but the rig does not latch it"
        )));
    }
    let status = work.ask(part, false, |status| !status.inputs.estop_loop)?;
    if status.inputs.estop_loop {
        return Err(Halt::Defect(format!(
            "the E-stop loop stays open after {what} was let go"
        )));
    }
    if status.fault.is_none() {
        return Err(Halt::Defect(
            "the fault was cleared by closing the loop, without an acknowledgement".to_owned(),
        ));
    }
    work.clear()
}

fn changed(before: RigInputs, after: RigInputs) -> &'static str {
    let flag = before.home_flag != after.home_flag;
    let limit = before.far_limit != after.far_limit;
    match (flag, limit, before.estop_loop != after.estop_loop) {
        (false, false, false) => "",
        (true, false, false) => "home flag",
        (false, true, false) => "far limit",
        (false, false, true) => "E-stop loop",
        _ => "several inputs",
    }
}

pub(super) fn home_flag(work: &mut Work<'_>) -> Result<(), Halt> {
    opens_alone(work, Part::HomeFlag, "home flag", |inputs| inputs.home_flag)
}

pub(super) fn far_limit(work: &mut Work<'_>) -> Result<(), Halt> {
    opens_alone(work, Part::FarLimit, "far limit", |inputs| inputs.far_limit)
}

fn opens_alone(
    work: &mut Work<'_>,
    part: Part,
    what: &'static str,
    its: fn(RigInputs) -> bool,
) -> Result<(), Halt> {
    work.to_the_middle()?;
    work.clear()?;
    let rest = work.status()?.inputs;
    if its(rest) {
        return Err(Halt::Defect(format!(
            "the {what} is open in the middle of the travel, where nothing actuates it: a dead contact, dirt, or a broken wire"
        )));
    }
    let status = work.ask(part, true, |status| status.inputs != rest)?;
    let seen = changed(rest, status.inputs);
    work.note("opened", seen);
    let defect = match seen {
        name if name == what => None,
        "" => Some(format!(
            "the {what} is dead: it does not open when it is actuated. A welded contact, a bridge, or no wire at its input"
        )),
        other => Some(format!(
            "swapped switches: actuating the {what} opens the {other}. Exchange their plugs"
        )),
    };
    let status = work.ask(part, false, |status| status.inputs == rest)?;
    if let Some(defect) = defect {
        return Err(Halt::Defect(defect));
    }
    if its(status.inputs) {
        return Err(Halt::Defect(format!(
            "the {what} stays open after it was let go: it sticks"
        )));
    }
    Ok(())
}
