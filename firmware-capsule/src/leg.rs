//! The legs of a motion: the speed of each, and where it ends.
//!
//! # How the zero is found
//!
//! Paying out can be counted but not felt: behind the worm gear, a slack thread and one that has wound itself
//! backwards onto the spool look the same. The sharp mark is the other end, where the force grows by at least 3 N per
//! mm. Its distance from the unfolded end depends on the stiffness of the origami, so each capsule is calibrated
//! once. A person says "this is unfolded" ([`Purpose::Calibrate`]); the run winds slowly to the end force and pays
//! out exactly what it wound. A reference run later winds to the same force and pays out the known length, so it ends
//! unfolded wherever it began.
//!
//! An obstacle stops the thread with the end force, too. A run that took it for the folded end would pay out past
//! zero by the thread that it had not wound. The rise tells the two apart: the lengths from half and from a quarter
//! of the end force to all of it must match the calibration. Something soft in the way can still hide an error of
//! [`FOUND_BY_RISE`](crate::mechanics::FOUND_BY_RISE), so such a run pays out less by that.
//!
//! A rise that is too short may also mean that the origami was folded from the start. A reference run then backs off
//! and tries once more; the second try decides. It backs off by [`BACK_OFF`] at a time, and only while it feels,
//! winding, that the thread still pulls: such a thread is past its slack, and further from zero than `BACK_OFF`. A
//! check without a reference pays nothing out.
//!
//! # Folded is not a force alone
//!
//! A fold ends on force, but it is folded only where the calibration says, within [`Settings::end_tolerance`]. An
//! obstacle in the last millimetres has a similar force and rise, but ends the fold short: that is a jam. Beyond the
//! calibrated end, by [`Settings::end_overrun`], the thread is broken or has slipped.
//!
//! # Speeds
//!
//! A thread that catches has to stop the motor. At no-load speed the motor's momentum alone pulls with 27 N, whatever
//! the current. So [`Settings::fold_cps`] limits winding: at 13.5 mm/s a jam in the last 2 mm reaches 20.8 N, at 12.9
//! mm/s 19.6 N. Paying out is limited by coasting: if the power is cut, the motor must stop before zero without a
//! brake.

use crate::calibration::Calibration;
use crate::detect::Load;
use crate::governor::Aim;
use crate::mechanics::{BACK_OFF, BACK_OFFS, COASTING_CPS2_PER_MA, Counts, LEAST_RISE, Thread};
use crate::sample::Spooling;
use crate::settings::Settings;
use protocol::capsule::CapsuleFault;

/// Current above the no-load current from which a fold slows down, so that pull and momentum do not add up. A slow
/// fold also ends with less current than a fast one. With 68 mA the nominal fold took 1.984 to 2.001 s, with 72 it
/// takes 1.973 to 1.993 s, at the same largest force of a catch.
const LOADED_FROM_MA: u16 = 72;
/// Speed of the last part of paying out, counts/s: 2 mm/s.
const LAST_CPS: i32 = 1_600;
/// Slow part of a fold before its calibrated end: 0.25 mm to slow down, then the range in which its force is compared
/// with that of the equally slow calibration.
pub const SLOW_ZONE: Thread = Thread(600);
/// Slow first part of an unfolding, in which the current tells whether the thread pulls. The extra current for
/// starting the motor fades within it.
pub const TENSION_ZONE: Thread = Thread(700);
/// A leg that pays out brakes so that the motor stops this far before its end. The predicted stopping distance, 0.01
/// mm at 2 mm/s, must not be further off than this.
pub const STOP_MARGIN: Thread = Thread(40);
/// Largest current, mA: accelerates the motor to full speed within 20 ms, and suits a cell of 40 mAh.
pub const MOST_MA: u16 = 220;
/// Largest current above the no-load current where force ends the leg, mA: 8.5 N, 11.3 N with the least friction.
const FORCE_LIMIT_MA: u16 = 200;
/// Largest current for paying out just before zero, mA: limits the damage if the encoder is lost there.
const LAST_LIMIT_MA: u16 = 60;
/// Length of that part.
const LAST_ZONE: Thread = Thread(1_500);
/// Highest place at which an unfolding ends, and where zero may be by now: all that is doubted of the count.
pub const HIGHEST_ZERO: Thread = Thread(2_000);

/// Purpose of a run to the folded end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Measure the distance from the unfolded start.
    Calibrate,
    /// Find the zero.
    Reference,
    /// See whether the capsule is folded.
    Check {
        /// The last known motion ended folded, and nothing has moved since.
        believed: bool,
    },
}

/// Continuation once the pull has been felt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Then {
    /// Pay out to this thread length.
    PayOut {
        /// Where to stop.
        to: Thread,
        /// Tries left, should there be no reading.
        left: u8,
    },
    /// Back off further if the thread pulls; otherwise try again to find the end.
    BackOff {
        /// Where the reference run began.
        origin: Counts,
        /// Back-offs left.
        left: u8,
    },
}

/// Lengths of thread over which the force rose to the end force.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rise {
    /// From half of the end force.
    pub half: Thread,
    /// From a quarter of the end force.
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

    /// The rise matches the calibrated origami: from half of the force within a quarter of its length. From a quarter
    /// of the force, its length over that from half may fall short of the calibrated ratio by an eighth. A linear
    /// rise has a ratio of 1.5; the origami's is above 2.
    ///
    /// Friction that has changed since the calibration moves the end force to where the origami is flatter, or before
    /// its hard end, and lengthens the rise by up to a third. A run that has `wound` almost all of the calibrated way
    /// may have such a rise. Something in the way shortens the rise there, and so stays a jam. Less friction shortens it,
    /// too, to 0.71 of the calibrated one at 0.7 times the friction. It is believed `past_the_end` only, where the origami
    /// was before. If that end is itself too early, the margin covers it: this run pays out only what it has wound.
    ///
    /// A calibration that felt its quarter early, from a snap or an early pull, has a larger ratio than later runs of
    /// the same capsule. Above 2.2 it is compared as 2.2, which still tells the origami from a line.
    pub fn is_of(self, calibration: &Calibration, wound: Thread, past_the_end: bool) -> bool {
        let (half, quarter) = (i64::from(self.half.0), i64::from(self.quarter.0));
        let known = i64::from(calibration.rise.0);
        let long = i64::from(calibration.long_rise.0).min(known * 22 / 10);
        // In 32nds.
        let (least, most, least_ratio) = match wound.0 >= calibration.folded.0 - FRICTION_MOVES.0 {
            true if past_the_end => (20, 44, 25),
            true => (24, 44, 25),
            false => (24, 40, 28),
        };
        (known * least..=known * most).contains(&(half * 32))
            && quarter * known * 32 >= least_ratio * long * half
    }
}

/// Most thread that a folded capsule winds to its end force in a check: it has crept and slackened by less. One that
/// winds more may not be folded, whatever the flash says, and has to show the rise of the origami, too.
const STILL_FOLDED: Thread = Thread(3_000);

/// Part of a motion with one direction and one end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leg {
    /// Wind slowly to the end force.
    Seek {
        /// Where the run began.
        origin: Counts,
        /// The second try, after a back-off.
        second: bool,
        /// Purpose of the run.
        purpose: Purpose,
    },
    /// Pay out a little, to have room for winding and feeling.
    BackOff {
        /// Where to stop.
        to: Counts,
        /// Continuation once the pull is known.
        then: Then,
    },
    /// Wind a little, to feel whether the thread pulls.
    Feel {
        /// Where the leg began.
        from: Counts,
        /// Continuation once the pull is known.
        then: Then,
    },
    /// Wind to the end force for a fold.
    Wind {
        /// Thread at the calibrated end.
        end: Thread,
        /// Something has resisted on the way: stay slow from now on.
        careful: bool,
        /// Target of a partial winding, before the end.
        short: Option<Thread>,
    },
    /// Pay out to zero or to a partial target.
    PayOut {
        /// Where to stop.
        to: Thread,
        /// The thread is taut down to here.
        taut_to: Option<Thread>,
    },
}

/// Consequence of one sample for a leg.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// The leg goes on.
    Continue,
    /// The leg is over. The motion continues with this one.
    Reverse(Leg),
    /// The pull has been felt. The motion continues with this leg, in the other direction.
    Felt(Leg),
    /// The leg continues as this one.
    Careful(Leg),
    /// The end force is that of the folded origami.
    EndFound {
        /// Thread wound since the run began.
        wound: Thread,
        /// Rise to the end force.
        rise: Rise,
        /// Purpose of the run.
        purpose: Purpose,
    },
    /// Folded.
    Folded,
    /// Paid out to zero.
    Unfolded,
    /// A partial motion has reached its target.
    Arrived,
}

impl Decision {
    /// The motion goes on, in this leg or in another.
    pub fn goes_on(&self) -> bool {
        matches!(
            self,
            Self::Continue | Self::Reverse(_) | Self::Felt(_) | Self::Careful(_)
        )
    }
}

/// Lowest speed at which a motor with this no-load current coasts over this many counts. Allows for a quarter less
/// friction than measured.
fn coasting_cps(counts: i32, no_load_ma: u16) -> i32 {
    let deceleration = u64::from(COASTING_CPS2_PER_MA) * u64::from(no_load_ma) * 3 / 4;
    let square = 2 * deceleration * u64::from(counts.max(0).unsigned_abs());
    i32::try_from(square.isqrt()).unwrap_or(i32::MAX)
}

/// The end force is near at this current above the no-load current. `was`: the previous result (hysteresis).
pub fn is_near(was: bool, excess_ma: u16, settings: &Settings) -> bool {
    let (from_ma, to_ma) = settings.near_ma;
    excess_ma >= if was { to_ma } else { from_ma }
}

impl Leg {
    /// Feels the pull, then pays out to `to`.
    pub fn feel(from: Counts, to: Thread) -> Self {
        let then = Then::PayOut { to, left: FEELS };
        Self::Feel { from, then }
    }

    /// Direction of the spool.
    pub fn spooling(self) -> Spooling {
        match self {
            Leg::Seek { .. } | Leg::Feel { .. } | Leg::Wind { .. } => Spooling::Wind,
            Leg::BackOff { .. } | Leg::PayOut { .. } => Spooling::PayOut,
        }
    }

    /// The tension of the thread is still to be measured.
    pub fn measures_tension(self) -> bool {
        matches!(
            self,
            Leg::PayOut {
                taut_to: Some(_),
                ..
            }
        )
    }

    /// Speed and current for `thread` on the spool. `near` is the result of [`is_near`].
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
                // A partial target may lie where the thread pulls, and the motor stands there with so little.
                let zero_um = to.0.min(HIGHEST_ZERO.0);
                let limit_ma = if thread.0.saturating_sub(zero_um) < LAST_ZONE.0 {
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

    /// Judges the leg at `counts`. `zero` is the count of thread zero; `stopping` is the distance that the motor runs
    /// on if it is braked now; `known` is the calibration, and
    /// where its folded end is by now, if the zero is known.
    ///
    /// # Errors
    /// A jam, or a thread that is broken, has slipped, or cannot be felt.
    pub fn decide(
        self,
        counts: Counts,
        zero: Counts,
        load: Load,
        stopping: Counts,
        (known, settings): (Option<(&Calibration, Option<Thread>)>, &Settings),
    ) -> Result<Decision, CapsuleFault> {
        let thread = counts.since(zero).thread();
        let calibrated = known.map_or(Thread(0), |(calibration, _)| calibration.folded);
        let stop_within = Thread(stopping.thread().0.saturating_add(STOP_MARGIN.0));
        let jam = CapsuleFault::Jam {
            thread_um: thread.0,
        };
        // Past the last possible end: without load the thread is broken; under load it has become longer.
        let past_the_end = match load.excess_ma {
            Some(excess_ma) if excess_ma >= LOADED_MA => CapsuleFault::SpoolSlip,
            _ => CapsuleFault::ThreadBroken,
        };
        Ok(match self {
            Leg::Wind { end, .. } if load.end_force => {
                let short_um = end.0 - thread.0;
                if short_um > settings.end_tolerance.0 || short_um > SURELY_FOLDED.0 && load.stands
                {
                    return Err(jam);
                }
                // More friction, or something hard just before the end: only the origami lets the thread on.
                if short_um > SURELY_FOLDED.0 {
                    return Ok(Decision::Continue);
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
                let purpose = match purpose {
                    Purpose::Check { believed: true } if wound.0 > STILL_FOLDED.0 => {
                        Purpose::Check { believed: false }
                    }
                    purpose => purpose,
                };
                let right = match (purpose, known) {
                    (Purpose::Check { believed: true }, _) => true,
                    (Purpose::Reference | Purpose::Check { .. }, Some((calibration, end))) => {
                        let past_the_end = end.is_some_and(|end| thread >= end);
                        rise.is_of(calibration, wound, past_the_end)
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
                    // The thread pulls with the end force.
                    Decision::Reverse(Leg::BackOff {
                        to: counts.back(BACK_OFF.counts()),
                        then: Then::BackOff {
                            origin,
                            left: BACK_OFFS,
                        },
                    })
                }
            }
            Leg::Feel { from, then } => {
                let way = counts.since(from).thread();
                // A standing motor takes more current than the thread's pull: read it once it turns. A motor that
                // stands at the end force is pulled, too.
                let blocked = load.end_force && load.stands;
                let felt = load.excess_ma.is_some() && way >= FELT_AFTER || blocked;
                let end = known.and_then(|(_, end)| end);
                let past = end
                    .is_some_and(|end| thread.0 >= end.0 + settings.end_overrun.0 - STOP_MARGIN.0);
                if !felt && !past && way < FELT_AT_MOST {
                    return Ok(Decision::Continue);
                }
                let pulls = blocked || pulls(&load);
                return self.felt(counts, thread, (felt, pulls), then);
            }
            Leg::Seek {
                origin,
                purpose: Purpose::Calibrate,
                ..
            } if counts.since(origin).thread() > settings.folded_range.1 => {
                return Err(past_the_end);
            }
            Leg::Seek { origin, .. }
                if counts.since(origin).thread() >= settings.seek_limit(calibrated) =>
            {
                return Err(past_the_end);
            }
            Leg::Seek { .. } => Decision::Continue,
            Leg::BackOff { to, then } if counts.since(to).thread() <= stop_within => {
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
    /// Chooses the next leg after a [`Leg::Feel`]. `felt`: there is a reading. `pulls`: the thread pulls.
    ///
    /// # Errors
    /// No try gave a reading, so nothing shows that the thread holds.
    fn felt(
        self,
        counts: Counts,
        thread: Thread,
        (felt, pulls): (bool, bool),
        then: Then,
    ) -> Result<Decision, CapsuleFault> {
        Ok(match then {
            Then::PayOut { left: 0, .. } if !felt => return Err(CapsuleFault::SlipOrBreak),
            Then::PayOut { to, left } if !felt => Decision::Reverse(Leg::BackOff {
                to: counts.back(ROOM_TO_FEEL.counts()),
                then: Then::PayOut { to, left: left - 1 },
            }),
            Then::PayOut { to, .. } => Decision::Felt(Leg::PayOut {
                to,
                taut_to: Some(Thread(thread.0.saturating_sub(TENSION_ZONE.0))),
            }),
            Then::BackOff { origin, left } if pulls && left > 0 => {
                Decision::Reverse(Leg::BackOff {
                    to: counts.back(BACK_OFF.counts()),
                    then: Then::BackOff {
                        origin,
                        left: left - 1,
                    },
                })
            }
            Then::BackOff { origin, .. } => Decision::Careful(Leg::Seek {
                origin,
                second: true,
                purpose: Purpose::Reference,
            }),
        })
    }
}

fn pulls(load: &Load) -> bool {
    load.excess_ma
        .is_some_and(|excess_ma| excess_ma >= LOADED_MA)
}

/// Minimum current above the no-load current of a thread that pulls, mA: 0.5 N.
const LOADED_MA: u16 = 12;
/// Distance before the calibrated end from which on an end force is the folded end. Backlash and a stretched thread
/// fold up to 0.13 mm less than the count says, and a fold must not be short by more than 0.3 mm.
const SURELY_FOLDED: Thread = Thread(120);
/// Distance by which more friction brings the end force forward: 0.8 mm with 1.4 times as much.
const FRICTION_MOVES: Thread = Thread(900);
/// Distances after which the pull is judged: the first once the motor is steady, the second in any case.
const FELT_AFTER: Thread = Thread(120);
const FELT_AT_MOST: Thread = Thread(300);
/// Thread that is paid out where there is no room to wind and feel.
const ROOM_TO_FEEL: Thread = Thread(400);
/// Further tries of a pull that gave no reading.
const FEELS: u8 = 2;

#[cfg(test)]
#[path = "../tests/unit/leg.rs"]
mod tests;
