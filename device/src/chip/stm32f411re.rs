//! The STM32F411: its memory, time base, reset cause and clock source.

pub mod clock;
pub mod flash;
pub mod serial;
pub mod supply;

use core::ops::Range;
use embassy_stm32::{interrupt, pac};
use protocol::system::{Clock, ResetCause};

/// The RAM.
pub(super) const RAM: Range<u32> = 0x2000_0000..0x2002_0000;

/// The timer of the HAL's time driver (a feature of the HAL in this package's manifest), and its interrupt.
pub(super) const TIME_DRIVER: pac::timer::TimGp16 = pac::TIM4;
pub(super) use interrupt::TIM4 as TIME_DRIVER_INTERRUPT;

/// Why the chip was reset; clears the flags (RCC_CSR, RM0383 section 6.3).
pub(super) fn reset_cause() -> ResetCause {
    let csr = pac::RCC.csr().read();
    pac::RCC.csr().modify(|w| w.set_rmvf(true));
    if csr.wdgrstf() {
        ResetCause::Watchdog
    } else if csr.porrstf() || csr.borrstf() {
        ResetCause::PowerOn
    } else if csr.sftrstf() {
        ResetCause::Software
    } else {
        ResetCause::Pin
    }
}

/// Source of the processor's clock.
pub(super) fn clock_source() -> Clock {
    let external = pac::RCC.pllcfgr().read().pllsrc() == pac::rcc::vals::Pllsrc::HSE;
    if external && pac::RCC.cr().read().hserdy() {
        Clock::External
    } else {
        Clock::Internal
    }
}
