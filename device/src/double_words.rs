//! A flash of pages and double words with a check code (ECC), as the STM32L4 has, in the form that the store wants.
//!
//! A double word is programmed once between two erasures, and once more only with zeros. One that was cut off halfway may have a check
//! code that does not fit. It is no error here: it is what a cut leaves, and the store steps over it.

use crate::store::{SECTOR, SECTORS};
use embedded_storage_async::nor_flash::{ErrorType, NorFlash, NorFlashError, ReadNorFlash};

/// Bytes that are programmed at once.
pub const DOUBLE_WORD: usize = 8;
/// Bytes that are erased at once. A sector of the store is some of them, one after the other.
pub const PAGE: u32 = 2 * 1024;
const _: () = assert!(SECTOR.is_multiple_of(PAGE));
/// What an unreadable double word is taken for: not blank, so nothing is written there, and no head of a record.
const UNREADABLE: [u8; DOUBLE_WORD] = [0x5A; DOUBLE_WORD];

/// What the chip does. Offsets are from the start of the flash.
pub trait DoubleWords {
    /// Why something was not done.
    type Error: NorFlashError;

    /// Reads a double word. `None` if its check code does not fit, or fits a blank one after a correction only: there programming fails.
    fn read(&mut self, offset: u32) -> Option<[u8; DOUBLE_WORD]>;

    /// Programs a double word that is blank; any one with zeros.
    ///
    /// # Errors
    /// It was not blank, or is worn.
    fn program(&mut self, offset: u32, bytes: [u8; DOUBLE_WORD]) -> Result<(), Self::Error>;

    /// Erases the page that begins there.
    ///
    /// # Errors
    /// It is worn.
    fn erase(&mut self, page: u32) -> Result<(), Self::Error>;
}

/// The store's sectors over such a flash.
#[derive(Clone, Debug)]
pub struct Sectors<D>(pub D);

impl<D: DoubleWords> Sectors<D> {
    fn read_one(&mut self, offset: u32) -> [u8; DOUBLE_WORD] {
        let read = self.0.read(offset);
        let within = offset % SECTOR;
        if within != 0 && within != SECTOR - DOUBLE_WORD as u32 {
            return read.unwrap_or(UNREADABLE);
        }
        // The log's marks. To the log half of a byte is one, and an erasure that was cut off may leave as much at the start of a sector that
        // is not blank. Here a mark is whole, or there is none; it is written over whatever is there, since it is zeros.
        let marked = read == Some([0; DOUBLE_WORD]);
        [if marked { 0 } else { 0xFF }; DOUBLE_WORD]
    }
}

impl<D: DoubleWords> ErrorType for Sectors<D> {
    type Error = D::Error;
}

impl<D: DoubleWords> ReadNorFlash for Sectors<D> {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), D::Error> {
        let mut at = offset;
        let mut left = bytes;
        while !left.is_empty() {
            let within = at as usize % DOUBLE_WORD;
            let (now, later) = left.split_at_mut(left.len().min(DOUBLE_WORD - within));
            let double_word = self.read_one(at - within as u32);
            now.copy_from_slice(&double_word[within..within + now.len()]);
            at += now.len() as u32;
            left = later;
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        SECTORS.end as usize
    }
}

impl<D: DoubleWords> NorFlash for Sectors<D> {
    const WRITE_SIZE: usize = DOUBLE_WORD;
    const ERASE_SIZE: usize = SECTOR as usize;

    /// From the first page to the last one. A cut leaves a sector without the mark at its start and with that at its end, which the log
    /// knows for an erasure to be repeated.
    async fn erase(&mut self, from: u32, to: u32) -> Result<(), D::Error> {
        for page in (from..to).step_by(PAGE as usize) {
            self.0.erase(page)?;
        }
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), D::Error> {
        let (double_words, rest) = bytes.as_chunks();
        debug_assert!(rest.is_empty());
        for (at, double_word) in (offset..).step_by(DOUBLE_WORD).zip(double_words) {
            if let Err(error) = self.0.program(at, *double_word) {
                // It read as blank and is not. The log would find it free again for ever: with zeros it is not.
                let _ = self.0.program(at, [0; DOUBLE_WORD]);
                return Err(error);
            }
        }
        Ok(())
    }
}
