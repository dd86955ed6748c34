//! Settings: ranges, rules, and homing with them.

use device::settings::Values;
use firmware_rig::{machine::Command, settings::Settings};
use motion::units::StepPosition;
use proptest::prelude::*;
use protocol::system::DeviceKind;
use protocol::{
    error::Refusal,
    rig::{RigFault, RigState},
    settings::{SettingKey, SettingRule},
};
use simulated_machines::carriage::Rig;

const DEFAULT: Values = Values::DEFAULT;

/// Checks a value as a device does: its range first, then the rules of all values together.
fn change(values: &Values, key: SettingKey, value: u32) -> Result<(Values, Settings), Refusal> {
    let values = values.with(key, value)?;
    match Settings::new(&values) {
        Ok(settings) => Ok((values, settings)),
        Err(rule) => Err(Refusal::SettingRule { key, rule }),
    }
}

fn set(values: &Values, key: SettingKey, value: u32) -> Values {
    match change(values, key, value) {
        Ok((values, _)) => values,
        Err(refusal) => panic!("{refusal}"),
    }
}

fn rule(values: &Values, key: SettingKey, value: u32) -> SettingRule {
    match change(values, key, value) {
        Err(Refusal::SettingRule { key: named, rule }) => {
            assert_eq!(named, key);
            rule
        }
        other => panic!("{} = {value}: {other:?}", key.name()),
    }
}

/// 800 steps per mm.
#[test]
fn the_defaults_are_the_papers_rig() {
    assert_eq!(Settings::new(&DEFAULT), Ok(Settings::REFERENCE));
    insta::assert_debug_snapshot!("default_settings", Settings::REFERENCE);
}

/// Both ends of every range, with all other settings at their defaults: in force, or refused by a named rule. One
/// beyond: refused for the range, which the text names.
#[test]
fn ranges_end_where_they_say() {
    use SettingKey as Key;
    for key in Key::of(DeviceKind::Rig) {
        let range = key.range();
        for (value, end) in [(range.min, "min"), (range.max, "max")] {
            let expected = match (key, end) {
                (Key::Microsteps, "max") => Some(SettingRule::HomingWithinStepRate),
                (Key::StrokeUm, "min") => Some(SettingRule::StrokeHoldsAStep),
                (Key::MaxStepHz, "min") => Some(SettingRule::HomingWithinStepRate),
                (Key::StepPulseNs, "max") => Some(SettingRule::PulseWithinStep),
                _ => None,
            };
            match change(&DEFAULT, key, value) {
                Ok((values, settings)) => {
                    assert_eq!(expected, None, "{} {end}", key.name());
                    assert_eq!(values.get(key), value);
                    assert_eq!(Settings::new(&values), Ok(settings));
                    // Nothing else has changed.
                    assert_eq!(set(&values, key, range.default), DEFAULT);
                }
                Err(refusal) => {
                    let rule =
                        expected.unwrap_or_else(|| panic!("{} {end}: {refusal}", key.name()));
                    assert_eq!(refusal, Refusal::SettingRule { key, rule });
                    assert!(refusal.to_string().contains(rule.text()));
                }
            }
        }
        for value in [range.min.checked_sub(1), range.max.checked_add(1)] {
            let Some(requested) = value else { continue };
            let refusal = Refusal::SettingRange { key, requested };
            assert_eq!(change(&DEFAULT, key, requested), Err(refusal));
            let text = refusal.to_string();
            assert!(text.contains(key.name()) && text.contains(&range.max.to_string()));
        }
    }
}

#[test]
fn every_rule_refuses_at_its_boundary() {
    use SettingKey as Key;
    let default = &DEFAULT;
    assert_eq!(rule(default, Key::FullSteps, 201), SettingRule::FullSteps);
    set(default, Key::FullSteps, 400);
    for microsteps in [3, 12, 255] {
        let refused = rule(default, Key::Microsteps, microsteps);
        assert_eq!(refused, SettingRule::Microsteps);
    }
    for shift in 0..=7 {
        set(default, Key::Microsteps, 1 << shift);
    }
    // One step of 1.25 um; with pull-off and flag out of the way.
    let near = set(&set(default, Key::FlagUm, 0), Key::PullOffUm, 100);
    assert_eq!(rule(&near, Key::StrokeUm, 1), SettingRule::StrokeHoldsAStep);
    assert_eq!(
        rule(&near, Key::StrokeUm, 99),
        SettingRule::FlagWithinStroke
    );
    set(&near, Key::StrokeUm, 100);
    // 50 mm per turn, 200 steps: 250 um each.
    let coarse = set(&set(default, Key::LeadUm, 50_000), Key::Microsteps, 1);
    let pull_off = rule(&coarse, Key::PullOffUm, 249);
    assert_eq!(pull_off, SettingRule::PullOffHoldsAStep);
    set(&coarse, Key::PullOffUm, 250);
    // 1,000 um of flag and 3,000 um of pull-off.
    let flag = rule(default, Key::StrokeUm, 3_999);
    assert_eq!(flag, SettingRule::FlagWithinStroke);
    let short = set(default, Key::StrokeUm, 4_000);
    let flag = rule(&short, Key::FlagUm, 1_001);
    assert_eq!(flag, SettingRule::FlagWithinStroke);
    // 4 us between two steps hold two of 2 us.
    let pulse = rule(default, Key::StepPulseNs, 2_001);
    assert_eq!(pulse, SettingRule::PulseWithinStep);
    let slow = set(default, Key::MaxStepHz, 50_000);
    set(&slow, Key::StepPulseNs, 10_000);
    // 20 mm/s at 800 steps per mm are 16 kHz.
    set(default, Key::MaxStepHz, 16_000);
    let rate = rule(default, Key::MaxStepHz, 15_999);
    assert_eq!(rate, SettingRule::HomingWithinStepRate);
    // The flag is left at twice the speed of the second pass.
    let slow = set(default, Key::MaxStepHz, 16_000);
    set(&slow, Key::LocateUmS, 10_000);
    let rate = rule(&slow, Key::LocateUmS, 10_001);
    assert_eq!(rate, SettingRule::HomingWithinStepRate);
    for off in 1..5 {
        let interval = rule(default, Key::TelemetryMs, off);
        assert_eq!(interval, SettingRule::TelemetryInterval);
    }
    set(default, Key::TelemetryMs, 5);
}

fn any_change() -> impl Strategy<Value = (SettingKey, u32)> {
    (
        prop::sample::select(SettingKey::of(DeviceKind::Rig).collect::<Vec<_>>()),
        any::<u32>(),
        0..4_u8,
    )
        .prop_map(|(key, random, kind)| {
            let range = key.range();
            let within = range.min + random % (range.max - range.min).saturating_add(1).max(1);
            let value = match kind {
                0 => random,
                1 => (range.min + random % 100).min(range.max),
                2 => 1 << (random % 9),
                _ => within,
            };
            (key, value)
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// Any changes in any order: the settings in force keep ranges and rules, a refusal changes nothing, and the
    /// records restore the settings.
    #[test]
    fn what_is_in_force_always_fits_together(
        changes in prop::collection::vec(any_change(), 1..60),
    ) {
        let mut values = DEFAULT;
        for (key, value) in changes {
            match change(&values, key, value) {
                Ok((next, settings)) => {
                    prop_assert_eq!(next.get(key), value);
                    prop_assert_eq!(Settings::new(&next), Ok(settings));
                    values = next;
                }
                Err(Refusal::SettingRange { .. }) => {
                    let range = key.range();
                    prop_assert!(!(range.min..=range.max).contains(&value));
                }
                Err(Refusal::SettingRule { key: named, rule }) => {
                    prop_assert_eq!(named, key);
                    prop_assert!(!rule.text().is_empty());
                }
                Err(other) => prop_assert!(false, "{:?}", other),
            }
        }
        let mut loaded = DEFAULT;
        for key in SettingKey::of(DeviceKind::Rig) {
            loaded.load(key as u8, &Values::record(values.get(key)));
        }
        prop_assert_eq!(loaded, values);
    }

}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// With any accepted settings homing finds 0, unless it times out or the carriage brakes too slowly to stop
    /// between flag and end of travel.
    #[test]
    fn every_accepted_settings_can_home(
        changes in prop::collection::vec(any_change(), 1..20),
        from in 0.0..1.0_f64,
    ) {
        let mut values = DEFAULT;
        for (key, value) in changes {
            if let Ok((next, _)) = change(&values, key, value) {
                values = next;
            }
        }
        // No more steps than a test can afford, where the rules allow it.
        let axis = Settings::new(&values).unwrap().axis;
        let most_um = axis.um_from_home(StepPosition(20_000)) as u32;
        let stroke_um = axis.stroke().0.min(most_um);
        let short = change(&values, SettingKey::StrokeUm, stroke_um);
        prop_assume!(short.is_ok());
        let (values, settings) = short.unwrap();
        let stroke = settings.axis.stroke_steps().0;
        let mut rig = Rig::new(settings, (from * f64::from(stroke)) as i32);
        rig.command(Command::Home).unwrap();
        rig.finish();
        let speed = f64::from(settings.seek_um_s.max(2 * settings.locate_um_s));
        let braking_um = speed * speed / (2.0 * f64::from(values.get(SettingKey::StopAccelUmS2)));
        match rig.fault() {
            None => prop_assert_eq!((rig.place, rig.machine.state()), (0, RigState::Ready)),
            Some(RigFault::HomingTimeout(_)) => {
                prop_assert!(rig.now / 100 > settings.homing_timeout_us);
            }
            // From the flag's edge to the end of travel, or from the far end of the way off the flag.
            Some(fault) => {
                let room_um = f64::from(settings.overtravel_um) / 2.0;
                prop_assert!(braking_um > room_um - 500.0, "{fault} {settings:?}");
            }
        }
    }
}
