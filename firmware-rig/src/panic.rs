//! Panic and processor faults: outputs off, last words kept over the reset, reset. Also keeps what else has to
//! survive a reset: the number of starts and an unacknowledged E-stop.
//!
//! All of it lives in the kilobyte of RAM that `memory.x` leaves out of data and stack.

#![allow(unsafe_code)]

use crate::board;
use core::{
    arch::asm,
    panic::PanicInfo,
    ptr::{addr_of_mut, read_volatile, write_volatile},
};
use cortex_m_rt::{ExceptionFrame, exception};
use heapless::{String, Vec};
use protocol::rig::RigFault;

const MAGIC: u32 = 0x5245_5430;
const LATCHED_LOOP: u32 = MAGIC ^ 1;
const LATCHED_FRAME: u32 = MAGIC ^ 2;

/// Longest last words, bytes.
const LONGEST: usize = 120;

// Numbers of the kept words.
const BOOT_MAGIC: usize = 0;
const BOOT_ID: usize = 1;
const LATCHED: usize = 2;
const WORDS_MAGIC: usize = 3;
const LENGTH: usize = 4;
const CHECK: usize = 5;
const TEXT: usize = 6;

unsafe extern "C" {
    static mut _last_words_start: [u32; TEXT + LONGEST];
}

#[inline(never)]
fn get(word: usize) -> u32 {
    // SAFETY: the linker script reserves a kilobyte at this address for nothing else; any bit pattern is a number.
    unsafe { read_volatile(addr_of_mut!(_last_words_start).cast::<u32>().add(word)) }
}

#[inline(never)]
fn set(word: usize, value: u32) {
    // SAFETY: as in `get`; callers are start-up, one task, or a panic, of which there is one at a time.
    unsafe {
        write_volatile(
            addr_of_mut!(_last_words_start).cast::<u32>().add(word),
            value,
        )
    }
}

/// Of the text; one letter per word.
fn check(length: usize) -> u32 {
    (0..length).fold(MAGIC ^ length as u32, |sum, index| {
        sum.rotate_left(5) ^ get(TEXT + index)
    })
}

/// What the previous start left.
pub struct Left {
    /// Number of this start.
    pub boot_id: u32,
    /// Text of a panic or processor fault; once.
    pub last_words: Option<String<LONGEST>>,
    /// An E-stop that was latched.
    pub latched: Option<RigFault>,
}

/// Keeps an E-stop over a reset, or forgets it (any other fault, or none).
pub fn keep_latched(fault: Option<RigFault>) {
    let word = match fault {
        Some(RigFault::EStopLoop) => LATCHED_LOOP,
        Some(RigFault::EStopFrame) => LATCHED_FRAME,
        _ => 0,
    };
    set(LATCHED, word);
}

/// Takes what the previous start left.
pub fn start() -> Left {
    let boot_id = if get(BOOT_MAGIC) == MAGIC {
        get(BOOT_ID).wrapping_add(1)
    } else {
        set(LATCHED, 0);
        1
    };
    let length = (get(LENGTH) as usize).min(LONGEST);
    let words = get(WORDS_MAGIC) == MAGIC && get(CHECK) == check(length);
    let last_words = words.then(|| {
        let text = (0..length)
            .map(|index| get(TEXT + index) as u8 & 0x7F)
            .collect();
        String::from_utf8(text).unwrap_or_default()
    });
    set(BOOT_MAGIC, MAGIC);
    set(BOOT_ID, boot_id);
    set(WORDS_MAGIC, 0);
    Left {
        boot_id,
        last_words,
        latched: match get(LATCHED) {
            LATCHED_LOOP => Some(RigFault::EStopLoop),
            LATCHED_FRAME => Some(RigFault::EStopFrame),
            _ => None,
        },
    }
}

fn die(text: &Text) -> ! {
    board::outputs_off();
    for (index, byte) in text.0.iter().enumerate() {
        set(TEXT + index, u32::from(*byte));
    }
    set(LENGTH, text.0.len() as u32);
    set(CHECK, check(text.0.len()));
    set(WORDS_MAGIC, MAGIC);
    defmt::error!("{=[u8]:a}", &text.0);
    cortex_m::peripheral::SCB::sys_reset()
}

/// Last words in the making, cut off at their end.
struct Text(Vec<u8, LONGEST>);

impl Text {
    fn new(beginning: &str) -> Self {
        let mut text = Self(Vec::new());
        text.push(beginning);
        text
    }

    fn push(&mut self, part: &str) {
        for byte in part.bytes() {
            let _ = self.0.push(byte);
        }
    }

    fn push_number(&mut self, number: u32, base: u32) {
        if number >= base {
            self.push_number(number / base, base);
        }
        let _ = self
            .0
            .push(b"0123456789abcdef"[(number % base) as usize % 16]);
    }
}

/// Message and place are not used: inlined, the optimiser sees that nobody reads them, and 9.5 KB of texts, places
/// and formatting stay out of the image. The callers tell as much, see `cargo xtask where`.
// rustc warns that the hint is ignored; it is not, as the image's size shows.
#[allow(unused_attributes)]
#[inline(always)]
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    die_with_callers()
}

#[inline(never)]
fn die_with_callers() -> ! {
    board::outputs_off();
    let mut text = Text::new("panic, called from");
    for caller in Callers::new() {
        text.push(" 0x");
        text.push_number(caller, 16);
    }
    die(&text)
}

/// Return addresses, innermost first, as many as the last words hold.
///
/// rustc keeps frame pointers on this target: r7 points to a pair of words, the caller's r7 and the return address.
struct Callers {
    frame: u32,
    left: u8,
}

impl Callers {
    #[inline(always)]
    fn new() -> Self {
        let frame;
        // SAFETY: reads a register.
        unsafe { asm!("mov {}, r7", out(reg) frame, options(nomem, nostack, preserves_flags)) };
        Self { frame, left: 9 }
    }
}

impl Iterator for Callers {
    type Item = u32;

    fn next(&mut self) -> Option<u32> {
        const RAM: core::ops::Range<u32> = 0x2000_0000..0x2001_FFF8;
        self.left = self.left.checked_sub(1)?;
        if !RAM.contains(&self.frame) || !self.frame.is_multiple_of(4) {
            return None;
        }
        // SAFETY: two aligned words within the RAM; whatever they hold is only printed or checked as an address.
        let [outer, caller] = unsafe { read_volatile(self.frame as *const [u32; 2]) };
        // The stack grows downward: outer frames lie above. Anything else is no frame, and the last one.
        self.frame = if outer > self.frame { outer } else { 0 };
        // Bit 0 says "Thumb".
        Some(caller & !1)
    }
}

/// `defmt::panic!` has printed its message; it must not format it a second time.
#[defmt::panic_handler]
fn defmt_panic() -> ! {
    die(&Text::new("a check failed; its text is in the debug log"))
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    board::outputs_off();
    let mut text = Text::new("processor fault at 0x");
    text.push_number(frame.pc(), 16);
    text.push(", called from 0x");
    text.push_number(frame.lr(), 16);
    die(&text)
}
