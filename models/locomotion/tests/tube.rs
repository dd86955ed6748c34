//! The pressurised tube: the reference series, and inputs that must have no effect.

use locomotion::body::FrictionRatio;
use locomotion::model::Model;
use locomotion::tube::{Params, Tube, averaged, placed, run};

/// The default body: tail and head, averaged over the placements, with as many digits as the tolerance supports.
const SERIES: [(f64, &str, &str); 5] = [
    (3000.0, "1.0", "0.9"),
    (4200.0, "1.5", "1.4"),
    (5000.0, "2.0", "1.8"),
    (6200.0, "3.6", "3.4"),
    (7000.0, "15.2", "15.2"),
];

#[test]
fn the_series_reproduces_to_the_printed_digits() {
    for (pressure, tail, head) in SERIES {
        let mean = averaged(Params::PAPER, pressure).unwrap();
        assert_eq!(format!("{:.1}", mean.tail_mm), tail, "{pressure} Pa");
        assert_eq!(format!("{:.1}", mean.head_mm), head, "{pressure} Pa");
    }
}

/// The model has not changed: the older body at its one starting place, with undivided steps of 0.05 s, gives the
/// older values.
#[test]
fn the_older_body_gives_its_older_values() {
    let mut older = Model::TUBE.tube().unwrap();
    older.body.friction_ratio = FrictionRatio::Fixed(1.222);
    older.wall_step_mm = 1000.0;
    for (pressure, printed) in [
        (3000.0, "1.542"),
        (4200.0, "3.232"),
        (5000.0, "4.264"),
        (6200.0, "7.535"),
        (7000.0, "14.452"),
    ] {
        assert_eq!(
            format!("{:.3}", run(older, pressure).unwrap()),
            printed,
            "{pressure} Pa"
        );
    }
    let mut tube = Tube::new(older, 3000.0).unwrap();
    while tube.time_s() < 20.0 {
        tube.step().unwrap();
    }
    assert_eq!(format!("{:.2}", tube.displacement_mm()), "1.54");
    assert_eq!(format!("{:.2}", tube.head_displacement_mm()), "0.47");
}

/// A quarter of the wall step together with four times the placements changes no mean by 0.05 mm.
#[test]
fn the_mean_is_converged() {
    for model in [Model::ONE, Model::TUBE] {
        let params = model.tube().unwrap();
        let fine = Params {
            wall_step_mm: params.wall_step_mm / 4.0,
            placements: 4 * params.placements,
            ..params
        };
        for pressure in [3000.0, 5000.0, 6200.0, 7000.0] {
            let (coarse, fine) = (
                averaged(params, pressure).unwrap(),
                averaged(fine, pressure).unwrap(),
            );
            for (end, other) in [
                (coarse.tail_mm, fine.tail_mm),
                (coarse.head_mm, fine.head_mm),
            ] {
                assert!(
                    (end - other).abs() < 0.05,
                    "{}, {pressure} Pa: {end} {other}",
                    model.name
                );
            }
        }
    }
}

/// The length of a time step has no effect: the wall step decides.
#[test]
fn the_time_step_is_only_how_often_one_looks() {
    for step_s in [0.1, 0.01] {
        let params = Params {
            step_s,
            ..Params::PAPER
        };
        let (mean, other) = (
            averaged(params, 7000.0).unwrap(),
            averaged(Params::PAPER, 7000.0).unwrap(),
        );
        assert!(
            (mean.tail_mm - other.tail_mm).abs() < 0.05,
            "{step_s} s: {mean:?} {other:?}"
        );
    }
}

/// The spread comes from the starting places, not from the steps: a tenth of the step leaves it unchanged.
#[test]
fn the_spread_is_not_the_noise_of_the_steps() {
    let params = Model::TUBE.tube().unwrap();
    let fine = Params {
        wall_step_mm: params.wall_step_mm / 10.0,
        ..params
    };
    let (coarse, fine) = (
        averaged(params, 7000.0).unwrap().range_mm,
        averaged(fine, 7000.0).unwrap().range_mm,
    );
    assert!(
        (coarse.0 - fine.0).abs() < 0.2 && (coarse.1 - fine.1).abs() < 0.2,
        "{coarse:?} {fine:?}"
    );
    assert!(fine.1 - fine.0 > 1.0, "{fine:?}");
}

#[test]
fn the_places_cover_one_segment() {
    let tails: Vec<_> = placed(Params {
        placements: 4,
        ..Params::PAPER
    })
    .map(|params| params.body.tail_mm)
    .collect();
    for (tail, wanted) in tails.iter().zip([1.05, 3.15, 5.25, 7.35]) {
        assert!((tail - wanted).abs() < 1e-12, "{tails:?}");
    }
    assert_eq!(tails.len(), 4);
    let one = Params {
        placements: 1,
        ..Params::PAPER
    };
    let mut middle = one;
    middle.body.tail_mm = 4.2;
    let mean = averaged(one, 5000.0).unwrap();
    let single = run(middle, 5000.0).unwrap();
    assert_eq!(mean.tail_mm, single);
    assert_eq!(mean.range_mm, (single, single));
}

/// Friction matters where the ratio follows from it: about 10 to 15 mm, where the paper has "about 14 mm" throughout.
#[test]
fn friction_matters_where_the_ratio_follows_from_it() {
    let at = |friction: f64| {
        let mut params = Model::TUBE.tube().unwrap();
        params.body.friction = friction;
        averaged(params, 7000.0).unwrap().tail_mm
    };
    assert_eq!(format!("{:.1}", at(0.08)), "10.1");
    assert_eq!(format!("{:.1}", at(0.15)), "13.1");
    assert_eq!(format!("{:.1}", at(0.20)), "15.3");
}

#[test]
fn the_compliance_is_that_of_a_thin_ring() {
    assert_eq!(
        format!("{:.4e}", Params::PAPER.compliance_mm_per_pa()),
        "4.5594e-5"
    );
}

#[test]
fn a_fixed_ratio_makes_friction_cancel_to_the_last_bit() {
    let reference = run(Params::PAPER, 7000.0).unwrap().to_bits();
    for thousandths in (80..=200).step_by(5) {
        let mut params = Params::PAPER;
        params.body.friction = f64::from(thousandths) / 1000.0;
        assert_eq!(
            run(params, 7000.0).unwrap().to_bits(),
            reference,
            "mu = {}",
            params.body.friction
        );
    }
}

#[test]
fn the_wall_never_passes_the_core_and_rises_with_pressure() {
    let mut last = -1.0;
    for pascals in 0..8000 {
        let wall = Params::PAPER.wall_mm(f64::from(pascals));
        assert!(wall <= 9.6 && wall >= last);
        last = wall;
    }
    assert_eq!(last, Params::PAPER.body.design.half_gap_mm());
}

/// The pulses as the paper describes them: 3 s long, from the right, 1 s apart; and with another delay.
#[test]
fn pulses_walk_from_right_to_left() {
    for delay_s in [1.0, 0.5] {
        let params = Params {
            delay_s,
            ..Params::PAPER
        };
        let mut tube = Tube::new(params, 7000.0).unwrap();
        let mut deepest_s = [(0.0, 0.0); 10];
        while tube.time_s() < 10.0 {
            tube.step().unwrap();
            for (best, wall) in deepest_s.iter_mut().zip(tube.walls_mm()) {
                if *wall > best.0 {
                    *best = (*wall, tube.time_s());
                }
            }
        }
        for (k, (wall, time_s)) in deepest_s.iter().rev().take(9).enumerate() {
            assert!(
                (time_s - (k as f64 * delay_s + 1.5)).abs() < 1e-9,
                "segment {k} from the right at {time_s} s"
            );
            assert!((wall - params.wall_mm(7000.0)).abs() < 1e-9);
        }
    }
}

#[test]
fn refusals() {
    for bad in [-1.0, f64::NAN, f64::INFINITY] {
        assert!(Tube::new(Params::PAPER, bad).is_err());
        assert!(
            Tube::new(
                Params {
                    critical_pa: bad,
                    ..Params::PAPER
                },
                3000.0
            )
            .is_err()
        );
        assert!(
            Tube::new(
                Params {
                    step_s: bad,
                    ..Params::PAPER
                },
                3000.0
            )
            .is_err()
        );
        assert!(
            Tube::new(
                Params {
                    wall_step_mm: bad,
                    ..Params::PAPER
                },
                3000.0
            )
            .is_err()
        );
    }
    assert!(
        Tube::new(
            Params {
                segments: 33,
                ..Params::PAPER
            },
            3000.0
        )
        .is_err()
    );
    assert!(
        Tube::new(
            Params {
                placements: 0,
                ..Params::PAPER
            },
            3000.0
        )
        .is_err()
    );
    assert!(
        Tube::new(
            Params {
                pulse_s: 11.0,
                ..Params::PAPER
            },
            3000.0
        )
        .is_err()
    );
}

/// Linear between the middles of two segments, constant beyond the outer ones.
#[test]
fn the_wall_between_the_middles_is_straight() {
    let mut tube = Tube::new(Params::PAPER, 7000.0).unwrap();
    while tube.time_s() < 6.4 {
        tube.step().unwrap();
    }
    let walls = tube.walls_mm().to_vec();
    assert!(walls.iter().any(|wall| *wall > 0.1));
    let close = |x_mm: f64, expected: f64| {
        let wall = tube.wall_at_mm(x_mm);
        assert!(
            (wall - expected).abs() < 1e-12,
            "{wall} for {expected} at {x_mm}"
        );
    };
    for (segment, pair) in (0..).zip(walls.windows(2)) {
        let middle_mm = (f64::from(segment) + 0.5) * 8.4;
        close(middle_mm, pair[0]);
        close(middle_mm + 2.1, 0.75 * pair[0] + 0.25 * pair[1]);
        close(middle_mm + 6.3, 0.25 * pair[0] + 0.75 * pair[1]);
    }
    for x_mm in [-50.0, 0.0, 4.1] {
        close(x_mm, walls[0]);
    }
    for x_mm in [79.9, 84.0, 130.0] {
        close(x_mm, walls[9]);
    }
}
