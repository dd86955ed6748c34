//! Runs: start, hold, resume, the step-loss check at the home flag, the record.

use super::{Actions, AtRest, Machine, Now, PathEnd, PathReport, State, read_back};
use crate::periods::Path;
use motion::{
    axis::Direction,
    run::RunPlan,
    units::{StepPosition, Steps},
};
use protocol::{
    error::Refusal,
    rig::{LinkLossPolicy, RigEvent, RigFault, RunOutcome, RunRecord},
};

pub(super) const NO_RUN: RunRecord = RunRecord {
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
    min_queue: None,
    glitches: 0,
    holds: 0,
    image_hash: 0,
    prepared_edges: 0,
    edges_timed: 0,
    worst_interval_error_ticks: 0,
};

/// The run in progress or held.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ActiveRun {
    plan: RunPlan,
    pub(super) link_loss: LinkLossPolicy,
    /// Stroke in progress, from 0.
    stroke: u32,
    /// Ticks of the record at the end of the run, if no further hold or stop intervenes.
    end_ticks: u64,
    /// The flag has opened in this stroke. Only the first edge counts: contacts bounce.
    flag_met: bool,
}

impl ActiveRun {
    fn begin_stroke(&mut self, stroke: u32) {
        (self.stroke, self.flag_met) = (stroke, false);
    }

    fn goes_home(&self) -> bool {
        self.plan.direction(self.stroke) == Some(Direction::Home)
    }

    /// Remaining steps of the stroke in progress, from a position within it.
    fn remaining(&self, position: StepPosition) -> Option<Steps> {
        let steps = self.plan.stroke(self.stroke)?.steps().0;
        let from_home = position.max(StepPosition::HOME);
        let from_home = from_home.distance_to(StepPosition::HOME).0;
        Some(Steps(match self.plan.direction(self.stroke)? {
            Direction::Away => steps.saturating_sub(from_home),
            Direction::Home => from_home.min(steps),
        }))
    }
}

impl Machine {
    pub(super) fn start_run(
        &mut self,
        now: &Now,
        plan: RunPlan,
        link_loss: LinkLossPolicy,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        self.refuse_unless_ready(&now.inputs)?;
        self.refuse_where_moved(now, actions)?;
        if now.position != StepPosition::HOME {
            return Err(Refusal::NotAtHome {
                position_um: self.settings.axis.um_from_home(now.position),
            });
        }
        if now.inputs.far_limit {
            return Err(Refusal::FarLimitOpen);
        }
        self.refuse_where_lost(now, actions)?;
        let run = self.record.run + 1;
        self.record = RunRecord {
            run,
            outcome: RunOutcome::Running,
            plan_hash: plan.hash(),
            image_hash: self.image_hash,
            ..NO_RUN
        };
        self.strokes = plan.strokes();
        self.residual = 0;
        self.last = (StepPosition::HOME, StepPosition::HOME);
        self.started_us = now.time_us;
        self.glitches_at_start = now.glitches;
        self.run = Some(ActiveRun {
            plan,
            link_loss,
            stroke: 0,
            end_ticks: 0,
            flag_met: false,
        });
        self.run_path(Path::Run(plan), actions);
        actions.emit(RigEvent::RunStarted { run });
        Ok(())
    }

    /// Refuses to start, and latches a fault, if the counter has changed since the last path: noise changed it, not the
    /// carriage, so every motion would be off by as much.
    pub(super) fn refuse_where_moved(
        &mut self,
        now: &Now,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        if now.position == self.rest {
            return Ok(());
        }
        let fault = read_back(self.rest, now.position);
        self.latch(fault, actions);
        Err(Refusal::RigFaulted(fault))
    }

    /// Refuses to start, and latches a fault, if the flag is closed at position 0: at least the steps from 0 to the
    /// flag's edge were lost on the way here.
    pub(super) fn refuse_where_lost(
        &mut self,
        now: &Now,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let flag = self.settings.flag;
        let tolerated = flag.distance_to(StepPosition::HOME).0 <= self.settings.max_residual_steps;
        if now.position != StepPosition::HOME || now.inputs.home_flag || tolerated {
            return Ok(());
        }
        let fault = RigFault::LostSteps {
            residual_steps: now.position.since(flag),
        };
        self.latch(fault, actions);
        Err(Refusal::RigFaulted(fault))
    }

    /// Starts a path of the run, within the configured stroke.
    fn run_path(&mut self, path: Path, actions: &mut Actions) {
        self.state = State::Running;
        self.recording = true;
        if let Some(run) = &mut self.run {
            run.end_ticks = self.record.ticks + path.last_tick();
        }
        let window = self.settings.axis.stroke_window();
        self.start_path(path, window, actions);
    }

    pub(super) fn hold(&mut self, actions: &mut Actions) -> Result<(), Refusal> {
        match self.state {
            State::Running => {
                self.stop_to(AtRest::Held, actions);
                Ok(())
            }
            State::Faulted(fault) => Err(Refusal::RigFaulted(fault)),
            _ => Err(Refusal::NothingToHold),
        }
    }

    pub(super) fn resume(&mut self, now: &Now, actions: &mut Actions) -> Result<(), Refusal> {
        let (State::Held, Some(run)) = (self.state, self.run) else {
            return Err(match self.state {
                State::Faulted(fault) => Refusal::RigFaulted(fault),
                _ => Refusal::NothingToResume,
            });
        };
        if now.inputs.estop_loop {
            return Err(Refusal::LoopOpen);
        }
        if now.inputs.far_limit {
            return Err(Refusal::FarLimitOpen);
        }
        if now.position != self.last.1 {
            let fault = read_back(self.last.1, now.position);
            self.latch(fault, actions);
            return Err(Refusal::RigFaulted(fault));
        }
        let (Some(profile), Some(remaining)) =
            (run.plan.stroke(run.stroke), run.remaining(now.position))
        else {
            return Err(Refusal::NothingToResume);
        };
        let first = if remaining == profile.steps() {
            *profile
        } else {
            profile.resumed(remaining).map_err(|_| Refusal::TooSlow)?
        };
        let path = Path::Rest {
            plan: run.plan,
            stroke: run.stroke,
            first,
        };
        self.run_path(path, actions);
        actions.emit(RigEvent::Resumed);
        Ok(())
    }

    pub(super) fn end_run(&mut self, outcome: RunOutcome, actions: &mut Actions) {
        if self.record.outcome == RunOutcome::Running {
            self.record.outcome = outcome;
            let run = self.record.run;
            actions.emit(RigEvent::RunEnded { run, outcome });
        }
    }

    /// Compares the counter with the flag's position at the edge that homing used: opening, on the way home.
    pub(super) fn check_step_loss(&mut self, count: StepPosition, actions: &mut Actions) {
        let Some(run) = &mut self.run else {
            return;
        };
        if run.flag_met || !run.goes_home() {
            return;
        }
        let residual = count.since(self.settings.flag);
        let lost = residual.unsigned_abs() > self.settings.max_residual_steps;
        // At rest, the flag may open a moment late: accept an edge near the expected position. Farther away, someone
        // moved the carriage: ignore it.
        if lost && matches!(self.state, State::Held) {
            return;
        }
        run.flag_met = true;
        self.residual = residual;
        if residual.abs() > self.record.worst_residual_steps.abs() {
            self.record.worst_residual_steps = residual;
        }
        if lost {
            let fault = RigFault::LostSteps {
                residual_steps: residual,
            };
            self.stop_to(AtRest::Faulted(fault), actions);
        }
    }

    pub(super) fn stroke_done(
        &mut self,
        stroke: u32,
        commanded: StepPosition,
        counted: StepPosition,
        actions: &mut Actions,
    ) {
        if !self.recording {
            return;
        }
        let missed = self.missed_flag(counted);
        self.record.strokes = stroke + 1;
        self.track(commanded, counted);
        // Stopping: the stroke was complete before the stop reached the generator.
        let (State::Running | State::Stopping(_), Some(run)) = (self.state, &mut self.run) else {
            return;
        };
        run.begin_stroke(stroke + 1);
        if commanded != counted {
            return self.latch(read_back(commanded, counted), actions);
        }
        if let Some(fault) = missed {
            return self.latch(fault, actions);
        }
        self.emit_stroke_done(stroke, actions);
    }

    fn emit_stroke_done(&self, stroke: u32, actions: &mut Actions) {
        let residual_steps = self.residual;
        actions.emit(RigEvent::StrokeDone {
            stroke,
            residual_steps,
        });
    }

    /// Checks that the flag has opened in a stroke towards home that began where it was certainly closed. If not, steps
    /// were lost: at least the distance from here to the flag's edge.
    pub(super) fn missed_flag(&self, counted: StepPosition) -> Option<RigFault> {
        let flag = self.settings.flag;
        let from = flag.distance_to(StepPosition::HOME).0;
        let from = from
            .saturating_add(self.settings.max_residual_steps)
            .saturating_add(self.settings.closes_the_flag_after().0);
        let on_the_way_home = self.run.is_some_and(|run| {
            run.plan.forward().steps().0 > from && !run.flag_met && run.goes_home()
        });
        let running = matches!(
            self.state,
            State::Running | State::Stopping(AtRest::Held | AtRest::Ready(_))
        );
        (running && on_the_way_home).then(|| RigFault::LostSteps {
            residual_steps: counted.since(flag),
        })
    }

    /// Adds the travel since the last report to the run's record. Reports come at the ends of strokes, so they include
    /// the extreme positions.
    fn track(&mut self, commanded: StepPosition, counted: StepPosition) {
        let record = &mut self.record;
        record.min_steps = record.min_steps.min(commanded.0);
        record.max_steps = record.max_steps.max(commanded.0);
        let commanded_edges = u64::from(commanded.distance_to(self.last.0).0);
        record.commanded_edges += commanded_edges;
        record.prepared_edges += commanded_edges;
        record.counted_edges += u64::from(counted.distance_to(self.last.1).0);
        self.last = (commanded, counted);
    }

    /// Adds a finished path to the record of its run.
    pub(super) fn record_path(&mut self, report: &PathReport) {
        if !core::mem::take(&mut self.recording) {
            return;
        }
        self.record.ticks += report.last_tick;
        self.record.prepared_edges += u64::from(report.unemitted.0);
        let queues = [self.record.min_queue, report.min_queue];
        self.record.min_queue = queues.into_iter().flatten().min();
        let timed = report.timed;
        self.record.edges_timed += timed.edges;
        let worst = &mut self.record.worst_interval_error_ticks;
        *worst = timed.worst_error_ticks.max(*worst);
        self.track(report.commanded, report.counted);
    }

    fn stroke_is_complete(&self, position: StepPosition) -> bool {
        self.run
            .is_some_and(|run| run.remaining(position) == Some(Steps(0)))
    }

    /// Returns the fault `missed` if the carriage rests behind the flag's edge or at the end of its stroke.
    pub(super) fn lost_at_rest(
        &self,
        position: StepPosition,
        missed: Option<RigFault>,
    ) -> Option<RigFault> {
        let flag = self.settings.flag;
        let limit = self.settings.max_residual_steps;
        let is_behind = position < flag && position.distance_to(flag).0 > limit;
        missed.filter(|_| is_behind || self.stroke_is_complete(position))
    }

    /// Handles the rest after a hold: the run is held, or complete if the hold came too late.
    pub(super) fn held(
        &mut self,
        end: PathEnd,
        position: StepPosition,
        missed: Option<RigFault>,
        actions: &mut Actions,
    ) {
        if let Some(fault) = self.lost_at_rest(position, missed) {
            return self.latch(fault, actions);
        }
        let (is_last, is_late) = self.run.map_or((false, false), |run| {
            let is_late = run.end_ticks != self.record.ticks;
            (run.stroke + 1 == self.strokes, is_late)
        });
        if end == PathEnd::Complete
            || self.record.strokes == self.strokes
            || is_last && self.stroke_is_complete(position)
        {
            // The hold came too late. Count it if its braking changed the times of the run.
            self.record.holds += u32::from(is_late);
            return self.complete(actions);
        }
        self.count_stroke_at_rest(position, actions);
        self.record.holds += 1;
        self.state = State::Held;
        actions.emit(RigEvent::Held {
            position_steps: position.0,
        });
    }

    /// Counts the stroke in progress if a stop or hold ended with its last step: execution reports only strokes that
    /// another one follows.
    pub(super) fn count_stroke_at_rest(&mut self, position: StepPosition, actions: &mut Actions) {
        if self.stroke_is_complete(position)
            && let Some(run) = &mut self.run
        {
            let stroke = run.stroke;
            run.begin_stroke(stroke + 1);
            self.record.strokes = stroke + 1;
            self.emit_stroke_done(stroke, actions);
        }
    }

    pub(super) fn complete(&mut self, actions: &mut Actions) {
        self.record.strokes = self.strokes;
        self.emit_stroke_done(self.strokes.saturating_sub(1), actions);
        self.end_run(RunOutcome::Complete, actions);
        self.state = State::Ready;
    }
}
