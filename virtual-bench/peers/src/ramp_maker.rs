//! The crate `ramp-maker` 0.2, in its own fixed point and in floats of 32 bits.

use ramp_maker::trapezoidal::DefaultNum;
use ramp_maker::{MotionProfile as _, Trapezoidal};

use crate::{Method, Move, TICK_HZ};

/// Ticks per millisecond.
const TICKS_PER_MS: u32 = TICK_HZ / 1_000;
/// Bits behind the point of its default numbers.
const FRACTION_BITS: u32 = 32;

/// Its default: 32 bits before the point and 32 behind.
///
/// In milliseconds. In ticks an acceleration of 8e-12 steps per square tick would be 0; in seconds, which its
/// documentation suggests, a delay has steps of 0.02 ticks and the square of a speed above 65,535 steps/s overflows.
pub struct Fixed {
    profile: Trapezoidal,
    /// Fraction of a tick that the last delay left over, in 2^-32 ticks.
    carry: u64,
}

impl Method for Fixed {
    fn new(order: &Move) -> Option<Self> {
        let per_ms = f64::from(TICKS_PER_MS);
        let acceleration = DefaultNum::checked_from_num(order.acceleration() * per_ms * per_ms)?;
        let speed = DefaultNum::checked_from_num(order.speed() * per_ms)?;
        let mut profile = Trapezoidal::new(acceleration);
        profile.enter_position_mode(speed, order.steps);
        Some(Self { profile, carry: 0 })
    }

    #[inline(never)]
    fn next_interval(&mut self) -> Option<u32> {
        let delay_ms = self.profile.next_delay()?;
        let ticks = delay_ms.to_bits() * u64::from(TICKS_PER_MS) + self.carry;
        self.carry = ticks & ((1 << FRACTION_BITS) - 1);
        Some((ticks >> FRACTION_BITS) as u32)
    }
}

/// Floats of 32 bits, which the core computes in hardware. In ticks.
pub struct Float {
    profile: Trapezoidal<f32>,
    /// Fraction of a tick that the last delay left over.
    carry: f32,
}

impl Method for Float {
    fn new(order: &Move) -> Option<Self> {
        let mut profile = Trapezoidal::new(order.acceleration() as f32);
        profile.enter_position_mode(order.speed() as f32, order.steps);
        Some(Self {
            profile,
            carry: 0.0,
        })
    }

    #[inline(never)]
    fn next_interval(&mut self) -> Option<u32> {
        let ticks = self.profile.next_delay()? + self.carry;
        let whole = ticks as u32;
        self.carry = ticks - whole as f32;
        Some(whole)
    }
}
