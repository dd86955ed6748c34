//! The last readings of a phase, for speeds and means. The phase's direction counts as positive.

use crate::units::Counts;
use heapless::Deque;

/// Readings over which a current is averaged.
pub const MEAN: usize = 8;

/// One reading with the drive before it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Reading {
    /// Time of the reading.
    pub at_us: u64,
    /// Encoder counts in the direction of the phase.
    pub along: Counts,
    /// Current that drives the motor; negative if it brakes.
    pub current_ua: i32,
    /// Duty times battery voltage that was ordered; none while braking.
    pub drive_mv: Option<i16>,
    /// Battery voltage.
    pub battery_mv: u16,
}

/// The last readings, as many as make [`MEAN`] intervals.
#[derive(Clone, Debug, Default)]
pub struct Readings(Deque<Reading, { MEAN + 1 }>);

impl Readings {
    /// Adds a reading.
    pub fn push(&mut self, reading: Reading) {
        if self.0.is_full() {
            self.0.pop_front();
        }
        let _ = self.0.push_back(reading);
    }

    /// Speed over the last `over` intervals, or as many as there are, counts/s.
    pub fn speed_cps(&self, over: usize) -> i32 {
        let mut recent = self.0.iter().rev().take(over + 1);
        match (recent.next_back(), self.0.back()) {
            (Some(first), Some(last)) => last.speed_since(first.along, first.at_us),
            _ => 0,
        }
    }

    /// Largest current of the last readings, in either direction.
    pub fn most_ua(&self) -> i32 {
        let magnitudes = self.0.iter().map(|reading| reading.current_ua.abs());
        magnitudes.max().unwrap_or(0)
    }

    /// Means of current, drive and battery voltage; none unless all of the last readings were driven.
    pub fn driven(&self) -> Option<(i32, i32, i32)> {
        let (mut current_ua, mut drive_mv, mut battery_mv) = (0, 0, 0);
        for age in 1..=MEAN {
            let reading = self.0.get(self.0.len().checked_sub(age)?)?;
            current_ua += reading.current_ua;
            drive_mv += i32::from(reading.drive_mv?);
            battery_mv += i32::from(reading.battery_mv);
        }
        let of = |sum| sum / MEAN as i32;
        Some((of(current_ua), of(drive_mv), of(battery_mv)))
    }
}

impl Reading {
    /// Mean speed since an earlier place, counts/s.
    pub fn speed_since(&self, along: Counts, at_us: u64) -> i32 {
        let elapsed_us = i32::try_from(self.at_us.saturating_sub(at_us)).unwrap_or(i32::MAX);
        // The chip divides 32 bits in 12 cycles. 2,000 counts within 64 ms are beyond any motor.
        let counts = (self.along - along).0.clamp(-2_000, 2_000);
        (counts * 1_000_000).checked_div(elapsed_us).unwrap_or(0)
    }
}
