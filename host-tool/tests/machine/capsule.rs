//! The capsule in virtual time: the firmware's control on the plant of its own tests.

#[path = "../../../firmware-capsule/tests/plant/mod.rs"]
mod plant;

use device::retained::Retained;
use device::service::Answers;
use device::service::Inbound;
use firmware_capsule::control::{self, Control};
use firmware_capsule::fold::Drive;
use plant::Plant;
use protocol::capsule::CapsuleTelemetry;
use protocol::system::ResetCause;
use protocol::table::{Reply, Telemetry};

use super::port::{At, Port};
use super::{Device, World};

/// Interval of readings while the bridge is awake, and while it sleeps, us.
const AWAKE_US: u64 = 1_000;
const ASLEEP_US: u64 = 100_000;
/// Thread on the spool when the capsule is switched on, mm.
const START_MM: f64 = 0.4;
/// The plant's time step, us.
const STEP_US: u64 = 20;

/// A capsule.
pub struct Capsule {
    control: Control<At<Board>>,
    port: Port,
    next_reading_us: u64,
}

struct Board {
    plant: Plant,
    /// So far has the plant come, device time.
    plant_us: u64,
    drive: Drive,
    /// The drive has changed since the last reading.
    changed: bool,
    shown: Option<CapsuleTelemetry>,
}

impl At<Board> {
    /// Lets the motor turn until now.
    fn turn(&mut self) {
        let board = &mut self.board;
        let steps = (self.port.now_us() - board.plant_us) / STEP_US;
        board.plant_us += steps * STEP_US;
        // At rest without drive nothing changes: the worm holds.
        let rests = board.drive == Drive::Off && board.plant.speed == 0.0;
        let steps = if rests { steps.min(1) } else { steps };
        board.plant.run(board.drive, (steps * STEP_US) as u32);
    }
}

impl control::Capsule for At<Board> {
    fn drive(&mut self, drive: Drive) {
        if self.board.drive != drive {
            self.turn();
            (self.board.drive, self.board.changed) = (drive, true);
        }
    }

    fn show(&mut self, telemetry: CapsuleTelemetry) {
        self.board.shown = Some(telemetry);
    }
}

impl Capsule {
    /// A capsule that has just been switched on.
    pub fn new(port: &Port, left: Retained) -> Self {
        Self::start(port, left, ResetCause::PowerOn, Plant::at(START_MM))
    }

    fn start(port: &Port, left: Retained, cause: ResetCause, plant: Plant) -> Self {
        let board = Board {
            plant,
            plant_us: 0,
            drive: Drive::Off,
            changed: false,
            shown: None,
        };
        let port = port.clone();
        let at = At {
            port: port.clone(),
            board,
        };
        Self {
            control: Control::new(at, left, cause),
            port,
            next_reading_us: 0,
        }
    }

    /// The motor task reads at once after a new order.
    fn read_if_changed(&mut self) {
        if self.control.capsule().board.changed {
            self.next_reading_us = self.port.now_us();
        }
    }
}

impl Device for Capsule {
    fn reset(&mut self, left: Retained, cause: ResetCause) {
        let plant = std::mem::replace(&mut self.control.capsule().board.plant, Plant::at(START_MM));
        *self = Self::start(&self.port, left, cause, plant);
    }

    fn due_us(&mut self) -> u64 {
        self.next_reading_us
    }

    fn live(&mut self, until_us: u64) {
        while self.next_reading_us <= until_us {
            let now_us = self.next_reading_us;
            self.port.set_now_us(now_us);
            let at = self.control.capsule();
            at.turn();
            at.board.changed = false;
            let sample = at.board.plant.sample();
            self.control.read(now_us, sample);
            let asleep = self.control.capsule().board.drive == Drive::Off;
            self.next_reading_us = now_us + if asleep { ASLEEP_US } else { AWAKE_US };
            self.read_if_changed();
        }
        self.port.set_now_us(until_us);
    }

    fn answer(&mut self, inbound: Inbound) -> Reply {
        let reply = self.control.answer(inbound);
        self.read_if_changed();
        reply
    }

    fn telemetry(&mut self) -> Option<Telemetry> {
        let time_us = self.port.now_us();
        let shown = self.control.capsule().board.shown?;
        Some(Telemetry::Capsule(CapsuleTelemetry { time_us, ..shown }))
    }

    fn world(&mut self, event: World) {
        unreachable!("{event:?} is of the rig");
    }
}
