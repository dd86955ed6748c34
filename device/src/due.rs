//! Counts the samples that were left out because the processor stalled.

/// Samples that have come due by `now_us` after the one due at `due_us`. They are left out: the sample sent now takes
/// the place of the last of them, and its number tells how many are missing.
#[must_use]
pub fn left_out(due_us: u64, now_us: u64, interval_us: u32) -> u32 {
    let late_us = u32::try_from(now_us.saturating_sub(due_us)).unwrap_or(u32::MAX);
    late_us.checked_div(interval_us).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_in_its_own_interval_leaves_none_out() {
        for late_us in [0, 1, 9_999] {
            assert_eq!(left_out(5_000, 5_000 + late_us, 10_000), 0, "{late_us}");
        }
        // A clock that is read a little early.
        assert_eq!(left_out(5_000, 4_999, 10_000), 0);
    }

    #[test]
    fn a_late_sample_leaves_out_those_that_came_due_before_it() {
        assert_eq!(left_out(5_000, 15_000, 10_000), 1);
        assert_eq!(left_out(5_172_097, 5_202_751, 10_000), 3);
        assert_eq!(left_out(0, 800_000, 5_000), 160);
        assert_eq!(left_out(0, u64::MAX, 5_000), u32::MAX / 5_000);
    }

    #[test]
    fn without_an_interval_none_is_left_out() {
        assert_eq!(left_out(0, 1_000_000, 0), 0);
    }
}
