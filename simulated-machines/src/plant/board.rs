//! The board between the firmware and the model of the mechanics: the bridge's pulses, the converter's readings, the
//! encoder's counter.

use capsule_plant::{Bridge, Parameters, Plant, Random};
use firmware_capsule::sense::{Counts, FINE, Sample, Zero};
use firmware_capsule::speed::Drive;

/// Ticks of a PWM period and its length, as on the board.
const PWM_TICKS: u32 = 200;
const PERIOD_S: f64 = 12.5e-6;
/// Length of two PWM periods: the shortest time that is a whole number of us.
pub const TWO_PERIODS_US: u64 = 25;
/// PWM periods in a millisecond.
pub const PERIODS_PER_MS: u64 = 80;
/// Supply of the converter and the amplifier, mV.
const SUPPLY_MV: u32 = 3_300;

/// The mechanics on their board.
#[derive(Clone, Debug)]
pub struct Board {
    /// The mechanics.
    pub plant: Plant,
    /// Largest current drawn from the cell, mean over a PWM period, mA.
    pub peak_ma: f64,
    random: Random,
    zero: Zero,
    battery_mv: u16,
    /// TIM2, which counts the edges of both encoder lines.
    counter: i32,
    encoder: (bool, bool),
}

/// Quarter of an encoder line for these two levels.
fn quarter((a, b): (bool, bool)) -> i32 {
    match (a, b) {
        (false, false) => 0,
        (true, false) => 1,
        (true, true) => 2,
        (false, true) => 3,
    }
}

impl Board {
    /// A board with the capsule at rest.
    pub fn new(parameters: Parameters, seed: u64) -> Self {
        let plant = Plant::new(parameters);
        Self {
            encoder: plant.encoder(),
            plant,
            peak_ma: 0.0,
            random: Random::new(seed),
            zero: Zero::default(),
            battery_mv: 0,
            counter: 0,
        }
    }

    /// Restarts the chip: its counter begins at 0, and it has not measured the amplifier's zero.
    pub fn restart(&mut self) {
        self.counter = 0;
        self.encoder = self.plant.encoder();
        self.zero = Zero::default();
    }

    /// Runs the bridge for this many PWM periods.
    pub fn run(&mut self, drive: Drive, periods: u64) {
        let (bridge, ticks) = match drive {
            Drive::Off => (Bridge::Coast, PWM_TICKS),
            Drive::Brake => (Bridge::Brake, PWM_TICKS),
            Drive::Millivolts(drive_mv) => {
                let battery_mv = u32::from(self.battery_mv);
                let wanted = u32::from(drive_mv.unsigned_abs()) * PWM_TICKS + battery_mv / 2;
                let ticks = wanted.checked_div(battery_mv);
                let bridge = if drive_mv >= 0 {
                    Bridge::Forward
                } else {
                    Bridge::Reverse
                };
                (bridge, ticks.map_or(0, |ticks| ticks.min(PWM_TICKS)))
            }
        };
        if self.plant.is_quiet() && bridge == Bridge::Coast {
            self.plant.rest(PERIOD_S * periods as f64);
            return;
        }
        let on_s = PERIOD_S * f64::from(ticks) / f64::from(PWM_TICKS);
        for _ in 0..periods {
            let phases = [(Bridge::Brake, PERIOD_S - on_s), (bridge, on_s)];
            self.plant.advance_period(&phases);
            self.peak_ma = self.peak_ma.max(self.plant.drawn_ma());
            let levels = self.plant.encoder();
            // One quarter is one count. Two quarters at once have no direction, so they count as none.
            self.counter += match (quarter(levels) - quarter(self.encoder)).rem_euclid(4) {
                1 => 1,
                3 => -1,
                _ => 0,
            };
            self.encoder = levels;
        }
    }

    /// Takes a reading with the converter, with the bridge awake or asleep.
    pub fn sample(&mut self, now_us: u64, awake: bool) -> Sample {
        let noise = self.random.normal() * self.plant.parameters.sense_noise_ma;
        let sense_mv = (self.plant.sense_mv(SUPPLY_MV.into()) + noise).clamp(0.0, 3_300.0);
        let fine = sense_mv / f64::from(SUPPLY_MV) * 4_095.0 * f64::from(FINE);
        let current_ua = self
            .zero
            .take_off(now_us, awake, fine.round() as i32, SUPPLY_MV);
        self.battery_mv = (self.plant.seen_battery_mv() / 2.0).round() as u16 * 2;
        Sample {
            counts: Counts(self.counter),
            current_ua,
            offset_ma: self.zero.offset_ma(SUPPLY_MV),
            battery_mv: self.battery_mv,
            driver_fault: awake && !self.plant.fault_high(),
        }
    }
}
