//! Trends of short series, as the paper's sentences name them: rising, convex, a straight line.

/// Number of steps that rise.
pub(crate) fn rising(series: &[f64]) -> usize {
    series.windows(2).filter(|w| w[1] > w[0]).count()
}

/// Number of bends that turn upward.
pub(crate) fn convex(series: &[f64]) -> usize {
    series
        .windows(3)
        .filter(|w| w[2] - w[1] > w[1] - w[0])
        .count()
}

/// R^2 of the least-squares line through points (x, y).
pub(crate) fn linearity(points: impl Iterator<Item = (f64, f64)> + Clone) -> f64 {
    let n = points.clone().count() as f64;
    let (sum_x, sum_y) = points
        .clone()
        .fold((0.0, 0.0), |(sx, sy), (x, y)| (sx + x, sy + y));
    let (mean_x, mean_y) = (sum_x / n, sum_y / n);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (x, y) in points {
        let (dx, dy) = (x - mean_x, y - mean_y);
        xx += dx * dx;
        xy += dx * dy;
        yy += dy * dy;
    }
    xy * xy / (xx * yy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_step_does_not_rise_and_a_straight_series_does_not_bend() {
        for (series, up, bent) in [
            (&[1.0, 2.0, 3.0, 4.0][..], 3, 0),
            (&[1.0, 1.0, 2.0, 2.0], 1, 1),
            (&[4.0, 5.0, 7.0, 6.0], 2, 1),
            (&[8.0, 4.0, 2.0, 1.0], 0, 2),
        ] {
            assert_eq!(rising(series), up, "{series:?}");
            assert_eq!(convex(series), bent, "{series:?}");
        }
    }

    /// By hand: through (0, 0), (1, 1), (2, 1) the line explains three quarters of the variance.
    #[test]
    fn a_line_explains_what_it_explains() {
        let points = [(0.0, 0.0), (1.0, 1.0), (2.0, 1.0)];
        assert!((linearity(points.into_iter()) - 0.75).abs() < 1e-12);
        let straight = [(0.0, 3.0), (2.0, 7.0), (3.0, 9.0)];
        assert!((linearity(straight.into_iter()) - 1.0).abs() < 1e-12);
    }
}
