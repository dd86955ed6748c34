//! The texts of faults and refusals all differ.

use protocol::{
    capsule::CapsuleFault,
    error::Field,
    rig::{HomingPhase, RigFault, Switch},
    settings::{SettingKey, SettingRule},
    system::DeviceKind,
    table::Reply,
};
use std::{collections::BTreeSet, fmt::Display};

/// The texts; asserts that they all differ.
fn distinct<T: Display>(values: impl IntoIterator<Item = T>) -> Vec<String> {
    let texts: Vec<_> = values.into_iter().map(|value| value.to_string()).collect();
    let different: BTreeSet<_> = texts.iter().collect();
    assert_eq!(different.len(), texts.len(), "{texts:#?}");
    texts
}

const PHASES: [HomingPhase; 5] = [
    HomingPhase::Clear,
    HomingPhase::Seek,
    HomingPhase::PullOff,
    HomingPhase::Locate,
    HomingPhase::ToZero,
];

#[test]
fn a_fault_of_the_rig_says_what_to_do() {
    let mut faults = vec![
        RigFault::EStopLoop,
        RigFault::EStopFrame,
        RigFault::FarLimit,
        RigFault::FlagStuck,
        RigFault::BothSwitchesOpen,
        RigFault::LostSteps {
            residual_steps: -64,
        },
        RigFault::ReadBack {
            commanded: 104_000,
            counted: 103_999,
        },
        RigFault::Underrun,
        RigFault::WindowGuard,
        RigFault::Watchdog,
        RigFault::Panic,
        RigFault::ClockMissing,
        RigFault::ClockFailed,
        RigFault::SwitchNoise(Switch::HomeFlag),
        RigFault::SwitchNoise(Switch::FarLimit),
    ];
    faults.extend(PHASES.map(RigFault::FlagNotFound));
    faults.extend(PHASES.map(RigFault::HomingTimeout));
    for text in distinct(faults) {
        let (what, remedy) = text.rsplit_once(": ").expect(&text);
        assert!(what.len() > 10 && remedy.len() > 10, "{text}");
    }
    let text = |fault: RigFault| fault.to_string();
    assert!(
        text(RigFault::LostSteps {
            residual_steps: -64
        })
        .contains("-64 steps")
    );
    let read_back = text(RigFault::ReadBack {
        commanded: 104_000,
        counted: 103_999,
    });
    assert!(read_back.contains("103999") && read_back.contains("104000"));
    assert!(text(RigFault::FlagNotFound(HomingPhase::Locate)).contains("second pass"));
}

#[test]
fn a_fault_of_the_capsule_says_what_to_do() {
    let faults = [
        CapsuleFault::Jam { thread_um: 12_034 },
        CapsuleFault::ThreadBroken,
        CapsuleFault::EncoderLost,
        CapsuleFault::OverCurrent { current_ma: 900 },
        CapsuleFault::LowBattery { battery_mv: 2_600 },
        CapsuleFault::Timeout,
        CapsuleFault::DriverFault,
        CapsuleFault::EStopFrame,
        CapsuleFault::Watchdog,
        CapsuleFault::Panic,
        CapsuleFault::SpoolSlip,
        CapsuleFault::SlipOrBreak,
        CapsuleFault::BridgeSilent,
        CapsuleFault::SenseLost,
        CapsuleFault::NotUnfolded { wound_um: 9_001 },
        CapsuleFault::SenseOrEncoder,
    ];
    let texts = distinct(faults);
    for text in &texts {
        assert!(text.contains(": ") && text.len() > 30, "{text}");
    }
    assert!(texts[0].contains("12.034 mm"));
    assert!(texts[3].contains("900 mA"));
    assert!(texts[4].contains("2600 mV"));
    assert!(texts[14].contains("9.001 mm"));
}

#[test]
fn each_refusal_has_its_own_text() {
    let replies = exemplars::replies();
    let refusals = replies.iter().filter_map(|reply| match reply {
        Reply::Refused(refusal) => Some(refusal),
        _ => None,
    });
    for text in distinct(refusals) {
        assert!(text.len() > 10, "{text}");
    }
    let errors = replies.iter().filter_map(|reply| match reply {
        Reply::Wire(error) => Some(error),
        _ => None,
    });
    for text in distinct(errors) {
        assert!(text.len() > 10, "{text}");
    }
}

#[test]
fn each_field_has_its_own_name() {
    let fields = [
        Field::Cycles,
        Field::StrokeUm,
        Field::TotalUs,
        Field::AccelUmS2,
        Field::ForwardUmS,
        Field::ReturnUmS,
        Field::FarDwellUs,
        Field::HomeDwellUs,
        Field::StartDelayUs,
        Field::PeriodMs,
        Field::PositionUm,
        Field::SpeedUmS,
    ];
    for name in distinct(fields) {
        assert!(!name.is_empty());
    }
}

/// A rule names settings as the operator types them.
#[test]
fn each_rule_names_a_setting() {
    for text in distinct(SettingRule::ALL.map(SettingRule::text)) {
        let named = SettingKey::ALL.iter().any(|key| text.contains(key.name()));
        assert!(named, "{text}");
    }
}

#[test]
fn keys_have_numbers_in_order() {
    for (number, key) in (0..).zip(SettingKey::ALL) {
        assert_eq!(SettingKey::from_number(number), Some(key));
        assert_eq!(key as u8, number);
    }
    let count = u8::try_from(SettingKey::ALL.len()).expect("numbers are bytes");
    assert_eq!(SettingKey::from_number(count), None);
    assert_eq!(SettingKey::from_number(u8::MAX), None);
}

#[test]
fn a_setting_or_a_rule_is_of_the_machines_that_have_it() {
    let of = |kind| SettingKey::of(kind).collect::<Vec<_>>();
    let (rig, capsule) = (of(DeviceKind::Rig), of(DeviceKind::Capsule));
    assert!(rig.contains(&SettingKey::LeadUm) && capsule.contains(&SettingKey::EndForceMa));
    for key in SettingKey::ALL {
        let shared = matches!(key, SettingKey::LinkTimeoutMs | SettingKey::TelemetryMs);
        let both = rig.contains(&key) && capsule.contains(&key);
        assert_eq!(both, shared, "{key:?}");
        assert!(rig.contains(&key) || capsule.contains(&key), "{key:?}");
        for (kind, keys) in [(DeviceKind::Rig, &rig), (DeviceKind::Capsule, &capsule)] {
            assert_eq!(key.is_of(kind), keys.contains(&key), "{key:?}");
        }
    }
    let rules = |kind| SettingRule::of(kind).collect::<Vec<_>>();
    let (rig, capsule) = (rules(DeviceKind::Rig), rules(DeviceKind::Capsule));
    assert!(rig.contains(&SettingRule::FullSteps) && capsule.contains(&SettingRule::FoldHasARange));
    for rule in SettingRule::ALL {
        let both = rig.contains(&rule) && capsule.contains(&rule);
        assert_eq!(both, rule == SettingRule::TelemetryInterval, "{rule:?}");
        assert!(rig.contains(&rule) || capsule.contains(&rule), "{rule:?}");
    }
}
