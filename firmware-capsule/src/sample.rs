//! One reading of the sensors, and the directions of the spool.

use crate::{sense::ma, units::Counts};

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sample {
    pub counts: Counts,
    /// Current of the motor: positive winding, opposite sign while braking.
    pub current_ua: i32,
    /// Offset of the shunt amplifier, measured at rest. Already subtracted from the current, unless it is too large.
    pub offset_ma: i16,
    pub battery_mv: u16,
    /// The bridge pulls nFAULT low.
    pub driver_fault: bool,
}

impl Sample {
    /// Magnitude of the current.
    pub fn magnitude_ma(&self) -> u16 {
        ma(self.current_ua).unsigned_abs()
    }
}

/// Direction of the spool: winds thread onto it, or pays thread out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Spooling {
    #[default]
    Wind,
    PayOut,
}

impl Spooling {
    /// A distance, a speed or a current, positive in this direction.
    pub fn along(self, value: i32) -> i32 {
        match self {
            Spooling::Wind => value,
            Spooling::PayOut => value.saturating_neg(),
        }
    }
}
