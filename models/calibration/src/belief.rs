//! Knowledge of the unknowns before a trial: the prior, or the smoothed samples of a posterior.
//!
//! Planning needs more than bare samples. A trial that tells all samples apart would seem to tell everything, and
//! never more than the logarithm of their number. So each sample becomes a normal kernel, shrunk towards their mean
//! to keep the mean and the covariance of the samples (West, Journal of the Royal Statistical Society B 55, 1993).

use rand::Rng;

use crate::chance::{normal, unit};
use crate::prior::{self, Point, UNKNOWNS};

/// Fewest samples that are smoothed.
pub const LEAST_SAMPLES: usize = 50;

/// A distribution of the unknowns that can be sampled and evaluated.
#[derive(Clone, Debug)]
pub enum Belief {
    /// The prior alone.
    Prior,
    /// Samples of a posterior.
    Smoothed(Smoothed),
}

/// Samples, each with a normal kernel of the same shape.
#[derive(Clone, Debug)]
pub struct Smoothed {
    /// Lower triangular matrix that maps a standard normal to a kernel.
    kernel: [Point; UNKNOWNS],
    /// Centres of the kernels, in coordinates in which each is a standard normal.
    centres: Vec<Point>,
}

impl Belief {
    /// Smooths samples of a posterior. None for fewer than [`LEAST_SAMPLES`], for NaN or infinity among them, and if
    /// they have no extent in some direction.
    #[must_use]
    pub fn smoothed(samples: &[Point]) -> Option<Self> {
        if samples.len() < LEAST_SAMPLES || samples.iter().flatten().any(|z| !z.is_finite()) {
            return None;
        }
        let count = samples.len() as f64;
        let dimensions = UNKNOWNS as f64;
        // Silverman's rule for a normal density in `dimensions` dimensions.
        let width = libm::pow(4.0 / ((dimensions + 2.0) * count), 1.0 / (dimensions + 4.0));
        let shrink = libm::sqrt(1.0 - width * width);
        let mean: Point = core::array::from_fn(|axis| {
            samples.iter().map(|point| point[axis]).sum::<f64>() / count
        });
        let kernel = triangle(samples, &mean, width)?;
        let centre = |point: &Point| {
            let shrunk =
                core::array::from_fn(|axis| mean[axis] + shrink * (point[axis] - mean[axis]));
            whitened(&kernel, &shrunk)
        };
        Some(Self::Smoothed(Smoothed {
            kernel,
            centres: samples.iter().map(centre).collect(),
        }))
    }

    /// A random point of the distribution.
    pub fn draw(&self, random: &mut impl Rng) -> Point {
        match self {
            Self::Prior => prior::draw(random),
            Self::Smoothed(this) => {
                let place = (unit(random) * this.centres.len() as f64) as usize;
                let centre = this.centres[place];
                let near: Point = core::array::from_fn(|axis| centre[axis] + normal(random));
                core::array::from_fn(|row| (0..=row).map(|k| this.kernel[row][k] * near[k]).sum())
            }
        }
    }

    /// Logarithm of the density at a point, up to a constant.
    #[must_use]
    pub fn log_density(&self, point: &Point) -> f64 {
        match self {
            Self::Prior => prior::log_density(point),
            Self::Smoothed(this) => {
                let at = whitened(&this.kernel, point);
                let square = |centre: &Point| -> f64 {
                    at.iter().zip(centre).map(|(a, c)| (a - c) * (a - c)).sum()
                };
                let nearest = this
                    .centres
                    .iter()
                    .map(square)
                    .fold(f64::INFINITY, f64::min);
                let share = |centre| libm::exp(0.5 * (nearest - square(centre)));
                libm::log(this.centres.iter().map(share).sum::<f64>()) - 0.5 * nearest
            }
        }
    }
}

/// Cholesky factor of the samples' covariance, times a width; none if some direction has no extent.
fn triangle(samples: &[Point], mean: &Point, width: f64) -> Option<[Point; UNKNOWNS]> {
    let covariance = |one: usize, other: usize| {
        let product = |point: &Point| (point[one] - mean[one]) * (point[other] - mean[other]);
        samples.iter().map(product).sum::<f64>() / (samples.len() - 1) as f64
    };
    let mut factor = [[0.0; UNKNOWNS]; UNKNOWNS];
    for row in 0..UNKNOWNS {
        for column in 0..=row {
            let known: f64 = (0..column)
                .map(|k| factor[row][k] * factor[column][k])
                .sum();
            let left = covariance(row, column) - known;
            factor[row][column] = if row == column {
                libm::sqrt(left)
            } else {
                left / factor[column][column]
            };
        }
        // Refuse NaN as well.
        if factor[row][row].partial_cmp(&1e-9) != Some(core::cmp::Ordering::Greater) {
            return None;
        }
    }
    Some(factor.map(|row| row.map(|value| value * width)))
}

/// A point in the coordinates of a kernel.
fn whitened(kernel: &[Point; UNKNOWNS], point: &Point) -> Point {
    let mut at = [0.0; UNKNOWNS];
    for row in 0..UNKNOWNS {
        let known: f64 = (0..row).map(|k| kernel[row][k] * at[k]).sum();
        at[row] = (point[row] - known) / kernel[row][row];
    }
    at
}
