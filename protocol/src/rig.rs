//! Messages of the rig.

use crate::settings::SettingKey;
use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

/// Finds the position reference in two passes over the home flag, then moves to position 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Home;

/// Homing was accepted and has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct HomeAccepted {
    /// Speed of the first pass.
    pub seek_um_s: u32,
    /// Speed of the second, measuring pass.
    pub locate_um_s: u32,
    /// The flag must be found within this travel.
    pub max_travel_um: u32,
}

/// Reaction of a run to a host that is silent for longer than the link time-out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum LinkLossPolicy {
    /// Category-1 stop (the default).
    Stop,
    Finish,
}

/// How the timing of a run is specified.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum RunTiming {
    /// Total duration from the start to the last step; the speeds follow from it.
    Total {
        /// Start delay, strokes and dwells together.
        total_us: u64,
        /// Acceleration of every ramp.
        accel_um_s2: u32,
    },
    /// Speeds; the duration follows from them.
    Speeds {
        /// Away from home.
        forward_um_s: u32,
        /// Towards home.
        return_um_s: u32,
        /// Acceleration of every ramp.
        accel_um_s2: u32,
    },
}

/// Starts a run: out to `stroke_um` and back to 0, `cycles` times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub struct Run {
    /// Number of cycles, 1..=10,000.
    pub cycles: u16,
    /// Length of a stroke, at most the configured one. It is rounded down to whole steps, at least one.
    pub stroke_um: u32,
    /// Total duration or speeds.
    pub timing: RunTiming,
    /// Pause at the far end.
    pub far_dwell_us: u32,
    /// Pause at home, except after the last cycle.
    pub home_dwell_us: u32,
    /// Between acceptance and the first stroke.
    pub start_delay_us: u32,
    /// Reaction if the host falls silent.
    pub link_loss: LinkLossPolicy,
}

/// One stroke as it will be executed. The three integers define the exact continuous profile: a symmetric
/// trapezoid from rest to rest over `steps` steps in `duration_ticks` whose ramps last `ramp_ticks` each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub struct Stroke {
    pub steps: u32,
    /// Duration in timer ticks of 10 ns.
    pub duration_ticks: u64,
    /// Duration of each ramp in timer ticks of 10 ns.
    pub ramp_ticks: u64,
    /// Achieved peak speed, rounded to the nearest.
    pub peak_um_s: u32,
    /// Achieved acceleration, rounded to the nearest.
    pub accel_um_s2: u32,
}

/// The run was solved and accepted: the request, and what will be executed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct RunAccepted {
    /// Number of the run, counted from 1 since the device started.
    pub run: u32,
    pub requested: Run,
    /// Strokes away from home.
    pub forward: Stroke,
    /// Strokes towards home.
    pub back: Stroke,
    /// From the start (start delay included) to the last step, in timer ticks of 10 ns.
    pub total_ticks: u64,
    /// Steps of the whole run.
    pub edges: u64,
    /// Fingerprint of the plan.
    pub plan_hash: u64,
}

/// Feed hold: decelerates to rest within the run, which can then be resumed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Hold;

/// Continues a held run exactly as planned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Resume;

/// Direction of travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// Away from home, to the left: positions grow.
    Away,
    /// Towards home, to the right.
    Home,
}

/// Moves towards the end of the stroke for as long as this request is renewed within the dead-man time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Jog {
    pub direction: Direction,
    /// Speed between the ramps.
    pub speed_um_s: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct MoveTo {
    /// Target, 0..= configured stroke: the last whole step within it.
    pub position_um: u32,
    /// Speed between the ramps.
    pub speed_um_s: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct MoveAccepted {
    pub from_steps: i32,
    pub to_steps: i32,
    /// The profile between them.
    pub stroke: Stroke,
}

/// Asks for the rig's health counters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetRigHealth;

/// Glitches of a switch: pulses too short to count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Glitches {
    /// Number since the start.
    pub count: u32,
    /// Device time of the last one, low 32 bits of us; 0 = none.
    pub last_us: u32,
    /// How often the line was so noisy that it was masked for a millisecond.
    pub masked: u32,
}

/// Health counters since the start of the device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct RigHealth {
    pub home_flag: Glitches,
    pub far_limit: Glitches,
    /// Receptions that ended with noise, framing error or overrun.
    pub uart_errors: u32,
    /// Frames with a bad checksum or length.
    pub bad_frames: u32,
    /// Events and telemetry samples dropped because the line was busy.
    pub unsent_frames: u32,
    /// Paths that ended because the queue of timer periods ran dry.
    pub underruns: u32,
    /// Deepest use of the stack, bytes.
    pub stack_used: u32,
    /// Size of the stack, bytes.
    pub stack_size: u32,
    /// Longest delay of the control task's 10 ms round.
    pub control_late_us: u32,
    /// Fingerprint of the image in flash: FNV-1a, 32 bits, over its words.
    pub image_hash: u32,
}

/// Asks what the rig's own hardware has shown since the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetRigHardware;

/// Counts of step timer, capture timer and pins since the start of the device. They wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct RigHardware {
    /// Intervals between two steps, captured at the pin, that equal the planned ones.
    pub intervals_exact: u32,
    /// Intervals that differed from the plan by 1 tick of 10 ns, in either direction.
    pub intervals_1_tick: u32,
    /// Intervals that differed by 2 ticks.
    pub intervals_2_ticks: u32,
    /// Intervals that differed by more.
    pub intervals_more: u32,
    /// How often the capture register was overwritten before DMA had fetched the instant in it.
    pub lost_captures: u32,
    /// How often a DMA stream of the step timer or of the capture timer reported a transfer error (TEIF, DMEIF). FIFO
    /// underruns do not count.
    pub dma_errors: u32,
    /// How often the step timer had to be reset because a stop found its DMA burst cut in two.
    pub timer_resets: u32,
    /// EN was high at the start, before the firmware drove it. Low means that it has no pull-up, or one without supply.
    /// High means only that nothing pulled it down at that moment, not that its voltage is right.
    pub enable_high_at_start: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetRunRecord;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum RunOutcome {
    /// No run since the start of the device.
    None,
    /// Still going on.
    Running,
    /// All cycles were executed.
    Complete,
    /// Stopped on request; the position is kept.
    Stopped,
    /// Ended by link loss; the position is kept.
    LinkLost,
    Faulted(RigFault),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct RunRecord {
    /// Number of the run, as in [`RunAccepted`].
    pub run: u32,
    /// How it ended, or `Running`.
    pub outcome: RunOutcome,
    /// Completed strokes.
    pub strokes: u32,
    /// Steps that the generator emitted. After a cut these are the steps up to the cut, not those that were prepared.
    pub commanded_edges: u64,
    /// Steps that the read-back counter saw at the pin.
    pub counted_edges: u64,
    /// Duration by the step timer in ticks of 10 ns, from the start (start delay included) to the last step. The pause
    /// of a hold does not count; its ramps do.
    pub ticks: u64,
    /// Fingerprint of the plan, as in [`RunAccepted`].
    pub plan_hash: u64,
    /// Smallest commanded position.
    pub min_steps: i32,
    /// Largest commanded position.
    pub max_steps: i32,
    /// Largest residual of the step-loss check at the home flag.
    pub worst_residual_steps: i32,
    /// Fewest timer periods in the queue at any time; 0 would be an underrun. None if every path of the run, or every
    /// stroke, was queued as a whole.
    pub min_queue: Option<u16>,
    /// False pulses on home flag and far limit that were filtered out.
    pub glitches: u32,
    /// Number of holds. One that came too late to stop before the run's end counts if it changed the run's times.
    pub holds: u32,
    /// Fingerprint of the image, as in [`RigHealth`].
    pub image_hash: u32,
    /// Prepared steps: those emitted, and those that a cut prevented.
    pub prepared_edges: u64,
    /// Steps whose instant was captured at the pin and compared with the plan; 0 = not timed.
    pub edges_timed: u64,
    /// Largest difference between a captured interval and the planned one, in timer ticks of 10 ns; [`u32::MAX`] if
    /// there were more edges than steps, or if the last step had none.
    pub worst_interval_error_ticks: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetRigStatus;

/// State of the rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum RigState {
    /// The position is unknown: home first.
    Unhomed,
    /// Finding the reference.
    Homing,
    /// At rest at a known position.
    Ready,
    Running,
    /// Feed hold: at rest inside a run.
    Held,
    /// Decelerating.
    Stopping,
    Faulted,
    /// Jog, or a move to a position.
    Moving,
}

/// Phases of homing: a fault says in which one it happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum HomingPhase {
    /// Leaving the flag before the first pass.
    Clear,
    /// First, fast pass towards the flag.
    Seek,
    /// Backing off the flag.
    PullOff,
    /// Second, slow pass towards the flag.
    Locate,
    /// To position 0.
    ToZero,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum RigFault {
    /// The E-stop and end-of-travel loop opened (or its wire is cut).
    // In this form, because the derive of `Schema` reads `rename = "..."`, and the name in JSON is not part of the
    // wire.
    #[serde(rename(serialize = "estop_loop", deserialize = "estop_loop"))]
    EStopLoop,
    #[serde(rename(serialize = "estop_frame", deserialize = "estop_frame"))]
    EStopFrame,
    /// The far limit opened while the carriage was moving away from home (or its wire is cut).
    FarLimit,
    /// Homing: the flag was not found within the allowed travel, or closed again or opened elsewhere.
    FlagNotFound(HomingPhase),
    /// Homing: the flag stayed actuated over the whole pull-off.
    FlagStuck,
    /// Home flag and far limit are both open: a cable is unplugged.
    BothSwitchesOpen,
    /// Step-loss check: the home flag opened more than `max_residual_steps` from where homing found it.
    LostSteps {
        /// Commanded position minus the one found.
        residual_steps: i32,
    },
    /// Emitted and counted steps disagree: jumper missing, or pulses damaged.
    ReadBack {
        /// Steps that the generator emitted.
        commanded: i32,
        /// Steps that the counter saw.
        counted: i32,
    },
    /// The queue of timer periods ran dry, or its DMA stream stopped by an error, and the pulses stopped.
    Underrun,
    /// The step generator refused a step that would have left the window.
    WindowGuard,
    /// A task did not check in; the device was reset.
    Watchdog,
    /// The firmware panicked or hit a processor fault; the device was reset.
    Panic,
    /// Homing took longer than its time-out.
    HomingTimeout(HomingPhase),
    /// The board's 8 MHz clock was missing at the start: ticks would have a wrong length, so nothing moves.
    ClockMissing,
    /// The board's 8 MHz clock stopped; the pulses ended with it and the device was reset.
    ClockFailed,
    /// A switch's line changes so often that its interrupt had to be masked again and again.
    SwitchNoise(Switch),
}

/// The switches that interrupts watch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum Switch {
    HomeFlag,
    FarLimit,
}

/// State of the rig's inputs; true = open (actuated, or wire cut).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct RigInputs {
    #[serde(rename(serialize = "home_flag_open", deserialize = "home_flag_open"))]
    pub home_flag: bool,
    #[serde(rename(serialize = "far_limit_open", deserialize = "far_limit_open"))]
    pub far_limit: bool,
    /// E-stop and end-of-travel loop.
    #[serde(rename(serialize = "estop_loop_open", deserialize = "estop_loop_open"))]
    pub estop_loop: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct RigStatus {
    /// Device time since its start.
    pub time_us: u64,
    pub state: RigState,
    /// The latched fault, if there is one.
    pub fault: Option<RigFault>,
    /// The position can be trusted.
    pub homed: bool,
    /// Position by the read-back counter.
    pub position_steps: i32,
    /// Position by the read-back counter in micrometres.
    pub position_um: i32,
    pub stroke_um: u32,
    /// Steps of one revolution of the screw.
    pub steps_per_rev: u32,
    /// Lead of the screw.
    pub lead_um: u32,
    /// Switches and E-stop loop.
    pub inputs: RigInputs,
    /// Number of the present or last run.
    pub run: u32,
    /// Stroke in progress, from 0.
    pub stroke: u32,
    pub strokes: u32,
    /// Time since the run was accepted, holds included; 0 when none is under way.
    pub elapsed_us: u64,
    /// After a watchdog reset or a panic: motion is refused until [`crate::system::Acknowledge`].
    pub needs_acknowledge: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum RigEvent {
    /// The position reference was found.
    Homed {
        /// Position at which the second pass met the flag, relative to the first pass.
        repeat_steps: i32,
        /// Shift of the reference against the previous homing, if the position was trusted.
        shift_steps: i32,
    },
    /// A run was accepted and begins, with its start delay.
    RunStarted {
        run: u32,
    },
    /// A stroke was completed.
    StrokeDone {
        /// From 0.
        stroke: u32,
        /// Residual of the step-loss check: count at the last pass of the home flag minus the reference.
        residual_steps: i32,
    },
    RunEnded {
        run: u32,
        outcome: RunOutcome,
    },
    /// The carriage came to rest after a stop.
    Stopped {
        position_steps: i32,
    },
    Faulted(RigFault),
    /// The run was held and the carriage is at rest.
    Held {
        position_steps: i32,
    },
    /// The held run continues.
    Resumed,
    Moved {
        position_steps: i32,
    },
    SettingChanged(SettingKey),
    /// All settings are at their defaults now.
    SettingsReset,
    /// Settings in flash cannot be used; their defaults are in force, or all defaults if they contradict each other.
    SettingsUnusable,
    /// The start button was pressed, but nothing could start.
    ButtonIgnored,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct RigTelemetry {
    /// Device time since its start.
    pub time_us: u64,
    pub state: RigState,
    /// Position by the read-back counter.
    pub position_steps: i32,
    /// Position by the generator, up to the last period handed to the timer.
    pub commanded_steps: i32,
    /// Mean speed since the previous telemetry.
    pub speed_um_s: i32,
    /// Stroke in progress, from 0.
    pub stroke: u32,
    /// Residual at the last pass of the home flag.
    pub residual_steps: i32,
    /// Switches and E-stop loop.
    pub inputs: RigInputs,
}
