//! Statistics of repeated measurements: mean and standard deviation, and a straight line with its confidence band.
//! Pure.

use statrs::distribution::{ContinuousCDF, StudentsT};

/// Confidence of the band and of all intervals here.
pub const CONFIDENCE: f64 = 0.95;

/// Mean and standard deviation of some values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Number of values.
    pub n: usize,
    /// Their mean.
    pub mean: f64,
    /// Standard deviation of the sample, with n - 1; none for a single value.
    pub sd: Option<f64>,
}

impl Spread {
    /// Mean and standard deviation of these values; none without values.
    #[must_use]
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

/// The least-squares line through points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedLine {
    /// Number of points.
    pub n: usize,
    /// Rise per unit of x.
    pub slope: f64,
    /// Value at x = 0.
    pub intercept: f64,
    /// Share of the variance of y that the line explains; none if all y are equal.
    pub r_squared: Option<f64>,
    /// Standard deviation of the points about the line, with n - 2; none for two points.
    pub residual_sd: Option<f64>,
    mean_x: f64,
    /// Sum of squares of x about its mean.
    squares_x: f64,
}

impl FittedLine {
    /// Through points (x, y); none for fewer than two different x, which determine no line.
    #[must_use]
    pub fn through(points: &[(f64, f64)]) -> Option<Self> {
        let n = points.len();
        let count = n as f64;
        let mean_x = points.iter().map(|(x, _)| x).sum::<f64>() / count;
        let mean_y = points.iter().map(|(_, y)| y).sum::<f64>() / count;
        let (mut squares_x, mut products, mut squares_y) = (0.0, 0.0, 0.0);
        for (x, y) in points {
            squares_x += (x - mean_x).powi(2);
            products += (x - mean_x) * (y - mean_y);
            squares_y += (y - mean_y).powi(2);
        }
        let first = points.first()?.0;
        if points.iter().all(|(x, _)| *x == first) {
            return None;
        }
        let slope = products / squares_x;
        let intercept = mean_y - slope * mean_x;
        let left: f64 = points
            .iter()
            .map(|(x, y)| (y - intercept - slope * x).powi(2))
            .sum();
        Some(Self {
            n,
            slope,
            intercept,
            r_squared: (squares_y > 0.0).then(|| 1.0 - left / squares_y),
            residual_sd: (n > 2).then(|| (left / (count - 2.0)).sqrt()),
            mean_x,
            squares_x,
        })
    }

    /// Its value at `x`.
    #[must_use]
    pub fn at(&self, x: f64) -> f64 {
        self.intercept + self.slope * x
    }

    /// Half the width of the band at `x` that contains the true line's value with [`CONFIDENCE`]; none for two
    /// points.
    #[must_use]
    pub fn half_band(&self, x: f64) -> Option<f64> {
        let sd = self.residual_sd?;
        let share = 1.0 / self.n as f64 + (x - self.mean_x).powi(2) / self.squares_x;
        Some(student_t(self.n - 2) * sd * share.sqrt())
    }

    /// Half the width of the interval of the slope with [`CONFIDENCE`]; none for two points.
    #[must_use]
    pub fn half_slope(&self) -> Option<f64> {
        let sd = self.residual_sd?;
        Some(student_t(self.n - 2) * sd / self.squares_x.sqrt())
    }
}

/// The t for which Student's distribution with `degrees` degrees of freedom has [`CONFIDENCE`] within -t to t;
/// infinite for 0.
fn student_t(degrees: usize) -> f64 {
    let t = StudentsT::new(0.0, 1.0, degrees as f64);
    t.map_or(f64::INFINITY, |t| t.inverse_cdf((1.0 + CONFIDENCE) / 2.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn near(a: f64, b: f64, scale: f64) -> bool {
        (a - b).abs() <= 1e-9 * scale.max(1.0)
    }

    /// Two points leave no degrees of freedom, so there is no t.
    #[test]
    fn a_line_through_two_points_has_no_band() {
        let line = FittedLine::through(&[(1.0, 2.0), (3.0, 6.0)]).expect("two places");
        assert_eq!((line.slope, line.intercept), (2.0, 0.0));
        assert_eq!((line.half_slope(), line.half_band(2.0)), (None, None));
        assert_eq!(student_t(0), f64::INFINITY);
    }

    #[test]
    fn students_t_is_as_in_the_tables() {
        for (degrees, wanted) in [
            (1, 12.706),
            (2, 4.303),
            (3, 3.182),
            (4, 2.776),
            (5, 2.571),
            (8, 2.306),
            (10, 2.228),
            (48, 2.011),
            (1_000, 1.962),
        ] {
            let t = student_t(degrees);
            assert!((t - wanted).abs() < 5e-4, "{degrees}: {t}");
        }
    }

    /// Worked out by hand: x 1, 2, 3, 4 and y 2, 4, 5, 8.
    #[test]
    fn a_line_of_four_points_is_the_one_of_the_book() {
        let line =
            FittedLine::through(&[(1.0, 2.0), (2.0, 4.0), (3.0, 5.0), (4.0, 8.0)]).expect("a line");
        assert!(near(line.slope, 1.9, 1.0) && near(line.intercept, 0.0, 1.0));
        // Residuals 0.1, 0.2, -0.7, 0.4: squares 0.70, of 18.75.
        assert!(near(
            line.r_squared.expect("spread"),
            1.0 - 0.7 / 18.75,
            1.0
        ));
        assert!(near(line.residual_sd.expect("four"), 0.35_f64.sqrt(), 1.0));
        let half = line.half_band(2.5).expect("four");
        assert!(
            (half - 4.302_652_7 * 0.35_f64.sqrt() / 2.0).abs() < 1e-6,
            "{half}"
        );
        let half = line.half_slope().expect("four");
        assert!(
            (half - 4.302_652_7 * (0.35_f64 / 5.0).sqrt()).abs() < 1e-6,
            "{half}"
        );
    }

    /// The same points three higher, and their mean and deviation.
    #[test]
    fn a_line_that_does_not_pass_the_origin_has_its_height() {
        let points = [(1.0, 5.0), (2.0, 7.0), (3.0, 8.0), (4.0, 11.0)];
        let line = FittedLine::through(&points).expect("a line");
        assert!(near(line.intercept, 3.0, 1.0) && near(line.at(4.0), 10.6, 1.0));
        assert!(near(line.residual_sd.expect("four"), 0.35_f64.sqrt(), 1.0));
        // Of five points three degrees of freedom are left: t is 3.1824, the residual deviation 0.6325.
        let five = [(1.0, 0.0), (2.0, 1.0), (3.0, 0.0), (4.0, 1.0), (5.0, 0.0)];
        let line = FittedLine::through(&five).expect("a line");
        let near = |is: Option<f64>, expected: f64| (is.expect("five") - expected).abs() < 1e-5;
        assert!(near(line.half_slope(), 0.636_489), "{line:?}");
        assert!(near(line.half_band(3.0), 0.900_132), "{line:?}");
        assert!(near(line.half_band(5.0), 1.559_075), "{line:?}");
    }

    #[test]
    fn a_spread_is_a_mean_and_its_deviation() {
        let points = [(1.0, 5.0), (2.0, 7.0), (3.0, 8.0), (4.0, 11.0)];
        let spread = Spread::of(&points.map(|(_, y)| y)).expect("four");
        assert!(near(spread.mean, 7.75, 1.0) && spread.n == 4);
        // Squares of 2.75, 0.75, 0.25, 3.25: 18.75 over 3.
        assert!(near(spread.sd.expect("four"), 2.5, 1.0));
    }

    #[test]
    fn what_cannot_be_said_is_not_said() {
        assert_eq!(Spread::of(&[]), None);
        assert_eq!(Spread::of(&[2.0]).expect("one").sd, None);
        assert_eq!(FittedLine::through(&[]), None);
        assert_eq!(FittedLine::through(&[(1.0, 1.0)]), None);
        assert_eq!(FittedLine::through(&[(1.0, 1.0), (1.0, 2.0)]), None);
        let two = FittedLine::through(&[(1.0, 1.0), (2.0, 3.0)]).expect("two");
        assert_eq!((two.residual_sd, two.half_band(1.0)), (None, None));
        let level = FittedLine::through(&[(1.0, 2.0), (2.0, 2.0), (3.0, 2.0)]).expect("level");
        assert_eq!((level.slope, level.r_squared), (0.0, None));
    }

    fn points() -> impl Strategy<Value = Vec<(f64, f64)>> {
        let length = -100_000_i32..100_000;
        let point =
            (0_i32..6_000, length).prop_map(|(x, y)| (f64::from(x) / 1e3, f64::from(y) / 1e3));
        prop::collection::vec(point, 3..40)
    }

    proptest! {
        #[test]
        fn mean_and_deviation_move_and_stretch_with_the_values(
            values in prop::collection::vec(-1e3..1e3_f64, 2..40), shift in -1e3..1e3_f64, stretch in 0.1..10.0_f64
        ) {
            let before = Spread::of(&values).expect("some");
            let moved: Vec<_> = values.iter().map(|value| value * stretch + shift).collect();
            let after = Spread::of(&moved).expect("some");
            prop_assert!(near(after.mean, before.mean * stretch + shift, 1e4));
            prop_assert!(near(after.sd.expect("two"), before.sd.expect("two") * stretch, 1e4));
            let (least, most) = values.iter().fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(*v), b.max(*v)));
            prop_assert!((least - 1e-9..=most + 1e-9).contains(&before.mean));
            // The standard deviation of n values is largest for the two ends alone.
            prop_assert!(before.sd.expect("two") <= (most - least) / std::f64::consts::SQRT_2 + 1e-9);
        }

        #[test]
        fn no_other_line_is_nearer(points in points(), tilt in -1.0..1.0_f64, lift in -1.0..1.0_f64) {
            prop_assume!(points.iter().any(|(x, _)| (x - points[0].0).abs() > 0.1));
            let line = FittedLine::through(&points).expect("different x");
            let squares = |slope: f64, intercept: f64| -> f64 {
                points.iter().map(|(x, y)| (y - intercept - slope * x).powi(2)).sum()
            };
            let best = squares(line.slope, line.intercept);
            prop_assert!(best <= squares(line.slope + tilt, line.intercept + lift) * (1.0 + 1e-9) + 1e-6);
            if let Some(r_squared) = line.r_squared {
                prop_assert!((-1e-9..=1.0 + 1e-9).contains(&r_squared));
            }
            // The band is narrowest in the middle of the points, and never negative.
            let middle = line.half_band(line.mean_x).expect("three");
            for x in [-10.0, 0.0, 3.0, 50.0] {
                prop_assert!(line.half_band(x).expect("three") >= middle);
            }
        }

        #[test]
        fn points_on_a_line_give_that_line(
            slope in -20.0..20.0_f64, intercept in -50.0..50.0_f64, count in 3_u32..30
        ) {
            let on: Vec<_> = (0..count).map(|x| (f64::from(x), intercept + slope * f64::from(x))).collect();
            let line = FittedLine::through(&on).expect("a line");
            prop_assert!(near(line.slope, slope, 1e2) && near(line.intercept, intercept, 1e2));
            prop_assert!(line.half_band(1.0).expect("three") < 1e-6);
        }
    }
}
