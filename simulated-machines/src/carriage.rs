//! A carriage on its screw, simulated pulse by pulse in virtual time. The firmware's own execution fills the step
//! ring; switches and read-back counter raise the same events as on the board.
//!
//! [`Carriage`] is the mechanics with execution. [`Rig`] adds the state machine.

pub mod ring;

use device::settings::Values;
use firmware_rig::{
    execution::{Mailbox, MotionTask, Order, Pace},
    machine::{Action, Actions, Command, Event, Machine, Now, PathEnd, PathReport},
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
    settings::SettingKey,
};
use ring::{Ahead, Round, Slots};
use std::ops::{Deref, DerefMut};

/// All switches closed.
pub const CLOSED: RigInputs = RigInputs {
    home_flag: false,
    far_limit: false,
    estop_loop: false,
};

/// Image hash that the simulated firmware reports.
pub const IMAGE_HASH: u32 = 0xCAFE;

/// Interval of control's rounds, ticks of 10 ns.
pub const CONTROL_ROUND: u64 = 1_000_000;

/// Builds the clock, position and switch readings that accompany an event.
pub fn now(time_us: u64, position: i32, inputs: RigInputs) -> Now {
    Now {
        time_us,
        position: StepPosition(position),
        inputs,
        glitches: 0,
    }
}

/// The end of a path whose last step was emitted at tick 1.
pub fn path_ended(end: PathEnd, commanded: i32, counted: i32) -> Event<'static> {
    let report = PathReport {
        commanded: StepPosition(commanded),
        counted: StepPosition(counted),
        last_tick: 1,
        min_queue: Some(100),
        ..PathReport::default()
    };
    Event::PathEnded(end, report)
}

/// The end of a stroke.
pub fn stroke_done(stroke: u32, commanded: i32, counted: i32) -> Event<'static> {
    Event::StrokeDone {
        stroke,
        commanded: StepPosition(commanded),
        counted: StepPosition(counted),
    }
}

/// An edge of the home flag.
pub fn flag_edge(opening: bool, count: i32) -> Event<'static> {
    let count = StepPosition(count);
    Event::FlagEdge { opening, count }
}

/// The mailbox between motion and control.
#[derive(Debug, Default)]
pub struct Mail {
    pub order: Option<Order>,
    pub stop: bool,
    pub cut: bool,
    /// Control's queue is full: it accepts no notices.
    pub full: bool,
    pub notices: Vec<Event<'static>>,
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

    fn notify(&mut self, event: Event<'static>) -> bool {
        if !self.full {
            self.notices.push(event);
        }
        !self.full
    }

    fn publish(&mut self, stroke: u32, commanded: StepPosition) {
        (self.stroke, self.commanded) = (stroke, commanded.0);
    }
}

/// A pulse at the pin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pulse {
    /// Time of the pulse, ticks of 10 ns.
    pub at: u64,
    pub direction: Direction,
    pub sync: bool,
}

/// Execution, ring, screw and switches, with the defects that a test can inject.
pub struct Carriage {
    /// Where the switches are mounted.
    pub mounted: Settings,
    motion: MotionTask,
    pub mail: Mail,
    pub ring: Slots,
    /// When motion next services the ring, ticks of 10 ns.
    pub next_round: u64,
    /// When the round that is playing ends, ticks of 10 ns.
    round_end: Option<u64>,
    /// True position of the carriage, steps from the reference.
    pub place: i32,
    /// The home flag reads this value regardless of the position.
    pub stuck_flag: Option<bool>,
    /// The far limit reads open.
    pub far_wire_cut: bool,
    /// E-stop pressed.
    pub pressed: bool,
    /// The jumper to the read-back counter is missing.
    pub jumper_cut: bool,
    /// Number of coming pulses that do not move the carriage.
    pub slipping: u32,
    /// Number of times the flag bounces when it opens.
    pub bounces: u32,
    /// False pulses on the switches since the start.
    pub glitches: u32,
    /// Time since the start, ticks of 10 ns.
    pub now: u64,
    /// Pulses since the start.
    pub pulses: u64,
    /// Time of the last pulse, ticks of 10 ns.
    pub last_pulse: u64,
    /// Every pulse, if a test asks for a trace.
    pub trace: Option<Vec<Pulse>>,
    flag_open: bool,
}

impl Carriage {
    pub fn new(mounted: Settings, place: i32) -> Self {
        let mut carriage = Self {
            mounted,
            motion: MotionTask::default(),
            mail: Mail::default(),
            ring: Slots::default(),
            next_round: u64::MAX,
            round_end: None,
            place,
            stuck_flag: None,
            far_wire_cut: false,
            pressed: false,
            jumper_cut: false,
            slipping: 0,
            bounces: 0,
            glitches: 0,
            now: 0,
            pulses: 0,
            last_pulse: 0,
            trace: None,
            flag_open: false,
        };
        carriage.flag_open = carriage.inputs().home_flag;
        carriage
    }

    fn stroke(&self) -> i32 {
        self.mounted.axis.stroke_steps().0 as i32
    }

    /// The carriage is more than half the overtravel past either end of the stroke.
    fn beyond_end(&self) -> bool {
        let margin = self.mounted.overtravel.0 as i32 / 2;
        self.place < -margin || self.place > self.stroke() + margin
    }

    pub fn inputs(&self) -> RigInputs {
        let axis = &self.mounted.axis;
        let flag = self.place <= self.mounted.flag.0;
        // The far limit sits one millimetre past the end of the stroke.
        let limit = self.stroke() + (axis.steps_per_rev() * 1_000 / axis.lead().0) as i32;
        RigInputs {
            home_flag: self.stuck_flag.unwrap_or(flag),
            far_limit: self.far_wire_cut || self.place > limit,
            estop_loop: self.pressed || self.beyond_end(),
        }
    }

    /// The clock, position and switches as they are now.
    pub fn observe(&self) -> Now {
        Now {
            glitches: self.glitches,
            ..now(self.now / 100, self.ring.counted, self.inputs())
        }
    }

    /// Deadline of motion's next round.
    pub fn pace(&self) -> Pace {
        self.motion.pace()
    }

    pub fn moving(&self) -> bool {
        self.pace() != Pace::Idle || self.mail.order.is_some()
    }

    /// Pulses that only a cut of the output can still prevent.
    pub fn queued(&self) -> u64 {
        self.ring.rounds_remaining()
    }

    /// Orders a path. Panics if another one is still being executed.
    pub fn order(&mut self, order: Order) {
        assert!(!self.moving(), "a path while another one is executed");
        self.mail.order = Some(order);
        self.wake();
    }

    /// Orders to decelerate.
    pub fn stop(&mut self) {
        self.mail.stop = true;
        self.wake();
    }

    /// Cuts the pulses at once.
    pub fn cut(&mut self) {
        self.ring.armed = false;
        self.mail.cut = true;
        self.wake();
    }

    pub fn set_position(&mut self, position: StepPosition) {
        assert!(!self.moving());
        self.ring.counted = position.0;
        self.mail.commanded = position.0;
    }

    fn wake(&mut self) {
        self.next_round = self.now;
    }

    /// Nothing is queued, or a cut is pending: motion must service the ring before it can play on.
    fn motion_is_due(&self) -> bool {
        self.ring.is_empty() || self.mail.cut
    }

    /// Runs one round of motion and returns its notices.
    pub fn motion_round(&mut self) -> Vec<Event<'static>> {
        self.ring.loop_open = self.inputs().estop_loop;
        self.motion.round(&mut self.ring, &mut self.mail);
        self.next_round = match self.pace() {
            Pace::Idle => u64::MAX,
            pace => self.now + 100 * u64::from(pace.within_us()),
        };
        if self.round_end.is_none() && self.ring.plays() {
            self.round_end = Some(self.now);
        }
        std::mem::take(&mut self.mail.notices)
    }

    /// When [`Carriage::step`] is next due with [`Ahead::Slots`], ticks of 10 ns.
    pub fn due(&self) -> u64 {
        self.next_round.min(self.round_end.unwrap_or(u64::MAX))
    }

    /// Services the ring if motion is due; otherwise plays the next round. Returns the events for control.
    pub fn step(&mut self) -> Vec<Event<'static>> {
        match self.ring.ahead {
            Ahead::Nothing => {
                if self.motion_is_due() {
                    return self.motion_round();
                }
                let Some(round) = self.ring.begin_round() else {
                    return Vec::new();
                };
                let begun = self.now;
                self.now += u64::from(round.ticks);
                let events = self.play(begun, round);
                self.ring.end_period();
                events
            }
            Ahead::Slots => match self.round_end {
                Some(end) if end < self.next_round => {
                    assert!(self.now <= end, "the clock ran while the ring stood");
                    self.now = end;
                    self.round_end = None;
                    let Some(round) = self.ring.begin_round() else {
                        return Vec::new();
                    };
                    self.round_end = Some(end + u64::from(round.ticks));
                    self.play(end, round)
                }
                _ if self.next_round == u64::MAX => Vec::new(),
                _ => {
                    self.now = self.next_round;
                    self.motion_round()
                }
            },
        }
    }

    fn play(&mut self, begun: u64, round: Round) -> Vec<Event<'static>> {
        if !round.pulse {
            return Vec::new();
        }
        let direction = self.ring.direction;
        self.last_pulse = begun;
        self.ring.capture(begun);
        if let Some(trace) = &mut self.trace {
            trace.push(Pulse {
                at: begun,
                direction,
                sync: round.sync,
            });
        }
        self.pulse(direction)
    }

    fn pulse(&mut self, direction: Direction) -> Vec<Event<'static>> {
        let before = self.inputs();
        let step = direction.sign();
        let mut events = Vec::new();
        self.pulses += 1;
        if !self.jumper_cut {
            self.ring.counted += step;
        }
        if self.slipping > 0 {
            self.slipping -= 1;
        } else {
            self.place += step;
        }
        let inputs = self.inputs();
        if inputs.estop_loop && !before.estop_loop {
            self.cut();
            events.push(Event::LoopOpened);
        }
        if inputs.far_limit && !before.far_limit && direction == Direction::Away {
            self.cut();
            events.push(Event::FarLimit);
        }
        if inputs.home_flag != self.flag_open {
            self.flag_open = inputs.home_flag;
            let (open, count) = (inputs.home_flag, self.ring.counted);
            events.push(flag_edge(open, count));
            for bounce in 1..=self.bounces as i32 {
                events.push(flag_edge(!open, count + bounce * 20 * step));
                events.push(flag_edge(open, count + bounce * 40 * step));
            }
        }
        events
    }
}

/// The state machine on a carriage. Dereferences to the carriage, because most tests inspect it.
pub struct Rig {
    pub machine: Machine,
    pub carriage: Carriage,
    pub events: Vec<RigEvent>,
    /// Window of every path ordered so far.
    pub windows: Vec<(i32, i32)>,
}

impl Deref for Rig {
    type Target = Carriage;

    fn deref(&self) -> &Carriage {
        &self.carriage
    }
}

impl DerefMut for Rig {
    fn deref_mut(&mut self) -> &mut Carriage {
        &mut self.carriage
    }
}

impl Rig {
    /// A rig after power-on with its carriage at `place`.
    pub fn new(settings: Settings, place: i32) -> Self {
        Self {
            machine: Machine::new(settings, None, IMAGE_HASH),
            carriage: Carriage::new(settings, place),
            events: Vec::new(),
            windows: Vec::new(),
        }
    }

    /// A homed rig.
    pub fn homed(settings: Settings) -> Self {
        Self::homed_with(settings, Ahead::Nothing)
    }

    /// A homed rig whose ring queues ahead as `ahead` says.
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

    /// Gives a command. Asserts that a refused one causes no actions.
    pub fn command(&mut self, command: Command) -> Result<(), Refusal> {
        let before = self.fault();
        let actions = self
            .machine
            .step(&self.carriage.observe(), Event::Command(&command));
        let refusal = actions.refusal;
        if refusal.is_some() {
            // Exception: a command may latch a fault if it finds the carriage elsewhere.
            assert!(actions.list.is_empty() || self.fault() != before);
        }
        self.perform(actions);
        refusal.map_or(Ok(()), Err)
    }

    pub fn event(&mut self, event: Event) {
        let actions = self.machine.step(&self.carriage.observe(), event);
        assert_eq!(actions.refusal, None, "only commands are refused");
        self.perform(actions);
    }

    /// Presses the E-stop: the hardware cuts the pulses.
    pub fn press(&mut self) {
        self.pressed = true;
        self.cut();
        self.event(Event::LoopOpened);
    }

    pub fn perform(&mut self, actions: Actions) {
        for action in actions.list {
            match action {
                Action::Start { path, window } => {
                    let Window { first, last } = window;
                    self.windows.push((first.0, last.0));
                    let settings = *self.machine.settings();
                    self.order(Order {
                        path,
                        window,
                        stop_accel: settings.stop_accel,
                        pulse_ticks: settings.pulse_ticks,
                    });
                    // Start the path now, so that the next action finds it begun.
                    self.motion_round();
                }
                Action::StopPath => self.stop(),
                Action::Cut => {
                    self.cut();
                    if self.moving() {
                        self.motion_round();
                    }
                }
                Action::SetPosition(position) => self.set_position(position),
                Action::Emit(event) => self.events.push(event),
            }
        }
    }

    /// Runs one round of motion and passes its notices to the machine.
    pub fn motion_round(&mut self) {
        let notices = self.carriage.motion_round();
        notices.into_iter().for_each(|notice| self.event(notice));
    }

    /// Steps the carriage and passes its events to the machine.
    pub fn step(&mut self) {
        if self.ring.ahead == Ahead::Nothing && self.motion_is_due() {
            self.motion_round(); // and a round of the ring in the same step
        }
        let (start, pulses, homed) = (self.now, self.pulses, self.machine.homed());
        let may_move = matches!(
            self.machine.state(),
            RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping
        );
        let events = self.carriage.step();
        if self.pulses > pulses {
            assert!(may_move, "a pulse in {:?}", self.machine.state());
            if homed && !self.jumper_cut {
                assert!((0..=self.stroke()).contains(&self.ring.counted));
            }
        }
        events.into_iter().for_each(|event| self.event(event));
        if self.now / CONTROL_ROUND != start / CONTROL_ROUND {
            self.event(Event::Tick);
        }
    }

    /// Executes this number of pulses, or fewer if the motion ends.
    pub fn pulses(&mut self, pulses: u64) {
        let until = self.pulses + pulses;
        while self.pulses < until && self.moving() {
            self.step();
        }
    }

    /// Lets this many ticks of 10 ns pass. Panics if anything moves.
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

/// The defaults with some values changed, each within its range.
pub fn values(changes: &[(SettingKey, u32)]) -> Values {
    let change =
        |values: Values, (key, value): &(SettingKey, u32)| values.with(*key, *value).unwrap();
    changes.iter().fold(Values::DEFAULT, change)
}

/// The settings of these values.
pub fn settings(changes: &[(SettingKey, u32)]) -> Settings {
    Settings::new(&values(changes)).unwrap()
}

/// A rig with few steps, so that a test can afford many motions: 4 steps per mm, 80 in the 20 mm stroke, the flag at
/// the fourth.
pub const SMALL: [(SettingKey, u32); 4] = [
    (SettingKey::LeadUm, 50_000),
    (SettingKey::Microsteps, 1),
    (SettingKey::StrokeUm, 20_000),
    (SettingKey::MaxResidualSteps, 1),
];

/// The settings of [`SMALL`].
pub fn small() -> Settings {
    settings(&SMALL)
}

/// A plan that the rig's limits allow.
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

/// [`plan`] as a run command.
pub fn run(settings: &Settings, cycles: u16, stroke_um: u32, link_loss: LinkLossPolicy) -> Command {
    Command::Run {
        plan: plan(settings, cycles, stroke_um, 40_000),
        link_loss,
    }
}
