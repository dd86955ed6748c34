//! One reading of the sensors, and which way the spool turns.

use crate::{mechanics::Counts, sense::ma};

/// One reading of the sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sample {
    /// Encoder.
    pub counts: Counts,
    /// Current of the motor, positive winding; a braked motor's has the other sign.
    pub current_ua: i32,
    /// The shunt amplifier's offset, taken at rest; the current is without it, unless it is too large.
    pub offset_ma: i16,
    /// Battery voltage.
    pub battery_mv: u16,
    /// The bridge pulls nFAULT low.
    pub driver_fault: bool,
}

impl Sample {
    /// Magnitude of the current.
    pub fn magnitude_ma(&self) -> u16 {
        ma(self.current_ua).unsigned_abs()
    }

    /// Current that drives the motor in this direction; negative if it brakes.
    pub fn along_ma(&self, spooling: Spooling) -> i16 {
        ma(spooling.along(self.current_ua))
    }
}

/// Which way the spool turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Spooling {
    /// Thread onto the spool.
    Wind,
    /// Thread off the spool.
    PayOut,
}

impl Spooling {
    /// A distance or speed in counts, positive in this direction.
    pub fn along(self, counts: i32) -> i32 {
        match self {
            Spooling::Wind => counts,
            Spooling::PayOut => counts.saturating_neg(),
        }
    }
}
