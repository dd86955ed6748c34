//! A carriage on its screw: carries out what the machine orders, pulse by pulse in virtual time, and answers with
//! the events that the switches and the read-back counter would raise. The real execution fills its step ring.

// Each test file uses a part of it.
#![allow(dead_code)]

pub mod ring;

use firmware_rig::{
    execution::{Mailbox, Motion, Order, Pace},
    machine::{Action, Actions, Command, Event, Machine, Now},
    settings::Settings,
};
use motion::{
    axis::Direction,
    run::{RunPlan, RunRequest, Timing},
    units::{StepPosition, Window},
};
use protocol::{
    error::Refusal,
    rig::{LinkLossPolicy, RigEvent, RigFault, RigInputs, RigState},
};
use ring::{Ahead, Slots};

/// All switches closed.
pub const CLOSED: RigInputs = RigInputs {
    home_flag: false,
    far_limit: false,
    estop_loop: false,
};

/// What the machine is told of a carriage at rest.
pub fn now(time_us: u64, position: i32, inputs: RigInputs) -> Now {
    Now {
        time_us,
        position: StepPosition(position),
        inputs,
        glitches: 0,
    }
}

/// What motion and control say to each other.
#[derive(Debug, Default)]
pub struct Mail {
    order: Option<Order>,
    stop: bool,
    cut: bool,
    notices: Vec<Event>,
    pub stroke: u32,
    pub commanded: i32,
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

/// The rig: machine, execution, carriage, faults.
pub struct Rig {
    pub machine: Machine,
    motion: Motion,
    pub mail: Mail,
    pub ring: Slots,
    /// When motion looks after the ring next, 10 ns each.
    next_round: u64,
    /// Where the carriage is, steps from where the reference lies.
    pub place: i32,
    /// The home flag reads this, whatever the carriage does.
    pub stuck_flag: Option<bool>,
    /// The far limit reads open.
    pub far_wire_cut: bool,
    /// E-stop pressed.
    pub pressed: bool,
    /// The jumper to the read-back counter is missing.
    pub jumper_cut: bool,
    /// So many of the next pulses do not move the carriage.
    pub slipping: u32,
    /// So many times does the flag bounce when it opens.
    pub bounces: u32,
    /// 10 ns each, since the start.
    pub now: u64,
    /// Pulses since the start.
    pub pulses: u64,
    /// When the last pulse was, 10 ns each.
    pub last_pulse: u64,
    pub events: Vec<RigEvent>,
    /// Windows of all paths.
    pub windows: Vec<(i32, i32)>,
    flag_open: bool,
}

impl Rig {
    /// A rig after power-on with its carriage at `place`.
    pub fn new(settings: Settings, place: i32) -> Self {
        let mut rig = Self {
            machine: Machine::new(settings, None, 0),
            motion: Motion::new(),
            mail: Mail::default(),
            ring: Slots::new(),
            next_round: 0,
            place,
            stuck_flag: None,
            far_wire_cut: false,
            pressed: false,
            jumper_cut: false,
            slipping: 0,
            bounces: 0,
            now: 0,
            pulses: 0,
            last_pulse: 0,
            events: Vec::new(),
            windows: Vec::new(),
            flag_open: false,
        };
        rig.flag_open = rig.inputs().home_flag;
        rig
    }

    /// The same, homed.
    pub fn homed(settings: Settings) -> Self {
        Self::homed_with(settings, Ahead::Nothing)
    }

    /// The same with a ring that queues ahead.
    pub fn homed_with(settings: Settings, ahead: Ahead) -> Self {
        let mut rig = Self::new(settings, settings.flag.0 + 10);
        rig.ring.ahead = ahead;
        rig.command(Command::Home).unwrap();
        rig.finish();
        assert_eq!(rig.machine.state(), RigState::Ready);
        assert_eq!((rig.place, rig.ring.counted), (0, 0));
        rig.events.clear();
        rig.windows.clear();
        rig.pulses = 0;
        rig.ring.cut = 0;
        rig
    }

    /// The read-back counter.
    pub fn counted(&self) -> i32 {
        self.ring.counted
    }

    fn stroke(&self) -> i32 {
        self.machine.settings().axis.stroke_steps().0 as i32
    }

    /// The end of travel, on either side, lies half an overtravel behind the stroke.
    fn beyond_end(&self) -> bool {
        let margin = self.machine.settings().overtravel.0 as i32 / 2;
        self.place < -margin || self.place > self.stroke() + margin
    }

    pub fn inputs(&self) -> RigInputs {
        let settings = self.machine.settings();
        let flag = self.place <= settings.flag.0;
        // A millimetre behind the stroke.
        let limit =
            self.stroke() + (settings.axis.steps_per_rev() * 1_000 / settings.axis.lead().0) as i32;
        RigInputs {
            home_flag: self.stuck_flag.unwrap_or(flag),
            far_limit: self.far_wire_cut || self.place > limit,
            estop_loop: self.pressed || self.beyond_end(),
        }
    }

    fn now(&self) -> Now {
        now(self.now / 100, self.ring.counted, self.inputs())
    }

    /// A command; only an accepted one has actions.
    pub fn command(&mut self, command: Command) -> Result<(), Refusal> {
        let now = self.now();
        let actions = self.machine.step(&now, Event::Command(command));
        let refusal = actions.refusal;
        if refusal.is_some() {
            // A resume looks first whether the carriage is where it was held.
            let found = command == Command::Resume && self.machine.state() == RigState::Faulted;
            assert!(actions.list.is_empty() || found);
        }
        self.perform(actions);
        refusal.map_or(Ok(()), Err)
    }

    pub fn event(&mut self, event: Event) {
        let now = self.now();
        let actions = self.machine.step(&now, event);
        self.perform(actions);
    }

    /// The E-stop is pressed: the hardware cuts the pulses.
    pub fn press(&mut self) {
        self.pressed = true;
        self.cut();
        self.event(Event::LoopOpened);
    }

    pub fn moving(&self) -> bool {
        self.motion.pace() != Pace::Idle || self.mail.order.is_some()
    }

    fn cut(&mut self) {
        self.ring.armed = false;
        self.mail.cut = true;
        self.next_round = self.now;
    }

    pub fn perform(&mut self, actions: Actions) {
        for action in actions.list {
            match action {
                Action::Start { path, window } => {
                    assert!(!self.moving(), "a path while another one is executed");
                    let Window { first, last } = window;
                    self.windows.push((first.0, last.0));
                    let settings = self.machine.settings();
                    self.mail.order = Some(Order {
                        path,
                        window,
                        stop_accel: settings.stop_accel,
                        pulse_ticks: settings.pulse_ticks,
                    });
                    self.next_round = self.now;
                    if self.ring.ahead == Ahead::Nothing {
                        self.round();
                    }
                }
                Action::StopPath => {
                    self.mail.stop = true;
                    self.next_round = self.now;
                }
                Action::Cut => {
                    self.cut();
                    if self.ring.ahead == Ahead::Nothing && self.moving() {
                        self.round();
                    }
                }
                Action::SetPosition(position) => {
                    assert!(!self.moving());
                    self.ring.counted = position.0;
                }
                Action::Emit(event) => self.events.push(event),
            }
        }
    }

    /// A round of motion, and what control hears of it.
    fn round(&mut self) {
        self.ring.loop_open = self.inputs().estop_loop;
        self.motion.round(&mut self.ring, &mut self.mail);
        self.next_round = self.now
            + match self.motion.pace() {
                Pace::Idle => u64::from(u32::MAX),
                Pace::Filled => 200_000,
                Pace::Waiting => 10_000,
            };
        for notice in std::mem::take(&mut self.mail.notices) {
            self.event(notice);
        }
    }

    /// Lets motion look after the ring if that is due, then plays a round of it.
    pub fn step(&mut self) {
        let due = match self.ring.ahead {
            Ahead::Nothing => self.ring.is_empty() || self.mail.cut,
            Ahead::Slots => self.now >= self.next_round,
        };
        if due {
            self.round();
        }
        let direction = self.ring.direction;
        let start = self.now;
        let Some((ticks, pulse)) = self.ring.play() else {
            if self.ring.ahead == Ahead::Slots && self.moving() {
                self.now = self.next_round;
            }
            return;
        };
        self.now += u64::from(ticks);
        if pulse {
            self.last_pulse = start;
            self.pulse(direction);
        }
        let round = 1_000_000; // 10 ms, as control's
        if self.now / round != start / round {
            self.event(Event::Tick);
        }
    }

    fn pulse(&mut self, direction: Direction) {
        let before = self.inputs();
        let step = direction.sign();
        assert!(matches!(
            self.machine.state(),
            RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping
        ));
        self.pulses += 1;
        if !self.jumper_cut {
            self.ring.counted += step;
        }
        if self.slipping > 0 {
            self.slipping -= 1;
        } else {
            self.place += step;
        }
        if self.machine.homed() && !self.jumper_cut {
            assert!((0..=self.stroke()).contains(&self.ring.counted));
        }
        let inputs = self.inputs();
        if inputs.estop_loop && !before.estop_loop {
            self.cut();
            self.event(Event::LoopOpened);
        }
        if inputs.far_limit && !before.far_limit && direction == Direction::Away {
            self.cut();
            self.event(Event::FarLimit);
        }
        if inputs.home_flag != self.flag_open {
            self.flag_open = inputs.home_flag;
            self.flag_edge(inputs.home_flag, self.ring.counted);
            for bounce in 1..=self.bounces as i32 {
                self.flag_edge(!inputs.home_flag, self.ring.counted + bounce * 20 * step);
                self.flag_edge(inputs.home_flag, self.ring.counted + bounce * 40 * step);
            }
        }
    }

    fn flag_edge(&mut self, opening: bool, count: i32) {
        let count = StepPosition(count);
        self.event(Event::FlagEdge { opening, count });
    }

    /// Executes so many pulses, or all that are left.
    pub fn pulses(&mut self, pulses: u64) {
        let until = self.pulses + pulses;
        while self.pulses < until && self.moving() {
            self.step();
        }
    }

    /// Pulses that come whatever is ordered, unless they are cut.
    pub fn queued(&self) -> u64 {
        self.ring.rounds_left()
    }

    /// Waits so long while nothing moves, 10 ns each.
    pub fn wait(&mut self, ticks: u64) {
        assert!(!self.moving());
        self.now += ticks;
        self.event(Event::Tick);
    }

    /// Executes until nothing moves.
    pub fn finish(&mut self) {
        while self.moving() {
            self.step();
        }
    }

    pub fn fault(&self) -> Option<RigFault> {
        self.machine.fault()
    }
}

/// A plan within the rig's limits.
pub fn plan(settings: &Settings, cycles: u16, stroke_um: u32, speed_um_s: u32) -> RunPlan {
    let request = RunRequest {
        cycles,
        stroke_um,
        timing: Timing::Speeds {
            forward_um_s: speed_um_s,
            return_um_s: speed_um_s,
            accel_um_s2: 1_000_000,
        },
        far_dwell_us: 5_000,
        home_dwell_us: 5_000,
        start_delay_us: 0,
    };
    RunPlan::solve(&settings.axis, &settings.limits, &request).unwrap()
}

/// The same as a command.
pub fn run(settings: &Settings, cycles: u16, stroke_um: u32, link_loss: LinkLossPolicy) -> Command {
    Command::Run {
        plan: plan(settings, cycles, stroke_um, 40_000),
        link_loss,
    }
}
