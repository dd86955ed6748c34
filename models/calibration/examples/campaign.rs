//! The cost of a fit of the paper's campaign: 2 x 5 x 10 synthetic net displacements of the default body.
//! `cargo run --release -p calibration --example campaign`

#![allow(clippy::print_stdout, clippy::unwrap_used)]

use std::time::Instant;

use calibration::chance::stream;
use calibration::fit::{Settings, fit};
use calibration::observation::{Kind, Lubrication};
use calibration::prior::{Values, unknowns};
use calibration::synthetic::{Planned, observations};
use locomotion::model::Model;

fn main() {
    let truth = Values([0.15, 40.0, 0.0007, 0.05]).point();
    let mut planned = vec![];
    for lubrication in [Lubrication::Dry, Lubrication::Lubricated] {
        for a in [1.0, 2.0, 3.0, 4.0, 5.05] {
            planned.push(Planned {
                lubrication,
                ..Planned::dry(Kind::Net { cycles: 5 }, a, 10, 1.0)
            });
        }
    }
    let trials = observations(&Model::ONE, &truth, &planned, &mut stream(1, 1)).unwrap();
    let start = Instant::now();
    let fit = fit(&Model::ONE, &trials, &Settings::full(1)).unwrap();
    println!(
        "{} trials, {:.1} s, {} draws, step {} mm, table off by {:.2}",
        trials.len(),
        start.elapsed().as_secs_f64(),
        fit.draws.count(),
        fit.step_mm,
        fit.table_error
    );
    for (place, unknown) in unknowns().iter().enumerate() {
        let at = |part| fit.quantile(place, part);
        println!(
            "{:<22} {:.5} {:.5} {:.5}  {:?}",
            unknown.key,
            at(0.05),
            at(0.5),
            at(0.95),
            fit.mixing[place]
        );
    }
}
