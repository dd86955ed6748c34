//! Trials of a body with known parameters, for tests of the calibration.

use std::collections::BTreeMap;

use locomotion::model::Model;
use locomotion::range::OutOfRange;
use rand::Rng;

use crate::chance;
use crate::fit::CONVERGED_STEP_MM;
use crate::observation::{Case, Kind, Lubrication, Notches, Observation};
use crate::prediction::Predictor;
use crate::prior::{Point, discrepancy_mm, parts};

/// Planned trials of one condition.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Planned {
    /// Kind and indentation.
    pub case: Case,
    /// State of the wall.
    pub lubrication: Lubrication,
    /// Number of repeats.
    pub repeats: usize,
    /// Standard deviation of the measurement error, mm.
    pub uncertainty_mm: f64,
}

impl Planned {
    /// Dry trials.
    #[must_use]
    pub const fn dry(kind: Kind, indentation_mm: f64, repeats: usize, uncertainty_mm: f64) -> Self {
        Self {
            case: Case {
                kind,
                indentation_mm,
            },
            lubrication: Lubrication::Dry,
            repeats,
            uncertainty_mm,
        }
    }
}

/// Simulated results of these trials with this body: the model's displacement, plus the model's errors, plus a
/// measurement error per trial. Strokes and nets in one notch and at one wall share the model's errors.
///
/// # Errors
/// A case or a body that the model does not cover.
pub fn observations(
    base: &Model,
    truth: &Point,
    planned: &[Planned],
    random: &mut impl Rng,
) -> Result<Vec<Observation>, OutOfRange> {
    let cases: Vec<Case> = planned.iter().map(|one| one.case).collect();
    let exact = Predictor::new(base, &cases, CONVERGED_STEP_MM)?.displacements_mm(&parts(truth))?;
    Ok(observed(&exact, truth, planned, random))
}

/// As [`observations`], from displacements that are already known.
pub fn observed(
    exact_mm: &[f64],
    truth: &Point,
    planned: &[Planned],
    random: &mut impl Rng,
) -> Vec<Observation> {
    let tau_mm = discrepancy_mm(truth);
    let notches = Notches::of(planned.iter().map(|one| one.case.indentation_mm));
    let mut errors = BTreeMap::new();
    let mut all = vec![];
    for (one, mm) in planned.iter().zip(exact_mm) {
        let Case {
            kind,
            indentation_mm,
        } = one.case;
        let family = (
            kind.is_isolated(),
            one.lubrication,
            notches.number(indentation_mm),
        );
        let own = *errors
            .entry(family)
            .or_insert_with(|| [0; 2].map(|_| tau_mm * chance::normal(random)));
        let [antegrade, returning] = kind.errors();
        let mm = mm + antegrade * own[0] + returning * own[1];
        for _ in 0..one.repeats {
            all.push(Observation {
                kind: one.case.kind,
                lubrication: one.lubrication,
                indentation_mm: one.case.indentation_mm,
                displacement_mm: mm + one.uncertainty_mm * chance::normal(random),
                uncertainty_mm: one.uncertainty_mm,
            });
        }
    }
    all
}
