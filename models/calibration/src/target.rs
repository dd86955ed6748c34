//! The sampled density: prior times likelihood.
//!
//! The mean of a condition's repeats is the model's displacement, plus the model's errors, plus the measurement error.
//! The model's error in an antegrade pass is one number for all strokes and nets in a notch and at a wall, and so is
//! its error in a returning pass: ten strokes show the same error ten times, and say no more about the body than one
//! exact stroke. All errors are normal, so the model's are integrated out: the means of a family of conditions have
//! the covariance `diag(u^2) + tau^2 A A^T`, with u the standard error of a mean and the rows of A from
//! [`crate::observation::Kind::errors`]. More repeats reduce u but not tau: they do not make a wrong model right.

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

/// A condition beside what the other conditions and a body predict of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Without {
    /// Its mean less the prediction, in standard deviations of the prediction.
    pub off: f64,
    /// Logarithm of its density there, up to a constant.
    pub log_density: f64,
}

/// Sums over a family of conditions, 1/mm^2 and 1/mm.
#[derive(Clone, Copy, Debug, Default)]
struct Family {
    /// `A^T S^-1 A`: antegrade, both, returning.
    precision: [f64; 3],
    /// `A^T S^-1 r`.
    pull: [f64; 2],
}

impl Family {
    fn add(&mut self, [antegrade, returning]: [f64; 2], off_mm: f64, precision: f64) {
        self.precision[0] += precision * antegrade * antegrade;
        self.precision[1] += precision * antegrade * returning;
        self.precision[2] += precision * returning * returning;
        self.pull[0] += precision * antegrade * off_mm;
        self.pull[1] += precision * returning * off_mm;
    }

    /// `I + tau^2 A^T S^-1 A` times a vector, inverted; and its determinant.
    fn solved(&self, variance: f64, [one, other]: [f64; 2]) -> ([f64; 2], f64) {
        let [a, b, c] = self.precision.map(|precision| variance * precision);
        let determinant = (1.0 + a) * (1.0 + c) - b * b;
        let solved = [
            ((1.0 + c) * one - b * other) / determinant,
            ((1.0 + a) * other - b * one) / determinant,
        ];
        (solved, determinant)
    }
}

/// Differences of the means from the model, and their families.
struct Off {
    /// For each condition: measured mean less the model's, mm, and 1 over the variance of its own error, 1/mm^2.
    of_conditions: Vec<(f64, f64)>,
    families: Vec<Family>,
    /// tau^2, mm^2.
    variance: f64,
}

impl Target<'_> {
    fn off(&self, point: &Point) -> Option<Off> {
        let found = self.table.displacements_mm(&parts(point))?;
        let mut families = vec![];
        let one = |(condition, place): (&Condition, &usize)| {
            let own_mm = libm::hypot(condition.uncertainty_mm, self.table_errors_mm[*place]);
            let off_mm = condition.mean_mm - found[*place];
            let precision = 1.0 / (own_mm * own_mm);
            if families.len() <= condition.family {
                families.resize(condition.family + 1, Family::default());
            }
            families[condition.family].add(condition.case.kind.errors(), off_mm, precision);
            (off_mm, precision)
        };
        let of_conditions = self.conditions.iter().zip(self.places).map(one).collect();
        let tau_mm = discrepancy_mm(point);
        Some(Off {
            of_conditions,
            families,
            variance: tau_mm * tau_mm,
        })
    }

    /// Logarithm of the likelihood, up to a constant; minus infinity outside the table.
    #[must_use]
    pub fn log_likelihood(&self, point: &Point) -> f64 {
        let Some(off) = self.off(point) else {
            return f64::NEG_INFINITY;
        };
        let own = |(off_mm, precision): &(f64, f64)| {
            -0.5 * (off_mm * off_mm * precision - libm::log(*precision))
        };
        let shared = |family: &Family| {
            let ([one, other], determinant) = family.solved(off.variance, family.pull);
            let explained = off.variance * (family.pull[0] * one + family.pull[1] * other);
            0.5 * (explained - libm::log(determinant))
        };
        off.of_conditions.iter().map(own).sum::<f64>()
            + off.families.iter().map(shared).sum::<f64>()
    }

    /// Each condition beside what all others predict of it with the body of a point; none outside the table.
    #[must_use]
    pub fn without(&self, point: &Point) -> Option<Vec<Without>> {
        let off = self.off(point)?;
        let one = |(condition, (off_mm, precision)): (&Condition, &(f64, f64))| {
            let family = &off.families[condition.family];
            let own = condition.case.kind.errors();
            let product = |solved: [f64; 2]| own[0] * solved[0] + own[1] * solved[1];
            let shared = |vector| off.variance * product(family.solved(off.variance, vector).0);
            // Row and diagonal of the inverse covariance.
            let pulled = precision * (off_mm - shared(family.pull));
            let diagonal = precision * (1.0 - precision * shared(own));
            let off = pulled / libm::sqrt(diagonal);
            Without {
                off,
                log_density: -0.5 * (off * off - libm::log(diagonal)),
            }
        };
        Some(
            self.conditions
                .iter()
                .zip(&off.of_conditions)
                .map(one)
                .collect(),
        )
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
