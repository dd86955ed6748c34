//! Why a measurement was aborted, and what faults mean on a new machine.

use client::error::ClientError;
use client::wording;
use protocol::error::Refusal;
use protocol::rig::RigFault;

#[derive(Debug)]
pub enum Halt {
    Aborted,
    /// The effect was not shown, for this reason.
    NotShown(String),
    /// A defect, described by this text.
    Defect(String),
    Client(ClientError),
    /// The connection to the fixture was lost.
    FixtureLost(String),
}

impl From<ClientError> for Halt {
    fn from(error: ClientError) -> Self {
        match error {
            ClientError::Interrupted { .. } => Self::Aborted,
            ClientError::Refused { refusal, .. } => Self::Defect(refused(&refusal)),
            ClientError::Overdue { .. } => Self::Defect(error.to_string()),
            error => Self::Client(error),
        }
    }
}

pub(super) fn refused(refusal: &Refusal) -> String {
    match refusal {
        Refusal::RigFaulted(fault) => fault_text(*fault),
        refusal => format!("the machine refuses: {}", wording::refusal(refusal)),
    }
}

pub fn fault_text(fault: RigFault) -> String {
    match fault {
        RigFault::ReadBack { commanded, counted } => format!(
            "the read-back does not count the steps ({} of {}): the jumper D2-A0 is missing or loose",
            counted.unsigned_abs(),
            commanded.unsigned_abs()
        ),
        RigFault::EStopLoop => {
            "the E-stop loop opened, and nobody was asked to open it: noise on its wire (shield it, 1 to 2.2 kohm from D12 to 3.3 V), a loose contact, or the carriage on an end-of-travel switch".to_owned()
        }
        fault => fault.to_string(),
    }
}

/// Explains how homing of a new rig ended.
pub fn homing_text(fault: RigFault, met_far_limit: bool) -> String {
    if met_far_limit {
        return "the motor is reversed: homing took the carriage to the left, to the far limit. Motor supply off, turn one motor coil around".to_owned();
    }
    match fault {
        RigFault::EStopLoop => "the E-stop loop opened while homing. If the carriage is at its left end, the motor is reversed: turn one motor coil around; at its right end, the home flag is not ahead of the end-of-travel switch".to_owned(),
        RigFault::FlagNotFound(_) => format!("{fault}; motor supply, driver current, coupling"),
        fault => fault_text(fault),
    }
}
