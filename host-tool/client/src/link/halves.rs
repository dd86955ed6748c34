//! A line as two threads use it.

use std::io::{Read, Write};
use std::time::Duration;

/// How long a read of the line waits: it ends so much later than the link. On Windows a write to a serial port waits for
/// a read.
pub const READ: Duration = Duration::from_millis(if cfg!(windows) { 2 } else { 10 });

/// Both directions of a line, each usable by a thread of its own. A read ends after ten milliseconds or less, with or without a byte.
pub struct Halves {
    /// Reads from the line.
    pub reader: Box<dyn Read + Send>,
    /// Writes to the line.
    pub writer: Box<dyn Write + Send>,
    /// Why no bytes will come any more when a read returns none.
    pub end: &'static str,
}
