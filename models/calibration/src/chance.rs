//! Streams of chance: one seed, and as many independent streams as there are uses for them.

use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};

/// The generator. Its algorithm is part of what a seed means.
pub type Random = ChaCha8Rng;

/// A stream of a seed. Streams of different numbers have nothing in common.
#[must_use]
pub fn stream(seed: u64, number: u64) -> Random {
    let mut random = Random::seed_from_u64(seed);
    random.set_stream(number);
    random
}

/// A number from 0 to 1, neither of them included: 53 bits.
pub fn unit(random: &mut impl Rng) -> f64 {
    ((random.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64
}

/// A standard normal number, by Box and Muller's method.
pub fn normal(random: &mut impl Rng) -> f64 {
    let radius = libm::sqrt(-2.0 * libm::log(unit(random)));
    radius * libm::cos(core::f64::consts::TAU * unit(random))
}
