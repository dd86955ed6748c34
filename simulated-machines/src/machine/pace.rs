//! Real time for a scripted machine, without jumps: if the computer freezes for a second, the machine must not conclude
//! that the host was silent for a second.

use std::time::{Duration, Instant};

/// Largest advance of the machine's clock between two polls of the line, us of the computer's time.
pub const TURN_US: u64 = 2_000;
/// Largest lag of the machine's clock, us of the computer's time. Time beyond this is dropped.
pub const MOST_LATE_US: u64 = 100_000;
/// Sleep when nothing is due.
const REST: Duration = Duration::from_micros(500);

/// The clock of a machine, running at `speed` times the computer's clock.
pub struct Pace {
    began: Instant,
    speed: u64,
    /// The computer's time that the machine has been given, and that it has lost, us.
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

    /// The machine's clock, us. Each call advances it by one turn at most.
    pub fn now_us(&mut self) -> u64 {
        self.after(self.began.elapsed().as_micros() as u64)
    }

    /// As [`Self::now_us`], with this much of the computer's time elapsed.
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
