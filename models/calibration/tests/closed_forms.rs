//! The gain of trials against closed forms, with a linear stand-in for the model, so that everything is normal.

use calibration::belief::Belief;
use calibration::chance::{normal, stream};
use calibration::design::{Effort, Estimate, choose, judge};
use calibration::history::Trial;
use calibration::prior::Point;

const EFFORT: Effort = Effort {
    histories: 96,
    draws: 512,
};
/// Standard errors within which an estimate has to lie; chance exceeds four of them once in 16,000 times.
const ERRORS: f64 = 4.0;
/// Error that the correction for the finite number of draws may leave, nats.
const BIAS: f64 = 0.01;

const STRONG: f64 = 3.0;
const MIXED: f64 = 1.0;

/// Displacements: of the first unknown, of the first two together, and a constant.
fn linear(point: &Point) -> Option<Vec<f64>> {
    Some(vec![STRONG * point[0], MIXED * (point[0] + point[1]), 7.0])
}

/// A trial of one displacement, in its own condition, without a discrepancy.
fn trial(place: usize, error_mm: f64) -> Trial {
    Trial {
        condition: place,
        place,
        discrepancies: 0.0,
        error_mm,
    }
}

fn close(found: Estimate, exact: f64) {
    assert!(
        found.error < 0.1,
        "an error of {} shows nothing",
        found.error
    );
    assert!(
        (found.mean - exact).abs() < ERRORS * found.error + BIAS,
        "{found:?}, not {exact}"
    );
}

/// The gain is 1/2 ln(1 + s^2/v) for one trial, and 1/2 ln det for two.
#[test]
fn a_linear_model_gives_the_closed_form() {
    for error_mm in [0.1, 1.0, 10.0] {
        let v = error_mm * error_mm;
        let trials = [trial(0, error_mm), trial(1, error_mm)];
        let judged = judge(&Belief::Prior, &linear, &trials, &EFFORT, 1).expect("covered");
        let first = 0.5 * (1.0 + STRONG * STRONG / v).ln();
        // I + A A^T / v, with the rows (s, 0) and (m, m).
        let (a, b, c) = (
            1.0 + STRONG * STRONG / v,
            STRONG * MIXED / v,
            1.0 + 2.0 * MIXED * MIXED / v,
        );
        let both = 0.5 * (a * c - b * b).ln();
        eprintln!("{error_mm}: {judged:?} {first} {both}");
        close(judged.gains[0], first);
        close(judged.sums[1], both);
    }
}

/// Repeats reduce the measurement error but not the model's error: after many repeats the next one tells nothing.
#[test]
fn repeats_of_a_condition_tell_less_each_time() {
    let trials = [trial(0, 1.0); 2];
    let judged = judge(&Belief::Prior, &linear, &trials, &EFFORT, 2).expect("covered");
    let exact = |repeats: f64| 0.5 * (1.0 + STRONG * STRONG * repeats).ln();
    close(judged.gains[0], exact(1.0));
    close(judged.sums[1], exact(2.0));
    assert!(
        judged.sums[1].mean < 2.0 * judged.gains[0].mean - 0.5,
        "{judged:?}"
    );
}

#[test]
fn a_condition_that_was_repeated_without_end_has_nothing_left_but_its_discrepancy() {
    let wrong = |condition: usize| Trial {
        condition,
        place: 0,
        discrepancies: 7.0,
        error_mm: 1e-2,
    };
    let again = [wrong(0), wrong(0)];
    let elsewhere = [wrong(0), wrong(1)];
    let of =
        |trials: &[Trial]| judge(&Belief::Prior, &linear, trials, &EFFORT, 3).expect("covered");
    let (again, elsewhere) = (of(&again), of(&elsewhere));
    assert!(again.gains[1].mean < 0.05, "{again:?}");
    assert!(elsewhere.gains[1].mean > 0.3, "{elsewhere:?}");
}

#[test]
fn what_is_the_same_for_all_bodies_tells_nothing_and_no_gain_is_negative() {
    let trials = [
        trial(2, 0.5),
        trial(0, 0.3),
        trial(2, 0.5),
        trial(1, 0.3),
        trial(0, 30.0),
    ];
    let judged = judge(&Belief::Prior, &linear, &trials, &EFFORT, 4).expect("covered");
    close(judged.gains[0], 0.0);
    close(judged.gains[2], 0.0);
    for gain in &judged.gains {
        assert!(gain.mean > -ERRORS * gain.error - BIAS, "{gain:?}");
    }
}

/// The scatter of a trial about a body shows the discrepancy, which is not part of the body.
#[test]
fn what_only_the_discrepancy_shows_in_tells_nothing_of_the_body() {
    let nothing = |condition: usize| Trial {
        condition,
        discrepancies: 7.0,
        ..trial(2, 0.1)
    };
    let trials = [nothing(0), nothing(1), nothing(0), nothing(2)];
    let judged = judge(&Belief::Prior, &linear, &trials, &EFFORT, 10).expect("covered");
    for gain in &judged.gains {
        close(*gain, 0.0);
    }
    // Tau is determined nevertheless.
    assert!(
        judged.after[3].mean < 0.8 * judged.before[3].mean,
        "{judged:?}"
    );
}

/// The widths are those of a normal posterior. The logarithm of tau is the fourth coordinate, so its 90 % interval is
/// exp(2 x 1.645) wide.
#[test]
fn a_width_is_that_of_the_posterior() {
    let sees = |point: &Point| Some(vec![point[3]]);
    let judged = judge(&Belief::Prior, &sees, &[trial(0, 0.5)], &EFFORT, 5).expect("covered");
    let (before, after) = (2.0 * 1.6449, 2.0 * 1.6449 / (1.0f64 + 4.0).sqrt());
    // Quantiles of 512 draws lie slightly inside.
    assert!(
        (judged.before[3].mean / before - 1.0).abs() < 0.02,
        "{judged:?}"
    );
    assert!(
        (judged.after[3].mean / after - 1.0).abs() < 0.03,
        "{judged:?}"
    );
}

/// The strong trial comes first, because it tells more; then the other one, because repeating the first tells little.
#[test]
fn the_choice_is_joint_and_names_ties() {
    let candidates = [
        trial(2, 0.5),
        trial(1, 0.3),
        trial(0, 0.3),
        Trial {
            condition: 9,
            ..trial(0, 0.3)
        },
    ];
    let steps = choose(&Belief::Prior, &linear, &candidates, 2, &EFFORT, 6).expect("covered");
    assert_eq!(steps[0].chosen, 2);
    assert_eq!(steps[0].ties, [3]);
    assert_eq!((steps[1].chosen, &*steps[1].ties), (1, &[][..]));
}

/// 200 samples of a normal belief, smoothed, give its closed form up to the uncertainty of 200 samples.
#[test]
fn smoothed_samples_stand_for_their_posterior() {
    let mut random = stream(7, 7);
    // The first coordinate is narrow, and the second depends on it.
    let samples: Vec<Point> = (0..200)
        .map(|_| {
            let [a, b, c, d]: Point = std::array::from_fn(|_| normal(&mut random));
            [0.5 + 0.1 * a, 0.2 * a + 0.05 * b, c, d]
        })
        .collect();
    let belief = Belief::smoothed(&samples).expect("extent");
    let judged = judge(
        &belief,
        &linear,
        &[trial(0, 0.1), trial(1, 0.1)],
        &EFFORT,
        8,
    )
    .expect("covered");
    let (s, v) = (0.1 * STRONG, 0.01);
    let (t, u) = (0.3 * MIXED, 0.05 * MIXED);
    let (a, b, c) = (1.0 + s * s / v, s * t / v, 1.0 + (t * t + u * u) / v);
    let (first, both) = (0.5 * a.ln(), 0.5 * (a * c - b * b).ln());
    eprintln!("{judged:?} {first} {both}");
    // The variance of 200 samples is known to a tenth, which is half of that in each gain.
    assert!(
        (judged.gains[0].mean - first).abs() < 0.1,
        "{judged:?} {first}"
    );
    assert!(
        (judged.sums[1].mean - both).abs() < 0.15,
        "{judged:?} {both}"
    );
}

#[test]
fn what_is_no_belief_is_refused() {
    let mut random = stream(9, 9);
    let mut draw = || -> Point { std::array::from_fn(|_| normal(&mut random)) };
    let mut samples: Vec<Point> = (0..60).map(|_| draw()).collect();
    assert!(Belief::smoothed(&samples).is_some());
    assert!(Belief::smoothed(&samples[..49]).is_none());
    assert!(Belief::smoothed(&[samples[0]; 60]).is_none());
    samples[3][2] = f64::INFINITY;
    assert!(Belief::smoothed(&samples).is_none());
}

/// The same seed gives the same bits on any number of threads; another seed gives others.
#[test]
fn a_seed_is_an_answer() {
    let few = Effort {
        histories: 7,
        draws: 64,
    };
    let candidates = [trial(0, 0.3), trial(1, 0.3)];
    let on = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads");
        pool.install(|| {
            (
                choose(&Belief::Prior, &linear, &candidates, 2, &few, seed),
                judge(&Belief::Prior, &linear, &candidates, &few, seed),
            )
        })
    };
    assert_eq!(on(1, 5), on(3, 5));
    assert_ne!(on(1, 5), on(1, 6));
}
