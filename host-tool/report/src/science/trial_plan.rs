//! Plans the next trials: candidates, the paper's procedure beside them, and the expected information of each.

use calibration::belief::Belief;
use calibration::design::{Choice, Effort, Estimate, Judged, choose, judge};
use calibration::history::Trial;
use calibration::observation::{Case, Kind, Lubrication};
use calibration::prior::Point;
use calibration::tabulated::Tabulated;
use locomotion::model::Model;
use locomotion::paper::INDENTATIONS_MM;
use locomotion::range::OutOfRange;
use serde::Serialize;

/// Cycles of the paper's run.
pub const PAPER_CYCLES: u16 = 5;
/// Repeats of each of the paper's conditions.
const PAPER_REPEATS: usize = 10;
/// Mean correction of a gain, nats, above which the trials are too exact for the number of draws.
const GREATEST_CORRECTION: f64 = 0.1;

/// Kind, indentation and wall of a trial.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Condition {
    /// Kind and indentation.
    pub case: Case,
    /// The model does not depend on it, but the model's error differs between the walls.
    pub lubrication: Lubrication,
}

/// Trials of one condition.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Planned {
    /// The condition.
    pub condition: Condition,
    /// Number of displacements that are averaged.
    pub repeats: usize,
}

impl Planned {
    /// Standard deviation of each displacement, mm, with readings of `reading_mm`.
    #[must_use]
    pub fn uncertainty_mm(&self, reading_mm: f64) -> f64 {
        self.condition.case.kind.uncertainty_mm(reading_mm)
    }

    /// Standard deviation of the measurement error of their mean, mm.
    fn error_mm(&self, reading_mm: f64) -> f64 {
        self.uncertainty_mm(reading_mm) / (self.repeats as f64).sqrt()
    }
}

/// Options of a plan.
#[derive(Clone, Debug)]
pub struct Asked {
    /// Kinds that may be measured.
    pub kinds: Vec<Kind>,
    /// Indentations that may be set, mm.
    pub indentations_mm: Vec<f64>,
    /// Available walls.
    pub walls: Vec<Lubrication>,
    /// Number of trials to choose.
    pub trials: usize,
    /// Displacements per trial.
    pub repeats: usize,
    /// Standard deviation of a displacement from one reading, mm: [`Kind::uncertainty_mm`].
    pub uncertainty_mm: f64,
    /// Accuracy of the estimates.
    pub effort: Effort,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// A series of trials and its expected information.
#[derive(Clone, Debug)]
pub struct Series {
    /// Name of the series.
    pub name: &'static str,
    /// Its trials.
    pub trials: Vec<Planned>,
    /// Expected information.
    pub judged: Judged,
}

impl Series {
    /// Number of displacements in all trials.
    #[must_use]
    pub fn displacements(&self) -> usize {
        self.trials.iter().map(|one| one.repeats).sum()
    }

    /// Expected information of all trials together, nats.
    #[must_use]
    pub fn sum(&self) -> Estimate {
        self.judged.sums[self.judged.sums.len() - 1]
    }
}

/// The recommended trials, and others for comparison.
#[derive(Clone, Debug)]
pub struct TrialPlan {
    /// All candidates.
    pub candidates: Vec<Condition>,
    /// The choice, step by step.
    pub steps: Vec<Choice>,
    /// Recommended; the paper's procedure with the same number of displacements; the paper's procedure in full.
    pub series: [Series; 3],
    /// Greatest error of the table, mm: root of the mean square over bodies.
    pub table_error_mm: f64,
}

/// The paper's procedure with `displacements` displacements: net displacements at its indentations, dry and
/// lubricated, distributed evenly.
#[must_use]
pub fn paper(displacements: usize) -> Vec<Planned> {
    let walls = [Lubrication::Dry, Lubrication::Lubricated];
    let conditions = walls.into_iter().flat_map(|lubrication| {
        INDENTATIONS_MM.map(|indentation_mm| Condition {
            case: Case {
                kind: Kind::Net {
                    cycles: PAPER_CYCLES,
                },
                indentation_mm,
            },
            lubrication,
        })
    });
    let count = walls.len() * INDENTATIONS_MM.len();
    conditions
        .enumerate()
        .map(|(place, condition)| Planned {
            condition,
            repeats: displacements / count + usize::from(place < displacements % count),
        })
        .filter(|one| one.repeats > 0)
        .collect()
}

/// All possible conditions, wall by wall.
fn candidates(asked: &Asked) -> Vec<Condition> {
    let mut all = vec![];
    for lubrication in &asked.walls {
        for kind in &asked.kinds {
            all.extend(asked.indentations_mm.iter().map(|mm| Condition {
                case: Case {
                    kind: *kind,
                    indentation_mm: *mm,
                },
                lubrication: *lubrication,
            }));
        }
    }
    all
}

/// Makes a plan. None if belief and model hardly overlap.
///
/// # Errors
/// An indentation or a body that the model does not cover.
pub fn plan(base: &Model, belief: &Belief, asked: &Asked) -> Result<Option<TrialPlan>, OutOfRange> {
    let candidates = candidates(asked);
    let displacements = asked.trials * asked.repeats;
    let whole = PAPER_REPEATS * paper(usize::MAX).len();
    let baselines = [paper(displacements), paper(whole)];
    let mut conditions = candidates.clone();
    for one in baselines.iter().flatten() {
        if !conditions.contains(&one.condition) {
            conditions.push(one.condition);
        }
    }
    let mut cases: Vec<Case> = vec![];
    for condition in &conditions {
        if !cases.contains(&condition.case) {
            cases.push(condition.case);
        }
    }
    let tabulated = Tabulated::new(base, &cases, belief, asked.seed)?;
    let response = |point: &Point| tabulated.at(point);
    let place = |all: &[Condition], one: &Condition| all.iter().position(|other| other == one);
    let trial = |planned: &Planned| Trial {
        condition: place(&conditions, &planned.condition).unwrap_or_default(),
        place: (cases.iter())
            .position(|case| *case == planned.condition.case)
            .unwrap_or_default(),
        discrepancies: planned.condition.case.kind.discrepancies(),
        error_mm: planned.error_mm(asked.uncertainty_mm),
    };
    let of = |condition: &Condition| Planned {
        condition: *condition,
        repeats: asked.repeats,
    };
    let trials: Vec<Trial> = candidates.iter().map(|one| trial(&of(one))).collect();
    let (effort, seed) = (&asked.effort, asked.seed);
    let Some(steps) = choose(belief, &response, &trials, asked.trials, effort, seed) else {
        return Ok(None);
    };
    let recommended = steps.iter().map(|step| of(&candidates[step.chosen]));
    let [as_many, all] = baselines;
    let series = [
        ("recommended", recommended.collect()),
        ("paper, as many", as_many),
        ("paper, whole", all),
    ]
    .map(|(name, planned): (_, Vec<Planned>)| {
        let trials: Vec<Trial> = planned.iter().map(trial).collect();
        // Judge by other histories than those that chose. Otherwise a lucky choice would be overrated.
        let judged = judge(belief, &response, &trials, effort, seed ^ AFRESH)?;
        Some(Series {
            name,
            trials: planned,
            judged,
        })
    });
    let [Some(recommended), Some(as_many), Some(all)] = series else {
        return Ok(None);
    };
    Ok(Some(TrialPlan {
        candidates,
        steps,
        series: [recommended, as_many, all],
        table_error_mm: tabulated.errors_mm.iter().copied().fold(0.0, f64::max),
    }))
}

/// Changes a seed, for independent histories.
const AFRESH: u64 = 1 << 62;

/// A row of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrialRow {
    /// Name of the series.
    pub series: &'static str,
    /// Number in it, from 1.
    pub trial: usize,
    /// Kind of displacement, in the words of `fit`.
    pub kind: &'static str,
    /// For `net`: cycles of the run.
    pub cycles: Option<u16>,
    /// For `stroke`: its number.
    pub stroke: Option<u16>,
    /// Indentation, mm.
    pub indentation_mm: f64,
    /// State of the wall.
    pub lubrication: String,
    /// Displacements.
    pub repeats: usize,
    /// Standard deviation of each, mm.
    pub uncertainty_mm: f64,
    /// Expected information on the body, given the trials before, nats.
    pub gain_nats: f64,
    /// Its standard error.
    pub gain_error_nats: f64,
    /// Joint information of this and all trials before, nats.
    pub sum_nats: f64,
    /// Its standard error.
    pub sum_error_nats: f64,
    /// Other candidates with as much information, within the error.
    pub ties: String,
}

/// Kind in the words of `fit`, cycles, stroke. For an odd number of strokes `fit` has no word, and no trial is planned:
/// they come from campaigns.
#[must_use]
pub fn columns(kind: Kind) -> (&'static str, Option<u16>, Option<u16>) {
    match kind {
        Kind::Net { cycles } => ("net", Some(cycles), None),
        Kind::After { strokes } => ("after", None, Some(strokes)),
        Kind::Stroke { number } => ("stroke", None, Some(number)),
        Kind::AntegradePass => ("antegrade_pass", None, None),
        Kind::ReturningPass => ("returning_pass", None, None),
    }
}

impl TrialPlan {
    /// The candidates with as much information as the one of a step, within the error.
    #[must_use]
    pub fn ties(&self, step: usize) -> Vec<String> {
        let name = |place: &usize| {
            let Condition { case, lubrication } = self.candidates[*place];
            let Case {
                kind,
                indentation_mm,
            } = case;
            format!("{kind} at {indentation_mm} mm, {lubrication}")
        };
        let step = self.steps.get(step);
        step.map_or(vec![], |step| step.ties.iter().map(name).collect())
    }

    /// All series as rows, with readings of `reading_mm`.
    #[must_use]
    pub fn rows(&self, reading_mm: f64) -> Vec<TrialRow> {
        let mut rows = vec![];
        for (number, series) in self.series.iter().enumerate() {
            for (place, planned) in series.trials.iter().enumerate() {
                let (kind, cycles, stroke) = columns(planned.condition.case.kind);
                let (gain, sum) = (series.judged.gains[place], series.judged.sums[place]);
                rows.push(TrialRow {
                    series: series.name,
                    trial: place + 1,
                    kind,
                    cycles,
                    stroke,
                    indentation_mm: planned.condition.case.indentation_mm,
                    lubrication: planned.condition.lubrication.to_string(),
                    repeats: planned.repeats,
                    uncertainty_mm: planned.uncertainty_mm(reading_mm),
                    gain_nats: gain.mean,
                    gain_error_nats: gain.error,
                    sum_nats: sum.mean,
                    sum_error_nats: sum.error,
                    ties: if number == 0 {
                        self.ties(place).join("; ")
                    } else {
                        String::new()
                    },
                });
            }
        }
        rows
    }

    /// Whether the number of draws was large enough for trials of this accuracy.
    #[must_use]
    pub fn is_resolved(&self) -> bool {
        self.series
            .iter()
            .all(|one| one.judged.correction <= GREATEST_CORRECTION)
    }
}

/// A displacement to be measured, as a row for `fit`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Empty {
    kind: &'static str,
    cycles: Option<u16>,
    stroke: Option<u16>,
    indentation_mm: f64,
    lubrication: String,
    displacement_mm: Option<f64>,
    uncertainty_mm: f64,
    origin: Option<String>,
    excluded: Option<String>,
}

/// Rows for the displacements of a series, to be filled in, with readings of `reading_mm`.
#[must_use]
pub fn empty(series: &Series, reading_mm: f64) -> Vec<Empty> {
    let of = |planned: &Planned| {
        let (kind, cycles, stroke) = columns(planned.condition.case.kind);
        let row = Empty {
            kind,
            cycles,
            stroke,
            indentation_mm: planned.condition.case.indentation_mm,
            lubrication: planned.condition.lubrication.to_string(),
            displacement_mm: None,
            uncertainty_mm: planned.uncertainty_mm(reading_mm),
            origin: None,
            excluded: None,
        };
        vec![row; planned.repeats]
    };
    series.trials.iter().flat_map(of).collect()
}

#[cfg(test)]
mod tests {
    use calibration::prior::UNKNOWNS;

    use super::*;
    use crate::science::observations;

    /// The first way back is the difference of two readings: to the plan, and to a fit of the rows that were filled in.
    #[test]
    fn a_fit_takes_the_errors_that_the_plan_reckoned_with() {
        let kinds = [
            Kind::Net { cycles: 5 },
            Kind::AntegradePass,
            Kind::ReturningPass,
            Kind::Stroke { number: 1 },
            Kind::Stroke { number: 2 },
        ];
        let planned = |kind| Planned {
            condition: Condition {
                case: Case {
                    kind,
                    indentation_mm: 5.05,
                },
                lubrication: Lubrication::Dry,
            },
            repeats: 1,
        };
        let none = Estimate {
            mean: 0.0,
            error: 0.0,
        };
        let series = Series {
            name: "recommended",
            trials: kinds.map(planned).to_vec(),
            judged: Judged {
                gains: vec![none; kinds.len()],
                sums: vec![none; kinds.len()],
                correction: 0.0,
                before: [none; UNKNOWNS],
                after: [none; UNKNOWNS],
            },
        };
        let mut csv = csv::Writer::from_writer(vec![]);
        for mut row in empty(&series, 0.5) {
            row.displacement_mm = Some(1.0);
            csv.serialize(row).expect("a row");
        }
        let text = csv.into_inner().expect("a table");
        let trials = observations::parse(&text, None).expect("readable");
        let read = trials
            .measured
            .iter()
            .map(|one| one.observation.uncertainty_mm);
        let reckoned = series.trials.iter().map(|one| one.error_mm(0.5));
        let reckoned: Vec<f64> = reckoned.collect();
        assert_eq!(read.collect::<Vec<_>>(), reckoned);
        assert_eq!(reckoned, [0.5, 0.5, 0.5, 0.5, 0.5 * 2f64.sqrt()]);
    }

    #[test]
    fn the_papers_procedure_is_dealt_out_evenly() {
        let repeats = |displacements: usize| -> Vec<usize> {
            paper(displacements).iter().map(|one| one.repeats).collect()
        };
        assert_eq!(repeats(100), [10; 10]);
        assert_eq!(repeats(10), [1; 10]);
        assert_eq!(repeats(13), [2, 2, 2, 1, 1, 1, 1, 1, 1, 1]);
        assert_eq!(repeats(3), [1; 3]);
        let lubricated = paper(10)[9].condition;
        assert_eq!(lubricated.lubrication, Lubrication::Lubricated);
        assert_eq!(lubricated.case.indentation_mm.to_bits(), 5.05f64.to_bits());
    }
}
