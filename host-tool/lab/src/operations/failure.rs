//! Failures as shown to the user: text, code, help, exit code.

use std::fmt;
use std::io;
use std::path::Path;

use crate::trials::experiment::ExperimentError;
use crate::trials::trial::{RecordError, Status};
use client::decimal;
use client::error::ClientError;
pub use client::exit::*;
use client::identity::kind_name;
use client::link::{LinkError, OpenError};
use client::named;
use locomotion::range::OutOfRange;
use miette::Diagnostic;
use motion::axis::AxisError;
use motion::run::RunError;
use protocol::error::{Field, Refusal};
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::operations::delivery::{self, Delivery, StopReport};

#[derive(Debug, thiserror::Error)]
pub enum Failure {
    #[error(transparent)]
    Client(#[from] ClientError),
    #[error(transparent)]
    Open(#[from] OpenError),
    #[error(transparent)]
    Experiment(#[from] ExperimentError),
    #[error(transparent)]
    Record(#[from] RecordError),
    /// No machine of the wanted kind was found, or none at all; `there` lists what was found instead.
    #[error("no {} found; {there}", wanted.map_or("machine", kind_name))]
    NotFound {
        wanted: Option<DeviceKind>,
        there: String,
    },
    /// Several of the wanted kind were found, which `there` lists.
    #[error("several {}s found: {there}", kind_name(*.wanted))]
    Ambiguous { wanted: DeviceKind, there: String },
    /// The server has no contact to the machine, or is overloaded.
    #[error("{why}")]
    Unreached { why: String, help: String },
    /// The action did not end as planned; the reason is its fault, if there was one.
    #[error("{action} {}{}", ended(*.status), reason.as_deref().map(|why| format!(": {why}")).unwrap_or_default())]
    Ended {
        action: &'static str,
        status: Status,
        reason: Option<String>,
        help: String,
    },
    /// At least one machine has not confirmed the stop.
    #[error("{}", delivery::summary(reports))]
    Stops { reports: Vec<StopReport> },
    /// Any other failure, in words.
    #[error("{}", .0.why)]
    Message(Box<Message>),
}

#[derive(Debug)]
pub struct Message {
    /// Keyword for programs: `retrograde::input`.
    pub code: String,
    /// The exit code; the table is in `docs/records.md`.
    pub exit_code: u8,
    pub why: String,
    pub help: String,
    /// Fields that `--json` shows beside the error.
    pub more: Value,
}

impl Diagnostic for Failure {
    fn code<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
        let code = match self {
            Self::Client(error) => return error.code(),
            Self::Open(error) => return error.code(),
            Self::Experiment(error) => return error.code(),
            Self::Record(error) => return error.code(),
            Self::NotFound { .. } | Self::Unreached { .. } => "retrograde::not_found",
            Self::Ambiguous { .. } => "retrograde::ambiguous",
            Self::Ended { .. } => "retrograde::ended",
            Self::Stops { .. } => "retrograde::stop",
            Self::Message(message) => &message.code,
        };
        Some(Box::new(code))
    }

    fn help<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
        let help = match self {
            Self::Client(error) => return error.help(),
            Self::Open(error) => return error.help(),
            Self::Experiment(error) => return error.help(),
            Self::Record(error) => return error.help(),
            Self::NotFound { wanted: None, .. } => {
                "plug a board in, or say where it is: `--rig /dev/ttyACM0`, `--capsule tcp:HOST:PORT`".to_owned()
            }
            Self::NotFound {
                wanted: Some(kind), ..
            } => format!(
                "plug the board in, or say where it is: `--{} /dev/ttyACM0` or `tcp:HOST:PORT`",
                kind_name(*kind)
            ),
            Self::Ambiguous { wanted, .. } => format!(
                "choose one: `--{} WHERE`; nothing but requests for an identity was sent",
                kind_name(*wanted)
            ),
            Self::Stops { .. } => delivery::DO_NOW.to_owned(),
            Self::Unreached { help, .. } | Self::Ended { help, .. } => help.clone(),
            Self::Message(message) if message.help.is_empty() => return None,
            Self::Message(message) => message.help.clone(),
        };
        Some(Box::new(help))
    }
}

impl Failure {
    /// The system refused to start a thread.
    #[must_use]
    pub fn no_thread(why: io::Error) -> Self {
        let why = format!("no thread could be started: {why}");
        let help = "nothing new was begun; end other programs of yours, or raise the limit of processes (`ulimit -u`; of a container: `--pids-limit`), then try again. `retrograde stop` and `estop` work all the same";
        Self::new("retrograde::no_thread", FAILED, why, help)
    }
}

impl From<RunError> for Failure {
    fn from(error: RunError) -> Self {
        let help = format!(
            "{}nothing was sent; `retrograde plan` tries runs without a rig",
            way_out(&error)
        );
        Self::new("retrograde::infeasible", REFUSED, error.to_string(), help)
    }
}

impl From<AxisError> for Failure {
    fn from(error: AxisError) -> Self {
        Self::new("retrograde::axis", REFUSED, error.to_string(), "")
    }
}

impl From<OutOfRange> for Failure {
    fn from(error: OutOfRange) -> Self {
        Self::new("retrograde::range", USAGE, error.to_string(), "")
    }
}

/// Error text for an invalid command line; rewrites clap's ranges, which use Rust's notation.
pub fn usage_text(error: &clap::Error) -> String {
    error.render().to_string().replace("..=", " to ")
}

/// `--json` value for an invalid command line; `text` is the message for a person.
pub fn usage(text: &str) -> Value {
    let mut parts = text.trim().splitn(2, "\n\n");
    let mut part = || parts.next().unwrap_or_default().trim().to_owned();
    let message = part();
    json!({
        "ok": false,
        "exit_code": USAGE,
        "error": {
            "code": "retrograde::usage",
            "message": message.trim_start_matches("error: "),
            "help": part(),
        },
    })
}

/// Suggests options that make the run feasible, from the planner's numbers.
fn way_out(error: &RunError) -> String {
    match *error {
        RunError::TotalTooShort {
            minimal_total_us,
            minimal_accel_um_s2: Some(um_s2),
        } => format!(
            "`--duration-s {}` in place of the timing that was given, or `--accel-mm-s2 {}`, if the rig's limits allow it; ",
            decimal::write(minimal_total_us, 6),
            decimal::write(um_s2.into(), 3)
        ),
        RunError::TotalTooShort {
            minimal_total_us, ..
        }
        | RunError::PeakAboveLimit {
            minimal_total_us: Some(minimal_total_us),
            ..
        } => format!(
            "`--duration-s {}` in place of the timing that was given; ",
            decimal::write(minimal_total_us, 6)
        ),
        _ => String::new(),
    }
}

fn ended(status: Status) -> &'static str {
    match status {
        Status::Complete => "is complete",
        Status::Refused => "was refused, and not begun",
        Status::Stopped => "was stopped on request; the position is kept",
        Status::LinkLost => {
            "was stopped by the device, which had not heard from the host for too long"
        }
        Status::Faulted => "ended by a fault",
        Status::Running | Status::Unknown => "has an unknown outcome",
    }
}

/// The commands that reference the thread of a capsule.
pub const FIND_THREAD: &str =
    "`retrograde capsule reference`; a new capsule, unfolded: `retrograde capsule calibrate`";

/// The commands that resolve a refusal.
fn way_on(refusal: &Refusal) -> Option<&'static str> {
    Some(match refusal {
        Refusal::NotHomed => "`retrograde home` finds the position",
        Refusal::NotAtHome { .. } => "`retrograde move 0` or `retrograde home`",
        Refusal::NotReferenced => FIND_THREAD,
        Refusal::RigFaulted(_) => {
            "once the cause is removed `retrograde ack rig`, then `retrograde home`"
        }
        Refusal::CapsuleFaulted(_) => "once the cause is removed `retrograde ack capsule`",
        Refusal::AcknowledgeFirst => "`retrograde ack`",
        Refusal::OutOfRange {
            field: Field::ThreadUm,
            min: 0,
            ..
        } => "`retrograde unfold`: a calibration begins unfolded",
        _ => return None,
    })
}

impl Failure {
    /// An error of any kind, with its code and remedy.
    pub fn of(error: &dyn Diagnostic, exit_code: u8) -> Self {
        let text = |of: Option<Box<dyn fmt::Display + '_>>| {
            of.map(|of| of.to_string()).unwrap_or_default()
        };
        Self::new(
            text(error.code()),
            exit_code,
            error.to_string(),
            text(error.help()),
        )
    }

    pub fn new(
        code: impl Into<String>,
        exit_code: u8,
        why: impl Into<String>,
        help: impl Into<String>,
    ) -> Self {
        Self::Message(Box::new(Message {
            code: code.into(),
            exit_code,
            why: why.into(),
            help: help.into(),
            more: Value::Null,
        }))
    }

    #[must_use]
    pub fn with(mut self, fields: Value) -> Self {
        if let Self::Message(message) = &mut self {
            message.more = fields;
        }
        self
    }

    /// An unusable file or argument, with the remedy.
    pub fn input(why: impl Into<String>, help: impl Into<String>) -> Self {
        Self::new("retrograde::input", USAGE, why, help)
    }

    /// Refused by this program itself, or requested too late; with the remedy.
    pub fn refused(why: impl Into<String>, help: impl Into<String>) -> Self {
        Self::new("retrograde::refused", REFUSED, why, help)
    }

    /// Turns an error of writing this file into a failure.
    pub fn file<E: Into<io::Error>>(path: &Path) -> impl FnOnce(E) -> Self {
        move |error| {
            let io = error.into();
            let why = format!("{}: {io}", path.display());
            let help = format!("{}, or choose another file", named::remedy(&io));
            Self::new("retrograde::file", FAILED, why, help)
        }
    }

    /// The result could not be written, although the command was carried out.
    pub fn output(io: &io::Error) -> Self {
        Self::new(
            "retrograde::output",
            FAILED,
            format!("standard output: {io}; the command was carried out, its result is lost"),
            format!(
                "{}; do not repeat a command that moves without looking",
                named::remedy(io)
            ),
        )
    }

    pub fn remedy(&self) -> String {
        self.help().map(|help| help.to_string()).unwrap_or_default()
    }

    pub fn in_one_line(&self) -> String {
        let help = self.help().map(|help| format!("; {help}"));
        let text = format!("{self}{}", help.unwrap_or_default());
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    /// The exit code; the table is in `docs/records.md`.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Client(error) | Self::Experiment(ExperimentError::Client(error)) => {
                error.exit_code()
            }
            Self::Open(_)
            | Self::NotFound { .. }
            | Self::Ambiguous { .. }
            | Self::Unreached { .. } => NO_DEVICE,
            Self::Experiment(ExperimentError::Both { .. }) => UNKNOWN,
            Self::Experiment(ExperimentError::Incomplete { status, .. })
            | Self::Ended { status, .. } => status_code(*status),
            Self::Stops { reports } => {
                let undelivered = |report: &StopReport| report.delivery == Delivery::NotDelivered;
                if reports.iter().any(undelivered) {
                    NOT_DELIVERED
                } else {
                    UNKNOWN
                }
            }
            Self::Message(message) => message.exit_code,
            Self::Experiment(ExperimentError::Record(_) | ExperimentError::Unrecorded { .. })
            | Self::Record(_) => FAILED,
        }
    }

    pub fn json(&self) -> Value {
        let mut value = json!({
            "ok": false,
            "exit_code": self.exit_code(),
            "error": {
                "code": self.code().map(|code| code.to_string()),
                "message": self.to_string(),
                "help": self.help().map(|help| help.to_string()),
            },
        });
        if let Self::Stops { reports } = self {
            value["machines"] = reports.iter().map(StopReport::json).collect();
        }
        if let Self::Message(message) = self
            && let (Some(value), Some(more)) = (value.as_object_mut(), message.more.as_object())
        {
            value.extend(more.clone());
        }
        value
    }

    pub fn text(&self) -> String {
        let code = self
            .code()
            .map(|code| format!("[{code}]"))
            .unwrap_or_default();
        let help = self
            .help()
            .map(|help| format!("\n  help: {}", help.to_string().replace('\n', "\n        ")))
            .unwrap_or_default();
        let way_on = self
            .refusal()
            .and_then(way_on)
            .map(|command| format!("; {command}"))
            .unwrap_or_default();
        format!("error{code}: {self}{help}{way_on}")
    }

    fn refusal(&self) -> Option<&Refusal> {
        match self.client()? {
            ClientError::Refused { refusal, .. } => Some(refusal),
            _ => None,
        }
    }

    /// Whether the link broke while the machine moved, or after an order to move, so that it may be moving.
    pub fn is_cut(&self) -> bool {
        matches!(
            self.client(),
            Some(ClientError::Link(LinkError::Cut { .. }))
        )
    }

    fn client(&self) -> Option<&ClientError> {
        match self {
            Self::Client(error) | Self::Experiment(ExperimentError::Client(error)) => Some(error),
            _ => None,
        }
    }
}

fn status_code(status: Status) -> u8 {
    match status {
        Status::Complete => DONE,
        Status::Refused => REFUSED,
        Status::Stopped => STOPPED,
        Status::LinkLost | Status::Faulted => FAULT,
        Status::Running | Status::Unknown => UNKNOWN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::rig::RigFault;
    use protocol::table::Impact;

    /// Whoever reads the terminal is told the command; programs and the page get the reason alone.
    #[test]
    fn a_refusal_names_the_command_that_leads_on_at_the_terminal_only() {
        for (refusal, command) in [
            (Refusal::NotHomed, "`retrograde home`"),
            (Refusal::NotReferenced, "`retrograde capsule reference`"),
            (
                Refusal::RigFaulted(RigFault::EStopFrame),
                "`retrograde ack rig`",
            ),
            (Refusal::AcknowledgeFirst, "`retrograde ack`"),
        ] {
            let failure = Failure::Client(ClientError::Refused {
                place: "the rig".to_owned(),
                request: "Home",
                impact: Impact::Motion,
                refusal,
            });
            assert!(failure.text().contains(command), "{}", failure.text());
            let json = failure.json().to_string();
            assert!(!json.contains(command), "{json}");
        }
    }
}
