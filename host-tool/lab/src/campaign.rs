//! Campaigns: a plan of trials that is carried out over hours or days, and can be interrupted at any instant.
//!
//! * [`plan`]: the plan, as people write it.
//! * [`form`]: the shape of the body. [`order`]: the order of the trials.
//! * [`ledger`]: the events, and the state that follows from them.
//! * [`readings`]: the readings of the caliper.
//! * [`files`], [`contents`], [`folder`]: the files, their names, reading and writing.
//! * [`manifest`]: the hash of every file. [`verify`]: everything that differs.
//! * [`prompts`]: the questions, and the possible answers.
//! * [`conduct`]: carries the trials out.
//! * [`statistics`]: mean, deviation, and a line. [`chance`]: random numbers from a seed.
//! * [`remaining`]: the remaining time.

pub mod chance;
pub mod conduct;
pub mod contents;
pub mod files;
pub mod folder;
pub mod form;
pub mod ledger;
pub mod manifest;
pub mod order;
pub mod plan;
pub mod prompts;
pub mod readings;
pub mod remaining;
pub mod statistics;
pub mod verify;

use std::io;
use std::path::{Path, PathBuf};

use client::named;
use client::wording::word;
use miette::Diagnostic;

#[derive(Debug, thiserror::Error, Diagnostic)]
#[error("{path}: {why}", path = path.display())]
#[diagnostic(code(retrograde::campaign), help("{remedy}"))]
pub struct CampaignError {
    pub path: PathBuf,
    pub why: String,
    pub remedy: String,
    /// Whether the command is wrong, and not the campaign.
    pub misuse: bool,
}

/// Remedy for a folder that cannot be written. A campaign has one folder, so the user cannot choose another.
pub fn make_room(remedy: &str) -> String {
    format!(
        "nothing that was entered before is lost: {remedy}, then `retrograde campaign run DIR` with its folder"
    )
}

/// The command that continues a campaign, ready to copy.
pub fn resumption(folder: &Path) -> String {
    format!("`retrograde campaign run {}`", word(folder))
}

impl CampaignError {
    /// Error for a damaged campaign.
    pub fn new(path: &Path, why: impl ToString, remedy: impl ToString) -> Self {
        Self {
            path: path.to_owned(),
            why: why.to_string(),
            remedy: remedy.to_string(),
            misuse: false,
        }
    }

    /// Error for a command that does not fit the campaign.
    pub fn misuse(path: &Path, why: impl ToString, remedy: impl ToString) -> Self {
        Self {
            misuse: true,
            ..Self::new(path, why, remedy)
        }
    }

    pub(crate) fn write(path: &Path, why: impl Into<io::Error>) -> Self {
        let why = why.into();
        let remedy = make_room(named::remedy(&why));
        Self::new(path, why, remedy)
    }
}
