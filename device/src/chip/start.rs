//! The start of any chip: time base, bus clocks, vector catches, reset cause, identity, watchdog.

use super::{
    stm32f411re::{self, TIME_DRIVER, TIME_DRIVER_INTERRUPT},
    supply,
};
use cortex_m::peripheral::DCB;
use embassy_stm32::{
    Config, Peri, interrupt::InterruptExt, pac, peripherals, wdg::IndependentWatchdog,
};
use protocol::system::{Chip, ResetCause};

/// Speed of the serial port, baud.
pub(super) const BAUD: u32 = 115_200;

/// Watchdog timeout. It must exceed the longest erasure of a settings sector, 500 ms, in which no task runs.
pub(super) const WATCHDOG_US: u32 = 800_000;

/// Starts the HAL, and clears the compare flag that its initialisation raises before the first interrupt can see it.
/// Otherwise the time driver would count it as half a period, 65 ms, and the clock could step back later.
pub fn init_clearing_stale_flags(config: Config) -> embassy_stm32::Peripherals {
    cortex_m::interrupt::free(|_| {
        let peripherals = embassy_stm32::init(config);
        TIME_DRIVER.sr().write_value(pac::timer::regs::SrGp16(0));
        TIME_DRIVER_INTERRUPT.unpend();
        peripherals
    })
}

/// Waits until clocks that were just enabled reach their peripherals: an access within two cycles of their bus may be
/// lost (ES0287 2.1.6, with this remedy; a read is too short on sister parts).
pub fn await_enabled_clocks() {
    cortex_m::asm::dsb();
}

/// Clears the vector catches that a debugger may have set: halts at resets and at processor faults (the VC bits of
/// DEMCR, which software may write; Armv7-M ARM C1.6.5). They outlive a reset, and the processor would halt with the
/// watchdog off. Only a debugger can change C_DEBUGEN, which enables them, so clear them at every start. Call it after
/// the HAL's start: the log needs its clock.
pub fn clear_vector_catches() {
    const CATCHES: u32 = 0x7F1;
    // SAFETY: the only user of this register; a read and a write without side effects.
    let catches = unsafe {
        let demcr = &(*DCB::PTR).demcr;
        let before = demcr.read();
        demcr.write(before & !CATCHES);
        before & CATCHES
    };
    if catches != 0 {
        defmt::warn!("cleared vector catches of a debugger: {=u32:#x}", catches);
    }
}

pub(super) fn feed() {
    pac::IWDG
        .kr()
        .write(|w| w.set_key(pac::iwdg::vals::Key::RESET));
}

/// Why the chip was reset. Call it once: it clears the flags.
pub fn reset_cause() -> ResetCause {
    stm32f411re::reset_cause()
}

/// Clock, supply and option bytes as they are now.
pub fn chip() -> Chip {
    let option_bytes = supply::option_bytes();
    Chip {
        clock: stm32f411re::clock_source(),
        brown_out: supply::brown_out(option_bytes),
        supply_low: supply::is_low(),
        option_bytes,
    }
}

/// The chip's unique number, 96 bits.
pub fn uid() -> [u8; 12] {
    embassy_stm32::uid::uid()
}

/// The watchdog, not yet started.
pub fn watchdog(
    iwdg: Peri<'static, peripherals::IWDG>,
) -> IndependentWatchdog<'static, peripherals::IWDG> {
    IndependentWatchdog::new(iwdg, WATCHDOG_US)
}
