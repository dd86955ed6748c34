//! Executes paths: keeps the step ring filled, turns DIR between strokes, reports ends.

use super::watchdog::{CHECK_IN, Client, check_in};
use crate::{
    board,
    channels::{COMMANDED, CUT, MOTION_WAKE, NOTICES, ORDERS, Order, STOP, STROKE},
    stepgen::{self, StepGen},
};
use core::sync::atomic::Ordering;
use embassy_time::{Duration, with_timeout};
use firmware_rig::{
    machine::{Event, PathEnd, PathReport},
    periods::{Item, Periods},
};
use motion::axis::{Acceleration, Direction};

/// Time that is kept prepared in the ring: what a stop has to wait for before it takes effect.
const LEAD_TICKS: u32 = 800_000;
/// Few, long periods must not let the ring run short.
const MIN_QUEUE: i32 = 8;
/// The ring wakes the task twice a round; this is for slow motion, where a round takes long.
const ROUND: Duration = Duration::from_millis(2);
/// While a turn or the end is awaited.
const SHORT_ROUND: Duration = Duration::from_micros(100);

/// Highest task priority. Idle: every 100 ms. Moving: every 2 ms at the latest.
#[embassy_executor::task]
pub async fn motion(mut generator: StepGen) -> ! {
    let mut work = None::<Execution>;
    let mut ended = None;
    loop {
        check_in(Client::Motion);
        let wait = match &work {
            None if ended.is_none() => CHECK_IN,
            Some(work) if work.filling == Filling::Full => ROUND,
            _ => SHORT_ROUND,
        };
        // Either way there is something to do.
        let _ = with_timeout(wait, MOTION_WAKE.wait()).await;
        if let Some(present) = &mut work {
            ended = present.advance(&mut generator);
            if ended.is_some() {
                work = None;
            }
        } else if ended.is_none()
            && let Some(order) = ORDERS.try_take()
        {
            match Execution::begin(&mut generator, order) {
                Ok(begun) => work = Some(begun),
                Err(end) => ended = Some(end),
            }
        }
        if let Some(event) = ended.take()
            && NOTICES.try_send(event).is_err()
        {
            // Control is behind, and has to know: in the next round.
            ended = Some(event);
        }
    }
}

/// Why the ring is not being filled.
#[derive(Clone, Copy, PartialEq)]
enum Filling {
    /// It is full.
    Full,
    /// The last pulse of a stroke has to leave the pin first.
    Turn { completed: u32, next: Direction },
    /// Everything has been handed out.
    Done,
    /// Nothing more may be handed out.
    Failed(PathEnd),
}

/// A path on its way to the pins.
struct Execution {
    periods: Periods,
    stop_accel: Acceleration,
    filling: Filling,
    min_queue: i32,
    stopped: bool,
}

impl Execution {
    /// # Errors
    /// The notice of its end: there is nothing to step, or the E-stop's loop is open.
    fn begin(generator: &mut StepGen, order: Order) -> Result<Self, Event> {
        CUT.store(false, Ordering::Release);
        STOP.store(false, Ordering::Release);
        STROKE.store(order.path.first_stroke(), Ordering::Relaxed);
        generator.clear(order.pulse_ticks);
        board::enable_driver();
        let Some(periods) = Periods::new(order.path, stepgen::counted(), order.window) else {
            let position = stepgen::counted();
            let report = PathReport {
                commanded: position,
                counted: position,
                ..PathReport::default()
            };
            return Err(Event::PathEnded(PathEnd::Complete, report));
        };
        stepgen::set_direction(periods.direction() == Direction::Away);
        let mut work = Self {
            periods,
            stop_accel: order.stop_accel,
            filling: Filling::Full,
            min_queue: i32::MAX,
            stopped: false,
        };
        work.fill(generator);
        match generator.start() {
            Ok(()) => Ok(work),
            Err(stepgen::LoopOpen) => {
                let _ = NOTICES.try_send(Event::LoopOpened);
                Err(work.end(generator, PathEnd::Cut))
            }
        }
    }

    /// More steps have not been counted than wait in the ring. A stop follows, and then the positions at rest tell.
    fn misses_edges(&self, generator: &StepGen) -> bool {
        let missed = self.periods.position().abs_diff(stepgen::counted());
        missed > generator.waiting_pulses()
    }

    /// One round; the notice of the end when it is over.
    fn advance(&mut self, generator: &mut StepGen) -> Option<Event> {
        generator.update();
        if self.filling == Filling::Full {
            self.min_queue = self.min_queue.min(generator.queue());
        }
        if CUT.load(Ordering::Acquire) {
            return Some(self.end(generator, PathEnd::Cut));
        }
        if STOP.swap(false, Ordering::AcqRel) || (!self.stopped && self.misses_edges(generator)) {
            self.stopped = true;
            self.periods.stop(self.stop_accel);
            if let Filling::Turn { .. } = self.filling {
                self.filling = Filling::Full; // the next stroke does not come
            }
        }
        self.fill(generator);
        COMMANDED.store(self.periods.position(), Ordering::Relaxed);
        // The zero slot behind the last period.
        let played = generator.queue() <= -2;
        let end = match self.filling {
            Filling::Failed(end) => {
                board::cut_pulses();
                end
            }
            Filling::Done if played && self.stopped => PathEnd::Stopped,
            Filling::Done if played => PathEnd::Complete,
            // It was reached with periods still to come.
            Filling::Full | Filling::Turn { .. } if played => PathEnd::Underrun,
            _ => return None,
        };
        Some(self.end(generator, end))
    }

    fn end(&self, generator: &mut StepGen, end: PathEnd) -> Event {
        generator.halt();
        let report = PathReport {
            commanded: self.periods.position(),
            counted: stepgen::counted(),
            last_tick: self.periods.last_step(),
            min_queue: self.min_queue.clamp(0, i32::from(u16::MAX)) as u16,
        };
        COMMANDED.store(report.commanded, Ordering::Relaxed);
        Event::PathEnded(end, report)
    }

    fn fill(&mut self, generator: &mut StepGen) {
        loop {
            match self.filling {
                Filling::Full => {}
                Filling::Turn { completed, next } if generator.waiting_pulses() == 0 => {
                    self.turn(completed, next);
                }
                Filling::Turn { .. } | Filling::Done | Filling::Failed(_) => return,
            }
            self.filling = self.top_up(generator);
            if self.filling == Filling::Full {
                return;
            }
        }
    }

    /// Until the ring is full or something else is to be done.
    fn top_up(&mut self, generator: &mut StepGen) -> Filling {
        loop {
            let enough = generator.lead() >= LEAD_TICKS && generator.queue() >= MIN_QUEUE;
            if enough || !generator.has_room() {
                return Filling::Full;
            }
            match self.periods.next_item() {
                Item::Period(period) => {
                    if generator.push(period).is_err() {
                        return Filling::Failed(PathEnd::Underrun);
                    }
                }
                Item::Turn { completed, next } => return Filling::Turn { completed, next },
                Item::End => return Filling::Done,
                Item::Guard => return Filling::Failed(PathEnd::Guard),
            }
        }
    }

    /// All pulses of a stroke have left: the counter must show them, and DIR may change.
    fn turn(&mut self, completed: u32, next: Direction) {
        let commanded = self.periods.position();
        let _ = NOTICES.try_send(Event::StrokeDone {
            stroke: completed,
            commanded,
            counted: stepgen::counted(),
        });
        stepgen::set_direction(next == Direction::Away);
        STROKE.store(completed + 1, Ordering::Relaxed);
    }
}
