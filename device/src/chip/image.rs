//! Facts from the linker's symbols: the fingerprint of the image in flash, the stack's size and use.

use crate::fingerprint;
use core::ptr::{addr_of, read_volatile};

/// Word that `cortex-m-rt` paints the stack with at the start (feature `paint-stack`).
const PAINT: u32 = 0xCCCC_CCCC;

unsafe extern "C" {
    static __stext: u32;
    static __sidata: u32;
    static __sdata: u32;
    static __edata: u32;
    static _stack_start: u32;
    static _stack_end: u32;
}

/// The words between two of the linker's symbols.
fn words(from: *const u32, to: *const u32) -> impl Iterator<Item = u32> {
    let count = (to as usize).saturating_sub(from as usize) / 4;
    // SAFETY: the linker script puts both ends, word-aligned, into the same memory. The read is volatile because the
    // stack changes while it is read.
    (0..count).map(move |index| unsafe { read_volatile(from.add(index)) })
}

/// The fingerprint of the image in flash.
pub fn hash() -> u32 {
    let start = addr_of!(__stext);
    let data = addr_of!(__edata) as usize - addr_of!(__sdata) as usize;
    let end = addr_of!(__sidata).wrapping_byte_add(data);
    fingerprint::of(words(start, end))
}

/// Size of the stack and its peak use, bytes.
pub fn stack() -> (u32, u32) {
    let (bottom, top) = (addr_of!(_stack_end), addr_of!(_stack_start));
    let untouched = words(bottom, top).take_while(|word| *word == PAINT).count() as u32 * 4;
    let size = (top as u32).saturating_sub(bottom as u32);
    (size, size.saturating_sub(untouched))
}
