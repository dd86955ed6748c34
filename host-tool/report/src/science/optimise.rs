//! Inverse design: which designs within limits move farthest for their length, and how certain that is.
//!
//! * [`limits`]: limits on a design, and the values of a design that they apply to.
//! * [`bounds`]: the limits that hold a design back.
//! * [`bodies`]: displacement of a design over all possible bodies and over places.
//! * [`search`]: proposals from a seed, and the Pareto front of several designs.
//!
//! The result is as uncertain as the knowledge of the body. Each design is evaluated with the same bodies, so the
//! share of bodies with which one beats another says how certain that ranking is.

pub mod bodies;
pub mod bounds;
pub mod limits;
pub mod search;

use locomotion::kinematics::Design;
use locomotion::range::OutOfRange;
use serde::Serialize;

use crate::science::optimise::bodies::{Bodies, Care, Per};
use crate::science::optimise::limits::{Limits, Needs};

/// A design with its requirements and its displacement.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DesignRow {
    /// `front`, or the name of the design that the front is compared with.
    pub design: &'static str,
    /// Angle of the short side from the transverse axis, degrees.
    pub alpha_deg: f64,
    /// Angle of the long side, degrees.
    pub beta_deg: f64,
    /// c/W.
    pub core_ratio: f64,
    /// Number m of crescents.
    pub crescents: u8,
    /// Overall length at rest, mm.
    pub length_mm: f64,
    /// Thread that folds it to the required width, mm.
    pub thread_mm: f64,
    /// Displacement of the folded body in a run, mm, + headward: the way back.
    pub folded_mm: f64,
    /// Smaller of the distances psi between crescents, folded and under the wave, mm.
    pub spacing_mm: f64,
    /// Force of the wave on one wing, N, by the beam model.
    pub force_n: f64,
    /// Mean displacement over bodies and places, mm, + headward.
    pub displacement_mm: f64,
    /// 5 % of the bodies that agree with the words move less far, mm.
    pub prior_5_mm: Option<f64>,
    /// 95 % of these bodies move less far, mm.
    pub prior_95_mm: Option<f64>,
    /// The same for bodies of a posterior, in place of the prior's.
    pub posterior_5_mm: Option<f64>,
    /// 95 % of them move less far, mm.
    pub posterior_95_mm: Option<f64>,
    /// Share of the bodies with which it moves farther than the compared design; none for the compared design itself.
    pub beats: Option<f64>,
    /// How many of the listed designs are no longer, move no less far, and are better in one of the two.
    pub dominated_by: usize,
    /// Limits that it breaks; empty for every design of the front.
    pub breaks: String,
    /// Limits without which it would go farther: there the limit decides, not the model. Empty for the compared design.
    pub at_bound: String,
    /// Displacement with each body, in their order.
    #[serde(skip)]
    pub each_mm: Vec<f64>,
}

impl DesignRow {
    /// Evaluates a design with all bodies.
    ///
    /// # Errors
    /// A design that the model does not cover.
    pub fn of(
        name: &'static str,
        design: &Design<f64>,
        limits: &Limits,
        needs: Needs,
        bodies: &Bodies,
        per: Per,
    ) -> Result<Self, OutOfRange> {
        let each_mm = bodies.displacements_mm(design, limits.indentation_mm, per, Care::Listed)?;
        let mut sorted = each_mm.clone();
        let band = locomotion::prior::Band::of(&mut sorted);
        let of = |fitted: bool| band.filter(|_| bodies.fitted() == fitted);
        Ok(Self {
            design: name,
            alpha_deg: design.tan_alpha().atan().to_degrees(),
            beta_deg: design.tan_beta().atan().to_degrees(),
            core_ratio: design.core_mm() / design.width_mm(),
            crescents: design.crescents(),
            length_mm: needs.length_mm,
            thread_mm: needs.thread_mm,
            folded_mm: needs.folded_mm,
            spacing_mm: needs.spacing_mm,
            force_n: needs.force_n,
            displacement_mm: mean(&each_mm),
            prior_5_mm: of(false).map(|band| band.low),
            prior_95_mm: of(false).map(|band| band.high),
            posterior_5_mm: of(true).map(|band| band.low),
            posterior_95_mm: of(true).map(|band| band.high),
            beats: None,
            dominated_by: 0,
            breaks: limits.broken(design, &needs).join(", "),
            at_bound: String::new(),
            each_mm,
        })
    }

    /// Band over the bodies, mm, of the posterior or else of the prior.
    #[must_use]
    pub fn band_mm(&self) -> (Option<f64>, Option<f64>) {
        (
            self.prior_5_mm.or(self.posterior_5_mm),
            self.prior_95_mm.or(self.posterior_95_mm),
        )
    }

    /// Share of the bodies with which this design moves farther than the other one.
    #[must_use]
    pub fn share_beating(&self, other: &Self) -> f64 {
        let pairs = self.each_mm.iter().zip(&other.each_mm);
        let better = pairs.filter(|(mine, others)| mine > others).count();
        better as f64 / self.each_mm.len().max(1) as f64
    }

    /// Whether it is no longer and moves no less far than the other, and is better in one of them.
    #[must_use]
    pub fn dominates(&self, other: &Self) -> bool {
        search::dominates(self.place(), other.place())
    }

    /// Length and displacement.
    fn place(&self) -> (f64, f64) {
        (self.length_mm, self.displacement_mm)
    }
}

/// The designs that no other one dominates, sorted by length, then the compared one. Fills in how they compare with
/// each other.
#[must_use]
pub fn ranked(candidates: Vec<DesignRow>, compared: DesignRow) -> Vec<DesignRow> {
    let places: Vec<_> = candidates.iter().map(DesignRow::place).collect();
    let kept = search::front(&places);
    let mut rows: Vec<_> = kept
        .into_iter()
        .map(|index| candidates[index].clone())
        .collect();
    for row in &mut rows {
        row.beats = Some(row.share_beating(&compared));
    }
    rows.push(compared);
    let counts: Vec<_> = rows
        .iter()
        .map(|row| rows.iter().filter(|other| other.dominates(row)).count())
        .collect();
    for (row, count) in rows.iter_mut().zip(counts) {
        row.dominated_by = count;
    }
    rows
}

/// The mean; NaN for no values.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The design of the front to use instead of the compared one: the farthest moving that is no longer.
#[must_use]
pub fn instead_of<'a>(front: &'a [DesignRow], compared: &DesignRow) -> Option<&'a DesignRow> {
    front
        .iter()
        .filter(|row| row.length_mm <= compared.length_mm)
        .max_by(|left, right| left.displacement_mm.total_cmp(&right.displacement_mm))
}
