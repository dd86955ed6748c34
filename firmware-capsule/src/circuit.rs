//! Plausibility check of the motor's voltage, current and speed, which have to agree: `U = R i + k w`.
//!
//! The drive orders the voltage, the amplifier measures the current, the encoder counts the speed. An encoder that
//! loses counts shows too little speed for the voltage. An amplifier with too little gain or a shifted zero shows the
//! wrong current. One equation cannot tell the two apart, so they share one fault.
//!
//! The equation is linear, so it also holds for means over any time in which the motor is driven, even while it
//! accelerates.

use crate::{mechanics::Counts, settings::Settings};

/// Readings per comparison: at 11 mm/s these are 450 counts, so that an error of one count is 0.2 %.
const READINGS: i32 = 48;
/// Successive comparisons that must disagree before a running motion faults.
const IN_A_ROW: u8 = 2;
/// Minimum readings for a comparison that the end of a motion cuts short.
const LEAST_READINGS: i32 = 16;
/// Minimum speed of a comparison, counts/s: slower ones include the motor's start.
const LEAST_CPS: i32 = 1_500;
/// Cell resistance included in the setting `motor_mohm`, mohm.
const CELL_MILLIOHM: i32 = 500;
/// Tolerance for noise, the duty's rounding to 21 mV and a drifting zero, mA.
const NOISE_MA: i32 = 4;
/// Tolerance in percent of the current: 4 % for the bridge and the amplifier, 8 % for a winding that is 20 K warmer.
const RESISTANCE_PERCENT: i32 = 12;
/// Tolerances in percent of the back-EMF. A magnet that is 20 K warmer gives 2.2 % less, so that more current flows
/// than the measured constant predicts. Nothing makes it give more.
const MORE_PERCENT: i32 = 3;
const LESS_PERCENT: i32 = 1;
/// Largest current at which the motor constant is measured, mA: with little current the resistance matters little.
const LIGHT_MA: i32 = 45;
/// Largest plausible deviation of a measured constant from the setting, percent.
const POSSIBLE_PERCENT: u32 = 20;

/// One reading; the leg's direction counts as positive.
#[derive(Clone, Copy, Debug)]
pub struct Reading {
    /// Drive up to this reading, mV.
    pub drive_mv: i16,
    /// Current, uA.
    pub current_ua: i32,
    /// Encoder counts in the direction of the leg.
    pub along: Counts,
    /// Battery under load, mV.
    pub battery_mv: u16,
    /// Battery voltage at rest less `battery_mv`, mV.
    pub sag_mv: u16,
    /// Time of the reading.
    pub at_us: u64,
}

/// Sums over the readings of one comparison.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    readings: i32,
    drive_mv: i32,
    current_ua: i32,
    began: Counts,
    began_us: u64,
}

/// Means over the readings of one comparison.
#[derive(Clone, Copy, Debug)]
struct Means {
    drive_mv: i32,
    current_ma: i32,
    cps: i32,
    /// Expected sag of the pulses below the mean voltage that the duty is made for. It may be off by its own size.
    pulses_sag_mv: i32,
    milliohm: i32,
}

/// Compares voltage, current and speed over a leg.
#[derive(Clone, Debug, Default)]
pub struct Circuit {
    sums: Sums,
    last: Option<Reading>,
    /// Comparisons in a row that disagree, with the sign of the excess current.
    against: i8,
    /// Sum and number of the measured motor constants, uV per count/s.
    constant: (u32, u32),
}

impl Circuit {
    /// Takes a reading; `None` if the motor is not driven or was braked just now. Returns true if the last
    /// comparisons disagree.
    pub fn take(
        &mut self,
        reading: Option<Reading>,
        known_uv_cps: u16,
        settings: &Settings,
    ) -> bool {
        let Some(reading) = reading else {
            (self.sums, self.last) = (Sums::default(), None);
            return false;
        };
        self.last = Some(reading);
        if self.sums.began_us == 0 {
            (self.sums.began, self.sums.began_us) = (reading.along, reading.at_us);
            return false;
        }
        self.sums.readings += 1;
        self.sums.drive_mv += i32::from(reading.drive_mv);
        self.sums.current_ua += reading.current_ua;
        if self.sums.readings < READINGS {
            return false;
        }
        let means = self.means(settings);
        self.sums = Sums {
            began: reading.along,
            began_us: reading.at_us,
            ..Sums::default()
        };
        let Some(means) = means else {
            return false;
        };
        self.add_constant(&means);
        let sign = means.disagrees(known_uv_cps, settings);
        self.against = match sign {
            0 => 0,
            _ if self.against.signum() == sign => self.against.saturating_add(sign),
            _ => sign,
        };
        self.against.unsigned_abs() >= IN_A_ROW
    }

    /// Verdict when a motion is about to end: the present comparison disagrees, or the one before if this one is too
    /// short.
    pub fn disagrees_now(&self, known_uv_cps: u16, settings: &Settings) -> bool {
        if self.sums.readings < LEAST_READINGS {
            return self.against != 0;
        }
        self.means(settings)
            .is_some_and(|means| means.disagrees(known_uv_cps, settings) != 0)
    }

    /// Motor constant measured by the comparisons with little current, uV per count/s; 0 if there was none.
    pub fn constant_uv_cps(&self) -> u16 {
        let (sum, count) = self.constant;
        u16::try_from(sum.checked_div(count).unwrap_or(0)).unwrap_or(u16::MAX)
    }

    /// Accepts a constant that is close to the setting, and 0, which means not measured.
    pub fn is_possible(constant_uv_cps: u16, settings: &Settings) -> bool {
        let known = settings.back_emf_uv_per_cps;
        constant_uv_cps == 0
            || u32::from(constant_uv_cps).abs_diff(known) * 100 <= known * POSSIBLE_PERCENT
    }

    fn add_constant(&mut self, means: &Means) {
        let back_mv =
            means.drive_mv - means.pulses_sag_mv - means.current_ma * means.milliohm / 1_000;
        if (0..=LIGHT_MA).contains(&means.current_ma) && means.cps >= LEAST_CPS && back_mv > 0 {
            let uv_cps = back_mv.unsigned_abs() * 1_000 / means.cps.unsigned_abs();
            self.constant = (self.constant.0 + uv_cps.min(10_000), self.constant.1 + 1);
        }
    }

    fn means(&self, settings: &Settings) -> Option<Means> {
        let last = self.last?;
        let elapsed_us = i32::try_from(last.at_us.checked_sub(self.sums.began_us)?).ok()?;
        let counts = last.along.since(self.sums.began).0;
        let cps = counts.checked_mul(1_000_000)?.checked_div(elapsed_us)?;
        let drive_mv = self.sums.drive_mv.checked_div(self.sums.readings)?;
        // In the pulses the battery sags below the mean voltage that the duty is made for.
        let battery_mv = i32::from(last.battery_mv).max(1);
        let duty = (drive_mv.clamp(0, battery_mv) * 1_000) / battery_mv;
        Some(Means {
            drive_mv,
            current_ma: self.sums.current_ua / self.sums.readings / 1_000,
            cps,
            pulses_sag_mv: (1_000 - duty) * i32::from(last.sag_mv) / 2_000,
            milliohm: settings.loop_milliohm as i32 - CELL_MILLIOHM,
        })
    }
}

impl Means {
    /// 0 if they agree; otherwise the sign of the excess current.
    fn disagrees(&self, known_uv_cps: u16, settings: &Settings) -> i8 {
        if self.cps < LEAST_CPS {
            return 0;
        }
        let constant = match known_uv_cps {
            0 => settings.back_emf_uv_per_cps as i32,
            known => i32::from(known),
        };
        let back_mv = self.cps.min(100_000) * constant / 1_000;
        let of = |mv: i32| mv * 1_000 / self.milliohm.max(1);
        let expected_ma = of(self.drive_mv - self.pulses_sag_mv - back_mv);
        let least_ma = self.current_ma.abs().max(expected_ma.abs());
        // The cell's resistance makes all of the sag occur in the pulses. A cell that has polarised or collapses sags
        // all the time. Tolerate both.
        let resistance_ma = least_ma * RESISTANCE_PERCENT / 100 + of(self.pulses_sag_mv);
        let tolerated_ma = |percent| NOISE_MA + resistance_ma + of(back_mv) * percent / 100;
        match self.current_ma - expected_ma {
            more if more > tolerated_ma(MORE_PERCENT) => 1,
            less if -less > tolerated_ma(LESS_PERCENT) => -1,
            _ => 0,
        }
    }
}
