//! Random numbers: one seed, and an independent stream for each use.

use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};

/// The generator. A seed gives the same numbers only with this algorithm.
pub type Random = ChaCha8Rng;

/// A stream of a seed. Streams with different numbers are independent.
#[must_use]
pub fn stream(seed: u64, number: u64) -> Random {
    let mut random = Random::seed_from_u64(seed);
    random.set_stream(number);
    random
}

/// A number between 0 and 1, both excluded, from 53 random bits.
pub fn unit(random: &mut impl Rng) -> f64 {
    ((random.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64
}

/// A standard normal number, by Box and Muller's method.
pub fn normal(random: &mut impl Rng) -> f64 {
    let radius = libm::sqrt(-2.0 * libm::log(unit(random)));
    radius * libm::cos(core::f64::consts::TAU * unit(random))
}
