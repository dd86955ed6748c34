//! Cuts what lies above and below a plot.

type Point = (f64, f64);

/// The part of an area between two heights.
pub(crate) fn clipped(outline: &[Point], low: f64, high: f64) -> Vec<Point> {
    let above = side(outline, |y| y - low);
    side(&above, |y| high - y)
}

/// The part of an area where `depth` of the height is not negative.
fn side(outline: &[Point], depth: impl Fn(f64) -> f64) -> Vec<Point> {
    let mut kept = vec![];
    let before = outline.iter().cycle().skip(outline.len().saturating_sub(1));
    for (from, to) in before.zip(outline) {
        let (depth_from, depth_to) = (depth(from.1), depth(to.1));
        if (depth_from < 0.0) != (depth_to < 0.0) {
            let part = depth_from / (depth_from - depth_to);
            let between = |a: f64, b: f64| a + (b - a) * part;
            kept.push((between(from.0, to.0), between(from.1, to.1)));
        }
        if depth_to >= 0.0 {
            kept.push(*to);
        }
    }
    kept
}

/// The part of each edge of an area between two heights, from one point to the next.
pub(crate) fn edges(outline: &[Point], low: f64, high: f64) -> Vec<[Point; 2]> {
    let within = |pair: &[Point]| {
        let [(x0, y0), (x1, y1)] = [pair[0], pair[1]];
        let way = y1 - y0;
        let (mut first, mut last) = (0.0_f64, 1.0_f64);
        if way == 0.0 {
            return (low..=high).contains(&y0).then_some([pair[0], pair[1]]);
        }
        let (a, b) = ((low - y0) / way, (high - y0) / way);
        first = first.max(a.min(b));
        last = last.min(a.max(b));
        let at = |part: f64| (x0 + (x1 - x0) * part, y0 + way * part);
        (first < last).then(|| [at(first), at(last)])
    };
    outline.windows(2).filter_map(within).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [Point; 4] = [(0.0, 0.0), (0.0, 10.0), (4.0, 10.0), (4.0, 0.0)];

    #[test]
    fn an_area_keeps_what_is_between() {
        let mut cut = clipped(&SQUARE, 2.0, 6.0);
        cut.sort_by(|a, b| a.partial_cmp(b).expect("numbers"));
        assert_eq!(cut, [(0.0, 2.0), (0.0, 6.0), (4.0, 2.0), (4.0, 6.0)]);
        assert_eq!(clipped(&SQUARE, -1.0, 11.0).len(), 4);
        assert_eq!(clipped(&SQUARE, 20.0, 30.0), []);
        assert_eq!(clipped(&[], 0.0, 1.0), []);
    }

    #[test]
    fn an_edge_ends_at_the_plot() {
        let rising = [(0.0, 0.0), (10.0, 10.0), (20.0, 10.0)];
        assert_eq!(edges(&rising, 2.0, 6.0), [[(2.0, 2.0), (6.0, 6.0)]]);
        assert_eq!(edges(&rising, 0.0, 10.0).len(), 2);
    }
}
