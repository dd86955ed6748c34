//! The chip's supply, and what its option bytes do about it.

pub use crate::option_bytes::stm32l4_brown_out as brown_out;
use embassy_stm32::{pac, pac::pwr::vals::Pls};

/// The level around 2.9 V (RM0394, PWR_CR2): the one above the 2.7 V of which the link speaks. This chip's flash does not need them.
const LEVEL: Pls = Pls::V2_9;

/// Switches the voltage detector on. It interrupts nobody; it is asked.
pub fn watch() {
    pac::RCC.apb1enr1().modify(|w| w.set_pwren(true));
    pac::PWR.cr2().modify(|w| {
        w.set_pls(LEVEL);
        w.set_pvde(true);
    });
}

/// The supply may be below 2.7 V. Needs [`watch`] before.
pub fn is_low() -> bool {
    pac::PWR.sr2().read().pvdo()
}

/// The option bytes as they have been in force since the start (FLASH_OPTR, RM0394).
pub fn option_bytes() -> u32 {
    pac::FLASH.optr().read().0
}
