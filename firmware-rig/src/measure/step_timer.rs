//! TIM1 and its burst: a period of 0, MOE's read-back, the burst's delay, repeated periods, and a burst cut in two.

#![allow(unsafe_code)]

use super::{MS, cycles_since, log_value};
use crate::board::{
    captures::clear_flags,
    channels::INTERVALS,
    pins,
    step_generator::{DMA_CHANNEL, STREAM, StepGenerator, is_armed, rearm_loop},
};
use core::cell::UnsafeCell;
use cortex_m::{asm::delay, peripheral::DWT};
use embassy_stm32::pac::{self, DMA2, TIM1, timer::regs::SrAdv};
use firmware_rig::{execution::Ring, periods::Period};
use measurements::Measurement as M;
use motion::slots::WORDS;
use motion::step_times::Equal;

/// Measures a period of 0, which blocks the counter. It becomes active as in the ring: preloaded, at an update.
pub fn report_blocked() {
    TIM1.arr().write(|w| w.set_arr(999));
    TIM1.egr().write(|w| w.set_ug(true));
    TIM1.cr1().modify(|w| w.set_cen(true));
    delay(MS);
    TIM1.arr().write(|w| w.set_arr(0));
    delay(MS);
    TIM1.sr().write_value(all_but_update());
    delay(MS);
    log_value(M::BlockedCount, TIM1.cnt().read().cnt().into());
    log_value(M::BlockedUpdates, TIM1.sr().read().uif().into());
    TIM1.cr1().modify(|w| w.set_cen(false));
}

/// In SR a written 0 clears a flag and a 1 leaves it.
fn all_but_update() -> SrAdv {
    let mut flags = SrAdv(u32::MAX);
    flags.set_uif(false);
    flags
}

/// Time from setting MOE until it reads back as set. An open loop keeps it from being set.
pub fn report_moe() {
    rearm_loop();
    let began = DWT::cycle_count();
    TIM1.bdtr().modify(|w| w.set_moe(true));
    let reads = (1..=1_000).find(|_| is_armed());
    let cycles = cycles_since(began);
    pins::cut_pulses();
    if let Some(reads) = reads {
        log_value(M::MoeReads, reads);
        log_value(M::MoeCycles, cycles);
    }
}

/// The delay of a burst: the latest counts at which its first and last word are seen, over 100 updates. The counter
/// begins at 0 with the update. Polling finds each word one read late at most.
pub fn report_burst(generator: &mut StepGenerator) {
    const PERIODS: u32 = 100;
    const TICKS: u32 = 20_000;
    generator.clear(200);
    for period in 0..PERIODS {
        let odd = period % 2 == 1;
        // Neighbouring periods differ in first and last word, so that each change shows.
        let _ = generator.push(Period {
            ticks: TICKS + u32::from(odd),
            repeats: 0,
            pulse: odd,
            sync: false,
        });
    }
    if generator.start().is_err() {
        return;
    }
    pins::cut_pulses();
    let mut latest = [0; 2];
    for _ in 0..PERIODS / 2 - 5 {
        for (word, latest) in latest.iter_mut().enumerate() {
            let seen = cortex_m::interrupt::free(|_| count_at_change(word));
            *latest = u32::from(seen).max(*latest);
        }
    }
    generator.halt();
    log_value(M::BurstFirst, latest[0]);
    log_value(M::BurstLast, latest[1]);
}

/// Waits for the next change of the first (0) or last word, and returns the count then.
fn count_at_change(word: usize) -> u16 {
    let now = || match word {
        0 => TIM1.arr().read().arr(),
        _ => TIM1.ccr(2).read().ccr(),
    };
    let (before, began) = (now(), DWT::cycle_count());
    while now() == before && cycles_since(began) < MS {}
    TIM1.cnt().read().cnt()
}

/// Plays slots several times by the repetition counter, and reports what was captured.
pub fn report_repeats(generator: &mut StepGenerator) {
    let groups = [1, 2, 4, 8, 16, 256].map(|steps| Equal {
        interval: 500,
        steps,
    });
    generator.clear(200);
    // 4 ms without a pulse: time for all slots.
    let pause = Period {
        ticks: 65_536,
        ..Period::default()
    };
    let (from, before) = (generator.counted(), INTERVALS.get());
    let pushed = (0..6).all(|_| generator.push(pause).is_ok())
        && generator.push_steps(&groups).is_ok()
        && generator.push(pause).is_ok();
    if !pushed || generator.start().is_err() {
        return;
    }
    let began = DWT::cycle_count();
    while !generator.has_played_out() && cycles_since(began) < 100 * MS {
        generator.update();
    }
    generator.halt();
    while !generator.time_edges(64) {}
    let after = INTERVALS.get();
    let off = |kind: usize| after[kind].wrapping_sub(before[kind]);
    let edges = generator.counted().since(from).unsigned_abs();
    log_value(M::RepeatEdges, edges);
    log_value(M::RepeatExact, off(0));
    log_value(M::RepeatWrong, off(2) + off(3));
    log_value(M::StepAtEnd, pins::step_is_high().into());
}

#[repr(C, align(4))]
struct Burst(UnsafeCell<[u16; WORDS]>);
// SAFETY: constant; only the DMA controller reads it.
unsafe impl Sync for Burst {}
/// Each word has a different value.
static BURST: Burst = Burst(UnsafeCell::new([11, 12, 13, 14, 15]));

/// Removes the request during a burst, and checks where the words of the next one land. After that the timer is
/// unusable until its next reset.
pub fn report_cut_bursts() {
    const TRIES: u32 = 200;
    pins::cut_pulses();
    let (mut cut, mut shift) = (0, 0);
    for wait in 0..TRIES {
        start_burst();
        delay(wait);
        request(false);
        delay(MS / 10);
        if u32::from(DMA2.st(STREAM).ndtr().read().ndt()) % WORDS as u32 != 0 {
            cut += 1;
            clear_registers();
            start_burst();
            delay(MS / 10);
            let found = registers().into_iter().position(|word| word == 11);
            // Found in none of the five: report a larger shift.
            shift = found.unwrap_or(WORDS).max(shift);
        }
        request(false);
        reset_timer();
    }
    log_value(M::CutBursts, cut);
    if cut > 0 {
        log_value(M::CutBurstShift, shift as u32);
    }
}

/// Brings the stream to the start of its words, and raises an update with the request on.
fn start_burst() {
    let stream = DMA2.st(STREAM);
    stream.cr().modify(|w| w.set_en(false));
    while stream.cr().read().en() {}
    clear_flags(DMA2, STREAM);
    stream.m0ar().write_value(BURST.0.get() as u32);
    stream.ndtr().write(|w| w.set_ndt(WORDS as u16));
    stream.cr().write(|w| {
        w.set_chsel(DMA_CHANNEL);
        w.set_dir(pac::dma::vals::Dir::MEMORY_TO_PERIPHERAL);
        w.set_circ(true);
        w.set_minc(true);
        w.set_psize(pac::dma::vals::Size::BITS16);
        w.set_msize(pac::dma::vals::Size::BITS16);
    });
    stream.cr().modify(|w| w.set_en(true));
    request(true);
    TIM1.egr().write(|w| w.set_ug(true));
}

fn request(on: bool) {
    TIM1.dier().modify(|w| w.set_ude(on));
}

/// The registers that a burst writes, in its order.
fn registers() -> [u16; WORDS] {
    [
        TIM1.arr().read().arr(),
        TIM1.rcr().read().rep(),
        TIM1.ccr(0).read().ccr(),
        TIM1.ccr(1).read().ccr(),
        TIM1.ccr(2).read().ccr(),
    ]
}

fn clear_registers() {
    TIM1.arr().write(|w| w.set_arr(0));
    TIM1.rcr().write(|w| w.set_rep(0));
    for channel in 0..3 {
        TIM1.ccr(channel).write(|w| w.set_ccr(0));
    }
}

/// Resets TIM1, including its burst's position, and sets the burst up again.
fn reset_timer() {
    let burst = TIM1.dcr().read();
    pac::RCC.apb2rstr().modify(|w| w.set_tim1rst(true));
    let _ = pac::RCC.apb2rstr().read();
    pac::RCC.apb2rstr().modify(|w| w.set_tim1rst(false));
    TIM1.cr1().write(|w| w.set_arpe(true));
    TIM1.dcr().write_value(burst);
}
