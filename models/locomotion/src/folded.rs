//! The folded body under the roller: a rigid block, narrower than the intestine.
//!
//! The wave touches the block only if it is deeper than the gap `a_c = (D - W_f)/2` beside it. With the excess
//! `e = a_pk - a_c` the wall meets the block's end `sqrt(2 R e - e^2)` ahead of the roller, at the slope
//! `sqrt(2 R e - e^2)/(R - e)`. If that slope is steeper than the friction, the roller pushes the block ahead of it to
//! the end of the stroke; otherwise it rides over the block. The returning roller leaves the block behind.

use crate::kinematics::Design;
use crate::range::{Ends, OutOfRange, check};

/// The rig, the intestine and the folded body in it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Params {
    /// Width D of the intestine, mm.
    pub intestine_mm: f64,
    /// Width W_f of the folded body, mm.
    pub width_mm: f64,
    /// Length of the folded body, mm.
    pub length_mm: f64,
    /// Friction coefficient between wall and body.
    pub friction: f64,
    /// Where the tail of the body lies at the start, mm from the intestine's left mark.
    pub tail_mm: f64,
    /// Travel of the carriage, mm.
    pub stroke_mm: f64,
    /// Radius of the rollers, mm.
    pub radius_mm: f64,
    /// Back-and-forth cycles of a run.
    pub cycles: u32,
}

impl Params {
    /// The paper's fold experiment; the settings of [`crate::model`] say where each value comes from. Width and
    /// length are those of [`Params::folded_by`] with 21 mm of thread, to three decimals.
    pub const PAPER: Self = Self {
        intestine_mm: 24.40,
        width_mm: 15.771,
        length_mm: 26.425,
        friction: 0.15,
        tail_mm: 65.0,
        stroke_mm: 130.0,
        radius_mm: 20.0,
        cycles: 5,
    };

    /// The same experiment with the width `W - 2a` and the length L(a) of a design after `thread_mm` of thread was
    /// drawn in.
    ///
    /// # Errors
    /// `thread_mm` outside the design's travel, `0..=d(h)`.
    pub fn folded_by(self, design: &Design<f64>, thread_mm: f64) -> Result<Self, OutOfRange> {
        let a_mm = design.indentation_for_thread_mm(thread_mm)?;
        Ok(Self {
            width_mm: design.folded_width_mm(a_mm)?,
            length_mm: design.length_mm(a_mm)?,
            ..self
        })
    }

    /// Width from which on the wave pushes the folded body ahead of itself, mm. It rides over a narrower one, or does
    /// not touch it.
    #[must_use]
    pub fn least_pushed_mm(&self, indentation_mm: f64) -> f64 {
        let excess_mm = self.radius_mm * (1.0 - 1.0 / libm::hypot(1.0, self.friction));
        self.intestine_mm - 2.0 * (indentation_mm - excess_mm)
    }
}

/// How the wave meets the folded body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Contact {
    /// The wave is no deeper than the gap beside the body.
    Untouched,
    /// The wall meets the body at so flat a slope that the roller rides over it.
    Overridden {
        /// Slope of the wall there, at most the friction.
        slope: f64,
    },
    /// The body is pushed ahead of the roller.
    Pushed {
        /// Slope of the wall there.
        slope: f64,
        /// Distance from the roller's axis to the body's near end, mm.
        ahead_mm: f64,
    },
}

/// The folded body under the rig's rollers.
#[derive(Clone, Debug)]
pub struct FoldedBody {
    params: Params,
    contact: Contact,
    tail_mm: f64,
}

impl FoldedBody {
    /// The body at `params.tail_mm` and the rollers at home, indenting by `indentation_mm`.
    ///
    /// # Errors
    /// The first parameter outside its range; an indentation outside `0..=D/2`; a body that would lie under the roller.
    pub fn new(params: Params, indentation_mm: f64) -> Result<Self, OutOfRange> {
        check(
            "intestine width D",
            "mm",
            params.intestine_mm,
            (0.0, 1e3),
            Ends::OpenBelow,
            "it is a width",
        )?;
        check(
            "folded width",
            "mm",
            params.width_mm,
            (0.0, params.intestine_mm),
            Ends::OpenBelow,
            "the folded body lies in the intestine",
        )?;
        check(
            "folded length",
            "mm",
            params.length_mm,
            (0.0, 1e3),
            Ends::OpenBelow,
            "it is a length",
        )?;
        check(
            "friction coefficient",
            "",
            params.friction,
            (0.0, 10.0),
            Ends::Closed,
            "it is a friction",
        )?;
        check(
            "stroke",
            "mm",
            params.stroke_mm,
            (0.0, 1e3),
            Ends::OpenBelow,
            "the carriage has to travel",
        )?;
        check(
            "roller radius",
            "mm",
            params.radius_mm,
            (params.intestine_mm / 2.0, 1e3),
            Ends::Closed,
            "the wave is an arc of the roller, no deeper than its radius",
        )?;
        check(
            "indentation a",
            "mm",
            indentation_mm,
            (0.0, params.intestine_mm / 2.0),
            Ends::Closed,
            "then the two walls meet",
        )?;
        let contact = contact(&params, indentation_mm);
        let ahead_mm = match contact {
            Contact::Pushed { ahead_mm, .. } => ahead_mm,
            Contact::Untouched | Contact::Overridden { .. } => 0.0,
        };
        check(
            "start of the tail",
            "mm",
            params.tail_mm,
            (-1e3, params.stroke_mm - ahead_mm - params.length_mm),
            Ends::Closed,
            "the body is laid down clear of the roller at home",
        )?;
        Ok(Self {
            params,
            contact,
            tail_mm: params.tail_mm,
        })
    }

    /// Moves the carriage straight to `carriage_mm`: 0 = home = right end, positive to the left.
    ///
    /// # Errors
    /// A position that is NaN or more than 100 mm outside the stroke.
    pub fn carriage_to(&mut self, carriage_mm: f64) -> Result<(), OutOfRange> {
        check(
            "carriage position",
            "mm",
            carriage_mm,
            (-100.0, self.params.stroke_mm + 100.0),
            Ends::Closed,
            "the rig's rail ends there",
        )?;
        let roller_mm = self.params.stroke_mm - carriage_mm;
        if let Contact::Pushed { ahead_mm, .. } = self.contact {
            // The body lies to the left of a roller that pushes, so only a move to the left reaches it.
            let free_tail_mm = roller_mm - ahead_mm - self.params.length_mm;
            if free_tail_mm < self.tail_mm {
                self.tail_mm = free_tail_mm;
            }
        }
        Ok(())
    }

    /// One cycle: to the far end and home.
    ///
    /// # Errors
    /// None after a successful [`FoldedBody::new`].
    pub fn cycle(&mut self) -> Result<(), OutOfRange> {
        self.carriage_to(self.params.stroke_mm)?;
        self.carriage_to(0.0)
    }

    /// Displacement of the body since the start, mm; + is headward. Negative if the antegrade wave pushes the body.
    pub fn displacement_mm(&self) -> f64 {
        self.tail_mm - self.params.tail_mm
    }

    /// Position of the body's tail, mm.
    pub fn tail_mm(&self) -> f64 {
        self.tail_mm
    }

    /// How the wave meets the body.
    pub fn contact(&self) -> Contact {
        self.contact
    }
}

fn contact(params: &Params, indentation_mm: f64) -> Contact {
    let gap_mm = (params.intestine_mm - params.width_mm) / 2.0;
    let depth_mm = indentation_mm - gap_mm;
    if depth_mm <= 0.0 {
        return Contact::Untouched;
    }
    let ahead_mm = libm::sqrt(depth_mm * (2.0 * params.radius_mm - depth_mm));
    let slope = ahead_mm / (params.radius_mm - depth_mm);
    if slope > params.friction {
        Contact::Pushed { slope, ahead_mm }
    } else {
        Contact::Overridden { slope }
    }
}

/// The paper's fold experiment: displacement of the body in mm after all cycles, + headward.
///
/// # Errors
/// As [`FoldedBody::new`].
pub fn run(params: Params, indentation_mm: f64) -> Result<f64, OutOfRange> {
    let mut body = FoldedBody::new(params, indentation_mm)?;
    for _ in 0..params.cycles {
        body.cycle()?;
    }
    Ok(body.displacement_mm())
}
