//! `cargo xtask board`: runs the image of the measurements on a board, and prints the table for docs/first-board.md.

use std::fmt::Write as _;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use measurements::{Base, END, Expected, Measurement, Place, Verdict, parse};

use crate::images;
use crate::process::{Failure, Result, first_line, lines_of, root};

/// Longest time between two lines of the image, or to the first one with flashing.
const SILENCE: Duration = Duration::from_secs(60);
const REMEDY: &str = "connect the board by USB and close every other log and debugger of it; \
                      `probe-rs list` shows it, `cargo xtask board --dry-run` what would be measured";

/// A measurement with its value, if there is one.
type Row = (Measurement, Option<u32>);

/// Reads the command's options.
///
/// # Errors
/// No `probe-rs`, no board, an image that does not come to its end, or a value that is not as expected.
pub(crate) fn run(options: &[String]) -> Result<()> {
    match options {
        [] => measure(),
        [flag] if flag == "--dry-run" => {
            print!("{}{PREPARATION}", plan());
            Ok(())
        }
        other => Err(Failure::new(
            format!("`board` does not know {}", other.join(" ")),
            "it takes `--dry-run` or nothing",
        )),
    }
}

/// Steps before and after, and where the rest is measured.
const PREPARATION: &str = "
Before: motor supply off, the driver out of its socket. Wires as in docs/rig.md; a row whose wire is missing is NOT AS
EXPECTED or not measured. The flash is measured only where no settings are stored, as on a new board.
Afterwards: `cargo rig`, for the board keeps the image of the measurements.
Not here, because it takes a hand, a meter or an oscilloscope: docs/first-board.md, \"The first hour with a board\".
";

fn measure() -> Result<()> {
    let version = first_line(Command::new("probe-rs").arg("--version"));
    if version.is_none() {
        return Err(Failure::new(
            "there is no `probe-rs`, which flashes the board and reads its log",
            "`cargo install probe-rs-tools --locked` (0.28 or later); \
             `cargo xtask board --dry-run` shows what would be measured",
        ));
    }
    one_probe(&lines_of(Command::new("probe-rs").arg("list"), REMEDY)?)?;
    images::build()?;
    let mut child = images::log_of("board")?
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|why| Failure::new(format!("probe-rs does not start: {why}"), REMEDY))?;
    let lines = follow(&mut child);
    // The child has done its work, or hangs. If it has ended by itself, neither call has an effect.
    let _ = child.kill();
    let _ = child.wait();
    let lines = lines?;
    let rows = rows(lines.iter().map(String::as_str));
    println!("{}", table(&rows, Place::Board));
    let path = PathBuf::from(file_name(&rows));
    std::fs::write(&path, file(&rows)).map_err(|why| {
        let what = format!("{} cannot be written: {why}", path.display());
        Failure::new(what, "call it from a folder that you can write to")
    })?;
    println!(
        "{} has the same: please send it to us, with a photograph of the board's sticker.",
        path.display()
    );
    outcome(&rows, Place::Board)
}

/// Reads the output of `probe-rs list`: a line for each probe begins with its number in brackets.
///
/// # Errors
/// No probe, or several: `probe-rs` would ask which one, or flash the wrong board.
fn one_probe(list: &[String]) -> Result<()> {
    let found = list.iter().filter(|line| line.trim().starts_with('['));
    match found.count() {
        0 => Err(Failure::new(
            "there is no board: `probe-rs list` shows no probe",
            REMEDY,
        )),
        1 => Ok(()),
        more => Err(Failure::new(
            format!("{more} probes are connected"),
            "unplug all but the board that is to be measured",
        )),
    }
}

/// Shows and returns the image's lines up to its last one.
fn follow(child: &mut Child) -> Result<Vec<String>> {
    let (sender, receiver) = channel();
    if let Some(output) = child.stdout.take() {
        // Ends with the child.
        thread::spawn(move || {
            let lines = BufReader::new(output).lines().map_while(|line| line.ok());
            for line in lines {
                if sender.send(line).is_err() {
                    break;
                }
            }
        });
    }
    up_to_the_end(&receiver)
}

fn up_to_the_end(lines: &Receiver<String>) -> Result<Vec<String>> {
    let mut seen: Vec<String> = vec![];
    loop {
        let Ok(line) = lines.recv_timeout(SILENCE) else {
            let after = seen.last().map_or("nothing", String::as_str);
            let what = format!("the image did not come to its end; its last line: {after}");
            return Err(Failure::new(what, REMEDY));
        };
        println!("{line}");
        let is_first_again = parse(&line).is_some_and(|(name, _)| {
            name == Measurement::ALL[0] && seen.iter().any(|line| parse(line).is_some())
        });
        if is_first_again {
            return Err(Failure::new(
                "the image started again within its measurements",
                "its last words above; `cargo xtask where board` finds their places",
            ));
        }
        if line.contains(END) {
            return Ok(seen);
        }
        seen.push(line);
    }
}

/// Every measurement with the value from these lines.
fn rows<'a>(lines: impl Iterator<Item = &'a str>) -> Vec<Row> {
    let values: Vec<_> = lines.filter_map(parse).collect();
    let value = |one| values.iter().find(|(name, _)| *name == one);
    let row = |one| (one, value(one).map(|(_, value)| *value));
    Measurement::ALL.into_iter().map(row).collect()
}

/// The table without values.
fn plan() -> String {
    let mut text =
        String::from("| item | name | measured | expected | wires |\n|---|---|---|---|---|\n");
    for one in Measurement::ALL {
        let (item, name, what) = (one.item(), one.name(), one.what());
        let (expected, wires) = (expected(one), one.wires().text());
        let _ = writeln!(text, "| {item} | {name} | {what} | {expected} | {wires} |");
    }
    text
}

/// The table that docs/first-board.md takes.
fn table(rows: &[Row], place: Place) -> String {
    let mut text = String::from(
        "| item | name | measured | expected | value | verdict |\n|---|---|---|---|---|---|\n",
    );
    for (one, value) in rows {
        let verdict = one.judge(*value, place);
        let value = value.map_or("-".to_owned(), |value| written(*one, value));
        let (item, name, what) = (one.item(), one.name(), one.what());
        let expected = expected(*one);
        let _ = writeln!(
            text,
            "| {item} | {name} | {what} | {expected} | {value} | {verdict} |"
        );
    }
    text
}

fn expected(one: Measurement) -> String {
    let (unit, range) = (one.unit(), one.expected());
    let text = match range {
        Expected::Any(_) => return "not known".to_owned(),
        Expected::Within(first, last) if first == last => format!("{first} {unit}"),
        Expected::Within(first, last) => format!("{first} to {last} {unit}"),
    };
    text.trim_end().to_owned()
}

fn written(one: Measurement, value: u32) -> String {
    match one.expected() {
        Expected::Any(Base::Hexadecimal) => format!("0x{value:08X}"),
        _ => format!("{value} {}", one.unit()).trim_end().to_owned(),
    }
}

/// Name of a file, with the chip's number, so that two boards' files stay apart.
fn file_name(rows: &[Row]) -> String {
    let words: Vec<_> = rows
        .iter()
        .take(3)
        .map(|(_, value)| format!("{:08x}", value.unwrap_or(0)))
        .collect();
    format!("board-{}.toml", words.join("-"))
}

/// All rows in TOML.
fn file(rows: &[Row]) -> String {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let mut git = Command::new("git");
    git.args(["describe", "--always", "--dirty"]);
    let commit = first_line(git.current_dir(root()));
    let mut text = format!(
        "unix_s = {}\ncommit = \"{}\"\n",
        now.map_or(0, |now| now.as_secs()),
        commit.unwrap_or_default()
    );
    for (one, value) in rows {
        let verdict = one.judge(*value, Place::Board);
        let _ = writeln!(text, "\n[{}]", one.name());
        if let Some(value) = value {
            let _ = writeln!(text, "value = {value}");
        }
        let _ = writeln!(text, "unit = \"{}\"", one.unit());
        let _ = writeln!(text, "expected = \"{}\"", expected(*one));
        let _ = writeln!(text, "verdict = \"{verdict}\"");
    }
    text
}

/// # Errors
/// Names every value that is not as expected, or is missing.
fn outcome(rows: &[Row], place: Place) -> Result<()> {
    let bad = |verdict| matches!(verdict, Verdict::Unexpected | Verdict::NotMeasured);
    let named: Vec<_> = rows
        .iter()
        .filter(|(one, value)| bad(one.judge(*value, place)))
        .map(|(one, value)| {
            let value = value.map_or("not measured".to_owned(), |value| written(*one, value));
            let (name, item, wires) = (one.name(), one.item(), one.wires().text());
            format!("{name} (item {item}): {value}; wires {wires}")
        })
        .collect();
    if named.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        format!("not as expected:\n       {}", named.join("\n       ")),
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

    fn judged(lines: &[String]) -> String {
        let rows = rows(lines.iter().map(String::as_str));
        match outcome(&rows, Place::Board) {
            Ok(()) => String::new(),
            Err(failure) => failure.to_string(),
        }
    }

    #[test]
    fn a_board_as_expected_passes() {
        assert_eq!(judged(&lines()), "");
    }

    /// Each value just outside of its range, and each missing line, gives a verdict that names the item.
    #[test]
    fn a_value_out_of_range_is_named_with_its_item() {
        for (nth, one) in Measurement::ALL.into_iter().enumerate() {
            let Expected::Within(first, last) = one.expected() else {
                continue;
            };
            let named = format!("{} (item {})", one.name(), one.item());
            for value in [first.checked_sub(1), last.checked_add(1)] {
                let Some(value) = value else { continue };
                let mut lines = lines();
                lines[nth] = format!("measured {} {value}", one.name());
                let text = judged(&lines);
                assert!(text.contains(&named), "{value}: {text}");
            }
            let mut lines = lines();
            lines.remove(nth);
            let text = judged(&lines);
            let missing = format!("{named}: not measured");
            assert!(text.contains(&missing), "{text}");
        }
    }

    #[test]
    fn the_plan_has_every_measurement_and_the_file_every_value() {
        let lines = lines();
        let rows = rows(lines.iter().map(String::as_str));
        let (plan, file) = (plan(), file(&rows));
        let file: Vec<_> = file.lines().collect();
        for one in Measurement::ALL {
            assert!(plan.contains(one.what()) && plan.contains(one.wires().text()));
            let title = format!("[{}]", one.name());
            let at = file.iter().position(|line| *line == title);
            assert!(file[at.expect("its table") + 1].starts_with("value = "));
        }
        assert_eq!(file_name(&rows), "board-00000007-00000007-00000007.toml");
    }

    /// The manual's table of items has a line for each that is measured.
    #[test]
    fn the_items_are_those_of_the_manual() {
        let path = root().join("docs/silicon.md");
        let manual = std::fs::read_to_string(path).expect("the manual");
        for one in Measurement::ALL {
            for item in one.item().split(", ").filter(|item| *item != "-") {
                let title = format!("### {item}. ");
                let known = manual.contains(&title)
                    || manual.contains(&format!("## {item}"))
                    || manual.contains(&format!("| {item} |"));
                assert!(known, "{}: no item {item}", one.name());
            }
        }
    }

    #[test]
    fn one_probe_is_needed() {
        let list = |text: &str| one_probe(&text.lines().map(str::to_owned).collect::<Vec<_>>());
        let found = "The following debug probes were found:\n";
        let probe = "[0]: STLink V2-1 -- 0483:374b:0671FF (ST-LINK)\n";
        assert!(list("No debug probes were found.\n").is_err());
        assert!(list(&format!("{found}{probe}")).is_ok());
        assert!(list(&format!("{found}{probe}{probe}")).is_err());
    }

    /// `probe-rs run` goes on after the last line, until it is ended.
    #[cfg(unix)]
    #[test]
    fn the_log_is_followed_to_the_images_last_line() {
        let text = format!("{}\n[INFO] {END}\nnever read", lines().join("\n"));
        let mut child = Command::new("sh")
            .args(["-c", "printf '%s\n' \"$1\"; exec sleep 60", "sh", &text])
            .stdout(Stdio::piped())
            .spawn()
            .expect("a shell");
        let seen = follow(&mut child).expect("it came to its end");
        child.kill().expect("it still runs");
        let _ = child.wait();
        assert_eq!(seen, lines());
    }

    #[test]
    fn an_image_that_starts_again_is_no_result() {
        let (sender, receiver) = channel();
        for line in lines().iter().take(3).chain(&lines()) {
            sender.send(line.clone()).expect("it listens");
        }
        drop(sender);
        let failure = up_to_the_end(&receiver).expect_err("it started again");
        assert!(failure.to_string().contains("started again"), "{failure}");
    }
}
