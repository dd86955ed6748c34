//! Eqs. (1)-(5), (7), (8): reference values, derivatives, domain, and why Eq. (6) is not used.

use locomotion::kinematics::{
    Design, RULES, Real, best_alpha, indentation_from_calipers_mm, printed_eq6_residual,
    repaired_eq6_residual,
};
use proptest::prelude::*;

/// a, psi, d0, d, L, dd0/da; 40-digit arithmetic, angles as printed.
const TABLE: [[f64; 6]; 7] = [
    [
        0.0,
        4.33754803248897,
        0.0,
        0.0,
        41.2070343116459,
        2.99955401133805,
    ],
    [
        1.0,
        2.98182461906426,
        1.35572341342471,
        12.2015107208224,
        31.6556542459668,
        0.694792049330173,
    ],
    [
        2.0,
        2.49202716407057,
        1.84552086841840,
        16.6096878157656,
        28.7326083279602,
        0.348713448561909,
    ],
    [
        3.0,
        2.21978758204095,
        2.11776045044803,
        19.0598440540322,
        27.3445666079759,
        0.212495003176995,
    ],
    [
        4.0,
        2.04622974359263,
        2.29131828889634,
        20.6218646000670,
        26.5882769144409,
        0.141140887705710,
    ],
    [
        5.05,
        1.92369221225762,
        2.41385582023136,
        21.7247023820822,
        26.1324420956497,
        0.0956323859997591,
    ],
    [
        9.76,
        1.73192092956098,
        2.60562710292799,
        23.4506439263519,
        25.5854183696992,
        0.0,
    ],
];

/// Eq. (5) term by term as printed, mm: its terms cancel at small `a`.
fn shortening_as_printed_mm<T: Real>(design: &Design<T>, a_mm: T) -> T {
    let u = design.half_gap_mm() - a_mm;
    let reach = |side: T| (side * side - u * u).sqrt();
    design.spacing_mm() - reach(design.long_side_mm()) + reach(design.short_side_mm())
}

fn paper<T: Real>() -> Design<T> {
    let t = T::from_f64;
    Design::new(t(24.40), t(4.88), t(12.53), t(33.69), 9).unwrap()
}

fn close(what: &str, got: f64, expected: f64, relative: f64) {
    assert!(
        (got - expected).abs() <= relative * expected.abs(),
        "{what}: {got} for {expected}"
    );
}

fn table_holds<T: Real>(relative: f64) {
    let design = paper::<T>();
    let into = |x: T| -> f64 { x.into() };
    close("h", into(design.half_gap_mm()), 9.76, relative);
    close(
        "l1",
        into(design.long_side_mm()),
        11.7300509332113,
        relative,
    );
    close(
        "l2",
        into(design.short_side_mm()),
        9.99813000365036,
        relative,
    );
    close("phi", into(design.spacing_mm()), 4.33754803248897, relative);
    for [a, psi, d0, d, length, slope] in TABLE {
        let a_mm = T::from_f64(a);
        close(
            "psi",
            into(design.squeezed_spacing_mm(a_mm).unwrap()),
            psi,
            relative,
        );
        close(
            "d0",
            into(design.shortening_per_crescent_mm(a_mm).unwrap()),
            d0,
            relative,
        );
        close("d", into(design.shortening_mm(a_mm).unwrap()), d, relative);
        close("L", into(design.length_mm(a_mm).unwrap()), length, relative);
        close(
            "dd0/da",
            into(design.slope_by_indentation(a_mm).unwrap()),
            slope,
            relative,
        );
        close(
            "core",
            into(design.core_length_mm(a_mm).unwrap()),
            9.0 * psi,
            relative,
        );
    }
    let three = T::from_f64(3.0);
    close(
        "dd0/dalpha",
        into(design.slope_by_alpha_mm(three).unwrap()),
        -7.22623347587000,
        relative,
    );
    close(
        "dd0/dbeta",
        into(design.slope_by_beta_mm(three).unwrap()),
        4.52894511726358,
        relative,
    );
}

#[test]
fn reference_values_in_f64() {
    // The reference values have 15 digits.
    table_holds::<f64>(1e-12);
}

#[test]
fn reference_values_in_f32() {
    table_holds::<f32>(2e-6);
}

#[test]
fn the_printed_form_loses_digits_in_f32_and_the_stable_one_does_not() {
    let (single, double) = (
        Design::with_slopes(24.40f32, 4.88, 2.0 / 9.0, 2.0 / 3.0, 9).unwrap(),
        Design::paper_ratios(),
    );
    let a = 1.0 / 1024.0;
    let exact = double.shortening_per_crescent_mm(a).unwrap();
    let error = |got: f32| (f64::from(got) - exact).abs() / exact;
    assert!(error(shortening_as_printed_mm(&single, a as f32)) > 1e-4);
    assert!(error(single.shortening_per_crescent_mm(a as f32).unwrap()) < 1e-6);
}

#[test]
fn printed_angles_and_ratios_agree_to_their_digits() {
    let (printed, ratios) = (Design::paper_printed(), Design::paper_ratios());
    assert_eq!(
        format!("{:.2}", (2.0f64 / 9.0).atan().to_degrees()),
        "12.53"
    );
    assert_eq!(
        format!("{:.2}", (2.0f64 / 3.0).atan().to_degrees()),
        "33.69"
    );
    assert!((printed.spacing_mm() - ratios.spacing_mm()).abs() < 1e-3);
    close("phi = 4h/9", ratios.spacing_mm(), 4.0 * 9.76 / 9.0, 1e-15);
}

#[test]
fn the_core_loses_more_than_the_whole() {
    let design = Design::paper_printed();
    let whole = design.length_mm(0.0).unwrap() - design.length_mm(5.05).unwrap();
    assert_eq!(
        format!("{:.2}", design.shortening_mm(5.05).unwrap()),
        "21.72"
    );
    assert_eq!(format!("{whole:.2}"), "15.07");
    // With the exact ratios the thread travels are 21.73, 22.22 and 23.45 mm.
    let ratios = Design::paper_ratios();
    for (a, printed) in [
        (5.05, "21.73"),
        ((24.40 - 13.0) / 2.0, "22.22"),
        (9.76, "23.45"),
    ] {
        assert_eq!(format!("{:.2}", ratios.shortening_mm(a).unwrap()), printed);
    }
}

#[test]
fn caliper_readings() {
    assert_eq!(
        indentation_from_calipers_mm(24.40, 14.30).unwrap(),
        (24.40 - 14.30) / 2.0
    );
    for bad in [-0.1, 24.5, f64::NAN] {
        assert!(indentation_from_calipers_mm(24.40, bad).is_err());
    }
    assert!(indentation_from_calipers_mm(f64::NAN, 1.0).is_err());
}

#[test]
fn best_alpha_is_the_lower_bound() {
    let best = best_alpha(33.69, 10.0..=20.0).unwrap();
    assert_eq!(best.alpha_deg, 10.0);
    for a in [0.1, 3.0, 9.76] {
        let d0 = |alpha| {
            Design::new(24.40, 4.88, alpha, 33.69, 9)
                .unwrap()
                .shortening_per_crescent_mm(a)
                .unwrap()
        };
        assert!((101..=200).all(|tenths| d0(f64::from(tenths) / 10.0) < d0(best.alpha_deg)));
    }
    for (beta, low, high) in [
        (33.69, 20.0, 10.0),
        (33.69, 0.0, 10.0),
        (33.69, 10.0, 34.0),
        (90.0, 10.0, 20.0),
        (f64::NAN, 1.0, 2.0),
    ] {
        assert!(best_alpha(beta, low..=high).is_err(), "{beta} {low} {high}");
    }
}

/// Eq. (6) cannot give the paper's alpha: as printed and repaired it has no root between 1 and 33.69 deg.
#[test]
fn equation_6_has_no_root_near_the_papers_angle() {
    let design =
        |alpha: f64| Design::with_slopes(24.40, 4.88, alpha.to_radians().tan(), 20.0, 9).unwrap();
    for a in [0.5, 1.0, 2.0, 3.0, 4.0, 5.05, 9.7] {
        for tenths in 10..=518 {
            let at = design(f64::from(tenths) / 10.0);
            assert!(repaired_eq6_residual(&at, a) > 0.0, "{tenths} {a}");
            assert!(at.slope_by_alpha_mm(a).unwrap() < 0.0);
        }
        for tenths in 10..=336 {
            let printed = printed_eq6_residual(&design(f64::from(tenths) / 10.0), a);
            assert!(printed > 0.0, "{tenths} {a}: {printed}");
        }
    }
    // At a = 0 the two sides meet where tan^2(alpha) is the golden ratio.
    let golden = f64::midpoint(1.0, 5.0f64.sqrt()).sqrt().atan().to_degrees();
    assert_eq!(format!("{golden:.3}"), "51.827");
    assert!(repaired_eq6_residual(&design(golden), 0.0).abs() < 1e-12);
    assert!(repaired_eq6_residual(&design(golden + 0.01), 0.0) < 0.0);
}

/// Eq. (6) in angles as the paper prints it, and with its right side repaired.
#[test]
fn the_residuals_are_those_of_equation_6() {
    for alpha_deg in [2.0f64, 12.53, 25.0, 31.0] {
        let alpha = alpha_deg.to_radians();
        let design = Design::with_slopes(24.40, 4.88, alpha.tan(), 2.0 / 3.0, 9).unwrap();
        let sec_squared = alpha.cos().powi(-2);
        let left = sec_squared * (1.0 - (2.0 - sec_squared).powi(2) * alpha.tan().powi(2));
        let k: f64 = 2.0 / (24.40 - 4.88);
        for a in [0.0f64, 0.05, 3.0, 9.76] {
            let printed = left - k.powi(2) * (k - a).powi(2);
            assert!((printed_eq6_residual(&design, a) - printed).abs() < 1e-12);
            let repaired = left - ((9.76 - a) / 9.76).powi(2);
            assert!((repaired_eq6_residual(&design, a) - repaired).abs() < 1e-12);
        }
    }
}

#[test]
fn the_papers_designs_have_the_papers_dimensions() {
    let rig = (24.40, 4.88, 9.76, 9);
    for (design, (width, core, half_gap, crescents)) in [
        (Design::paper_printed(), rig),
        (Design::paper_ratios(), rig),
        (Design::paper_tube(), (24.00, 4.80, 9.60, 9)),
    ] {
        assert_eq!((design.width_mm(), design.core_mm()), (width, core));
        close("h", design.half_gap_mm(), half_gap, 1e-15);
        assert_eq!(design.crescents(), crescents);
        close("tan alpha", design.tan_alpha(), 2.0 / 9.0, 2e-4);
        close("tan beta", design.tan_beta(), 2.0 / 3.0, 2e-4);
    }
}

#[test]
fn the_papers_rules_put_the_papers_design_in_the_middle() {
    for rule in RULES {
        let value = (rule.of)(&Design::paper_printed());
        assert!(
            (value / rule.target - 1.0).abs() < 0.04,
            "{} = {value}",
            rule.quantity
        );
    }
}

#[test]
fn an_error_says_what_to_do() {
    let error = Design::paper_ratios()
        .shortening_mm(10.0)
        .unwrap_err()
        .to_string();
    assert_eq!(
        error,
        "indentation a = 10 mm is not usable: the wall moves inward, and at a = h it reaches the core; choose a value \
         from 0 to 9.76 mm"
    );
}

/// Width, core, tangents and m of any valid design, as f32 so that both precisions get the same numbers.
fn designs() -> impl Strategy<Value = (f32, f32, f32, f32, u8)> {
    (
        5.0..60.0f32,
        0.05..0.8f32,
        1.0..60.0f32,
        1.0..25.0f32,
        1..=32u8,
    )
        .prop_map(|(width, part, alpha, more, m)| {
            (
                width,
                width * part,
                alpha.to_radians().tan(),
                (alpha + more).to_radians().tan(),
                m,
            )
        })
}

proptest! {
    #[test]
    fn d0_rises_and_is_concave((w, c, ta, tb, m) in designs(), parts in 3..60u32) {
        let design = Design::with_slopes(f64::from(w), f64::from(c), f64::from(ta), f64::from(tb), m).unwrap();
        let h = design.half_gap_mm();
        let d0: Vec<f64> = (0..=parts)
            .map(|i| design.shortening_per_crescent_mm(h * (f64::from(i) / f64::from(parts))).unwrap())
            .collect();
        prop_assert_eq!(d0[0], 0.0);
        for three in d0.windows(3) {
            prop_assert!(three[0] < three[1] && three[1] < three[2]);
            prop_assert!(three[2] - three[1] < three[1] - three[0]);
        }
        prop_assert!(d0[parts as usize] < design.spacing_mm());
    }

    /// The stable forms equal the printed ones, and psi + d0 = phi.
    #[test]
    fn stable_and_printed_forms_agree((w, c, ta, tb, m) in designs(), part in 0.0..=1.0f64) {
        let design = Design::with_slopes(f64::from(w), f64::from(c), f64::from(ta), f64::from(tb), m).unwrap();
        let a = design.half_gap_mm() * part;
        let d0 = design.shortening_per_crescent_mm(a).unwrap();
        let tolerance = 1e-13 * design.long_side_mm() * design.long_side_mm() / (design.half_gap_mm() * design.tan_alpha());
        prop_assert!((d0 - shortening_as_printed_mm(&design, a)).abs() <= tolerance);
        prop_assert!((design.squeezed_spacing_mm(a).unwrap() + d0 - design.spacing_mm()).abs() <= 1e-14 * design.long_side_mm());
    }

    #[test]
    fn f32_stays_within_9e_7((w, c, ta, tb, m) in designs(), part in 0.0..=1.0f32) {
        let single = Design::with_slopes(w, c, ta, tb, m).unwrap();
        let double = Design::with_slopes(f64::from(w), f64::from(c), f64::from(ta), f64::from(tb), m).unwrap();
        let a = single.half_gap_mm() * part;
        prop_assume!(f64::from(a) <= double.half_gap_mm());
        let exact = double.shortening_per_crescent_mm(f64::from(a)).unwrap();
        let error = (f64::from(single.shortening_per_crescent_mm(a).unwrap()) - exact).abs();
        prop_assert!(error <= 9e-7 * exact, "{error} of {exact}");
    }

    /// The derivatives equal central differences of d0.
    #[test]
    fn derivatives_are_slopes((w, c, ta, tb, m) in designs(), part in 0.05..0.95f64) {
        let (w, c, alpha, beta) = (f64::from(w), f64::from(c), f64::from(ta).atan().to_degrees(), f64::from(tb).atan().to_degrees());
        let design = Design::new(w, c, alpha, beta, m).unwrap();
        let a = design.half_gap_mm() * part;
        let d0 = |alpha: f64, beta: f64, a: f64| Design::new(w, c, alpha, beta, m).unwrap().shortening_per_crescent_mm(a).unwrap();
        let scale = design.spacing_mm();
        let step = 1e-5 * design.half_gap_mm();
        let by_a = (d0(alpha, beta, a + step) - d0(alpha, beta, a - step)) / (2.0 * step);
        let slope = design.slope_by_indentation(a).unwrap();
        prop_assert!((by_a - slope).abs() <= 1e-5 * slope + 1e-9 * scale, "a: {by_a} {slope}");
        let turn = 1e-4f64;
        let by_alpha = (d0(alpha + turn, beta, a) - d0(alpha - turn, beta, a)) / (2.0 * turn.to_radians());
        let slope = design.slope_by_alpha_mm(a).unwrap();
        prop_assert!(slope < 0.0 && (by_alpha - slope).abs() <= 1e-5 * design.long_side_mm(), "alpha: {by_alpha} {slope}");
        let by_beta = (d0(alpha, beta + turn, a) - d0(alpha, beta - turn, a)) / (2.0 * turn.to_radians());
        let slope = design.slope_by_beta_mm(a).unwrap();
        prop_assert!(slope > 0.0 && (by_beta - slope).abs() <= 1e-5 * design.long_side_mm(), "beta: {by_beta} {slope}");
    }

    #[test]
    fn thread_and_indentation_are_inverse((w, c, ta, tb, m) in designs(), part in 0.001..=0.999f64) {
        let design = Design::with_slopes(f64::from(w), f64::from(c), f64::from(ta), f64::from(tb), m).unwrap();
        let thread = design.shortening_mm(design.half_gap_mm()).unwrap() * part;
        let a = design.indentation_for_thread_mm(thread).unwrap();
        prop_assert!((design.shortening_mm(a).unwrap() / thread - 1.0).abs() < 1e-13);
    }

    #[test]
    fn outside_the_domain_is_refused((w, c, ta, tb, m) in designs(), by in 1e-9..1e3f64) {
        let design = Design::with_slopes(f64::from(w), f64::from(c), f64::from(ta), f64::from(tb), m).unwrap();
        for a in [-by, design.half_gap_mm() + by, f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            prop_assert!(design.squeezed_spacing_mm(a).is_err());
            prop_assert!(design.shortening_per_crescent_mm(a).is_err());
            prop_assert!(design.shortening_mm(a).is_err());
            prop_assert!(design.core_length_mm(a).is_err());
            prop_assert!(design.length_mm(a).is_err());
            prop_assert!(design.wing_reach_mm(a).is_err());
            prop_assert!(design.folded_width_mm(a).is_err());
            prop_assert!(design.slope_by_indentation(a).is_err());
            prop_assert!(design.slope_by_alpha_mm(a).is_err());
            prop_assert!(design.slope_by_beta_mm(a).is_err());
        }
    }
}

#[test]
fn no_design_with_bad_angles_or_widths() {
    let new = |w: f64, c: f64, alpha: f64, beta: f64, m: u8| Design::new(w, c, alpha, beta, m);
    assert!(new(24.4, 4.88, 12.53, 33.69, 9).is_ok());
    for (w, c, alpha, beta, m) in [
        (24.4, 4.88, 33.69, 33.69, 9),
        (24.4, 4.88, 40.0, 33.69, 9),
        (24.4, 4.88, 12.53, 90.0, 9),
        (24.4, 4.88, 12.53, 120.0, 9),
        (24.4, 4.88, 0.0, 33.69, 9),
        (24.4, 4.88, -5.0, 33.69, 9),
        (24.4, 4.88, f64::NAN, 33.69, 9),
        (24.4, 4.88, 12.53, f64::NAN, 9),
        (24.4, 24.4, 12.53, 33.69, 9),
        (24.4, 0.0, 12.53, 33.69, 9),
        (f64::NAN, 4.88, 12.53, 33.69, 9),
        (24.4, f64::NAN, 12.53, 33.69, 9),
        (24.4, 4.88, 12.53, 33.69, 0),
        (24.4, 4.88, 12.53, 33.69, 33),
    ] {
        assert!(
            new(w, c, alpha, beta, m).is_err(),
            "{w} {c} {alpha} {beta} {m}"
        );
    }
}
