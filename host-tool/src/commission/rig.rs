//! The rig's steps. Those without motor power come first; nothing moves before the switches are known to work.

use std::path::Path;

use protocol::rig::{Direction, GetRigHealth, Jog, RigFault, RigInputs, RigState, RunOutcome};
use protocol::rig::{LinkLossPolicy, RigStatus, Run, RunTiming};
use protocol::settings::SettingKey as Key;
use protocol::system::{BrownOut, Clock, GetChip, ResetCause};
use serde_json::json;

use crate::commission::hands::{Part, Reading};
use crate::commission::image;
use crate::commission::steps::Step;
use crate::commission::work::{Halt, HomeEnd, Work, by_speed, fault_text, homing_text};
use crate::decimal;

/// What turns steps into millimetres.
const SCREW: [Key; 3] = [Key::LeadUm, Key::FullSteps, Key::Microsteps];
/// What homing depends on.
const HOMING: &[Key] = &[
    Key::LeadUm,
    Key::FullSteps,
    Key::Microsteps,
    Key::StrokeUm,
    Key::SeekUmS,
    Key::LocateUmS,
    Key::HomingAccelUmS2,
    Key::StopAccelUmS2,
    Key::OvertravelUm,
    Key::PullOffUm,
    Key::FlagUm,
    Key::SwitchFilterUs,
    Key::MaxStepHz,
    Key::StepPulseNs,
];
/// What the pulses of a run depend on.
const PULSES: &[Key] = &[
    Key::LeadUm,
    Key::FullSteps,
    Key::Microsteps,
    Key::MaxSpeedUmS,
    Key::MaxAccelUmS2,
    Key::MaxStepHz,
    Key::StepPulseNs,
    Key::TurnaroundUs,
];
/// What a whole run depends on.
const RUN: &[Key] = &[
    Key::LeadUm,
    Key::FullSteps,
    Key::Microsteps,
    Key::StrokeUm,
    Key::MaxSpeedUmS,
    Key::MaxAccelUmS2,
    Key::MaxStepHz,
    Key::StepPulseNs,
    Key::TurnaroundUs,
    Key::FlagUm,
    Key::LedgerLimitSteps,
    Key::SwitchFilterUs,
];

/// A step without settings, at which nothing has to be looked at.
const PLAIN: Step = Step {
    name: "",
    shows: "",
    look: "",
    of_image: true,
    settings: &[],
    needs_hands: true,
    check: image_is_the_one,
};

/// The steps in their order.
pub const STEPS: &[Step] = &[
    Step {
        name: "image",
        shows: "the image on the board is the one that was built; its last start was no failure",
        look: "the LED blinks slowly: not homed",
        needs_hands: false,
        check: image_is_the_one,
        ..PLAIN
    },
    Step {
        name: "clock",
        shows: "the board has its 8 MHz clock, and its clock goes as the host's",
        needs_hands: false,
        check: clock,
        ..PLAIN
    },
    Step {
        name: "enable",
        shows: "EN is pulled up while the processor does not drive it: the driver is off",
        of_image: false,
        check: enable,
        ..PLAIN
    },
    Step {
        name: "quiet",
        shows: "loop, home flag and far limit are quiet while nothing moves",
        settings: &[Key::SwitchFilterUs],
        needs_hands: false,
        check: quiet,
        ..PLAIN
    },
    Step {
        name: "e-stop",
        shows: "the E-stop button opens the loop, is latched, and closes it again",
        look: "the LED blinks fast while the fault is latched",
        check: e_stop,
        ..PLAIN
    },
    Step {
        name: "home-end",
        shows: "the end-of-travel switch beyond home opens the loop",
        check: home_end,
        ..PLAIN
    },
    Step {
        name: "far-end",
        shows: "the end-of-travel switch beyond the far end opens the loop",
        check: far_end,
        ..PLAIN
    },
    Step {
        name: "home-flag",
        shows: "the home flag, and nothing else, opens while it is actuated",
        settings: &[Key::SwitchFilterUs],
        check: home_flag,
        ..PLAIN
    },
    Step {
        name: "far-limit",
        shows: "the far limit, and nothing else, opens while it is actuated",
        settings: &[Key::SwitchFilterUs],
        check: far_limit,
        ..PLAIN
    },
    Step {
        name: "pulses",
        shows: "homing without motor power: each step is counted, the flag is not found",
        look: "on an oscilloscope STEP stays low after the last pulse",
        settings: HOMING,
        check: pulses,
        ..PLAIN
    },
    Step {
        name: "home",
        shows: "the motor turns the right way, and the carriage finds its flag",
        look: "the carriage has to go to the RIGHT; a hand on the supply switch",
        settings: HOMING,
        check: home,
        ..PLAIN
    },
    Step {
        name: "travel",
        shows: "the carriage travels as far as the settings of screw and driver say",
        settings: &SCREW,
        check: travel,
        ..PLAIN
    },
    Step {
        name: "repeat",
        shows: "three more homings find the same place within 2 steps",
        settings: HOMING,
        check: repeat,
        ..PLAIN
    },
    Step {
        name: "read-back",
        shows: "without motor power, every step of many strokes is counted",
        settings: PULSES,
        check: read_back,
        ..PLAIN
    },
    Step {
        name: "edge-timing",
        shows: "the intervals between steps, timed at the pin, are those of the plan",
        settings: PULSES,
        check: edge_timing,
        ..PLAIN
    },
    Step {
        name: "e-stop-moving",
        shows: "the E-stop ends a run at once; releasing it moves nothing",
        settings: &SCREW,
        check: e_stop_moving,
        ..PLAIN
    },
    Step {
        name: "jumper",
        shows: "a read-back jumper that is pulled ends a run within a stroke",
        settings: &SCREW,
        check: jumper,
        ..PLAIN
    },
    Step {
        name: "cable",
        shows: "a cable that is pulled ends a run, and the board outlives it",
        look: "the carriage stands after about link_timeout_ms",
        settings: &[
            Key::LinkTimeoutMs,
            Key::LeadUm,
            Key::FullSteps,
            Key::Microsteps,
        ],
        check: cable,
        ..PLAIN
    },
    Step {
        name: "hold",
        shows: "a run that is held and resumed makes all its steps",
        settings: &SCREW,
        check: hold,
        ..PLAIN
    },
    Step {
        name: "jog",
        shows: "a jog that is not renewed stops by itself, a move ends where it was sent",
        settings: &[Key::DeadManMs, Key::LeadUm, Key::FullSteps, Key::Microsteps],
        check: jog,
        ..PLAIN
    },
    Step {
        name: "stroke",
        shows: "the whole stroke is free: far limit and end switches lie beyond it",
        look: "nothing touches on the way",
        settings: &[Key::StrokeUm, Key::LeadUm, Key::FullSteps, Key::Microsteps],
        check: stroke,
        ..PLAIN
    },
    Step {
        name: "run",
        shows: "the paper's run: all steps counted, none lost, nothing too late",
        settings: RUN,
        check: run,
        ..PLAIN
    },
];

/// False pulses on a switch's line in a run of the last step that are too many.
const TOO_MANY_GLITCHES: u32 = 100;
/// A pull-up of 10 kohm against the driver's own resistor gives more than this, mV.
const LEAST_ENABLE_MV: i64 = 2_500;
/// More than the 3.3 V of the board, mV.
const MOST_ENABLE_MV: i64 = 3_600;
/// Two quartz clocks differ by less than 100; the rest is for a host whose answers come late, parts per million.
const CLOCK_PPM: i64 = 2_000;
/// How long the lines are watched, us.
const QUIET_US: u64 = 3_000_000;
/// The longest way of the travel measurement, um.
const TRAVEL_UM: u32 = 40_000;
/// Largest difference between two homings, steps.
const REPEAT_STEPS: i32 = 2;

fn image_is_the_one(work: &mut Work<'_>) -> Result<(), Halt> {
    let Some(identity) = work.device.identity().copied() else {
        return Err(Halt::NotShown(
            "the board did not identify itself".to_owned(),
        ));
    };
    let on_board = work.subject.image.clone();
    work.note("image", on_board.clone());
    work.note("firmware", work.subject.firmware.clone());
    if matches!(
        identity.reset_cause,
        ResetCause::Panic | ResetCause::Watchdog
    ) {
        let words = work.device.last_words()?;
        return Err(Halt::Defect(format!(
            "its last start was a failure: {}. {words}",
            crate::identity::reset_cause(identity.reset_cause)
        )));
    }
    let Some(file) = work.options.image.clone() else {
        return Err(Halt::NotShown(
            "there is no image file to compare with: `--image ELF`".to_owned(),
        ));
    };
    let built = fingerprint(&file)?;
    work.note("image_file", built.clone());
    if built != on_board {
        return Err(Halt::Defect(format!(
            "stale image: the board has {on_board}, {} is {built}. `retrograde flash rig`",
            file.display()
        )));
    }
    Ok(())
}

fn fingerprint(file: &Path) -> Result<String, Halt> {
    match image::fingerprint(file) {
        Ok(hash) => Ok(format!("{hash:08x}")),
        Err(why) => Err(Halt::NotShown(format!("{}: {why}", file.display()))),
    }
}

fn clock(work: &mut Work<'_>) -> Result<(), Halt> {
    let chip = work.device.call(GetChip)?;
    work.note("clock", format!("{:?}", chip.clock).to_lowercase());
    work.note("brown_out", format!("{:?}", chip.brown_out).to_lowercase());
    work.note("option_bytes", format!("{:08x}", chip.option_bytes));
    if chip.clock == Clock::Internal {
        return Err(Halt::Defect(fault_text(RigFault::ClockMissing)));
    }
    if chip.supply_low {
        return Err(Halt::Defect(
            "the board's supply is below 2.7 V: check how it is fed".to_owned(),
        ));
    }
    if chip.brown_out == BrownOut::Off {
        work.say("  note: the brown-out reset is off (option bytes); see docs/silicon.md, item 10");
    }
    compare_clocks(work, CLOCK_PPM, |work| Ok(work.status()?.time_us))
}

/// Compares the device's clock with that of the link; beyond `limit_ppm` it is wrong.
pub(super) fn compare_clocks(
    work: &mut Work<'_>,
    limit_ppm: i64,
    mut device_us: impl FnMut(&mut Work<'_>) -> Result<u64, Halt>,
) -> Result<(), Halt> {
    // The quickest of some answers says best what time it is there: its round trip is the uncertainty.
    let mut pair = |work: &mut Work<'_>| {
        let mut best = (i64::MAX, 0, 0);
        for _ in 0..8 {
            let before = work.device.now_us();
            let there = device_us(work)?;
            let after = work.device.now_us();
            let trip = signed(after - before);
            if trip < best.0 {
                best = (trip, signed(before) + trip / 2, signed(there));
            }
        }
        Ok::<_, Halt>(best)
    };
    let first = pair(work)?;
    work.pause(work.options.clock_us)?;
    let last = pair(work)?;
    let (here, there) = (last.1 - first.1, last.2 - first.2);
    let ppm = |us: i64| us.saturating_mul(1_000_000) / here.max(1);
    let (off, unsure) = (ppm(there - here), ppm((first.0 + last.0) / 2) + 1);
    work.note("compared_us", here);
    work.note("clock_off_ppm", off);
    work.note("uncertain_ppm", unsure);
    if off.abs() > limit_ppm + unsure {
        return Err(Halt::Defect(format!(
            "the board's clock is off by {off} ppm (+-{unsure}) against this computer's"
        )));
    }
    Ok(())
}

fn signed(us: u64) -> i64 {
    i64::try_from(us).unwrap_or(i64::MAX)
}

fn enable(work: &mut Work<'_>) -> Result<(), Halt> {
    work.supply(false)?;
    let boot = work.boot_id();
    let mv = work.read(Reading::EnableInReset)?;
    work.find_again()?;
    work.note("enable_in_reset_mv", mv);
    if work.boot_id() == boot {
        return Err(Halt::NotShown(
            "the board was not reset, so it drove EN itself".to_owned(),
        ));
    }
    let volts = decimal::write_signed(mv, 3);
    if mv < LEAST_ENABLE_MV {
        return Err(Halt::Defect(format!(
            "EN has no pull-up: {volts} V in reset, so the driver is on while no firmware runs. 10 kohm from D8 to 3.3 V"
        )));
    }
    if mv > MOST_ENABLE_MV {
        return Err(Halt::Defect(format!(
            "EN is pulled up to {volts} V, more than the board's 3.3 V: 10 kohm from D8 to 3.3 V"
        )));
    }
    Ok(())
}

fn quiet(work: &mut Work<'_>) -> Result<(), Halt> {
    work.clear()?;
    let before = work.device.call(GetRigHealth)?;
    let status = work.until(QUIET_US, |status| status.fault.is_some())?;
    let after = work.device.call(GetRigHealth)?;
    let home = after.home_flag.count.wrapping_sub(before.home_flag.count);
    let far = after.far_limit.count.wrapping_sub(before.far_limit.count);
    work.note("watched_us", QUIET_US);
    work.note("home_flag_false_pulses", home);
    work.note("far_limit_false_pulses", far);
    match status.fault {
        Some(RigFault::EStopLoop) => {
            return Err(Halt::Defect(
                "the E-stop loop is noisy: it opens although nobody touches it. A loose contact, or a wire beside the motor's: shield it, 1 to 2.2 kohm from D12 to 3.3 V".to_owned(),
            ));
        }
        Some(fault) => return Err(Halt::Defect(fault_text(fault))),
        None => {}
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

fn e_stop(work: &mut Work<'_>) -> Result<(), Halt> {
    opens_the_loop(work, Part::EStop, "the E-stop button")
}

fn home_end(work: &mut Work<'_>) -> Result<(), Halt> {
    opens_the_loop(work, Part::HomeEnd, "the end-of-travel switch beyond home")
}

fn far_end(work: &mut Work<'_>) -> Result<(), Halt> {
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

/// The inputs that differ, for people.
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

fn home_flag(work: &mut Work<'_>) -> Result<(), Halt> {
    opens_alone(work, Part::HomeFlag, "home flag", |inputs| inputs.home_flag)
}

fn far_limit(work: &mut Work<'_>) -> Result<(), Halt> {
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

fn pulses(work: &mut Work<'_>) -> Result<(), Halt> {
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

fn home(work: &mut Work<'_>) -> Result<(), Halt> {
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

fn travel(work: &mut Work<'_>) -> Result<(), Halt> {
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
    let settings = [Key::LeadUm, Key::FullSteps, Key::Microsteps].map(|key| work.setting(key));
    if let Some(defect) = wrong_travel(commanded, measured, settings) {
        return Err(Halt::Defect(defect));
    }
    work.go_to(0).map(|_| ())
}

/// What a measured travel says about screw and driver, with the settings lead, full steps and microsteps; none if it is
/// the commanded one within 1.5 %, which is more than a caliper's error.
#[must_use]
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

fn repeat(work: &mut Work<'_>) -> Result<(), Halt> {
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

/// A run with short strokes as fast as they go, within the way on which the rig does not look for its flag: without
/// motor power the flag does not change.
fn short_strokes(work: &Work<'_>, strokes: u32) -> Result<Run, Halt> {
    let [lead, full, micro] = SCREW.map(|key| u64::from(work.setting(key)));
    let steps_per_rev = (full * micro).max(1);
    let um = |steps: u64| u32::try_from(steps * lead / steps_per_rev).unwrap_or(u32::MAX);
    let flag_um = work.setting(Key::FlagUm);
    let limit_um = um(u64::from(work.setting(Key::LedgerLimitSteps)));
    let stroke_um = if flag_um > 0 { flag_um } else { limit_um };
    let stroke_um = stroke_um.min(work.setting(Key::StrokeUm));
    if stroke_um < um(2).max(1) {
        return Err(Halt::NotShown(
            "flag_um and ledger_limit_steps are 0: there is no stroke without a look at the flag"
                .to_owned(),
        ));
    }
    let fastest = um(u64::from(work.setting(Key::MaxStepHz)));
    let speed = work.setting(Key::MaxSpeedUmS).min(fastest);
    let cycles = u16::try_from(strokes.div_ceil(2)).unwrap_or(u16::MAX);
    let accel = work.setting(Key::MaxAccelUmS2);
    Ok(by_speed(cycles, stroke_um, speed, accel))
}

fn read_back(work: &mut Work<'_>) -> Result<(), Halt> {
    let run = short_strokes(work, work.options.strokes)?;
    let (accepted, record) = work.run_without_power(run)?;
    work.whole(&accepted, &record)
}

fn edge_timing(work: &mut Work<'_>) -> Result<(), Halt> {
    let run = short_strokes(work, work.options.strokes.min(200))?;
    let (accepted, record) = work.run_without_power(run)?;
    work.whole(&accepted, &record)?;
    work.note("edges_timed", record.edges_timed);
    work.note(
        "worst_interval_error_ticks",
        record.worst_interval_error_ticks,
    );
    if record.edges_timed == 0 {
        return Err(Halt::NotShown(
            "not timed: there is no second jumper from STEP to the capture input".to_owned(),
        ));
    }
    if record.worst_interval_error_ticks > 0 {
        return Err(Halt::Defect(format!(
            "an interval between two steps differs from the plan by {} ns",
            u64::from(record.worst_interval_error_ticks) * 10
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

fn e_stop_moving(work: &mut Work<'_>) -> Result<(), Halt> {
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

fn jumper(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    work.start_short_run(10)?;
    work.under_way()?;
    let status = work.ask(Part::Jumper, false, at_rest)?;
    // Half a second is a stroke's quarter; the end of the stroke finds what the rounds before have not.
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
            "the run goes on without the jumper D2-A0: something else feeds the read-back"
                .to_owned(),
        )),
    }
}

fn cable(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    work.start_short_run(10)?;
    work.under_way()?;
    let boot = work.boot_id();
    work.pull_the_cable()?;
    if work.boot_id() != boot {
        return Err(Halt::Defect(
            "the board lost its supply with the cable and started again: feed it by E5V or VIN, see docs/rig.md".to_owned(),
        ));
    }
    let status = work.until(2_000_000, at_rest)?;
    let record = work.device.run_record()?;
    work.note("stands_at_um", status.position_um);
    match record.outcome {
        RunOutcome::LinkLost => Ok(()),
        RunOutcome::Complete => Err(Halt::NotShown(
            "the run was over before the cable was pulled".to_owned(),
        )),
        RunOutcome::Faulted(fault) => Err(Halt::Defect(fault_text(fault))),
        other => Err(Halt::Defect(format!(
            "the run did not end with the cable: {other:?}"
        ))),
    }
}

fn at_rest(status: &RigStatus) -> bool {
    !matches!(
        status.state,
        RigState::Running | RigState::Stopping | RigState::Moving | RigState::Homing
    )
}

fn hold(work: &mut Work<'_>) -> Result<(), Halt> {
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

fn jog(work: &mut Work<'_>) -> Result<(), Halt> {
    work.at_home()?;
    let speed_um_s = 5_000.min(work.setting(Key::MaxSpeedUmS));
    work.device.call(Jog {
        sense: Direction::Away,
        speed_um_s,
    })?;
    // The host is heard all the time: it is the jog itself that is not renewed.
    let dead_man = u64::from(work.setting(Key::DeadManMs));
    let status = work.until(dead_man * 1_000 + 2_000_000, at_rest)?;
    work.note("jogged_um", status.position_um);
    let farthest = u64::from(speed_um_s) * (dead_man + 200) / 1_000;
    if status.state != RigState::Ready || i64::from(status.position_um) > signed(farthest) {
        return Err(Halt::Defect(format!(
            "a jog that was not renewed went {} um and is {:?}",
            status.position_um, status.state
        )));
    }
    // The rig takes no new motion while a repetition of the jog might be under way.
    work.pause(dead_man * 1_000 + 50_000)?;
    let target = work.setting(Key::StrokeUm) / 2;
    let there = work.go_to(target)?;
    work.note("moved_to_um", there.position_um);
    let step = i64::from(there.lead_um.div_ceil(there.steps_per_rev.max(1)));
    if (i64::from(there.position_um) - i64::from(target)).abs() > step {
        return Err(Halt::Defect(format!(
            "a move to {target} um ended at {} um",
            there.position_um
        )));
    }
    work.go_to(0).map(|_| ())
}

fn stroke(work: &mut Work<'_>) -> Result<(), Halt> {
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

fn run(work: &mut Work<'_>) -> Result<(), Halt> {
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
