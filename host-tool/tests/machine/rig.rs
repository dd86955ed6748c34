//! The rig in virtual time: the firmware's control and execution on a step ring, a carriage, switches and button.

#[path = "../../../firmware-rig/tests/carriage/ring.rs"]
mod ring;

use device::identity::identity;
use device::retained::{self, EStop, WORDS};
use device::service::Inbound;
use firmware_rig::control::{self, Control, ROUND_US};
use firmware_rig::execution::{Mailbox, Motion, Order, Pace};
use firmware_rig::machine::{Event, Now};
use firmware_rig::settings::Settings;
use motion::axis::Direction;
use motion::units::{StepPosition, Steps};
use protocol::rig::{Glitches, RigHealth, RigInputs, RigTelemetry};
use protocol::system::{self, DeviceKind, Identity, ResetCause, Urgent};
use protocol::table::{Reply, Telemetry};

use super::flash::{Flash, Retained};
use super::port::Port;
use super::{Device, UID, World};
use ring::{Ahead, Slots};

/// Ticks of 10 ns per us.
const TICKS_PER_US: u64 = 100;
/// Fingerprint of the image.
const IMAGE_HASH: u32 = 0xCAFE;
/// Where the carriage stands when the rig is switched on, steps from the reference: 5 mm.
const START: i32 = 4_000;

/// A rig.
pub struct Rig {
    control: Control<Board, Flash>,
    flash: Flash,
    identity: Identity,
    /// When control's next round is due, ticks.
    next_control: u64,
}

/// Everything but control.
struct Board {
    port: Port,
    /// Since the start of the device, ticks.
    now: u64,
    motion: Motion,
    /// When motion's next round is due, ticks.
    next_motion: u64,
    mail: Mail,
    ring: Slots,
    /// When the round of the ring that plays ends, ticks.
    round_end: Option<u64>,
    carriage: Carriage,
    retained: Retained,
    /// Time and position of the last sample of telemetry.
    sampled: (u64, StepPosition),
}

/// What a reset does not change.
#[derive(Clone, Copy)]
struct Carriage {
    /// Steps from the reference.
    place: i32,
    /// Edge of the home flag and of the far limit.
    flag: i32,
    limit: i32,
    loop_open: bool,
    button_down: bool,
    timer_stands: bool,
}

impl Carriage {
    fn inputs(&self) -> RigInputs {
        RigInputs {
            home_flag: self.place <= self.flag,
            far_limit: self.place > self.limit,
            estop_loop: self.loop_open,
        }
    }
}

/// What motion and control say to each other.
#[derive(Default)]
struct Mail {
    order: Option<Order>,
    stop: bool,
    cut: bool,
    notices: Vec<Event>,
    stroke: u32,
    commanded: i32,
}

impl Mailbox for Mail {
    fn take_order(&mut self) -> Option<Order> {
        let order = self.order.take()?;
        (self.stop, self.cut) = (false, false);
        Some(order)
    }

    fn is_cut(&self) -> bool {
        self.cut
    }

    fn take_stop(&mut self) -> bool {
        std::mem::take(&mut self.stop)
    }

    fn notify(&mut self, event: Event) -> bool {
        self.notices.push(event);
        true
    }

    fn show(&mut self, stroke: u32, commanded: StepPosition) {
        (self.stroke, self.commanded) = (stroke, commanded.0);
    }
}

impl Board {
    fn new(carriage: Carriage, retained: Retained) -> Self {
        let mut ring = Slots::new();
        ring.ahead = Ahead::Slots;
        Self {
            port: Port::default(),
            now: 0,
            motion: Motion::new(),
            next_motion: u64::MAX,
            mail: Mail::default(),
            ring,
            round_end: None,
            carriage,
            retained,
            sampled: (0, StepPosition::HOME),
        }
    }

    fn now_us(&self) -> u64 {
        self.now / TICKS_PER_US
    }

    fn next_pulse(&self) -> u64 {
        match self.round_end {
            Some(end) if !self.carriage.timer_stands => end,
            _ => u64::MAX,
        }
    }

    /// A round of motion. Its notices come back.
    fn motion_round(&mut self) -> Vec<Event> {
        self.ring.loop_open = self.carriage.loop_open;
        self.motion.round(&mut self.ring, &mut self.mail);
        self.next_motion = match self.motion.pace() {
            Pace::Idle => u64::MAX,
            Pace::Filled => self.now + 2_000 * TICKS_PER_US,
            Pace::Waiting => self.now + 100 * TICKS_PER_US,
        };
        self.round_end = match self.round_end {
            _ if !self.ring.plays() => None,
            None => Some(self.now),
            end => end,
        };
        std::mem::take(&mut self.mail.notices)
    }

    /// The next round of the ring begins. What the switches say to it comes back.
    fn play(&mut self) -> Option<Event> {
        let Some(round) = self.ring.begin_round() else {
            self.round_end = None;
            return None;
        };
        self.round_end = Some(self.now + u64::from(round.ticks));
        if self.ring.interrupts() {
            self.wake();
        }
        if !round.pulse {
            return None;
        }
        let before = self.carriage.inputs();
        let direction = self.ring.direction;
        self.ring.counted += direction.sign();
        self.carriage.place += direction.sign();
        let inputs = self.carriage.inputs();
        if inputs.far_limit && !before.far_limit && direction == Direction::Away {
            self.cut_pulses();
            return Some(Event::FarLimit);
        }
        let (opening, count) = (inputs.home_flag, StepPosition(self.ring.counted));
        (opening != before.home_flag).then_some(Event::FlagEdge { opening, count })
    }

    fn wake(&mut self) {
        self.next_motion = self.now;
    }

    /// No further pulse, and motion hears of it.
    fn cut_pulses(&mut self) {
        self.ring.armed = false;
        self.mail.cut = true;
        self.wake();
    }
}

impl control::Rig for Board {
    fn now(&self) -> Now {
        Now {
            time_us: self.now_us(),
            position: StepPosition(self.ring.counted),
            inputs: self.carriage.inputs(),
            glitches: 0,
        }
    }

    fn button_is_down(&self) -> bool {
        self.carriage.button_down
    }

    fn stroke(&self) -> u32 {
        self.mail.stroke
    }

    fn silence_us(&self) -> u32 {
        self.port.silence_us(self.now_us())
    }

    fn health(&self) -> RigHealth {
        let no_glitches = Glitches {
            count: 0,
            last_us: 0,
        };
        RigHealth {
            home_flag: no_glitches,
            far_limit: no_glitches,
            uart_errors: 0,
            bad_frames: 0,
            unsent_frames: 0,
            stack_used: 0,
            stack_size: 0,
            underruns: 0,
            control_late_us: 0,
            image_hash: 0,
        }
    }

    fn start(&mut self, order: Order) {
        self.mail.order = Some(order);
        self.wake();
    }

    fn stop_path(&mut self) {
        self.mail.stop = true;
        self.wake();
    }

    fn cut(&mut self) {
        self.cut_pulses();
    }

    fn set_position(&mut self, position: StepPosition) {
        self.ring.counted = position.0;
    }

    fn set_telemetry(&mut self, period_ms: u16) {
        self.port.set_telemetry(self.now_us(), period_ms);
    }

    fn set_switch_filter(&mut self, _: u32) {}

    fn keep_latched(&mut self, estop: Option<EStop>) {
        retained::keep_latched(&mut self.retained, estop);
    }

    fn tell(&mut self, event: &system::Event) {
        self.port.tell(self.now_us(), event);
    }
}

impl Rig {
    /// A rig that has just been switched on.
    pub fn new(flash: &Flash) -> Self {
        let settings = Settings::new(flash.settings().values()).expect("a possible rig");
        let carriage = Carriage {
            place: START,
            flag: settings.flag.0,
            // A millimetre behind the stroke.
            limit: settings.axis.stroke_steps().0 as i32 + 800,
            loop_open: false,
            button_down: false,
            timer_stands: false,
        };
        let retained = Retained([0; WORDS]);
        Self::start(flash, carriage, retained, ResetCause::PowerOn)
    }

    fn start(flash: &Flash, carriage: Carriage, mut retained: Retained, cause: ResetCause) -> Self {
        let left = retained::start(&mut retained);
        let identity = identity(DeviceKind::Rig, UID, left.boot_id, cause);
        let board = Board::new(carriage, retained);
        Self {
            control: Control::new(board, flash.clone(), left, cause, IMAGE_HASH),
            flash: flash.clone(),
            identity,
            next_control: ROUND_US * TICKS_PER_US,
        }
    }
}

impl Device for Rig {
    fn identity(&self) -> Identity {
        self.identity
    }

    fn reset(&mut self, cause: ResetCause) {
        let board = self.control.rig();
        let retained = Retained(board.retained.0);
        *self = Self::start(&self.flash.clone(), board.carriage, retained, cause);
    }

    fn port(&mut self) -> &mut Port {
        &mut self.control.rig().port
    }

    fn due_us(&mut self) -> u64 {
        let board = self.control.rig();
        let due = board.next_pulse().min(board.next_motion);
        due.min(self.next_control) / TICKS_PER_US
    }

    fn live(&mut self, until_us: u64) {
        let until = until_us * TICKS_PER_US;
        loop {
            let board = self.control.rig();
            let pulse = board.next_pulse();
            let due = pulse.min(board.next_motion).min(self.next_control);
            if due > until {
                board.now = until;
                return;
            }
            board.now = due;
            if due == pulse {
                if let Some(event) = board.play() {
                    self.control.event(event);
                }
            } else if due == board.next_motion {
                for notice in board.motion_round() {
                    self.control.event(notice);
                }
            } else {
                self.next_control += ROUND_US * TICKS_PER_US;
                self.control.tick();
            }
        }
    }

    fn answer(&mut self, inbound: Inbound) -> Reply {
        if inbound == Inbound::Urgent(Urgent::EStop) {
            // The pulses end before control hears of it.
            self.control.rig().cut_pulses();
        }
        self.control.answer(inbound)
    }

    fn telemetry(&mut self) -> Option<Telemetry> {
        let snapshot = self.control.snapshot();
        let board = self.control.rig();
        let (now_us, position) = (board.now_us(), StepPosition(board.ring.counted));
        let (before_us, from) = std::mem::replace(&mut board.sampled, (now_us, position));
        let steps = position.since(from);
        let nm = snapshot.axis.length_of(Steps(steps.unsigned_abs())).0;
        let speed_um_s = (nm * 1_000 / (now_us - before_us).max(1)) as i32;
        Some(Telemetry::Rig(RigTelemetry {
            time_us: now_us,
            state: snapshot.state,
            position_steps: position.0,
            commanded_steps: board.mail.commanded,
            speed_um_s: speed_um_s * steps.signum(),
            stroke: board.mail.stroke,
            residual_steps: snapshot.residual_steps,
            inputs: board.carriage.inputs(),
        }))
    }

    fn world(&mut self, event: World) {
        let board = self.control.rig();
        match event {
            World::EStopLoop { open } => {
                board.carriage.loop_open = open;
                // The break input cuts the pulses and interrupts; at rest, control looks at the loop.
                if open && board.ring.armed {
                    board.cut_pulses();
                    self.control.event(Event::LoopOpened);
                }
            }
            World::Button { down } => board.carriage.button_down = down,
            World::TimerStands => board.carriage.timer_stands = true,
            World::Reset | World::StopFrame => {}
        }
    }
}
