//! From what the ADC reads to volts and amperes.
//!
//! The ADC measures against its supply, and a linear regulator's output falls with an empty cell: 3,300 mV is what the
//! supply should be, not what it is. The chip's own reference does not fall with it, so one more conversion tells.
//!
//! The shunt carries the motor's current in both directions, so its amplifier shows zero at half of its supply. With the bridge asleep
//! no current flows, so what the amplifier shows then is its zero, and one that lies elsewhere is a wrong or broken amplifier.

use core::ops::RangeInclusive;

/// Full scale of the 12-bit ADC.
const FULL: u32 = 4_095;
/// Supply to which the factory's reading of the reference is converted.
const FACTORY_MV: u32 = 3_300;
/// What the factory may have read then: 1.18 to 1.24 V (DS10314 table 74), and 1 % for its own error.
const FACTORY: RangeInclusive<u16> = 1_450..=1_555;
/// 1.21 V, the middle: 2.5 % off at most.
const TYPICAL: u16 = 1_502;
/// Outside of this the chip does not work, so it was not the supply that was measured (DS10314 table 14).
const SUPPLY_MV: RangeInclusive<u32> = 1_700..=3_600;

/// The largest offset of the shunt amplifier that is taken off: 0.9 N of thread force.
pub const MOST_OFFSET_MA: u16 = 20;
/// The bridge has slept so long: the motor's current is gone, and the amplifier's filter (0.1 ms) has settled.
const SETTLED_US: u64 = 10_000;

/// The chip's reference, as the factory read it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reference(u16);

impl Reference {
    /// From the word that the factory has left in the chip, and the supply at which it was read; `None` if it cannot be one.
    pub fn from_factory(word: u16, supply_mv: u32) -> Option<Self> {
        let word = (u32::from(word) * supply_mv + FACTORY_MV / 2) / FACTORY_MV;
        let word = u16::try_from(word).ok()?;
        FACTORY.contains(&word).then_some(Self(word))
    }

    /// The reference of a chip without a word.
    pub const fn typical() -> Self {
        Self(TYPICAL)
    }

    /// Supply of the ADC in mV, if it now reads its reference as `reading`. `None` if the chip could not run on that.
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

/// Parts of a step of the converter in which means of several readings are kept.
pub const FINE: i32 = 16;
/// Half of the amplifier's supply, which is the converter's too.
const HALF: i32 = FULL as i32 * FINE / 2;

/// The shunt amplifier's zero. It lies at half of its supply, and moves with it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Zero {
    asleep_since_us: Option<u64>,
    /// Mean distance from the half, in fine steps times [`AVERAGED`].
    offset: i32,
    readings: i32,
}

/// A reading so far from the mean is not noise: 10 mA.
const JUMP: i32 = 200;
/// The mean is taken over about so many readings at rest. One reading has noise, which would be in all readings of a motion.
const AVERAGED: i32 = 32;

impl Zero {
    /// Takes a reading in fine steps, with the bridge awake or asleep, and returns the current in uA, positive winding. An offset
    /// above [`MOST_OFFSET_MA`] is not one, and stays in the reading.
    pub fn take_off(&mut self, now_us: u64, awake: bool, reading: i32, supply_mv: u32) -> i32 {
        let from_half = reading - HALF;
        if awake {
            self.asleep_since_us = None;
        } else {
            let since_us = *self.asleep_since_us.get_or_insert(now_us);
            if now_us.saturating_sub(since_us) >= SETTLED_US {
                self.average(from_half);
            }
        }
        let current = if self.offset_ma(supply_mv).unsigned_abs() > MOST_OFFSET_MA {
            from_half
        } else {
            from_half - self.offset / AVERAGED
        };
        fine_ua(current, supply_mv)
    }

    fn average(&mut self, from_half: i32) {
        let step = from_half * AVERAGED - self.offset;
        if step.abs() > JUMP * AVERAGED {
            self.readings = 0;
        }
        self.readings = (self.readings + 1).min(AVERAGED);
        self.offset += step / self.readings;
    }

    /// As it was at the last settled readings, mA; 0 before the first.
    pub fn offset_ma(&self, supply_mv: u32) -> i16 {
        ma(fine_ua(self.offset / AVERAGED, supply_mv))
    }
}

/// 1 mV per mA.
fn fine_ua(fine: i32, supply_mv: u32) -> i32 {
    // At most half of the converter's range, 2 V.
    let scaled = i64::from(fine) * i64::from(supply_mv) * 1_000;
    (scaled / (i64::from(FULL) * i64::from(FINE))) as i32
}

/// Rounded to mA.
pub fn ma(ua: i32) -> i16 {
    let ma = (ua + 500 * ua.signum()) / 1_000;
    ma.clamp(i16::MIN.into(), i16::MAX.into()) as i16
}
