//! What ends any phase at once. [`Guards::check`] has them in their order, each with the time for which its sign has
//! to last.
//!
//! Three measurements watch one another: the drive orders the voltage, the amplifier measures the current, the encoder
//! counts the speed. They have to agree in `U = R i + k w`.

use crate::readings::{Reading, Readings};
use crate::sample::{Sample, Spooling};
use crate::settings::Settings;
use crate::units::{Counts, Thread};
use protocol::capsule::CapsuleFault;

/// Readings of nFAULT that end a phase: the bridge needs up to 1 ms to wake up (DRV8833).
const DRIVER_READINGS: u8 = 3;
/// Readings of a low battery that end a phase.
const LOW_READINGS: u8 = 15;
/// Below this the cell has collapsed. The chip's own supply falls with it, so that readings mean nothing.
const COLLAPSED_MV: u16 = 2_000;
/// Collapsed readings, not necessarily in a row: a collapse stops the drive, and the cell recovers meanwhile.
const COLLAPSES: u8 = 5;
/// Over-current: twice the current that the speed loop lets a healthy motor draw; braked from full speed it draws 0.4 A.
const OVER_CURRENT_UA: i32 = 450_000;
/// Readings of an over-current that end a phase.
const OVER_READINGS: u8 = 2;
/// Beyond this lies an amplifier whose output is open: its range ends at 1,475 mA at the lowest supply.
const RAIL_UA: i32 = 1_300_000;
/// A real current near that range sags the battery by at least this.
const SHORT_SAG_MV: u16 = 100;
/// Counts in the wrong direction, 0.05 mm, that reveal swapped encoder lines.
const WRONG_WAY_COUNTS: i32 = 40;
/// Counts that make progress: two encoder lines, because one broken channel makes the count flicker by one.
const PROGRESS_COUNTS: i32 = 8;
/// Longest time that a driven motor may make no progress. All of the current is ordered within 40 ms.
pub const STANDSTILL_US: u64 = 50_000;
/// A motor that stands draws at least this share of what its resistance lets through; one that turns, but is not
/// counted, draws less by its back-EMF. Hot copper, a weak cell and the amplifier's gain take most of the rest.
const STALLED_PERCENT: i32 = 80;
/// Below this no current flows: a turning motor draws at least 10 mA.
const NOTHING_UA: i32 = 5_000;
/// Least sag of the battery from a motor that draws current; a cell has at least 0.3 ohm.
const LEAST_SAG_MV: i32 = 15;
/// Readings over which voltage, current and speed are compared: an error of one count is then 0.3 % at 7 mm/s.
const COMPARED: i32 = 64;
/// Minimum speed of a comparison, counts/s: slower ones include the motor's start.
const LEAST_CPS: i32 = 1_200;
/// A motor that counts less than this, counts/s, counts nothing: one broken line flickers by one count.
const UNCOUNTED_CPS: i32 = 400;
/// Time after a start or a brake in which the motor takes up its speed, and its current says nothing.
pub const STEADY_US: u64 = 30_000;
/// Tolerances of a comparison, mA and percent of the current: noise and a drifting zero; bridge, amplifier, and a winding
/// that is 20 K warmer.
const TOLERATED_MA: i32 = 5;
const TOLERATED_PERCENT: i32 = 12;
/// Tolerance in percent of the back-EMF: a magnet that is 20 K warmer gives 2.2 % less.
const BACK_EMF_PERCENT: i32 = 3;
/// Resistance of a good cell, mohm: it is included in the setting `motor_mohm`, and used until it is measured.
pub const CELL_MILLIOHM: i32 = 500;

/// Sums over the readings of one comparison.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    readings: i32,
    drive_mv: i32,
    current_ma: i32,
    began: Option<(Counts, u64)>,
}

/// Means of one comparison: effective voltage at motor and bridge, and how far a sagging cell leaves it open; current
/// and speed.
#[derive(Clone, Copy, Debug)]
pub struct Means {
    motor_mv: i32,
    open_mv: i32,
    /// Current, mA.
    pub current_ma: i32,
    cps: i32,
}

impl Means {
    /// Back-EMF constant, uV per count per second.
    pub fn back_emf_uv_cps(&self, settings: &Settings) -> Option<i32> {
        let back_mv =
            self.motor_mv - self.current_ma * (settings.loop_milliohm - CELL_MILLIOHM) / 1_000;
        (back_mv * 1_000).checked_div(self.cps)
    }

    /// Voltage, current and speed contradict each other.
    fn disagree(&self, back_emf_uv_cps: i32, settings: &Settings) -> bool {
        let back_mv = self.cps.min(100_000) * back_emf_uv_cps / 1_000;
        let of = |mv: i32| mv * 1_000 / (settings.loop_milliohm - CELL_MILLIOHM).max(1);
        let expected_ma = of(self.motor_mv - back_mv);
        let percent_ma = self.current_ma.abs().max(expected_ma.abs()) * TOLERATED_PERCENT / 100;
        let tolerated_ma =
            TOLERATED_MA + percent_ma + of(self.open_mv) + of(back_mv) * BACK_EMF_PERCENT / 100;
        (self.current_ma - expected_ma).abs() > tolerated_ma
    }
}

/// Watches one phase.
#[derive(Clone, Debug)]
pub struct Guards {
    spooling: Spooling,
    rest_mv: u16,
    readings: Readings,
    /// Furthest count so far, and the time at which it was reached.
    furthest: Option<(Counts, u64)>,
    steady_from_us: u64,
    driver: u8,
    over: u8,
    low: u8,
    collapses: u8,
    /// The last meaningful voltage below the limit.
    sagged_mv: u16,
    sums: Sums,
    /// The last comparison.
    pub means: Option<Means>,
}

/// Counts a sign as long as it lasts.
pub fn lasts(count: &mut u8, holds: bool, readings: u8) -> bool {
    *count = if holds { count.saturating_add(1) } else { 0 };
    *count >= readings
}

impl Guards {
    /// Watches a phase whose drive begins at `from_us`. `rest_mv` is the battery voltage without load.
    pub fn new(spooling: Spooling, from_us: u64, rest_mv: u16) -> Self {
        Self {
            spooling,
            rest_mv,
            readings: Readings::default(),
            furthest: None,
            steady_from_us: from_us + STEADY_US,
            driver: 0,
            over: 0,
            low: 0,
            collapses: 0,
            sagged_mv: COLLAPSED_MV,
            sums: Sums::default(),
            means: None,
        }
    }

    /// The speed over the last 8 ms, and the lowest value that it may have reached in the last 3 ms, counts/s.
    pub fn speeds_cps(&self) -> (i32, i32) {
        let cps = self.readings.speed_cps(usize::MAX - 1);
        (cps, cps.min(self.readings.speed_cps(3)))
    }

    /// Mean current of the last readings, uA, if all of them were driven and the motor is at its speed.
    pub fn steady_ua(&self, now_us: u64) -> Option<i32> {
        let (current_ua, ..) = self.readings.driven()?;
        (now_us >= self.steady_from_us).then_some(current_ua)
    }

    /// Takes a reading. `drive_mv` was ordered before it, in the direction of the phase; none while braking. Returns
    /// true if the motor stands although it is driven.
    ///
    /// # Errors
    /// The fault that ends the phase.
    pub fn check(
        &mut self,
        now_us: u64,
        sample: &Sample,
        drive_mv: Option<i16>,
        back_emf_uv_cps: i32,
        settings: &Settings,
    ) -> Result<bool, CapsuleFault> {
        let along = Counts(self.spooling.along(sample.counts.0));
        let current_ua = self.spooling.along(sample.current_ua);
        let battery_mv = sample.battery_mv;
        let reading = Reading {
            at_us: now_us,
            along,
            current_ua,
            drive_mv,
            battery_mv,
        };
        self.readings.push(reading);
        if lasts(&mut self.driver, sample.driver_fault, DRIVER_READINGS) {
            return Err(CapsuleFault::DriverFault);
        }
        if self.is_open(&reading) {
            return Err(CapsuleFault::SenseLost);
        }
        // More than any healthy motor draws; braked or driven backwards it may draw more.
        let over = !(-2 * OVER_CURRENT_UA..=OVER_CURRENT_UA).contains(&current_ua);
        if lasts(&mut self.over, over, OVER_READINGS) {
            let current_ma = sample.magnitude_ma();
            return Err(CapsuleFault::OverCurrent { current_ma });
        }
        let low = battery_mv < settings.loaded_battery_mv;
        let collapsed = battery_mv < COLLAPSED_MV;
        self.collapses = self.collapses.saturating_add(u8::from(collapsed));
        if low && !collapsed {
            self.sagged_mv = battery_mv;
        }
        if lasts(&mut self.low, low, LOW_READINGS) || self.collapses >= COLLAPSES {
            let battery_mv = self.sagged_mv;
            return Err(CapsuleFault::LowBattery { battery_mv });
        }
        let (furthest, since_us) = *self.furthest.get_or_insert((along, now_us));
        let progress = (along - furthest).0;
        if progress <= -WRONG_WAY_COUNTS {
            return Err(CapsuleFault::EncoderLost);
        }
        if self.compare(&reading) {
            let means = self.means.filter(|means| means.cps >= LEAST_CPS);
            if means.is_some_and(|means| means.disagree(back_emf_uv_cps, settings)) {
                return Err(self.name_of_contradiction());
            }
        }
        if progress >= PROGRESS_COUNTS {
            self.furthest = Some((along, now_us));
        } else if now_us.saturating_sub(since_us) >= STANDSTILL_US {
            return self.name_of_standstill(settings).map_or(Ok(true), Err);
        }
        Ok(false)
    }

    /// The amplifier's output lies at 0 V, which reads as a current that no motor draws. While winding, it is against
    /// the drive; while paying out, the battery does not sag as it would under a real one.
    fn is_open(&self, reading: &Reading) -> bool {
        match self.spooling {
            Spooling::Wind => reading.current_ua < -RAIL_UA,
            Spooling::PayOut => {
                let sag_mv = self.rest_mv.saturating_sub(reading.battery_mv);
                reading.current_ua > RAIL_UA && sag_mv < SHORT_SAG_MV
            }
        }
    }

    /// Adds a reading to the comparison. True if one is complete.
    fn compare(&mut self, reading: &Reading) -> bool {
        let Some(drive_mv) = reading.drive_mv else {
            self.steady_from_us = reading.at_us + STEADY_US;
            self.sums = Sums::default();
            return false;
        };
        if reading.at_us < self.steady_from_us {
            return false;
        }
        let Some((began, began_us)) = self.sums.began else {
            self.sums.began = Some((reading.along, reading.at_us));
            return false;
        };
        self.sums.readings += 1;
        self.sums.drive_mv += i32::from(drive_mv);
        self.sums.current_ma += reading.current_ua / 1_000;
        if self.sums.readings < COMPARED {
            return false;
        }
        let mean_mv = self.sums.drive_mv / self.sums.readings;
        // In the pulses the battery sags below the mean voltage that the duty is made for, by all of the sag if that is
        // the cell's resistance, by nothing if the cell has polarised. Take half, and leave the other half open.
        let battery_mv = i32::from(reading.battery_mv).max(1);
        let pause = 1_000 - mean_mv.clamp(0, battery_mv) * 1_000 / battery_mv;
        let open_mv = i32::from(self.rest_mv.saturating_sub(reading.battery_mv)) * pause / 2_000;
        self.means = Some(Means {
            motor_mv: mean_mv - open_mv,
            open_mv,
            current_ma: self.sums.current_ma / self.sums.readings,
            cps: reading.speed_since(began, began_us),
        });
        self.sums = Sums::default();
        true
    }

    /// Whether no current flows although it is driven: then the bridge or the amplifier is broken.
    fn silent(&self) -> Option<CapsuleFault> {
        let (current_ua, _, battery_mv) = self.readings.driven()?;
        let fault = match i32::from(self.rest_mv) - battery_mv {
            LEAST_SAG_MV.. => CapsuleFault::SenseLost,
            _ => CapsuleFault::BridgeSilent,
        };
        // A motor that is not counted is driven with too little, and its current passes zero.
        let flows = self.readings.most_ua() >= 2 * NOTHING_UA;
        (current_ua.abs() < NOTHING_UA && !flows).then_some(fault)
    }

    /// Names what contradicts the two others, where the last readings tell.
    fn name_of_contradiction(&self) -> CapsuleFault {
        let counts_nothing = self.readings.speed_cps(3).abs() < UNCOUNTED_CPS;
        self.silent().unwrap_or(match counts_nothing {
            true => CapsuleFault::EncoderLost,
            false => CapsuleFault::SenseOrEncoder,
        })
    }

    /// Names why a driven motor stands; none if something holds it.
    fn name_of_standstill(&self, settings: &Settings) -> Option<CapsuleFault> {
        if let Some(fault) = self.silent() {
            return Some(fault);
        }
        // Driven and braked by turns: it is held.
        let (current_ua, drive_mv, _) = self.readings.driven()?;
        let stalled_ma = drive_mv * 1_000 / settings.loop_milliohm.max(1);
        let is_held = current_ua / 10 >= stalled_ma * STALLED_PERCENT;
        (!is_held).then_some(CapsuleFault::EncoderLost)
    }
}

/// Way that a motor at this speed runs on if it is shorted now: its time constant with the bridge's 0.6 ohm in the
/// loop, 6.9 ms, less a tenth for friction, plus 1 ms between two samples.
pub fn runs_on(cps: i32) -> Thread {
    const STOPS_US: i64 = 7_300;
    let counts = i64::from(cps.max(0)) * STOPS_US / 1_000_000;
    Counts(counts as i32).thread()
}
