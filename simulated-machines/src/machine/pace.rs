//! Real time for a scripted machine that never jumps: a computer that froze for a second is not a host that was silent
//! for one.

use std::time::{Duration, Instant};

/// The machine's clock goes on by so much of the computer's time at most; then the line is looked at.
pub const TURN_US: u64 = 2_000;
/// So far may the machine's clock be behind; what is more is given up, as if it had not been.
pub const MOST_LATE_US: u64 = 100_000;
/// So long is slept when nothing is due.
const REST: Duration = Duration::from_micros(500);

/// The clock of a machine, so many times as fast as the computer's.
pub struct Pace {
    began: Instant,
    speed: u64,
    /// Of the computer's time, us: what the machine has had, and what it will never have.
    given_us: u64,
    lost_us: u64,
}

impl Pace {
    pub fn new(speed: u32) -> Self {
        Self {
            began: Instant::now(),
            speed: speed.into(),
            given_us: 0,
            lost_us: 0,
        }
    }

    /// The machine's clock now, us: a little later than when this was asked last.
    pub fn now_us(&mut self) -> u64 {
        self.after(self.began.elapsed().as_micros() as u64)
    }

    /// As [`Self::now_us`], after so much of the computer's time.
    pub fn after(&mut self, elapsed_us: u64) -> u64 {
        let late_us = elapsed_us - self.lost_us - self.given_us;
        self.lost_us += late_us.saturating_sub(MOST_LATE_US);
        self.given_us += late_us.min(TURN_US);
        self.given_us * self.speed
    }

    /// Sleeps, unless the machine has to catch up.
    pub fn rest(&self) {
        let elapsed_us = self.began.elapsed().as_micros() as u64;
        if elapsed_us - self.lost_us < self.given_us + TURN_US {
            std::thread::sleep(REST);
        }
    }
}
