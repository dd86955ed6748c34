//! The settings' log in the STM32F411's flash, and its write operations.

mod log;
mod twice;

use log::{KEPT, start, young};
use protocol::settings::SettingKey;
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

/// A reset writes the values that differ from the defaults, and the name. It erases nothing while there is a log.
#[test]
fn a_reset_writes_what_differs() {
    let flash = Flash::holding(young());
    start(&flash).reset().unwrap();
    let heads = |operation: &&Operation| matches!(operation, Operation::Write { words: 2, .. });
    let operations = flash.operations();
    assert_eq!(operations.iter().filter(heads).count(), KEPT.len() + 1);
    let erasures = |operation: &Operation| matches!(operation, Operation::Erase { .. });
    assert!(!operations.iter().any(erasures));
}
