//! The external clock: waits for it, does without it, and handles its stop.

use super::super::{
    retained::Ram,
    start::{WATCHDOG_US, feed, init_clearing_stale_flags},
};
use crate::retained::{Retained, keep_clock_failed, leave_again};
use embassy_stm32::{Config, pac};
use embassy_sync::once_lock::OnceLock;
use protocol::system::ResetCause;

/// Longest wait for the external clock before the link is served without it, ms. An ST-LINK powered from its USB has
/// started by then; with an external supply it may take seconds.
const CLOCK_MS: u32 = 300;
/// The oscillator that runs after a reset, kHz.
const RESET_KHZ: u32 = 16_000;

/// What the previous start left, and why this one began.
static LEFT: OnceLock<(Retained, ResetCause)> = OnceLock::new();

/// Notes what the next start has to find again if the clock stops while this one has moved nothing. Call it first.
pub fn note(left: &Retained, cause: ResetCause) {
    let _ = LEFT.init((left.clone(), cause));
}

/// Starts the watchdog, then the HAL with `external` clocks, or with `internal` ones if the external clock does not
/// start. It stays switched on, and [`external_clock_has_come`] tells when it starts later. A clock that stops later
/// breaks TIM1, which ends all pulses, and raises the NMI (RM0383 section 6.2.7).
///
/// The HAL alone would wait for the external clock for ever, and without a watchdog.
pub fn init_with_either_clock(external: Config, internal: Config) -> embassy_stm32::Peripherals {
    start_watchdog();
    let comes = external_clock_comes();
    // Before the HAL waits for the clock: a stop is noticed from here on.
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

/// Resets, now that the external clock runs. The next start reports the findings of this one.
pub fn start_again(left: &Retained, cause: ResetCause) -> ! {
    leave_again(&mut Ram, left, cause);
    cortex_m::peripheral::SCB::sys_reset()
}

/// Resets after a stop of the external clock. The outputs are off, and the chip runs on its own oscillator by now. If
/// nothing `has_moved`, nothing is lost, and the next start only replaces this one.
pub fn die_of_the_clock(has_moved: bool) -> ! {
    match LEFT.try_get().filter(|_| !has_moved) {
        Some((left, cause)) => leave_again(&mut Ram, left, *cause),
        None => keep_clock_failed(&mut Ram),
    }
    // Clear the flag, else the NMI comes again at once.
    pac::RCC.cir().modify(|w| w.set_cssc(true));
    cortex_m::peripheral::SCB::sys_reset()
}
