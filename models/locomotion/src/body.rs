//! The unfolded body as a chain of crescents with Coulomb friction, moved by a wall that presses and retreats.
//!
//! Quasi-static and massless: time does not enter, only the order of the wall's shapes. For each new shape:
//! 1. each crescent is indented by `a_i = coupling * wall(x_i)` at its previous position,
//! 2. the links take their lengths psi(a_i) from Eq. (4), which shifts each crescent by `delta_i` relative to the tail,
//! 3. the whole body moves by the `S` that costs the least friction work
//!    `sum mu w_i [ (S + delta_i)^+ + r (-(S + delta_i))^+ ]`, `w_i = preload + mean a_i`,
//!    where + is headward, the wings' easy direction. `S` is a weighted quantile of `-delta_i`.
//!
//! The friction coefficient mu multiplies every weight by the same factor, so it changes `S` only through r. With a
//! fixed r it cancels. That independence is an assumption of the model (the fixed r), not evidence for the paper's
//! finding. With [`FrictionRatio::Facets`] it does not cancel.

use crate::kinematics::{Design, MAX_CRESCENTS};
use crate::range::{Ends, OutOfRange, check};

/// Capacity of the arrays: links of the largest design.
pub(crate) const LINKS: usize = MAX_CRESCENTS as usize;

/// r: friction against the wings over friction with them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FrictionRatio {
    /// The same at every friction coefficient, `>= 1`; fitted.
    Fixed(f64),
    /// Coulomb friction on facets at the angle beta: `(1 + mu tan beta)/(1 - mu tan beta)`.
    Facets,
}

impl FrictionRatio {
    /// Its value for a design at a friction coefficient.
    ///
    /// # Errors
    /// A fixed ratio below 1; a friction at which the facets lock, `mu tan beta >= 1`.
    pub fn at(self, design: &Design<f64>, friction: f64) -> Result<f64, OutOfRange> {
        match self {
            Self::Fixed(ratio) => {
                check(
                    "friction ratio r",
                    "",
                    ratio,
                    (1.0, 1e6),
                    Ends::Closed,
                    "it is hard over easy",
                )?;
                Ok(ratio)
            }
            Self::Facets => {
                check(
                    "friction coefficient",
                    "",
                    friction,
                    (0.0, 1.0 / design.tan_beta()),
                    Ends::Open,
                    "from 1/tan(beta) on the facets lock, and the friction ratio has no value",
                )?;
                let slope = friction * design.tan_beta();
                Ok((1.0 + slope) / (1.0 - slope))
            }
        }
    }
}

/// Properties of the body. [`crate::model`] has named sets of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Params {
    /// Its geometry.
    pub design: Design<f64>,
    /// chi: fraction of the wall's indentation that reaches a crescent, `0..=1`.
    pub coupling: f64,
    /// mu: friction coefficient in the easy direction, `> 0`. Common to all crescents, so it acts through
    /// [`FrictionRatio::Facets`] only.
    pub friction: f64,
    /// r: friction in the hard direction over that in the easy one.
    pub friction_ratio: FrictionRatio,
    /// delta0, mm: indentation that every crescent feels even where the wave does not touch it, `>= 0`.
    pub preload_mm: f64,
    /// Where the tip of the rearmost wing lies at the start, mm from the intestine's left mark.
    pub tail_mm: f64,
}

impl Params {
    /// The paper's body in these models: geometry of section III, the rest as `docs/science.md` says.
    pub const PAPER: Self = Self {
        design: Design::paper_ratios(),
        coupling: 0.15,
        friction: 0.15,
        friction_ratio: FrictionRatio::Fixed(40.0),
        preload_mm: 0.0007,
        tail_mm: 0.0,
    };
}

/// The body and its position.
#[derive(Clone, Debug)]
pub struct Chain {
    params: Params,
    ratio: f64,
    start_mm: f64,
    /// Length of the core at rest.
    relaxed_mm: f64,
    core_tail_mm: f64,
    indentation_mm: [f64; LINKS],
    link_mm: [f64; LINKS],
    /// From the core's tail end to the middle of each link.
    middle_mm: [f64; LINKS],
    /// Scratch memory of a step: indentation and link of each crescent, then its shift and its weight.
    pairs: [(f64, f64); LINKS],
}

impl Chain {
    /// A relaxed body with its rearmost tip at `params.tail_mm`.
    ///
    /// # Errors
    /// The first parameter outside its range.
    pub fn new(params: Params) -> Result<Self, OutOfRange> {
        check(
            "coupling chi",
            "",
            params.coupling,
            (0.0, 1.0),
            Ends::Closed,
            "a crescent cannot feel more than the wall's indentation",
        )?;
        check(
            "friction coefficient",
            "",
            params.friction,
            (0.0, 10.0),
            Ends::OpenBelow,
            "without friction nothing holds the body",
        )?;
        let ratio = params.friction_ratio.at(&params.design, params.friction)?;
        check(
            "preload",
            "mm",
            params.preload_mm,
            (0.0, 100.0),
            Ends::Closed,
            "it is an indentation",
        )?;
        check(
            "start of the tail",
            "mm",
            params.tail_mm,
            (-1000.0, 1000.0),
            Ends::Closed,
            "the intestine is a tenth of that",
        )?;
        let start_mm = params.tail_mm + params.design.wing_reach_mm(0.0)?;
        let mut chain = Self {
            params,
            ratio,
            start_mm,
            relaxed_mm: 0.0,
            core_tail_mm: start_mm,
            indentation_mm: [0.0; LINKS],
            link_mm: [params.design.spacing_mm(); LINKS],
            middle_mm: [0.0; LINKS],
            pairs: [(0.0, 0.0); LINKS],
        };
        chain.middle_mm = middles(chain.links_mm());
        chain.relaxed_mm = chain.core_mm();
        Ok(chain)
    }

    /// Number of crescents.
    fn m(&self) -> usize {
        self.params.design.crescents().into()
    }

    /// Applies the next shape of the wall: its inward indentation in mm as a function of the place x in mm.
    ///
    /// # Errors
    /// A shape that is negative, NaN or would push a crescent past its core; the body then stays unchanged.
    pub fn step(&mut self, wall_mm: impl Fn(f64) -> f64) -> Result<(), OutOfRange> {
        let m = self.m();
        // First the indentation and the link of each crescent, kept apart until all of them are checked. Then its shift
        // and its weight replace them.
        let pairs = &mut self.pairs[..m];
        let mut changed = false;
        let before = (self.middle_mm[..m].iter())
            .zip(&self.indentation_mm)
            .zip(&self.link_mm);
        for (next, ((middle_mm, was), link_mm)) in pairs.iter_mut().zip(before) {
            let a = self.params.coupling * wall_mm(self.core_tail_mm + middle_mm);
            *next = if a == *was {
                (a, *link_mm)
            } else {
                changed = true;
                (a, self.params.design.squeezed_spacing_mm(a)?)
            };
        }
        if !changed {
            return Ok(()); // every delta is 0, so `S` is 0
        }
        let mut end_mm = 0.0;
        let places = (self.middle_mm[..m].iter_mut())
            .zip(&mut self.indentation_mm)
            .zip(&mut self.link_mm);
        for (pair, ((middle_mm, was), link_mm)) in pairs.iter_mut().zip(places) {
            let (a, link) = *pair;
            let middle = end_mm + link / 2.0;
            end_mm += link;
            let hold = self.params.preload_mm + (*was + a) / 2.0;
            *pair = (middle - *middle_mm, self.params.friction * hold);
            (*middle_mm, *was, *link_mm) = (middle, a, link);
        }
        self.core_tail_mm += least_work_shift(pairs, self.ratio);
        Ok(())
    }

    /// Whether no crescent is pressed, nor would be by a wave between these two positions: such a step changes nothing.
    pub(crate) fn is_clear_of(&self, (low_mm, high_mm): (f64, f64)) -> bool {
        let middles_mm = &self.middle_mm[..self.m()];
        let before = middles_mm
            .last()
            .is_none_or(|last| self.core_tail_mm + last < low_mm);
        let behind = middles_mm
            .first()
            .is_none_or(|first| self.core_tail_mm + first > high_mm);
        (before || behind) && self.indentations_mm().iter().all(|a| *a == 0.0)
    }

    /// Displacement of the tail since the start, mm; + is headward (retrograde).
    pub fn displacement_mm(&self) -> f64 {
        self.core_tail_mm - self.start_mm
    }

    /// Displacement of the head since the start, mm. Less than that of the tail while the body is squeezed.
    pub fn head_displacement_mm(&self) -> f64 {
        self.head_mm() - self.start_mm - self.relaxed_mm
    }

    /// Position of the core's tail end, mm.
    pub fn core_tail_mm(&self) -> f64 {
        self.core_tail_mm
    }

    /// Position of the core's head end, mm.
    pub fn head_mm(&self) -> f64 {
        self.core_tail_mm + self.core_mm()
    }

    fn core_mm(&self) -> f64 {
        self.link_mm[..self.m()].iter().sum::<f64>()
    }

    /// Indentation of each crescent, tail first, mm.
    pub fn indentations_mm(&self) -> &[f64] {
        &self.indentation_mm[..self.m()]
    }

    /// Present length of each link, tail first, mm.
    pub fn links_mm(&self) -> &[f64] {
        &self.link_mm[..self.m()]
    }
}

/// Middle of each link, from the core's tail end.
pub(crate) fn middles(links_mm: &[f64]) -> [f64; LINKS] {
    let mut middles = [0.0; LINKS];
    let mut sum = 0.0;
    for (middle, link) in middles.iter_mut().zip(links_mm) {
        *middle = sum + link / 2.0;
        sum += link;
    }
    middles
}

/// The `S` that minimises `sum w [ (S+delta)^+ + r (-(S+delta))^+ ]` over pairs `(delta, w)`.
///
/// The sum is convex in `S`, and its slope changes only at `S = -delta`. Just above that point the slope is `sum(w) -
/// (1+r) * (the weight of all pairs with a smaller delta)`. The minimum is at the greatest delta for which the slope is
/// not negative. The search begins at the smallest delta, because r is large and only a few lie below it.
fn least_work_shift(pairs: &[(f64, f64)], ratio: f64) -> f64 {
    let most_below = pairs.iter().map(|(_, w)| w).sum::<f64>() / (1.0 + ratio);
    let mut below = 0.0;
    let mut passed = f64::NEG_INFINITY;
    loop {
        let mut least = f64::INFINITY;
        let mut weight = 0.0;
        for &(delta, w) in pairs {
            if delta > passed && delta < least {
                (least, weight) = (delta, w);
            } else if delta == least {
                weight += w;
            }
        }
        if least == f64::INFINITY {
            // Reached only if all weights are 0.
            return -passed;
        }
        below += weight;
        passed = least;
        if below > most_below {
            return -least;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn work(pairs: &[(f64, f64)], ratio: f64, shift: f64) -> f64 {
        pairs
            .iter()
            .map(|(delta, w)| {
                let slip = shift + delta;
                w * if slip > 0.0 { slip } else { -ratio * slip }
            })
            .sum()
    }

    proptest! {
        /// Neither a point where the slope changes nor a point near the answer costs less work.
        #[test]
        fn the_shift_has_the_least_work(
            pairs in prop::collection::vec((-2.0..2.0f64, 0.001..5.0f64), 1..20),
            ratio in 1.0..30.0f64,
        ) {
            let shift = least_work_shift(&pairs, ratio);
            let least = work(&pairs, ratio, shift);
            let others: Vec<f64> = pairs.iter().map(|(d, _)| -d).chain([shift - 1e-3, shift + 1e-3]).collect();
            for other in others {
                prop_assert!(work(&pairs, ratio, other) >= least * (1.0 - 1e-12));
            }
        }

        /// A body that is squeezed evenly and released regains its length, wherever it has moved.
        #[test]
        fn a_released_body_is_relaxed(a in 0.01..9.0f64) {
            let params = Params::PAPER;
            let mut chain = Chain::new(params).unwrap();
            let length = chain.head_mm() - chain.core_tail_mm();
            chain.step(|_| a).unwrap();
            prop_assert!(chain.head_mm() - chain.core_tail_mm() < length);
            chain.step(|_| 0.0).unwrap();
            prop_assert!((chain.head_mm() - chain.core_tail_mm() - length).abs() < 1e-12);
        }
    }

    #[test]
    fn a_wall_past_the_core_is_refused_and_changes_nothing() {
        let mut chain = Chain::new(Params {
            coupling: 1.0,
            ..Params::PAPER
        })
        .unwrap();
        chain.step(|x| if x < 20.0 { 3.0 } else { 0.0 }).unwrap();
        let before = (chain.displacement_mm(), chain.head_mm());
        for bad in [f64::NAN, -0.1, 9.77, f64::INFINITY] {
            assert!(chain.step(|_| bad).is_err());
            assert_eq!(before, (chain.displacement_mm(), chain.head_mm()));
        }
    }
}
