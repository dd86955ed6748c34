//! Carries out a campaign: readings, trials, displacements, in the order of the plan, until it is done or the operator
//! quits. Writes each result to the folder before the next step begins.

mod displacement;
mod modelled;
mod reach;
mod readings;
mod trial;

use std::iter;

use crate::trials::experiment::ExperimentError;
use crate::trials::trial::{RecordError, Status};
use client::error::ClientError;
use client::identity::{IdentityRecord, Origin};
use client::subject::Subject;
use client::{Device, Homed, Observer, Pacer, Unobserved};
use jiff::Timestamp;
use protocol::rig::RigState;
use protocol::settings::GetName;
use protocol::system::{DeviceKind, Urgent};
use serde_json::{Value, json};

use crate::campaign::CampaignError;
use crate::campaign::folder::Folder;
use crate::campaign::ledger::{AttemptOutcome, LedgerEvent, LedgerRow, TrialState, TrialStatus};
use crate::campaign::prompts::{self, Answer, Halt, Question};
use crate::campaign::readings::ReadingRow;

/// Longest time between two calls that keep the machines' links alive while a question waits, us.
const KEEP_ALIVE_INTERVAL_US: u64 = 50_000;

/// Reopens a session with a machine, or says why that fails.
pub type Connect<'a> = dyn FnMut(DeviceKind) -> Result<Device, String> + 'a;

/// Shows text to the operator and asks for answers.
pub trait Prompter {
    fn say(&mut self, text: &str);
    /// Waits for an answer, and calls `keep_alive` several times a second.
    ///
    /// # Errors
    /// [`Halt`]; typed text is not lost.
    fn answer(
        &mut self,
        question: &Question<'_>,
        keep_alive: &mut dyn FnMut() -> Result<(), ClientError>,
    ) -> Result<String, Halt>;
    /// Whether a person answers, who needs to see the question and the possible answers.
    fn is_person(&self) -> bool;
    fn observer(&mut self) -> Box<dyn Observer + '_>;
    /// The keys that hold and resume a run, if there are any.
    fn pacer(&mut self) -> Option<Pacer>;
    fn now(&self) -> Timestamp;
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    Through,
    Enough,
    Aborted,
}

/// Why a session cannot continue. All results so far are in the folder.
#[derive(Debug, thiserror::Error)]
pub enum Broken {
    #[error(transparent)]
    Campaign(#[from] CampaignError),
    /// A machine or a record failed. The ledger keeps this text.
    #[error("{}", in_ledger(.0))]
    Experiment(#[from] ExperimentError),
    /// A motion did not end as planned.
    #[error("{action} ended as {status:?}")]
    Ended {
        action: &'static str,
        status: Status,
        reason: Option<String>,
    },
    /// A machine is in a state in which no trial can begin.
    #[error("{why}")]
    NotReady { why: String, help: String },
}

impl From<ClientError> for Broken {
    fn from(error: ClientError) -> Self {
        Self::Experiment(error.into())
    }
}

impl From<RecordError> for Broken {
    fn from(error: RecordError) -> Self {
        Self::Experiment(error.into())
    }
}

fn in_ledger(error: &ExperimentError) -> String {
    match error {
        ExperimentError::Client(error) => error.in_record(),
        error => error.to_string(),
    }
}

impl Broken {
    /// Outcome of the attempt that failed this way.
    fn outcome(&self) -> AttemptOutcome {
        match self {
            Self::Campaign(_) => AttemptOutcome::Lost,
            Self::NotReady { .. } => AttemptOutcome::Refused,
            Self::Ended { status, .. } => AttemptOutcome::from(*status),
            Self::Experiment(ExperimentError::Client(error)) => match error {
                error if error.is_refusal() => AttemptOutcome::Refused,
                ClientError::Interrupted { .. } => AttemptOutcome::Stopped,
                ClientError::NotHomed {
                    fault: None,
                    link_lost: true,
                } => AttemptOutcome::LinkLost,
                ClientError::NotHomed { fault: None, .. } => AttemptOutcome::Stopped,
                ClientError::NotHomed { .. } | ClientError::Overdue { .. } => {
                    AttemptOutcome::Faulted
                }
                _ => AttemptOutcome::Lost,
            },
            Self::Experiment(ExperimentError::Incomplete { status, .. }) => {
                AttemptOutcome::from(*status)
            }
            // The attempt counts as lost, because it cannot be checked without its record.
            Self::Experiment(
                ExperimentError::Record(_)
                | ExperimentError::Unrecorded { .. }
                | ExperimentError::Both { .. },
            ) => AttemptOutcome::Lost,
        }
    }
}

/// The machines, and what does not change about them during a session.
pub struct Machines {
    rig: Device,
    capsule: Option<Device>,
    origin: Origin,
    /// Gaps in the rig's commissioning, or `complete`.
    commissioning: String,
    known: Value,
    /// Time and result of the last homing; none while the position is unknown.
    homed: Option<(Timestamp, Homed)>,
    /// A stop that a dropped link knew of.
    stopped: Option<Urgent>,
}

impl Machines {
    /// Asks the machines for their identities and settings.
    pub fn new(
        rig: Device,
        capsule: Option<Device>,
        commissioning: Option<String>,
    ) -> Result<Self, ClientError> {
        let origin = capsule
            .as_ref()
            .map_or(rig.origin(), |capsule| rig.origin().max(capsule.origin()));
        let mut machines = Self {
            rig,
            capsule,
            origin,
            commissioning: commissioning.unwrap_or_else(|| "complete".to_owned()),
            known: Value::Null,
            homed: None,
            stopped: None,
        };
        machines.known = machines.facts()?;
        Ok(machines)
    }

    /// What must not change during a session: identities, settings, commissioning.
    fn facts(&mut self) -> Result<Value, ClientError> {
        let subject = Subject::of(&mut self.rig)?;
        let name = self.rig.call(GetName)?.name;
        let identity = |device: &Device| {
            let place = device.place();
            device
                .identity()
                .map(|identity| IdentityRecord::new(identity, &place))
        };
        let mut known = json!({
            "rig": {
                "identity": identity(&self.rig),
                "name": name.as_str(),
                "image": subject.image,
                "settings": subject.settings,
                "commissioning": self.commissioning,
            },
        });
        if let Some(capsule) = &self.capsule {
            known["capsule"] = json!({ "identity": identity(capsule) });
        }
        Ok(known)
    }

    /// Stops every motion in progress: it belongs to an attempt of an earlier session, which the ledger lists as lost.
    /// Returns the machines stopped.
    pub fn come_to_rest(&mut self) -> Result<Vec<&'static str>, ClientError> {
        let mut stopped = vec![];
        let state = self.rig.rig_status()?.state;
        if matches!(
            state,
            RigState::Running | RigState::Held | RigState::Homing | RigState::Moving
        ) {
            self.rig.urgent(Urgent::Stop)?;
            stopped.push("rig");
        }
        self.rig.wait_rest(&mut Unobserved)?;
        if let Some(capsule) = &mut self.capsule
            && client::moves(capsule.capsule_status()?.state)
        {
            capsule.urgent(Urgent::Stop)?;
            stopped.push("capsule");
        }
        Ok(stopped)
    }

    /// The strongest stop since the last call, once the machines have confirmed it. It applies to older orders only, so
    /// later ones are sent again.
    fn take_stop(&mut self) -> Result<Option<Urgent>, ClientError> {
        let mut strongest = self.stopped;
        for device in iter::once(&mut self.rig).chain(&mut self.capsule) {
            if let Some(urgent) = device.interrupted() {
                device.settle()?;
                device.forget_stop();
                strongest = strongest.max(Some(urgent));
            }
        }
        self.stopped = None;
        Ok(strongest)
    }

    fn keep_alive(&mut self) -> Result<(), ClientError> {
        let kept = self.rig.idle(KEEP_ALIVE_INTERVAL_US, &mut Unobserved);
        if let Some(capsule) = &mut self.capsule {
            // Long enough to send another process's question.
            capsule.idle(1_000, &mut Unobserved)?;
        }
        kept
    }
}

pub struct Conduct<'a> {
    folder: &'a mut Folder,
    machines: &'a mut Machines,
    prompter: &'a mut dyn Prompter,
    connect: &'a mut Connect<'a>,
    /// Whether a machine did not answer while a question waited, and is still unreachable.
    gone: bool,
    /// Name of the camera's next file, if the operator has entered one.
    camera: Option<String>,
    /// Block of the last homing in this session.
    homed_in: Option<u32>,
}

/// What to do after an answer.
enum Next {
    /// Begin the trial; or the value is in the ledger.
    Proceed,
    /// Read the state again to find the next step.
    Reread,
    /// End the session at the operator's request.
    Quit,
}

impl<'a> Conduct<'a> {
    /// A session; asks nothing and moves nothing yet.
    pub fn new(
        folder: &'a mut Folder,
        machines: &'a mut Machines,
        prompter: &'a mut dyn Prompter,
        connect: &'a mut Connect<'a>,
    ) -> Self {
        Self {
            folder,
            machines,
            prompter,
            connect,
            gone: false,
            camera: None,
            homed_in: None,
        }
    }

    /// Continues the campaign, with at most `attempts` new attempts.
    pub fn carry_out(&mut self, attempts: Option<u32>) -> Result<Ending, Broken> {
        let ended = self.go_on(attempts);
        let sealed = self.folder.seal();
        self.tell_folded();
        let ended = ended?;
        sealed?;
        Ok(ended)
    }

    fn go_on(&mut self, mut attempts: Option<u32>) -> Result<Ending, Broken> {
        loop {
            self.folder.seal()?;
            // Report a stop since the last question before asking the next one.
            if !self.gone && matches!(self.report_stop()?, Next::Quit) {
                return Ok(Ending::Aborted);
            }
            let Some(next) = self.folder.campaign().state.next() else {
                return Ok(Ending::Through);
            };
            let (planned, number) = (next.planned.clone(), next.attempts.len() as u32);
            let then = if next.status() == TrialStatus::Unmeasured {
                self.measure(&planned, number)?
            } else {
                if attempts == Some(0) {
                    return Ok(Ending::Enough);
                }
                match self.set_up(&planned)? {
                    Next::Proceed => match self.ask_ready(&planned, number + 1)? {
                        Next::Proceed => {
                            attempts = attempts.map(|remaining| remaining - 1);
                            self.attempt(&planned, number + 1)?
                        }
                        then => then,
                    },
                    then => then,
                }
            };
            if matches!(then, Next::Quit) {
                return Ok(Ending::Aborted);
            }
        }
    }

    fn row(&mut self, row: LedgerRow) -> Result<(), Broken> {
        let (now, origin) = (self.prompter.now(), self.machines.origin);
        Ok(self.folder.append(row, now, origin)?)
    }

    fn reading_row(&mut self, row: ReadingRow) -> Result<(), Broken> {
        let (now, origin) = (self.prompter.now(), self.machines.origin);
        Ok(self.folder.append_reading(row, now, origin)?)
    }

    fn note(&mut self, trial: u32, text: String) -> Result<(), Broken> {
        let line = format!("  noted on trial {trial}: {text}");
        self.row(LedgerRow::of(LedgerEvent::Note, trial, None).saying(Some(text)))?;
        self.prompter.say(&line);
        Ok(())
    }

    /// Takes the latest entry back: an exclusion or a skip, or else a displacement.
    fn undo(&mut self) -> Result<(), Broken> {
        let campaign = self.folder.campaign();
        let not_note = |row: &&LedgerRow| row.event != LedgerEvent::Note;
        let not_counted = (campaign.rows.iter().rfind(not_note))
            .filter(|row| matches!(row.event, LedgerEvent::Skipped | LedgerEvent::Excluded))
            .and_then(|row| row.trial);
        let last = campaign.state.last_measured(&campaign.rows);
        let excluded = last.map(|(trial, _)| trial).filter(|trial| {
            campaign.state.trial(*trial).map(TrialState::status) == Some(TrialStatus::Excluded)
        });
        let (row, text) = match (not_counted.or(excluded), last) {
            (Some(trial), _) => (
                LedgerRow::of(LedgerEvent::Included, trial, None),
                format!(
                    "  trial {trial} is included again, as by `campaign edit ... include {trial}`"
                ),
            ),
            (None, Some((trial, attempt))) => (
                LedgerRow::of(LedgerEvent::Undone, trial, Some(attempt)),
                format!("  the displacement of trial {trial} is taken back"),
            ),
            (None, None) => {
                self.prompter.say("  no displacement was entered yet");
                return Ok(());
            }
        };
        self.row(row)?;
        self.prompter.say(&text);
        Ok(())
    }

    /// Reports a stop since the last call. Orders given before it do not begin.
    fn report_stop(&mut self) -> Result<Next, Broken> {
        let Some(urgent) = self.machines.take_stop()? else {
            return Ok(Next::Proceed);
        };
        self.prompter.say(match urgent {
            Urgent::Stop => "  a stop was requested: nothing begins before Enter at a checklist",
            Urgent::EStop => {
                "  an emergency stop was requested: nothing begins before `retrograde ack`"
            }
        });
        Ok(self.reread_or_quit())
    }

    /// Asks a person again. Without a person the same answer would come at once, for ever.
    fn reread_or_quit(&self) -> Next {
        match self.prompter.is_person() {
            true => Next::Reread,
            false => Next::Quit,
        }
    }

    /// Asks until the answer is clear. None: the operator quits.
    fn ask(&mut self, question: &Question<'_>) -> Result<Option<Answer>, Broken> {
        let person = self.prompter.is_person();
        if person || !matches!(question, Question::Reading { .. }) {
            for line in question.text() {
                self.prompter.say(&line);
            }
        }
        if person {
            self.prompter.say(&format!("  ({})", question.hint()));
        }
        // A machine that is still unreachable has already been reported.
        let mut reported = self.gone;
        loop {
            let machines = &mut *self.machines;
            let mut keep_alive = || machines.keep_alive();
            let text = match self.prompter.answer(question, &mut keep_alive) {
                Ok(text) => text,
                Err(Halt::Aborted) => return Ok(None),
                // The operator's stop also ends the wait.
                Err(Halt::Client(ClientError::Interrupted { .. })) => return Ok(None),
                // An answer needs no machine, so a lost line must not discard what is being typed.
                Err(Halt::Client(error)) => {
                    self.gone = true;
                    if !std::mem::replace(&mut reported, true) {
                        self.prompter
                            .say(&format!("  {error}; you can still answer"));
                    }
                    continue;
                }
            };
            match prompts::parse(&text) {
                Answer::Quit => return Ok(None),
                Answer::Unclear(why) => self.prompter.say(&format!("  {why}")),
                answer => return Ok(Some(answer)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::rig::RigFault;

    #[test]
    fn each_end_of_a_homing_is_told_as_what_it_was() {
        let not_homed = |fault, link_lost| ClientError::NotHomed { fault, link_lost };
        let overdue = ClientError::Overdue {
            place: "rig".to_owned(),
            action: "homing",
            limit_ms: 1,
        };
        for (error, outcome) in [
            (not_homed(None, false), AttemptOutcome::Stopped),
            (not_homed(None, true), AttemptOutcome::LinkLost),
            (
                not_homed(Some(RigFault::EStopFrame), true),
                AttemptOutcome::Faulted,
            ),
            (overdue, AttemptOutcome::Faulted),
            (
                ClientError::Interrupted { request: "Home" },
                AttemptOutcome::Stopped,
            ),
        ] {
            let text = error.to_string();
            assert_eq!(Broken::from(error).outcome(), outcome, "{text}");
        }
    }

    /// The ledger keeps this text, and whoever reads it later has nothing else.
    #[test]
    fn a_lost_record_is_in_the_ledger_with_its_file() {
        let full = std::io::Error::other("the disk is full");
        let error = RecordError::write(std::path::Path::new("trials/001-1/run.csv"), full);
        let broken = Broken::from(error);
        assert_eq!(broken.outcome(), AttemptOutcome::Lost);
        let text = broken.to_string();
        assert!(
            text.contains("run.csv") && text.contains("the disk is full"),
            "{text}"
        );
        let stopped = ClientError::Interrupted { request: "Home" };
        let text = stopped.in_record();
        assert_eq!(Broken::from(stopped).to_string(), text);
        assert!(!text.is_empty());
    }
}
