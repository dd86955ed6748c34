//! The limits that hold a design back: without one of them, a design that is no longer would go farther.
//!
//! Near the design, the displacement and the limited values are taken as linear in alpha, beta, c/W and the number of
//! crescents (as if continuous), by finite differences. A limit's shadow price is how much farther the best design
//! within reach goes when that limit alone is loosened.

use locomotion::kinematics::MAX_CRESCENTS;
use locomotion::range::OutOfRange;

use crate::science::optimise::bodies::{Bodies, Care, Per};
use crate::science::optimise::limits::{Limits, Needs};
use crate::science::optimise::mean;
use crate::science::optimise::search::{FREE, Proposal, placed};

/// Number of a design's continuous values: alpha, beta, c/W. The number of crescents comes last.
const SMOOTH: usize = 3;
/// Number of crescents that counts like the whole range of one of the others: one crescent is within reach.
const RANGE: f64 = 50.0;

/// A change of a design, or a gradient over it.
type Change = [f64; SMOOTH + 1];

/// Step of the finite differences to either side, as a share of the range: below it the model's ripple shows.
const STEP: f64 = 0.01;
/// Largest change of the design, as a share of the range.
const REACH: f64 = 0.02;
/// Share by which a limit is loosened: of the limit, or for a bound of the search, of its range.
const LOOSER: f64 = 0.01;
/// Least gain from which a limit is named, as a share of the displacement.
const WORTH: f64 = 5e-4;

/// A limit near a design: `row` times the change of the design is at most `slack`.
#[derive(Clone, Copy, Debug)]
struct Plane {
    /// None for planes that are no limits of the search: the reach, and a length that must not grow.
    name: Option<&'static str>,
    row: Change,
    slack: f64,
    looser: f64,
}

fn dot(one: Change, other: Change) -> f64 {
    one.iter().zip(other).map(|(a, b)| a * b).sum()
}

/// Displacement, and what the limits apply to: length, thread, spacing, force.
type Figures = [f64; 5];

/// The figures of a design, and how they change with it.
///
/// # Errors
/// A design that the model does not cover.
fn figures(
    proposal: &Proposal,
    limits: &Limits,
    bodies: &Bodies,
    per: Per,
) -> Result<(Figures, [Change; 5]), OutOfRange> {
    let (width_mm, crescents) = (proposal.design.width_mm(), proposal.design.crescents());
    let at = |unit: [f64; FREE], crescents: u8| -> Result<Figures, OutOfRange> {
        let design = placed(unit, crescents, width_mm, limits)?;
        let needs = limits.needs(&design)?;
        let a_mm = limits.indentation_mm;
        let mm = mean(&bodies.displacements_mm(&design, a_mm, per, Care::Searched)?);
        let Needs {
            length_mm,
            thread_mm,
            spacing_mm,
            force_n,
            ..
        } = needs;
        Ok([mm, length_mm, thread_mm, spacing_mm, force_n])
    };
    let mut slopes = [Change::default(); 5];
    let mut put = |axis: usize, less: Figures, more: Figures, apart: f64| {
        for (slopes, (less, more)) in slopes.iter_mut().zip(less.into_iter().zip(more)) {
            slopes[axis] = (more - less) / apart;
        }
    };
    for axis in 0..SMOOTH {
        let (mut low, mut high) = (proposal.unit, proposal.unit);
        low[axis] = (low[axis] - STEP).max(0.0);
        high[axis] = (high[axis] + STEP).min(1.0);
        let apart = high[axis] - low[axis];
        put(axis, at(low, crescents)?, at(high, crescents)?, apart);
    }
    let fewer = crescents.saturating_sub(1).max(1);
    let more = (crescents + 1).min(MAX_CRESCENTS);
    let (less, longer) = (at(proposal.unit, fewer)?, at(proposal.unit, more)?);
    put(SMOOTH, less, longer, f64::from(more - fewer) / RANGE);
    Ok((at(proposal.unit, crescents)?, slopes))
}

/// The bounds of the search and of the reach around a position.
fn bounds(unit: [f64; FREE]) -> Vec<Plane> {
    let names = [
        ["least alpha", "largest alpha"].map(Some),
        ["least beta", "largest beta"].map(Some),
        ["least core", "largest core"].map(Some),
        [None; 2],
    ];
    let mut planes = vec![];
    for (axis, [least, largest]) in names.into_iter().enumerate() {
        for (sign, name, slack) in [(-1.0, least, unit[axis]), (1.0, largest, 1.0 - unit[axis])] {
            let mut row = Change::default();
            row[axis] = sign;
            let looser = LOOSER;
            let reach = Plane {
                name: None,
                row,
                slack: REACH,
                looser,
            };
            planes.push(reach);
            if name.is_some() {
                planes.push(Plane {
                    name,
                    slack,
                    ..reach
                });
            }
        }
    }
    planes
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
    let (here, slopes) = figures(proposal, limits, bodies, per)?;
    let mut planes = bounds(proposal.unit);
    // A design that does not fill the length must not become longer. That is no limit of the search.
    let is_full = limits.length_mm - here[1] < LOOSER * limits.length_mm;
    let longest = is_full.then_some("most length");
    for (place, name, sign, limit) in [
        (1, longest, 1.0, here[1]),
        (2, Some("most thread"), 1.0, limits.thread_mm),
        (3, Some("least spacing"), -1.0, limits.spacing_mm),
        (4, Some("most force"), 1.0, limits.force_n),
    ] {
        planes.push(Plane {
            name,
            row: slopes[place].map(|slope| sign * slope),
            slack: (sign * (limit - here[place])).max(0.0),
            looser: LOOSER * limit,
        });
    }
    let before = farthest(slopes[0], &planes);
    let gains = |place: &usize| {
        let mut looser = planes.clone();
        looser[*place].slack += looser[*place].looser;
        farthest(slopes[0], &looser) - before > WORTH * here[0].abs()
    };
    let named = (0..planes.len()).filter(|place| planes[*place].name.is_some());
    Ok(named
        .filter(gains)
        .filter_map(|place| planes[place].name)
        .collect())
}

/// Largest `gain` times a change within the planes. It lies at a corner, where as many planes meet as a change has
/// numbers.
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
