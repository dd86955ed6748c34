//! Ctrl-C, SIGTERM and SIGHUP: once is a controlled stop, twice the emergency stop.

use std::io::{self, IsTerminal};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, OnceLock};

use protocol::system::Urgent;

use crate::client::Interrupt;

/// Interrupts so far. A process has one handler, so it also has one count.
static PRESSED: OnceLock<Arc<AtomicU8>> = OnceLock::new();

/// Installs the handler on the first call; returns what the operator wants stopped.
pub(crate) fn install() -> Interrupt {
    let pressed = PRESSED
        .get_or_init(|| {
            let pressed = Arc::new(AtomicU8::new(0));
            let count = Arc::clone(&pressed);
            // Without a handler Ctrl-C ends the process, and the device stops by its link time-out.
            let _ = ctrlc::set_handler(move || {
                let before = count.load(Ordering::Relaxed);
                count.store(before.saturating_add(1), Ordering::Relaxed);
                // The progress bar stands in this line: away with it.
                let clear = if io::stderr().is_terminal() {
                    "\r\x1b[2K"
                } else {
                    ""
                };
                eprintln!(
                    "{clear}{}",
                    match before {
                        0 => "stopping; once more for the emergency stop",
                        _ => "emergency stop",
                    }
                );
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
