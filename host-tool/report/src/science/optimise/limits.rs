//! Limits on a design: length, thread to fold it, the way back of the folded body, room for the folded sides, force, the
//! least alpha and the least core.

use locomotion::beam::NoAnswer;
use locomotion::beam::crescent::{Shape, Wing};
use locomotion::folded;
use locomotion::kinematics::Design;
use locomotion::range::{Ends, OutOfRange, check};

/// Largest alpha of the search, degrees.
pub const MOST_ALPHA_DEG: f64 = 40.0;
/// Largest c/W of the search.
pub const MOST_CORE_RATIO: f64 = 0.6;

/// Angles are printed to two decimals: an alpha this little below the least one keeps it, degrees.
const PRINTED_DEG: f64 = 0.005;

/// The limits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Greatest overall length at rest, mm.
    pub length_mm: f64,
    /// Width to which the thread has to fold it, mm: the wave has to push it back then.
    pub folded_width_mm: f64,
    /// Greatest length of thread for that, mm.
    pub thread_mm: f64,
    /// Least distance psi between crescents, folded and under the wave, mm: both sides have to fit into it.
    pub spacing_mm: f64,
    /// Greatest force of the wave on one wing, N.
    pub force_n: f64,
    /// Indentation of the wave at which all limits apply, mm.
    pub indentation_mm: f64,
    /// Least alpha, degrees.
    pub least_alpha_deg: f64,
    /// Least c/W: no model here predicts when a core bends.
    pub least_core_ratio: f64,
    /// The rig and its intestine for the folded body; its width and length are those of the design.
    pub folded: folded::Params,
}

/// The values of a design that the limits apply to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Needs {
    /// Overall length at rest, mm.
    pub length_mm: f64,
    /// Thread that folds it to the required width, mm; NaN if its core is wider.
    pub thread_mm: f64,
    /// Displacement of the folded body in a run, mm, + headward; NaN if its core is wider, or it does not fit into the
    /// rig.
    pub folded_mm: f64,
    /// Smaller of the distances psi between crescents, folded and under the wave, mm; NaN if its core is wider.
    pub spacing_mm: f64,
    /// Force of the wave on one wing without friction, N; NaN if the beam model has no answer.
    pub force_n: f64,
}

impl Limits {
    /// Refuses limits that are impossible for a structure of this width.
    ///
    /// # Errors
    /// The first limit outside its range.
    pub fn check(&self, width_mm: f64) -> Result<(), OutOfRange> {
        let over = |quantity, unit, value, range, because| {
            check(quantity, unit, value, range, Ends::OpenBelow, because)
        };
        over(
            "indentation a",
            "mm",
            self.indentation_mm,
            (0.0, width_mm / 2.0),
            "without a wave nothing moves, and the wall cannot pass the axis",
        )?;
        over(
            "longest structure",
            "mm",
            self.length_mm,
            (0.0, 200.0),
            "a body has a length, and the rig's intestine is 130 mm long",
        )?;
        over(
            "folded width",
            "mm",
            self.folded_width_mm,
            (self.folded.least_pushed_mm(self.indentation_mm), width_mm),
            "the wave does not push a narrower one back, and folded it is narrower than unfolded",
        )?;
        over(
            "longest thread",
            "mm",
            self.thread_mm,
            (0.0, 200.0),
            "folding draws thread in",
        )?;
        over(
            "least distance between crescents",
            "mm",
            self.spacing_mm,
            (0.0, 100.0),
            "the sides of a crescent have a thickness",
        )?;
        over(
            "greatest force",
            "N",
            self.force_n,
            (0.0, 1000.0),
            "a wave presses on the wings",
        )?;
        over(
            "least alpha",
            "deg",
            self.least_alpha_deg,
            (0.0, MOST_ALPHA_DEG),
            "the search goes up to there",
        )?;
        over(
            "least core ratio c/W",
            "",
            self.least_core_ratio,
            (0.0, MOST_CORE_RATIO),
            "the search goes up to there",
        )
    }

    /// Computes a design's values at these limits' indentation and folded width.
    ///
    /// # Errors
    /// Folded width and indentation that [`Limits::check`] refuses.
    pub fn needs(&self, design: &Design<f64>) -> Result<Needs, OutOfRange> {
        let drawn_mm = (design.width_mm() - self.folded_width_mm) / 2.0;
        let squeezed_mm = drawn_mm.max(self.indentation_mm);
        let (mut thread_mm, mut folded_mm, mut spacing_mm) = (f64::NAN, f64::NAN, f64::NAN);
        if squeezed_mm <= design.half_gap_mm() {
            spacing_mm = design.squeezed_spacing_mm(squeezed_mm)?;
            thread_mm = design.shortening_mm(drawn_mm)?;
            let folded = folded::Params {
                width_mm: self.folded_width_mm,
                length_mm: design.length_mm(drawn_mm)?,
                ..self.folded
            };
            folded_mm = folded::run(folded, self.indentation_mm).unwrap_or(f64::NAN);
        }
        Ok(Needs {
            length_mm: design.length_mm(0.0)?,
            thread_mm,
            folded_mm,
            spacing_mm,
            force_n: self.force_n(design).unwrap_or(f64::NAN),
        })
    }

    fn force_n(&self, design: &Design<f64>) -> Result<f64, NoAnswer> {
        let wing = Wing {
            design: *design,
            ..Wing::PAPER
        };
        let shape = Shape::Roller {
            radius_mm: self.folded.radius_mm,
            behind_mm: 0.0,
        };
        let squeezed = wing.squeezed(0.0, self.indentation_mm, shape, 0.0)?;
        Ok(squeezed.value.inward_n)
    }

    /// Limits that a design breaks, by the names of their options.
    #[must_use]
    pub fn broken(&self, design: &Design<f64>, needs: &Needs) -> Vec<&'static str> {
        let alpha_deg = design.tan_alpha().atan().to_degrees();
        let ratio = design.core_mm() / design.width_mm();
        // NaN breaks every limit.
        let kept = |value: f64, most: f64| value <= most;
        [
            ("most-length-mm", kept(needs.length_mm, self.length_mm)),
            ("folded-width-mm", needs.folded_mm < 0.0),
            (
                "most-thread-mm",
                needs.thread_mm.is_nan() || kept(needs.thread_mm, self.thread_mm),
            ),
            (
                "least-spacing-mm",
                needs.spacing_mm.is_nan() || kept(self.spacing_mm, needs.spacing_mm),
            ),
            ("most-force-n", kept(needs.force_n, self.force_n)),
            (
                "least-alpha-deg",
                alpha_deg >= self.least_alpha_deg - PRINTED_DEG,
            ),
            ("least-core-ratio", ratio >= self.least_core_ratio - 1e-9),
        ]
        .into_iter()
        .filter_map(|(name, kept)| (!kept).then_some(name))
        .collect()
    }
}
