//! The last readings of a phase, for speeds and means. The phase's direction counts as positive.

use crate::units::Counts;

/// Readings kept: 32 ms.
const KEPT: usize = 32;

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

/// The last readings.
#[derive(Clone, Debug)]
pub struct Readings {
    points: [Reading; KEPT],
    next: usize,
    count: usize,
}

impl Default for Readings {
    fn default() -> Self {
        Self {
            points: [Reading::default(); KEPT],
            next: 0,
            count: 0,
        }
    }
}

impl Readings {
    /// Adds a reading.
    pub fn push(&mut self, reading: Reading) {
        self.points[self.next] = reading;
        self.next = (self.next + 1) % KEPT;
        self.count = (self.count + 1).min(KEPT);
    }

    /// The reading `age` readings before the last one.
    fn back(&self, age: usize) -> Option<&Reading> {
        (age < self.count).then(|| &self.points[(self.next + KEPT - 1 - age) % KEPT])
    }

    /// Speed over the last `over` intervals, or as many as there are, counts/s.
    pub fn speed_cps(&self, over: usize) -> i32 {
        let oldest = over.min(self.count.saturating_sub(1));
        let (Some(first), Some(last)) = (self.back(oldest), self.back(0)) else {
            return 0;
        };
        let elapsed_us = i32::try_from(last.at_us.saturating_sub(first.at_us)).unwrap_or(i32::MAX);
        // The chip divides 32 bits in 12 cycles. 2,000 counts within 32 ms are beyond any motor.
        let counts = (last.along - first.along).0.clamp(-2_000, 2_000);
        (counts * 1_000_000).checked_div(elapsed_us).unwrap_or(0)
    }

    /// Means of current and drive over the last `over` readings; none unless all of them were driven.
    pub fn driven(&self, over: usize) -> Option<(i32, i32)> {
        let (mut current_ua, mut drive_mv) = (0, 0);
        for age in 0..over {
            let reading = self.back(age)?;
            current_ua += reading.current_ua;
            drive_mv += i32::from(reading.drive_mv?);
        }
        Some((current_ua / over as i32, drive_mv / over as i32))
    }

    /// Mean of the battery voltage over the last `over` readings.
    pub fn battery_mv(&self, over: usize) -> Option<u16> {
        let sum: Option<u32> = (0..over)
            .map(|age| Some(u32::from(self.back(age)?.battery_mv)))
            .sum();
        sum?.checked_div(over as u32).map(|mean| mean as u16)
    }
}
