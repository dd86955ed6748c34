//! Compares the intervals between the edges that were captured at the pin with those that were given out, tick by tick.

use crate::periods::Period;
use heapless::Deque;

/// Periods with pulses whose edges have not been compared yet: those that wait in the ring, and those that played since the
/// last look. More than a ring and a half.
const EXPECTED: usize = 256;

/// What the comparison has found on a path.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Timed {
    /// Edges that were captured and compared.
    pub edges: u32,
    /// Largest difference between a captured interval and the planned one. [`u32::MAX`] is an edge without a step.
    pub worst_error_ticks: u32,
}

/// Captured intervals by their difference from the plan, since the start of the device; the counts wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Intervals {
    /// None.
    pub exact: u32,
    /// 1 tick, 2 ticks, and more, in either direction.
    pub off: [u32; 3],
}

/// Equal steps, from the edge before them on.
#[derive(Clone, Copy, Debug, Default)]
struct Steps {
    /// Ticks from the edge before to the first one.
    first: u32,
    /// Ticks from one to the next.
    interval: u32,
    /// Steps after the first one.
    repeats: u8,
}

/// The comparison of one path.
///
/// An edge that is missing, moved or added shows as a wrong interval. Those of the first and of the last step show in the number
/// of edges instead.
#[derive(Debug, Default)]
pub struct EdgeTiming {
    expected: Deque<Steps, EXPECTED>,
    /// Ticks from the start of the last pulse that was given out to the end of the last period.
    since_pulse: u32,
    /// The steps in progress, whose first one was captured: as many as are still to come.
    present: Steps,
    /// Instant of the last edge, on the clock of the captures.
    last: u32,
    /// Captures or expectations were lost: nothing more can be compared on this path.
    lost: bool,
    timed: Timed,
    intervals: Intervals,
}

impl EdgeTiming {
    /// Another path begins.
    pub fn clear(&mut self) {
        *self = Self {
            intervals: self.intervals,
            ..Self::default()
        };
    }

    /// What was found since.
    pub fn timed(&self) -> Timed {
        self.timed
    }

    /// What was found on all paths.
    pub fn intervals(&self) -> Intervals {
        self.intervals
    }

    /// A period was given out.
    pub fn expect(&mut self, period: Period) {
        if self.lost {
            return;
        }
        if !period.pulse {
            let rounds = u32::from(period.repeats) + 1;
            self.since_pulse = self.since_pulse.wrapping_add(period.ticks * rounds);
            return;
        }
        let steps = Steps {
            first: self.since_pulse,
            interval: period.ticks,
            repeats: period.repeats,
        };
        self.since_pulse = period.ticks;
        // Without the jumper nobody takes them out.
        self.lost = self.expected.push_back(steps).is_err();
    }

    /// Edges were captured at these instants; the clock wraps. Once per step: a few instructions each.
    pub fn compare(&mut self, instants: impl Iterator<Item = u32>) {
        if self.lost {
            return;
        }
        let Timed {
            mut edges,
            worst_error_ticks: mut worst,
        } = self.timed;
        let (mut present, mut last) = (self.present, self.last);
        let (first, mut added) = (edges, 0_u32);
        for at in instants {
            let planned = if present.repeats > 0 {
                present.repeats -= 1;
                Some(present.interval)
            } else if let Some(next) = self.expected.pop_front() {
                present = next;
                Some(next.first)
            } else {
                None
            };
            let error = match planned {
                None => {
                    added += 1;
                    u32::MAX
                }
                // Nothing is before the first edge.
                Some(_) if edges == 0 => 0,
                Some(planned) => {
                    let interval = at.wrapping_sub(last);
                    (interval.wrapping_sub(planned) as i32).unsigned_abs()
                }
            };
            if error > 0 {
                worst = worst.max(error);
                self.count(error);
            }
            edges = edges.wrapping_add(1);
            last = at;
        }
        (self.present, self.last) = (present, last);
        // Those that are off have been taken off already; nothing is before the first edge.
        let intervals = edges.wrapping_sub(first).wrapping_sub(added);
        let intervals = intervals.wrapping_sub(u32::from(first == 0 && intervals > 0));
        self.intervals.exact = self.intervals.exact.wrapping_add(intervals);
        self.timed = Timed {
            edges,
            worst_error_ticks: worst,
        };
    }

    /// An interval was off. One that was added belongs to none.
    #[cold]
    fn count(&mut self, error_ticks: u32) {
        if error_ticks < u32::MAX {
            let off = &mut self.intervals.off[error_ticks.min(3) as usize - 1];
            *off = off.wrapping_add(1);
            self.intervals.exact = self.intervals.exact.wrapping_sub(1);
        }
    }

    /// Nothing more can be compared on this path, as without the jumper.
    pub fn is_over(&self) -> bool {
        self.lost
    }

    /// Captures were overwritten before they were compared.
    pub fn lose(&mut self) {
        self.lost = true;
    }
}
