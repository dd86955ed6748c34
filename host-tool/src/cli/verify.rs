//! `verify`: finds every change of a folder since it was written.

use std::path::PathBuf;

use campaign::{CampaignError, manifest, verify as verification};
use clap::Args;
use operations::failure::Failure;
use serde_json::{Value, json};

use crate::cli::failure::Own;
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
    let verified = verification::verify(folder).map_err(Own::from)?;
    for finding in &verified.findings {
        screen.say(&format!("{finding}\n  remedy: {}", finding.remedy));
    }
    if !verified.findings.is_empty() {
        return Err(Own::Changed {
            folder: folder.clone(),
            findings: verified.findings,
        }
        .into());
    }
    let has_manifest = folder.join(manifest::NAME).exists();
    if !has_manifest && verified.records == 0 {
        return Err(Own::from(CampaignError::misuse(
            folder,
            format!("there is no {} and no record of a trial", manifest::NAME),
            "give the folder of a campaign, or of records",
        ))
        .into());
    }
    screen.say(&match has_manifest {
        true => format!(
            "{}: {} files are as {} says; {} records are whole and in order.",
            folder.display(),
            verified.files,
            manifest::NAME,
            verified.records,
        ),
        false => format!(
            "{}: there is no {}, so nothing shows whether files were changed; {} records have all their rows in order.",
            folder.display(),
            manifest::NAME,
            verified.records,
        ),
    });
    Ok(json!({
        "campaign": verified.campaign,
        "manifest": has_manifest,
        "files": verified.files,
        "records": verified.records,
        "findings": [],
    }))
}
