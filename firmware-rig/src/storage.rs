//! Settings in flash, sectors 1 to 3: one record per value, written only while nothing moves.
//!
//! A write keeps the processor from fetching instructions for 16 us, an erasure for up to 500 ms (DS9716 table 45).
//! A cut of the power at any instant leaves the old value or the new one (`sequential-storage`).

use core::ops::Range;
use embassy_futures::block_on;
use embassy_stm32::flash::{Bank1Region1, Blocking, Error};
use embedded_storage::nor_flash::{NorFlash as _, ReadNorFlash as _};
use embedded_storage_async::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
use sequential_storage::{
    cache::{Cache, Uncached},
    map::{MapConfig, MapStorage},
};

/// Offsets in flash, as in `memory.x`.
const SECTORS: Range<u32> = 0x4000..0x1_0000;
/// The longest record, its key included, in whole words.
pub const RECORD: usize = 32;

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
        self.0.erase(from, to)
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        self.0.write(offset, bytes)
    }
}

/// The records.
pub struct Store {
    map: MapStorage<u8, Flash, Cache<Uncached, Uncached, Uncached, u8>>,
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
                Cache::new_uncached(),
            ),
        }
    }

    /// The content of a record, if there is one.
    ///
    /// # Errors
    /// The sectors cannot be read as records.
    pub fn load<'a>(
        &mut self,
        number: u8,
        buffer: &'a mut [u8; RECORD],
    ) -> Result<Option<&'a [u8]>, Failed> {
        block_on(self.map.fetch_item(buffer, &number)).map_err(|_| Failed)
    }

    /// Writes a record. Stops the processor for up to a second: only while nothing moves.
    ///
    /// # Errors
    /// The record is not written; the old one counts.
    pub fn save(&mut self, key: u8, content: &[u8]) -> Result<(), Failed> {
        let mut buffer = [0; RECORD];
        block_on(self.map.store_item(&mut buffer, &key, &content)).map_err(|_| Failed)
    }
}
