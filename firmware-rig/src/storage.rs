//! Settings in flash, sectors 1 to 3: one record per value, written only while nothing moves.
//!
//! A write keeps the processor from fetching instructions for 16 us typically, an erasure for up to 500 ms (STM32F411
//! datasheet, flash memory programming; x32).
//! A cut of the power at any instant leaves the old value or the new one (`sequential-storage`).

use core::ops::Range;
use embassy_futures::block_on;
use embassy_stm32::{
    flash::{Bank1Region1, Blocking, Error},
    pac,
};
use embedded_storage::nor_flash::{NorFlash as _, ReadNorFlash as _};
use embedded_storage_async::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
use protocol::settings::SettingKey;
use sequential_storage::{
    cache::{Cache, Uncached, key_pointers::ArrayKeyPointers},
    map::{MapConfig, MapStorage},
};

/// Offsets in flash, as in `memory.x`.
const SECTORS: Range<u32> = 0x4000..0x1_0000;
/// The longest record, its key included, in whole words.
const RECORD: usize = 32;
/// Number of the record that mending writes; it means nothing.
const MENDED_RECORD: u8 = 0xF1;

/// The blocking driver of the first four sectors as an asynchronous one that never waits.
struct Flash(Bank1Region1<'static, Blocking>);

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
    const ERASE_SIZE: usize = 16 * 1024;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Error> {
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
        self.0.erase(from, to)
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        self.0.write(offset, bytes)
    }
}

/// Where each record lies. Without it, making room in a full sector searches both others for each of its eight
/// hundred records: six seconds, in which the watchdog bites.
type Pointers = Cache<Uncached, Uncached, ArrayKeyPointers<u8, KEYS>, u8>;
/// Settings, the name, and the one that mending writes.
const KEYS: usize = SettingKey::ALL.len() + 2;

/// The records.
pub struct Store {
    map: MapStorage<u8, Flash, Pointers>,
}

/// The flash refused to be written or is worn out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Failed;

impl Store {
    /// The store of this chip; one exists.
    pub fn new(sectors: Bank1Region1<'static, Blocking>) -> Self {
        Self {
            map: MapStorage::new(
                Flash(sectors),
                const { MapConfig::new(SECTORS) },
                Cache::new(Uncached, Uncached, ArrayKeyPointers::new()),
            ),
        }
    }

    /// Calls `record` with key and content of every record, older ones first: the last of a key counts.
    ///
    /// # Errors
    /// The sectors cannot be read as records; what was read before stands.
    pub fn load(&mut self, mut record: impl FnMut(u8, &[u8])) -> Result<(), Failed> {
        self.read(&mut record).or_else(|Failed| {
            // An erasure was cut off: writing mends that, reading everything does not (sequential-storage 8.0.2).
            self.save(MENDED_RECORD, &[])?;
            self.read(&mut record)
        })
    }

    #[inline(never)]
    fn read(&mut self, record: &mut dyn FnMut(u8, &[u8])) -> Result<(), Failed> {
        let mut buffer = [0; RECORD];
        let read = async {
            let mut records = self.map.fetch_all_items(&mut buffer).await?;
            while let Some((key, content)) = records.next::<&[u8]>(&mut buffer).await? {
                record(key, content);
            }
            Ok(())
        };
        block_on(read).map_err(|_: sequential_storage::Error<Error>| Failed)
    }

    /// Writes a record. Stops the processor for up to a second: only while nothing moves.
    ///
    /// # Errors
    /// The record is not written; the old one counts.
    #[inline(never)]
    pub fn save(&mut self, key: u8, content: &[u8]) -> Result<(), Failed> {
        let mut buffer = [0; RECORD];
        block_on(self.map.store_item(&mut buffer, &key, &content)).map_err(|_| Failed)
    }
}
