//! The sampled density: prior times likelihood.
//!
//! The mean of a condition's repeats is the model's displacement, plus the model's discrepancy in this condition,
//! plus the measurement error. Both errors are normal, so the discrepancy is integrated out: the variance of the mean
//! is `u^2 + (g tau)^2`, with u the standard error of the mean and g of [`crate::observation::Kind::discrepancies`].
//! More repeats reduce u but not tau: they do not make a wrong model right.

use crate::observation::Condition;
use crate::prior::{Point, UNKNOWNS, discrepancy_mm, log_density, parts};
use crate::table::Table;

/// Prior times likelihood of some conditions, by a table of the model.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a> {
    /// The measured conditions.
    pub conditions: &'a [Condition],
    /// Index of each condition's case in the table.
    pub places: &'a [usize],
    /// The tabulated model.
    pub table: &'a Table,
    /// The table's error in each of its cases, mm: counts as an additional error.
    pub table_errors_mm: &'a [f64],
}

/// Standard deviation of a condition's mean about the model's displacement, mm.
#[must_use]
pub fn deviation_mm(condition: &Condition, discrepancy_mm: f64) -> f64 {
    libm::hypot(
        condition.uncertainty_mm,
        condition.case.kind.discrepancies() * discrepancy_mm,
    )
}

impl Target<'_> {
    /// Logarithm of the likelihood, up to a constant; minus infinity outside the table.
    #[must_use]
    pub fn log_likelihood(&self, point: &Point) -> f64 {
        let Some(found) = self.table.displacements_mm(&parts(point)) else {
            return f64::NEG_INFINITY;
        };
        let discrepancy_mm = discrepancy_mm(point);
        let one = |(condition, place): (&Condition, &usize)| {
            let deviation_mm = deviation_mm(condition, discrepancy_mm);
            let deviation_mm = libm::hypot(deviation_mm, self.table_errors_mm[*place]);
            let off = (condition.mean_mm - found[*place]) / deviation_mm;
            -0.5 * off * off - libm::log(deviation_mm)
        };
        self.conditions.iter().zip(self.places).map(one).sum()
    }
}

/// The target with its likelihood to a power: 0 is the prior, 1 the posterior.
pub(crate) struct Tempered<'a> {
    pub(crate) target: Target<'a>,
    pub(crate) power: f64,
}

impl hammer_and_sample::Model for Tempered<'_> {
    type Params = Point;

    fn log_prob(&self, point: &[f64; UNKNOWNS]) -> f64 {
        let log = self.target.log_likelihood(point);
        // Outside the table, and where a coordinate is NaN, the density is zero.
        if log.is_finite() {
            log_density(point) + self.power * log
        } else {
            f64::NEG_INFINITY
        }
    }
}
