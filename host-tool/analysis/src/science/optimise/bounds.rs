//! The limits that hold a design back: those without which one that is no longer would go farther.
//!
//! Near the design everything is taken as straight, by finite differences: the displacement and what the limits apply to,
//! over alpha, beta, c/W and the number of crescents as if it were continuous. A limit's shadow price is how much farther
//! the best design within reach goes when that limit alone is loosened.

use locomotion::kinematics::MAX_CRESCENTS;
use locomotion::range::OutOfRange;

use crate::science::optimise::bodies::{Bodies, Care, Per};
use crate::science::optimise::limits::Limits;
use crate::science::optimise::mean;
use crate::science::optimise::search::{FREE, Proposal, placed};

/// Numbers of a design that are continuous: alpha, beta, c/W. The crescents come last.
const SMOOTH: usize = 3;
/// Crescents that count like the whole range of one of the others: within reach is one of them.
const RANGE: f64 = 50.0;

/// A change of a design, or how much something changes with it.
type Change = [f64; SMOOTH + 1];

/// Step of the finite differences to either side, as a share of the range: below it the model's ripple shows.
const STEP: f64 = 0.01;
/// Distance within which the design may change.
const REACH: f64 = 0.02;
/// A limit is loosened by this share of it, a bound of the search by this share of its range.
const LOOSER: f64 = 0.01;
/// A limit is named from this gain on, as a share of the displacement.
const WORTH: f64 = 5e-4;

/// A limit near a design: `row` times the change of the design is at most `slack`.
#[derive(Clone, Copy, Debug)]
struct Plane {
    /// None for what is no limit of the search: the reach, and being no longer.
    name: Option<&'static str>,
    row: Change,
    slack: f64,
    looser: f64,
}

fn dot(one: Change, other: Change) -> f64 {
    one.iter().zip(other).map(|(a, b)| a * b).sum()
}

/// Names of the limits that hold a design back.
///
/// # Errors
/// A design that the model does not cover.
pub fn holding_back(
    proposal: &Proposal,
    limits: &Limits,
    bodies: &Bodies,
    per: Per,
) -> Result<Vec<&'static str>, OutOfRange> {
    let design = &proposal.design;
    let a_mm = limits.indentation_mm;
    // Displacement, length, thread, spacing, force.
    let at = |unit: [f64; FREE], crescents: u8| -> Result<[f64; 5], OutOfRange> {
        let design = placed(unit, crescents, design.width_mm(), limits)?;
        let needs = limits.needs(&design)?;
        let each_mm = bodies.displacements_mm(&design, a_mm, per, Care::Searched)?;
        let (length_mm, thread_mm) = (needs.length_mm, needs.thread_mm);
        Ok([
            mean(&each_mm),
            length_mm,
            thread_mm,
            needs.spacing_mm,
            needs.force_n,
        ])
    };
    let crescents = design.crescents();
    let here = at(proposal.unit, crescents)?;
    let mut slopes = [Change::default(); 5];
    let mut planes = vec![];
    let bounds = [
        ("least alpha", "largest alpha"),
        ("least beta", "largest beta"),
        ("least core", "largest core"),
    ];
    for (axis, (least, largest)) in bounds.into_iter().enumerate() {
        let (mut low, mut high) = (proposal.unit, proposal.unit);
        low[axis] = (low[axis] - STEP).max(0.0);
        high[axis] = (high[axis] + STEP).min(1.0);
        for ((slopes, low_at), high_at) in slopes
            .iter_mut()
            .zip(at(low, crescents)?)
            .zip(at(high, crescents)?)
        {
            slopes[axis] = (high_at - low_at) / (high[axis] - low[axis]);
        }
        let part = proposal.unit[axis];
        for (sign, name, slack) in [(-1.0, least, part), (1.0, largest, 1.0 - part)] {
            let mut row = Change::default();
            row[axis] = sign;
            let plane = Plane {
                name: Some(name),
                row,
                slack,
                looser: LOOSER,
            };
            let reach = Plane {
                name: None,
                slack: REACH,
                ..plane
            };
            planes.extend([plane, reach]);
        }
    }
    let (fewer, more) = (
        crescents.saturating_sub(1).max(1),
        (crescents + 1).min(MAX_CRESCENTS),
    );
    let apart = f64::from(more - fewer) / RANGE;
    let (less, longer) = (at(proposal.unit, fewer)?, at(proposal.unit, more)?);
    for ((slopes, less), longer) in slopes.iter_mut().zip(less).zip(longer) {
        slopes[SMOOTH] = (longer - less) / apart;
    }
    for sign in [-1.0, 1.0] {
        planes.push(Plane {
            name: None,
            row: [0.0, 0.0, 0.0, sign],
            slack: REACH,
            looser: 0.0,
        });
    }
    let [gain, length, thread, spacing, force] = slopes;
    let is_full = limits.length_mm - here[1] < LOOSER * limits.length_mm;
    for (name, row, sign, value, limit) in [
        (
            is_full.then_some("most length"),
            length,
            1.0,
            here[1],
            here[1],
        ),
        (Some("most thread"), thread, 1.0, here[2], limits.thread_mm),
        (
            Some("least spacing"),
            spacing,
            -1.0,
            here[3],
            limits.spacing_mm,
        ),
        (Some("most force"), force, 1.0, here[4], limits.force_n),
    ] {
        planes.push(Plane {
            name,
            row: row.map(|slope| sign * slope),
            slack: (sign * (limit - value)).max(0.0),
            looser: LOOSER * limit,
        });
    }
    let before = farthest(gain, &planes);
    let gains = |place: &usize| {
        let mut looser = planes.clone();
        looser[*place].slack += looser[*place].looser;
        farthest(gain, &looser) - before > WORTH * here[0].abs()
    };
    let named = (0..planes.len()).filter(|place| planes[*place].name.is_some());
    Ok(named
        .filter(gains)
        .filter_map(|place| planes[place].name)
        .collect())
}

/// Largest `gain` times a change within the planes. It lies where as many of them meet as a change has numbers.
fn farthest(gain: Change, planes: &[Plane]) -> f64 {
    let within = |corner: &Change| {
        planes
            .iter()
            .all(|plane| dot(plane.row, *corner) <= plane.slack + 1e-9)
    };
    let count = planes.len();
    let mut best = 0.0_f64;
    for a in 0..count {
        for b in a + 1..count {
            for c in b + 1..count {
                for d in c + 1..count {
                    let corner = meeting([a, b, c, d].map(|place| &planes[place]));
                    if let Some(corner) = corner.filter(within) {
                        best = best.max(dot(gain, corner));
                    }
                }
            }
        }
    }
    best
}

/// Where the planes meet, by elimination; none for planes that do not meet in one point.
fn meeting(planes: [&Plane; SMOOTH + 1]) -> Option<Change> {
    let mut rows = planes.map(|plane| (plane.row, plane.slack));
    for pivot in 0..rows.len() {
        let size = |row: &(Change, f64)| row.0[pivot].abs();
        let largest =
            (pivot..rows.len()).max_by(|a, b| size(&rows[*a]).total_cmp(&size(&rows[*b])))?;
        rows.swap(pivot, largest);
        let (row, slack) = rows[pivot];
        if row[pivot].abs() < 1e-9 {
            return None;
        }
        for (place, other) in rows.iter_mut().enumerate() {
            let factor = if place == pivot {
                0.0
            } else {
                other.0[pivot] / row[pivot]
            };
            for (value, of_pivot) in other.0.iter_mut().zip(row) {
                *value -= factor * of_pivot;
            }
            other.1 -= factor * slack;
        }
    }
    Some(core::array::from_fn(|axis| {
        rows[axis].1 / rows[axis].0[axis]
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::science::optimise::limits::Needs;
    use locomotion::model::Model;

    /// A design at the least alpha with its needs and its displacement.
    type Found = (Proposal, Needs, f64);

    fn limits() -> Limits {
        Limits {
            length_mm: 42.0,
            folded_width_mm: 15.77,
            thread_mm: 23.0,
            spacing_mm: 1.6,
            force_n: 0.55,
            indentation_mm: 5.05,
            least_alpha_deg: 12.53,
            least_core_ratio: 0.2,
            folded: Model::ONE.folded(Some(0.0)).expect("a block"),
        }
    }

    fn designs(bodies: &Bodies) -> Vec<Found> {
        let limits = limits();
        let mut all = vec![];
        for crescents in 9..=15 {
            for place in 0..100 {
                let unit = [0.0, 0.15 + 0.003 * f64::from(place), 0.0, 0.5];
                let design = placed(unit, crescents, 24.4, &limits).expect("a design");
                let needs = limits.needs(&design).expect("covered");
                if needs.length_mm > 50.4 || needs.length_mm < 36.0 {
                    continue;
                }
                let mm = bodies.displacements_mm(&design, 5.05, Per::Wave, Care::Searched);
                all.push((
                    Proposal { unit, design },
                    needs,
                    mean(&mm.expect("covered")),
                ));
            }
        }
        all
    }

    fn best<'a>(all: &'a [Found], limits: &Limits) -> &'a Found {
        let keeps = |found: &&Found| limits.broken(&found.0.design, &found.1).is_empty();
        let kept = all.iter().filter(keeps);
        kept.max_by(|a, b| a.2.total_cmp(&b.2))
            .expect("one keeps them")
    }

    /// Loosens each limit in turn and searches again among many designs. A fifth looser, a named limit lets one go
    /// farther; a twenty-fifth looser, no other one does. Crescents are whole, so nothing smaller shows what a limit costs.
    #[test]
    fn the_named_limits_are_those_that_cost_displacement() {
        let bodies = Bodies::of_prior(&Model::ONE).expect("bodies");
        let all = designs(&bodies);
        for limits in [
            limits(),
            Limits {
                spacing_mm: 1.9,
                ..limits()
            },
            Limits {
                spacing_mm: 0.5,
                thread_mm: 20.0,
                ..limits()
            },
            Limits {
                spacing_mm: 1.0,
                thread_mm: 30.0,
                ..limits()
            },
        ] {
            let (proposal, needs, mm) = best(&all, &limits);
            let named = holding_back(proposal, &limits, &bodies, Per::Wave).expect("covered");
            let is_full = limits.length_mm - needs.length_mm < LOOSER * limits.length_mm;
            let gain = |name: &str, by: f64| {
                let mut looser = limits;
                match name {
                    "most length" => looser.length_mm *= 1.0 + by,
                    "most thread" => looser.thread_mm *= 1.0 + by,
                    "least spacing" => looser.spacing_mm *= 1.0 - by,
                    _ => looser.force_n *= 1.0 + by,
                }
                if !is_full {
                    looser.length_mm = needs.length_mm;
                }
                best(&all, &looser).2 / mm - 1.0
            };
            for name in ["most length", "most thread", "least spacing", "most force"] {
                let (far, near) = (gain(name, 0.2), gain(name, 0.04));
                match named.contains(&name) {
                    true => assert!(far > 5e-3, "{name}: {far}"),
                    false => assert!(near < 5e-3, "{name}: {near}"),
                }
            }
        }
    }
}
