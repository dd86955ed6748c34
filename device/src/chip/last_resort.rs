//! Panic and processor faults: outputs off, last words kept over the reset, reset.

use super::{retained::Ram, stm32f411re::RAM};
use crate::{last_words::Draft, retained::keep_last_words};
use core::{
    arch::asm,
    ptr::read_volatile,
    sync::atomic::{AtomicBool, Ordering},
};
use cortex_m_rt::ExceptionFrame;

/// Defines the handlers of an image: for a panic, for a failed check of defmt and for a processor fault. Each calls
/// `$outputs_off`, the image's safe state, before it keeps its last words. No task and no interrupt can switch an output
/// on again: a panic switches the interrupts off first, and a processor fault has the highest priority.
#[macro_export]
macro_rules! last_resort {
    ($outputs_off:path) => {
        /// Inlined, so that the optimiser drops the unused message and location: 9.5 KB of texts and formatting stay
        /// out of the image. The callers' addresses tell as much, see `cargo xtask where`.
        // rustc warns that the hint is ignored; it is not, as the image's size shows.
        #[allow(unused_attributes)]
        #[inline(always)]
        #[panic_handler]
        fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
            $crate::chip::last_resort::interrupts_off();
            $outputs_off();
            $crate::chip::last_resort::die_of_a_panic()
        }

        /// `defmt::panic!` has printed its message; it must not format it a second time.
        #[defmt::panic_handler]
        fn defmt_panic() -> ! {
            $crate::chip::last_resort::interrupts_off();
            $outputs_off();
            $crate::chip::last_resort::die_of_a_failed_check()
        }

        /// An overflow leaves the stack pointer below the RAM, where nothing can be pushed: the rest runs on a stack of
        /// its own, which `memory.x` keeps free.
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
            $crate::chip::last_resort::die_of_a_fault(frame, interrupted)
        }
    };
}

/// Ends the work of all tasks and interrupts.
#[inline(always)]
pub fn interrupts_off() {
    cortex_m::interrupt::disable();
}

/// True once the last words are kept. A later panic comes from logging them and must not replace them.
static DYING: AtomicBool = AtomicBool::new(false);

/// Keeps the last words and resets. A panic while a frame of the log is being written panics again when it logs: the
/// first words are then kept, and nothing is logged.
pub(super) fn die(words: &Draft) -> ! {
    // A panic or fault never returns, so none of them is resumed between this check and the store below.
    if DYING.load(Ordering::Relaxed) {
        cortex_m::peripheral::SCB::sys_reset();
    }
    keep_last_words(&mut Ram, words.bytes());
    DYING.store(true, Ordering::Relaxed);
    defmt::error!("{=[u8]:a}", words.bytes());
    cortex_m::peripheral::SCB::sys_reset()
}

/// A panic. The outputs are off.
#[inline(never)]
pub fn die_of_a_panic() -> ! {
    let frame;
    // SAFETY: reads a register.
    unsafe { asm!("mov {}, r7", out(reg) frame, options(nomem, nostack, preserves_flags)) };
    die_with_callers("panic, called from", frame)
}

fn die_with_callers(what: &str, frame: u32) -> ! {
    let mut words = Draft::new(what);
    for caller in (Callers { frame, left: 9 }) {
        words.push(" ");
        words.push_address(caller);
    }
    die(&words)
}

/// A failed check of defmt. The outputs are off.
pub fn die_of_a_failed_check() -> ! {
    die(&Draft::new("a check failed; its text is in the debug log"))
}

/// A processor fault, with the address of the exception's frame and the frame pointer (r7) of the interrupted
/// function. The outputs are off.
///
/// The stack ends where the RAM begins. There is no memory below it, so an overflow is a fault, and the fault's own frame
/// finds no room either (Armv7-M ARM B1.5.11).
pub fn die_of_a_fault(frame: u32, interrupted: u32) -> ! {
    if !RAM.contains(&frame) {
        die_with_callers("stack overflow, called from", interrupted);
    }
    // SAFETY: the processor has stored the frame there, in the RAM.
    let frame = unsafe { &*(frame as *const ExceptionFrame) };
    let mut words = Draft::new("processor fault at ");
    words.push_address(frame.pc());
    words.push(", called from ");
    words.push_address(frame.lr());
    die(&words)
}

/// Return addresses, innermost first, as many as the last words hold.
///
/// rustc keeps frame pointers on this target: r7 points to a pair of words, the caller's r7 and the return address.
struct Callers {
    frame: u32,
    left: u8,
}

impl Iterator for Callers {
    type Item = u32;

    fn next(&mut self) -> Option<u32> {
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
