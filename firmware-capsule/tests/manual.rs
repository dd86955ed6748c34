//! The manual of the capsule lists every setting and every rule as the protocol has them.

use protocol::{
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
