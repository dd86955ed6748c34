//! What is between the firmware and the model of the capsule's mechanics: the bridge's pulses, the readings of the
//! converter, the encoder's counter.

use capsule_plant::{Bridge, Parameters, Plant, Random};
use firmware_capsule::{detect::Sample, fold::Drive, mechanics::Counts, sense::Offset};

/// Ticks of a PWM period, and its length, as on the board.
const PWM_TICKS: u32 = 800;
const PERIOD_S: f64 = 50e-6;
/// The same, us.
pub const PERIOD_US: u64 = 50;

/// The mechanics on their board.
#[derive(Clone, Debug)]
pub struct Board {
    /// The mechanics.
    pub plant: Plant,
    /// Largest current from the cell, mean over a PWM period, mA.
    pub peak_ma: f64,
    random: Random,
    offset: Offset,
    /// Means of amplifier and battery over the last period, mV.
    means_mv: (f64, f64),
    battery_mv: u16,
    /// TIM2, which counts the edges of both lines.
    counter: i32,
    encoder: (bool, bool),
}

/// Quarter of a line that both levels mean.
fn quarter((a, b): (bool, bool)) -> i32 {
    match (a, b) {
        (false, false) => 0,
        (true, false) => 1,
        (true, true) => 2,
        (false, true) => 3,
    }
}

impl Board {
    /// At rest.
    pub fn new(parameters: Parameters, seed: u64) -> Self {
        let plant = Plant::new(parameters);
        Self {
            encoder: plant.encoder(),
            means_mv: (plant.sense_mv(3_300.0), plant.terminal_mv()),
            plant,
            peak_ma: 0.0,
            random: Random::new(seed),
            offset: Offset::default(),
            battery_mv: 0,
            counter: 0,
        }
    }

    /// The counter misses so many counts, for once: the thread reads longer than it is.
    pub fn miscount(&mut self, counts: i32) {
        self.counter += counts;
    }

    /// So many periods of the bridge.
    pub fn run(&mut self, drive: Drive, periods: u64) {
        let (bridge, ticks) = match drive {
            Drive::Off => (Bridge::Coast, 0),
            Drive::Brake => (Bridge::Brake, PWM_TICKS),
            Drive::Millivolts(drive_mv) => {
                let wanted = u32::from(drive_mv.unsigned_abs()) * PWM_TICKS;
                let ticks = wanted.checked_div(u32::from(self.battery_mv));
                let bridge = if drive_mv >= 0 {
                    Bridge::Forward
                } else {
                    Bridge::Reverse
                };
                (bridge, ticks.map_or(0, |ticks| ticks.min(PWM_TICKS)))
            }
        };
        if self.plant.is_quiet() && bridge == Bridge::Coast {
            self.means_mv = (self.plant.sense_mv(3_300.0), self.plant.terminal_mv());
            return;
        }
        let on_s = PERIOD_S * f64::from(ticks) / f64::from(PWM_TICKS);
        let mut sensed_mv = self.plant.sense_mv(3_300.0);
        for _ in 0..periods {
            let (mut sense, mut battery, mut current) = (0.0, 0.0, 0.0);
            for (bridge, length_s) in [(bridge, on_s), (Bridge::Coast, PERIOD_S - on_s)] {
                if length_s <= 0.0 {
                    continue;
                }
                self.plant.set_bridge(bridge);
                let steps = (length_s / 20e-6).ceil();
                let weight = length_s / steps / PERIOD_S;
                let (counter, encoder) = (&mut self.counter, &mut self.encoder);
                let sensed_mv = &mut sensed_mv;
                self.plant.advance(length_s, |plant| {
                    // The filter's output is no straight line within a step, but nearly.
                    let sense_mv = plant.sense_mv(3_300.0);
                    sense += f64::midpoint(*sensed_mv, sense_mv) * weight;
                    *sensed_mv = sense_mv;
                    battery += plant.terminal_mv() * weight;
                    if bridge == Bridge::Forward || bridge == Bridge::Reverse {
                        current += plant.drawn_ma() * weight;
                    }
                    let levels = plant.encoder();
                    // One step is a count; two, which cannot be told apart, are none.
                    *counter += match (quarter(levels) - quarter(*encoder)).rem_euclid(4) {
                        1 => 1,
                        3 => -1,
                        _ => 0,
                    };
                    *encoder = levels;
                });
            }
            self.means_mv = (sense, battery);
            self.peak_ma = self.peak_ma.max(current);
        }
    }

    /// What the converter reads after a period, with the bridge awake or asleep.
    pub fn sample(&mut self, now_us: u64, awake: bool) -> Sample {
        let (sense_mv, battery_mv) = self.means_mv;
        let noise = self.random.normal() * self.plant.parameters.sense_noise_ma;
        let reading_ua = ((sense_mv + noise).max(0.0) * 1e3).round() as u32;
        let current_ua = self.offset.take_off(now_us, awake, reading_ua);
        self.battery_mv = (battery_mv / 2.0).round() as u16 * 2;
        Sample {
            counts: Counts(self.counter),
            current_ma: ((current_ua + 500) / 1_000) as u16,
            current_ua,
            offset_ma: self.offset.offset_ma(),
            battery_mv: self.battery_mv,
            driver_fault: awake && !self.plant.fault_high(),
        }
    }
}
