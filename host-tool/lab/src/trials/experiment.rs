//! Recorded actions: a run, an actuation.

use std::path::PathBuf;

use client::decimal;
use client::diagnosis::Sign;
use client::error::ClientError;
use client::identity::IdentityRecord;
use client::{Begun, Both, Clock, Device, Homed, Observer, Pace, Progress};
use miette::Diagnostic;
use protocol::capsule::{
    ActuationKind, ActuationOutcome, ActuationRecord, Calibrate, CheckFolded, FoldTo,
};
use protocol::error::Refusal;
use protocol::rig::{LinkLossPolicy, Run, RunOutcome, RunRecord, RunTiming};
use protocol::system::{DeviceKind, Event, Identity};
use protocol::table::Telemetry;
use serde_json::{Value, json};

use crate::trials::trial::{
    Action, Ending, RecordError, Recorder, Recording, Screw, Status, TrialRecord,
};

/// The paper's run: 5 cycles of 130 mm in 40 s.
pub const PAPER_RUN: Run = Run {
    cycles: 5,
    stroke_um: 130_000,
    timing: RunTiming::Total {
        total_us: 40_000_000,
        accel_um_s2: DEFAULT_ACCEL_UM_S2,
    },
    far_dwell_us: 0,
    home_dwell_us: 0,
    start_delay_us: 0,
    link_loss: LinkLossPolicy::Stop,
};

/// Default acceleration of a run, um/s2.
pub const DEFAULT_ACCEL_UM_S2: u32 = 100_000;

/// Default telemetry interval, ms: 100 Hz use a third of 115200 baud.
pub const DEFAULT_TELEMETRY_MS: u16 = 10;

/// Why a recorded action failed.
#[derive(Debug, thiserror::Error, Diagnostic)]
pub enum ExperimentError {
    /// The device or the link to it failed.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Client(#[from] ClientError),
    /// The record could not be written.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Record(#[from] RecordError),
    /// The action ended, but its record is incomplete.
    #[error("{ended}; but {record}")]
    #[diagnostic(
        code(retrograde::record),
        help(
            "the machine is well, what it did is said above; what was recorded until then is kept: {}",
            record.remedy
        )
    )]
    Unrecorded {
        /// The device's account of the action.
        ended: String,
        /// Why the record is incomplete.
        record: RecordError,
    },
    /// Both machines of a run were lost, and the capsule may be moving.
    #[error("{rig}; and the capsule: {capsule}")]
    #[diagnostic(
        code(retrograde::outcome_unknown),
        help(
            "look at both machines; press the emergency stop button and switch the capsule off NOW if anything moves"
        )
    )]
    Both {
        rig: Box<ExperimentError>,
        capsule: ClientError,
    },
    /// An action did not end as planned, so the next one did not begin.
    #[error("{step} ended as {status:?}{}", reason.as_deref().map(|why| format!(": {why}")).unwrap_or_default())]
    #[diagnostic(
        code(retrograde::incomplete),
        help("the data so far is in {}", sidecar.display())
    )]
    Incomplete {
        step: &'static str,
        status: Status,
        /// The fault, if there was one.
        reason: Option<String>,
        sidecar: PathBuf,
    },
}

/// A recorded action, with the device's account of it.
#[derive(Clone, Debug)]
pub struct RecordedTrial<R> {
    pub record: R,
    pub trial: TrialRecord,
    pub csv: PathBuf,
    pub sidecar: PathBuf,
}

impl<R> RecordedTrial<R> {
    /// The sidecar's contents and the paths of both files, for programs.
    pub fn json(&self) -> Value {
        json!({
            "trial": self.trial,
            "csv": self.csv.display().to_string(),
            "sidecar": self.sidecar.display().to_string(),
        })
    }
}

/// A recorded run.
pub type RunTrial = RecordedTrial<RunRecord>;

/// A recorded actuation.
pub type ActuationTrial = RecordedTrial<ActuationRecord>;

/// Executes one run and records it, whatever its outcome.
///
/// # Errors
/// The rig refused or was lost, or the record could not be written. Both files exist before anything moves.
pub fn run(
    rig: &mut Device,
    run: Run,
    recording: &Recording,
    observer: &mut dyn Observer,
) -> Result<RunTrial, ExperimentError> {
    let identity = identity(rig, DeviceKind::Rig)?;
    let action = Action::Run {
        screw: Screw::from(&rig.rig_status()?),
        requested: run,
        achieved: None,
        executed: None,
    };
    record(
        rig,
        &identity,
        action,
        recording,
        observer,
        |rig, observer| {
            let accepted = rig.run(run)?;
            let record = rig.wait_run(&accepted, observer)?;
            Ok((record, Ending::Run(record)))
        },
    )
}

/// An order to the capsule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Actuation {
    pub kind: ActuationKind,
    /// Thread at which a partial fold stops; the other motions have their own ends.
    pub target_um: i32,
}

impl From<ActuationKind> for Actuation {
    fn from(kind: ActuationKind) -> Self {
        Self { kind, target_um: 0 }
    }
}

impl Actuation {
    /// A fold or an unfolding that stops with this much thread on the spool.
    #[must_use]
    pub const fn fold_to(target_um: i32) -> Self {
        Self {
            kind: ActuationKind::FoldTo,
            target_um,
        }
    }
}

/// All kinds of actuations.
pub const ACTUATIONS: [ActuationKind; 6] = [
    ActuationKind::Reference,
    ActuationKind::Calibrate,
    ActuationKind::CheckFolded,
    ActuationKind::Fold,
    ActuationKind::Unfold,
    ActuationKind::FoldTo,
];

/// Prefix of the actuation's files.
#[must_use]
pub const fn stem(kind: ActuationKind) -> &'static str {
    match kind {
        ActuationKind::Reference => "reference",
        ActuationKind::Calibrate => "calibrate",
        ActuationKind::CheckFolded => "check-folded",
        ActuationKind::Fold => "fold",
        ActuationKind::Unfold => "unfold",
        ActuationKind::FoldTo => "fold-to",
    }
}

/// The capsule's activity during the actuation, in words.
#[must_use]
pub const fn doing(kind: ActuationKind) -> &'static str {
    match kind {
        ActuationKind::Reference => "referencing",
        ActuationKind::Calibrate => "calibrating",
        ActuationKind::CheckFolded => "checking",
        ActuationKind::Fold => "folding",
        ActuationKind::Unfold => "unfolding",
        ActuationKind::FoldTo => "folding partly",
    }
}

/// Time after a calibration within which the capsule writes it to its flash, or says that it could not, us.
const KEPT_US: u64 = 1_000_000;

/// Executes one actuation and records it, whatever its outcome.
///
/// # Errors
/// The capsule refused or was lost, or the record could not be written. Both files exist before anything moves.
pub fn actuate(
    capsule: &mut Device,
    motion: impl Into<Actuation>,
    recording: &Recording,
    observer: &mut dyn Observer,
) -> Result<ActuationTrial, ExperimentError> {
    let Actuation { kind, target_um } = motion.into();
    let identity = identity(capsule, DeviceKind::Capsule)?;
    let action = Action::Actuation {
        actuation: kind,
        accepted: None,
        record: None,
    };
    let act = |capsule: &mut Device, observer: &mut dyn Observer| {
        let accepted = match kind {
            ActuationKind::Reference => capsule.reference()?,
            ActuationKind::Calibrate => capsule.call(Calibrate)?,
            ActuationKind::CheckFolded => capsule.call(CheckFolded)?,
            ActuationKind::Fold => capsule.fold()?,
            ActuationKind::Unfold => capsule.unfold()?,
            ActuationKind::FoldTo => capsule.call(FoldTo {
                thread_um: target_um,
            })?,
        };
        let record = capsule.wait_actuation(&accepted, observer)?;
        if kind == ActuationKind::Calibrate {
            // The actuation has ended, whatever happens to the link now.
            let _ = capsule.idle(KEPT_US, observer);
        }
        Ok((record, Ending::Actuation(record)))
    };
    record(capsule, &identity, action, recording, observer, act)
}

/// Records what `act` orders and waits for. Both files exist before it begins. A failed record hides neither what the
/// device did nor how it was lost.
fn record<R>(
    device: &mut Device,
    identity: &Identity,
    action: Action,
    recording: &Recording,
    observer: &mut dyn Observer,
    act: impl FnOnce(&mut Device, &mut dyn Observer) -> Result<(R, Ending), ClientError>,
) -> Result<RecordedTrial<R>, ExperimentError> {
    let settings = device.settings(identity.device)?;
    let identity = IdentityRecord::new(identity, &device.place());
    let trial = TrialRecord::new(action, identity, settings, recording);
    let mut recorder = Recorder::create(trial, recording)?;
    let (csv, sidecar) = (recorder.csv().to_owned(), recorder.sidecar().to_owned());
    let mut recorded = Recorded {
        recorder: &mut recorder,
        observer,
    };
    let outcome = listen(device, recording.telemetry_ms).and_then(|()| act(device, &mut recorded));
    let lost_events = device.take_lost_events();
    match outcome {
        Ok((record, ending)) => {
            let ended = verdict(&ending);
            // Ignore the error: the action has ended. The next request will notice a device that does not answer.
            let _ = device.set_telemetry(0);
            // Make this the last exchange: an emergency stop may be sent with any earlier one, and must be in the
            // record.
            recorder.latched(after_stops(device, &ending));
            match recorder.finish(ending, lost_events) {
                Ok(trial) => Ok(RecordedTrial {
                    record,
                    trial,
                    csv,
                    sidecar,
                }),
                Err(record) => Err(ExperimentError::Unrecorded { ended, record }),
            }
        }
        Err(error) => {
            let ending = without_record(&recorder, &error);
            if let Err(record) = recorder.finish(ending, lost_events) {
                observer.unrecorded(&record.to_string());
            }
            Err(error.into())
        }
    }
}

/// Turns the telemetry on and discards earlier telemetry, events and losses.
pub(crate) fn listen(device: &mut Device, telemetry_ms: u16) -> Result<(), ClientError> {
    device.set_telemetry(telemetry_ms)?;
    device.take_telemetry();
    device.take_events()?;
    device.take_lost_events();
    Ok(())
}

/// Forwards everything to the record and to the observer; also reports failures of the record to the observer.
struct Recorded<'a> {
    recorder: &'a mut Recorder,
    observer: &'a mut dyn Observer,
}

impl Recorded<'_> {
    fn both(&mut self) -> Both<'_> {
        Both(self.recorder, self.observer)
    }

    fn tell(&mut self) {
        if let Some(error) = self.recorder.news() {
            self.observer.unrecorded(&error.to_string());
        }
    }
}

impl Observer for Recorded<'_> {
    fn begun(&mut self, begun: &Begun) {
        self.both().begun(begun);
    }
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.both().telemetry(sample, missed);
        self.tell();
    }
    fn event(&mut self, event: &Event) {
        self.both().event(event);
    }
    fn progress(&mut self, progress: &Progress) {
        self.both().progress(progress);
        self.tell();
    }
    fn refused(&mut self, pace: Pace, refusal: &Refusal) {
        self.both().refused(pace, refusal);
    }
    fn turn(&mut self, now_us: u64, clock: Option<Clock>) {
        self.both().turn(now_us, clock);
    }
}

/// The device's account of an action, in a sentence.
fn verdict(ending: &Ending) -> String {
    match ending {
        Ending::Run(record) => format!(
            "the run ended as {:?} after {} strokes and {} steps",
            record.outcome, record.strokes, record.counted_edges
        ),
        Ending::Actuation(record) => format!(
            "the actuation ended as {:?} with {} mm of thread after {} s",
            record.outcome,
            decimal::fixed(record.thread_um.into(), 3),
            decimal::fixed(record.duration_ms.into(), 3)
        ),
        Ending::Refused(why) | Ending::Lost(why) => why.clone(),
    }
}

/// The fault after an action that ended by a stop, or shortly before one. If the device no longer answers, the fault is
/// missing in the record.
pub(crate) fn after_stops(device: &mut Device, ending: &Ending) -> Option<String> {
    let is_stopped = match ending {
        Ending::Run(record) => record.outcome == RunOutcome::Stopped,
        Ending::Actuation(record) => record.outcome == ActuationOutcome::Stopped,
        Ending::Refused(_) | Ending::Lost(_) => false,
    };
    if !is_stopped && device.interrupted().is_none() {
        return None;
    }
    device.latched_fault().ok().flatten()
}

/// The end of an action without a record from the machine.
pub(crate) fn without_record(recorder: &Recorder, error: &ClientError) -> Ending {
    if error.is_refusal() && !recorder.has_begun() {
        Ending::Refused(error.to_string())
    } else {
        Ending::Lost(error.to_string())
    }
}

pub(crate) fn identity(device: &Device, wanted: DeviceKind) -> Result<Identity, ClientError> {
    device.require(wanted)?;
    device
        .identity()
        .copied()
        .ok_or_else(|| ClientError::NoAnswer {
            sign: Sign::Silence,
            place: device.place(),
        })
}

/// Homes the rig.
///
/// # Errors
/// As [`Device::home`] and [`Device::wait_homing`].
pub fn home(rig: &mut Device, observer: &mut dyn Observer) -> Result<Homed, ClientError> {
    // Discard old events: the end of another host's homing must not count as the end of this one.
    rig.take_events()?;
    let accepted = rig.home()?;
    rig.wait_homing(&accepted, observer)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two kinds with one prefix would be taken for each other in a folder.
    #[test]
    fn each_actuation_has_a_name_of_its_own() {
        let kinds = ACTUATIONS;
        for name in [stem, doing] {
            let names: std::collections::BTreeSet<_> = kinds.map(name).into();
            assert!(
                names.len() == kinds.len() && !names.contains(""),
                "{names:?}"
            );
        }
        assert_eq!(stem(ActuationKind::FoldTo), "fold-to");
    }
}
