//! `devices`: ports, the machines at them, and every place that the user has configured.

use client::identity::IdentityRecord;
use lab::operations::failure::Failure;
use lab::operations::places::{Places, line};
use serde_json::{Value, json};

use crate::cli::configured;
use crate::cli::screen::Screen;

pub(crate) fn devices(places: &Places<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let found = places.survey(None);
    if found.is_empty() {
        screen.say("No serial ports.");
    }
    for found in &found {
        screen.say(&line(found));
    }
    let (configured, error) = configured::survey(places);
    for configured in &configured {
        screen.say(&configured.line());
    }
    if let Some(error) = error {
        screen.hint(&format!("warning: no names: {error}"));
    }
    let list: Vec<_> = found
        .iter()
        .map(|found| {
            json!({
                "address": found.candidate.address.to_string(),
                "description": found.candidate.description,
                "identity": found.answer.as_ref().ok().map(|identity| IdentityRecord::new(identity, &found.candidate.address.to_string())),
                "error": found.answer.as_ref().err().map(ToString::to_string),
            })
        })
        .collect();
    let configured: Vec<_> = configured
        .iter()
        .map(configured::Configured::json)
        .collect();
    Ok(json!({ "devices": list, "configured": configured }))
}
