//! The roller rig: the reference series, any movement of the carriage, and inputs that must have no effect.

use locomotion::body::{self, Chain, FrictionRatio};
use locomotion::model::Model;
use locomotion::roller::{IsolatedPass, Params, UnfoldedBody, isolated_pass, run, wall_mm};
use proptest::prelude::*;

/// The default body, with as many digits as the step of 0.05 mm supports.
const SERIES: [(f64, &str); 5] = [
    (1.0, "13.0"),
    (2.0, "22.0"),
    (3.0, "31.0"),
    (4.0, "38.9"),
    (5.05, "46.3"),
];

#[test]
fn the_series_reproduces_to_the_printed_digits() {
    for (a, printed) in SERIES {
        assert_eq!(
            format!("{:.1}", run(Params::PAPER, a).unwrap()),
            printed,
            "a = {a}"
        );
    }
}

/// The model has not changed: the older body with its step of 0.5 mm gives the older values.
#[test]
fn the_older_body_gives_its_older_values() {
    let older = Params {
        step_mm: 0.5,
        ..Model::RIG.rig().unwrap()
    };
    for (a, printed) in [
        (1.0, "17.861454"),
        (2.0, "25.538617"),
        (3.0, "33.702460"),
        (4.0, "40.247951"),
        (5.05, "46.560299"),
    ] {
        assert_eq!(format!("{:.6}", run(older, a).unwrap()), printed, "a = {a}");
    }
    let fine = Params {
        step_mm: 0.1,
        ..older
    };
    let pass = isolated_pass(fine, 5.05).unwrap();
    assert_eq!(format!("{:.3}", pass.antegrade_mm), "9.271");
    assert_eq!(format!("{:.3}", pass.returning_mm), "-0.021");
}

/// A fifth of the step changes no value of the series by 0.05 mm.
#[test]
fn the_series_is_converged_in_the_step() {
    for (a, _) in SERIES {
        let fine = Params {
            step_mm: 0.01,
            ..Params::PAPER
        };
        let difference = run(fine, a).unwrap() - run(Params::PAPER, a).unwrap();
        assert!(difference.abs() < 0.05, "a = {a}: {difference}");
    }
}

/// "Hardly": a return pass moves the body by at most an eighth of an antegrade one; for the older body it is a third
/// at 1 mm.
#[test]
fn a_returning_roller_hardly_moves_the_default_body() {
    let worst = |params: Params| {
        SERIES.map(|(a, _)| {
            let pass = isolated_pass(params, a).unwrap();
            pass.returning_mm.abs() / pass.antegrade_mm
        })
    };
    let one = worst(Params::PAPER);
    assert!(one.iter().all(|fraction| *fraction < 0.125), "{one:?}");
    let older = worst(Model::RIG.rig().unwrap());
    assert!((0.33..0.35).contains(&older[0]), "{older:?}");
}

/// While the rollers are on the body, its head lags behind the tail by the shortening of the core.
#[test]
fn head_and_tail_move_apart_and_meet_again() {
    let mut body = UnfoldedBody::new(Params::PAPER, 5.05).unwrap();
    body.carriage_to(110.0).unwrap();
    let lost = Params::PAPER.body.design.core_length_mm(0.0).unwrap()
        - (body.chain().head_mm() - body.chain().core_tail_mm());
    assert!(lost > 1.0, "{lost}");
    let apart = body.displacement_mm() - body.head_displacement_mm();
    assert!((apart - lost).abs() < 1e-12, "{apart} {lost}");
    body.carriage_to(0.0).unwrap();
    let apart = body.displacement_mm() - body.head_displacement_mm();
    assert!(apart.abs() < 1e-12, "{apart}");
}

/// With facets the friction matters: more friction holds better against the returning roller.
#[test]
fn friction_matters_where_the_ratio_follows_from_it() {
    let at = |friction| {
        let mut params = Params::PAPER;
        params.body.friction_ratio = FrictionRatio::Facets;
        params.body.friction = friction;
        params
    };
    let (slippery, rough) = (
        isolated_pass(at(0.08), 5.05).unwrap(),
        isolated_pass(at(0.20), 5.05).unwrap(),
    );
    let net_mm = |pass: IsolatedPass| pass.antegrade_mm + pass.returning_mm;
    assert!(
        net_mm(rough) - net_mm(slippery) > 0.3,
        "{rough:?} {slippery:?}"
    );
    // 1/tan(beta) = 1.5: from this friction on the facets lock.
    assert!(UnfoldedBody::new(at(1.499), 5.05).is_ok());
    let error = UnfoldedBody::new(at(1.5), 5.05).unwrap_err();
    assert_eq!((error.value, error.max), (1.5, 1.5));
}

#[test]
fn a_fixed_ratio_makes_friction_cancel_to_the_last_bit() {
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

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// For any turning points, neither more calls on the way nor a repeated run changes a bit.
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

    /// The positions at which the wave does not touch the body, which are passed over, would change nothing.
    #[test]
    fn every_touch_counts(
        turns in prop::collection::vec(-600..1_400i32, 1..6),
        a in 0.0..9.7f64,
        radius_mm in 9.77..60.0f64,
        tail_mm in -50.0..150.0f64,
        coupling in 0.05..1.0f64,
    ) {
        let body = body::Params { tail_mm, coupling, ..Params::PAPER.body };
        let params = Params { body, radius_mm, step_mm: 0.1, ..Params::PAPER };
        let mut found = UnfoldedBody::new(params, a).unwrap();
        let mut chain = Chain::new(body).unwrap();
        let mut step = |at: i32| {
            let roller_mm = params.stroke_mm - f64::from(at) * params.step_mm;
            chain.step(|x| wall_mm(a, radius_mm, x - roller_mm)).unwrap();
            chain.displacement_mm()
        };
        let (mut at, mut expected) = (0, step(0));
        for turn in turns {
            while at != turn {
                at += (turn - at).signum();
                expected = step(at);
            }
            found.carriage_to(f64::from(turn) * params.step_mm).unwrap();
            prop_assert_eq!(found.displacement_mm().to_bits(), expected.to_bits());
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
