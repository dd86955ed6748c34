//! Checks a record: counted, commanded and planned steps agree, as do rows, losses, origin and outcome, and the
//! telemetry covers the motion without gaps.
//!
//! Each defect is a sentence with its numbers. Only [`read`] and its callers open files.

use std::collections::BTreeMap;
use std::path::Path;

use client::decimal;
use client::identity::Origin;
use client::plain;
use protocol::capsule::CapsuleEvent;
use protocol::rig::{RigEvent, Run};
use protocol::system::What;
use serde::de::DeserializeOwned;

use crate::trials::trial::{
    Achieved, Action, CapsuleSample, Executed, RigSample, Status, TrialRecord,
};

/// Tolerance for a late sample, us: the device sends more urgent messages first.
const LATE_US: u64 = 10_000;

/// A row of either machine's telemetry.
pub trait Sample: DeserializeOwned {
    /// Device time in us, samples lost just before, and the origin that the row states.
    fn common(&self) -> (u64, u16, Origin);
}

impl Sample for RigSample {
    fn common(&self) -> (u64, u16, Origin) {
        (self.time_us, self.missed, self.origin)
    }
}

impl Sample for CapsuleSample {
    fn common(&self) -> (u64, u16, Origin) {
        (self.time_us, self.missed, self.origin)
    }
}

/// Reads the telemetry row by row, up to the first unreadable one. Returns what is wrong with the file.
pub fn read<T: DeserializeOwned>(
    sidecar: &Path,
    trial: &TrialRecord,
    mut see: impl FnMut(T),
) -> Option<String> {
    let path = sidecar.with_file_name(&trial.telemetry);
    let name = &trial.telemetry;
    let mut reader = match plain::rows(&path) {
        Ok(rows) => csv::Reader::from_reader(rows),
        Err(error) => return Some(format!("{name} cannot be read: {error}")),
    };
    let mut row = 1_u64;
    let mut rows = reader.deserialize();
    while let Some(read) = rows.next() {
        match read {
            Ok(sample) => see(sample),
            // The tool was killed while writing it.
            Err(_) if trial.status == Status::Running && rows.next().is_none() => break,
            // Do not trust the rows after it.
            Err(error) => return Some(format!("row {row} of {name} cannot be read: {error}")),
        }
        row += 1;
    }
    None
}

/// Summary of the telemetry, of constant size.
#[derive(Debug, Default)]
pub struct Seen {
    rows: u64,
    missed: u64,
    first: Option<(u64, u16)>,
    last_us: u64,
    /// The first origin that differs from the sidecar's.
    other: Option<Origin>,
    /// First row whose successor is not later.
    back: Option<u64>,
    /// Time between two rows and samples lost between them: how often, and when first.
    steps: BTreeMap<(u64, u16), (u64, u64)>,
}

impl Seen {
    /// Adds the next row of a trial.
    pub fn take<T: Sample>(&mut self, trial: &TrialRecord, sample: &T) {
        let (time_us, missed, origin) = sample.common();
        if ![Origin::Unknown, trial.device.origin].contains(&origin) {
            self.other.get_or_insert(origin);
        }
        match self.first {
            None => self.first = Some((time_us, missed)),
            Some(_) if time_us <= self.last_us => {
                self.back.get_or_insert(self.rows);
            }
            Some(_) => {
                let step = self.steps.entry((time_us - self.last_us, missed));
                step.or_insert((0, self.last_us)).0 += 1;
            }
        }
        self.last_us = time_us;
        self.rows += 1;
        self.missed += u64::from(missed);
    }

    /// Time between samples, us: the median of those without a loss between them.
    fn interval_us(&self) -> Option<u64> {
        let all = || self.steps.iter().filter(|((_, missed), _)| *missed == 0);
        let half = all().map(|(_, (count, _))| count).sum::<u64>() / 2;
        let mut until = 0;
        all().find_map(|((us, _), (count, _))| {
            until += count;
            (until > half).then_some(*us)
        })
    }
}

/// What makes a record doubtful or incomplete.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Defects {
    /// Contradictions within the record.
    pub contradictions: Vec<String>,
    /// Missing telemetry. The record of the motion is still valid: the machine may have continued while the host did
    /// not listen.
    pub gaps: Vec<String>,
}

impl Defects {
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

    /// Compares the outcome in the machine's record with the sidecar's status.
    fn ends_alike(&mut self, says: Status, trial: &TrialRecord, of: &str) {
        // A fault latched after the end of the motion is in the sidecar only.
        let ended = [Status::Complete, Status::Stopped, Status::LinkLost].contains(&says);
        let later = ended && trial.status == Status::Faulted;
        if says != trial.status && !(later && trial.error.is_some()) {
            self.say(format!("{of} and the sidecar's status differ"));
        }
    }
}

/// The defects of a record: its sidecar, its telemetry, and the two together.
#[must_use]
pub fn record(sidecar: &Path, trial: &TrialRecord) -> Defects {
    match trial.action {
        Action::Run { .. } => seen(sidecar, trial, |_: &RigSample| {}),
        Action::Actuation { .. } => seen(sidecar, trial, |_: &CapsuleSample| {}),
    }
}

/// As [`record`]; calls `see` with the readable telemetry.
#[must_use]
pub fn seen<T: Sample>(sidecar: &Path, trial: &TrialRecord, mut see: impl FnMut(&T)) -> Defects {
    let mut all = Seen::default();
    let unreadable = read(sidecar, trial, |sample| {
        all.take(trial, &sample);
        see(&sample);
    });
    let mut defects = match trial.action {
        Action::Run { .. } => run(trial, &all),
        Action::Actuation { .. } => actuation(trial, &all),
    };
    // Report the defect of the file first.
    defects.contradictions.splice(0..0, unreadable);
    defects
}

/// Defects of a rig's run.
fn run(trial: &TrialRecord, seen: &Seen) -> Defects {
    let mut defects = telemetry(trial, seen);
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
        covers(trial, seen, executed.ticks / 100, &mut defects);
    } else if trial.status == Status::Complete {
        defects.say("it is called complete, without what was planned or executed");
    }
    if let Some(executed) = executed {
        defects.ends_alike(executed.outcome.into(), trial, "the record's outcome");
    }
    defects
}

/// Defects of a capsule's trial.
fn actuation(trial: &TrialRecord, seen: &Seen) -> Defects {
    let mut defects = telemetry(trial, seen);
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
    let duration_us = u64::from(record.duration_ms) * 1_000;
    covers(trial, seen, duration_us, &mut defects);
    defects
}

/// Start of the motion according to its event, device time.
#[must_use]
pub fn start_us(trial: &TrialRecord) -> Option<u64> {
    let mut events = trial.events.iter();
    let started = events.find(|event| {
        matches!(
            event.what,
            What::Rig(RigEvent::RunStarted { .. }) | What::Capsule(CapsuleEvent::Started { .. })
        )
    })?;
    Some(started.time_us)
}

/// Checks that apply to the telemetry of both machines.
fn telemetry(trial: &TrialRecord, seen: &Seen) -> Defects {
    let mut defects = Defects::default();
    let name = &trial.telemetry;
    if let Some(why) = trial.not_whole() {
        // The sidecar's numbers are those of all samples, or of the first ones.
        defects.lack(why);
    } else {
        if seen.rows != trial.samples {
            defects.say(format!(
                "{name} has {} rows, {} were recorded",
                seen.rows, trial.samples
            ));
        }
        if seen.missed != trial.missed_samples {
            defects.say(format!(
                "by the rows of {name} {} samples were lost, by the sidecar {}",
                seen.missed, trial.missed_samples
            ));
        }
    }
    if let Some(other) = seen.other {
        defects.say(format!(
            "{name} is of origin {other}, the sidecar of origin {}",
            trial.device.origin
        ));
    }
    match seen.back {
        Some(row) => defects.say(format!(
            "time does not advance between rows {row} and {} of {name}",
            row + 1
        )),
        None => gaps(trial, seen, &mut defects),
    }
    defects
}

/// Longest plausible time between two samples with `missed` lost ones between them.
fn longest_us(interval_us: u64, missed: u16) -> u64 {
    let missed_us = interval_us.saturating_mul(u64::from(missed) + 1);
    missed_us.saturating_add(LATE_US.max(interval_us - interval_us.div_ceil(10)))
}

fn gaps(trial: &TrialRecord, seen: &Seen, defects: &mut Defects) {
    let Some(interval_us) = seen.interval_us() else {
        return;
    };
    let is_gap = |((us, missed), _): &(&(u64, u16), _)| *us > longest_us(interval_us, *missed);
    let gaps = || seen.steps.iter().filter(is_gap);
    if let Some(((us, _), (_, first_us))) = gaps().min_by_key(|(_, (_, first_us))| first_us) {
        defects.lack(format!(
            "{} gaps in {} that no lost samples explain, the first of {} s at {} s",
            gaps().map(|(_, (count, _))| count).sum::<u64>(),
            trial.telemetry,
            seconds(*us),
            seconds(*first_us)
        ));
    }
}

/// Checks that the telemetry begins and ends with the motion.
fn covers(trial: &TrialRecord, seen: &Seen, duration_us: u64, defects: &mut Defects) {
    if trial.status != Status::Complete {
        return;
    }
    let name = &trial.telemetry;
    let Some((first_us, missed)) = seen.first else {
        defects.lack(format!("{name} is empty"));
        return;
    };
    let start_us = start_us(trial).unwrap_or(first_us);
    let interval_us = seen.interval_us().unwrap_or(0);
    let begins_us = start_us
        .saturating_add(longest_us(interval_us, missed))
        .saturating_add(interval_us);
    if first_us > begins_us {
        defects.lack(format!(
            "{name} begins {} s after the motion",
            seconds(first_us - start_us)
        ));
    }
    let end_us = start_us.saturating_add(duration_us);
    // No row reports samples that the link lost after the last row.
    if seen.last_us.saturating_add(longest_us(interval_us, 2)) < end_us {
        defects.lack(format!(
            "{name} ends {} s before the motion",
            seconds(end_us - seen.last_us)
        ));
    }
}

/// Compares what was requested, planned and executed; the counts only of a complete run.
fn planned_and_done(
    trial: &TrialRecord,
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
