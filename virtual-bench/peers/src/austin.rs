//! Austin's ramp in whole counts with a carried remainder, from the equations of his paper; the cruise is one whole
//! count, as in Atmel's application note AVR446.
//!
//! ```text
//! first delay   c_0 = 0.676 f sqrt(2 / a)
//! then          c_n = c_(n-1) - (2 c_(n-1) + rest) / (4 n + 1)      n < 0 on the way down
//! ramp          v^2 / (2 a) steps
//! ```

use crate::{Method, Move};

/// Corrects the error of the approximation at the first step (Austin).
const FIRST: f64 = 0.676;

#[derive(Clone, Copy)]
enum Phase {
    Accelerate,
    Cruise,
    Decelerate,
}

/// The delays.
pub struct Delays {
    phase: Phase,
    /// The number n of the equation.
    n: i32,
    delay: i32,
    rest: i32,
    /// Steps taken.
    step: i32,
    steps: i32,
    /// Step at which the way down begins.
    down_from: i32,
    /// Steps of the way down, negative.
    down: i32,
    /// Delay in cruise.
    least: i32,
    /// Delay that the way up had come to, from which the way down begins.
    last_up: i32,
}

impl Method for Delays {
    fn new(order: &Move) -> Option<Self> {
        let (acceleration, speed) = (order.acceleration(), order.speed());
        let first = libm::round(FIRST * libm::sqrt(2.0 / acceleration)) as i32;
        let ramp = libm::round(speed * speed / (2.0 * acceleration)) as i32;
        let steps = i32::try_from(order.steps).ok()?;
        // Twice the first delay is the largest number.
        first.checked_mul(2)?;
        (0 < ramp && 2 * ramp < steps).then_some(Self {
            phase: Phase::Accelerate,
            n: 0,
            delay: first,
            rest: 0,
            step: 0,
            steps,
            down_from: steps - ramp,
            down: -ramp,
            least: libm::round(1.0 / speed) as i32,
            last_up: first,
        })
    }

    #[inline(never)]
    fn next_interval(&mut self) -> Option<u32> {
        if self.step >= self.steps {
            return None;
        }
        if self.step > 0 {
            match self.phase {
                Phase::Accelerate => {
                    self.n += 1;
                    self.ramp();
                    self.last_up = self.delay;
                    if self.delay <= self.least {
                        self.delay = self.least;
                        self.rest = 0;
                        self.phase = Phase::Cruise;
                    }
                }
                Phase::Cruise => {}
                Phase::Decelerate => {
                    self.n = (self.n + 1).min(-1);
                    self.ramp();
                }
            }
        }
        self.step += 1;
        if self.step == self.down_from {
            self.phase = Phase::Decelerate;
            self.n = self.down - 1;
            self.delay = self.last_up;
            self.rest = 0;
        }
        Some(self.delay as u32)
    }
}

impl Delays {
    #[inline(always)]
    fn ramp(&mut self) {
        let (above, below) = (2 * self.delay + self.rest, 4 * self.n + 1);
        self.delay -= above / below;
        self.rest = above % below;
    }
}
