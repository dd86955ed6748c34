//! The range that the paper's words leave: bodies drawn from declared priors, kept if they agree with its sentences.
//!
//! The paper's text gives no millimetres for the rig's displacement. The band of all bodies that agree with its words
//! shows how little a single number means. This is rejection sampling: one seeded stream makes [`draws`] from
//! [`PRIORS`], and [`agrees`] is the test. The outcome takes seconds to compute, so it is stored as lists of draw
//! numbers; a test repeats the computation. Rig and tube are judged separately: that one body serves both is our
//! assumption, not a sentence of the paper.

mod kept;

use rand_core::{Rng, SeedableRng};
use rand_xorshift::XorShiftRng;

use crate::model::{Model, Setting, Value};
use crate::paper::{INDENTATIONS_MM, pressures_pa};
use crate::range::OutOfRange;
use crate::{roller, trend, tube};

/// Seed of the stream.
pub const SEED: u64 = 2022;
/// Number of draws.
pub const DRAWS: u16 = 4000;

/// Assumption about one parameter before any sentence is read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prior {
    /// The parameter, as in a model file.
    pub key: &'static str,
    /// Least value.
    pub low: f64,
    /// Greatest value.
    pub high: f64,
    /// Uniform in the logarithm; otherwise uniform in the value.
    pub logarithmic: bool,
    /// Reason for the range.
    pub because: &'static str,
}

/// The parameters that the paper's text leaves open, and their ranges, all assumed.
pub const PRIORS: [Prior; 5] = [
    Prior {
        key: "body.coupling",
        low: 0.03,
        high: 1.0,
        logarithmic: true,
        because: "1: the whole indentation reaches a crescent",
    },
    Prior {
        key: "body.friction_ratio",
        low: 1.2,
        high: 200.0,
        logarithmic: true,
        because: "from rigid facets at mu = 0.15, 1.22, to hooks that hardly slip back",
    },
    Prior {
        key: "body.preload_mm",
        low: 1e-4,
        high: 0.2,
        logarithmic: true,
        because: "W = D to the accuracy of the print, 0.15 mm",
    },
    Prior {
        key: "tube.critical_pa",
        low: 7000.0,
        high: 7500.0,
        logarithmic: false,
        because: "above 7000 Pa the wall is severely shrunk",
    },
    Prior {
        key: "tube.buckling_mm",
        low: 0.01,
        high: 0.5,
        logarithmic: true,
        because: "slight at 3000 Pa, severe at 7000 Pa",
    },
];

/// The sentences that a body has to agree with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Words {
    /// On the rig, sections III and III.A.
    Rig,
    /// On the tube, sections II.B and II.C.
    Tube,
}

/// "Hardly": a return pass moves the body by at most this share of an antegrade pass, at each indentation.
pub const HARDLY: f64 = 0.2;
/// "Approximately linearly": R^2 of a line through the five indentations.
pub const LINEAR: f64 = 0.95;
/// "About 1 mm" at 3000 Pa.
pub const ABOUT_1_MM: (f64, f64) = (0.5, 1.5);
/// "About 14 mm" and "about 15 mm" at 7000 Pa: the paper gives both for one case.
const ABOUT_15_MM: (f64, f64) = (13.0, 16.0);
/// "Faster" from about 6000 Pa: slope above 5800 Pa over the slope below.
pub const FASTER: f64 = 1.5;

/// Steps of the models when a draw is tested: coarse, for speed. The errors, at most 0.3 mm, are small against the
/// bands.
const ROLLER_STEP_MM: f64 = 0.25;
const WALL_STEP_MM: f64 = 0.08;
const PLACEMENTS: u32 = 4;

/// The rig with the coarse step for many bodies.
pub(crate) const fn rough_rig(params: roller::Params) -> roller::Params {
    roller::Params {
        step_mm: ROLLER_STEP_MM,
        ..params
    }
}

/// The tube with the coarse steps for many bodies.
pub(crate) const fn rough_tube(params: tube::Params) -> tube::Params {
    tube::Params {
        wall_step_mm: WALL_STEP_MM,
        placements: PLACEMENTS,
        ..params
    }
}

/// One set of values for [`PRIORS`], in their order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draw {
    /// Its number in the stream.
    pub index: u16,
    /// The values.
    pub values: [f64; PRIORS.len()],
}

impl Draw {
    /// The model with these values in place of its own.
    pub fn apply(&self, model: &Model) -> Model {
        let mut drawn = *model;
        for (prior, value) in PRIORS.iter().zip(self.values) {
            if let Some(setting) = Setting::named(prior.key) {
                // Cannot fail: all of them take numbers, as the test `every_prior_is_a_parameter` checks.
                let _ = drawn.set(setting, Value::Number(value));
            }
        }
        drawn
    }
}

/// All draws.
pub fn draws() -> impl Iterator<Item = Draw> {
    let mut random = XorShiftRng::seed_from_u64(SEED);
    (0..DRAWS).map(move |index| Draw {
        index,
        values: PRIORS.map(|prior| {
            // 53 random bits, uniform from 0 to 1.
            let part = (random.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
            if prior.logarithmic {
                prior.low * libm::exp(part * libm::log(prior.high / prior.low))
            } else {
                prior.low + part * (prior.high - prior.low)
            }
        }),
    })
}

/// The draws that agree with the words.
pub fn agreeing(words: Words) -> impl Iterator<Item = Draw> {
    let mut kept = kept(words).iter().copied().peekable();
    draws().filter(move |draw| kept.next_if_eq(&draw.index).is_some())
}

/// Numbers of the draws that agree with the words.
pub fn kept(words: Words) -> &'static [u16] {
    match words {
        Words::Rig => &kept::RIG,
        Words::Tube => &kept::TUBE,
    }
}

/// Whether a model agrees with the words.
///
/// # Errors
/// A model with a value outside its range.
pub fn agrees(words: Words, model: &Model) -> Result<bool, OutOfRange> {
    match words {
        Words::Rig => agrees_on_rig(model),
        Words::Tube => agrees_on_tube(model),
    }
}

fn agrees_on_rig(model: &Model) -> Result<bool, OutOfRange> {
    let params = rough_rig(model.rig()?);
    // Begin with the deepest: it rejects most draws.
    for a in INDENTATIONS_MM.into_iter().rev() {
        let pass = roller::isolated_pass(params, a)?;
        if pass.antegrade_mm <= 0.0 || libm::fabs(pass.returning_mm) > HARDLY * pass.antegrade_mm {
            return Ok(false);
        }
    }
    let mut series = [0.0; INDENTATIONS_MM.len()];
    for (mm, a) in series.iter_mut().zip(INDENTATIONS_MM) {
        *mm = roller::run(params, a)?;
    }
    let points = INDENTATIONS_MM.into_iter().zip(series);
    Ok(series[0] > 0.0
        && trend::rising(&series) == series.len() - 1
        && trend::linearity(points) >= LINEAR)
}

fn agrees_on_tube(model: &Model) -> Result<bool, OutOfRange> {
    let params = rough_tube(model.tube()?);
    let about = |pressure_pa: f64, (low, high): (f64, f64)| -> Result<Option<f64>, OutOfRange> {
        let mm = tube::averaged(params, pressure_pa)?.tail_mm;
        Ok((low..=high).contains(&mm).then_some(mm))
    };
    let Some(first) = about(3000.0, ABOUT_1_MM)? else {
        return Ok(false);
    };
    let Some(last) = about(7000.0, ABOUT_15_MM)? else {
        return Ok(false);
    };
    let mut series = [first; 11];
    for (mm, pressure_pa) in series.iter_mut().zip(pressures_pa()).skip(1) {
        *mm = tube::averaged(params, pressure_pa)?.tail_mm;
    }
    series[10] = last;
    let below = (series[7] - series[0]) / 2800.0;
    let above = (series[10] - series[7]) / 1200.0;
    // Test curvature as a trend of the whole series: nine tips leave a ripple on the single bends.
    let curved = series[10] - series[5] > series[5] - series[0];
    Ok(trend::rising(&series) == 10 && curved && above >= FASTER * below)
}

/// Range of a quantity over the draws that agree: from 5 to 95 % of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Band {
    /// 5 % of the draws lie below.
    pub low: f64,
    /// Median.
    pub median: f64,
    /// 95 % of the draws lie below.
    pub high: f64,
    /// Least and greatest value.
    pub range: (f64, f64),
    /// Number of draws.
    pub sets: usize,
}

impl Band {
    /// The band of these values, which it sorts; none without values.
    pub fn of(values: &mut [f64]) -> Option<Self> {
        values.sort_unstable_by(f64::total_cmp);
        let last = values.len().checked_sub(1)?;
        let at = |part: f64| values[libm::round(part * last as f64) as usize];
        Some(Self {
            low: at(0.05),
            median: at(0.5),
            high: at(0.95),
            range: (values[0], values[last]),
            sets: values.len(),
        })
    }
}
