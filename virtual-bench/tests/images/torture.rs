//! Two virtual minutes of `cargo xtask torture`, always the same.

use std::io::Write;

use virtual_bench::torture;

/// Where docs/testing.md begins, too.
const SEED: u64 = 0x7027_4000;
const MINUTES: u64 = 2;

#[test]
fn two_minutes_of_torture_break_no_rule() {
    // The seed at once: making a scenario shorter takes a while.
    let mut line = |text| drop(writeln!(std::io::stdout(), "{text}"));
    let tally = torture::run(SEED, MINUTES, &mut line).unwrap_or_else(|broken| panic!("{broken}"));
    // A series that reaches nothing finds nothing.
    let reached = tally.scenarios.iter().chain(&tally.answers[..2]);
    let reached = reached.chain(&tally.restarts[1..2]).chain(&tally.judged);
    assert!(reached.into_iter().all(|count| *count > 0), "{tally}");
}

#[test]
fn a_scenario_is_the_same_each_time() {
    let once = || torture::scenario(SEED).unwrap_or_else(|broken| panic!("{broken}"));
    assert_eq!(once(), once());
}
