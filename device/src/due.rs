//! Counts the telemetry samples skipped because the processor stalled.

/// Samples that have come due by `now_us` after the one due at `due_us`. The sample sent now replaces the last of them,
/// and its sequence number shows how many are missing.
#[must_use]
pub fn skipped(due_us: u64, now_us: u64, interval_us: u32) -> u32 {
    let late_us = u32::try_from(now_us.saturating_sub(due_us)).unwrap_or(u32::MAX);
    late_us.checked_div(interval_us).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_in_its_own_interval_skips_none() {
        for late_us in [0, 1, 9_999] {
            assert_eq!(skipped(5_000, 5_000 + late_us, 10_000), 0, "{late_us}");
        }
        // A clock that is read a little early.
        assert_eq!(skipped(5_000, 4_999, 10_000), 0);
    }

    #[test]
    fn a_late_sample_skips_those_that_came_due_before_it() {
        assert_eq!(skipped(5_000, 15_000, 10_000), 1);
        assert_eq!(skipped(5_172_097, 5_202_751, 10_000), 3);
        assert_eq!(skipped(0, 800_000, 5_000), 160);
        assert_eq!(skipped(0, u64::MAX, 5_000), u32::MAX / 5_000);
    }

    #[test]
    fn without_an_interval_none_is_skipped() {
        assert_eq!(skipped(0, 1_000_000, 0), 0);
    }
}
