//! The kilobyte of RAM that survives a reset; [`crate::retained`] describes its content.

use crate::retained::{EStop, Retained, WORDS, Words};
use core::ptr::{addr_of_mut, read_volatile, write_volatile};

unsafe extern "C" {
    static mut _last_words_start: [u32; WORDS];
}

/// The words at the address that `memory.x` keeps free.
pub(super) struct Ram;

impl Words for Ram {
    fn get(&self, index: usize) -> u32 {
        // SAFETY: the linker script reserves a kilobyte at this address for nothing else; any bit pattern is a number.
        unsafe { read_volatile(addr_of_mut!(_last_words_start).cast::<u32>().add(index)) }
    }

    fn set(&mut self, index: usize, value: u32) {
        // SAFETY: as in `get`; callers are start-up, one task, or a panic, of which there is one at a time.
        unsafe {
            write_volatile(
                addr_of_mut!(_last_words_start).cast::<u32>().add(index),
                value,
            )
        }
    }
}

/// Takes the data of the previous start. Call it once, before anything else.
pub fn start() -> Retained {
    crate::retained::start(&mut Ram)
}

/// Keeps an E-stop over a reset, or clears it. Only the task that owns the state machine calls it.
pub fn keep_latched(estop: Option<EStop>) {
    crate::retained::keep_latched(&mut Ram, estop);
}
