//! Reacts to a stop of the 8 MHz clock.

#![allow(unsafe_code)]

use super::pins;
use device::chip::clock::reset_after_clock_failure;

/// The 8 MHz clock stopped, and the chip runs on its own oscillator. TIM1 is broken by hardware; the driver is switched
/// off here.
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() -> ! {
    clock_failed()
}

/// Switches everything off and resets the chip; the next start reports why.
pub fn clock_failed() -> ! {
    // The driver stays on after the first motion.
    let has_moved = pins::driver_is_on();
    pins::outputs_off();
    reset_after_clock_failure(has_moved)
}
