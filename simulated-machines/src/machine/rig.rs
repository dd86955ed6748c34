//! The rig in virtual time: the firmware's control on the simulated carriage, with a start button.

pub use crate::carriage::SMALL as FEW_STEPS;
use crate::carriage::ring::Ahead;
use crate::carriage::{CONTROL_ROUND, Carriage, IMAGE_HASH};
use device::retained::Retained;
use device::service::Answers;
use device::service::Inbound;
use firmware_rig::control::{self, Control};
use firmware_rig::execution::Order;
use firmware_rig::machine::{Command, Event, Now};
use firmware_rig::settings::Settings;
use motion::units::StepPosition;
use protocol::rig::{GetRigStatus, RigHardware, RigHealth, RigTelemetry};
use protocol::system::{ResetCause, Urgent};
use protocol::table::{Endpoint, Reply, Response, Telemetry};

use super::port::{At, Port};
use super::{Device, World};
use crate::chip::Flash;

/// Ticks of 10 ns per us.
const TICKS_PER_US: u64 = 100;
/// Position of the carriage when the rig is switched on, steps from the reference: 5 mm.
const START: i32 = 4_000;
/// Start position of a rig with few steps: 2.5 mm.
const FEW_STEPS_START: i32 = 10;

pub struct Rig {
    control: Control<At<Board>, Flash>,
    flash: Flash,
    port: Port,
    /// When control's next round is due, ticks.
    next_control: u64,
    timer_stands: bool,
    /// Time and position of the last telemetry sample.
    sampled: (u64, StepPosition),
}

struct Board {
    carriage: Carriage,
    button_is_down: bool,
}

impl control::Rig for At<Board> {
    fn now(&self) -> Now {
        self.board.carriage.observe()
    }

    fn button_is_down(&self) -> bool {
        self.board.button_is_down
    }

    fn stroke(&self) -> u32 {
        self.board.carriage.mail.stroke
    }

    fn health(&self) -> RigHealth {
        RigHealth::default()
    }

    fn hardware(&self) -> RigHardware {
        RigHardware {
            enable_high_at_start: true,
            ..RigHardware::default()
        }
    }

    fn start(&mut self, order: Order) {
        self.board.carriage.order(order);
    }

    fn rearm_loop(&mut self) {}

    fn stop_path(&mut self) {
        self.board.carriage.stop();
    }

    fn cut(&mut self) {
        self.board.carriage.cut();
    }

    fn set_position(&mut self, position: StepPosition) {
        self.board.carriage.set_position(position);
    }

    fn set_switch_filter(&mut self, _: u32) {}

    /// Always false: no external clock comes up after the start.
    fn clock_has_come(&self) -> bool {
        false
    }

    fn restart(&mut self, _: &Retained, _: ResetCause) {
        unreachable!("no clock is missing");
    }
}

impl Rig {
    /// A rig that has just been switched on.
    pub fn new(port: &Port, flash: &Flash, previous: Retained, few_steps: bool) -> Self {
        let (mounted, place) = match few_steps {
            true => (crate::carriage::small(), FEW_STEPS_START),
            false => (Settings::REFERENCE, START),
        };
        Self::start(port, flash, previous, ResetCause::PowerOn, (mounted, place))
    }

    fn start(
        port: &Port,
        flash: &Flash,
        previous: Retained,
        cause: ResetCause,
        (mounted, place): (Settings, i32),
    ) -> Self {
        let mut board = Board {
            carriage: Carriage::new(mounted, place),
            button_is_down: false,
        };
        board.carriage.ring.ahead = Ahead::Slots;
        let port = port.clone();
        let at = At {
            port: port.clone(),
            board,
        };
        Self {
            control: Control::new(at, flash.clone(), previous, cause, IMAGE_HASH),
            flash: flash.clone(),
            port,
            next_control: CONTROL_ROUND,
            timer_stands: false,
            sampled: (0, StepPosition::HOME),
        }
    }

    fn carriage(&mut self) -> &mut Carriage {
        &mut self.control.rig().board.carriage
    }

    /// When the carriage next needs a step, ticks.
    fn carriage_due(&mut self) -> u64 {
        if self.timer_stands {
            self.carriage().next_round
        } else {
            self.carriage().due()
        }
    }

    /// Asserts that a homed rig never steps outside its stroke.
    fn assert_within_stroke(&mut self) {
        let counted = self.carriage().ring.counted;
        let stroke = self.control.snapshot().axis.stroke_window();
        if stroke.contains(StepPosition(counted)) {
            return;
        }
        let status = self.control.request(GetRigStatus.into_request());
        if let Reply::Accepted(Response::GetRigStatus(status)) = status {
            assert!(
                !status.homed,
                "a step to {counted} of {stroke:?}: {status:?}"
            );
        }
    }

    /// Steps the carriage; returns its notices.
    fn step(&mut self) -> Vec<Event<'static>> {
        let timer_stands = self.timer_stands;
        let carriage = self.carriage();
        if timer_stands {
            carriage.now = carriage.next_round;
            return carriage.motion_round();
        }
        let before = carriage.pulses;
        let notices = carriage.step();
        if carriage.pulses > before {
            self.assert_within_stroke();
        }
        notices
    }
}

impl Device for Rig {
    fn reset(&mut self, previous: Retained, cause: ResetCause) {
        let carriage = self.carriage();
        let stays = (carriage.mounted, carriage.place);
        *self = Self::start(&self.port, &self.flash, previous, cause, stays);
    }

    fn due_us(&mut self) -> u64 {
        self.carriage_due().min(self.next_control) / TICKS_PER_US
    }

    fn advance(&mut self, until_us: u64) {
        let until = until_us * TICKS_PER_US;
        loop {
            let due = self.carriage_due();
            if due.min(self.next_control) > until {
                self.carriage().now = until;
                return self.port.set_now_us(until_us);
            }
            if due <= self.next_control {
                let notices = self.step();
                if !notices.is_empty() {
                    self.port.set_now_us(due / TICKS_PER_US);
                }
                for notice in notices {
                    self.control.event(notice);
                }
            } else {
                self.carriage().now = self.next_control;
                self.port.set_now_us(self.next_control / TICKS_PER_US);
                self.next_control += CONTROL_ROUND;
                self.control.tick();
            }
        }
    }

    fn answer(&mut self, inbound: Inbound) -> Reply {
        if inbound == Inbound::Urgent(Urgent::EStop) {
            // The pulses end before control is notified.
            self.carriage().cut();
        }
        self.control.answer(inbound)
    }

    fn telemetry(&mut self) -> Option<Telemetry> {
        let snapshot = self.control.snapshot();
        let carriage = &self.control.rig().board.carriage;
        let (now, commanded_steps, stroke) = (
            carriage.observe(),
            carriage.mail.commanded,
            carriage.mail.stroke,
        );
        let (before_us, from) = std::mem::replace(&mut self.sampled, (now.time_us, now.position));
        let (steps, time_us) = (now.position.since(from), now.time_us - before_us);
        Some(Telemetry::Rig(RigTelemetry {
            time_us: now.time_us,
            state: snapshot.state,
            position_steps: now.position.0,
            commanded_steps,
            speed_um_s: snapshot.axis.mean_speed_um_s(steps, time_us),
            stroke,
            residual_steps: snapshot.residual_steps,
            inputs: now.inputs,
        }))
    }

    fn is_driven(&mut self) -> bool {
        let ring = &self.carriage().ring;
        ring.armed && ring.running
    }

    fn work(&mut self) -> u64 {
        self.carriage().pulses
    }

    fn world(&mut self, event: World) {
        match event {
            World::EStopLoop { open } => {
                let carriage = self.carriage();
                carriage.pressed = open;
                // While armed, the break input cuts the pulses and interrupts. At rest, control polls the loop.
                if open && carriage.ring.armed {
                    carriage.cut();
                    self.control.event(Event::LoopOpened);
                }
            }
            World::Button { down } => self.control.rig().board.button_is_down = down,
            World::TimerStands => self.timer_stands = true,
            World::Resume => self.control.event(Event::Command(&Command::Resume)),
            World::Reset | World::StopFrame | World::Battery { .. } => {
                unreachable!("{event:?} is of the device or the capsule")
            }
        }
    }
}
