//! The capsule in virtual time: the firmware's control on the simulated board.

use crate::plant::board::{Board as Mechanics, TWO_PERIODS_US};
use capsule_plant::{Defect, Parameters};
use device::retained::Retained;
use device::service::Answers;
use device::service::Inbound;
use firmware_capsule::control::{self, Control};
use firmware_capsule::speed::Drive;
use protocol::capsule::CapsuleTelemetry;
use protocol::system::ResetCause;
use protocol::table::{Reply, Telemetry};

use super::port::{At, Port};
use super::{Device, World};
use crate::chip::Flash;

/// Interval of readings while the bridge is awake, and while it sleeps, us.
const AWAKE_US: u64 = 1_000;
const ASLEEP_US: u64 = 100_000;
/// Longest time that a motor coasts, us.
const COASTS_US: u64 = 500_000;

/// Thread length of the folded capsule, um: 5.6 N at 20.5 mm of travel plus 1 mm of slack.
pub const FOLDED_UM: i32 = 21_470;

pub struct Capsule {
    control: Control<At<Board>, Flash>,
    flash: Flash,
    port: Port,
    next_reading_us: u64,
    /// Number of readings with the bridge awake.
    awake: u64,
}

struct Board {
    mechanics: Mechanics,
    /// Device time up to which the mechanics have been simulated, us.
    mechanics_us: u64,
    drive: Drive,
    /// The bridge has woken since the last reading.
    woken: bool,
    shown: Option<CapsuleTelemetry>,
}

impl At<Board> {
    /// Simulates the mechanics up to now.
    fn turn(&mut self) {
        let board = &mut self.board;
        let twice = (self.port.now_us() - board.mechanics_us) / TWO_PERIODS_US;
        board.mechanics_us += twice * TWO_PERIODS_US;
        board.mechanics.run(board.drive, 2 * twice);
    }
}

impl control::Capsule for At<Board> {
    fn drive(&mut self, drive: Drive) {
        if self.board.drive != drive {
            self.turn();
            self.board.woken |= self.board.drive == Drive::Off;
            self.board.drive = drive;
        }
    }

    fn show(&mut self, telemetry: CapsuleTelemetry) {
        self.board.shown = Some(telemetry);
    }
}

impl Capsule {
    /// A capsule that has just been switched on, unfolded.
    pub fn new(port: &Port, flash: &Flash, previous: Retained) -> Self {
        let mechanics = Mechanics::new(Parameters::nominal(), 0);
        Self::start(port, flash, previous, ResetCause::PowerOn, mechanics)
    }

    fn start(
        port: &Port,
        flash: &Flash,
        previous: Retained,
        cause: ResetCause,
        mechanics: Mechanics,
    ) -> Self {
        let at = At {
            port: port.clone(),
            board: Board {
                mechanics,
                mechanics_us: 0,
                drive: Drive::Off,
                woken: false,
                shown: None,
            },
        };
        Self {
            control: Control::new(at, flash.clone(), previous, cause),
            flash: flash.clone(),
            port: port.clone(),
            next_reading_us: 0,
            awake: 0,
        }
    }

    /// The motor task takes a reading as soon as the bridge wakes.
    fn read_if_woken(&mut self) {
        if self.control.capsule().board.woken {
            self.next_reading_us = self.port.now_us();
        }
    }
}

impl Device for Capsule {
    fn reset(&mut self, previous: Retained, cause: ResetCause) {
        // Let the motor coast to rest with the bridge asleep; then the worm holds.
        let board = &mut self.control.capsule().board;
        board
            .mechanics
            .run(Drive::Off, 2 * COASTS_US / TWO_PERIODS_US);
        let mechanics = board.mechanics.clone();
        *self = Self::start(&self.port, &self.flash, previous, cause, mechanics);
    }

    fn due_us(&mut self) -> u64 {
        self.next_reading_us
    }

    fn advance(&mut self, until_us: u64) {
        while self.next_reading_us <= until_us {
            let now_us = self.next_reading_us;
            self.port.set_now_us(now_us);
            let at = self.control.capsule();
            at.turn();
            at.board.woken = false;
            let awake = at.board.drive != Drive::Off;
            let sample = at.board.mechanics.sample(now_us, awake);
            self.control.read(now_us, sample);
            self.awake += u64::from(awake);
            let asleep = self.control.capsule().board.drive == Drive::Off;
            self.next_reading_us = now_us + if asleep { ASLEEP_US } else { AWAKE_US };
            self.read_if_woken();
        }
        self.port.set_now_us(until_us);
    }

    fn answer(&mut self, inbound: Inbound) -> Reply {
        let reply = self.control.answer(inbound);
        self.read_if_woken();
        reply
    }

    fn telemetry(&mut self) -> Option<Telemetry> {
        let time_us = self.port.now_us();
        let shown = self.control.capsule().board.shown?;
        Some(Telemetry::Capsule(CapsuleTelemetry { time_us, ..shown }))
    }

    fn is_driven(&mut self) -> bool {
        self.control.capsule().board.drive != Drive::Off
    }

    fn work(&mut self) -> u64 {
        self.awake
    }

    fn world(&mut self, event: World) {
        let World::Battery { mv } = event else {
            unreachable!("{event:?} is of the rig");
        };
        let plant = &mut self.control.capsule().board.mechanics.plant;
        plant.inject(Defect::Battery(mv.into()));
        if !self.is_driven() {
            // Read now: a sleeping capsule reads ten times a second, which would miss a change this abrupt.
            self.next_reading_us = self.port.now_us();
        }
    }
}
