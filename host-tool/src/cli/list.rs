//! `list`: campaigns and trials by date, specimen and outcome.

use std::path::PathBuf;

use clap::Args;
use clap::builder::PossibleValuesParser;
use jiff::civil::Date;
use lab::campaign::catalogue::{self, Wanted};
use lab::operations::arguments::{CAMPAIGNS_FOLDER, DATA_FOLDER};
use lab::operations::failure::Failure;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

/// Arguments of `list`.
#[derive(Debug, Args)]
pub struct ListArgs {
    /// Where to look, also in folders within [default: retrograde-campaigns and retrograde-data].
    #[arg(value_name = "DIR")]
    pub folders: Vec<PathBuf>,
    /// Also list every attempt at the trials of campaigns.
    #[arg(long)]
    pub trials: bool,
    /// From this day on, UTC: 2026-01-31.
    #[arg(long, value_name = "DATE", value_parser = day)]
    pub since: Option<Date>,
    /// Up to this day, UTC.
    #[arg(long, value_name = "DATE", value_parser = day)]
    pub until: Option<Date>,
    /// A part of the specimen's description, or of the note of a trial outside campaigns.
    #[arg(long, value_name = "TEXT")]
    pub specimen: Option<String>,
    /// Its outcome; a campaign is `complete` or `open`.
    #[arg(long, value_name = "OUTCOME", ignore_case = true, value_parser = PossibleValuesParser::new(catalogue::outcomes()))]
    pub outcome: Option<String>,
}

fn day(text: &str) -> Result<Date, String> {
    let day = text.parse();
    day.map_err(|_| "write the day as 2026-01-31".to_owned())
}

pub(crate) fn list(args: &ListArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut folders = args.folders.clone();
    if folders.is_empty() {
        let usual = [CAMPAIGNS_FOLDER, DATA_FOLDER].map(PathBuf::from);
        folders = usual.into_iter().filter(|folder| folder.is_dir()).collect();
    } else if let Some(missing) = folders.iter().find(|folder| !folder.is_dir()) {
        return Err(Failure::input(
            format!("{} is no folder", missing.display()),
            "name folders of records or campaigns: `retrograde list DIR`",
        ));
    }
    let wanted = Wanted {
        since: args.since,
        until: args.until,
        specimen: args.specimen.clone(),
        outcome: args.outcome.clone(),
    };
    let catalogue = catalogue::list(&folders, args.trials, &wanted);
    if catalogue.entries.is_empty() {
        let places: Vec<_> = folders
            .iter()
            .map(|folder| folder.display().to_string())
            .collect();
        screen.say(&match places.as_slice() {
            [] => format!("There is neither {CAMPAIGNS_FOLDER} nor {DATA_FOLDER} here: `retrograde list DIR` looks elsewhere."),
            places => format!("Nothing of this kind in {}.", places.join(", ")),
        });
    }
    for entry in &catalogue.entries {
        let started = entry.started_utc.map_or_else(
            || "not begun       ".to_owned(),
            |time| time.strftime("%Y-%m-%d %H:%M").to_string(),
        );
        let specimen = entry.specimen.as_deref().map(|text| format!("; {text}"));
        screen.say(&format!(
            "{started}  {:<9}  {:<7}  {}{}\n    {}",
            entry.outcome,
            entry.origin.name(),
            entry.what,
            specimen.unwrap_or_default(),
            entry.path.display()
        ));
    }
    for why in &catalogue.unreadable {
        screen.hint(&format!("unreadable: {why}"));
    }
    Ok(json!(catalogue))
}
