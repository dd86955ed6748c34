//! Priors: their quantiles, their draws, and their unknowns.

use calibration::chance::stream;
use calibration::fit::quantile;
use calibration::prior::{DISCREPANCY, OF_BODY, Shape, Values, draw, parts, unknowns, with_body};
use locomotion::model::{Model, Setting};

#[test]
fn every_unknown_is_a_parameter_or_the_discrepancy() {
    let all = unknowns();
    for unknown in &all[..OF_BODY] {
        assert!(unknown.key.starts_with("body."), "{unknown:?}");
        assert!(Setting::named(unknown.key).is_some() && !unknown.because.is_empty());
    }
    assert_eq!(all[OF_BODY].key, DISCREPANCY);
    let mut random = stream(3, 3);
    for _ in 0..100 {
        let point = draw(&mut random);
        let values = Values::at(&point);
        let model = with_body(&Model::ONE, &parts(&point));
        model.check().expect("within the model's ranges");
        for (unknown, value) in all.iter().zip(values.of_body()) {
            let set = Setting::named(unknown.key).expect("known").value(&model);
            assert!((set / value - 1.0).abs() < 1e-12, "{}", unknown.key);
        }
    }
}

#[test]
fn a_value_has_its_coordinate_back() {
    for shape in [
        Shape::Even(7.0, 9.0),
        Shape::EvenInLogarithm(1e-4, 0.2),
        Shape::LogNormal {
            median: 0.1,
            spread: 1.0,
        },
    ] {
        for z in [-3.0, -0.5, 0.0, 1.0, 2.5] {
            let back = shape.coordinate(shape.value(z));
            assert!((back - z).abs() < 1e-9, "{shape:?}: {back} for {z}");
        }
        assert!(shape.value(-1.0) < shape.value(1.0));
        assert!((shape.quantile(0.5) / shape.value(0.0) - 1.0).abs() < 1e-12);
    }
    assert_eq!(Shape::Even(7.0, 9.0).coordinate(9.5), f64::INFINITY);
}

/// The model accepts the ends of the priors, to the last bit: tables have nodes there.
#[test]
fn the_ends_of_the_priors_are_covered() {
    for part in [0.0, 1.0] {
        with_body(&Model::ONE, &[part; OF_BODY])
            .check()
            .expect("covered");
    }
}

/// A twentieth of the draws lies below the 5 % quantile, within four standard errors.
#[test]
fn the_draws_have_the_quantiles() {
    let mut random = stream(11, 0);
    let draws: Vec<Values> = (0..20_000).map(|_| Values::draw(&mut random)).collect();
    for (place, unknown) in unknowns().iter().enumerate() {
        for part in [0.05, 0.5, 0.95] {
            let limit = unknown.shape.quantile(part);
            let below = draws.iter().filter(|draw| draw.0[place] < limit).count() as f64 / 20_000.0;
            let error = (part * (1.0 - part) / 20_000.0f64).sqrt();
            assert!(
                (below - part).abs() < 4.0 * error,
                "{}: {below} for {part}",
                unknown.key
            );
        }
    }
    assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
}
