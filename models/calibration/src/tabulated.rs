//! The model tabulated over all bodies of a belief, and the table's error.

use locomotion::model::Model;
use locomotion::range::OutOfRange;
use rayon::prelude::*;

use crate::belief::Belief;
use crate::chance::stream;
use crate::fit::CONVERGED_STEP_MM;
use crate::observation::Case;
use crate::prediction::Predictor;
use crate::prior::{OF_BODY, Parts, Point, parts};
use crate::table::{Region, Table};

/// Step of the rollers, mm. A plan needs the differences between bodies, not each displacement to a hundredth.
pub const STEP_MM: f64 = 0.25;
/// Nodes of the table.
const NODES: [usize; OF_BODY] = [20, 18, 10];
/// Number of posterior draws that the table has to enclose.
const AROUND: usize = 2_000;
/// Margin of the table around these, to each side, as a share of its width.
const MARGIN: f64 = 0.05;
/// Number of bodies on which the table is checked.
const TRIED: usize = 64;

/// A table and its error.
#[derive(Debug)]
pub struct Tabulated {
    table: Table,
    /// For each case: root of the mean squared error over bodies of the belief, mm, against the converged model.
    pub errors_mm: Vec<f64>,
}

impl Tabulated {
    /// Tabulates these cases over a belief.
    ///
    /// # Errors
    /// A case or a body that the model does not cover.
    pub fn new(
        base: &Model,
        cases: &[Case],
        belief: &Belief,
        seed: u64,
    ) -> Result<Self, OutOfRange> {
        let mut random = stream(seed, u64::MAX);
        let drawn: Vec<Parts> = (0..AROUND)
            .map(|_| parts(&belief.draw(&mut random)))
            .collect();
        let region = match belief {
            Belief::Prior => Region::WHOLE,
            Belief::Smoothed(_) => Region::around(&drawn, MARGIN).unwrap_or(Region::WHOLE),
        };
        let converged = Predictor::new(base, cases, CONVERGED_STEP_MM)?;
        let table = Table::new(converged.with_step(STEP_MM), region, NODES);
        let squares = |body: &Parts| -> Result<Vec<f64>, OutOfRange> {
            let exact = converged.displacements_mm(body)?;
            let read = table.displacements_mm(body);
            let square = |(place, mm): (usize, &f64)| {
                read.as_ref()
                    .map_or(f64::INFINITY, |read| (read[place] - mm).powi(2))
            };
            Ok(exact.iter().enumerate().map(square).collect())
        };
        let found: Vec<Vec<f64>> = drawn[..TRIED]
            .par_iter()
            .map(squares)
            .collect::<Result<_, _>>()?;
        let errors_mm = (0..cases.len())
            .map(|case| {
                let sum: f64 = found.iter().map(|squares| squares[case]).sum();
                libm::sqrt(sum / TRIED as f64)
            })
            .collect();
        Ok(Self { table, errors_mm })
    }

    /// Displacements of all cases at a point, mm; none outside the table.
    #[must_use]
    pub fn at(&self, point: &Point) -> Option<Vec<f64>> {
        self.table.displacements_mm(&parts(point))
    }
}
