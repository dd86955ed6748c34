//! The state machine in closed loop with the model of the capsule's mechanics, in virtual time: the bridge's pulses, the
//! readings of the converter, and what the board does between both.

pub mod cases;

use capsule_plant::{Bridge, Parameters, Plant, Random};
use firmware_capsule::{
    calibration::Calibration,
    detect::Sample,
    fold::{Actions, Capsule, Command, Drive, Event},
    mechanics::Counts,
    sense::Offset,
};
use protocol::capsule::CapsuleEvent;

/// Ticks of a PWM period, and its length, as on the board.
const PWM_TICKS: u32 = 800;
const PERIOD_S: f64 = 50e-6;

/// The capsule and its firmware.
#[derive(Clone)]
pub struct Simulation {
    /// The mechanics.
    pub plant: Plant,
    /// The firmware.
    pub capsule: Capsule,
    /// Device time.
    pub now_us: u64,
    /// What the firmware has reported.
    pub events: Vec<CapsuleEvent>,
    /// What it has asked to be kept.
    pub kept: Option<Calibration>,
    /// Largest current from the cell, mean over a PWM period, mA.
    pub peak_ma: f64,
    random: Random,
    offset: Offset,
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

impl Simulation {
    /// Started, at rest, the offset of the amplifier taken.
    pub fn new(parameters: Parameters, seed: u64) -> Self {
        let plant = Plant::new(parameters);
        let mut sim = Self {
            encoder: plant.encoder(),
            plant,
            capsule: Capsule::new(None, None, false),
            now_us: 0,
            events: Vec::new(),
            kept: None,
            peak_ma: 0.0,
            random: Random::new(seed),
            offset: Offset::default(),
            battery_mv: 0,
            counter: 0,
        };
        for _ in 0..100 {
            sim.tick();
        }
        sim
    }

    /// The model capsule, unfolded.
    pub fn nominal() -> Self {
        Self::new(Parameters::nominal(), 0)
    }

    /// One millisecond, then a sample.
    pub fn tick(&mut self) {
        self.now_us += 1_000;
        let readings = self.run_bridge();
        let sample = self.sample(readings);
        self.give(Event::Sample(sample));
    }

    /// Twenty periods of the bridge. Means of amplifier and battery over the last one, mV.
    fn run_bridge(&mut self) -> (f64, f64) {
        let (bridge, ticks) = match self.capsule.drive() {
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
            return (self.plant.sense_mv(), self.plant.terminal_mv());
        }
        let on_s = PERIOD_S * f64::from(ticks) / f64::from(PWM_TICKS);
        let (mut sense, mut battery) = (0.0, 0.0);
        for _ in 0..20 {
            (sense, battery) = (0.0, 0.0);
            let mut current = 0.0;
            for (bridge, length_s) in [(bridge, on_s), (Bridge::Coast, PERIOD_S - on_s)] {
                if length_s <= 0.0 {
                    continue;
                }
                self.plant.set_bridge(bridge);
                let steps = (length_s / 20e-6).ceil();
                let weight = length_s / steps / PERIOD_S;
                let (counter, encoder) = (&mut self.counter, &mut self.encoder);
                self.plant.advance(length_s, |plant| {
                    sense += plant.sense_mv() * weight;
                    battery += plant.terminal_mv() * weight;
                    if bridge == Bridge::Forward || bridge == Bridge::Reverse {
                        current += plant.current_ma().abs() * weight;
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
            self.peak_ma = self.peak_ma.max(current);
        }
        (sense, battery)
    }

    fn sample(&mut self, (sense_mv, battery_mv): (f64, f64)) -> Sample {
        let noise = self.random.normal() * self.plant.parameters.sense_noise_ma;
        let awake = self.capsule.drive() != Drive::Off;
        let reading_ua = ((sense_mv + noise).max(0.0) * 1e3).round() as u32;
        let current_ua = self.offset.take_off(self.now_us, awake, reading_ua);
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

    /// Gives the firmware an event.
    pub fn give(&mut self, event: Event) -> Actions {
        let actions = self.capsule.step(self.now_us, event);
        self.events.extend(actions.events.iter().copied());
        self.kept = actions.calibrated.or(self.kept);
        actions
    }

    /// Orders something that must not be refused.
    pub fn order(&mut self, command: Command) {
        let actions = self.give(Event::Command(command));
        assert_eq!(actions.refusal, None, "{command:?} refused");
    }

    /// Runs until the machine rests, the bridge sleeps, and the motor stands; at most 20 s.
    pub fn settle(&mut self) {
        for _ in 0..20_000 {
            self.tick();
            if !self.capsule.is_moving() && self.capsule.drive() == Drive::Off {
                break;
            }
        }
        assert!(
            !self.capsule.is_moving(),
            "still moving: {:?}",
            self.capsule
        );
        for _ in 0..100 {
            self.tick();
        }
    }

    /// Orders and runs until everything rests.
    pub fn run(&mut self, command: Command) {
        self.order(command);
        self.settle();
    }

    /// A capsule that has been calibrated, unfolded.
    pub fn calibrated(parameters: Parameters, seed: u64) -> Self {
        let mut sim = Self::new(parameters, seed);
        sim.run(Command::Calibrate);
        sim.forget();
        sim
    }

    /// Extremes and events count from here.
    pub fn forget(&mut self) {
        self.events.clear();
        self.plant.forget_extremes();
        self.peak_ma = 0.0;
    }

    /// Orders and runs until the true thread passes `mm`.
    pub fn run_past(&mut self, command: Command, mm: f64) {
        let above = self.plant.wound_mm() > mm;
        self.order(command);
        while (self.plant.wound_mm() > mm) == above {
            self.tick();
            assert!(self.capsule.is_moving(), "ended before {mm} mm");
        }
    }
}
