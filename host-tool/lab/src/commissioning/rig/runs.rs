//! Runs: every step counted and timed, and the conditions that end a run.

use client::decimal;
use protocol::rig::{
    Direction, GetRigHardware, GetRigHealth, Jog, LinkLossPolicy, RigFault, RigHardware, RigState,
    RigStatus, Run, RunOutcome, RunTiming,
};
use protocol::settings::SettingKey as Key;
use serde_json::json;

use super::depends::SCREW;
use crate::commissioning::halt::{Halt, fault_text};
use crate::commissioning::operator::Part;
use crate::commissioning::work::Work;
use crate::commissioning::work::rig::by_speed;

/// Cycles whose edges are timed; the intervals of all others are the same.
const TIMED_CYCLES: u16 = 100;
/// Allowed error of an interval, ticks: an edge rises for up to 100 ns and is sampled every 10 ns, so an interval may
/// be one sample longer or shorter than planned.
const JITTER_TICKS: u32 = 1;
/// False pulses on a switch's line at which a run of the last step fails.
const TOO_MANY_GLITCHES: u32 = 100;

/// A run with the fastest strokes, too short for the rig to check its flag: without motor power the flag does not
/// change.
fn short_strokes(work: &Work<'_>, cycles: u16) -> Result<Run, Halt> {
    let [lead, full, micro] = SCREW.map(|key| u64::from(work.setting(key)));
    let steps_per_rev = (full * micro).max(1);
    let um = |steps: u32| u64::from(steps) * lead / steps_per_rev;
    // A distance that does not fit into 32 bits exceeds every setting.
    let within = |setting: u32, um: u64| u32::try_from(um).map_or(setting, |um| um.min(setting));
    let stroke_um = work.setting(Key::StrokeUm);
    let stroke_um = match work.setting(Key::FlagUm) {
        0 => within(stroke_um, um(work.setting(Key::MaxResidualSteps))),
        flag_um => flag_um.min(stroke_um),
    };
    // One step is the shortest stroke that the rig accepts.
    let least_um = lead.div_ceil(steps_per_rev);
    if u64::from(stroke_um) < least_um {
        return Err(Halt::NotShown(format!(
            "there is no stroke without a look at the flag: flag_um, or the way of max_residual_steps if it is 0, has to be {least_um} um or more"
        )));
    }
    let fastest = um(work.setting(Key::MaxStepHz));
    let speed = within(work.setting(Key::MaxSpeedUmS), fastest);
    let accel = work.setting(Key::MaxAccelUmS2);
    Ok(by_speed(cycles, stroke_um, speed, accel))
}

pub(super) fn read_back(work: &mut Work<'_>) -> Result<(), Halt> {
    let run = short_strokes(work, work.options.read_back_cycles)?;
    let (accepted, record) = work.run_without_power(run)?;
    work.whole(&accepted, &record)
}

pub(super) fn edge_timing(work: &mut Work<'_>) -> Result<(), Halt> {
    let cycles = work.options.read_back_cycles.min(TIMED_CYCLES);
    let run = short_strokes(work, cycles)?;
    // Home first, so that the way home is not timed as well.
    work.at_home()?;
    let before = work.device.call(GetRigHardware)?;
    let (accepted, record) = work.run_without_power(run)?;
    let after = work.device.call(GetRigHardware)?;
    work.whole(&accepted, &record)?;
    work.note("edges_timed", record.edges_timed);
    work.note(
        "worst_interval_error_ticks",
        record.worst_interval_error_ticks,
    );
    let mut count = |name: &str, count: fn(&RigHardware) -> u32| {
        let counted = count(&after).wrapping_sub(count(&before));
        work.note(name, counted);
        counted
    };
    count("intervals_exact", |counts| counts.intervals_exact);
    count("intervals_1_tick", |counts| counts.intervals_1_tick);
    let two = count("intervals_2_ticks", |counts| counts.intervals_2_ticks);
    let more = count("intervals_more", |counts| counts.intervals_more);
    let lost = count("lost_captures", |counts| counts.lost_captures);
    let dma_errors = count("dma_errors", |counts| counts.dma_errors);
    if record.edges_timed == 0 && lost == 0 && dma_errors == 0 {
        return Err(Halt::NotShown(
            "not timed: the second jumper, from D2 (STEP) to A1, is missing".to_owned(),
        ));
    }
    if record.worst_interval_error_ticks == u32::MAX {
        return Err(Halt::Defect(format!(
            "{} edges were captured, and not one for each of {} steps: noise on the wire from STEP to A1, or a bad contact",
            record.edges_timed, accepted.edges
        )));
    }
    if record.worst_interval_error_ticks > JITTER_TICKS {
        return Err(Halt::Defect(format!(
            "an interval between two steps differs from the plan by {} ns; {} of {} by more than the 10 ns of the sampling",
            u64::from(record.worst_interval_error_ticks) * 10,
            two.wrapping_add(more),
            record.edges_timed.saturating_sub(1)
        )));
    }
    if record.edges_timed < accepted.edges && lost > 0 {
        return Err(Halt::Defect(format!(
            "a capture was lost after {} of {} steps: its instant was overwritten before DMA had fetched it. The steps are counted right: look for two edges close together, which is noise on the wire from STEP to A1, and report it if there are none",
            record.edges_timed, accepted.edges
        )));
    }
    if record.edges_timed < accepted.edges && dma_errors > 0 {
        return Err(Halt::Defect(format!(
            "DMA reported {dma_errors} errors, and of {} steps {} were timed: report this",
            accepted.edges, record.edges_timed
        )));
    }
    if record.edges_timed != accepted.edges {
        return Err(Halt::Defect(format!(
            "of {} steps {} were timed",
            accepted.edges, record.edges_timed
        )));
    }
    Ok(())
}

pub(super) fn e_stop_moving(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    work.start_short_run(10)?;
    work.under_way()?;
    let status = work.ask(Part::EStop, true, at_rest)?;
    let record = work.device.run_record()?;
    work.note("counted_edges", record.counted_edges);
    let stands = status.position_steps;
    if record.outcome == RunOutcome::Complete {
        return Err(Halt::NotShown(
            "the run was over before the E-stop was pressed".to_owned(),
        ));
    }
    if record.outcome != RunOutcome::Faulted(RigFault::EStopLoop) {
        work.ask(Part::EStop, false, |status| !status.inputs.estop_loop)?;
        return Err(Halt::Defect(format!(
            "the E-stop did not end the run: {:?}",
            record.outcome
        )));
    }
    work.ask(Part::EStop, false, |status| !status.inputs.estop_loop)?;
    work.pause(1_000_000)?;
    let later = work.status()?;
    work.note("moved_after_release_steps", later.position_steps - stands);
    if later.position_steps != stands || later.state != RigState::Faulted {
        return Err(Halt::Defect(
            "releasing the E-stop moved the carriage or cleared the fault".to_owned(),
        ));
    }
    work.clear()
}

pub(super) fn jumper(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    work.start_short_run(10)?;
    work.under_way()?;
    let status = work.ask(Part::Jumper, false, at_rest)?;
    // The fault may take until the end of the stroke, where all steps are counted again; half a second is only a
    // quarter of one.
    let status = match status.fault {
        Some(_) => status,
        None => work.until(3_000_000, at_rest)?,
    };
    work.hand(Part::Jumper, true)?;
    work.note("position_steps", status.position_steps);
    match status.fault {
        Some(RigFault::ReadBack { commanded, counted }) => {
            work.note("commanded_steps", commanded);
            work.note("counted_steps", counted);
            work.clear()
        }
        Some(fault) => Err(Halt::Defect(fault_text(fault))),
        None if at_rest(&status) => Err(Halt::NotShown(
            "the run was over before the jumper was pulled".to_owned(),
        )),
        None => Err(Halt::Defect(
            "the run continues without the jumper D2-A0: something else feeds the read-back"
                .to_owned(),
        )),
    }
}

pub(super) fn cable(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    let timeout_ms = work.setting(Key::LinkTimeoutMs);
    // A cycle takes more than 1 s, so the run is longer than the time-out that ends it.
    let cycles = u16::try_from(10 + timeout_ms / 1_000).unwrap_or(u16::MAX);
    work.start_short_run(cycles)?;
    work.under_way()?;
    let before = (work.boot_id(), work.status()?.time_us);
    work.pull_the_cable()?;
    let after = (work.boot_id(), work.status()?.time_us);
    if has_restarted(before, after) {
        return Err(Halt::Defect(
            "the board lost its supply with the cable and started again: feed it by E5V or VIN, see docs/build.md".to_owned(),
        ));
    }
    // This session has not begun the run, so its requests do not keep it going.
    let limit_us = u64::from(timeout_ms) * 1_000 + 2_000_000;
    let status = work.until(limit_us, at_rest)?;
    let record = work.device.run_record()?;
    work.note("stands_at_um", status.position_um);
    match record.outcome {
        RunOutcome::LinkLost => Ok(()),
        RunOutcome::Complete => Err(Halt::NotShown(format!(
            "the run was over before the cable was pulled, or before link_timeout_ms, {timeout_ms} ms, had passed after that"
        ))),
        RunOutcome::Faulted(fault) => Err(Halt::Defect(fault_text(fault))),
        other => Err(Halt::Defect(format!(
            "the run did not end with the cable: {other:?}"
        ))),
    }
}

/// Whether the board has restarted between two readings of its number of starts and its clock. After a power cut that
/// number begins at 1 again, so only the time shows it.
fn has_restarted(before: (Option<u32>, u64), after: (Option<u32>, u64)) -> bool {
    after.0 != before.0 || after.1 < before.1
}

fn at_rest(status: &RigStatus) -> bool {
    !matches!(
        status.state,
        RigState::Running | RigState::Stopping | RigState::Moving | RigState::Homing
    )
}

pub(super) fn hold(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    let accepted = work.start_short_run(1)?;
    work.under_way()?;
    work.device.call(protocol::rig::Hold)?;
    let held = work.until(2_000_000, at_rest)?;
    work.note("held_at_um", held.position_um);
    if held.state != RigState::Held {
        return Err(Halt::Defect(format!(
            "the run was not held: {:?}",
            held.state
        )));
    }
    work.pause(500_000)?;
    let later = work.status()?;
    if later.position_steps != held.position_steps {
        return Err(Halt::Defect(
            "the carriage moved while it was held".to_owned(),
        ));
    }
    work.device.call(protocol::rig::Resume)?;
    let record = work.finish(&accepted)?;
    work.note("holds", record.holds);
    work.whole(&accepted, &record)
}

pub(super) fn jog(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    let speed_um_s = 5_000.min(work.setting(Key::MaxSpeedUmS));
    work.device.call(Jog {
        direction: Direction::Away,
        speed_um_s,
    })?;
    // The host keeps sending: only the jog is not renewed.
    let dead_man_ms = work.setting(Key::DeadManMs);
    let dead_man_us = u64::from(dead_man_ms) * 1_000;
    let status = work.until(dead_man_us + 2_000_000, at_rest)?;
    work.note("jogged_um", status.position_um);
    let farthest = i64::from(speed_um_s) * (i64::from(dead_man_ms) + 200) / 1_000;
    if status.state != RigState::Ready || i64::from(status.position_um) > farthest {
        return Err(Halt::Defect(format!(
            "a jog that was not renewed went {} mm and is {:?}",
            decimal::write_signed(status.position_um.into(), 3),
            status.state
        )));
    }
    let target = work.setting(Key::StrokeUm) / 2;
    let there = work.go_to(target)?;
    work.note("moved_to_um", there.position_um);
    let step = i64::from(there.lead_um.div_ceil(there.steps_per_rev.max(1)));
    if (i64::from(there.position_um) - i64::from(target)).abs() > step {
        return Err(Halt::Defect(format!(
            "a move to {} mm ended at {} mm",
            decimal::write(target.into(), 3),
            decimal::write_signed(there.position_um.into(), 3)
        )));
    }
    work.go_to(0).map(|_| ())
}

pub(super) fn run(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    let before = work.device.call(GetRigHealth)?;
    let cycles = work.options.cycles;
    let run = Run {
        stroke_um: 130_000.min(work.setting(Key::StrokeUm)),
        timing: RunTiming::Total {
            total_us: u64::from(cycles) * 8_000_000,
            accel_um_s2: 100_000.min(work.setting(Key::MaxAccelUmS2)),
        },
        link_loss: LinkLossPolicy::Stop,
        ..by_speed(cycles, 0, 0, 0)
    };
    let accepted = work.start(run)?;
    let record = work.finish(&accepted)?;
    work.whole(&accepted, &record)?;
    let after = work.device.call(GetRigHealth)?;
    work.note("min_queue", json!(record.min_queue));
    work.note("false_pulses", record.glitches);
    work.note("edges_timed", record.edges_timed);
    work.note(
        "worst_interval_error_ticks",
        record.worst_interval_error_ticks,
    );
    work.note("underruns", after.underruns.wrapping_sub(before.underruns));
    work.note(
        "serial_errors",
        after.uart_errors.wrapping_sub(before.uart_errors),
    );
    work.note("control_late_us", after.control_late_us);
    if record.worst_residual_steps.abs() > 1 {
        return Err(Halt::Defect(format!(
            "the home flag was met {} steps off: steps were lost, or screw or flag are loose",
            record.worst_residual_steps
        )));
    }
    if record.glitches > TOO_MANY_GLITCHES {
        return Err(Halt::Defect(format!(
            "{} false pulses on the switches: a wire runs beside the motor's",
            record.glitches
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::has_restarted;

    #[test]
    fn a_board_that_was_switched_on_twice_has_restarted() {
        let before = (Some(1), 90_000_000);
        assert!(!has_restarted(before, (Some(1), 97_000_000)), "it goes on");
        assert!(has_restarted(before, (Some(2), 97_000_000)), "reset");
        assert!(
            has_restarted(before, (Some(1), 2_000_000)),
            "lost its supply"
        );
    }
}
