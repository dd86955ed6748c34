//! The load of the motor: what a fit finds, and the parts of its uncertainty.

use super::*;

#[test]
fn friction_is_found_from_the_two_slopes() {
    for truth in [0.08, 0.10, 0.15, 0.20, 0.30_f64] {
        let lead = LEAD_DEG.to_radians();
        let down = (truth.atan() - lead).tan() / lead.tan();
        let found = friction(down / raising(truth), 0.0).expect("a worm");
        assert!((found - truth).abs() < 1e-6, "{truth}: {found}");
    }
    // A tenth more while it is lowered.
    let lead = LEAD_DEG.to_radians();
    let down = ((0.15_f64 * 1.1).atan() - lead).tan() / lead.tan();
    let found = friction(down / raising(0.15), 0.1).expect("a worm");
    assert!((found - 0.15).abs() < 1e-6, "{found}");
    // No worm has a coefficient above 1, and the result is not clamped to 1.
    assert_eq!(friction(0.8, 0.0), None);
}

#[test]
fn the_beam_gives_the_forces_of_the_design() {
    for (travel_mm, newton) in [
        (0.0, 0.0),
        (16.6, 1.2),
        (19.0, 2.9),
        (20.6, 5.8),
        (21.7, 10.8),
    ] {
        let found = beam_n(travel_mm);
        assert!(
            (found - newton).abs() <= 0.04 * newton + 0.01,
            "{travel_mm} mm: {found} N"
        );
    }
}
/// A block of a fold at this travel with a slack of nothing.
fn block(thread_mm: f64, way_mm: f64, speed_mm_s: f64) -> Block {
    Block {
        thread_mm,
        way_mm,
        speed_mm_s,
        current_ma: 50.0,
        accelerating_ma: 0.0,
        duty: 0.5,
        battery_mv: 3_700.0,
    }
}

const TRUTH: Values = [18.0, 18.0, 27.0, RATIO.0, 0.8, 0.02, 0.5];

/// Both motions of a capsule with these parameters, a block in each 0.25 mm.
fn motions(values: &Values) -> [Vec<Block>; 2] {
    let places = || (2..80).map(|place| f64::from(place) * 0.25);
    let mut folding: Vec<_> = places().map(|mm| block(mm, 0.24, 12.0)).collect();
    let mut unfolding: Vec<_> = places().rev().map(|mm| block(mm, -0.28, 14.0)).collect();
    let readings = Readings {
        folding: &folding,
        unfolding: &unfolding,
        hysteresis: HYSTERESIS,
    };
    let predicted = readings.predicted(values);
    for (block, ma) in folding.iter_mut().chain(&mut unfolding).zip(predicted) {
        block.accelerating_ma = 0.4;
        block.current_ma = ma + 0.4;
    }
    [folding, unfolding]
}

#[test]
fn a_fit_finds_what_the_currents_were_made_of() {
    let [folding, unfolding] = motions(&TRUTH);
    let found = fit(&folding, &unfolding).expect("it fits");
    for index in [FOLDING, UNFOLDING, PULL, DOWN, SLACK, DAMPING] {
        let (is, was) = (found.values[index], TRUTH[index]);
        assert!((is - was).abs() < 0.01 * was, "{index}: {is} for {was}");
    }
    // More hysteresis needs a larger ratio, and less a smaller one.
    let [less, more] = found
        .with
        .map(|(hysteresis, with)| (hysteresis, with[DOWN]));
    assert!((less.0 - 0.07).abs() < 1e-9 && (more.0 - 0.27).abs() < 1e-9);
    assert!(
        less.1 < TRUTH[DOWN] && TRUTH[DOWN] < more.1,
        "{less:?} {more:?}"
    );
}

#[test]
fn a_start_has_the_currents_that_fit_its_slack() {
    let mut truth = TRUTH;
    (truth[FOLDING], truth[UNFOLDING]) = (21.0, 17.0);
    let [folding, unfolding] = motions(&truth);
    let readings = Readings {
        folding: &folding,
        unfolding: &unfolding,
        hysteresis: HYSTERESIS,
    };
    let found = readings.start([0.8, 0.02, 0.5]).expect("determined");
    for (found, expected) in found.iter().zip(truth) {
        assert!((found - expected).abs() < 1e-6, "{found} for {expected}");
    }
}

#[test]
fn a_prediction_is_friction_and_the_pull_of_a_taut_thread() {
    let folding = [block(5.0, 0.24, 12.0), block(1.0, 0.24, 12.0)];
    let unfolding = [block(15.0, -0.28, 14.0), block(0.9, -0.28, 14.0)];
    let readings = Readings {
        folding: &folding,
        unfolding: &unfolding,
        hysteresis: 0.2,
    };
    let taut = 0.2 / (left_mm(0.02) + LATER_MM);
    // Taut from 1.0 mm on: half of the second block.
    let found = readings.predicted(&[18.0, 17.0, 27.0, 0.3, 0.8, 0.02, taut]);
    let force = |block: &Block, lost: f64| mean(block, 0.8, |force| (force + lost).max(0.0));
    let expected = [
        18.0 + 27.0 * force(&folding[0], 0.24),
        18.0 + 27.0 * force(&folding[1], 0.24) / 2.0,
        17.0 + 27.0 * 0.3 * force(&unfolding[0], -0.35),
        17.0,
    ];
    for (found, expected) in found.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-9, "{found} for {expected}");
    }
    let known = readings.residuals(&[18.0, 17.0, 27.0, 0.35, 0.8, 0.02, taut]);
    assert!((known[4] + NOISE_MA).abs() < 1e-9 && (known[5] + NOISE_MA).abs() < 1e-9);
}

#[test]
fn the_mean_force_of_a_block_is_that_of_its_three_places() {
    let found = mean(&block(17.0, 2.0, 0.0), 1.0, |force| 2.0 * force);
    let expected = (beam_n(15.0) + 4.0 * beam_n(16.0) + beam_n(17.0)) / 3.0;
    assert!((found - expected).abs() < 1e-9, "{found}");
    assert!(beam_n(16.004) > beam_n(16.0) && beam_n(16.004) < beam_n(16.01));
}

/// Damping of 0.02 opens all but the last; a large one leaves nearly all of the fold.
#[test]
fn a_damped_origami_has_not_opened_after_its_rest() {
    let left: Vec<_> = [0.002, 0.02, 0.1, 0.4].map(left_mm).into();
    assert!(
        left.is_sorted() && left[0] < 2.0 && left[3] < 21.0,
        "{left:?}"
    );
    let time = f64::from(REST_S) * (1.0 - HYSTERESIS);
    // dx/dt is -(1 - h) F / q: from the end to the place that is left.
    let took: f64 = (0..10_000)
        .map(|step| {
            let way_mm = 21.0 - left[1];
            let mm = left[1] + way_mm * (f64::from(step) + 0.5) / 10_000.0;
            0.02 * way_mm / 10_000.0 / beam_n(mm)
        })
        .sum();
    assert!((took / time - 1.0).abs() < 0.05, "{took} of {time} s");
}

#[test]
fn the_uncertainties_are_of_the_fit_and_of_the_ranges() {
    let friction = Friction {
        value: 0.15,
        fit: 0.03,
        direction: 0.01,
        with: [0.14, 0.18],
    };
    assert!((friction.uncertainty() - 0.05).abs() < 1e-9);
    let mut load = Load {
        values: TRUTH,
        uncertainties: [0.6, 0.8, 0.9, 0.01, 0.03, 0.0, 0.0],
        with: [(0.07, TRUTH), (0.27, TRUTH)],
    };
    load.values[FOLDING] = 20.0;
    let no_load = load.no_load_ma();
    let expected = 0.5_f64.hypot(1.0) + 0.03 * 19.0;
    assert!((no_load.value - 19.0).abs() < 1e-9);
    assert!((no_load.uncertainty - expected).abs() < 1e-9);
    (load.with[0].1[SLACK], load.with[1].1[SLACK]) = (0.84, 0.75);
    let expected = 0.03_f64.hypot(0.05) + 0.1;
    assert!((load.slack_mm().uncertainty - expected).abs() < 1e-9);
    (load.with[0].1[DOWN], load.with[1].1[DOWN]) = (0.26, 0.31);
    let worm = load.worm_friction().expect("a worm");
    let of = |down: f64, hysteresis: f64, direction: f64| {
        super::friction(down / (1.0 - hysteresis), direction).expect("below 1")
    };
    assert!((worm.value - of(0.29, 0.17, 0.0)).abs() < 1e-9);
    let [less, more] = [0.28, 0.30].map(|down| (of(down, 0.17, 0.0) - worm.value).abs());
    assert!((worm.fit - less.max(more)).abs() < 1e-9);
    let [less, more] = [-0.1, 0.1].map(|by| (of(0.29, 0.17, by) - worm.value).abs());
    assert!((worm.direction - less.max(more)).abs() < 1e-9);
    assert!((worm.with[0] - of(0.26, 0.07, 0.0)).abs() < 1e-9);
    assert!((worm.with[1] - of(0.31, 0.27, 0.0)).abs() < 1e-9);
    // 27 mA/N at 2.1 mV s/rad, over 15.6 uN m and what the worm takes.
    let stiffness = load.stiffness(2.1, &friction);
    let expected = 27.0 * 2.1 / 15.625 / raising(0.15);
    assert!((stiffness.value - expected).abs() < 1e-6);
    let more = |by: f64| raising(0.15 + by) / raising(0.15) - 1.0;
    let with = (raising(0.15) / raising(0.14) - 1.0).max(1.0 - raising(0.15) / raising(0.18));
    let share = (0.9_f64 / 27.0).hypot(more(0.03)).hypot(with + more(0.01));
    let expected = (share + 0.05) * stiffness.value;
    assert!((stiffness.uncertainty - expected).abs() < 1e-6);
}

#[test]
fn what_the_amplifier_may_be_off_is_along_each_motion() {
    let [mut folding, unfolding] = motions(&TRUTH);
    folding.truncate(3);
    folding[0].current_ma = 200.0;
    let readings = Readings {
        folding: &folding,
        unfolding: &unfolding[..5],
        hysteresis: HYSTERESIS,
    };
    assert!((readings.ripple_ma()[0] - 4.0).abs() < 1e-9);
    let [folds, unfolds] = readings.drifts_ma();
    assert_eq!(folds, [-0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(unfolds, [0.0, 0.0, 0.0, -0.5, -0.25, 0.0, 0.25, 0.5]);
}

/// The force builds up over 0.6 mm to 15 % and is lost within 0.05 mm: of nine places of a block of 0.8 mm, five.
#[test]
fn a_snap_pulls_before_its_place_and_not_behind_it() {
    let folding = [block(11.0, 0.8, 12.0), block(5.0, 0.8, 12.0)];
    let unfolding = [block(11.0, 0.8, 12.0), block(0.5, 0.8, 14.0)];
    let readings = Readings {
        folding: &folding,
        unfolding: &unfolding,
        hysteresis: HYSTERESIS,
    };
    let values = [18.0, 17.0, 27.0, 0.3, 1.0, 0.0, 0.0];
    let shares = [1.0 / 3.0, 0.5, 2.0 / 3.0, 5.0 / 6.0, 1.0];
    let newton: f64 = (shares.iter().enumerate())
        .map(|(place, share)| share * beam_n(9.6 + 0.1 * place as f64))
        .sum();
    let ma = 27.0 * 0.15 * newton / 9.0;
    let found = readings.snap_ma(&values, 10.0);
    for (found, expected) in found.iter().zip([ma, 0.0, 0.3 * ma, 0.0]) {
        assert!((found - expected).abs() < 1e-9, "{found} for {expected}");
    }
    // A slack thread pulls nothing, wherever a snap might be.
    assert_eq!(readings.snap_ma(&values, -0.5)[3], 0.0);
}

/// Ripple and drift, and half of the square of each snap in the mean over its range, add to the noise.
#[test]
fn the_uncertainty_is_that_of_the_noise_and_of_what_the_model_leaves_out() {
    for noise_ma in [0.0, 2.0] {
        let [mut folding, unfolding] = motions(&TRUTH);
        for (place, block) in folding.iter_mut().enumerate() {
            block.current_ma += if place % 2 == 0 { noise_ma } else { -noise_ma };
        }
        let readings = Readings {
            folding: &folding,
            unfolding: &unfolding,
            hysteresis: HYSTERESIS,
        };
        let slopes = readings.slopes(&TRUTH);
        let (mut normal, _) = equations(&slopes, &vec![0.0; slopes.len()]);
        normal[DAMPING][DAMPING] += 1e-6;
        normal[TAUT][TAUT] += 1e-6;
        let inverse = inverse(normal).expect("determined");
        // 78 blocks each way, of which the folding ones err.
        let variance = (78.0 * noise_ma * noise_ma / 149.0).max(0.25);
        let shift = |pattern_ma: &[f64]| {
            let right: Values = std::array::from_fn(|index| {
                let pairs = slopes.iter().zip(pattern_ma);
                pairs.map(|(slope, off)| slope[index] * off).sum()
            });
            times(&inverse, &right)
        };
        let mut patterns = vec![(1.0, shift(&readings.ripple_ma()))];
        patterns.extend(readings.drifts_ma().map(|drift_ma| (1.0, shift(&drift_ma))));
        for (from_mm, to_mm) in SNAPS_MM {
            for place in 0..9 {
                let at_mm = from_mm + (to_mm - from_mm) * f64::from(place) / 8.0;
                patterns.push((2.0 / 9.0, shift(&readings.snap_ma(&TRUTH, at_mm))));
            }
        }
        let found = readings.uncertainties(&TRUTH).expect("determined");
        for index in 0..COUNT {
            let noise = 4.0 * variance * inverse[index][index];
            let off: f64 = patterns
                .iter()
                .map(|(weight, shift)| weight * shift[index] * shift[index])
                .sum();
            let expected = (noise + off).sqrt();
            let ratio = found[index] / expected;
            assert!((ratio - 1.0).abs() < 1e-6, "{index}: {ratio}");
        }
    }
}
