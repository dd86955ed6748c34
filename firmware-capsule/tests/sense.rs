//! Supply, reference and offset of the capsule's readings.

use firmware_capsule::sense::{MOST_OFFSET_MA, Offset, Reference, millivolts};

/// What the ADC reads for `mv` at a supply of `supply_mv`.
fn reading(mv: f64, supply_mv: f64) -> u16 {
    (mv / supply_mv * 4_095.0) as u16
}

#[test]
fn the_supply_is_right_to_half_a_percent_over_the_range_of_the_reference() {
    for reference_mv in [1_180.0, 1_210.0, 1_240.0] {
        let word = reading(reference_mv, 3_300.0);
        let reference = Reference::from_factory(word).expect("in the range of the data sheet");
        for supply_mv in (1_720..3_590).step_by(7) {
            let now = reading(reference_mv, f64::from(supply_mv));
            let measured = reference.supply_mv(now).expect("the chip runs on it");
            let error = f64::from(measured) / f64::from(supply_mv) - 1.0;
            assert!(error.abs() < 0.005, "{measured} mV for {supply_mv} mV");
        }
    }
}

#[test]
fn what_cannot_be_a_reading_of_the_reference_is_none() {
    for word in [0, 1_449, 1_556, 0x0FFF, 0xFFFF] {
        assert_eq!(Reference::from_factory(word), None, "{word}");
    }
    for word in [1_450, 1_555] {
        assert!(Reference::from_factory(word).is_some(), "{word}");
    }
    let reference = Reference::typical();
    assert_eq!(reference, Reference::from_factory(1_502).expect("a word"));
    // Off, at its rail, and what 1,699 and 3,601 mV would make of it.
    for now in [0, 1, 1_376, 2_918, 4_095] {
        assert_eq!(reference.supply_mv(now), None, "{now}");
    }
    assert_eq!(reference.supply_mv(1_377), Some(3_600));
    assert_eq!(reference.supply_mv(2_916), Some(1_700));
}

#[test]
fn a_mean_is_rounded_down_and_scales_with_the_supply() {
    assert_eq!(millivolts(4_095 * 5, 5, 3_300), 3_300);
    assert_eq!(
        millivolts(4_095 * 10, 10, 3_600),
        3_600,
        "the largest sum fits"
    );
    assert_eq!(millivolts(1, 1, 3_300), 0);
    assert_eq!(millivolts(2_048, 1, 2_950), 1_475);
    assert_eq!(millivolts(7, 0, 3_300), 0, "no reading, no voltage");
}

#[test]
fn an_offset_is_taken_at_rest_and_off_every_reading() {
    let mut offset = Offset::default();
    assert_eq!(offset.take_off(1_000, false, 12), 12, "just fallen asleep");
    assert_eq!(offset.take_off(10_999, false, 12), 12, "not settled");
    assert_eq!(offset.offset_ma(), 0);
    assert_eq!(offset.take_off(11_000, false, 12), 0);
    assert_eq!(offset.offset_ma(), 12);
    assert_eq!(offset.take_off(12_000, true, 172), 160);
    assert_eq!(offset.take_off(13_000, true, 5), 0, "never below nothing");
    // Asleep again: the current of the motor that runs out is no offset.
    assert_eq!(offset.take_off(14_000, false, 400), 388);
    assert_eq!(offset.offset_ma(), 12);
    assert_eq!(offset.take_off(114_000, false, 13), 0);
    assert_eq!(offset.offset_ma(), 13, "it follows the temperature");
}

#[test]
fn an_offset_that_is_too_large_stays_in_the_reading() {
    for (reading_ma, shown_ma) in [
        (MOST_OFFSET_MA, 0),
        (MOST_OFFSET_MA + 1, MOST_OFFSET_MA + 1),
        (1_650, 1_650),
        (u16::MAX, u16::MAX),
    ] {
        let mut offset = Offset::default();
        offset.take_off(0, false, reading_ma);
        assert_eq!(offset.take_off(100_000, false, reading_ma), shown_ma);
        assert_eq!(offset.offset_ma(), reading_ma);
    }
}

#[test]
fn a_clock_that_steps_back_settles_nothing() {
    let mut offset = Offset::default();
    offset.take_off(50_000, false, 9);
    assert_eq!(offset.take_off(40_000, false, 9), 9);
}
