//! Settings: values, ranges, rules, records in flash.

mod carriage;

use carriage::Rig;
use firmware_rig::{
    machine::Command,
    settings::{Ages, NAME_RECORD, Settings, Values},
};
use motion::{axis::Axis, run::Limits};
use proptest::prelude::*;
use protocol::{
    error::Refusal,
    rig::{RigFault, RigState},
    settings::{SettingKey, SettingRule},
};

const DEFAULT: Values = Values::DEFAULT;

fn set(values: &Values, key: SettingKey, value: u32) -> Values {
    match values.with(key, value) {
        Ok((values, _)) => values,
        Err(refusal) => panic!("{refusal}"),
    }
}

fn rule(values: &Values, key: SettingKey, value: u32) -> SettingRule {
    match values.with(key, value) {
        Err(Refusal::SettingRule { key: named, rule }) => {
            assert_eq!(named, key);
            rule
        }
        other => panic!("{} = {value}: {other:?}", key.name()),
    }
}

#[test]
fn the_defaults_are_the_papers_rig() {
    assert_eq!(Settings::new(&DEFAULT), Ok(Settings::REFERENCE));
    let Settings {
        axis,
        limits,
        pulse_ticks,
        seek_um_s,
        locate_um_s,
        homing_accel_um_s2,
        stop_accel_um_s2,
        overtravel_um,
        pull_off_um,
        flag_um,
        homing_timeout_us,
        ledger_limit_steps,
        link_timeout_us,
        dead_man_us,
    } = Settings::REFERENCE;
    assert_eq!(axis, Axis::REFERENCE);
    assert_eq!(
        limits,
        Limits {
            max_speed_um_s: 49_000,
            max_accel_um_s2: 2_000_000,
            min_interval_ticks: 400,
            min_turnaround_ticks: 100_000,
        }
    );
    assert_eq!((seek_um_s, locate_um_s), (20_000, 2_000));
    assert_eq!((homing_accel_um_s2, stop_accel_um_s2), (200_000, 1_000_000));
    assert_eq!(
        (overtravel_um, pull_off_um, flag_um),
        (10_000, 3_000, 1_000)
    );
    assert_eq!((pulse_ticks, ledger_limit_steps), (200, 8));
    assert_eq!(homing_timeout_us, 60_000_000);
    assert_eq!((link_timeout_us, dead_man_us), (1_000_000, 300_000));
}

/// Both ends of every range against the defaults: in force, or refused for a rule by name. One beyond: refused for
/// the range, which the text names.
#[test]
fn ranges_end_where_they_say() {
    use SettingKey as Key;
    for key in Key::ALL {
        let range = key.range();
        for (value, end) in [(range.min, "min"), (range.max, "max")] {
            let expected = match (key, end) {
                (Key::Microsteps, "max") => Some(SettingRule::HomingWithinStepRate),
                (Key::StrokeUm, "min") => Some(SettingRule::StrokeHoldsAStep),
                (Key::MaxStepHz, "min") => Some(SettingRule::HomingWithinStepRate),
                (Key::StepPulseNs, "max") => Some(SettingRule::PulseWithinStep),
                _ => None,
            };
            match DEFAULT.with(key, value) {
                Ok((values, settings)) => {
                    assert_eq!(expected, None, "{} {end}", key.name());
                    assert_eq!(values.get(key), value);
                    assert_eq!(Settings::new(&values), Ok(settings));
                    // And nothing else has changed.
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
            assert_eq!(DEFAULT.with(key, requested), Err(refusal));
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

/// Records of another firmware are left alone.
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

/// Numbers are for ever: they name the records of rigs in use.
#[test]
fn numbers_of_keys_stay() {
    for (number, key) in SettingKey::ALL.into_iter().enumerate() {
        assert_eq!(key as usize, number);
        assert_eq!(SettingKey::from_number(number as u8), Some(key));
        assert!(key.name().ends_with(&unit_in_name(key)), "{}", key.name());
    }
    assert_eq!(SettingKey::from_number(SettingKey::ALL.len() as u8), None);
    let pinned = [
        (SettingKey::LeadUm, 0),
        (SettingKey::StrokeUm, 3),
        (SettingKey::FlagUm, 15),
        (SettingKey::ButtonAccelUmS2, 25),
    ];
    for (key, number) in pinned {
        assert_eq!(key as u8, number);
    }
}

/// How a unit is written in a name.
fn unit_in_name(key: SettingKey) -> String {
    match key.unit() {
        "1" => String::new(),
        "steps/turn" => "steps".into(),
        unit => format!("_{}", unit.to_lowercase().replace('/', "_")),
    }
}

fn config() -> ProptestConfig {
    ProptestConfig {
        cases: 2_000,
        failure_persistence: None,
        rng_seed: prop::test_runner::RngSeed::Fixed(1),
        ..ProptestConfig::default()
    }
}

fn any_change() -> impl Strategy<Value = (SettingKey, u32)> {
    (
        prop::sample::select(SettingKey::ALL.to_vec()),
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
    #![proptest_config(config())]

    /// Whatever is asked for in whatever order: what is in force keeps ranges and rules, a refusal changes nothing,
    /// and the records give it back.
    #[test]
    fn what_is_in_force_always_fits_together(
        changes in prop::collection::vec(any_change(), 1..60),
    ) {
        let mut values = DEFAULT;
        for (key, value) in changes {
            match values.with(key, value) {
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
        for key in SettingKey::ALL {
            loaded.load(key as u8, &Values::record(values.get(key)));
        }
        prop_assert_eq!(loaded, values);
    }

    /// Whatever is accepted, homing finds 0 with it. Or its time is over; or the carriage brakes too slowly to stop
    /// between flag and end of travel.
    #[test]
    fn every_accepted_settings_can_home(
        changes in prop::collection::vec(any_change(), 1..20),
        from in 0.0..1.0_f64,
    ) {
        let mut values = DEFAULT;
        for (key, value) in changes {
            if let Ok((next, _)) = values.with(key, value) {
                values = next;
            }
        }
        let settings = Settings::new(&values).unwrap();
        let stroke = settings.axis.stroke_steps().0;
        if stroke > 20_000 {
            return Ok(()); // too many steps for a test
        }
        let mut rig = Rig::new(settings, (from * f64::from(stroke)) as i32);
        rig.command(Command::Home).unwrap();
        rig.finish();
        let speed = f64::from(settings.seek_um_s.max(2 * settings.locate_um_s));
        let braking_um = speed * speed / (2.0 * f64::from(settings.stop_accel_um_s2));
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

proptest! {
    /// Whatever is written and however often the rig starts anew: the last record of each number is young.
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
                    // A start: the log is read again, without the sectors that were dropped.
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

#[test]
fn a_number_of_another_firmware_does_not_count() {
    let mut ages = Ages::new();
    ages.wrote(200);
    for _ in 0..1000 {
        ages.wrote(0);
    }
    assert_eq!(ages.overdue(), None);
}
