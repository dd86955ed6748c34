//! Evaluates a campaign: which trials count and why others do not, means, deviations and lines, and the records of
//! rig and capsule for each trial. Its rows are the tables of the report.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use client::identity::{IdentityRecord, Origin};
use client::{limited, plain};
use lab::campaign::CampaignError;
use lab::campaign::contents::Campaign;
use lab::campaign::files::ATTEMPTS;
use lab::campaign::form::Form;
use lab::campaign::ledger::{Attempt, AttemptOutcome, Source, TrialState, TrialStatus};
use lab::campaign::manifest::{self, Manifest};
use lab::campaign::order::Condition;
use lab::campaign::plan::{Lubrication, Millimetres, TrialPurpose};
use lab::campaign::readings::{Quantity, Summary};
use lab::campaign::statistics::{FittedLine, Spread};
use lab::campaign::verify::{Finding, verify};
use lab::trials::check::{self, Defects};
use lab::trials::trial::{Action, RigSample, TrialRecord};
use serde::{Serialize, Serializer};

use crate::figures::{position_at, since};

/// Why a trial that has not begun does not count.
pub(crate) const NOT_DONE: &str = "not done yet";

/// A number printed with `DECIMALS` decimals, the same on the page and in the tables.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rounded<const DECIMALS: usize>(pub f64);

impl<const DECIMALS: usize> std::fmt::Display for Rounded<DECIMALS> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let text = format!("{:.DECIMALS$}", self.0);
        let size = text.trim_start_matches('-');
        let is_zero = size.chars().all(|c| "0.".contains(c));
        f.write_str(if is_zero { size } else { &text })
    }
}

impl<const DECIMALS: usize> Serialize for Rounded<DECIMALS> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// A trial: a row of `report/trials.csv`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrialRow {
    pub trial: u32,
    pub block: u32,
    pub purpose: TrialPurpose,
    pub lubrication: Lubrication,
    pub indentation: String,
    pub shape: Form,
    pub repeat: u32,
    pub counts: bool,
    pub reason: Option<String>,
    /// Whether the trial is done but its record is unreliable.
    #[serde(skip)]
    pub has_defect: bool,
    pub attempts: usize,
    pub attempt: Option<u32>,
    /// Indentation a_n by Eq. 8.
    pub indentation_mm: Option<Millimetres>,
    /// Displacement of the tail, positive headward.
    pub displacement_mm: Option<Millimetres>,
    pub source: Option<Source>,
    pub planned_steps: Option<u64>,
    /// Steps that the generator emitted.
    pub commanded_steps: Option<u64>,
    pub counted_steps: Option<u64>,
    /// Largest residual of the step-loss check.
    pub worst_residual_steps: Option<i32>,
    /// Largest deviation of a sample's position from the plan, in either direction.
    pub greatest_deviation_mm: Option<Rounded<4>>,
    /// Duration of the run by the step timer minus that of the plan, ticks of 10 ns.
    pub late_ticks: Option<i64>,
    /// False pulses on the limit inputs.
    pub glitches: Option<u32>,
    pub holds: Option<u32>,
    pub samples: Option<u64>,
    pub lost_samples: Option<u64>,
    /// Energy of the capsule's motor in this attempt.
    pub energy_mj: Option<u32>,
    /// The telemetry, within the campaign's folder.
    pub telemetry: Option<String>,
    /// Hash according to the manifest.
    pub telemetry_sha256: Option<String>,
    pub origin: Origin,
}

/// Trials of one condition: a row of `report/conditions.csv`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ConditionRow {
    pub purpose: TrialPurpose,
    pub lubrication: Lubrication,
    pub indentation: String,
    pub shape: Form,
    pub planned: usize,
    pub n: usize,
    /// Mean of a_n over the trials that count.
    pub indentation_mm: Option<Rounded<3>>,
    /// Mean of their displacements.
    pub mean_mm: Option<Rounded<3>>,
    pub sd_mm: Option<Rounded<3>>,
    pub origin: Origin,
}

/// A line through displacement over indentation, by the means of the clampings: a row of `report/lines.csv`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LineRow {
    pub lubrication: Lubrication,
    pub n: usize,
    /// Rise, mm of displacement per mm of indentation.
    pub slope: Rounded<4>,
    pub intercept_mm: Rounded<4>,
    /// Fraction of the trials' variance that the line explains.
    pub r_squared: Option<Rounded<4>>,
    /// Standard deviation of the trials about the line.
    pub residual_sd_mm: Option<Rounded<4>>,
    pub origin: Origin,
}

/// An attempt: a row of `report/attempts.csv`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AttemptRow {
    pub trial: u32,
    pub attempt: u32,
    pub began_utc: String,
    pub outcome: Option<AttemptOutcome>,
    /// Whether the trial uses this attempt.
    pub stands: bool,
    /// Why the trial does not use it.
    pub reason: Option<String>,
    pub camera_file: Option<String>,
    pub origin: Origin,
}

/// Accepted readings of one width: a row of `report/readings.csv`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReadingsRow {
    pub readings_set: u32,
    pub quantity: Quantity,
    /// Name of the indentation; empty for the width.
    pub indentation: Option<String>,
    pub n: usize,
    pub mean_mm: Rounded<4>,
    /// Standard deviation of the sample; none for a single reading.
    pub sd_mm: Option<Rounded<4>>,
    /// Greatest reading minus least.
    pub spread_mm: Millimetres,
    /// a_n = (D - i_n)/2 with the last D, Eq. 8.
    pub indentation_mm: Option<Rounded<4>>,
    pub origin: Origin,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    pub sidecar: PathBuf,
    pub trial: TrialRecord,
    pub defects: Defects,
}

#[derive(Clone, Debug)]
pub struct Evaluation {
    pub campaign: Campaign,
    pub origin: Origin,
    pub findings: Vec<Finding>,
    pub manifest: Manifest,
    pub manifest_sha256: String,
    pub trials: Vec<TrialRow>,
    /// The records of each trial, in the same order.
    pub parts: Vec<Vec<Part>>,
    /// All conditions of the plan, including those without a trial that counts.
    pub conditions: Vec<ConditionRow>,
    pub lines: Vec<(LineRow, FittedLine)>,
    pub attempts: Vec<AttemptRow>,
    pub readings: Vec<ReadingsRow>,
    pub devices: Vec<IdentityRecord>,
    /// Names and versions of the tools that recorded.
    pub tools: Vec<String>,
    /// Rig in the records of the attempts that count: name, image, commissioning.
    pub rigs: Vec<[String; 3]>,
}

/// Reads a campaign's folder, verifies it first, and evaluates it.
pub fn evaluate(folder: &Path) -> Result<Evaluation, CampaignError> {
    let findings = verify(folder)?.findings;
    let campaign = Campaign::read(folder)?;
    let manifest = manifest::read(folder)?.unwrap_or_default();
    let manifest_sha256 = manifest::hash_of_all(folder).unwrap_or_default();
    let origin = campaign.origin().unwrap_or(Origin::Unknown);
    let mut evaluation = Evaluation {
        origin,
        findings,
        manifest,
        manifest_sha256,
        trials: vec![],
        parts: vec![],
        conditions: vec![],
        lines: vec![],
        attempts: vec![],
        readings: vec![],
        devices: vec![],
        tools: vec![],
        rigs: vec![],
        campaign: campaign.clone(),
    };
    for state in &campaign.state.trials {
        let parts = parts(&campaign, state);
        let row = evaluation.trial_row(state, &parts);
        evaluation.trials.push(row);
        evaluation.parts.push(parts);
        let attempts = state.attempts.iter();
        evaluation
            .attempts
            .extend(attempts.map(|attempt| attempt_row(state, attempt, origin)));
    }
    evaluation.machines();
    evaluation.conditions = evaluation.condition_rows();
    evaluation.lines = [Lubrication::Dry, Lubrication::Lubricated]
        .into_iter()
        .filter_map(|lubrication| {
            let points = evaluation.points(TrialPurpose::Series, lubrication);
            line(lubrication, &points, origin)
        })
        .collect();
    evaluation.readings = evaluation.reading_rows();
    Ok(evaluation)
}

/// The records in the folder of the attempt that counts.
fn parts(campaign: &Campaign, state: &TrialState) -> Vec<Part> {
    let Some(attempt) = state.attempt() else {
        return vec![];
    };
    let folder = campaign.attempt_folder(state.planned.trial, attempt.number);
    let mut files = plain::files(&folder);
    files.retain(|file| file.extension().is_some_and(|kind| kind == "json"));
    let mut parts: Vec<Part> = files
        .into_iter()
        // Other JSON files are not records of a machine; `verify` checks them.
        .filter_map(|sidecar| Some((TrialRecord::read(&sidecar).ok()?, sidecar)))
        .map(|(trial, sidecar)| {
            let defects = check::record(&sidecar, &trial);
            Part {
                sidecar,
                trial,
                defects,
            }
        })
        .collect();
    // Sort by the capsule's clock, with the run last: the computer's clock may have been set during the trial.
    let is_run = |part: &Part| matches!(part.trial.action, Action::Run { .. });
    parts.sort_by_key(|part| (is_run(part), check::start_us(&part.trial)));
    parts
}

pub fn run_of(parts: &[Part]) -> Option<&Part> {
    parts
        .iter()
        .find(|part| matches!(part.trial.action, Action::Run { .. }))
}

/// Time of a sample in s, and its position minus that of the plan, mm. None for a run that was held or not planned.
pub fn deviation(trial: &TrialRecord) -> Option<impl Fn(&RigSample) -> (f64, f64)> {
    let Action::Run {
        screw,
        requested,
        achieved: Some(achieved),
        executed: Some(executed),
    } = &trial.action
    else {
        return None;
    };
    let start_us = check::start_us(trial)?;
    (executed.holds == 0).then_some(move |sample: &RigSample| {
        let time_s = since(start_us, sample.time_us);
        let planned_mm = position_at(screw, requested, achieved, time_s);
        (time_s, screw.mm(sample.position_steps.into()) - planned_mm)
    })
}

/// (a_n, mean displacement) of each clamping, mm. All trials of one clamping share its a_n and its errors, so these
/// means, not the trials, are independent of each other. Clampings of equal a_n count as one.
pub fn clampings(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut all: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for (a_mm, displacement_mm) in points {
        all.entry(a_mm.to_bits())
            .or_default()
            .push(*displacement_mm);
    }
    all.into_iter()
        .filter_map(|(bits, values)| Some((f64::from_bits(bits), Spread::of(&values)?.mean)))
        .collect()
}

/// Describes the line of [`line`] in a caption. Change both together.
pub(crate) const LINE: &str =
    "The line is that of least squares through the means of the clampings";

/// The line of a series, through the means of its clampings.
fn line(
    lubrication: Lubrication,
    points: &[(f64, f64)],
    origin: Origin,
) -> Option<(LineRow, FittedLine)> {
    let line = FittedLine::through(&clampings(points))?;
    let n = points.len();
    let off = |(a_mm, displacement_mm): &(f64, f64)| displacement_mm - line.at(*a_mm);
    let residual: f64 = points.iter().map(|point| off(point).powi(2)).sum();
    let values: Vec<f64> = points.iter().map(|(_, value)| *value).collect();
    let spread = Spread::of(&values)?.sd.filter(|sd| *sd > 0.0);
    let row = LineRow {
        lubrication,
        n,
        slope: Rounded(line.slope),
        intercept_mm: Rounded(line.intercept),
        r_squared: spread.map(|sd| Rounded(1.0 - residual / (sd.powi(2) * (n - 1) as f64))),
        residual_sd_mm: (n > 2).then(|| Rounded((residual / (n - 2) as f64).sqrt())),
        origin,
    };
    Some((row, line))
}

impl Evaluation {
    /// The file's path within the folder, as in the manifest.
    pub fn within(&self, file: &Path) -> String {
        let file = file.strip_prefix(&self.campaign.folder).unwrap_or(file);
        let parts = file.iter().map(|part| part.to_string_lossy());
        parts.collect::<Vec<_>>().join("/")
    }

    /// The file's hash according to the manifest.
    pub fn hash(&self, file: &Path) -> Option<String> {
        Some(manifest::hex(self.manifest.0.get(&self.within(file))?))
    }

    /// Why a trial does not count according to the ledger; none for one that is done.
    fn not_done(state: &TrialState) -> Option<String> {
        let of = |what: &str, why: &str| match why {
            "" => what.to_owned(),
            why => format!("{what}: {why}"),
        };
        match state.status() {
            TrialStatus::Done => None,
            TrialStatus::Excluded => {
                let why = state.excluded.as_deref().unwrap_or_default();
                Some(of("excluded", why))
            }
            TrialStatus::Skipped => {
                let why = state.skipped.as_deref().unwrap_or_default();
                Some(of("skipped", why))
            }
            TrialStatus::Unmeasured => Some("its displacement is missing".to_owned()),
            TrialStatus::UnderWay => Some("under way".to_owned()),
            TrialStatus::Open => Some(match state.attempts.last() {
                None => NOT_DONE.to_owned(),
                Some(last) => {
                    let outcome = last.outcome.map_or("open", AttemptOutcome::name);
                    format!("no attempt counts; the last one: {outcome}")
                }
            }),
        }
    }

    /// Why the record of a finished trial is unreliable.
    fn record_defect(&self, state: &TrialState, parts: &[Part]) -> Option<String> {
        let attempt = state.attempt()?;
        let folder = format!(
            "{ATTEMPTS}/{}",
            Attempt::folder(state.planned.trial, attempt.number)
        );
        let is_of = |path: &str| {
            let rest = path.strip_prefix(&folder);
            rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
        };
        if let Some(finding) = self.findings.iter().find(|finding| is_of(&finding.path)) {
            return Some(format!(
                "omitted, its record is not as it was written: {finding}"
            ));
        }
        // Missing telemetry leaves the record of the motion valid.
        let contradictions = parts.iter().flat_map(|part| &part.defects.contradictions);
        if let Some(defect) = contradictions.into_iter().next() {
            return Some(format!("omitted, its record contradicts itself: {defect}"));
        }
        match run_of(parts) {
            None => Some("omitted, it has no record of a run".to_owned()),
            Some(run) if run.trial.device.origin != self.origin => Some(format!(
                "omitted, its record is of origin {}, the ledger of origin {}",
                run.trial.device.origin, self.origin
            )),
            Some(_) => None,
        }
    }

    fn trial_row(&self, state: &TrialState, parts: &[Part]) -> TrialRow {
        let planned = &state.planned;
        let attempt = state.attempt();
        let displacement = attempt.and_then(|attempt| attempt.displacement);
        let not_done = Self::not_done(state);
        let record_defect = match not_done {
            None => self.record_defect(state, parts),
            Some(_) => None,
        };
        let has_defect = record_defect.is_some();
        let reason = not_done.or(record_defect);
        let run = run_of(parts);
        let (achieved, executed) = match run.map(|part| &part.trial.action) {
            Some(Action::Run {
                achieved, executed, ..
            }) => (achieved.as_ref(), executed.as_ref()),
            _ => (None, None),
        };
        let deviation_mm = run.and_then(|part| {
            let deviation = deviation(&part.trial)?;
            let mut most: Option<f64> = None;
            check::read(&part.sidecar, &part.trial, |sample| {
                let mm = deviation(&sample).1.abs();
                most = Some(most.map_or(mm, |most| most.max(mm)));
            });
            most
        });
        let energies: Vec<u32> = parts
            .iter()
            .filter_map(|part| match &part.trial.action {
                Action::Actuation { record, .. } => Some(record.as_ref()?.energy_mj),
                _ => None,
            })
            .collect();
        let telemetry = run.map(|part| part.sidecar.with_file_name(&part.trial.telemetry));
        TrialRow {
            trial: planned.trial,
            block: planned.block,
            purpose: planned.purpose,
            lubrication: planned.lubrication,
            indentation: planned.indentation.clone(),
            shape: planned.shape,
            repeat: planned.repeat,
            counts: reason.is_none(),
            reason,
            has_defect,
            attempts: state.attempts.len(),
            attempt: attempt.map(|attempt| attempt.number),
            indentation_mm: attempt.and_then(|attempt| attempt.indentation_mm),
            displacement_mm: displacement.map(|displacement| displacement.value),
            source: displacement.map(|displacement| displacement.source),
            planned_steps: achieved.map(|achieved| achieved.edges),
            commanded_steps: executed.map(|executed| executed.commanded_edges),
            counted_steps: executed.map(|executed| executed.counted_edges),
            worst_residual_steps: executed.map(|executed| executed.worst_residual_steps),
            greatest_deviation_mm: deviation_mm.map(Rounded),
            late_ticks: achieved.zip(executed).map(|(achieved, executed)| {
                executed.ticks.cast_signed() - achieved.total_ticks.cast_signed()
            }),
            glitches: executed.map(|executed| executed.glitches),
            holds: executed.map(|executed| executed.holds),
            samples: run.map(|part| part.trial.samples),
            lost_samples: run.map(|part| part.trial.missed_samples),
            energy_mj: (!energies.is_empty()).then(|| energies.iter().sum()),
            telemetry: telemetry.as_deref().map(|file| self.within(file)),
            telemetry_sha256: telemetry.as_deref().and_then(|file| self.hash(file)),
            origin: self.origin,
        }
    }

    fn machines(&mut self) {
        for part in self.parts.iter().flatten() {
            let device = &part.trial.device;
            if !self.devices.contains(device) {
                self.devices.push(device.clone());
            }
            if !self.tools.contains(&part.trial.tool) {
                self.tools.push(part.trial.tool.clone());
            }
        }
        for state in &self.campaign.state.trials {
            let Some(attempt) = state.attempt() else {
                continue;
            };
            let trial = state.planned.trial;
            let folder = self.campaign.attempt_folder(trial, attempt.number);
            if let Some(rig) = conditions(&folder)
                && !self.rigs.contains(&rig)
            {
                self.rigs.push(rig);
            }
        }
    }

    /// (a_n, displacement) of the trials that count for a purpose, mm.
    pub fn points(&self, purpose: TrialPurpose, lubrication: Lubrication) -> Vec<(f64, f64)> {
        self.trials
            .iter()
            .filter(|row| row.counts && row.purpose == purpose)
            .filter(|row| row.lubrication == lubrication)
            .filter_map(|row| Some((row.indentation_mm?.mm(), row.displacement_mm?.mm())))
            .collect()
    }

    fn condition_rows(&self) -> Vec<ConditionRow> {
        let plan = &self.campaign.plan;
        let mut groups: BTreeMap<_, (Condition, Vec<&TrialRow>)> = BTreeMap::new();
        for (state, row) in self.campaign.state.trials.iter().zip(&self.trials) {
            let condition = state.planned.condition();
            let rank = plan.rank(&condition.indentation);
            let key = (
                condition.purpose,
                condition.lubrication,
                rank,
                condition.shape,
            );
            let group = groups.entry(key).or_insert_with(|| (condition, vec![]));
            group.1.push(row);
        }
        groups
            .into_values()
            .map(|(condition, rows)| {
                let counted: Vec<&&TrialRow> = rows.iter().filter(|row| row.counts).collect();
                // Compute in whole micrometres: the mean is then exact, and `campaign status` rounds the same value.
                let spread_um = |of: fn(&TrialRow) -> Option<Millimetres>| {
                    let values = counted.iter().filter_map(|row| of(row));
                    Spread::of(&values.map(|value| value.um as f64).collect::<Vec<_>>())
                };
                let displacement = spread_um(|row| row.displacement_mm);
                let indentation = spread_um(|row| row.indentation_mm);
                ConditionRow {
                    purpose: condition.purpose,
                    lubrication: condition.lubrication,
                    indentation: condition.indentation,
                    shape: condition.shape,
                    planned: rows.len(),
                    n: counted.len(),
                    indentation_mm: indentation.map(|spread| Rounded(spread.mean / 1e3)),
                    mean_mm: displacement.map(|spread| Rounded(spread.mean / 1e3)),
                    sd_mm: displacement
                        .and_then(|spread| spread.sd)
                        .map(|sd_um| Rounded(sd_um / 1e3)),
                    origin: self.origin,
                }
            })
            .collect()
    }

    fn reading_rows(&self) -> Vec<ReadingsRow> {
        let readings = &self.campaign.readings;
        let sets = readings.sets.iter().filter(|set| set.accepted);
        sets.filter_map(|set| {
            let summary = Summary::of(&set.values)?;
            let indentation_mm = match set.quantity {
                Quantity::Width => None,
                Quantity::BetweenCrests => readings.indentation_mm(set).map(Rounded),
            };
            Some(ReadingsRow {
                readings_set: set.number,
                quantity: set.quantity,
                indentation: set.indentation.clone(),
                n: summary.count,
                mean_mm: Rounded(summary.mean_mm),
                sd_mm: summary.sd_mm.map(Rounded),
                spread_mm: summary.spread(),
                indentation_mm,
                origin: self.origin,
            })
        })
        .collect()
    }
}

/// The rig's state recorded before an attempt; none if it was not recorded.
fn conditions(folder: &Path) -> Option<[String; 3]> {
    let text = plain::read_text(&folder.join("conditions.json"), limited::RECORD).ok()?;
    let conditions: serde_json::Value = serde_json::from_str(&text).ok()?;
    let rig = conditions.get("machines")?.get("rig")?;
    let value = |name: &str| {
        let text = rig.get(name).and_then(serde_json::Value::as_str);
        text.unwrap_or_default().to_owned()
    };
    Some(["name", "image", "commissioning"].map(value))
}

fn attempt_row(state: &TrialState, attempt: &Attempt, origin: Origin) -> AttemptRow {
    let current = state.attempt().map(|attempt| attempt.number);
    AttemptRow {
        trial: state.planned.trial,
        attempt: attempt.number,
        began_utc: attempt.began.to_string(),
        outcome: attempt.outcome,
        stands: current == Some(attempt.number),
        reason: attempt
            .given_up
            .as_ref()
            .map(|why| format!("given up: {why}"))
            .or_else(|| attempt.reason.clone()),
        camera_file: attempt.camera_file.clone(),
        origin,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Five clampings of 10, 10, 10, 1 and 1 trials: the line of their means does not follow those that were repeated
    /// most.
    #[test]
    fn a_clamping_of_many_trials_does_not_pull_the_line() {
        let clamping = |(a_mm, off_mm, n): (f64, f64, usize)| vec![(a_mm, 8.0 * a_mm + off_mm); n];
        let numbers = [
            (1.0, 1.0, 10),
            (2.0, -1.0, 10),
            (3.0, 1.0, 10),
            (4.0, -1.0, 1),
            (5.0, 1.0, 1),
        ];
        let points = numbers.map(clamping).concat();
        let (row, drawn) = line(Lubrication::Dry, &points, Origin::Board).expect("a line");
        assert_eq!(row.n, 32);
        for (found, expected) in [
            (row.slope.0, 8.0),
            (row.intercept_mm.0, 0.2),
            (drawn.at(5.0), 40.2),
        ] {
            assert!((found - expected).abs() < 1e-9, "{found}: {row:?}");
        }
        // The trials' residuals are 0.8 and -1.2 mm, 21 and 11 of them, and their spread is about their own mean.
        let sd = row.residual_sd_mm.expect("32 trials").0;
        let squares: f64 = 21.0 * 0.8_f64.powi(2) + 11.0 * 1.2_f64.powi(2);
        assert!((sd - (squares / 30.0).sqrt()).abs() < 1e-9, "{sd}");
        let rise = |(_, y): &(f64, f64)| *y;
        let mean = points.iter().map(rise).sum::<f64>() / 32.0;
        let all: f64 = points.iter().map(|(_, y)| (y - mean).powi(2)).sum();
        let r_squared = row.r_squared.expect("a spread").0;
        assert!((r_squared - 1.0 + squares / all).abs() < 1e-9, "{row:?}");
    }
}
