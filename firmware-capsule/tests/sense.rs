//! Supply, reference and offset of the capsule's readings.

use firmware_capsule::sense::{self, FINE, MOST_OFFSET_MA, Reference, Zero, millivolts};

/// The ADC's reading of `mv` at a supply of `supply_mv`.
fn reads(mv: f64, supply_mv: f64) -> u16 {
    (mv / supply_mv * 4_095.0) as u16
}

#[test]
fn the_supply_is_right_to_half_a_percent_over_the_range_of_the_reference() {
    for reference_mv in [1_180.0, 1_210.0, 1_240.0] {
        let word = reads(reference_mv, 3_300.0);
        let reference = Reference::from_factory(word).expect("in the range of the data sheet");
        for supply_mv in (1_720..3_590).step_by(7) {
            let now = reads(reference_mv, f64::from(supply_mv));
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
    let reference = Reference::TYPICAL;
    assert_eq!(Reference::from_factory(1_502), Some(reference));
    // A reference that is off or at its rail, and its readings at supplies of 1,699 and 3,601 mV.
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
    assert_eq!(millivolts(7, 0, 3_300), 0, "no reading, no voltage");
}

/// A reading with this current, in the converter's fine steps.
fn reading(ma: f64) -> i32 {
    ((0.5 + ma / 3_300.0) * 4_095.0 * f64::from(FINE)).round() as i32
}

/// The current after the zero was taken off, mA.
fn taken_ma(zero: &mut Zero, now_us: u64, awake: bool, ma: f64) -> i16 {
    sense::ma(zero.take_off(now_us, awake, reading(ma), 3_300))
}

#[test]
fn the_zero_is_taken_at_rest_and_off_every_reading() {
    for offset in [12.0, -12.0] {
        let mut zero = Zero::default();
        let shown = offset as i16;
        assert_eq!(taken_ma(&mut zero, 1_000, true, offset), shown, "awake");
        assert_eq!(
            taken_ma(&mut zero, 2_000, false, offset),
            shown,
            "just asleep"
        );
        assert_eq!(
            taken_ma(&mut zero, 10_999, false, offset),
            shown,
            "not settled"
        );
        assert_eq!(zero.offset_ma(3_300), 0);
        assert_eq!(taken_ma(&mut zero, 11_000, false, offset), 0);
        assert_eq!(zero.offset_ma(3_300), shown);
        for current in [160.0, -160.0] {
            assert_eq!(
                taken_ma(&mut zero, 12_000, true, offset + current),
                current as i16
            );
        }
        // The bridge sleeps again: the current of a motor that runs out must not be taken for the offset.
        assert_eq!(taken_ma(&mut zero, 14_000, false, offset + 388.0), 388);
        assert_eq!(zero.offset_ma(3_300), shown);
    }
}

/// The amplifier's zero and the ADC's full scale both fall with an empty battery.
#[test]
fn the_zero_follows_the_supply() {
    let mut zero = Zero::default();
    let half = 4_095 * FINE / 2;
    assert_eq!(zero.take_off(0, true, half, 3_300), 0);
    assert_eq!(zero.take_off(0, true, half, 2_800), 0);
    let above = half + 100 * FINE;
    assert_eq!(sense::ma(zero.take_off(0, true, above, 3_300)), 81);
    assert_eq!(sense::ma(zero.take_off(0, true, above, 2_800)), 68);
}

/// A zero from a single reading would put its noise into all readings of a motion.
#[test]
fn the_offset_is_a_mean_and_follows_the_temperature() {
    let mut zero = Zero::default();
    taken_ma(&mut zero, 0, false, 12.0);
    let mut now_us = 10_000;
    for reading_ma in [10.0, 14.0].repeat(40) {
        taken_ma(&mut zero, now_us, false, reading_ma);
        now_us += 100_000;
    }
    assert_eq!(taken_ma(&mut zero, now_us, true, 20.0), 8);
    for _ in 0..200 {
        taken_ma(&mut zero, now_us, false, 15.0);
        now_us += 100_000;
    }
    assert_eq!(zero.offset_ma(3_300), 15);
    // An amplifier that fails is seen with the second reading.
    taken_ma(&mut zero, now_us, false, -1_650.0);
    assert_eq!((zero.offset_ma(3_300), zero.is_doubted()), (15, true));
    taken_ma(&mut zero, now_us + 1_000, false, -1_650.0);
    assert_eq!((zero.offset_ma(3_300), zero.is_doubted()), (-1_650, false));
}

/// The bridge has slept since the reset: the first reading is a zero, if the amplifier has settled.
#[test]
fn the_first_reading_after_a_start_is_the_zero() {
    for (now_us, offset_ma) in [(9_999, 0), (10_000, 12)] {
        let mut zero = Zero::default();
        taken_ma(&mut zero, now_us, false, 12.0);
        assert_eq!(zero.offset_ma(3_300), offset_ma, "{now_us} us");
    }
}

/// It would cost a referenced capsule its position.
#[test]
fn a_single_wrong_reading_is_no_zero() {
    let mut zero = Zero::default();
    for (ms, ma) in (10..).zip([4.0, 4.0, 900.0, 4.0, -900.0, 4.0]) {
        taken_ma(&mut zero, 1_000 * ms, false, ma);
        assert_eq!(zero.offset_ma(3_300), 4, "{ma} mA");
    }
}

/// 200 fine steps are 10 mA: noise up to there, which the mean follows slowly, and above another zero, if it comes twice.
#[test]
fn a_zero_that_jumps_is_another_one() {
    let half = 4_095 * FINE / 2;
    for (fine, off) in [(200, 188), (201, 0), (-200, -188), (-201, 0)] {
        let mut zero = Zero::default();
        for ms in 0..100 {
            zero.take_off(1_000 * ms, false, half, 3_300);
        }
        zero.take_off(100_000, false, half + fine, 3_300);
        let left_ua = zero.take_off(101_000, false, half + fine, 3_300);
        assert_eq!(left_ua, off * 3_300_000 / (4_095 * FINE), "{fine}");
    }
}

#[test]
fn an_offset_that_is_too_large_stays_in_the_reading() {
    let most = i16::try_from(MOST_OFFSET_MA).expect("it fits");
    for (reading_ma, shown_ma) in [
        (most, 0),
        (-most, 0),
        (most + 1, most + 1),
        (-most - 1, -most - 1),
        (1_650, 1_650),
        (-1_650, -1_650),
    ] {
        let mut zero = Zero::default();
        taken_ma(&mut zero, 0, false, reading_ma.into());
        let shown = taken_ma(&mut zero, 100_000, false, reading_ma.into());
        assert_eq!((shown, zero.offset_ma(3_300)), (shown_ma, reading_ma));
    }
}

#[test]
fn a_clock_that_steps_back_settles_nothing() {
    let mut zero = Zero::default();
    taken_ma(&mut zero, 49_000, true, 9.0);
    taken_ma(&mut zero, 50_000, false, 9.0);
    assert_eq!(taken_ma(&mut zero, 40_000, false, 9.0), 9);
}
