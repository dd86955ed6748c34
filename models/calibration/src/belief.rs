//! What is held of the unknowns before a trial: the prior, or the samples of a posterior, smoothed.
//!
//! Samples alone are no belief to plan from: a trial that tells them all apart would seem to tell everything, and no more
//! than the logarithm of their number. So a normal kernel stands for each, shrunk towards their mean so
//! that mean and covariance stay those of the samples (West, Journal of the Royal Statistical Society B 55, 1993).

use rand::Rng;

use crate::chance::{normal, unit};
use crate::prior::{self, Point, UNKNOWNS};

/// Least number of samples that are smoothed.
pub const LEAST_SAMPLES: usize = 50;

/// A distribution of the unknowns that can be drawn from and evaluated.
#[derive(Clone, Debug)]
pub enum Belief {
    /// Nothing but the prior.
    Prior,
    /// Samples of a posterior.
    Smoothed(Smoothed),
}

/// Samples, each with a normal kernel of the same shape.
#[derive(Clone, Debug)]
pub struct Smoothed {
    /// Lower triangle: from a standard normal to a kernel.
    kernel: [Point; UNKNOWNS],
    /// Centres of the kernels, in coordinates in which each is a standard normal.
    centres: Vec<Point>,
}

impl Belief {
    /// Samples of a posterior, smoothed; none if they are fewer than [`LEAST_SAMPLES`], no numbers, or all alike in a direction.
    #[must_use]
    pub fn smoothed(samples: &[Point]) -> Option<Self> {
        if samples.len() < LEAST_SAMPLES || samples.iter().flatten().any(|z| !z.is_finite()) {
            return None;
        }
        let count = samples.len() as f64;
        let dimensions = UNKNOWNS as f64;
        // Silverman's rule for a normal density in so many dimensions.
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

    /// A point drawn from it.
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

    /// Logarithm of its density at a point, but for a constant.
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

/// Cholesky factor of the samples' covariance, times a width; none where it has no extent.
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
        // A NaN is refused, too.
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
