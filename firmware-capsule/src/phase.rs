//! One phase of a motion as data: a goal, a direction, a target by count, two speeds. One function judges where it
//! ends, one says how fast it goes. Between two phases the motor is shorted.

use crate::sample::Spooling;
use crate::settings::Settings;
use crate::speed::MOST_MA;
use crate::units::Thread;
use protocol::capsule::CapsuleFault;

/// Speed of winding where force or pull is measured: 3.5 mm/s. A hard end then stops the motor within 14 N.
const WIND_CPS: i32 = 2_852;
/// Speed of the last part of paying out: 2 mm/s.
const HOME_CPS: i32 = 1_630;
/// Length of the slow last part of a phase.
const SLOW: Thread = Thread(950);
/// Length before it, over which the speed falls: a motor that is braked would need as long to be steady again. A motor
/// that pays out at full speed coasts less than both if the power is cut.
const SLOWS_DOWN: Thread = Thread(350);
/// Way that is paid out and wound again to feel the thread: more than the play of gears and hysteresis.
pub const FELT: Thread = Thread(850);
/// A motor that stands this close before its target has arrived: more would make a fold too short.
const STANDS_SHORT: Thread = Thread(200);
/// An unfolding ends this far before zero: the run-out of the shorted motor must not be further off.
pub const HOME: Thread = Thread(40);
/// Largest current for paying out just before zero, mA: it bounds how far an uncounted motor gets.
const HOME_MA: u16 = 60;
/// Length of that part.
const HOME_ZONE: Thread = Thread(1_500);

/// What ends a phase.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Goal {
    /// The target by count.
    Arrive,
    /// The target by count, which is the folded end.
    Fold,
    /// The target by count, where the thread has been slackened to feel it.
    Slacken,
    /// The target by count, where the thread has been tightened again.
    Tighten,
    /// The end force. At the target there should have been one.
    Seek,
}

/// A phase.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Phase {
    /// What ends it.
    pub goal: Goal,
    /// Direction.
    pub spooling: Spooling,
    /// Where it ends.
    pub target: Thread,
    fast_cps: i32,
    slow_cps: i32,
}

impl Phase {
    /// A phase that begins at `from`. Force and pull are measured slowly.
    pub fn new(goal: Goal, from: Thread, target: Thread, settings: &Settings) -> Self {
        let pays_out = match goal {
            Goal::Slacken => true,
            Goal::Arrive => target <= from,
            Goal::Fold | Goal::Tighten | Goal::Seek => false,
        };
        let (fast_cps, slow_cps) = match goal {
            Goal::Arrive if pays_out => (settings.unfold_cps, HOME_CPS),
            Goal::Arrive | Goal::Fold => (settings.fold_cps, WIND_CPS),
            Goal::Slacken | Goal::Tighten | Goal::Seek => (WIND_CPS, WIND_CPS),
        };
        Self {
            goal,
            spooling: if pays_out {
                Spooling::PayOut
            } else {
                Spooling::Wind
            },
            target,
            fast_cps,
            slow_cps,
        }
    }

    /// Way that is left to the target.
    fn left(&self, thread: Thread) -> Thread {
        Thread(self.spooling.along((self.target - thread).0))
    }

    /// It ends before it begins.
    pub fn is_over(&self, thread: Thread) -> bool {
        self.left(thread) <= Thread(0)
    }

    /// Speed, counts/s, and largest current, mA, with this thread on the spool.
    pub fn aim(&self, thread: Thread) -> (i32, u16) {
        let beyond_um = (self.left(thread) - SLOW).0.clamp(0, SLOWS_DOWN.0);
        let cps = self.slow_cps + (self.fast_cps - self.slow_cps) * beyond_um / SLOWS_DOWN.0;
        let near_zero = self.spooling == Spooling::PayOut && thread < HOME_ZONE;
        (cps, if near_zero { HOME_MA } else { MOST_MA })
    }

    /// Judges where the phase is: true if it is over. `runs_on` is the way that the shorted motor runs on.
    ///
    /// # Errors
    /// Something holds the thread, or nothing does.
    pub fn judge(
        &self,
        thread: Thread,
        runs_on: Thread,
        (stands, end_force): (bool, bool),
        settings: &Settings,
    ) -> Result<bool, CapsuleFault> {
        let (shortest, _) = settings.folded_range;
        let left = self.left(thread);
        match self.goal {
            Goal::Seek if end_force || stands => match thread >= shortest {
                true => Ok(true),
                false => Err(CapsuleFault::NotUnfolded { wound_um: thread.0 }),
            },
            Goal::Seek if left <= Thread(0) => Err(CapsuleFault::SlipOrBreak),
            Goal::Seek => Ok(false),
            _ if left <= runs_on || stands && left <= STANDS_SHORT => Ok(true),
            _ if stands => Err(CapsuleFault::Jam {
                thread_um: thread.0,
            }),
            _ => Ok(false),
        }
    }
}
