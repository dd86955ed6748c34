//! Plays paths with the rig's motion code: counts, captures and times their edges, and measures the code's cycles.

use super::{MS, cycles_since, log_value};
use crate::board::{
    channels::{
        DMA_ERRORS, FIFO_ERRORS, INTERVALS, LOST_CAPTURES, MOTION_WAKE, MotionMailbox, NOTICES,
        ORDERS, TIMER_RESETS,
    },
    step_generator::StepGenerator,
};
use core::sync::atomic::Ordering;
use cortex_m::peripheral::DWT;
use embassy_stm32::pac::{GPIOA, gpio::vals::Moder};
use firmware_rig::{
    execution::{MotionTask, Order, Ring},
    machine::Event,
    periods::Path,
    settings::Settings,
};
use measurements::Measurement as M;
use motion::{
    axis::Direction,
    trapezoid::StrokeProfile,
    units::{StepPosition, Steps, Ticks, Window},
};

/// Steps, duration and ramp of a path, ticks, and the first of the seven measurements that it gives: edges missing
/// or too many, intervals by error, captures lost, cycles.
const PATHS: [(u32, u64, u64, M); 3] = [
    // 3503.046 ticks a step.
    (5_000, 17_515_230 + 500_000, 500_000, M::CruiseMissing),
    // 800 ticks a step at the peak.
    (10_000, 16_000_000, 8_000_000, M::RampMissing),
    // 400.497 ticks a step.
    (20_000, 8_009_940 + 500_000, 500_000, M::FastMissing),
];

/// Releases EN, as a reset does. The pull-up then keeps the driver off, even though motion's code switches it on.
fn release_enable() {
    const { assert!(wiring::rig::ENABLE.port == 'A') };
    let pin = wiring::rig::ENABLE.number;
    GPIOA.moder().modify(|w| w.set_moder(pin, Moder::INPUT));
}

/// Plays all paths.
pub fn report(generator: &mut StepGenerator, mut feed: impl FnMut()) {
    release_enable();
    for (steps, duration, ramp, first) in PATHS {
        feed();
        let Ok(profile) = StrokeProfile::from_parts(Steps(steps), Ticks(duration), Ticks(ramp))
        else {
            continue;
        };
        let (before, lost) = (INTERVALS.get(), LOST_CAPTURES.load(Ordering::Relaxed));
        let Some((missing, cycles)) = play(generator, profile, &mut feed) else {
            continue;
        };
        let after = INTERVALS.get();
        let off = |kind: usize| after[kind].wrapping_sub(before[kind]);
        let lost = LOST_CAPTURES.load(Ordering::Relaxed).wrapping_sub(lost);
        let values = [
            missing,
            off(0),
            off(1),
            off(2),
            off(3),
            lost,
            cycles / steps,
        ];
        for (name, value) in M::ALL.into_iter().skip(first as usize).zip(values) {
            log_value(name, value);
        }
    }
    log_value(M::TimerResets, TIMER_RESETS.load(Ordering::Relaxed));
    log_value(M::DmaErrors, DMA_ERRORS.load(Ordering::Relaxed));
    log_value(M::FifoErrors, FIFO_ERRORS.load(Ordering::Relaxed));
}

/// Plays a path as the motion task does. Returns the edges missing or in excess at the pin, and the cycles of the
/// rounds; none if the open loop kept the path from starting.
fn play(
    generator: &mut StepGenerator,
    profile: StrokeProfile,
    mut feed: impl FnMut(),
) -> Option<(u32, u32)> {
    let from = generator.counted();
    let steps = profile.steps().0;
    ORDERS.signal(Order {
        path: Path::Move {
            profile,
            // Home, because an open far limit would end a path away from home, and this measurement is wired without
            // it.
            direction: Direction::Home,
        },
        window: Window {
            first: StepPosition(i32::MIN),
            last: StepPosition(i32::MAX),
        },
        stop_accel: Settings::REFERENCE.stop_accel,
        pulse_ticks: 200,
    });
    let (mut motion, mut cycles) = (MotionTask::default(), 0_u32);
    loop {
        let began = DWT::cycle_count();
        motion.round(generator, &mut MotionMailbox);
        cycles = cycles.wrapping_add(cycles_since(began));
        match NOTICES.try_receive() {
            Ok(Event::PathEnded(_, report)) => {
                let counted = report.counted.since(from).unsigned_abs();
                return Some((steps.abs_diff(counted), cycles));
            }
            Ok(Event::LoopOpened) => return None,
            _ => {}
        }
        feed();
        let wait = motion.pace().within_us() * (MS / 1_000);
        let began = DWT::cycle_count();
        while cycles_since(began) < wait && !MOTION_WAKE.signaled() {}
        MOTION_WAKE.reset();
    }
}
