//! Information, in nats, of one future measurement about which of several equally likely draws is true.
//!
//! Each draw predicts the measurement as a normal. The information is the entropy of their mixture minus the mean
//! entropy that remains once the draw is known. The measurement is one-dimensional, so each entropy is an integral
//! over a grid and needs no second random sample: of the two nested samples of a nested Monte Carlo estimate only the
//! draws remain.
//!
//! A finite sample of draws has too little entropy, by an amount inversely proportional to its size. For half of the
//! draws the error is twice as large, so the halves serve to remove it (Richardson); [`Information::correction`] is
//! the amount removed.

/// A normal with a weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Normal {
    /// Its weight, above 0.
    pub weight: f64,
    /// Mean, mm.
    pub mean_mm: f64,
    /// Variance, mm^2, above 0.
    pub variance_mm2: f64,
}

/// An estimate from one set of draws.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Information {
    /// The information, nats, corrected.
    pub nats: f64,
    /// Size of the correction, nats. There are too few draws if it is not small against `nats`.
    pub correction: f64,
}

/// Grid points per standard deviation of the narrowest normal: the error of the sum is then below 1e-13.
const POINTS: f64 = 2.0;
/// Half-width of a normal on the grid, in standard deviations.
const REACH: f64 = 6.5;

/// Information of a measurement that draws predict as `predictions`, one normal each. `left` is the entropy that
/// remains once the draw is known. Compares the first half with the second: keep draws of the same origin together.
#[must_use]
pub fn information(predictions: &[Normal], left: f64) -> Information {
    let (first, second) = predictions.split_at(predictions.len() / 2);
    let whole = entropy(predictions);
    let correction = whole - 0.5 * (entropy(first) + entropy(second));
    Information {
        nats: whole - left + correction,
        correction,
    }
}

/// Entropy of a mixture of normals, nats.
#[must_use]
pub fn entropy(mixture: &[Normal]) -> f64 {
    let least = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::INFINITY, f64::min);
    let deviation = |one: &Normal| libm::sqrt(one.variance_mm2);
    let narrowest = least(&mut mixture.iter().map(deviation));
    let low = least(
        &mut mixture
            .iter()
            .map(|one| one.mean_mm - REACH * deviation(one)),
    );
    let high = -least(
        &mut mixture
            .iter()
            .map(|one| -one.mean_mm - REACH * deviation(one)),
    );
    let step = narrowest / POINTS;
    let mut density = vec![0.0; ((high - low) / step) as usize + 2];
    for one in mixture {
        add(&mut density, one, low, step);
    }
    let sum: f64 = mixture.iter().map(|one| one.weight).sum();
    let plain = |density: f64| {
        let share = density / sum;
        if share > 0.0 {
            -share * libm::log(share)
        } else {
            0.0
        }
    };
    density.into_iter().map(plain).sum::<f64>() * step
}

/// Entropy of a mixture of normals with the same mean, nats; ignores their `mean_mm`. The grid widens with the
/// distance from the middle, so that very different widths cost nothing.
#[must_use]
pub fn concentric_entropy(mixture: &[Normal]) -> f64 {
    const STEP: f64 = 0.1;
    let deviations = || mixture.iter().map(|one| libm::sqrt(one.variance_mm2));
    let narrowest = deviations().fold(f64::INFINITY, f64::min);
    let widest = deviations().fold(0.0, f64::max);
    let sum: f64 = mixture.iter().map(|one| one.weight).sum();
    let places = (libm::asinh(REACH * widest / narrowest) / STEP) as usize + 1;
    let plain = |place: usize| {
        let at = place as f64 * STEP;
        let off = narrowest * libm::sinh(at);
        let density = |one: &Normal| {
            let height = one.weight / libm::sqrt(core::f64::consts::TAU * one.variance_mm2);
            height * libm::exp(-0.5 * off * off / one.variance_mm2)
        };
        let density = mixture.iter().map(density).sum::<f64>() / sum;
        let sides = if place == 0 { 1.0 } else { 2.0 };
        let share = -density * libm::log(density.max(f64::MIN_POSITIVE));
        sides * share * narrowest * libm::cosh(at) * STEP
    };
    (0..=places).map(plain).sum()
}

/// Adds a normal to a grid. Computes each value outward from the previous one, without an exponential.
fn add(grid: &mut [f64], one: &Normal, low: f64, step: f64) {
    let deviation = libm::sqrt(one.variance_mm2);
    let centre = (((one.mean_mm - low) / step) as usize).min(grid.len() - 1);
    let off = (low + centre as f64 * step - one.mean_mm) / deviation;
    let stride = step / deviation;
    let height =
        one.weight * libm::exp(-0.5 * off * off) / (deviation * libm::sqrt(core::f64::consts::TAU));
    let reach = (REACH / stride) as usize + 1;
    let bend = libm::exp(-stride * stride);
    let first = |sign: f64| libm::exp(-stride * (sign * off + 0.5 * stride));
    let (mut value, mut ratio) = (height, first(1.0));
    for slot in grid[centre..].iter_mut().take(reach + 1) {
        *slot += value;
        value *= ratio;
        ratio *= bend;
    }
    (value, ratio) = (height * first(-1.0), first(-1.0) * bend);
    for slot in grid[..centre].iter_mut().rev().take(reach) {
        *slot += value;
        value *= ratio;
        ratio *= bend;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Entropy of a normal of variance 1.
    fn own() -> f64 {
        0.5 * (core::f64::consts::TAU * core::f64::consts::E).ln()
    }

    fn normals(means_mm: &[f64]) -> Vec<Normal> {
        let one = |mean_mm: &f64| Normal {
            weight: 1.0,
            mean_mm: *mean_mm,
            variance_mm2: 1.0,
        };
        means_mm.iter().map(one).collect()
    }

    #[test]
    fn draws_that_are_far_apart_are_told_apart() {
        let found = information(&normals(&[0.0, 100.0, 250.0, 400.0]), own());
        assert!((found.correction - 2f64.ln()).abs() < 1e-9, "{found:?}");
        assert!((found.nats - 8f64.ln()).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn a_number_that_is_the_same_for_all_tells_nothing() {
        let found = information(&normals(&[3.0; 10]), own());
        assert!(found.nats.abs() < 1e-9, "{found:?}");
        assert!(found.correction.abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn both_grids_agree_on_one_middle() {
        let wide = [(1.0, 1.0), (0.3, 9.0), (2.0, 1.2), (0.1, 2500.0)];
        let mixture = wide.map(|(weight, variance_mm2)| Normal {
            weight,
            mean_mm: 4.0,
            variance_mm2,
        });
        let (one, other) = (entropy(&mixture), concentric_entropy(&mixture));
        assert!((one - other).abs() < 1e-7, "{one} {other}");
        assert!((concentric_entropy(&mixture[..1]) - own()).abs() < 1e-9);
    }

    /// Against a sum over 400,000 points, computed without the grid.
    #[test]
    fn weights_and_widths_count() {
        let both = [(0.75, 0.0, 1.0), (0.25, 0.5, 25.0)];
        let mixture = both.map(|(weight, mean_mm, variance_mm2)| Normal {
            weight: 2.0 * weight,
            mean_mm,
            variance_mm2,
        });
        let density = |x: f64| -> f64 {
            let of = |(weight, mean, variance): &(f64, f64, f64)| {
                let height = weight / (core::f64::consts::TAU * variance).sqrt();
                height * (-(x - mean).powi(2) / (2.0 * variance)).exp()
            };
            both.iter().map(of).sum()
        };
        let step = 3e-4;
        let exact: f64 = (-200_000..200_000)
            .map(|place| density(f64::from(place) * step))
            .filter(|density| *density > 0.0)
            .map(|density| -density * density.ln() * step)
            .sum();
        let found = entropy(&mixture);
        assert!((found - exact).abs() < 1e-6, "{found} {exact}");
    }
}
