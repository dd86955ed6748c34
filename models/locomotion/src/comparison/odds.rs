//! How probable it is that a sentence is met: the share of bodies that meet its condition, where the body matters.

use crate::comparison::{ROWS, Row};
use crate::prior::Words;

/// The value of each row for one body; none if the row was skipped, has no condition, or has no value.
pub type Values = [Option<f64>; ROWS];

/// How many of several bodies meet a condition, and the uncertainty of that share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Share {
    /// Bodies that meet it.
    pub met: usize,
    /// Bodies that were evaluated; at least one.
    pub bodies: usize,
    /// 95 % interval of the probability, after Wilson.
    pub interval: (f64, f64),
}

impl Share {
    /// From `met` of `bodies`. `independent` is their effective number: draws of a chain are correlated.
    pub fn of(met: usize, bodies: usize, independent: f64) -> Self {
        let part = met as f64 / bodies as f64;
        Self {
            met,
            bodies,
            interval: wilson(part, independent.min(bodies as f64)),
        }
    }

    /// The share itself.
    pub fn part(&self) -> f64 {
        self.met as f64 / self.bodies as f64
    }
}

/// Wilson's 95 % interval of a share among `count` bodies. It stays within 0 to 1 and has a width even at shares 0
/// and 1.
fn wilson(part: f64, count: f64) -> (f64, f64) {
    /// Quantile of the normal distribution: plus or minus this holds 95 % of it.
    const Z: f64 = 1.959_963_984_540_054;
    let scale = 1.0 + Z * Z / count;
    let centre = (part + Z * Z / (2.0 * count)) / scale;
    let half = Z / scale * libm::sqrt(part * (1.0 - part) / count + Z * Z / (4.0 * count * count));
    ((centre - half).max(0.0), (centre + half).min(1.0))
}

/// Probability that one row is met.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Odds {
    /// The row has no condition.
    Unstated,
    /// Every body gives the same value, so the row is always met or never.
    AnyBody(bool),
    /// The value depends on the body.
    Shares {
        /// Among bodies of the prior, before any sentence was read.
        prior: Option<Share>,
        /// Among bodies that agree with the words of the row's world.
        words: Option<Share>,
        /// Among draws of a posterior. Trials on the rig say nothing about the tube.
        posterior: Option<Share>,
    },
}

/// Evaluated bodies: for each, the values of its rows.
#[derive(Clone, Copy, Debug, Default)]
pub struct Asked<'a> {
    /// Draws of the prior, on the rig and in the tube.
    pub prior: &'a [Values],
    /// Draws that agree with the words on the rig.
    pub rig: &'a [Values],
    /// Draws that agree with the words on the tube.
    pub tube: &'a [Values],
    /// Draws of a posterior.
    pub posterior: &'a [Values],
    /// Effective number of independent draws of the posterior.
    pub independent: f64,
}

/// The odds of each row. `own` are the values of the model itself, computed with the same coarse steps as the
/// bodies'.
pub fn odds(rows: &[Row; ROWS], own: &Values, asked: &Asked<'_>) -> [Odds; ROWS] {
    core::array::from_fn(|place| {
        let Some(condition) = rows[place].condition else {
            return Odds::Unstated;
        };
        let everywhere = [asked.prior, asked.rig, asked.tube, asked.posterior];
        let mut all = everywhere
            .into_iter()
            .flatten()
            .chain([own])
            .filter_map(|values| values[place]);
        if let Some(first) = all.next()
            && all.all(|other| same(first, other))
        {
            return Odds::AnyBody(condition.met(first));
        }
        let share = |bodies: &[Values], independent: Option<f64>| {
            let asked = bodies.iter().filter_map(|values| values[place]);
            let count = asked.clone().count();
            let met = asked.filter(|value| condition.met(*value)).count();
            (count > 0).then(|| Share::of(met, count, independent.unwrap_or(count as f64)))
        };
        Odds::Shares {
            prior: share(asked.prior, None),
            words: match rows[place].world {
                Some(Words::Rig) => share(asked.rig, None),
                Some(Words::Tube) => share(asked.tube, None),
                None => None,
            },
            posterior: share(asked.posterior, Some(asked.independent)),
        }
    })
}

/// Whether two values are equal except for rounding; NaN never is.
fn same(one: f64, other: f64) -> bool {
    libm::fabs(one - other) <= super::condition::EXACT * (1.0 + libm::fabs(one))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand from Wilson's formula: 8 of 10, none of 20, all of 20.
    #[test]
    fn intervals_are_wilsons() {
        for (met, bodies, low, high) in [
            (8, 10, 0.490_162, 0.943_318),
            (0, 20, 0.0, 0.161_125),
            (20, 20, 0.838_875, 1.0),
        ] {
            let share = Share::of(met, bodies, bodies as f64);
            let (found_low, found_high) = share.interval;
            assert!((found_low - low).abs() < 1e-5, "{share:?}");
            assert!((found_high - high).abs() < 1e-5, "{share:?}");
        }
    }

    /// Correlated draws tell less. An effective number above their count tells no more.
    #[test]
    fn dependent_draws_are_worth_less() {
        let width = |independent| {
            let (low, high) = Share::of(50, 100, independent).interval;
            high - low
        };
        assert!(width(25.0) > 1.8 * width(100.0));
        assert_eq!(width(100.0), width(1e6));
    }
}
