//! Screw, motor and stroke: converts lengths to steps and keeps positions inside the stroke.
//!
//! Position 0 is home, the right end. Positions grow to the left, up to the stroke.

use core::fmt;

use crate::units::{Decimal, Micrometres, StepPosition, Steps, TICK_HZ, Window};

/// Longest stroke of any axis: 130 mm, the paper's.
pub const MAX_STROKE: Micrometres = Micrometres(130_000);

/// Shortest and longest lead of a screw, um per turn.
const LEADS_UM: (u32, u32) = (500, 50_000);
/// Maximum full steps of a motor per turn.
const MAX_FULL_STEPS: u16 = 400;
/// Maximum microsteps per full step.
const MAX_MICROSTEPS: u16 = 256;

// Every position of every axis fits `i32`: the longest stroke on the finest axis has 26.6 M steps.
const _: () = {
    let steps_per_rev = MAX_FULL_STEPS as u64 * MAX_MICROSTEPS as u64;
    assert!(MAX_STROKE.0 as u64 * steps_per_rev / LEADS_UM.0 as u64 <= i32::MAX as u64);
};

/// One linear axis: lead screw, stepper motor, microsteps of its driver and configured stroke.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Axis {
    lead_um: u32,
    full_steps_per_rev: u16,
    microsteps: u16,
    stroke_um: u32,
    ratio: Ratio,
}

/// Steps per micrometre, a reduced fraction: equal ratios compare equal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Ratio {
    steps: u32,
    um: u32,
}

impl Axis {
    /// The paper's rig: SFU1204 screw with a lead of 4 mm, 200 full steps per turn, 1/16 microsteps,
    /// 130 mm stroke. 800 steps per mm.
    pub const REFERENCE: Self = match Self::new(4_000, 200, 16, 130_000) {
        Ok(axis) => axis,
        Err(_) => panic!("the reference axis is valid"),
    };

    /// Creates an axis: lead 500..=50,000 um per turn, 200 or 400 full steps per turn, microsteps
    /// a power of two in 1..=256, stroke 1..=130,000 um.
    ///
    /// # Errors
    /// The first value that is out of range, or a stroke shorter than one step.
    pub const fn new(
        lead_um: u32,
        full_steps_per_rev: u16,
        microsteps: u16,
        stroke_um: u32,
    ) -> Result<Self, AxisError> {
        if lead_um < LEADS_UM.0 || lead_um > LEADS_UM.1 {
            return Err(AxisError::Lead { lead_um });
        }
        if full_steps_per_rev != 200 && full_steps_per_rev != MAX_FULL_STEPS {
            return Err(AxisError::FullSteps { full_steps_per_rev });
        }
        if !microsteps.is_power_of_two() || microsteps > MAX_MICROSTEPS {
            return Err(AxisError::Microsteps { microsteps });
        }
        if stroke_um == 0 || stroke_um > MAX_STROKE.0 {
            return Err(AxisError::Stroke { stroke_um });
        }
        let steps_per_rev = full_steps_per_rev as u32 * microsteps as u32;
        let divisor = gcd(steps_per_rev, lead_um);
        let axis = Self {
            lead_um,
            full_steps_per_rev,
            microsteps,
            stroke_um,
            ratio: Ratio {
                steps: steps_per_rev / divisor,
                um: lead_um / divisor,
            },
        };
        if axis.stroke_steps().0 == 0 {
            return Err(AxisError::StrokeBelowOneStep { stroke_um });
        }
        Ok(axis)
    }

    /// Travel per turn of the screw.
    #[must_use]
    pub const fn lead(&self) -> Micrometres {
        Micrometres(self.lead_um)
    }

    /// Microsteps per full step.
    #[must_use]
    pub const fn microsteps(&self) -> u16 {
        self.microsteps
    }

    #[must_use]
    pub const fn stroke(&self) -> Micrometres {
        Micrometres(self.stroke_um)
    }

    /// Microsteps per turn of the screw.
    #[must_use]
    pub const fn steps_per_rev(&self) -> u32 {
        self.full_steps_per_rev as u32 * self.microsteps as u32
    }

    /// The last step inside the configured stroke, at most 26.6 M.
    #[must_use]
    pub const fn stroke_steps(&self) -> Steps {
        Steps(self.whole_steps(Micrometres(self.stroke_um)) as u32)
    }

    /// All positions of the configured stroke, home and far end included.
    #[must_use]
    pub const fn stroke_window(&self) -> Window {
        Window {
            first: self.home().signed(),
            last: self.far().signed(),
        }
    }

    /// Whole steps that fit into `length`, rounded down. `None` above `u32::MAX` steps.
    #[must_use]
    pub const fn steps_within(&self, length: Micrometres) -> Option<Steps> {
        let steps = self.whole_steps(length);
        if steps > u32::MAX as u64 {
            return None;
        }
        Some(Steps(steps as u32))
    }

    const fn whole_steps(&self, length: Micrometres) -> u64 {
        length.0 as u64 * self.ratio.steps as u64 / self.ratio.um as u64
    }

    /// Length of these steps, to the nearest nanometre.
    const fn length_nm(&self, steps: u32) -> u64 {
        // 2^32 * 50,000 * 1,000 is below 2^58.
        let numerator = steps as u64 * self.ratio.um as u64 * 1_000;
        (numerator + self.ratio.steps as u64 / 2) / self.ratio.steps as u64
    }

    /// A position from home in um, rounded to the nearest, negative behind home. Wraps beyond 2^31 um, 2 km.
    #[must_use]
    pub const fn um_from_home(&self, position: StepPosition) -> i32 {
        let um = ((self.length_nm(position.0.unsigned_abs()) + 500) / 1_000) as i32;
        if position.0 < 0 { -um } else { um }
    }

    /// Mean speed over `steps`, which are negative toward home, in a time of at least 1 us; um/s, rounded toward zero.
    /// Saturates at 2 km/s.
    #[must_use]
    pub fn mean_speed_um_s(&self, steps: i32, time_us: u64) -> i32 {
        let nm = self.length_nm(steps.unsigned_abs());
        let speed = nm.saturating_mul(1_000) / time_us.max(1);
        let speed = i32::try_from(speed).unwrap_or(i32::MAX);
        if steps < 0 { -speed } else { speed }
    }

    /// Home, the right end.
    #[must_use]
    pub const fn home(&self) -> Position {
        Position { steps: 0 }
    }

    /// The far end of the configured stroke.
    #[must_use]
    pub const fn far(&self) -> Position {
        Position {
            steps: self.stroke_steps().0,
        }
    }

    /// The position this many steps from home; `None` beyond the configured stroke.
    #[must_use]
    pub const fn position(&self, from_home: Steps) -> Option<Position> {
        if from_home.0 > self.stroke_steps().0 {
            return None;
        }
        Some(Position { steps: from_home.0 })
    }

    /// The last whole step within this distance from home; `None` for a distance beyond the configured stroke, even by
    /// less than a step.
    #[must_use]
    pub const fn position_um(&self, from_home: Micrometres) -> Option<Position> {
        if from_home.0 > self.stroke_um {
            return None;
        }
        Some(Position {
            steps: self.whole_steps(from_home) as u32,
        })
    }

    /// A speed on this axis, um/s.
    ///
    /// # Errors
    /// The speed is zero.
    pub const fn speed(&self, um_s: u32) -> Result<Speed, AxisError> {
        if um_s == 0 {
            return Err(AxisError::NoSpeed);
        }
        Ok(Speed {
            um_s,
            ratio: self.ratio,
        })
    }

    /// An acceleration on this axis, um/s^2.
    ///
    /// # Errors
    /// The acceleration is zero.
    pub const fn acceleration(&self, um_s2: u32) -> Result<Acceleration, AxisError> {
        if um_s2 == 0 {
            return Err(AxisError::NoAcceleration);
        }
        Ok(Acceleration {
            um_s2,
            ratio: self.ratio,
        })
    }

    /// `steps * scale / per` in micrometres, to the nearest integer, half up; `u32::MAX` if it does
    /// not fit.
    pub(crate) fn scaled_um(&self, steps: u32, scale: u128, per: u128) -> u32 {
        let numerator = u128::from(steps) * u128::from(self.ratio.um) * scale;
        let denominator = per * u128::from(self.ratio.steps);
        u32::try_from((numerator + denominator / 2) / denominator).unwrap_or(u32::MAX)
    }
}

/// A whole step inside the configured stroke. Only an [`Axis`] creates positions, so none is outside. Use it with the
/// axis that created it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Position {
    steps: u32,
}

impl Position {
    /// Distance from home.
    #[must_use]
    pub const fn steps(self) -> Steps {
        Steps(self.steps)
    }

    /// The same position as a counter's value.
    #[must_use]
    pub const fn signed(self) -> StepPosition {
        // At most 26.6 M, which fits.
        StepPosition(self.steps as i32)
    }
}

impl From<Position> for StepPosition {
    fn from(position: Position) -> Self {
        position.signed()
    }
}

/// Direction of travel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Direction {
    /// Away from home: to the left, positions grow. The forward stroke.
    Away,
    /// Toward home: to the right, positions shrink. The return stroke.
    #[default]
    Home,
}

impl Direction {
    /// Change of a position by one step: +1 away from home, -1 toward home.
    #[must_use]
    pub const fn sign(self) -> i32 {
        match self {
            Self::Away => 1,
            Self::Home => -1,
        }
    }
}

impl StepPosition {
    /// The position `by` steps further in `direction`; `None` if it does not fit `i32`.
    #[must_use]
    pub const fn moved(self, direction: Direction, by: Steps) -> Option<Self> {
        let moved = match direction {
            Direction::Away => self.0.checked_add_unsigned(by.0),
            Direction::Home => self.0.checked_sub_unsigned(by.0),
        };
        match moved {
            Some(steps) => Some(Self(steps)),
            None => None,
        }
    }

    /// Direction and distance from here to `to`; `None` if they are the same.
    #[must_use]
    pub const fn way_to(self, to: Self) -> Option<(Direction, Steps)> {
        let direction = if self.0 < to.0 {
            Direction::Away
        } else if self.0 > to.0 {
            Direction::Home
        } else {
            return None;
        };
        Some((direction, self.distance_to(to)))
    }
}

impl Window {
    /// Steps from `position` to the edge of the window in `direction`; 0 at the edge and everywhere outside, even if
    /// the direction leads back in.
    #[must_use]
    pub const fn room(&self, position: StepPosition, direction: Direction) -> Steps {
        if !self.contains(position) {
            return Steps(0);
        }
        match direction {
            Direction::Away => position.distance_to(self.last),
            Direction::Home => position.distance_to(self.first),
        }
    }
}

/// An exact speed on an axis, above zero.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Speed {
    um_s: u32,
    ratio: Ratio,
}

impl Speed {
    /// Fewest whole ticks for `steps` at this speed: ceil(steps / speed).
    pub(crate) fn least_span(self, steps: Steps) -> u128 {
        let way = u128::from(steps.0) * u128::from(TICK_HZ) * u128::from(self.ratio.um);
        way.div_ceil(u128::from(self.um_s) * u128::from(self.ratio.steps))
    }
}

/// An exact acceleration on an axis, above zero.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Acceleration {
    um_s2: u32,
    ratio: Ratio,
}

impl Acceleration {
    /// `steps / acceleration` in ticks^2, rounded up.
    pub(crate) fn least_square(self, steps: Steps) -> u128 {
        let per = u128::from(self.um_s2) * u128::from(self.ratio.steps);
        self.square_of_unit(steps).div_ceil(per)
    }

    /// The least acceleration, um/s^2, for which `least_square(steps)` is at most `square`.
    pub(crate) fn least_for(self, steps: Steps, square: u128) -> u64 {
        let per = square.max(1) * u128::from(self.ratio.steps);
        let um_s2 = self.square_of_unit(steps).div_ceil(per);
        u64::try_from(um_s2).unwrap_or(u64::MAX)
    }

    /// Steps to brake to rest from one step per `interval` ticks, rounded up: v^2 / 2a.
    pub(crate) fn steps_to_rest(self, interval: u32) -> u128 {
        let speed_of_unit = u128::from(TICK_HZ) * u128::from(TICK_HZ) * u128::from(self.ratio.um);
        let square = u128::from(interval) * u128::from(interval);
        speed_of_unit
            .div_ceil(2 * square.max(1) * u128::from(self.um_s2) * u128::from(self.ratio.steps))
    }

    /// Numerator of `steps / acceleration` in ticks^2; the denominator is the acceleration in um/s^2.
    fn square_of_unit(self, steps: Steps) -> u128 {
        // At most 2^32 * 2^54 * 2^16.
        u128::from(steps.0) * u128::from(TICK_HZ) * u128::from(TICK_HZ) * u128::from(self.ratio.um)
    }
}

/// The reason why an axis, a speed or an acceleration was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AxisError {
    /// Lead outside 500..=50,000 um.
    Lead {
        /// Requested lead, um per turn.
        lead_um: u32,
    },
    /// Neither 200 nor 400 full steps per turn.
    FullSteps {
        /// Requested full steps per turn.
        full_steps_per_rev: u16,
    },
    /// Not a power of two in 1..=256.
    Microsteps {
        /// Requested microsteps per full step.
        microsteps: u16,
    },
    /// Stroke outside 1..=130,000 um.
    Stroke {
        /// Requested stroke, um.
        stroke_um: u32,
    },
    /// Stroke shorter than one step.
    StrokeBelowOneStep {
        /// Requested stroke, um.
        stroke_um: u32,
    },
    /// A speed of zero.
    NoSpeed,
    NoAcceleration,
}

impl fmt::Display for AxisError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Lead { lead_um } => write!(
                f,
                "a lead of {} mm is outside 0.5 to 50 mm: enter the screw's travel per turn",
                Decimal::milli(lead_um.into())
            ),
            Self::FullSteps { full_steps_per_rev } => write!(
                f,
                "{full_steps_per_rev} full steps per turn: use 200 (1.8 degrees) or 400 (0.9 degrees)"
            ),
            Self::Microsteps { microsteps } => write!(
                f,
                "{microsteps} microsteps: use 1, 2, 4, 8, 16, 32, 64, 128 or 256, as set on the driver"
            ),
            Self::Stroke { stroke_um } => write!(
                f,
                "a stroke of {} mm is outside 0.001 to 130 mm: enter the travel between the end stops",
                Decimal::milli(stroke_um.into())
            ),
            Self::StrokeBelowOneStep { stroke_um } => write!(
                f,
                "a stroke of {} mm is shorter than one step: use a longer stroke or more microsteps",
                Decimal::milli(stroke_um.into())
            ),
            Self::NoSpeed => write!(f, "the speed is zero: use at least 0.001 mm/s"),
            Self::NoAcceleration => {
                write!(f, "the acceleration is zero: use at least 0.001 mm/s2")
            }
        }
    }
}

impl core::error::Error for AxisError {}

const fn gcd(mut a: u32, mut b: u32) -> u32 {
    while b != 0 {
        (a, b) = (b, a % b);
    }
    a
}
