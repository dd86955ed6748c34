//! The manual agrees with the code: every fault with its text, every setting with unit, range and default, every rule.

use protocol::{
    rig::{HomingPhase, RigFault, Switch},
    settings::{SettingKey, SettingRule},
    system::DeviceKind,
};

const MANUAL: &str = include_str!("../../docs/rig.md");

/// The row of a table that begins with `name` in code quotes, cell by cell.
fn row(name: &str) -> Vec<&'static str> {
    let start = format!("| `{name}` |");
    let mut rows = MANUAL.lines().filter(|line| line.starts_with(&start));
    let (row, more) = (rows.next(), rows.next());
    assert!(row.is_some() && more.is_none(), "{name} has no row, or two");
    row.unwrap().split(" | ").collect()
}

#[test]
fn every_fault_is_in_the_manual() {
    let faults = [
        RigFault::EStopLoop,
        RigFault::EStopFrame,
        RigFault::FarLimit,
        RigFault::FlagNotFound(HomingPhase::Seek),
        RigFault::HomingTimeout(HomingPhase::Seek),
        RigFault::FlagStuck,
        RigFault::BothSwitchesOpen,
        RigFault::LostSteps { residual_steps: 1 },
        RigFault::ReadBack {
            commanded: 1,
            counted: 2,
        },
        RigFault::Underrun,
        RigFault::WindowGuard,
        RigFault::Watchdog,
        RigFault::Panic,
        RigFault::ClockMissing,
        RigFault::ClockFailed,
        RigFault::SwitchNoise(Switch::FarLimit),
    ];
    for fault in faults {
        let name = match fault {
            RigFault::EStopLoop => "EStopLoop",
            RigFault::EStopFrame => "EStopFrame",
            RigFault::FarLimit => "FarLimit",
            RigFault::FlagNotFound(_) => "FlagNotFound",
            RigFault::HomingTimeout(_) => "HomingTimeout",
            RigFault::FlagStuck => "FlagStuck",
            RigFault::BothSwitchesOpen => "BothSwitchesOpen",
            RigFault::LostSteps { .. } => "LostSteps",
            RigFault::ReadBack { .. } => "ReadBack",
            RigFault::Underrun => "Underrun",
            RigFault::WindowGuard => "WindowGuard",
            RigFault::Watchdog => "Watchdog",
            RigFault::Panic => "Panic",
            RigFault::ClockMissing => "ClockMissing",
            RigFault::ClockFailed => "ClockFailed",
            RigFault::SwitchNoise(_) => "SwitchNoise",
        };
        let row = row(name);
        assert_eq!(row.len(), 4, "{name}: text, meaning, remedy");
        // The manual quotes a text with numbers only from behind the numbers.
        let text = fault.to_string();
        assert!(text.ends_with(row[1]), "{name}: {text}");
        assert!(row[1].len() >= 40, "{name}: quote more of the text");
    }
}

/// A number with commas.
fn number(value: u32) -> String {
    let digits = value.to_string();
    let groups = digits.as_bytes().rchunks(3).rev();
    let groups: Vec<_> = groups.map(|group| str::from_utf8(group).unwrap()).collect();
    groups.join(",")
}

/// The rows of the manual's table, generated.
fn settings_table() -> String {
    let row = |key: SettingKey| {
        let range = key.range();
        format!(
            "| `{}` | {} | {} to {} | {} | {} |\n",
            key.name(),
            key.unit().replace('1', "-"),
            number(range.min),
            number(range.max),
            number(range.default),
            key.doc()
        )
    };
    SettingKey::of(DeviceKind::Rig).map(row).collect()
}

#[test]
fn every_setting_is_in_the_manual() {
    let table = settings_table();
    assert!(
        MANUAL.contains(&format!("|---|---|---|---|---|\n{table}\n")),
        "put this table into docs/rig.md:\n{table}"
    );
}

#[test]
fn every_rule_is_in_the_manual() {
    let list: String = SettingRule::of(DeviceKind::Rig)
        .map(|rule| format!("- {}\n", rule.text()))
        .collect();
    assert!(
        MANUAL.contains(&format!("\n\n{list}\n")),
        "put this list into docs/rig.md:\n{list}"
    );
}
