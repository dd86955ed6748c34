//! Statistics of repeated measurements: mean and standard deviation, and the least-squares line.

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    pub n: usize,
    pub mean: f64,
    /// Sample standard deviation, with n - 1; none for a single value.
    pub sd: Option<f64>,
}

impl Spread {
    /// Mean and standard deviation of these values; none without values.
    pub fn of(values: &[f64]) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let n = values.len();
        let mean = values.iter().sum::<f64>() / n as f64;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let sd = (n > 1).then(|| (squares / (n - 1) as f64).sqrt());
        Some(Self { n, mean, sd })
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedLine {
    /// Rise per unit of x.
    pub slope: f64,
    pub intercept: f64,
}

impl FittedLine {
    /// Least-squares line through points (x, y); none for fewer than two different x, which determine no line.
    pub fn through(points: &[(f64, f64)]) -> Option<Self> {
        let first = points.first()?.0;
        if points.iter().all(|(x, _)| *x == first) {
            return None;
        }
        let count = points.len() as f64;
        let mean_x = points.iter().map(|(x, _)| x).sum::<f64>() / count;
        let mean_y = points.iter().map(|(_, y)| y).sum::<f64>() / count;
        let (mut squares, mut products) = (0.0, 0.0);
        for (x, y) in points {
            squares += (x - mean_x).powi(2);
            products += (x - mean_x) * (y - mean_y);
        }
        let slope = products / squares;
        let intercept = mean_y - slope * mean_x;
        Some(Self { slope, intercept })
    }

    pub fn at(&self, x: f64) -> f64 {
        self.intercept + self.slope * x
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Worked out by hand: x 1, 2, 3, 4 and y 2, 4, 5, 8, also three higher.
    #[test]
    fn a_line_and_a_spread_are_those_of_the_book() {
        let points = [(1.0, 5.0), (2.0, 7.0), (3.0, 8.0), (4.0, 11.0)];
        let line = FittedLine::through(&points).expect("a line");
        assert!((line.slope - 1.9).abs() < 1e-12 && (line.at(0.0) - 3.0).abs() < 1e-12);
        let lower = points.map(|(x, y)| (x, y - 3.0));
        assert!(FittedLine::through(&lower).expect("a line").intercept.abs() < 1e-12);
        // Squares of 2.75, 0.75, 0.25, 3.25: 18.75 over 3.
        let spread = Spread::of(&points.map(|(_, y)| y)).expect("four");
        assert_eq!((spread.n, spread.mean, spread.sd), (4, 7.75, Some(2.5)));
    }

    #[test]
    fn what_cannot_be_said_is_not_said() {
        assert_eq!(Spread::of(&[]), None);
        assert_eq!(Spread::of(&[2.0]).expect("one").sd, None);
        for none in [&[][..], &[(1.0, 1.0)], &[(1.0, 1.0), (1.0, 2.0)]] {
            assert_eq!(FittedLine::through(none), None);
        }
    }

    proptest! {
        #[test]
        fn no_other_line_is_nearer(
            points in prop::collection::vec((0.0..6.0_f64, -100.0..100.0_f64), 3..40),
            tilt in -1.0..1.0_f64,
            lift in -1.0..1.0_f64,
        ) {
            prop_assume!(points.iter().any(|(x, _)| (x - points[0].0).abs() > 0.1));
            let line = FittedLine::through(&points).expect("different x");
            let squares = |slope: f64, intercept: f64| -> f64 {
                points.iter().map(|(x, y)| (y - intercept - slope * x).powi(2)).sum()
            };
            let best = squares(line.slope, line.intercept);
            prop_assert!(best <= squares(line.slope + tilt, line.intercept + lift) * (1.0 + 1e-9) + 1e-6);
        }
    }
}
