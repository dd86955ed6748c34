//! Identifies seeded capsules and prints how often, and how narrowly: the table of `docs/capsule-figures.md`.
//!
//! `cargo run --release -p simulated-machines --features links --example identify [CAPSULES]`, 100 unless told.
#![allow(clippy::print_stdout)]

use capsule_plant::verdict;
use simulated_machines::population::{missed, tried};

fn main() {
    let count = std::env::args().nth(1).map_or(Ok(100), |text| text.parse());
    let Ok(count @ 1..) = count else {
        println!("say how many capsules, such as 100");
        return;
    };
    let tried = verdict::all(count, tried);
    let found: Vec<_> = tried.iter().flatten().collect();
    println!(
        "| parameter | within its uncertainty | median uncertainty | largest | largest error |"
    );
    println!("|---|---|---|---|---|");
    for (index, (name, ..)) in found[0].iter().enumerate() {
        let column: Vec<_> = found.iter().map(|row| row[index]).collect();
        let mut shares: Vec<f64> = column
            .iter()
            .map(|(_, truth, found)| found.uncertainty / truth)
            .collect();
        shares.sort_by(f64::total_cmp);
        let outside = column
            .iter()
            .filter(|one| !missed(&[**one]).is_empty())
            .count();
        let worst = column
            .iter()
            .map(|(_, truth, found)| (found.value / truth - 1.0).abs())
            .fold(0.0, f64::max);
        println!(
            "| `{name}` | {} of {count} | {:.1} % | {:.1} % | {:.1} % |",
            column.len() - outside,
            100.0 * shares[shares.len() / 2],
            100.0 * shares[shares.len() - 1],
            100.0 * worst
        );
    }
    let whole = found.iter().filter(|row| missed(row).is_empty()).count();
    println!("all six: {whole} of {count}");
    for (seed, one) in tried.iter().enumerate() {
        match one {
            Ok(row) if missed(row).is_empty() => {}
            Ok(row) => println!("seed {seed}: {:?}", missed(row)),
            Err(error) => println!("seed {seed}: refused, {error}"),
        }
    }
}
