//! Home flag and far limit: filtered in the interrupt that their edges raise.
//!
//! The handler samples the contact for 21 us (a setting) after the edge. Shorter pulses (electrical noise of the motor) are
//! counted and have no effect; a contact that stays open stops the pulses 21 us after its edge, within 50 us at the
//! longest setting and two sampling windows. A pulse that ends and begins again raises the next interrupt.

#![allow(unsafe_code)]

use super::{
    channels,
    pins::{self, FAR_LINE, HOME_LINE},
    step_generator,
};
use core::sync::atomic::Ordering;
use embassy_stm32::{
    interrupt,
    pac::{self, EXTI},
};
use embassy_time::Instant;
use firmware_rig::machine::Event;
use motion::axis::Direction;

/// A contact that is still bouncing after this many sampling windows counts as open: the safe side.
const WINDOWS: u32 = 2;

#[pac::interrupt]
fn EXTI9_5() {
    // Before anything else: where the carriage was at the edge.
    let count = step_generator::counted();
    let pending = EXTI.pr(0).read();
    if pending.line(FAR_LINE) {
        let open = settle(FAR_LINE, 1, false, || pins::inputs().far_limit);
        if open && pins::direction() == Direction::Away && step_generator::is_armed() {
            pins::cut_pulses();
            channels::pulses_were_cut(Event::FarLimit);
        }
    }
    if pending.line(HOME_LINE) {
        let before = channels::HOME_FLAG_OPEN.load(Ordering::Relaxed);
        let opening = settle(HOME_LINE, 0, before, || pins::inputs().home_flag);
        if opening != before {
            channels::HOME_FLAG_OPEN.store(opening, Ordering::Relaxed);
            let _ = channels::NOTICES.try_send(Event::FlagEdge { opening, count });
        }
    }
}

/// Samples a contact until it keeps its level for a whole window; counts the pulses that did not last.
fn settle(line: usize, counter: usize, before: bool, level: impl Fn() -> bool) -> bool {
    let window_us = u64::from(channels::SWITCH_FILTER_US.load(Ordering::Relaxed));
    for window in 0..WINDOWS {
        EXTI.pr(0).write(|w| w.set_line(line, true));
        let first = level();
        let start = Instant::now();
        let mut steady = true;
        while steady && start.elapsed().as_micros() < window_us {
            steady = level() == first;
        }
        if steady {
            // A pulse that was over before the first look.
            if window == 0 && first == before {
                channels::GLITCHES[counter].add();
            }
            return first;
        }
        channels::GLITCHES[counter].add();
    }
    true
}
