//! Speed loop on the encoder, with the current bounded by the motor's equation.
//!
//! The bridge shorts the motor between the pulses, so a duty `D` gives the mean current `(D V - e) / R` at any
//! inductance. The back-EMF `e` follows from the speed. The loop asks for a current and converts it to a duty, so the
//! current is bounded from the first pulse on, even if it is never measured. To slow down, the loop shorts the motor
//! for a millisecond at a time. That takes 14 % of its speed and nothing from the battery.

use crate::settings::Settings;

/// Integral gain, uA per count/s and ms, times 1/4: a time constant of 67 ms.
const INTEGRAL_QUARTERS: i32 = 1;
/// The same while the motor hardly turns, to get a load moving sooner.
const STANDING_QUARTERS: i32 = 4;
/// Excess speed above which the motor is braked, counts/s; or a quarter of the aim, if that is more.
const BRAKE_ABOVE_CPS: i32 = 500;

/// Current against the motion that stops a motor which meets something, mA.
const PLUG_MA: u32 = 600;
/// Largest voltage for it, mV: an empty cell has no more.
const MOST_PLUG_MV: i64 = -2_500;

/// Output of the speed loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effort {
    /// Motor shorted.
    Brake,
    /// Duty times battery voltage, positive in the direction of the leg.
    Millivolts(i16),
}

/// Aim of the speed loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Aim {
    /// Speed in the direction of the leg, counts/s.
    pub cps: i32,
    /// Largest current, mA.
    pub limit_ma: u16,
    /// Largest current that the integral part may hold, mA. A heavier load is moved more slowly.
    pub held_ma: u16,
}

/// The speed loop.
#[derive(Clone, Debug, Default)]
pub struct Governor {
    integral_ua: i32,
    ordered_ma: Option<u16>,
    /// The last effort asked for all that the battery has.
    saturated: bool,
    /// Consecutive milliseconds of braking.
    braked_ms: u8,
}

impl Governor {
    /// Current that the last effort was meant to give, mA; none while braking.
    pub fn ordered_ma(&self) -> Option<u16> {
        self.ordered_ma
    }

    /// Takes a third off the integral part. A motor whose load falls is braked again and again otherwise, and never
    /// turns steadily.
    pub fn hold_less(&mut self) {
        self.integral_ua -= self.integral_ua / 3;
    }

    /// Drives the motor against its direction, which brakes it harder than a short circuit.
    pub fn plug(&mut self, cps: i32, settings: &Settings) -> Effort {
        self.ordered_ma = None;
        self.braked_ms = self.braked_ms.saturating_add(1);
        let back_mv = cps.max(0) as u32 * settings.back_emf_uv_per_cps / 1_000;
        let against_mv = PLUG_MA * settings.loop_milliohm / 1_000;
        let millivolts = i64::from(back_mv) - i64::from(against_mv);
        // At least as strong as a short circuit, which is 0 mV.
        Effort::Millivolts(millivolts.clamp(MOST_PLUG_MV, 0) as i16)
    }

    /// Shorts the motor for a millisecond at any speed.
    pub fn brake(&mut self) -> Effort {
        self.ordered_ma = None;
        self.braked_ms = self.braked_ms.saturating_add(1);
        Effort::Brake
    }

    /// Runs the loop once a millisecond. Takes the speed in the direction of the leg, and the lowest value that it
    /// may have by now, so that the current stays bounded while something stops the motor.
    pub fn step(
        &mut self,
        aim: Aim,
        (cps, least_cps): (i32, i32),
        battery_mv: u16,
        settings: &Settings,
    ) -> Effort {
        let error = aim.cps.saturating_sub(cps);
        // The speed is a mean over past milliseconds. A shorted motor is slower by now.
        let by_now_cps = match self.braked_ms {
            0 => least_cps,
            1 => least_cps - least_cps / 8,
            _ => least_cps - least_cps / 4,
        };
        if by_now_cps.saturating_sub(aim.cps) > (aim.cps / 4).max(BRAKE_ABOVE_CPS) {
            return self.brake();
        }
        self.braked_ms = 0;
        let limit_ua = i32::from(aim.limit_ma) * 1_000;
        let held_ua = i32::from(aim.held_ma.min(aim.limit_ma)) * 1_000;
        // Anti-windup: hold the integral part while the proportional part alone reaches the limit...
        let proportional_ua = error.saturating_mul(settings.proportional_ua);
        // ... and while the battery gives no more.
        if proportional_ua < limit_ua && !(self.saturated && error > 0) {
            let quarters = if cps < aim.cps / 8 {
                STANDING_QUARTERS
            } else {
                INTEGRAL_QUARTERS
            };
            let step = error.saturating_mul(quarters) / 4;
            self.integral_ua = self.integral_ua.saturating_add(step).clamp(0, held_ua);
        }
        let current_ua = proportional_ua
            .saturating_add(self.integral_ua)
            .clamp(0, limit_ua);
        self.ordered_ma = Some((current_ua / 1_000) as u16);
        let drive_mv = drive_mv(current_ua as u32, least_cps, battery_mv, settings);
        self.saturated = drive_mv >= battery_mv;
        if self.saturated && error < 0 {
            // Keep no more than the battery gives, so that the drive falls with the aim.
            let given_ua = given_ua(least_cps, battery_mv, settings);
            let most_ua = given_ua.saturating_sub(proportional_ua).max(0);
            self.integral_ua = self.integral_ua.min(most_ua);
        }
        Effort::Millivolts(i16::try_from(drive_mv).unwrap_or(i16::MAX))
    }
}

/// Duty times battery voltage that gives this mean current at this speed, mV.
fn drive_mv(current_ua: u32, cps: i32, battery_mv: u16, settings: &Settings) -> u16 {
    // Backward rotation adds to the current; count it as standstill.
    let back_mv = (cps.max(0) as u32).saturating_mul(settings.back_emf_uv_per_cps) / 1_000;
    // uA * mohm / 1000 = uV. A quarter of both factors, so that 250 mA and 20 ohm fit.
    let resistive_mv = (current_ua / 4).saturating_mul(settings.loop_milliohm / 4) / 62_500;
    let drive_mv = back_mv.saturating_add(resistive_mv);
    drive_mv.min(battery_mv.into()) as u16
}

/// Mean current that all of the battery's voltage gives at this speed, uA.
fn given_ua(cps: i32, battery_mv: u16, settings: &Settings) -> i32 {
    let back_mv = i64::from(cps.max(0)) * i64::from(settings.back_emf_uv_per_cps) / 1_000;
    let left_uv = (i64::from(battery_mv) - back_mv).max(0) * 1_000;
    let ua = left_uv * 1_000 / i64::from(settings.loop_milliohm.max(1));
    i32::try_from(ua).unwrap_or(i32::MAX)
}

#[cfg(test)]
#[path = "../tests/unit/governor.rs"]
mod tests;
