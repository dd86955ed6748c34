//! Values of the settings as on the wire, and the rig's store of them and of its name in flash. What they mean is the image's
//! business.

use crate::store::{NAME_RECORD, StorageFailed, Store};
use embedded_storage_async::nor_flash::NorFlash;
use heapless::String;
use protocol::{
    error::Refusal,
    settings::{MAX_NAME, SettingKey},
    system::DeviceKind,
};

/// Layout of a record in flash; others are not read.
const RECORD_VERSION: u8 = 1;

/// One value per key, each within its range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Values([u32; SettingKey::ALL.len()]);

impl Values {
    /// Those of a new device.
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

    /// Takes over a record as read from flash. One that is unknown, of another layout or out of range is left
    /// out: an older or newer firmware wrote it.
    pub fn load(&mut self, number: u8, record: &[u8]) {
        let (Some(key), [RECORD_VERSION, a, b, c, d]) = (SettingKey::from_number(number), record)
        else {
            return;
        };
        let value = u32::from_le_bytes([*a, *b, *c, *d]);
        if let Ok(values) = self.with(key, value) {
            *self = values;
        }
    }

    /// A value as it is written to flash.
    pub const fn record(value: u32) -> [u8; 5] {
        let [a, b, c, d] = value.to_le_bytes();
        [RECORD_VERSION, a, b, c, d]
    }
}

/// What a start found in flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Found {
    /// A log of settings, or an empty one.
    Settings,
    /// A log of values that do not go together.
    Conflict,
    /// No log.
    Noise,
}

/// Values and name in force, and the log in flash that they came from.
pub struct SettingsStore<F: NorFlash> {
    store: Store<F>,
    found: Found,
    values: Values,
    name: String<MAX_NAME>,
}

impl<F: NorFlash> SettingsStore<F> {
    /// Reads the flash. The second value is false if what is there cannot be used: not a log, or values that do not
    /// `go_together` (a cut of the power within a reset to the defaults may leave such). Then the defaults are in force.
    pub fn load(flash: F, go_together: impl FnOnce(&Values) -> bool) -> (Self, bool) {
        let mut store = Store::new(flash);
        let (mut values, mut name) = (Values::DEFAULT, String::new());
        let loaded = store.load(|number, record| match number {
            NAME_RECORD => {
                let text = core::str::from_utf8(record).unwrap_or_default();
                name = text.try_into().unwrap_or_default();
            }
            _ => values.load(number, record),
        });
        let found = if loaded.is_err() {
            Found::Noise
        } else if go_together(&values) {
            Found::Settings
        } else {
            Found::Conflict
        };
        let usable = found == Found::Settings;
        if !usable {
            values = Values::DEFAULT;
        }
        let kept = Self {
            store,
            found,
            values,
            name,
        };
        (kept, usable)
    }

    /// The values in force.
    pub fn values(&self) -> &Values {
        &self.values
    }

    /// The device's name; empty = none.
    pub fn name(&self) -> &str {
        &self.name
    }

    // Flash first: what is in force is what the next start will find.

    /// Changes a value, which is within its range.
    ///
    /// # Errors
    /// Nothing has changed.
    pub fn set(&mut self, key: SettingKey, value: u32) -> Result<(), StorageFailed> {
        let values = self.values.with(key, value).map_err(|_| StorageFailed)?;
        self.save(key as u8, &Values::record(value))?;
        self.values = values;
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

    /// Goes back to the defaults of all values and of the name.
    ///
    /// # Errors
    /// The flash is worn out; some values may have changed in it, none in force.
    pub fn reset(&mut self) -> Result<(), StorageFailed> {
        if self.found == Found::Noise || self.save_defaults().is_err() {
            // The flash holds something that is no log.
            self.store.erase()?;
        }
        self.found = Found::Settings;
        self.name.clear();
        self.values = Values::DEFAULT;
        Ok(())
    }

    fn save_defaults(&mut self) -> Result<(), StorageFailed> {
        for key in SettingKey::of(DeviceKind::Rig) {
            let default = key.range().default;
            // After a conflict the values in force are not those in flash.
            if self.found == Found::Conflict || self.values.get(key) != default {
                self.save(key as u8, &Values::record(default))?;
            }
        }
        self.save(NAME_RECORD, &[])
    }

    /// Writes a record, and again before it those that would be dropped some day.
    fn save(&mut self, number: u8, content: &[u8]) -> Result<(), StorageFailed> {
        while let Some(number) = self.store.overdue() {
            match SettingKey::from_number(number) {
                Some(key) => {
                    let record = Values::record(self.values.get(key));
                    self.store.save(number, &record)?;
                }
                None => self.store.save(number, self.name.as_bytes())?,
            }
        }
        self.store.save(number, content)
    }
}
