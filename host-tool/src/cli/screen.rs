//! Where text goes: results to standard output, what goes on to standard error if the output is JSON.

use std::io::Write;

use serde_json::Value;

use crate::cli::Keyboard;
use crate::cli::failure::{DONE, Failure};
use crate::progress::Live;

/// The two streams of a command.
pub(crate) struct Screen<'a> {
    pub(crate) out: &'a mut dyn Write,
    pub(crate) err: &'a mut dyn Write,
    pub(crate) json: bool,
    /// Standard error is a terminal, so that a bar may be drawn.
    pub(crate) terminal: bool,
    /// There is a person at it, who wants no JSON.
    pub(crate) keyboard: Option<Keyboard>,
}

impl Screen<'_> {
    fn stream(&mut self) -> &mut dyn Write {
        if self.json { self.err } else { self.out }
    }

    /// Says what goes on. A closed pipe must not stop the supervision of a machine.
    pub(crate) fn say(&mut self, text: &str) {
        let _ = writeln!(self.stream(), "{text}");
    }

    /// Says something to the person that is no result.
    pub(crate) fn hint(&mut self, text: &str) {
        let _ = writeln!(self.err, "{text}");
    }

    /// Whether the person answers with yes; without a person it is no.
    pub(crate) fn confirms(&mut self, question: &str) -> bool {
        let Some(keyboard) = &mut self.keyboard else {
            return false;
        };
        let _ = writeln!(self.err, "{question} Type yes and Enter.");
        let mut answer = String::new();
        keyboard.read_line(&mut answer).is_ok()
            && ["y", "yes"].contains(&answer.trim().to_lowercase().as_str())
    }

    /// Shows an action that goes on.
    pub(crate) fn live(&mut self) -> Live<'_> {
        let terminal = self.terminal;
        Live::new(self.stream(), terminal)
    }

    /// Ends a command: the JSON object, or the error.
    pub(crate) fn finish(&mut self, result: Result<Value, Failure>) -> u8 {
        match result {
            Ok(mut value) => {
                if self.json {
                    if let Some(object) = value.as_object_mut() {
                        object.shift_insert(0, "ok".to_owned(), Value::Bool(true));
                    }
                    let _ = writeln!(self.out, "{value:#}");
                }
                DONE
            }
            Err(failure) => {
                if self.json {
                    let _ = writeln!(self.out, "{:#}", failure.json());
                }
                let _ = writeln!(self.err, "{}", failure.text());
                failure.exit_code()
            }
        }
    }
}
