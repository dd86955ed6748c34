//! Settings: records in flash, numbers of keys, ages of records.

use device::{
    settings::Values,
    store::{Ages, NAME_RECORD},
};
use proptest::prelude::*;
use protocol::settings::SettingKey;

const DEFAULT: Values = Values::DEFAULT;

#[test]
fn records_come_back() {
    for key in SettingKey::ALL {
        let range = key.range();
        for value in [range.min, range.max] {
            let mut values = DEFAULT;
            values.load(key as u8, &Values::record(value));
            for other in SettingKey::ALL {
                let expected = if other == key {
                    value
                } else {
                    other.range().default
                };
                assert_eq!(values.get(other), expected);
            }
        }
    }
    // The layout, byte for byte: version 1, little-endian.
    assert_eq!(Values::record(0x0102_0304), [1, 4, 3, 2, 1]);
}

/// Records of other firmware are ignored.
#[test]
fn records_that_do_not_fit_are_ignored() {
    let stroke = SettingKey::StrokeUm as u8;
    let fine = Values::record(100_000);
    let other_version = [2, fine[1], fine[2], fine[3], fine[4]];
    let count = SettingKey::ALL.len() as u8;
    let records: [(u8, &[u8]); 9] = [
        (stroke, &other_version),
        (stroke, &fine[..4]),
        (stroke, &[]),
        (stroke, &[fine[0], fine[1], fine[2], fine[3], fine[4], 0]),
        (stroke, &Values::record(130_001)),
        (stroke, &Values::record(0)),
        (count, &fine),
        (NAME_RECORD, &fine),
        (u8::MAX, &fine),
    ];
    for (number, record) in records {
        let mut values = DEFAULT;
        values.load(number, record);
        assert_eq!(values, DEFAULT, "{number} {record:?}");
    }
    let mut values = DEFAULT;
    values.load(stroke, &fine);
    assert_eq!(values.get(SettingKey::StrokeUm), 100_000);
}

proptest! {
    /// Whatever is written, and however often the rig restarts: the last record of each number is never old.
    #[test]
    fn nothing_that_is_needed_grows_old(
        writes in prop::collection::vec((0..SettingKey::ALL.len() as u8 + 2, 1..400_u32), 1..40),
    ) {
        let mut log = Vec::new();
        let mut ages = Ages::new();
        let mut used = std::collections::BTreeSet::new();
        for (number, times) in writes {
            let number = match usize::from(number).checked_sub(SettingKey::ALL.len()) {
                None => number,
                Some(0) => NAME_RECORD,
                Some(_) => {
                    // A restart reads the log again, without the dropped sectors.
                    let from = log.len().saturating_sub(500);
                    ages = Ages::new();
                    log[from..].iter().for_each(|number| ages.wrote(*number));
                    continue;
                }
            };
            for _ in 0..times {
                while let Some(overdue) = ages.overdue() {
                    ages.wrote(overdue);
                    log.push(overdue);
                }
                ages.wrote(number);
                log.push(number);
                used.insert(number);
                let young = log.len().saturating_sub(Ages::OLDEST as usize + Ages::NUMBERS + 1);
                for number in &used {
                    prop_assert!(log[young..].contains(number), "{number} of {}", log.len());
                }
            }
        }
    }
}

/// A record is old after 256 later ones, whichever they are: neither the name nor any setting hides another.
#[test]
fn a_record_is_old_after_256_others() {
    assert_eq!(Ages::OLDEST, 256);
    let keys = SettingKey::ALL.into_iter().map(|key| key as u8);
    for number in keys.chain([NAME_RECORD]) {
        let others = [
            SettingKey::LeadUm as u8,
            SettingKey::ButtonAccelUmS2 as u8,
            NAME_RECORD,
        ];
        for other in others.into_iter().filter(|other| *other != number) {
            let mut ages = Ages::new();
            ages.wrote(number);
            for _ in 0..Ages::OLDEST {
                ages.wrote(other);
                assert_eq!(ages.overdue(), None);
            }
            ages.wrote(other);
            assert_eq!(ages.overdue(), Some(number));
            ages.wrote(number);
            assert_eq!(ages.overdue(), None);
        }
    }
}

/// Not even the first setting of a newer firmware, whose number follows on ours.
#[test]
fn a_number_of_another_firmware_does_not_count() {
    for number in [SettingKey::ALL.len() as u8, 200] {
        let mut ages = Ages::new();
        ages.wrote(number);
        for _ in 0..1000 {
            ages.wrote(0);
        }
        assert_eq!(ages.overdue(), None);
        // Nor does it make the name look younger.
        let mut ages = Ages::new();
        ages.wrote(NAME_RECORD);
        for _ in 0..200 {
            ages.wrote(0);
        }
        ages.wrote(number);
        for _ in 0..56 {
            ages.wrote(0);
        }
        assert_eq!(ages.overdue(), Some(NAME_RECORD), "{number}");
    }
}
