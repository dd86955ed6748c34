//! The settings' log in the STM32F411's flash, and its write operations.

mod log;
mod twice;

use device::{
    settings::{Record, Records, SettingsOnly, SettingsStore, Values},
    store::{SECTORS, StorageFailed, Store},
};
use log::{start, young};
use protocol::{settings::SettingKey, system::DeviceKind};
use simulated_machines::chip::{self, Flash, Operation};

/// An erasure takes half a second, and wears the flash.
#[test]
fn a_blank_sector_is_not_erased() {
    let flash = Flash::blank();
    start(&flash).set(SettingKey::FlagUm, 900).unwrap();
    let erasures = |operation: &Operation| matches!(operation, Operation::Erase { .. });
    assert!(!flash.operations().iter().any(erasures));
    assert_eq!(
        flash.operations().len(),
        4,
        "the sector's mark, and a record's head and two parts"
    );
}

/// It erases nothing while there is a log.
#[test]
fn a_reset_writes_one_record() {
    let flash = Flash::holding(young());
    start(&flash).reset().unwrap();
    assert_eq!(flash.operations().len(), 2, "a head and a content");
}

/// A machine that keeps a count beside its settings, under the number of a setting that it does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Count(u32);

const COUNT: u8 = SettingKey::LeadUm as u8;

impl Records for Count {
    const KIND: DeviceKind = DeviceKind::Capsule;
    const NUMBERS: &'static [u8] = &[COUNT];

    fn load(&mut self, number: u8, record: &[u8]) {
        assert_eq!(number, COUNT);
        self.0 = u32::from_le_bytes(record.try_into().unwrap());
    }

    fn record(&self, number: u8) -> Option<Record> {
        (number == COUNT).then(|| self.0.to_le_bytes().into_iter().collect())
    }
}

fn counting(flash: &Flash) -> (SettingsStore<Flash, Count>, bool) {
    SettingsStore::load_with(flash.clone(), |_| true)
}

#[test]
fn other_records_are_kept_beside_the_settings() {
    let flash = Flash::blank();
    let (mut store, _) = counting(&flash);
    store.set(SettingKey::EndForceMa, 100).unwrap();
    store.keep(COUNT, Count(0x0102_0304)).unwrap();
    assert_eq!(store.records(), &Count(0x0102_0304));
    let (mut store, usable) = counting(&Flash::holding(flash.bytes()));
    assert!(usable);
    assert_eq!(store.records(), &Count(0x0102_0304));
    assert_eq!(store.values().get(SettingKey::EndForceMa), 100);
    // A number without a record changes nothing.
    assert_eq!(store.keep(COUNT + 1, Count(7)), Err(StorageFailed));
    assert_eq!(store.records(), &Count(0x0102_0304));
}

/// The first record makes the log: a reset of the settings may never be ordered.
#[test]
fn a_record_is_kept_even_where_there_was_no_log() {
    let flash = Flash::holding(vec![0; SECTORS.end as usize]);
    let (mut store, usable) = counting(&flash);
    assert!(!usable);
    store.keep(COUNT, Count(9)).unwrap();
    let (store, usable) = counting(&Flash::holding(flash.bytes()));
    assert!(usable);
    assert_eq!(store.records(), &Count(9));
}

/// A board that was the other machine before: its settings' numbers are not read as values of this one.
#[test]
fn a_setting_of_the_other_machine_is_not_in_force() {
    let flash = Flash::blank();
    let mut log = Store::new(flash.clone());
    let own = (SettingKey::FlagUm, 900);
    for (key, value) in [(SettingKey::EndForceMa, 100), own] {
        log.save(key as u8, &Values::record(value)).unwrap();
    }
    let store = start(&flash);
    assert_eq!(store.values(), &Values::DEFAULT.with(own.0, own.1).unwrap());
}

#[test]
fn a_machine_with_settings_alone_keeps_no_other_record() {
    let flash = Flash::blank();
    let mut store = start(&flash);
    assert_eq!(store.keep(0, SettingsOnly), Err(StorageFailed));
    assert!(flash.operations().is_empty());
}
