//! The crate `stepgen` 0.1.3: Austin's ramps with delays in 1/256 of its tick.

use stepgen::Stepgen;

use crate::{Method, Move, TICK_HZ};

/// Number of fraction bits of its delays.
const FRACTION_BITS: u32 = 8;
/// It keeps the first delay in 16 bits before the point, which it checks, and twice that delay in 32 bits all together,
/// which it does not: from here on it would wrap unnoticed.
const MOST_TICKS: f64 = 32_768.0;
/// Factor of its first delay against the exact one.
const FIRST: f64 = 0.676;

/// Its delays, in ticks.
pub struct Delays {
    generator: Stepgen,
    /// Bits of its delays below one of our ticks.
    bits: u32,
    /// Fraction of a tick that the last delay left over.
    carry: u32,
}

impl Method for Delays {
    fn new(order: &Move) -> Option<Self> {
        let first = FIRST * libm::sqrt(2.0 / order.acceleration());
        // Its tick is ours, or the least power of two of them with which the first delay fits.
        // 100 MHz is divisible by every one of these.
        let longer = (0..=FRACTION_BITS).find(|bits| first < MOST_TICKS * f64::from(1 << bits))?;
        let tick_hz = f64::from(TICK_HZ);
        let parts = |value: f64| libm::round(value * 256.0) as u32;
        let mut generator = Stepgen::new(TICK_HZ >> longer);
        generator
            .set_acceleration(parts(order.acceleration() * tick_hz * tick_hz))
            .ok()?;
        generator
            .set_target_speed(parts(order.speed() * tick_hz))
            .ok()?;
        generator.set_target_step(order.steps).ok()?;
        Some(Self {
            generator,
            bits: FRACTION_BITS - longer,
            carry: 0,
        })
    }

    #[inline(never)]
    fn next_interval(&mut self) -> Option<u32> {
        let delay = self.generator.next()? + self.carry;
        self.carry = delay & ((1 << self.bits) - 1);
        Some(delay >> self.bits)
    }
}
