//! The JSON file of a record: its heading in a list, and the kinds of other JSON files.

use std::path::Path;

use client::decimal;
use client::limited;
use client::plain;
use protocol::capsule::ActuationKind;
use serde_json::Value;

use crate::trials::trial::{Action, RecordError, TrialRecord};

/// The action in a few words.
#[must_use]
pub fn heading(trial: &TrialRecord) -> String {
    match &trial.action {
        Action::Run { requested, .. } => format!(
            "Run, {} cycles of {} mm",
            requested.cycles,
            decimal::write(requested.stroke_um.into(), 3)
        ),
        Action::Actuation { actuation, .. } => match actuation {
            ActuationKind::Reference => "Reference of the thread".to_owned(),
            ActuationKind::Calibrate => "Calibration of the thread".to_owned(),
            ActuationKind::CheckFolded => "Check that it is folded".to_owned(),
            ActuationKind::Fold => "Fold".to_owned(),
            ActuationKind::Unfold => "Unfold".to_owned(),
            ActuationKind::FoldTo => "Partial fold".to_owned(),
        },
    }
}

/// Description of a JSON file of this program that is not a trial; none for foreign files.
pub fn other(file: &Path) -> Option<String> {
    let text = plain::read_text(file, limited::RECORD).ok()?;
    let value: Value = serde_json::from_str(&text).ok()?;
    let what = if value.get("board_uid").is_some() && value.get("steps").is_some() {
        "a commissioning"
    } else if value.get("kind").is_some_and(|kind| kind == "fetched") {
        "an action that was fetched from its machine"
    } else {
        return None;
    };
    Some(format!("the record of {what}, which is not a trial"))
}

/// Error of a JSON file that cannot be read as a trial; none for records of other kinds and for files without telemetry
/// beside them.
#[must_use]
pub fn unreadable(file: &Path, error: RecordError) -> Option<String> {
    let is_record = plain::is_file(&file.with_extension("csv")) && other(file).is_none();
    is_record.then(|| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn only_a_trial_beside_its_telemetry_is_told_as_unreadable() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("one.json");
        let unreadable = || unreadable(&file, RecordError::read(&file, "no trial"));
        fs::write(&file, "{}").expect("written");
        assert_eq!(unreadable(), None, "without telemetry");
        fs::write(file.with_extension("csv"), "").expect("written");
        assert!(unreadable().is_some_and(|why| why.contains("no trial")));
        for (text, kind) in [
            (r#"{"board_uid": "", "steps": []}"#, "commissioning"),
            (r#"{"kind": "fetched"}"#, "fetched"),
        ] {
            fs::write(&file, text).expect("written");
            assert_eq!(unreadable(), None, "{text}");
            assert!(
                other(&file).is_some_and(|what| what.contains(kind)),
                "{text}"
            );
        }
        for text in [r#"{"board_uid": ""}"#, r#"{"steps": []}"#, "x"] {
            fs::write(&file, text).expect("written");
            assert_eq!(other(&file), None, "{text}");
        }
    }

    #[test]
    fn a_heading_says_which_motion_it_was() {
        let recording = crate::trials::trial::Recording {
            folder: "x".into(),
            stem: "fold".to_owned(),
            now: jiff::Timestamp::UNIX_EPOCH,
            note: None,
            telemetry_ms: 20,
        };
        let device = crate::trials::trial::tests::device();
        let action = Action::Actuation {
            actuation: ActuationKind::FoldTo,
            accepted: None,
            record: None,
        };
        let trial = TrialRecord::new(action, device, Default::default(), &recording);
        assert_eq!(heading(&trial), "Partial fold");
    }
}
