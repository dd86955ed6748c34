//! The condition that a sentence of the paper puts on a number, as data that a program can check.

use core::fmt;

/// Requirement of a sentence on a quantity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Condition {
    /// Between two values, both included.
    Within(f64, f64),
    /// At least this.
    AtLeast(f64),
    /// At most this.
    AtMost(f64),
    /// More than this.
    Above(f64),
    /// Less than this.
    Below(f64),
}

impl Condition {
    /// Exactly this number: for counts, and for values that are zero except for rounding.
    pub const fn exactly(value: f64) -> Self {
        Self::about(value, EXACT)
    }

    /// A value with a tolerance to either side: half a unit of its last digit, or a declared one.
    pub const fn about(value: f64, tolerance: f64) -> Self {
        Self::Within(value - tolerance, value + tolerance)
    }

    /// Whether a value meets the condition; NaN meets none.
    pub fn met(self, value: f64) -> bool {
        match self {
            Self::Within(low, high) => (low..=high).contains(&value),
            Self::AtLeast(least) => value >= least,
            Self::AtMost(most) => value <= most,
            Self::Above(bound) => value > bound,
            Self::Below(bound) => value < bound,
        }
    }
}

/// Tolerance of an exact value: rounding of the last bits.
pub(crate) const EXACT: f64 = 1e-9;

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Within(low, high) if high - low < 4.0 * EXACT => {
                write!(f, "{}", Short((low + high) / 2.0))
            }
            Self::Within(low, high) => write!(f, "{} to {}", Short(low), Short(high)),
            Self::AtLeast(least) => write!(f, "at least {}", Short(least)),
            Self::AtMost(most) => write!(f, "at most {}", Short(most)),
            Self::Above(bound) => write!(f, "more than {}", Short(bound)),
            Self::Below(bound) => write!(f, "less than {}", Short(bound)),
        }
    }
}

/// Prints a bound with the decimals it was written with, three at most.
struct Short(f64);

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let thousandths = libm::round(self.0 * 1000.0) + 0.0;
        write!(f, "{}", thousandths / 1000.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::ToString;

    #[test]
    fn bounds_belong_to_it_as_their_words_say() {
        for (condition, text, met, missed) in [
            (
                Condition::Within(0.5, 1.5),
                "0.5 to 1.5",
                &[0.5, 1.0, 1.5][..],
                &[0.49, 1.51][..],
            ),
            (
                Condition::about(24.4, 0.005),
                "24.395 to 24.405",
                &[24.4],
                &[24.41],
            ),
            (Condition::exactly(9.0), "9", &[9.0], &[8.0, 9.001]),
            (Condition::exactly(0.0), "0", &[0.0, -0.0, 1e-12], &[1e-6]),
            (
                Condition::AtLeast(0.95),
                "at least 0.95",
                &[0.95, 1.0],
                &[0.949],
            ),
            (Condition::AtMost(0.2), "at most 0.2", &[0.2, -3.0], &[0.21]),
            (
                Condition::Above(0.0),
                "more than 0",
                &[1e-300],
                &[0.0, -1.0],
            ),
            (
                Condition::Below(0.0),
                "less than 0",
                &[-1e-300],
                &[0.0, 1.0],
            ),
        ] {
            assert_eq!(condition.to_string(), text);
            assert!(met.iter().all(|value| condition.met(*value)), "{condition}");
            assert!(
                !missed.iter().any(|value| condition.met(*value)),
                "{condition}"
            );
            assert!(!condition.met(f64::NAN), "{condition}: NaN");
        }
    }
}
