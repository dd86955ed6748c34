//! The legs of a motion: how each one is driven and where it ends.
//!
//! # How the zero is found
//!
//! Paying out can be counted but not felt: behind the worm gear, a slack thread and one that has wound itself
//! backwards onto the spool look the same. First contact is no sharp mark either: by the beam estimate of the
//! origami the current rises by 0.3 of the no-load current (0.2 N) only about 9 mm after the slack has ended, and
//! friction moves that point more than the thread does. So the engagement is recorded, but nothing refers to it. The
//! sharp mark is the other end: at [`FORCE_MA`](crate::mechanics::FORCE_MA) the force grows by about 5 N per mm, so
//! an error of 10 % in the current is 0.15 mm of thread. A reference run therefore winds slowly to the same force
//! at the same voltage as a fold, calls that point [`FOLDED`], and pays out exactly that much. It ends unfolded, wherever
//! it began.
//!
//! An obstacle stops the thread with the end force, too. If it were taken for the folded end, the run would pay out
//! past zero by the thread that was not wound. The rise tells the two apart: from 3 N to the end force the origami
//! takes at least [`LEAST_RISE`] of thread, an obstacle almost none. A rise that is too short may also mean that the
//! origami was folded from the start, so the run backs off by [`BACK_OFF`] and tries once more; the second try
//! decides. Only a thread that catches within the first 4 mm is paid out too far by that, by the part of the 4 mm
//! that was not wound; [`SEEK_LIMIT`] allows for it.
//!
//! # Zero after a fold
//!
//! If a fold reaches the end force beyond [`FOLDED`], that point becomes the new [`FOLDED`]; before it, the zero
//! stays. So the next unfold pays out the shorter of two estimates, and the slack takes up what remains wound.

use crate::{
    detect::{Load, Spooling},
    mechanics::{
        BACK_OFF, Counts, END_WINDOW, FOLDED, LEAST_RISE, SEEK_LIMIT, SOFT_MAXIMUM, Thread,
    },
};
use protocol::capsule::CapsuleFault;

/// Drive over the long way.
pub const FAST_MV: u16 = 3_700;
/// Drive where force ends the leg: the motor stalls at 11 N.
pub const GENTLE_MV: u16 = 1_500;
/// A fold is gentle from here on.
pub const GENTLE_FROM: Thread = Thread(18_000);
/// A leg that pays out is braked so that the motor stops this far before its end. The stopping distance, 0.15 mm at
/// 20 mm/s, must be predicted to within this.
pub const STOP_MARGIN: Thread = Thread(40);

/// Part of a motion with one direction and one end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leg {
    /// Wind to the end force, for the reference.
    Seek {
        /// Where the reference run began.
        origin: Counts,
        /// The second try, after a back-off.
        second: bool,
    },
    /// Pay out a little, to measure the rise on a second try.
    BackOff {
        /// Where to stop.
        to: Counts,
        /// Where the reference run began.
        origin: Counts,
    },
    /// Wind to the end force, for the fold.
    Wind,
    /// Pay out to zero.
    PayOut,
}

/// What one sample means for a leg.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// The leg goes on.
    Continue,
    /// The leg is over; the motion goes on with this one.
    Reverse(Leg),
    /// The end force is that of the folded origami, so the thread's zero is here; pay out to it.
    ZeroFound(Counts),
    /// Folded.
    Folded,
    /// Paid out to zero.
    Unfolded,
}

impl Leg {
    /// Which way the spool turns.
    pub fn spooling(self) -> Spooling {
        match self {
            Leg::Seek { .. } | Leg::Wind => Spooling::Wind,
            Leg::BackOff { .. } | Leg::PayOut => Spooling::PayOut,
        }
    }

    /// Magnitude of the drive with `thread` on the spool.
    pub fn drive_mv(self, thread: Thread) -> u16 {
        match self {
            Leg::Wind if thread < GENTLE_FROM => FAST_MV,
            Leg::PayOut => FAST_MV,
            Leg::Seek { .. } | Leg::BackOff { .. } | Leg::Wind => GENTLE_MV,
        }
    }

    /// Judges the leg at `counts`. `zero` is the count of thread zero, `stopping` the distance that the motor runs
    /// on if it is braked now.
    ///
    /// # Errors
    /// A jam, or a thread that is broken or longer than the count says.
    pub fn decide(
        self,
        counts: Counts,
        zero: Counts,
        load: Load,
        stopping: Counts,
    ) -> Result<Decision, CapsuleFault> {
        let thread = counts.since(zero).thread();
        let stop_within = Thread(stopping.thread().0.saturating_add(STOP_MARGIN.0));
        let jam = CapsuleFault::Jam {
            thread_um: thread.0,
        };
        // Past the last possible end: without load the thread is broken; with load it is longer than the count
        // says, and a new reference run helps.
        let past_the_end = if load.engaged_at.is_some() {
            CapsuleFault::Timeout
        } else {
            CapsuleFault::ThreadBroken
        };
        Ok(match self {
            Leg::Wind if load.end_force && thread >= END_WINDOW && thread <= SOFT_MAXIMUM => {
                Decision::Folded
            }
            Leg::Wind if thread >= SOFT_MAXIMUM => return Err(past_the_end),
            Leg::Wind if load.end_force => return Err(jam),
            Leg::Wind => Decision::Continue,
            Leg::Seek { origin, second } if load.end_force => {
                let rise = load
                    .rise_from
                    .map_or(Thread(0), |from| counts.since(from).thread());
                if rise >= LEAST_RISE {
                    Decision::ZeroFound(counts.back(FOLDED.counts()))
                } else if second {
                    return Err(jam);
                } else {
                    Decision::Reverse(Leg::BackOff {
                        to: counts.back(BACK_OFF.counts()),
                        origin,
                    })
                }
            }
            Leg::Seek { origin, .. } if counts.since(origin).thread() >= SEEK_LIMIT => {
                return Err(past_the_end);
            }
            Leg::Seek { .. } => Decision::Continue,
            Leg::BackOff { .. } | Leg::PayOut if load.end_force => return Err(jam),
            Leg::BackOff { to, origin } if counts.since(to).thread() <= stop_within => {
                Decision::Reverse(Leg::Seek {
                    origin,
                    second: true,
                })
            }
            Leg::PayOut if thread <= stop_within => Decision::Unfolded,
            Leg::BackOff { .. } | Leg::PayOut => Decision::Continue,
        })
    }
}

#[cfg(test)]
#[path = "../tests/unit/leg.rs"]
mod tests;
