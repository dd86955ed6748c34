//! Lists and ranges of numbers as people write them: `7000`, `0.08,0.20`, `3000:7000:400`. They are read in
//! millionths, so that every member is the float nearest to its decimals.

use std::str::FromStr;

use client::decimal;

pub const MOST: usize = 10_000;

/// Decimals that a number may have.
const DECIMALS: u32 = 6;
const SCALE: f64 = 1e6;
/// Largest number, in millionths, for which division by [`SCALE`] gives the float nearest to the decimals.
const LARGEST: u64 = 1_000_000_000_000;

/// Numbers in the order as written; never empty.
#[derive(Clone, Debug, PartialEq)]
pub struct Values(pub Vec<f64>);

impl FromStr for Values {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut values = vec![];
        for item in text.split(',') {
            let number = |part: &str| {
                decimal::parse(part, DECIMALS, LARGEST).map_err(|why| format!("{part:?}: {why}"))
            };
            let parts: Vec<_> = item.split(':').collect();
            let (low, high, step) = match parts[..] {
                [one] => (number(one)?, number(one)?, 1),
                [low, high, step] => (number(low)?, number(high)?, number(step)?),
                _ => return Err(format!("{item:?}: write LOW:HIGH:STEP")),
            };
            if step == 0 {
                return Err(format!("{item:?}: the step must be more than 0"));
            }
            if high < low {
                return Err(format!("{item:?}: the range ends below its beginning"));
            }
            if (high - low) % step != 0 {
                return Err(format!(
                    "{item:?}: steps of {} lead to {} or {}, not to {}",
                    decimal::write(step, DECIMALS),
                    decimal::write(high - (high - low) % step, DECIMALS),
                    decimal::write(high - (high - low) % step + step, DECIMALS),
                    decimal::write(high, DECIMALS),
                ));
            }
            if (high - low) / step >= (MOST - values.len()) as u64 {
                return Err(format!("more than {MOST} values: take a larger step"));
            }
            values.extend(
                (low..=high)
                    .step_by(step as usize)
                    .map(|v| v as f64 / SCALE),
            );
        }
        Ok(Self(values))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use locomotion::paper::{frictions, pressures_pa};

    fn values(text: &str) -> Result<Vec<f64>, String> {
        text.parse().map(|Values(values)| values)
    }

    #[test]
    fn the_papers_ranges_are_the_papers_numbers_bit_by_bit() {
        assert_eq!(values("0.08:0.20:0.005"), Ok(frictions().collect()));
        assert_eq!(values("3000:7000:400"), Ok(pressures_pa().collect()));
        assert_eq!(values("1:4:1,5.05"), Ok(vec![1.0, 2.0, 3.0, 4.0, 5.05]));
    }

    #[test]
    fn what_is_no_range_is_refused_and_nothing_is_cut_off() {
        for (text, says) in [
            ("", "not a number"),
            ("1:2", "LOW:HIGH:STEP"),
            ("1:2:0", "more than 0"),
            ("2:1:1", "ends below"),
            ("0.05:0.2:0.04", "lead to 0.17 or 0.21, not to 0.2"),
            ("-1", "negative"),
            ("nan", "not a number"),
            ("0:1:0.0001", "more than 10000 values"),
            ("0:0.9999:0.0001,1", "more than 10000 values"),
        ] {
            let why = values(text).expect_err(text);
            assert!(why.contains(says), "{text}: {why}");
        }
        assert_eq!(values("0:0.9999:0.0001").map(|all| all.len()), Ok(MOST));
    }
}
