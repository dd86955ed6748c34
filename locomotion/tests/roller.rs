//! The roller rig: the reference series, any movement of the carriage, and what must not matter.

use locomotion::roller::{PARAMETERS, Params, UnfoldedBody, isolated_pass, run, wall_mm};
use proptest::prelude::*;

const SERIES: [(f64, &str); 5] = [
    (1.0, "17.861454"),
    (2.0, "25.538617"),
    (3.0, "33.702460"),
    (4.0, "40.247951"),
    (5.05, "46.560299"),
];

#[test]
fn the_series_reproduces_to_the_printed_digits() {
    for (a, printed) in SERIES {
        assert_eq!(
            format!("{:.6}", run(Params::PAPER, a).unwrap()),
            printed,
            "a = {a}"
        );
    }
}

fn linearity(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let mean = |f: fn(&(f64, f64)) -> f64| points.iter().map(f).sum::<f64>() / n;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let sum =
        |f: &dyn Fn(f64, f64) -> f64| points.iter().map(|p| f(p.0 - mx, p.1 - my)).sum::<f64>();
    let (xx, xy, yy) = (sum(&|x, _| x * x), sum(&|x, y| x * y), sum(&|_, y| y * y));
    xy * xy / (xx * yy)
}

/// R^2 of a line: 0.993 over a = 1 to 5 mm by 0.25 mm, 0.996 over the five indentations alone.
#[test]
fn the_series_is_nearly_linear() {
    let at = |a: f64| (a, run(Params::PAPER, a).unwrap());
    let fine: Vec<_> = (4..=20)
        .map(|quarters| at(f64::from(quarters) / 4.0))
        .collect();
    assert_eq!(format!("{:.3}", linearity(&fine)), "0.993");
    let five: Vec<_> = SERIES.iter().map(|(a, _)| at(*a)).collect();
    assert_eq!(format!("{:.3}", linearity(&five)), "0.996");
}

/// The reference values of the isolated pass belong to a roller step of 0.1 mm and a wave that clears the body.
#[test]
fn isolated_passes() {
    let pass = isolated_pass(
        Params {
            step_mm: 0.1,
            ..Params::PAPER
        },
        5.05,
    )
    .unwrap();
    assert_eq!(format!("{:.3}", pass.antegrade_mm), "9.271");
    assert_eq!(format!("{:.3}", pass.returning_mm), "-0.021");
}

#[test]
fn friction_does_not_matter_to_the_last_bit() {
    for (a, _) in SERIES {
        let reference = run(Params::PAPER, a).unwrap().to_bits();
        for thousandths in (80..=200).step_by(5) {
            let mut params = Params::PAPER;
            params.body.friction = f64::from(thousandths) / 1000.0;
            assert_eq!(
                run(params, a).unwrap().to_bits(),
                reference,
                "mu = {}",
                params.body.friction
            );
        }
    }
}

#[test]
fn no_wave_no_motion() {
    assert_eq!(run(Params::PAPER, 0.0).unwrap(), 0.0);
}

#[test]
fn counted_steps_of_a_screw_give_the_same_bits() {
    for steps_per_mm in [800u32, 640, 25, 200 * 16 / 5, 1001] {
        let mut body = UnfoldedBody::new(Params::PAPER, 5.05).unwrap();
        let far = 130 * steps_per_mm;
        for _ in 0..5 {
            for step in (0..=far).chain((0..far).rev()) {
                body.carriage_to(f64::from(step) / f64::from(steps_per_mm))
                    .unwrap();
            }
        }
        assert_eq!(body.displacement_mm(), run(Params::PAPER, 5.05).unwrap());
    }
}

#[test]
fn refusals() {
    for bad in [-0.1, 9.77, f64::NAN, f64::INFINITY] {
        assert!(UnfoldedBody::new(Params::PAPER, bad).is_err());
    }
    let mut body = UnfoldedBody::new(Params::PAPER, 3.0).unwrap();
    body.carriage_to(80.0).unwrap();
    let before = body.displacement_mm();
    for bad in [-100.1, 230.1, f64::NAN, f64::NEG_INFINITY] {
        assert!(body.carriage_to(bad).is_err());
    }
    assert_eq!(body.displacement_mm(), before);
    assert!(
        UnfoldedBody::new(
            Params {
                step_mm: 0.0,
                ..Params::PAPER
            },
            3.0
        )
        .is_err()
    );
    assert!(
        UnfoldedBody::new(
            Params {
                radius_mm: 5.0,
                ..Params::PAPER
            },
            3.0
        )
        .is_err()
    );
}

#[test]
fn the_table_of_parameters_is_complete() {
    let labels: Vec<_> = PARAMETERS.iter().map(|p| p.name).collect();
    let mut unique = labels.clone();
    unique.sort_unstable();
    unique.dedup();
    assert_eq!(unique.len(), labels.len());
    assert!(
        PARAMETERS
            .iter()
            .all(|p| !p.source.is_empty() && p.value.is_finite())
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever the turning points, neither more calls on the way nor a repeated run changes a bit.
    #[test]
    fn only_the_way_counts_not_the_calls(
        turns in prop::collection::vec(0.0..130.0f64, 1..8),
        parts in 2u32..50,
        a in 0.1..9.7f64,
    ) {
        let mut whole = UnfoldedBody::new(Params::PAPER, a).unwrap();
        let mut again = whole.clone();
        let mut divided = whole.clone();
        let mut at = 0.0;
        for turn in turns {
            whole.carriage_to(turn).unwrap();
            again.carriage_to(turn).unwrap();
            for part in 1..parts {
                divided.carriage_to(at + (turn - at) * f64::from(part) / f64::from(parts)).unwrap();
            }
            divided.carriage_to(turn).unwrap();
            at = turn;
            prop_assert_eq!(whole.displacement_mm().to_bits(), again.displacement_mm().to_bits());
            prop_assert_eq!(whole.displacement_mm().to_bits(), divided.displacement_mm().to_bits());
        }
    }
}

#[test]
fn the_carriage_may_overtravel_by_100_mm() {
    let mut body = UnfoldedBody::new(Params::PAPER, 5.05).unwrap();
    for good in [-100.0, 230.0] {
        assert!(body.carriage_to(good).is_ok(), "{good}");
    }
}

/// The wall lies on the roller's circle where it is indented, and outside of it elsewhere.
#[test]
fn the_wave_is_the_rollers_arc() {
    for (peak, radius) in [(5.05, 20.0), (1.0, 20.0), (9.76, 10.0)] {
        assert!((wall_mm(peak, radius, 0.0) - peak).abs() < 1e-12);
        for tenths in -300..=300 {
            let x = f64::from(tenths) / 10.0;
            let wall = wall_mm(peak, radius, x);
            assert!((0.0..=peak + 1e-12).contains(&wall));
            let from_axis = (x * x + (radius - peak + wall).powi(2)).sqrt();
            if wall > 0.0 {
                assert!((from_axis - radius).abs() < 1e-9, "{x}: {from_axis}");
            } else {
                assert!(from_axis >= radius - 1e-9, "{x}: {from_axis}");
            }
        }
    }
}
