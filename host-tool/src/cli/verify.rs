//! `verify`: finds every change of a folder since it was written.

use std::path::PathBuf;

use clap::Args;
use lab::campaign::{CampaignError, manifest, verify as verification};
use lab::operations::failure::Failure;
use serde_json::{Value, json};

use crate::cli::failure;
use crate::cli::screen::Screen;

/// Arguments of `verify`.
#[derive(Debug, Args)]
pub struct VerifyArgs {
    /// The folder of a campaign, or of records.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
}

pub(crate) fn verify(args: &VerifyArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let folder = &args.folder;
    let verified = verification::verify(folder).map_err(failure::campaign)?;
    let has_manifest = folder.join(manifest::NAME).exists();
    for finding in &verified.findings {
        screen.say(&format!("{finding}\n  remedy: {}", finding.remedy));
    }
    if !verified.findings.is_empty() {
        return Err(failure::changed(folder, &verified.findings));
    }
    if !has_manifest && verified.records == 0 {
        return Err(failure::campaign(CampaignError::misuse(
            folder,
            format!("there is no {} and no record of a trial", manifest::NAME),
            "give the folder of a campaign, or of records",
        )));
    }
    let whole = verified.records - verified.unended.len();
    let unended = unended(&verified.unended);
    screen.say(&match has_manifest {
        true => format!(
            "{}: {} files are as {} says; {whole} records are whole and in order{unended}.",
            folder.display(),
            verified.files,
            manifest::NAME,
        ),
        false => format!(
            "{}: there is no {}, so nothing shows whether files were changed; {whole} records have all their rows in order{unended}.",
            folder.display(),
            manifest::NAME,
        ),
    });
    Ok(json!({
        "campaign": verified.campaign,
        "manifest": has_manifest,
        "files": verified.files,
        "records": verified.records,
        "unended": verified.unended,
        "findings": [],
    }))
}

/// Names the records without an end. Whether something still records them is not known here.
fn unended(records: &[String]) -> String {
    let have = match records.len() {
        0 => return String::new(),
        1 => "1 has no end, because it".to_owned(),
        count => format!("{count} have no end, because each"),
    };
    format!(
        "; {have} is under way or was cut off: {}",
        records.join(", ")
    )
}
