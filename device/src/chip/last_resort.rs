//! Panic and processor faults: outputs off, last words kept over the reset, reset.

use super::{retained::Ram, stm32f411re::RAM};
use crate::{
    last_words::{Draft, add_callers, of_a_panic},
    retained::keep_last_words,
};
use core::{
    arch::asm,
    fmt::Write,
    panic::PanicInfo,
    ptr::read_volatile,
    sync::atomic::{AtomicBool, Ordering},
};
use cortex_m_rt::ExceptionFrame;

/// Defines an image's handlers of a panic and of a processor fault. Each calls `$outputs_off`, the image's safe state,
/// before it keeps the last words. No task and no interrupt can switch an output on again: the panic handler disables
/// interrupts first, and a processor fault has the highest priority.
#[macro_export]
macro_rules! last_resort {
    ($outputs_off:path) => {
        #[panic_handler]
        fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
            $crate::chip::last_resort::interrupts_off();
            $outputs_off();
            $crate::chip::last_resort::handle_panic(info)
        }

        /// After a stack overflow the stack pointer is below the RAM, where nothing can be pushed. The handler
        /// therefore runs on its own stack, which `memory.x` reserves.
        #[unsafe(naked)]
        #[unsafe(no_mangle)]
        extern "C" fn HardFault() -> ! {
            core::arch::naked_asm!(
                "mrs r0, msp",
                "mov r1, r7",
                "movw r2, #:lower16:_fault_stack_start",
                "movt r2, #:upper16:_fault_stack_start",
                "msr msp, r2",
                "b {}",
                sym processor_fault,
            )
        }

        extern "C" fn processor_fault(frame: u32, interrupted: u32) -> ! {
            $outputs_off();
            $crate::chip::last_resort::handle_fault(frame, interrupted)
        }
    };
}

/// Keeps tasks and interrupts from running again.
#[inline(always)]
pub fn interrupts_off() {
    cortex_m::interrupt::disable();
}

/// True once the last words are kept. A later panic comes from logging them and must not replace them.
static WORDS_KEPT: AtomicBool = AtomicBool::new(false);

/// Keeps the last words and resets. A panic during the output of a log frame panics again when it logs: the first words
/// are then kept, and nothing is logged.
pub(super) fn keep_and_reset(words: &Draft) -> ! {
    // A panic or fault never returns, so no earlier one can continue between this check and the store below.
    if WORDS_KEPT.load(Ordering::Relaxed) {
        cortex_m::peripheral::SCB::sys_reset();
    }
    keep_last_words(&mut Ram, words.0.as_bytes());
    WORDS_KEPT.store(true, Ordering::Relaxed);
    defmt::error!("{=str}", words.0.as_str());
    cortex_m::peripheral::SCB::sys_reset()
}

/// Handles a panic. The outputs are off already.
pub fn handle_panic(info: &PanicInfo<'_>) -> ! {
    let frame;
    // SAFETY: reads a register.
    unsafe { asm!("mov {}, r7", out(reg) frame, options(nomem, nostack, preserves_flags)) };
    let place = info
        .location()
        .map_or(("?", 0), |at| (at.file(), at.line()));
    keep_and_reset(&of_a_panic(
        place.0,
        place.1,
        info.message(),
        Callers { frame },
    ))
}

/// Handles a processor fault, given the address of the exception's frame and the frame pointer (r7) of the interrupted
/// function. The outputs are off already.
///
/// The stack ends where the RAM begins. There is no memory below it, so an overflow is a fault, and the fault's own
/// frame finds no room either (Armv7-M ARM B1.5.11).
pub fn handle_fault(frame: u32, interrupted: u32) -> ! {
    if !is_in_ram(frame, size_of::<ExceptionFrame>()) {
        let mut words = Draft::default();
        let frame = interrupted;
        add_callers(&mut words, "stack overflow, called from", Callers { frame });
        keep_and_reset(&words)
    }
    // SAFETY: as just checked; the processor has stored the frame there.
    let frame = unsafe { &*(frame as *const ExceptionFrame) };
    let (pc, lr) = (frame.pc(), frame.lr());
    let mut words = Draft::default();
    let _ = write!(words, "processor fault at {pc:#x}, called from {lr:#x}");
    keep_and_reset(&words)
}

/// Whether these bytes are whole words in the RAM.
fn is_in_ram(at: u32, bytes: usize) -> bool {
    at.is_multiple_of(4) && RAM.start <= at && at <= RAM.end - bytes as u32
}

/// Return addresses, innermost first.
///
/// rustc keeps frame pointers on this target: r7 points to a pair of words, the caller's r7 and the return address.
struct Callers {
    frame: u32,
}

impl Iterator for Callers {
    type Item = u32;

    fn next(&mut self) -> Option<u32> {
        if !is_in_ram(self.frame, size_of::<[u32; 2]>()) {
            return None;
        }
        // SAFETY: two aligned words within the RAM; whatever they hold is only printed or checked as an address.
        let [outer, caller] = unsafe { read_volatile(self.frame as *const [u32; 2]) };
        // The stack grows downward: outer frames are at higher addresses. Any other pointer ends the list.
        self.frame = if outer > self.frame { outer } else { 0 };
        // Bit 0 marks Thumb code.
        Some(caller & !1)
    }
}
