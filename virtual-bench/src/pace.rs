//! Paces a machine whose time is virtual by real time: how far it may run now. On a computer that is too slow the
//! machine slows down; its delay does not grow.
//!
//! Nothing here reads a clock: the caller passes the real time that has elapsed.

use std::fmt;

/// Longest piece to run in one go. Between two of them the line is checked, and the thread sleeps.
const TURN_US: u64 = 1_000;
/// Longest delay that the machine still catches up, us; beyond it the time counts as lost. No client waits for an
/// answer that long.
const MOST_LATE_US: u64 = 100_000;
/// Interval between two reports of lost time.
const REPORT_US: u64 = 5_000_000;

/// The next action of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Turn {
    /// Run until its clock shows this time, us.
    Run(u64),
    /// Sleep this long, us, unless input arrives.
    Rest(u64),
}

/// Time that a machine has lost because the computer was too slow for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Slow {
    /// Time lost, us.
    pub(crate) lost_us: u64,
    /// Interval in which it was lost, us.
    pub(crate) of_us: u64,
}

impl fmt::Display for Slow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |us: u64| us as f64 / 1e6;
        write!(
            f,
            "this computer is too slow for it: {:.2} s of the last {:.1} s are lost, as if they had not been",
            seconds(self.lost_us),
            seconds(self.of_us)
        )
    }
}

/// Keeps a machine's time beside the computer's.
#[derive(Debug)]
pub(crate) struct Pace {
    epoch_us: u64,
    lost_us: u64,
    /// Input has arrived: hand it over before a whole piece is due.
    hurried: bool,
    /// Real time and total loss at the last report.
    reported: (u64, u64),
}

impl Pace {
    /// Starts at real time 0, when the machine's clock shows `now_us`.
    pub(crate) fn new(now_us: u64) -> Self {
        Self {
            epoch_us: now_us,
            lost_us: 0,
            hurried: false,
            reported: (0, 0),
        }
    }

    /// The next action of a machine whose clock shows `now_us`, after `elapsed_us` of real time.
    pub(crate) fn turn(&mut self, elapsed_us: u64, now_us: u64) -> Turn {
        let due_us = self.epoch_us + elapsed_us.saturating_sub(self.lost_us);
        let late_us = due_us.saturating_sub(now_us);
        self.lost_us += late_us.saturating_sub(MOST_LATE_US);
        let hurried = std::mem::take(&mut self.hurried);
        if late_us >= TURN_US || hurried && late_us > 0 {
            return Turn::Run(now_us + late_us.min(TURN_US));
        }
        let early_us = now_us.saturating_sub(due_us);
        Turn::Rest(early_us + TURN_US - late_us)
    }

    /// Input has arrived for the machine: it runs at once, as far as it may.
    pub(crate) fn hurry(&mut self) {
        self.hurried = true;
    }

    /// Total time that the machine has lost, us.
    pub(crate) fn lost_us(&self) -> u64 {
        self.lost_us
    }

    /// The loss since the last report, if a report is due and there is a loss.
    pub(crate) fn report(&mut self, elapsed_us: u64) -> Option<Slow> {
        let (since_us, lost_us) = self.reported;
        if elapsed_us.saturating_sub(since_us) < REPORT_US {
            return None;
        }
        self.reported = (elapsed_us, self.lost_us);
        let slow = Slow {
            lost_us: self.lost_us - lost_us,
            of_us: elapsed_us - since_us,
        };
        (slow.lost_us > 0).then_some(slow)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEGAN_US: u64 = 5_000;

    /// Ten seconds of real time.
    struct Lived {
        /// The machine's own time.
        us: u64,
        pace: Pace,
        pieces: u64,
        rests: u64,
        reports: Vec<Slow>,
    }

    /// Runs a machine for which each ms costs `cost_us` of real time and each rest lasts `overslept_us` too long.
    fn lived(cost_us: u64, overslept_us: u64) -> Lived {
        let (mut elapsed_us, mut now_us) = (0, BEGAN_US);
        let mut lived = Lived {
            us: 0,
            pace: Pace::new(now_us),
            pieces: 0,
            rests: 0,
            reports: vec![],
        };
        while elapsed_us < 10_000_000 {
            match lived.pace.turn(elapsed_us, now_us) {
                Turn::Run(until_us) => {
                    assert!(until_us > now_us && until_us - now_us <= TURN_US);
                    elapsed_us += (until_us - now_us) * cost_us / 1_000;
                    now_us = until_us;
                    lived.pieces += 1;
                }
                Turn::Rest(us) => {
                    assert!((1..=TURN_US).contains(&us));
                    elapsed_us += us + overslept_us;
                    lived.rests += 1;
                }
            }
            let due_us = BEGAN_US + elapsed_us - lived.pace.lost_us();
            let behind_us = due_us.saturating_sub(now_us);
            assert!(behind_us <= MOST_LATE_US + 10 * cost_us, "{behind_us}");
            lived.reports.extend(lived.pace.report(elapsed_us));
        }
        lived.us = now_us - BEGAN_US;
        lived
    }

    #[test]
    fn a_quick_emulator_keeps_real_time_and_rests_once_for_each_piece() {
        for (cost_us, overslept_us) in [(1, 0), (30, 60), (400, 0), (900, 60), (400, 7_000)] {
            let lived = lived(cost_us, overslept_us);
            let limit_us = 2 * TURN_US + overslept_us;
            assert!(lived.us.abs_diff(10_000_000) <= limit_us, "{}", lived.us);
            assert_eq!(lived.pace.lost_us(), 0);
            assert_eq!(lived.reports, []);
            assert!(lived.pieces <= 10_000, "{} pieces", lived.pieces);
            assert!(lived.rests <= lived.pieces + 1, "{} rests", lived.rests);
        }
    }

    #[test]
    fn a_slow_one_is_slow_and_not_later_and_later() {
        let lived = lived(2_000, 0);
        assert!(lived.us.abs_diff(5_000_000) <= 10_000, "{}", lived.us);
        let lost_us = lived.pace.lost_us();
        assert!((lived.us + lost_us).abs_diff(10_000_000) <= 2 * MOST_LATE_US);
        assert_eq!(lived.rests, 1);
        // Half of the time is lost, and each report must say so.
        assert_eq!(lived.reports.len(), 2);
        for Slow { lost_us, of_us } in lived.reports {
            assert!(lost_us.abs_diff(of_us / 2) <= 2 * MOST_LATE_US, "{lost_us}");
        }
    }

    #[test]
    fn what_comes_for_it_does_not_wait_for_a_whole_piece() {
        let mut pace = Pace::new(BEGAN_US);
        assert_eq!(pace.turn(400, BEGAN_US), Turn::Rest(600));
        pace.hurry();
        assert_eq!(pace.turn(401, BEGAN_US), Turn::Run(BEGAN_US + 401));
        assert_eq!(pace.turn(402, BEGAN_US + 401), Turn::Rest(999));
        // A machine that is early cannot run, and the hurry is over.
        pace.hurry();
        assert_eq!(pace.turn(500, BEGAN_US + 700), Turn::Rest(1_200));
        assert_eq!(pace.turn(900, BEGAN_US + 700), Turn::Rest(800));
    }

    #[test]
    fn a_computer_that_was_away_is_told_once() {
        let mut pace = Pace::new(0);
        assert_eq!(pace.turn(3_000_000, 0), Turn::Run(TURN_US));
        assert_eq!(pace.lost_us(), 3_000_000 - MOST_LATE_US);
        assert_eq!(pace.report(4_000_000), None);
        let told = Slow {
            lost_us: 2_900_000,
            of_us: 5_000_000,
        };
        assert_eq!(pace.report(5_000_000), Some(told));
        assert_eq!(pace.report(10_000_000), None);
    }
}
