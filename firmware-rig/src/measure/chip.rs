//! The chip's identity and option bytes, its stack guard, and its clocks compared with each other.

#![allow(unsafe_code)]

use super::{MS, cycles_since, log_value};
use crate::board::channels::ENABLE_HIGH_AT_START;
use core::{arch::asm, sync::atomic::Ordering};
use cortex_m::peripheral::{DWT, SCB};
use device::chip::{start, supply};
use embassy_stm32::pac::{self, TIM5, timer::vals::CcmrInputCcs};
use measurements::Measurement as M;

/// Below it nothing is mapped (RM0383 section 2.3).
const RAM_BEGINS: usize = 0x2000_0000;

/// TIM5_OR: connects an oscillator to channel 4, to measure it against the core's clock (RM0383 section 6.2.11).
const TIM5_OPTIONS: *mut u32 = 0x4000_0C50 as *mut u32;
/// Value of TIM5_OR that connects LSI to channel 4: TI4_RMP = 01.
const LSI_TO_CHANNEL_4: u32 = 1 << 6;

/// Time from HSEON to HSERDY. A clock that takes longer than the firmware waits gives more than 300 ms.
///
/// Call it before the HAL's start, while the core runs at 16 MHz.
pub fn external_clock_start_us() -> u32 {
    const CYCLES_PER_US: u32 = 16;
    const LONGEST: u32 = 301_000 * CYCLES_PER_US;
    pac::RCC.cr().modify(|w| w.set_hsebyp(true));
    let began = DWT::cycle_count();
    pac::RCC.cr().modify(|w| w.set_hseon(true));
    while !pac::RCC.cr().read().hserdy() && cycles_since(began) < LONGEST {}
    let took = cycles_since(began);
    // The start that follows switches the clock on again.
    pac::RCC.cr().modify(|w| w.set_hseon(false));
    took / CYCLES_PER_US
}

/// Reports the chip's identity and option bytes, EN at the reset, and the start time of the clock.
pub fn report(clock_us: u32) {
    let mut words = start::uid().into_iter();
    for number in [M::UniqueNumber0, M::UniqueNumber1, M::UniqueNumber2] {
        let word = [(); 4].map(|()| words.next().unwrap_or(0));
        log_value(number, u32::from_le_bytes(word));
    }
    log_value(M::ChipRevision, pac::DBGMCU.idcode().read().0);
    let high = ENABLE_HIGH_AT_START.load(Ordering::Relaxed);
    log_value(M::EnableAtReset, high.into());
    log_value(M::ExternalClockStart, clock_us);
    let options = supply::option_bytes();
    log_value(M::OptionBytes, options);
    log_value(M::BrownOutBits, options >> 2 & 3);
    log_value(M::WatchdogBySoftware, options >> 5 & 1);
}

/// Stores below the RAM, where an overflowing stack would. The processor ignores the bus fault and keeps its flag:
/// BFHFNMIGN with FAULTMASK (Armv7-M ARM B3.2.8).
pub fn report_guard() {
    const IGNORED: u32 = 1 << 8;
    // SAFETY: registers of the processor that nothing else uses at that time; there is no memory at the address.
    let faults = unsafe {
        let scb = &*SCB::PTR;
        scb.ccr.modify(|ccr| ccr | IGNORED);
        asm!("cpsid f");
        (RAM_BEGINS as *mut u32).wrapping_sub(1).write_volatile(0);
        asm!("dsb", "cpsie f");
        scb.ccr.modify(|ccr| ccr & !IGNORED);
        let faults = scb.cfsr.read();
        scb.cfsr.write(faults);
        faults
    };
    // PRECISERR, IMPRECISERR.
    log_value(M::StackGuard, u32::from(faults >> 9 & 3 != 0));
}

/// Reports TIM5's and the watchdog's clock against the core's. TIM5 counts.
pub fn report_clocks() {
    let (began, from) = (DWT::cycle_count(), TIM5.cnt().read());
    while cycles_since(began) < 1_000_000 {}
    log_value(M::TimerTicks, TIM5.cnt().read().wrapping_sub(from));

    // Capture every eighth edge of LSI.
    // SAFETY: an existing register that nothing else uses.
    unsafe { TIM5_OPTIONS.write_volatile(LSI_TO_CHANNEL_4) };
    TIM5.ccmr_input(1).modify(|w| {
        w.set_ccs(1, CcmrInputCcs::TI4);
        w.set_icpsc(1, 3);
    });
    TIM5.ccer().modify(|w| w.set_cce(3, true));
    if let (Some(_), Some(first), Some(second)) = (captured(), captured(), captured()) {
        let ticks = second.wrapping_sub(first);
        log_value(M::WatchdogClock, 8 * 100_000_000 / ticks.max(1));
    }
    TIM5.ccer().modify(|w| w.set_cce(3, false));
}

/// The next instant captured on channel 4; none within 2 ms.
fn captured() -> Option<u32> {
    let began = DWT::cycle_count();
    while cycles_since(began) < 2 * MS {
        if TIM5.sr().read().ccif(3) {
            return Some(TIM5.ccr(3).read());
        }
    }
    None
}
