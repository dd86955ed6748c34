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

/// Least-squares line of points (x, y): slope, value at 0, R^2.
struct Line {
    slope: f64,
    at_0: f64,
    explained: f64,
}

impl Line {
    fn through(points: impl Iterator<Item = (f64, f64)> + Clone) -> Self {
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
        let slope = xy / xx;
        Self {
            slope,
            at_0: mean_y - slope * mean_x,
            explained: xy * xy / (xx * yy),
        }
    }
}

/// R^2 of the least-squares line through points (x, y).
pub(crate) fn linearity(points: impl Iterator<Item = (f64, f64)> + Clone) -> f64 {
    Line::through(points).explained
}

/// Where a series bends. Fits two lines that meet, by least squares, and returns the x where they meet, to a thousandth
/// of the points' range. NaN for a straight series.
pub(crate) fn bend(points: &[(f64, f64)]) -> f64 {
    const PLACES: u16 = 1_000;
    /// Rounding of the last bits, as a share of the squares that the bend has to explain.
    const ROUNDING: f64 = 1e-18;
    let (Some((first, _)), Some((last, _))) = (points.first(), points.last()) else {
        return f64::NAN;
    };
    let off = |of: &dyn Fn((f64, f64)) -> f64| {
        let line = Line::through(points.iter().map(|point| (point.0, of(*point))));
        move |x: f64, y: f64| y - line.at_0 - line.slope * x
    };
    let left = off(&|(_, y)| y);
    let squares: f64 = points.iter().map(|(_, y)| y * y).sum();
    // Share of the straight line's residual squares that a bend at x explains.
    let explained = |bend: f64| {
        let rise = |x: f64| (x - bend).max(0.0);
        let bent = off(&|(x, _)| rise(x));
        let (mut both, mut own) = (0.0, 0.0);
        for (x, y) in points {
            let (bent, left) = (bent(*x, rise(*x)), left(*x, *y));
            both += bent * left;
            own += bent * bent;
        }
        both * both / own
    };
    let mut best = (ROUNDING * squares, f64::NAN);
    for place in 1..PLACES {
        let x = first + (last - first) * f64::from(place) / f64::from(PLACES);
        let explained = explained(x);
        if explained > best.0 {
            best = (explained, x);
        }
    }
    best.1
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

    /// Two lines that meet at 4.5, between two points; a straight series; none.
    #[test]
    fn a_series_bends_where_its_lines_meet() {
        let of = |y: fn(f64) -> f64| -> std::vec::Vec<_> {
            (0..11).map(f64::from).map(|x| (x, y(x))).collect()
        };
        let bent = of(|x| x + 9.0 * (x - 4.5).max(0.0));
        assert!((bend(&bent) - 4.5).abs() < 0.01, "{}", bend(&bent));
        assert!(bend(&of(|x| 3.0 + 0.7 * x)).is_nan());
        assert!(bend(&[]).is_nan());
    }
}
