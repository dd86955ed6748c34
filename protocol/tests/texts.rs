//! The texts that an operator reads, and the settings with their ranges.

use protocol::{
    capsule::CapsuleFault,
    error::Refusal,
    rig::{HomingPhase, RigFault, Switch},
    settings::{SettingKey, SettingRule},
    system::DeviceKind,
    table::Reply,
};
use std::{collections::BTreeSet, fmt::Write};

const PHASES: [HomingPhase; 5] = [
    HomingPhase::Clear,
    HomingPhase::Seek,
    HomingPhase::PullOff,
    HomingPhase::Locate,
    HomingPhase::ToZero,
];

fn faults_of_the_rig() -> Vec<RigFault> {
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
    faults
}

const FAULTS_OF_THE_CAPSULE: [CapsuleFault; 14] = [
    CapsuleFault::Jam { thread_um: 12_034 },
    CapsuleFault::EncoderLost,
    CapsuleFault::OverCurrent { current_ma: 900 },
    CapsuleFault::LowBattery { battery_mv: 2_600 },
    CapsuleFault::Timeout,
    CapsuleFault::DriverFault,
    CapsuleFault::EStopFrame,
    CapsuleFault::Watchdog,
    CapsuleFault::Panic,
    CapsuleFault::SlipOrBreak,
    CapsuleFault::BridgeSilent,
    CapsuleFault::SenseLost,
    CapsuleFault::NotUnfolded { wound_um: 9_001 },
    CapsuleFault::SenseOrEncoder,
];

/// A fault says what happened, a colon, and what to do. No two texts are alike.
#[test]
fn faults_and_refusals_have_their_texts() {
    let rig = faults_of_the_rig().into_iter().map(|it| it.to_string());
    let capsule = FAULTS_OF_THE_CAPSULE.into_iter().map(|it| it.to_string());
    let mut all = Vec::new();
    for faults in [rig.collect::<Vec<_>>(), capsule.collect()] {
        let distinct: BTreeSet<_> = faults.iter().collect();
        assert_eq!(distinct.len(), faults.len(), "{faults:#?}");
        for text in faults {
            let (what, remedy) = text.rsplit_once(": ").expect(&text);
            assert!(what.len() > 10 && remedy.len() > 10, "{text}");
            all.push(text);
        }
    }
    let refusals = exemplars::replies()
        .into_iter()
        .filter_map(|reply| match reply {
            Reply::Refused(refusal) => Some(refusal.to_string()),
            Reply::Wire(error) => Some(error.to_string()),
            Reply::Accepted(_) | Reply::Urgent(_) => None,
        });
    let refusals: Vec<_> = refusals.collect();
    let distinct: BTreeSet<_> = refusals.iter().collect();
    assert_eq!(distinct.len(), refusals.len(), "{refusals:#?}");
    all.extend(refusals);
    insta::assert_snapshot!("texts", all.join("\n"));
}

/// Numbers never change: they name the records in the flash of machines in use. A rule names settings as the operator
/// types them.
#[test]
fn settings_and_rules_stay() {
    let owners = |is_of: &dyn Fn(DeviceKind) -> bool| match (
        is_of(DeviceKind::Rig),
        is_of(DeviceKind::Capsule),
    ) {
        (true, false) => "rig",
        (false, true) => "capsule",
        (true, true) => "both",
        (false, false) => "none",
    };
    let mut table = String::new();
    for (number, key) in SettingKey::ALL.into_iter().enumerate() {
        assert_eq!(SettingKey::from_number(key as u8), Some(key));
        assert_eq!(key as usize, number);
        let (range, owner) = (key.range(), owners(&|kind| key.is_of(kind)));
        let (name, unit) = (key.name(), key.unit());
        let (min, max, default) = (range.min, range.max, range.default);
        let _ = writeln!(
            table,
            "{number} {name} ({unit}) of {owner}: {min} to {max}, {default}"
        );
    }
    assert_eq!(SettingKey::from_number(SettingKey::ALL.len() as u8), None);
    for rule in SettingRule::ALL {
        let of = |kind| SettingRule::of(kind).any(|it| it == rule);
        let (text, owner) = (rule.text(), owners(&of));
        let named = SettingKey::ALL.iter().any(|key| text.contains(key.name()));
        assert!(named, "{text}");
        let _ = writeln!(table, "{rule:?} of {owner}: {text}");
    }
    insta::assert_snapshot!("settings", table);
}

#[test]
fn no_text_shows_a_number_that_stands_for_none() {
    let text = Refusal::TooFast {
        requested_us: 1,
        min_us: 2,
        min_accel_um_s2: u64::MAX,
    }
    .to_string();
    assert!(!text.contains("18446744073709551615"), "{text}");
}
