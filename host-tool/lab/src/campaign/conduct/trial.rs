//! One attempt at a trial, from its checklist to its last record: everything that moves.

use std::fs;
use std::path::Path;

use crate::trials::coordination::{self, Recordings, Shaping};
use crate::trials::experiment::{self, ExperimentError};
use crate::trials::trial::{RecordError, Recording, Status, json as json_text};
use client::error::ClientError;
use client::identity::{Origin, tool};
use client::plain::replace;
use client::{Device, Unobserved};
use protocol::capsule::{ActuationKind, CapsuleState};
use protocol::error::Refusal;
use protocol::rig::{MoveTo, RigEvent};
use protocol::system::What;
use serde_json::json;

use crate::campaign::conduct::{Broken, Conduct, Next};
use crate::campaign::files::RUN;
use crate::campaign::form::Form;
use crate::campaign::ledger::{AttemptOutcome, LedgerEvent, LedgerRow, TrialState, TrialStatus};
use crate::campaign::order::Planned;
use crate::campaign::plan::{Millimetres, TrialPurpose};
use crate::campaign::prompts::{Answer, Question, camera_file, checks};
use crate::campaign::{remaining, resumption};

/// Speed of the carriage on its way home between two trials, um/s.
const HOMEWARD_UM_S: u32 = 20_000;

impl Conduct<'_> {
    pub(super) fn ask_ready(&mut self, planned: &Planned, attempt: u32) -> Result<Next, Broken> {
        let campaign = self.folder.campaign();
        let of = campaign.order.len();
        let camera = self.camera_for(planned.trial, attempt);
        let remaining_s = remaining::remaining_s(campaign);
        let mut checks = checks(planned, attempt, of, camera.as_deref());
        checks[0].push_str(&format!(" {}.", remaining::text(remaining_s)));
        let question = Question::Ready {
            planned,
            attempt,
            checks,
        };
        let Some(answer) = self.ask(&question)? else {
            return Ok(Next::Quit);
        };
        match answer {
            Answer::Enter | Answer::Yes => return self.may_move(),
            Answer::Undo => self.undo()?,
            Answer::Exclude(reason) => self.exclude_last(reason)?,
            Answer::Skip(reason) => {
                self.row(
                    LedgerRow::of(LedgerEvent::Skipped, planned.trial, None).saying(Some(reason)),
                )?;
                self.camera = None;
                self.prompter.say(&format!(
                    "  trial {} is skipped; undo takes it in again",
                    planned.trial
                ));
            }
            Answer::Note(text) => self.note(planned.trial, text)?,
            Answer::Camera(_) if self.folder.campaign().plan.metadata.camera == "none" => {
                self.prompter.say(
                    "  the plan says `camera = \"none\"`, so no file is noted; `note TEXT` keeps a remark",
                );
            }
            Answer::Camera(file) => self.camera = Some(file),
            Answer::Clamp => self.clamp()?,
            Answer::Repeat(_) => {
                self.prompter.say(
                    "  `undo` goes back to the last displacement; there `repeat` does it again",
                );
            }
            Answer::Length(_) | Answer::Again | Answer::Quit | Answer::Unclear(_) => {
                self.prompter.say("  Enter begins the trial");
            }
        }
        Ok(Next::Reread)
    }

    /// Excludes the trial of the latest attempt. A displacement that was corrected since may belong to another one.
    fn exclude_last(&mut self, reason: String) -> Result<(), Broken> {
        let campaign = self.folder.campaign();
        let ended = |row: &&LedgerRow| row.event == LedgerEvent::Ended;
        let latest = campaign.rows.iter().rfind(ended);
        let Some((trial, attempt)) = latest.and_then(|row| row.trial.zip(row.attempt)) else {
            self.prompter.say("  no trial is done yet");
            return Ok(());
        };
        let status = campaign.state.trial(trial).map(TrialState::status);
        match status {
            Some(TrialStatus::Done) => {
                let row = LedgerRow::of(LedgerEvent::Excluded, trial, Some(attempt));
                self.row(row.saying(Some(reason)))?;
                self.prompter.say(&format!(
                    "  trial {trial} is excluded; undo takes it in again"
                ));
            }
            Some(TrialStatus::Excluded) => {
                self.prompter
                    .say(&format!("  trial {trial} is excluded already"));
            }
            _ => self.prompter.say(&format!(
                "  trial {trial} does not count anyway; `campaign edit ... exclude` names another one"
            )),
        }
        Ok(())
    }

    fn camera_for(&self, trial: u32, attempt: u32) -> Option<String> {
        let plan = &self.folder.campaign().plan;
        let proposed = || camera_file(&plan.name, trial, attempt);
        (plan.metadata.camera != "none").then(|| self.camera.clone().unwrap_or_else(proposed))
    }

    pub(super) fn attempt(&mut self, planned: &Planned, attempt: u32) -> Result<Next, Broken> {
        let trial = planned.trial;
        let campaign = self.folder.campaign();
        let set = campaign.readings.clamped().cloned();
        let a_mm = set
            .as_ref()
            .and_then(|set| campaign.readings.indentation_mm(set));
        let mut row = LedgerRow::of(LedgerEvent::Began, trial, Some(attempt));
        row.readings_set = set.map(|set| set.number);
        row.indentation_mm = a_mm.map(|a| Millimetres::from_um((a * 1_000.0).round() as i64));
        row.camera_file = self.camera_for(trial, attempt);
        self.row(row.clone())?;
        self.camera = None;
        let folder = self.folder.campaign().attempt_folder(trial, attempt);
        let result = self.act(planned, attempt, &row, &folder);
        let mut row = LedgerRow::of(LedgerEvent::Ended, trial, Some(attempt));
        row.outcome = Some(match &result {
            Ok(()) => AttemptOutcome::Complete,
            Err(broken) => broken.outcome(),
        });
        let reason = result.as_ref().err().map(|broken| match broken {
            Broken::Ended {
                reason: Some(reason),
                ..
            } => format!("{broken}: {reason}"),
            broken => broken.to_string(),
        });
        let ended = self.row(row.saying(reason));
        let sealed = self.folder.seal_attempt(trial, attempt);
        // Report the first of several errors.
        let stopped = matches!(&result, Err(broken) if broken.outcome() == AttemptOutcome::Stopped);
        match result {
            Err(_) if stopped && ended.is_ok() => {
                self.prompter.say(&format!(
                    "  stopped: attempt {attempt} of trial {trial} does not count"
                ));
                Ok(Next::Quit)
            }
            Err(broken) => Err(broken),
            Ok(()) => {
                ended?;
                sealed?;
                Ok(Next::Reread)
            }
        }
    }

    fn act(
        &mut self,
        planned: &Planned,
        attempt: u32,
        began: &LedgerRow,
        folder: &Path,
    ) -> Result<(), Broken> {
        fs::create_dir_all(folder).map_err(|io| RecordError::write(folder, io))?;
        self.go_home(planned.block)?;
        self.write_conditions(planned, attempt, began, folder)?;
        if planned.purpose == TrialPurpose::FoldTest {
            self.shape(planned.shape, folder)?;
        }
        let plan = &self.folder.campaign().plan;
        let (run, fold_at) = (plan.run, plan.fold_at);
        let recording = self.recording(folder, RUN, planned);
        if let Some(pacer) = self.prompter.pacer() {
            self.machines.rig.set_pacer(pacer);
        }
        let mut fold = None;
        let trial = match fold_at {
            Some(cue) if planned.shape == Form::Folding => {
                let of_fold = self.recording(folder, "fold", planned);
                let recordings = Recordings {
                    run: &recording,
                    actuation: &of_fold,
                };
                let capsule = self.machines.capsule.as_mut().ok_or_else(no_capsule)?;
                let ran = coordination::run(
                    (&mut self.machines.rig, capsule),
                    run,
                    (Shaping::Fold, cue),
                    &recordings,
                    &mut *self.prompter.observer(),
                )?;
                fold = Some(ran.actuation);
                ran.run
            }
            _ => {
                let mut observer = self.prompter.observer();
                experiment::run(&mut self.machines.rig, run, &recording, &mut *observer)?
            }
        };
        let strokes = 2 * u32::from(run.cycles);
        write_pulses(folder, &trial.trial.events, strokes, self.machines.origin)?;
        let fold = match fold {
            // A capsule that may be moving matters more than a run that has ended.
            Some(Err(ExperimentError::Client(error))) if error.may_move() => {
                return Err(error.into());
            }
            fold => fold,
        };
        if trial.trial.status != Status::Complete {
            return Err(Broken::Ended {
                action: "the run",
                status: trial.trial.status,
                reason: trial.trial.error,
            });
        }
        if let Some(fold) = fold.transpose()?
            && fold.trial.status != Status::Complete
        {
            return Err(Broken::Ended {
                action: "the fold in the run",
                status: fold.trial.status,
                reason: fold.trial.error,
            });
        }
        Ok(())
    }

    /// Moves the carriage to 0. Homes first in each block and each session, because handling the rollers may have
    /// turned the screw.
    fn go_home(&mut self, block: u32) -> Result<(), Broken> {
        let resume = resumption(&self.folder.campaign().folder);
        let not_ready = |why: String, help: &str| {
            let help = format!("{help}, then {resume}");
            Broken::NotReady { why, help }
        };
        let status = self.machines.rig.rig_status()?;
        if let Some(fault) = status.fault {
            let why = format!("the rig has a fault: {fault}");
            return Err(not_ready(why, "remove its cause, `retrograde ack rig`"));
        }
        if !status.homed || self.homed_in != Some(block) {
            let homed = experiment::home(&mut self.machines.rig, &mut *self.prompter.observer())?;
            self.machines.homed = Some((self.prompter.now(), homed));
            self.homed_in = Some(block);
            return Ok(());
        }
        let to = MoveTo {
            position_um: 0,
            speed_um_s: HOMEWARD_UM_S,
        };
        let rig = &mut self.machines.rig;
        let status = match rig.call(to) {
            Ok(accepted) => rig.wait_move(&accepted, &mut Unobserved)?.1,
            Err(ClientError::Refused {
                refusal: Refusal::AlreadyThere,
                ..
            }) => rig.rig_status()?,
            Err(error) => return Err(error.into()),
        };
        if status.position_steps == 0 && status.fault.is_none() {
            return Ok(());
        }
        if rig.interrupted().is_some() {
            return Err(Broken::Ended {
                action: "the move home",
                status: Status::Stopped,
                reason: None,
            });
        }
        let at = status.position_steps;
        let why = format!("the carriage is at {at} steps after the move to 0");
        Err(not_ready(why, "`retrograde info rig` says what is wrong"))
    }

    fn recording(&self, folder: &Path, stem: &str, planned: &Planned) -> Recording {
        Recording {
            folder: folder.to_owned(),
            stem: stem.to_owned(),
            now: self.prompter.now(),
            note: Some(format!(
                "campaign {}, trial {}: {}, {}, {}, repeat {}",
                self.folder.campaign().plan.name,
                planned.trial,
                planned.indentation,
                planned.lubrication.name(),
                planned.shape.name(),
                planned.repeat
            )),
            telemetry_ms: self.folder.campaign().plan.telemetry_ms,
        }
    }

    /// Folds or unfolds the capsule if the trial needs the other shape; records it.
    fn shape(&mut self, wanted: Form, folder: &Path) -> Result<(), Broken> {
        let status = self.capsule()?.capsule_status()?;
        let resume = resumption(&self.folder.campaign().folder);
        let not_ready = |help: &str| {
            Err(Broken::NotReady {
                why: format!("the capsule is {:?}", status.state),
                help: format!("{help}, then {resume}"),
            })
        };
        let mut steps = vec![];
        match status.state {
            CapsuleState::Unreferenced => steps.push(ActuationKind::Reference),
            CapsuleState::Unfolded => {}
            CapsuleState::Folded | CapsuleState::Stopped => steps.push(ActuationKind::Unfold),
            CapsuleState::Faulted => {
                return not_ready("`retrograde info capsule`, `retrograde ack capsule`");
            }
            CapsuleState::Referencing
            | CapsuleState::Folding
            | CapsuleState::Unfolding
            | CapsuleState::Checking => return not_ready("wait until it has stopped"),
        }
        if status.state == CapsuleState::Folded && wanted == Form::Folded {
            // The record of its fold belongs to another attempt, and the body may have slipped since.
            self.prompter
                .say("The capsule is still folded: it will be unfolded and folded again.");
        }
        if wanted == Form::Folded {
            steps.push(ActuationKind::Fold);
        }
        for kind in steps {
            self.actuate(kind, folder)?;
        }
        Ok(())
    }

    pub(super) fn actuate(&mut self, kind: ActuationKind, folder: &Path) -> Result<(), Broken> {
        self.prompter.say(match kind {
            ActuationKind::Reference => "Reference the capsule.",
            ActuationKind::Fold => "Fold the capsule.",
            _ => "Unfold the capsule.",
        });
        let recording = Recording {
            folder: folder.to_owned(),
            stem: experiment::stem(kind).to_owned(),
            now: self.prompter.now(),
            note: None,
            telemetry_ms: self.folder.campaign().plan.telemetry_ms,
        };
        let Some(capsule) = &mut self.machines.capsule else {
            return Err(no_capsule());
        };
        let mut observer = self.prompter.observer();
        let trial = experiment::actuate(capsule, kind, &recording, &mut *observer)?;
        if trial.trial.status != Status::Complete {
            return Err(Broken::Ended {
                action: experiment::doing(kind),
                status: trial.trial.status,
                reason: trial.trial.error,
            });
        }
        Ok(())
    }

    fn capsule(&mut self) -> Result<&mut Device, Broken> {
        self.machines.capsule.as_mut().ok_or_else(no_capsule)
    }

    /// Writes what the records of the run lack: conditions, machines and settings.
    fn write_conditions(
        &self,
        planned: &Planned,
        attempt: u32,
        began: &LedgerRow,
        folder: &Path,
    ) -> Result<(), Broken> {
        let campaign = self.folder.campaign();
        let homed = self.machines.homed.as_ref().map(|(when, homed)| {
            json!({
                "time_utc": when,
                "repeat_steps": homed.repeat_steps,
                "shift_steps": homed.shift_steps,
            })
        });
        let conditions = json!({
            "format": 1,
            "origin": self.machines.origin,
            "tool": tool(),
            "campaign": campaign.plan.name,
            "planned": planned,
            "attempt": attempt,
            "readings_set": began.readings_set,
            "indentation_mm": began.indentation_mm,
            "camera_file": began.camera_file,
            "metadata": campaign.plan.metadata,
            "homing": homed,
            "machines": self.machines.known,
        });
        let path = folder.join("conditions.json");
        json_text(&conditions)
            .and_then(|bytes| replace(&path, &bytes))
            .map_err(|io| RecordError::write(&path, io).into())
    }
}

fn no_capsule() -> Broken {
    Broken::NotReady {
        why: "the fold test needs the capsule".to_owned(),
        help: "`--capsule WHERE`, then try again".to_owned(),
    }
}

/// Writes when each stroke began, by the rig's clock. The sync pulse to the camera comes with the first step, later by
/// the time that the carriage needs for it from rest.
fn write_pulses(
    folder: &Path,
    events: &[protocol::system::Event],
    strokes: u32,
    origin: Origin,
) -> Result<(), RecordError> {
    let path = folder.join("sync.csv");
    let mut text = String::from("stroke,time_us,origin\n");
    // The strokes of a campaign follow each other without dwell, so each begins when the previous one ends. An event
    // may be missing.
    let mut begins: Vec<(u32, u64)> = events
        .iter()
        .filter_map(|event| match event.what {
            What::Rig(RigEvent::RunStarted { .. }) => Some((0, event.time_us)),
            What::Rig(RigEvent::StrokeDone { stroke, .. }) => Some((stroke + 1, event.time_us)),
            _ => None,
        })
        .collect();
    // The end of the last stroke begins none.
    begins.retain(|(stroke, _)| *stroke < strokes);
    for (stroke, time_us) in begins {
        text.push_str(&format!("{stroke},{time_us},{origin}\n"));
    }
    replace(&path, text.as_bytes()).map_err(|io| RecordError::write(&path, io))
}
