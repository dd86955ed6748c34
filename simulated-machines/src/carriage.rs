//! A carriage on its screw, in virtual time, pulse by pulse. The real execution fills its step ring; switches and
//! read-back counter raise the events that they would raise on the board.
//!
//! [`Carriage`] is what stays the same whoever decides; [`Rig`] puts the state machine on top of it.

pub mod ring;

use device::settings::Values;
use firmware_rig::{
    execution::{Mailbox, Motion, Order, Pace},
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

/// Fingerprint of the image.
pub const IMAGE_HASH: u32 = 0xCAFE;

/// How often control looks at the clock, 10 ns each.
pub const CONTROL_ROUND: u64 = 1_000_000;

/// What comes with an event.
pub fn now(time_us: u64, position: i32, inputs: RigInputs) -> Now {
    Now {
        time_us,
        position: StepPosition(position),
        inputs,
        glitches: 0,
    }
}

/// The end of a path after its last step at tick 1.
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

/// What motion and control say to each other.
#[derive(Debug, Default)]
pub struct Mail {
    pub order: Option<Order>,
    pub stop: bool,
    pub cut: bool,
    /// Control takes no notices.
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

    fn show(&mut self, stroke: u32, commanded: StepPosition) {
        (self.stroke, self.commanded) = (stroke, commanded.0);
    }
}

/// A pulse that left the pin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pulse {
    /// When, 10 ns each.
    pub at: u64,
    pub direction: Direction,
    pub sync: bool,
}

/// Execution, ring, screw and switches, with everything that can go wrong with them.
pub struct Carriage {
    /// Where the switches are mounted.
    pub mounted: Settings,
    motion: Motion,
    pub mail: Mail,
    pub ring: Slots,
    /// When motion looks after the ring next, 10 ns each.
    pub next_round: u64,
    /// When the round that plays ends.
    round_end: Option<u64>,
    /// Where the carriage is, steps from the reference.
    pub place: i32,
    /// The home flag reads this, wherever the carriage is.
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
    /// False pulses on the switches since the start.
    pub glitches: u32,
    /// 10 ns each, since the start.
    pub now: u64,
    /// Pulses since the start.
    pub pulses: u64,
    /// When the last pulse was, 10 ns each.
    pub last_pulse: u64,
    /// All pulses, if a test wants them.
    pub trace: Option<Vec<Pulse>>,
    flag_open: bool,
}

impl Carriage {
    pub fn new(mounted: Settings, place: i32) -> Self {
        let mut carriage = Self {
            mounted,
            motion: Motion::default(),
            mail: Mail::default(),
            ring: Slots::new(),
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

    /// The end of travel, on either side, lies half an overtravel behind the stroke.
    fn beyond_end(&self) -> bool {
        let margin = self.mounted.overtravel.0 as i32 / 2;
        self.place < -margin || self.place > self.stroke() + margin
    }

    pub fn inputs(&self) -> RigInputs {
        let axis = &self.mounted.axis;
        let flag = self.place <= self.mounted.flag.0;
        // A millimetre behind the stroke.
        let limit = self.stroke() + (axis.steps_per_rev() * 1_000 / axis.lead().0) as i32;
        RigInputs {
            home_flag: self.stuck_flag.unwrap_or(flag),
            far_limit: self.far_wire_cut || self.place > limit,
            estop_loop: self.pressed || self.beyond_end(),
        }
    }

    /// What comes with an event.
    pub fn look(&self) -> Now {
        Now {
            glitches: self.glitches,
            ..now(self.now / 100, self.ring.counted, self.inputs())
        }
    }

    /// How soon motion wants to look after the ring again.
    pub fn pace(&self) -> Pace {
        self.motion.pace()
    }

    pub fn moving(&self) -> bool {
        self.pace() != Pace::Idle || self.mail.order.is_some()
    }

    /// Pulses that come whatever is ordered, unless they are cut.
    pub fn queued(&self) -> u64 {
        self.ring.rounds_left()
    }

    /// Orders a path.
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

    /// No further pulse.
    pub fn cut(&mut self) {
        self.ring.armed = false;
        self.mail.cut = true;
        self.wake();
    }

    pub fn set_position(&mut self, position: StepPosition) {
        assert!(!self.moving());
        self.ring.counted = position.0;
    }

    fn wake(&mut self) {
        self.next_round = self.now;
    }

    /// With nothing queued ahead: motion has to look after the ring before it can play.
    fn motion_is_due(&self) -> bool {
        self.ring.is_empty() || self.mail.cut
    }

    /// A round of motion. Its notices come back.
    pub fn motion_round(&mut self) -> Vec<Event<'static>> {
        self.ring.loop_open = self.inputs().estop_loop;
        self.motion.round(&mut self.ring, &mut self.mail);
        self.next_round = match self.pace() {
            Pace::Idle => u64::MAX,
            pace => self.now + 100 * pace.within_us(),
        };
        if self.round_end.is_none() && self.ring.plays() {
            self.round_end = Some(self.now);
        }
        std::mem::take(&mut self.mail.notices)
    }

    /// When [`Carriage::step`] is due next with a ring that queues ahead.
    pub fn due(&self) -> u64 {
        self.next_round.min(self.round_end.unwrap_or(u64::MAX))
    }

    /// Lets motion look after the ring if that is due; else plays the next round of the ring. What control hears of
    /// it comes back.
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
                    if self.ring.interrupts() {
                        self.wake();
                    }
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

/// The state machine on a carriage. Most tests look at the carriage, so a rig stands for it.
pub struct Rig {
    pub machine: Machine,
    pub carriage: Carriage,
    pub events: Vec<RigEvent>,
    /// Windows of all paths.
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

    /// A command; only an accepted one has actions.
    pub fn command(&mut self, command: Command) -> Result<(), Refusal> {
        let actions = self
            .machine
            .step(&self.carriage.look(), Event::Command(&command));
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
        let actions = self.machine.step(&self.carriage.look(), event);
        assert_eq!(actions.refusal, None, "only commands are refused");
        self.perform(actions);
    }

    /// The E-stop is pressed: the hardware cuts the pulses.
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
                    // What comes next finds the path begun.
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

    /// A round of motion, and what the machine hears of it.
    pub fn motion_round(&mut self) {
        let notices = self.carriage.motion_round();
        notices.into_iter().for_each(|notice| self.event(notice));
    }

    /// The carriage's step, and what the machine hears of it.
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

    /// Executes so many pulses, or all that are left.
    pub fn pulses(&mut self, pulses: u64) {
        let until = self.pulses + pulses;
        while self.pulses < until && self.moving() {
            self.step();
        }
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

/// A rig with few steps, 4 per mm, so that a test can afford many of them: 80 in its stroke of 20 mm, the flag at the
/// fourth.
pub const SMALL: [(SettingKey, u32); 4] = [
    (SettingKey::LeadUm, 50_000),
    (SettingKey::Microsteps, 1),
    (SettingKey::StrokeUm, 20_000),
    (SettingKey::LedgerLimitSteps, 1),
];

/// [`SMALL`] in force.
pub fn small() -> Settings {
    settings(&SMALL)
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
