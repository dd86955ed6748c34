//! Pool of processors whose machine was dropped, with their translated code. The next machine with the same program
//! takes one instead of translating everything again.
//!
//! A processor is reset to the state in which it was made, and its translations of memory that may have changed are
//! dropped. Translations of the program stay, because the program is identical to the byte; they do not change what it
//! does. A program that sets the MPU up would lose them: the emulator drops all translations when the MPU changes, and
//! links no blocks while it is on.

use std::sync::{Mutex, PoisonError};

use rigless::emulator::{Processor, Queued};
use rigless::image::Image;
use sha2::{Digest, Sha256};

use super::map::{FLASH_BASE, FLASH_BYTES, SECTOR_BYTES};

/// Most processors in the pool: as many machines as tests run at once, and a few more.
const MOST: usize = 12;
/// Flash that the firmware programs itself: sectors 1 to 3.
const SETTINGS: std::ops::Range<u64> = FLASH_BASE + SECTOR_BYTES[0]
    ..FLASH_BASE + SECTOR_BYTES[0] + SECTOR_BYTES[1] + SECTOR_BYTES[2] + SECTOR_BYTES[3];
const FLASH: std::ops::Range<u64> = FLASH_BASE..FLASH_BASE + FLASH_BYTES;
/// Alignment of mapped memory: no host page is larger.
const PAGE: usize = 4_096;

/// A program, identified by the flash without the settings and by the clock of the processor that runs it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Program {
    flash: [u8; 32],
    core_hz: u64,
}

impl Program {
    /// The program that a machine with these images starts with.
    pub(crate) fn of(images: &[Image], core_hz: u64) -> Self {
        let mut flash = vec![0xFF; FLASH_BYTES as usize];
        for (address, bytes) in images.iter().flat_map(Image::segments) {
            let fits = FLASH.contains(&address) && address + bytes.len() as u64 <= FLASH.end;
            if fits {
                let at = (address - FLASH.start) as usize;
                flash[at..at + bytes.len()].copy_from_slice(bytes);
            }
        }
        let [from, to] = [SETTINGS.start, SETTINGS.end].map(|at| (at - FLASH.start) as usize);
        flash[from..to].fill(0xFF);
        Self {
            flash: Sha256::digest(&flash).into(),
            core_hz,
        }
    }
}

/// A processor, and the data for reusing it.
#[derive(Debug)]
pub(super) struct PooledProcessor {
    pub(super) inner: Box<dyn Processor>,
    pub(super) program: Program,
    /// Its state after a reset, before it has executed anything.
    pub(super) fresh: Vec<u8>,
    /// Memory that was mapped: start, length, and whether it can be written.
    pub(super) mapped: Vec<(u64, u64, bool)>,
    /// Flash outside the settings that was changed while it ran.
    pub(super) changed: Vec<(u64, u64)>,
    /// Memory that it is mapped to while it is in the pool. Must be dropped after the processor.
    pub(super) idle: Vec<Vec<u8>>,
}

static POOL: Mutex<Vec<PooledProcessor>> = Mutex::new(Vec::new());

/// Takes a processor for `program`, in the state in which it was made.
pub(super) fn take(program: &Program) -> Option<PooledProcessor> {
    let mut pool = POOL.lock().unwrap_or_else(PoisonError::into_inner);
    let nth = pool.iter().rposition(|pooled| pooled.program == *program)?;
    let mut processor = pool.remove(nth);
    drop(pool);
    processor.inner.load(&processor.fresh).ok()?;
    for &(start, length, writable) in &processor.mapped {
        if writable {
            processor
                .inner
                .ask(Queued::Invalidate(start, start + length));
        }
    }
    let changed = processor
        .changed
        .drain(..)
        .chain([(SETTINGS.start, SETTINGS.end)]);
    for (start, end) in changed {
        processor.inner.ask(Queued::Invalidate(start, end));
    }
    Some(processor)
}

/// Whether a change of these bytes may alter the program.
pub(super) fn is_program(start: u64, end: u64) -> bool {
    let outside = |range: &std::ops::Range<u64>| end <= range.start || range.end <= start;
    let within_settings = SETTINGS.start <= start && end <= SETTINGS.end;
    !(outside(&FLASH) || within_settings)
}

/// Puts a processor into the pool before its machine is dropped together with the memory that it is mapped to.
pub(super) fn keep(mut processor: PooledProcessor) {
    let mut idle = Vec::new();
    for &(start, length, writable) in &processor.mapped {
        let mut bytes = vec![0_u8; length as usize + PAGE];
        let host = bytes.as_mut_ptr();
        let host = host.wrapping_add(host.align_offset(PAGE));
        // SAFETY: `host` is aligned and followed by `length` bytes of `bytes`. Nothing else accesses them, and they are
        // dropped after the processor, or when other memory is mapped instead.
        #[allow(unsafe_code)]
        unsafe {
            processor.inner.map(start, length, host, writable);
        }
        idle.push(bytes);
    }
    processor.idle = idle;
    let mut pool = POOL.lock().unwrap_or_else(PoisonError::into_inner);
    if pool.len() == MOST {
        pool.remove(0);
    }
    pool.push(processor);
}
