//! The error of all models: a value that they do not cover.

use core::fmt;

/// A value outside the range in which an equation or a model holds. Values are never clamped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OutOfRange {
    /// Name of the value.
    pub quantity: &'static str,
    /// The value that was refused; may be NaN.
    pub value: f64,
    /// Lower end of the admissible range.
    pub min: f64,
    /// Upper end of the admissible range.
    pub max: f64,
    /// Unit of the three values; empty for a pure number.
    pub unit: &'static str,
    /// Whether the ends belong to the range.
    pub ends: Ends,
    /// Reason for the range.
    pub because: &'static str,
}

impl fmt::Display for OutOfRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            quantity,
            value,
            min,
            max,
            unit,
            ends,
            because,
        } = self;
        let gap = if unit.is_empty() { "" } else { " " };
        write!(
            f,
            "{quantity} = {value}{gap}{unit} is not usable: {because}; choose a value "
        )?;
        match ends {
            Ends::Closed => write!(f, "from {min} to {max}{gap}{unit}"),
            Ends::Open => write!(f, "above {min} and below {max}{gap}{unit}"),
            Ends::OpenBelow => write!(f, "above {min}, at most {max}{gap}{unit}"),
        }
    }
}

impl core::error::Error for OutOfRange {}

/// The ends of a range that belong to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ends {
    /// `min <= value <= max`
    Closed,
    /// `min < value < max`
    Open,
    /// `min < value <= max`
    OpenBelow,
}

/// Refuses `value`, NaN included, unless it lies between `min` and `max`.
///
/// # Errors
/// The value, its range and the reason for it.
pub fn check(
    quantity: &'static str,
    unit: &'static str,
    value: f64,
    (min, max): (f64, f64),
    ends: Ends,
    because: &'static str,
) -> Result<(), OutOfRange> {
    let inside = match ends {
        Ends::Closed => value >= min && value <= max,
        Ends::Open => value > min && value < max,
        Ends::OpenBelow => value > min && value <= max,
    };
    if inside {
        return Ok(());
    }
    Err(OutOfRange {
        quantity,
        value,
        min,
        max,
        unit,
        ends,
        because,
    })
}
