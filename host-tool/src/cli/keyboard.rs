//! The person at the keyboard: answers, and holds and resumes a run. The process that runs it has the serial port, so
//! that no other one could.

use std::io::{self, BufRead, BufReader, IsTerminal};
use std::sync::mpsc;
use std::thread;

use crate::cli::Keyboard;
use crate::client::{Pace, Pacer};

/// What can be typed during a run.
pub(crate) const HINT: &str =
    "h and Enter holds the run, r and Enter goes on with it, Ctrl-C stops it.";

/// Standard input, if a person sits at it.
pub(crate) fn standard() -> Option<Keyboard> {
    let input = io::stdin();
    (input.is_terminal() && in_foreground(&input))
        .then(|| Box::new(BufReader::new(input)) as Keyboard)
}

/// A shell's background job that reads its terminal is suspended, and a run with it.
#[cfg(unix)]
fn in_foreground(input: &io::Stdin) -> bool {
    rustix::termios::tcgetpgrp(input).is_ok_and(|group| group == rustix::process::getpgrp())
}

#[cfg(not(unix))]
fn in_foreground(_: &io::Stdin) -> bool {
    true
}

/// Reads lines until the program ends; a thread of its own, for reading a terminal cannot be broken off.
pub(crate) fn pacer(keyboard: Keyboard) -> Pacer {
    let (typed, wishes) = mpsc::channel();
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
    Box::new(move || wishes.try_recv().ok())
}
