//! Predictions of the `locomotion` model: one run per indentation gives all its nets and strokes.

use locomotion::model::Model;
use locomotion::range::OutOfRange;
use locomotion::roller::{self, UnfoldedBody};

use crate::observation::{Case, Kind};
use crate::prior::{Parts, with_body};

/// The runs that predict a list of cases.
#[derive(Clone, Debug)]
pub struct Predictor {
    base: Model,
    step_mm: f64,
    cases: Vec<Case>,
    runs: Vec<Run>,
    passes: Vec<Passes>,
}

/// A run at one indentation, and the displacements that it has to give: the index of the case, and the strokes after
/// which it begins and ends.
#[derive(Clone, Debug)]
struct Run {
    indentation_mm: f64,
    asked: Vec<(usize, [usize; 2])>,
}

/// Isolated passes at one indentation, and the indices of the cases that they give.
#[derive(Clone, Debug)]
struct Passes {
    indentation_mm: f64,
    antegrade: Vec<usize>,
    returning: Vec<usize>,
}

/// Strokes of a run after which a displacement of this kind begins and ends; none for an isolated pass.
fn strokes(kind: Kind) -> Option<[usize; 2]> {
    match kind {
        Kind::Net { cycles } => Some([0, 2 * usize::from(cycles)]),
        Kind::After { strokes } => Some([0, strokes.into()]),
        Kind::Stroke { number } => Some([usize::from(number) - 1, number.into()]),
        Kind::AntegradePass | Kind::ReturningPass => None,
    }
}

impl Predictor {
    /// Prepares the runs for these cases, with rig, rollers and design of a model, and a roller step of `step_mm`.
    ///
    /// # Errors
    /// A case that the model does not cover.
    pub fn new(base: &Model, cases: &[Case], step_mm: f64) -> Result<Self, OutOfRange> {
        let mut this = Self {
            base: *base,
            step_mm,
            cases: cases.to_vec(),
            runs: vec![],
            passes: vec![],
        };
        for (place, case) in cases.iter().enumerate() {
            this.add(place, case);
        }
        let mut params = base.rig()?;
        params.step_mm = step_mm;
        for case in cases {
            UnfoldedBody::new(params, case.indentation_mm)?;
        }
        Ok(this)
    }

    fn add(&mut self, place: usize, case: &Case) {
        let indentation_mm = case.indentation_mm;
        let Some(strokes) = strokes(case.kind) else {
            let known = (self.passes.iter()).position(|one| one.indentation_mm == indentation_mm);
            let at = known.unwrap_or_else(|| {
                self.passes.push(Passes {
                    indentation_mm,
                    antegrade: vec![],
                    returning: vec![],
                });
                self.passes.len() - 1
            });
            let passes = &mut self.passes[at];
            match case.kind {
                Kind::ReturningPass => passes.returning.push(place),
                _ => passes.antegrade.push(place),
            }
            return;
        };
        let known = (self.runs.iter()).position(|one| one.indentation_mm == indentation_mm);
        let at = known.unwrap_or_else(|| {
            self.runs.push(Run {
                indentation_mm,
                asked: vec![],
            });
            self.runs.len() - 1
        });
        self.runs[at].asked.push((place, strokes));
    }

    /// The same cases with another step.
    #[must_use]
    pub fn with_step(&self, step_mm: f64) -> Self {
        Self {
            step_mm,
            ..self.clone()
        }
    }

    /// The cases.
    #[must_use]
    pub fn cases(&self) -> &[Case] {
        &self.cases
    }

    /// Displacements of all cases, mm, in their order.
    ///
    /// # Errors
    /// A body that the model does not cover.
    pub fn displacements_mm(&self, body: &Parts) -> Result<Vec<f64>, OutOfRange> {
        let mut params = with_body(&self.base, body).rig()?;
        params.step_mm = self.step_mm;
        let mut found = vec![0.0; self.cases.len()];
        for run in &self.runs {
            let mut unfolded = UnfoldedBody::new(params, run.indentation_mm)?;
            let mut after = vec![0.0];
            let last = run.asked.iter().map(|(_, [_, end])| *end).max();
            for stroke in 0..last.unwrap_or_default() {
                let far = stroke % 2 == 0;
                unfolded.carriage_to(if far { params.stroke_mm } else { 0.0 })?;
                after.push(unfolded.displacement_mm());
            }
            for (place, [begin, end]) in &run.asked {
                found[*place] = after[*end] - after[*begin];
            }
        }
        for passes in &self.passes {
            let pass = roller::isolated_pass(params, passes.indentation_mm)?;
            for place in &passes.antegrade {
                found[*place] = pass.antegrade_mm;
            }
            for place in &passes.returning {
                found[*place] = pass.returning_mm;
            }
        }
        Ok(found)
    }
}
