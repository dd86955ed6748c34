//! A fold or an unfolding that begins at a position of a run, and its timing by the clocks of both machines.
//!
//! The host waits for the rig's event or sample and then commands the capsule. It never blocks on the capsule: the rig
//! must keep hearing from it, whatever happens to the other link.

use std::path::Path;

use client::error::{ClientError, Missing};
use client::identity::IdentityRecord;
use client::{Begun, Both, Clock, Device, Observer};
use protocol::capsule::{
    ActuationAccepted, ActuationKind, ActuationRecord, CapsuleEvent, Fold, GetCapsuleStatus, Unfold,
};
use protocol::rig::{RigEvent, Run, RunOutcome};
use protocol::system::{DeviceKind, Event, Urgent, What};
use protocol::table::{Endpoint, Telemetry};
use serde::{Deserialize, Serialize};

use crate::trials::cue::{Coordination, Cue};
use crate::trials::experiment::{self, ActuationTrial, ExperimentError, RunTrial, after_stops};
use crate::trials::trial::{Action, Ending, Recorder, Recording, Screw, TrialRecord};

/// Fold or unfold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Shaping {
    /// The origami is unfolded before it.
    Fold,
    /// The origami is folded before it.
    Unfold,
}

impl From<Shaping> for ActuationKind {
    fn from(shaping: Shaping) -> Self {
        match shaping {
            Shaping::Fold => Self::Fold,
            Shaping::Unfold => Self::Unfold,
        }
    }
}

/// A run and the actuation coordinated with it.
pub struct Coordinated {
    pub run: RunTrial,
    /// The actuation; an error if it did not begin, or was lost.
    pub actuation: Result<ActuationTrial, ExperimentError>,
    pub coordination: Coordination,
}

/// Where to record both.
pub struct Recordings<'a> {
    pub run: &'a Recording,
    pub actuation: &'a Recording,
}

/// Executes a run, and an actuation that begins at its cue. The run continues even if the actuation fails; a run that
/// ends early stops the actuation.
///
/// # Errors
/// The rig refused or was lost, or a record could not be written; the actuation's record is complete even then. All
/// files exist before anything moves.
pub fn run(
    (rig, capsule): (&mut Device, &mut Device),
    run: Run,
    (shaping, cue): (Shaping, Cue),
    recordings: &Recordings<'_>,
    observer: &mut dyn Observer,
) -> Result<Coordinated, ExperimentError> {
    let action = Action::Actuation {
        actuation: shaping.into(),
        accepted: None,
        record: None,
    };
    let screw = Screw::from(&rig.rig_status()?);
    let device = IdentityRecord::new(
        &experiment::identity(capsule, DeviceKind::Capsule)?,
        &capsule.place(),
    );
    let settings = capsule.settings(DeviceKind::Capsule)?;
    let recorder = Recorder::create(
        TrialRecord::new(action, device, settings, recordings.actuation),
        recordings.actuation,
    )?;
    if let Err(error) = experiment::listen(capsule, recordings.actuation.telemetry_ms) {
        let ending = experiment::without_record(&recorder, &error);
        // The loss of the capsule is the cause: report it even if the record cannot be written.
        let _ = recorder.finish(ending, capsule.take_lost_events());
        return Err(error.into());
    }
    let mut partner = Partner {
        together_us: (rig.now_us(), capsule.now_us()),
        last_request_us: capsule.now_us(),
        capsule,
        shaping,
        cue,
        // At the start of the run, the carriage rests for the start delay only.
        dwell_us: match cue.stroke() {
            0 => run.start_delay_us.into(),
            _ => run.home_dwell_us.into(),
        },
        screw,
        stroke_um: run.stroke_um,
        recorder,
        began_us: None,
        before: None,
        phase: Phase::Waiting,
    };
    let ran = experiment::run(rig, run, recordings.run, &mut Both(&mut partner, observer));
    let (actuation, coordination) = partner.end(ran.as_ref().ok());
    match (ran, actuation) {
        (Err(rig), Err(ExperimentError::Client(capsule))) if capsule.may_move() => {
            let rig = Box::new(rig);
            Err(ExperimentError::Both { rig, capsule })
        }
        (ran, actuation) => Ok(Coordinated {
            run: ran?,
            actuation,
            coordination,
        }),
    }
}

/// Longest single wait for an answer, us.
const SHORT_US: u64 = 5_000;

/// Progress of the actuation.
enum Phase {
    Waiting,
    /// The carriage has reached the cue. `cue_us` is by the rig's clock, `due_us` by the rig's link.
    Cued {
        cue_us: u64,
        clock: Option<Clock>,
        due_us: Option<u64>,
        asked: bool,
    },
    Accepted {
        cue_us: u64,
        clock: Option<Clock>,
        accepted: ActuationAccepted,
    },
    Failed(ClientError),
}

/// Time of the cue by the rig's clock, us, and that clock's relation to the rig's link.
type CueTime = (u64, Option<Clock>);

/// Why there is no record of the actuation: for its sidecar, and the error if there was one.
struct NoRecord {
    ending: Ending,
    error: Option<ClientError>,
}

impl NoRecord {
    fn refused(why: &str) -> Self {
        Self {
            ending: Ending::Refused(why.to_owned()),
            error: None,
        }
    }
}

/// The capsule, polled while the host waits for the rig.
struct Partner<'a> {
    capsule: &'a mut Device,
    shaping: Shaping,
    cue: Cue,
    dwell_us: u64,
    recorder: Recorder,
    /// The same instant by the rig's link and by the capsule's link.
    together_us: (u64, u64),
    /// Time of the last request to the capsule, by its link.
    last_request_us: u64,
    /// When the actuation began, by the capsule's clock.
    began_us: Option<u64>,
    screw: Screw,
    stroke_um: u32,
    /// The rig's last sample before the cue: its time in us and position in nm.
    before: Option<(u64, i64)>,
    phase: Phase,
}

/// Keeps the capsule's records, and notes when the actuation begins.
struct Noting<'a> {
    recorder: &'a mut Recorder,
    began_us: &'a mut Option<u64>,
}

impl Observer for Noting<'_> {
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.recorder.telemetry(sample, missed);
    }
    fn event(&mut self, event: &Event) {
        if matches!(event.what, What::Capsule(CapsuleEvent::Started { .. })) {
            *self.began_us = Some(event.time_us);
        }
        self.recorder.event(event);
    }
}

impl Partner<'_> {
    fn cued(&mut self, cue_us: u64) {
        self.phase = Phase::Cued {
            cue_us,
            clock: None,
            due_us: None,
            asked: false,
        };
    }

    /// Handles a sample (time in us, position in nm); sets the cue once the carriage has reached its position.
    fn passed(&mut self, now: (u64, i64), at_um: u32) {
        let place_nm = i64::from(at_um) * 1_000;
        if now.1 < place_nm {
            self.before = Some(now);
            return;
        }
        // Interpolate linearly: between two samples the speed is nearly constant.
        let cue_us = match self.before {
            Some((time_us, before_nm)) => {
                let (way, part) = (now.1 - before_nm, place_nm - before_nm);
                let took = i128::from(now.0.saturating_sub(time_us));
                time_us + (took * i128::from(part) / i128::from(way.max(1))) as u64
            }
            None => now.0,
        };
        self.dwell_us = 0;
        self.cued(cue_us);
    }

    /// Advances the capsule's link to the same instant, and sends the request that is due.
    fn attend(&mut self, now_us: u64, clock: Option<Clock>) -> Result<(), ClientError> {
        let (rig_us, capsule_us) = self.together_us;
        let until_us = capsule_us + now_us.saturating_sub(rig_us);
        let mut noting = Noting {
            recorder: &mut self.recorder,
            began_us: &mut self.began_us,
        };
        let answer = self.capsule.attend(until_us, &mut noting)?;
        if let Phase::Cued {
            cue_us,
            clock: known,
            due_us,
            asked,
        } = &mut self.phase
        {
            // Keep the first clock relation known after the cue.
            *known = known.or(clock);
            let due_us = *due_us.get_or_insert(now_us + self.dwell_us);
            let accepted = match self.shaping {
                Shaping::Fold => answer.and_then(Fold::from_response),
                Shaping::Unfold => answer.and_then(Unfold::from_response),
            };
            if let Some(accepted) = accepted {
                self.phase = Phase::Accepted {
                    cue_us: *cue_us,
                    clock: *known,
                    accepted,
                };
                self.recorder.begun(&Begun::Actuation(accepted));
            } else if !*asked && now_us >= due_us && !self.capsule.is_posted() {
                *asked = true;
                self.last_request_us = until_us;
                return match self.shaping {
                    Shaping::Fold => self.capsule.post(Fold),
                    Shaping::Unfold => self.capsule.post(Unfold),
                };
            }
        }
        if !self.capsule.is_posted()
            && until_us >= self.last_request_us + self.capsule.keep_alive_us()
        {
            self.last_request_us = until_us;
            self.capsule.post(GetCapsuleStatus)?;
        }
        Ok(())
    }

    /// Cancels an actuation not requested yet.
    fn begin_nothing(&mut self) {
        if let Phase::Cued {
            due_us,
            asked: false,
            ..
        } = &mut self.phase
        {
            *due_us = Some(u64::MAX);
        }
    }

    /// Waits for the end of the actuation, if it has begun, and completes its record.
    fn end(
        mut self,
        run: Option<&RunTrial>,
    ) -> (Result<ActuationTrial, ExperimentError>, Coordination) {
        self.begin_nothing();
        // If the run ended between the command and its answer, the capsule moves nevertheless: wait for the answer.
        while self.capsule.is_posted() && !matches!(self.phase, Phase::Failed(_)) {
            let (rig_us, capsule_us) = self.together_us;
            let on_us = self.capsule.now_us() - capsule_us + SHORT_US;
            self.turn(rig_us + on_us, None);
        }
        self.stop_with(run);
        let (outcome, cue_time) = self.wait();
        let coordination = self.coordination(run.map(|run| &*run.sidecar), cue_time);
        (self.record(outcome, coordination.clone()), coordination)
    }

    /// Waits for the end of an actuation that has begun. Returns its record, and the time of the cue.
    fn wait(&mut self) -> (Result<ActuationRecord, NoRecord>, Option<CueTime>) {
        match std::mem::replace(&mut self.phase, Phase::Waiting) {
            Phase::Waiting => {
                let why = format!(
                    "the run ended before cycle {} came to its place",
                    self.cue.cycle
                );
                (Err(NoRecord::refused(&why)), None)
            }
            Phase::Cued { asked: false, .. } => {
                let why = "the run ended in the dwell before it";
                (Err(NoRecord::refused(why)), None)
            }
            Phase::Cued { cue_us, clock, .. } => {
                let ending = Ending::Lost("the run ended before the capsule answered".into());
                let error = None;
                (Err(NoRecord { ending, error }), Some((cue_us, clock)))
            }
            Phase::Failed(error) => {
                let ending = experiment::without_record(&self.recorder, &error);
                let error = Some(error);
                (Err(NoRecord { ending, error }), None)
            }
            Phase::Accepted {
                cue_us,
                clock,
                accepted,
            } => {
                let mut noting = Noting {
                    recorder: &mut self.recorder,
                    began_us: &mut self.began_us,
                };
                let ended = self.capsule.wait_actuation(&accepted, &mut noting);
                let outcome = ended.map_err(|error| NoRecord {
                    ending: Ending::Lost(error.to_string()),
                    error: Some(error),
                });
                (outcome, Some((cue_us, clock)))
            }
        }
    }

    /// Completes the record of the actuation, whether it took place or not.
    fn record(
        mut self,
        outcome: Result<ActuationRecord, NoRecord>,
        coordination: Coordination,
    ) -> Result<ActuationTrial, ExperimentError> {
        let csv = self.recorder.csv().to_owned();
        let sidecar = self.recorder.sidecar().to_owned();
        self.recorder.coordinated(coordination);
        let lost = self.capsule.take_lost_events();
        // Discard what the capsule still sends.
        let _ = self.capsule.set_telemetry(0);
        let ending = match &outcome {
            Ok(record) => {
                let ending = Ending::Actuation(*record);
                // Make this the last exchange: an emergency stop may be sent with any earlier one, and must be in the
                // record.
                self.recorder.latched(after_stops(self.capsule, &ending));
                ending
            }
            Err(missing) => missing.ending.clone(),
        };
        let finished = self.recorder.finish(ending, lost);
        match (finished, outcome) {
            // More urgent than a record that could not be written.
            (
                _,
                Err(NoRecord {
                    error: Some(error), ..
                }),
            ) if error.may_move() => Err(error.into()),
            (Err(error), _) => Err(error.into()),
            (Ok(trial), Ok(record)) => Ok(ActuationTrial {
                record,
                trial,
                csv,
                sidecar,
            }),
            (Ok(trial), Err(_)) => Err(ExperimentError::Incomplete {
                step: experiment::doing(self.shaping.into()),
                status: trial.status,
                reason: trial.error,
                sidecar,
            }),
        }
    }

    /// Stops the actuation if its run has ended early, or the rig was lost: whatever stopped the rig stops both.
    fn stop_with(&mut self, run: Option<&RunTrial>) {
        let is_complete = run.is_some_and(|run| run.record.outcome == RunOutcome::Complete);
        let may_move = matches!(
            self.phase,
            Phase::Accepted { .. }
                | Phase::Failed(ClientError::Unanswered {
                    missing: Missing::Outcome,
                    ..
                })
        );
        if !is_complete
            && may_move
            && self.capsule.interrupted().is_none()
            && let Err(error) = self.capsule.urgent(Urgent::Stop)
        {
            self.phase = Phase::Failed(error);
        }
    }

    fn coordination(&self, run: Option<&Path>, cue: Option<CueTime>) -> Coordination {
        let clocks = cue.and_then(|(_, rig)| Some((rig?.ahead_us, self.capsule.clock()?.ahead_us)));
        let (rig_us, capsule_us) = self.together_us;
        let apart_us = capsule_us.cast_signed() - rig_us.cast_signed();
        let ahead = clocks.map(|(rig, capsule)| {
            let least = apart_us - capsule.1 + rig.0;
            let most = apart_us - capsule.0 + rig.1;
            (least, most)
        });
        let apart = cue
            .zip(self.began_us)
            .map(|((cue_us, _), began_us)| began_us.cast_signed() - cue_us.cast_signed());
        Coordination {
            run: run
                .and_then(Path::file_name)
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned(),
            cue: self.cue,
            cue_time_us: cue.map(|(cue_us, _)| cue_us),
            began_time_us: self.began_us,
            capsule_ahead_us: ahead,
            latency_us: apart
                .zip(ahead)
                .map(|(apart, (least, most))| (apart - most, apart - least)),
        }
    }
}

impl Observer for Partner<'_> {
    fn event(&mut self, event: &Event) {
        if !matches!(self.phase, Phase::Waiting) {
            return;
        }
        let away = self.cue.stroke();
        match (event.what, self.cue.at_um) {
            (What::Rig(RigEvent::RunStarted { .. }), None) if away == 0 => {
                self.cued(event.time_us + self.dwell_us);
            }
            (What::Rig(RigEvent::StrokeDone { stroke, .. }), None)
                if stroke.checked_add(1) == Some(away) =>
            {
                self.cued(event.time_us + self.dwell_us);
            }
            // If the cue is at the turning point, no sample may lie beyond it: use the end of the stroke.
            (What::Rig(RigEvent::StrokeDone { stroke, .. }), Some(at_um)) if stroke == away => {
                self.passed((event.time_us, i64::from(self.stroke_um) * 1_000), at_um);
            }
            _ => {}
        }
    }

    fn telemetry(&mut self, sample: &Telemetry, _: u16) {
        if let (Phase::Waiting, Some(at_um), Telemetry::Rig(rig)) =
            (&self.phase, self.cue.at_um, sample)
            && rig.stroke == self.cue.stroke()
        {
            let at_nm = self.screw.nm(rig.position_steps.into());
            self.passed((rig.time_us, at_nm), at_um);
        }
    }

    fn turn(&mut self, now_us: u64, clock: Option<Clock>) {
        if matches!(self.phase, Phase::Failed(_)) {
            return;
        }
        if let Err(error) = self.attend(now_us, clock) {
            self.phase = Phase::Failed(error);
        }
    }
}
