//! The commissioning steps of the rig. Those without motor power come first; nothing moves after a switch has failed
//! its step.

mod board;
mod depends;
mod runs;
mod switches;
mod travel;

use protocol::settings::SettingKey as Key;

use crate::commissioning::step::ProcedureStep;
use depends::{BRAKED, HOMING, PULSES, RUN, SCREW};

pub use travel::wrong_travel;

/// A step without settings and without anything to observe.
const PLAIN: ProcedureStep = ProcedureStep {
    name: "",
    shows: "",
    observe: "",
    of_image: true,
    settings: &[],
    needs_operator: true,
    check: board::image_is_the_one,
};

pub const STEPS: &[ProcedureStep] = &[
    ProcedureStep {
        name: "image",
        shows: "the image on the board is the one that was built; its last start did not fail",
        observe: "the LED blinks slowly: not homed",
        needs_operator: false,
        check: board::image_is_the_one,
        ..PLAIN
    },
    ProcedureStep {
        name: "clock",
        shows: "the board has its 8 MHz clock, and its clock goes as the host's",
        needs_operator: false,
        check: board::clock,
        ..PLAIN
    },
    ProcedureStep {
        name: "enable",
        shows: "EN is pulled up while the processor does not drive it: the driver is off",
        of_image: false,
        check: board::enable,
        ..PLAIN
    },
    ProcedureStep {
        name: "quiet",
        shows: "loop, home flag and far limit are quiet while nothing moves",
        settings: &[Key::SwitchFilterUs],
        needs_operator: false,
        check: switches::quiet,
        ..PLAIN
    },
    ProcedureStep {
        name: "e-stop",
        shows: "the E-stop button opens the loop, is latched, and closes it again",
        observe: "the LED blinks fast while the fault is latched",
        check: switches::e_stop,
        ..PLAIN
    },
    ProcedureStep {
        name: "home-end",
        shows: "the end-of-travel switch beyond home opens the loop",
        check: switches::home_end,
        ..PLAIN
    },
    ProcedureStep {
        name: "far-end",
        shows: "the end-of-travel switch beyond the far end opens the loop",
        check: switches::far_end,
        ..PLAIN
    },
    ProcedureStep {
        name: "home-flag",
        shows: "the home flag, and nothing else, opens while it is actuated",
        settings: &[Key::SwitchFilterUs],
        check: switches::home_flag,
        ..PLAIN
    },
    ProcedureStep {
        name: "far-limit",
        shows: "the far limit, and nothing else, opens while it is actuated",
        settings: &[Key::SwitchFilterUs],
        check: switches::far_limit,
        ..PLAIN
    },
    ProcedureStep {
        name: "pulses",
        shows: "homing without motor power: each step is counted, the flag is not found",
        observe: "on an oscilloscope STEP stays low after the last pulse",
        settings: HOMING,
        check: travel::pulses,
        ..PLAIN
    },
    ProcedureStep {
        name: "home",
        shows: "the motor turns the right way, and the carriage finds its flag",
        observe: "the carriage has to go to the RIGHT; a hand on the supply switch",
        settings: HOMING,
        check: travel::home,
        ..PLAIN
    },
    ProcedureStep {
        name: "travel",
        shows: "the carriage travels as far as the settings of screw and driver say",
        settings: &SCREW,
        check: travel::travel,
        ..PLAIN
    },
    ProcedureStep {
        name: "repeat",
        shows: "three more homings find the same place within 2 steps",
        settings: HOMING,
        check: travel::repeat,
        ..PLAIN
    },
    ProcedureStep {
        name: "read-back",
        shows: "without motor power, every step of many strokes is counted",
        settings: PULSES,
        check: runs::read_back,
        ..PLAIN
    },
    ProcedureStep {
        name: "edge-timing",
        shows: "the intervals between steps, timed at the pin, are those of the plan within 10 ns",
        settings: PULSES,
        check: runs::edge_timing,
        ..PLAIN
    },
    ProcedureStep {
        name: "e-stop-moving",
        shows: "the E-stop ends a run at once; releasing it moves nothing",
        settings: &SCREW,
        check: runs::e_stop_moving,
        ..PLAIN
    },
    ProcedureStep {
        name: "jumper",
        shows: "a read-back jumper that is pulled ends a run within a stroke",
        settings: &SCREW,
        check: runs::jumper,
        ..PLAIN
    },
    ProcedureStep {
        name: "cable",
        shows: "a cable that is pulled ends a run, and the board outlives it",
        observe: "the carriage stops after about link_timeout_ms",
        settings: &[
            Key::LinkTimeoutMs,
            Key::LeadUm,
            Key::FullSteps,
            Key::Microsteps,
            Key::StopAccelUmS2,
        ],
        check: runs::cable,
        ..PLAIN
    },
    ProcedureStep {
        name: "hold",
        shows: "a run that is held and resumed makes all its steps",
        settings: BRAKED,
        check: runs::hold,
        ..PLAIN
    },
    ProcedureStep {
        name: "jog",
        shows: "a jog that is not renewed stops, a move ends at its target",
        settings: &[
            Key::DeadManMs,
            Key::LeadUm,
            Key::FullSteps,
            Key::Microsteps,
            Key::StrokeUm,
            Key::HomingAccelUmS2,
            Key::StopAccelUmS2,
        ],
        check: runs::jog,
        ..PLAIN
    },
    ProcedureStep {
        name: "stroke",
        shows: "the whole stroke is free: far limit and end switches lie beyond it",
        observe: "nothing touches on the way",
        // The position of the flag defines position 0, from which the stroke counts.
        settings: &[
            Key::StrokeUm,
            Key::LeadUm,
            Key::FullSteps,
            Key::Microsteps,
            Key::FlagUm,
        ],
        check: travel::stroke,
        ..PLAIN
    },
    ProcedureStep {
        name: "run",
        shows: "the paper's run: all steps counted, none lost, nothing too late",
        settings: RUN,
        check: runs::run,
        ..PLAIN
    },
];
