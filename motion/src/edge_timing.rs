//! Compares the intervals between edges captured at the pin with the planned ones, tick by tick.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::timeline::{Mark, REMEMBERED, Timeline};

/// Result of the comparison on a path.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Timed {
    /// Edges that were captured and compared.
    pub edges: u64,
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
    next: u32,
    /// End of the period before it.
    end: Mark,
    /// Edges still to come of that period.
    to_come: u32,
    /// Ticks between these edges.
    interval: u32,
    /// When the next of these edges is due, on the captures' clock: one interval after the last edge.
    due: u32,
    /// The captures' clock minus the path's, at the last edge.
    offset: u32,
    /// The first edge of the path was captured. No interval ends at it.
    begun: bool,
    /// Captures or periods were lost, so the rest of this path cannot be compared.
    lost: bool,
    timed: Timed,
    intervals: Intervals,
}

impl EdgeTiming {
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

    /// Result of a path whose every step was emitted; also finds a missing edge of the last step, which ends no
    /// interval.
    pub fn timed_whole(&self, line: &Timeline) -> Timed {
        let missing = self.to_come > 0 || self.end.pulses != line.end().pulses;
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

    /// Compares edges captured at these instants, which DMA has written; their clock wraps. Spends only a few
    /// instructions on each edge, because it runs once per step.
    // Not inlined, so that its state stays in registers.
    #[inline(never)]
    pub fn compare(&mut self, line: &Timeline, instants: &[AtomicU32]) {
        if self.lost {
            return;
        }
        if !line.remembers(self.next) {
            self.lost = true;
            // Few steps follow the missing edge, so a pause has pushed its period out of the timeline. With other edges
            // captured, the jumper is present and this edge is missing.
            let behind = line.end().pulses.wrapping_sub(self.end.pulses);
            if self.begun && instants.is_empty() && behind < REMEMBERED / 2 {
                self.timed.worst_error_ticks = u32::MAX;
            }
            return;
        }
        if !self.begun {
            self.begin(line, instants);
        }
        let given = line.given();
        let (mut next, mut end, mut to_come) = (self.next, self.end, self.to_come);
        let (mut interval, mut due, mut offset) = (self.interval, self.due, self.offset);
        let mut edges = instants.iter();
        let additional = 'edges: loop {
            while to_come > 0 {
                let Some(at) = edges.next() else {
                    break 'edges 0;
                };
                let at = at.load(Ordering::Relaxed);
                if at != due {
                    offset = offset.wrapping_add(self.differ(at, due));
                }
                due = at.wrapping_add(interval);
                to_come -= 1;
            }
            // A separate loop for periods of one step: if the periods differ, nearly all are of this kind.
            let mark = loop {
                if next == given {
                    break 'edges edges.len();
                }
                let mark = line.at_end_of(next);
                due = end.ticks.wrapping_add(offset);
                let pulses = mark.pulses.wrapping_sub(end.pulses);
                let edge = if pulses == 1 { edges.next() } else { None };
                let Some(at) = edge else {
                    to_come = pulses;
                    break mark;
                };
                let at = at.load(Ordering::Relaxed);
                if at != due {
                    offset = offset.wrapping_add(self.differ(at, due));
                }
                end = mark;
                next = next.wrapping_add(1);
            };
            let ticks = mark.ticks.wrapping_sub(end.ticks);
            interval = ticks.checked_div(to_come).unwrap_or(0);
            end = mark;
            next = next.wrapping_add(1);
        };
        (self.next, self.end, self.to_come) = (next, end, to_come);
        (self.interval, self.due, self.offset) = (interval, due, offset);
        self.pass_pauses(line);
        if additional > 0 {
            self.timed.worst_error_ticks = u32::MAX;
        }
        self.timed.edges += instants.len() as u64;
        // `differ` has already subtracted the intervals that are off. No interval ends at an additional edge.
        let intervals = instants.len().wrapping_sub(additional) as u32;
        self.intervals.exact = self.intervals.exact.wrapping_add(intervals);
    }

    /// Aligns the captures' clock with the path by its first edge, at which no interval ends.
    #[inline(never)]
    fn begin(&mut self, line: &Timeline, instants: &[AtomicU32]) {
        let Some(first) = instants.first() else {
            return;
        };
        if line.end().pulses == 0 {
            return; // an edge without a step
        }
        let first = first.load(Ordering::Relaxed);
        if self.to_come > 0 {
            // An earlier call has already taken the period of this edge.
            (self.offset, self.due) = (first.wrapping_sub(self.due), first);
        } else {
            self.pass_pauses(line);
            self.offset = first.wrapping_sub(self.end.ticks);
        }
        self.begun = true;
        self.intervals.exact = self.intervals.exact.wrapping_sub(1);
    }

    /// Skips periods without pulses, even if an edge before them is still to come or missing: a long pause would push
    /// its period out of the timeline.
    fn pass_pauses(&mut self, line: &Timeline) {
        while self.next != line.given() && line.at_end_of(self.next).pulses == self.end.pulses {
            self.end = line.at_end_of(self.next);
            self.next = self.next.wrapping_add(1);
        }
    }

    /// Counts an interval that differs from the planned one, and returns the difference in ticks.
    #[cold]
    #[inline(never)]
    fn differ(&mut self, at: u32, due: u32) -> u32 {
        let by = at.wrapping_sub(due);
        let error = (by as i32).unsigned_abs();
        self.timed.worst_error_ticks = self.timed.worst_error_ticks.max(error);
        let off = &mut self.intervals.off[error.min(3) as usize - 1];
        *off = off.wrapping_add(1);
        self.intervals.exact = self.intervals.exact.wrapping_sub(1);
        by
    }

    /// Whether the rest of this path cannot be compared, as without the jumper.
    pub fn is_over(&self) -> bool {
        self.lost
    }

    /// Notes that captures were overwritten before they were compared.
    pub fn lose(&mut self) {
        self.lost = true;
    }
}
