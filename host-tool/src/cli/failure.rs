//! Failures of single commands. `operations` has those that several commands share.

use std::path::Path;

use lab::campaign::verify::Verified;
use lab::campaign::{CampaignError, resumption};
use lab::operations::failure::{FAILED, Failure, STOPPED, USAGE};
use miette::Diagnostic;
use report::figures::FigureError;
use serde_json::{Value, json};

/// A campaign that cannot be used.
pub(crate) fn campaign(error: CampaignError) -> Failure {
    let exit_code = if error.misuse { USAGE } else { FAILED };
    Failure::of(&error, exit_code)
}

/// A report that could not be written.
pub(crate) fn report(error: impl Diagnostic) -> Failure {
    Failure::of(&error, FAILED)
}

pub(crate) fn figure(error: FigureError) -> Failure {
    Failure::new("retrograde::figure", FAILED, error.to_string(), "")
}

/// The operator quit a campaign.
pub(crate) fn aborted(folder: &Path) -> Failure {
    let why = format!(
        "aborted; everything that was entered is in {}",
        folder.display()
    );
    let help = format!("{} goes on", resumption(folder));
    Failure::new("retrograde::aborted", STOPPED, why, help)
}

/// A folder was changed since it was written, or a record in it is incomplete.
pub(crate) fn verified(folder: &Path, verified: &Verified) -> Failure {
    let is = match verified.findings.is_empty() {
        true => "is unchanged, but a record in it is incomplete",
        false => "is not as it was written",
    };
    let findings = [&verified.findings[..], &verified.not_whole].concat();
    let first = findings.first().map(ToString::to_string);
    let more = match findings.len() {
        0 | 1 => String::new(),
        count => format!(", and {} more findings", count - 1),
    };
    let why = format!(
        "{} {is}: {}{more}",
        folder.display(),
        first.unwrap_or_default()
    );
    let help = "each finding above has its remedy; until then do not rely on what it names";
    Failure::new("retrograde::changed", FAILED, why, help).with(json!({ "findings": findings }))
}

/// The report was written, but some of its data is unreliable. `written` is the result for `--json`, as after success.
pub(crate) fn report_defects(page: &Path, defects: &str, written: Value) -> Failure {
    let why = format!(
        "{} is written; {defects}; the lines above name each",
        page.display()
    );
    let help = "the page says the same in red; what is not named can be relied on. `retrograde verify` looks at a folder without a report";
    Failure::new("retrograde::report_defects", FAILED, why, help).with(written)
}
