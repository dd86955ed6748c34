//! The person at the keyboard answers questions, and holds and resumes a run: the process that runs it owns the serial
//! port, so no other process can.

use std::io::{self, BufRead, BufReader, IsTerminal};
use std::sync::mpsc;
use std::thread;

use crate::cli::Keyboard;
use crate::client::{Pace, Pacer};

/// What can be typed during a run.
pub(crate) const HINT: &str = "h and Enter holds the run, r and Enter resumes it, Ctrl-C stops it.";

/// Standard input, if it is a terminal with this process in the foreground.
pub(crate) fn standard() -> Option<Keyboard> {
    is_there().then(|| Box::new(BufReader::new(io::stdin())) as Keyboard)
}

/// Whether a person can type here.
pub(crate) fn is_there() -> bool {
    let input = io::stdin();
    input.is_terminal() && in_foreground(&input)
}

/// The shell suspends a background job that reads from the terminal, which would suspend the run, too.
#[cfg(unix)]
fn in_foreground(input: &io::Stdin) -> bool {
    rustix::termios::tcgetpgrp(input).is_ok_and(|group| group == rustix::process::getpgrp())
}

#[cfg(not(unix))]
fn in_foreground(_: &io::Stdin) -> bool {
    true
}

/// Reads lines until the program ends, on a thread of its own because a read from a terminal cannot be interrupted.
pub(crate) fn pacer(keyboard: Keyboard) -> Pacer {
    let (typed, requests) = mpsc::channel();
    thread::spawn(move || {
        for line in keyboard.lines().map_while(Result::ok) {
            let pace = match line.trim() {
                "h" => Pace::Hold,
                "r" => Pace::Resume,
                "" => continue,
                _ => {
                    eprintln!("{HINT}");
                    continue;
                }
            };
            if typed.send(pace).is_err() {
                return;
            }
        }
    });
    Box::new(move || requests.try_recv().ok())
}
