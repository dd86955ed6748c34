//! Tries the firmware's library on many seeded capsules and prints the tables of `docs/capsule.md`.
//!
//! `cargo run --release -p firmware-capsule --example capsules [CASES] [DEFECT ...]`, 200 cases unless told.
#![allow(clippy::print_stdout)]

use capsule_plant::{Parameters, cases::Kind, verdict};
use std::collections::BTreeMap;

#[path = "../tests/cases.rs"]
#[allow(dead_code)] // the tests use more of it
mod cases;

/// The names with how often each came, as a cell of a table.
fn counted<T>(found: &[T], name: impl Fn(&T) -> &str) -> String {
    let mut counts = BTreeMap::<&str, u32>::new();
    for case in found {
        *counts.entry(name(case)).or_default() += 1;
    }
    format!("{counts:?}")
}

fn most<T>(found: &[T], of: impl Fn(&T) -> f64) -> f64 {
    found.iter().map(of).fold(f64::MIN, f64::max)
}

fn lives(what: &str, count: u64, of: fn(u64) -> Parameters, (friction, warm): (f64, bool)) {
    let found = verdict::all(count, |seed| cases::life(of(seed), seed, friction, warm));
    println!(
        "| {what} | {} | {:.3} | {:.2} | {:.1} | {:.2} | {:.0}, {:.0} | {:.0} | {:.1} |",
        counted(&found, |life| &life.name),
        -most(&found, |life| -life.least_mm),
        most(&found, |life| life.left_mm),
        most(&found, |life| life.peak_n),
        most(&found, |life| life.short_mm),
        most(&found, |life| life.longest_ms[0].into()),
        most(&found, |life| life.longest_ms[1].into()),
        most(&found, |life| life.energy_mj),
        most(&found, |life| 100.0 * life.energy_error),
    );
}

fn faults(kind: Kind, count: u64) {
    let found = verdict::all(count, |seed| cases::try_case(kind, seed));
    let least_mm = -most(&found, |(_, least_mm)| -least_mm);
    let verdicts: Vec<_> = found.into_iter().map(|(verdict, _)| verdict).collect();
    println!(
        "{} least thread {least_mm:.3} mm",
        verdict::row(kind, &verdicts)
    );
    for (seed, name) in verdict::wrong(kind, &verdicts).take(5) {
        println!("  {kind:?}, seed {seed}: {name}");
    }
}

fn obstacles_and_cuts(count: u64) {
    let found = verdict::all(count, cases::obstacle);
    println!(
        "{count} obstacles: {}, at most {:.1} N, `Folded` short by at most {:.2} mm; then unfold: {}; least thread {:.3} mm",
        counted(&found, |(verdict, ..)| &verdict.name),
        most(&found, |(verdict, ..)| verdict.peak_n),
        most(&found, |(verdict, ..)| verdict.short_mm.unwrap_or(f64::MIN)),
        counted(&found, |(_, after, _)| after),
        -most(&found, |(.., least_mm)| -least_mm),
    );
    let mut found = verdict::all(count, cases::cut);
    println!(
        "{count} cuts of the power or resets: {}; least thread {:.3} mm",
        counted(&found, |(name, ..)| name),
        -most(&found, |(_, least_mm, _)| -least_mm),
    );
    found.retain(|(name, ..)| name.starts_with("Unfolded"));
    println!(
        "  left at most {:.2} mm",
        most(&found, |(.., left_mm)| *left_mm)
    );
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let count = arguments.next().map_or(Ok(200), |text| text.parse());
    let only: Result<Vec<Kind>, _> = arguments.map(|name| name.parse()).collect();
    let (Ok(count), Ok(only)) = (count, only) else {
        return println!("say how many cases, and which of {:?}", Kind::ALL);
    };
    if only.is_empty() {
        println!(
            "| three cycles | how they end | least thread, mm | left, mm | N | short, mm | fold, unfolding, ms | mJ | energy off, % |\n|---|---|---|---|---|---|---|---|---|"
        );
        lives("nominal", 1, |_| Parameters::nominal(), (1.0, false));
        lives("22 to 40 degrees", count, Parameters::lifelike, (1.0, true));
        for friction in [1.0, 0.7, 1.2, 1.4] {
            let what = format!("friction x {friction}");
            lives(&what, count, Parameters::lifelike, (friction, false));
        }
        obstacles_and_cuts(count);
    }
    println!("{}", verdict::HEAD);
    Kind::wanted(&only).for_each(|kind| faults(kind, count));
}
