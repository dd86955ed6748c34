//! Displacement of a design by one wave, over bodies with unknown coupling, friction ratio and preload, each at
//! another place.

use locomotion::kinematics::Design;
use locomotion::model::Model;
use locomotion::prior::{Words, agreeing};
use locomotion::range::OutOfRange;
use locomotion::roller;

use crate::science::posterior::Posterior;

/// Offset from one starting place to the next, as a share of a spacing: the golden section spreads any number evenly.
const PLACES: f64 = 0.618_033_988_749_894_9;

/// Reference of a displacement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Per {
    /// One wave and its way back.
    Wave,
    /// One wave and its way back, divided by the number of crescents.
    Crescent,
}

impl Per {
    /// The reference in words.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::Wave => "per wave",
            Self::Crescent => "per wave and crescent",
        }
    }
}

/// Accuracy of an evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Care {
    /// For the search: about `SEARCHED` of the bodies and a coarse step. It overestimates all displacements by 0.7 %.
    Searched,
    /// For the table: all bodies, and a step that changes no mean by 0.03 mm.
    Listed,
}

impl Care {
    /// Takes every n-th of `count` bodies, and the step of the roller, mm.
    fn effort(self, count: usize) -> (usize, f64) {
        match self {
            Self::Searched => ((count / SEARCHED).max(1), 0.25),
            Self::Listed => (1, 0.1),
        }
    }
}

/// Approximate number of bodies during the search; all if there are fewer.
const SEARCHED: usize = 48;

/// Bodies on the rig.
#[derive(Clone, Debug)]
pub struct Bodies {
    params: Vec<roller::Params>,
    /// Whether they are those of a posterior; otherwise of the prior.
    fitted: bool,
}

impl Bodies {
    /// The model with each of the bodies that agree with the paper's words on the rig.
    ///
    /// # Errors
    /// A model with a value outside its range.
    pub fn of_prior(model: &Model) -> Result<Self, OutOfRange> {
        let bodies: Result<_, _> = agreeing(Words::Rig)
            .map(|draw| draw.apply(model).rig())
            .collect();
        Ok(Self {
            params: bodies?,
            fitted: false,
        })
    }

    /// The model with each of the bodies of a posterior.
    ///
    /// # Errors
    /// A model with a value outside its range.
    pub fn of_posterior(model: &Model, posterior: &Posterior) -> Result<Self, OutOfRange> {
        let bodies: Result<_, _> = posterior.bodies(model).iter().map(Model::rig).collect();
        Ok(Self {
            params: bodies?,
            fitted: true,
        })
    }

    /// Number of bodies.
    #[must_use]
    pub fn count(&self) -> usize {
        self.params.len()
    }

    /// Whether they are those of a posterior.
    #[must_use]
    pub fn fitted(&self) -> bool {
        self.fitted
    }

    /// Displacement of a design with each body, mm, + headward, by one wave from head to tail and back. The wave
    /// begins and ends clear of the body, so that the ends of a stroke have no effect.
    ///
    /// # Errors
    /// An indentation or a design that the model does not cover.
    pub fn displacements_mm(
        &self,
        design: &Design<f64>,
        indentation_mm: f64,
        per: Per,
        care: Care,
    ) -> Result<Vec<f64>, OutOfRange> {
        let share = match per {
            Per::Wave => 1.0,
            Per::Crescent => 1.0 / f64::from(design.crescents()),
        };
        let length_mm = design.length_mm(0.0)?;
        let (stride, step_mm) = care.effort(self.count());
        self.params
            .iter()
            .enumerate()
            .step_by(stride)
            .map(|(number, body)| {
                let mut params = *body;
                let place = ((number as f64 + 0.5) * PLACES).fract();
                params.body.design = *design;
                params.body.tail_mm = place * design.spacing_mm();
                params.step_mm = params.step_mm.max(step_mm);
                params.stroke_mm = length_mm + design.spacing_mm() + params.radius_mm;
                let pass = roller::isolated_pass(params, indentation_mm)?;
                Ok(share * (pass.antegrade_mm + pass.returning_mm))
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean(values: &[f64]) -> f64 {
        values.iter().sum::<f64>() / values.len() as f64
    }

    /// The paper's design with a fifth of the step, at other places and with longer travel to either side.
    #[test]
    fn step_and_place_hardly_change_the_mean() {
        let design = Design::paper_printed();
        let mut bodies = Bodies::of_prior(&Model::ONE).expect("the default model");
        assert_eq!(bodies.count(), 434);
        let searched = bodies
            .displacements_mm(&design, 5.05, Per::Wave, Care::Searched)
            .expect("the paper's design");
        bodies.params = bodies.params.into_iter().step_by(9).collect();
        let listed = bodies
            .displacements_mm(&design, 5.05, Per::Wave, Care::Listed)
            .expect("the paper's design");
        let fine: Vec<f64> = bodies
            .params
            .iter()
            .map(|body| {
                let mut params = *body;
                params.body.design = design;
                params.body.tail_mm = 0.37;
                params.step_mm = 0.02;
                params.stroke_mm = 130.0;
                let pass = roller::isolated_pass(params, 5.05).expect("the paper's design");
                pass.antegrade_mm + pass.returning_mm
            })
            .collect();
        let (searched_mm, listed_mm, fine_mm) = (mean(&searched), mean(&listed), mean(&fine));
        assert!((listed_mm - fine_mm).abs() < 0.03, "{listed_mm} {fine_mm}");
        assert!(
            (searched_mm - fine_mm).abs() < 0.01 * fine_mm,
            "{searched_mm} {fine_mm}"
        );
        let crescents = bodies
            .displacements_mm(&design, 5.05, Per::Crescent, Care::Listed)
            .expect("the paper's design");
        assert!((mean(&crescents) - listed_mm / 9.0).abs() < 1e-12);
    }
}
