//! Compares the intervals between edges captured at the pin with the planned ones, tick by tick.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::timeline::Timeline;

/// Result of the comparison on a path.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Timed {
    /// Edges that were captured and compared.
    pub edges: u32,
    /// Largest difference between a captured interval and the planned one; [`u32::MAX`] after an edge without a step or
    /// a step without an edge.
    pub worst_error_ticks: u32,
}

/// Captured intervals, counted by their difference from the plan, since the start of the device; the counts wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Intervals {
    /// Intervals without a difference.
    pub exact: u32,
    /// Intervals off by 1 tick, by 2 ticks, and by more, in either direction.
    pub off: [u32; 3],
}

/// Comparison of one path.
///
/// A missing, moved or additional edge shows as a wrong interval; at the last step, in [`EdgeTiming::timed_whole`].
#[derive(Debug, Default)]
pub struct EdgeTiming {
    /// Number of the next period with pulses.
    next: u32,
    /// Edges still to come of the period before it.
    to_come: u32,
    /// Ticks between these edges.
    interval: u32,
    /// When the next of these edges is due, on the captures' clock: one interval after the last edge.
    due: u32,
    /// The captures' clock minus the path's, at the last edge.
    offset: u32,
    /// Captures or periods were lost: nothing more can be compared on this path.
    lost: bool,
    timed: Timed,
    intervals: Intervals,
}

impl EdgeTiming {
    /// Starts a new path.
    pub fn clear(&mut self) {
        *self = Self {
            intervals: self.intervals,
            ..Self::default()
        };
    }

    /// Result since the start of the path.
    pub fn timed(&self) -> Timed {
        self.timed
    }

    /// Result of a path of which every step has left. A last step without an edge shows in no interval.
    pub fn timed_whole(&self, line: &Timeline) -> Timed {
        let missing = self.to_come > 0 || self.next != line.given_with_pulses();
        let mut timed = self.timed;
        // Without the jumper nothing was timed.
        if missing && timed.edges > 0 && !self.lost {
            timed.worst_error_ticks = u32::MAX;
        }
        timed
    }

    /// Result on all paths since the start of the device.
    pub fn intervals(&self) -> Intervals {
        self.intervals
    }

    /// Compares edges captured at these instants, which DMA has written; their clock wraps. Runs once per step, so each
    /// edge costs a few instructions.
    // Not inlined, so that its state stays in registers although its caller is optimised for size.
    #[inline(never)]
    pub fn compare(&mut self, line: &Timeline, instants: &[AtomicU32]) {
        // Without the jumper no edges arrive, and the timeline forgets periods before they are compared.
        self.lost |= !line.remembers(self.next);
        if self.lost {
            return;
        }
        let given = line.given_with_pulses();
        let (mut next, mut to_come, mut due) = (self.next, self.to_come, self.due);
        let (mut interval, mut offset) = (self.interval, self.offset);
        let mut edges = instants.iter();
        let mut additional = 0;
        while let Some(at) = edges.next() {
            let at = at.load(Ordering::Relaxed);
            if to_come == 0 {
                if next == given {
                    self.timed.worst_error_ticks = u32::MAX;
                    additional = 1 + edges.len();
                    break;
                }
                let pulses = line.pulses(next);
                // The first edge has no interval before it.
                if next == 0 {
                    offset = at.wrapping_sub(pulses.first);
                    self.intervals.exact = self.intervals.exact.wrapping_sub(1);
                }
                next = next.wrapping_add(1);
                due = pulses.first.wrapping_add(offset);
                (interval, to_come) = (pulses.steps.interval, pulses.steps.steps);
            }
            to_come = to_come.wrapping_sub(1);
            if at != due {
                let by = at.wrapping_sub(due);
                self.differ(by);
                offset = offset.wrapping_add(by);
                due = at;
            }
            due = due.wrapping_add(interval);
        }
        (self.next, self.to_come, self.due) = (next, to_come, due);
        (self.interval, self.offset) = (interval, offset);
        self.timed.edges = self.timed.edges.wrapping_add(instants.len() as u32);
        // `differ` has already subtracted the intervals that are off. An additional edge ends none.
        let intervals = instants.len().wrapping_sub(additional) as u32;
        self.intervals.exact = self.intervals.exact.wrapping_add(intervals);
    }

    /// Notes an interval that differs from the planned one.
    #[cold]
    #[inline(never)]
    fn differ(&mut self, by: u32) {
        let error = (by as i32).unsigned_abs();
        self.timed.worst_error_ticks = self.timed.worst_error_ticks.max(error);
        let off = &mut self.intervals.off[error.min(3) as usize - 1];
        *off = off.wrapping_add(1);
        self.intervals.exact = self.intervals.exact.wrapping_sub(1);
    }

    /// Whether nothing more can be compared on this path, as without the jumper.
    pub fn is_over(&self) -> bool {
        self.lost
    }

    /// Notes that captures were overwritten before they were compared.
    pub fn lose(&mut self) {
        self.lost = true;
    }
}
