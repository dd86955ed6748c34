//! Panic and processor faults: outputs off, last words kept over the reset, reset.
//!
//! The last words live in the kilobyte of RAM that `memory.x` leaves out of data and stack.

#![allow(unsafe_code)]

use crate::board;
use core::{
    fmt::Write,
    panic::PanicInfo,
    ptr::{read_volatile, write_volatile},
};
use cortex_m_rt::{ExceptionFrame, exception};
use heapless::String;

const MAGIC: u32 = 0x5245_5430;

/// What is kept. Whole words only, so that every bit pattern is a valid value.
#[repr(C)]
#[derive(Clone, Copy)]
struct Kept {
    boot_magic: u32,
    boot_id: u32,
    words_magic: u32,
    len: u32,
    text: [u32; 30],
    check: u32,
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

fn check(kept: &Kept) -> u32 {
    kept.text
        .iter()
        .fold(kept.words_magic ^ kept.len, |sum, word| {
            sum.rotate_left(5) ^ word
        })
}

/// Takes what the previous start left: the number of this start and, once, the last words.
pub fn start() -> (u32, Option<String<120>>) {
    let mut kept = load();
    let boot_id = if kept.boot_magic == MAGIC {
        kept.boot_id.wrapping_add(1)
    } else {
        1
    };
    let words =
        (kept.words_magic == MAGIC && kept.len <= 120 && kept.check == check(&kept)).then(|| {
            let mut text = String::new();
            for byte in kept
                .text
                .iter()
                .flat_map(|word| word.to_le_bytes())
                .take(kept.len as usize)
            {
                // Cannot overflow: at most 120 bytes.
                let _ = text.push(if byte.is_ascii() {
                    char::from(byte)
                } else {
                    '?'
                });
            }
            text
        });
    (kept.boot_magic, kept.boot_id, kept.words_magic) = (MAGIC, boot_id, 0);
    store(&kept);
    (boot_id, words)
}

fn die(text: &str) -> ! {
    board::outputs_off();
    let mut kept = load();
    let bytes = text.as_bytes();
    let len = bytes.len().min(120);
    kept.text = [0; 30];
    for (index, byte) in bytes.iter().take(len).enumerate() {
        kept.text[index / 4] |= u32::from(*byte) << (index % 4 * 8);
    }
    (kept.words_magic, kept.len) = (MAGIC, len as u32);
    kept.check = check(&kept);
    store(&kept);
    defmt::error!("{=str}", text);
    cortex_m::peripheral::SCB::sys_reset()
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    board::outputs_off();
    let mut text = String::<120>::new();
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
    let mut text = String::<120>::new();
    let _ = write!(
        text,
        "processor fault at {:#010x}, called from {:#010x}",
        frame.pc(),
        frame.lr()
    );
    die(&text)
}
