//! The pressurised tube: the reference series and what must not matter.

use locomotion::tube::{PARAMETERS, Params, Tube, run};

const SERIES: [(f64, &str); 5] = [
    (3000.0, "1.542"),
    (4200.0, "3.232"),
    (5000.0, "4.264"),
    (6200.0, "7.535"),
    (7000.0, "14.452"),
];

#[test]
fn the_series_reproduces_to_the_printed_digits() {
    for (pressure, printed) in SERIES {
        assert_eq!(
            format!("{:.3}", run(Params::PAPER, pressure).unwrap()),
            printed,
            "{pressure} Pa"
        );
    }
}

#[test]
fn the_compliance_is_that_of_a_thin_ring() {
    assert_eq!(
        format!("{:.4e}", Params::PAPER.compliance_mm_per_pa()),
        "4.5594e-5"
    );
}

#[test]
fn friction_does_not_matter_to_the_last_bit() {
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

/// The pulses as the paper words them: 3 s long, from the right, 1 s apart. And at another delay.
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
                pulse_s: 11.0,
                ..Params::PAPER
            },
            3000.0
        )
        .is_err()
    );
}

#[test]
fn every_parameter_has_a_source() {
    assert!(
        PARAMETERS
            .iter()
            .all(|p| !p.source.is_empty() && p.value.is_finite())
    );
}

/// Straight between the middles of two segments, level beyond the outer ones.
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
