//! Tries the firmware's library on many seeded capsules and prints the tables of `docs/capsule-figures.md`.
//!
//! `cargo run --release -p firmware-capsule --example capsules [CASES PER FAULT]`, 500 unless told; with `--sensitivity` before it, what
//! each effect does alone.
#![allow(clippy::print_stdout, clippy::print_stderr)]

use capsule_plant::{Defect, Effect, Effects, Parameters, cases::Kind, verdict};
use simulated_machines::plant::cases::{self, Figures};
use std::collections::BTreeMap;

fn share(part: usize, whole: usize) -> f64 {
    100.0 * part as f64 / whole as f64
}

fn faults(count: u64, only: &[Kind]) {
    println!("{}", verdict::HEAD);
    for kind in Kind::wanted(only) {
        let count = if kind == Kind::Healthy {
            2 * count
        } else {
            count
        };
        let verdicts = verdict::all(count, |seed| cases::try_case(kind, seed));
        let wrong: Vec<_> = verdict::wrong(kind, &verdicts).take(20).collect();
        if !wrong.is_empty() {
            eprintln!("{kind:?}, wrong: {wrong:?}");
        }
        println!("{}", verdict::row(kind, &verdicts));
    }
}

fn healthy(count: u64) {
    let nominal = cases::figures(Parameters::nominal(), 0, 3).expect("it completes");
    println!("nominal: {nominal:.3?}");
    let found: Vec<Figures> = verdict::all(count, |seed| {
        cases::figures(Parameters::lifelike(seed), seed, 3)
    })
    .into_iter()
    .flatten()
    .collect();
    let whole = found.len();
    println!("{whole} of {count} healthy capsules completed three cycles");
    let within = found
        .iter()
        .filter(|f| (4.0..=9.0).contains(&f.end_n))
        .count();
    let most = |of: fn(&Figures) -> f64| found.iter().map(of).fold(f64::MIN, f64::max);
    println!(
        "end force within 4 to 9 N: {:.1} %, largest {:.2} N, largest on the way {:.2} N",
        share(within, whole),
        most(|f| f.end_n),
        most(|f| f.peak_n)
    );
    let honest = found
        .iter()
        .filter(|f| f.energy_error.abs() <= 0.05)
        .count();
    println!(
        "energy within 5 %: {:.1} %, worst {:.1} %, mean {:+.1} %",
        share(honest, whole),
        100.0 * most(|f| f.energy_error.abs()),
        100.0 * found.iter().map(|f| f.energy_error).sum::<f64>() / whole as f64
    );
    println!(
        "folded end repeats within {:.3} mm, unfolded end within {:.3} mm of zero",
        most(|f| f.fold_repeat_mm),
        most(|f| f.unfold_mm)
    );
    println!(
        "least thread on the spool {:.3} mm",
        -most(|f| -f.lowest_mm)
    );
    println!(
        "largest current from the cell, mean of a period: {:.0} mA",
        most(|f| f.peak_ma)
    );
    println!(
        "slowest fold {:.0} ms, unfolding {:.0} ms",
        most(|f| f.duration_ms[0].into()),
        most(|f| f.duration_ms[1].into())
    );
}

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

/// Prints how healthy capsules fold after changes of a normal life: warmth, wear, friction.
fn lives(count: u64) {
    println!(
        "| change | capsules | how three cycles end | least thread, mm | folded end off by at most, mm |"
    );
    println!("|---|---|---|---|---|");
    let found = verdict::all(2 * count, |seed| {
        cases::through_the_day(seed, Parameters::lifelike(seed))
    });
    let least = found.iter().map(|f| f.1).fold(f64::MAX, f64::min);
    println!(
        "| three cycles at 22 to 40 degrees | {} | {} | {least:.3} | - |",
        2 * count,
        counted(found.iter().map(|f| &f.0))
    );
    let found = verdict::all(count / 4, |seed| cases::grows_old(seed, 50));
    let least = found.iter().map(|f| f.1).fold(f64::MAX, f64::min);
    println!(
        "| 500 cycles | {} | {} | {least:.3} | - |",
        count / 4,
        counted(found.iter().map(|f| &f.0))
    );
    for times in [0.7, 0.8, 0.9, 1.1, 1.2, 1.3, 1.4] {
        let found = verdict::all(count, |seed| {
            cases::lives_on(Parameters::lifelike(seed), seed, &[Defect::Friction(times)])
        });
        let least = found.iter().map(|f| f.1).fold(f64::MAX, f64::min);
        let off = found.iter().map(|f| f.2).fold(0.0, f64::max);
        println!(
            "| friction in the worm x {times} | {count} | {} | {least:.3} | {off:.2} |",
            counted(found.iter().map(|f| &f.0))
        );
    }
    let found = verdict::all(count, cases::held_and_warmed);
    let least = found.iter().map(|f| f.1).fold(f64::MAX, f64::min);
    println!(
        "| folded at 22, held, unfolded at 37 degrees | {count} | {} | {least:.3} | - |",
        counted(found.iter().map(|f| &f.0))
    );
    for friction in [1.0, 0.7, 1.2, 1.4] {
        let found = verdict::all(count, |seed| cases::referenced_again(seed, friction));
        let least = found.iter().map(|f| f.1).fold(f64::MAX, f64::min);
        println!(
            "| friction in the worm x {friction}, a reference run between two cycles | {count} | {} | {least:.3} | - |",
            counted(found.iter().map(|f| &f.0))
        );
    }
    for obstacle in [false, true] {
        let found = verdict::all(count, |seed| cases::referenced_past(seed, obstacle));
        let least = found.iter().map(|f| f.1).fold(f64::MAX, f64::min);
        let what = if obstacle {
            "past 0.5 to 300 N/mm"
        } else {
            "nothing in the way"
        };
        println!(
            "| a reference run from anywhere, {what} | {count} | {} | {least:.3} | - |",
            counted(found.iter().map(|f| &f.0))
        );
    }
    let found = verdict::all(3 * count, cases::referenced_short);
    let off = found.iter().map(|f| f.1).fold(0.0, f64::max);
    let many = found.iter().filter(|f| f.1 > 0.3).count();
    println!(
        "| a reference run past 0.5 to 300 N/mm in its last 4 mm, and a fold | {} | {} | - | {off:.2}, above 0.3 in {many} |",
        3 * count,
        counted(found.iter().map(|f| &f.0))
    );
    let found = verdict::all(3 * count, cases::checked_short);
    let least = found.iter().map(|f| f.1).fold(f64::MAX, f64::min);
    println!(
        "| the same, then a reset, a check and an unfolding | {} | {} | {least:.3} | - |",
        3 * count,
        counted(found.iter().map(|f| &f.0))
    );
    let found = verdict::all(2 * count, cases::rescued);
    let least = found.iter().map(|f| f.1).fold(f64::MAX, f64::min);
    println!(
        "| the way out after a cut, a watchdog, an emergency stop or a silent host | {} | {} | {least:.3} | - |",
        2 * count,
        counted(found.iter().map(|f| &f.0))
    );
}

/// Each effect alone, as large as it is and twice as large: what it does to healthy capsules, and to the names of the others.
fn sensitivity(count: u64, only: &[Kind]) {
    println!(
        "| effect, alone | times | three cycles at 22 to 40 degrees | largest force, N | defects named rightly | otherwise |"
    );
    println!("|---|---|---|---|---|---|");
    let none = std::iter::once((None, 0.0));
    let some = Effect::ALL
        .into_iter()
        .flat_map(|effect| [1.0, 2.0].map(|times| (Some(effect), times)));
    for (effect, times) in none.chain(some) {
        let with = |parameters: Parameters| Parameters {
            effects: effect.map_or(Effects::NONE, |effect| {
                parameters.effects.only(effect, times)
            }),
            ..parameters
        };
        let healthy = verdict::all(count, |seed| {
            cases::through_the_day(seed, with(Parameters::lifelike(seed)))
        });
        let most_n = healthy.iter().map(|f| f.2).fold(0.0, f64::max);
        let (mut right, mut whole, mut otherwise) = (0, 0, Vec::new());
        for kind in Kind::wanted(only).filter(|kind| *kind != Kind::Healthy) {
            let verdicts = verdict::all(count / 4, |seed| {
                cases::try_with(kind, seed, with(kind.parameters(seed)))
            });
            let wrong = verdict::wrong(kind, &verdicts).map(|(_, name)| name);
            whole += verdicts.len();
            let wrong: Vec<_> = wrong.map(|name| format!("{kind:?} {name}")).collect();
            right += verdicts.len() - wrong.len();
            otherwise.extend(wrong);
        }
        println!(
            "| {} | {times} | {} | {most_n:.1} | {right} of {whole} | {} |",
            effect.map_or("none".to_owned(), |effect| format!("{effect:?}")),
            counted(healthy.iter().map(|f| &f.0)),
            counted(otherwise.iter()),
        );
    }
}

fn main() {
    let mut arguments = std::env::args().skip(1).peekable();
    let sensitive = arguments.next_if(|word| word == "--sensitivity").is_some();
    let count = arguments.next().map_or(Ok(500), |text| text.parse());
    let Ok(count) = count else {
        println!(
            "say how many cases per fault, such as 500, and which defects, if not all: `500 Jam Short`"
        );
        return;
    };
    let only = match arguments
        .map(|name| name.parse())
        .collect::<Result<Vec<Kind>, _>>()
    {
        Ok(only) => only,
        Err(why) => return println!("{why}"),
    };
    if sensitive {
        return sensitivity(count, &only);
    }
    if only.is_empty() {
        healthy(2 * count);
        lives(count);
    }
    faults(count, &only);
    if only.is_empty() {
        let lowest = verdict::all(300, cases::cut)
            .into_iter()
            .fold(f64::MAX, f64::min);
        println!("300 power cuts: least thread on the spool {lowest:.3} mm");
        let lowest = verdict::all(300, cases::cut_anywhere)
            .into_iter()
            .fold(f64::MAX, f64::min);
        println!("a cut each 8 ms of 300 unfoldings: least thread on the spool {lowest:.3} mm");
        for (folded, way) in [(true, "a check"), (false, "a reference run")] {
            let found = verdict::all(2 * count, |seed| {
                cases::found_again(Parameters::lifelike(seed), seed, folded)
            });
            let complete: Vec<_> = found.iter().flatten().collect();
            let least = |index: usize| {
                complete
                    .iter()
                    .map(|found| found[index])
                    .fold(f64::MAX, f64::min)
            };
            let most = complete
                .iter()
                .map(|found| found[1])
                .fold(f64::MIN, f64::max);
            println!(
                "{} of {} resets ended by {way}: least thread on the spool {:.3} mm, left by the unfolding {:.3} to {most:.3} mm",
                complete.len(),
                found.len(),
                least(0),
                least(1),
            );
        }
    }
}
