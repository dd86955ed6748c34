//! Messages of the rig.

use crate::settings::SettingKey;
use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

/// Finds the position reference: two passes over the home flag, then to position 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Home;

/// Homing was accepted and has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct HomeAccepted {
    /// Speed of the first pass.
    pub seek_um_s: u32,
    /// Speed of the second, measuring pass.
    pub locate_um_s: u32,
    /// The flag must be found within this travel.
    pub max_travel_um: u32,
}

/// What a run does when the host falls silent for longer than the link time-out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum LinkLossPolicy {
    /// Category-1 stop (the default).
    Stop,
    /// Finish the run.
    Finish,
}

/// How the time of a run is given.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RunTiming {
    /// Total duration from the start to the last step; speeds follow.
    Total {
        /// Start delay, dwells and strokes together.
        total_us: u64,
        /// Acceleration of every ramp.
        accel_um_s2: u32,
    },
    /// Speeds; the duration follows.
    Speeds {
        /// Away from home.
        forward_um_s: u32,
        /// Towards home.
        return_um_s: u32,
        /// Acceleration of every ramp.
        accel_um_s2: u32,
    },
}

/// Starts a run: `cycles` times out to `stroke_um` and back to 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Run {
    /// 1..=10,000.
    pub cycles: u16,
    /// 1..= configured stroke.
    pub stroke_um: u32,
    /// Duration or speeds.
    pub timing: RunTiming,
    /// Pause at the far end.
    pub far_dwell_us: u32,
    /// Pause at home, except after the last cycle.
    pub home_dwell_us: u32,
    /// Between acceptance and the first stroke.
    pub start_delay_us: u32,
    /// What silence of the host does.
    pub link_loss: LinkLossPolicy,
}

/// One stroke as it will be executed. The three integers define the exact continuous profile: a symmetric
/// trapezoid from rest to rest over `steps` steps in `duration_ticks` whose ramps last `ramp_ticks` each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Stroke {
    /// Steps of the stroke.
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

/// The run was solved and accepted. `requested` beside what will be executed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RunAccepted {
    /// Counts runs since the device started, from 1.
    pub run: u32,
    /// As requested.
    pub requested: Run,
    /// Strokes away from home.
    pub forward: Stroke,
    /// Strokes towards home.
    pub back: Stroke,
    /// From the start, with the start delay, to the last step, in ticks of 10 ns.
    pub total_ticks: u64,
    /// Steps of the whole run.
    pub edges: u64,
    /// Fingerprint of the plan.
    pub plan_hash: u64,
}

/// Feed hold: decelerates within a run, which can be resumed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Hold;

/// Goes on with a held run, exactly as planned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Resume;

/// Direction of travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Direction {
    /// Away from home, to the left: positions grow.
    Away,
    /// Towards home, to the right.
    Home,
}

/// Moves until the end of the stroke as long as this is repeated within the dead-man time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Jog {
    /// Direction of travel. (The field's name is part of the schema key.)
    pub sense: Direction,
    /// How fast.
    pub speed_um_s: u32,
}

/// Moves to a position within the stroke.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MoveTo {
    /// Where, 0..=configured stroke.
    pub position_um: u32,
    /// How fast.
    pub speed_um_s: u32,
}

/// A move has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MoveAccepted {
    /// From here.
    pub from_steps: i32,
    /// To there.
    pub to_steps: i32,
    /// How.
    pub stroke: Stroke,
}

/// Asks for counters of the rig's health.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GetRigHealth;

/// False pulses on a switch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Glitches {
    /// Since the start.
    pub count: u32,
    /// Device time of the last one, low 32 bits of us; 0 = none.
    pub last_us: u32,
}

/// Counters since the start of the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RigHealth {
    /// Home flag.
    pub home_flag: Glitches,
    /// Far limit.
    pub far_limit: Glitches,
    /// Receptions that ended with noise, framing error or overrun.
    pub uart_errors: u32,
    /// Frames with a bad checksum or length.
    pub bad_frames: u32,
    /// Events and telemetry that found the line busy and were not sent.
    pub unsent_frames: u32,
    /// Paths that ended because the queue of timer periods ran dry.
    pub underruns: u32,
    /// Highest use of the stack.
    pub stack_used: u32,
    /// Size of the stack.
    pub stack_size: u32,
    /// Longest time that the control task's 10 ms round was late.
    pub control_late_us: u32,
    /// Fingerprint of the image in flash: FNV-1a, 32 bits, over its words.
    pub image_hash: u32,
}

/// Asks for the record of the last run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GetRunRecord;

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RunOutcome {
    /// No run since the start of the device.
    None,
    /// Still going on.
    Running,
    /// All cycles executed.
    Complete,
    /// Stopped on request; the position is kept.
    Stopped,
    /// Ended by link loss; the position is kept.
    LinkLost,
    /// Ended by a fault.
    Faulted(RigFault),
}

/// Record of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RunRecord {
    /// Number of the run, as in [`RunAccepted`].
    pub run: u32,
    /// How it ended.
    pub outcome: RunOutcome,
    /// Completed strokes.
    pub strokes: u32,
    /// Steps that the generator emitted.
    pub commanded_edges: u64,
    /// Steps that the read-back counter saw at the pin.
    pub counted_edges: u64,
    /// Duration by the step timer, ticks of 10 ns, from the start, with the start delay, to the last step. The pause of a
    /// hold does not count; its ramps do.
    pub ticks: u64,
    /// Fingerprint of the plan.
    pub plan_hash: u64,
    /// Smallest commanded position.
    pub min_steps: i32,
    /// Largest commanded position.
    pub max_steps: i32,
    /// Largest residual of the position ledger at the home flag.
    pub worst_residual_steps: i32,
    /// Shortest queue of prepared timer periods seen; 0 would be an underrun.
    pub min_queue: u16,
    /// False pulses on the limit inputs that were filtered out.
    pub glitches: u32,
    /// How often it was held.
    pub holds: u32,
    /// Fingerprint of the image, as in [`RigHealth`].
    pub image_hash: u32,
}

/// Asks for the rig's status.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GetRigStatus;

/// State of the rig (design: "Rig states").
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RigState {
    /// The position is unknown: home first.
    Unhomed,
    /// Finding the reference.
    Homing,
    /// At rest at a known position.
    Ready,
    /// Executing a run.
    Running,
    /// Feed hold: at rest inside a run.
    Held,
    /// Decelerating.
    Stopping,
    /// A fault is latched.
    Faulted,
    /// Jog, or a move to a position.
    Moving,
}

/// Steps of homing, for the fault's text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
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

/// Why the rig latched a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RigFault {
    /// The E-stop and end-of-travel loop opened (or its wire is cut).
    EStopLoop,
    /// Emergency stop by frame.
    EStopFrame,
    /// The far limit opened while the carriage was moving away from home (or its wire is cut).
    FarLimit,
    /// Homing: the flag did not change within the allowed travel.
    FlagNotFound(HomingPhase),
    /// Homing: the flag stayed actuated over the whole pull-off.
    FlagStuck,
    /// Home flag and far limit are both open: a cable is unplugged.
    BothSwitchesOpen,
    /// The ledger at the home flag disagrees with the homing reference.
    LostSteps {
        /// Commanded minus found position.
        residual_steps: i32,
    },
    /// Emitted and counted steps disagree: jumper missing, or pulses damaged.
    ReadBack {
        /// By the generator.
        commanded: i32,
        /// By the counter.
        counted: i32,
    },
    /// The step generator ran out of prepared periods and stopped the pulses.
    Underrun,
    /// The step generator refused a step that would have left the window.
    WindowGuard,
    /// A task did not check in; the device was reset.
    Watchdog,
    /// The firmware panicked or hit a processor fault; the device was reset.
    Panic,
    /// Homing took longer than its time-out.
    HomingTimeout(HomingPhase),
}

/// State of the rig's inputs; true = open (actuated, or wire cut).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RigInputs {
    /// Home flag.
    pub home_flag: bool,
    /// Far limit.
    pub far_limit: bool,
    /// E-stop and end-of-travel loop.
    pub estop_loop: bool,
}

/// Status of the rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RigStatus {
    /// Device time.
    pub time_us: u64,
    /// State.
    pub state: RigState,
    /// The latched fault.
    pub fault: Option<RigFault>,
    /// The position can be trusted.
    pub homed: bool,
    /// Position by the read-back counter.
    pub position_steps: i32,
    /// The same in micrometres.
    pub position_um: i32,
    /// Configured stroke.
    pub stroke_um: u32,
    /// Steps of one revolution of the screw.
    pub steps_per_rev: u32,
    /// Lead of the screw.
    pub lead_um: u32,
    /// Inputs.
    pub inputs: RigInputs,
    /// Number of the present or last run.
    pub run: u32,
    /// Stroke in progress, from 0.
    pub stroke: u32,
    /// Strokes of the run.
    pub strokes: u32,
    /// Time since the run was accepted.
    pub elapsed_us: u64,
    /// Motion is refused until [`crate::system::Acknowledge`] after a watchdog reset or a panic.
    pub needs_acknowledge: bool,
}

/// What happened on the rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RigEvent {
    /// The position reference was found.
    Homed {
        /// Position at which the second pass met the flag, relative to the first pass.
        repeat_steps: i32,
        /// Shift of the reference against the previous homing, if the position was trusted.
        shift_steps: i32,
    },
    /// The first stroke began.
    RunStarted {
        /// Number of the run.
        run: u32,
    },
    /// A stroke was completed.
    StrokeDone {
        /// From 0.
        stroke: u32,
        /// Residual of the ledger: count at the last pass of the home flag minus the reference.
        residual_steps: i32,
    },
    /// The run ended.
    RunEnded {
        /// Number of the run.
        run: u32,
        /// How.
        outcome: RunOutcome,
    },
    /// The carriage came to rest after a stop.
    Stopped {
        /// Where.
        position_steps: i32,
    },
    /// A fault was latched.
    Faulted(RigFault),
    /// The run was held; the carriage stands.
    Held {
        /// Where.
        position_steps: i32,
    },
    /// The held run goes on.
    Resumed,
    /// A move or jog ended.
    Moved {
        /// Where.
        position_steps: i32,
    },
    /// A setting was changed.
    SettingChanged(SettingKey),
    /// All settings are at their defaults now.
    SettingsReset,
    /// The stored settings do not fit together or cannot be read: the defaults are in force.
    SettingsUnusable,
    /// The start button was pressed and nothing could be started.
    ButtonIgnored,
}

/// Telemetry of the rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RigTelemetry {
    /// Device time.
    pub time_us: u64,
    /// State.
    pub state: RigState,
    /// Position by the read-back counter.
    pub position_steps: i32,
    /// Position by the generator, as far as it has been handed to the timer.
    pub commanded_steps: i32,
    /// Mean speed since the previous telemetry.
    pub speed_um_s: i32,
    /// Stroke in progress, from 0.
    pub stroke: u32,
    /// Residual of the ledger at the last pass of the home flag.
    pub residual_steps: i32,
    /// Inputs.
    pub inputs: RigInputs,
}
