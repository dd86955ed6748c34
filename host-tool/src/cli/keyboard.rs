//! The keyboard: answers questions, and holds, resumes and stops a run.

use std::io::{self, BufRead, BufReader, IsTerminal};
use std::sync::mpsc::{self, Receiver, TryRecvError};
use std::thread;
use std::time::{Duration, Instant};

use client::{Pace, Pacer};
use lab::operations::interrupt;

use crate::cli::screen::Keyboard;

/// Hint that lists the keys or words for a run.
pub(crate) fn hint(single: bool) -> &'static str {
    if single {
        "h holds the run, r and Enter resumes it, s or Ctrl-C stops it."
    } else {
        "h and Enter holds the run, r and Enter resumes it, s and Enter or Ctrl-C stops it."
    }
}

/// Standard input, if it is a terminal with this process in the foreground. If a background job read from the terminal,
/// the shell would suspend it, and the run with it.
pub(crate) fn standard() -> Option<Keyboard> {
    let input = io::stdin();
    let is_there = input.is_terminal()
        && rustix::termios::tcgetpgrp(&input)
            .is_ok_and(|group| group == rustix::process::getpgrp());
    is_there.then(|| Box::new(BufReader::new(input)) as Keyboard)
}

/// An earlier Enter after a question belongs to the previous question, or is a bounce of the key: nobody has read the
/// new question yet.
const READ_FIRST: Duration = Duration::from_millis(500);

/// Answer to an Enter that came too soon.
pub(crate) const TOO_SOON: &str = "That Enter came before this could be read. Press it again.";

pub(crate) enum TypedLine {
    Text(String),
    /// An Enter alone, before a person can have read the question.
    TooSoon,
}

pub(crate) struct Lines {
    typed: Receiver<(Instant, String)>,
    /// The lines come from a terminal, not from a file.
    by_hand: bool,
}

impl Lines {
    /// Reads until the program ends, on its own thread because a read from a terminal cannot be interrupted.
    pub(crate) fn new(keyboard: Keyboard, by_hand: bool) -> Self {
        let (typing, typed) = mpsc::channel();
        read_with(move || {
            for line in keyboard.lines().map_while(Result::ok) {
                if typing.send((Instant::now(), line)).is_err() {
                    return;
                }
            }
        });
        Self { typed, by_hand }
    }

    /// The next line, whenever it was typed.
    pub(crate) fn next(&self) -> Result<String, TryRecvError> {
        self.typed.try_recv().map(|(_, line)| line)
    }

    /// The next line, as an answer to a question asked at `asked`.
    pub(crate) fn answer(&self, asked: Instant) -> Result<TypedLine, TryRecvError> {
        let (at, line) = self.typed.try_recv()?;
        let is_soon = self.by_hand && at < asked + READ_FIRST;
        Ok(match line.trim() {
            "" if is_soon => TypedLine::TooSoon,
            _ => TypedLine::Text(line),
        })
    }
}

/// Starts a thread that reads. Without one, the input counts as ended.
fn read_with(read: impl FnOnce() + Send + 'static) {
    if let Err(why) = thread::Builder::new().spawn(read) {
        interrupt::tell(&format!(
            "the keyboard is not read: no thread could be started: {why}"
        ));
    }
}

/// The request that a word or a key makes of a run. Stops the run itself, and prints the hint for an unknown word.
pub(crate) fn pace(word: &str, hint: &str) -> Option<Pace> {
    match word {
        "h" | "H" => return Some(Pace::Hold),
        "r" | "R" => return Some(Pace::Resume),
        "s" | "S" => interrupt::press(),
        "" => {}
        _ => interrupt::tell(hint),
    }
    None
}

/// The letter of a key that was pressed alone, or held. Several characters at once are a paste, or an escape sequence
/// of the terminal.
fn lone(typed: &[u8]) -> Option<char> {
    let (first, rest) = typed.split_first()?;
    rest.iter()
        .all(|byte| byte == first)
        .then_some(char::from(*first))
}

/// Reads until the program ends, on its own thread because a read from a terminal cannot be interrupted: single keys if
/// the terminal supports them, lines otherwise.
pub(crate) fn pacer(mut keyboard: Keyboard, single: bool) -> Pacer {
    let (typed, requests) = mpsc::channel();
    let hint = hint(single);
    read_with(move || {
        // False once no run takes requests any more.
        let take = |word: &str| pace(word, hint).is_none_or(|pace| typed.send(pace).is_ok());
        if single {
            // Only Enter resumes, because it ends no escape sequence: one that arrives in pieces may leave a lone `R`.
            let mut resumes = false;
            while let Ok(typed @ [_, ..]) = keyboard.fill_buf() {
                let (count, key) = (typed.len(), lone(typed));
                keyboard.consume(count);
                let goes_on = match key {
                    Some('\n') if resumes => take("r"),
                    Some('r' | 'R') => {
                        interrupt::tell("Enter resumes the run");
                        true
                    }
                    Some(key) => take(key.to_string().trim()),
                    None => true,
                };
                resumes = matches!(key, Some('r' | 'R'));
                if !goes_on {
                    return;
                }
            }
        } else {
            for line in keyboard.lines().map_while(Result::ok) {
                if !take(line.trim()) {
                    return;
                }
            }
        }
    });
    Box::new(move || requests.try_recv().ok())
}

/// Switches standard input to single keys without echo until dropped. Ctrl-C stays a signal.
#[derive(Debug)]
pub(crate) struct SingleKeys {
    before: rustix::termios::Termios,
}

impl SingleKeys {
    /// `None` if the terminal cannot deliver single keys.
    pub(crate) fn begin() -> Option<Self> {
        use rustix::termios::{
            LocalModes, OptionalActions, SpecialCodeIndex, tcgetattr, tcsetattr,
        };
        let input = io::stdin();
        let before = tcgetattr(&input).ok()?;
        let mut keys = before.clone();
        keys.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
        // A read ends 0.1 s after the last byte: anything faster was not typed by hand, and arrives together.
        keys.special_codes[SpecialCodeIndex::VMIN] = u8::MAX;
        keys.special_codes[SpecialCodeIndex::VTIME] = 1;
        tcsetattr(&input, OptionalActions::Now, &keys).ok()?;
        Some(Self { before })
    }
}

impl Drop for SingleKeys {
    fn drop(&mut self) {
        use rustix::termios::{OptionalActions, tcsetattr};
        // A terminal that has closed needs no restoring.
        let _ = tcsetattr(io::stdin(), OptionalActions::Now, &self.before);
    }
}
