//! One phase of a motion as data: a goal, a direction, a target by count, two speeds. One function judges where it
//! ends, one says how fast it goes. Between two phases the motor is shorted.

use crate::settings::Settings;
use crate::speed::MOST_MA;
use crate::units::{HOME, NEAR, SLOWS, Spooling, Thread};
use protocol::capsule::CapsuleFault;

/// Speed of winding where force or pull is measured: 3.5 mm/s. A hard end then stops the motor within 14 N.
const WIND_CPS: i32 = 2_852;
/// Speed of the last part of paying out: 2 mm/s.
const HOME_CPS: i32 = 1_630;
/// Length of the slow last part of a phase, and of thread that is paid out and wound again to feel it: more than the play
/// of gears and hysteresis.
const SLOW: Thread = Thread(850);
/// Largest current for paying out where an unfolding is slow, mA: it bounds how far an uncounted motor gets.
const HOME_MA: u16 = 60;

/// What a phase is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Goal {
    /// Wind until the end force comes.
    Seek,
    /// Go to a place.
    Place,
    /// Go back for the run-up of a fold, unless it has one.
    RunUp,
    /// Wind to the folded end.
    Fold,
    /// Slacken the thread, to feel it.
    Slacken,
    /// Tighten it again.
    Tighten,
    /// Pay out to the unfolded end.
    Home,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Phase {
    pub goal: Goal,
    pub spooling: Spooling,
    target: Thread,
    /// Far from the target, and near it, counts/s.
    speeds: (i32, i32),
}

impl Phase {
    /// A phase that begins at `from`. `top` is the place that the motion is about.
    pub fn new(goal: Goal, from: Thread, top: Thread, settings: &Settings) -> Self {
        let target = match goal {
            Goal::Seek => settings.folded_range.1,
            Goal::RunUp => from.min(top - SLOWS),
            Goal::Slacken => top - SLOW,
            Goal::Place | Goal::Fold | Goal::Tighten => top,
            Goal::Home => HOME,
        };
        let spooling = match target > from {
            true => Spooling::Wind,
            false => Spooling::PayOut,
        };
        let speeds = match (goal, spooling) {
            (Goal::Seek | Goal::Slacken | Goal::Tighten, _) => (WIND_CPS, WIND_CPS),
            (_, Spooling::Wind) => (settings.fold_cps, WIND_CPS),
            (_, Spooling::PayOut) => (settings.unfold_cps, HOME_CPS),
        };
        Self {
            goal,
            spooling,
            target,
            speeds,
        }
    }

    /// Way that remains to the target.
    pub fn remaining(&self, thread: Thread) -> Thread {
        Thread(self.spooling.along((self.target - thread).0))
    }

    /// Speed, counts/s, and largest current, mA, with this thread on the spool.
    pub fn aim(&self, thread: Thread) -> (i32, u16) {
        let ((fast_cps, slow_cps), ramp_um) = (self.speeds, (SLOWS - SLOW).0);
        let beyond_um = (self.remaining(thread) - SLOW).0.clamp(0, ramp_um);
        let cps = slow_cps + (fast_cps - slow_cps) * beyond_um / ramp_um;
        let near_zero = self.spooling == Spooling::PayOut && thread < SLOWS;
        (cps, if near_zero { HOME_MA } else { MOST_MA })
    }

    /// Judges where the phase is: true if it is over. The shorted motor runs on by `way`.
    ///
    /// # Errors
    /// Something holds the thread, or nothing does.
    pub fn judge(&self, thread: Thread, way: Thread, stands: bool) -> Result<bool, CapsuleFault> {
        let (remaining, thread_um) = (self.remaining(thread), thread.0);
        match self.goal {
            Goal::Seek if !stands && remaining <= Thread(0) => Err(CapsuleFault::SlipOrBreak),
            Goal::Seek => Ok(stands),
            _ if remaining <= way || stands && remaining <= NEAR => Ok(true),
            _ if stands => Err(CapsuleFault::Jam { thread_um }),
            _ => Ok(false),
        }
    }
}
