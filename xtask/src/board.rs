//! `cargo xtask board`: runs the image of the measurements on a board, and prints its values beside the expected ones.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::Duration;

use measurements::{Base, END, Expected, Measurement, parse};

use crate::images;
use crate::process::{Failure, Result, lines_of};

/// Longest time between two lines of the image, or to the first one with flashing.
const SILENCE: Duration = Duration::from_secs(60);
const REMEDY: &str = "install probe-rs 0.28 or later, connect the board by USB and close every other log and debugger \
                      of it; `probe-rs list` shows it, `cargo xtask board --dry-run` what would be measured";

/// Before the table of `--dry-run`.
const PREPARATION: &str = "\
Before: motor supply off, the driver out of its socket. Wires as in docs/build.md; a row whose wire is missing is NOT AS
EXPECTED or not measured. The flash is measured only where no settings are stored, as on a new board.
Afterwards: `cargo rig`, for the board keeps the image of the measurements.
";

/// Measures, or shows with `--dry-run` what would be measured.
///
/// # Errors
/// No `probe-rs`, no board or several, an image that does not finish, or an unexpected value.
pub(crate) fn run(options: &[String]) -> Result<()> {
    match options {
        [] => measure(),
        [flag] if flag == "--dry-run" => {
            println!("{PREPARATION}");
            for one in Measurement::ALL {
                println!("{}; wires {}", row(one, None), one.wires().text());
            }
            Ok(())
        }
        other => Err(Failure::new(
            format!("`board` does not know {}", other.join(" ")),
            "it takes `--dry-run` or nothing",
        )),
    }
}

fn measure() -> Result<()> {
    // `probe-rs` would ask which one of several, or flash the wrong board.
    let list = lines_of(Command::new("probe-rs").arg("list"), REMEDY)?;
    let is_probe = |line: &&String| line.trim().starts_with('[');
    let probes = list.iter().filter(is_probe).count();
    if probes != 1 {
        let what = format!("{probes} boards are connected, not one");
        return Err(Failure::new(what, REMEDY));
    }
    images::build()?;
    let mut child = images::log_of("board")?
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|why| Failure::new(format!("probe-rs does not start: {why}"), REMEDY))?;
    let (sender, lines) = channel();
    if let Some(output) = child.stdout.take() {
        // Ends with the child.
        thread::spawn(move || {
            let lines = BufReader::new(output).lines().map_while(|line| line.ok());
            lines.for_each(|line| drop(sender.send(line)));
        });
    }
    let values = follow(&lines);
    // `probe-rs run` continues after the last line. If it has ended already, neither call has an effect.
    let _ = child.kill();
    let _ = child.wait();
    judge(&values?)
}

/// The image's values up to its last line.
fn follow(lines: &Receiver<String>) -> Result<Vec<(Measurement, u32)>> {
    let mut values = vec![];
    loop {
        let Ok(line) = lines.recv_timeout(SILENCE) else {
            let last = values
                .last()
                .map_or("none", |(one, _): &(Measurement, _)| one.name());
            let what = format!("the image stopped before its last line; its last value: {last}");
            return Err(Failure::new(what, REMEDY));
        };
        let Some((one, value)) = parse(&line) else {
            println!("{line}");
            if line.contains(END) {
                return Ok(values);
            }
            continue;
        };
        if one == Measurement::ALL[0] && !values.is_empty() {
            return Err(Failure::new(
                "the image started again within its measurements",
                "its last words above; `cargo xtask where board` finds their places",
            ));
        }
        println!("{}", row(one, Some(value)));
        values.push((one, value));
    }
}

/// A measurement with its item, value and what is expected.
fn row(one: Measurement, value: Option<u32>) -> String {
    let unit = one.unit();
    let (base, expected) = match one.expected() {
        Expected::Any(base) => (base, "not known".to_owned()),
        Expected::Within(first, last) if first == last => {
            (Base::Decimal, format!("{first} {unit}"))
        }
        Expected::Within(first, last) => (Base::Decimal, format!("{first} to {last} {unit}")),
    };
    let value = match (value, base) {
        (None, _) => String::new(),
        (Some(value), Base::Hexadecimal) => format!("0x{value:08X}"),
        (Some(value), Base::Decimal) => format!("{value} {unit}"),
    };
    let (name, item, what) = (one.name(), one.item(), one.what());
    format!("{name:<20} {value:<18} expected {expected:<24} item {item}: {what}")
}

/// # Errors
/// Names every value that is unexpected or missing.
fn judge(values: &[(Measurement, u32)]) -> Result<()> {
    let mut named = vec![];
    for one in Measurement::ALL {
        let value = values.iter().find(|(name, _)| *name == one);
        let holds = match (value, one.expected()) {
            (Some((_, value)), expected) => expected.holds(*value),
            // A burst is only shifted if one was cut.
            (None, expected) => matches!(expected, Expected::Any(_)),
        };
        if !holds {
            let value = value.map_or("missing".to_owned(), |(_, value)| value.to_string());
            named.push(format!("{} (item {}): {value}", one.name(), one.item()));
        }
    }
    if named.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        format!(
            "these values are wrong or missing:\n       {}",
            named.join("\n       ")
        ),
        "check the wires first; docs/silicon.md says what each item means",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Lines as `probe-rs` prints them, all in the middle of what is expected.
    fn lines() -> Vec<String> {
        let line = |one: Measurement| {
            let value = match one.expected() {
                Expected::Within(first, last) => first + (last - first) / 2,
                Expected::Any(_) => 7,
            };
            format!("[INFO] measured {} {value} (firmware_board)", one.name())
        };
        Measurement::ALL.into_iter().map(line).collect()
    }

    fn followed(lines: impl IntoIterator<Item = String>) -> std::result::Result<(), String> {
        let (sender, receiver) = channel();
        lines
            .into_iter()
            .for_each(|line| sender.send(line).expect("it listens"));
        drop(sender);
        let ended = follow(&receiver).and_then(|values| judge(&values));
        ended.map_err(|failure| failure.to_string())
    }

    #[test]
    fn a_value_out_of_range_and_a_missing_one_are_named() {
        let end = || [format!("[INFO] {END}"), "never read".to_owned()];
        assert_eq!(followed(lines().into_iter().chain(end())), Ok(()));
        for (nth, one) in Measurement::ALL.into_iter().enumerate() {
            let mut bad = lines();
            bad.remove(nth);
            let Expected::Within(_, last) = one.expected() else {
                continue;
            };
            let name = format!("{} (item {})", one.name(), one.item());
            let missing = followed(bad.clone().into_iter().chain(end()));
            assert!(missing.is_err_and(|text| text.contains(&name)));
            bad.push(format!("measured {} {}", one.name(), last + 1));
            let wrong = followed(bad.into_iter().chain(end()));
            assert!(wrong.is_err_and(|text| text.contains(&name)));
        }
        let again = followed(lines().into_iter().take(3).chain(lines()));
        assert!(again.is_err_and(|text| text.contains("started again")));
        assert!(followed(lines()).is_err_and(|text| text.contains("its last line")));
    }
}
