//! Settings in flash, sectors 1 to 3: one record per value, written only while nothing moves.
//!
//! A write keeps the processor from fetching instructions for 16 us typically, an erasure for up to 500 ms (STM32F411
//! datasheet, flash memory programming; x32).
//! A cut of the power at any instant leaves the old value or the new one (`sequential-storage`). Its queue is used,
//! not its map: on a full sector the map searches all records for each of them, six seconds in which the watchdog
//! bites, and its answer to that, a cache, and the map itself take 6 KB more flash. A full queue drops its oldest
//! sector, so what is still needed is written again long before.

use core::ops::Range;
use embassy_futures::block_on;
use embassy_stm32::{
    flash::{Bank1Region1, Blocking, Error},
    pac,
};
use embedded_storage::nor_flash::{NorFlash as _, ReadNorFlash as _};
use embedded_storage_async::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
use firmware_rig::settings::Ages;
use sequential_storage::{
    cache::{Cache, Uncached},
    queue::{QueueConfig, QueueStorage},
};

/// Offsets in flash, as in `memory.x`.
const SECTORS: Range<u32> = 0x4000..0x1_0000;
/// Bytes of each.
const SECTOR: u32 = 16 * 1024;
/// The longest record, its number included, in whole words.
const RECORD: usize = 28;
/// At least so many records fit into a sector: each has 8 bytes of head, the sector two marks of a word.
const IN_A_SECTOR: u32 = (SECTOR - 8) / (RECORD as u32 + 8);
const _: () = assert!(Ages::OLDEST + Ages::NUMBERS as u32 <= IN_A_SECTOR);

/// The blocking driver of the first four sectors as an asynchronous one that never waits.
struct Flash(Bank1Region1<'static, Blocking>);

impl Flash {
    fn is_blank(&mut self, sector: u32) -> Result<bool, Error> {
        let mut word = [0; 4];
        for offset in (sector..sector + SECTOR).step_by(word.len()) {
            self.0.read(offset, &mut word)?;
            if word != [0xFF; 4] {
                return Ok(false);
            }
        }
        Ok(true)
    }
}

impl ErrorType for Flash {
    type Error = Error;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Error> {
        self.0.read(offset, bytes)
    }

    fn capacity(&self) -> usize {
        SECTORS.end as usize
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR as usize;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Error> {
        for sector in (from..to).step_by(SECTOR as usize) {
            // Nobody else can for as long as it takes.
            pac::IWDG
                .kr()
                .write(|w| w.set_key(pac::iwdg::vals::Key::RESET));
            // The driver leaves the parallelism at x8, with which an erasure takes up to 800 ms instead of 500 ms.
            pac::FLASH.keyr().write_value(0x4567_0123);
            pac::FLASH.keyr().write_value(0xCDEF_89AB);
            pac::FLASH
                .cr()
                .modify(|w| w.set_psize(pac::flash::vals::Psize::PSIZE32));
            self.0.erase(sector, sector + SECTOR)?;
        }
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        // The first word of a sector is written when it comes into use. An erasure that was cut off may have left
        // both of the words by which the log knows a blank sector, and not what lies between.
        if offset.is_multiple_of(SECTOR) && !self.is_blank(offset)? {
            self.erase(offset, offset + SECTOR).await?;
        }
        self.0.write(offset, bytes)
    }
}

/// The settings' log: a record is a number and its content, the last one of a number counts.
pub struct Store {
    log: QueueStorage<Flash, Cache<Uncached, Uncached, Uncached>>,
    ages: Ages,
}

/// The flash refused to be written or is worn out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Failed;

impl From<sequential_storage::Error<Error>> for Failed {
    fn from(_: sequential_storage::Error<Error>) -> Self {
        Self
    }
}

impl Store {
    /// The store of this chip; one exists.
    pub fn new(sectors: Bank1Region1<'static, Blocking>) -> Self {
        Self {
            log: QueueStorage::new(
                Flash(sectors),
                const { QueueConfig::new(SECTORS) },
                Cache::new_uncached(),
            ),
            ages: Ages::new(),
        }
    }

    /// Calls `record` with number and content of every record, older ones first.
    ///
    /// # Errors
    /// The sectors cannot be read as records; what was read before stands.
    pub fn load(&mut self, mut record: impl FnMut(u8, &[u8])) -> Result<(), Failed> {
        let mut buffer = [0; RECORD];
        block_on(async {
            let mut records = self.log.iter().await?;
            while let Some(entry) = records.next(&mut buffer).await? {
                if let [number, content @ ..] = &*entry {
                    self.ages.wrote(*number);
                    record(*number, content);
                }
            }
            Ok(())
        })
    }

    /// Writes a record. Stops the processor for up to a second: only while nothing moves.
    /// [`Store::overdue`] has to be asked after each.
    ///
    /// # Errors
    /// The record is not written; the old one counts.
    pub fn save(&mut self, number: u8, content: &[u8]) -> Result<(), Failed> {
        let mut record = heapless::Vec::<u8, RECORD>::new();
        let fits = record.push(number).is_ok() && record.extend_from_slice(content).is_ok();
        if !fits {
            return Err(Failed);
        }
        block_on(self.log.push(&record, true))?;
        self.ages.wrote(number);
        Ok(())
    }

    /// Erases everything. Only where nothing can be read or written any more: a cut of the power in between could
    /// bring older values back.
    ///
    /// # Errors
    /// The flash is worn out.
    pub fn erase(&mut self) -> Result<(), Failed> {
        block_on(self.log.erase_all())?;
        self.ages = Ages::new();
        Ok(())
    }

    /// Number of a record that has to be written again before others.
    pub fn overdue(&self) -> Option<u8> {
        self.ages.overdue()
    }
}
