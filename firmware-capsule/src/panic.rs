//! Panic and processor faults: bridge asleep, last words kept over the reset, reset.
//!
//! The last words live in the kilobyte of RAM that `memory.x` leaves out of data and stack, with a checksum each
//! for the boot counter and the text: after a power cut the RAM holds anything.

#![allow(unsafe_code)]

use crate::board;
use core::{
    fmt::Write,
    panic::PanicInfo,
    ptr::{read_volatile, write_volatile},
};
use cortex_m_rt::{ExceptionFrame, exception};
use heapless::String;

/// Longest text, that of [`protocol::system::LastWords`].
const TEXT: usize = 120;
const BOOT_MAGIC: u32 = 0x4341_5031;
const TEXT_MAGIC: u32 = 0x4341_5032;
const CRC32: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);

/// What is kept. Whole words only, so that every bit pattern is a valid value.
#[repr(C)]
#[derive(Clone, Copy)]
struct Kept {
    boot_magic: u32,
    boot_id: u32,
    boot_crc: u32,
    text_magic: u32,
    len: u32,
    text: [u32; TEXT / 4],
    text_crc: u32,
}

unsafe extern "C" {
    static mut _last_words_start: Kept;
}

fn load() -> Kept {
    // SAFETY: the linker script reserves a kilobyte at this address for nothing else, and all bit patterns are valid.
    unsafe { read_volatile(&raw const _last_words_start) }
}

fn store(kept: &Kept) {
    // SAFETY: as in `load`; callers are start-up before any task, or a panic, of which there is one at a time.
    unsafe { write_volatile(&raw mut _last_words_start, *kept) }
}

fn crc_of(words: impl IntoIterator<Item = u32>) -> u32 {
    let mut digest = CRC32.digest();
    for word in words {
        digest.update(&word.to_le_bytes());
    }
    digest.finalize()
}

fn text_crc(kept: &Kept) -> u32 {
    crc_of([kept.text_magic, kept.len].into_iter().chain(kept.text))
}

/// Takes what the previous start left: the number of this start and, once, the last words.
pub(crate) fn start() -> (u32, Option<String<TEXT>>) {
    let mut kept = load();
    let counted =
        kept.boot_magic == BOOT_MAGIC && kept.boot_crc == crc_of([kept.boot_magic, kept.boot_id]);
    let boot_id = if counted {
        kept.boot_id.wrapping_add(1)
    } else {
        1
    };
    let spoken = kept.text_magic == TEXT_MAGIC
        && kept.len as usize <= TEXT
        && kept.text_crc == text_crc(&kept);
    let words = spoken.then(|| {
        let mut text = String::new();
        let bytes = kept.text.iter().flat_map(|word| word.to_le_bytes());
        for byte in bytes.take(kept.len as usize) {
            // Cannot overflow: at most 120 bytes.
            let _ = text.push(if byte.is_ascii() {
                char::from(byte)
            } else {
                '?'
            });
        }
        text
    });
    (kept.boot_magic, kept.boot_id) = (BOOT_MAGIC, boot_id);
    kept.boot_crc = crc_of([BOOT_MAGIC, boot_id]);
    kept.text_magic = 0;
    store(&kept);
    (boot_id, words)
}

fn die(text: &str) -> ! {
    board::outputs_off();
    let mut kept = load();
    let bytes = &text.as_bytes()[..text.len().min(TEXT)];
    kept.text = [0; TEXT / 4];
    for (word, chunk) in kept.text.iter_mut().zip(bytes.chunks(4)) {
        let mut four = [0; 4];
        four[..chunk.len()].copy_from_slice(chunk);
        *word = u32::from_le_bytes(four);
    }
    (kept.text_magic, kept.len) = (TEXT_MAGIC, bytes.len() as u32);
    kept.text_crc = text_crc(&kept);
    store(&kept);
    defmt::error!("{=str}", text);
    cortex_m::peripheral::SCB::sys_reset()
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    board::outputs_off();
    let mut text = String::<TEXT>::new();
    // Cut off at 120 bytes: the place comes first.
    if let Some(place) = info.location() {
        let _ = write!(text, "{}:{}: ", place.file(), place.line());
    }
    let _ = write!(text, "{}", info.message());
    die(&text)
}

/// `defmt::panic!` has printed its message; it must not format it a second time.
#[defmt::panic_handler]
fn defmt_panic() -> ! {
    die("a check failed; its text is in the debug log")
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    board::outputs_off();
    let mut text = String::<TEXT>::new();
    let _ = write!(
        text,
        "processor fault at {:#010x}, called from {:#010x}",
        frame.pc(),
        frame.lr()
    );
    die(&text)
}
