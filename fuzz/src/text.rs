//! Changes of files, for the targets that read them. A position is in thousandths of the file.

use serde::{Deserialize, Serialize};

/// A change of one file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Change {
    /// Replaces this many bytes by others.
    Replace(u16, u8, Vec<u8>),
    /// Replaces the next number by one of [`NUMBERS`].
    Number(u16, u8),
    /// Cuts the file off.
    Cut(u16),
    /// Repeats all rows from there on.
    Twice(u16),
    /// Puts one of `WORDS` into the next text in quotes, or there if none follows.
    Word(u16, u8),
}

/// Numbers that are hard on whoever reads them, most of them limits of integers.
pub const NUMBERS: [&str; 10] = [
    "0",
    "-1",
    "65535",
    "2147483647",
    "-2147483648",
    "4294967295",
    "9223372036854775807",
    "18446744073709551615",
    "1e308",
    "0.1",
];

/// Characters that a terminal obeys, as themselves and as JSON and TOML escape them, and ways out of a folder.
const WORDS: [&str; 12] = [
    "\u{1b}]0;mine\u{7}",
    "\u{9b}2J",
    "\u{202e}gpj",
    "\u{2066}",
    "\r",
    "\\u001b[2J",
    "\\u009b31m",
    "\\u202e",
    "\\n\\u0000",
    "../../outside/secret.json",
    "/dev/zero",
    "",
];

fn place(bytes: &[u8], thousandths: u16) -> usize {
    bytes.len() * usize::from(thousandths.min(1_000)) / 1_000
}

/// Replaces `count` bytes.
pub fn replace(bytes: &mut Vec<u8>, at: u16, count: u8, by: &[u8]) {
    let at = place(bytes, at);
    let end = (at + usize::from(count)).min(bytes.len());
    bytes.splice(at..end, by.iter().copied());
}

/// Replaces the next number, if there is one.
pub fn number(bytes: &mut Vec<u8>, at: u16, number: u8) {
    let at = place(bytes, at);
    let of_number = |byte: &u8| byte.is_ascii_digit() || *byte == b'-';
    let Some(from) = bytes[at..].iter().position(of_number).map(|skip| at + skip) else {
        return;
    };
    let count = bytes[from..]
        .iter()
        .take_while(|byte| of_number(byte))
        .count();
    let number = NUMBERS[usize::from(number) % NUMBERS.len()];
    bytes.splice(from..from + count, number.bytes());
}

/// Cuts a file off.
pub fn cut(bytes: &mut Vec<u8>, at: u16) {
    bytes.truncate(place(bytes, at));
}

/// Repeats the rows behind the next line break.
pub fn twice(bytes: &mut Vec<u8>, at: u16) {
    let at = place(bytes, at);
    let line = bytes[at..].iter().position(|byte| *byte == b'\n');
    let rows = line.map_or(vec![], |line| bytes[at + line + 1..].to_vec());
    bytes.extend(rows);
}

fn word(bytes: &mut Vec<u8>, at: u16, word: u8) {
    let at = place(bytes, at);
    let quote = bytes[at..].iter().position(|byte| *byte == b'"');
    let at = quote.map_or(at, |quote| at + quote + 1);
    let word = WORDS[usize::from(word) % WORDS.len()];
    bytes.splice(at..at, word.bytes());
}

impl Change {
    /// Makes the change.
    pub fn make(&self, bytes: &mut Vec<u8>) {
        match self {
            Self::Replace(at, count, by) => replace(bytes, *at, *count, by),
            Self::Number(at, index) => number(bytes, *at, *index),
            Self::Cut(at) => cut(bytes, *at),
            Self::Twice(at) => twice(bytes, *at),
            Self::Word(at, index) => word(bytes, *at, *index),
        }
    }
}
