//! Facts from the linker's symbols: the fingerprint of the image in flash, the stack's size, use and guard.

use super::stm32f411re::GUARD;
use crate::fingerprint;
use core::{
    ops::Range,
    ptr::{addr_of, read_volatile},
};
use cortex_m::peripheral::{MPU, SCB};

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
    // SAFETY: the linker script puts both ends, word-aligned, into the same memory; volatile, for the stack is in use.
    (0..count).map(move |index| unsafe { read_volatile(from.add(index)) })
}

/// The fingerprint of the image in flash.
pub fn hash() -> u32 {
    let start = addr_of!(__stext);
    let data = addr_of!(__edata) as usize - addr_of!(__sdata) as usize;
    let end = addr_of!(__sidata).wrapping_byte_add(data);
    fingerprint::of(words(start, end))
}

/// The guard: the first place above the statics that is aligned to its size.
fn guard() -> Range<u32> {
    let first = (addr_of!(_stack_end) as u32).next_multiple_of(GUARD);
    first..first + GUARD
}

/// Guards the stack: an overflow becomes a processor fault with last words, instead of overwriting the statics. Call
/// it once, before anything needs much of the stack. The handlers of processor fault and NMI may use the guard.
///
/// The other regions and the background repeat the processor's memory map without the MPU (Armv7-M ARM table B3-1).
pub fn guard_stack() {
    /// Bytes of a region as 2^(SIZE + 1), and ENABLE.
    const fn region(bytes: u64) -> u32 {
        (bytes.trailing_zeros() - 1) << 1 | 1
    }
    const HALF_GIB: u32 = region(1 << 29);
    const FULL_ACCESS: u32 = 0b011 << 24;
    // TEX in three bits, S, C, B.
    const WRITE_THROUGH: u32 = 0b00_0010 << 16;
    const WRITE_BACK_ALLOCATE: u32 = 0b00_1011 << 16;
    const NO_ACCESS: u32 = 0;
    const VALID: u32 = 1 << 4;
    let regions = [
        (0x0000_0000, FULL_ACCESS | WRITE_THROUGH | HALF_GIB),
        (0x2000_0000, FULL_ACCESS | WRITE_BACK_ALLOCATE | HALF_GIB),
        // Where regions overlap, the one with the highest number applies.
        (
            guard().start,
            NO_ACCESS | WRITE_BACK_ALLOCATE | region(GUARD as u64),
        ),
    ];
    // SAFETY: the only user of the MPU; the regions leave everything as it is but the guard, which nobody uses.
    unsafe {
        let mpu = &*MPU::PTR;
        for (number, (base, attributes)) in (0..).zip(regions) {
            mpu.rbar.write(base | VALID | number);
            mpu.rasr.write(attributes);
        }
        // On, with the default map as background; off in the handlers of processor fault and NMI.
        mpu.ctrl.write(1 << 2 | 1);
    }
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}

/// Whether the processor fault is a stack overflow: an instruction hit the guard, or the stacking of an exception did,
/// usually that of the fault itself (CFSR and MMFAR, Armv7-M ARM B3.2.15 and B3.2.18).
pub(super) fn stack_has_overflowed() -> bool {
    const STACKING: u32 = 1 << 5 | 1 << 4;
    const ADDRESS_VALID: u32 = 1 << 7;
    // SAFETY: reads registers.
    let (status, address) = unsafe {
        let scb = &*SCB::PTR;
        (scb.cfsr.read(), scb.mmfar.read())
    };
    status & STACKING != 0 || (status & ADDRESS_VALID != 0 && guard().contains(&address))
}

/// Size of the stack and its peak use, bytes.
pub fn stack() -> (u32, u32) {
    let (bottom, top) = (guard().end as *const u32, addr_of!(_stack_start));
    let untouched = words(bottom, top).take_while(|word| *word == PAINT).count() as u32 * 4;
    let size = (top as u32).saturating_sub(bottom as u32);
    (size, size.saturating_sub(untouched))
}
