//! The last readings of a motion, for speeds, means and trends.

use crate::mechanics::Counts;
use crate::sample::Sample;

/// Readings kept: 32 ms.
const KEPT: usize = 32;

/// One reading with the current ordered before it. Running sums make any mean the difference of two sums: the
/// processor has one millisecond for everything.
#[derive(Clone, Copy, Debug, Default)]
struct Point {
    at_us: u64,
    counts: Counts,
    /// Counts since the previous reading, if that was about 1 ms earlier.
    step: Option<i32>,
    /// Current ordered before the reading; `None` if the drive gave no pulses.
    ordered_ma: Option<u16>,
    /// Number of consecutive driven readings up to this one.
    driven: usize,
    /// Sums over all readings up to this one; they wrap.
    sums: Sums,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    current_ma: i32,
    ordered_ma: u32,
    battery_mv: u32,
}

/// The last readings.
#[derive(Clone, Debug)]
pub struct Window {
    points: [Point; KEPT],
    next: usize,
    count: usize,
}

impl Window {
    /// An empty window.
    pub fn new() -> Self {
        Self {
            points: [Point::default(); KEPT],
            next: 0,
            count: 0,
        }
    }

    /// Adds a reading. `current_ma` is its current in the direction of the leg.
    pub fn push(&mut self, at_us: u64, sample: &Sample, current_ma: i16, ordered_ma: Option<u16>) {
        let before = self.back(0).copied().unwrap_or_default();
        let elapsed_us = at_us.saturating_sub(before.at_us);
        let follows = self.count != 0 && (500..=1_500).contains(&elapsed_us);
        let sums = Sums {
            current_ma: before.sums.current_ma.wrapping_add(current_ma.into()),
            ordered_ma: before
                .sums
                .ordered_ma
                .wrapping_add(ordered_ma.unwrap_or(0).into()),
            battery_mv: before
                .sums
                .battery_mv
                .wrapping_add(sample.battery_mv.into()),
        };
        self.points[self.next] = Point {
            at_us,
            counts: sample.counts,
            step: follows.then(|| sample.counts.since(before.counts).0),
            ordered_ma,
            driven: match ordered_ma {
                Some(_) => (before.driven + 1).min(KEPT),
                None => 0,
            },
            sums,
        };
        self.next = (self.next + 1) % KEPT;
        self.count = (self.count + 1).min(KEPT);
    }

    /// The reading `age` readings before the last one.
    fn back(&self, age: usize) -> Option<&Point> {
        (age < self.count).then(|| &self.points[(self.next + KEPT - 1 - age) % KEPT])
    }

    /// The last reading, and the sums before the last `over` readings; `None` if some of them are missing.
    fn over(&self, over: usize) -> Option<(&Point, Sums)> {
        let last = self.back(0)?;
        // Before the first reading the sums are 0. A full window has lost its oldest, but still holds more than any
        // caller asks for.
        let before = match over == self.count {
            true if over < KEPT => Sums::default(),
            _ => self.back(over)?.sums,
        };
        Some((last, before))
    }

    /// Speed in counts/s from the reading `from` readings ago, or the oldest, to the one `to` readings ago. Positive
    /// winds.
    pub fn speed_cps(&self, from: usize, to: usize) -> i32 {
        let oldest = from.min(self.count.saturating_sub(1));
        let (Some(first), Some(last)) = (self.back(oldest), self.back(to)) else {
            return 0;
        };
        let elapsed_us = last.at_us.saturating_sub(first.at_us);
        let counts = last.counts.since(first.counts).0;
        // Divide 32 bits where possible: it takes the chip 12 cycles, 64 bits take hundreds, and each reading asks
        // ten times.
        if let (Some(travel), Ok(elapsed_us)) =
            (counts.checked_mul(1_000_000), i32::try_from(elapsed_us))
        {
            return travel.checked_div(elapsed_us).unwrap_or(0);
        }
        let travel = i64::from(counts) * 1_000_000;
        let elapsed_us = i64::try_from(elapsed_us).unwrap_or(i64::MAX);
        let speed = travel.checked_div(elapsed_us).unwrap_or(0);
        speed.clamp(i32::MIN.into(), i32::MAX.into()) as i32
    }

    /// Counts between the reading `age` readings ago and the one before it, if they are about 1 ms apart.
    pub fn step(&self, age: usize) -> Option<i32> {
        self.back(age)?.step
    }

    /// The last `over` readings are there, and all of them were driven.
    pub fn is_driven(&self, over: usize) -> bool {
        self.back(0).is_some_and(|last| last.driven >= over)
    }

    /// Means of the current in the direction of the leg and of the ordered current over the last `over` readings,
    /// fewer than are kept; `None` if some of them are missing or were not driven.
    pub fn means_ma(&self, over: usize) -> Option<(u16, u16)> {
        let (last, before) = self.over(over)?;
        if last.driven < over {
            return None;
        }
        let mean = |sum: u32, before: u32| {
            (sum.wrapping_sub(before) + over as u32 / 2).checked_div(over as u32)
        };
        let ordered_ma = mean(last.sums.ordered_ma, before.ordered_ma)?;
        // A current that brakes the motor counts as 0.
        let sum = last.sums.current_ma.wrapping_sub(before.current_ma).max(0);
        let current_ma = mean(sum as u32, 0)?;
        Some((current_ma as u16, ordered_ma as u16))
    }

    /// Signed mean of the current over the last `over` readings: negative if it brakes the motor.
    pub fn along_ma(&self, over: usize) -> Option<i32> {
        let (last, before) = self.over(over)?;
        let sum = last.sums.current_ma.wrapping_sub(before.current_ma);
        sum.checked_div(over as i32)
    }

    /// Current above the ordered one in the last reading, less its mean over the `before` readings that precede it;
    /// `None` if some of them are missing or were not driven.
    pub fn surge_ma(&self, before: usize) -> Option<i32> {
        let (last, oldest) = self.over(before + 1)?;
        if last.driven <= before {
            return None;
        }
        let surplus = |sums: Sums| sums.current_ma.wrapping_sub(sums.ordered_ma as i32);
        let earlier = surplus(self.back(1)?.sums);
        let mean = earlier
            .wrapping_sub(surplus(oldest))
            .checked_div(before as i32)?;
        Some(
            surplus(last.sums)
                .wrapping_sub(earlier)
                .saturating_sub(mean),
        )
    }

    /// The last reading has the largest ordered current of the last `over` readings; false if some of them are
    /// missing or were not driven.
    pub fn orders_most_now(&self, over: usize) -> bool {
        let ordered = |age| self.back(age).and_then(|point| point.ordered_ma);
        ordered(0).is_some_and(|now| (0..over).all(|age| ordered(age).is_some_and(|ma| ma <= now)))
    }

    /// Mean of the battery voltage over the last `over` readings, fewer than are kept.
    pub fn battery_mv(&self, over: usize) -> Option<u16> {
        let (last, before) = self.over(over)?;
        let sum = last.sums.battery_mv.wrapping_sub(before.battery_mv);
        sum.checked_div(over as u32).map(|mean| mean as u16)
    }
}

impl Default for Window {
    fn default() -> Self {
        Self::new()
    }
}
