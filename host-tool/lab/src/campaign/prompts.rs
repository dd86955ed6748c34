//! The questions of a campaign and the possible answers. A trait hides who answers: a person at a terminal, or the
//! plan.

use client::decimal::DecimalError;
use client::error::ClientError;

use crate::campaign::form::Form;
use crate::campaign::ledger::Attempt;
use crate::campaign::order::Planned;
use crate::campaign::plan::{Lubrication, Millimetres, TrialPurpose};
use crate::campaign::readings::Quantity;

#[derive(Debug)]
pub enum Halt {
    Aborted,
    /// The link to a machine failed while the question waited.
    Client(ClientError),
}

#[derive(Clone, Debug, PartialEq)]
pub enum Question<'a> {
    /// The operator has to prepare something by hand.
    Prepare { todo: Vec<String> },
    Reading {
        /// D or i_n.
        quantity: Quantity,
        /// Name of the indentation, for i_n.
        indentation: Option<&'a str>,
        /// Number of the reading, from 1.
        number: u32,
        count: u32,
    },
    /// A set of readings is implausible.
    Odd { questions: &'a [String] },
    Ready {
        planned: &'a Planned,
        attempt: u32,
        checks: Vec<String>,
    },
    Displacement {
        planned: &'a Planned,
        attempt: u32,
        of: usize,
        /// The modelled value, on the virtual bench.
        model: Option<Millimetres>,
    },
}

impl Question<'_> {
    /// The question in words, line by line.
    pub fn text(&self) -> Vec<String> {
        match self {
            Self::Prepare { todo } => todo.clone(),
            Self::Reading {
                quantity,
                indentation,
                number,
                count,
            } => {
                let what = match (quantity, indentation) {
                    (Quantity::BetweenCrests, Some(name)) => {
                        format!("i at {name}, between the crests of the wave")
                    }
                    _ => "D, between the walls".to_owned(),
                };
                vec![format!("Reading {number} of {count}: {what}, mm:")]
            }
            Self::Odd { questions } => {
                let mut lines = questions.to_vec();
                lines.push("Is that so?".to_owned());
                lines
            }
            Self::Ready { checks, .. } => checks.clone(),
            Self::Displacement {
                planned,
                attempt,
                of,
                model,
            } => {
                let asked = match model {
                    None => "Displacement of the tail, mm, + headward:".to_owned(),
                    Some(model) => {
                        format!("Displacement by the model: {model} mm (not a measurement).")
                    }
                };
                vec![heading(planned, *attempt, *of), asked]
            }
        }
    }

    pub fn hint(&self) -> &'static str {
        match self {
            Self::Prepare { .. } => "Enter when it is done; q quits",
            Self::Reading { .. } => "the number and Enter; undo takes the last one back; q quits",
            Self::Odd { .. } => {
                "yes takes the readings as they are; undo takes the last one back; again, or no, measures all again; q quits"
            }
            Self::Ready { .. } => {
                "Enter begins; undo, skip [REASON], exclude REASON, note TEXT, camera FILE, clamp; q quits"
            }
            Self::Displacement { model: None, .. } => {
                "the number and Enter; undo, repeat [REASON], skip [REASON], exclude REASON, note TEXT; q quits"
            }
            Self::Displacement { model: Some(_), .. } => {
                "Enter takes it; repeat [REASON], skip [REASON], exclude REASON, note TEXT; q quits"
            }
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer {
    Enter,
    Length(Millimetres),
    Yes,
    Again,
    /// Take the last entry back.
    Undo,
    Repeat(String),
    Skip(String),
    /// Exclude the trial from the evaluation.
    Exclude(String),
    Note(String),
    Camera(String),
    /// The rollers will be clamped again.
    Clamp,
    Quit,
    /// Not understood, with the reason.
    Unclear(String),
}

pub fn parse(text: &str) -> Answer {
    // A key that a terminal does not know may arrive as a control character.
    let text = text.replace(char::is_control, " ");
    let text = text.trim();
    let (word, rest) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
    let rest = rest.trim().to_owned();
    let alone = |answer: Answer| match rest.is_empty() {
        true => answer,
        false => Answer::Unclear(format!("`{word}` takes no further words")),
    };
    let needs = |answer: fn(String) -> Answer, what: &str| match rest.is_empty() {
        true => Answer::Unclear(format!(
            "`{word}` needs {what}: `{word} {}`",
            what.to_uppercase()
        )),
        false => answer(rest.clone()),
    };
    match word.to_lowercase().as_str() {
        "" => Answer::Enter,
        "y" | "yes" => alone(Answer::Yes),
        "n" | "no" | "again" => alone(Answer::Again),
        "undo" => alone(Answer::Undo),
        "clamp" => alone(Answer::Clamp),
        "q" | "quit" => alone(Answer::Quit),
        "repeat" => Answer::Repeat(rest),
        "skip" => Answer::Skip(rest),
        "exclude" => needs(Answer::Exclude, "a reason"),
        "note" => needs(Answer::Note, "a text"),
        "camera" => needs(Answer::Camera, "a file"),
        _ => length(text),
    }
}

fn length(text: &str) -> Answer {
    let plain = match text.strip_prefix('+') {
        Some(digits) if !digits.starts_with('-') => digits,
        _ => text,
    };
    let numeric = plain.starts_with(|first: char| first.is_ascii_digit() || "-.".contains(first));
    let unit = plain.ends_with(|last: char| last.is_alphabetic());
    match plain.parse::<Millimetres>() {
        Ok(length) => Answer::Length(length),
        Err(DecimalError::Comma) => Answer::Unclear(format!(
            "{text} has a comma: write a point, for example 12.5"
        )),
        Err(_) if numeric && unit => Answer::Unclear(format!(
            "{text} has a unit: write the number of millimetres alone, for example 12.5"
        )),
        Err(error) if numeric => Answer::Unclear(format!("{text}: {error}")),
        Err(_) => Answer::Unclear(format!("`{text}` is neither a number nor a word of these")),
    }
}

/// The trial that a question is about: after a correction, displacements of several trials may be missing.
fn heading(planned: &Planned, attempt: u32, of: usize) -> String {
    format!(
        "Trial {} of {of}{}: {}, {}, {}, repeat {}.",
        planned.trial,
        match attempt {
            1 => String::new(),
            _ => format!(", attempt {attempt}"),
        },
        planned.indentation,
        planned.lubrication.name(),
        planned.shape.name(),
        planned.repeat,
    )
}

pub fn checks(
    planned: &Planned,
    attempt: u32,
    of: usize,
    camera_file: Option<&str>,
) -> Vec<String> {
    let mut lines = vec![heading(planned, attempt, of)];
    lines.push(match planned.lubrication {
        Lubrication::Dry => "  [ ] the walls are dry".to_owned(),
        Lubrication::Lubricated => "  [ ] fresh soapy water is on both walls".to_owned(),
    });
    if planned.purpose == TrialPurpose::FoldTest {
        lines.push(match planned.shape {
            Form::Unfolded => "  [ ] the capsule is connected; it will be unfolded".to_owned(),
            Form::Folded => "  [ ] the capsule is connected; it will be folded now".to_owned(),
            Form::Folding => {
                "  [ ] the capsule is connected; it will be unfolded, and fold in the run"
                    .to_owned()
            }
        });
    }
    lines.push("  [ ] the tail is at its mark, the way of the carriage is free".to_owned());
    if let Some(file) = camera_file {
        lines.push(format!("  [ ] the camera records, as {file}"));
    }
    lines
}

/// Proposed name of the camera's file.
pub fn camera_file(name: &str, trial: u32, attempt: u32) -> String {
    format!("{name}-{}", Attempt::folder(trial, attempt))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn an_answer_is_a_number_or_a_word() {
        let um = |um| Answer::Length(Millimetres::from_um(um));
        for (text, answer) in [
            ("", Answer::Enter),
            ("  ", Answer::Enter),
            ("46.5", um(46_500)),
            ("+46.5", um(46_500)),
            (" -3 ", um(-3_000)),
            ("undo", Answer::Undo),
            ("Repeat it slipped", Answer::Repeat("it slipped".to_owned())),
            ("repeat", Answer::Repeat(String::new())),
            (
                "exclude  wall torn ",
                Answer::Exclude("wall torn".to_owned()),
            ),
            ("note 21 degC", Answer::Note("21 degC".to_owned())),
            ("q", Answer::Quit),
            ("Quit", Answer::Quit),
            ("y", Answer::Yes),
            ("yes", Answer::Yes),
            ("n", Answer::Again),
            ("no", Answer::Again),
            ("again", Answer::Again),
            ("clamp", Answer::Clamp),
            ("skip", Answer::Skip(String::new())),
            ("skip no soap", Answer::Skip("no soap".to_owned())),
            ("camera IMG_1.MOV", Answer::Camera("IMG_1.MOV".to_owned())),
        ] {
            assert_eq!(parse(text), answer, "{text:?}");
        }
        for (text, says) in [
            ("46,5", "comma"),
            ("46.5 mm", "unit"),
            ("46.5mm", "unit"),
            ("4.65 cm", "unit"),
            ("46.5555", "more than 3 decimals"),
            ("--3", "-3"),
            ("+-3", "neither"),
            ("exclude", "needs a reason"),
            ("undo that", "takes no further words"),
            ("folded", "neither"),
        ] {
            let Answer::Unclear(why) = parse(text) else {
                panic!("{text:?}: {:?}", parse(text));
            };
            assert!(why.contains(says), "{text:?}: {why}");
        }
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "\\PC*") {
            let _ = parse(&text);
        }
    }
}
