//! The paper's rig (section III): a pair of rollers drawn along a silicone intestine, and the unfolded body in it.
//!
//! The model has no clock. It follows any sequence of carriage positions: it takes a step whenever the carriage
//! reaches another multiple of `step_mm`, however finely the positions are given. A stop in mid-stroke leaves the
//! roller's wave on the body, and a reversal continues from there.

use crate::body::{self, Chain};
use crate::range::{Ends, OutOfRange, check};

/// The rig, the intestine and the body in it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Params {
    /// The unfolded body.
    pub body: body::Params,
    /// Travel of the carriage, mm.
    pub stroke_mm: f64,
    /// Radius of the rollers, mm.
    pub radius_mm: f64,
    /// Travel of the carriage between two evaluations of the model, mm.
    pub step_mm: f64,
    /// Back-and-forth cycles of a run.
    pub cycles: u32,
}

impl Params {
    /// The paper's experiment with the body `one` of [`crate::model`]; its settings say where each value comes from.
    pub const PAPER: Self = Self {
        body: body::Params::PAPER,
        stroke_mm: 130.0,
        radius_mm: 20.0,
        step_mm: 0.05,
        cycles: 5,
    };
}

/// How far beyond either end of the stroke a carriage position may lie, mm: enough for the wave to clear the body.
const OVERTRAVEL_MM: f64 = 100.0;

/// A carriage this close to a multiple of the step has reached it, mm. Positions computed from a screw's steps carry
/// rounding errors.
const REACHED_MM: f64 = 1e-6;

/// Inward indentation of the wall at a distance from the roller's axis, mm: the roller's arc, `peak_mm` deep.
pub fn wall_mm(peak_mm: f64, radius_mm: f64, distance_mm: f64) -> f64 {
    let square = radius_mm * radius_mm - distance_mm * distance_mm;
    if square <= 0.0 {
        return 0.0;
    }
    let depth = peak_mm - radius_mm + libm::sqrt(square);
    if depth > 0.0 { depth } else { 0.0 }
}

/// How far from the roller's axis [`wall_mm`] is not 0, or a little more, mm.
fn reach_mm(peak_mm: f64, radius_mm: f64) -> f64 {
    libm::sqrt(peak_mm * (2.0 * radius_mm - peak_mm)) + REACHED_MM
}

/// The unfolded body under the rig's rollers.
#[derive(Clone, Debug)]
pub struct UnfoldedBody {
    params: Params,
    indentation_mm: f64,
    /// How far from the roller's axis its arc reaches into the wall, mm.
    reach_mm: f64,
    chain: Chain,
    /// Carriage position at the last evaluation, in multiples of `step_mm`.
    at: i32,
}

impl UnfoldedBody {
    /// The body at the left end and the rollers at home, indenting by `indentation_mm` (the paper's a_n).
    ///
    /// # Errors
    /// The first parameter outside its range; an indentation outside `0..=h`.
    pub fn new(params: Params, indentation_mm: f64) -> Result<Self, OutOfRange> {
        Self::laid_in(params, indentation_mm, 0.0)
    }

    /// The body at its start, with the carriage at `carriage_mm`: for a pass that begins at the far end.
    ///
    /// # Errors
    /// As [`UnfoldedBody::new`]; a carriage outside the stroke.
    pub fn laid_in(
        params: Params,
        indentation_mm: f64,
        carriage_mm: f64,
    ) -> Result<Self, OutOfRange> {
        let mut body = Self::apart(params, indentation_mm)?;
        check(
            "carriage position",
            "mm",
            carriage_mm,
            (0.0, params.stroke_mm),
            Ends::Closed,
            "a body is laid in while the rollers stand within their stroke",
        )?;
        // Fits into i32: at most 1000 mm in steps of 0.001 mm.
        body.evaluate(libm::round(carriage_mm / params.step_mm) as i32)?;
        Ok(body)
    }

    /// The body at its start, not touched yet.
    fn apart(params: Params, indentation_mm: f64) -> Result<Self, OutOfRange> {
        check(
            "stroke",
            "mm",
            params.stroke_mm,
            (0.0, 1000.0),
            Ends::OpenBelow,
            "the carriage has to travel",
        )?;
        check(
            "roller radius",
            "mm",
            params.radius_mm,
            (params.body.design.half_gap_mm(), 1000.0),
            Ends::Closed,
            "the wave is an arc of the roller, no deeper than its radius",
        )?;
        check(
            "roller step",
            "mm",
            params.step_mm,
            (0.001, 10.0),
            Ends::Closed,
            "finer costs time for nothing, coarser jumps over crescents",
        )?;
        check(
            "indentation a",
            "mm",
            indentation_mm,
            (0.0, params.body.design.half_gap_mm()),
            Ends::Closed,
            "the wall moves inward, and at a = h it reaches the core",
        )?;
        Ok(Self {
            params,
            indentation_mm,
            reach_mm: reach_mm(indentation_mm, params.radius_mm),
            chain: Chain::new(params.body)?,
            at: 0,
        })
    }

    /// Moves the carriage to `carriage_mm`: 0 = home = right end, positive to the left.
    ///
    /// Between two calls the carriage moves straight. The result does not depend on how many calls make up a stroke.
    ///
    /// # Errors
    /// A position that is NaN or more than 100 mm outside the stroke.
    pub fn carriage_to(&mut self, carriage_mm: f64) -> Result<(), OutOfRange> {
        check(
            "carriage position",
            "mm",
            carriage_mm,
            (-OVERTRAVEL_MM, self.params.stroke_mm + OVERTRAVEL_MM),
            Ends::Closed,
            "the rig's rail ends there",
        )?;
        while carriage_mm >= f64::from(self.at + 1) * self.params.step_mm - REACHED_MM {
            self.evaluate(self.at + 1)?;
        }
        while carriage_mm <= f64::from(self.at - 1) * self.params.step_mm + REACHED_MM {
            self.evaluate(self.at - 1)?;
        }
        Ok(())
    }

    fn evaluate(&mut self, at: i32) -> Result<(), OutOfRange> {
        let roller_mm = self.params.stroke_mm - f64::from(at) * self.params.step_mm;
        let (peak, radius) = (self.indentation_mm, self.params.radius_mm);
        let ends_mm = (roller_mm - self.reach_mm, roller_mm + self.reach_mm);
        // A third of a pass and more: the wave has not reached the body yet, or has left it.
        if !self.chain.is_clear_of(ends_mm) {
            let reach_mm = self.reach_mm;
            self.chain.step(|x| {
                let distance_mm = x - roller_mm;
                if libm::fabs(distance_mm) > reach_mm {
                    return 0.0;
                }
                wall_mm(peak, radius, distance_mm)
            })?;
        }
        self.at = at;
        Ok(())
    }

    /// One cycle: to the far end and home.
    ///
    /// # Errors
    /// None after a successful [`UnfoldedBody::new`].
    pub fn cycle(&mut self) -> Result<(), OutOfRange> {
        self.carriage_to(self.params.stroke_mm)?;
        self.carriage_to(0.0)
    }

    /// Displacement of the tail since the start, mm; + is headward (retrograde).
    pub fn displacement_mm(&self) -> f64 {
        self.chain.displacement_mm()
    }

    /// Displacement of the head since the start, mm. Less than that of the tail while the rollers squeeze the body.
    pub fn head_displacement_mm(&self) -> f64 {
        self.chain.head_displacement_mm()
    }

    /// The body's chain of contacts, for drawing.
    pub fn chain(&self) -> &Chain {
        &self.chain
    }
}

/// The paper's run: displacement of the tail in mm after all cycles, + headward.
///
/// # Errors
/// As [`UnfoldedBody::new`].
pub fn run(params: Params, indentation_mm: f64) -> Result<f64, OutOfRange> {
    let mut body = UnfoldedBody::new(params, indentation_mm)?;
    for _ in 0..params.cycles {
        body.cycle()?;
    }
    Ok(body.displacement_mm())
}

/// Effect of one roller pass in each direction on a body that is relaxed before and after it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IsolatedPass {
    /// Displacement by the pass from head to tail, mm, + headward.
    pub antegrade_mm: f64,
    /// Displacement by the pass from tail to head, mm, + headward. Of the size of the model's ripple.
    pub returning_mm: f64,
}

/// Simulates two isolated passes over fresh bodies, from clear of one end to clear of the other.
///
/// # Errors
/// As [`UnfoldedBody::new`].
pub fn isolated_pass(params: Params, indentation_mm: f64) -> Result<IsolatedPass, OutOfRange> {
    let clear_mm = params.stroke_mm + 2.0 * params.radius_mm;
    let mut antegrade = UnfoldedBody::new(params, indentation_mm)?;
    antegrade.carriage_to(clear_mm)?;
    // Over a fresh body, with the roller behind it.
    let mut returning = UnfoldedBody::apart(params, indentation_mm)?;
    returning.at = antegrade.at;
    returning.carriage_to(0.0)?;
    Ok(IsolatedPass {
        antegrade_mm: antegrade.displacement_mm(),
        returning_mm: returning.displacement_mm(),
    })
}
