//! Settings: their conversion, and the combinations that are refused.

use device::settings::Values;
use firmware_capsule::settings::Settings;
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
fn the_defaults_are_what_the_population_was_tried_with() {
    let settings = Settings::REFERENCE;
    assert!((f64::from(settings.end_force_ma) - current_ma(5.61)).abs() < 1.0);
    assert_eq!((settings.fold_cps, settings.unfold_cps), (5_704, 8_149));
    assert_eq!(settings.link_timeout_us, 1_000_000);
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
    /// With any accepted settings the end force can be reached, and a calibration can be read back.
    #[test]
    fn limits_keep_their_order(fractions in prop::collection::vec(0.0..=1.0, Key::ALL.len())) {
        let mut values = Values::DEFAULT;
        for (key, fraction) in Key::of(DeviceKind::Capsule).zip(fractions) {
            let range = key.range();
            let value = range.min + (f64::from(range.max - range.min) * fraction) as u32;
            values = values.with(key, value).expect("within its range");
        }
        if let Ok(settings) = Settings::new(&values) {
            // The speed loop orders at most 220 mA, and the largest no-load current is 30 mA.
            prop_assert!(settings.end_force_ma + 30 < 220);
            let (shortest, longest) = settings.folded_range;
            prop_assert!(8_000 <= shortest.0 && longest.0 <= 28_000);
            prop_assert!(settings.loaded_battery_mv < settings.least_battery_mv);
        }
    }
}
