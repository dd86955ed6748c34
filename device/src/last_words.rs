//! The text that a panic or a processor fault keeps for the next start.

use core::fmt::{self, Display, Write};
use heapless::String;

/// Longest text, bytes; as in [`protocol::system::LastWords`].
pub const LONGEST: usize = 120;
/// Longest part of a file's path in the text of a panic, bytes: its end.
const LONGEST_FILE: usize = 40;
/// Room for an address and the space before it.
const ADDRESS: usize = " 0x01234567".len();

/// Text of the last panic or processor fault.
pub type LastWords = String<LONGEST>;

/// Collects the last words. Text that does not fit is cut off.
#[derive(Debug, Default)]
pub struct Draft(pub LastWords);

impl Write for Draft {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let mut letters = text.chars();
        letters
            .try_for_each(|letter| self.0.push(letter))
            .map_err(|_| fmt::Error)
    }
}

/// The last words of a panic: file and line, message, and as many return addresses as fit, innermost first.
pub fn of_a_panic(
    file: &str,
    line: u32,
    message: impl Display,
    callers: impl Iterator<Item = u32>,
) -> Draft {
    let file = file.get(file.len().saturating_sub(LONGEST_FILE)..);
    let mut words = Draft::default();
    let _ = write!(words, "panic at {}:{line}: {message}", file.unwrap_or("?"));
    add_callers(&mut words, ", called from", callers);
    words
}

/// Appends return addresses, as many as fit whole.
pub fn add_callers(words: &mut Draft, what: &str, callers: impl Iterator<Item = u32>) {
    let room = |words: &Draft| LONGEST - words.0.len();
    if room(words) >= what.len() + ADDRESS {
        let _ = words.write_str(what);
        for caller in callers {
            if room(words) < ADDRESS {
                return;
            }
            let _ = write!(words, " {caller:#x}");
        }
    }
}
