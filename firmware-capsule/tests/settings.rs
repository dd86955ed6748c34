//! Settings: their conversion, and the combinations that are refused.

use device::settings::Values;
use firmware_capsule::{
    mechanics::{POSSIBLE_FOLD, Thread},
    settings::Settings,
};
use proptest::prelude::*;
use protocol::{
    settings::{SettingKey as Key, SettingRule},
    system::DeviceKind,
};

fn with(changes: &[(Key, u32)]) -> Result<Settings, SettingRule> {
    let mut values = Values::DEFAULT;
    for (key, value) in changes {
        values = values.with(*key, *value).expect("within its range");
    }
    Settings::new(&values)
}

/// Current above no-load at a thread force: spool, gears and motor as in the data sheets.
fn current_ma(newton: f64) -> f64 {
    let torque_mnm = newton * 1.5 / (120.0 * 0.8 * 0.315);
    torque_mnm / 2.11 * 1e3
}

#[test]
fn currents_are_the_forces_they_stand_for() {
    let settings = Settings::REFERENCE;
    assert!((f64::from(settings.force_ma) - current_ma(5.61)).abs() < 1.0);
    assert!((f64::from(settings.rise_start_ma) - current_ma(2.78)).abs() < 1.0);
}

#[test]
fn the_defaults_are_what_the_population_was_tried_with() {
    let settings = Settings::REFERENCE;
    assert_eq!((settings.force_ma, settings.rise_start_ma), (132, 65));
    assert_eq!((settings.near_ma, settings.met_ma), ((102, 73), 97));
    assert_eq!(settings.resisted_ma, 130);
    assert_eq!((settings.fold_cps, settings.pay_out_cps), (9_330, 17_100));
    assert_eq!((settings.slow_cps, settings.near_cps), (5_700, 4_000));
    assert_eq!(settings.link_timeout_us, 1_000_000);
    let longest_um = settings.folded_range.1.0;
    for (calibrated_um, most_um) in [
        (longest_um - 1, longest_um),
        (longest_um + 1, longest_um + 1),
    ] {
        let limit = settings.seek_limit(Thread(calibrated_um));
        assert_eq!(limit, Thread(most_um + 1_000));
    }
}

#[test]
fn another_end_force_takes_its_neighbourhood_along_and_stays_within_what_is_given() {
    let settings = Settings::REFERENCE;
    assert_eq!(settings.with_force(1_000), settings);
    let more = settings.with_force(1_350);
    assert_eq!((more.force_ma, more.met_ma), (178, 130));
    assert_eq!((more.near_ma, more.resisted_ma), ((137, 98), 175));
    assert_eq!(settings.with_force(2_000).force_ma, 185);
    assert_eq!(more.rise_start_ma, settings.rise_start_ma);
}

#[test]
fn values_that_do_not_go_together_are_named() {
    let short = [(Key::LongestFoldUm, 16_999)];
    assert_eq!(with(&short), Err(SettingRule::FoldHasARange));
    assert!(with(&[(Key::LongestFoldUm, 17_000)]).is_ok());
    let high = [(Key::LoadedBatteryMv, 2_801)];
    assert_eq!(with(&high), Err(SettingRule::LoadedBelowRest));
    assert!(with(&[(Key::LoadedBatteryMv, 2_800)]).is_ok());
    for (period_ms, fine) in [(0, true), (1, false), (4, false), (5, true), (1_000, true)] {
        let settings = with(&[(Key::TelemetryMs, period_ms)]);
        assert_eq!(settings.is_ok(), fine, "{period_ms}");
    }
}

proptest! {
    /// With any accepted settings the limits keep their order: the force limit can be reached, the end is approached
    /// more slowly, and a calibration can be read back.
    #[test]
    fn limits_keep_their_order(fractions in prop::collection::vec(0.0..=1.0, Key::ALL.len())) {
        let mut values = Values::DEFAULT;
        for (key, fraction) in Key::of(DeviceKind::Capsule).zip(fractions) {
            let range = key.range();
            let value = range.min + (f64::from(range.max - range.min) * fraction) as u32;
            values = values.with(key, value).expect("within its range");
        }
        if let Ok(settings) = Settings::new(&values) {
            let (from_ma, to_ma) = settings.near_ma;
            prop_assert!(settings.rise_start_ma < to_ma && to_ma < settings.met_ma);
            prop_assert!(settings.met_ma < from_ma && from_ma < settings.force_ma);
            // The speed loop orders at most 220 mA, and the largest no-load current is 30 mA.
            prop_assert!(settings.force_ma + 30 < 220);
            prop_assert!(settings.near_cps < settings.slow_cps);
            prop_assert!(settings.slow_cps <= settings.fold_cps);
            let (shortest, longest) = settings.folded_range;
            prop_assert!(POSSIBLE_FOLD.0 <= shortest && longest <= POSSIBLE_FOLD.1);
            prop_assert!(Thread(0) < settings.end_tolerance);
            prop_assert!(settings.loaded_battery_mv < settings.least_battery_mv);
        }
    }
}
