//! Prints what the models cost on this machine: `cargo run --release -p locomotion --example cost`.
#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::time::Instant;

use locomotion::{folded, roller, tube};

/// Best of several rounds, in microseconds per call.
fn microseconds(rounds: u32, mut work: impl FnMut()) -> f64 {
    (0..rounds)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64() * 1e6
        })
        .fold(f64::INFINITY, f64::min)
}

fn main() {
    let roller = microseconds(200, || {
        let _ = black_box(roller::run(
            black_box(roller::Params::PAPER),
            black_box(5.05),
        ));
    });
    let folded = microseconds(200, || {
        let _ = black_box(folded::run(
            black_box(folded::Params::PAPER),
            black_box(5.05),
        ));
    });
    let series = microseconds(20, || {
        for thousandths in (80..=200).step_by(5) {
            let mut params = tube::Params::PAPER;
            params.body.friction = f64::from(thousandths) / 1000.0;
            let _ = black_box(tube::run(black_box(params), 7000.0));
        }
        for pascals in (3000..=7000).step_by(400) {
            let _ = black_box(tube::run(
                black_box(tube::Params::PAPER),
                f64::from(pascals),
            ));
        }
    });
    println!("roller run, 5 cycles, 5.05 mm:          {roller:9.1} us");
    println!("folded run, 5 cycles, 5.05 mm:          {folded:9.3} us");
    println!("tube, 25 frictions and 11 pressures:    {series:9.1} us on one core");
}
