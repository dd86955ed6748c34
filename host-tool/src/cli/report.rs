//! `report`: an HTML page of trials, or of a campaign.

use std::path::{Path, PathBuf};

use clap::Args;
use client::wording::word;
use lab::campaign::files::{ORDER, PLAN};
use lab::operations::failure::Failure;
use report::html::{self, Existing, campaign as campaign_report};
use serde_json::{Value, json};

use crate::cli::failure;
use crate::cli::screen::Screen;

/// Arguments of `report`.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Records: JSON files of trials, or folders of them; or the folder of one campaign.
    #[arg(required = true, value_name = "TRIAL")]
    pub trials: Vec<PathBuf>,
    /// The HTML file [default: report.html]; a campaign's report goes to its folder `report`.
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Replace an existing report.
    #[arg(long)]
    pub force: bool,
}

pub(crate) fn report(args: &ReportArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let existing = match args.force {
        true => Existing::Replace,
        false => Existing::Keep,
    };
    if let Some(folder) = args.trials.iter().find(|path| is_campaign(path)) {
        return report_campaign(folder, args, existing, screen);
    }
    let out = args.out.clone().unwrap_or_else(|| "report.html".into());
    let found = html::find(&args.trials).map_err(failure::report)?;
    let report = html::write(&found, &[], &out, existing).map_err(failure::report)?;
    let trials = match found.sidecars.len() {
        1 => "1 trial".to_owned(),
        n => format!("{n} trials"),
    };
    screen.say(&format!("{trials} in {}", out.display()));
    for damaged in &report.damaged {
        screen.hint(&format!("damaged: {}", damaged.sidecar.display()));
        for defect in &damaged.defects {
            screen.hint(&format!("  {defect}"));
        }
    }
    for omitted in &found.omitted {
        screen.hint(&omitted.to_string());
    }
    let shown = |path: &PathBuf| path.display().to_string();
    let value = json!({
        "trials": found.sidecars.iter().map(shown).collect::<Vec<_>>(),
        "report": shown(&out),
        "damaged": report.damaged,
        "omitted": found.omitted,
    });
    let lost = found
        .omitted
        .iter()
        .filter(|omitted| omitted.is_record)
        .count();
    match (report.damaged.len(), lost) {
        (0, 0) => Ok(value),
        (damaged, lost) => {
            let defects = format!(
                "trials that contradict themselves or are incomplete: {damaged}, records omitted: {lost}"
            );
            Err(failure::report_defects(&out, &defects, value))
        }
    }
}

/// A campaign needs more than a plan, because people keep plans in any folder.
fn is_campaign(path: &Path) -> bool {
    path.join(PLAN).is_file() && path.join(ORDER).is_file()
}

fn report_campaign(
    folder: &Path,
    args: &ReportArgs,
    existing: Existing,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    if args.trials.len() > 1 || args.out.is_some() {
        let is_there = campaign_report::present(folder) != campaign_report::Present::Nothing;
        let force = if args.force || is_there {
            " --force"
        } else {
            ""
        };
        let (shown, folder) = (folder.display(), word(folder));
        return Err(Failure::input(
            format!(
                "{shown} is a campaign: its report is of it alone, and goes to its folder `report`"
            ),
            format!("`retrograde report {folder}{force}`"),
        ));
    }
    let written = campaign_report::write(folder, existing).map_err(failure::report)?;
    screen.say(&format!(
        "{} of {} trials count; origin {}",
        written.counted, written.planned, written.origin
    ));
    for file in &written.files {
        screen.say(&format!("  {}", file.display()));
    }
    for finding in &written.findings {
        screen.hint(&format!("not as it was written: {finding}"));
    }
    for notice in &written.notices {
        screen.hint(notice);
    }
    match (written.findings.len(), written.defects) {
        (0, 0) => Ok(json!(written)),
        (findings, defects) => {
            let defects = format!(
                "findings of `verify`: {findings}, trials whose records cannot be relied on: {defects}"
            );
            Err(failure::report_defects(
                &written.page,
                &defects,
                json!(written),
            ))
        }
    }
}
