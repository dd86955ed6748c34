//! A short run and its recording; and the paper's plan with replacements, each of which must occur in it.

use std::path::Path;

use jiff::Timestamp;
use lab::trials::experiment::PAPER_RUN;
use lab::trials::trial::Recording;
use protocol::rig::{Run, RunTiming};

/// Two cycles of 10 mm, 2 s each.
pub const SHORT_RUN: Run = Run {
    cycles: 2,
    stroke_um: 10_000,
    timing: RunTiming::Total {
        total_us: 4_000_000,
        accel_um_s2: 100_000,
    },
    ..PAPER_RUN
};

pub fn recording(folder: &Path, stem: &str, telemetry_ms: u16) -> Recording {
    Recording {
        folder: folder.to_owned(),
        stem: stem.to_owned(),
        now: Timestamp::UNIX_EPOCH,
        note: None,
        telemetry_ms,
    }
}

pub const PAPER: &str = include_str!("../../../examples/paper.toml");

/// Changes for trials of a single kind.
pub const ONE_CONDITION: [(&str, &str); 4] = [
    ("cycles = 5", "cycles = 1"),
    (r#"["dry", "lubricated"]"#, r#"["dry"]"#),
    (r#"["a1", "a2", "a3", "a4", "a5"]"#, r#"["a5"]"#),
    (
        "[fold_test]\nlubrication = \"lubricated\"\nindentation = \"a5\"\nrepeats = 1\n",
        "",
    ),
];

/// `plan` with each first text replaced by the second one.
pub fn changed(plan: &str, changes: &[(&str, &str)]) -> String {
    changes.iter().fold(plan.to_owned(), |plan, (old, new)| {
        assert_eq!(plan.matches(old).count(), 1, "`{old}` in the plan");
        plan.replace(old, new)
    })
}
