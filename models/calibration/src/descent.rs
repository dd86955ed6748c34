//! The lowest place of a function of the body, without its slopes: Nelder and Mead's simplex.

use crate::prior::OF_BODY;

/// A body in standard normal coordinates.
pub type Place = [f64; OF_BODY];

/// Evaluations of a descent, at most.
const MOST: usize = 400;
/// The simplex has shrunk to a point when its values differ by less than this.
const FLAT: f64 = 1e-4;

/// Descends from a start, with first steps of this width. Returns the lowest place found and its value.
pub fn lowest(of: &dyn Fn(&Place) -> f64, start: &Place, width: &Place) -> (Place, f64) {
    let mut left = MOST;
    let mut best = (*start, of(start));
    // A simplex may collapse beside a ridge: begin again where it ended, until that leads no lower.
    loop {
        let found = simplex(of, &best.0, width, &mut left);
        let gained = best.1 - found.1;
        if found.1 < best.1 {
            best = found;
        }
        if left == 0 || gained.partial_cmp(&FLAT) != Some(core::cmp::Ordering::Greater) {
            return best;
        }
    }
}

fn simplex(
    of: &dyn Fn(&Place) -> f64,
    start: &Place,
    width: &Place,
    left: &mut usize,
) -> (Place, f64) {
    let mut corners = vec![(*start, of(start))];
    for axis in 0..OF_BODY {
        let mut corner = *start;
        corner[axis] += width[axis];
        corners.push((corner, of(&corner)));
    }
    loop {
        corners.sort_by(|one, other| one.1.total_cmp(&other.1));
        let (lowest, second, highest) = (corners[0], corners[OF_BODY - 1].1, corners[OF_BODY]);
        if *left == 0 || highest.1 - lowest.1 < FLAT {
            return lowest;
        }
        *left -= 1;
        let middle: Place = core::array::from_fn(|axis| {
            corners[..OF_BODY]
                .iter()
                .map(|corner| corner.0[axis])
                .sum::<f64>()
                / OF_BODY as f64
        });
        let along = |far: f64| {
            let place: Place =
                core::array::from_fn(|axis| middle[axis] + far * (highest.0[axis] - middle[axis]));
            (place, of(&place))
        };
        let reflected = along(-1.0);
        let next = if reflected.1 < lowest.1 {
            let farther = along(-2.0);
            if farther.1 < reflected.1 {
                farther
            } else {
                reflected
            }
        } else if reflected.1 < second {
            reflected
        } else {
            along(if reflected.1 < highest.1 { -0.5 } else { 0.5 })
        };
        if next.1 < highest.1 {
            corners[OF_BODY] = next;
            continue;
        }
        for corner in &mut corners[1..] {
            for (value, best) in corner.0.iter_mut().zip(lowest.0) {
                *value = f64::midpoint(*value, best);
            }
            corner.1 = of(&corner.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_finds_the_floor_of_a_bent_valley() {
        let valley = |place: &Place| {
            let [x, y, z] = *place;
            10.0 * (y - x * x).powi(2) + (1.0 - x).powi(2) + (z - y).powi(2) + 3.0
        };
        let (place, value) = lowest(&valley, &[-0.5, 1.0, 0.0], &[0.3; 3]);
        assert!((value - 3.0).abs() < 1e-2, "{value} at {place:?}");
    }
}
