//! The beam model against closed forms and published solutions; its results against the model's own limits.

use locomotion::beam::band::{INPUTS, band, does_as_the_paper_says, draw};
use locomotion::beam::crescent::{Shape, Wing};
use locomotion::beam::rod::{Properties, Rod};
use locomotion::beam::thread::{Params, run};
use locomotion::beam::{NoAnswer, Validation};
use locomotion::folded;

const LENGTH_MM: f64 = 10.0;
const BENDING: f64 = 21.0;

fn rod(elements: u16) -> Rod {
    rod_of(elements, None)
}

fn rod_of(elements: u16, guided_tip_rad: Option<f64>) -> Rod {
    Rod::new(Properties {
        length_mm: LENGTH_MM,
        bending_n_mm2: BENDING,
        root_rad: 0.0,
        elements,
        guided_tip_rad,
    })
    .unwrap()
}

/// Simpson's rule over a smooth function.
fn integral(from: f64, to: f64, f: impl Fn(f64) -> f64) -> f64 {
    const N: usize = 4000;
    let h = (to - from) / N as f64;
    let inner: f64 = (1..N)
        .map(|i| if i % 2 == 0 { 2.0 } else { 4.0 } * f(from + h * i as f64))
        .sum();
    h / 3.0 * (f(from) + inner + f(to))
}

/// The elastica of a cantilever with a dead force across its tip, by elliptic integrals, for a rotation of the tip:
/// (P L^2/B, deflection over L, position of the tip along the unbent rod over L).
fn elastica(tip_rad: f64) -> (f64, f64, f64) {
    let k2 = (1.0 + tip_rad.sin()) / 2.0;
    let from = (1.0 / (2.0 * k2).sqrt()).asin();
    let to = std::f64::consts::FRAC_PI_2;
    let first = integral(from, to, |t| 1.0 / (1.0 - k2 * t.sin().powi(2)).sqrt());
    let second = integral(from, to, |t| (1.0 - k2 * t.sin().powi(2)).sqrt());
    (
        first * first,
        1.0 - 2.0 * second / first,
        (2.0 * tip_rad.sin()).sqrt() / first,
    )
}

#[test]
fn an_end_moment_bends_the_rod_to_a_circle() {
    for turn in [0.1, 1.0, -2.0, std::f64::consts::TAU] {
        let mut rod = rod(64);
        rod.load_tip([0.0; 2], turn * BENDING / LENGTH_MM).unwrap();
        assert!((rod.tip_rad() - turn).abs() < 1e-8);
        let radius = LENGTH_MM / turn;
        let [x, y] = rod.tip_mm();
        assert!((x - radius * turn.sin()).abs() < 0.002 * LENGTH_MM, "{x}");
        assert!(
            (y - radius * (1.0 - turn.cos())).abs() < 0.002 * LENGTH_MM,
            "{y}"
        );
        // Work of a moment that grows in proportion to the turn.
        let work = BENDING * turn * turn / LENGTH_MM / 2.0;
        assert!((rod.energy_n_mm() - work).abs() < 1e-7 * work);
    }
}

#[test]
fn an_end_force_bends_it_to_the_elastica() {
    for degrees in [1.0, 5.0, 15.0, 30.0, 45.0, 60.0, 75.0f64] {
        let (load, across, along) = elastica(degrees.to_radians());
        let mut rod = rod(32);
        rod.load_tip([0.0, load * BENDING / LENGTH_MM / LENGTH_MM], 0.0)
            .unwrap();
        let [x, y] = rod.tip_mm();
        assert!((rod.tip_rad().to_degrees() / degrees - 1.0).abs() < 0.003);
        assert!((y / LENGTH_MM / across - 1.0).abs() < 0.003, "{degrees}");
        assert!(((LENGTH_MM - x) / LENGTH_MM / (1.0 - along) - 1.0).abs() < 0.004);
    }
}

#[test]
fn the_published_cantilever_is_met() {
    // K. Mattiasson, Int. J. Numer. Methods Eng. 17 (1981) 145-153: P L^2/(E I), w/L, u/L, rotation of the tip.
    for (load, across, shortened, turn) in [
        (1.0, 0.30172, 0.05643, 0.46135),
        (2.0, 0.49346, 0.16064, 0.78175),
        (5.0, 0.71379, 0.38763, 1.21537),
        (10.0, 0.81061, 0.55500, 1.43029),
    ] {
        let mut rod = rod(400);
        rod.load_tip([0.0, load * BENDING / LENGTH_MM / LENGTH_MM], 0.0)
            .unwrap();
        let [x, y] = rod.tip_mm();
        assert!((y / LENGTH_MM - across).abs() < 2e-5, "{load}: {y}");
        assert!((1.0 - x / LENGTH_MM - shortened).abs() < 2e-5, "{load}");
        assert!((rod.tip_rad() - turn).abs() < 2e-5, "{load}");
    }
}

#[test]
fn a_small_load_meets_the_linear_beam() {
    let force = 1e-5;
    let mut rod = rod(200);
    rod.load_tip([0.0, force], 0.0).unwrap();
    let deflection = force * LENGTH_MM.powi(3) / 3.0 / BENDING;
    assert!((rod.tip_mm()[1] / deflection - 1.0).abs() < 2e-5);
    assert!((rod.root_moment_n_mm() / (force * LENGTH_MM) - 1.0).abs() < 2e-2);
}

#[test]
fn the_error_falls_with_the_square_of_the_elements() {
    let (load, across, _) = elastica(60f64.to_radians());
    let error = |elements| {
        let mut rod = rod(elements);
        rod.load_tip([0.0, load * BENDING / LENGTH_MM / LENGTH_MM], 0.0)
            .unwrap();
        (rod.tip_mm()[1] / LENGTH_MM / across - 1.0).abs()
    };
    let errors = [4, 8, 16, 32, 64, 128].map(error);
    for pair in errors.windows(2) {
        let order = (pair[0] / pair[1]).log2();
        assert!((1.9..2.1).contains(&order), "{errors:?}");
    }
    assert!(errors[1] < 0.01 && errors[5] < 3e-5, "{errors:?}");
}

/// The greatest compression at which a straight rod is stable.
fn buckling_n(mut stands: impl FnMut(f64) -> bool) -> f64 {
    let (mut low, mut high) = (0.0, 100.0);
    while high - low > 1e-9 {
        let middle = (low + high) / 2.0;
        if stands(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

#[test]
fn struts_buckle_at_eulers_loads() {
    let unit = std::f64::consts::PI.powi(2) * BENDING / LENGTH_MM.powi(2);
    // A clamped and guided strut is half of one of twice the length with both ends clamped: 4 pi^2 B/(2L)^2.
    for (guide, euler) in [(None, unit / 4.0), (Some(0.0), unit)] {
        let found = buckling_n(|force| {
            let mut rod = rod_of(100, guide);
            rod.load_tip([-force, 0.0], 0.0).unwrap();
            rod.is_stable_under_dead_load()
        });
        assert!((found / euler - 1.0).abs() < 2e-4, "{found} for {euler}");
    }
}

#[test]
fn a_buckled_strut_follows_the_elastica() {
    // Timoshenko and Gere, Theory of Elastic Stability, 2.7: a cantilever strut whose tip has turned by 60 deg
    // carries 1.152 P_E.
    let euler = std::f64::consts::PI.powi(2) * BENDING / LENGTH_MM.powi(2) / 4.0;
    let mut rod = rod(200);
    // A transverse force selects a side; then it is removed.
    rod.load_tip([0.0, 0.2 * euler], 0.0).unwrap();
    rod.load_tip([-1.1517 * euler, 0.2 * euler], 0.0).unwrap();
    rod.load_tip([-1.1517 * euler, 0.0], 0.0).unwrap();
    assert!((rod.tip_rad().to_degrees() - 60.0).abs() < 0.1);
    assert!(rod.is_stable_under_dead_load());
}

#[test]
fn a_wall_does_the_work_that_the_wing_stores() {
    let wing = Wing::PAPER;
    for shape in [
        Shape::Flat,
        Shape::Roller {
            radius_mm: 20.0,
            behind_mm: 0.0,
        },
    ] {
        const N: usize = 200;
        let deepest = 5.05;
        let mut work = 0.0;
        let mut before = 0.0;
        // Use a fine spacing where the force rises fast.
        let at = |i: usize| deepest * (i as f64 / N as f64).powi(3);
        for i in 1..=N {
            let force = wing.squeezed(0.0, at(i), shape, 0.0).unwrap().value;
            work += (force.inward_n + before) / 2.0 * (at(i) - at(i - 1));
            before = force.inward_n;
            if i == N {
                assert!((work / force.energy_n_mm - 1.0).abs() < 2e-3, "{shape:?}");
            }
        }
    }
}

#[test]
fn a_wing_at_first_touch_is_the_linear_beam_and_the_pawl() {
    let wing = Wing {
        elements: 200,
        ..Wing::PAPER
    };
    for drawn in [0.0, 1.0, 4.0] {
        let angle = wing.rest_rad(drawn).unwrap();
        let length = wing.design.short_side_mm();
        let bending = wing.bending_n_mm2().unwrap();
        let deep = 1e-5;
        let free = wing.squeezed(drawn, deep, Shape::Flat, 0.0).unwrap().value;
        let linear = 3.0 * bending * deep / length.powi(3) / angle.sin().powi(2);
        assert!((free.inward_n / linear - 1.0).abs() < 1e-3, "{drawn}");
        for friction in [0.15, -0.15] {
            let force = wing
                .squeezed(drawn, deep, Shape::Flat, friction)
                .unwrap()
                .value;
            let pawl = angle.tan() / (angle.tan() + friction);
            let found = force.inward_n / free.inward_n;
            assert!((found / pawl - 1.0).abs() < 3e-3, "{drawn} {friction}");
            assert!((force.tailward_n - friction * force.inward_n).abs() < 1e-9);
        }
    }
}

#[test]
fn the_law_predicts_what_the_beam_does_under_friction() {
    let wing = Wing::PAPER;
    let law = wing.law(0.0, 3.0, 12).unwrap();
    for deep in [0.5, 1.5, 3.0] {
        for friction in [0.15, -0.10] {
            let beam = wing.squeezed(0.0, deep, Shape::Flat, friction).unwrap();
            let lever = law.lever(deep);
            let short = law.force_n(deep) * lever / (lever + friction);
            let error = short / beam.value.inward_n - 1.0;
            assert!(error.abs() < 0.05, "{deep} {friction}: {error}");
        }
    }
}

#[test]
fn a_wall_that_does_not_reach_the_wing_does_not_load_it() {
    let none = Wing::PAPER.squeezed(1.0, 0.0, Shape::Flat, 0.1).unwrap();
    assert!(none.value.inward_n.abs() < 1e-9 && none.value.energy_n_mm < 1e-12);
    assert_eq!(none.validation, Validation::NotAgainstARig);
}

#[test]
fn a_roller_of_large_radius_is_a_plane() {
    let wide = Shape::Roller {
        radius_mm: 1e4,
        behind_mm: 0.0,
    };
    for deep in [0.1, 1.0, 3.0] {
        let flat = Wing::PAPER.squeezed(0.0, deep, Shape::Flat, 0.05).unwrap();
        let round = Wing::PAPER.squeezed(0.0, deep, wide, 0.05).unwrap();
        let ratio = round.value.inward_n / flat.value.inward_n;
        assert!((ratio - 1.0).abs() < 5e-3, "{deep}: {ratio}");
    }
}

#[test]
fn no_node_reaches_through_the_roller() {
    let (radius_mm, deep) = (20.0, 5.05);
    for behind_mm in [-3.0, 0.0, 3.0] {
        let shape = Shape::Roller {
            radius_mm,
            behind_mm,
        };
        let wing = Wing::PAPER;
        let rest = wing.squeezed(0.0, 0.0, Shape::Flat, 0.0).unwrap().value;
        let tip_y = rest.nodes_mm.last().unwrap()[1];
        let bent = wing.squeezed(0.0, deep, shape, 0.05).unwrap().value;
        let centre = [
            wing.design.half_gap_mm() - deep + radius_mm,
            tip_y + behind_mm,
        ];
        for node in &bent.nodes_mm {
            let distance = (node[0] - centre[0]).hypot(node[1] - centre[1]);
            assert!(distance > radius_mm - 0.001, "{behind_mm}: {distance}");
        }
    }
}

#[test]
fn the_least_alpha_is_the_angle_of_friction() {
    for friction in [0.08, 0.15, 0.20f64] {
        let found = Wing::PAPER.least_alpha_deg(friction, 0.0, 0.0).unwrap();
        let angle = friction.atan().to_degrees();
        assert!(
            (found.value - angle).abs() < 0.05,
            "{} {angle}",
            found.value
        );
        // A wall that opens towards the tail helps by its own angle.
        let sloped = Wing::PAPER.least_alpha_deg(friction, 0.05, 0.0).unwrap();
        let gain = angle - sloped.value;
        assert!((gain - 0.05f64.atan().to_degrees()).abs() < 0.05, "{gain}");
    }
}

#[test]
fn what_the_beam_cannot_do_is_refused() {
    let wing = Wing::PAPER;
    assert!(matches!(
        wing.squeezed(0.0, 9.8, Shape::Flat, 0.0),
        Err(NoAnswer::OutOfRange(_))
    ));
    assert!(wing.squeezed(0.0, f64::NAN, Shape::Flat, 0.0).is_err());
    // Friction outweighs the slant: the wing locks like a pawl.
    let locked = wing.squeezed(0.0, 0.5, Shape::Flat, -0.5).unwrap_err();
    assert!(locked.to_string().contains("jams"), "{locked}");
    for bad in [0.0, -1.0, f64::NAN] {
        let thin = Wing {
            thickness_mm: bad,
            ..wing
        };
        let error = thin.squeezed(0.0, 1.0, Shape::Flat, 0.0).unwrap_err();
        assert!(error.to_string().contains("wing thickness"), "{error}");
    }
}

/// A body with a wall that takes the thrust of the roller: it behaves as the paper says of the unfolded one.
fn soft() -> Params {
    Params {
        friction: 0.19,
        wall_n_mm2: 0.005,
        backed: 0.0,
        ..Params::PAPER
    }
}

#[test]
fn an_unfolded_body_on_a_soft_wall_moves_headward() {
    let moved = run(soft(), 0.0, 5.05).unwrap();
    assert!((10.0..100.0).contains(&moved.value), "{}", moved.value);
    assert_eq!(
        moved.validation.to_string(),
        "beam model, not validated against a rig"
    );
}

#[test]
fn only_draws_that_do_as_the_paper_says_are_kept() {
    let kept = (0..100)
        .filter(|index| does_as_the_paper_says(draw(Params::PAPER, 1, *index), 5.05).unwrap())
        .count();
    assert!((1..50).contains(&kept), "{kept}");
    let pushed = Params {
        friction: 0.08,
        wall_n_mm2: 1.0,
        backed: 1.0,
        ..Params::PAPER
    };
    assert!(!does_as_the_paper_says(pushed, 5.05).unwrap());
}

#[test]
fn the_displacement_fades_with_the_thread_without_a_jump() {
    let mut before = run(soft(), 0.0, 5.05).unwrap().value;
    for thread in 1..=44 {
        let now = run(soft(), f64::from(thread) / 2.0, 5.05).unwrap().value;
        assert!(
            now <= before + 2.0 && now > before - 12.0,
            "{thread}: {now}"
        );
        before = now;
    }
    assert!(before.abs() < 0.5, "{before}");
}

#[test]
fn a_body_that_no_wave_reaches_does_not_move() {
    let moved = run(Params::PAPER, 22.3, 5.05).unwrap().value;
    assert!(moved == 0.0, "{moved}");
    assert!(run(Params::PAPER, 24.0, 5.05).is_err());
}

#[test]
fn a_stiff_wall_pushes_the_folded_body_as_it_does_the_block() {
    let (thread, start) = (20.0, Params::PAPER.core_tail_mm);
    let stiff = Params {
        friction: 0.08,
        wall_n_mm2: 1.0,
        backed: 1.0,
        ..Params::PAPER
    };
    let moved = run(stiff, thread, 5.05).unwrap().value;
    let design = stiff.wing.design;
    let mut block = folded::Params::PAPER.folded_by(&design, thread).unwrap();
    let drawn = design.indentation_for_thread_mm(thread).unwrap();
    block.tail_mm = start - design.wing_reach_mm(drawn).unwrap();
    block.friction = stiff.friction;
    let rigid = folded::run(block, 5.05).unwrap();
    assert!(
        rigid < -50.0 && (moved - rigid).abs() < 4.0,
        "{moved} {rigid}"
    );
}

#[test]
fn the_width_of_the_wing_cancels() {
    let narrow = {
        let mut params = soft();
        params.wing.width_mm /= 4.0;
        params.weight_n /= 4.0;
        params
    };
    for thread in [0.0, 7.0] {
        let difference =
            run(soft(), thread, 5.05).unwrap().value - run(narrow, thread, 5.05).unwrap().value;
        assert!(difference.abs() < 1e-4, "{thread}: {difference}");
    }
}

#[test]
fn the_same_seed_draws_the_same_inputs_within_their_ranges() {
    let mut sum = 0.0;
    for index in 0..500 {
        let params = draw(Params::PAPER, 7, index);
        assert_eq!(params, draw(Params::PAPER, 7, index));
        assert_ne!(params, draw(Params::PAPER, 8, index));
        let values = [
            params.friction,
            params.wall_n_mm2,
            params.wing.modulus_mpa,
            params.wing.thickness_mm,
            params.backed,
            params.preload_mm,
            params.weight_n,
        ];
        for (value, input) in values.iter().zip(&INPUTS) {
            assert!(
                (input.low..=input.high).contains(value),
                "{} {value}",
                input.name
            );
        }
        sum += params.backed;
    }
    assert!((sum / 500.0 - 0.5).abs() < 0.05, "{sum}");
}

#[test]
fn the_band_is_made_of_the_curves() {
    let curves: Vec<Vec<f64>> = (0..=100).map(|i| vec![f64::from(i) - 10.0, 5.0]).collect();
    let rows = band(&[0.0, 1.0], &curves).value;
    assert_eq!(
        (rows[0].low_mm, rows[0].median_mm, rows[0].high_mm),
        (-5.0, 40.0, 85.0)
    );
    assert!((rows[0].reversed - 9.0 / 101.0).abs() < 1e-12);
    assert_eq!((rows[1].low_mm, rows[1].reversed), (5.0, 0.0));
    assert!(band(&[0.0], &[]).value.is_empty());
}

#[test]
fn what_the_thread_model_cannot_do_is_refused() {
    for (name, bad) in [
        (
            "friction",
            Params {
                friction: f64::NAN,
                ..Params::PAPER
            },
        ),
        (
            "share",
            Params {
                backed: 1.5,
                ..Params::PAPER
            },
        ),
        (
            "wall",
            Params {
                wall_n_mm2: 0.0,
                ..Params::PAPER
            },
        ),
    ] {
        let error = run(bad, 1.0, 5.05).unwrap_err().to_string();
        assert!(error.contains(name), "{error}");
    }
    assert!(run(Params::PAPER, 0.0, 9.5).is_err());
}
