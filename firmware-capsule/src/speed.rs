//! Speed loop on the encoder, with the current bounded by the motor's equation `U = R i + k w`.
//!
//! The bridge shorts the motor between the pulses, so a duty `D` gives the mean current `(D V - k w) / R`. The current,
//! and with it the force, is thus bounded from the first pulse on, even if it is never measured. To slow down, the loop
//! shorts the motor for a millisecond at a time, which takes 14 % of its speed and nothing from the battery.

use crate::settings::Settings;
use crate::units::Spooling;

/// Largest current, mA: 7.0 to 11.3 N over the range of the worm's friction, and full speed within 20 ms.
pub const MOST_MA: u16 = 220;
/// Proportional gain, uA per count/s: with the motor's 4.2 counts/s2 per uA 60 rad/s, for a speed that is 4 ms old.
const PROPORTIONAL_UA: i32 = 15;
/// Integral gain, uA per count/s and ms, times 1/4: a time constant of 67 ms.
const INTEGRAL_QUARTERS: i32 = 1;
/// The same while the motor hardly turns: all of the current within 40 ms.
const STANDING_QUARTERS: i32 = 8;

/// State of the bridge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Drive {
    /// Bridge asleep.
    #[default]
    Off,
    /// Motor shorted.
    Brake,
    /// Duty times battery voltage; positive winds. Never more than the battery has.
    Millivolts(i16),
}

impl Drive {
    /// Voltage at the motor, if it is driven.
    pub fn millivolts(self) -> Option<i16> {
        match self {
            Drive::Millivolts(millivolts) => Some(millivolts),
            Drive::Off | Drive::Brake => None,
        }
    }
}

#[derive(Clone, Debug, Default)]
pub struct SpeedLoop {
    integral_ua: i32,
    /// The last drive was all that the battery has.
    saturated: bool,
    /// Consecutive milliseconds of braking.
    braked_ms: u8,
    /// Duty times battery voltage in the direction of the phase; none shorts the motor.
    drive_mv: Option<i16>,
}

impl SpeedLoop {
    /// Sets the drive, once a millisecond. Takes the aim, the speed in the direction of the phase and the lowest value
    /// that it may have by now, so that the current stays bounded while something stops the motor.
    pub fn step(&mut self, aim: (i32, u16), speeds: (i32, i32), battery_mv: u16, motor: &Settings) {
        let ((aim_cps, most_ma), (cps, least_cps)) = (aim, speeds);
        let error = aim_cps.saturating_sub(cps);
        // The speed is a mean over past milliseconds. A shorted motor is slower by now.
        let by_now_cps = least_cps - least_cps / 8 * i32::from(self.braked_ms.min(2));
        if by_now_cps.saturating_sub(aim_cps) > aim_cps / 4 {
            self.braked_ms = self.braked_ms.saturating_add(1);
            // Less load than before: a motor that is braked again and again never turns steadily.
            self.integral_ua -= self.integral_ua / 8;
            self.drive_mv = None;
            return;
        }
        self.braked_ms = 0;
        let limit_ua = i32::from(most_ma) * 1_000;
        let proportional_ua = error.saturating_mul(PROPORTIONAL_UA);
        // Hold the integral part while the limit or the battery bounds the current.
        if proportional_ua < limit_ua && !(self.saturated && error > 0) {
            let quarters = match cps < aim_cps / 8 {
                true => STANDING_QUARTERS,
                false => INTEGRAL_QUARTERS,
            };
            let step = error.saturating_mul(quarters) / 4;
            self.integral_ua = self.integral_ua.saturating_add(step).clamp(0, limit_ua);
        }
        let current_ua = proportional_ua.saturating_add(self.integral_ua);
        let wanted_mv = drive_mv(current_ua.clamp(0, limit_ua), least_cps, motor);
        self.saturated = wanted_mv >= i32::from(battery_mv);
        self.drive_mv = Some(wanted_mv.min(battery_mv.into()).clamp(0, i16::MAX.into()) as i16);
    }

    /// The drive that was set, in this direction.
    pub fn drive(&self, spooling: Spooling) -> Drive {
        let signed = |along_mv: i16| Drive::Millivolts(spooling.along(along_mv.into()) as i16);
        self.drive_mv.map_or(Drive::Brake, signed)
    }
}

/// Duty times battery voltage that gives this mean current at this speed, mV.
fn drive_mv(current_ua: i32, cps: i32, settings: &Settings) -> i32 {
    // Backward rotation adds to the current; count it as standstill. 100,000 counts/s are beyond any motor.
    let back_mv = cps.clamp(0, 100_000) * settings.back_emf_uv_per_cps / 1_000;
    // uA * mohm / 1000 = uV. A quarter of both factors, so that 220 mA and 20 ohm fit.
    let resistive_mv = current_ua / 4 * (settings.loop_milliohm / 4) / 62_500;
    back_mv + resistive_mv
}
