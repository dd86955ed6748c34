//! A log of numbered records in flash: the last record of a number is in force.
//!
//! A power cut at any instant leaves the old record or the new one. `sequential-storage` ensures this, with the repair
//! of interrupted erasures here. We use its queue, not its map. On a full sector the map searches all records for each
//! of them: six seconds, which the watchdog does not allow. The map and the cache that would remedy this take 6 KB more
//! flash. A full queue drops its oldest sector, so we rewrite a record that is still needed long before.

use core::ops::Range;
use embassy_futures::block_on;
use embedded_storage_async::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
use protocol::settings::SettingKey;
use sequential_storage::{
    cache::{Cache, Uncached, page_pointers::ArrayPagePointers},
    queue::{QueueConfig, QueueStorage},
};

/// Offsets of the log's sectors in flash, as in `memory.x`.
pub const SECTORS: Range<u32> = 0x4000..0x1_0000;
const SECTORS_END: u32 = SECTORS.end;
/// Size of a sector, bytes.
pub const SECTOR: u32 = 16 * 1024;
/// Number of the name's record; settings have theirs from 0.
pub const NAME_RECORD: u8 = 0xF0;
/// Number of the record after which all settings have their defaults. It holds the name. It needs no rewriting: the
/// records that it overrides are older, so the log drops them before it.
pub const DEFAULTS_RECORD: u8 = 0xF1;
/// Bytes read at a time when checking that a sector is blank. Word by word, the calls take 40 ms at 16 MHz, in which
/// no task runs.
const BLANK_CHECK: usize = 128;
const _: () = assert!((SECTOR as usize).is_multiple_of(BLANK_CHECK));
/// The longest record, its number included, in whole words.
const RECORD: usize = 28;
/// `RECORD` in whole write units; the largest unit is a double word.
const LONGEST_READ: usize = RECORD.next_multiple_of(8);
/// Length of the longest record in the log, with its head.
const LONGEST_IN_LOG: u32 = LONGEST_READ as u32 + 8;
/// Minimum records per sector for a given write size. Each record has 8 bytes of head, the sector two marks.
const fn in_a_sector(write_size: usize) -> u32 {
    (SECTOR - 2 * write_size as u32) / (RECORD.next_multiple_of(write_size) as u32 + 8)
}

/// Age of each number's last record, in records.
///
/// The log drops its oldest sector when it needs room. A record younger than a sector's worth of records is never in
/// that sector. So a record that becomes older than [`Ages::OLDEST`] is written again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ages {
    records: u32,
    /// Record count when each number was last written; 0 is never.
    last: [u32; Self::NUMBERS],
}

impl Ages {
    /// Settings and the name.
    pub const NUMBERS: usize = SettingKey::ALL.len() + 1;
    /// Age at which a record is written again, in records.
    pub const OLDEST: u32 = 256;

    /// The ages for an empty log.
    pub const fn new() -> Self {
        Self {
            records: 0,
            last: [0; Self::NUMBERS],
        }
    }

    /// Counts a record. The record of a number unknown to this firmware ages and is lost.
    pub fn wrote(&mut self, number: u8) {
        self.records += 1;
        let slot = match number {
            NAME_RECORD => Self::NUMBERS - 1,
            number if usize::from(number) < SettingKey::ALL.len() => usize::from(number),
            _ => return,
        };
        self.last[slot] = self.records;
    }

    /// A number whose last record is too old, if any.
    pub fn overdue(&self) -> Option<u8> {
        let too_old = |last: &u32| *last != 0 && self.records - last > Self::OLDEST;
        let slot = self.last.iter().position(too_old)?;
        Some(
            SettingKey::ALL
                .get(slot)
                .map_or(NAME_RECORD, |key| *key as u8),
        )
    }
}

impl Default for Ages {
    fn default() -> Self {
        Self::new()
    }
}

/// A flash that erases a sector again before its first use, unless it is blank to the last word.
#[derive(Debug)]
struct Checked<F> {
    flash: F,
    /// A sector whose erasure was interrupted and could not be repeated yet. It reads as blank, whatever it contains.
    half_erased: Option<u32>,
    /// Free bytes in the sector that was written last, behind the last byte written.
    room: u32,
}

impl<F: NorFlash> Checked<F> {
    async fn is_blank(&mut self, sector: u32) -> Result<bool, F::Error> {
        let mut block = [0; BLANK_CHECK];
        for offset in (sector..sector + SECTOR).step_by(block.len()) {
            self.flash.read(offset, &mut block).await?;
            if block.chunks_exact(4).any(|word| word != [0xFF; 4]) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Whether the log sees a mark at this offset: at least four bits are programmed.
    async fn is_marked(&mut self, offset: u32) -> Result<bool, F::Error> {
        let mut read = [0xFF; LONGEST_READ];
        let read = &mut read[..F::READ_SIZE];
        self.flash.read(offset, read).await?;
        let programmed: u32 = read.iter().map(|byte| byte.count_zeros()).sum();
        Ok(programmed >= 4)
    }

    /// Whether the log sees marks at the sector's beginning and end. The sector in use has one at its beginning only.
    async fn marks(&mut self, sector: u32) -> Result<(bool, bool), F::Error> {
        let end = sector + SECTOR - F::READ_SIZE as u32;
        Ok((self.is_marked(sector).await?, self.is_marked(end).await?))
    }

    async fn is_in_use(&mut self, sector: u32) -> Result<bool, F::Error> {
        Ok(self.marks(sector).await? == (true, false))
    }

    /// The sector behind the one in use, which the log erases next. After an interrupted erasure it may look like one
    /// in use too.
    async fn oldest(&mut self) -> Result<Option<u32>, F::Error> {
        let mut oldest = None;
        for sector in SECTORS.step_by(SECTOR as usize) {
            let behind = match sector + SECTOR {
                SECTORS_END => SECTORS.start,
                behind => behind,
            };
            if self.is_in_use(sector).await? && (oldest.is_none() || self.is_in_use(behind).await?)
            {
                oldest = Some(behind);
            }
        }
        Ok(oldest)
    }

    /// Erases the oldest sector if its marks show an interrupted erasure; with `even_whole`, also if it is full. Its
    /// records are obsolete: those still needed were written again long before (see [`Ages`]). If the erasure fails, as
    /// with a low supply, the sector is hidden until it succeeds. True if there was such a sector.
    async fn erase_oldest(&mut self, even_whole: bool) -> Result<bool, F::Error> {
        let Some(oldest) = self.oldest().await? else {
            return Ok(false);
        };
        let (begin, end) = self.marks(oldest).await?;
        if begin == end && !(begin && even_whole) {
            return Ok(false);
        }
        self.half_erased = Some(oldest);
        let _ = self.erase(oldest, oldest + SECTOR).await;
        Ok(true)
    }
}

impl<F: NorFlash> ErrorType for Checked<F> {
    type Error = F::Error;
}

impl<F: NorFlash> ReadNorFlash for Checked<F> {
    const READ_SIZE: usize = F::READ_SIZE;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), F::Error> {
        let hidden = |sector| (sector..sector + SECTOR).contains(&offset);
        if self.half_erased.is_some_and(hidden) {
            bytes.fill(0xFF);
            return Ok(());
        }
        self.flash.read(offset, bytes).await
    }

    fn capacity(&self) -> usize {
        self.flash.capacity()
    }
}

impl<F: NorFlash> NorFlash for Checked<F> {
    const WRITE_SIZE: usize = F::WRITE_SIZE;
    const ERASE_SIZE: usize = F::ERASE_SIZE;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), F::Error> {
        self.flash.erase(from, to).await?;
        self.half_erased = self
            .half_erased
            .filter(|sector| !(from..to).contains(sector));
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), F::Error> {
        // A sector comes into use when its first word is written. After an interrupted erasure the two words that the
        // log checks may be blank, but not those in between.
        if offset.is_multiple_of(SECTOR) && !self.is_blank(offset).await? {
            self.erase(offset, offset + SECTOR).await?;
        }
        self.flash.write(offset, bytes).await?;
        self.room = (SECTOR - 1) - (offset + bytes.len() as u32 - 1) % SECTOR;
        Ok(())
    }
}

/// The flash refused the write, or is worn out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StorageFailed;

impl<E> From<sequential_storage::Error<E>> for StorageFailed {
    fn from(_: sequential_storage::Error<E>) -> Self {
        Self
    }
}

/// Most records that are written while something moves, when none is written again.
pub const MOST_AT_ONCE: u32 = 120;
/// Number of sectors.
const COUNT: usize = ((SECTORS.end - SECTORS.start) / SECTOR) as usize;

/// The queue. It caches the address of its next record, because a search takes tens of milliseconds at 16 MHz, and a
/// capsule writes while its motor turns.
type Log<F> = QueueStorage<Checked<F>, Cache<Uncached, ArrayPagePointers<COUNT>, Uncached>>;

fn log<F: NorFlash>(flash: Checked<F>) -> Log<F> {
    let cache = Cache::new(Uncached, ArrayPagePointers::new(), Uncached);
    QueueStorage::new(flash, const { QueueConfig::new(SECTORS) }, cache)
}

/// The log, on a flash whose asynchronous operations never wait.
pub struct Store<F: NorFlash> {
    log: Log<F>,
    ages: Ages,
}

impl<F: NorFlash> Store<F> {
    /// Bytes that the log reads for a record.
    const READ: usize = RECORD.next_multiple_of(F::WRITE_SIZE);
    const FITS: () = assert!(
        Self::READ <= LONGEST_READ
            // One more: the record of the defaults may come before the old records.
            && Ages::OLDEST + (Ages::NUMBERS as u32) + MOST_AT_ONCE < in_a_sector(F::WRITE_SIZE)
    );

    /// The log in [`SECTORS`] of `flash`. Repeats an erasure that a power cut has interrupted, which takes up to half a
    /// second.
    pub fn new(flash: F) -> Self {
        const { Self::FITS };
        let mut flash = Checked {
            flash,
            half_erased: None,
            room: 0,
        };
        // With two sectors in use the log would read or write the wrong one. Ignore read errors here: the log reports
        // them later.
        let _ = block_on(flash.erase_oldest(false));
        Self {
            log: log(flash),
            ages: Ages::new(),
        }
    }

    /// Calls `record` with number and content of every record, oldest first. If a half-erased sector blocks the
    /// reading, erases it and calls `record` again from the first one.
    ///
    /// # Errors
    /// The sectors cannot be read as records; the records passed to `record` so far are valid.
    pub fn load(mut self, mut record: impl FnMut(u8, &[u8])) -> (Self, Result<(), StorageFailed>) {
        let mut read = self.read(&mut record);
        if read.is_err() && block_on(self.log.flash().erase_oldest(true)).unwrap_or(false) {
            // The queue's cache of that sector is outdated.
            self.log = log(self.log.destroy().0);
            read = self.read(&mut record);
        }
        (self, read)
    }

    fn read(&mut self, record: &mut impl FnMut(u8, &[u8])) -> Result<(), StorageFailed> {
        let mut buffer = [0; LONGEST_READ];
        let buffer = &mut buffer[..Self::READ];
        self.ages = Ages::new();
        block_on(async {
            let mut records = self.log.iter().await?;
            while let Some(entry) = records.next(buffer).await? {
                if let [number, content @ ..] = &*entry {
                    self.ages.wrote(*number);
                    record(*number, content);
                }
            }
            Ok(())
        })
    }

    /// Writes a record. Stops the processor for up to a second: call it only while nothing moves. Check
    /// [`Store::overdue`] after each call.
    ///
    /// # Errors
    /// The record is not written; the old one stays in force.
    pub fn save(&mut self, number: u8, content: &[u8]) -> Result<(), StorageFailed> {
        let mut record = heapless::Vec::<u8, RECORD>::new();
        let fits = record.push(number).is_ok() && record.extend_from_slice(content).is_ok();
        if !fits {
            return Err(StorageFailed);
        }
        block_on(self.log.push(&record, true))?;
        self.ages.wrote(number);
        Ok(())
    }

    /// Erases everything. Call it only if the log can be neither read nor written: a power cut during the erasure could
    /// bring back older values.
    ///
    /// # Errors
    /// The flash is worn out.
    pub fn erase(&mut self) -> Result<(), StorageFailed> {
        block_on(self.log.erase_all())?;
        self.ages = Ages::new();
        Ok(())
    }

    /// Records of any length that can be written before a sector is erased; 0 before the first is written.
    pub fn room(&mut self) -> u32 {
        self.log.flash().room.saturating_sub(F::WRITE_SIZE as u32) / LONGEST_IN_LOG
    }

    /// Number of the next record that must be written again.
    pub fn overdue(&self) -> Option<u8> {
        self.ages.overdue()
    }
}
