//! Beam model of a crescent: an elastic wing between core and wall, and how a thread through the core changes it.
//!
//! * [`rod`]: the planar rod, inextensible, with any rotation, loaded at its tip or by a wall with friction.
//! * [`crescent`]: the wing under a wall or a roller: force against indentation, the least alpha, the lever.
//! * [`thread`]: displacement of the body against the thread drawn in, without a switch between two models.
//! * [`band`]: the same curve over uncertain inputs, declared and seeded.
//!
//! Tests check the rod against closed forms, but not the results derived from it: each carries its [`Validation`].

use core::fmt;

use crate::range::OutOfRange;

pub mod band;
pub mod crescent;
pub mod rod;
pub mod thread;

/// How far a result was validated against something other than this model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Validation {
    /// The solver meets closed forms; no rig was compared with the result.
    NotAgainstARig,
}

impl fmt::Display for Validation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::NotAgainstARig => "beam model, not validated against a rig",
        })
    }
}

/// A result of the beam model together with its [`Validation`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Modelled<T> {
    /// The result.
    pub value: T,
    /// How far it was validated.
    pub validation: Validation,
}

impl<T> Modelled<T> {
    pub(crate) const fn new(value: T) -> Self {
        Self {
            value,
            validation: Validation::NotAgainstARig,
        }
    }
}

/// Why the beam model has no answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NoAnswer {
    /// A value that the model does not cover.
    OutOfRange(OutOfRange),
    /// No equilibrium was found near the one before.
    NoEquilibrium {
        /// The load or the indentation that the last step aimed at.
        at: f64,
        /// Remaining imbalance, relative.
        residual: f64,
    },
    /// The body did not come to rest at one place of the roller.
    NoRest {
        /// Place of the roller, mm.
        roller_mm: f64,
    },
}

impl fmt::Display for NoAnswer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OutOfRange(error) => error.fmt(f),
            Self::NoEquilibrium { at, residual } => write!(
                f,
                "the beam has no equilibrium near {at} that could be reached in steps (residual {residual:.1e}): it \
                 snaps or jams there; choose a smaller indentation, a smaller load or less friction"
            ),
            Self::NoRest { roller_mm } => write!(
                f,
                "the body does not come to rest with the roller at {roller_mm} mm: choose a finer roller step"
            ),
        }
    }
}

impl core::error::Error for NoAnswer {}

impl From<OutOfRange> for NoAnswer {
    fn from(error: OutOfRange) -> Self {
        Self::OutOfRange(error)
    }
}
