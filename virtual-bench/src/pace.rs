//! Paces a machine whose time is virtual by real time: how far it may run now. On a computer that is too slow the
//! machine slows down; its delay does not grow.
//!
//! Nothing here reads a clock: the caller passes the real time that has elapsed.

use std::fmt;

/// Longest turn while bytes pass on the line, us. Between two turns the line is polled, and the thread sleeps.
const TURN_US: u64 = 1_000;
/// Longest turn while the line is quiet, us. Waking the thread costs more than emulating a machine at rest; bytes wake
/// it at once.
const QUIET_TURN_US: u64 = 20_000;
/// The line is quiet after this long without a byte, us.
const QUIET_AFTER_US: u64 = 50_000;
/// Longest delay that the machine still catches up, us; beyond it the time counts as lost. Translating the code of a
/// first fold takes less.
const MOST_LATE_US: u64 = 250_000;
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
            "this computer is too slow for it: its clock lost {:.2} s of the last {:.1} s",
            seconds(self.lost_us),
            seconds(self.of_us)
        )
    }
}

/// Keeps a machine's clock in step with the computer's.
#[derive(Debug)]
pub(crate) struct Pace {
    epoch_us: u64,
    lost_us: u64,
    /// Input has arrived: pass it on before a whole turn is due.
    hurried: bool,
    /// A byte has passed since the last turn.
    talked: bool,
    /// Real time until which the turns are short, us.
    short_until_us: u64,
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
            talked: false,
            short_until_us: 0,
            reported: (0, 0),
        }
    }

    /// The next action of a machine whose clock shows `now_us`, after `elapsed_us` of real time.
    pub(crate) fn turn(&mut self, elapsed_us: u64, now_us: u64) -> Turn {
        let due_us = self.epoch_us + elapsed_us.saturating_sub(self.lost_us);
        let late_us = due_us.saturating_sub(now_us);
        self.lost_us += late_us.saturating_sub(MOST_LATE_US);
        let hurried = std::mem::take(&mut self.hurried);
        if std::mem::take(&mut self.talked) {
            self.short_until_us = elapsed_us + QUIET_AFTER_US;
        }
        let piece_us = if elapsed_us < self.short_until_us {
            TURN_US
        } else {
            QUIET_TURN_US
        };
        if late_us >= piece_us || hurried && late_us > 0 {
            return Turn::Run(now_us + late_us.min(piece_us));
        }
        let early_us = now_us.saturating_sub(due_us);
        Turn::Rest(early_us + piece_us - late_us)
    }

    /// Notes that input has arrived: the next turn begins at once, as far as the pace allows.
    pub(crate) fn hurry(&mut self) {
        self.hurried = true;
        self.talked = true;
    }

    /// Notes that the machine has sent bytes: the next turns are short.
    pub(crate) fn sent(&mut self) {
        self.talked = true;
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

    /// Runs a machine for which each ms costs `cost_us` of real time and each rest lasts `overslept_us` too long. It
    /// sends bytes all the time, or never.
    fn lived(talks: bool, cost_us: u64, overslept_us: u64) -> Lived {
        let piece_us = if talks { TURN_US } else { QUIET_TURN_US };
        let (mut elapsed_us, mut now_us) = (0, BEGAN_US);
        let mut lived = Lived {
            us: 0,
            pace: Pace::new(now_us),
            pieces: 0,
            rests: 0,
            reports: vec![],
        };
        while elapsed_us < 10_000_000 {
            if talks {
                lived.pace.sent();
            }
            match lived.pace.turn(elapsed_us, now_us) {
                Turn::Run(until_us) => {
                    assert!(until_us > now_us && until_us - now_us <= piece_us);
                    elapsed_us += (until_us - now_us) * cost_us / 1_000;
                    now_us = until_us;
                    lived.pieces += 1;
                }
                Turn::Rest(us) => {
                    assert!((1..=piece_us).contains(&us));
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
        let loads = [(1, 0), (30, 60), (400, 0), (900, 60), (400, 7_000)];
        for (talks, (cost_us, overslept_us)) in
            loads.map(|load| [(true, load), (false, load)]).concat()
        {
            let lived = lived(talks, cost_us, overslept_us);
            let piece_us = if talks { TURN_US } else { QUIET_TURN_US };
            let limit_us = 2 * piece_us + overslept_us;
            assert!(lived.us.abs_diff(10_000_000) <= limit_us, "{}", lived.us);
            assert_eq!(lived.pace.lost_us(), 0);
            assert_eq!(lived.reports, []);
            assert!(
                lived.pieces <= 10_000_000 / piece_us,
                "{} pieces",
                lived.pieces
            );
            assert!(lived.rests <= lived.pieces + 1, "{} rests", lived.rests);
        }
    }

    #[test]
    fn a_slow_one_is_slow_and_not_later_and_later() {
        let lived = lived(true, 2_000, 0);
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
        assert_eq!(pace.turn(400, BEGAN_US), Turn::Rest(QUIET_TURN_US - 400));
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
        assert_eq!(pace.turn(3_000_000, 0), Turn::Run(QUIET_TURN_US));
        assert_eq!(pace.lost_us(), 3_000_000 - MOST_LATE_US);
        assert_eq!(pace.report(4_000_000), None);
        let expected = Slow {
            lost_us: 3_000_000 - MOST_LATE_US,
            of_us: 5_000_000,
        };
        assert_eq!(pace.report(5_000_000), Some(expected));
        assert_eq!(pace.report(10_000_000), None);
    }
}
