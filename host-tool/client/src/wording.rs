//! Words refusals in the units that people type: mm, mm/s, s. The wire and the firmware's own texts use micrometres and
//! microseconds.

use std::path::{Path, PathBuf};

use protocol::error::{Field, Refusal};
use serde::{Serialize, Serializer};
use serde_json::Value;

use crate::decimal;

/// Name of a state or an outcome, as in files and HTTP; empty for a value with parts.
pub fn name(of: &impl Serialize) -> String {
    match serde_json::to_value(of) {
        Ok(Value::String(name)) => name,
        _ => String::new(),
    }
}

/// Serializes a path as text. JSON is Unicode: U+FFFD replaces bytes that are not.
pub fn path<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&path.display())
}

/// Serializes paths as [`path`] does.
pub fn paths<S: Serializer>(paths: &[PathBuf], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(paths.iter().map(|path| path.display().to_string()))
}

/// A path quoted as one word of a command line.
pub fn word(path: &Path) -> String {
    let text = match path.display().to_string() {
        option if option.starts_with('-') => format!("./{option}"),
        text => text,
    };
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+,:@%=\\".contains(c);
    match !text.is_empty() && text.chars().all(is_plain) {
        true => text,
        false => format!("'{}'", text.replace('\'', "'\\''")),
    }
}

pub fn refusal(refusal: &Refusal) -> String {
    match *refusal {
        Refusal::OutOfRange {
            field,
            requested,
            min,
            max,
        } => {
            let (name, decimals, unit) = named(field);
            let write = |value| decimal::write(value, decimals);
            format!(
                "{name} is {}{unit}, allowed is {} to {}{unit}",
                write(requested),
                write(min),
                write(max)
            )
        }
        Refusal::TooFast {
            requested_us,
            min_us,
            min_accel_um_s2,
        } => {
            let (requested, min) = (decimal::write(requested_us, 6), decimal::write(min_us, 6));
            match min_accel_um_s2 {
                u64::MAX => format!(
                    "{requested} s is too short: with the delay and the dwells no acceleration within the limits is enough; at this acceleration the run takes at least {min} s"
                ),
                um_s2 => format!(
                    "{requested} s is too short: at this acceleration the run takes at least {min} s; to do it in the requested time needs at least {}",
                    accel(um_s2)
                ),
            }
        }
        Refusal::SpeedLimit {
            needed_um_s,
            max_um_s,
        } => format!(
            "needs {}, the axis allows {}: give it more time, or less speed; a higher acceleration helps only where the mean speed of a stroke is allowed",
            speed(needed_um_s),
            speed(max_um_s)
        ),
        Refusal::NotAtHome { position_um } => format!(
            "the carriage is at {} mm, a run starts at 0: move to 0 or home first",
            decimal::write_signed(position_um.into(), 3)
        ),
        _ => refusal.to_string(),
    }
}

fn speed(um_s: u64) -> String {
    format!("{} mm/s", decimal::write(um_s, 3))
}

fn accel(um_s2: u64) -> String {
    format!("{} mm/s2", decimal::write(um_s2, 3))
}

/// Name of the value, number of decimals between the wire's unit and the displayed one, and the displayed unit.
fn named(field: Field) -> (&'static str, u32, &'static str) {
    match field {
        Field::Cycles => ("the number of cycles", 0, ""),
        Field::StrokeUm => ("the stroke", 3, " mm"),
        Field::TotalUs => ("the duration", 6, " s"),
        Field::AccelUmS2 => ("the acceleration", 3, " mm/s2"),
        Field::ForwardUmS => ("the speed away from home", 3, " mm/s"),
        Field::ReturnUmS => ("the speed towards home", 3, " mm/s"),
        Field::FarDwellUs => ("the dwell at the far end", 6, " s"),
        Field::HomeDwellUs => ("the dwell at home", 6, " s"),
        Field::StartDelayUs => ("the start delay", 6, " s"),
        Field::PeriodMs => ("the telemetry interval", 0, " ms"),
        Field::PositionUm => ("the position", 3, " mm"),
        Field::SpeedUmS => ("the speed", 3, " mm/s"),
        Field::ThreadUm => ("the thread", 3, " mm"),
    }
}

/// Error of a file that cannot be parsed as JSON or TOML, without the names of Rust's types.
pub fn unreadable(error: &impl ToString) -> String {
    let mut text = error.to_string().trim_end().to_owned();
    for (jargon, words) in [
        ("expected ident", "this is not JSON"),
        ("expected u8", "expected a whole number from 0 to 255"),
        ("expected u16", "expected a whole number from 0 to 65535"),
        (
            "expected u32",
            "expected a whole number from 0 to 4294967295",
        ),
        ("expected u64", "expected a whole number of at least 0"),
        ("expected f64", "expected a number"),
    ] {
        text = text.replace(jargon, words);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_a_word_and_no_option() {
        for (path, expected) in [
            ("study", "study"),
            ("my study", "'my study'"),
            ("a'b", r"'a'\''b'"),
            ("-study", "./-study"),
            ("--my study", "'./--my study'"),
        ] {
            assert_eq!(word(Path::new(path)), expected);
        }
    }

    #[test]
    fn no_refusal_of_a_motion_speaks_micrometres() {
        let range = |field| Refusal::OutOfRange {
            field,
            requested: 130_500,
            min: 0,
            max: 130_000,
        };
        assert_eq!(
            refusal(&range(Field::PositionUm)),
            "the position is 130.5 mm, allowed is 0 to 130 mm"
        );
        for text in [
            refusal(&range(Field::ForwardUmS)),
            refusal(&range(Field::StartDelayUs)),
            refusal(&Refusal::SpeedLimit {
                needed_um_s: 60_000,
                max_um_s: 49_000,
            }),
            refusal(&Refusal::TooFast {
                requested_us: 1,
                min_us: 2,
                min_accel_um_s2: 3,
            }),
            refusal(&Refusal::TooFast {
                requested_us: 1,
                min_us: 2,
                min_accel_um_s2: u64::MAX,
            }),
            refusal(&Refusal::NotAtHome { position_um: -5 }),
        ] {
            assert!(!text.contains(" um") && !text.contains(" us "), "{text}");
            assert!(!text.contains("18446744073709551615"), "{text}");
        }
    }

    #[test]
    fn a_file_that_cannot_be_read_is_explained_without_rusts_words() {
        let words = unreadable(&"expected u32 at line 1 column 7\n");
        assert_eq!(
            words,
            "expected a whole number from 0 to 4294967295 at line 1 column 7"
        );
        assert_eq!(unreadable(&"expected ident"), "this is not JSON");
    }
}
