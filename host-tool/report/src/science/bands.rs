//! Prior bands: displacements, in one case, of the bodies that agree with the paper's words.

use locomotion::model::Model;
use locomotion::prior::{self, Band, Words, agreeing};
use locomotion::range::OutOfRange;
use locomotion::{roller, tube};

use crate::science::posterior::Posterior;

/// Most cases with bands: each costs some hundred runs.
pub const MOST: usize = 100;
/// Step of the roller, mm, and of the walls, mm: errors of some tenths of a millimetre are invisible in a band.
const ROLLER_STEP_MM: f64 = 0.25;
const WALL_STEP_MM: f64 = 0.08;

/// Standard normal numbers, each in the middle of a tenth of the probability: they stand for the discrepancy of a body
/// without a random number.
const NORMAL: [f64; 10] = [
    -1.644_854, -1.036_433, -0.674_490, -0.385_320, -0.125_661, 0.125_661, 0.385_320, 0.674_490,
    1.036_433, 1.644_854,
];

/// The bands of some cases.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bands {
    of_cases: Vec<(f64, Band)>,
    /// Whether the bodies are those of a posterior; otherwise of the prior.
    pub fitted: bool,
}

impl Bands {
    /// From the cases and each body's displacement in each of them.
    #[must_use]
    pub fn of(cases: &[f64], values: &[Vec<f64>]) -> Self {
        let band = |(place, case): (usize, &f64)| {
            let mut values: Vec<_> = values.iter().map(|body| body[place]).collect();
            Some((*case, Band::of(&mut values)?))
        };
        Self {
            of_cases: cases.iter().enumerate().filter_map(band).collect(),
            fitted: false,
        }
    }

    /// From each fitted body's displacement in each of the cases, with its discrepancy: the standard deviation of the
    /// model's error in a displacement, mm, without the error of measurement.
    #[must_use]
    pub fn with_discrepancy(cases: &[f64], values: &[Vec<f64>], deviations_mm: &[f64]) -> Self {
        let spread = |(values, deviation_mm): (&Vec<f64>, &f64)| {
            let deviation_mm = *deviation_mm;
            let values = values.clone();
            NORMAL.map(|z| values.iter().map(|mm| mm + deviation_mm * z).collect())
        };
        let all: Vec<Vec<f64>> = values.iter().zip(deviations_mm).flat_map(spread).collect();
        Self {
            fitted: true,
            ..Self::of(cases, &all)
        }
    }

    /// The band of a case.
    #[must_use]
    pub fn of_case(&self, case: f64) -> Option<Band> {
        let found = self.of_cases.iter().find(|(other, _)| *other == case);
        found.map(|(_, band)| *band)
    }

    /// The outline of all bands, from left to right and back, for a figure.
    #[must_use]
    pub fn outline(&self) -> Vec<(f64, f64)> {
        let mut sorted = self.of_cases.clone();
        sorted.sort_by(|left, right| left.0.total_cmp(&right.0));
        let low = sorted.iter().map(|(case, band)| (*case, band.low));
        let high = sorted.iter().rev().map(|(case, band)| (*case, band.high));
        low.chain(high).collect()
    }
}

/// The distinct cases, if they are few enough for bands.
#[must_use]
pub fn few(cases: &[f64]) -> Option<Vec<f64>> {
    let mut different = cases.to_vec();
    different.sort_by(f64::total_cmp);
    different.dedup();
    (different.len() <= MOST).then_some(different)
}

/// A body that agrees with the words, and its index among them.
pub type Body = (usize, Model);

/// The model with each of the bodies that agree with the words.
#[must_use]
pub fn bodies(model: &Model, words: Words) -> Vec<Body> {
    agreeing(words)
        .map(|draw| draw.apply(model))
        .enumerate()
        .collect()
}

/// The model with each of the bodies of a posterior.
#[must_use]
pub fn fitted(model: &Model, posterior: &Posterior) -> Vec<Body> {
    posterior.bodies(model).into_iter().enumerate().collect()
}

/// Displacement of a body on the rig at each indentation, mm.
///
/// # Errors
/// An indentation that the model does not cover.
pub fn on_rig((_, model): &Body, indentations_mm: &[f64]) -> Result<Vec<f64>, OutOfRange> {
    let mut params = model.rig()?;
    params.step_mm = params.step_mm.max(ROLLER_STEP_MM);
    indentations_mm
        .iter()
        .map(|a| roller::run(params, *a))
        .collect()
}

/// Displacement of a body in the tube at each pressure, mm. Each body starts at another place, because the paper does
/// not say where its body lay.
///
/// # Errors
/// A pressure that the model does not cover.
pub fn in_tube((number, model): &Body, pressures_pa: &[f64]) -> Result<Vec<f64>, OutOfRange> {
    let params = model.tube()?;
    let place = number % (params.placements.max(1) as usize);
    let mut params = tube::placed(params).nth(place).unwrap_or(params);
    params.wall_step_mm = params.wall_step_mm.max(WALL_STEP_MM);
    pressures_pa
        .iter()
        .map(|pressure_pa| tube::run(params, *pressure_pa))
        .collect()
}

/// A band for people, rounded to its significant digits.
#[must_use]
pub fn text(low: Option<f64>, high: Option<f64>) -> String {
    let number = |mm: f64| match mm.abs() {
        small if small < 10.0 => format!("{:.1}", mm + 0.0),
        _ => format!("{mm:.0}"),
    };
    match (low, high) {
        (Some(low), Some(high)) => format!("{} to {}", number(low), number(high)),
        _ => "-".to_owned(),
    }
}

/// Describes a prior band in a sentence.
#[must_use]
pub fn meaning(words: Words) -> String {
    let (world, kept) = match words {
        Words::Rig => ("rig", prior::kept(words).len()),
        Words::Tube => ("tube", prior::kept(words).len()),
    };
    format!(
        "5 to 95 % of the {kept} bodies, of {} drawn, that agree with the paper's words on the {world}; the words do not say \
         which of them it was",
        prior::DRAWS
    )
}
