//! R-hat and effective sample size against another program's values, and against defects that each of them must
//! reveal.

use calibration::chance::{normal, stream};
use calibration::diagnostics::{bulk_ess, r_hat, tail_ess};
use calibration::prior::UNKNOWNS;
use calibration::sampler::{Draws, Effort, Mixing, Place};
use std::collections::BTreeSet;

/// Chains that any program can reproduce: a linear congruential generator drives an autoregression.
fn chains(seed: u64, count: usize, length: usize, memory: f64, shift: f64) -> Vec<Vec<f64>> {
    let mut state = seed;
    let chain = |number: usize| {
        let mut x = 0.0;
        let mut one = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            x = memory * x + ((state >> 11) as f64 / (1u64 << 53) as f64 - 0.5);
            x + shift * number as f64
        };
        (0..length).map(|_| one()).collect()
    };
    (0..count).map(chain).collect()
}

/// Values of arviz-stats 0.8.0 for the same chains: `rhat(method="rank")`, `ess(method="bulk")` and
/// `ess(method="tail", prob=(0.05, 0.95))`.
#[test]
fn as_another_program_has_it() {
    for (seed, count, length, memory, shift, hat, ess, tail) in [
        (
            1,
            4,
            200,
            0.6,
            0.0,
            1.006_484_679_949_389_2,
            228.886_614_120_992_8,
            410.599_539_671_267_1,
        ),
        (
            2,
            4,
            200,
            0.0,
            0.0,
            1.000_937_947_739_667_6,
            809.573_454_413_395_1,
            742.821_847_406_133_2,
        ),
        (
            3,
            4,
            200,
            -0.4,
            0.0,
            1.003_820_136_812_945_8,
            2_025.410_798_173_902_5,
            726.156_652_794_946_8,
        ),
        (
            4,
            3,
            151,
            0.9,
            0.2,
            1.207_557_926_251_212,
            10.373_959_880_648_835,
            31.475_874_752_924_327,
        ),
        (
            5,
            4,
            400,
            0.95,
            0.0,
            1.071_413_186_639_065_3,
            50.097_939_206_083_66,
            76.206_343_659_539_47,
        ),
    ] {
        let chains = chains(seed, count, length, memory, shift);
        let found = (r_hat(&chains, 1), bulk_ess(&chains, 1));
        assert!(
            (found.0 - hat).abs() < 1e-9,
            "seed {seed}: {} for {hat}",
            found.0
        );
        assert!(
            (found.1 / ess - 1.0).abs() < 1e-9,
            "seed {seed}: {} effective for {ess}",
            found.1
        );
        let found = tail_ess(&chains, 1);
        assert!(
            (found / tail - 1.0).abs() < 1e-9,
            "seed {seed}: {found} effective in the tails for {tail}"
        );
    }
}

/// R-hat reveals one chain in another place, and one that is wider.
#[test]
fn chains_that_differ_show() {
    let good = chains(7, 4, 1_000, 0.3, 0.0);
    assert!(r_hat(&good, 1) < 1.01);
    let mut elsewhere = good.clone();
    elsewhere[2].iter_mut().for_each(|x| *x += 0.5);
    assert!(r_hat(&elsewhere, 1) > 1.05);
    let mut wider = good.clone();
    wider[2].iter_mut().for_each(|x| *x *= 4.0);
    assert!(r_hat(&wider, 1) > 1.05);
}

#[test]
fn what_cannot_be_judged_is_no_number() {
    assert!(r_hat(&[], 1).is_nan() && bulk_ess(&[], 1).is_nan() && tail_ess(&[], 1).is_nan());
    let short = vec![vec![1.0, 2.0, 3.0]; 4];
    assert!(r_hat(&short, 1).is_nan() && bulk_ess(&short, 1).is_nan());
    assert!(tail_ess(&short, 1).is_nan());
    let still = vec![vec![1.0; 100]; 4];
    assert!(r_hat(&still, 1).is_nan() && bulk_ess(&still, 1).is_nan());
    assert!(tail_ess(&still, 1).is_nan());
}

/// Walkers that all follow one path are worth one walker; independent ones count in full.
#[test]
fn walkers_count_for_what_they_are_worth() {
    let (walkers, steps) = (10, 500);
    let mut random = stream(1, 1);
    let mut ensembles = |together: bool| -> Vec<Vec<f64>> {
        let mut ensemble = || -> Vec<f64> {
            let mut row = || {
                let common = normal(&mut random);
                let mut own = || {
                    if together {
                        common
                    } else {
                        normal(&mut random)
                    }
                };
                (0..walkers).map(|_| own()).collect::<Vec<f64>>()
            };
            (0..steps).flat_map(|_| row()).collect()
        };
        (0..4).map(|_| ensemble()).collect()
    };
    let alike = bulk_ess(&ensembles(true), walkers);
    let own = bulk_ess(&ensembles(false), walkers);
    assert!((1_500.0..2_700.0).contains(&alike), "{alike}");
    assert!((15_000.0..27_000.0).contains(&own), "{own}");
}

/// Those of one walker depend on each other: 200 of 48,000 came from a single one of each ensemble.
#[test]
fn a_few_draws_are_those_of_all_walkers() {
    const WALKERS: usize = 24;
    for (steps, count) in [(500, 200), (1_000, 200), (2_000, 4_000)] {
        let point = |number: usize| {
            let mut point = [0.0; UNKNOWNS];
            point[0] = (number % WALKERS) as f64;
            point[1] = (number / WALKERS) as f64;
            point
        };
        let ensemble: Vec<_> = (0..steps * WALKERS).map(point).collect();
        let draws = Draws {
            walkers: WALKERS,
            ensembles: vec![ensemble; 4],
            accepted: 0.3,
        };
        let few = draws.thinned(count);
        assert_eq!(few.len(), count);
        let of_one = few.len() / 4;
        for ensemble in few.chunks(of_one) {
            let walkers: BTreeSet<_> = ensemble.iter().map(|point| point[0] as usize).collect();
            assert_eq!(walkers.len(), WALKERS, "{steps} steps, {count} draws");
            // In order, over all of the time.
            assert!(ensemble.is_sorted_by(|one, next| one[1] <= next[1]));
            assert!(ensemble[of_one - 1][1] - ensemble[0][1] > 0.95 * steps as f64);
        }
    }
}

#[test]
fn quantiles_need_all_three_numbers() {
    for (r_hat, ess, tail_ess, enough) in [
        (1.01, 400.0, 400.0, true),
        (1.010_1, 400.0, 400.0, false),
        (1.0, 399.9, 400.0, false),
        (1.0, 400.0, 399.9, false),
        (f64::NAN, 400.0, 400.0, false),
        (1.0, f64::NAN, 400.0, false),
        (1.0, 400.0, f64::NAN, false),
    ] {
        let one = Mixing {
            r_hat,
            ess,
            tail_ess,
        };
        assert_eq!(one.is_enough(), enough, "{one:?}");
    }
}

/// A program that reads the draws tells chains and steps by these numbers.
#[test]
fn a_draw_knows_its_ensemble_its_walker_and_its_step() {
    let point = |number: usize| [number as f64, 0.0, 0.0, 0.0];
    let draws = Draws {
        walkers: 2,
        ensembles: vec![(0..6).map(point).collect(), (6..12).map(point).collect()],
        accepted: 1.0,
    };
    assert_eq!(draws.count(), 12);
    for (number, (place, found)) in draws.all().enumerate() {
        let expected = Place {
            ensemble: number / 6,
            chain: number / 6 * 2 + number % 2,
            draw: number % 6 / 2,
        };
        assert_eq!((place, *found), (expected, point(number)));
    }
}

#[test]
fn an_effort_that_only_locates_keeps_no_more_than_it_needs() {
    let few = Effort {
        steps: 7,
        ..Effort::FULL
    };
    let many = Effort {
        steps: 501,
        ..Effort::FULL
    };
    assert_eq!((few.quick().steps, few.quick().doublings), (7, 0));
    assert_eq!((many.quick().steps, many.quick().doublings), (500, 0));
    assert_eq!(many.quick().walkers, Effort::FULL.walkers);
    let text = Effort::FULL.text();
    assert!(text.starts_with("4 ensembles of 24 walkers"), "{text}");
    assert!(text.contains("6 stages of 20 steps from 256"), "{text}");
}
