//! What a capsule keeps in flash: its calibration, and totals with how the last motion ended. In the same log as the
//! rig's settings.
//!
//! A record is 24 bytes with its head, and one is written after each motion, once the motor stands; another one before
//! a motion that leaves the folded end. Three sectors of 16 KiB, 10,000 erasures each (data sheet), are worth 20
//! million records.

use crate::calibration::Calibration;
use device::store::{Ages, StorageFailed, Store};
use embedded_storage_async::nor_flash::NorFlash;

const CALIBRATION: u8 = 0;
const TOTALS: u8 = 1;
/// The log knows as many numbers.
const _: () = assert!((TOTALS as usize) < Ages::NUMBERS - 1);

/// Over the life of the capsule.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Motions.
    pub actuations: u32,
    /// Energy drawn by the motor.
    pub energy_mj: u64,
    /// The last motion ended folded, and none has begun since.
    pub folded: bool,
}

/// Version and the fields, little-endian.
const TOTALS_RECORD: usize = 14;
const VERSION: u8 = 1;

impl Totals {
    fn record(&self) -> [u8; TOTALS_RECORD] {
        let mut record = [VERSION; TOTALS_RECORD];
        record[1..5].copy_from_slice(&self.actuations.to_le_bytes());
        record[5..13].copy_from_slice(&self.energy_mj.to_le_bytes());
        record[13] = u8::from(self.folded);
        record
    }

    fn from_record(record: &[u8]) -> Option<Self> {
        let &[VERSION, a, b, c, d, e, f, g, h, i, j, k, l, folded] = record else {
            return None;
        };
        Some(Self {
            actuations: u32::from_le_bytes([a, b, c, d]),
            energy_mj: u64::from_le_bytes([e, f, g, h, i, j, k, l]),
            folded: folded == 1,
        })
    }
}

/// What is in flash, and the log that it is in.
pub struct Kept<F: NorFlash> {
    store: Store<F>,
    usable: bool,
    calibration: Option<Calibration>,
    totals: Totals,
}

impl<F: NorFlash> Kept<F> {
    /// Reads the flash. What is there and is no log is erased with the first record that is written.
    pub fn load(flash: F) -> Self {
        let mut store = Store::new(flash);
        let (mut calibration, mut totals) = (None, Totals::default());
        let loaded = store.load(|number, record| match number {
            CALIBRATION => calibration = Calibration::from_record(record),
            TOTALS => totals = Totals::from_record(record).unwrap_or(totals),
            _ => {} // of another firmware
        });
        Self {
            store,
            usable: loaded.is_ok(),
            calibration,
            totals,
        }
    }

    /// The calibration.
    pub fn calibration(&self) -> Option<Calibration> {
        self.calibration
    }

    /// The totals.
    pub fn totals(&self) -> &Totals {
        &self.totals
    }

    /// Keeps a calibration.
    ///
    /// # Errors
    /// It is not kept.
    pub fn keep_calibration(&mut self, calibration: Calibration) -> Result<(), StorageFailed> {
        self.save(CALIBRATION, &calibration.record())?;
        self.calibration = Some(calibration);
        Ok(())
    }

    /// Keeps the totals.
    ///
    /// # Errors
    /// They are not kept.
    pub fn keep_totals(&mut self, totals: Totals) -> Result<(), StorageFailed> {
        self.save(TOTALS, &totals.record())?;
        self.totals = totals;
        Ok(())
    }

    /// Writes a record, and again before it those that would be dropped some day.
    fn save(&mut self, number: u8, content: &[u8]) -> Result<(), StorageFailed> {
        if !self.usable {
            self.store.erase()?;
            self.usable = true;
        }
        while let Some(overdue) = self.store.overdue() {
            match (overdue, &self.calibration) {
                (CALIBRATION, Some(calibration)) => {
                    self.store.save(CALIBRATION, &calibration.record())?;
                }
                (TOTALS, _) => self.store.save(TOTALS, &self.totals.record())?,
                // Of another firmware, or of no use: an empty record takes its place.
                (other, _) => self.store.save(other, &[])?,
            }
        }
        self.store.save(number, content)
    }
}
