//! Failures that only one command has. `operations` has those that several commands share.

use std::path::{Path, PathBuf};

use lab::campaign::verify::Finding;
use lab::campaign::{CampaignError, resumption};
use lab::operations::failure::{FAILED, FAULT, Failure, REFUSED, STOPPED, USAGE};
use miette::Diagnostic;
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

impl From<Own> for Failure {
    fn from(own: Own) -> Self {
        let fields = match &own {
            Own::Changed { findings, .. } => json!({ "findings": findings }),
            Own::ReportDefects { written, .. } => written.clone(),
            _ => Value::Null,
        };
        Self::of(&own, own.exit_code()).with(fields)
    }
}

impl Own {
    fn exit_code(&self) -> u8 {
        match self {
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
