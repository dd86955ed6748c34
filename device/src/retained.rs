//! Data that survives a reset: the number of starts, a latched E-stop, the last words.
//!
//! It is in the kilobyte of RAM that `memory.x` reserves. After a power cut that RAM holds arbitrary bits, so a magic
//! number marks each item, and the last words have a checksum.

use crate::last_words::{LONGEST, LastWords};
use heapless::String;
use protocol::system::ResetCause;

/// Words of RAM that keep their content over a reset; any bit pattern is valid.
pub trait Words {
    /// Reads a word.
    fn get(&self, index: usize) -> u32;
    /// Writes a word.
    fn set(&mut self, index: usize, value: u32);
}

/// Number of words in use.
pub const WORDS: usize = CAUSE + 1;

const MAGIC: u32 = 0x5245_5430;
const LATCHED_LOOP: u32 = MAGIC ^ 1;
const LATCHED_FRAME: u32 = MAGIC ^ 2;

// Indices.
const BOOT_MAGIC: usize = 0;
const BOOT_ID: usize = 1;
const LATCHED: usize = 2;
const TEXT_MAGIC: usize = 3;
const LENGTH: usize = 4;
const CHECK: usize = 5;
const TEXT: usize = 6;
const CLOCK: usize = TEXT + LONGEST;
const CAUSE: usize = CLOCK + 1;

/// Causes that can be kept for the next start. Stored as [`MAGIC`] + 1 + index.
const CAUSES: [ResetCause; 5] = [
    ResetCause::PowerOn,
    ResetCause::Pin,
    ResetCause::Panic,
    ResetCause::Watchdog,
    ResetCause::Software,
];

/// An emergency stop that stays latched over a reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EStop {
    /// The E-stop loop opened.
    Loop,
    /// By an urgent frame of the host.
    Frame,
}

/// Data of the previous start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Retained {
    /// Number of this start, from 1 after the supply was switched on.
    pub boot_id: u32,
    /// Text of a panic or processor fault; reported once.
    pub last_words: Option<LastWords>,
    /// An E-stop that is not acknowledged yet.
    pub latched: Option<EStop>,
    /// A stop of the clock ended the previous start; reported once.
    pub clock_failed: bool,
    /// Cause of the previous start, if this start only replaces it; reported once.
    pub cause: Option<ResetCause>,
}

/// Takes the data of the previous start, and counts this one.
pub fn start(words: &mut impl Words) -> Retained {
    let boot_id = if words.get(BOOT_MAGIC) == MAGIC {
        words.get(BOOT_ID).wrapping_add(1)
    } else {
        words.set(LATCHED, 0);
        words.set(CLOCK, 0);
        words.set(CAUSE, 0);
        1
    };
    let clock_failed = words.get(CLOCK) == MAGIC;
    words.set(CLOCK, 0);
    let place = words.get(CAUSE).wrapping_sub(MAGIC + 1);
    words.set(CAUSE, 0);
    let length = (words.get(LENGTH) as usize).min(LONGEST);
    let is_intact = words.get(TEXT_MAGIC) == MAGIC && words.get(CHECK) == check(words, length);
    let last_words = is_intact.then(|| {
        let text = (0..length).map(|index| words.get(TEXT + index) as u8 & 0x7F);
        String::from_utf8(text.collect()).unwrap_or_default()
    });
    words.set(BOOT_MAGIC, MAGIC);
    words.set(BOOT_ID, boot_id);
    words.set(TEXT_MAGIC, 0);
    let latched = match words.get(LATCHED) {
        LATCHED_LOOP => Some(EStop::Loop),
        LATCHED_FRAME => Some(EStop::Frame),
        _ => None,
    };
    Retained {
        boot_id,
        last_words,
        latched,
        clock_failed,
        cause: CAUSES.get(place as usize).copied(),
    }
}

/// Passes the data of the previous start and the cause of this one on to the next start, which replaces this one before
/// it has moved anything. A latched E-stop is kept anyway.
pub fn pass_on(words: &mut impl Words, previous: &Retained, cause: ResetCause) {
    if previous.clock_failed {
        keep_clock_failed(words);
    }
    if let Some(text) = &previous.last_words {
        keep_last_words(words, text.as_bytes());
    }
    let place = CAUSES.iter().position(|kept| *kept == cause);
    words.set(CAUSE, place.map_or(0, |place| MAGIC + 1 + place as u32));
}

/// Keeps for the next start that the clock stopped.
pub fn keep_clock_failed(words: &mut impl Words) {
    words.set(CLOCK, MAGIC);
}

/// Keeps an E-stop over a reset, or forgets it.
pub fn keep_latched(words: &mut impl Words, estop: Option<EStop>) {
    let word = match estop {
        Some(EStop::Loop) => LATCHED_LOOP,
        Some(EStop::Frame) => LATCHED_FRAME,
        None => 0,
    };
    words.set(LATCHED, word);
}

/// Keeps the last words for the next start.
pub fn keep_last_words(words: &mut impl Words, text: &[u8]) {
    let text = &text[..text.len().min(LONGEST)];
    for (index, byte) in text.iter().enumerate() {
        words.set(TEXT + index, u32::from(*byte));
    }
    words.set(LENGTH, text.len() as u32);
    words.set(CHECK, check(words, text.len()));
    words.set(TEXT_MAGIC, MAGIC);
}

/// Checksum of the last words, as for frames: at this length it detects any five wrong bits. It uses a table: bit by
/// bit it would take 2 ms of a panic at 16 MHz, and the reset has to come soon.
static CRC32C: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);

/// Checksum of the text; one letter per word.
fn check(words: &impl Words, length: usize) -> u32 {
    let mut digest = CRC32C.digest();
    digest.update(&(MAGIC ^ length as u32).to_le_bytes());
    for index in 0..length {
        digest.update(&words.get(TEXT + index).to_le_bytes());
    }
    digest.finalize()
}
