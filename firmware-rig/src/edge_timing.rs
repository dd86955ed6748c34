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

/// The comparison of one path.
///
/// An edge that is missing, moved or added shows as a wrong interval. Those of the first and of the last step show in the number
/// of edges instead.
#[derive(Debug, Default)]
pub struct EdgeTiming {
    /// Number of the next period with pulses.
    next: u32,
    /// Edges still to come of the one before.
    to_come: u32,
    /// Ticks between them.
    interval: u32,
    /// When the last edge came, on the clock of the captures, and when it was planned, on that of the path.
    last: (u32, u32),
    /// Captures or periods were lost: nothing more can be compared on this path.
    lost: bool,
    timed: Timed,
}

impl EdgeTiming {
    /// Another path begins.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// What was found since.
    pub fn timed(&self) -> Timed {
        self.timed
    }

    /// Edges were captured at these instants; the clock wraps. Once per step: a few instructions each.
    pub fn compare(&mut self, line: &Timeline, instants: impl Iterator<Item = u32>) {
        // Without the jumper nobody takes the periods out.
        let Some(mut periods) = line.with_pulses(self.next) else {
            self.lost = true;
            return;
        };
        if self.lost {
            return;
        }
        let (mut to_come, mut interval) = (self.to_come, self.interval);
        let (mut last, mut last_planned) = self.last;
        let (mut edges, mut worst) = (self.timed.edges, self.timed.worst_error_ticks);
        for at in instants {
            let mut planned = last_planned.wrapping_add(interval);
            let unplanned = to_come == 0 && periods == 0;
            if to_come > 0 {
                to_come -= 1;
            } else if periods > 0 {
                let pulses = line.pulses(self.next);
                self.next = self.next.wrapping_add(1);
                periods -= 1;
                (planned, interval) = (pulses.first, pulses.steps.interval);
                to_come = pulses.steps.steps - 1;
            }
            // From the edge before to this one: as it came, less as it was planned.
            let late = at
                .wrapping_sub(last)
                .wrapping_sub(planned.wrapping_sub(last_planned));
            if late != 0 || unplanned {
                let error = match edges {
                    _ if unplanned => u32::MAX,
                    // Nothing is before the first edge.
                    0 => 0,
                    _ => (late as i32).unsigned_abs(),
                };
                worst = worst.max(error);
            }
            edges = edges.wrapping_add(1);
            (last, last_planned) = (at, planned);
        }
        (self.to_come, self.interval) = (to_come, interval);
        self.last = (last, last_planned);
        self.timed = Timed {
            edges,
            worst_error_ticks: worst,
        };
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
