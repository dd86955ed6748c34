//! Tries the firmware's library on many seeded capsules and prints the tables of `docs/capsule.md`.
//!
//! `cargo run --release -p firmware-capsule --example capsules [CASES] [DEFECT ...]`, 200 cases unless told.
#![allow(clippy::print_stdout)]

use capsule_plant::{Parameters, cases::Kind, verdict};
use cases::Life;
use std::collections::BTreeMap;

#[path = "../tests/cases.rs"]
#[allow(dead_code)] // the tests use more of it
mod cases;

/// The names with how often each came.
fn counted<'a>(names: impl Iterator<Item = &'a String>) -> String {
    let mut counts = BTreeMap::<&str, u32>::new();
    for name in names {
        *counts.entry(name).or_default() += 1;
    }
    let named: Vec<_> = counts
        .iter()
        .map(|(name, count)| format!("{name} {count}"))
        .collect();
    named.join(", ")
}

fn most<T>(found: &[T], of: impl Fn(&T) -> f64) -> f64 {
    found.iter().map(of).fold(f64::MIN, f64::max)
}

fn least<T>(found: &[T], of: impl Fn(&T) -> f64) -> f64 {
    found.iter().map(of).fold(f64::MAX, f64::min)
}

fn lives(what: &str, found: &[Life]) {
    println!(
        "| {what} | {} | {} | {:.3} | {:.2} | {:.1} | {:.2} | {:.0}, {:.0} | {:.0} | {:.1} |",
        found.len(),
        counted(found.iter().map(|life| &life.name)),
        least(found, |life| life.least_mm),
        most(found, |life| life.left_mm),
        most(found, |life| life.peak_n),
        most(found, |life| life.short_mm),
        most(found, |life| life.longest_ms[0].into()),
        most(found, |life| life.longest_ms[1].into()),
        most(found, |life| life.energy_mj),
        most(found, |life| 100.0 * life.energy_error),
    );
}

fn healthy(count: u64) {
    println!(
        "| three cycles | capsules | how they end | least thread, mm | left, mm | largest force, N | short, mm | fold, unfolding, ms | mJ | energy off, % |\n|---|---|---|---|---|---|---|---|---|---|"
    );
    lives(
        "nominal",
        &[cases::life(Parameters::nominal(), 0, 1.0, false)],
    );
    for (what, friction, warm) in [
        ("healthy", 1.0, false),
        ("22 to 40 degrees", 1.0, true),
        ("friction x 0.7", 0.7, false),
        ("friction x 1.2", 1.2, false),
        ("friction x 1.4", 1.4, false),
    ] {
        let found = verdict::all(count, |seed| {
            cases::life(Parameters::lifelike(seed), seed, friction, warm)
        });
        lives(what, &found);
    }
}

fn faults(count: u64, only: &[Kind]) {
    println!("{}", verdict::HEAD);
    for kind in Kind::wanted(only) {
        let found = verdict::all(count, |seed| cases::try_case(kind, seed));
        let least_mm = least(&found, |(_, least_mm)| *least_mm);
        let verdicts: Vec<_> = found.into_iter().map(|(verdict, _)| verdict).collect();
        println!(
            "{} least thread {least_mm:.3} mm",
            verdict::row(kind, &verdicts)
        );
        for (seed, name) in verdict::wrong(kind, &verdicts).take(5) {
            println!("  {kind:?}, seed {seed}: {name}");
        }
    }
}

fn obstacles(count: u64) {
    let found = verdict::all(count, cases::obstacle);
    println!(
        "{count} obstacles: {}, at most {:.1} N, `Folded` short by at most {:.2} mm; then unfold: {}; least thread {:.3} mm",
        counted(found.iter().map(|(verdict, ..)| &verdict.name)),
        most(&found, |(verdict, ..)| verdict.peak_n),
        most(&found, |(verdict, ..)| verdict.short_mm.unwrap_or(f64::MIN)),
        counted(found.iter().map(|(_, after, _)| after)),
        least(&found, |(.., least_mm)| *least_mm),
    );
}

fn cuts(count: u64) {
    let found = verdict::all(count, cases::cut);
    println!(
        "{count} cuts of the power or resets: {}; least thread {:.3} mm, left at most {:.2} mm",
        counted(found.iter().map(|(name, ..)| name)),
        least(&found, |(_, least_mm, _)| *least_mm),
        most(&found, |(name, _, left_mm)| {
            if name.starts_with("Unfolded") {
                *left_mm
            } else {
                0.0
            }
        }),
    );
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let count = arguments.next().map_or(Ok(200), |text| text.parse());
    let only: Result<Vec<Kind>, _> = arguments.map(|name| name.parse()).collect();
    let (Ok(count), Ok(only)) = (count, only) else {
        return println!(
            "say how many cases, such as 200, and which of {:?}, if not all",
            Kind::ALL
        );
    };
    if only.is_empty() {
        healthy(count);
        obstacles(count);
        cuts(count);
    }
    faults(count, &only);
}
