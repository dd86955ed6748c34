//! Checks a record: counted, commanded and planned steps agree, as do rows, losses, origin and outcome, and the telemetry
//! covers the motion without gaps.
//!
//! Each defect is a sentence with its numbers. Only [`read`], and what reads by it, opens files.

use std::path::Path;

use client::decimal;
use client::identity::Origin;
use client::plain;
use protocol::capsule::CapsuleEvent;
use protocol::rig::{RigEvent, Run};
use protocol::system::What;
use serde::Deserialize;

use crate::trials::trial::{Achieved, Action, CapsuleSample, Executed, RigSample, Status, Trial};

/// Tolerance for a late sample, us: the device sends it late when it has something more urgent to do.
const LATE_US: u64 = 10_000;

/// Common fields of the telemetry rows of both machines.
pub trait Sample: for<'de> Deserialize<'de> {
    /// Device time, us.
    fn time_us(&self) -> u64;
    /// Samples lost just before.
    fn missed(&self) -> u16;
    /// Origin as the row states it.
    fn origin(&self) -> Origin;
}

impl Sample for RigSample {
    fn time_us(&self) -> u64 {
        self.time_us
    }
    fn missed(&self) -> u16 {
        self.missed
    }
    fn origin(&self) -> Origin {
        self.origin
    }
}

impl Sample for CapsuleSample {
    fn time_us(&self) -> u64 {
        self.time_us
    }
    fn missed(&self) -> u16 {
        self.missed
    }
    fn origin(&self) -> Origin {
        self.origin
    }
}

/// Reads the telemetry up to the first unreadable row; reports what is wrong with the file as defects.
pub fn read<T: Sample>(sidecar: &Path, trial: &Trial) -> (Vec<T>, Vec<String>) {
    let path = sidecar.with_file_name(&trial.telemetry);
    let name = &trial.telemetry;
    let mut reader = match plain::rows(&path) {
        Ok(rows) => csv::Reader::from_reader(rows),
        Err(error) => return (vec![], vec![format!("{name} cannot be read: {error}")]),
    };
    let mut samples = vec![];
    let mut rows = reader.deserialize();
    while let Some(row) = rows.next() {
        match row {
            Ok(sample) => samples.push(sample),
            // The tool was killed while it wrote it.
            Err(_) if trial.status == Status::Running && rows.next().is_none() => break,
            Err(error) => {
                // Do not trust the rows after it.
                let row = samples.len() + 1;
                return (
                    samples,
                    vec![format!("row {row} of {name} cannot be read: {error}")],
                );
            }
        }
    }
    (samples, vec![])
}

/// Defects of a record.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Defects {
    /// The contradictions within it.
    pub contradictions: Vec<String>,
    /// Missing telemetry. The record of the motion is still true: the machine may have moved on while nobody listened.
    pub gaps: Vec<String>,
}

impl Defects {
    /// All of them.
    #[must_use]
    pub fn all(&self) -> Vec<String> {
        let mut all = [&self.contradictions[..], &self.gaps].concat();
        all.dedup();
        all
    }

    fn say(&mut self, contradiction: impl Into<String>) {
        self.contradictions.push(contradiction.into());
    }

    fn lack(&mut self, gap: impl Into<String>) {
        self.gaps.push(gap.into());
    }

    fn agree(&mut self, holds: bool, otherwise: &str) {
        if !holds {
            self.say(otherwise);
        }
    }

    /// Compares the outcome by the machine's record with the sidecar's status.
    fn ends_alike(&mut self, says: Status, trial: &Trial, of: &str) {
        // A fault that was latched behind the end of the motion is in the sidecar only.
        let ended = [Status::Complete, Status::Stopped, Status::LinkLost].contains(&says);
        let later = ended && trial.status == Status::Faulted;
        if says != trial.status && !(later && trial.error.is_some()) {
            self.say(format!("{of} and the sidecar's status differ"));
        }
    }

    /// Puts the defects of the files first.
    fn after(self, files: Vec<String>) -> Self {
        Self {
            contradictions: [files, self.contradictions].concat(),
            ..self
        }
    }
}

/// The defects of a record: its sidecar, its telemetry, and the two together.
#[must_use]
pub fn record(sidecar: &Path, trial: &Trial) -> Defects {
    match trial.action {
        Action::Run { .. } => rig(sidecar, trial).1,
        Action::Actuation { .. } => capsule(sidecar, trial).1,
    }
}

/// The readable telemetry of a record of the rig, and the defects of the record.
#[must_use]
pub fn rig(sidecar: &Path, trial: &Trial) -> (Vec<RigSample>, Defects) {
    let (samples, unreadable) = read::<RigSample>(sidecar, trial);
    let defects = run(trial, &samples).after(unreadable);
    (samples, defects)
}

/// The readable telemetry of a record of the capsule, and the defects of the record.
#[must_use]
pub fn capsule(sidecar: &Path, trial: &Trial) -> (Vec<CapsuleSample>, Defects) {
    let (samples, unreadable) = read::<CapsuleSample>(sidecar, trial);
    let defects = actuation(trial, &samples).after(unreadable);
    (samples, defects)
}

/// Defects of a rig's run.
#[must_use]
pub fn run(trial: &Trial, samples: &[RigSample]) -> Defects {
    let mut defects = telemetry(trial, samples);
    let Action::Run {
        requested,
        achieved,
        executed,
        ..
    } = &trial.action
    else {
        return defects;
    };
    if let (Some(achieved), Some(executed)) = (achieved, executed) {
        planned_and_done(trial, requested, achieved, executed, &mut defects);
        covers(
            trial,
            samples,
            run_start_us(trial),
            executed.ticks / 100,
            &mut defects,
        );
    } else if trial.status == Status::Complete {
        defects.say("it is called complete, without what was planned or executed");
    }
    if let Some(executed) = executed {
        defects.ends_alike(executed.outcome.into(), trial, "the record's outcome");
    }
    defects
}

/// Defects of a capsule's trial.
#[must_use]
pub fn actuation(trial: &Trial, samples: &[CapsuleSample]) -> Defects {
    let mut defects = telemetry(trial, samples);
    let Action::Actuation {
        actuation,
        accepted,
        record,
    } = &trial.action
    else {
        return defects;
    };
    let Some(record) = record else {
        if trial.status == Status::Complete {
            defects.say("it is called complete, without the capsule's record");
        }
        return defects;
    };
    defects.ends_alike(record.outcome.into(), trial, "the record's outcome");
    defects.agree(
        record.kind == *actuation,
        "the record is that of another kind of actuation",
    );
    defects.agree(
        accepted.is_none_or(|accepted| accepted.actuation == record.actuation),
        "the record is that of another actuation than was accepted",
    );
    covers(
        trial,
        samples,
        actuation_start_us(trial),
        u64::from(record.duration_ms) * 1_000,
        &mut defects,
    );
    defects
}

/// Start of a run according to its event, device time.
#[must_use]
pub fn run_start_us(trial: &Trial) -> Option<u64> {
    let started = |what: &What| matches!(what, What::Rig(RigEvent::RunStarted { .. }));
    let event = trial.events.iter().find(|event| started(&event.what))?;
    Some(event.time_us)
}

/// Start of an actuation according to its event, device time.
#[must_use]
pub fn actuation_start_us(trial: &Trial) -> Option<u64> {
    let started = |what: &What| matches!(what, What::Capsule(CapsuleEvent::Started { .. }));
    let event = trial.events.iter().find(|event| started(&event.what))?;
    Some(event.time_us)
}

/// Checks that apply to the telemetry of both machines.
fn telemetry<T: Sample>(trial: &Trial, samples: &[T]) -> Defects {
    let mut defects = Defects::default();
    let name = &trial.telemetry;
    if let Some(why) = trial.not_whole() {
        defects.lack(why);
    }
    // While a trial runs, its sidecar does not know the final number of samples.
    if trial.status != Status::Running {
        if samples.len() as u64 != trial.samples {
            defects.say(format!(
                "{name} has {} rows, {} were recorded",
                samples.len(),
                trial.samples
            ));
        }
        let missed: u64 = samples
            .iter()
            .map(|sample| u64::from(sample.missed()))
            .sum();
        if missed != trial.missed_samples {
            defects.say(format!(
                "by the rows of {name} {missed} samples were lost, by the sidecar {}",
                trial.missed_samples
            ));
        }
    }
    let other =
        |sample: &T| sample.origin() != Origin::Unknown && sample.origin() != trial.device.origin;
    if let Some(sample) = samples.iter().find(|sample| other(sample)) {
        defects.say(format!(
            "{name} is of origin {}, the sidecar of origin {}",
            sample.origin(),
            trial.device.origin
        ));
    }
    let back = samples
        .windows(2)
        .position(|pair| pair[1].time_us() <= pair[0].time_us());
    match back {
        Some(row) => defects.say(format!(
            "time does not go on between rows {} and {} of {name}",
            row + 1,
            row + 2
        )),
        None => gaps(trial, samples, &mut defects),
    }
    defects
}

/// Time between samples, us: the median of those without a loss between them.
fn interval_us<T: Sample>(samples: &[T]) -> Option<u64> {
    let mut all: Vec<u64> = samples
        .windows(2)
        .filter(|pair| pair[1].missed() == 0)
        .map(|pair| pair[1].time_us().saturating_sub(pair[0].time_us()))
        .collect();
    all.sort_unstable();
    all.get(all.len() / 2).copied()
}

/// Longest plausible time between two samples with `missed` lost ones between them.
fn longest_us(interval_us: u64, missed: u16) -> u64 {
    let missed_us = interval_us.saturating_mul(u64::from(missed) + 1);
    missed_us.saturating_add(LATE_US.max(interval_us - interval_us.div_ceil(10)))
}

fn gaps<T: Sample>(trial: &Trial, samples: &[T], defects: &mut Defects) {
    let Some(interval_us) = interval_us(samples) else {
        return;
    };
    let is_gap = |pair: &&[T]| {
        pair[1].time_us() - pair[0].time_us() > longest_us(interval_us, pair[1].missed())
    };
    let gaps: Vec<_> = samples.windows(2).filter(is_gap).collect();
    if let Some(first) = gaps.first() {
        defects.lack(format!(
            "{} gaps in {} that no lost samples explain, the first of {} s at {} s",
            gaps.len(),
            trial.telemetry,
            seconds(first[1].time_us() - first[0].time_us()),
            seconds(first[0].time_us())
        ));
    }
}

/// Checks that the telemetry begins and ends with the motion.
fn covers<T: Sample>(
    trial: &Trial,
    samples: &[T],
    start_us: Option<u64>,
    duration_us: u64,
    defects: &mut Defects,
) {
    if trial.status != Status::Complete {
        return;
    }
    let name = &trial.telemetry;
    let (Some(first), Some(last)) = (samples.first(), samples.last()) else {
        defects.lack(format!("{name} is empty"));
        return;
    };
    let start_us = start_us.unwrap_or(first.time_us());
    let interval_us = interval_us(samples).unwrap_or(0);
    let begins_us = start_us
        .saturating_add(longest_us(interval_us, first.missed()))
        .saturating_add(interval_us);
    if first.time_us() > begins_us {
        defects.lack(format!(
            "{name} begins {} s after the motion",
            seconds(first.time_us() - start_us)
        ));
    }
    let end_us = start_us.saturating_add(duration_us);
    // No row reports samples that the link lost after the last row.
    if last.time_us().saturating_add(longest_us(interval_us, 2)) < end_us {
        defects.lack(format!(
            "{name} ends {} s before the motion",
            seconds(end_us - last.time_us())
        ));
    }
}

/// Compares what was requested, planned and executed; the counts only of a complete run.
fn planned_and_done(
    trial: &Trial,
    requested: &Run,
    achieved: &Achieved,
    executed: &Executed,
    defects: &mut Defects,
) {
    let cycle_steps = u64::from(achieved.forward.steps) + u64::from(achieved.back.steps);
    let planned = u64::from(requested.cycles) * cycle_steps;
    if planned != achieved.edges {
        defects.say(format!(
            "{} cycles of {cycle_steps} steps are {planned}, the plan says {}",
            requested.cycles, achieved.edges
        ));
    }
    defects.agree(
        executed.plan_hash == achieved.plan_hash,
        "the executed plan has another fingerprint than the accepted one",
    );
    if trial.status != Status::Complete {
        return;
    }
    if executed.counted_edges != executed.commanded_edges {
        defects.say(format!(
            "{} steps were commanded, {} were seen at the pin",
            executed.commanded_edges, executed.counted_edges
        ));
    }
    if executed.commanded_edges != achieved.edges {
        defects.say(format!(
            "it is called complete with {} of {} steps",
            executed.commanded_edges, achieved.edges
        ));
    }
    let strokes = u32::from(requested.cycles) * 2;
    if executed.strokes != strokes {
        defects.say(format!(
            "it is called complete with {} of {strokes} strokes",
            executed.strokes
        ));
    }
    if executed.holds == 0 && executed.ticks != achieved.total_ticks {
        defects.say(format!(
            "it took {} s, the plan {} s",
            decimal::seconds(executed.ticks),
            decimal::seconds(achieved.total_ticks)
        ));
    }
}

fn seconds(us: u64) -> String {
    decimal::write(us, 6)
}

#[cfg(test)]
mod tests;
