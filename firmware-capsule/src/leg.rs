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
mod tests {
    use super::*;

    /// Anything but 0, so that counts and distances differ.
    const ZERO: Counts = Counts(-5_000);
    const ORIGIN: Counts = Counts(70_000);
    const FIRST: Leg = seek(false);
    const SECOND: Leg = seek(true);

    const fn seek(second: bool) -> Leg {
        Leg::Seek {
            origin: ORIGIN,
            second,
        }
    }

    /// The first count that reads `um` of thread from `from`.
    fn after(from: Counts, um: i32) -> Counts {
        let nearest = Counts(from.0 + Thread(um).counts().0);
        if nearest.since(from).thread() < Thread(um) {
            next(nearest)
        } else {
            nearest
        }
    }

    /// One count less: 1.2 um.
    fn before(counts: Counts) -> Counts {
        Counts(counts.0 - 1)
    }

    fn next(counts: Counts) -> Counts {
        Counts(counts.0 + 1)
    }

    const UNLOADED: Load = Load {
        end_force: false,
        engaged_at: None,
        rise_from: None,
    };
    const ENGAGED: Load = Load {
        engaged_at: Some(Counts(0)),
        ..UNLOADED
    };
    const END_FORCE: Load = Load {
        end_force: true,
        ..ENGAGED
    };

    fn decide(leg: Leg, counts: Counts, load: Load) -> Result<Decision, CapsuleFault> {
        leg.decide(counts, ZERO, load, Counts(0))
    }

    fn jam(counts: Counts) -> Result<Decision, CapsuleFault> {
        let thread_um = counts.since(ZERO).thread().0;
        Err(CapsuleFault::Jam { thread_um })
    }

    #[test]
    fn a_fold_ends_with_force_between_the_end_window_and_the_soft_maximum() {
        let window = after(ZERO, 20_000);
        let maximum = after(ZERO, 24_500);
        let fold = |counts, load| decide(Leg::Wind, counts, load);
        for load in [UNLOADED, ENGAGED] {
            for counts in [ZERO, before(window), window, before(maximum)] {
                assert_eq!(fold(counts, load), Ok(Decision::Continue));
            }
        }
        for counts in [ZERO, after(ZERO, 10_000), before(window)] {
            assert_eq!(fold(counts, END_FORCE), jam(counts));
        }
        for counts in [window, after(ZERO, 22_000), maximum] {
            assert_eq!(fold(counts, END_FORCE), Ok(Decision::Folded));
        }
        for counts in [maximum, next(maximum), after(maximum, 5_000)] {
            assert_eq!(fold(counts, UNLOADED), Err(CapsuleFault::ThreadBroken));
            assert_eq!(fold(counts, ENGAGED), Err(CapsuleFault::Timeout));
        }
        assert_eq!(fold(next(maximum), END_FORCE), Err(CapsuleFault::Timeout));
    }

    #[test]
    fn a_seek_is_limited_by_its_way_from_the_origin() {
        let limit = after(ORIGIN, 28_500);
        for leg in [FIRST, SECOND] {
            for load in [UNLOADED, ENGAGED] {
                // The soft maximum has no meaning here: the zero is arbitrary.
                for counts in [ORIGIN, after(ZERO, 24_500), before(limit)] {
                    assert_eq!(decide(leg, counts, load), Ok(Decision::Continue));
                }
            }
            let broken = Err(CapsuleFault::ThreadBroken);
            assert_eq!(decide(leg, limit, UNLOADED), broken);
            assert_eq!(decide(leg, limit, ENGAGED), Err(CapsuleFault::Timeout));
        }
    }

    #[test]
    fn half_a_millimetre_of_rise_makes_the_end_force_the_folded_end() {
        let here = after(ORIGIN, 9_000);
        let rising_for = |um| Load {
            rise_from: Some(here.back(after(Counts(0), um))),
            ..END_FORCE
        };
        let found = Ok(Decision::ZeroFound(here.back(Thread(21_500).counts())));
        let back_off = Ok(Decision::Reverse(Leg::BackOff {
            to: here.back(Thread(4_000).counts()),
            origin: ORIGIN,
        }));
        for (load, long_enough) in [
            (END_FORCE, false),
            (rising_for(0), false),
            (rising_for(499), false),
            (rising_for(500), true),
            (rising_for(2_000), true),
        ] {
            let (first, second) = if long_enough {
                (found, found)
            } else {
                (back_off, jam(here))
            };
            assert_eq!(decide(FIRST, here, load), first, "{load:?}");
            assert_eq!(decide(SECOND, here, load), second, "{load:?}");
        }
    }

    #[test]
    fn paying_out_ends_where_the_braked_motor_reaches_the_margin() {
        let to = Counts(3_000);
        let back_off = Leg::BackOff { to, origin: ORIGIN };
        for stopping_um in [0, 150] {
            let stopping = Thread(stopping_um).counts();
            for (leg, end, over) in [
                (Leg::PayOut, ZERO, Decision::Unfolded),
                (back_off, to, Decision::Reverse(SECOND)),
            ] {
                let last = after(end, stopping_um + 40);
                let decide = |counts, load| leg.decide(counts, ZERO, load, stopping);
                for counts in [after(end, 20_000), next(last)] {
                    assert_eq!(decide(counts, ENGAGED), Ok(Decision::Continue), "{leg:?}");
                }
                for counts in [last, end, after(end, -3_000)] {
                    assert_eq!(decide(counts, ENGAGED), Ok(over), "{leg:?}");
                }
                for counts in [after(end, 20_000), end] {
                    assert_eq!(decide(counts, END_FORCE), jam(counts), "{leg:?}");
                }
            }
        }
    }

    #[test]
    fn a_stopping_distance_beyond_all_bounds_ends_paying_out() {
        let far = after(ZERO, 20_000);
        let over = Leg::PayOut.decide(far, ZERO, UNLOADED, Counts(i32::MAX));
        assert_eq!(over, Ok(Decision::Unfolded));
    }

    #[test]
    fn force_is_met_gently_and_the_long_way_is_fast() {
        let back_off = Leg::BackOff {
            to: ZERO,
            origin: ORIGIN,
        };
        for (leg, spooling, until_18_mm, beyond) in [
            (FIRST, Spooling::Wind, 1_500, 1_500),
            (back_off, Spooling::PayOut, 1_500, 1_500),
            (SECOND, Spooling::Wind, 1_500, 1_500),
            (Leg::Wind, Spooling::Wind, 3_700, 1_500),
            (Leg::PayOut, Spooling::PayOut, 3_700, 3_700),
        ] {
            assert_eq!(leg.spooling(), spooling, "{leg:?}");
            for um in [-4_000, 0, 17_999] {
                assert_eq!(leg.drive_mv(Thread(um)), until_18_mm, "{leg:?} {um}");
            }
            for um in [18_000, 24_500] {
                assert_eq!(leg.drive_mv(Thread(um)), beyond, "{leg:?} {um}");
            }
        }
    }
}
