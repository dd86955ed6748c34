//! The legs of a motion: how fast each one is, and where it ends.
//!
//! # How the zero is found
//!
//! Paying out can be counted but not felt: behind the worm gear, a slack thread and one that has wound itself
//! backwards onto the spool look the same. The sharp mark is the other end, where the force grows by 3 N per mm and
//! more. How far that is from the unfolded end depends on the stiffness of the origami, so it is measured once per
//! capsule: a person says "this is unfolded" ([`Purpose::Calibrate`]), and the run winds slowly to the end force and pays
//! out exactly what it wound. From then on a reference run winds to the same force and pays out the length that is
//! known; it ends unfolded, wherever it began.
//!
//! An obstacle stops the thread with the end force, too. If it were taken for the folded end, the run would pay out
//! past zero by the thread that was not wound. The rise tells the two apart: the thread from half of the end force to all of it, and that from a
//! quarter, have to be those of the calibration. What something soft in the way can hide in that is [`FOUND_BY_RISE`](crate::mechanics::FOUND_BY_RISE), and
//! so much before its zero does such a run believe the thread to end. A rise that is too short may also mean
//! that the origami was folded from the start, so a reference run backs off and tries once more; the
//! second try decides. It backs off by [`BACK_OFF`] at a time, and only while it then feels, winding, that the thread still pulls: a thread that
//! pulls is past its slack, and further from zero than that. A check never pays out past where it began.
//!
//! # Folded is not a force alone
//!
//! A fold ends on force, but it is folded only where the calibration says, within [`Settings::end_tolerance`]: an
//! obstacle in the last millimetres has force and rise of the right kind, and is short. That is called a jam. Beyond
//! the calibrated end, by [`Settings::end_overrun`], the thread is broken or has slipped.
//!
//! # Speeds
//!
//! A thread that catches has to stop the motor, and the motor's own momentum pulls with 27 N at its no-load speed, whatever
//! the current does; so winding is bounded to [`Settings::fold_cps`]: at 13.5 mm/s a jam in the last
//! 2 mm reaches 20.8 N, at 12.9 mm/s 19.6 N. Paying out is bounded by what the motor would coast if the power were
//! cut: it must stand before zero without a brake.

use crate::calibration::Calibration;
use crate::detect::Load;
use crate::governor::Aim;
use crate::mechanics::{BACK_OFF, BACK_OFFS, COASTING_CPS2_PER_MA, Counts, LEAST_RISE, Thread};
use crate::sample::Spooling;
use crate::settings::Settings;
use protocol::capsule::CapsuleFault;

/// Above the no-load current: from this pull on, a fold becomes slower, so that pull and momentum together do not grow. It
/// ends a fold with less current than one that keeps its speed.
const LOADED_FROM_MA: u16 = 68;
/// The last of paying out: 2 mm/s.
const LAST_CPS: i32 = 1_600;
/// A fold is slow for this much before its calibrated end: 0.25 mm to become slow, and the zone in which its force is compared with
/// the calibration's, which was as slow.
pub const SLOW_ZONE: Thread = Thread(600);
/// The first of an unfolding is slow, so that its current tells whether the thread pulls. What it takes to start the motor
/// is almost gone by then.
pub const TENSION_ZONE: Thread = Thread(700);
/// A leg that pays out is braked so that the motor stops this far before its end. The stopping distance, 0.01 mm at
/// 2 mm/s, must be predicted to within this.
pub const STOP_MARGIN: Thread = Thread(40);
/// Most current: it accelerates the motor to full speed within 20 ms, and is what a cell of 40 mAh likes to give.
pub const MOST_MA: u16 = 220;
/// Most current above the no-load current where force ends the leg: 8.5 N, 11.3 N with the least friction.
const FORCE_LIMIT_MA: u16 = 200;
/// Most current for the last of paying out: what a lost encoder could do there is bounded by it.
const LAST_LIMIT_MA: u16 = 60;
/// The last of paying out.
const LAST_ZONE: Thread = Thread(1_500);

/// What a run to the folded end is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// To measure how far it is; it began unfolded.
    Calibrate,
    /// To find the zero.
    Reference,
    /// To see whether it is folded; `believed` if nothing has moved since it was.
    Check {
        /// The last motion that is known of ended folded.
        believed: bool,
    },
}

/// What follows when the pull has been felt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Then {
    /// The thread is paid out to here.
    PayOut(Thread),
    /// A reference run backs off further, if the thread pulls, and else tries again.
    BackOff {
        /// Where it began.
        origin: Counts,
        /// So often.
        left: u8,
    },
}

/// How far it was from shares of the end force to all of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rise {
    /// From half.
    pub half: Thread,
    /// From a quarter.
    pub quarter: Thread,
}

impl Rise {
    fn to(counts: Counts, load: &Load) -> Self {
        let since =
            |from: Option<Counts>| from.map_or(Thread(0), |from| counts.since(from).thread());
        Self {
            half: since(load.rise_from),
            quarter: since(load.long_rise_from),
        }
    }

    /// It is that of the calibrated origami: within a quarter of it, and as much longer from a quarter as it was, to an eighth. What rises along
    /// a straight line has the half's rise and half as much again; the origami's grows by more than as much again.
    pub fn is_of(self, calibration: &Calibration) -> bool {
        let (half, quarter) = (i64::from(self.half.0), i64::from(self.quarter.0));
        let (known, long) = (
            i64::from(calibration.rise.0),
            i64::from(calibration.long_rise.0),
        );
        (half - known).abs() * 4 <= known && quarter * known * 8 >= 7 * long * half
    }
}

/// Part of a motion with one direction and one end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leg {
    /// Wind slowly to the end force.
    Seek {
        /// Where the run began.
        origin: Counts,
        /// The second try, after a back-off.
        second: bool,
        /// What for.
        purpose: Purpose,
    },
    /// Pay out a little, to measure the rise on a second try.
    BackOff {
        /// Where to stop.
        to: Counts,
        /// Where the reference run began.
        origin: Counts,
        /// So often again.
        left: u8,
    },
    /// Wind a little, to feel whether the thread pulls.
    Feel {
        /// Where from.
        from: Counts,
        /// What for.
        then: Then,
    },
    /// Wind to the end force, for the fold.
    Wind {
        /// Thread at the calibrated end.
        end: Thread,
        /// Something resisted on the way: slow from there.
        careful: bool,
        /// Stop here instead, before the end.
        short: Option<Thread>,
    },
    /// Pay out to zero, or not so far.
    PayOut {
        /// Where to stop.
        to: Thread,
        /// The thread is taut down to here.
        taut_to: Option<Thread>,
    },
}

/// What one sample means for a leg.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// The leg goes on.
    Continue,
    /// The leg is over; the motion goes on with this one.
    Reverse(Leg),
    /// The pull was felt: the motion goes on with this one, the other way.
    Felt(Leg),
    /// The leg goes on like this one.
    Careful(Leg),
    /// The end force is that of the folded origami: `wound` from the origin, `rise` from half of the end force.
    EndFound {
        /// Since the run began.
        wound: Thread,
        /// Since shares of the end force.
        rise: Rise,
        /// What it was looked for.
        purpose: Purpose,
    },
    /// Folded.
    Folded,
    /// Paid out to zero.
    Unfolded,
    /// Where a partial fold was to stop.
    Arrived,
}

/// Least speed at which the motor, coasting with this no-load current, ends so many counts further. A quarter less
/// friction than measured is allowed for.
fn coasting_cps(counts: i32, no_load_ma: u16) -> i32 {
    let deceleration = u64::from(COASTING_CPS2_PER_MA) * u64::from(no_load_ma) * 3 / 4;
    let square = 2 * deceleration * u64::from(counts.max(0).unsigned_abs());
    i32::try_from(square.isqrt()).unwrap_or(i32::MAX)
}

/// With so much current above the no-load current, the end force is near; it `was` so before.
pub fn is_near(was: bool, excess_ma: u16, settings: &Settings) -> bool {
    let (from_ma, to_ma) = settings.near_ma;
    excess_ma >= if was { to_ma } else { from_ma }
}

impl Leg {
    /// Which way the spool turns.
    pub fn spooling(self) -> Spooling {
        match self {
            Leg::Seek { .. } | Leg::Feel { .. } | Leg::Wind { .. } => Spooling::Wind,
            Leg::BackOff { .. } | Leg::PayOut { .. } => Spooling::PayOut,
        }
    }

    /// Speed and current with `thread` on the spool; `near` is [`is_near`].
    pub fn aim(self, thread: Thread, no_load_ma: u16, near: bool, settings: &Settings) -> Aim {
        let slow = Aim {
            cps: if near {
                settings.near_cps
            } else {
                settings.slow_cps
            },
            limit_ma: no_load_ma.saturating_add(FORCE_LIMIT_MA),
            held_ma: MOST_MA,
        };
        match self {
            Leg::Seek { .. } | Leg::BackOff { .. } => slow,
            Leg::Feel { .. } => Aim {
                cps: settings.near_cps,
                ..slow
            },
            Leg::Wind {
                end,
                careful,
                short,
            } if careful || thread.0 >= short.unwrap_or(end).0 - SLOW_ZONE.0 => slow,
            Leg::Wind { .. } => Aim {
                cps: settings.fold_cps,
                limit_ma: MOST_MA,
                held_ma: no_load_ma.saturating_add(LOADED_FROM_MA),
            },
            Leg::PayOut {
                taut_to: Some(taut_to),
                ..
            } if thread > taut_to => Aim {
                cps: settings.slow_cps,
                limit_ma: MOST_MA,
                held_ma: MOST_MA,
            },
            Leg::PayOut { to, .. } => {
                let left = Thread(thread.0.saturating_sub(to.0));
                let counts = Thread(left.0.saturating_sub(STOP_MARGIN.0)).counts().0;
                let limit_ma = if left < LAST_ZONE {
                    LAST_LIMIT_MA
                } else {
                    MOST_MA
                };
                Aim {
                    cps: coasting_cps(counts, no_load_ma).clamp(LAST_CPS, settings.pay_out_cps),
                    limit_ma,
                    held_ma: limit_ma,
                }
            }
        }
    }

    /// Judges the leg at `counts`. `zero` is the count of thread zero, `stopping` the distance that the motor runs
    /// on if it is braked now.
    ///
    /// # Errors
    /// A jam, or a thread that is broken or has slipped.
    pub fn decide(
        self,
        counts: Counts,
        zero: Counts,
        load: Load,
        stopping: Counts,
        (calibration, settings): (Option<&Calibration>, &Settings),
    ) -> Result<Decision, CapsuleFault> {
        let thread = counts.since(zero).thread();
        let stop_within = Thread(stopping.thread().0.saturating_add(STOP_MARGIN.0));
        let jam = CapsuleFault::Jam {
            thread_um: thread.0,
        };
        // Past the last possible end: without load the thread is broken; with load there is more of it than there was.
        let past_the_end = match load.excess_ma {
            Some(excess_ma) if excess_ma >= LOADED_MA => CapsuleFault::SpoolSlip,
            _ => CapsuleFault::ThreadBroken,
        };
        Ok(match self {
            Leg::Wind { end, .. } if load.end_force => {
                if thread.0 < end.0 - settings.end_tolerance.0 {
                    return Err(jam);
                }
                Decision::Folded
            }
            Leg::Wind {
                short: Some(short), ..
            } if thread.0.saturating_add(stop_within.0) >= short.0 => Decision::Arrived,
            Leg::Wind { end, .. } if thread.0 >= end.0 + settings.end_overrun.0 => {
                return Err(past_the_end);
            }
            Leg::Wind {
                end,
                careful: false,
                short,
            } if load.resisted => Decision::Careful(Leg::Wind {
                end,
                careful: true,
                short,
            }),
            Leg::Wind { .. } => Decision::Continue,
            Leg::Seek {
                origin,
                second,
                purpose,
            } if load.end_force => {
                let wound = counts.since(origin).thread();
                let rise = Rise::to(counts, &load);
                let right = match (purpose, calibration) {
                    (Purpose::Check { believed: true }, _) => true,
                    (Purpose::Reference | Purpose::Check { .. }, Some(calibration)) => {
                        rise.is_of(calibration)
                    }
                    _ => rise.half >= LEAST_RISE,
                };
                if right {
                    Decision::EndFound {
                        wound,
                        rise,
                        purpose,
                    }
                } else if second || purpose != Purpose::Reference {
                    return Err(jam);
                } else {
                    // It pulls with the end force.
                    Decision::Reverse(Leg::BackOff {
                        to: counts.back(BACK_OFF.counts()),
                        origin,
                        left: BACK_OFFS,
                    })
                }
            }
            Leg::Feel { from, then } => {
                let way = counts.since(from).thread();
                let felt = load.excess_ma.is_some() && way >= FELT_AFTER;
                let past = calibration.is_some_and(|calibration| {
                    thread.0 >= calibration.folded.0 + settings.end_overrun.0 - STOP_MARGIN.0
                });
                if !felt && !load.end_force && !past && way < FELT_AT_MOST {
                    return Ok(Decision::Continue);
                }
                self.felt(counts, thread, load.end_force || pulls(&load), then)
            }
            Leg::Seek {
                origin,
                purpose: Purpose::Calibrate,
                ..
            } if counts.since(origin).thread() > settings.folded_range.1 => {
                return Err(past_the_end);
            }
            Leg::Seek { origin, .. } if counts.since(origin).thread() >= settings.seek_limit() => {
                return Err(past_the_end);
            }
            Leg::Seek { .. } => Decision::Continue,
            Leg::BackOff { to, origin, left } if counts.since(to).thread() <= stop_within => {
                let then = Then::BackOff { origin, left };
                Decision::Reverse(Leg::Feel { from: counts, then })
            }
            Leg::PayOut { to, .. } if thread.0 - to.0 <= stop_within.0 => match to {
                Thread(0) => Decision::Unfolded,
                _ => Decision::Arrived,
            },
            Leg::BackOff { .. } | Leg::PayOut { .. } => Decision::Continue,
        })
    }
}

impl Leg {
    /// What follows when it has been felt whether the thread `pulls`.
    pub fn felt(self, counts: Counts, thread: Thread, pulls: bool, then: Then) -> Decision {
        match then {
            Then::PayOut(to) => Decision::Felt(Leg::PayOut {
                to,
                taut_to: Some(Thread(thread.0.saturating_sub(TENSION_ZONE.0))),
            }),
            Then::BackOff { origin, left } if pulls && left > 0 => {
                Decision::Reverse(Leg::BackOff {
                    to: counts.back(BACK_OFF.counts()),
                    origin,
                    left: left - 1,
                })
            }
            Then::BackOff { origin, .. } => Decision::Careful(Leg::Seek {
                origin,
                second: true,
                purpose: Purpose::Reference,
            }),
        }
    }
}

fn pulls(load: &Load) -> bool {
    load.excess_ma
        .is_some_and(|excess_ma| excess_ma >= LOADED_MA)
}

/// A thread that pulls with 0.5 N, at least.
const LOADED_MA: u16 = 12;
/// The pull can be felt from here on, once the motor is steady; and at the latest here.
const FELT_AFTER: Thread = Thread(120);
const FELT_AT_MOST: Thread = Thread(300);

#[cfg(test)]
#[path = "../tests/unit/leg.rs"]
mod tests;
