//! What a capsule keeps in flash: its calibration, totals with how the last motion ended, settings and name. In a log like the
//! rig's: settings have their keys' numbers, and those of the rig's first two are the capsule's own records.
//!
//! A record is 24 bytes with its head, and one is written after each motion, once the motor stands; another one before
//! a motion that leaves the folded end. Three sectors of 16 KiB, 10,000 erasures each (data sheet), are worth 20
//! million records.

use crate::{calibration::Calibration, settings::Settings};
use device::{
    settings::Values,
    store::{NAME_RECORD, StorageFailed, Store},
};
use embedded_storage_async::nor_flash::NorFlash;
use heapless::String;
use protocol::{
    settings::{MAX_NAME, SettingKey},
    system::DeviceKind,
};

const CALIBRATION: u8 = 0;
const TOTALS: u8 = 1;
/// No setting of a capsule has their numbers.
const _: () = assert!(
    !SettingKey::ALL[CALIBRATION as usize].is_of(DeviceKind::Capsule)
        && !SettingKey::ALL[TOTALS as usize].is_of(DeviceKind::Capsule)
);

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
    values: Values,
    settings: Settings,
    /// The values in flash do not go together; those of the defaults are in force.
    conflict: bool,
    name: String<MAX_NAME>,
}

/// The setting that a record is of.
fn setting(number: u8) -> Option<SettingKey> {
    SettingKey::from_number(number).filter(|key| key.is_of(DeviceKind::Capsule))
}

impl<F: NorFlash> Kept<F> {
    /// Reads the flash. What is there and is no log is erased with the first record that is written. The second value is false if
    /// the settings do not go together (a cut of the power within a reset to the defaults may leave such): the defaults are in force.
    pub fn load(flash: F) -> (Self, bool) {
        let mut store = Store::new(flash);
        let (mut calibration, mut totals) = (None, Totals::default());
        let (mut values, mut name) = (Values::DEFAULT, String::new());
        let loaded = store.load(|number, record| match number {
            CALIBRATION => calibration = Calibration::from_record(record),
            TOTALS => totals = Totals::from_record(record).unwrap_or(totals),
            NAME_RECORD => {
                let text = core::str::from_utf8(record).unwrap_or_default();
                name = text.try_into().unwrap_or_default();
            }
            _ if setting(number).is_some() => values.load(number, record),
            _ => {} // of another firmware
        });
        let settings = Settings::new(&values);
        let kept = Self {
            store,
            usable: loaded.is_ok(),
            calibration,
            totals,
            values: match settings {
                Ok(_) => values,
                Err(_) => Values::DEFAULT,
            },
            settings: settings.unwrap_or_default(),
            conflict: settings.is_err(),
            name,
        };
        (kept, settings.is_ok())
    }

    /// The values of the settings in force.
    pub fn values(&self) -> &Values {
        &self.values
    }

    /// What they mean.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The capsule's name; empty = none.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Changes a setting, which is within its range and goes together with the others.
    ///
    /// # Errors
    /// Nothing has changed.
    pub fn set(
        &mut self,
        key: SettingKey,
        value: u32,
        settings: Settings,
    ) -> Result<(), StorageFailed> {
        let values = self.values.with(key, value).map_err(|_| StorageFailed)?;
        self.save(key as u8, &Values::record(value))?;
        (self.values, self.settings) = (values, settings);
        Ok(())
    }

    /// Changes the name.
    ///
    /// # Errors
    /// Nothing has changed.
    pub fn set_name(&mut self, name: String<MAX_NAME>) -> Result<(), StorageFailed> {
        self.save(NAME_RECORD, name.as_bytes())?;
        self.name = name;
        Ok(())
    }

    /// Goes back to the defaults of all settings and of the name. Calibration and totals stay.
    ///
    /// # Errors
    /// The flash is worn out; some values may have changed in it, none in force.
    pub fn reset(&mut self) -> Result<(), StorageFailed> {
        for key in SettingKey::of(DeviceKind::Capsule) {
            let default = key.range().default;
            // After a conflict the values in force are not those in flash.
            if self.conflict || self.values.get(key) != default {
                self.save(key as u8, &Values::record(default))?;
            }
        }
        self.set_name(String::new())?;
        self.conflict = false;
        (self.values, self.settings) = (Values::DEFAULT, Settings::default());
        Ok(())
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
                (NAME_RECORD, _) => self.store.save(NAME_RECORD, self.name.as_bytes())?,

                (other, _) => match setting(other) {
                    Some(key) => {
                        let record = Values::record(self.values.get(key));
                        self.store.save(other, &record)?;
                    }
                    // Of another firmware, or of no use: an empty record takes its place.
                    None => self.store.save(other, &[])?,
                },
            }
        }
        self.store.save(number, content)
    }
}
