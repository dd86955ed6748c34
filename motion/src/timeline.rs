//! The latest planned periods: ticks and pulses from the start of the path to the end of each.

use crate::slots::SLOTS;
use crate::step_times::Equal;

/// Periods whose ends are remembered: those waiting in the ring, and those played since the captured edges were last
/// compared. Each is at most one ring.
pub const REMEMBERED: u32 = 2 * SLOTS as u32;

/// Progress on a path; both values wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mark {
    /// Ticks from its start.
    pub ticks: u32,
    /// Pulses from its start.
    pub pulses: u32,
}

impl Mark {
    /// Difference from an earlier mark to this one.
    #[inline]
    #[must_use]
    pub fn since(self, before: Self) -> Self {
        Self {
            ticks: self.ticks.wrapping_sub(before.ticks),
            pulses: self.pulses.wrapping_sub(before.pulses),
        }
    }
}

/// The latest periods of a path.
#[derive(Debug)]
pub struct Timeline {
    /// End of each period; its index is the period's number modulo the array's length.
    marks: [Mark; REMEMBERED as usize],
    /// End of the last period.
    end: Mark,
    given: u32,
}

impl Default for Timeline {
    fn default() -> Self {
        Self {
            marks: [Mark::default(); REMEMBERED as usize],
            end: Mark::default(),
            given: 0,
        }
    }
}

impl Timeline {
    pub fn clear(&mut self) {
        self.marks.fill(Mark::default());
        (self.end, self.given) = (Mark::default(), 0);
    }

    /// Appends a pause as one period without pulses.
    pub fn extend_by_pause(&mut self, ticks: u32) {
        self.end.ticks = self.end.ticks.wrapping_add(ticks);
        self.marks[(self.given % REMEMBERED) as usize] = self.end;
        self.given = self.given.wrapping_add(1);
    }

    /// Appends periods with a pulse in each round, one period for each group.
    // Not inlined, so that the line stays in registers.
    #[inline(never)]
    pub fn extend(&mut self, groups: &[Equal]) {
        let (mut given, mut end) = (self.given, self.end);
        for &Equal { interval, steps } in groups {
            end = Mark {
                ticks: end.ticks.wrapping_add(interval.wrapping_mul(steps)),
                pulses: end.pulses.wrapping_add(steps),
            };
            self.marks[(given % REMEMBERED) as usize] = end;
            given = given.wrapping_add(1);
        }
        (self.given, self.end) = (given, end);
    }

    /// Number of periods since the start; wraps in runs of many hours.
    #[must_use]
    pub fn given(&self) -> u32 {
        self.given
    }

    /// End of the last period.
    #[must_use]
    pub fn end(&self) -> Mark {
        self.end
    }

    /// End of period `number`, counted from 0, which has to be one of the last [`REMEMBERED`]. Before the first period
    /// the progress is zero.
    #[inline]
    #[must_use]
    pub fn at_end_of(&self, number: u32) -> Mark {
        self.marks[(number % REMEMBERED) as usize]
    }

    /// Whether all periods from number `from` on are remembered.
    #[must_use]
    pub fn remembers(&self, from: u32) -> bool {
        self.given.wrapping_sub(from) <= REMEMBERED
    }

    /// Ticks from the last emitted pulse to the end of the last period, if `unemitted` pulses are still to come.
    /// `None` if that pulse is older than the remembered periods.
    #[must_use]
    pub fn ticks_since_last_pulse(&self, unemitted: u32) -> Option<u32> {
        let last = self.end.pulses.wrapping_sub(unemitted);
        let mut after = self.end;
        for back in 2..=REMEMBERED {
            let before = self.at_end_of(self.given.wrapping_sub(back));
            let period = after.since(before);
            // The pulse's number within the period, from 1.
            let nth = last.wrapping_sub(before.pulses);
            if (1..=period.pulses).contains(&nth) {
                let round = period.ticks / period.pulses;
                let at = before.ticks.wrapping_add((nth - 1) * round);
                return Some(self.end.ticks.wrapping_sub(at));
            }
            after = before;
        }
        None
    }
}
