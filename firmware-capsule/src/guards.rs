//! What ends any phase at once: [`Guards::check`] has the signs in their order. The drive orders the voltage, the
//! amplifier measures the current, the encoder counts the speed: they watch one another by `U = R i + k w`.

use crate::sense::{Counts, Sample};
use crate::settings::Settings;
use crate::speed::{Drive, MOST_MA};
use crate::units::{Spooling, Thread};
use heapless::Deque;
use protocol::capsule::CapsuleFault;

/// Readings in a row of nFAULT, or of an over-current, that end a phase: the bridge takes up to 1 ms to wake (DRV8833).
const LASTS: u8 = 2;
/// Readings of a low battery that end a phase, also one by one: a collapse stops the drive, and the cell recovers.
const LOW_READINGS: u8 = 15;
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
/// Readings over which a current is averaged.
pub const MEAN: usize = 8;
/// Readings over which voltage, current and speed are compared: an error of one count is then 0.3 % at 7 mm/s.
const COMPARED: usize = 64;
/// Readings after a start or a brake in which the motor takes up its speed, and its current says nothing.
const UNSTEADY: usize = 30;
/// Tolerated difference of currents, mA: noise and a drifting zero.
const TOLERATED_MA: i32 = 5;
/// Tolerated difference in percent of the current: bridge, amplifier, and a winding that is 20 K warmer.
const TOLERATED_PERCENT: i32 = 12;
/// Tolerance in percent of the back-EMF: a magnet that is 20 K warmer gives 2.2 % less.
const BACK_EMF_PERCENT: i32 = 3;
/// Resistance of a good cell, mohm: it is included in the setting `motor_mohm`.
const CELL_MILLIOHM: i32 = 500;
/// Speed of the motor over the way that it runs on if it is shorted: its time constant with the bridge's 0.6 ohm in the
/// loop, 6.9 ms, less a tenth for friction, plus 1 ms between two samples, is 1 s / 137.
const STOPS_PER_S: i32 = 137;

/// One reading with the drive before it. The phase's direction counts as positive.
#[derive(Clone, Copy, Debug, Default)]
struct Reading {
    at_us: u64,
    along: Counts,
    /// Negative if it brakes.
    current_ua: i32,
    /// Duty times battery voltage; 0 while braking.
    drive_mv: i32,
    battery_mv: i32,
}

#[derive(Clone, Debug, Default)]
pub struct Guards {
    spooling: Spooling,
    /// Battery voltage without load.
    rest_mv: i32,
    /// With the back-EMF of this motor.
    settings: Settings,
    /// As many as make [`COMPARED`] intervals.
    readings: Deque<Reading, { COMPARED + 1 }>,
    /// Driven readings since the last brake, less those that a comparison has used.
    driven: usize,
    /// Furthest count so far, and the time at which it was reached.
    furthest: Option<(Counts, u64)>,
    /// Readings in a row of nFAULT and of an over-current, and all of a low battery.
    driver: u8,
    over: u8,
    low: u8,
    /// Back-EMF of the motor in the first comparison, uV per count per second.
    pub back_emf: Option<u16>,
}

impl Guards {
    /// Watches a phase in this direction.
    pub fn new(spooling: Spooling, rest_mv: u16, settings: Settings) -> Self {
        Self {
            spooling,
            rest_mv: rest_mv.into(),
            settings,
            ..Self::default()
        }
    }

    /// Speed over the last intervals, counts/s.
    fn cps(&self, intervals: usize) -> i32 {
        let first = self.readings.len().saturating_sub(intervals + 1);
        let (Some(first), Some(last)) = (self.readings.get(first), self.readings.back()) else {
            return 0;
        };
        let elapsed_us = i32::try_from(last.at_us.saturating_sub(first.at_us)).unwrap_or(i32::MAX);
        // The chip divides 32 bits in 12 cycles. 2,000 counts within 64 ms are beyond any motor.
        let counts = (last.along - first.along).0.clamp(-2_000, 2_000);
        (counts * 1_000_000).checked_div(elapsed_us).unwrap_or(0)
    }

    /// The speed over the last 8 ms, and the lowest value that it may have reached in the last 3 ms, counts/s.
    pub fn speeds_cps(&self) -> (i32, i32) {
        let cps = self.cps(MEAN);
        (cps, cps.min(self.cps(3)))
    }

    /// Way that the motor runs on if it is shorted now.
    pub fn runs_on(&self) -> Thread {
        Counts(self.cps(MEAN).max(0) / STOPS_PER_S).thread()
    }

    /// Mean current, uA, drive and battery, mV, of the last readings; none unless all of them were driven.
    fn means(&self, count: usize) -> Option<[i32; 3]> {
        let mut sums = [0; 3];
        for of in self.readings.iter().rev().take(count) {
            let values = [of.current_ua, of.drive_mv, of.battery_mv];
            sums = core::array::from_fn(|index| sums[index] + values[index]);
        }
        (self.driven >= count).then(|| sums.map(|sum| sum / count as i32))
    }

    /// Mean current of the last readings, uA, if the motor is at its speed.
    pub fn steady_ua(&self) -> Option<i32> {
        let [current_ua, ..] = self.means(MEAN)?;
        (self.driven >= UNSTEADY).then_some(current_ua)
    }

    /// Takes a reading and the drive before it. Returns true if the motor stands although it is driven.
    ///
    /// # Errors
    /// The fault that ends the phase.
    pub fn check(&mut self, now_us: u64, new: &Sample, drive: Drive) -> Result<bool, CapsuleFault> {
        let along = Counts(self.spooling.along(new.counts.0));
        let current_ua = self.spooling.along(new.current_ua);
        let drive_mv = drive.millivolts().unwrap_or(0);
        if self.readings.is_full() {
            self.readings.pop_front();
        }
        let _ = self.readings.push_back(Reading {
            at_us: now_us,
            along,
            current_ua,
            drive_mv: self.spooling.along(drive_mv.into()),
            battery_mv: new.battery_mv.into(),
        });
        self.driven = drive.millivolts().map_or(0, |_| self.driven + 1);
        self.driver = (self.driver + 1) * u8::from(new.driver_fault);
        if self.driver >= LASTS {
            return Err(CapsuleFault::DriverFault);
        }
        // Twice the current that the speed loop orders. A braked motor may draw twice as much.
        let over_ua = 2_000 * i32::from(MOST_MA);
        let is_over = !(-2 * over_ua..=over_ua).contains(&current_ua);
        self.over = (self.over + 1) * u8::from(is_over);
        if self.over >= LASTS {
            // An amplifier whose output is open reads as a current against the drive while winding. While paying out,
            // the battery does not sag as it would under a real current.
            let sags = self.rest_mv - i32::from(new.battery_mv) >= LEAST_SAG_MV;
            let is_real = current_ua > 0 && (self.spooling == Spooling::Wind || sags);
            let current_ma = new.magnitude_ma();
            return Err(match is_real {
                true => CapsuleFault::OverCurrent { current_ma },
                false => CapsuleFault::SenseLost,
            });
        }
        let battery_mv = new.battery_mv;
        self.low += u8::from(battery_mv < self.settings.loaded_battery_mv);
        if self.low >= LOW_READINGS {
            return Err(CapsuleFault::LowBattery { battery_mv });
        }
        let (furthest, since_us) = *self.furthest.get_or_insert((along, now_us));
        let progress = (along - furthest).0;
        if progress <= -WRONG_WAY_COUNTS {
            return Err(CapsuleFault::EncoderLost);
        }
        if progress >= PROGRESS_COUNTS {
            self.furthest = Some((along, now_us));
            self.compare()?;
        } else if now_us.saturating_sub(since_us) >= STANDSTILL_US {
            return self.name_of_standstill().map_or(Ok(true), Err);
        }
        Ok(false)
    }

    /// Compares voltage, current and speed of a motor that makes progress, each [`COMPARED`] readings.
    fn compare(&mut self) -> Result<(), CapsuleFault> {
        if self.driven < UNSTEADY + COMPARED {
            return Ok(());
        }
        let (Some([current_ua, drive_mv, battery_mv]), cps @ 1..) =
            (self.means(COMPARED), self.cps(COMPARED))
        else {
            return Ok(());
        };
        self.driven -= COMPARED;
        // In the pulses the battery sags below the mean voltage that the duty is made for, by all of the sag if that is
        // the cell's resistance, by nothing if the cell has polarised. Take half, and leave the other half open.
        let battery_mv = battery_mv.max(1);
        let pause = 1_000 - drive_mv.clamp(0, battery_mv) * 1_000 / battery_mv;
        let open_mv = (self.rest_mv - battery_mv).max(0) * pause / 2_000;
        let (motor_mv, current_ma) = (drive_mv - open_mv, current_ua / 1_000);
        let milliohm = (self.settings.loop_milliohm - CELL_MILLIOHM).max(1);
        let back_mv = cps.min(100_000) * self.settings.back_emf_uv_per_cps / 1_000;
        let of = |mv: i32| mv * 1_000 / milliohm;
        let expected_ma = of(motor_mv - back_mv);
        let percent_ma = current_ma.abs().max(expected_ma.abs()) * TOLERATED_PERCENT / 100;
        let tolerated_ma =
            TOLERATED_MA + percent_ma + of(open_mv) + of(back_mv) * BACK_EMF_PERCENT / 100;
        if (current_ma - expected_ma).abs() > tolerated_ma {
            return Err(self.silent().unwrap_or(CapsuleFault::SenseOrEncoder));
        }
        let measured_mv = motor_mv - current_ma * milliohm / 1_000;
        let measured = u16::try_from(measured_mv * 1_000 / cps).ok();
        self.back_emf = self.back_emf.or(measured);
        Ok(())
    }

    /// Names what is broken if no current flows although the motor is driven: the bridge or the amplifier.
    fn silent(&self) -> Option<CapsuleFault> {
        let [current_ua, _, battery_mv] = self.means(MEAN)?;
        // A motor that is not counted is driven with too little, and its current passes zero.
        let mut last = self.readings.iter().rev().take(MEAN);
        let flows = current_ua.abs() >= NOTHING_UA
            || last.any(|reading| reading.current_ua.abs() >= 2 * NOTHING_UA);
        let fault = match self.rest_mv - battery_mv {
            LEAST_SAG_MV.. => CapsuleFault::SenseLost,
            _ => CapsuleFault::BridgeSilent,
        };
        (!flows).then_some(fault)
    }

    /// Names why a driven motor stands; none if something holds it.
    fn name_of_standstill(&self) -> Option<CapsuleFault> {
        // Driven and braked by turns: it is held.
        let [current_ua, drive_mv, _] = self.means(MEAN)?;
        let stalled_ma = drive_mv * 1_000 / self.settings.loop_milliohm.max(1);
        let is_held = current_ua / 10 >= stalled_ma * STALLED_PERCENT;
        (self.silent()).or((!is_held).then_some(CapsuleFault::EncoderLost))
    }
}
