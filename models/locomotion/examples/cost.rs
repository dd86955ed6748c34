//! Prints what the models cost on this machine: `cargo run --release -p locomotion --example cost`.
#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::time::Instant;

use locomotion::beam::crescent::{Shape, Wing};
use locomotion::beam::thread;
use locomotion::comparison::frictions;
use locomotion::paper::pressures_pa;
use locomotion::{folded, roller, tube};
use rayon::prelude::*;

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
    let at = |friction: f64, pressure_pa: f64| {
        let mut params = tube::Params::PAPER;
        params.body.friction = friction;
        (params, pressure_pa)
    };
    let cases: Vec<_> = frictions()
        .map(|friction| at(friction, 7000.0))
        .chain(pressures_pa().map(|pressure_pa| at(0.15, pressure_pa)))
        .collect();
    let run = |(params, pressure_pa): &(tube::Params, f64)| {
        let _ = black_box(tube::averaged(black_box(*params), *pressure_pa));
    };
    let series = microseconds(20, || cases.iter().for_each(run));
    let parallel = microseconds(20, || cases.par_iter().for_each(run));
    let over_tip = Shape::Roller {
        radius_mm: 20.0,
        behind_mm: 0.0,
    };
    let beam = microseconds(200, || {
        let _ = black_box(black_box(Wing::PAPER).squeezed(0.0, 5.05, over_tip, 0.0));
    });
    let threaded = microseconds(50, || {
        let _ = black_box(thread::run(black_box(thread::Params::PAPER), 5.0, 5.05));
    });
    let threads = rayon::current_num_threads();
    println!("roller run, 5 cycles, 5.05 mm:          {roller:9.1} us");
    println!("folded run, 5 cycles, 5.05 mm:          {folded:9.3} us");
    println!("tube, 25 frictions and 11 pressures:    {series:9.1} us on one core");
    println!("the same on {threads} threads:                  {parallel:9.1} us");
    println!("beam: a wing under a roller, 5.05 mm:   {beam:9.1} us");
    println!("beam: a run with 5 mm of thread:        {threaded:9.1} us");
}
