//! A carriage on its screw: carries out what the machine orders, pulse by pulse in virtual time, and answers with
//! the events that the switches, the read-back counter and the step generator would raise.

// Each test file uses a part of it.
#![allow(dead_code)]

use firmware_rig::{
    machine::{Action, Actions, Command, Event, Machine, PathEnd, PathReport},
    periods::{Item, Period, Periods},
    settings::Settings,
};
use motion::{
    axis::Direction,
    run::{RunPlan, RunRequest, Timing},
};
use protocol::{
    error::Refusal,
    rig::{LinkLossPolicy, RigEvent, RigFault, RigInputs, RigState},
};

/// All switches closed.
pub const CLOSED: RigInputs = RigInputs {
    home_flag: false,
    far_limit: false,
    estop_loop: false,
};

/// The rig: machine, carriage, faults.
pub struct Rig {
    pub machine: Machine,
    /// Where the carriage is, steps from where the reference lies.
    pub place: i32,
    /// The read-back counter.
    pub counted: i32,
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
    /// Pulses that were handed out and cut, since the start.
    pub cut: u64,
    /// 10 ns each, since the start.
    pub now: u64,
    /// Pulses since the start.
    pub pulses: u64,
    /// When the last pulse was, 10 ns each.
    pub last_pulse: u64,
    pub events: Vec<RigEvent>,
    /// Windows of all paths.
    pub windows: Vec<(i32, i32)>,
    path: Option<Periods>,
    /// Rounds of the period in progress that are still to come.
    rounds: Option<Period>,
    stopping: bool,
    flag_open: bool,
}

impl Rig {
    /// A rig after power-on with its carriage at `place`.
    pub fn new(settings: Settings, place: i32) -> Self {
        let mut rig = Self {
            machine: Machine::new(settings, None),
            place,
            counted: 0,
            stuck_flag: None,
            far_wire_cut: false,
            pressed: false,
            jumper_cut: false,
            slipping: 0,
            bounces: 0,
            cut: 0,
            now: 0,
            pulses: 0,
            last_pulse: 0,
            events: Vec::new(),
            windows: Vec::new(),
            path: None,
            rounds: None,
            stopping: false,
            flag_open: false,
        };
        rig.flag_open = rig.inputs().home_flag;
        rig
    }

    /// The same, homed.
    pub fn homed(settings: Settings) -> Self {
        let mut rig = Self::new(settings, settings.flag_steps() + 10);
        rig.command(Command::Home).unwrap();
        rig.finish();
        assert_eq!(rig.machine.state(), RigState::Ready);
        assert_eq!((rig.place, rig.counted), (0, 0));
        rig.events.clear();
        rig.windows.clear();
        rig.pulses = 0;
        rig
    }

    fn stroke(&self) -> i32 {
        self.machine.settings().axis.stroke_steps().0 as i32
    }

    /// The end of travel, on either side, lies half an overtravel behind the stroke.
    fn beyond_end(&self) -> bool {
        let settings = self.machine.settings();
        let margin = settings.steps(settings.overtravel_um) / 2;
        self.place < -margin || self.place > self.stroke() + margin
    }

    pub fn inputs(&self) -> RigInputs {
        let flag = self.place <= self.machine.settings().flag_steps();
        RigInputs {
            home_flag: self.stuck_flag.unwrap_or(flag),
            far_limit: self.far_wire_cut
                || self.place > self.stroke() + self.machine.settings().steps(1_000),
            estop_loop: self.pressed || self.beyond_end(),
        }
    }

    /// A command; only an accepted one has actions.
    pub fn command(&mut self, command: Command) -> Result<(), Refusal> {
        let mut actions = Actions::new();
        let (now_us, inputs) = (self.now / 100, self.inputs());
        let result = self
            .machine
            .command(now_us, command, self.counted, inputs, &mut actions);
        if result.is_err() {
            // A resume looks first whether the carriage is where it was held.
            let found = command == Command::Resume && self.machine.state() == RigState::Faulted;
            assert!(actions.is_empty() || found);
        }
        self.perform(actions);
        result
    }

    pub fn event(&mut self, event: Event) {
        let actions = self.machine.event(event, self.inputs());
        self.perform(actions);
    }

    /// The host falls silent, or the button is pressed.
    pub fn press(&mut self) {
        self.pressed = true;
        self.event(Event::LoopOpened);
    }

    pub fn moving(&self) -> bool {
        self.path.is_some()
    }

    pub fn perform(&mut self, actions: Actions) {
        for action in actions {
            match action {
                Action::Start { path, window } => {
                    assert!(self.path.is_none(), "a path while another one is executed");
                    self.windows.push(window);
                    self.path = Periods::new(path, self.counted, window);
                    self.stopping = false;
                }
                Action::StopPath => {
                    let settings = self.machine.settings();
                    let stop = settings.axis.acceleration(settings.stop_accel_um_s2);
                    if let Some(periods) = &mut self.path {
                        periods.stop(stop.unwrap());
                        self.stopping = true;
                    }
                }
                Action::Cut => self.end(PathEnd::Cut),
                Action::SetPosition(position) => {
                    assert!(self.path.is_none());
                    self.counted = position;
                }
                Action::Emit(event) => self.events.push(event),
            }
        }
    }

    fn end(&mut self, end: PathEnd) {
        self.cut += self.handed_out();
        self.rounds = None;
        if let Some(periods) = self.path.take() {
            let report = PathReport {
                commanded: periods.position(),
                counted: self.counted,
                last_tick: periods.last_step(),
                min_queue: 60,
            };
            self.event(Event::PathEnded(end, report));
        }
    }

    /// Executes the next round of a period, or a turn.
    pub fn step(&mut self) {
        let Some(periods) = &mut self.path else {
            return;
        };
        let direction = periods.direction();
        let item = match self.rounds.take() {
            Some(period) => Item::Period(period),
            None => periods.next_item(),
        };
        match item {
            Item::Period(period) => {
                self.rounds = period
                    .repeats
                    .checked_sub(1)
                    .map(|repeats| Period { repeats, ..period });
                self.now += u64::from(period.ticks);
                if period.pulse {
                    self.last_pulse = self.now - u64::from(period.ticks);
                    self.pulse(direction);
                }
                let round = 1_000_000; // 10 ms, as control's
                if self.now / round != (self.now - u64::from(period.ticks)) / round {
                    let now_us = self.now / 100;
                    self.event(Event::Tick { now_us });
                }
            }
            Item::Turn { completed, .. } => {
                let (commanded, counted) = (periods.position(), self.counted);
                self.event(Event::StrokeDone {
                    stroke: completed,
                    commanded,
                    counted,
                });
            }
            Item::End => self.end(if self.stopping {
                PathEnd::Stopped
            } else {
                PathEnd::Complete
            }),
            Item::Guard => self.end(PathEnd::Guard),
        }
    }

    fn pulse(&mut self, direction: Direction) {
        let before = self.inputs();
        let step = if direction == Direction::Away { 1 } else { -1 };
        assert!(matches!(
            self.machine.state(),
            RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping
        ));
        self.pulses += 1;
        if !self.jumper_cut {
            self.counted += step;
        }
        if self.slipping > 0 {
            self.slipping -= 1;
        } else {
            self.place += step;
        }
        if self.machine.homed() && !self.jumper_cut {
            assert!((0..=self.stroke()).contains(&self.counted));
        }
        let inputs = self.inputs();
        if inputs.estop_loop && !before.estop_loop {
            self.event(Event::LoopOpened);
        }
        if inputs.far_limit && !before.far_limit && direction == Direction::Away {
            self.event(Event::FarLimit);
        }
        if inputs.home_flag != self.flag_open {
            self.flag_open = inputs.home_flag;
            self.flag_edge(inputs.home_flag, self.counted);
            for bounce in 1..=self.bounces as i32 {
                self.flag_edge(!inputs.home_flag, self.counted + bounce * 20 * step);
                self.flag_edge(inputs.home_flag, self.counted + bounce * 40 * step);
            }
        }
    }

    fn flag_edge(&mut self, opening: bool, count: i32) {
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
    pub fn handed_out(&self) -> u64 {
        self.rounds
            .map_or(0, |period| u64::from(period.repeats) + 1)
    }

    /// Waits so long while nothing moves, 10 ns each.
    pub fn wait(&mut self, ticks: u64) {
        assert!(!self.moving());
        self.now += ticks;
        let now_us = self.now / 100;
        self.event(Event::Tick { now_us });
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
