//! Real time for a machine whose time is virtual: how far it may run now. A computer that is too slow makes the machine slow, not
//! later and later.

use std::time::Instant;

/// Longest piece in one go: between two of them the line is looked at.
const TURN_US: u64 = 1_000;
/// So far may the machine's time be behind before that is given up: nobody waits for an answer that long.
const MOST_LATE_US: u64 = 100_000;

/// Keeps a machine's time beside the computer's.
#[derive(Debug)]
pub(crate) struct Pace {
    began: Instant,
    epoch_us: u64,
    lost_us: u64,
}

impl Pace {
    /// From now on, when the machine's clock shows `now_us`.
    pub(crate) fn new(now_us: u64) -> Self {
        Self {
            began: Instant::now(),
            epoch_us: now_us,
            lost_us: 0,
        }
    }

    /// Until when the machine may run, by its clock, which shows `now_us`; none if it is early.
    pub(crate) fn until_us(&mut self, now_us: u64) -> Option<u64> {
        self.after(self.began.elapsed().as_micros() as u64, now_us)
    }

    fn after(&mut self, elapsed_us: u64, now_us: u64) -> Option<u64> {
        let due_us = self.epoch_us + elapsed_us.saturating_sub(self.lost_us);
        let late_us = due_us.saturating_sub(now_us);
        self.lost_us += late_us.saturating_sub(MOST_LATE_US);
        (late_us > 0).then(|| now_us + late_us.min(TURN_US))
    }

    /// By how much the machine has fallen behind for good, us.
    pub(crate) fn lost_us(&self) -> u64 {
        self.lost_us
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Lets a machine run for 10 s of the computer's time; each ms of its own takes `cost_us`. Its time, and what was lost.
    fn lived(cost_us: u64) -> (u64, u64) {
        let (mut pace, mut elapsed_us, mut now_us) = (Pace::new(5_000), 0, 5_000);
        while elapsed_us < 10_000_000 {
            match pace.after(elapsed_us, now_us) {
                Some(until_us) => {
                    assert!(until_us - now_us <= TURN_US);
                    elapsed_us += (until_us - now_us) * cost_us / 1_000;
                    now_us = until_us;
                }
                None => elapsed_us += 200,
            }
            let behind_us = (5_000 + elapsed_us - pace.lost_us()).saturating_sub(now_us);
            assert!(behind_us <= MOST_LATE_US + 10 * cost_us, "{behind_us}");
        }
        (now_us - 5_000, pace.lost_us())
    }

    #[test]
    fn a_quick_emulator_keeps_real_time() {
        let (lived_us, lost_us) = lived(400);
        assert!(lived_us.abs_diff(10_000_000) <= 1_000, "{lived_us}");
        assert_eq!(lost_us, 0);
    }

    #[test]
    fn a_slow_one_is_slow_and_not_later_and_later() {
        let (lived_us, lost_us) = lived(2_000);
        assert!(lived_us.abs_diff(5_000_000) <= 10_000, "{lived_us}");
        assert!((lived_us + lost_us).abs_diff(10_000_000) <= 2 * MOST_LATE_US);
    }
}
