//! Keeps the record of the present or last actuation: duration, currents, energy, how it ended. [`trace`] has its
//! readings.

pub mod trace;

use crate::sense::Sample;
use crate::units::Thread;
use protocol::capsule::{ActuationKind, ActuationOutcome, ActuationRecord};

/// Unit of the energy counter, fJ: fine enough to need no division per reading. A fold has 2.4e14 of them.
const FJ_PER_MJ: u64 = 1_000_000_000_000;
/// Resolution of the duty: parts of a PWM period.
const SHARE: u32 = 1_024;
/// Largest current that the amplifier can show, uA.
const MOST_UA: i32 = 2_000_000;
/// Rise of the current in the pulses, uA per volt. R T2 / 12 L2 with 6.2 ohm, 12.5 us and 53 uH is 28.7 mA/V.
/// Subtracted: the ripple's heat in the cell and the error of summing periods of one duty (fitted to the plant).
const RISE_UA_PER_V: u32 = 26_300;
/// Current above the no-load current at which the thread pulls: 0.3 N.
const ENGAGED_MA: i32 = 7;
/// Time of winding from which that counts: until then the current may accelerate the motor.
const ENGAGES_US: u64 = 150_000;

/// Fills an [`ActuationRecord`] while the actuation runs.
#[derive(Clone, Debug)]
pub(crate) struct Recorder {
    /// Without duration and energy, which are counted more finely.
    pub(crate) record: ActuationRecord,
    started_us: u64,
    /// Time of the last sample.
    at_us: u64,
    energy_fj: u64,
}

impl Default for Recorder {
    /// The state before the first actuation.
    fn default() -> Self {
        Self {
            record: ActuationRecord {
                actuation: 0,
                kind: ActuationKind::Reference,
                outcome: ActuationOutcome::None,
                duration_ms: 0,
                thread_um: 0,
                end_current_ma: 0,
                peak_current_ma: 0,
                engaged_um: 0,
                energy_mj: 0,
                min_battery_mv: 0,
            },
            started_us: 0,
            at_us: 0,
            energy_fj: 0,
        }
    }
}

impl Recorder {
    /// The record so far.
    pub(crate) fn record(&self) -> ActuationRecord {
        let energy_mj = self.energy_fj.saturating_add(FJ_PER_MJ / 2) / FJ_PER_MJ;
        ActuationRecord {
            duration_ms: u32::try_from((self.at_us - self.started_us) / 1_000).unwrap_or(u32::MAX),
            energy_mj: u32::try_from(energy_mj).unwrap_or(u32::MAX),
            ..self.record
        }
    }

    /// Begins the record of the next actuation.
    pub(crate) fn start(
        &mut self,
        now_us: u64,
        kind: ActuationKind,
        thread: Thread,
        battery_mv: u16,
    ) {
        let actuation = self.record.actuation.saturating_add(1);
        *self = Self::default();
        (self.started_us, self.at_us) = (now_us, now_us);
        self.record.actuation = actuation;
        (self.record.kind, self.record.outcome) = (kind, ActuationOutcome::Running);
        (self.record.thread_um, self.record.min_battery_mv) = (thread.0, battery_mv);
    }

    /// Notes a sample of the running actuation. `drive_mv` was ordered before it, positive for winding; `rest_mv` is the
    /// battery voltage without load.
    pub(crate) fn sample(
        &mut self,
        now_us: u64,
        sample: &Sample,
        drive_mv: Option<i16>,
        rest_mv: u16,
    ) {
        let elapsed_us = now_us.saturating_sub(self.at_us);
        self.at_us = now_us;
        self.record.min_battery_mv = self.record.min_battery_mv.min(sample.battery_mv);
        if let Some(drive_mv) = drive_mv {
            self.add_energy(sample, drive_mv, rest_mv, elapsed_us);
        }
    }

    fn add_energy(&mut self, sample: &Sample, drive_mv: i16, rest_mv: u16, elapsed_us: u64) {
        let battery_mv = u32::from(sample.battery_mv);
        let drive = u32::from(drive_mv.unsigned_abs());
        // The battery gives current only in the pulses, D = drive / battery of the time. It gives more than the
        // motor's mean, because the current rises in them. The rise is (V R T2 / 12 L2) D2 (1 - D)2, accurate to 2 %.
        let Some(share) = (drive * SHARE).checked_div(battery_mv) else {
            return;
        };
        let share = share.min(SHARE);
        let both = share * (SHARE - share) / SHARE;
        let rise_ua = battery_mv * RISE_UA_PER_V / 1_000 * both / SHARE * both / SHARE;
        // 2 A times 1,024 fits an i32.
        let along_ua = sample.current_ua.clamp(-MOST_UA, MOST_UA) * i32::from(drive_mv.signum());
        let drawn_ua = along_ua * share as i32 / SHARE as i32 + rise_ua as i32;
        // The reading averages pulses and pauses. The shorter the pulses, the more the battery sags in them beyond
        // that mean.
        let sag_mv = u32::from(rest_mv.saturating_sub(sample.battery_mv));
        let in_pulses_mv = (sag_mv * battery_mv)
            .checked_div(drive)
            .map_or(sag_mv, |sag| sag.min(u32::from(rest_mv) / 2));
        let under_load_mv = u32::from(rest_mv.max(sample.battery_mv)) - in_pulses_mv;
        // mV * uA = nW: 32 V and 2 A fit an i64; nW * us = fJ. A motor that the drive brakes feeds energy back.
        let power_nw = i64::from(under_load_mv) * i64::from(drawn_ua);
        let elapsed_us = i64::try_from(elapsed_us).unwrap_or(0);
        self.energy_fj = self
            .energy_fj
            .saturating_add_signed(power_nw.saturating_mul(elapsed_us));
    }

    /// Notes the steady current, `excess_ma` above the no-load current after winding for `winds_us`, and where the thread
    /// engaged first.
    pub(crate) fn current(
        &mut self,
        current_ma: u16,
        excess_ma: i32,
        winds_us: u64,
        thread: Thread,
    ) {
        self.record.end_current_ma = current_ma;
        self.record.peak_current_ma = self.record.peak_current_ma.max(current_ma);
        if self.record.engaged_um == 0 && winds_us >= ENGAGES_US && excess_ma >= ENGAGED_MA {
            self.record.engaged_um = thread.0;
        }
    }
}

#[cfg(test)]
#[path = "../tests/unit/record.rs"]
mod tests;
