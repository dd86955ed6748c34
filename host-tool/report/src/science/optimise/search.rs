//! Proposes designs from a seed: first spread evenly (a Latin hypercube), then near the best ones. Finds those that
//! no other design beats in both length and displacement.
//!
//! A design is four numbers from 0 to 1: alpha, beta, c/W and the share of the crescents that fit into the length.

use lab::campaign::chance::Chance;
use locomotion::kinematics::{Design, MAX_CRESCENTS};
use locomotion::range::OutOfRange;

use crate::science::optimise::limits::{Limits, MOST_ALPHA_DEG, MOST_CORE_RATIO};

/// Free numbers of a design.
pub const FREE: usize = 4;
/// Largest beta of the search, degrees.
const MOST_BETA_DEG: f64 = 70.0;
/// Least difference of beta and alpha, degrees: below it the crescents are thinner than a printer can print.
const LEAST_BETWEEN_DEG: f64 = 2.0;

/// A design to be tried.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposal {
    /// Position between the bounds, 0 to 1.
    pub unit: [f64; FREE],
    /// The design.
    pub design: Design<f64>,
}

impl Proposal {
    /// The design at a position between the bounds.
    ///
    /// # Errors
    /// An invalid width.
    pub fn new(unit: [f64; FREE], width_mm: f64, limits: &Limits) -> Result<Self, OutOfRange> {
        let most = most_crescents(&placed(unit, 1, width_mm, limits)?, limits)?;
        let crescents = 1.0 + (unit[3] * most).floor().min(most - 1.0);
        Ok(Self {
            unit,
            design: placed(unit, crescents as u8, width_mm, limits)?,
        })
    }
}

/// The design at a position between the bounds, with another number of crescents.
///
/// # Errors
/// An invalid width.
pub fn placed(
    unit: [f64; FREE],
    crescents: u8,
    width_mm: f64,
    limits: &Limits,
) -> Result<Design<f64>, OutOfRange> {
    let between = |part: f64, low: f64, high: f64| low + part * (high - low);
    let alpha_deg = between(unit[0], limits.least_alpha_deg, MOST_ALPHA_DEG);
    let beta_deg = between(unit[1], alpha_deg + LEAST_BETWEEN_DEG, MOST_BETA_DEG);
    let ratio = between(unit[2], limits.least_core_ratio, MOST_CORE_RATIO);
    Design::new(width_mm, ratio * width_mm, alpha_deg, beta_deg, crescents)
}

impl Proposal {
    /// A given design, with the nearest position between the bounds.
    ///
    /// # Errors
    /// None for a design.
    pub fn given(design: Design<f64>, limits: &Limits) -> Result<Self, OutOfRange> {
        let part = |value: f64, low: f64, high: f64| ((value - low) / (high - low)).clamp(0.0, 1.0);
        let [alpha_deg, beta_deg] =
            [design.tan_alpha(), design.tan_beta()].map(|tan| tan.atan().to_degrees());
        let ratio = design.core_mm() / design.width_mm();
        let most = most_crescents(&design, limits)?;
        Ok(Self {
            unit: [
                part(alpha_deg, limits.least_alpha_deg, MOST_ALPHA_DEG),
                part(beta_deg, alpha_deg + LEAST_BETWEEN_DEG, MOST_BETA_DEG),
                part(ratio, limits.least_core_ratio, MOST_CORE_RATIO),
                part(f64::from(design.crescents()) - 0.5, 0.0, most),
            ],
            design,
        })
    }
}

/// Number of such crescents that fit into the length, at least 1.
fn most_crescents(design: &Design<f64>, limits: &Limits) -> Result<f64, OutOfRange> {
    let room_mm = limits.length_mm - design.wing_reach_mm(0.0)?;
    let most = (room_mm / design.spacing_mm()).floor();
    Ok(most.clamp(1.0, MAX_CRESCENTS.into()))
}

/// Positions spread so that each of the numbers takes every one of `count` equal parts once.
pub fn hypercube(count: usize, chance: &mut Chance) -> Vec<[f64; FREE]> {
    let mut places = vec![[0.0; FREE]; count];
    for number in 0..FREE {
        let mut parts: Vec<usize> = (0..count).collect();
        chance.shuffle(&mut parts);
        for (place, part) in places.iter_mut().zip(parts) {
            place[number] = (part as f64 + chance.part()) / count as f64;
        }
    }
    places
}

/// A position near one parent, with some numbers of the other. A step beyond a bound ends on it.
pub fn child(one: [f64; FREE], other: [f64; FREE], reach: f64, chance: &mut Chance) -> [f64; FREE] {
    let mut place = one;
    for (number, others) in place.iter_mut().zip(other) {
        if chance.below(3) == 0 {
            *number = others;
        }
        if chance.below(2) == 0 {
            *number = (*number + reach * chance.normal()).clamp(0.0, 1.0);
        }
    }
    place
}

/// Whether the first design is no longer and moves no less far than the other, and is better in one of them.
#[must_use]
pub fn dominates(one: (f64, f64), other: (f64, f64)) -> bool {
    one.0 <= other.0 && one.1 >= other.1 && one != other
}

/// Displacements below this count as none, mm: the ripple of the model.
const NOWHERE_MM: f64 = 0.05;

/// Indices of the designs that move at all and that no other one dominates, from short to long. Of equal designs it
/// keeps the first.
#[must_use]
pub fn front(places: &[(f64, f64)]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_by(|one, other| {
        let (one, other) = (places[*one], places[*other]);
        one.0.total_cmp(&other.0).then(other.1.total_cmp(&one.1))
    });
    let mut farthest = NOWHERE_MM;
    order.retain(|index| {
        let better = places[*index].1 > farthest;
        farthest = farthest.max(places[*index].1);
        better
    });
    order
}

/// At most `most` of these, evenly spread, with both ends.
#[must_use]
pub fn thinned(front: &[usize], most: usize) -> Vec<usize> {
    let last = front.len().saturating_sub(1);
    if front.len() <= most || most < 2 {
        return front.to_vec();
    }
    (0..most).map(|i| front[i * last / (most - 1)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hypercube_takes_each_part_once() {
        let places = hypercube(50, &mut Chance::new(3));
        for number in 0..FREE {
            let mut parts: Vec<_> = places
                .iter()
                .map(|place| (place[number] * 50.0) as u8)
                .collect();
            parts.sort_unstable();
            assert_eq!(parts, (0..50).collect::<Vec<_>>());
        }
    }

    /// Compares with the definition, over random places of which many are equal in one of the two.
    #[test]
    fn the_front_is_what_nothing_dominates() {
        let mut chance = Chance::new(9);
        for _ in 0..200 {
            let places: Vec<_> = (0..30)
                .map(|_| (chance.below(8) as f64, chance.below(8) as f64 - 1.0))
                .collect();
            let kept = front(&places);
            for (index, place) in places.iter().enumerate() {
                let nowhere = place.1 <= NOWHERE_MM;
                let dominated = places.iter().any(|other| dominates(*other, *place));
                let listed = kept.iter().any(|kept| places[*kept] == *place);
                assert_eq!(listed, !dominated && !nowhere, "{index}: {places:?}");
            }
            let mut different: Vec<_> = kept.iter().map(|kept| places[*kept]).collect();
            different.dedup();
            assert_eq!(different.len(), kept.len(), "of equal ones only one");
        }
    }

    #[test]
    fn thinning_keeps_both_ends() {
        let all: Vec<usize> = (0..100).collect();
        let few = thinned(&all, 7);
        assert_eq!((few.len(), few[0], few[6]), (7, 0, 99));
        assert_eq!(thinned(&all[..5], 7), all[..5]);
    }
}
