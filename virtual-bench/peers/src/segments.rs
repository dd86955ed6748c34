//! One speed for each hundredth of a second: the position at the end of each segment lies on the profile, and the whole
//! steps up to there are spread evenly, as motion controllers of the family of grbl do it.
//!
//! With floats of 32 bits, as there. Where a segment ends is counted in whole ticks and every segment aims at the
//! profile again, so that nothing adds up.

use crate::{Method, Move, TICK_HZ};

/// Length of a segment, ticks.
const SEGMENT: u32 = TICK_HZ / 100;

/// The intervals.
pub struct Intervals {
    order: Move,
    /// Half the acceleration, steps per square tick.
    half: f32,
    /// Cruise, steps per tick.
    speed: f32,
    /// Where the last segment ended: ticks, steps.
    end: u32,
    position: f32,
    /// The tick of the last step of the segments so far, and their steps.
    tick: u32,
    done: u32,
    /// Of the present segment.
    left: u32,
    interval: u32,
}

impl Method for Intervals {
    fn new(order: &Move) -> Option<Self> {
        Some(Self {
            order: *order,
            half: (order.acceleration() / 2.0) as f32,
            speed: order.speed() as f32,
            end: 0,
            position: 0.0,
            tick: 0,
            done: 0,
            left: 0,
            interval: 0,
        })
    }

    #[inline(never)]
    fn next_interval(&mut self) -> Option<u32> {
        while self.left == 0 {
            if self.done == self.order.steps {
                return None;
            }
            self.prepare();
        }
        self.left -= 1;
        Some(self.interval)
    }
}

impl Intervals {
    /// Steps at an instant of the profile.
    fn at(&self, tick: u32) -> f32 {
        let Move {
            steps,
            duration_ticks,
            ramp_ticks,
        } = self.order;
        if tick <= ramp_ticks {
            self.half * (tick as f32) * (tick as f32)
        } else if tick <= duration_ticks - ramp_ticks {
            // In a cruise the position is that of the speed from half the ramp on.
            self.speed * (tick - ramp_ticks / 2) as f32
        } else {
            let left = (duration_ticks - tick) as f32;
            steps as f32 - self.half * left * left
        }
    }

    /// The next segment. Without a step in it, the one after that follows.
    #[inline(never)]
    fn prepare(&mut self) {
        let Move {
            steps,
            duration_ticks,
            ..
        } = self.order;
        let begun = self.end;
        self.end = duration_ticks.min(begun + SEGMENT);
        let position = self.at(self.end);
        let whole = match self.end == duration_ticks {
            true => steps,
            false => (position as u32).clamp(self.done, steps),
        };
        let count = whole - self.done;
        // The last step comes before the end of the segment: the position is a fraction of a step beyond it.
        let ahead = (position - whole as f32).max(0.0);
        let length = (self.end - begun) as f32;
        let before = ahead * length / (position - self.position);
        let last = self.end - before as u32;
        if let Some(interval) = (last - self.tick).checked_div(count) {
            self.interval = interval;
            self.tick += interval * count;
            self.left = count;
            self.done = whole;
        }
        self.position = position;
    }
}
