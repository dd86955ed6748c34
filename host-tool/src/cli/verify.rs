//! `verify`: finds every change of a folder since it was written, and every incomplete record.

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
    for finding in verified.findings.iter().chain(&verified.not_whole) {
        screen.say(&format!("{finding}\n  remedy: {}", finding.remedy));
    }
    if !(verified.findings.is_empty() && verified.not_whole.is_empty()) {
        return Err(failure::verified(folder, &verified));
    }
    if !has_manifest && verified.records == 0 {
        return Err(failure::campaign(CampaignError::misuse(
            folder,
            format!("there is no {} and no record of a trial", manifest::NAME),
            "give the folder of a campaign, or of records",
        )));
    }
    let compared = match has_manifest {
        true => format!("{} files are as {} says", verified.files, manifest::NAME),
        false => format!(
            "there is no {}, so nothing shows whether files were changed",
            manifest::NAME
        ),
    };
    screen.say(&format!(
        "{}: {compared}; {} records are whole and in order.",
        folder.display(),
        verified.records
    ));
    Ok(json!({
        "campaign": verified.campaign,
        "manifest": has_manifest,
        "files": verified.files,
        "records": verified.records,
        "findings": [],
    }))
}
