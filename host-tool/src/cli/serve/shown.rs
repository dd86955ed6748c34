//! The progress of a campaign that runs in a terminal, for the server's page.

use std::path::{Path, PathBuf};

use lab::campaign::contents::Campaign;
use lab::campaign::ledger::TrialStatus;
use lab::campaign::remaining;
use lab::operations::arguments::CAMPAIGNS_FOLDER;
use lab::trials::listing::Listing;
use serde_json::{Value, json};

/// The incomplete campaign with the newest row.
pub(crate) fn newest() -> Option<PathBuf> {
    let folders = Listing::read(Path::new(CAMPAIGNS_FOLDER)).folders;
    let campaigns = folders.iter().filter_map(|path| Campaign::read(path).ok());
    let open = campaigns.filter(|campaign| campaign.state.next().is_some());
    let last = open.max_by_key(|campaign| {
        let rows = campaign.rows.iter().map(|row| row.time_utc);
        rows.chain(campaign.reading_rows.iter().map(|row| row.time_utc))
            .max()
    });
    Some(last?.folder)
}

/// The campaign's name, progress and next step, or the reason why it cannot be read.
pub(crate) fn json(folder: &Path) -> Value {
    let campaign = match Campaign::read(folder) {
        Ok(campaign) => campaign,
        Err(error) => {
            return json!({ "folder": folder.display().to_string(), "error": error.to_string() });
        }
    };
    let state = &campaign.state;
    let done = state
        .trials
        .iter()
        .filter(|trial| trial.status() == TrialStatus::Done);
    let next = state.next().map(|next| {
        format!(
            "trial {}: {} {} {}",
            next.planned.trial,
            next.planned.indentation,
            next.planned.lubrication.name(),
            next.planned.shape.name()
        )
    });
    let remaining = next
        .is_some()
        .then(|| remaining::text(remaining::remaining_s(&campaign)));
    json!({
        "name": campaign.plan.name,
        "folder": folder.display().to_string(),
        "done": done.count(),
        "trials": state.trials.len(),
        "next": next,
        "remaining_text": remaining,
    })
}
