//! Panic and processor faults: outputs off, last words kept over the reset, reset.
//!
//! The last words live in the kilobyte of RAM that `memory.x` leaves out of data and stack.

#![allow(unsafe_code)]

use crate::board;
use core::{
    panic::PanicInfo,
    ptr::{read_volatile, write_volatile},
};
use cortex_m_rt::{ExceptionFrame, exception};
use heapless::String;
use protocol::rig::RigFault;

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
    /// An E-stop that was not acknowledged: [`LATCHED_LOOP`] or [`LATCHED_FRAME`].
    latched: u32,
}

const LATCHED_LOOP: u32 = MAGIC ^ 1;
const LATCHED_FRAME: u32 = MAGIC ^ 2;

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

/// What the previous start left.
pub struct Left {
    /// Number of this start.
    pub boot_id: u32,
    /// Text of a panic or processor fault; once.
    pub last_words: Option<String<120>>,
    /// An E-stop that was latched.
    pub latched: Option<RigFault>,
}

/// Keeps an E-stop over a reset, or forgets it (any other fault, or none).
pub fn keep_latched(fault: Option<RigFault>) {
    let mut kept = load();
    kept.latched = match fault {
        Some(RigFault::EStopLoop) => LATCHED_LOOP,
        Some(RigFault::EStopFrame) => LATCHED_FRAME,
        _ => 0,
    };
    store(&kept);
}

/// Takes what the previous start left.
pub fn start() -> Left {
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
    Left {
        boot_id,
        last_words: words,
        latched: match kept.latched {
            LATCHED_LOOP => Some(RigFault::EStopLoop),
            LATCHED_FRAME => Some(RigFault::EStopFrame),
            _ => None,
        },
    }
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

/// Last words in the making, cut off at their end.
#[derive(Default)]
struct Text(String<120>);

impl Text {
    fn push(&mut self, part: &str) {
        for letter in part.chars() {
            let _ = self.0.push(letter);
        }
    }

    fn push_number(&mut self, number: u32, base: u32) {
        if number >= base {
            self.push_number(number / base, base);
        }
        // A digit of its base always is one.
        let _ = self
            .0
            .push(char::from_digit(number % base, base).unwrap_or('?'));
    }

    fn as_str(&self) -> &str {
        &self.0
    }
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    board::outputs_off();
    let mut text = Text::default();
    // Cut off at 120 bytes: the place comes first.
    if let Some(place) = info.location() {
        text.push(place.file());
        text.push(":");
        text.push_number(place.line(), 10);
        text.push(": ");
    }
    // A message with arguments needs the formatting machinery, two kilobytes; the place tells enough.
    text.push(info.message().as_str().unwrap_or("panic"));
    die(text.as_str())
}

/// `defmt::panic!` has printed its message; it must not format it a second time.
#[defmt::panic_handler]
fn defmt_panic() -> ! {
    die("a check failed; its text is in the debug log")
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    board::outputs_off();
    let mut text = Text::default();
    text.push("processor fault at 0x");
    text.push_number(frame.pc(), 16);
    text.push(", called from 0x");
    text.push_number(frame.lr(), 16);
    die(text.as_str())
}
