//! Supply, reference and offset of the capsule's readings.

use firmware_capsule::sense::{MOST_OFFSET_MA, Offset, Reference, microvolts, millivolts};

/// What the ADC reads for `mv` at a supply of `supply_mv`.
fn reading(mv: f64, supply_mv: f64) -> u16 {
    (mv / supply_mv * 4_095.0) as u16
}

#[test]
fn the_supply_is_right_to_half_a_percent_over_the_range_of_the_reference() {
    // The STM32F411's factory reads it at 3.3 V, the STM32L412's at 3.0 V.
    for (reference_mv, factory_mv) in [1_180.0, 1_210.0, 1_240.0]
        .into_iter()
        .flat_map(|mv| [(mv, 3_300), (mv, 3_000)])
    {
        let word = reading(reference_mv, f64::from(factory_mv));
        let reference =
            Reference::from_factory(word, factory_mv).expect("in the range of the data sheet");
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
        assert_eq!(Reference::from_factory(word, 3_300), None, "{word}");
    }
    for word in [1_450, 1_555] {
        assert!(Reference::from_factory(word, 3_300).is_some(), "{word}");
    }
    let reference = Reference::typical();
    let factory = Reference::from_factory(1_502, 3_300);
    assert_eq!(reference, factory.expect("a word"));
    // 1.212 V, the STM32L412's typical reference, read at 3.0 V; taken for one at 3.3 V it would be 10 % off.
    assert!(Reference::from_factory(1_654, 3_000).is_some());
    for (word, supply_mv) in [(1_654, 3_300), (1_502, 3_000), (0xFFFF, 3_000)] {
        assert_eq!(Reference::from_factory(word, supply_mv), None, "{word}");
    }
    // Off, at its rail, and what 1,699 and 3,601 mV would make of it.
    for now in [0, 1, 1_376, 2_918, 4_095] {
        assert_eq!(reference.supply_mv(now), None, "{now}");
    }
    assert_eq!(reference.supply_mv(1_377), Some(3_600));
    assert_eq!(reference.supply_mv(2_916), Some(1_700));
}

#[test]
fn a_mean_is_rounded_and_scales_with_the_supply() {
    assert_eq!(millivolts(4_095 * 5, 5, 3_300), 3_300);
    assert_eq!(
        millivolts(4_095 * 10, 10, 3_600),
        3_600,
        "the largest sum fits"
    );
    assert_eq!(millivolts(1, 1, 3_300), 1, "0.8 mV");
    assert_eq!(microvolts(1, 1, 3_300), 806);
    assert_eq!(microvolts(2_048, 1, 2_950), 1_475_360);
    assert_eq!(millivolts(7, 0, 3_300), 0, "no reading, no voltage");
}

#[test]
fn an_offset_is_taken_at_rest_and_off_every_reading() {
    let mut offset = Offset::default();
    assert_eq!(offset.take_off(1_000, false, 12_000), 12_000, "just asleep");
    assert_eq!(
        offset.take_off(10_999, false, 12_000),
        12_000,
        "not settled"
    );
    assert_eq!(offset.offset_ma(), 0);
    assert_eq!(offset.take_off(11_000, false, 12_000), 0);
    assert_eq!(offset.offset_ma(), 12);
    assert_eq!(offset.take_off(12_000, true, 172_000), 160_000);
    assert_eq!(
        offset.take_off(13_000, true, 5_000),
        0,
        "never below nothing"
    );
    // Asleep again: the current of the motor that runs out is no offset.
    assert_eq!(offset.take_off(14_000, false, 400_000), 388_000);
    assert_eq!(offset.offset_ma(), 12);
}

/// The noise of one reading would be in all readings of a motion.
#[test]
fn the_offset_is_a_mean_and_follows_the_temperature() {
    let mut offset = Offset::default();
    offset.take_off(0, false, 12_000);
    let mut now_us = 10_000;
    for reading_ua in [10_000, 14_000].repeat(40) {
        offset.take_off(now_us, false, reading_ua);
        now_us += 100_000;
    }
    assert!((11_900..=12_100).contains(&(20_000 - offset.take_off(now_us, true, 20_000))));
    for _ in 0..200 {
        offset.take_off(now_us, false, 15_000);
        now_us += 100_000;
    }
    assert_eq!(offset.offset_ma(), 15);
    // An amplifier that fails is seen at once.
    offset.take_off(now_us, false, 1_650_000);
    assert_eq!(offset.offset_ma(), 1_650);
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
        let reading_ua = u32::from(reading_ma) * 1_000;
        offset.take_off(0, false, reading_ua);
        let shown_ua = offset.take_off(100_000, false, reading_ua);
        assert_eq!(shown_ua, u32::from(shown_ma) * 1_000);
        assert_eq!(offset.offset_ma(), reading_ma);
    }
}

#[test]
fn a_clock_that_steps_back_settles_nothing() {
    let mut offset = Offset::default();
    offset.take_off(50_000, false, 9_000);
    assert_eq!(offset.take_off(40_000, false, 9_000), 9_000);
}
