//! Completes the record of a process that was killed while it recorded. The line's next owner does this, with the
//! machine's own data.

use std::path::Path;

use client::Device;
use client::error::ClientError;
use client::identity::IdentityRecord;
use protocol::capsule::ActuationOutcome;
use protocol::rig::{RigState, RunOutcome};
use trials::trial::{Action, CAMPAIGN_PLAN, Ending, Moved, Status, Trial};

/// Completes the record that was left on the line of `device`, if there is one and nothing moves any more. Returns a
/// message for the user.
///
/// # Errors
/// As [`Device::call`].
pub fn end_record(device: &mut Device) -> Result<Option<String>, ClientError> {
    let Some(sidecar) = device.left_record() else {
        return Ok(None);
    };
    // Skip campaigns: they complete their own records when they are resumed.
    let is_campaign = |folder: &Path| folder.join(CAMPAIGN_PLAN).exists();
    let trial = Trial::read(&sidecar).ok();
    let trial = trial.filter(|trial| trial.status == Status::Running);
    let Some(mut trial) = trial.filter(|_| !sidecar.ancestors().skip(1).take(3).any(is_campaign))
    else {
        device.records(None);
        return Ok(None);
    };
    let name = sidecar.display();
    let Some(ending) = ending(device, &trial)? else {
        return Ok(Some(format!(
            "what the process began whose record is {name} still moves, though that process has ended; `retrograde stop` stops it"
        )));
    };
    let kept = match is_same(device, &trial) {
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
    device.records(None);
    Ok(Some(said))
}

/// The machine is that of the record, and has not been started again since.
fn is_same(device: &Device, trial: &Trial) -> bool {
    let place = device.place();
    let now = device
        .identity()
        .map(|identity| IdentityRecord::new(identity, &place));
    now.is_some_and(|now| (&now.uid, now.boot_id) == (&trial.device.uid, trial.device.boot_id))
}

/// The end of the action according to the machine; `None` while it moves.
fn ending(device: &mut Device, trial: &Trial) -> Result<Option<Ending>, ClientError> {
    let lost = |why: &str| {
        Ok(Some(Ending::Lost(format!(
            "the process that recorded it has ended; {why}"
        ))))
    };
    if !is_same(device, trial) {
        return lost("the machine was started again since, or is another one");
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
