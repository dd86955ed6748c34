//! The progress of a campaign that runs in a terminal, for the server's page.

use std::path::{Path, PathBuf};

use lab::campaign::catalogue::{self, Kind, Wanted};
use lab::campaign::contents::Campaign;
use lab::campaign::ledger::Standing;
use lab::campaign::order::doing;
use lab::campaign::remaining;
use lab::operations::arguments::CAMPAIGNS_FOLDER;
use serde_json::{Value, json};

/// The newest incomplete campaign.
pub(crate) fn newest() -> Option<PathBuf> {
    let wanted = Wanted {
        outcome: Some(catalogue::OPEN.to_owned()),
        ..Wanted::default()
    };
    let found = catalogue::list(&[PathBuf::from(CAMPAIGNS_FOLDER)], false, &wanted);
    let mut campaigns = found.entries.into_iter().rev();
    campaigns
        .find(|entry| entry.kind == Kind::Campaign)
        .map(|entry| entry.path)
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
        .filter(|trial| trial.standing() == Standing::Done);
    let next = state.next().map(|next| {
        format!(
            "trial {}: {} {} {}",
            next.planned.trial,
            next.planned.indentation,
            next.planned.lubrication.name(),
            doing(next.planned.purpose, next.planned.shape)
        )
    });
    let left = next
        .is_some()
        .then(|| remaining::text(remaining::remaining_s(&campaign)));
    json!({
        "name": campaign.plan.name,
        "folder": folder.display().to_string(),
        "done": done.count(),
        "trials": state.trials.len(),
        "next": next,
        "left_text": left,
    })
}
