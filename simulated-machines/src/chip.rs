//! The STM32F411's flash, modelled in memory: programs words, erases sectors, and can lose its supply in the middle
//! of an operation.

use crate::dice::Dice;
use device::store::{SECTOR, SECTORS};
use embedded_storage_async::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use std::{
    ops::Range,
    sync::{Arc, Mutex, MutexGuard},
};

/// Where in an operation the supply fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cut {
    Before,
    /// After `done` words of a write, or `done` quarters of an erasure. The rest of an erasure is left with random
    /// bits; with `torn` so is the next word of a write.
    Within {
        done: usize,
        torn: bool,
    },
    /// Leaves the first and last word of the sector blank and random bits between. Cuts a write after its first word.
    BlankAtBothEnds,
    After,
}

impl Cut {
    pub const ALL: [Self; 13] = [
        Self::Before,
        Self::within(0, true),
        Self::within(1, false),
        Self::within(1, true),
        Self::within(2, false),
        Self::within(2, true),
        Self::within(3, false),
        Self::within(3, true),
        Self::within(4, true),
        Self::within(5, true),
        Self::within(6, true),
        Self::BlankAtBothEnds,
        Self::After,
    ];

    const fn within(done: usize, torn: bool) -> Self {
        Self::Within { done, torn }
    }
}

/// An operation on the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    Write { offset: u32, words: usize },
    Erase { sector: u32 },
}

/// The flash's supply: when it fails, and which operations fail.
#[derive(Debug, Default)]
struct Supply {
    /// Operations since the start.
    operations: Vec<Operation>,
    /// The operation in which the supply fails, counted from the start, and where in it.
    cut: Option<(usize, Cut)>,
    failed: bool,
    /// Operations requested since `fail`, and the range of them that fails.
    asked: usize,
    failing: Range<usize>,
    /// Random bits that a cut operation leaves.
    noise: Dice,
}

impl Supply {
    /// Begins an operation; returns where it will be cut.
    fn begin(&mut self, operation: Operation) -> Result<Cut, Error> {
        self.end()?;
        self.asked += 1;
        if self.failing.contains(&(self.asked - 1)) {
            return Err(Error::Worn);
        }
        self.operations.push(operation);
        match self.cut {
            Some((number, cut)) if number + 1 == self.operations.len() => {
                self.failed = true;
                Ok(cut)
            }
            _ => Ok(Cut::After),
        }
    }

    /// An error if the supply failed during the operation.
    fn end(&self) -> Result<(), Error> {
        if self.failed { Err(Error::Off) } else { Ok(()) }
    }
}

#[derive(Debug)]
struct Array {
    bytes: Vec<u8>,
    supply: Supply,
}

/// The flash; clones share its content.
#[derive(Clone, Debug)]
pub struct Flash(Arc<Mutex<Array>>);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Error {
    /// The supply is off.
    Off,
    Worn,
}

impl NorFlashError for Error {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl Flash {
    pub fn blank() -> Self {
        Self::holding(vec![0xFF; SECTORS.end as usize])
    }

    /// A freshly started flash with this content.
    pub fn holding(bytes: Vec<u8>) -> Self {
        assert_eq!(bytes.len(), SECTORS.end as usize);
        Self(Arc::new(Mutex::new(Array {
            bytes,
            supply: Supply::default(),
        })))
    }

    fn array(&self) -> MutexGuard<'_, Array> {
        self.0.lock().unwrap()
    }

    pub fn bytes(&self) -> Vec<u8> {
        self.array().bytes.clone()
    }

    /// Writes and erasures since the start.
    pub fn operations(&self) -> Vec<Operation> {
        self.array().supply.operations.clone()
    }

    /// Makes the supply fail after `after` more operations.
    pub fn cut(&self, after: usize, cut: Cut, seed: u64) {
        let supply = &mut self.array().supply;
        supply.cut = Some((supply.operations.len() + after, cut));
        supply.noise = Dice(seed);
    }

    pub fn wear(&self) {
        self.fail(0..usize::MAX);
    }

    /// Makes these operations fail, counted from now on.
    pub fn fail(&self, failing: Range<usize>) {
        let supply = &mut self.array().supply;
        (supply.asked, supply.failing) = (0, failing);
    }
}

impl Array {
    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        let words = bytes.len() / 4;
        let (done, torn) = match self.supply.begin(Operation::Write { offset, words })? {
            Cut::Before => (0, false),
            Cut::Within { done, torn } => (done.min(words), torn),
            Cut::BlankAtBothEnds => (1, false),
            Cut::After => (words, false),
        };
        let target = &mut self.bytes[offset as usize..][..bytes.len()];
        // Programming can only clear bits, so the word must be blank. Exception: the log marks a sector by clearing a
        // word to 0.
        let blank = target.iter().all(|byte| *byte == 0xFF);
        let mark = bytes == [0; 4];
        assert!(blank || mark, "a word is programmed twice at {offset:#x}");
        target[..4 * done].copy_from_slice(&bytes[..4 * done]);
        if torn && done < words {
            // The torn word: some of its bits are already programmed to 0.
            for index in 4 * done..4 * done + 4 {
                target[index] = bytes[index] | self.supply.noise.bits() as u8;
            }
        }
        self.supply.end()
    }

    fn erase(&mut self, sector: u32) -> Result<(), Error> {
        let cut = self.supply.begin(Operation::Erase { sector })?;
        let quarter = SECTOR as usize / 4;
        let bytes = &mut self.bytes[sector as usize..][..SECTOR as usize];
        let noise = &mut self.supply.noise;
        match cut {
            Cut::Before => {}
            Cut::After => bytes.fill(0xFF),
            // Interrupted erasure: some bits are already back to 1.
            Cut::BlankAtBothEnds => {
                bytes.fill_with(|| noise.bits() as u8);
                bytes[..4].fill(0xFF);
                bytes[SECTOR as usize - 4..].fill(0xFF);
            }
            Cut::Within { done, torn } => {
                let done = done.min(4) * quarter;
                for byte in &mut bytes[..done] {
                    *byte |= if torn { noise.bits() as u8 } else { 0xFF };
                }
                for byte in &mut bytes[done..] {
                    *byte |= noise.bits() as u8 & noise.bits() as u8;
                }
            }
        }
        self.supply.end()
    }
}

impl ErrorType for Flash {
    type Error = Error;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Error> {
        let array = self.array();
        array.supply.end()?;
        bytes.copy_from_slice(&array.bytes[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        SECTORS.end as usize
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR as usize;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Error> {
        assert!(SECTORS.start <= from && from < to && to <= SECTORS.end);
        for sector in (from..to).step_by(SECTOR as usize) {
            self.array().erase(sector)?;
        }
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        let end = offset + bytes.len() as u32;
        assert!(SECTORS.start <= offset && end <= SECTORS.end && offset.is_multiple_of(4));
        assert!(bytes.len().is_multiple_of(4) && !bytes.is_empty());
        self.array().write(offset, bytes)
    }
}
