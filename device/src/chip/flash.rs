//! Sectors 0 to 3 of the flash as the settings' store wants them: asynchronous in form, never waiting in fact.
//!
//! A write keeps the processor from fetching instructions for 16 us typically, an erasure for up to 500 ms (STM32F411
//! datasheet, flash memory programming; x32).
//!
//! Below 2.7 V neither is allowed by words (x32). A start there leaves cells that read differently each time, so it is
//! refused; what has begun goes on.

use super::{start, supply};
use crate::{
    half_periods,
    store::{SECTOR, SECTORS},
};
use embassy_stm32::{
    Peri,
    flash::{Bank1Region1, Blocking, Error, Flash},
    pac, peripherals,
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
/// and after an odd number of them its clock would run backwards 30 times a second. TIM4, which counts slowly enough,
/// says how long it was.
fn with_the_clock_kept<T>(stall: impl FnOnce() -> T) -> T {
    cortex_m::interrupt::free(|_| {
        pac::RCC.apb1enr().modify(|w| w.set_tim4en(true));
        let _ = pac::RCC.apb1enr().read();
        let coarse = pac::TIM4;
        // The prescaler is taken with an update. Timer clock 100 MHz / 50,000: 2 kHz, up to 32 s.
        coarse.psc().write_value(COARSE_DIVIDER - 1);
        coarse.egr().write(|w| w.set_ug(true));
        coarse.cr1().modify(|w| w.set_cen(true));
        let (flags, from) = flags_and_count();
        let coarse_from = coarse.cnt().read().cnt();
        let result = stall();
        let coarse_passed = coarse.cnt().read().cnt().wrapping_sub(coarse_from);
        let (left, to) = flags_and_count();
        coarse.cr1().modify(|w| w.set_cen(false));
        pac::RCC.apb1enr().modify(|w| w.set_tim4en(false));
        let passed_us = half_periods::passed_us(from, to, u32::from(coarse_passed) * COARSE_US);
        // SAFETY: the driver's own handler; with interrupts off it cannot run at the same time from its vector.
        let handle = || unsafe { TIM5() };
        handle();
        for _ in 0..half_periods::lost(from, passed_us, flags, left) {
            pac::TIM5.egr().write(|w| w.set_ccg(0, true));
            handle();
        }
        // Alarms that became due meanwhile.
        pac::TIM5.egr().write(|w| w.set_ccg(1, true));
        handle();
        result
    })
}

/// TIM4's clock by its count, and the length of one.
const COARSE_DIVIDER: u16 = 50_000;
const COARSE_US: u32 = 500;

unsafe extern "C" {
    /// The vector of the HAL's time driver.
    fn TIM5();
}

/// Flags of half-periods that the driver has not counted yet, and the count that goes with them.
fn flags_and_count() -> (u32, u16) {
    loop {
        let flags = || {
            let status = pac::TIM5.sr().read();
            u32::from(status.uif()) + u32::from(status.ccif(0))
        };
        let (before, count) = (flags(), pac::TIM5.cnt().read() as u16);
        if flags() == before {
            return (before, count);
        }
    }
}
