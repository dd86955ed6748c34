//! Home flag and far limit: filtered in the interrupt that their edges raise.
//!
//! The handler samples the contact for 21 us (a setting) after the edge. It counts shorter pulses (electrical noise of
//! the motor), which have no effect. A contact that stays open stops the pulses 21 us after its edge, within 50 us at
//! the longest setting and two sampling windows. A pulse that ends and begins again raises the next interrupt. A line
//! that does so too often is masked for a millisecond, so that it starves neither motion nor link.

#![allow(unsafe_code)]

use super::{
    channels,
    pins::{self, FAR_LINE, HOME_LINE},
    step_generator,
};
use core::sync::atomic::{AtomicBool, AtomicI32, AtomicU32, Ordering};
use embassy_stm32::{
    interrupt,
    pac::{self, EXTI},
};
use embassy_time::Instant;
use firmware_rig::machine::Event;
use motion::{axis::Direction, units::StepPosition};
use protocol::rig::Switch;

/// A contact that is still bouncing after this many sampling windows has no level.
const WINDOWS: u32 = 2;
/// A line that changes more often than this within a millisecond is masked for a millisecond. With the longest filter
/// three services take 15 % of the processor.
const SERVICES_PER_MS: u32 = 3;
const MASKED_US: u32 = 1_000;
/// A line that is masked more often than this within 100 ms cannot be watched: a fault.
const MASKINGS_PER_100_MS: u32 = 20;

/// How often a line raises its interrupt. Only the interrupt changes it, but tasks clear `is_masked`.
struct Watch {
    line: usize,
    since_us: AtomicU32,
    services: AtomicU32,
    masked_since_us: AtomicU32,
    maskings: AtomicU32,
    /// When the line was masked.
    masked_at_us: AtomicU32,
    is_masked: AtomicBool,
}

impl Watch {
    const fn new(line: usize) -> Self {
        Self {
            line,
            since_us: AtomicU32::new(0),
            services: AtomicU32::new(0),
            masked_since_us: AtomicU32::new(0),
            maskings: AtomicU32::new(0),
            masked_at_us: AtomicU32::new(0),
            is_masked: AtomicBool::new(false),
        }
    }

    /// Counts a service, and masks the line after too many. True if it had to be masked too often.
    fn serve(&self) -> bool {
        if count_within(&self.since_us, &self.services, 1_000) <= SERVICES_PER_MS {
            return false;
        }
        EXTI.imr(0).modify(|w| w.set_line(self.line, false));
        self.masked_at_us.store(now_us(), Ordering::Relaxed);
        self.is_masked.store(true, Ordering::Release);
        // Motion's next round may be 4 ms away, but has to run when the mask ends.
        channels::MOTION_WAKE.signal(());
        count_within(&self.masked_since_us, &self.maskings, 100_000) > MASKINGS_PER_100_MS
    }

    /// Unmasks the line when its time is over, and first checks its level.
    fn unmask_when_due(&self) {
        // Check this first: every round of motion calls this, the line is rarely masked, and reading the clock is slow.
        if !self.is_masked.load(Ordering::Acquire) {
            return;
        }
        let masked_us = now_us().wrapping_sub(self.masked_at_us.load(Ordering::Relaxed));
        if masked_us >= MASKED_US {
            self.is_masked.store(false, Ordering::Relaxed);
            cortex_m::interrupt::free(|_| {
                EXTI.pr(0).write(|w| w.set_line(self.line, true));
                EXTI.imr(0).modify(|w| w.set_line(self.line, true));
                EXTI.swier(0).write(|w| w.set_line(self.line, true));
            });
        }
    }
}

/// Home flag and far limit, in the order of [`channels::GLITCHES`].
static WATCHES: [Watch; 2] = [Watch::new(HOME_LINE), Watch::new(FAR_LINE)];

/// Whether the home flag had no level at its last service, and the carriage's position at the first edge then. Used by
/// the interrupt only.
static BOUNCING: AtomicBool = AtomicBool::new(false);
static FIRST_EDGE: AtomicI32 = AtomicI32::new(0);

fn now_us() -> u32 {
    Instant::now().as_micros() as u32
}

/// Counts events within a window of this length, this one included.
fn count_within(since_us: &AtomicU32, count: &AtomicU32, window_us: u32) -> u32 {
    let now_us = now_us();
    let mut number = count.load(Ordering::Relaxed);
    if now_us.wrapping_sub(since_us.load(Ordering::Relaxed)) >= window_us {
        since_us.store(now_us, Ordering::Relaxed);
        number = 0;
    }
    count.store(number + 1, Ordering::Relaxed);
    number + 1
}

/// Time within which motion has to poll the switches: until a mask ends, or unlimited.
pub fn poll_within_us() -> u32 {
    let masked = |watch: &Watch| watch.is_masked.load(Ordering::Relaxed);
    if WATCHES.iter().any(masked) {
        MASKED_US
    } else {
        u32::MAX
    }
}

/// Unmasks noisy lines whose time is over. Motion calls it in each round, control every 10 ms.
pub fn unmask_due_lines() {
    WATCHES.iter().for_each(Watch::unmask_when_due);
}

#[pac::interrupt]
fn EXTI9_5() {
    // Read the count before anything else: it is the carriage's position at the edge.
    let count = step_generator::counted();
    // A masked line sets its pending bit all the same.
    let pending = pac::exti::regs::Lines(EXTI.pr(0).read().0 & EXTI.imr(0).read().0);
    if pending.line(FAR_LINE) {
        let before = channels::FAR_LIMIT_OPEN.load(Ordering::Relaxed);
        let level = settle(FAR_LINE, 1, before, || pins::inputs().far_limit);
        channels::FAR_LIMIT_OPEN.store(level.unwrap_or(before), Ordering::Relaxed);
        // A contact without a level counts as open: the safe side.
        if level.unwrap_or(true) && pins::direction() == Direction::Away {
            let armed = step_generator::is_armed();
            pins::cut_pulses();
            if armed {
                channels::pulses_were_cut(Event::FarLimit);
            }
        }
        watch(1, Switch::FarLimit);
    }
    if pending.line(HOME_LINE) {
        let before = channels::HOME_FLAG_OPEN.load(Ordering::Relaxed);
        let level = settle(HOME_LINE, 0, before, || pins::inputs().home_flag);
        // A bouncing flag has no level. Once it settles, its first edge gives the position.
        let bounces = BOUNCING.swap(level.is_none(), Ordering::Relaxed);
        if !bounces {
            FIRST_EDGE.store(count.0, Ordering::Relaxed);
        }
        if let Some(opening) = level.filter(|opening| *opening != before) {
            let count = StepPosition(FIRST_EDGE.load(Ordering::Relaxed));
            channels::HOME_FLAG_OPEN.store(opening, Ordering::Relaxed);
            let _ = channels::NOTICES.try_send(Event::FlagEdge { opening, count });
        }
        watch(0, Switch::HomeFlag);
    }
}

fn watch(index: usize, switch: Switch) {
    let too_often = WATCHES[index].serve();
    if WATCHES[index].is_masked.load(Ordering::Relaxed) {
        channels::GLITCHES[index].add_masking();
    }
    if too_often {
        pins::cut_pulses();
        channels::pulses_were_cut(Event::SwitchNoise(switch));
    }
}

/// Samples a contact until it keeps its level for a whole window. Counts the pulses that did not last. None if the
/// contact does not settle.
fn settle(line: usize, counter: usize, before: bool, level: impl Fn() -> bool) -> Option<bool> {
    let window_us = u64::from(channels::SWITCH_FILTER_US.load(Ordering::Relaxed));
    for window in 0..WINDOWS {
        EXTI.pr(0).write(|w| w.set_line(line, true));
        let first = level();
        let start = Instant::now();
        // Read the time first, then the level: an interruption in between must not end the window before its last
        // level is read.
        let steady = loop {
            let is_over = start.elapsed().as_micros() >= window_us;
            let same = level() == first;
            if is_over || !same {
                break same;
            }
        };
        if steady {
            // A pulse that was over before the first sample.
            if window == 0 && first == before {
                channels::GLITCHES[counter].add();
            }
            return Some(first);
        }
        channels::GLITCHES[counter].add();
    }
    None
}
