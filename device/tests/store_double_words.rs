//! The settings' log in the STM32L412's flash of double words with a check code, through the adapter that the image
//! uses. It was not tried on such a chip: the model follows the reference manual.

#[path = "chip/double_words.rs"]
mod chip;
#[path = "store/log.rs"]
mod log;

use chip::{Cut, Flash, Operation};
use device::store::{SECTORS, StorageFailed};
use embedded_storage_async::nor_flash::{NorFlash, ReadNorFlash};
use log::{KEPT, start, young};
use protocol::settings::SettingKey;

/// Erasing wears a page.
#[test]
fn a_blank_sector_is_not_erased() {
    let flash = Flash::blank();
    start(&flash).set(SettingKey::FlagUm, 900).unwrap();
    let erasures = |operation: &Operation| matches!(operation, Operation::Erase { .. });
    assert!(!flash.operations().iter().any(erasures));
    assert_eq!(
        flash.operations().len(),
        3,
        "the sector's mark, and a record's head and content"
    );
}

/// The cuts of the other tests do leave unreadable double words. Records before and behind them remain readable.
#[test]
fn what_a_cut_made_unreadable_is_stepped_over() {
    let mut unreadable = 0;
    for number in 0..2 {
        for seed in 0..50 {
            let flash = Flash::holding(young());
            flash.cut(number, Cut::ALL[1], seed);
            start(&flash).set(SettingKey::FlagUm, 1_234).unwrap_err();
            let flash = Flash::holding(flash.bytes());
            unreadable += flash.unreadable();
            let mut store = start(&flash);
            assert_eq!(store.values().get(SettingKey::FlagUm), 900);
            store.set(SettingKey::FlagUm, 1_235).unwrap();
            let store = start(&Flash::holding(flash.bytes()));
            assert_eq!(store.values().get(SettingKey::FlagUm), 1_235);
            assert_eq!(store.values().get(KEPT[1].0), KEPT[1].1);
        }
    }
    assert!(unreadable > 20, "{unreadable}");
}

/// Otherwise the log would take it for free each time, and could never store anything again.
#[test]
fn a_double_word_that_cannot_be_programmed_costs_one_record() {
    for place in 0..2 {
        let flash = Flash::holding(young());
        // The head of the next record (0) or its content (1).
        let head = flash.operations().len();
        start(&flash).set(SettingKey::FlagUm, 1_000).unwrap();
        let Operation::Write { offset, .. } = flash.operations()[head] else {
            panic!("no head")
        };
        let flash = Flash::holding(young());
        flash.stick(offset + place * 8);
        let mut store = start(&flash);
        assert_eq!(store.set(SettingKey::FlagUm, 1_234), Err(StorageFailed));
        assert_eq!(store.values().get(SettingKey::FlagUm), 900);
        store.set(SettingKey::FlagUm, 1_235).unwrap();
        let store = start(&Flash::holding(flash.bytes()));
        assert_eq!(store.values().get(SettingKey::FlagUm), 1_235);
    }
}

/// Any number of bytes from any place.
#[test]
fn bytes_are_read_across_double_words() {
    let content: Vec<u8> = (0..SECTORS.end).map(|at| (at % 251) as u8).collect();
    let mut flash = Flash::holding(content.clone());
    let first = SECTORS.start as usize + 8; // behind the mark
    for from in first..first + 9 {
        for length in 0..20 {
            let mut bytes = vec![0; length];
            embassy_futures::block_on(flash.read(from as u32, &mut bytes)).unwrap();
            assert_eq!(bytes, content[from..from + length]);
        }
    }
}

/// A sector is eight pages: all of them are erased.
#[test]
fn a_sector_is_erased_page_by_page() {
    let mut flash = Flash::holding(vec![0; SECTORS.end as usize]);
    embassy_futures::block_on(flash.erase(0x8000, 0xC000)).unwrap();
    let pages: Vec<Operation> = (0x8000..0xC000)
        .step_by(0x800)
        .map(|sector| Operation::Erase { sector })
        .collect();
    assert_eq!(flash.operations(), pages);
    let bytes = flash.bytes();
    let blank = |byte: &u8| *byte == 0xFF;
    assert_eq!(bytes.iter().position(blank), Some(0x8000));
    assert!(bytes[0x8000..0xC000].iter().all(blank) && bytes[0xC000] == 0);
}
