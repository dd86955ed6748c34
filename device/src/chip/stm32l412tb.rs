//! The STM32L412: its memory, its time base, why it was reset. No such chip has run this.
//!
//! Registers, pins and memory are those of `stm32-metapac`. RM0394 and DS12469, where they are named, are known and were not at hand, but
//! for the data sheet's first page: whoever makes a board checks them there.

pub mod flash;
pub mod serial;
pub mod supply;

use core::ops::Range;
use embassy_stm32::{interrupt, pac};
use protocol::system::{Clock, ResetCause};

/// Where a stack can be: the RAM without what survives a reset, and without its last two words.
pub(super) const RAM: Range<u32> = 0x2000_0400..0x2000_9FF8;

/// Bytes between statics and stack that nobody may touch, a power of two. There is no room for more: a large frame may step over
/// them.
pub(super) const GUARD: u32 = 1_024;

/// The timer of the HAL's time driver (a feature of the HAL in this package's manifest), and its interrupt. The break of TIM1, which
/// shares it, is not used.
// SAFETY: TIM15 has the registers of a general-purpose timer that the driver uses; the driver itself sees it as one.
pub(super) const TIME_DRIVER: pac::timer::TimGp16 =
    unsafe { pac::timer::TimGp16::from_ptr(pac::TIM15.as_ptr()) };
pub(super) use interrupt::TIM1_BRK_TIM15 as TIME_DRIVER_INTERRUPT;

/// Why the chip was reset; clears the flags (RM0394, RCC_CSR). There is no flag for a supply that was switched on: it is a brown-out.
pub(super) fn reset_cause() -> ResetCause {
    let csr = pac::RCC.csr().read();
    pac::RCC.csr().modify(|w| w.set_rmvf(true));
    if csr.iwdgrstf() {
        ResetCause::Watchdog
    } else if csr.borrstf() {
        ResetCause::PowerOn
    } else if csr.sftrstf() {
        ResetCause::Software
    } else {
        ResetCause::Pin
    }
}

/// What the processor's clock is made from.
pub(super) fn clock_source() -> Clock {
    Clock::Internal
}
