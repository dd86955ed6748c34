//! The paper's series and free sweeps. The runs are independent, so any number of threads gives the same rows in the
//! same order, bit for bit.

use locomotion::comparison::frictions;
use locomotion::model::Model;
use locomotion::paper::{INDENTATIONS_MM, pressures_pa};
use locomotion::range::OutOfRange;
use locomotion::{folded, roller, tube};
use rayon::prelude::*;
use serde::Serialize;

use crate::science::bands::Bands;

/// The pressure of the paper's friction series, Pa (section II.B).
pub const FRICTION_SERIES_PA: f64 = 7000.0;
/// Friction of a lubricated and of a dry intestine: the ends of the paper's range \[assumed\].
pub const LUBRICATION: [(&str, f64); 2] = [("with", 0.08), ("without", 0.20)];

/// A pool of threads.
pub struct Workers {
    pool: rayon::ThreadPool,
}

impl Workers {
    /// A pool of `threads` threads, by default one per core.
    ///
    /// # Errors
    /// The system provides no threads.
    pub fn new(threads: Option<u16>) -> Result<Self, rayon::ThreadPoolBuildError> {
        let threads = threads.map_or(0, usize::from);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()?;
        Ok(Self { pool })
    }

    /// Runs `work` with its parallel parts on these threads.
    pub fn install<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        self.pool.install(work)
    }

    /// Applies `work` to all `items`; the results are in the order of the items. Calls `done` after each.
    ///
    /// # Errors
    /// The error of the first item that has one, in the order of the items.
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

/// Parameters of a run in the tube.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TubeCase {
    /// Friction coefficient.
    pub friction: f64,
    /// Peristaltic pressure at its peak, Pa.
    pub pressure_pa: f64,
}

/// A simulated run in the tube.
#[derive(Clone, Debug, PartialEq)]
pub struct TubeRun {
    /// Its parameters.
    pub case: TubeCase,
    /// From the start to the end, mean over the placements.
    pub course: Vec<Moment>,
    /// Least and greatest displacement of the tail at the end over the placements, mm.
    pub range_mm: (f64, f64),
}

/// A moment of a run in the tube.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moment {
    /// Time since the start, s.
    pub time_s: f64,
    /// Displacement of the tail, mm, + headward.
    pub tail_mm: f64,
    /// Displacement of the head, mm, + headward.
    pub head_mm: f64,
}

impl TubeRun {
    /// The end.
    #[must_use]
    pub fn end(&self) -> Moment {
        self.course.last().copied().unwrap_or_default()
    }
}

/// The paper's friction series: 0.08, 0.085 ... 0.20 at 7000 Pa.
#[must_use]
pub fn friction_cases() -> Vec<TubeCase> {
    tube_cases(&frictions().collect::<Vec<_>>(), &[FRICTION_SERIES_PA])
}

/// The paper's pressure series: 3000, 3400 ... 7000 Pa at one friction.
#[must_use]
pub fn pressure_cases(friction: f64) -> Vec<TubeCase> {
    tube_cases(&[friction], &pressures_pa().collect::<Vec<_>>())
}

/// Every friction with every pressure; the pressure varies fastest.
#[must_use]
pub fn tube_cases(frictions: &[f64], pressures_pa: &[f64]) -> Vec<TubeCase> {
    let with = |&friction: &f64| {
        pressures_pa.iter().map(move |&pressure_pa| TubeCase {
            friction,
            pressure_pa,
        })
    };
    frictions.iter().flat_map(with).collect()
}

/// Simulates runs in the tube from all placements, and takes their mean.
///
/// # Errors
/// A friction or a pressure that the model does not cover.
pub fn tube_run(mut params: tube::Params, case: &TubeCase) -> Result<TubeRun, OutOfRange> {
    params.body.friction = case.friction;
    let steps = tube::steps(&params) as usize;
    let mut course = vec![Moment::default(); steps + 1];
    let mut range_mm = (f64::INFINITY, f64::NEG_INFINITY);
    let share = 1.0 / f64::from(params.placements);
    for placed in tube::placed(params) {
        let mut tube = tube::Tube::new(placed, case.pressure_pa)?;
        for moment in &mut course[1..] {
            tube.step()?;
            moment.time_s = tube.time_s();
            moment.tail_mm += share * tube.displacement_mm();
            moment.head_mm += share * tube.head_displacement_mm();
        }
        let end_mm = tube.displacement_mm();
        range_mm = (range_mm.0.min(end_mm), range_mm.1.max(end_mm));
    }
    Ok(TubeRun {
        case: *case,
        course,
        range_mm,
    })
}

/// The end of a run in the tube.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TubeRow {
    /// Friction coefficient.
    pub friction: f64,
    /// Peristaltic pressure at its peak, Pa.
    pub pressure_pa: f64,
    /// Displacement of the tail at the end, mm, + headward: mean over the placements.
    pub displacement_mm: f64,
    /// Displacement of the head at the end, mm.
    pub head_displacement_mm: f64,
    /// Least displacement of the tail over the placements, mm.
    pub least_mm: f64,
    /// Greatest displacement of the tail over the placements, mm.
    pub greatest_mm: f64,
    /// Prior band: 5 % of the bodies that agree with the words move less far, mm.
    pub prior_5_mm: Option<f64>,
    /// Prior band: 95 % of them move less far, mm.
    pub prior_95_mm: Option<f64>,
    /// Number in the paper's text ("about"), mm.
    pub paper_about_mm: Option<f64>,
}

/// The end of each run, with its prior band and the number in the paper's text.
#[must_use]
pub fn tube_rows(
    runs: &[TubeRun],
    bands: &Bands,
    paper_about_mm: impl Fn(&TubeCase) -> Option<f64>,
) -> Vec<TubeRow> {
    let row = |run: &TubeRun| {
        let band = bands.of_case(run.case.pressure_pa);
        TubeRow {
            friction: run.case.friction,
            pressure_pa: run.case.pressure_pa,
            displacement_mm: run.end().tail_mm,
            head_displacement_mm: run.end().head_mm,
            least_mm: run.range_mm.0,
            greatest_mm: run.range_mm.1,
            prior_5_mm: band.map(|band| band.low),
            prior_95_mm: band.map(|band| band.high),
            paper_about_mm: paper_about_mm(&run.case),
        }
    };
    runs.iter().map(row).collect()
}

/// The paper's number for the friction series (II.C): about 14 mm at each friction. It is one sentence, not 25
/// values.
pub const PAPER_ON_FRICTION_MM: f64 = 14.0;

/// The paper's numbers for the pressure series (II.C): from about 1 mm to about 15 mm.
#[must_use]
pub fn paper_on_pressure_mm(case: &TubeCase) -> Option<f64> {
    match case.pressure_pa {
        3000.0 => Some(1.0),
        7000.0 => Some(15.0),
        _ => None,
    }
}

/// A moment of a run in the tube.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TubeMoment {
    /// Friction coefficient.
    pub friction: f64,
    /// Peristaltic pressure at its peak, Pa.
    pub pressure_pa: f64,
    /// Time since the start, s.
    pub time_s: f64,
    /// Displacement of the tail so far, mm, + headward.
    pub displacement_mm: f64,
    /// Displacement of the head so far, mm, + headward.
    pub head_displacement_mm: f64,
}

/// All moments of the runs.
#[must_use]
pub fn tube_moments(runs: &[TubeRun]) -> Vec<TubeMoment> {
    let moments = |run: &TubeRun| {
        let TubeCase {
            friction,
            pressure_pa,
        } = run.case;
        let moment = move |moment: &Moment| TubeMoment {
            friction,
            pressure_pa,
            time_s: moment.time_s,
            displacement_mm: moment.tail_mm,
            head_displacement_mm: moment.head_mm,
        };
        run.course.iter().map(moment).collect::<Vec<_>>()
    };
    runs.iter().flat_map(moments).collect()
}

/// Parameters of a run on the rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RollerCase {
    /// Friction coefficient.
    pub friction: f64,
    /// Indentation of the rollers, the paper's a_n, mm.
    pub indentation_mm: f64,
}

/// A simulated run on the rig.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RollerRow {
    /// `with` or `without` for the paper's two series; empty elsewhere.
    pub lubrication: &'static str,
    /// Friction coefficient.
    pub friction: f64,
    /// Indentation of the rollers, the paper's a_n, mm.
    pub indentation_mm: f64,
    /// Displacement of the tail after all cycles, mm, + headward.
    pub displacement_mm: f64,
    /// Displacement of the head after all cycles, mm: equal to the tail's once the rollers have left the body.
    pub head_displacement_mm: f64,
    /// Prior band: 5 % of the bodies that agree with the words move less far, mm.
    pub prior_5_mm: Option<f64>,
    /// Prior band: 95 % of them move less far, mm.
    pub prior_95_mm: Option<f64>,
    /// Posterior band instead, for a model that was fitted to trials: 5 % of its bodies, with the model's discrepancy, move
    /// less far, mm.
    pub posterior_5_mm: Option<f64>,
    /// 95 % of them move less far, mm.
    pub posterior_95_mm: Option<f64>,
}

impl RollerRow {
    /// The row with the band of its indentation.
    #[must_use]
    pub fn with_band(self, bands: &Bands) -> Self {
        let band = bands.of_case(self.indentation_mm);
        let (low, high) = (band.map(|band| band.low), band.map(|band| band.high));
        if bands.fitted {
            Self {
                posterior_5_mm: low,
                posterior_95_mm: high,
                ..self
            }
        } else {
            Self {
                prior_5_mm: low,
                prior_95_mm: high,
                ..self
            }
        }
    }

    /// Ends of its band: of the posterior or else of the prior.
    #[must_use]
    pub fn band_mm(&self) -> (Option<f64>, Option<f64>) {
        (
            self.prior_5_mm.or(self.posterior_5_mm),
            self.prior_95_mm.or(self.posterior_95_mm),
        )
    }
}

/// The paper's roller series: a_1 to a_5 with and without lubrication.
#[must_use]
pub fn lubrication_cases() -> Vec<RollerCase> {
    roller_cases(&LUBRICATION.map(|(_, friction)| friction), &INDENTATIONS_MM)
}

/// Every friction with every indentation; the indentation varies fastest.
#[must_use]
pub fn roller_cases(frictions: &[f64], indentations_mm: &[f64]) -> Vec<RollerCase> {
    let with = |&friction: &f64| {
        indentations_mm
            .iter()
            .map(move |&indentation_mm| RollerCase {
                friction,
                indentation_mm,
            })
    };
    frictions.iter().flat_map(with).collect()
}

/// Simulates one run on the rig.
///
/// # Errors
/// A friction or an indentation that the model does not cover.
pub fn roller_run(mut params: roller::Params, case: &RollerCase) -> Result<RollerRow, OutOfRange> {
    params.body.friction = case.friction;
    let mut body = roller::UnfoldedBody::new(params, case.indentation_mm)?;
    for _ in 0..params.cycles {
        body.cycle()?;
    }
    Ok(RollerRow {
        lubrication: "",
        friction: case.friction,
        indentation_mm: case.indentation_mm,
        displacement_mm: body.displacement_mm(),
        head_displacement_mm: body.head_displacement_mm(),
        prior_5_mm: None,
        prior_95_mm: None,
        posterior_5_mm: None,
        posterior_95_mm: None,
    })
}

/// As [`roller_run`], for one run of the two series of [`lubrication_cases`]; adds the name of the series and the
/// band.
///
/// # Errors
/// As [`roller_run`].
pub fn lubricated_run(
    params: roller::Params,
    bands: &Bands,
    case: &RollerCase,
) -> Result<RollerRow, OutOfRange> {
    let named = LUBRICATION.iter().find(|(_, mu)| *mu == case.friction);
    Ok(RollerRow {
        lubrication: named.map_or("", |(name, _)| name),
        ..roller_run(params, case)?.with_band(bands)
    })
}

/// Displacements by one roller pass in each direction over a fresh body.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct IsolatedRow {
    /// Indentation of the rollers, mm.
    pub indentation_mm: f64,
    /// Step of the roller in the model, mm.
    pub step_mm: f64,
    /// Displacement by the pass from head to tail, mm, + headward.
    pub antegrade_mm: f64,
    /// Displacement by the pass from tail to head, mm, + headward.
    pub returning_mm: f64,
}

/// Simulates isolated passes at one indentation.
///
/// # Errors
/// An indentation that the model does not cover.
pub fn isolated_run(
    params: roller::Params,
    indentation_mm: f64,
) -> Result<IsolatedRow, OutOfRange> {
    let pass = roller::isolated_pass(params, indentation_mm)?;
    Ok(IsolatedRow {
        indentation_mm,
        step_mm: params.step_mm,
        antegrade_mm: pass.antegrade_mm,
        returning_mm: pass.returning_mm,
    })
}

/// A moment of the fold test.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FoldRow {
    /// Distance travelled by the carriage, mm.
    pub travel_mm: f64,
    /// Position of the carriage, mm from home (the right end).
    pub carriage_mm: f64,
    /// Displacement of the folded body, mm, + headward.
    pub folded_mm: f64,
    /// Displacement of the unfolded body, mm, + headward.
    pub unfolded_mm: f64,
}

/// The fold test: a folded and an unfolded body under the same waves.
#[derive(Clone, Debug, PartialEq)]
pub struct FoldTest {
    /// The folded body and the rig.
    pub params: folded::Params,
    /// Indentation of the rollers, mm.
    pub indentation_mm: f64,
    /// How the wave meets the folded body.
    pub contact: folded::Contact,
    /// From the start to the end of the last cycle.
    pub course: Vec<FoldRow>,
}

/// Travel of the carriage between two rows of a fold test, mm, at most.
const FOLD_ROW_MM: f64 = 5.0;

/// The fold test of section III.A, by default with the model's thread drawn in.
///
/// # Errors
/// A thread or an indentation that the models do not cover.
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
        indentation_mm,
        contact: folded.contact(),
        course,
    })
}
