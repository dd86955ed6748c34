//! How much one number that is still to be measured tells, in nats: the mutual information between the number and which
//! of some equally likely draws is the true one.
//!
//! Each draw predicts the number as a normal. The information is the entropy of their mixture less the mean of their own
//! entropies. The number is one-dimensional, so the entropy is an integral over a grid and not a second random sample: of
//! the two nested samples of a nested Monte Carlo estimate only the draws remain.
//!
//! A finite sample of draws has too little entropy, by an amount in proportion to the inverse of their number. Two halves
//! have twice as much of it, which is taken off (Richardson); [`Information::correction`] says how much that was.

/// What one draw says of the number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction {
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
    /// How much the correction was, nats. Not small beside `nats`: there are too few draws.
    pub correction: f64,
}

/// Points of the grid for each standard deviation of the narrowest normal: the error of the sum is below 1e-13 then.
const POINTS: f64 = 2.0;
/// How far a normal reaches, in standard deviations.
const REACH: f64 = 6.5;

/// The information in a number of which draws predict this. The halves are the first and the second one: draws that came from the
/// same place have to stand together.
#[must_use]
pub fn information(predictions: &[Prediction]) -> Information {
    let mean_of = |of: fn(&Prediction) -> f64| {
        predictions.iter().map(of).sum::<f64>() / predictions.len() as f64
    };
    let own = mean_of(|one| entropy_of_normal(one.variance_mm2));
    let [whole, halves] = entropies(predictions);
    let correction = whole - halves;
    Information {
        nats: whole - own + correction,
        correction,
    }
}

/// Entropy of a normal, nats.
fn entropy_of_normal(variance_mm2: f64) -> f64 {
    0.5 * libm::log(core::f64::consts::TAU * core::f64::consts::E * variance_mm2)
}

/// Entropy of the mixture of all, and the mean of those of the two halves, nats.
fn entropies(predictions: &[Prediction]) -> [f64; 2] {
    let least = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::INFINITY, f64::min);
    let deviation = |one: &Prediction| libm::sqrt(one.variance_mm2);
    let narrowest = least(&mut predictions.iter().map(deviation));
    let low = least(
        &mut predictions
            .iter()
            .map(|one| one.mean_mm - REACH * deviation(one)),
    );
    let high = -least(
        &mut predictions
            .iter()
            .map(|one| -one.mean_mm - REACH * deviation(one)),
    );
    let step = narrowest / POINTS;
    let points = ((high - low) / step) as usize + 2;
    let middle = predictions.len() / 2;
    let mut densities = [vec![0.0; points], vec![0.0; points]];
    for (place, one) in predictions.iter().enumerate() {
        let half = &mut densities[usize::from(place >= middle)];
        add(half, one, low, step);
    }
    let [first, second] = densities;
    let counts = [middle as f64, (predictions.len() - middle) as f64];
    let plain = |density: f64| {
        if density > 0.0 {
            -density * libm::log(density)
        } else {
            0.0
        }
    };
    let (mut whole, mut halves) = (0.0, 0.0);
    for (one, other) in first.into_iter().zip(second) {
        whole += plain((one + other) / (counts[0] + counts[1]));
        halves += 0.5 * (plain(one / counts[0]) + plain(other / counts[1]));
    }
    [whole * step, halves * step]
}

/// Adds a normal to a grid. From its middle outwards each value follows from the one before, without an exponential.
fn add(grid: &mut [f64], one: &Prediction, low: f64, step: f64) {
    let deviation = libm::sqrt(one.variance_mm2);
    let centre = (((one.mean_mm - low) / step) as usize).min(grid.len() - 1);
    let off = (low + centre as f64 * step - one.mean_mm) / deviation;
    let stride = step / deviation;
    let height = libm::exp(-0.5 * off * off) / (deviation * libm::sqrt(core::f64::consts::TAU));
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

    fn normals(means_mm: &[f64], variance_mm2: f64) -> Vec<Prediction> {
        let one = |mean_mm: &f64| Prediction {
            mean_mm: *mean_mm,
            variance_mm2,
        };
        means_mm.iter().map(one).collect()
    }

    #[test]
    fn draws_that_are_far_apart_are_told_apart() {
        let found = entropies(&normals(&[0.0, 100.0, 250.0, 400.0], 1.0));
        let own = entropy_of_normal(1.0);
        assert!((found[0] - own - 4f64.ln()).abs() < 1e-9, "{found:?}");
        assert!((found[1] - own - 2f64.ln()).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn a_number_that_is_the_same_for_all_tells_nothing() {
        let found = information(&normals(&[3.0; 10], 0.04));
        assert!(found.nats.abs() < 1e-9, "{found:?}");
        assert!(found.correction.abs() < 1e-9, "{found:?}");
    }

    /// A narrow and a wide normal around the same place: a number tells them apart by its distance. By the trapezoidal
    /// rule in 400,000 steps over 60 standard deviations, worked out apart from the grid.
    #[test]
    fn widths_tell_as_well_as_means() {
        let both = [(0.0, 1.0), (0.5, 25.0)];
        let predictions = both.map(|(mean_mm, variance_mm2)| Prediction {
            mean_mm,
            variance_mm2,
        });
        let density = |x: f64| -> f64 {
            let of = |(mean, variance): &(f64, f64)| {
                (-(x - mean).powi(2) / (2.0 * variance)).exp()
                    / (core::f64::consts::TAU * variance).sqrt()
            };
            both.iter().map(of).sum::<f64>() / 2.0
        };
        let step = 1.5e-4 * 2.0;
        let exact: f64 = (-200_000..200_000)
            .map(|place| density(f64::from(place) * step))
            .filter(|density| *density > 0.0)
            .map(|density| -density * density.ln() * step)
            .sum();
        let found = entropies(&predictions)[0];
        assert!((found - exact).abs() < 1e-6, "{found} {exact}");
    }
}
