//! Whether displacements can be in millimetres, with + headward: data in another unit or with the opposite sign is
//! refused, because a large enough discrepancy would explain it.
//!
//! Data are refused if no body explains them as they are, and a body explains them well after a change of sign or
//! unit. What is left after the change has to be a movement: a body that stands still explains anything that is made
//! small enough.

use crate::chance::{Random, stream};
use crate::descent::{Place, lowest};
use crate::observation::Condition;
use crate::prior::{OF_BODY, Point, UNKNOWNS, discrepancy_mm, draw, parts};
use crate::table::Table;

/// A mistake in writing displacements down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mistake {
    /// Factor that corrects the displacements.
    pub factor: f64,
    /// The mistake, in words.
    pub what: &'static str,
}

/// The mistakes that are recognised.
const MISTAKES: [Mistake; 4] = [
    Mistake {
        factor: -1.0,
        what: "their signs are reversed: + is headward",
    },
    Mistake {
        factor: 10.0,
        what: "they are in centimetres: write millimetres",
    },
    Mistake {
        factor: 1e3,
        what: "they are in metres: write millimetres",
    },
    Mistake {
        factor: 1e-3,
        what: "they are in micrometres: write millimetres",
    },
];

/// Bodies of the prior among which the search begins.
const BODIES: usize = 400;
/// Bodies from which it descends.
const STARTS: usize = 6;
/// First steps of a descent, in standard deviations of the prior.
const WIDTH: Place = [0.2; OF_BODY];
/// Squared error per condition above which data is suspected, in variances of its uncertainty and the discrepancy's
/// median together: twice the standard deviation.
const SUSPECTED: f64 = 4.0;
/// A correction has to divide the squared error by this.
const BETTER: f64 = 10.0;

/// The mistake that explains the data, if there is one.
#[must_use]
pub fn mistake(
    conditions: &[Condition],
    places: &[usize],
    table: &Table,
    seed: u64,
) -> Option<Mistake> {
    let tau_mm = discrepancy_mm(&[0.0; UNKNOWNS]);
    let search = Search::new(conditions, places, table, seed, tau_mm);
    search.explains(search.misfit(1.0))
}

/// Like [`mistake`], without the discrepancy, which hides a wrong unit that makes all displacements small. `chi_square`
/// is that of the nearest body, also without it. `table` is that of the whole prior.
#[must_use]
pub fn mistake_beside(
    chi_square: f64,
    conditions: &[Condition],
    places: &[usize],
    table: &Table,
    seed: u64,
) -> Option<Mistake> {
    let as_written = chi_square / conditions.len() as f64;
    Search::new(conditions, places, table, seed, 0.0).explains(as_written)
}

/// The search for the body nearest to corrected data.
struct Search<'a> {
    conditions: &'a [Condition],
    places: &'a [usize],
    table: &'a Table,
    /// Discrepancy that counts as an error, mm.
    tau_mm: f64,
    /// Bodies of the prior, with their displacements.
    bodies: Vec<(Place, Vec<f64>)>,
}

impl<'a> Search<'a> {
    fn new(
        conditions: &'a [Condition],
        places: &'a [usize],
        table: &'a Table,
        seed: u64,
        tau_mm: f64,
    ) -> Self {
        let mut random: Random = stream(seed, u64::MAX - 2);
        let body = |_| {
            let point = draw(&mut random);
            let found = table.displacements_mm(&parts(&point))?;
            Some((core::array::from_fn(|axis| point[axis]), found))
        };
        Self {
            conditions,
            places,
            table,
            tau_mm,
            bodies: (0..BODIES).filter_map(body).collect(),
        }
    }

    /// Squared error per condition of displacements times a factor.
    fn square(&self, factor: f64, found_mm: &[f64]) -> f64 {
        let one = |(condition, place): (&Condition, &usize)| {
            let own_mm = factor * condition.uncertainty_mm;
            let model_mm = condition.case.kind.discrepancies() * self.tau_mm;
            let off_mm = factor * condition.mean_mm - found_mm[*place];
            (off_mm / libm::hypot(own_mm, model_mm)).powi(2)
        };
        let all = self.conditions.iter().zip(self.places).map(one);
        all.sum::<f64>() / self.conditions.len() as f64
    }

    /// The same of the body that comes nearest.
    fn misfit(&self, factor: f64) -> f64 {
        let mut all: Vec<(f64, Place)> = (self.bodies.iter())
            .map(|(place, found)| (self.square(factor, found), *place))
            .collect();
        all.sort_by(|one, other| one.0.total_cmp(&other.0));
        let of = |place: &Place| {
            let found = self.table.displacements_mm(&parts(&with_tau(place)));
            found.map_or(f64::INFINITY, |found| self.square(factor, &found))
        };
        all.iter()
            .take(STARTS)
            .map(|(_, start)| lowest(&of, start, &WIDTH).1)
            .fold(f64::INFINITY, f64::min)
    }

    fn explains(&self, as_written: f64) -> Option<Mistake> {
        // NaN is not suspected either: there is no body to compare with.
        if as_written.partial_cmp(&SUSPECTED) != Some(core::cmp::Ordering::Greater) {
            return None;
        }
        let still = vec![0.0; self.places.iter().max().map_or(0, |last| last + 1)];
        MISTAKES
            .into_iter()
            .filter(|mistake| self.square(mistake.factor, &still) > SUSPECTED)
            .map(|mistake| (self.misfit(mistake.factor), mistake))
            .min_by(|one, other| one.0.total_cmp(&other.0))
            .filter(|(corrected, _)| *corrected < as_written / BETTER && *corrected < SUSPECTED)
            .map(|(_, mistake)| mistake)
    }
}

/// A point with the discrepancy's median.
fn with_tau(place: &Place) -> Point {
    core::array::from_fn(|axis| place.get(axis).copied().unwrap_or(0.0))
}
