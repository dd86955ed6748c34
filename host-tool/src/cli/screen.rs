//! Output of a command. Results and progress go to standard output; with `--json` progress goes to standard error. All
//! text passes [`visible`] here, whatever its source.

use std::io::{self, BufRead, Write};

use client::visible;
use lab::operations::failure::{DONE, Failure};
use lab::trials::progress::Live;
use serde_json::Value;

/// Source of a person's typed lines.
pub type Keyboard = Box<dyn BufRead + Send>;

pub(crate) struct Screen<'a> {
    pub(crate) out: &'a mut dyn Write,
    pub(crate) err: &'a mut dyn Write,
    pub(crate) json: bool,
    /// Whether standard error is a terminal, so that a progress bar may be drawn.
    pub(crate) terminal: bool,
    /// Whether the keyboard is that of a terminal, which can deliver single keys.
    pub(crate) single_keys: bool,
    /// The person at the terminal; none with `--json`.
    pub(crate) keyboard: Option<Keyboard>,
    /// The first error in writing the result to standard output.
    pub(crate) failed: Option<io::Error>,
}

/// Writes a line in one piece.
fn line(out: &mut dyn Write, text: &str) -> io::Result<()> {
    out.write_all(format!("{}\n", visible::lines(text)).as_bytes())
}

impl Screen<'_> {
    fn stream(&mut self) -> &mut dyn Write {
        if self.json { self.err } else { self.out }
    }

    /// Prints a line. A failing output must not end the supervision of a machine, so the command continues and fails at
    /// its end.
    pub(crate) fn say(&mut self, text: &str) {
        let written = line(self.stream(), text);
        if !self.json {
            self.note(written);
        }
    }

    pub(crate) fn print(&mut self, text: &[u8]) {
        let written = self.out.write_all(text);
        self.note(written);
    }

    /// Keeps the first error of standard output. A closed pipe is not an error: its reader has read enough.
    fn note(&mut self, written: io::Result<()>) {
        if let Err(io) = written
            && io.kind() != io::ErrorKind::BrokenPipe
        {
            self.failed.get_or_insert(io);
        }
    }

    pub(crate) fn hint(&mut self, text: &str) {
        let _ = line(self.err, text);
    }

    /// Asks for confirmation; false if no person can answer.
    pub(crate) fn confirms(&mut self, question: &str) -> bool {
        let Some(keyboard) = &mut self.keyboard else {
            return false;
        };
        let _ = line(self.err, &format!("{question} Type yes and Enter."));
        let mut answer = String::new();
        keyboard.read_line(&mut answer).is_ok()
            && ["y", "yes"].contains(&answer.trim().to_lowercase().as_str())
    }

    pub(crate) fn live(&mut self) -> Live<'_> {
        match self.terminal {
            true => Live::new(self.err, true),
            false => Live::new(self.stream(), false),
        }
    }

    /// Prints the JSON object or the error, and returns the exit code.
    pub(crate) fn finish(&mut self, result: Result<Value, Failure>) -> u8 {
        match result {
            Ok(mut value) => {
                if self.json {
                    if let Some(object) = value.as_object_mut() {
                        object.shift_insert(0, "ok".to_owned(), Value::Bool(true));
                    }
                    let text = format!("{value:#}");
                    let written = writeln!(self.out, "{}", visible::json(&text));
                    self.note(written);
                }
                let flushed = self.out.flush();
                self.note(flushed);
                match self.failed.take() {
                    None => DONE,
                    Some(io) => {
                        let failure = Failure::output(&io);
                        self.hint(&failure.text());
                        failure.exit_code()
                    }
                }
            }
            Err(failure) => {
                if self.json {
                    let text = format!("{:#}", failure.json());
                    let _ = writeln!(self.out, "{}", visible::json(&text));
                }
                self.hint(&failure.text());
                failure.exit_code()
            }
        }
    }
}
