//! Ctrl-C, SIGTERM and SIGHUP: once is a controlled stop, twice the emergency stop.

use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, OnceLock};

use client::Interrupt;
use protocol::system::Urgent;

const STOPPING: &str = "stopping; Ctrl-C now for the emergency stop";

/// Interrupts so far. A process has one handler, so it also has one count.
static PRESSED: OnceLock<Arc<AtomicU8>> = OnceLock::new();

/// Installs the handler on the first call; returns what the operator wants stopped.
pub fn install() -> Interrupt {
    let pressed = PRESSED
        .get_or_init(|| {
            let pressed = Arc::new(AtomicU8::new(0));
            let count = Arc::clone(&pressed);
            // Without a handler Ctrl-C ends the process, and the device stops by its link time-out.
            let _ = ctrlc::set_handler(move || {
                // In one step: the key of `press` may come at the same moment, and neither may be lost.
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

/// Stops in a controlled way, as the first Ctrl-C does. Once more it changes nothing: a key that repeats is no emergency.
pub fn press() {
    if let Some(pressed) = PRESSED.get()
        && pressed.fetch_max(1, Ordering::Relaxed) == 0
    {
        tell(STOPPING);
    }
}

/// Tells a person something while a progress bar may stand in the line.
pub fn tell(text: &str) {
    let clear = if io::stderr().is_terminal() {
        "\r\x1b[2K"
    } else {
        ""
    };
    // In one piece: the bar is drawn by another thread, and would wipe what stands in the line without its end.
    let line = format!("{clear}{text}\n");
    let _ = io::stderr().write_all(line.as_bytes());
}
