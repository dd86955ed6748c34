//! Failures as the user sees them: text, code, help, exit code.

use std::io;
use std::path::{Path, PathBuf};

use analysis::report::ReportError;
use analysis::report::campaign::CampaignReportError;
use analysis::report::figures::FigureError;
use campaign::CampaignError;
use campaign::verify::Finding;
use client::decimal;
use client::error::ClientError;
use client::identity;
use client::link::OpenError;
use client::wording;
use locomotion::range::OutOfRange;
use miette::Diagnostic;
use motion::axis::AxisError;
use motion::run::RunError;
use protocol::system::DeviceKind;
use serde_json::{Value, json};
use trials::experiment::ExperimentError;
use trials::trial::{RecordError, Status};

use crate::cli::configured;
use crate::cli::doctor::{self, Finding as Sickness};
use crate::cli::stops::{self, Delivery, Told};

/// Success.
pub const DONE: u8 = 0;
/// A file or this program failed.
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

/// Why a command failed.
#[derive(Debug, thiserror::Error, Diagnostic)]
pub enum Failure {
    /// The device or the link to it.
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
    /// A campaign cannot be used.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Campaign(#[from] CampaignError),
    /// The operator left a campaign.
    #[error("left; everything that was entered is in {}", folder.display())]
    #[diagnostic(
        code(retrograde::left),
        help("`retrograde campaign resume {}` goes on", folder.display())
    )]
    Left {
        /// Its folder.
        folder: PathBuf,
    },
    /// A folder is not as it was written.
    #[error("{}", changed(folder, findings))]
    #[diagnostic(
        code(retrograde::changed),
        help("each finding above has its remedy; what was changed is no record any more")
    )]
    Changed {
        /// The folder.
        folder: PathBuf,
        /// What is wrong with it.
        findings: Vec<Finding>,
    },
    /// A report was written, but not all that was to be on it can be relied on.
    #[error("{} is written, but {defects}; the lines above name each", page.display())]
    #[diagnostic(
        code(retrograde::report_defects),
        help(
            "the page says the same in red; what is not named can be relied on. `retrograde verify` looks at a folder without a report"
        )
    )]
    ReportDefects {
        /// The page.
        page: PathBuf,
        /// How many cannot be relied on, in words.
        defects: String,
        /// The same as after success, for `--json`.
        written: Value,
    },
    /// The report could not be written.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Report(#[from] ReportError),
    /// The report of a campaign could not be written.
    #[error(transparent)]
    #[diagnostic(transparent)]
    CampaignReport(#[from] CampaignReportError),
    /// A figure could not be drawn.
    #[error(transparent)]
    #[diagnostic(code(retrograde::figure))]
    Figure(#[from] FigureError),
    /// The run is infeasible.
    #[error("{}", wording::infeasible(.0))]
    #[diagnostic(
        code(retrograde::infeasible),
        help("{}nothing was sent; `retrograde plan` tries runs without a rig", way_out(.0))
    )]
    Run(#[from] RunError),
    /// The screw is impossible.
    #[error("{}", wording::axis(.0))]
    #[diagnostic(code(retrograde::axis))]
    Axis(#[from] AxisError),
    /// A number that the models do not cover.
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
        /// What was found instead.
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
        /// All of them.
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
        /// What was found instead.
        there: String,
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
        /// What the user can do now.
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
    /// The result could not be written. What was asked for has been done.
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
        /// What the user can do.
        help: String,
    },
    /// A file or an argument that cannot be used.
    #[error("{why}")]
    #[diagnostic(code(retrograde::input), help("{help}"))]
    Input {
        /// The reason.
        why: String,
        /// What the user can do.
        help: String,
    },
    /// The rig refused an import of settings, or it was interrupted.
    #[error("{}: {setting}: {cause}; {}", file.display(), aftermath(changed))]
    #[diagnostic(code(retrograde::import), help("{}", way_back(changed)))]
    Import {
        /// The file.
        file: PathBuf,
        /// The setting that could not be set.
        setting: &'static str,
        /// The reason.
        cause: Box<ClientError>,
        /// Changes that could not be undone; empty if everything is as before.
        changed: Vec<String>,
    },
    /// A commissioning that is not complete.
    #[error("{why}")]
    #[diagnostic(code(retrograde::commission), help("{help}"))]
    Commission {
        /// What kept it from completion.
        ending: Unfinished,
        /// The reason.
        why: String,
        /// What the user can do.
        help: String,
    },
    /// A stop that not every machine has confirmed.
    #[error("{}", stops::summary(told))]
    #[diagnostic(code(retrograde::stop), help("{}", stops::DO_NOW))]
    Stops {
        /// What became of it, for each machine.
        told: Vec<Told>,
    },
    /// The rig was called by a name that it does not carry.
    #[error("{}; nothing was moved", configured::wrong_name(name, place, carried))]
    #[diagnostic(
        code(retrograde::wrong_name),
        help(
            "are two rigs exchanged? `retrograde devices` shows all names and places. If this is the right one, `retrograde --rig {name} settings name {name}` gives it its name"
        )
    )]
    WrongName {
        /// What the link leads to.
        place: String,
        /// The name by which it was called.
        name: String,
        /// The name that it carries; empty if it has none.
        carried: String,
    },
    /// The doctor has found something wrong.
    #[error("{}", doctor::summary(findings))]
    #[diagnostic(code(retrograde::doctor), help("each finding above has its remedy"))]
    Sick {
        /// All findings.
        findings: Vec<Sickness>,
    },
    /// The image could not be flashed.
    #[error("{why}")]
    #[diagnostic(code(retrograde::flash), help("{help}"))]
    Flash {
        /// The reason.
        why: String,
        /// What the user can do.
        help: String,
    },
}

/// For `--json`, a command line that cannot be understood; `text` is what a person is told.
pub(crate) fn usage(text: &str) -> Value {
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

/// What kept a commissioning from completion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unfinished {
    /// A step has found something wrong.
    Defect,
    /// Nobody was there to show something.
    NotShown,
    /// The operator left.
    Left,
}

/// The options that make the run feasible, from the planner's numbers.
fn way_out(error: &RunError) -> String {
    match *error {
        RunError::TotalTooShort {
            minimal_total_us,
            minimal_accel_um_s2: Some(um_s2),
        } => format!(
            "`--duration-s {}`, or `--accel-mm-s2 {}`, if the rig's limits allow it; ",
            decimal::write(minimal_total_us, 6),
            decimal::write(um_s2.into(), 3)
        ),
        RunError::TotalTooShort {
            minimal_total_us, ..
        }
        | RunError::PeakAboveLimit {
            minimal_total_us: Some(minimal_total_us),
            ..
        } => format!("`--duration-s {}`; ", decimal::write(minimal_total_us, 6)),
        _ => String::new(),
    }
}

fn changed(folder: &Path, findings: &[Finding]) -> String {
    let first = findings.first().map(ToString::to_string);
    let more = match findings.len() {
        0 | 1 => String::new(),
        count => format!(", and {} more findings", count - 1),
    };
    format!(
        "{} is not as it was written: {}{more}",
        folder.display(),
        first.unwrap_or_default()
    )
}

fn aftermath(changed: &[String]) -> String {
    if changed.is_empty() {
        return "all settings are as before".to_owned();
    }
    format!(
        "the import could not be undone; these are changed: {}",
        changed.join(", ")
    )
}

fn way_back(changed: &[String]) -> &'static str {
    if changed.is_empty() {
        "correct the file; `retrograde info rig` shows whether the rig has to be homed again"
    } else {
        "`retrograde settings list` shows the present values; correct them by hand, or import a correct file"
    }
}

fn ended(status: Status) -> &'static str {
    match status {
        Status::Complete => "is complete",
        Status::Stopped => "was stopped on request; the position is kept",
        Status::LinkLost => {
            "was stopped by the device, which had not heard from the host for too long"
        }
        Status::Faulted => "ended by a fault",
        Status::Running | Status::Unknown => "has an unknown outcome",
    }
}

impl Failure {
    /// With its remedy, in one line.
    #[must_use]
    pub(crate) fn in_one_line(&self) -> String {
        let help = self.help().map(|help| format!("; {help}"));
        let text = format!("{self}{}", help.unwrap_or_default());
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    /// The exit code; the table is in `docs/host-tool.md`.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Client(error) => client_code(error),
            Self::Open(_)
            | Self::NotFound { .. }
            | Self::Ambiguous { .. }
            | Self::WrongName { .. }
            | Self::NothingFound { .. } => NO_DEVICE,
            Self::Experiment(ExperimentError::Client(error)) => client_code(error),
            Self::Experiment(ExperimentError::Incomplete { status, .. })
            | Self::Ended { status, .. } => status_code(*status),
            Self::Import { cause, changed, .. } => {
                if changed.is_empty() {
                    client_code(cause)
                } else {
                    UNKNOWN
                }
            }
            Self::Commission { ending, .. } => match ending {
                Unfinished::Defect => FAULT,
                Unfinished::NotShown => REFUSED,
                Unfinished::Left => STOPPED,
            },
            Self::Stops { told } => {
                let undelivered = |told: &Told| told.delivery == Delivery::NotDelivered;
                if told.iter().any(undelivered) {
                    NOT_DELIVERED
                } else {
                    UNKNOWN
                }
            }
            Self::Sick { findings } => {
                let codes = findings.iter().map(Sickness::exit_code);
                // A place without a machine outweighs what a machine says.
                codes.filter(|code| *code != DONE).min().unwrap_or(FAILED)
            }
            Self::Campaign(CampaignError { misuse: true, .. })
            | Self::Input { .. }
            | Self::Range(_) => USAGE,
            Self::Left { .. } => STOPPED,
            Self::Run(_) | Self::Axis(_) | Self::Refused { .. } => REFUSED,
            Self::Experiment(ExperimentError::Record(_) | ExperimentError::Unrecorded { .. })
            | Self::Record(_)
            | Self::Campaign(_)
            | Self::Changed { .. }
            | Self::ReportDefects { .. }
            | Self::Report(_)
            | Self::CampaignReport(_)
            | Self::Figure(_)
            | Self::File { .. }
            | Self::Output { .. }
            | Self::Flash { .. } => FAILED,
        }
    }

    /// For `--json`.
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
        if let Self::Changed { findings, .. } = self {
            value["findings"] = json!(findings);
        }
        if let Self::ReportDefects { written, .. } = self
            && let (Some(value), Some(written)) = (value.as_object_mut(), written.as_object())
        {
            value.extend(written.clone());
        }
        if let Self::Sick { findings } = self {
            value["findings"] = findings.iter().map(Sickness::json).collect();
        }
        value
    }

    /// For people.
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
        format!("error{code}: {self}{help}")
    }
}

fn client_code(error: &ClientError) -> u8 {
    match error {
        ClientError::Link(_)
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
        | ClientError::WrongResponse { .. } => UNKNOWN,
        ClientError::Overdue { .. } => FAULT,
        ClientError::NotHomed { fault } => {
            if fault.is_some() {
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
        Status::Stopped => STOPPED,
        Status::LinkLost | Status::Faulted => FAULT,
        Status::Running | Status::Unknown => UNKNOWN,
    }
}
