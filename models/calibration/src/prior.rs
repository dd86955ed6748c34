//! The unknowns and their priors.
//!
//! The sampler works on standard normal coordinates: each unknown is the quantile of its prior at the probability of
//! its coordinate. So the prior is equally round in every direction, no range has an edge for a walker to run into,
//! and a draw from the prior is a draw of normal numbers.

use locomotion::model::{Model, Setting, Value};
use locomotion::prior::PRIORS;
use rand::Rng;
use statrs::function::erf::erf_inv;

use crate::chance;

/// Number of unknowns.
pub const UNKNOWNS: usize = 4;
/// Number of unknowns that are parameters of the body.
pub const OF_BODY: usize = 3;

/// Standard normal coordinates of one set of unknowns.
pub type Point = [f64; UNKNOWNS];

/// A body as probabilities of its priors, from 0 to 1 each.
pub type Parts = [f64; OF_BODY];

/// Probability that a standard normal is below z.
fn probability(z: f64) -> f64 {
    0.5 * libm::erfc(-z / core::f64::consts::SQRT_2)
}

/// Quantile of the standard normal.
fn normal(part: f64) -> f64 {
    core::f64::consts::SQRT_2 * erf_inv(2.0 * part - 1.0)
}

/// The shape of a prior.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Uniform from the first to the second value.
    Even(f64, f64),
    /// Uniform in the logarithm from the first to the second value.
    EvenInLogarithm(f64, f64),
    /// Normal in the logarithm.
    LogNormal {
        /// Median.
        median: f64,
        /// Standard deviation of the natural logarithm.
        spread: f64,
    },
}

impl Shape {
    /// Quantile of the prior at a probability, `0..=1`.
    #[must_use]
    pub fn quantile(self, part: f64) -> f64 {
        match self {
            Self::Even(low, high) => low + part * (high - low),
            // Clamp: rounding could lead beyond the ends, where the model refuses values.
            Self::EvenInLogarithm(low, high) => {
                (low * libm::exp(part * libm::log(high / low))).clamp(low, high)
            }
            Self::LogNormal { median, spread } => median * libm::exp(spread * normal(part)),
        }
    }

    /// Value at a standard normal coordinate.
    #[must_use]
    pub fn value(self, z: f64) -> f64 {
        match self {
            Self::LogNormal { median, spread } => median * libm::exp(spread * z),
            Self::Even(..) | Self::EvenInLogarithm(..) => self.quantile(probability(z)),
        }
    }

    /// Standard normal coordinate of a value; infinite at the ends of a uniform prior and beyond them.
    #[must_use]
    pub fn coordinate(self, value: f64) -> f64 {
        match self {
            Self::Even(low, high) => normal((value - low) / (high - low)),
            Self::EvenInLogarithm(low, high) => {
                normal(libm::log(value / low) / libm::log(high / low))
            }
            Self::LogNormal { median, spread } => libm::log(value / median) / spread,
        }
    }
}

/// One unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unknown {
    /// The parameter as in a model file, or [`DISCREPANCY`].
    pub key: &'static str,
    /// Its unit; empty for a pure number.
    pub unit: &'static str,
    /// Its prior.
    pub shape: Shape,
    /// Reason for the prior.
    pub because: &'static str,
}

/// The key of the model's discrepancy.
pub const DISCREPANCY: &str = "fit.discrepancy_mm";

/// The model's discrepancy tau: standard deviation of the model's error in one pass of the rollers.
const TAU: Unknown = Unknown {
    key: DISCREPANCY,
    unit: "mm",
    shape: Shape::LogNormal {
        median: 0.1,
        spread: 1.0,
    },
    because: "a hundredth of an antegrade pass at 5.05 mm; 0.02 to 0.5 mm are not surprising",
};

/// All unknowns: the parameters of the body that trials on the rig can determine, with the priors of
/// [`locomotion::prior`], and the model's discrepancy. The tube's wall is missing, because no trial on the rig has
/// one.
#[must_use]
pub fn unknowns() -> [Unknown; UNKNOWNS] {
    let mut all = [TAU; UNKNOWNS];
    let of_body = PRIORS.iter().filter(|prior| prior.key.starts_with("body."));
    for (unknown, prior) in all.iter_mut().zip(of_body) {
        *unknown = Unknown {
            key: prior.key,
            unit: Setting::named(prior.key).map_or("", |setting| setting.unit),
            shape: if prior.logarithmic {
                Shape::EvenInLogarithm(prior.low, prior.high)
            } else {
                Shape::Even(prior.low, prior.high)
            },
            because: prior.because,
        };
    }
    all
}

/// Values of all unknowns, in the order of [`unknowns`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Values(pub [f64; UNKNOWNS]);

impl Values {
    /// Values at a point.
    #[must_use]
    pub fn at(point: &Point) -> Self {
        let mut values = *point;
        for (value, unknown) in values.iter_mut().zip(unknowns()) {
            *value = unknown.shape.value(*value);
        }
        Self(values)
    }

    /// The point of these values.
    #[must_use]
    pub fn point(&self) -> Point {
        let mut point = self.0;
        for (value, unknown) in point.iter_mut().zip(unknowns()) {
            *value = unknown.shape.coordinate(*value);
        }
        point
    }

    /// A draw from the prior.
    pub fn draw(random: &mut impl Rng) -> Self {
        Self::at(&draw(random))
    }

    /// The parameters of the body.
    #[must_use]
    pub fn of_body(&self) -> &[f64] {
        &self.0[..OF_BODY]
    }
}

/// tau at a point, mm.
#[must_use]
pub fn discrepancy_mm(point: &Point) -> f64 {
    TAU.shape.value(point[OF_BODY])
}

/// The body at a point.
#[must_use]
pub fn parts(point: &Point) -> Parts {
    core::array::from_fn(|axis| probability(point[axis]))
}

/// Replaces the body of a model.
#[must_use]
pub fn with_body(model: &Model, body: &Parts) -> Model {
    let mut changed = *model;
    for (unknown, part) in unknowns().iter().zip(body) {
        if let Some(setting) = Setting::named(unknown.key) {
            // Cannot fail: all take numbers, as the test `every_unknown_is_a_parameter_or_the_discrepancy` checks.
            let _ = changed.set(setting, Value::Number(unknown.shape.quantile(*part)));
        }
    }
    changed
}

/// A point drawn from the prior.
pub fn draw(random: &mut impl Rng) -> Point {
    core::array::from_fn(|_| chance::normal(random))
}

/// Logarithm of the prior's density at a point, up to a constant.
#[must_use]
pub fn log_density(point: &Point) -> f64 {
    -0.5 * point.iter().map(|z| z * z).sum::<f64>()
}
