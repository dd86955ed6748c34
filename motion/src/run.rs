//! A whole experiment: cycles of forward stroke, far dwell, return stroke and home dwell on one
//! uninterrupted timeline. It is solved exactly before it starts, or refused with the limit that
//! it breaks. Nothing is clamped.

use core::fmt;

use crate::axis::{Acceleration, Axis, AxisError, Direction, Speed};
use crate::trapezoid::{StrokeError, StrokeProfile};
use crate::units::{Decimal, Micrometres, Steps, TICK_HZ, TICKS_PER_US, Ticks};

/// Maximum cycles of one run.
pub const MAX_CYCLES: u16 = 10_000;

/// Limits of the machine for every run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Highest speed of the carriage, um/s, at least 1.
    pub max_speed_um_s: u32,
    /// Highest acceleration, um/s^2.
    pub max_accel_um_s2: u32,
    /// Shortest interval between two steps that driver and step generator accept, ticks.
    pub min_interval_ticks: u32,
    /// Shortest time between the last step of a stroke and the first of the next, ticks: the
    /// driver needs it to change direction.
    pub min_turnaround_ticks: u32,
}

/// A run as the operator requests it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RunRequest {
    /// Pairs of strokes, 1..=[`MAX_CYCLES`].
    pub cycles: u16,
    /// Length of each stroke, from home, um; at most the stroke of the axis.
    pub stroke_um: u32,
    /// Duration, or speeds.
    pub timing: Timing,
    /// Rest at the far end in each cycle, us.
    pub far_dwell_us: u32,
    /// Rest at home between two cycles, us; there is none after the last.
    pub home_dwell_us: u32,
    /// Rest before the first stroke, us.
    pub start_delay_us: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Timing {
    /// All strokes are alike, and the run takes exactly this long, delay and dwells included.
    Total {
        /// Duration of the run, us.
        total_us: u64,
        /// Highest acceleration, um/s^2.
        accel_um_s2: u32,
    },
    /// Each stroke is as fast as its speed and the acceleration allow.
    Speeds {
        /// Highest speed away from home, um/s.
        forward_um_s: u32,
        /// Highest speed toward home, um/s.
        return_um_s: u32,
        /// Highest acceleration of both, um/s^2.
        accel_um_s2: u32,
    },
}

/// A solved run. Times count from its start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RunPlan {
    cycles: u16,
    forward: StrokeProfile,
    return_: StrokeProfile,
    far_dwell_ticks: u64,
    home_dwell_ticks: u64,
    start_delay_ticks: u64,
    /// Extra rest before the last return stroke, less than a tick per stroke: it makes the total exact.
    last_far_extra_ticks: u64,
    total_ticks: u64,
}

impl RunPlan {
    /// Solves a request on an axis, within limits.
    ///
    /// # Errors
    /// The first reason why the run is infeasible.
    pub fn solve(axis: &Axis, limits: &Limits, request: &RunRequest) -> Result<Self, RunError> {
        Self::solve_as_is(axis, limits, request).map_err(|error| {
            let Timing::Total { total_us, .. } = request.timing else {
                return error;
            };
            // Check the suggested acceleration: it may exceed the limit or leave the driver too little time to turn. A
            // higher one would leave even less.
            let suffices = |accel_um_s2| {
                let timing = Timing::Total {
                    total_us,
                    accel_um_s2,
                };
                let harder = RunRequest { timing, ..*request };
                Self::solve_as_is(axis, limits, &harder).is_ok()
            };
            match error {
                RunError::TotalTooShort {
                    minimal_total_us,
                    minimal_accel_um_s2: Some(accel_um_s2),
                } if !suffices(accel_um_s2) => RunError::TotalTooShort {
                    minimal_total_us,
                    minimal_accel_um_s2: None,
                },
                RunError::AccelerationTooLow {
                    minimal_um_s2,
                    shortest,
                    ..
                } if !suffices(minimal_um_s2) => {
                    RunError::Profile(StrokeError::TooSlow { duration: shortest })
                }
                error => error,
            }
        })
    }

    fn solve_as_is(axis: &Axis, limits: &Limits, request: &RunRequest) -> Result<Self, RunError> {
        let cycles = request.cycles;
        if cycles == 0 || cycles > MAX_CYCLES {
            return Err(RunError::Cycles { cycles });
        }
        let stroke = Micrometres(request.stroke_um);
        if stroke.0 == 0 || stroke > axis.stroke() {
            return Err(RunError::Stroke {
                stroke,
                longest: axis.stroke(),
            });
        }
        let steps = match axis.steps_within(stroke) {
            Some(steps) if steps.0 > 0 => steps,
            _ => return Err(RunError::StrokeBelowOneStep { stroke }),
        };

        let ticks = |us: u32| u64::from(us) * TICKS_PER_US;
        let (far, home) = (ticks(request.far_dwell_us), ticks(request.home_dwell_us));
        let delay = ticks(request.start_delay_us);
        let count = u64::from(cycles);
        // Below 2^39 + 2^14 * 2^40.
        let rests = delay + count * far + (count - 1) * home;

        let (forward, return_, extra) = match request.timing {
            Timing::Total {
                total_us,
                accel_um_s2,
            } => {
                let strokes = Strokes {
                    axis,
                    limits,
                    steps,
                    count: 2 * count,
                    rests,
                };
                let (profile, extra) = strokes.in_total(total_us, accel_um_s2)?;
                (profile, profile, extra)
            }
            Timing::Speeds {
                forward_um_s,
                return_um_s,
                accel_um_s2,
            } => {
                within_acceleration(limits, accel_um_s2)?;
                let stroke = |um_s: u32| {
                    if um_s > limits.max_speed_um_s {
                        return Err(RunError::SpeedAboveLimit {
                            speed_um_s: um_s,
                            max_um_s: limits.max_speed_um_s,
                        });
                    }
                    let profile = StrokeProfile::from_speed(
                        steps,
                        axis.speed(um_s)?,
                        axis.acceleration(accel_um_s2)?,
                    )?;
                    within_step_rate(axis, limits, &profile)?;
                    Ok(profile)
                };
                (stroke(forward_um_s)?, stroke(return_um_s)?, 0)
            }
        };

        let turnaround = |dwell: u64, next: &StrokeProfile, at: Direction| {
            let ticks = dwell + next.first_interval().0;
            let least = u64::from(limits.min_turnaround_ticks);
            if ticks < least {
                return Err(RunError::Turnaround {
                    before: at,
                    dwell: Ticks(dwell),
                    minimal_dwell_us: Ticks(dwell + least - ticks).to_us_ceil(),
                });
            }
            Ok(())
        };
        turnaround(far, &return_, Direction::Home)?;
        if cycles > 1 {
            turnaround(home, &forward, Direction::Away)?;
        }

        Ok(Self {
            cycles,
            forward,
            return_,
            far_dwell_ticks: far,
            home_dwell_ticks: home,
            start_delay_ticks: delay,
            last_far_extra_ticks: extra,
            // A stroke is below 2^45: n intervals of 2^30, and 2 n T below 2^60. No sum overflows.
            total_ticks: count * (forward.duration().0 + return_.duration().0) + rests + extra,
        })
    }

    /// Pairs of strokes.
    #[must_use]
    pub const fn cycles(&self) -> u16 {
        self.cycles
    }

    /// The stroke away from home.
    #[must_use]
    pub const fn forward(&self) -> &StrokeProfile {
        &self.forward
    }

    /// The stroke toward home.
    #[must_use]
    pub const fn return_(&self) -> &StrokeProfile {
        &self.return_
    }

    /// Time from the start to the last step.
    #[must_use]
    pub const fn total(&self) -> Ticks {
        Ticks(self.total_ticks)
    }

    /// Steps of the whole run, both ways.
    #[must_use]
    pub const fn edges(&self) -> u64 {
        2 * self.cycles as u64 * self.forward.steps().0 as u64
    }

    /// Strokes of the whole run: two per cycle.
    #[must_use]
    pub const fn strokes(&self) -> u32 {
        2 * self.cycles as u32
    }

    /// Direction of stroke `index`, counted from 0; `None` beyond the run.
    #[must_use]
    pub const fn direction(&self, index: u32) -> Option<Direction> {
        if index >= self.strokes() {
            return None;
        }
        Some(if index.is_multiple_of(2) {
            Direction::Away
        } else {
            Direction::Home
        })
    }

    /// Profile of stroke `index`, counted from 0; `None` beyond the run.
    #[must_use]
    pub fn stroke(&self, index: u32) -> Option<&StrokeProfile> {
        self.direction(index).map(|direction| match direction {
            Direction::Away => &self.forward,
            Direction::Home => &self.return_,
        })
    }

    /// Start of stroke `index`, counted from 0; `None` beyond the run. Add the
    /// [`crate::step_times::StepTimes`] of the stroke to get the time of each step.
    #[must_use]
    pub fn stroke_start(&self, index: u32) -> Option<Ticks> {
        let direction = self.direction(index)?;
        let cycle = u64::from(index / 2);
        let (forward, return_) = (self.forward.duration().0, self.return_.duration().0);
        let period = forward + self.far_dwell_ticks + return_ + self.home_dwell_ticks;
        let start = self.start_delay_ticks + cycle * period;
        Some(Ticks(match direction {
            Direction::Away => start,
            Direction::Home if index + 1 == self.strokes() => {
                start + forward + self.far_dwell_ticks + self.last_far_extra_ticks
            }
            Direction::Home => start + forward + self.far_dwell_ticks,
        }))
    }

    /// FNV-1a, 64 bits, over the integers that define the run, each as eight bytes, low byte
    /// first: cycles; steps, duration and ramp forward; the same for the return; far dwell,
    /// home dwell, start delay, last far extra. Equal hashes mean equal edges.
    #[must_use]
    pub fn hash(&self) -> u64 {
        let stroke = |p: &StrokeProfile| [u64::from(p.steps().0), p.duration().0, p.ramp().0];
        [u64::from(self.cycles)]
            .into_iter()
            .chain(stroke(&self.forward))
            .chain(stroke(&self.return_))
            .chain([
                self.far_dwell_ticks,
                self.home_dwell_ticks,
                self.start_delay_ticks,
                self.last_far_extra_ticks,
            ])
            .flat_map(u64::to_le_bytes)
            .fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
                (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
            })
    }
}

/// Finds the strokes of a run that has to last exactly a given time.
struct Strokes<'a> {
    axis: &'a Axis,
    limits: &'a Limits,
    steps: Steps,
    count: u64,
    rests: u64,
}

impl Strokes<'_> {
    /// The profile of all strokes, and the ticks left over when the time is divided by the number of strokes.
    fn in_total(&self, total_us: u64, accel_um_s2: u32) -> Result<(StrokeProfile, u64), RunError> {
        within_acceleration(self.limits, accel_um_s2)?;
        let acceleration = self.axis.acceleration(accel_um_s2)?;
        let total = Ticks::from_us(total_us).ok_or(RunError::TooLong)?;
        let moving = total.0.saturating_sub(self.rests);
        let duration = Ticks(moving / self.count);
        let fastest = self.axis.speed(self.limits.max_speed_um_s)?;
        let profile = match StrokeProfile::from_duration(self.steps, duration, acceleration) {
            Ok(profile) => profile,
            Err(StrokeError::Infeasible {
                minimal_duration, ..
            }) => {
                let minimal_accel_um_s2 = self.least_accel(duration, fastest, acceleration);
                let Some(shortest) = self.shortest(fastest, acceleration) else {
                    // At this acceleration no stroke has exact step times, however long it takes.
                    return Err(match minimal_accel_um_s2 {
                        Some(minimal_um_s2) => RunError::AccelerationTooLow {
                            accel_um_s2,
                            minimal_um_s2,
                            max_um_s2: self.limits.max_accel_um_s2,
                            shortest: minimal_duration,
                        },
                        None => RunError::Profile(StrokeError::TooSlow {
                            duration: minimal_duration,
                        }),
                    });
                };
                return Err(match self.total_us(shortest) {
                    Some(minimal_total_us) => RunError::TotalTooShort {
                        minimal_total_us,
                        minimal_accel_um_s2,
                    },
                    None => RunError::TooLong,
                });
            }
            Err(other) => return Err(RunError::Profile(other)),
        };
        if !profile.within(fastest) {
            return Err(RunError::PeakAboveLimit {
                peak_um_s: profile.peak_um_s(self.axis),
                max_um_s: self.limits.max_speed_um_s,
                minimal_total_us: self
                    .shortest(fastest, acceleration)
                    .and_then(|shortest| self.total_us(shortest)),
            });
        }
        within_step_rate(self.axis, self.limits, &profile)?;
        Ok((profile, moving % self.count))
    }

    /// Minimum ticks for all steps of a stroke at its peak speed, by the speed limit and the step rate.
    fn least_span(&self, fastest: Speed) -> u128 {
        let interval = u128::from(self.limits.min_interval_ticks);
        let steps = u128::from(self.steps.0);
        fastest.least_span(self.steps).max(steps * interval)
    }

    /// The shortest duration of a stroke within the limits of speed and step rate.
    fn shortest(&self, fastest: Speed, acceleration: Acceleration) -> Option<Ticks> {
        let square = acceleration.least_square(self.steps);
        let span = self.least_span(fastest);
        let profile = StrokeProfile::shortest_within(self.steps, span, square).ok()?;
        Some(profile.duration())
    }

    /// The least acceleration for strokes of this duration within the limits of speed and step rate. Its ramps are the
    /// longest that keep the peak within these limits, and the step times exact. Of `any` only the axis is used.
    fn least_accel(&self, duration: Ticks, fastest: Speed, any: Acceleration) -> Option<u32> {
        let time = u128::from(duration.0);
        let within = time.checked_sub(self.least_span(fastest))?.min(time / 2);
        let longest =
            StrokeProfile::longest_ramp(self.steps, duration, u64::try_from(within).ok()?)?;
        let ramp = u128::from(longest.0);
        u32::try_from(any.least_for(self.steps, ramp * (time - ramp))).ok()
    }

    /// Duration of the run with strokes of this duration, us, rounded up; `None` if it overflows.
    fn total_us(&self, stroke: Ticks) -> Option<u64> {
        let moving = stroke.0.checked_mul(self.count)?;
        Some(Ticks(moving.checked_add(self.rests)?).to_us_ceil())
    }
}

fn within_acceleration(limits: &Limits, accel_um_s2: u32) -> Result<(), RunError> {
    if accel_um_s2 > limits.max_accel_um_s2 {
        return Err(RunError::AccelerationAboveLimit {
            accel_um_s2,
            max_um_s2: limits.max_accel_um_s2,
        });
    }
    Ok(())
}

fn within_step_rate(axis: &Axis, limits: &Limits, profile: &StrokeProfile) -> Result<(), RunError> {
    let least = limits.min_interval_ticks;
    if profile.min_interval().0 < u64::from(least) {
        // Round down, so that this speed is slow enough.
        let steps_per_s = TICK_HZ / u64::from(least);
        let max_um_s = steps_per_s * u64::from(axis.lead().0) / u64::from(axis.steps_per_rev());
        return Err(RunError::StepRate {
            interval: profile.min_interval(),
            min_interval: Ticks(u64::from(least)),
            max_um_s,
        });
    }
    Ok(())
}

/// The reason why a run was refused, and the values that would make it feasible.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunError {
    /// Cycles outside 1..=[`MAX_CYCLES`].
    Cycles { cycles: u16 },
    /// A stroke of zero, or beyond the axis.
    Stroke {
        stroke: Micrometres,
        longest: Micrometres,
    },
    /// Stroke shorter than one step.
    StrokeBelowOneStep { stroke: Micrometres },
    AccelerationAboveLimit {
        /// Requested acceleration, um/s^2.
        accel_um_s2: u32,
        /// Limit, um/s^2.
        max_um_s2: u32,
    },
    SpeedAboveLimit {
        /// Requested speed, um/s.
        speed_um_s: u32,
        /// Limit, um/s.
        max_um_s: u32,
    },
    /// The total is too short for this acceleration. Changing either number alone is enough; both are exact.
    TotalTooShort {
        /// The shortest total at this acceleration within the limits of speed and step rate, us.
        minimal_total_us: u64,
        /// The least acceleration for this total with which the run is within all limits, um/s^2;
        /// `None` if there is none.
        minimal_accel_um_s2: Option<u32>,
    },
    /// At this acceleration no stroke of this length has exact step times, whatever the total.
    AccelerationTooLow {
        /// Requested acceleration, um/s^2.
        accel_um_s2: u32,
        /// The least acceleration for this total with which the run is within all limits, um/s^2.
        minimal_um_s2: u32,
        /// Limit, um/s^2.
        max_um_s2: u32,
        /// The shortest stroke at the requested acceleration, which is too slow for exact step times.
        shortest: Ticks,
    },
    /// The total needs a peak speed above the machine's limit.
    PeakAboveLimit {
        /// Peak speed needed, um/s.
        peak_um_s: u32,
        /// Limit, um/s.
        max_um_s: u32,
        /// The shortest total at this acceleration within the limit, us, if there is one.
        minimal_total_us: Option<u64>,
    },
    /// Steps would be closer than driver and step generator accept.
    StepRate {
        /// Interval at peak speed.
        interval: Ticks,
        min_interval: Ticks,
        /// A peak speed that is slow enough, um/s.
        max_um_s: u64,
    },
    /// Too little time for the driver to turn between two strokes.
    Turnaround {
        /// Direction of the next stroke: [`Direction::Home`] is the turn at the far end.
        before: Direction,
        dwell: Ticks,
        /// The shortest dwell that suffices for these strokes, in whole microseconds.
        minimal_dwell_us: u64,
    },
    /// The duration of the run does not fit 64 bits of ticks.
    TooLong,
    /// A speed or an acceleration of zero.
    Rate(AxisError),
    /// The stroke is outside the bounds of [`StrokeProfile`].
    Profile(StrokeError),
}

impl From<AxisError> for RunError {
    fn from(error: AxisError) -> Self {
        Self::Rate(error)
    }
}

impl From<StrokeError> for RunError {
    fn from(error: StrokeError) -> Self {
        Self::Profile(error)
    }
}

impl fmt::Display for RunError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Cycles { cycles } => {
                write!(f, "{cycles} cycles: use 1 to {MAX_CYCLES}")
            }
            Self::Stroke { stroke, longest } => write!(
                f,
                "a stroke of {stroke} does not fit: use more than zero and at most {longest}"
            ),
            Self::StrokeBelowOneStep { stroke } => write!(
                f,
                "a stroke of {stroke} is shorter than one step: use a longer one"
            ),
            Self::AccelerationAboveLimit {
                accel_um_s2,
                max_um_s2,
            } => write!(
                f,
                "an acceleration of {} mm/s2 is above the limit: use at most {} mm/s2",
                Decimal::milli(accel_um_s2.into()),
                Decimal::milli(max_um_s2.into())
            ),
            Self::SpeedAboveLimit {
                speed_um_s,
                max_um_s,
            } => write!(
                f,
                "a speed of {} mm/s is above the limit: use at most {} mm/s",
                Decimal::milli(speed_um_s.into()),
                Decimal::milli(max_um_s.into())
            ),
            Self::TotalTooShort {
                minimal_total_us,
                minimal_accel_um_s2,
            } => too_short(f, minimal_total_us, minimal_accel_um_s2),
            Self::AccelerationTooLow {
                accel_um_s2,
                minimal_um_s2,
                ..
            } => write!(
                f,
                "an acceleration of {} mm/s2 is too low for exact step times: accelerate with at least {} mm/s2",
                Decimal::milli(accel_um_s2.into()),
                Decimal::milli(minimal_um_s2.into())
            ),
            Self::PeakAboveLimit {
                peak_um_s,
                max_um_s,
                minimal_total_us,
            } => {
                write!(
                    f,
                    "the run needs a peak speed of {} mm/s, above the limit of {} mm/s: ",
                    Decimal::milli(peak_um_s.into()),
                    Decimal::milli(max_um_s.into())
                )?;
                match minimal_total_us {
                    Some(us) => write!(
                        f,
                        "allow at least {} s in total, or accelerate harder",
                        Decimal::micro(us)
                    ),
                    None => write!(f, "allow more time, or accelerate harder"),
                }
            }
            Self::StepRate {
                interval,
                min_interval,
                max_um_s,
            } => write!(
                f,
                "steps would be {} ticks apart, less than the minimum of {}: stay below {} mm/s or use fewer microsteps",
                interval.0,
                min_interval.0,
                Decimal::milli(max_um_s)
            ),
            Self::Turnaround {
                before,
                dwell,
                minimal_dwell_us,
            } => write!(
                f,
                "a dwell of {dwell} at {} is too short to turn: use at least {} s",
                match before {
                    Direction::Home => "the far end",
                    Direction::Away => "home",
                },
                Decimal::micro(minimal_dwell_us)
            ),
            Self::TooLong => write!(f, "the run is too long: use fewer cycles or less time"),
            Self::Rate(error) => error.fmt(f),
            Self::Profile(error) => error.fmt(f),
        }
    }
}

/// The text of [`RunError::TotalTooShort`].
fn too_short(f: &mut fmt::Formatter<'_>, total_us: u64, accel_um_s2: Option<u32>) -> fmt::Result {
    let total = Decimal::micro(total_us);
    write!(f, "too little time: allow at least {total} s in total")?;
    match accel_um_s2.map(|um_s2| Decimal::milli(um_s2.into())) {
        Some(accel) => write!(f, ", or accelerate with at least {accel} mm/s2"),
        None => write!(
            f,
            "; no acceleration within the limits is enough for the requested time"
        ),
    }
}

impl core::error::Error for RunError {}
