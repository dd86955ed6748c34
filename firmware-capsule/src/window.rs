//! The last readings of a motion: speed, means, and how it changed.

use crate::{detect::Sample, mechanics::Counts};

/// Readings that are kept: 32 ms.
const KEPT: usize = 32;

/// One reading with what was ordered before it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Point {
    /// When it was taken.
    pub at_us: u64,
    /// Encoder.
    pub counts: Counts,
    /// Motor current.
    pub current_ma: u16,
    /// Battery.
    pub battery_mv: u16,
    /// Current that the drive before the reading was meant to give; `None` if it gave no pulses.
    pub ordered_ma: Option<u16>,
}

/// The last readings.
#[derive(Clone, Debug)]
pub struct Window {
    points: [Point; KEPT],
    next: usize,
    count: usize,
}

impl Window {
    /// Without a reading.
    pub fn new() -> Self {
        Self {
            points: [Point::default(); KEPT],
            next: 0,
            count: 0,
        }
    }

    /// Takes a reading.
    pub fn push(&mut self, at_us: u64, sample: &Sample, ordered_ma: Option<u16>) {
        self.points[self.next] = Point {
            at_us,
            counts: sample.counts,
            current_ma: sample.current_ma,
            battery_mv: sample.battery_mv,
            ordered_ma,
        };
        self.next = (self.next + 1) % KEPT;
        self.count = (self.count + 1).min(KEPT);
    }

    /// The reading `age` readings before the last one.
    pub fn back(&self, age: usize) -> Option<&Point> {
        (age < self.count).then(|| &self.points[(self.next + KEPT - 1 - age) % KEPT])
    }

    /// Counts per second from the reading `from` readings ago, or the oldest, to the one `to` readings ago. Positive winds.
    pub fn speed_cps(&self, from: usize, to: usize) -> i32 {
        let oldest = from.min(self.count.saturating_sub(1));
        let (Some(first), Some(last)) = (self.back(oldest), self.back(to)) else {
            return 0;
        };
        let elapsed_us = last.at_us.saturating_sub(first.at_us);
        let travel = i64::from(last.counts.since(first.counts).0) * 1_000_000;
        let elapsed_us = i64::try_from(elapsed_us).unwrap_or(i64::MAX);
        let speed = travel.checked_div(elapsed_us).unwrap_or(0);
        speed.clamp(i32::MIN.into(), i32::MAX.into()) as i32
    }

    /// Counts between the reading `age` readings ago and the one before it, if they are about 1 ms apart.
    pub fn step(&self, age: usize) -> Option<i32> {
        let (last, first) = (self.back(age)?, self.back(age + 1)?);
        let elapsed_us = last.at_us.saturating_sub(first.at_us);
        (500..=1_500)
            .contains(&elapsed_us)
            .then(|| last.counts.since(first.counts).0)
    }

    /// Means of current and of ordered current over the last `over` readings; `None` if some of them are missing or were
    /// not driven.
    pub fn means_ma(&self, over: usize) -> Option<(u16, u16)> {
        let (mut current, mut ordered) = (0_u32, 0_u32);
        for age in 0..over {
            let point = self.back(age)?;
            current += u32::from(point.current_ma);
            ordered += u32::from(point.ordered_ma?);
        }
        let mean = |sum: u32| (sum + over as u32 / 2).checked_div(over as u32);
        Some((mean(current)? as u16, mean(ordered)? as u16))
    }

    /// No more current was ordered in the last `over` readings than in the last one; false if some of them are missing
    /// or were not driven.
    pub fn orders_most_now(&self, over: usize) -> bool {
        let ordered = |age| self.back(age).and_then(|point| point.ordered_ma);
        ordered(0).is_some_and(|now| (0..over).all(|age| ordered(age).is_some_and(|ma| ma <= now)))
    }

    /// Mean of the battery voltage over the last `over` readings.
    pub fn battery_mv(&self, over: usize) -> Option<u16> {
        let mut sum = 0_u32;
        for age in 0..over {
            sum += u32::from(self.back(age)?.battery_mv);
        }
        sum.checked_div(over as u32).map(|mean| mean as u16)
    }
}

impl Default for Window {
    fn default() -> Self {
        Self::new()
    }
}
