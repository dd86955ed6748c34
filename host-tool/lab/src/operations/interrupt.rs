//! Handles Ctrl-C, SIGTERM and SIGHUP. Each is a controlled stop; Ctrl-C, pressed again, is the emergency stop.

use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, OnceLock};

use client::{Interrupt, visible};
use protocol::system::Urgent;

use crate::operations::output::{ERASE, Stream};

const STOPPING: &str = "stopping; Ctrl-C now for the emergency stop";

/// Number of interrupts. Global, because a process has one handler.
static PRESSED: OnceLock<Arc<AtomicU8>> = OnceLock::new();

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// Ctrl-C: a person is at the keyboard.
    Key,
    /// SIGTERM or SIGHUP. Several of them are not an emergency: closing a terminal sends SIGHUP twice, from its shell
    /// and from the system.
    End,
}

/// Installs the handler on the first call. Returns the interrupt that reports the stop to send.
pub fn install() -> Interrupt {
    let pressed = PRESSED
        .get_or_init(|| {
            let pressed = Arc::new(AtomicU8::new(0));
            let count = Arc::clone(&pressed);
            on_signals(move |signal| match signal {
                Signal::Key => escalate(&count),
                Signal::End => stop(&count),
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

/// Calls `handle` for each signal that ends this program, in a thread that may wait and allocate. A system may refuse a
/// handler; a signal then ends the process, and the device stops by its link time-out.
pub fn on_signals(handle: impl Fn(Signal) + Send + Sync + 'static) {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

    let handle = Arc::new(handle);
    let _ = follow(&[SIGINT], Signal::Key, Arc::clone(&handle));
    let _ = follow(&[SIGTERM, SIGHUP], Signal::End, handle);
}

/// Forwards each of these signals through a pipe, which counts them: two that arrive before the thread wakes up stay
/// two.
fn follow(
    numbers: &[i32],
    signal: Signal,
    handle: Arc<impl Fn(Signal) + Send + Sync + 'static>,
) -> io::Result<()> {
    use std::io::Read;

    let (mut arrived, arriving) = io::pipe()?;
    // Start the thread first: a signal registered without it would be lost.
    std::thread::Builder::new().spawn(move || {
        while arrived.read_exact(&mut [0]).is_ok() {
            handle(signal);
        }
    })?;
    for number in numbers {
        signal_hook::low_level::pipe::register(*number, arriving.try_clone()?)?;
    }
    Ok(())
}

/// Requests a controlled stop, as the first Ctrl-C does. Repeating it changes nothing: a repeating key is not an
/// emergency.
pub fn press() {
    if let Some(pressed) = PRESSED.get() {
        stop(pressed);
    }
}

fn stop(pressed: &AtomicU8) {
    if pressed.fetch_max(1, Ordering::Relaxed) == 0 {
        tell(STOPPING);
    }
}

fn escalate(pressed: &AtomicU8) {
    // Atomic, because [`press`] may be called at the same moment, and neither count may be lost.
    let more = |before: u8| Some(before.saturating_add(1));
    let before = pressed.try_update(Ordering::Relaxed, Ordering::Relaxed, more);
    tell(match before {
        Ok(0) => STOPPING,
        _ => "emergency stop",
    });
}

/// Prints a message, even if a progress bar occupies the line.
pub fn tell(text: &str) {
    let erase = if io::stderr().is_terminal() {
        ERASE
    } else {
        ""
    };
    // Write it in one piece: another thread draws the bar and would erase an unfinished line.
    let line = format!("{erase}{}\n", visible::lines(text));
    let _ = Stream::Err.write_all(line.as_bytes());
}
