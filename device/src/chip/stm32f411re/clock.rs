//! The external clock: waits for it, starts without it, and handles its failure.

use super::super::{
    retained::Ram,
    start::{WATCHDOG_US, feed, init_clearing_stale_flags},
};
use crate::retained::{Retained, keep_clock_failed, pass_on};
use embassy_stm32::{Config, pac};
use embassy_sync::once_lock::OnceLock;
use protocol::system::ResetCause;

/// Longest wait for the external clock before the link is served without it, ms. An ST-LINK powered from its USB has
/// started by then; with an external supply it may take seconds.
const CLOCK_MS: u32 = 300;
/// The oscillator that runs after a reset, kHz.
const RESET_KHZ: u32 = 16_000;

/// Data of the previous start, and the cause of this one.
static PREVIOUS: OnceLock<(Retained, ResetCause)> = OnceLock::new();

/// Notes the data that the next start takes over if the clock stops before this one has moved anything. Call it first.
pub fn note(previous: &Retained, cause: ResetCause) {
    let _ = PREVIOUS.init((previous.clone(), cause));
}

/// Starts the watchdog, then the HAL with `external` clocks, or with `internal` ones if the external clock does not
/// start. It stays switched on, and [`external_clock_has_come`] is true once it runs. If it stops later, it breaks
/// TIM1, which ends all pulses, and raises the NMI (RM0383 section 6.2.7).
///
/// The HAL alone would wait for the external clock for ever, and without a watchdog.
pub fn init_with_either_clock(external: Config, internal: Config) -> embassy_stm32::Peripherals {
    start_watchdog();
    let comes = external_clock_comes();
    // Enable the clock security before the HAL waits for the clock.
    pac::RCC.cr().modify(|w| w.set_csson(comes));
    let peripherals = init_clearing_stale_flags(if comes { external } else { internal });
    // The HAL switches off what it does not use.
    pac::RCC.cr().modify(|w| w.set_hseon(true));
    peripherals
}

/// Starts the watchdog with the timeout that [`super::super::start::watchdog`] will set. Prescaler and reload value
/// are accepted only while its clock runs, so it is started first (RM0383 chapter 15).
fn start_watchdog() {
    use pac::iwdg::vals::{Key, Pr};
    let key = |key| pac::IWDG.kr().write(|w| w.set_key(key));
    key(Key::START);
    key(Key::ENABLE);
    pac::IWDG.pr().write(|w| w.set_pr(Pr::DIVIDE_BY8));
    // 32 kHz / 8 = 4 ticks per millisecond.
    pac::IWDG
        .rlr()
        .write(|w| w.set_rl((WATCHDOG_US / 250 - 1) as u16));
    // Takes five cycles of the watchdog's clock; wait a millisecond at most.
    let taken = |_| {
        let status = pac::IWDG.sr().read();
        !status.pvu() && !status.rvu()
    };
    let _ = (0..RESET_KHZ / 10).any(taken);
    feed();
}

/// Switches the external clock on and waits up to `CLOCK_MS` for it.
fn external_clock_comes() -> bool {
    pac::RCC.cr().modify(|w| w.set_hsebyp(true));
    pac::RCC.cr().modify(|w| w.set_hseon(true));
    (0..CLOCK_MS).any(|_| {
        cortex_m::asm::delay(RESET_KHZ);
        feed();
        external_clock_has_come()
    })
}

/// The external clock runs.
pub fn external_clock_has_come() -> bool {
    pac::RCC.cr().read().hserdy()
}

/// Resets, now that the external clock runs. The next start takes over the data of this one.
pub fn restart(previous: &Retained, cause: ResetCause) -> ! {
    pass_on(&mut Ram, previous, cause);
    cortex_m::peripheral::SCB::sys_reset()
}

/// Resets after a stop of the external clock. The outputs are off already, and the chip runs on its own oscillator. If
/// nothing `has_moved`, the position is not lost, and the next start only replaces this one.
pub fn reset_after_clock_failure(has_moved: bool) -> ! {
    match PREVIOUS.try_get().filter(|_| !has_moved) {
        Some((previous, cause)) => pass_on(&mut Ram, previous, *cause),
        None => keep_clock_failed(&mut Ram),
    }
    // Clear the flag, or the NMI repeats at once.
    pac::RCC.cir().modify(|w| w.set_cssc(true));
    cortex_m::peripheral::SCB::sys_reset()
}
