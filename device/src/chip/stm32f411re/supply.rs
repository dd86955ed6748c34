//! The chip's supply, and its option bytes.

pub use crate::option_bytes::brown_out;
use embassy_stm32::pac;

/// PLS level of the voltage detector. It is the only one that guarantees 2.7 V: it trips at 2.77 to 2.89 V on the way
/// down (DS10314 table 19). Level 4 starts at 2.59 V.
const LEVEL: u8 = 5;

/// Switches the voltage detector on (PVD, RM0383 section 5.4.1). It raises no interrupt; it is polled.
pub fn watch() {
    pac::PWR.cr1().modify(|w| {
        w.set_pls(LEVEL);
        w.set_pvde(true);
    });
}

/// The supply is below 2.7 V, the minimum for writing words to flash (DS10314 table 45). Call [`watch`] before.
pub fn is_low() -> bool {
    pac::PWR.csr1().read().pvdo()
}

/// The option bytes in force since the start (FLASH_OPTCR, RM0383 section 3.8.6).
pub fn option_bytes() -> u32 {
    pac::FLASH.optcr().read().0
}
