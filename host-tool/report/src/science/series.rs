//! The paper's series and free sweeps. The runs are independent, so any number of threads gives the same rows in the
//! same order, bit for bit.

use lab::campaign::plan::Lubrication;
use locomotion::model::{Model, Setting, Value};
use locomotion::paper::{INDENTATIONS_MM, frictions, pressures_pa};
use locomotion::range::OutOfRange;
use locomotion::{folded, roller, tube};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Map, json};

use crate::science::model_file::ModelError;

/// The pressure of the paper's friction series, Pa (section II.B).
pub const FRICTION_SERIES_PA: f64 = 7000.0;
/// Friction with and without lubrication.
pub const LUBRICATION: [(&str, f64); 2] = [
    ("with", Lubrication::Lubricated.friction()),
    ("without", Lubrication::Dry.friction()),
];

pub struct Workers {
    pool: rayon::ThreadPool,
}

impl Workers {
    /// A pool of `threads` threads, by default one per core.
    pub fn new(threads: Option<u16>) -> Result<Self, rayon::ThreadPoolBuildError> {
        let threads = threads.map_or(0, usize::from);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()?;
        Ok(Self { pool })
    }

    /// Applies `work` to all `items`; the results are in the order of the items. Calls `done` after each.
    ///
    /// # Errors
    /// The error of the first item that fails, in the order of the items.
    pub fn map<T: Sync, R: Send>(
        &self,
        items: &[T],
        done: &(dyn Fn() + Sync),
        work: impl Fn(&T) -> Result<R, OutOfRange> + Sync,
    ) -> Result<Vec<R>, OutOfRange> {
        let results: Vec<_> = self.pool.install(|| {
            items
                .par_iter()
                .map(|item| {
                    let result = work(item);
                    done();
                    result
                })
                .collect()
        });
        results.into_iter().collect()
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Case {
    pub friction: f64,
    /// Peristaltic pressure at its peak in the tube, Pa; indentation a_n of the rollers on the rig, mm.
    pub load: f64,
}

/// Every friction with every load; the load varies fastest.
pub fn cases(frictions: &[f64], loads: &[f64]) -> Vec<Case> {
    let with = |&friction: &f64| loads.iter().map(move |&load| Case { friction, load });
    frictions.iter().flat_map(with).collect()
}

/// The paper's friction series: 0.08, 0.085 ... 0.20 at 7000 Pa.
pub fn friction_cases() -> Vec<Case> {
    cases(&frictions().collect::<Vec<_>>(), &[FRICTION_SERIES_PA])
}

/// The paper's pressure series: 3000, 3400 ... 7000 Pa at one friction.
pub fn pressure_cases(friction: f64) -> Vec<Case> {
    cases(&[friction], &pressures_pa().collect::<Vec<_>>())
}

/// The paper's roller series: a_1 to a_5 with and without lubrication.
pub fn lubrication_cases() -> Vec<Case> {
    cases(&LUBRICATION.map(|(_, friction)| friction), &INDENTATIONS_MM)
}

/// A moment of a run in the tube: mean over the placements.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TubeMoment {
    pub friction: f64,
    /// Peristaltic pressure at its peak, Pa.
    pub pressure_pa: f64,
    pub time_s: f64,
    /// Displacement of the tail so far, mm, positive headward.
    pub displacement_mm: f64,
    /// Displacement of the head so far, mm, positive headward.
    pub head_displacement_mm: f64,
}

#[derive(Clone, Debug, PartialEq)]
pub struct TubeRun {
    pub course: Vec<TubeMoment>,
    pub end: TubeRow,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TubeRow {
    pub friction: f64,
    /// Peristaltic pressure at its peak, Pa.
    pub pressure_pa: f64,
    /// Displacement of the tail at the end, mm, positive headward: mean over the placements.
    pub displacement_mm: f64,
    /// Displacement of the head at the end, mm.
    pub head_displacement_mm: f64,
    /// Least displacement of the tail over the placements, mm.
    pub least_mm: f64,
    /// Greatest displacement of the tail over the placements, mm.
    pub greatest_mm: f64,
    /// Number in the paper's text ("about"), mm.
    pub paper_about_mm: Option<f64>,
}

/// Simulates runs in the tube from all placements, and takes their mean.
pub fn tube_run(mut params: tube::Params, case: &Case) -> Result<TubeRun, OutOfRange> {
    params.body.friction = case.friction;
    let start = TubeMoment {
        friction: case.friction,
        pressure_pa: case.load,
        time_s: 0.0,
        displacement_mm: 0.0,
        head_displacement_mm: 0.0,
    };
    let mut course = vec![start; tube::steps(&params) as usize + 1];
    let (mut least_mm, mut greatest_mm) = (f64::INFINITY, f64::NEG_INFINITY);
    let fraction = 1.0 / f64::from(params.placements);
    for placed in tube::placed(params) {
        let mut tube = tube::Tube::new(placed, case.load)?;
        for moment in &mut course[1..] {
            tube.step()?;
            moment.time_s = tube.time_s();
            moment.displacement_mm += fraction * tube.displacement_mm();
            moment.head_displacement_mm += fraction * tube.head_displacement_mm();
        }
        least_mm = least_mm.min(tube.displacement_mm());
        greatest_mm = greatest_mm.max(tube.displacement_mm());
    }
    let last = course.last().copied().unwrap_or(start);
    let end = TubeRow {
        friction: case.friction,
        pressure_pa: case.load,
        displacement_mm: last.displacement_mm,
        head_displacement_mm: last.head_displacement_mm,
        least_mm,
        greatest_mm,
        paper_about_mm: None,
    };
    Ok(TubeRun { course, end })
}

/// The paper's number for the friction series (II.C): about 14 mm at each friction. It is one sentence, not 25
/// values.
pub const PAPER_ON_FRICTION_MM: f64 = 14.0;

/// The ends of these runs of the pressure series, with the paper's numbers (II.C): from about 1 mm to about 15 mm.
pub fn beside_the_paper(runs: &[TubeRun]) -> Vec<TubeRow> {
    let row = |run: &TubeRun| TubeRow {
        paper_about_mm: match run.end.pressure_pa {
            3000.0 => Some(1.0),
            7000.0 => Some(15.0),
            _ => None,
        },
        ..run.end
    };
    runs.iter().map(row).collect()
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RollerRow {
    /// `with` or `without` for the frictions of the paper's two series; else empty.
    pub lubrication: &'static str,
    pub friction: f64,
    /// Indentation of the rollers, the paper's a_n, mm.
    pub indentation_mm: f64,
    /// Displacement of the tail after all cycles, mm, positive headward.
    pub displacement_mm: f64,
    /// Displacement of the head after all cycles, mm: equal to the tail's once the rollers have left the body.
    pub head_displacement_mm: f64,
}

/// Simulates one run on the rig.
pub fn roller_run(mut params: roller::Params, case: &Case) -> Result<RollerRow, OutOfRange> {
    params.body.friction = case.friction;
    let mut body = roller::UnfoldedBody::new(params, case.load)?;
    for _ in 0..params.cycles {
        body.cycle()?;
    }
    let named = LUBRICATION.iter().find(|(_, mu)| *mu == case.friction);
    Ok(RollerRow {
        lubrication: named.map_or("", |(name, _)| name),
        friction: case.friction,
        indentation_mm: case.load,
        displacement_mm: body.displacement_mm(),
        head_displacement_mm: body.head_displacement_mm(),
    })
}

#[derive(Clone, Debug)]
pub struct Axis {
    pub setting: &'static Setting,
    pub values: Vec<f64>,
}

/// A model of a sweep, and the values of its axes by the keys of the parameters.
pub type Variant = (Model, Map<String, serde_json::Value>);

/// A model for each combination of the axes' values; the last axis varies fastest.
pub fn variants(model: &Model, axes: &[Axis]) -> Result<Vec<Variant>, ModelError> {
    let mut all = vec![(*model, Map::new())];
    for Axis { setting, values } in axes {
        let mut next = vec![];
        for (model, of) in &all {
            for value in values {
                let (mut model, mut of) = (*model, of.clone());
                let set = model.set(setting, Value::Number(*value));
                set.map_err(|why| ModelError::Unsuitable {
                    key: setting.key,
                    why,
                })?;
                // Runs already have a column for their friction.
                let name = match setting.key {
                    "body.friction" => "friction",
                    key => key,
                };
                of.insert(name.to_owned(), json!(value));
                next.push((model, of));
            }
        }
        all = next;
    }
    Ok(all)
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SweepRow<R> {
    #[serde(flatten)]
    pub axes: Map<String, serde_json::Value>,
    /// Pressure, Pa, or indentation, mm.
    #[serde(skip)]
    pub load: f64,
    #[serde(skip)]
    pub mm: f64,
    #[serde(flatten)]
    pub run: R,
}

impl<R> SweepRow<R> {
    /// A run with the values of its axes.
    pub fn new(axes: &Map<String, serde_json::Value>, load: f64, mm: f64, run: R) -> Self {
        let axes = axes.clone();
        Self {
            axes,
            load,
            mm,
            run,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FoldRow {
    /// Distance travelled by the carriage, mm.
    pub travel_mm: f64,
    /// Position of the carriage, mm from home (the right end).
    pub carriage_mm: f64,
    /// Displacement of the folded body, mm, positive headward.
    pub folded_mm: f64,
    /// Displacement of the unfolded body, mm, positive headward.
    pub unfolded_mm: f64,
}

/// The fold test: a folded and an unfolded body under the same waves.
#[derive(Clone, Debug, PartialEq)]
pub struct FoldTest {
    /// The folded body and the rig.
    pub params: folded::Params,
    /// How the wave meets the folded body.
    pub contact: folded::Contact,
    /// From the start to the end of the last cycle.
    pub course: Vec<FoldRow>,
}

/// Maximum travel of the carriage between two rows of a fold test, mm.
const FOLD_ROW_MM: f64 = 5.0;

/// The fold test of section III.A, by default with the model's thread drawn in.
pub fn fold_test(
    model: &Model,
    indentation_mm: f64,
    thread_mm: Option<f64>,
) -> Result<FoldTest, OutOfRange> {
    let (unfolded, params) = (model.rig()?, model.folded(thread_mm)?);
    let mut folded = folded::FoldedBody::new(params, indentation_mm)?;
    let mut other = roller::UnfoldedBody::new(unfolded, indentation_mm)?;
    let rows = (params.stroke_mm / FOLD_ROW_MM).ceil() as u32;
    let mut course = vec![];
    for stroke in 0..params.cycles * 2 {
        // The first row of a stroke is the last of the previous one: skip it, except for the first stroke.
        for row in u32::from(stroke > 0)..=rows {
            let gone_mm = params.stroke_mm * f64::from(row) / f64::from(rows);
            let carriage_mm = if stroke % 2 == 0 {
                gone_mm
            } else {
                params.stroke_mm - gone_mm
            };
            folded.carriage_to(carriage_mm)?;
            other.carriage_to(carriage_mm)?;
            course.push(FoldRow {
                travel_mm: f64::from(stroke) * params.stroke_mm + gone_mm,
                carriage_mm,
                folded_mm: folded.displacement_mm(),
                unfolded_mm: other.displacement_mm(),
            });
        }
    }
    Ok(FoldTest {
        params,
        contact: folded.contact(),
        course,
    })
}
