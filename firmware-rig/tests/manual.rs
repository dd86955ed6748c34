//! The manual says what the code says: every fault with its text, every setting with its default.

use firmware_rig::settings::Settings;
use motion::run::Limits;
use protocol::rig::{HomingPhase, RigFault};

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
    ];
    for fault in faults {
        let name = match fault {
            RigFault::EStopLoop => "EStopLoop",
            RigFault::EStopFrame => "EStopFrame",
            RigFault::FarLimit => "FarLimit",
            RigFault::FlagNotFound(_) => "FlagNotFound",
            RigFault::FlagStuck => "FlagStuck",
            RigFault::BothSwitchesOpen => "BothSwitchesOpen",
            RigFault::LostSteps { .. } => "LostSteps",
            RigFault::ReadBack { .. } => "ReadBack",
            RigFault::Underrun => "Underrun",
            RigFault::WindowGuard => "WindowGuard",
            RigFault::Watchdog => "Watchdog",
            RigFault::Panic => "Panic",
        };
        let row = row(name);
        assert_eq!(row.len(), 4, "{name}: text, meaning, remedy");
        // Texts with numbers are quoted from behind these.
        let text = fault.to_string();
        assert!(text.ends_with(row[1]), "{name}: {text}");
        assert!(row[1].len() >= 40, "{name}: quote more of the text");
    }
}

#[test]
fn every_setting_is_in_the_manual() {
    // Without "..": a new field has to be named here.
    let Settings {
        axis,
        limits:
            Limits {
                max_speed_um_s,
                max_accel_um_s2,
                min_interval_ticks,
                min_turnaround_ticks,
            },
        seek_um_s,
        locate_um_s,
        homing_accel_um_s2,
        stop_accel_um_s2,
        overtravel_um,
        pull_off_um,
        flag_um,
        ledger_limit_steps,
        link_timeout_us,
    } = Settings::REFERENCE;
    let defaults: [(&str, u64); 17] = [
        ("lead_um", axis.lead().0.into()),
        ("full_steps_per_rev", axis.full_steps_per_rev().into()),
        ("microsteps", axis.microsteps().into()),
        ("stroke_um", axis.stroke().0.into()),
        ("max_speed_um_s", max_speed_um_s.into()),
        ("max_accel_um_s2", max_accel_um_s2.into()),
        ("min_interval_ticks", min_interval_ticks.into()),
        ("min_turnaround_ticks", min_turnaround_ticks.into()),
        ("seek_um_s", seek_um_s.into()),
        ("locate_um_s", locate_um_s.into()),
        ("homing_accel_um_s2", homing_accel_um_s2.into()),
        ("stop_accel_um_s2", stop_accel_um_s2.into()),
        ("overtravel_um", overtravel_um.into()),
        ("pull_off_um", pull_off_um.into()),
        ("flag_um", flag_um.into()),
        ("ledger_limit_steps", ledger_limit_steps.into()),
        ("link_timeout_us", link_timeout_us),
    ];
    for (name, default) in defaults {
        let row = row(name);
        assert_eq!(row.len(), 5, "{name}: unit, range, default, what it is");
        assert_eq!(row[3].replace(',', ""), default.to_string(), "{name}");
    }
}
