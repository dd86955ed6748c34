//! Readings of the sensors, and their conversion: encoder counts to thread, and the ADC's readings to volts and amperes.
//!
//! The ADC measures relative to its supply. An empty cell pulls the linear regulator's output below its nominal 3,300
//! mV. The chip's internal reference does not fall with it, so one more conversion measures the supply.
//!
//! The shunt carries the motor's current in both directions, so its amplifier shows zero at half of its supply. No
//! current flows while the bridge sleeps, so the output is then its zero. A zero far from the half means a wrong or
//! broken amplifier.

use crate::units::Thread;
use core::ops::{Add, RangeInclusive, Sub};

/// Full scale of the 12-bit ADC.
const FULL: u32 = 4_095;
/// Supply at which the factory has read the reference, mV.
const FACTORY_MV: u32 = 3_300;
/// Plausible factory readings: 1.18 to 1.24 V (DS10314 table 74), and 1 % for the factory's own error.
const FACTORY: RangeInclusive<u16> = 1_450..=1_555;
/// Supply at which the chip works (DS10314 table 14). A result outside of it did not measure the supply.
const SUPPLY_MV: RangeInclusive<u32> = 1_700..=3_600;

/// Fine steps per step of the converter, so that means over several readings keep their resolution.
pub const FINE: i32 = 16;
/// Nominal zero of the amplifier: half of its supply, which is the converter's too.
const HALF: i32 = FULL as i32 * FINE / 2;
/// Deviation from the mean that is not noise, fine steps: 10 mA.
const JUMP: i32 = 200;
/// Readings at rest over which the zero is averaged, so that the noise of one does not shift a whole motion.
const AVERAGED: i32 = 32;
/// Largest offset of the shunt amplifier that is subtracted, mA: 0.9 N of thread force.
pub const MOST_OFFSET_MA: u16 = 20;
/// Sleep of the bridge after which a reading is the zero: the motor's current is gone, and the amplifier's filter
/// (0.16 ms) has settled.
pub const SETTLED_US: u64 = 10_000;

/// Encoder counts: 16 lines of four edges per motor revolution. Positive winds the thread up. Wraps as the counter
/// does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Counts(pub i32);

/// One count is `2 pi * 1500 um / (4 * 30 * 64)` of thread. With pi = 355/113 (8e-8 off) that is 8875/7232 um.
const UM_PER_COUNT: (i64, i64) = (8875, 7232);

/// A ratio below 2 with 31 binary places: the chip multiplies to 64 bits in a cycle, and divides them in hundreds.
const fn ratio((numerator, denominator): (i64, i64)) -> i64 {
    ((numerator << 31) + denominator / 2) / denominator
}

const fn rescale(value: i32, ratio: i64) -> i64 {
    (value as i64 * ratio + (1 << 30)) >> 31
}

impl Counts {
    /// Length of thread, rounded to the nearest um.
    pub fn thread(self) -> Thread {
        let um = rescale(self.0, const { ratio(UM_PER_COUNT) });
        Thread(um.clamp(i32::MIN.into(), i32::MAX.into()) as i32)
    }
}

impl Thread {
    /// Encoder counts, rounded to the nearest count.
    pub const fn counts(self) -> Counts {
        // Fewer than there are um, so they fit.
        Counts(rescale(self.0, const { ratio((UM_PER_COUNT.1, UM_PER_COUNT.0)) }) as i32)
    }
}

impl Add for Counts {
    type Output = Self;
    fn add(self, more: Self) -> Self {
        Self(self.0.wrapping_add(more.0))
    }
}

impl Sub for Counts {
    type Output = Self;
    fn sub(self, less: Self) -> Self {
        Self(self.0.wrapping_sub(less.0))
    }
}

/// One reading of the sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sample {
    pub counts: Counts,
    /// Current of the motor: positive winding, opposite sign while braking.
    pub current_ua: i32,
    /// Offset of the shunt amplifier, measured at rest. Already subtracted from the current, unless it is too large.
    pub offset_ma: i16,
    pub battery_mv: u16,
    /// The bridge pulls nFAULT low.
    pub driver_fault: bool,
}

impl Sample {
    /// Magnitude of the current.
    pub fn magnitude_ma(&self) -> u16 {
        ma(self.current_ua).unsigned_abs()
    }
}

/// Factory reading of the chip's reference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reference(u16);

impl Reference {
    /// 1.21 V, the middle of the range: 2.5 % off at most.
    pub const TYPICAL: Self = Self(1_502);

    /// The word in the chip; `None` if it is implausible.
    pub fn from_factory(word: u16) -> Option<Self> {
        FACTORY.contains(&word).then_some(Self(word))
    }

    /// Supply of the ADC in mV for this reading of the reference; `None` if the chip could not run on it.
    pub fn supply_mv(self, reading: u16) -> Option<u32> {
        let reading = u32::from(reading);
        let supply_mv = (FACTORY_MV * u32::from(self.0) + reading / 2).checked_div(reading)?;
        SUPPLY_MV.contains(&supply_mv).then_some(supply_mv)
    }
}

/// Mean voltage at a pin in mV, from the sum of `count` readings.
pub fn millivolts(sum: u32, count: u32, supply_mv: u32) -> u32 {
    let full = FULL * count;
    // 4,095 * 16 * 3,600 fits.
    (sum * supply_mv + full / 2).checked_div(full).unwrap_or(0)
}

/// Measured zero of the shunt amplifier. Kept relative to the half, because it moves with the supply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Zero {
    /// Time of the last reading with the bridge awake; 0 since the reset.
    awake_us: u64,
    /// Mean distance from the half, fine steps times [`AVERAGED`].
    offset: i32,
    readings: i32,
    /// The last reading at rest was far from the mean.
    has_jumped: bool,
}

impl Zero {
    /// Converts a reading in fine steps to a current in uA, positive winding. Measures the zero while the bridge
    /// sleeps. An offset above [`MOST_OFFSET_MA`] is not subtracted, because it is a fault.
    pub fn take_off(&mut self, now_us: u64, awake: bool, reading: i32, supply_mv: u32) -> i32 {
        let from_half = reading - HALF;
        if awake {
            self.awake_us = now_us;
        } else if now_us.saturating_sub(self.awake_us) >= SETTLED_US {
            self.average(from_half);
        }
        let offset = match self.offset_ma(supply_mv).unsigned_abs() {
            ..=MOST_OFFSET_MA => self.offset / AVERAGED,
            _ => 0,
        };
        fine_ua(from_half - offset, supply_mv)
    }

    fn average(&mut self, from_half: i32) {
        let step = from_half * AVERAGED - self.offset;
        let jumps = self.readings > 0 && step.abs() > JUMP * AVERAGED;
        // One reading may be wrong, two are the zero.
        self.has_jumped = jumps && !self.has_jumped;
        if self.has_jumped {
            return;
        }
        if jumps {
            self.readings = 0;
        }
        self.readings = (self.readings + 1).min(AVERAGED);
        self.offset += step / self.readings;
    }

    /// The last reading at rest may be a new zero or a wrong one: the next one tells.
    pub fn is_doubted(&self) -> bool {
        self.has_jumped
    }

    /// Offset at the last settled readings, mA; 0 before the first.
    pub fn offset_ma(&self, supply_mv: u32) -> i16 {
        ma(fine_ua(self.offset / AVERAGED, supply_mv))
    }
}

/// Fine steps to uA: the amplifier gives 1 mV per mA.
fn fine_ua(fine: i32, supply_mv: u32) -> i32 {
    // The input is at most half of the converter's range, 2 V.
    let scaled = i64::from(fine) * i64::from(supply_mv) * 1_000;
    (scaled / (i64::from(FULL) * i64::from(FINE))) as i32
}

/// Rounds uA to mA.
pub fn ma(ua: i32) -> i16 {
    let ma = (ua + 500 * ua.signum()) / 1_000;
    ma.clamp(i16::MIN.into(), i16::MAX.into()) as i16
}
