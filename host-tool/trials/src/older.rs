//! Reads records of format 1, which write names as the code does: `Complete`, `EStopLoop`.

use serde_json::{Map, Value};

use crate::trial::{FORMAT, Trial};

/// The trial of a sidecar of format 1; none if it is of another format, or damaged.
pub(crate) fn read(text: &str) -> Option<Trial> {
    let mut value: Value = serde_json::from_str(text).ok()?;
    if value.get("format")?.as_u64()? != 1 {
        return None;
    }
    for part in ["action", "events"] {
        let part = value.get_mut(part)?;
        *part = renamed(part.take());
    }
    *value.get_mut("format")? = FORMAT.into();
    serde_json::from_value(value).ok()
}

/// The same with today's names. There is no free text in it.
fn renamed(value: Value) -> Value {
    match value {
        Value::String(name) => Value::String(snake(&name)),
        Value::Array(all) => all.into_iter().map(renamed).collect(),
        Value::Object(all) => Value::Object(Map::from_iter(
            all.into_iter()
                .map(|(name, value)| (snake(&name), renamed(value))),
        )),
        other => other,
    }
}

/// `LostSteps` as `lost_steps`. A name that is in today's form stays.
fn snake(name: &str) -> String {
    let mut out = String::with_capacity(name.len() + 4);
    for c in name.replace("EStop", "Estop").chars() {
        if c.is_ascii_uppercase() && !out.is_empty() {
            out.push('_');
        }
        out.push(c.to_ascii_lowercase());
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::{Action, Moved, Recording, Screw};
    use jiff::Timestamp;
    use protocol::rig::{MoveTo, RigEvent, RigFault, RunOutcome};
    use protocol::system::{Event, What};

    #[test]
    fn a_name_of_format_1_becomes_that_of_today() {
        for (then, now) in [
            ("EStopLoop", "estop_loop"),
            ("LostSteps", "lost_steps"),
            ("home_flag", "home_flag"),
            ("6a87a5a5", "6a87a5a5"),
        ] {
            assert_eq!(snake(then), now);
        }
    }

    #[test]
    fn a_record_of_format_1_is_read_with_all_its_names() {
        let outcome = RunOutcome::Faulted(RigFault::EStopLoop);
        let action = Action::Move {
            screw: Screw {
                lead_um: 4_000,
                steps_per_rev: 1_600,
                stroke_um: 20_000,
            },
            requested: MoveTo {
                position_um: 10_000,
                speed_um_s: 5_000,
            },
            accepted: None,
            moved: Some(Moved {
                outcome,
                position_steps: 17,
            }),
        };
        let recording = Recording {
            folder: "x".into(),
            stem: "pass".to_owned(),
            now: Timestamp::UNIX_EPOCH,
            note: Some("The E-stop: EStopLoop".to_owned()),
            telemetry_ms: 10,
        };
        let mut trial = Trial::new(action, crate::trial::tests::device(), &recording);
        trial.events = vec![
            event(1, What::Acknowledged),
            event(2, What::Rig(RigEvent::Moved { position_steps: 17 })),
            event(
                3,
                What::Rig(RigEvent::Faulted(RigFault::LostSteps { residual_steps: 9 })),
            ),
        ];
        let today = serde_json::to_string(&trial).expect("text");
        let of_format_1 = [
            ("\"format\":2", "\"format\":1"),
            ("\"faulted\"", "\"Faulted\""),
            ("\"estop_loop\"", "\"EStopLoop\""),
            ("\"acknowledged\"", "\"Acknowledged\""),
            ("{\"rig\":", "{\"Rig\":"),
            ("{\"moved\":", "{\"Moved\":"),
            ("\"lost_steps\"", "\"LostSteps\""),
        ]
        .iter()
        .fold(today.clone(), |text, (now, then)| {
            assert!(text.contains(now), "{now} in {text}");
            text.replace(now, then)
        });
        assert!(serde_json::from_str::<Trial>(&of_format_1).is_err());
        assert_eq!(read(&of_format_1), Some(trial));
        assert_eq!(read(&today), None);
        assert_eq!(read(r#"{"format": 1}"#), None);
    }

    fn event(index: u32, what: What) -> Event {
        Event {
            index,
            time_us: 5,
            what,
        }
    }
}
