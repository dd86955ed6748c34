//! The capsule's state machine in closed loop with the model of its mechanics, in virtual time.

pub mod board;
pub mod cases;

use board::{Board, PERIODS_PER_MS};
use capsule_plant::Parameters;
use core::ops::{Deref, DerefMut};
use firmware_capsule::calibration::Calibration;
use firmware_capsule::fold::{Actions, Capsule, Command, Drive, Event};
use firmware_capsule::sample::Sample;
use firmware_capsule::settings::Settings;
use protocol::capsule::CapsuleEvent;

/// Delay from a reading to the resulting duty, us, as measured on the image (`virtual-bench bench`). Without it a jam
/// pulls 1.5 N less than on the image.
const ORDER_US: u64 = 600;

/// The capsule and its firmware.
#[derive(Clone)]
pub struct Simulation {
    /// The mechanics on their board.
    pub board: Board,
    /// The firmware.
    pub capsule: Capsule,
    /// Device time.
    pub now_us: u64,
    /// Events that the firmware has reported.
    pub events: Vec<CapsuleEvent>,
    /// Calibration that the firmware has asked to keep in flash.
    pub kept: Option<Calibration>,
    /// Drive before the last decision; the bridge keeps it until control has judged the reading.
    before: Drive,
}

impl Deref for Simulation {
    type Target = Board;

    fn deref(&self) -> &Board {
        &self.board
    }
}

impl DerefMut for Simulation {
    fn deref_mut(&mut self) -> &mut Board {
        &mut self.board
    }
}

impl Simulation {
    /// A started capsule at rest, with the amplifier's offset already measured.
    pub fn new(parameters: Parameters, seed: u64) -> Self {
        let mut sim = Self {
            board: Board::new(parameters, seed),
            capsule: Capsule::new(None, None, None, Settings::REFERENCE),
            now_us: 0,
            events: Vec::new(),
            kept: None,
            before: Drive::Off,
        };
        for _ in 0..100 {
            sim.tick();
        }
        sim
    }

    /// The nominal capsule, unfolded.
    pub fn nominal() -> Self {
        Self::new(Parameters::nominal(), 0)
    }

    /// Simulates one millisecond and takes a sample. Returns it with the drive that follows from it.
    pub fn tick(&mut self) -> (Sample, Drive) {
        self.now_us += 1_000;
        let drive = self.capsule.drive();
        let before = std::mem::replace(&mut self.before, drive);
        let late = ORDER_US * PERIODS_PER_MS / 1_000;
        self.board.run(before, late);
        self.board.run(drive, PERIODS_PER_MS - late);
        let sample = self.board.sample(self.now_us, drive != Drive::Off);
        (sample, self.give(Event::Sample(sample)).drive)
    }

    /// Passes an event to the firmware.
    pub fn give(&mut self, event: Event) -> Actions {
        let actions = self.capsule.step(self.now_us, event);
        self.events.extend(actions.events.iter().copied());
        self.kept = actions.calibrated.or(self.kept);
        actions
    }

    /// Gives a command. Panics if it is refused.
    pub fn order(&mut self, command: Command) {
        let actions = self.give(Event::Command(command));
        assert_eq!(actions.refusal, None, "{command:?} refused");
    }

    /// Runs until the capsule rests, the bridge sleeps and the motor stands; at most 20 s.
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

    /// Gives a command and runs until everything rests.
    pub fn run(&mut self, command: Command) {
        self.order(command);
        self.settle();
    }

    /// A calibrated capsule, unfolded.
    pub fn calibrated(parameters: Parameters, seed: u64) -> Self {
        let mut sim = Self::new(parameters, seed);
        sim.run(Command::Calibrate);
        sim.forget();
        sim
    }

    /// Resets the firmware at rest: it loses the position, the worm holds. Also clears extremes and events.
    pub fn reset(&mut self, was_folded: bool) {
        let folded = was_folded.then(|| self.capsule.margin());
        self.capsule = Capsule::new(None, self.kept, folded, Settings::REFERENCE);
        self.forget();
        for _ in 0..100 {
            self.tick();
        }
    }

    /// Clears extremes and events.
    pub fn forget(&mut self) {
        self.events.clear();
        self.plant.forget_extremes();
        self.peak_ma = 0.0;
    }

    /// Gives a command and runs until the true thread length passes `mm`.
    pub fn run_past(&mut self, command: Command, mm: f64) {
        let above = self.plant.wound_mm() > mm;
        self.order(command);
        while (self.plant.wound_mm() > mm) == above {
            self.tick();
            assert!(self.capsule.is_moving(), "ended before {mm} mm");
        }
    }
}
