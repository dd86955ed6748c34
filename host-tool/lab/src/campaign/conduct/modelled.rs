//! The modelled displacement of an attempt on the virtual bench, where the rollers touch nothing. The recorded
//! telemetry drives the model, so it follows the actual motion of the carriage.

use std::path::Path;

use crate::campaign::chance::Chance;
use crate::campaign::form::Form;
use crate::campaign::ledger::Source;
use crate::campaign::order::Planned;
use crate::campaign::plan::{CampaignPlan, Millimetres};
use crate::trials::trial::{Action, RecordError, Status, TrialRecord};
use client::plain;
use locomotion::kinematics::Design;
use locomotion::model::Model;
use locomotion::range::OutOfRange;
use locomotion::{folded, roller};

/// Slack of the thread before it pulls, mm: the same as in the bench's capsule.
const SLACK_MM: f64 = 1.0;

#[derive(Debug, thiserror::Error)]
pub(super) enum ModelError {
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error("the model does not cover it: {0}")]
    Range(#[from] OutOfRange),
    #[error("there is no record of a completed fold")]
    NoFold,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Modelled {
    /// The displacement, rounded to the caliper's resolution.
    pub(super) value: Millimetres,
    pub(super) source: Source,
    /// Model and scatter in words, for the record.
    pub(super) text: String,
}

/// The columns of a telemetry row that the model needs.
#[derive(serde::Deserialize)]
struct PositionRow {
    time_us: u64,
    position_steps: i32,
}

/// The modelled displacement of an attempt with this indentation, with the scatter that the plan declares.
pub(super) fn displacement(
    plan: &CampaignPlan,
    planned: &Planned,
    attempt: u32,
    indentation_mm: f64,
    sidecar: &Path,
) -> Result<Modelled, ModelError> {
    let run = TrialRecord::read(sidecar)?;
    let samples: Vec<PositionRow> = run.samples(sidecar)?;
    let Action::Run { screw, .. } = &run.action else {
        return Err(RecordError::read(sidecar, "it is not the record of a run").into());
    };
    let friction = planned.lubrication.friction();
    let positions = |samples: &[PositionRow]| -> Vec<f64> {
        let steps = samples.iter().map(|sample| sample.position_steps);
        steps.map(|steps| screw.mm(f64::from(steps))).collect()
    };
    let unfolded = |samples: &[PositionRow]| -> Result<f64, OutOfRange> {
        // At home, the distance from the rollers to the body's start equals the planned travel.
        let mut params = roller::Params::PAPER;
        params.body.friction = friction;
        params.stroke_mm = stroke_mm(plan);
        let mut body = roller::UnfoldedBody::new(params, indentation_mm)?;
        for position in positions(samples) {
            body.carriage_to(position)?;
        }
        Ok(body.displacement_mm())
    };
    let folded = |samples: &[PositionRow], fold: &Fold, moved_mm: f64| -> Result<f64, OutOfRange> {
        let design = Design::paper_printed();
        let mut params = folded::Params::PAPER.folded_by(&design, fold.thread_mm - SLACK_MM)?;
        params.friction = friction;
        // At the same fraction of the stroke as in the paper.
        params.tail_mm *= stroke_mm(plan) / params.stroke_mm;
        params.stroke_mm = stroke_mm(plan);
        params.tail_mm += moved_mm;
        let mut body = folded::FoldedBody::new(params, indentation_mm)?;
        for position in positions(samples) {
            body.carriage_to(position)?;
        }
        Ok(body.displacement_mm())
    };
    let attempt_folder = sidecar.parent().unwrap_or(sidecar);
    let (mm, name) = match planned.shape {
        Form::Unfolded => (unfolded(&samples)?, "roller model"),
        Form::Folded => {
            let fold = last_fold(attempt_folder)?;
            (folded(&samples, &fold, 0.0)?, "folded block model")
        }
        Form::Folding => {
            let fold = last_fold(attempt_folder)?;
            let cue_us = fold.cue_us.ok_or(ModelError::NoFold)?;
            let (before, after) =
                samples.split_at(samples.partition_point(|sample| sample.time_us < cue_us));
            let moved_mm = unfolded(before)?;
            (
                moved_mm + folded(after, &fold, moved_mm)?,
                "roller model until the fold begins, folded block model from then on",
            )
        }
    };
    Ok(noted(plan, planned, attempt, mm, name, friction))
}

/// Adds the scatter that the plan declares to a displacement, and describes how it was made.
fn noted(
    plan: &CampaignPlan,
    planned: &Planned,
    attempt: u32,
    mut mm: f64,
    name: &str,
    friction: f64,
) -> Modelled {
    let mut text = format!("{name} (model {}), friction {friction}", Model::ONE.name);
    let scatter = plan.virtual_bench;
    let source = if scatter.scatter_mm.um > 0 {
        // The seed does not depend on the session, so an interrupted campaign gives the same values.
        let seed = u64::from(scatter.seed) << 32
            | u64::from(planned.trial) << 8
            | u64::from(attempt & 0xFF);
        mm += scatter.scatter_mm.mm() * Chance::new(seed).normal();
        text.push_str(&format!(
            ", scatter of {} mm added, seed {}",
            scatter.scatter_mm, scatter.seed
        ));
        Source::ModelWithScatter
    } else {
        Source::Model
    };
    let step_um = plan.metadata.caliper_resolution_mm.um.max(1);
    let um = (mm * 1_000.0 / step_um as f64).round() as i64 * step_um;
    Modelled {
        value: Millimetres::from_um(um),
        source,
        text,
    }
}

fn stroke_mm(plan: &CampaignPlan) -> f64 {
    f64::from(plan.run.stroke_um) / 1e3
}

struct Fold {
    thread_mm: f64,
    /// Time of the cue for the fold by the rig's clock, us; none if the fold came before the run.
    cue_us: Option<u64>,
}

fn last_fold(folder: &Path) -> Result<Fold, ModelError> {
    let mut folds = plain::files(folder);
    folds.retain(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("fold-") && name.ends_with(".json")
    });
    for path in folds.iter().rev() {
        let trial = TrialRecord::read(path)?;
        if let (
            Status::Complete,
            Action::Actuation {
                record: Some(record),
                ..
            },
        ) = (trial.status, &trial.action)
        {
            return Ok(Fold {
                thread_mm: f64::from(record.thread_um) / 1_000.0,
                cue_us: trial
                    .coordination
                    .as_ref()
                    .and_then(|tied| tied.cue_time_us),
            });
        }
    }
    Err(ModelError::NoFold)
}
