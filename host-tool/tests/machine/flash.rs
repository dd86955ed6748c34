//! What a machine keeps while it is switched off or reset: its settings in flash, and a kilobyte of retained RAM.

use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard};

use device::retained::{WORDS, Words};
use device::settings::SettingsStore;
use device::store::{SECTOR, SECTORS};
use embedded_storage_async::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use protocol::settings::SettingKey;

/// Flash in memory. Clones are the same flash.
#[derive(Clone)]
pub struct Flash(Arc<Mutex<Cells>>);

struct Cells {
    bytes: Vec<u8>,
    /// How often it was written.
    writes: u32,
    /// Writes that fail, by their number from 0.
    failing: Range<u32>,
}

/// A write that the flash refused.
#[derive(Debug)]
pub struct WriteFailed;

impl NorFlashError for WriteFailed {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl Flash {
    /// A flash that was never written.
    pub fn blank() -> Self {
        Self(Arc::new(Mutex::new(Cells {
            bytes: vec![0xFF; SECTORS.end as usize],
            writes: 0,
            failing: 0..0,
        })))
    }

    fn cells(&self) -> MutexGuard<'_, Cells> {
        self.0.lock().expect("nobody panics while it is written")
    }

    /// Counts writes anew; those in `failing` will fail.
    pub fn fail(&self, failing: Range<u32>) {
        let mut cells = self.cells();
        (cells.writes, cells.failing) = (0, failing);
    }

    pub fn writes(&self) -> u32 {
        self.cells().writes
    }

    /// The log of settings as a machine finds it at its start.
    pub fn settings(&self) -> SettingsStore<Self> {
        let (settings, usable) = SettingsStore::load(self.clone(), |_| true);
        assert!(usable, "the log can be read");
        settings
    }

    /// All values, in the order of their keys.
    pub fn values(&self) -> Vec<u32> {
        let settings = self.settings();
        SettingKey::ALL
            .map(|key| settings.values().get(key))
            .to_vec()
    }
}

impl ErrorType for Flash {
    type Error = WriteFailed;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), WriteFailed> {
        let from = offset as usize;
        bytes.copy_from_slice(&self.cells().bytes[from..from + bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        SECTORS.end as usize
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR as usize;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), WriteFailed> {
        self.cells().bytes[from as usize..to as usize].fill(0xFF);
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), WriteFailed> {
        let mut cells = self.cells();
        let number = cells.writes;
        cells.writes += 1;
        if cells.failing.contains(&number) {
            return Err(WriteFailed);
        }
        let from = offset as usize;
        let words = &mut cells.bytes[from..from + bytes.len()];
        assert!(
            words.iter().all(|byte| *byte == 0xFF),
            "a word is written once"
        );
        words.copy_from_slice(bytes);
        Ok(())
    }
}

/// RAM that survives a reset, but no power cut.
pub struct Retained(pub [u32; WORDS]);

impl Words for Retained {
    fn get(&self, index: usize) -> u32 {
        self.0[index]
    }

    fn set(&mut self, index: usize, value: u32) {
        self.0[index] = value;
    }
}
