//! Ways to time the steps of a move from rest to rest, each as it would be called once per step.
//!
//! * [`ours`]: `motion`, one step at a time and in batches;
//! * [`ramp_maker`], [`stepgen`]: two crates, through their public functions;
//! * [`austin`]: D. Austin, "Generate stepper-motor speed profiles in real time" (2005), in whole counts, as Atmel's
//!   application note AVR446 has it;
//! * [`segments`]: one speed for each hundredth of a second, as motion controllers of the family of grbl move.
//!
//! Each is used as well as its interface permits: it gets the move in the unit in which it is most exact, and a
//! fraction of a tick is carried over to the next interval, not dropped.
#![no_std]
#![forbid(unsafe_code)]

pub mod austin;
pub mod ours;
pub mod ramp_maker;
pub mod segments;
pub mod stepgen;

/// Ticks per second: one tick is 10 ns.
pub const TICK_HZ: u32 = 100_000_000;

/// A move from rest to rest: a symmetric trapezoid of speed over time.
#[derive(Clone, Copy, Debug)]
pub struct Move {
    /// Number of steps.
    pub steps: u32,
    /// Duration, ticks.
    pub duration_ticks: u32,
    /// Duration of each ramp, ticks.
    pub ramp_ticks: u32,
}

impl Move {
    /// Acceleration, steps per square tick.
    #[must_use]
    pub fn acceleration(&self) -> f64 {
        self.speed() / f64::from(self.ramp_ticks)
    }

    /// Speed of the cruise, steps per tick.
    #[must_use]
    pub fn speed(&self) -> f64 {
        f64::from(self.steps) / f64::from(self.duration_ticks - self.ramp_ticks)
    }
}

/// A way to time steps.
pub trait Method: Sized {
    /// Gets ready for a move; `None` if its numbers do not fit.
    fn new(order: &Move) -> Option<Self>;

    /// Ticks from the last step to the next; `None` at the end.
    fn next_interval(&mut self) -> Option<u32>;
}
