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
use motion::axis::Direction;

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
    loop {
        check_in(Client::Motion);
        if let Ok(order) = with_timeout(CHECK_IN, ORDERS.wait()).await {
            let (end, report) = execute(&mut generator, order).await;
            NOTICES.send(Event::PathEnded(end, report)).await;
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

struct Execution<'a> {
    generator: &'a mut StepGen,
    periods: Periods,
    /// Number of the period with the last pulse.
    last_pulse: u32,
    filling: Filling,
}

impl Execution<'_> {
    fn fill(&mut self) {
        loop {
            if let Filling::Turn { completed, next } = self.filling {
                if !self.generator.has_played(self.last_pulse) {
                    return;
                }
                self.turn(completed, next);
            } else if matches!(self.filling, Filling::Done | Filling::Failed(_)) {
                return;
            }
            self.filling = Filling::Full;
            let enough = self.generator.lead() >= LEAD_TICKS && self.generator.queue() >= MIN_QUEUE;
            if enough || !self.generator.has_room() {
                return;
            }
            self.filling = match self.periods.next_item() {
                Item::Period(period) => match self.generator.push(period) {
                    Ok(()) => {
                        if period.pulse {
                            self.last_pulse = self.generator.pushed();
                        }
                        Filling::Full
                    }
                    Err(stepgen::Underrun) => Filling::Failed(PathEnd::Underrun),
                },
                Item::Turn { completed, next } => Filling::Turn { completed, next },
                Item::End => Filling::Done,
                Item::Guard => Filling::Failed(PathEnd::Guard),
            };
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

    fn report(&self, min_queue: i32) -> PathReport {
        PathReport {
            commanded: self.periods.position(),
            counted: stepgen::counted(),
            last_tick: self.periods.last_step(),
            min_queue: min_queue.clamp(0, i32::from(u16::MAX)) as u16,
        }
    }
}

async fn execute(generator: &mut StepGen, order: Order) -> (PathEnd, PathReport) {
    CUT.store(false, Ordering::Release);
    STOP.store(false, Ordering::Release);
    STROKE.store(order.path.first_stroke(), Ordering::Relaxed);
    generator.clear(order.pulse_ticks);
    board::enable_driver();
    let Some(periods) = Periods::new(order.path, stepgen::counted(), order.window) else {
        let position = stepgen::counted();
        return (
            PathEnd::Complete,
            PathReport {
                commanded: position,
                counted: position,
                ..PathReport::default()
            },
        );
    };
    stepgen::set_direction(periods.direction() == Direction::Away);
    let mut min_queue = i32::MAX;
    let mut stopped = false;
    let mut work = Execution {
        generator,
        periods,
        last_pulse: 0,
        filling: Filling::Full,
    };
    work.fill();
    let mut end = match work.generator.start() {
        Ok(()) => None,
        Err(stepgen::LoopOpen) => {
            let _ = NOTICES.try_send(Event::LoopOpened);
            Some(PathEnd::Cut)
        }
    };
    while end.is_none() {
        let wait = if work.filling == Filling::Full {
            ROUND
        } else {
            SHORT_ROUND
        };
        // Either way there is something to do.
        let _ = with_timeout(wait, MOTION_WAKE.wait()).await;
        check_in(Client::Motion);
        work.generator.update();
        if work.filling == Filling::Full {
            min_queue = min_queue.min(work.generator.queue());
        }
        if CUT.load(Ordering::Acquire) {
            end = Some(PathEnd::Cut);
            break;
        }
        if STOP.swap(false, Ordering::AcqRel) {
            stopped = true;
            work.periods.stop(order.stop_accel);
            if let Filling::Turn { .. } = work.filling {
                work.filling = Filling::Full; // the next stroke does not come
            }
        }
        work.fill();
        COMMANDED.store(work.periods.position(), Ordering::Relaxed);
        end = match work.filling {
            Filling::Failed(end) => {
                board::cut_pulses();
                Some(end)
            }
            Filling::Done if work.generator.queue() <= -2 => Some(if stopped {
                PathEnd::Stopped
            } else {
                PathEnd::Complete
            }),
            // The zero slot was reached with periods still to come.
            _ if work.filling != Filling::Done && work.generator.queue() <= -2 => {
                Some(PathEnd::Underrun)
            }
            _ => None,
        };
    }
    work.generator.halt();
    let report = work.report(min_queue);
    COMMANDED.store(report.commanded, Ordering::Relaxed);
    // Whoever asked for a stop after the end has what they wanted.
    (end.unwrap_or(PathEnd::Cut), report)
}
