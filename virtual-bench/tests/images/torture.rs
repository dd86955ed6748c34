//! Three virtual minutes of `cargo xtask torture`, always the same.

use virtual_bench::torture::{Tally, scenario};

/// Four that together carry out every order and meet every kind of restart.
const SEEDS: [u64; 4] = [0x7027_4011, 0x7027_4013, 0x7027_4023, 0x7027_4029];
const ORDERS: [&str; 16] = [
    "Acknowledge",
    "Calibrate",
    "CheckFolded",
    "FactoryReset",
    "Fold",
    "FoldTo",
    "Hold",
    "Home",
    "Jog",
    "MoveTo",
    "Reference",
    "Resume",
    "Run",
    "SetSetting",
    "SetTelemetry",
    "Unfold",
];

#[test]
fn three_minutes_of_torture_break_no_rule() {
    let tortured = |seed| scenario(seed).unwrap_or_else(|broken| panic!("{broken}"));
    let each = SEEDS.map(tortured);
    assert_eq!(
        each[1],
        tortured(SEEDS[1]),
        "a scenario is the same each time"
    );
    let mut all = Tally::default();
    each.into_iter().for_each(|one| all += one);
    assert!(all.virtual_ns >= 180_000_000_000, "{all}");
    // A series that reaches nothing finds nothing.
    assert_eq!(all.done.keys().copied().collect::<Vec<_>>(), ORDERS);
    let mut counts = all.restarts.iter().chain(&all.judged);
    assert!(counts.all(|count| *count > 0), "{all}");
}
