//! Sectors 0 to 3 of the flash as the settings' store wants them: asynchronous in form, never waiting in fact.
//!
//! A write keeps the processor from fetching instructions for 16 us typically, an erasure for up to 500 ms (STM32F411
//! datasheet, flash memory programming; x32).
//!
//! Below 2.7 V neither is allowed by words (x32). A start there leaves cells that read differently each time, so it is
//! refused; what has begun goes on.

use super::{
    start::{self, TIME_DRIVER},
    supply,
};
use crate::{
    half_periods,
    store::{SECTOR, SECTORS},
};
use embassy_stm32::{
    Peri,
    flash::{Bank1Region1, Blocking, Error, Flash},
    pac, peripherals, rcc,
};
use embedded_storage::nor_flash::{NorFlash as _, ReadNorFlash as _};
use embedded_storage_async::nor_flash::{ErrorType, NorFlash, ReadNorFlash};

/// Sectors 0 to 3.
pub struct Sectors(Bank1Region1<'static, Blocking>);

impl Sectors {
    /// Those of this chip.
    pub fn new(flash: Peri<'static, peripherals::FLASH>) -> Self {
        supply::watch();
        Self(
            Flash::new_blocking(flash)
                .into_blocking_regions()
                .bank1_region1,
        )
    }
}

/// Words are too many bits at once for a supply that is too low.
fn check_supply() -> Result<(), Error> {
    if supply::is_low() {
        defmt::warn!("the supply is below 2.7 V: nothing is stored");
        return Err(Error::Parallelism);
    }
    Ok(())
}

impl ErrorType for Sectors {
    type Error = Error;
}

impl ReadNorFlash for Sectors {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Error> {
        self.0.read(offset, bytes)
    }

    fn capacity(&self) -> usize {
        SECTORS.end as usize
    }
}

impl NorFlash for Sectors {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR as usize;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Error> {
        for sector in (from..to).step_by(SECTOR as usize) {
            check_supply()?;
            // No task runs during an erase.
            start::feed();
            // The driver leaves the parallelism at x8, with which an erasure takes up to 800 ms instead of 500 ms.
            pac::FLASH.keyr().write_value(0x4567_0123);
            pac::FLASH.keyr().write_value(0xCDEF_89AB);
            pac::FLASH
                .cr()
                .modify(|w| w.set_psize(pac::flash::vals::Psize::PSIZE32));
            let erased = with_the_clock_kept(|| self.0.erase(sector, sector + SECTOR));
            start::feed();
            erased?;
        }
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        check_supply()?;
        self.0.write(offset, bytes)
    }
}

/// Does what keeps the processor from counting time, and tells the time driver afterwards how much has passed.
///
/// The driver counts half-periods of its 16-bit timer, 32.768 ms each, from one flag for each half. A longer stall loses some,
/// and after an odd number of them its clock would run backwards 30 times a second. TIM5, which has 32 bits, says how long
/// it was. A timer that counts already goes on as it is.
fn with_the_clock_kept<T>(stall: impl FnOnce() -> T) -> T {
    cortex_m::interrupt::free(|_| {
        let watch = pac::TIM5;
        let counts = pac::RCC.apb1enr().read().tim5en();
        pac::RCC.apb1enr().modify(|w| w.set_tim5en(true));
        let _ = pac::RCC.apb1enr().read();
        if !counts {
            watch.cr1().modify(|w| w.set_cen(true));
        }
        let (flags, from) = flags_and_count();
        let watch_from = watch.cnt().read();
        let result = stall();
        wait_for_no_flag_to_come();
        let watch_passed = watch.cnt().read().wrapping_sub(watch_from);
        let (left, to) = flags_and_count();
        if !counts {
            watch.cr1().modify(|w| w.set_cen(false));
            pac::RCC.apb1enr().modify(|w| w.set_tim5en(false));
        }
        let ticks_per_us = rcc::frequency::<peripherals::TIM5>().0 / 1_000_000;
        let passed_us = half_periods::passed_us(from, to, watch_passed / ticks_per_us);
        // SAFETY: the driver's own handler; with interrupts off it cannot run at the same time from its vector.
        let handle = || unsafe { TIM4() };
        handle();
        for _ in 0..half_periods::lost(from, passed_us, flags, left) {
            TIME_DRIVER.egr().write(|w| w.set_ccg(0, true));
            handle();
        }
        // Alarms that became due meanwhile.
        TIME_DRIVER.egr().write(|w| w.set_ccg(1, true));
        handle();
        result
    })
}

unsafe extern "C" {
    /// The vector of the HAL's time driver.
    fn TIM4();
}

/// The handlers below take far less than this.
const HANDLING_US: u16 = 1_000;

/// Waits over the end of a half-period if it is near: one that began between the look at the flags and the handlers would be
/// counted by nobody, since its flag stands already.
fn wait_for_no_flag_to_come() {
    let left_us = || half_periods::left_us(TIME_DRIVER.cnt().read().cnt());
    while left_us() < HANDLING_US {}
}

/// Flags of half-periods that the driver has not counted yet, and the count that goes with them.
fn flags_and_count() -> (u32, u16) {
    loop {
        let flags = || {
            let status = TIME_DRIVER.sr().read();
            u32::from(status.uif()) + u32::from(status.ccif(0))
        };
        let (before, count) = (flags(), TIME_DRIVER.cnt().read().cnt());
        if flags() == before {
            return (before, count);
        }
    }
}
