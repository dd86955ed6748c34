//! Sectors 0 to 3 of the flash, for the settings' store. The interface is asynchronous but never waits.
//!
//! A write keeps the processor from fetching instructions for 16 us typically, an erasure for up to 500 ms (STM32F411
//! datasheet, flash memory programming; x32).
//!
//! Below 2.7 V, writing and erasing by words (x32) are not allowed: cells could read differently each time. Both are
//! refused below that voltage. An operation that has begun continues.

use super::{super::start, TIME_DRIVER, supply};
use crate::{
    half_periods::{self, Timers},
    store::{SECTOR, SECTORS},
};
use embassy_stm32::{
    Peri,
    flash::{Bank1Region1, Blocking, Error, Flash},
    pac, peripherals, rcc,
};
use embedded_storage::nor_flash::{NorFlash as _, ReadNorFlash as _};
use embedded_storage_async::nor_flash::{ErrorType, NorFlash, ReadNorFlash};

/// The four sectors of 16 KiB, 0 to 3; sector 0 holds the image's start.
pub struct Sectors(Bank1Region1<'static, Blocking>);

impl Sectors {
    /// Takes the sectors of this chip.
    pub fn new(flash: Peri<'static, peripherals::FLASH>) -> Self {
        supply::watch();
        Self(
            Flash::new_blocking(flash)
                .into_blocking_regions()
                .bank1_region1,
        )
    }
}

/// Refuses when the supply is too low to write whole words.
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
            // The driver leaves the parallelism at x8, where an erasure takes up to 800 ms instead of 500 ms.
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

/// Runs `stall`, which keeps the processor from counting time, and corrects the clock afterwards. TIM5 is the
/// stopwatch; if it counts already, its setting stays.
fn with_the_clock_kept<T>(stall: impl FnOnce() -> T) -> T {
    cortex_m::interrupt::free(|_| {
        let watch = pac::TIM5;
        let counts = pac::RCC.apb1enr().read().tim5en();
        pac::RCC.apb1enr().modify(|w| w.set_tim5en(true));
        start::await_enabled_clocks();
        if !counts {
            watch.cr1().modify(|w| w.set_cen(true));
        }
        let result = half_periods::keep_over(&HardwareTimers, stall);
        if !counts {
            watch.cr1().modify(|w| w.set_cen(false));
            pac::RCC.apb1enr().modify(|w| w.set_tim5en(false));
        }
        // Trigger the alarms that became due during the stall.
        TIME_DRIVER.egr().write(|w| w.set_ccg(1, true));
        HardwareTimers.handle();
        result
    })
}

unsafe extern "C" {
    /// The vector of the HAL's time driver.
    fn TIM4();
}

/// TIM4 of the time driver, and TIM5.
struct HardwareTimers;

impl Timers for HardwareTimers {
    fn flags(&self) -> u32 {
        let status = TIME_DRIVER.sr().read();
        u32::from(status.uif()) + u32::from(status.ccif(0))
    }

    fn count(&self) -> u16 {
        TIME_DRIVER.cnt().read().cnt()
    }

    fn stopwatch(&self) -> u32 {
        pac::TIM5.cnt().read()
    }

    fn stopwatch_ticks_per_us(&self) -> u32 {
        rcc::frequency::<peripherals::TIM5>().0 / 1_000_000
    }

    fn raise(&self) {
        TIME_DRIVER.egr().write(|w| w.set_ccg(0, true));
    }

    fn handle(&self) {
        // SAFETY: the driver's own handler; with interrupts off it cannot run at the same time from its vector.
        unsafe { TIM4() }
    }
}
