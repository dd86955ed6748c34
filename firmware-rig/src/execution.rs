//! Executes paths: keeps the step ring filled, turns DIR between strokes, stops, reports ends. Pure: the ring and the
//! other tasks are traits, so that the host tests run what the motion task runs.

use crate::{
    machine::{Event, PathEnd, PathReport},
    periods::{Item, Path, Period, Periods},
};
use device::supervision::CHECK_IN_MS;
use motion::{
    axis::{Acceleration, Direction},
    edge_timing::Timed,
    step_times::Equal,
    units::{StepPosition, Steps, TICKS_PER_US, Window},
};

/// Time prepared ahead in the ring, 8 ms. A stop takes effect only after it.
pub const LEAD_TICKS: u32 = 800_000;
/// Lead at which the ring counts as full, 7.8 ms. The ring plays while it is filled, and replacing each step at once
/// would cost a batch each.
const FULL_TICKS: u32 = LEAD_TICKS / 40 * 39;
/// Fewest periods to keep in the ring: a few long ones reach the lead, but must not let the ring run short.
const MIN_QUEUE: u32 = 8;
/// Periods at which the ring counts as full. It holds 20 more, but on a steep ramp at the highest step rates it plays
/// periods as fast as they are prepared: filling it completely would never end and would starve the other tasks.
const FULL_QUEUE: u32 = 232;
/// Most periods to prepare before showing them to the ring. The captured edges are compared after each batch: on a
/// steep ramp the ring plays nearly as fast as it is filled, so a round lasts as long as the ramp and the capture
/// buffer would overflow.
const BATCH: usize = 64;
/// Batches up to this size are always allowed. A larger one has at most half as many periods as wait in the ring, so
/// that those outlast its preparation.
const LEAST_BATCH: u32 = 8;
/// Most edges compared in one poll.
pub const EDGES_PER_POLL: u32 = 128;
/// Polls needed to drain the capture buffer: 2,048 edges, and one more, because a poll stops at the end of the buffer.
/// The bound keeps noise on the wire from holding up motion.
const POLLS: u32 = 17;
/// Periods in the ring that leave time to compare edges, unless half the lead does.
const AMPLE_QUEUE: u32 = 64;

/// The ring is too nearly empty to append a period safely.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Underrun;

/// Why the ring did not start. No pulse was emitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StartError {
    /// The E-stop loop is open, or was since it was last rearmed.
    LoopOpen,
    /// The first periods were not fetched.
    NotFetched,
}

/// The step generator: a ring of periods that the hardware plays, and the counter of emitted edges.
pub trait Ring {
    /// Halts, and empties the ring for a new path with step pulses of this width.
    fn clear(&mut self, pulse_ticks: u16);

    /// Appends a period; the caller has checked [`Ring::room`].
    ///
    /// # Errors
    /// DMA is so near that it might read an incomplete period.
    fn push(&mut self, period: Period) -> Result<(), Underrun>;

    /// Appends a period for each group of steps: at least one, at most [`Ring::room`]. They become valid together.
    ///
    /// # Errors
    /// DMA is so near that it might read only some of them.
    fn push_steps(&mut self, groups: &[Equal]) -> Result<(), Underrun>;

    /// Free places for periods.
    fn room(&self) -> u32;

    /// Waiting periods, without the one that plays and the preloaded one.
    fn waiting(&self) -> u32;

    /// Ticks from the end of the period that plays to the end of the last one.
    fn lead(&self) -> u32;

    /// Upper bound of the pulses not emitted yet: those of the period in progress and of all queued after it.
    fn waiting_pulses(&self) -> u32;

    /// Pulses that are certainly not emitted yet: those of all periods behind the one that plays.
    fn queued_pulses(&self) -> u32;

    /// Ticks from the last emitted pulse to the end of the last period, if `unemitted` pulses were not emitted. None if
    /// the ring no longer holds that pulse.
    fn ticks_since_last_pulse(&self, unemitted: u32) -> Option<u32>;

    /// The last period has ended, and the ring is empty.
    fn has_played_out(&self) -> bool;

    /// Updates how far the ring has played. All other queries refer to the last update.
    fn update(&mut self);

    /// An error stopped the ring, at any slot, and the last update cut its pulses.
    fn has_failed(&self) -> bool {
        false
    }

    /// Arms the outputs and starts to play.
    ///
    /// # Errors
    /// Nothing was started.
    fn start(&mut self) -> Result<(), StartError>;

    /// Ends the pulses and stops the ring; the motor holds.
    fn halt(&mut self);

    /// Switches the driver on.
    fn enable_driver(&mut self);

    /// Sets DIR and the counter's direction together. Only while no pulse can come.
    fn set_direction(&mut self, direction: Direction);

    /// Position by the counter of emitted edges.
    fn counted(&self) -> StepPosition;

    /// Compares up to `at_most` captured edges with the periods that were pushed. True if no more are waiting.
    fn time_edges(&mut self, at_most: u32) -> bool;

    /// Result of the comparison since the ring was cleared; `whole` if every step was emitted.
    fn timed(&self, whole: bool) -> Timed;
}

/// The other tasks, as execution sees them.
pub trait Mailbox {
    /// Takes the next path to execute, and clears earlier stops and cuts.
    fn take_order(&mut self) -> Option<Order>;

    /// The pulses of the present path were cut.
    fn is_cut(&self) -> bool;

    /// Takes a request to decelerate.
    fn take_stop(&mut self) -> bool;

    /// Notifies control; false if its queue is full.
    fn notify(&mut self, event: Event<'static>) -> bool;

    /// Publishes stroke and position of the present path.
    fn publish(&mut self, stroke: u32, commanded: StepPosition);
}

/// A path, and how to execute it.
#[derive(Clone, Debug)]
pub struct Order {
    pub path: Path,
    /// Allowed positions.
    pub window: Window,
    /// Deceleration of a stop.
    pub stop_accel: Acceleration,
    /// Width of a step pulse.
    pub pulse_ticks: u16,
}

/// Deadline of the next round.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// No path is being executed.
    Idle,
    /// The ring is full: half of it has played after this time.
    Filled { within_us: u32 },
    /// Waits for a turn, the end of the path, or room in control's queue.
    Waiting,
}

impl Pace {
    /// Time until the next round at the latest, us. Rounds that find the ring full are most of the load of steady
    /// motion, so they are as rare as possible.
    pub const fn within_us(self) -> u32 {
        match self {
            Pace::Idle => CHECK_IN_MS as u32 * 1_000,
            Pace::Filled { within_us } => within_us,
            Pace::Waiting => 100,
        }
    }
}

/// The motion task: takes an order, executes it and reports its end.
#[derive(Debug, Default)]
pub struct MotionTask {
    execution: Option<Execution>,
    /// End of a path that is not reported yet because control's queue was full.
    unreported: Option<Event<'static>>,
}

impl MotionTask {
    pub fn pace(&self) -> Pace {
        match &self.execution {
            None if self.unreported.is_none() => Pace::Idle,
            Some(execution)
                if execution.filling == Filling::Full && execution.ended_stroke.is_none() =>
            {
                Pace::Filled {
                    within_us: execution.half_us,
                }
            }
            _ => Pace::Waiting,
        }
    }

    pub fn round(&mut self, ring: &mut impl Ring, mailbox: &mut impl Mailbox) {
        if let Some(execution) = &mut self.execution {
            let ended = execution.advance(ring, mailbox);
            if ended.is_some() {
                (self.execution, self.unreported) = (None, ended);
            }
        } else if self.unreported.is_none()
            && let Some(order) = mailbox.take_order()
        {
            match Execution::begin(ring, mailbox, order) {
                Ok(begun) => self.execution = Some(begun),
                Err(end) => self.unreported = Some(end),
            }
        }
        // If control's queue is full, the next round tries again: this event must not be lost.
        if let Some(event) = &self.unreported
            && mailbox.notify(*event)
        {
            self.unreported = None;
        }
    }
}

/// Why filling the ring has stopped.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Filling {
    Full,
    /// DIR has to turn, after the last pulse of the stroke.
    Turn {
        next: Direction,
    },
    /// Everything is queued.
    Done,
    /// Nothing more may be queued.
    Failed(PathEnd),
}

#[derive(Debug)]
struct Execution {
    periods: Periods,
    stop_accel: Acceleration,
    /// Stroke whose pulses are being emitted.
    stroke: u32,
    /// Direction of the pulses in the ring.
    direction: Direction,
    /// A stroke whose last pulse is queued, but whose end is not reported yet.
    ended_stroke: Option<u32>,
    /// Position up to which every step had certainly been emitted in the last round.
    passed: StepPosition,
    /// Tick of the last step before the ring's pulses.
    passed_tick: u64,
    filling: Filling,
    /// Half of the time prepared in the ring, us.
    half_us: u32,
    min_queue: Option<u16>,
    stopped: bool,
    /// Buffer in which steps are prepared for the ring.
    batch: [Equal; BATCH],
}

impl Execution {
    /// # Errors
    /// The notice of its end: there is nothing to step, or the E-stop loop is open.
    fn begin(
        ring: &mut impl Ring,
        mailbox: &mut impl Mailbox,
        order: Order,
    ) -> Result<Self, Event<'static>> {
        let stroke = order.path.first_stroke();
        ring.clear(order.pulse_ticks);
        ring.enable_driver();
        let position = ring.counted();
        mailbox.publish(stroke, position);
        let Some(periods) = Periods::new(order.path, position, order.window) else {
            let report = PathReport {
                commanded: position,
                counted: position,
                ..PathReport::default()
            };
            return Err(Event::PathEnded(PathEnd::Complete, report));
        };
        let direction = periods.direction();
        ring.set_direction(direction);
        let mut execution = Self {
            periods,
            stop_accel: order.stop_accel,
            stroke,
            direction,
            ended_stroke: None,
            passed: position,
            passed_tick: 0,
            filling: Filling::Full,
            half_us: 0,
            min_queue: None,
            stopped: false,
            batch: [Equal::default(); BATCH],
        };
        execution.fill(ring, mailbox);
        match ring.start() {
            Ok(()) => Ok(execution),
            Err(StartError::LoopOpen) => {
                let _ = mailbox.notify(Event::LoopOpened);
                Err(execution.end(ring, mailbox, PathEnd::Cut))
            }
            Err(StartError::NotFetched) => Err(execution.end(ring, mailbox, PathEnd::Underrun)),
        }
    }

    /// Runs one round. Returns the notice of the end when the path is over.
    fn advance(
        &mut self,
        ring: &mut impl Ring,
        mailbox: &mut impl Mailbox,
    ) -> Option<Event<'static>> {
        ring.update();
        if self.filling == Filling::Full {
            let waiting = ring.waiting() as u16; // the ring holds fewer than that by far
            self.min_queue = Some(self.min_queue.map_or(waiting, |least| least.min(waiting)));
        }
        if mailbox.is_cut() {
            return Some(self.end(ring, mailbox, PathEnd::Cut));
        }
        if ring.has_failed() {
            return Some(self.end(ring, mailbox, PathEnd::Underrun));
        }
        // The pulses are not cut now, so they were not cut at the update above. A cut may come later in this round:
        // then the periods play on without pulses until the ring is halted.
        self.passed = self.before_the_last(ring.waiting_pulses());
        if ring.waiting_pulses() == 0 {
            self.passed_tick = self.periods.last_step();
        }
        if mailbox.take_stop() || (!self.stopped && self.misses_edges(ring)) {
            self.stopped = true;
            self.periods.stop(self.stop_accel);
            if let Filling::Turn { .. } = self.filling {
                self.filling = Filling::Full; // no stroke follows
            }
        }
        self.fill(ring, mailbox);
        self.time_edges(ring);
        mailbox.publish(self.stroke, self.periods.position());
        let played_out = ring.has_played_out();
        let end = match self.filling {
            Filling::Failed(end) => end,
            Filling::Done if played_out && self.stopped => PathEnd::Stopped,
            Filling::Done if played_out => PathEnd::Complete,
            // The ring played out before all periods were queued.
            Filling::Full | Filling::Turn { .. } if played_out => PathEnd::Underrun,
            _ => return None,
        };
        Some(self.end(ring, mailbox, end))
    }

    /// Whether the counter lacks more steps than wait in the ring, so that some are lost. The motion stops, because
    /// only positions at rest show how many.
    fn misses_edges(&self, ring: &impl Ring) -> bool {
        let missed = self.periods.position().distance_to(ring.counted());
        missed.0 > ring.waiting_pulses()
    }

    fn end(
        &mut self,
        ring: &mut impl Ring,
        mailbox: &mut impl Mailbox,
        end: PathEnd,
    ) -> Event<'static> {
        ring.halt();
        ring.update();
        let _ = (0..POLLS).any(|_| ring.time_edges(EDGES_PER_POLL));
        let counted = ring.counted();
        let unemitted = match end {
            PathEnd::Complete | PathEnd::Stopped => 0,
            PathEnd::Cut | PathEnd::Underrun | PathEnd::Guard => self.unemitted(ring, counted),
        };
        if unemitted == 0 {
            self.report_stroke_end(ring, mailbox);
        }
        let last_tick = match ring.ticks_since_last_pulse(unemitted) {
            _ if unemitted == 0 => self.periods.last_step(),
            Some(ticks) => self.periods.cursor() - u64::from(ticks),
            None => self.passed_tick,
        };
        let report = PathReport {
            commanded: self.before_the_last(unemitted),
            unemitted: Steps(unemitted),
            counted,
            last_tick,
            min_queue: self.min_queue,
            timed: ring.timed(unemitted == 0),
        };
        mailbox.publish(self.stroke, report.commanded);
        Event::PathEnded(end, report)
    }

    /// Prepared steps that were not emitted, by the counter, within the limits of the ring. Without its jumper the
    /// counter does not count, and only the steps that were certainly emitted are taken as emitted.
    fn unemitted(&self, ring: &impl Ring, counted: StepPosition) -> u32 {
        let to_come = |from: StepPosition| {
            let steps = self.periods.position().since(from);
            i64::from(steps) * i64::from(self.direction.sign())
        };
        let most = to_come(self.passed).max(0);
        let least = i64::from(ring.queued_pulses()).min(most);
        // Neither limit exceeds the ring's size, so the cast is safe.
        to_come(counted).clamp(least, most) as u32
    }

    /// The position `steps` before the last prepared one. All of these steps go in one direction.
    fn before_the_last(&self, steps: u32) -> StepPosition {
        let end = self.periods.position();
        StepPosition(end.0 - steps as i32 * self.direction.sign())
    }

    fn fill(&mut self, ring: &mut impl Ring, mailbox: &mut impl Mailbox) {
        if all_emitted(ring, mailbox) {
            self.report_stroke_end(ring, mailbox);
        }
        loop {
            match self.filling {
                Filling::Full => {}
                Filling::Turn { next } if all_emitted(ring, mailbox) => {
                    self.report_stroke_end(ring, mailbox);
                    self.turn(ring, next);
                }
                Filling::Turn { .. } | Filling::Done | Filling::Failed(_) => return,
            }
            self.filling = self.top_up(ring);
            if self.filling == Filling::Full {
                self.half_us = ring.lead() / (2 * TICKS_PER_US as u32);
                return;
            }
        }
    }

    /// Fills the ring until it is full or something else has to happen first.
    fn top_up(&mut self, ring: &mut impl Ring) -> Filling {
        loop {
            let (lead, room) = (ring.lead(), ring.room());
            let waiting = ring.waiting();
            if lead >= FULL_TICKS && waiting >= MIN_QUEUE || waiting >= FULL_QUEUE || room == 0 {
                return Filling::Full;
            }
            let most = room.min((waiting / 2).max(LEAST_BATCH)) as usize;
            let batch = &mut self.batch[..most.min(BATCH)];
            let count = self.periods.steps(batch, LEAD_TICKS.saturating_sub(lead));
            let pushed = if count > 0 {
                ring.push_steps(&batch[..count])
            } else {
                match self.periods.next_item() {
                    Item::Period(period) => ring.push(period),
                    Item::StrokeEnd { stroke } => {
                        self.ended_stroke = Some(stroke);
                        Ok(())
                    }
                    Item::Turn { next } => return Filling::Turn { next },
                    Item::End => return Filling::Done,
                    Item::Guard => return Filling::Failed(PathEnd::Guard),
                }
            };
            if pushed.is_err() {
                return Filling::Failed(PathEnd::Underrun);
            }
            self.time_edges(ring);
        }
    }

    /// Compares captured edges for as long as the ring can wait. Without time, some captures are not compared: watching
    /// a run must not end it.
    fn time_edges(&self, ring: &mut impl Ring) {
        for _ in 0..POLLS {
            let ample = ring.lead() >= LEAD_TICKS / 2 || ring.waiting() >= AMPLE_QUEUE;
            if (self.filling == Filling::Full && !ample) || ring.time_edges(EDGES_PER_POLL) {
                return;
            }
            ring.update();
        }
    }

    /// Reports the end of a stroke whose last pulse was emitted, with the counter's position.
    fn report_stroke_end(&mut self, ring: &impl Ring, mailbox: &mut impl Mailbox) {
        let Some(stroke) = self.ended_stroke else {
            return;
        };
        let notified = mailbox.notify(Event::StrokeDone {
            stroke,
            commanded: self.periods.position(),
            counted: ring.counted(),
        });
        if notified {
            self.ended_stroke = None;
        }
        self.stroke = stroke + 1;
    }

    /// Turns DIR for the next stroke, after all pulses were emitted.
    fn turn(&mut self, ring: &mut impl Ring, next: Direction) {
        // If control's queue was full, the end of the stroke stays unreported; the record at the end includes it.
        self.ended_stroke = None;
        ring.set_direction(next);
        self.direction = next;
        self.passed = self.periods.position();
        self.passed_tick = self.periods.last_step();
    }
}

/// Whether every pulse of the ring was emitted. After a cut an empty ring does not show it.
fn all_emitted(ring: &impl Ring, mailbox: &impl Mailbox) -> bool {
    ring.waiting_pulses() == 0 && !mailbox.is_cut()
}
