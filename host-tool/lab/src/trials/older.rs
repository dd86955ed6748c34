//! Reads records of format 1, which write names as the code does: `Complete`, `EStopLoop`.

use serde_json::{Map, Value};

/// A sidecar of format 1 as one of `format`; none if it is of another format, or no sidecar.
pub(crate) fn read(text: &str, format: u32) -> Option<Value> {
    let mut value: Value = serde_json::from_str(text).ok()?;
    if value.get("format")?.as_u64()? != 1 {
        return None;
    }
    for part in ["action", "events"] {
        let part = value.get_mut(part)?;
        *part = renamed(part.take());
    }
    *value.get_mut("format")? = format.into();
    Some(value)
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
}
