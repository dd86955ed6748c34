//! Standard output and standard error, written by one thread, so that a paused terminal or a slow reader delays no
//! machine.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::sync::{Condvar, LazyLock, Mutex, MutexGuard, PoisonError};
use std::thread;

use rustix::stdio::stderr;
use rustix::termios::tcgetwinsize;

/// Maximum text that waits to be written, bytes. Beyond it the oldest lines are dropped.
const WAITING: usize = 16 << 20;

/// Goes back to the beginning of the line and erases it.
pub const ERASE: &str = "\r\x1b[2K";

/// A standard stream. A write never waits. A flush waits until all is written, and returns the first error of standard
/// output so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stream {
    Out,
    Err,
}

impl Stream {
    fn write_now(self, text: &[u8]) -> io::Result<()> {
        match self {
            Self::Out => {
                let mut out = io::stdout().lock();
                out.write_all(text).and_then(|()| out.flush())
            }
            Self::Err => io::stderr().write_all(text),
        }
    }
}

impl Write for Stream {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        match QUEUE.has_thread {
            true => QUEUE.put(*self, text),
            false => self.write_now(text)?,
        }
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        QUEUE.wait()
    }
}

/// Width of the terminal at standard error.
pub fn columns() -> usize {
    let columns = tcgetwinsize(stderr()).map_or(0, |size| size.ws_col);
    if columns == 0 { 80 } else { columns.into() }
}

static QUEUE: LazyLock<Queue> = LazyLock::new(|| {
    let thread = thread::Builder::new().spawn(|| QUEUE.work(Stream::write_now));
    Queue {
        has_thread: thread.is_ok(),
        ..Queue::default()
    }
});

#[derive(Default)]
struct QueueState {
    texts: VecDeque<(Stream, Vec<u8>)>,
    /// Size of all these texts.
    bytes: usize,
    /// Number of texts that were dropped since the last write.
    dropped: u32,
    /// A text is being written.
    writes: bool,
    failed: Option<io::Error>,
}

#[derive(Default)]
struct Queue {
    /// Whether the thread for the output could be started. Without it, a write may wait.
    has_thread: bool,
    state: Mutex<QueueState>,
    changed: Condvar,
}

impl Queue {
    fn state(&self) -> MutexGuard<'_, QueueState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn until(&self, is_met: impl Fn(&QueueState) -> bool) -> MutexGuard<'_, QueueState> {
        let waited = self
            .changed
            .wait_while(self.state(), |state| !is_met(state));
        waited.unwrap_or_else(PoisonError::into_inner)
    }

    fn put(&self, stream: Stream, text: &[u8]) {
        let state = &mut *self.state();
        let erases = |text: &[u8]| text.starts_with(ERASE.as_bytes());
        // This bar was not displayed yet, and the new text would erase it.
        let is_bar = |last: &mut (Stream, Vec<u8>)| erases(&last.1) && !last.1.ends_with(b"\n");
        if erases(text)
            && let Some((_, bar)) = state.texts.pop_back_if(is_bar)
        {
            state.bytes -= bar.len();
        }
        state.texts.push_back((stream, text.to_vec()));
        state.bytes += text.len();
        while state.bytes > WAITING
            && state.texts.len() > 1
            && let Some((_, oldest)) = state.texts.pop_front()
        {
            state.bytes -= oldest.len();
            state.dropped += 1;
        }
        self.changed.notify_all();
    }

    fn wait(&self) -> io::Result<()> {
        let state = self.until(|state| state.texts.is_empty() && !state.writes);
        match &state.failed {
            None => Ok(()),
            Some(io) => Err(match io.raw_os_error() {
                Some(code) => io::Error::from_raw_os_error(code),
                None => io.kind().into(),
            }),
        }
    }

    fn work(&self, write: impl Fn(Stream, &[u8]) -> io::Result<()>) {
        loop {
            let mut state = self.until(|state| !state.texts.is_empty());
            let Some((stream, text)) = state.texts.pop_front() else {
                continue;
            };
            state.bytes -= text.len();
            state.writes = true;
            let dropped = std::mem::take(&mut state.dropped);
            drop(state);
            if dropped > 0 {
                let note = format!("({dropped} lines are omitted: nobody read them in time)\n");
                let _ = write(Stream::Err, note.as_bytes());
            }
            let written = write(stream, &text);
            let mut state = self.state();
            state.writes = false;
            if let (Stream::Out, Err(io)) = (stream, written) {
                state.failed.get_or_insert(io);
            }
            self.changed.notify_all();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use super::*;

    #[test]
    fn a_reader_that_does_not_read_holds_up_no_writer_and_gets_the_newest_lines_in_order() {
        static QUEUE: LazyLock<Queue> = LazyLock::new(Queue::default);
        let line = |number: usize| format!("{number}: {}\n", "x".repeat(10_000));
        for number in 0..2_000 {
            QUEUE.put(Stream::Out, line(number).as_bytes());
        }
        for text in ["one", "two", "three", "\n"] {
            QUEUE.put(Stream::Err, format!("{ERASE}{text}").as_bytes());
        }
        let (write, written) = channel();
        thread::spawn(move || {
            QUEUE.work(|stream, text| {
                let text = String::from_utf8_lossy(text).into_owned();
                write.send((stream, text)).map_err(io::Error::other)
            });
        });
        QUEUE.wait().expect("written");
        let texts: Vec<_> = written.try_iter().collect();
        let omitted = 2_000 - (texts.len() - 2);
        let note = format!("({omitted} lines");
        assert!(texts[0].1.starts_with(&note), "{:?}", texts[0]);
        assert_eq!(texts[1], (Stream::Out, line(omitted)));
        assert_eq!(texts[texts.len() - 2].1, line(1_999));
        assert_eq!(texts[texts.len() - 1], (Stream::Err, format!("{ERASE}\n")));
    }
}
