//! From what the ADC reads to volts and amperes.
//!
//! The ADC measures against its supply, and a linear regulator's output falls with an empty cell: 3,300 mV is what the
//! supply should be, not what it is. The chip's own reference does not fall with it, so one more conversion tells.
//!
//! The shunt amplifier's offset counts as current in every reading. With the bridge asleep no current flows, so what
//! the amplifier shows then is its offset, and an offset that is too large is a wrong or broken amplifier.

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
    microvolts(sum, count, supply_mv).saturating_add(500) / 1_000
}

/// The same in uV.
pub fn microvolts(sum: u32, count: u32, supply_mv: u32) -> u32 {
    let full = u64::from(FULL * count);
    // 4,095 * 10 * 3,600,000 fits.
    let scaled = u64::from(sum) * u64::from(supply_mv) * 1_000 + full / 2;
    // At most the supply.
    scaled.checked_div(full).unwrap_or(0) as u32
}

/// The shunt amplifier's offset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Offset {
    asleep_since_us: Option<u64>,
    mean_ua: u32,
    readings: u32,
}

/// A reading so far from the mean is not noise.
const JUMP_UA: u32 = 10_000;
/// The mean is taken over about so many readings at rest. One reading has noise, which would be in all readings of a motion.
const AVERAGED: u32 = 32;

impl Offset {
    /// Takes a reading of the current in uA, with the bridge awake or asleep, and returns it without the offset. An offset
    /// above [`MOST_OFFSET_MA`] is not one, and stays in the reading.
    pub fn take_off(&mut self, now_us: u64, awake: bool, reading_ua: u32) -> u32 {
        if awake {
            self.asleep_since_us = None;
        } else {
            let since_us = *self.asleep_since_us.get_or_insert(now_us);
            if now_us.saturating_sub(since_us) >= SETTLED_US {
                self.average(reading_ua);
            }
        }
        if self.offset_ma() > MOST_OFFSET_MA {
            return reading_ua;
        }
        reading_ua.saturating_sub(self.mean_ua)
    }

    fn average(&mut self, reading_ua: u32) {
        if self.mean_ua.abs_diff(reading_ua) > JUMP_UA {
            self.readings = 0;
        }
        self.readings = (self.readings + 1).min(AVERAGED);
        let step = (i64::from(reading_ua) - i64::from(self.mean_ua)) / i64::from(self.readings);
        // Between the mean and the reading: fits.
        self.mean_ua = (i64::from(self.mean_ua) + step) as u32;
    }

    /// As it was at the last settled readings; 0 before the first.
    pub fn offset_ma(&self) -> u16 {
        u16::try_from((self.mean_ua + 500) / 1_000).unwrap_or(u16::MAX)
    }
}
