//! The manual of the capsule lists every fault, every setting and every rule as the protocol has them.

use protocol::{
    capsule::CapsuleFault,
    settings::{SettingKey, SettingRule},
    system::DeviceKind,
};

const MANUAL: &str = include_str!("../../docs/capsule.md");

/// A number with commas.
fn number(value: u32) -> String {
    let digits = value.to_string();
    let groups = digits.as_bytes().rchunks(3).rev();
    let groups: Vec<_> = groups
        .map(|group| str::from_utf8(group).expect("digits"))
        .collect();
    groups.join(",")
}

#[test]
fn every_fault_is_in_the_manual() {
    for fault in [
        CapsuleFault::Jam { thread_um: 1 },
        CapsuleFault::SlipOrBreak,
        CapsuleFault::EncoderLost,
        CapsuleFault::BridgeSilent,
        CapsuleFault::SenseLost,
        CapsuleFault::SenseOrEncoder,
        CapsuleFault::OverCurrent { current_ma: 1 },
        CapsuleFault::LowBattery { battery_mv: 1 },
        CapsuleFault::DriverFault,
        CapsuleFault::NotUnfolded { wound_um: 1 },
        CapsuleFault::Timeout,
        CapsuleFault::EStopFrame,
        CapsuleFault::Watchdog,
        CapsuleFault::Panic,
    ] {
        let shown = format!("{fault:?}");
        let name = shown.split(' ').next().expect("a name");
        let start = format!("| `{name}` | ");
        let rows: Vec<_> = MANUAL
            .lines()
            .filter_map(|line| line.strip_prefix(&start))
            .collect();
        let [row] = rows[..] else {
            panic!("{name}: {rows:?}");
        };
        let text = fault
            .to_string()
            .replace("0.001", "1")
            .replace(" 1 m", " N m");
        assert!(row.starts_with(&format!("{text} | ")), "{name}: {text}");
    }
}

#[test]
fn every_setting_is_in_the_manual() {
    let row = |key: SettingKey| {
        let range = key.range();
        format!(
            "| `{}` | {} | {} to {} | {} | {} |\n",
            key.name(),
            key.unit(),
            number(range.min),
            number(range.max),
            number(range.default),
            key.doc()
        )
    };
    let table: String = SettingKey::of(DeviceKind::Capsule).map(row).collect();
    assert!(
        MANUAL.contains(&format!("|---|---|---|---|---|\n{table}\n")),
        "put this table into docs/capsule.md:\n{table}"
    );
}

#[test]
fn every_rule_is_in_the_manual() {
    for rule in SettingRule::of(DeviceKind::Capsule) {
        assert!(MANUAL.contains(&format!("- {}\n", rule.text())), "{rule:?}");
    }
}
