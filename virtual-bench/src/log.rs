//! The firmware's log: defmt frames, read from its RTT buffer as a debug probe does and decoded with the ELF.

use std::fmt;
use std::sync::Arc;

use defmt_decoder::{DecodeError, Table};
use object::{Object, ObjectSymbol};
use rigless::emulator::Host;
use rigless::soc::Width;

/// Offset of the first up-channel in the control block, after the 16-byte name and two counts.
const CHANNEL: u64 = 24;
const BUFFER: u64 = CHANNEL + 4;
const SIZE: u64 = CHANNEL + 8;
const WRITTEN: u64 = CHANNEL + 12;
const READ: u64 = CHANNEL + 16;

/// A piece of the log as read, or a start of the firmware.
#[derive(Clone, Debug)]
enum Chunk {
    Bytes(u64, Vec<u8>),
    Restart(u64),
}

/// Reads the log while the machine runs.
pub(crate) struct Tap {
    control_block: Option<u64>,
    table: Option<Arc<Table>>,
    chunks: Vec<Chunk>,
}

impl Tap {
    pub(crate) fn new(elf: &[u8]) -> Result<Self, String> {
        let file = object::File::parse(elf).map_err(|error| error.to_string())?;
        let control_block = file
            .symbols()
            .find(|symbol| symbol.name() == Ok("_SEGGER_RTT"))
            .map(|symbol| symbol.address());
        let table = Table::parse(elf).map_err(|error| error.to_string())?;
        Ok(Self {
            control_block,
            table: table.map(Arc::new),
            chunks: Vec::new(),
        })
    }

    pub(crate) fn drain(&mut self, host: &mut dyn Host, now_ns: u64) {
        if let Some(bytes) = self.read(host).filter(|bytes| !bytes.is_empty()) {
            self.chunks.push(Chunk::Bytes(now_ns, bytes));
        }
    }

    /// Reads the rest of the log before the firmware restarts and overwrites it.
    pub(crate) fn restarted(&mut self, host: &mut dyn Host, now_ns: u64) {
        self.drain(host, now_ns);
        self.chunks.push(Chunk::Restart(now_ns));
    }

    pub(crate) fn powered_up(&mut self, now_ns: u64) {
        self.chunks.push(Chunk::Restart(now_ns));
    }

    pub(crate) fn log(&self) -> Log {
        Log {
            table: self.table.clone(),
            chunks: self.chunks.clone(),
        }
    }

    fn read(&self, host: &mut dyn Host) -> Option<Vec<u8>> {
        let block = self.control_block?;
        let mut word = |address| host.read(address, Width::W32).ok();
        let (written, read) = (word(block + WRITTEN)?, word(block + READ)?);
        if written == read {
            return None;
        }
        let (buffer, size) = (word(block + BUFFER)?, word(block + SIZE)?);
        if written >= size || read >= size || size > 1 << 20 {
            return None;
        }
        let mut bytes = Vec::new();
        let mut at = read;
        while at != written {
            bytes.push(host.read(buffer + at, Width::W8).ok()? as u8);
            at = (at + 1) % size;
        }
        host.write(block + READ, Width::W32, written).ok()?;
        Some(bytes)
    }
}

/// The log of a machine since its first power-up.
#[derive(Clone)]
pub struct Log {
    table: Option<Arc<Table>>,
    chunks: Vec<Chunk>,
}

/// One line of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogLine {
    /// When it was read, ns on the bench's clock: up to one quantum after it was written.
    pub at_ns: u64,
    /// Level and message.
    pub text: String,
}

impl Log {
    /// Every line, in order.
    #[must_use]
    pub fn lines(&self) -> Vec<LogLine> {
        let mut lines = Vec::new();
        let Some(table) = &self.table else {
            return lines;
        };
        let mut decoder = table.new_stream_decoder();
        for chunk in &self.chunks {
            let (at_ns, bytes) = match chunk {
                Chunk::Bytes(at_ns, bytes) => (*at_ns, bytes),
                Chunk::Restart(at_ns) => {
                    decoder = table.new_stream_decoder();
                    let text = "---- start ----".into();
                    lines.push(LogLine {
                        at_ns: *at_ns,
                        text,
                    });
                    continue;
                }
            };
            decoder.received(bytes);
            loop {
                let text = match decoder.decode() {
                    Ok(frame) => {
                        let level = frame.level().map_or("print", |level| level.as_str());
                        format!("{level}: {}", frame.display_message())
                    }
                    Err(DecodeError::UnexpectedEof) => break,
                    Err(DecodeError::Malformed) => "(a frame that cannot be decoded)".into(),
                };
                lines.push(LogLine { at_ns, text });
            }
        }
        lines
    }
}

impl fmt::Display for Log {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for line in self.lines() {
            writeln!(f, "{:>14.6} s  {}", line.at_ns as f64 / 1e9, line.text)?;
        }
        Ok(())
    }
}
