//! The paper's series and free sweeps. The runs are independent, so any number of threads gives the same rows in the same
//! order, bit for bit.

use locomotion::comparison::{INDENTATIONS_MM, frictions, pressures_pa};
use locomotion::range::OutOfRange;
use locomotion::{folded, roller, tube};
use rayon::prelude::*;
use serde::Serialize;

/// The pressure of the paper's friction series, Pa (section II.B).
pub const FRICTION_SERIES_PA: f64 = 7000.0;
/// The friction of the paper's pressure series (section II.B).
pub const PRESSURE_SERIES_FRICTION: f64 = 0.15;
/// Friction of a lubricated and of a dry intestine: the ends of the paper's range \[assumed\].
pub const LUBRICATION: [(&str, f64); 2] = [("with", 0.08), ("without", 0.20)];
/// Step of the roller for isolated passes, mm. Finer than in the series, because a returning pass gives only ripple.
pub const ISOLATED_STEP_MM: f64 = 0.1;

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
    /// Time, s, and displacement of the tail, mm, from the start to the end.
    pub course: Vec<(f64, f64)>,
}

impl TubeRun {
    /// Displacement of the tail at the end, mm, + headward.
    #[must_use]
    pub fn displacement_mm(&self) -> f64 {
        self.course.last().map_or(0.0, |(_, mm)| *mm)
    }
}

/// The paper's friction series: 0.08, 0.085 ... 0.20 at 7000 Pa.
#[must_use]
pub fn friction_cases() -> Vec<TubeCase> {
    let case = |friction| TubeCase {
        friction,
        pressure_pa: FRICTION_SERIES_PA,
    };
    frictions().map(case).collect()
}

/// The paper's pressure series: 3000, 3400 ... 7000 Pa at one friction.
#[must_use]
pub fn pressure_cases(friction: f64) -> Vec<TubeCase> {
    let case = |pressure_pa| TubeCase {
        friction,
        pressure_pa,
    };
    pressures_pa().map(case).collect()
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

/// Simulates one run in the tube.
///
/// # Errors
/// A friction or a pressure that the model does not cover.
pub fn tube_run(case: &TubeCase) -> Result<TubeRun, OutOfRange> {
    let mut params = tube::Params::PAPER;
    params.body.friction = case.friction;
    let mut tube = tube::Tube::new(params, case.pressure_pa)?;
    let steps = (params.duration_s / params.step_s).round() as u32;
    let mut course = vec![(0.0, 0.0)];
    for _ in 0..steps {
        tube.step()?;
        course.push((tube.time_s(), tube.displacement_mm()));
    }
    Ok(TubeRun {
        case: *case,
        course,
    })
}

/// The end of a run in the tube.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TubeRow {
    /// Friction coefficient.
    pub friction: f64,
    /// Peristaltic pressure at its peak, Pa.
    pub pressure_pa: f64,
    /// Displacement of the tail after 20 s, mm, + headward.
    pub displacement_mm: f64,
    /// The paper's text on it ("about"), mm.
    pub paper_about_mm: Option<f64>,
}

/// The ends of runs, each beside the paper's text on it.
#[must_use]
pub fn tube_rows(
    runs: &[TubeRun],
    paper_about_mm: impl Fn(&TubeCase) -> Option<f64>,
) -> Vec<TubeRow> {
    let row = |run: &TubeRun| TubeRow {
        friction: run.case.friction,
        pressure_pa: run.case.pressure_pa,
        displacement_mm: run.displacement_mm(),
        paper_about_mm: paper_about_mm(&run.case),
    };
    runs.iter().map(row).collect()
}

/// The paper's words on the friction series (II.C): about 14 mm at each friction.
#[must_use]
pub fn paper_on_friction_mm(_: &TubeCase) -> Option<f64> {
    Some(14.0)
}

/// The paper's words on the pressure series (II.C): from about 1 mm to about 15 mm.
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
}

/// All moments of the runs.
#[must_use]
pub fn tube_moments(runs: &[TubeRun]) -> Vec<TubeMoment> {
    let moments = |run: &TubeRun| {
        let TubeCase {
            friction,
            pressure_pa,
        } = run.case;
        let moment = move |&(time_s, displacement_mm): &(f64, f64)| TubeMoment {
            friction,
            pressure_pa,
            time_s,
            displacement_mm,
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
    /// Displacement of the tail after five cycles, mm, + headward.
    pub displacement_mm: f64,
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

/// Simulates one run on the rig: five cycles of 130 mm.
///
/// # Errors
/// A friction or an indentation that the model does not cover.
pub fn roller_run(case: &RollerCase) -> Result<RollerRow, OutOfRange> {
    let mut params = roller::Params::PAPER;
    params.body.friction = case.friction;
    Ok(RollerRow {
        lubrication: "",
        friction: case.friction,
        indentation_mm: case.indentation_mm,
        displacement_mm: roller::run(params, case.indentation_mm)?,
    })
}

/// As [`roller_run`], for the two series of [`lubrication_cases`], whose name goes into the row.
///
/// # Errors
/// As [`roller_run`].
pub fn lubricated_run(case: &RollerCase) -> Result<RollerRow, OutOfRange> {
    let named = LUBRICATION.iter().find(|(_, mu)| *mu == case.friction);
    Ok(RollerRow {
        lubrication: named.map_or("", |(name, _)| name),
        ..roller_run(case)?
    })
}

/// One roller pass in each direction over a fresh body.
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
pub fn isolated_run(indentation_mm: &f64) -> Result<IsolatedRow, OutOfRange> {
    let params = roller::Params {
        step_mm: ISOLATED_STEP_MM,
        ..roller::Params::PAPER
    };
    let pass = roller::isolated_pass(params, *indentation_mm)?;
    Ok(IsolatedRow {
        indentation_mm: *indentation_mm,
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

/// Travel of the carriage between two rows of a fold test, mm.
const FOLD_ROW_MM: f64 = 5.0;

/// The fold test of section III.A, by default with 21 mm of thread drawn in.
///
/// # Errors
/// A thread or an indentation that the models do not cover.
pub fn fold_test(indentation_mm: f64, thread_mm: Option<f64>) -> Result<FoldTest, OutOfRange> {
    let unfolded = roller::Params::PAPER;
    let params = match thread_mm {
        None => folded::Params::PAPER,
        Some(mm) => folded::Params::PAPER.folded_by(&unfolded.body.design, mm)?,
    };
    let mut folded = folded::FoldedBody::new(params, indentation_mm)?;
    let mut other = roller::UnfoldedBody::new(unfolded, indentation_mm)?;
    let rows = (params.stroke_mm / FOLD_ROW_MM).round() as u32;
    let mut course = vec![];
    for stroke in 0..params.cycles * 2 {
        // The first row of a stroke is the last of the one before.
        for row in u32::from(stroke > 0)..=rows {
            let gone_mm = f64::from(row) * FOLD_ROW_MM;
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
