//! Failures as shown to the user: text, code, help, exit code.

use std::io;
use std::path::{Path, PathBuf};

use crate::trials::experiment::ExperimentError;
use crate::trials::trial::{RecordError, Status};
use client::decimal;
use client::error::ClientError;
use client::identity;
use client::link::OpenError;
use client::wording;
use locomotion::range::OutOfRange;
use miette::Diagnostic;
use motion::axis::AxisError;
use motion::run::RunError;
use protocol::error::{Field, Refusal};
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::operations::delivery::{self, Delivery, Told};

/// Success.
pub const DONE: u8 = 0;
/// A file could not be used, or this program failed.
pub const FAILED: u8 = 1;
/// The command line cannot be understood.
pub const USAGE: u8 = 2;
/// Refused by the check or by the device; nothing moved.
pub const REFUSED: u8 = 3;
/// No device, the wrong one, several, or the link was lost.
pub const NO_DEVICE: u8 = 4;
/// Firmware and host tool do not match.
pub const MISMATCH: u8 = 5;
/// The device latched a fault, or ended the action by itself.
pub const FAULT: u8 = 6;
/// Whether the command was carried out is unknown: look at the machine.
pub const UNKNOWN: u8 = 7;
/// A stop did not reach a machine.
pub const NOT_DELIVERED: u8 = 8;
/// Stopped by the operator.
pub const STOPPED: u8 = 130;

/// A failure specific to one command.
pub trait CommandFailure: Diagnostic + Send + Sync {
    /// The exit code; the table is in `docs/records.md`.
    fn exit_code(&self) -> u8;

    /// Adds the fields that `--json` shows beside the error.
    fn describe(&self, value: &mut Value) {
        let _ = value;
    }
}

/// A [`CommandFailure`], reported without further text.
#[derive(Debug)]
pub struct OfCommand(Box<dyn CommandFailure>);

impl std::fmt::Display for OfCommand {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

impl std::error::Error for OfCommand {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.0.source()
    }
}

impl Diagnostic for OfCommand {
    fn code<'a>(&'a self) -> Option<Box<dyn std::fmt::Display + 'a>> {
        self.0.code()
    }

    fn help<'a>(&'a self) -> Option<Box<dyn std::fmt::Display + 'a>> {
        self.0.help()
    }
}

impl<T: CommandFailure + 'static> From<T> for Failure {
    fn from(failure: T) -> Self {
        Self::Command(OfCommand(Box::new(failure)))
    }
}

/// The reason why a command failed.
#[derive(Debug, thiserror::Error, Diagnostic)]
pub enum Failure {
    /// An error of the device or of the link to it.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Client(#[from] ClientError),
    /// The link could not be opened.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Open(#[from] OpenError),
    /// A recorded action failed.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Experiment(#[from] ExperimentError),
    /// A record could not be written or read.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Record(#[from] RecordError),
    /// The run is infeasible.
    #[error("{0}")]
    #[diagnostic(
        code(retrograde::infeasible),
        help("{}nothing was sent; `retrograde plan` tries runs without a rig", way_out(.0))
    )]
    Run(#[from] RunError),
    /// The screw is impossible.
    #[error("{0}")]
    #[diagnostic(code(retrograde::axis))]
    Axis(#[from] AxisError),
    /// A number outside the range of the models.
    #[error("{0}")]
    #[diagnostic(code(retrograde::range))]
    Range(#[from] OutOfRange),
    /// No machine of the wanted kind was found.
    #[error("no {} found; {there}", identity::kind_name(*.wanted))]
    #[diagnostic(
        code(retrograde::not_found),
        help("plug the board in, or say where it is: `--{} /dev/ttyACM0` or `tcp:HOST:PORT`", identity::kind_name(*.wanted))
    )]
    NotFound {
        /// The wanted kind.
        wanted: DeviceKind,
        /// The machines and places that were found instead.
        there: String,
    },
    /// Several of the wanted kind were found.
    #[error("several {}s found: {there}", identity::kind_name(*.wanted))]
    #[diagnostic(
        code(retrograde::ambiguous),
        help("choose one: `--{} WHERE`; nothing but requests for an identity was sent", identity::kind_name(*.wanted))
    )]
    Ambiguous {
        /// The wanted kind.
        wanted: DeviceKind,
        /// All machines of this kind that were found.
        there: String,
    },
    /// Nothing was found at all.
    #[error("no machine found; {there}")]
    #[diagnostic(
        code(retrograde::not_found),
        help(
            "plug a board in, or say where it is: `--rig /dev/ttyACM0`, `--capsule tcp:HOST:PORT`"
        )
    )]
    NothingFound {
        /// The places that were found instead.
        there: String,
    },
    /// The server has no contact to the machine, or too much to do at once.
    #[error("{why}")]
    #[diagnostic(code(retrograde::not_found), help("{help}"))]
    Unreached {
        /// The reason.
        why: String,
        /// The remedy.
        help: String,
    },
    /// The action did not end as planned.
    #[error("{action} {}{}", ended(*.status), reason.as_deref().map(|why| format!(": {why}")).unwrap_or_default())]
    #[diagnostic(code(retrograde::ended), help("{help}"))]
    Ended {
        /// The action, such as `the run`.
        action: &'static str,
        /// How it ended.
        status: Status,
        /// The fault, if there was one.
        reason: Option<String>,
        /// The remedy.
        help: String,
    },
    /// A file could not be written.
    #[error("{path}: {io}", path = path.display())]
    #[diagnostic(
        code(retrograde::file),
        help("choose a file in a folder that can be written, with free space")
    )]
    File {
        /// The file.
        path: PathBuf,
        /// The operating system's reason.
        io: io::Error,
    },
    /// The result could not be written, although the command was carried out.
    #[error("standard output: {io}; the command was carried out, its result is lost")]
    #[diagnostic(
        code(retrograde::output),
        help(
            "write to a device with free space; do not repeat a command that moves without looking"
        )
    )]
    Output {
        /// The operating system's reason.
        io: io::Error,
    },
    /// Refused by this program itself, or requested too late.
    #[error("{why}")]
    #[diagnostic(code(retrograde::refused), help("{help}"))]
    Refused {
        /// The reason.
        why: String,
        /// The remedy.
        help: String,
    },
    /// An unusable file or argument.
    #[error("{why}")]
    #[diagnostic(code(retrograde::input), help("{help}"))]
    Input {
        /// The reason.
        why: String,
        /// The remedy.
        help: String,
    },
    /// At least one machine has not confirmed the stop.
    #[error("{}", delivery::summary(told))]
    #[diagnostic(code(retrograde::stop), help("{}", delivery::DO_NOW))]
    Stops {
        /// The result for each machine.
        told: Vec<Told>,
    },
    /// The rig does not have the name by which it was called.
    #[error("{}; nothing was moved", wrong_name(name, place, carried))]
    #[diagnostic(
        code(retrograde::wrong_name),
        help(
            "are two rigs exchanged? `retrograde devices` shows all names and places. If this is the right one, `retrograde --rig {name} settings name {name}` gives it its name",
            name = wording::word(Path::new(name))
        )
    )]
    WrongName {
        /// The machine's place, as the user named it.
        place: String,
        /// The name by which it was called.
        name: String,
        /// The rig's actual name; empty if it has none.
        carried: String,
    },
    /// A failure specific to one command.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Command(OfCommand),
}

/// Text for a wrong name of a rig.
pub fn wrong_name(name: &str, place: &str, carried: &str) -> String {
    match carried {
        "" => format!("the rig at {place} carries no name, and should be `{name}`"),
        carried => format!("the rig at {place} is called `{carried}`, not `{name}`"),
    }
}

/// Text of a command line that cannot be understood; clap writes ranges as Rust does.
#[must_use]
pub fn usage_text(error: &clap::Error) -> String {
    error.render().to_string().replace("..=", " to ")
}

/// Value for `--json` of a command line that cannot be understood; `text` is the message for a person.
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

/// The commands that find the thread of a capsule that is not referenced.
pub const FIND_THREAD: &str = "folded when it was reset: `retrograde capsule check`; else `retrograde capsule reference`; a new capsule, unfolded: `retrograde capsule calibrate`";

/// The commands that lead on from a refusal.
fn way_on(refusal: &Refusal) -> Option<&'static str> {
    Some(match refusal {
        Refusal::NotHomed => "`retrograde home` finds the position",
        Refusal::NotAtHome { .. } => "`retrograde move 0` or `retrograde home`",
        Refusal::NotReferenced => FIND_THREAD,
        Refusal::RigFaulted(_) => {
            "once the cause is gone `retrograde ack rig`, then `retrograde home`"
        }
        Refusal::CapsuleFaulted(_) => "once the cause is gone `retrograde ack capsule`",
        Refusal::AcknowledgeFirst => "`retrograde ack`",
        Refusal::OutOfRange {
            field: Field::ThreadUm,
            min: 0,
            ..
        } => {
            "`retrograde unfold`, or `retrograde capsule reference` after a stop: a calibration begins unfolded"
        }
        _ => return None,
    })
}

impl Failure {
    /// An unusable file or argument, with the remedy.
    pub fn input(why: impl Into<String>, help: impl Into<String>) -> Self {
        let (why, help) = (why.into(), help.into());
        Self::Input { why, help }
    }

    /// Refused by this program itself, or requested too late; with the remedy.
    pub fn refused(why: impl Into<String>, help: impl Into<String>) -> Self {
        let (why, help) = (why.into(), help.into());
        Self::Refused { why, help }
    }

    /// Turns an error with this file into a failure.
    pub fn file<E: Into<io::Error>>(path: &Path) -> impl FnOnce(E) -> Self {
        move |error| Self::File {
            path: path.to_owned(),
            io: error.into(),
        }
    }

    /// The remedy; empty where there is none.
    #[must_use]
    pub fn remedy(&self) -> String {
        self.help().map(|help| help.to_string()).unwrap_or_default()
    }

    /// Text with its remedy, in one line.
    #[must_use]
    pub fn in_one_line(&self) -> String {
        let help = self.help().map(|help| format!("; {help}"));
        let text = format!("{self}{}", help.unwrap_or_default());
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    /// The exit code; the table is in `docs/records.md`.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Client(error) => client_code(error),
            Self::Open(_)
            | Self::NotFound { .. }
            | Self::Ambiguous { .. }
            | Self::WrongName { .. }
            | Self::NothingFound { .. }
            | Self::Unreached { .. } => NO_DEVICE,
            Self::Experiment(ExperimentError::Client(error)) => client_code(error),
            Self::Experiment(ExperimentError::Both { .. }) => UNKNOWN,
            Self::Experiment(ExperimentError::Incomplete { status, .. })
            | Self::Ended { status, .. } => status_code(*status),
            Self::Command(failure) => failure.0.exit_code(),
            Self::Stops { told } => {
                let undelivered = |told: &Told| told.delivery == Delivery::NotDelivered;
                if told.iter().any(undelivered) {
                    NOT_DELIVERED
                } else {
                    UNKNOWN
                }
            }
            Self::Input { .. } | Self::Range(_) => USAGE,
            Self::Run(_) | Self::Axis(_) | Self::Refused { .. } => REFUSED,
            Self::Experiment(ExperimentError::Record(_) | ExperimentError::Unrecorded { .. })
            | Self::Record(_)
            | Self::File { .. }
            | Self::Output { .. } => FAILED,
        }
    }

    /// Value for `--json`.
    #[must_use]
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
        if let Self::Stops { told } = self {
            value["machines"] = told.iter().map(Told::json).collect();
        }
        if let Self::Command(failure) = self {
            failure.0.describe(&mut value);
        }
        value
    }

    /// Text for people.
    #[must_use]
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

    /// The reason for which a machine refused a request.
    fn refusal(&self) -> Option<&Refusal> {
        match self.client()? {
            ClientError::Refused { refusal, .. } => Some(refusal),
            _ => None,
        }
    }

    /// The link broke while the machine moved, or after it was ordered to: it may be moving.
    #[must_use]
    pub fn is_cut(&self) -> bool {
        matches!(self.client(), Some(ClientError::Cut { .. }))
    }

    fn client(&self) -> Option<&ClientError> {
        match self {
            Self::Client(error) | Self::Experiment(ExperimentError::Client(error)) => Some(error),
            _ => None,
        }
    }
}

/// The exit code of an error of the client.
#[must_use]
pub fn client_code(error: &ClientError) -> u8 {
    match error {
        ClientError::Link(_)
        | ClientError::Cut { .. }
        | ClientError::NoAnswer { .. }
        | ClientError::WrongDevice { .. }
        | ClientError::NoReply { .. }
        | ClientError::OwnerBusy { .. }
        | ClientError::SessionLost { .. } => NO_DEVICE,
        ClientError::Mismatch { .. } => MISMATCH,
        ClientError::Refused { .. } | ClientError::Rejected { .. } | ClientError::Owned { .. } => {
            REFUSED
        }
        ClientError::OutcomeUnknown { .. }
        | ClientError::StopUnconfirmed { .. }
        | ClientError::Silent { .. }
        | ClientError::RecordGone { .. }
        | ClientError::WrongResponse { .. } => UNKNOWN,
        ClientError::Overdue { .. } => FAULT,
        ClientError::NotHomed { fault, link_lost } => {
            if fault.is_some() || *link_lost {
                FAULT
            } else {
                STOPPED
            }
        }
        ClientError::Interrupted { .. } => STOPPED,
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
