//! Pages 8 to 31 of the flash as the settings' store wants them.
//!
//! A double word is programmed in 91 us at most, a page erased in 24.5 ms at most (DS12469, flash memory characteristics); the
//! processor, which fetches its instructions from the only bank, stands meanwhile. Between two pages interrupts are handled, so the time
//! driver, whose half-periods are 32.8 ms, misses none.
//!
//! The flash can be written as long as the chip runs, so the supply is not asked.

use super::super::{last_resort::die, start};
use crate::{
    double_words::{DOUBLE_WORD, DoubleWords, PAGE, Sectors as Adapter},
    last_words::Draft,
};
use core::{
    ptr::with_exposed_provenance,
    sync::atomic::{AtomicBool, Ordering},
};
use embassy_stm32::{
    Peri,
    flash::{Bank1Region, Blocking, Error, FLASH_BASE, Flash},
    pac, peripherals,
};

/// A double word of the settings is being read. Set by [`Pages`], read by the NMI.
static READING: AtomicBool = AtomicBool::new(false);
/// Its check code did not fit. Set by the NMI, read by [`Pages`].
static UNREADABLE: AtomicBool = AtomicBool::new(false);

/// The settings' sectors of this chip.
pub type Sectors = Adapter<Pages>;

/// The pages below them.
pub struct Pages(Bank1Region<'static, Blocking>);

impl Sectors {
    /// Those of this chip.
    pub fn new(flash: Peri<'static, peripherals::FLASH>) -> Self {
        // The data cache, which is on after a reset, would show what was there before an erasure (RM0394, FLASH_ACR).
        pac::FLASH.acr().modify(|w| w.set_dcen(false));
        Adapter(Pages(
            Flash::new_blocking(flash)
                .into_blocking_regions()
                .bank1_region,
        ))
    }
}

impl DoubleWords for Pages {
    type Error = Error;

    fn read(&mut self, offset: u32) -> Option<[u8; DOUBLE_WORD]> {
        let address = FLASH_BASE + offset as usize;
        let (bytes, corrected) = cortex_m::interrupt::free(|_| {
            pac::FLASH.eccr().write(|w| w.set_eccc(true)); // forgets an older correction
            UNREADABLE.store(false, Ordering::SeqCst);
            READING.store(true, Ordering::SeqCst);
            // SAFETY: the store asks for aligned double words within its sectors, which can always be read.
            let word = unsafe { with_exposed_provenance::<u64>(address).read_volatile() };
            // An NMI comes before this ends.
            cortex_m::asm::dsb();
            cortex_m::asm::isb();
            READING.store(false, Ordering::SeqCst);
            (word.to_le_bytes(), pac::FLASH.eccr().read().eccc())
        });
        let blank_by_correction = corrected && bytes == [0xFF; DOUBLE_WORD];
        let readable = !UNREADABLE.load(Ordering::SeqCst) && !blank_by_correction;
        readable.then_some(bytes)
    }

    fn program(&mut self, offset: u32, bytes: [u8; DOUBLE_WORD]) -> Result<(), Error> {
        self.0.blocking_write(offset, &bytes)
    }

    fn erase(&mut self, page: u32) -> Result<(), Error> {
        // No task runs while the pages of a sector are erased.
        start::feed();
        let erased = self.0.blocking_erase(page, page + PAGE);
        start::feed();
        erased
    }
}

/// What the NMI asks: whether it came from a double word of the settings, which a cut of the power may leave unreadable. Then all is
/// well, and its flag is cleared (ECCD of FLASH_ECCR, RM0394).
pub fn explains_the_nmi() -> bool {
    if !pac::FLASH.eccr().read().eccd() {
        return false;
    }
    pac::FLASH.eccr().write(|w| w.set_eccd(true));
    let reading = READING.load(Ordering::SeqCst);
    UNREADABLE.store(reading, Ordering::SeqCst);
    reading
}

/// Code or constants are damaged. The outputs are off.
pub fn die_of_a_damaged_image() -> ! {
    die(&Draft::new("the image in flash is damaged: flash it again"))
}
