//! The model's band behind the displacements of a campaign: the range left by the paper's words or by a calibration.

use lab::campaign::files::TRIALS;
use lab::campaign::manifest::hex;
use lab::campaign::plan::{Lubrication, Purpose};
use locomotion::model::{Model, Setting, Value};
use locomotion::prior::{Words, agreeing};
use rayon::prelude::*;

use crate::html::evaluation::Evaluation;
use crate::science::bands::{self, Bands, Body};
use crate::science::posterior::Posterior;

/// Label of a band whose bodies are those of a calibration.
pub(crate) const FITTED_BAND: &str = "model, 5 to 95 % of fitted bodies";

/// Most bodies for a band: more of them move its edges by less than the width of the line.
const MOST_BODIES: usize = 110;
/// Number of indentations at which the band is computed.
const DEPTHS: u32 = 5;

/// Origin of the bodies of a band.
#[derive(Clone, Debug)]
pub struct BandSource {
    /// Design and rig.
    pub model: Model,
    /// Bodies of a calibration; without it, those that agree with the paper's words.
    pub posterior: Option<Posterior>,
}

impl Default for BandSource {
    fn default() -> Self {
        Self {
            model: Model::ONE,
            posterior: None,
        }
    }
}

impl BandSource {
    /// At most `MOST_BODIES` of the bodies, evenly taken, and a sentence that describes them.
    fn bodies(&self, model: &Model) -> (Vec<Body>, String) {
        let (all, of) = match &self.posterior {
            Some(posterior) => (bands::fitted(model, posterior), posterior.what()),
            None => (
                bands::bodies(model, Words::Rig),
                format!(
                    "the {} bodies that agree with the paper's words on the rig",
                    agreeing(Words::Rig).count()
                ),
            ),
        };
        let some: Vec<Body> = all
            .iter()
            .step_by(all.len().div_ceil(MOST_BODIES).max(1))
            .copied()
            .collect();
        let what = format!("{} of {of}", some.len());
        (some, what)
    }
}

/// A band with its descriptions.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelBand {
    /// From left to right and back: indentation and displacement, mm.
    pub outline: Vec<(f64, f64)>,
    /// For the figure.
    pub label: &'static str,
    /// For the caption.
    pub meaning: String,
}

/// The band of a campaign's net displacement, from its least indentation to its greatest. None with fewer than two
/// indentations, or if the model does not cover them.
#[must_use]
pub fn band(evaluation: &Evaluation, source: &BandSource) -> Option<ModelBand> {
    let walls = [Lubrication::Dry, Lubrication::Lubricated];
    let depths: Vec<f64> = walls
        .into_iter()
        .flat_map(|wall| evaluation.points(Purpose::Series, wall))
        .map(|(a_mm, _)| a_mm)
        .collect();
    let least = depths.iter().copied().reduce(f64::min)?;
    let greatest = depths.iter().copied().reduce(f64::max)?;
    if least >= greatest {
        return None;
    }
    let share = |place: u32| f64::from(place) / f64::from(DEPTHS - 1);
    let at: Vec<f64> = (0..DEPTHS)
        .map(|place| least + (greatest - least) * share(place))
        .collect();
    let run = &evaluation.campaign.plan.run;
    let mut model = source.model;
    for (key, value) in [
        ("rig.stroke_mm", f64::from(run.stroke_um) / 1_000.0),
        ("rig.cycles", run.cycles.into()),
    ] {
        model.set(Setting::named(key)?, Value::Number(value)).ok()?;
    }
    let (bodies, of) = source.bodies(&model);
    let found: Vec<Vec<f64>> = bodies
        .par_iter()
        .map(|body| bands::on_rig(body, &at).ok())
        .collect::<Option<_>>()?;
    let fitted_to_these = match &source.posterior {
        Some(posterior) if rests_on(posterior, evaluation) => {
            " It was fitted to these very trials: that they lie in it is no evidence."
        }
        _ => "",
    };
    let outline = Bands::of(&at, &found).outline();
    let heights = || outline.iter().map(|point| point.1);
    let (low, high) = (heights().reduce(f64::min)?, heights().reduce(f64::max)?);
    Some(ModelBand {
        outline,
        label: match source.posterior {
            Some(_) => FITTED_BAND,
            None => "model, 5 to 95 % of bodies that fit the paper's words",
        },
        meaning: format!(
            "The grey area is a model's, not validated against a rig: net displacement of 5 to 95 % of {of}, each under rollers \
             that go as the plan says. It goes from {low:.1} to {high:.1} mm; the plot shows as much of it as lies beside the trials.{fitted_to_these}"
        ),
    })
}

/// Whether a posterior was fitted to trials of this campaign.
fn rests_on(posterior: &Posterior, evaluation: &Evaluation) -> bool {
    let Some(hash) = evaluation.manifest.0.get(TRIALS) else {
        return false;
    };
    let hash = hex(hash);
    let sources = posterior.source.iter().flat_map(|source| &source.sha256);
    sources.into_iter().any(|listed| listed.starts_with(&hash))
}
