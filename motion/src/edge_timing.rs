//! Compares the intervals between the edges that were captured at the pin with those that were given out, tick by tick.

use crate::timeline::Timeline;

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

/// The comparison of one path.
///
/// An edge that is missing, moved or added shows as a wrong interval. Those of the first and of the last step show in
/// the number of edges instead.
#[derive(Debug, Default)]
pub struct EdgeTiming {
    /// Number of the next period with pulses.
    next: u32,
    /// Edges still to come of the one before.
    to_come: u32,
    /// Ticks between them.
    interval: u32,
    /// When the next of them is planned, on the clock of the path.
    planned: u32,
    /// From the clock of the path to that of the captures, by the last edge.
    offset: u32,
    /// Captures or periods were lost: nothing more can be compared on this path.
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

    /// Edges were captured at these instants; the clock wraps. Once per step: a few instructions each.
    // A function of its own: so its state stays in registers, although its caller is optimised for size.
    #[inline(never)]
    pub fn compare(&mut self, line: &Timeline, instants: &[u32]) {
        // Without the jumper no edge takes the periods out.
        self.lost |= !line.remembers(self.next);
        if self.lost {
            return;
        }
        let edges = self.timed.edges.wrapping_add(instants.len() as u32);
        let (begins, mut added) = (self.next == 0, 0_u32);
        let (mut to_come, mut interval) = (self.to_come, self.interval);
        let (mut planned, mut offset, mut next) = (self.planned, self.offset, self.next);
        for &at in instants {
            if to_come == 0 {
                if next == line.given_with_pulses() {
                    self.timed.worst_error_ticks = u32::MAX;
                    added = added.wrapping_add(1);
                    continue;
                }
                let pulses = line.pulses(next);
                next = next.wrapping_add(1);
                planned = pulses.first;
                interval = pulses.steps.interval;
                to_come = pulses.steps.steps;
            }
            to_come = to_come.wrapping_sub(1);
            let now = at.wrapping_sub(planned);
            if now != offset {
                // Nothing is before the first edge.
                let is_first = next == 1 && to_come + 1 == line.pulses(0).steps.steps;
                if !is_first {
                    self.differ(now.wrapping_sub(offset));
                }
                offset = now;
            }
            planned = planned.wrapping_add(interval);
        }
        (self.to_come, self.interval) = (to_come, interval);
        (self.planned, self.offset, self.next) = (planned, offset, next);
        self.timed.edges = edges;
        // Those that are off have been taken off already. Nothing is before the first edge, and an added one ends no
        // interval.
        let intervals = (instants.len() as u32).wrapping_sub(added);
        let intervals = intervals.wrapping_sub(u32::from(begins && intervals > 0));
        self.intervals.exact = self.intervals.exact.wrapping_add(intervals);
    }

    /// An interval differs from the planned one.
    #[cold]
    #[inline(never)]
    fn differ(&mut self, by: u32) {
        let error = (by as i32).unsigned_abs();
        self.timed.worst_error_ticks = self.timed.worst_error_ticks.max(error);
        let off = &mut self.intervals.off[error.min(3) as usize - 1];
        *off = off.wrapping_add(1);
        self.intervals.exact = self.intervals.exact.wrapping_sub(1);
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
