//! Random choices from a seed.

/// SplitMix64 (Steele, Lea, Flood 2014). A seed gives the same choices in every version, so that a resumed campaign
/// keeps its order; no general-purpose crate promises that across its versions.
#[derive(Clone, Debug)]
pub struct Chance(u64);

impl Chance {
    pub const fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A uniform number below `bound`; 0 if `bound` is 0.
    pub fn below(&mut self, bound: usize) -> usize {
        let bound = bound as u64;
        if bound == 0 {
            return 0;
        }
        // Reject numbers beyond the last whole multiple of `bound`, which would favour small results.
        let whole = u64::MAX - u64::MAX % bound;
        loop {
            let bits = self.bits();
            if bits < whole {
                return (bits % bound) as usize;
            }
        }
    }

    /// Puts the items into a random order; all orders are equally likely (Fisher and Yates).
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            items.swap(last, self.below(last + 1));
        }
    }

    /// From the normal distribution with mean 0 and standard deviation 1 (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        // Above 0, because the logarithm of 0 is infinite.
        let unit = |bits: u64| ((bits >> 11) as f64 + 1.0) / (1_u64 << 53) as f64;
        let (radius, angle) = (unit(self.bits()), unit(self.bits()));
        (-2.0 * radius.ln()).sqrt() * (std::f64::consts::TAU * angle).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A campaign begun with an older version must continue in the same order.
    #[test]
    fn a_seed_means_the_same_for_ever() {
        let mut chance = Chance::new(1_234_567);
        // Reference values by the authors of the algorithm, for this seed.
        let expected = [
            6_457_827_717_110_365_317,
            3_203_168_211_198_807_973,
            9_817_491_932_198_370_423,
        ];
        assert_eq!([(); 3].map(|()| chance.bits()), expected);
        let mut items = [0, 1, 2, 3, 4, 5, 6, 7];
        Chance::new(1).shuffle(&mut items);
        assert_eq!(items, [4, 3, 2, 7, 5, 6, 0, 1]);
        // The seed whose first number is the greatest of all, and is drawn again.
        assert_eq!(Chance::new(3_558_559_446_808_474_027).below(3), 1);
    }

    #[test]
    fn the_normal_distribution_has_its_moments() {
        let mut chance = Chance::new(7);
        let values: Vec<f64> = (0..20_000).map(|_| chance.normal()).collect();
        let mean = values.iter().sum::<f64>() / 20_000.0;
        let square = values.iter().map(|value| value * value).sum::<f64>() / 20_000.0;
        assert!(
            mean.abs() < 0.035 && (square - 1.0).abs() < 0.05,
            "{mean} {square}"
        );
    }
}
