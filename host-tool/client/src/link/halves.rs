//! The two directions of a line, for two threads.

use std::io::{Read, Write};
use std::time::Duration;

/// Longest wait of a read. A reader notices the end of the link only after it. Shorter on Windows, where a write to a
/// serial port waits for a read.
pub const READ: Duration = Duration::from_millis(if cfg!(windows) { 2 } else { 10 });

/// Both directions of a line, each usable by a thread of its own. A read returns within [`READ`], with or without
/// bytes.
pub struct Halves {
    /// Reads from the line.
    pub reader: Box<dyn Read + Send>,
    /// Writes to the line.
    pub writer: Box<dyn Write + Send>,
    /// The reason why no more bytes come, when a read returns none.
    pub end: &'static str,
}
