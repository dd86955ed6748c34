//! Completes the record of a process that was killed while it recorded. The line's next owner does this, with the
//! machine's own data.

use std::path::Path;

use crate::trials::trial::{Action, CAMPAIGN_LEDGER, CAMPAIGN_PLAN, Ending, Moved, Status, Trial};
use client::Device;
use client::error::ClientError;
use client::identity::IdentityRecord;
use jiff::{SignedDuration, Timestamp};
use protocol::capsule::ActuationOutcome;
use protocol::rig::{RigState, RunOutcome};
use protocol::system::DeviceKind;

/// A machine's clock may fall behind by this much: a virtual one loses time on a busy computer.
const SLOW: SignedDuration = SignedDuration::from_secs(60);

/// Completes the record that was left on the line of `device`, if there is one and nothing moves any more. Returns a
/// message for the user.
///
/// # Errors
/// As [`Device::call`].
pub fn end_record(device: &mut Device, now: Timestamp) -> Result<Option<String>, ClientError> {
    let Some(sidecar) = device.left_record() else {
        return Ok(None);
    };
    let trial = Trial::read(&sidecar).ok();
    let trial = trial.filter(|trial| trial.status == Status::Running);
    let Some(mut trial) = trial.filter(|_| !is_of_a_campaign(&sidecar)) else {
        device.left_has_ended();
        return Ok(None);
    };
    let name = sidecar.display();
    let is_same = is_same(device, &trial, now)?;
    let Some(ending) = ending(device, &trial, is_same)? else {
        return Ok(Some(format!(
            "what the process began whose record is {name} is not over, though that process has ended; `retrograde stop` ends it"
        )));
    };
    let kept = match is_same {
        true => device.kept_events()?,
        false => (vec![], 0),
    };
    let said = match trial.end_left(&sidecar, ending, kept) {
        Ok(()) => format!(
            "the process that recorded {name} ended before its action; the record was ended from what the machine knows"
        ),
        Err(why) => {
            format!("the record {name} of a process that has ended could not be ended: {why}")
        }
    };
    device.left_has_ended();
    Ok(Some(said))
}

/// Ends the record for an owner of the line that looks again and again, and tells of it once.
#[derive(Debug, Default)]
pub struct Once(Option<String>);

impl Once {
    /// As [`end_record`], without a message that is the same as the last one.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn end_record(
        &mut self,
        device: &mut Device,
        now: Timestamp,
    ) -> Result<Option<String>, ClientError> {
        let said = end_record(device, now)?.filter(|said| self.0.as_ref() != Some(said));
        if said.is_some() {
            self.0.clone_from(&said);
        }
        Ok(said)
    }
}

/// Whether the record is one of a campaign, which completes its own when it is resumed: CAMPAIGN/trials/ATTEMPT/RECORD.
fn is_of_a_campaign(sidecar: &Path) -> bool {
    let has = |folder: &Path, name: &str| folder.join(name).exists();
    sidecar
        .ancestors()
        .nth(3)
        .is_some_and(|folder| has(folder, CAMPAIGN_PLAN) && has(folder, CAMPAIGN_LEDGER))
}

/// Whether this is the machine of the record, without a restart since. The number of starts begins at 1 after each
/// power-on, so the time since the start is compared as well.
fn is_same(device: &mut Device, trial: &Trial, now: Timestamp) -> Result<bool, ClientError> {
    let place = device.place();
    let Some(identity) = device.identity() else {
        return Ok(false);
    };
    let found = IdentityRecord::new(identity, &place);
    if (&found.uid, found.boot_id) != (&trial.device.uid, trial.device.boot_id) {
        return Ok(false);
    }
    let time_us = match identity.device {
        DeviceKind::Rig => device.rig_status()?.time_us,
        DeviceKind::Capsule => device.capsule_status()?.time_us,
    };
    Ok(was_on(time_us, trial.started_utc, now))
}

/// Whether a machine that began `time_us` ago was on when a record began.
fn was_on(time_us: u64, started: Timestamp, now: Timestamp) -> bool {
    let since = now.duration_since(started);
    SLOW + SignedDuration::from_micros(time_us.cast_signed()) >= since
}

/// The end of the action according to the machine; `None` while it moves.
fn ending(
    device: &mut Device,
    trial: &Trial,
    is_same: bool,
) -> Result<Option<Ending>, ClientError> {
    let lost = |why: &str| {
        Ok(Some(Ending::Lost(format!(
            "the process that recorded it has ended; {why}"
        ))))
    };
    if !is_same {
        return lost(
            "the machine was started again since or is another one, or the computer's clock was set",
        );
    }
    match &trial.action {
        Action::Run { achieved, .. } => {
            let record = device.run_record()?;
            match achieved {
                _ if record.outcome == RunOutcome::Running => Ok(None),
                Some(achieved) if achieved.run == record.run => Ok(Some(Ending::Run(record))),
                Some(_) => lost("the rig has run again since"),
                None => lost("it is not known whether the rig began the run"),
            }
        }
        Action::Move { accepted, .. } => {
            let status = device.rig_status()?;
            let position_steps = status.position_steps;
            match (status.state, accepted) {
                (RigState::Moving | RigState::Stopping, _) => Ok(None),
                (_, Some(accepted)) if accepted.to_steps == position_steps => {
                    let outcome = RunOutcome::Complete;
                    Ok(Some(Ending::Move(Moved {
                        outcome,
                        position_steps,
                    })))
                }
                _ => lost(&format!("the carriage is at {position_steps} steps")),
            }
        }
        Action::Actuation { accepted, .. } => {
            let record = device.actuation_record()?;
            match accepted {
                _ if record.outcome == ActuationOutcome::Running => Ok(None),
                Some(accepted) if accepted.actuation == record.actuation => {
                    Ok(Some(Ending::Actuation(record)))
                }
                Some(_) => lost("the capsule has moved again since"),
                None => lost("it is not known whether the capsule began to move"),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: a plan in the project's folder kept the records of single runs "running" for ever.
    #[test]
    fn a_plan_near_a_record_makes_no_campaign() {
        let folder = tempfile::tempdir().expect("a folder");
        let has = |name| std::fs::write(folder.path().join(name), "").expect("written");
        let record = |below| is_of_a_campaign(&folder.path().join(below));
        has(CAMPAIGN_PLAN);
        for below in ["run.json", "retrograde-data/run.json", "a/b/run.json"] {
            assert!(!record(below), "{below}");
        }
        has(CAMPAIGN_LEDGER);
        assert!(record("trials/001-1/run.json"));
    }

    #[test]
    fn a_machine_that_was_switched_on_since_is_not_the_one_of_the_record() {
        let at = |second| Timestamp::from_second(second).expect("a time");
        let s = 1_000_000;
        for (time_us, started, now, is) in [
            // On for 100 s before the record, and 30 s since.
            (130 * s, 1_000, 1_030, true),
            // Switched off and on 200 s after its beginning, and asked 60 s later.
            (60 * s, 1_000, 1_260, false),
            // A virtual machine that has lost 50 s of 100.
            (50 * s, 1_000, 1_100, true),
            // The computer's clock was set back.
            (30 * s, 1_000, 400, true),
        ] {
            let found = was_on(time_us, at(started), at(now));
            assert_eq!(found, is, "{time_us} us, {started} to {now} s");
        }
    }
}
