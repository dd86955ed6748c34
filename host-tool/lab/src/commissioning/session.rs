//! Carries out the open steps one after the other, and writes the record after each.

use std::path::Path;

use crate::trials::trial::RecordError;
use client::error::ClientError;
use client::visible::wrapped;
use jiff::Timestamp;

use crate::commissioning::halt::Halt;
use crate::commissioning::operator::needs_operator;
use crate::commissioning::procedure::Procedure;
use crate::commissioning::record::{Commissioning, Finding, StepOutcome};
use crate::commissioning::step::{self, ProcedureStep};
use crate::commissioning::work::Work;

#[derive(Debug)]
pub enum Ending {
    Through,
    /// Name of the step that failed, and the defect.
    Defect(&'static str, String),
    /// The operator quit. The step in progress, if any, has no result.
    Aborted(Option<&'static str>),
}

#[derive(Debug)]
pub enum Broken {
    Client(ClientError),
    Record(RecordError),
    FixtureLost(String),
}

/// Line width of the output, columns: fits a terminal of 80.
pub const COLUMNS: usize = 78;

/// Carries out the steps whose results do not hold. A failed step ends the session, because later steps may rely on it.
pub fn carry_out(
    work: &mut Work<'_>,
    record: &mut Commissioning,
    path: &Path,
    now: &dyn Fn() -> Timestamp,
) -> Result<Ending, Broken> {
    let all = step::steps(work.subject.machine);
    let mut procedure = Procedure::new(all);
    while let Some((number, step)) = procedure.next(record, &work.subject) {
        announce(work, number, all.len(), step);
        let (outcome, reason) = match begin(work, step) {
            Ok(()) => (StepOutcome::Passed, None),
            Err(Halt::Defect(why)) => (StepOutcome::Failed, Some(why)),
            Err(Halt::NotShown(why)) => (StepOutcome::NotShown, Some(why)),
            Err(Halt::Aborted) => return Ok(Ending::Aborted(Some(step.name))),
            Err(Halt::Client(error)) => return Err(Broken::Client(error)),
            Err(Halt::FixtureLost(why)) => return Err(Broken::FixtureLost(why)),
        };
        let finding = Finding {
            outcome,
            reason: reason.clone(),
            measured: work.take_measured(),
        };
        tell(work, &finding);
        procedure.enter(record, step, finding, &work.subject, now());
        record.write(path).map_err(Broken::Record)?;
        if outcome == StepOutcome::Failed {
            return Ok(Ending::Defect(step.name, reason.unwrap_or_default()));
        }
        if work.unless_aborted().is_err() {
            return Ok(Ending::Aborted(None));
        }
    }
    Ok(Ending::Through)
}

fn begin(work: &mut Work<'_>, step: &ProcedureStep) -> Result<(), Halt> {
    work.take_measured();
    // Also notices that the operator has quit.
    work.pause(0)?;
    if step.needs_operator && !work.has_operator() {
        return Err(needs_operator());
    }
    (step.check)(work)
}

fn announce(work: &mut Work<'_>, number: usize, count: usize, step: &ProcedureStep) {
    say_wrapped(
        work,
        &format!("[{number}/{count}] {}: {}", step.name, step.shows),
        "  ",
    );
    if !step.observe.is_empty() {
        say_wrapped(work, &format!("  observe: {}", step.observe), "           ");
    }
}

fn tell(work: &mut Work<'_>, finding: &Finding) {
    let numbers: Vec<_> = finding
        .measured
        .iter()
        .map(|(name, value)| match value.as_str() {
            Some(text) => format!("{name} {text}"),
            None => format!("{name} {value}"),
        })
        .collect();
    let outcome = match finding.outcome {
        StepOutcome::Passed => "passed",
        StepOutcome::Failed => "FAILED",
        StepOutcome::NotShown => "not shown",
    };
    if !numbers.is_empty() {
        say_wrapped(work, &format!("  {}", numbers.join(", ")), "  ");
    }
    match &finding.reason {
        None => work.say(&format!("  {outcome}")),
        Some(reason) => say_wrapped(work, &format!("  {outcome}: {reason}"), "    "),
    }
}

fn say_wrapped(work: &mut Work<'_>, text: &str, indent: &str) {
    for line in wrapped(text, COLUMNS, indent) {
        work.say(&line);
    }
}
