//! The rig's state machine: `step(now, Event) -> Actions`. Pure; the time is an argument.
//!
//! ```text
//! Unhomed --home--> Homing --found--> Ready --run--> Running --complete--> Ready
//!    Ready --jog, move--> Moving --arrived--> Ready
//!    Running --hold--> Stopping --at rest--> Held --resume--> Running
//!    Homing, Running, Moving --stop--> Stopping --at rest--> Unhomed, Ready
//!    any --fault--> Faulted --acknowledge--> Unhomed
//! ```
//!
//! A fault is latched, and after it the position is unknown until homed again. Neither a release of the
//! E-stop nor a reset nor a new connection moves anything: only an accepted command does.
//!
//! This file has the states and the handling of a path's end; `homing`, `running` and `moving` have the rest.

mod homing;
mod moving;
mod running;

use crate::{periods::Path, settings::Settings};
use homing::Homing;
use motion::{
    axis::{Direction, Position, Speed},
    edge_timing::Timed,
    run::RunPlan,
    units::{StepPosition, Steps, Window},
};
use moving::Jog;
use protocol::{
    client::{ATTEMPTS, RETRY_AFTER_US},
    error::Refusal,
    rig::{LinkLossPolicy, RigEvent, RigFault, RigInputs, RigState, RunOutcome, RunRecord, Switch},
};
use running::ActiveRun;

/// Time for which a host repeats an unanswered request, us.
const REPEATED_US: u64 = ATTEMPTS as u64 * RETRY_AFTER_US;

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
    pub commanded: StepPosition,
    /// Prepared steps that were not emitted.
    pub unemitted: Steps,
    /// Position by the read-back counter.
    pub counted: StepPosition,
    /// Tick of the last emitted step, from the path's start.
    pub last_tick: u64,
    /// Fewest periods in the queue before the last one was queued; none if the whole path was queued at once.
    pub min_queue: Option<u16>,
    /// Result of comparing the captured edges with the planned ones.
    pub timed: Timed,
}

/// Time, position and inputs that come with every event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Now {
    pub time_us: u64,
    /// Position by the read-back counter.
    pub position: StepPosition,
    /// Switches and E-stop loop, the home flag filtered.
    pub inputs: RigInputs,
    /// False pulses on the switches since the device's start; wraps.
    pub glitches: u32,
}

/// Input of the state machine. Notices of interrupts and motion wait in a channel, so keep the enum small: a command,
/// which may hold a whole plan, is a reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event<'a> {
    /// The host or the start button orders something.
    Command(&'a Command),
    /// The home flag changed, filtered.
    FlagEdge {
        /// Opened (actuated).
        opening: bool,
        /// Read-back position at the edge.
        count: StepPosition,
    },
    /// The far limit opened while the carriage moved away from home. The pulses are already cut.
    FarLimit,
    /// A switch's line is too noisy to be watched. The pulses are already cut.
    SwitchNoise(Switch),
    /// The E-stop loop opened. The pulses are already cut, by hardware.
    LoopOpened,
    /// A stroke of a run is complete: its last pulse was emitted.
    StrokeDone {
        /// From 0.
        stroke: u32,
        /// Position by the generator.
        commanded: StepPosition,
        /// Position by the read-back counter.
        counted: StepPosition,
    },
    /// The path has ended, and nothing moves.
    PathEnded(PathEnd, PathReport),
    /// The host has been silent for longer than the link time-out.
    LinkSilent,
    /// Time has passed.
    Tick,
}

/// A request that may move or stop the rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Command {
    /// Find the reference.
    Home,
    Run {
        plan: RunPlan,
        /// Reaction to a silent host.
        link_loss: LinkLossPolicy,
    },
    /// Decelerate within a run, to continue later.
    Hold,
    /// Continue the held run.
    Resume,
    /// Move towards an end of the stroke until the dead-man time has passed without another jog.
    Jog {
        /// Away from home, or home.
        direction: Direction,
        /// Highest speed.
        speed: Speed,
    },
    MoveTo {
        target: Position,
        /// Highest speed.
        speed: Speed,
    },
    /// The start button: home if needed, else run, else stop. `None` if its run is not possible.
    Button(Option<RunPlan>),
    /// Category-1 stop; never refused.
    Stop,
    /// Emergency stop by frame; never refused. The pulses are already cut.
    EStop,
    Acknowledge,
}

/// What a step of the machine asks the control task to do.
// Lives in a short list on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
pub enum Action {
    /// Execute a path; no step outside `window`.
    Start {
        path: Path,
        /// Allowed positions.
        window: Window,
    },
    /// Decelerate to rest.
    StopPath,
    Cut,
    /// Set the position of a carriage at rest.
    SetPosition(StepPosition),
    /// Record and send.
    Emit(RigEvent),
}

/// Result of [`Machine::step`].
#[derive(Clone, Debug, Default)]
pub struct Actions {
    /// Carry them out in this order.
    pub list: heapless::Vec<Action, 6>,
    /// The command was refused and changed nothing, with one exception: a resume that finds the carriage moved since
    /// the hold, or a run or move from 0 that finds the flag closed, latches a fault.
    pub refusal: Option<Refusal>,
}

impl Actions {
    /// No step has more actions than the list holds; the enumeration test checks it.
    fn push(&mut self, action: Action) {
        let full = self.list.push(action).is_err();
        debug_assert!(!full, "list of actions too short");
    }

    fn emit(&mut self, event: RigEvent) {
        self.push(Action::Emit(event));
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    Unhomed,
    Homing(Homing),
    Ready,
    Running,
    Held,
    /// A move, or a jog.
    Moving(Option<Jog>),
    /// Decelerating; the state to enter at rest.
    Stopping(AtRest),
    Faulted(RigFault),
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum AtRest {
    Unhomed,
    Ready(RunOutcome),
    Held,
    Moved,
    Faulted(RigFault),
}

#[derive(Clone, Debug)]
pub struct Machine {
    settings: Settings,
    state: State,
    homed: bool,
    /// A path was started and its end has not been reported.
    path: bool,
    image_hash: u32,
    record: RunRecord,
    run: Option<ActiveRun>,
    /// The active path belongs to the run: its reports go into the record, also after a fault.
    recording: bool,
    /// Strokes of the present or last run.
    strokes: u32,
    residual: i32,
    started_us: u64,
    glitches_at_start: u32,
    /// Positions of the last report: by the generator, by the counter.
    last: (StepPosition, StepPosition),
    /// Counted position at the end of the last path. The counter must be there when the next one begins.
    rest: StepPosition,
    /// Ignore jogs until this time: they renew a stopped one.
    jog_stopped_until_us: u64,
}

impl Machine {
    /// A machine after a start. `fault` is latched from the beginning if the previous start ended badly. `image_hash`
    /// goes into the records of runs.
    pub fn new(settings: Settings, fault: Option<RigFault>, image_hash: u32) -> Self {
        Self {
            settings,
            state: fault.map_or(State::Unhomed, State::Faulted),
            homed: false,
            path: false,
            image_hash,
            record: running::NO_RUN,
            run: None,
            recording: false,
            strokes: 0,
            residual: 0,
            started_us: 0,
            glitches_at_start: 0,
            last: (StepPosition::HOME, StepPosition::HOME),
            rest: StepPosition::HOME,
            jog_stopped_until_us: 0,
        }
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

    /// Replaces the settings; check [`Machine::may_change_settings`] first. If the meaning of positions changes, the
    /// position becomes unknown.
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

    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    pub fn state(&self) -> RigState {
        match self.state {
            State::Unhomed => RigState::Unhomed,
            State::Homing(_) => RigState::Homing,
            State::Ready => RigState::Ready,
            State::Running => RigState::Running,
            State::Held => RigState::Held,
            State::Moving(_) => RigState::Moving,
            State::Stopping(_) => RigState::Stopping,
            State::Faulted(_) => RigState::Faulted,
        }
    }

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
        &self.record
    }

    /// Strokes of the present or last run.
    pub fn strokes(&self) -> u32 {
        self.strokes
    }

    /// Residual at the last pass of the home flag, steps.
    pub fn residual(&self) -> i32 {
        self.residual
    }

    /// When the present or last run began.
    pub fn started_us(&self) -> u64 {
        self.started_us
    }

    /// Handles one event and returns the actions to carry out.
    pub fn step(&mut self, now: &Now, event: Event<'_>) -> Actions {
        let mut actions = Actions::default();
        self.handle(now, event, &mut actions);
        actions
    }

    /// Like `step`, but adds to `actions`, which is too large to be copied at each tick.
    pub fn handle(&mut self, now: &Now, event: Event<'_>, actions: &mut Actions) {
        if self.recording {
            self.record.glitches = now.glitches.wrapping_sub(self.glitches_at_start);
        }
        match event {
            Event::Command(command) => {
                actions.refusal = self.command(now, command, actions).err();
            }
            Event::FlagEdge { opening, count } => self.flag_edge(opening, count, actions),
            Event::FarLimit => self.latch(RigFault::FarLimit, actions),
            Event::SwitchNoise(switch) => self.latch(RigFault::SwitchNoise(switch), actions),
            Event::LoopOpened => self.latch(RigFault::EStopLoop, actions),
            Event::StrokeDone {
                stroke,
                commanded,
                counted,
            } => self.stroke_done(stroke, commanded, counted, actions),
            Event::PathEnded(end, report) => self.path_ended(now, end, report, actions),
            Event::LinkSilent => self.link_silent(now, actions),
            Event::Tick => self.tick(now.time_us, actions),
        }
    }

    fn command(
        &mut self,
        now: &Now,
        command: &Command,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        match *command {
            Command::Home => self.home(now, LinkLossPolicy::Stop, actions),
            Command::Run { plan, link_loss } => self.start_run(now, plan, link_loss, actions),
            Command::Hold => self.hold(actions),
            Command::Resume => self.resume(now, actions),
            Command::Jog { direction, speed } => self.jog(now, direction, speed, actions),
            Command::MoveTo { target, speed } => {
                self.refuse_unless_ready(&now.inputs)?;
                self.move_to(now, target, speed, None, actions)
            }
            Command::Button(plan) => self.button(now, plan, actions),
            Command::Stop => {
                self.stop(now, RunOutcome::Stopped, actions);
                Ok(())
            }
            Command::EStop => {
                self.latch(RigFault::EStopFrame, actions);
                Ok(())
            }
            Command::Acknowledge => self.acknowledge(&now.inputs),
        }
    }

    fn refuse_unless_at_rest(&self, inputs: &RigInputs) -> Result<(), Refusal> {
        match self.state {
            State::Faulted(RigFault::Watchdog | RigFault::Panic) => {
                return Err(Refusal::AcknowledgeFirst);
            }
            State::Faulted(fault) => return Err(Refusal::RigFaulted(fault)),
            State::Unhomed | State::Ready => {}
            _ => return Err(Refusal::RigBusy(self.state())),
        }
        if inputs.estop_loop {
            return Err(Refusal::LoopOpen);
        }
        if inputs.home_flag && inputs.far_limit {
            return Err(Refusal::BothSwitchesOpen);
        }
        Ok(())
    }

    fn refuse_unless_ready(&self, inputs: &RigInputs) -> Result<(), Refusal> {
        self.refuse_unless_at_rest(inputs)?;
        if matches!(self.state, State::Ready) {
            Ok(())
        } else {
            Err(Refusal::NotHomed)
        }
    }

    fn button(
        &mut self,
        now: &Now,
        plan: Option<RunPlan>,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let policy = LinkLossPolicy::Finish;
        match self.state {
            State::Homing(_) | State::Running | State::Moving(_) => {
                self.refuse_repeated_jogs(now.time_us);
                self.stop(now, RunOutcome::Stopped, actions);
                Ok(())
            }
            State::Held => self.resume(now, actions),
            State::Ready if now.position == StepPosition::HOME => {
                let plan = plan.ok_or(Refusal::TooSlow)?;
                self.start_run(now, plan, policy, actions)
            }
            _ => self.home(now, policy, actions),
        }
    }

    fn stop(&mut self, now: &Now, outcome: RunOutcome, actions: &mut Actions) {
        match self.state {
            State::Homing(_) => self.stop_to(AtRest::Unhomed, actions),
            State::Running => self.stop_to(AtRest::Ready(outcome), actions),
            State::Moving(jog) => {
                let until_us = jog.map_or(0, |jog| jog.until_us);
                self.jog_stopped_until_us = self.jog_stopped_until_us.max(until_us);
                self.stop_to(AtRest::Moved, actions);
            }
            State::Held if now.position != self.last.1 => {
                self.latch(read_back(self.last.1, now.position), actions);
            }
            // Already at rest: just end the run.
            State::Held => {
                self.end_run(outcome, actions);
                self.state = State::Ready;
                let position_steps = self.last.1.0;
                actions.emit(RigEvent::Stopped { position_steps });
            }
            // Braking for a hold: end the run instead of holding it.
            State::Stopping(AtRest::Held) => self.state = State::Stopping(AtRest::Ready(outcome)),
            _ => {} // nothing moves, or it is stopping already
        }
    }

    fn stop_to(&mut self, at_rest: AtRest, actions: &mut Actions) {
        self.state = State::Stopping(at_rest);
        actions.push(Action::StopPath);
    }

    /// Starts a path. For a path of a run call `run_path`, which also records it.
    fn start_path(&mut self, path: Path, window: Window, actions: &mut Actions) {
        self.path = true;
        actions.push(Action::Start { path, window });
    }

    fn acknowledge(&mut self, inputs: &RigInputs) -> Result<(), Refusal> {
        let State::Faulted(fault) = self.state else {
            return Err(Refusal::NothingToAcknowledge);
        };
        // An open loop would latch the next fault at once.
        let present = inputs.estop_loop
            // Cannot be acknowledged: the rig resets when the clock starts.
            || fault == RigFault::ClockMissing
            // The carriage cannot be at both ends: the switches' cable is unplugged, whatever the fault was.
            || inputs.home_flag && inputs.far_limit;
        // Wait for the old path's report: it must not be taken for the next path's.
        if present || self.path {
            return Err(Refusal::CauseStillPresent);
        }
        self.state = State::Unhomed;
        Ok(())
    }

    /// Cuts the pulses, and latches the fault unless one is latched already.
    fn latch(&mut self, fault: RigFault, actions: &mut Actions) {
        actions.push(Action::Cut);
        if let State::Faulted(_) = self.state {
            return; // the first cause is the one to report
        }
        self.end_run(RunOutcome::Faulted(fault), actions);
        self.homed = false;
        self.state = State::Faulted(fault);
        actions.emit(RigEvent::Faulted(fault));
    }

    fn link_silent(&mut self, now: &Now, actions: &mut Actions) {
        let policy = match &self.state {
            State::Running => self.run.map(|run| run.link_loss),
            State::Homing(homing) => Some(homing.link_loss),
            State::Moving(_) => Some(LinkLossPolicy::Stop),
            _ => None,
        };
        if policy == Some(LinkLossPolicy::Stop) {
            self.refuse_repeated_jogs(now.time_us);
            self.stop(now, RunOutcome::LinkLost, actions);
        }
    }

    /// Refuses jogs for a while after the rig has ended one: the host does not know it yet and may repeat a renewal.
    fn refuse_repeated_jogs(&mut self, now_us: u64) {
        if let State::Moving(Some(_)) = self.state {
            self.jog_stopped_until_us = now_us.saturating_add(REPEATED_US);
        }
    }

    fn tick(&mut self, now_us: u64, actions: &mut Actions) {
        match &self.state {
            State::Homing(homing) if now_us > homing.deadline_us => {
                self.latch(RigFault::HomingTimeout(homing.phase), actions);
            }
            State::Moving(Some(jog)) if now_us > jog.until_us => {
                self.refuse_repeated_jogs(now_us);
                self.stop_to(AtRest::Moved, actions);
            }
            _ => {}
        }
    }

    fn flag_edge(&mut self, opening: bool, count: StepPosition, actions: &mut Actions) {
        match &mut self.state {
            State::Running | State::Held | State::Stopping(AtRest::Held | AtRest::Ready(_))
                if opening =>
            {
                self.check_step_loss(count, actions);
            }
            State::Homing(homing) => {
                let found = homing.flag_edge(opening, count);
                if found {
                    actions.push(Action::StopPath);
                }
            }
            _ => {}
        }
    }

    fn path_ended(&mut self, now: &Now, end: PathEnd, report: PathReport, actions: &mut Actions) {
        if !core::mem::take(&mut self.path) {
            return;
        }
        let (commanded, counted) = (report.commanded, report.counted);
        self.rest = counted;
        let missed = self.missed_flag(counted);
        self.record_path(&report);
        if let State::Faulted(_) = self.state {
            return;
        }
        match end {
            PathEnd::Underrun => return self.latch(RigFault::Underrun, actions),
            PathEnd::Guard => return self.latch(RigFault::WindowGuard, actions),
            // The cause may be reported later than the cut. With the loop closed it was the E-stop frame, which cuts
            // before control reads it. The read-back counter has the true position.
            PathEnd::Cut if now.inputs.estop_loop => {
                return self.latch(RigFault::EStopLoop, actions);
            }
            PathEnd::Cut => return self.latch(RigFault::EStopFrame, actions),
            PathEnd::Complete | PathEnd::Stopped => {}
        }
        if commanded != counted {
            return self.latch(read_back(commanded, counted), actions);
        }
        let position_steps = counted.0;
        let stopped = RigEvent::Stopped { position_steps };
        match self.state {
            State::Homing(homing) => self.homing_move_ended(now, homing, counted, actions),
            State::Running if end == PathEnd::Complete => match missed {
                Some(fault) => self.latch(fault, actions),
                None => self.complete(actions),
            },
            // The path ended before it was complete, although no stop was requested.
            State::Running => {
                self.end_run(RunOutcome::Stopped, actions);
                self.state = State::Ready;
                actions.emit(stopped);
            }
            State::Stopping(at_rest) => {
                match at_rest {
                    AtRest::Unhomed => self.state = State::Unhomed,
                    AtRest::Ready(outcome) => {
                        if let Some(fault) = self.lost_at_rest(counted, missed) {
                            return self.latch(fault, actions);
                        }
                        // The stop came after the last step: the run is complete.
                        if end == PathEnd::Complete {
                            self.complete(actions);
                        } else {
                            self.count_stroke_at_rest(counted, actions);
                            self.end_run(outcome, actions);
                            self.state = State::Ready;
                        }
                    }
                    AtRest::Held => return self.held(end, counted, missed, actions),
                    AtRest::Moved => self.state = State::Ready,
                    AtRest::Faulted(fault) => return self.latch(fault, actions),
                }
                actions.emit(stopped);
            }
            State::Moving(_) => {
                self.state = State::Ready;
                actions.emit(RigEvent::Moved { position_steps });
            }
            State::Unhomed | State::Ready | State::Held | State::Faulted(_) => {}
        }
    }
}

fn read_back(commanded: StepPosition, counted: StepPosition) -> RigFault {
    RigFault::ReadBack {
        commanded: commanded.0,
        counted: counted.0,
    }
}
