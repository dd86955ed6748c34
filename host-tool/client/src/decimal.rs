//! Reads decimal numbers exactly, into integers of the smallest unit. Without floats there is no NaN, no infinity and
//! no rounding.

use std::str::FromStr;

use motion::units::Decimal;

/// The reason why a text was refused as a number.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecimalError {
    #[error("negative: use a number of at least 0")]
    Negative,
    #[error("has an exponent: write all digits, for example 130 or 12.5")]
    Exponent,
    #[error("has a comma: write a point, for example 12.5")]
    Comma,
    #[error("not a number: write digits, for example 130 or 12.5")]
    NotANumber,
    /// Finer than the smallest unit.
    #[error("{}", too_fine(*.0))]
    TooFine(u32),
    /// Beyond the largest value that can be sent.
    #[error("too large: use at most {0}")]
    TooLarge(u64),
}

fn too_fine(decimals: u32) -> String {
    match decimals {
        0 => "not a whole number: write for example 5".to_owned(),
        _ => format!(
            "more than {decimals} decimals: the finest step is {}",
            write(1, decimals)
        ),
    }
}

/// Reads a decimal number as a multiple of `10^-decimals`, at most `max` of these.
///
/// # Errors
/// The first error in the text.
pub fn parse(text: &str, decimals: u32, max: u64) -> Result<u64, DecimalError> {
    let text = text.trim();
    let scale = 10_u64.pow(decimals);
    let too_large = DecimalError::TooLarge(max / scale);
    if text.starts_with('-') {
        return Err(DecimalError::Negative);
    }
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits = |part: &str| part.bytes().all(|byte| byte.is_ascii_digit());
    if !digits(whole) || !digits(fraction) || (whole.is_empty() && fraction.is_empty()) {
        let exponent =
            text.starts_with(|first: char| first.is_ascii_digit()) && text.contains(['e', 'E']);
        return Err(match text {
            _ if exponent => DecimalError::Exponent,
            _ if text.contains(',') => DecimalError::Comma,
            _ => DecimalError::NotANumber,
        });
    }
    let fraction = fraction.trim_end_matches('0');
    if fraction.len() > decimals as usize {
        return Err(DecimalError::TooFine(decimals));
    }
    let padded = format!("{fraction:0<width$}", width = decimals as usize);
    let value = |part: &str| match part {
        "" => Some(0),
        part => part.parse::<u64>().ok(),
    };
    value(whole)
        .and_then(|whole| whole.checked_mul(scale))
        .and_then(|whole| whole.checked_add(value(&padded)?))
        .filter(|value| *value <= max)
        .ok_or(too_large)
}

/// Like [`parse`], limited to `u32`.
fn parse_u32(text: &str, decimals: u32) -> Result<u32, DecimalError> {
    let max = u64::from(u32::MAX);
    let value = parse(text, decimals, max)?;
    u32::try_from(value).map_err(|_| DecimalError::TooLarge(max / 10_u64.pow(decimals)))
}

/// Millimetres, millimetres per second or per second squared, kept in thousandths: um, um/s, um/s2.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Milli(pub u32);

impl FromStr for Milli {
    type Err = DecimalError;
    fn from_str(text: &str) -> Result<Self, DecimalError> {
        parse_u32(text, 3).map(Self)
    }
}

/// Seconds of a dwell or delay, kept in us; at most 71 minutes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ShortSeconds(pub u32);

impl FromStr for ShortSeconds {
    type Err = DecimalError;
    fn from_str(text: &str) -> Result<Self, DecimalError> {
        parse_u32(text, 6).map(Self)
    }
}

/// Seconds of a run, kept in us.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seconds(pub u64);

impl FromStr for Seconds {
    type Err = DecimalError;
    fn from_str(text: &str) -> Result<Self, DecimalError> {
        parse(text, 6, u64::MAX).map(Self)
    }
}

/// Writes `value / 10^decimals` exactly, without trailing zeros.
#[must_use]
pub fn write(value: u64, decimals: u32) -> String {
    Decimal { value, decimals }.to_string()
}

/// Writes `value / 10^decimals` with all decimals, to show the resolution.
#[must_use]
pub fn fixed(value: i64, decimals: u32) -> String {
    let sign = if value < 0 { "-" } else { "" };
    let scale = 10_u64.pow(decimals);
    let value = value.unsigned_abs();
    if decimals == 0 {
        return format!("{sign}{value}");
    }
    format!(
        "{sign}{}.{:0width$}",
        value / scale,
        value % scale,
        width = decimals as usize
    )
}

/// Writes ticks of 10 ns as seconds with all eight decimals.
#[must_use]
pub fn seconds(ticks: u64) -> String {
    fixed(i64::try_from(ticks).unwrap_or(i64::MAX), 8)
}

/// Like [`write()`], with a sign.
#[must_use]
pub fn write_signed(value: i64, decimals: u32) -> String {
    let sign = if value < 0 { "-" } else { "" };
    format!("{sign}{}", write(value.unsigned_abs(), decimals))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_is_not_a_number_says_so() {
        assert_eq!(
            DecimalError::TooFine(0).to_string(),
            "not a whole number: write for example 5"
        );
        assert!(DecimalError::TooFine(3).to_string().ends_with("0.001"));
        let cases = [
            ("NaN", DecimalError::NotANumber),
            ("nan", DecimalError::NotANumber),
            ("inf", DecimalError::NotANumber),
            ("infinity", DecimalError::NotANumber),
            ("", DecimalError::NotANumber),
            (".", DecimalError::NotANumber),
            ("+5", DecimalError::NotANumber),
            ("0x10", DecimalError::NotANumber),
            ("1 000", DecimalError::NotANumber),
            ("1.2.3", DecimalError::NotANumber),
            ("\u{661}\u{662}", DecimalError::NotANumber),
            ("-5", DecimalError::Negative),
            ("-0", DecimalError::Negative),
            ("1e999", DecimalError::Exponent),
            ("1E3", DecimalError::Exponent),
            ("12,5", DecimalError::Comma),
            ("0.0001", DecimalError::TooFine(3)),
            ("4294967.296", DecimalError::TooLarge(4_294_967)),
            (
                "99999999999999999999999999",
                DecimalError::TooLarge(4_294_967),
            ),
        ];
        for (text, error) in cases {
            assert_eq!(text.parse::<Milli>(), Err(error), "{text:?}");
        }
    }

    #[test]
    fn numbers_are_exact() {
        assert_eq!("130".parse(), Ok(Milli(130_000)));
        assert_eq!("130.0000".parse(), Ok(Milli(130_000)));
        assert_eq!(".5".parse(), Ok(Milli(500)));
        assert_eq!("4294967.295".parse(), Ok(Milli(u32::MAX)));
        assert_eq!("40".parse(), Ok(Seconds(40_000_000)));
        assert_eq!("0.000001".parse(), Ok(ShortSeconds(1)));
        assert_eq!(write_signed(-1_250, 3), "-1.25");
        assert_eq!(fixed(-50, 3), "-0.050");
        assert_eq!(seconds(4_000_000_001), "40.00000001");
    }

    proptest! {
        #[test]
        fn writing_and_reading_are_inverse(value: u64, decimals in 0_u32..=9) {
            prop_assert_eq!(parse(&write(value, decimals), decimals, u64::MAX), Ok(value));
        }

        #[test]
        fn no_text_panics(text in "\\PC*") {
            let _ = parse(&text, 6, u64::MAX);
        }
    }
}
