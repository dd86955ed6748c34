//! Failures that only one command has. `operations` has those that several commands share.

use std::path::{Path, PathBuf};

use client::error::ClientError;
use client::identity::kind_name;
use lab::campaign::differences::Finding;
use lab::campaign::{CampaignError, resumption};
use lab::operations::failure::{
    CommandFailure, FAILED, FAULT, REFUSED, STOPPED, UNKNOWN, USAGE, client_code,
};
use miette::Diagnostic;
use protocol::error::Refusal;
use protocol::system::DeviceKind;
use report::figures::FigureError;
use report::html::ReportError;
use report::html::campaign::CampaignReportError;
use serde_json::{Value, json};

/// Failure of a single command.
#[derive(Debug, thiserror::Error, Diagnostic)]
pub(crate) enum Own {
    /// A campaign cannot be used.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Campaign(#[from] CampaignError),
    /// The operator left a campaign.
    #[error("left; everything that was entered is in {}", folder.display())]
    #[diagnostic(code(retrograde::left), help("{} goes on", resumption(folder)))]
    Left {
        /// Its folder.
        folder: PathBuf,
    },
    /// A folder has changed since it was written.
    #[error("{}", changed(folder, findings))]
    #[diagnostic(
        code(retrograde::changed),
        help("each finding above has its remedy; until then do not rely on what it names")
    )]
    Changed {
        /// The folder.
        folder: PathBuf,
        /// The changes found.
        findings: Vec<Finding>,
    },
    /// The report was written, but some of its data cannot be relied on.
    #[error("{} is written; {defects}; the lines above name each", page.display())]
    #[diagnostic(
        code(retrograde::report_defects),
        help(
            "the page says the same in red; what is not named can be relied on. `retrograde verify` looks at a folder without a report"
        )
    )]
    ReportDefects {
        /// The page.
        page: PathBuf,
        /// Number of unreliable parts, in words.
        defects: String,
        /// The result for `--json`, as after success.
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
    /// The rig refused an import of settings, or it was interrupted.
    #[error("{}: {setting}: {cause}; {}", file.display(), aftermath(changed))]
    #[diagnostic(code(retrograde::import), help("{}", way_back(changed, *machine, cause)))]
    Import {
        /// Whose settings they are.
        machine: DeviceKind,
        /// The file.
        file: PathBuf,
        /// The setting that could not be set.
        setting: &'static str,
        /// The reason.
        cause: Box<ClientError>,
        /// Changes that could not be undone; empty if everything is restored.
        changed: Vec<String>,
    },
    /// A commissioning is incomplete.
    #[error("{why}")]
    #[diagnostic(code(retrograde::commission), help("{help}"))]
    Commission {
        /// The obstacle to completion.
        ending: Unfinished,
        /// The reason.
        why: String,
        /// Advice to the user.
        help: String,
    },
}

impl CommandFailure for Own {
    fn exit_code(&self) -> u8 {
        match self {
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
            Self::Campaign(CampaignError { misuse: true, .. }) => USAGE,
            Self::Left { .. } => STOPPED,
            Self::Campaign(_)
            | Self::Changed { .. }
            | Self::ReportDefects { .. }
            | Self::Report(_)
            | Self::CampaignReport(_)
            | Self::Figure(_) => FAILED,
        }
    }

    fn describe(&self, value: &mut Value) {
        match self {
            Self::Changed { findings, .. } => value["findings"] = json!(findings),
            Self::ReportDefects { written, .. } => {
                if let (Some(value), Some(written)) = (value.as_object_mut(), written.as_object()) {
                    value.extend(written.clone());
                }
            }
            _ => {}
        }
    }
}

/// Obstacle to the completion of a commissioning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unfinished {
    /// A step has found a defect.
    Defect,
    /// A step needed a person, and none was there.
    NotShown,
    /// The operator left.
    Left,
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

fn way_back(changed: &[String], machine: DeviceKind, cause: &ClientError) -> String {
    let name = kind_name(machine);
    if !changed.is_empty() {
        return format!(
            "`retrograde settings --of {name} list` shows the present values; correct them by hand, or import a correct file"
        );
    }
    let of_value = |refusal: &Refusal| {
        matches!(
            refusal,
            Refusal::SettingRange { .. } | Refusal::SettingRule { .. } | Refusal::NameNotPrintable
        )
    };
    let first = match cause {
        ClientError::Refused { refusal, .. } if of_value(refusal) => "correct the file",
        _ => "the file may be good: remove the cause, then again",
    };
    match machine {
        DeviceKind::Rig => {
            format!("{first}; `retrograde info rig` shows whether the rig has to be homed again")
        }
        DeviceKind::Capsule => {
            format!("{first}; `retrograde info capsule` shows how the capsule is")
        }
    }
}
