//! The values of all settings, and their store in flash, which also keeps the name and a machine's other records. The
//! image interprets the values.

use crate::store::{DEFAULTS_RECORD, NAME_RECORD, StorageFailed, Store};
use embedded_storage_async::nor_flash::NorFlash;
use heapless::String;
use protocol::{
    error::Refusal,
    settings::{MAX_NAME, SettingKey},
    system::DeviceKind,
};

/// Version of a record's layout in flash. Records of other versions are not read.
const RECORD_VERSION: u8 = 1;

/// One value per key, each within its range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Values([u32; SettingKey::ALL.len()]);

impl Values {
    /// Values of a new device.
    pub const DEFAULT: Self = {
        let mut values = [0; SettingKey::ALL.len()];
        let mut index = 0;
        while index < values.len() {
            values[index] = SettingKey::ALL[index].range().default;
            index += 1;
        }
        Self(values)
    };

    /// The value of a setting, in its unit.
    pub const fn get(&self, key: SettingKey) -> u32 {
        self.0[key as usize]
    }

    /// These values with one changed.
    ///
    /// # Errors
    /// Outside its range.
    pub fn with(&self, key: SettingKey, value: u32) -> Result<Self, Refusal> {
        let range = key.range();
        if !(range.min..=range.max).contains(&value) {
            return Err(Refusal::SettingRange {
                key,
                requested: value,
            });
        }
        let mut values = *self;
        values.0[key as usize] = value;
        Ok(values)
    }

    /// Loads a record from flash; ignores that of an unknown setting. False if another firmware wrote it, in another
    /// layout or with a value out of range. The default is then in force, not the value of an earlier record. An empty
    /// record also restores the default.
    pub fn load(&mut self, number: u8, record: &[u8]) -> bool {
        let Some(key) = SettingKey::from_number(number) else {
            return true;
        };
        self.0[key as usize] = key.range().default;
        let [RECORD_VERSION, a, b, c, d] = record else {
            return record.is_empty();
        };
        let loaded = self.with(key, u32::from_le_bytes([*a, *b, *c, *d]));
        *self = loaded.unwrap_or(*self);
        loaded.is_ok()
    }

    /// A value as it is written to flash.
    pub const fn record(value: u32) -> [u8; 5] {
        let [a, b, c, d] = value.to_le_bytes();
        [RECORD_VERSION, a, b, c, d]
    }
}

/// A record as it is written to flash, without its number.
pub type Record = heapless::Vec<u8, MAX_RECORD>;
/// Longest record, bytes. Of the settings' records a name is the longest.
const MAX_RECORD: usize = 27;
const _: () = assert!(MAX_NAME <= MAX_RECORD);

/// Records that a machine keeps in the log besides its settings and its name.
pub trait Records: Clone + Default {
    /// The machine whose settings the log holds.
    const KIND: DeviceKind;
    /// Numbers of these records; no setting of the machine has them.
    const NUMBERS: &'static [u8];

    /// Loads a record from flash. Ignores one of another layout.
    fn load(&mut self, number: u8, record: &[u8]);

    /// The record to write under this number, if any.
    fn record(&self, number: u8) -> Option<Record>;
}

/// No other records: the rig keeps settings and name only.
#[derive(Clone, Copy, Debug, Default)]
pub struct SettingsOnly;

impl Records for SettingsOnly {
    const KIND: DeviceKind = DeviceKind::Rig;
    const NUMBERS: &'static [u8] = &[];

    fn load(&mut self, _: u8, _: &[u8]) {}

    fn record(&self, _: u8) -> Option<Record> {
        None
    }
}

/// Content of the flash, as found at the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Found {
    /// A log of settings, or an empty one.
    Settings,
    /// A log of settings, some of which this firmware cannot read: their defaults are in force.
    Unread,
    /// A log whose values contradict each other.
    Conflict,
    Noise,
}

/// Values, name and records in force, and the log in flash that they came from.
pub struct SettingsStore<F: NorFlash, R = SettingsOnly> {
    store: Store<F>,
    found: Found,
    values: Values,
    name: String<MAX_NAME>,
    records: R,
}

impl<F: NorFlash> SettingsStore<F> {
    /// Like [`SettingsStore::load_with`], for a machine without other records.
    pub fn load(flash: F, go_together: impl FnOnce(&Values) -> bool) -> (Self, bool) {
        Self::load_with(flash, go_together)
    }
}

impl<F: NorFlash, R: Records> SettingsStore<F, R> {
    /// Reads the flash. The second value is false if the content is not a log, or the values fail `go_together`, as
    /// those of another firmware may: the defaults are then in force. It is also false if a single value cannot be
    /// used: its default is then in force.
    ///
    /// Without a log the other records are dropped too: the readable ones may be outdated.
    pub fn load_with(flash: F, go_together: impl FnOnce(&Values) -> bool) -> (Self, bool) {
        let (mut values, mut name) = (Values::DEFAULT, String::new());
        let mut records = R::default();
        // Whether the last record of each setting could not be used; a later record overrides an earlier one.
        let mut passed_over = [false; SettingKey::ALL.len()];
        let (store, loaded) = Store::new(flash).load(|number, record| match number {
            NAME_RECORD => name = name_in(record),
            DEFAULTS_RECORD => {
                (values, name) = (Values::DEFAULT, name_in(record));
                passed_over = [false; SettingKey::ALL.len()];
            }
            _ if R::NUMBERS.contains(&number) => records.load(number, record),
            _ => {
                // Other records belong to another firmware.
                if let Some(key) = setting::<R>(number) {
                    passed_over[key as usize] = !values.load(number, record);
                }
            }
        });
        let found = if loaded.is_err() {
            Found::Noise
        } else if !go_together(&values) {
            Found::Conflict
        } else if passed_over.contains(&true) {
            Found::Unread
        } else {
            Found::Settings
        };
        let usable = found == Found::Settings;
        if matches!(found, Found::Noise | Found::Conflict) {
            values = Values::DEFAULT;
        }
        if found == Found::Noise {
            (name, records) = (String::new(), R::default());
        }
        let kept = Self {
            store,
            found,
            values,
            name,
            records,
        };
        (kept, usable)
    }

    pub fn values(&self) -> &Values {
        &self.values
    }

    /// The device's name; empty = none.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The other records in force.
    pub fn records(&self) -> &R {
        &self.records
    }

    // Write flash first: the values in force are always those that the next start will find.

    /// Changes a value, which is within its range.
    ///
    /// # Errors
    /// The flash refused the write. The values in force have not changed.
    pub fn set(&mut self, key: SettingKey, value: u32) -> Result<(), StorageFailed> {
        let values = self.values.with(key, value).map_err(|_| StorageFailed)?;
        self.end_conflict()?;
        self.save(key as u8, &Values::record(value))?;
        self.values = values;
        Ok(())
    }

    /// Changes the name.
    ///
    /// # Errors
    /// Nothing has changed.
    pub fn set_name(&mut self, name: String<MAX_NAME>) -> Result<(), StorageFailed> {
        self.end_old_conflict()?;
        self.save(NAME_RECORD, name.as_bytes())?;
        self.name = name;
        Ok(())
    }

    /// Replaces the other records; only the one with this number differs. A flash without a log is erased first,
    /// because the machine writes these records without an operator who could order a factory reset.
    ///
    /// # Errors
    /// Nothing has changed.
    pub fn keep(&mut self, number: u8, records: R) -> Result<(), StorageFailed> {
        let record = records.record(number).ok_or(StorageFailed)?;
        if self.found == Found::Noise {
            self.begin_anew()?;
        }
        self.end_old_conflict()?;
        self.save(number, &record)?;
        self.records = records;
        Ok(())
    }

    /// Like [`Self::keep`] while something moves: writes the record and nothing else, and erases nothing.
    ///
    /// # Errors
    /// There is no room: [`Self::make_room`] was not called. Or the flash is worn out.
    pub fn keep_moving(&mut self, number: u8, records: R) -> Result<(), StorageFailed> {
        let record = records.record(number).ok_or(StorageFailed)?;
        if self.found != Found::Settings && self.found != Found::Unread || self.store.room() == 0 {
            return Err(StorageFailed);
        }
        self.store.save(number, &record)?;
        self.records = records;
        Ok(())
    }

    /// Makes room for this many records to be written while something moves. If the sector has less room, fills it up
    /// and erases the next one now, which takes up to a second.
    ///
    /// # Errors
    /// The flash is worn out.
    pub fn make_room(&mut self, records: u32) -> Result<(), StorageFailed> {
        let Some(&number) = R::NUMBERS.first() else {
            return Ok(());
        };
        self.renew()?;
        while self.store.room() < records {
            self.keep(number, self.records.clone())?;
        }
        Ok(())
    }

    /// Restores the defaults of all values and of the name, with one record: a power cut leaves all of them as they
    /// were, or none. The other records stay.
    ///
    /// # Errors
    /// The flash is worn out. No value in force has changed.
    pub fn reset(&mut self) -> Result<(), StorageFailed> {
        if self.save_defaults(&[]).is_err() {
            self.begin_anew()?;
        }
        self.found = Found::Settings;
        self.name.clear();
        self.values = Values::DEFAULT;
        Ok(())
    }

    /// Erases a flash that holds no log, and starts a new one with the other records only: all settings are defaults.
    fn begin_anew(&mut self) -> Result<(), StorageFailed> {
        self.store.erase()?;
        self.found = Found::Settings;
        for number in R::NUMBERS {
            if let Some(record) = self.records.record(*number) {
                self.store.save(*number, &record)?;
            }
        }
        Ok(())
    }

    /// After a conflict, writes the defaults, which are in force, and the name. Otherwise the next start would find the
    /// conflict again, or a single new value would end it and bring back the old values of the others.
    fn end_conflict(&mut self) -> Result<(), StorageFailed> {
        if self.found == Found::Conflict {
            let name = self.name.clone();
            self.save_defaults(name.as_bytes())?;
            self.found = Found::Settings;
        }
        Ok(())
    }

    /// Writes the defaults with this name. In a conflict it bypasses [`Self::save`], which might first rewrite an old
    /// record: that could end the conflict, and a power cut would then restore the other old values.
    fn save_defaults(&mut self, name: &[u8]) -> Result<(), StorageFailed> {
        match self.found {
            Found::Conflict => self.store.save(DEFAULTS_RECORD, name),
            _ => self.save(DEFAULTS_RECORD, name),
        }
    }

    /// Ends a conflict before [`Self::save`] rewrites one of its old records, which could end the conflict halfway.
    fn end_old_conflict(&mut self) -> Result<(), StorageFailed> {
        match self.store.overdue() {
            Some(_) => self.end_conflict(),
            None => Ok(()),
        }
    }

    /// Writes a record.
    fn save(&mut self, number: u8, content: &[u8]) -> Result<(), StorageFailed> {
        if self.found == Found::Noise {
            // The next start would not reach this record.
            return Err(StorageFailed);
        }
        self.renew()?;
        self.store.save(number, content)
    }

    /// Rewrites each record that the log may drop soon with its oldest sector.
    fn renew(&mut self) -> Result<(), StorageFailed> {
        while let Some(overdue) = self.store.overdue() {
            // Replace a record of another firmware by an empty one, which no firmware reads.
            let record = self.record(overdue).unwrap_or_default();
            self.store.save(overdue, &record)?;
        }
        Ok(())
    }

    /// The record in force under a number.
    fn record(&self, number: u8) -> Option<Record> {
        if number == NAME_RECORD {
            return Some(self.name.as_bytes().try_into().unwrap_or_default());
        }
        if R::NUMBERS.contains(&number) {
            return self.records.record(number);
        }
        let value = self.values.get(setting::<R>(number)?);
        Some(Values::record(value).into_iter().collect())
    }
}

/// The name in a record; empty if it is not UTF-8.
fn name_in(record: &[u8]) -> String<MAX_NAME> {
    let text = core::str::from_utf8(record).unwrap_or_default();
    text.try_into().unwrap_or_default()
}

fn setting<R: Records>(number: u8) -> Option<SettingKey> {
    SettingKey::from_number(number).filter(|key| key.is_of(R::KIND))
}
