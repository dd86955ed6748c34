//! The capsule's state machine in closed loop with the model of its mechanics, in virtual time.

pub mod board;

use board::{Board, PERIODS_PER_MS};
use capsule_plant::{Bridge, Parameters};
use core::ops::{Deref, DerefMut};
use firmware_capsule::known::{Calibration, Known};
use firmware_capsule::machine::{Actions, Capsule, Event};
use firmware_capsule::sense::Sample;
use firmware_capsule::settings::Settings;
use firmware_capsule::speed::Drive;
use firmware_capsule::units::Thread;
use protocol::capsule::{ActuationKind, CapsuleEvent, CapsuleFault};

/// Delay from a reading to the resulting duty, us, as measured on the image (`virtual-bench bench`). Without it a jam
/// pulls 1.5 N less than on the image.
const ORDER_US: u64 = 600;

/// Orders of the host.
pub const CALIBRATE: Event = Event::Begin(ActuationKind::Calibrate, Thread(0));
pub const REFERENCE: Event = Event::Begin(ActuationKind::Reference, Thread(0));
pub const FOLD: Event = Event::Begin(ActuationKind::Fold, Thread(0));
pub const UNFOLD: Event = Event::Begin(ActuationKind::Unfold, Thread(0));
pub const CHECK: Event = Event::Begin(ActuationKind::CheckFolded, Thread(0));
pub const ESTOP: Event = Event::Fail(CapsuleFault::EStopFrame);

/// A partial fold, to this length of thread in um.
pub const fn fold_to(thread_um: i32) -> Event {
    Event::Begin(ActuationKind::FoldTo, Thread(thread_um))
}

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
    /// The record in flash.
    pub kept: Known,
    /// Records written within motions.
    pub writes: u32,
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
            capsule: Capsule::new(None, Known::default(), Settings::REFERENCE),
            now_us: 0,
            events: Vec::new(),
            kept: Known::default(),
            writes: 0,
            before: Drive::Off,
        };
        sim.wait(100);
        sim
    }

    /// The nominal capsule, unfolded.
    pub fn nominal() -> Self {
        Self::new(Parameters::nominal(), 0)
    }

    /// Simulates one millisecond and takes a sample. Returns it with the drive that follows from it.
    pub fn tick(&mut self) -> (Sample, Drive) {
        self.now_us += 1_000;
        let drive = self.capsule.drive;
        let before = std::mem::replace(&mut self.before, drive);
        let late = ORDER_US * PERIODS_PER_MS / 1_000;
        self.board.run(before, late);
        self.board.run(drive, PERIODS_PER_MS - late);
        let sample = self.board.sample(self.now_us, drive != Drive::Off);
        self.give(Event::Sample(sample));
        (sample, self.capsule.drive)
    }

    /// Lets this many milliseconds pass.
    pub fn wait(&mut self, ms: u32) {
        for _ in 0..ms {
            self.tick();
        }
    }

    /// Passes an event to the firmware.
    pub fn give(&mut self, event: Event) -> Actions {
        let actions = self.capsule.step(self.now_us, event);
        self.events.extend(actions.events.iter().copied());
        if let Some(known) = actions.keep {
            self.kept = known;
            self.writes += 1;
        }
        actions
    }

    /// Gives an order. Panics if it is refused.
    pub fn order(&mut self, order: Event) {
        let actions = self.give(order);
        assert_eq!(actions.refusal, None, "{order:?} refused");
    }

    /// Runs until the capsule rests, the bridge sleeps and the motor stands, at most a minute. The flash then has the
    /// position.
    pub fn settle(&mut self) {
        for _ in 0..60_000 {
            self.tick();
            if !self.capsule.is_moving() && self.capsule.drive == Drive::Off {
                break;
            }
        }
        assert!(
            !self.capsule.is_moving(),
            "still moving: {:?}",
            self.capsule
        );
        self.wait(100);
        self.kept = self.capsule.known.resting(self.capsule.sample.counts);
    }

    /// Gives an order and runs until everything rests.
    pub fn run(&mut self, order: Event) {
        self.order(order);
        self.settle();
    }

    /// A calibrated capsule, unfolded.
    pub fn calibrated(parameters: Parameters, seed: u64) -> Self {
        let mut sim = Self::new(parameters, seed);
        sim.run(CALIBRATE);
        sim.forget();
        sim
    }

    /// The calibration. Panics without one.
    pub fn calibration(&self) -> Calibration {
        self.capsule.known.calibration.expect("it is calibrated")
    }

    /// Thread at the folded end of the calibration, mm.
    pub fn folded_mm(&self) -> f64 {
        f64::from(self.calibration().folded.0) / 1e3
    }

    /// Cuts the power, or lets a `fault` reset the chip: the motor runs down, and the firmware starts from the flash.
    pub fn restart(&mut self, fault: Option<CapsuleFault>) {
        self.plant.set_bridge(Bridge::Coast);
        self.plant.advance(2.0, |_| ());
        assert!(self.plant.is_quiet(), "it still moves");
        let kept = self.kept;
        self.capsule = Capsule::new(fault, kept, Settings::REFERENCE);
        self.before = Drive::Off;
        self.board.restart();
        self.wait(100);
    }

    /// Clears extremes and events.
    pub fn forget(&mut self) {
        self.events.clear();
        self.plant.forget_extremes();
        self.peak_ma = 0.0;
    }

    /// Gives an order and runs until the true thread length passes `mm`.
    pub fn run_past(&mut self, order: Event, mm: f64) {
        let above = self.plant.wound_mm() > mm;
        self.order(order);
        while (self.plant.wound_mm() > mm) == above {
            self.tick();
            assert!(self.capsule.is_moving(), "ended before {mm} mm");
        }
    }
}
