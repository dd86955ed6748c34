//! The capsule in virtual time: the firmware's control on a model of motor, thread and origami.

#[path = "../../../firmware-capsule/tests/plant/mod.rs"]
mod plant;

use device::identity::identity;
use device::retained::{self, EStop, WORDS};
use device::service::Inbound;
use firmware_capsule::control::{self, Control};
use firmware_capsule::fold::Drive;
use plant::Plant;
use protocol::capsule::CapsuleTelemetry;
use protocol::system::{self, DeviceKind, Identity, ResetCause};
use protocol::table::{Reply, Telemetry};

use super::flash::Retained;
use super::port::Port;
use super::{Device, UID, World};

/// Interval of readings while the bridge is awake, and while it sleeps, us.
const AWAKE_US: u64 = 1_000;
const ASLEEP_US: u64 = 100_000;
/// Thread on the spool when the capsule is switched on, mm.
const START_MM: f64 = 0.4;
/// The model's time step, us.
const STEP_US: u64 = 20;

/// A capsule.
pub struct Capsule {
    control: Control<Board>,
    identity: Identity,
    next_reading_us: u64,
}

/// Everything but control.
struct Board {
    port: Port,
    /// Since the start of the device.
    now_us: u64,
    plant: Plant,
    /// So far has the model come.
    plant_us: u64,
    drive: Drive,
    /// The drive has changed since the last reading: the motor task reads at once.
    changed: bool,
    shown: Option<CapsuleTelemetry>,
    retained: Retained,
}

impl Board {
    fn new(plant: Plant, retained: Retained) -> Self {
        Self {
            port: Port::default(),
            now_us: 0,
            plant,
            plant_us: 0,
            drive: Drive::Off,
            changed: false,
            shown: None,
            retained,
        }
    }

    /// Lets the motor turn until now.
    fn turn(&mut self) {
        let steps = (self.now_us - self.plant_us) / STEP_US;
        self.plant_us += steps * STEP_US;
        // At rest without drive nothing changes: the worm holds.
        let rests = self.drive == Drive::Off && self.plant.speed == 0.0;
        let steps = if rests { steps.min(1) } else { steps };
        self.plant.run(self.drive, (steps * STEP_US) as u32);
    }
}

impl control::Capsule for Board {
    fn now_us(&self) -> u64 {
        self.now_us
    }

    fn silence_us(&self) -> u32 {
        self.port.silence_us(self.now_us)
    }

    fn drive(&mut self, drive: Drive) {
        if self.drive != drive {
            self.turn();
            (self.drive, self.changed) = (drive, true);
        }
    }

    fn show(&mut self, telemetry: CapsuleTelemetry) {
        self.shown = Some(telemetry);
    }

    fn set_telemetry(&mut self, period_ms: u16) {
        self.port.set_telemetry(self.now_us, period_ms);
    }

    fn keep_latched(&mut self, estop: Option<EStop>) {
        retained::keep_latched(&mut self.retained, estop);
    }

    fn tell(&mut self, event: &system::Event) {
        self.port.tell(self.now_us, event);
    }
}

impl Capsule {
    /// A capsule that has just been switched on.
    pub fn new() -> Self {
        let retained = Retained([0; WORDS]);
        Self::start(Plant::at(START_MM), retained, ResetCause::PowerOn)
    }

    fn start(plant: Plant, mut retained: Retained, cause: ResetCause) -> Self {
        let left = retained::start(&mut retained);
        Self {
            identity: identity(DeviceKind::Capsule, UID, left.boot_id, cause),
            control: Control::new(Board::new(plant, retained), left, cause),
            next_reading_us: 0,
        }
    }

    fn read(&mut self) {
        let board = self.control.capsule();
        board.turn();
        board.changed = false;
        let (now_us, sample) = (board.now_us, board.plant.sample());
        self.control.read(now_us, sample);
        let asleep = self.control.capsule().drive == Drive::Off;
        self.next_reading_us = now_us + if asleep { ASLEEP_US } else { AWAKE_US };
        self.read_at_once_if_changed();
    }

    fn read_at_once_if_changed(&mut self) {
        let board = self.control.capsule();
        if board.changed {
            self.next_reading_us = board.now_us;
        }
    }
}

impl Device for Capsule {
    fn identity(&self) -> Identity {
        self.identity
    }

    fn reset(&mut self, cause: ResetCause) {
        let board = self.control.capsule();
        let plant = std::mem::replace(&mut board.plant, Plant::at(START_MM));
        let retained = Retained(board.retained.0);
        *self = Self::start(plant, retained, cause);
    }

    fn port(&mut self) -> &mut Port {
        &mut self.control.capsule().port
    }

    fn due_us(&mut self) -> u64 {
        self.next_reading_us
    }

    fn live(&mut self, until_us: u64) {
        while self.next_reading_us <= until_us {
            self.control.capsule().now_us = self.next_reading_us;
            self.read();
        }
        self.control.capsule().now_us = until_us;
    }

    fn answer(&mut self, inbound: Inbound) -> Reply {
        let reply = self.control.answer(inbound);
        self.read_at_once_if_changed();
        reply
    }

    fn telemetry(&mut self) -> Option<Telemetry> {
        let board = self.control.capsule();
        let time_us = board.now_us;
        let shown = board.shown?;
        Some(Telemetry::Capsule(CapsuleTelemetry { time_us, ..shown }))
    }

    fn world(&mut self, event: World) {
        unreachable!("{event:?} is of the rig");
    }
}
