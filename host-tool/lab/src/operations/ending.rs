//! Ends of motions, in words.

use crate::trials::trial::{Status, TrialRecord};
use client::decimal;
use client::{Device, Unobserved};
use protocol::rig::{self, RigState, RigStatus};

use crate::operations::failure::Failure;

/// Holds the run in progress, and waits until the carriage is at rest.
///
/// # Errors
/// The run has ended, or somebody else has resumed it.
pub fn held(rig: &mut Device) -> Result<RigStatus, Failure> {
    rig.call(rig::Hold)?;
    let status = rig.wait_rest(&mut Unobserved)?;
    if status.state == RigState::Running {
        return Err(Failure::refused(
            "the run was held, but somebody else has resumed it",
            "`retrograde hold` holds it again, `retrograde stop` ends it",
        ));
    }
    if status.state != RigState::Held {
        return Err(match Status::from(rig.run_record()?.outcome) {
            Status::Complete => Failure::refused(
                "too late, the run is complete",
                format!("nothing is held; the rig is at {} mm", millimetres(&status)),
            ),
            ending => ended("the run", ending, &status, None),
        });
    }
    Ok(status)
}

/// Checks that a recorded motion ended as planned.
pub fn completed(action: &'static str, trial: &TrialRecord, help: String) -> Result<(), Failure> {
    if trial.status == Status::Complete {
        return Ok(());
    }
    Err(Failure::Ended {
        action,
        status: trial.status,
        reason: trial.error.clone(),
        help,
    })
}

pub fn cut_short(action: &'static str, rig: &Device, status: &RigStatus) -> Failure {
    let (ending, reason) = match (status.fault, rig.interrupted()) {
        (Some(_), _) => (Status::Faulted, None),
        (None, Some(_)) => (Status::Stopped, None),
        (None, None) => (
            Status::Stopped,
            Some("by the start button, or because the rig did not hear this tool in time"),
        ),
    };
    ended(action, ending, status, reason)
}

fn ended(
    action: &'static str,
    ending: Status,
    status: &RigStatus,
    reason: Option<&str>,
) -> Failure {
    let place = millimetres(status);
    Failure::Ended {
        action,
        status: ending,
        reason: status
            .fault
            .map(|fault| fault.to_string())
            .or(reason.map(str::to_owned)),
        help: if status.fault.is_some() {
            format!(
                "the carriage is at {place} mm by the step counter; `retrograde ack rig`, then `retrograde home`"
            )
        } else {
            format!("the carriage is at {place} mm")
        },
    }
}

pub fn millimetres(status: &RigStatus) -> String {
    decimal::write_signed(status.position_um.into(), 3)
}

pub fn homed_text(homed: &client::Homed) -> String {
    format!(
        "Homed in {} s; the two passes differ by {} steps, the reference moved by {} steps.",
        decimal::write(homed.duration_us / 1_000, 3),
        homed.repeat_steps,
        homed.shift_steps
    )
}
