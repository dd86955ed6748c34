//! Handles Ctrl-C, SIGTERM and SIGHUP: the first is a controlled stop, the second the emergency stop.

use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, OnceLock};

use client::{Interrupt, visible};
use protocol::system::Urgent;

const STOPPING: &str = "stopping; Ctrl-C now for the emergency stop";

/// Number of interrupts. Global, because a process has one handler.
static PRESSED: OnceLock<Arc<AtomicU8>> = OnceLock::new();

/// Installs the handler on the first call. Returns the interrupt that reports the stop to send.
pub fn install() -> Interrupt {
    let pressed = PRESSED
        .get_or_init(|| {
            let pressed = Arc::new(AtomicU8::new(0));
            let count = Arc::clone(&pressed);
            // Ignore failures: without a handler Ctrl-C ends the process, and the device stops by its link time-out.
            let _ = ctrlc::set_handler(move || {
                // Atomic: [`press`] may be called at the same moment, and neither count may be lost.
                let more = |before: u8| Some(before.saturating_add(1));
                let before = count.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more);
                tell(match before {
                    Ok(0) => STOPPING,
                    _ => "emergency stop",
                });
            });
            pressed
        })
        .clone();
    Arc::new(move || match pressed.load(Ordering::Relaxed) {
        0 => None,
        1 => Some(Urgent::Stop),
        _ => Some(Urgent::EStop),
    })
}

/// Requests a controlled stop, as the first Ctrl-C does. Repeating it changes nothing: a key that repeats is not an
/// emergency.
pub fn press() {
    if let Some(pressed) = PRESSED.get()
        && pressed.fetch_max(1, Ordering::Relaxed) == 0
    {
        tell(STOPPING);
    }
}

/// Prints a message, even if a progress bar occupies the line.
pub fn tell(text: &str) {
    let clear = if io::stderr().is_terminal() {
        "\r\x1b[2K"
    } else {
        ""
    };
    // Write in one piece: another thread draws the bar and would wipe an unfinished line.
    let line = format!("{clear}{}\n", visible::lines(text));
    let _ = io::stderr().write_all(line.as_bytes());
}
