//! The rig's state machine: events in, actions out. Pure; the time is an argument.
//!
//! ```text
//! Unhomed --home--> Homing --found--> Ready --run--> Running --complete--> Ready
//!    Ready --jog, move--> Moving --there--> Ready
//!    Running --hold--> Stopping --at rest--> Held --resume--> Running
//!    Homing, Running, Moving --stop--> Stopping --at rest--> Unhomed, Ready
//!    any --fault--> Faulted --acknowledge--> Unhomed
//! ```
//!
//! A fault is latched, and after it the position is unknown until homed again. Neither a release of the
//! E-stop nor a reset nor a new connection moves anything: only an accepted command does.

use crate::{periods::Path, settings::Settings};
use motion::{
    axis::{Direction, Position, Speed},
    run::RunPlan,
    trapezoid::StrokeProfile,
    units::Steps,
};
use protocol::{
    error::Refusal,
    rig::{
        HomingPhase, LinkLossPolicy, RigEvent, RigFault, RigInputs, RigState, RunOutcome, RunRecord,
    },
};

/// What the motion task reports when a path has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathEnd {
    /// All steps were emitted.
    Complete,
    /// Decelerated to rest on request.
    Stopped,
    /// The pulses were cut (E-stop loop, far limit, E-stop frame).
    Cut,
    /// The queue ran dry.
    Underrun,
    /// A step outside the window was refused.
    Guard,
}

/// Counters of a path at its end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PathReport {
    /// Position by the generator.
    pub commanded: i32,
    /// Position by the read-back counter.
    pub counted: i32,
    /// Tick of the last step, from the path's start.
    pub last_tick: u64,
    /// Shortest queue seen while periods were still to come.
    pub min_queue: u16,
}

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The home flag changed, filtered; `count` was the read-back position at the edge.
    FlagEdge {
        /// Opened (actuated).
        opening: bool,
        /// Read-back position at the edge.
        count: i32,
    },
    /// The far limit opened while the carriage moved away from home. The pulses are already cut.
    FarLimit,
    /// The E-stop loop opened. The pulses are already cut, by hardware.
    LoopOpened,
    /// A stroke of a run is complete and its last pulse has left.
    StrokeDone {
        /// From 0.
        stroke: u32,
        /// Position by the generator.
        commanded: i32,
        /// Position by the read-back counter.
        counted: i32,
    },
    /// The path has ended; nothing moves any more.
    PathEnded(PathEnd, PathReport),
    /// The host has been silent for longer than the link time-out.
    LinkSilent,
    /// Time has passed.
    Tick {
        /// Device time.
        now_us: u64,
    },
}

/// A request that may move or stop the rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Command {
    /// Find the reference.
    Home,
    /// Execute a plan.
    Run {
        /// The plan.
        plan: RunPlan,
        /// What silence of the host does.
        link_loss: LinkLossPolicy,
    },
    /// Decelerate within a run, to go on later.
    Hold,
    /// Go on with the held run.
    Resume,
    /// Move towards an end of the stroke until the dead-man time has passed without another jog.
    Jog {
        /// Which way.
        direction: Direction,
        /// How fast.
        speed: Speed,
    },
    /// Move to a position.
    MoveTo {
        /// Where.
        target: Position,
        /// How fast.
        speed: Speed,
    },
    /// The start button: home if needed, else run, else stop. `None` if its run is not possible.
    Button(Option<RunPlan>),
    /// Category-1 stop.
    Stop,
    /// Emergency stop by frame. The pulses are already cut.
    EStop,
    /// Clear a latched fault.
    Acknowledge,
}

/// What is to be done.
// Lives in a short list on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
pub enum Action {
    /// Execute a path; no step outside `window`.
    Start {
        /// What.
        path: Path,
        /// First and last allowed position.
        window: (i32, i32),
    },
    /// Decelerate to rest.
    StopPath,
    /// No further pulse.
    Cut,
    /// The carriage stands; its position is this from now on.
    SetPosition(i32),
    /// Record and send.
    Emit(RigEvent),
}

/// Actions of one event.
pub type Actions = heapless::Vec<Action, 6>;

#[derive(Clone, Copy, Debug, PartialEq)]
struct Homing {
    phase: HomingPhase,
    /// Flag edge of the first pass.
    seek: Option<i32>,
    /// Flag edge of the second pass.
    locate: Option<i32>,
    /// The flag by its filtered edges: one look at the pin could meet a glitch.
    flag_open: bool,
    /// The position was trusted when homing began.
    was_homed: bool,
    /// Between the two passes: position of the second against the first.
    repeat: i32,
    shift: i32,
    link_loss: LinkLossPolicy,
    deadline_us: u64,
}

/// The run that is going on or held.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Course {
    plan: RunPlan,
    link_loss: LinkLossPolicy,
    /// Stroke in progress, from 0.
    stroke: u32,
    /// The flag has opened in this stroke. Only the first edge counts: contacts bounce.
    flag_met: bool,
}

impl Course {
    fn direction(&self) -> Option<Direction> {
        self.plan.direction(self.stroke)
    }

    /// Steps left of the stroke in progress, from a position within it.
    fn left(&self, position: i32) -> Option<Steps> {
        let steps = self.plan.stroke(self.stroke)?.steps().0;
        let gone = position.max(0).unsigned_abs();
        Some(Steps(match self.direction()? {
            Direction::Away => steps.saturating_sub(gone),
            Direction::Home => gone.min(steps),
        }))
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    Unhomed,
    Homing(Homing),
    Ready,
    Running,
    Held,
    Moving {
        /// A jog of this direction and speed, until this time.
        jog: Option<(Direction, Speed, u64)>,
    },
    /// Decelerating, then to the state in `then`.
    Stopping {
        then: Then,
    },
    Faulted(RigFault),
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Then {
    Unhomed,
    Ready(RunOutcome),
    Held,
    Moved,
    Faulted(RigFault),
}

/// The machine.
#[derive(Clone, Debug)]
pub struct Machine {
    settings: Settings,
    state: State,
    homed: bool,
    /// A path was started and its end has not been reported.
    path: bool,
    run: RunRecord,
    image_hash: u32,
    course: Option<Course>,
    /// The path is that of the run: its reports belong into the record, also after a fault.
    recording: bool,
    strokes: u32,
    residual: i32,
    started_us: u64,
    /// Positions of the last report: by the generator, by the counter.
    last: (i32, i32),
    /// Until then a jog is the renewal of one that was stopped, and starts nothing.
    jog_stopped_until_us: u64,
}

const NO_RUN: RunRecord = RunRecord {
    run: 0,
    outcome: RunOutcome::None,
    strokes: 0,
    commanded_edges: 0,
    counted_edges: 0,
    ticks: 0,
    plan_hash: 0,
    min_steps: 0,
    max_steps: 0,
    worst_residual_steps: 0,
    min_queue: 0,
    glitches: 0,
    holds: 0,
    image_hash: 0,
};

impl Machine {
    /// A machine after a start; `fault` is latched from the start when the last one ended badly.
    pub fn new(settings: Settings, fault: Option<RigFault>) -> Self {
        Self {
            settings,
            state: fault.map_or(State::Unhomed, State::Faulted),
            homed: false,
            path: false,
            run: NO_RUN,
            image_hash: 0,
            course: None,
            recording: false,
            strokes: 0,
            residual: 0,
            started_us: 0,
            last: (0, 0),
            jog_stopped_until_us: 0,
        }
    }

    /// Puts the fingerprint of the image into the records of runs.
    #[must_use]
    pub fn with_image(mut self, hash: u32) -> Self {
        self.image_hash = hash;
        self
    }

    /// Whether settings may be changed now.
    ///
    /// # Errors
    /// Something moves, or a run is held.
    pub fn may_change_settings(&self) -> Result<(), Refusal> {
        match self.state {
            State::Unhomed | State::Ready | State::Faulted(_) if !self.path => Ok(()),
            _ => Err(Refusal::RigBusy(self.state())),
        }
    }

    /// Takes other settings, where [`Machine::may_change_settings`]. Where they give positions another meaning,
    /// the position is unknown from then on.
    pub fn set_settings(&mut self, settings: Settings) {
        let same = (settings.axis, settings.flag_um) == (self.settings.axis, self.settings.flag_um);
        self.settings = settings;
        if !same {
            self.homed = false;
            if matches!(self.state, State::Ready) {
                self.state = State::Unhomed;
            }
        }
    }

    /// The settings in force.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// State as on the wire.
    pub fn state(&self) -> RigState {
        match self.state {
            State::Unhomed => RigState::Unhomed,
            State::Homing(_) => RigState::Homing,
            State::Ready => RigState::Ready,
            State::Running => RigState::Running,
            State::Held => RigState::Held,
            State::Moving { .. } => RigState::Moving,
            State::Stopping { .. } => RigState::Stopping,
            State::Faulted(_) => RigState::Faulted,
        }
    }

    /// The latched fault.
    pub fn fault(&self) -> Option<RigFault> {
        match self.state {
            State::Faulted(fault) => Some(fault),
            _ => None,
        }
    }

    /// The position can be trusted.
    pub fn homed(&self) -> bool {
        self.homed
    }

    /// Record of the present or last run.
    pub fn record(&self) -> &RunRecord {
        &self.run
    }

    /// Strokes of the present or last run.
    pub fn strokes(&self) -> u32 {
        self.strokes
    }

    /// Residual of the ledger at the last pass of the home flag.
    pub fn residual(&self) -> i32 {
        self.residual
    }

    /// When the present or last run began.
    pub fn started_us(&self) -> u64 {
        self.started_us
    }

    /// Takes a command.
    ///
    /// # Errors
    /// The refusal; nothing has changed and no action was added. Only a resume that finds the carriage elsewhere
    /// than it was held has latched that as a fault.
    pub fn command(
        &mut self,
        now_us: u64,
        command: Command,
        position: i32,
        inputs: RigInputs,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        match command {
            Command::Home => self.home(now_us, LinkLossPolicy::Stop, position, inputs, actions),
            Command::Run { plan, link_loss } => {
                self.start_run(now_us, plan, link_loss, position, inputs, actions)
            }
            Command::Hold => self.hold(actions),
            Command::Resume => self.resume(position, inputs, actions),
            Command::Jog { direction, speed } => {
                self.jog(now_us, direction, speed, position, inputs, actions)
            }
            Command::MoveTo { target, speed } => {
                self.refuse_unless_ready(inputs)?;
                self.move_to(target, speed, None, position, inputs, actions)
            }
            Command::Button(plan) => self.button(now_us, plan, position, inputs, actions),
            Command::Stop => {
                self.stop(RunOutcome::Stopped, actions);
                Ok(())
            }
            Command::EStop => {
                self.latch(RigFault::EStopFrame, actions);
                Ok(())
            }
            Command::Acknowledge => self.acknowledge(inputs),
        }
    }

    fn refuse_unless_at_rest(&self, inputs: RigInputs) -> Result<(), Refusal> {
        match self.state {
            State::Faulted(RigFault::Watchdog | RigFault::Panic) => {
                return Err(Refusal::AcknowledgeFirst);
            }
            State::Faulted(fault) => return Err(Refusal::RigFaulted(fault)),
            State::Unhomed | State::Ready => {}
            _ => return Err(Refusal::RigBusy(self.state())),
        }
        if inputs.estop_loop {
            return Err(Refusal::RigFaulted(RigFault::EStopLoop));
        }
        if inputs.home_flag && inputs.far_limit {
            return Err(Refusal::RigFaulted(RigFault::BothSwitchesOpen));
        }
        Ok(())
    }

    fn refuse_unless_ready(&self, inputs: RigInputs) -> Result<(), Refusal> {
        self.refuse_unless_at_rest(inputs)?;
        if matches!(self.state, State::Ready) {
            Ok(())
        } else {
            Err(Refusal::NotHomed)
        }
    }

    fn home(
        &mut self,
        now_us: u64,
        link_loss: LinkLossPolicy,
        position: i32,
        inputs: RigInputs,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        self.refuse_unless_at_rest(inputs)?;
        let homing = Homing {
            phase: if inputs.home_flag {
                HomingPhase::Clear
            } else {
                HomingPhase::Seek
            },
            seek: None,
            locate: None,
            flag_open: inputs.home_flag,
            was_homed: self.homed,
            repeat: 0,
            shift: 0,
            link_loss,
            deadline_us: now_us.saturating_add(self.settings.homing_timeout_us),
        };
        self.homed = false;
        self.enter(homing, position, actions);
        Ok(())
    }

    /// Starts the move of a homing phase.
    fn enter(&mut self, homing: Homing, position: i32, actions: &mut Actions) {
        let settings = &self.settings;
        let pull_off = settings.steps(settings.pull_off_um);
        let (direction, distance, speed) = match homing.phase {
            // The flag reaches from its edge to the end of travel on the home side.
            HomingPhase::Clear => (
                Direction::Away,
                settings.flag_steps() + settings.steps(settings.overtravel_um),
                settings.locate_um_s * 2,
            ),
            HomingPhase::Seek => {
                // From a known position, no farther than needed.
                let from = if homing.was_homed {
                    position.max(0)
                } else {
                    settings.steps(settings.axis.stroke().0)
                };
                (
                    Direction::Home,
                    from + settings.steps(settings.overtravel_um),
                    settings.seek_um_s,
                )
            }
            HomingPhase::PullOff => (
                Direction::Away,
                homing.seek.unwrap_or(position) + pull_off - position,
                settings.seek_um_s,
            ),
            HomingPhase::Locate => (Direction::Home, 2 * pull_off, settings.locate_um_s),
            HomingPhase::ToZero => {
                let direction = if position > 0 {
                    Direction::Home
                } else {
                    Direction::Away
                };
                (direction, position.abs(), settings.seek_um_s)
            }
        };
        let accel = settings.axis.acceleration(settings.homing_accel_um_s2);
        let speed = settings.axis.speed(speed);
        let profile = match (speed, accel) {
            (Ok(speed), Ok(accel)) => {
                StrokeProfile::from_speed(Steps(distance.unsigned_abs()), speed, accel).ok()
            }
            _ => None,
        };
        if homing.phase == HomingPhase::ToZero && distance == 0 {
            return self.homed_at_zero(homing, actions);
        }
        let Some(profile) = profile else {
            // Only with settings that no validator would pass.
            return self.latch(RigFault::FlagNotFound(homing.phase), actions);
        };
        let end = match direction {
            Direction::Away => position.saturating_add(distance),
            Direction::Home => position.saturating_sub(distance),
        };
        let window = (position.min(end), position.max(end));
        self.state = State::Homing(homing);
        self.path = true;
        push(
            actions,
            Action::Start {
                path: Path::Move { profile, direction },
                window,
            },
        );
    }

    fn homed_at_zero(&mut self, homing: Homing, actions: &mut Actions) {
        self.homed = true;
        self.residual = 0;
        self.state = State::Ready;
        push(
            actions,
            Action::Emit(RigEvent::Homed {
                repeat_steps: homing.repeat,
                shift_steps: homing.shift,
            }),
        );
    }

    fn start_run(
        &mut self,
        now_us: u64,
        plan: RunPlan,
        link_loss: LinkLossPolicy,
        position: i32,
        inputs: RigInputs,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        self.refuse_unless_ready(inputs)?;
        if position != 0 {
            return Err(Refusal::NotAtHome {
                position_um: self.settings.um(position),
            });
        }
        if inputs.far_limit {
            return Err(Refusal::RigFaulted(RigFault::FarLimit));
        }
        let run = self.run.run + 1;
        self.run = RunRecord {
            run,
            outcome: RunOutcome::Running,
            plan_hash: plan.hash(),
            image_hash: self.image_hash,
            ..NO_RUN
        };
        self.recording = true;
        self.path = true;
        self.strokes = plan.strokes();
        self.residual = 0;
        self.last = (0, 0);
        self.started_us = now_us;
        self.course = Some(Course {
            plan,
            link_loss,
            stroke: 0,
            flag_met: false,
        });
        self.state = State::Running;
        push(
            actions,
            Action::Start {
                path: Path::Run(plan),
                window: self.stroke_window(),
            },
        );
        push(actions, Action::Emit(RigEvent::RunStarted { run }));
        Ok(())
    }

    /// First and last position of the configured stroke.
    fn stroke_window(&self) -> (i32, i32) {
        let last = i32::try_from(self.settings.axis.stroke_steps().0).unwrap_or(i32::MAX);
        (0, last)
    }

    fn hold(&mut self, actions: &mut Actions) -> Result<(), Refusal> {
        match self.state {
            State::Running => {
                self.stop_then(Then::Held, actions);
                Ok(())
            }
            State::Faulted(fault) => Err(Refusal::RigFaulted(fault)),
            _ => Err(Refusal::NothingToHold),
        }
    }

    fn resume(
        &mut self,
        position: i32,
        inputs: RigInputs,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let (State::Held, Some(course)) = (self.state, self.course) else {
            return Err(match self.state {
                State::Faulted(fault) => Refusal::RigFaulted(fault),
                _ => Refusal::NothingToResume,
            });
        };
        if inputs.estop_loop {
            return Err(Refusal::RigFaulted(RigFault::EStopLoop));
        }
        if inputs.far_limit {
            return Err(Refusal::RigFaulted(RigFault::FarLimit));
        }
        if position != self.last.1 {
            let fault = RigFault::ReadBack {
                commanded: self.last.1,
                counted: position,
            };
            self.latch(fault, actions);
            return Err(Refusal::RigFaulted(fault));
        }
        let (Some(profile), Some(left)) =
            (course.plan.stroke(course.stroke), course.left(position))
        else {
            return Err(Refusal::NothingToResume);
        };
        let first = if left == profile.steps() {
            *profile
        } else {
            profile.resumed(left).map_err(|_| Refusal::TooSlow)?
        };
        self.state = State::Running;
        (self.recording, self.path) = (true, true);
        let path = Path::Rest {
            plan: course.plan,
            stroke: course.stroke,
            first,
        };
        push(
            actions,
            Action::Start {
                path,
                window: self.stroke_window(),
            },
        );
        push(actions, Action::Emit(RigEvent::Resumed));
        Ok(())
    }

    fn jog(
        &mut self,
        now_us: u64,
        direction: Direction,
        speed: Speed,
        position: i32,
        inputs: RigInputs,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let until = now_us.saturating_add(self.settings.dead_man_us);
        let jog = Some((direction, speed, until));
        if let State::Moving {
            jog: Some((same, as_fast, _)),
        } = self.state
            && (same, as_fast) == (direction, speed)
        {
            self.state = State::Moving { jog };
            return Ok(());
        }
        self.refuse_unless_ready(inputs)?;
        if now_us < self.jog_stopped_until_us {
            return Err(Refusal::RigBusy(RigState::Stopping));
        }
        let target = match direction {
            Direction::Away => self.settings.axis.far(),
            Direction::Home => self.settings.axis.home(),
        };
        self.move_to(target, speed, jog, position, inputs, actions)
    }

    fn move_to(
        &mut self,
        target: Position,
        speed: Speed,
        jog: Option<(Direction, Speed, u64)>,
        position: i32,
        inputs: RigInputs,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let to = i32::try_from(target.steps().0).unwrap_or(i32::MAX);
        let direction = match to - position {
            0 => return Err(Refusal::AlreadyThere),
            1.. => Direction::Away,
            _ => Direction::Home,
        };
        if inputs.far_limit && direction == Direction::Away {
            return Err(Refusal::RigFaulted(RigFault::FarLimit));
        }
        let profile = self.settings.move_profile(to - position, speed)?;
        self.state = State::Moving { jog };
        self.path = true;
        push(
            actions,
            Action::Start {
                path: Path::Move { profile, direction },
                window: (position.min(to), position.max(to)),
            },
        );
        Ok(())
    }

    fn button(
        &mut self,
        now_us: u64,
        plan: Option<RunPlan>,
        position: i32,
        inputs: RigInputs,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let policy = LinkLossPolicy::Finish;
        match (self.state, plan) {
            (State::Homing(_) | State::Running | State::Moving { .. }, _) => {
                self.stop(RunOutcome::Stopped, actions);
                Ok(())
            }
            (State::Held, _) => self.resume(position, inputs, actions),
            (State::Ready, plan) if position == 0 => {
                let plan = plan.ok_or(Refusal::TooSlow)?;
                self.start_run(now_us, plan, policy, position, inputs, actions)
            }
            _ => self.home(now_us, policy, position, inputs, actions),
        }
    }

    fn stop(&mut self, outcome: RunOutcome, actions: &mut Actions) {
        match self.state {
            State::Homing(_) => self.stop_then(Then::Unhomed, actions),
            State::Running => self.stop_then(Then::Ready(outcome), actions),
            State::Moving { jog } => {
                self.jog_stopped_until_us = jog.map_or(0, |(.., until)| until);
                self.stop_then(Then::Moved, actions);
            }
            // It stands already; its run is over.
            State::Held => {
                self.end_run(outcome, actions);
                self.state = State::Ready;
                let position_steps = self.last.1;
                push(actions, Action::Emit(RigEvent::Stopped { position_steps }));
            }
            // On its way to a rest within a run that shall not go on.
            State::Stopping { then: Then::Held } => {
                self.state = State::Stopping {
                    then: Then::Ready(outcome),
                };
            }
            _ => {} // nothing moves, or it is stopping already
        }
    }

    fn stop_then(&mut self, then: Then, actions: &mut Actions) {
        self.state = State::Stopping { then };
        push(actions, Action::StopPath);
    }

    fn acknowledge(&mut self, inputs: RigInputs) -> Result<(), Refusal> {
        let State::Faulted(fault) = self.state else {
            return Err(Refusal::NothingToAcknowledge);
        };
        let present = match fault {
            RigFault::EStopLoop if inputs.estop_loop => true,
            // Whatever it was: no carriage is at both ends, the switches' cable is unplugged.
            _ => inputs.home_flag && inputs.far_limit,
        };
        // Its report must not be taken for that of the next path.
        if present || self.path {
            return Err(Refusal::CauseStillPresent);
        }
        self.state = State::Unhomed;
        Ok(())
    }

    /// Latches a fault. Cuts the pulses: whatever moved has stopped.
    fn latch(&mut self, fault: RigFault, actions: &mut Actions) {
        push(actions, Action::Cut);
        if let State::Faulted(_) = self.state {
            return; // the first cause is the one to report
        }
        self.end_run(RunOutcome::Faulted(fault), actions);
        self.homed = false;
        self.state = State::Faulted(fault);
        push(actions, Action::Emit(RigEvent::Faulted(fault)));
    }

    fn end_run(&mut self, outcome: RunOutcome, actions: &mut Actions) {
        if self.run.outcome == RunOutcome::Running {
            self.run.outcome = outcome;
            push(
                actions,
                Action::Emit(RigEvent::RunEnded {
                    run: self.run.run,
                    outcome,
                }),
            );
        }
    }

    /// Takes an event.
    pub fn event(&mut self, event: Event, inputs: RigInputs) -> Actions {
        let mut actions = Actions::new();
        match event {
            Event::FlagEdge { opening, count } => self.flag_edge(opening, count, &mut actions),
            Event::FarLimit => self.latch(RigFault::FarLimit, &mut actions),
            Event::LoopOpened => self.latch(RigFault::EStopLoop, &mut actions),
            Event::StrokeDone {
                stroke,
                commanded,
                counted,
            } => {
                self.stroke_done(stroke, commanded, counted, &mut actions);
            }
            Event::PathEnded(end, report) => self.path_ended(end, report, inputs, &mut actions),
            Event::LinkSilent => {
                let policy = match self.state {
                    State::Running => self.course.map(|course| course.link_loss),
                    State::Homing(homing) => Some(homing.link_loss),
                    State::Moving { .. } => Some(LinkLossPolicy::Stop),
                    _ => None,
                };
                if policy == Some(LinkLossPolicy::Stop) {
                    self.stop(RunOutcome::LinkLost, &mut actions);
                }
            }
            Event::Tick { now_us } => match self.state {
                State::Homing(homing) if now_us > homing.deadline_us => {
                    self.latch(RigFault::HomingTimeout(homing.phase), &mut actions);
                }
                State::Moving {
                    jog: Some((_, _, until)),
                } if now_us > until => self.stop_then(Then::Moved, &mut actions),
                _ => {}
            },
        }
        actions
    }

    fn flag_edge(&mut self, opening: bool, count: i32, actions: &mut Actions) {
        match &mut self.state {
            State::Running | State::Held | State::Stopping { then: Then::Held } if opening => {
                self.ledger(count, actions);
            }
            State::Homing(homing) => {
                homing.flag_open = opening;
                match homing.phase {
                    HomingPhase::Clear if !opening => push(actions, Action::StopPath),
                    HomingPhase::Seek if opening && homing.seek.is_none() => {
                        homing.seek = Some(count);
                        push(actions, Action::StopPath);
                    }
                    HomingPhase::Locate if opening && homing.locate.is_none() => {
                        homing.locate = Some(count);
                        push(actions, Action::StopPath);
                    }
                    _ => {}
                }
            }
            _ => {}
        }
    }

    /// The flag opens on the way home: the same edge in the same direction as in homing.
    fn ledger(&mut self, count: i32, actions: &mut Actions) {
        let Some(course) = &mut self.course else {
            return;
        };
        if course.flag_met || course.direction() != Some(Direction::Home) {
            return;
        }
        let residual = count - self.settings.flag_steps();
        let lost = residual.unsigned_abs() > self.settings.ledger_limit_steps;
        // At rest it opens a moment late at the most; elsewhere it was a hand.
        if lost && matches!(self.state, State::Held) {
            return;
        }
        course.flag_met = true;
        self.residual = residual;
        if residual.abs() > self.run.worst_residual_steps.abs() {
            self.run.worst_residual_steps = residual;
        }
        if lost {
            let fault = RigFault::LostSteps {
                residual_steps: residual,
            };
            self.stop_then(Then::Faulted(fault), actions);
        }
    }

    fn stroke_done(&mut self, stroke: u32, commanded: i32, counted: i32, actions: &mut Actions) {
        if !self.recording {
            return;
        }
        let missed = self.missed_flag(counted);
        self.run.strokes = stroke + 1;
        self.track(commanded, counted);
        // Stopping: it was complete before the stop reached the generator.
        let (State::Running | State::Stopping { .. }, Some(course)) =
            (self.state, &mut self.course)
        else {
            return;
        };
        (course.stroke, course.flag_met) = (stroke + 1, false);
        if commanded != counted {
            return self.latch(RigFault::ReadBack { commanded, counted }, actions);
        }
        if let Some(fault) = missed {
            return self.latch(fault, actions);
        }
        push(
            actions,
            Action::Emit(RigEvent::StrokeDone {
                stroke,
                residual_steps: self.residual,
            }),
        );
    }

    /// At the end of a stroke towards home that began beyond the flag, the flag has to be open. Where it really
    /// is nobody knows then: at least as far off as from here to its edge.
    fn missed_flag(&self, counted: i32) -> Option<RigFault> {
        let limit = i32::try_from(self.settings.ledger_limit_steps).unwrap_or(i32::MAX);
        let from = self.settings.flag_steps().saturating_add(limit).max(0);
        let on_the_way_home = self.course.is_some_and(|course| {
            let beyond = course.plan.forward().steps().0 > from.unsigned_abs();
            beyond && !course.flag_met && course.direction() == Some(Direction::Home)
        });
        let running = matches!(
            self.state,
            State::Running | State::Stopping { then: Then::Held }
        );
        (running && on_the_way_home).then(|| RigFault::LostSteps {
            residual_steps: counted.saturating_sub(self.settings.flag_steps()),
        })
    }

    /// Adds the way since the last report to the run's record. Positions are reported at the ends of strokes,
    /// where they are extreme.
    fn track(&mut self, commanded: i32, counted: i32) {
        self.run.min_steps = self.run.min_steps.min(commanded);
        self.run.max_steps = self.run.max_steps.max(commanded);
        self.run.commanded_edges += u64::from(commanded.abs_diff(self.last.0));
        self.run.counted_edges += u64::from(counted.abs_diff(self.last.1));
        self.last = (commanded, counted);
    }

    /// False pulses on the limit inputs since the run began.
    pub fn set_glitches(&mut self, glitches: u32) {
        if self.recording {
            self.run.glitches = glitches;
        }
    }

    fn path_ended(
        &mut self,
        end: PathEnd,
        report: PathReport,
        inputs: RigInputs,
        actions: &mut Actions,
    ) {
        if !core::mem::take(&mut self.path) {
            return;
        }
        let (commanded, counted) = (report.commanded, report.counted);
        let missed = self.missed_flag(counted);
        if core::mem::take(&mut self.recording) {
            self.run.ticks += report.last_tick;
            self.run.min_queue = if self.run.holds == 0 {
                report.min_queue
            } else {
                self.run.min_queue.min(report.min_queue)
            };
            self.track(commanded, counted);
        }
        if let State::Faulted(_) = self.state {
            return;
        }
        match end {
            PathEnd::Underrun => return self.latch(RigFault::Underrun, actions),
            PathEnd::Guard => return self.latch(RigFault::WindowGuard, actions),
            // Whoever cut the pulses tells why, but perhaps later than this; the read-back counter has the
            // true position. Without the loop it was the link: its frame cuts before it is read.
            PathEnd::Cut if inputs.estop_loop => return self.latch(RigFault::EStopLoop, actions),
            PathEnd::Cut => return self.latch(RigFault::EStopFrame, actions),
            PathEnd::Complete | PathEnd::Stopped => {}
        }
        if commanded != counted {
            return self.latch(RigFault::ReadBack { commanded, counted }, actions);
        }
        let stopped = RigEvent::Stopped {
            position_steps: counted,
        };
        match self.state {
            State::Homing(homing) => self.homing_move_ended(homing, counted, inputs, actions),
            State::Running if end == PathEnd::Complete => {
                if let Some(fault) = missed {
                    return self.latch(fault, actions);
                }
                self.complete(actions);
            }
            // Not asked for, and all the same not complete.
            State::Running => {
                self.end_run(RunOutcome::Stopped, actions);
                self.state = State::Ready;
                push(actions, Action::Emit(stopped));
            }
            State::Stopping { then } => {
                match then {
                    Then::Unhomed => self.state = State::Unhomed,
                    // The stop came too late to stop anything.
                    Then::Ready(_) if end == PathEnd::Complete => self.complete(actions),
                    Then::Ready(outcome) => {
                        self.end_run(outcome, actions);
                        self.state = State::Ready;
                    }
                    Then::Held => return self.held(end, counted, missed, actions),
                    Then::Moved => self.state = State::Ready,
                    Then::Faulted(fault) => return self.latch(fault, actions),
                }
                push(actions, Action::Emit(stopped));
            }
            State::Moving { .. } => {
                self.state = State::Ready;
                let position_steps = counted;
                push(actions, Action::Emit(RigEvent::Moved { position_steps }));
            }
            State::Unhomed | State::Ready | State::Held | State::Faulted(_) => {}
        }
    }

    /// The carriage stands within its run.
    fn held(
        &mut self,
        end: PathEnd,
        position: i32,
        missed: Option<RigFault>,
        actions: &mut Actions,
    ) {
        let limit = i32::try_from(self.settings.ledger_limit_steps).unwrap_or(i32::MAX);
        let behind_the_flag = position.saturating_add(limit) < self.settings.flag_steps();
        let stroke_complete = self
            .course
            .is_some_and(|course| course.left(position) == Some(Steps(0)));
        if let Some(fault) = missed.filter(|_| stroke_complete || behind_the_flag) {
            return self.latch(fault, actions);
        }
        if end == PathEnd::Complete || self.run.strokes == self.strokes {
            return self.complete(actions);
        }
        if stroke_complete && let Some(course) = &mut self.course {
            let stroke = course.stroke;
            (course.stroke, course.flag_met) = (stroke + 1, false);
            if course.stroke == self.strokes {
                return self.complete(actions);
            }
            self.run.strokes = course.stroke;
            let residual_steps = self.residual;
            push(
                actions,
                Action::Emit(RigEvent::StrokeDone {
                    stroke,
                    residual_steps,
                }),
            );
        }
        self.run.holds += 1;
        self.state = State::Held;
        let position_steps = position;
        push(actions, Action::Emit(RigEvent::Held { position_steps }));
    }

    fn complete(&mut self, actions: &mut Actions) {
        self.run.strokes = self.strokes;
        push(
            actions,
            Action::Emit(RigEvent::StrokeDone {
                stroke: self.strokes.saturating_sub(1),
                residual_steps: self.residual,
            }),
        );
        self.end_run(RunOutcome::Complete, actions);
        self.state = State::Ready;
    }

    fn homing_move_ended(
        &mut self,
        mut homing: Homing,
        position: i32,
        inputs: RigInputs,
        actions: &mut Actions,
    ) {
        let missing = match homing.phase {
            // The edge that was found may be that of the cable.
            _ if inputs.home_flag && inputs.far_limit => Some(RigFault::BothSwitchesOpen),
            HomingPhase::Clear | HomingPhase::PullOff => {
                homing.flag_open.then_some(RigFault::FlagStuck)
            }
            HomingPhase::Seek => homing
                .seek
                .is_none()
                .then_some(RigFault::FlagNotFound(HomingPhase::Seek)),
            HomingPhase::Locate => homing
                .locate
                .is_none()
                .then_some(RigFault::FlagNotFound(HomingPhase::Locate)),
            HomingPhase::ToZero => None,
        };
        if let Some(fault) = missing {
            return self.latch(fault, actions);
        }
        homing.phase = match homing.phase {
            HomingPhase::Clear => HomingPhase::Seek,
            HomingPhase::Seek => HomingPhase::PullOff,
            HomingPhase::PullOff => HomingPhase::Locate,
            HomingPhase::Locate => HomingPhase::ToZero,
            HomingPhase::ToZero => return self.homed_at_zero(homing, actions),
        };
        let mut position = position;
        if homing.phase == HomingPhase::ToZero {
            let found = homing.locate.unwrap_or(position);
            homing.repeat = found - homing.seek.unwrap_or(found);
            if homing.was_homed {
                homing.shift = found - self.settings.flag_steps();
            }
            position = position - found + self.settings.flag_steps();
            push(actions, Action::SetPosition(position));
        }
        self.enter(homing, position, actions);
    }
}

/// No event has more actions than the list holds; the enumeration test checks it.
fn push(actions: &mut Actions, action: Action) {
    let full = actions.push(action).is_err();
    debug_assert!(!full, "list of actions too short");
}
