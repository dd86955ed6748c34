//! Force of the origami over the thread's travel.

use std::sync::OnceLock;

/// Step of the crescent's height, mm.
const HEIGHT_MM: f64 = 0.01;
/// Step of the table in travel, mm.
const STEP_MM: f64 = 0.005;

/// Force of the nine crescents at a travel, N, by a beam estimate:
/// F = 0.2055 N/mm a / (d psi / da), travel = 9 (psi(0) - psi(a)), with the paper's Eqs. (2) to (5) and (7).
#[must_use]
pub fn force_n(travel_mm: f64) -> f64 {
    static TABLE: OnceLock<Vec<f64>> = OnceLock::new();
    let table = TABLE.get_or_init(over_travel);
    let place = travel_mm.max(0.0) / STEP_MM;
    let index = place as usize;
    match (table.get(index), table.get(index + 1)) {
        (Some(low), Some(high)) => low + (high - low) * (place - index as f64),
        _ => table[table.len() - 1],
    }
}

/// The force in equal steps of travel.
fn over_travel() -> Vec<f64> {
    let over_height: Vec<(f64, f64)> = (0..970)
        .map(|index| f64::from(index) * HEIGHT_MM)
        .map(|a| {
            let slope = (psi(a - 1e-4) - psi(a + 1e-4)) / 2e-4;
            (9.0 * (psi(0.0) - psi(a)), 0.2055 * a / slope)
        })
        .collect();
    let (longest_mm, _) = over_height[over_height.len() - 1];
    (0..=(longest_mm / STEP_MM) as usize)
        .map(|index| index as f64 * STEP_MM)
        .map(|travel_mm| {
            let above = over_height.partition_point(|(travel, _)| *travel <= travel_mm);
            let (low, high) = (over_height[above - 1], over_height[above]);
            low.1 + (high.1 - low.1) * (travel_mm - low.0) / (high.0 - low.0)
        })
        .collect()
}

/// Half the depth of a crescent whose height is reduced by `a`, mm.
fn psi(a: f64) -> f64 {
    let (h, ta, tb) = (9.76_f64, 2.0 / 9.0, 2.0 / 3.0);
    let longer = h * (1.0_f64 + tb * tb).sqrt();
    let shorter = h * (1.0_f64 + ta * ta).sqrt();
    let u = h - a;
    (longer * longer - u * u).sqrt() - (shorter * shorter - u * u).sqrt()
}

#[cfg(test)]
mod tests {
    use super::force_n;

    #[test]
    fn it_gives_the_published_forces() {
        for (travel_mm, newton) in [(16.6, 1.2), (19.0, 2.9), (20.6, 5.8), (21.7, 10.8)] {
            let error = force_n(travel_mm) / newton - 1.0;
            assert!(
                error.abs() < 0.04,
                "{travel_mm} mm: {} N",
                force_n(travel_mm)
            );
        }
        assert!(force_n(-1.0) == 0.0 && force_n(0.0) < 0.01);
    }
}
