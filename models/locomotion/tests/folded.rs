//! The folded body: untouched, ridden over or pushed.

use locomotion::folded::{Contact, FoldedBody, Params, run};
use locomotion::kinematics::Design;
use proptest::prelude::*;

#[test]
fn the_default_is_the_body_folded_by_21_mm_of_thread() {
    let unfolded = Params {
        width_mm: 24.40,
        length_mm: 41.2,
        ..Params::PAPER
    };
    let folded = unfolded.folded_by(&Design::paper_ratios(), 21.0).unwrap();
    assert_eq!(
        format!("{:.3} {:.3}", folded.width_mm, folded.length_mm),
        format!(
            "{:.3} {:.3}",
            Params::PAPER.width_mm,
            Params::PAPER.length_mm
        )
    );
    assert_eq!(folded.tail_mm, Params::PAPER.tail_mm);
}

/// The paper's deepest wave, 5.05 mm, leaves a gap of 14.3 mm.
#[test]
fn a_narrow_body_is_not_touched() {
    for width_mm in [4.88, 13.0, 14.29] {
        let params = Params {
            width_mm,
            ..Params::PAPER
        };
        assert_eq!(
            FoldedBody::new(params, 5.05).unwrap().contact(),
            Contact::Untouched
        );
        assert_eq!(run(params, 5.05).unwrap(), 0.0);
    }
}

#[test]
fn a_flat_contact_is_ridden_over() {
    // slope 0.15 at e = R (1 - 1/sqrt(1 + 0.15^2)) = 0.2213 mm, so between 14.3 and 14.7427 mm of width
    let at = |width_mm| Params {
        width_mm,
        ..Params::PAPER
    };
    assert!(matches!(
        FoldedBody::new(at(14.742), 5.05).unwrap().contact(),
        Contact::Overridden { .. }
    ));
    assert_eq!(run(at(14.742), 5.05).unwrap(), 0.0);
    let Contact::Pushed { slope, .. } = FoldedBody::new(at(14.744), 5.05).unwrap().contact() else {
        panic!("it is pushed");
    };
    // A slope equal to the friction does not push.
    let just_held = Params {
        friction: slope,
        ..at(14.744)
    };
    assert_eq!(
        FoldedBody::new(just_held, 5.05).unwrap().contact(),
        Contact::Overridden { slope }
    );
}

#[test]
fn a_pushed_body_goes_with_the_antegrade_wave_only() {
    let mut body = FoldedBody::new(Params::PAPER, 5.05).unwrap();
    let Contact::Pushed { ahead_mm, .. } = body.contact() else {
        panic!("{:?}", body.contact());
    };
    body.carriage_to(20.0).unwrap();
    assert_eq!(body.displacement_mm(), 0.0, "not reached yet");
    body.carriage_to(130.0).unwrap();
    let far = -(ahead_mm + Params::PAPER.length_mm + Params::PAPER.tail_mm);
    assert!((body.displacement_mm() - far).abs() < 1e-12);
    let pushed = body.displacement_mm();
    for carriage in [0.0, 130.0, 64.0, 130.0] {
        body.carriage_to(carriage).unwrap();
        assert_eq!(
            body.displacement_mm(),
            pushed,
            "neither the return nor a later cycle moves it"
        );
    }
    assert_eq!(run(Params::PAPER, 5.05).unwrap(), pushed);
}

#[test]
fn refusals() {
    for bad in [-0.1, 12.3, f64::NAN] {
        assert!(FoldedBody::new(Params::PAPER, bad).is_err());
    }
    let under_the_roller = Params {
        tail_mm: 120.0,
        ..Params::PAPER
    };
    assert!(FoldedBody::new(under_the_roller, 5.05).is_err());
    assert!(
        FoldedBody::new(Params::PAPER, 5.05)
            .unwrap()
            .carriage_to(f64::NAN)
            .is_err()
    );
    assert!(
        Params::PAPER
            .folded_by(&Design::paper_ratios(), 23.46)
            .is_err()
    );
}

proptest! {
    /// The body moves neither headward nor past the wave's foot, and only the leftmost position of the carriage
    /// counts.
    #[test]
    fn only_the_farthest_place_counts(
        turns in prop::collection::vec(0.0..130.0f64, 1..20),
        width_mm in 5.0..24.4f64,
        a in 0.0..9.7f64,
    ) {
        let params = Params { width_mm, tail_mm: 40.0, ..Params::PAPER };
        let mut body = FoldedBody::new(params, a).unwrap();
        for turn in &turns {
            body.carriage_to(*turn).unwrap();
        }
        let mut direct = FoldedBody::new(params, a).unwrap();
        direct.carriage_to(turns.iter().copied().fold(0.0, f64::max)).unwrap();
        prop_assert_eq!(body.displacement_mm().to_bits(), direct.displacement_mm().to_bits());
        prop_assert!(body.displacement_mm() <= 0.0);
    }
}

/// Where the roller's arc meets the body, the indentation equals the gap and the slope equals the stated one.
#[test]
fn a_pushed_body_touches_the_rollers_arc() {
    for a in [4.6, 5.05, 6.0, 9.0] {
        let body = FoldedBody::new(
            Params {
                tail_mm: 40.0,
                ..Params::PAPER
            },
            a,
        )
        .unwrap();
        let Contact::Pushed { slope, ahead_mm } = body.contact() else {
            panic!("{:?}", body.contact());
        };
        let wall = |x| locomotion::roller::wall_mm(a, 20.0, x);
        let gap_mm = (24.40 - 15.771) / 2.0;
        assert!((wall(ahead_mm) - gap_mm).abs() < 1e-12);
        let rise = (wall(ahead_mm - 1e-4) - wall(ahead_mm + 1e-4)) / 2e-4;
        assert!((rise - slope).abs() < 1e-6, "{rise} {slope}");
    }
}

#[test]
fn the_tail_is_where_the_body_went() {
    let mut body = FoldedBody::new(Params::PAPER, 5.05).unwrap();
    assert_eq!(body.tail_mm(), 65.0);
    body.carriage_to(90.0).unwrap();
    assert!(body.displacement_mm() < -1.0);
    assert!((body.tail_mm() - 65.0 - body.displacement_mm()).abs() < 1e-12);
}

/// With the carriage at home, the roller just touches a body at the rightmost allowed position.
#[test]
fn a_body_is_laid_down_clear_of_the_roller() {
    let Contact::Pushed { ahead_mm, .. } = FoldedBody::new(Params::PAPER, 5.05).unwrap().contact()
    else {
        panic!("it is pushed");
    };
    let last_mm = 130.0 - ahead_mm - Params::PAPER.length_mm;
    let at = |tail_mm| {
        FoldedBody::new(
            Params {
                tail_mm,
                ..Params::PAPER
            },
            5.05,
        )
    };
    assert!(at(last_mm - 1e-9).is_ok());
    assert!(at(last_mm + 1e-9).is_err());
}

#[test]
fn the_carriage_may_overtravel_by_100_mm() {
    let mut body = FoldedBody::new(Params::PAPER, 5.05).unwrap();
    for good in [-100.0, 230.0] {
        assert!(body.carriage_to(good).is_ok(), "{good}");
    }
    for bad in [-100.1, 230.1] {
        assert!(body.carriage_to(bad).is_err(), "{bad}");
    }
}
