//! The step generator: TIM1 makes the pulses, with periods that DMA reads from a ring; TIM2 counts them at the pin;
//! their captured instants are compared with the periods.
//!
//! Each ring slot is one period of TIM1, or several equal ones by its repetition counter: five half-words in register
//! order {ARR, RCR, CCR1, CCR2, CCR3}, written through TIM1_DMAR at every update event (RM0383 sections
//! 12.3.3, 12.4.19 and 12.4.20). PWM mode 1 puts the pulse at the start of a period; CCR1 makes the sync pulse in the
//! same way, so both have no latency at all. Everything is preloaded: while slot j plays, slot j+1 sits in the preload
//! registers and slot j+2 is fetched at the next update. Its first word is already in the stream by then, which in
//! direct mode loads one item ahead.
//!
//! The slot after the last written one is always zero. A zero period blocks the counter with the output low
//! (ARR = 0, RM0383 section 12.4.12): end marker, underrun guard and clean stop in one. However late the
//! producer is, no pulse is ever repeated, doubled or misplaced; the generator only stops.
//!
//! The break flag BIF is the latch of the E-stop loop: every opening sets it, at rest too, and only [`rearm_loop`]
//! clears it. Nothing starts while it is set.

#![allow(unsafe_code)]

use super::{
    captures::{Captures, clear_flags, count_errors},
    channels::{self, INTERVALS, POSITION_SHIFT, TIMER_RESETS},
    clock::clock_failed,
    pins,
};
use core::sync::atomic::{Ordering, compiler_fence};
use embassy_stm32::{
    interrupt::{self, InterruptExt},
    pac::{self, DMA2, TIM1, TIM2},
};
use firmware_rig::{
    execution::{Ring, StartError, Underrun},
    machine::Event,
    periods::Period,
};
use motion::{
    axis::Direction,
    edge_timing::{EdgeTiming, Timed},
    slots::{SLOTS, Slots, WORDS},
    step_times::Equal,
    timeline::{Mark, Timeline},
    units::StepPosition,
};

const RING_WORDS: u32 = (SLOTS * WORDS) as u32;
/// Most periods that may wait in the ring. The remaining slots keep the zero slot away from the reader.
const MAX_QUEUE: i32 = SLOTS as i32 - 4;
/// Width of the sync pulse, 50 us, or as long as the period.
const SYNC_TICKS: u32 = 5_000;
/// The stream of DMA2 that carries the bursts.
pub const STREAM: usize = 5;
/// TIM1_UP (RM0383 table 28).
pub const DMA_CHANNEL: u8 = 6;
/// Reads of MOE before concluding that the loop is open.
const MOE_READS: u32 = 16;
/// Reads of NDTR before concluding that a slot is not fetched.
const FETCH_READS: u32 = 1_000;
/// DCR.DBA of ARR: register offset 0x2C / 4.
const DBA_ARR: u8 = 11;
/// Longest time from a timer request to its first transfer: 2 us at 100 MHz. About 0.5 us is expected.
const REQUEST_CYCLES: u32 = 200;
/// Waits of `REQUEST_CYCLES` before giving up on a burst. Together they are longer than any burst.
const BURST_WAITS: u32 = 50;
/// Reads before giving up on a stream that should stop: it stops within some bus cycles, or never.
const STREAM_READS: u32 = 1_000;
/// Ticks reserved for cutting the pulses, 1 us; it takes less.
const CUT_TICKS: i32 = 100;
/// Reads of STEP before giving up on the end of a pulse. They take longer than any pulse.
const PULSE_READS: u32 = 2_000;
/// Value for TIM1's SR that clears all flags except the break flag: a written 0 clears a flag.
const ALL_BUT_BREAK: pac::timer::regs::SrAdv = pac::timer::regs::SrAdv(1 << 7);

/// Read by the DMA controller.
static RING: Slots = Slots::new();

/// The generator; one exists.
pub struct StepGenerator {
    /// The slots filled since [`Ring::clear`].
    line: Timeline,
    /// Slots that DMA has fetched; exceeds those filled by one while the last one plays, by two when halted.
    fetched: u32,
    /// Slot that DMA reads next, when `fetched` was last updated.
    read_slot: u32,
    running: bool,
    captures: Captures,
    timing: EdgeTiming,
    /// Width of a step pulse: a setting, no less than the driver's minimum (DRV8825: 1.9 us).
    pulse_ticks: u16,
}

impl StepGenerator {
    /// Sets up TIM1, its DMA stream and TIM2. Outputs stay off.
    pub fn new(_: pins::Timers) -> Self {
        configure_timer();
        let stream = DMA2.st(STREAM);
        stream.par().write_value(TIM1.dmar().as_ptr() as u32);

        // Counts rising edges on ETR, up or down by CR1.DIR (RM0383 section 13.3.3, external clock mode 2). A level
        // counts after eight equal samples at 25 MHz: a spike of less than 280 ns is ignored, a pulse of more than 320
        // ns counts. The shortest step pulse is 1 us, and so is the shortest pause between two.
        TIM2.arr().write_value(u32::MAX);
        TIM2.smcr().write(|w| {
            w.set_ece(true);
            w.set_etf(pac::timer::vals::FilterValue::FDTS_DIV4_N8);
        });
        TIM2.egr().write(|w| w.set_ug(true));
        TIM2.cr1().modify(|w| w.set_cen(true));

        // SAFETY: the handler is below; it touches registers and channels only.
        unsafe {
            interrupt::TIM1_BRK_TIM9.enable();
        }
        rearm_loop();
        Self {
            line: Timeline::default(),
            fetched: 0,
            read_slot: 0,
            running: false,
            captures: Captures::new(),
            timing: EdgeTiming::default(),
            pulse_ticks: 0,
        }
    }

    /// Slots that wait in the ring; -1 while the last one plays, -2 when none plays.
    fn queue(&self) -> i32 {
        self.line.given().wrapping_sub(self.fetched) as i32
    }

    /// Cuts the pulses in the pause between two of them: the counter would miss the edge of a pulse shortened below its
    /// filter. E-stop and limits do not wait for the pause.
    fn cut_between_pulses(&mut self) {
        for _ in 0..PULSE_READS {
            let cut = cortex_m::interrupt::free(|_| {
                self.update();
                let slot = self.fetched.wrapping_sub(2);
                let last_tick = RING.last_tick(slot);
                let remaining = i32::from(last_tick) - i32::from(TIM1.cnt().read().cnt());
                // Safe to cut: the next pulse is too far away to begin before the outputs are off, or the counter is
                // blocked.
                let none_begins = remaining > CUT_TICKS || last_tick == 0;
                let cut = none_begins && !pins::step_is_high();
                if cut {
                    pins::cut_pulses();
                }
                cut
            });
            if cut || !self.running {
                break;
            }
        }
        pins::cut_pulses();
    }

    /// Whether there is certainly time to append a period.
    fn is_in_time(&self) -> bool {
        !self.running || self.queue() >= 2
    }

    /// Publishes `count` slots from `first` on by writing the first word of the first one, after all other words. If
    /// DMA fetches a half-written slot anyway, its zero stops the counter.
    fn publish(&mut self, first: u32, last_tick: u16, count: i32) -> Result<(), Underrun> {
        RING.publish(first, last_tick);
        self.update();
        // If no other slot is queued, DMA has fetched the slot before these, and prefetched the first word of the
        // first one: perhaps still the zero that stops the counter.
        if self.running && self.queue() <= count {
            return Err(Underrun);
        }
        Ok(())
    }

    /// The path from the end of a slot to the end of the last one. The slot is `before` slots behind DMA's next read: 2
    /// is the one that plays.
    fn behind(&self, before: u32) -> Mark {
        let mark = self.line.at_end_of(self.fetched.wrapping_sub(before));
        self.line.end().since(mark)
    }
}

impl Ring for StepGenerator {
    fn clear(&mut self, pulse_ticks: u16) {
        self.halt();
        self.pulse_ticks = pulse_ticks;
        for slot in 0..SLOTS as u32 {
            RING.end(slot);
        }
        // Set both, or the stream might continue where the last path ended.
        let stream = DMA2.st(STREAM);
        stream.m0ar().write_value(RING.as_ptr() as u32);
        stream.ndtr().write(|w| w.set_ndt(RING_WORDS as u16));
        self.line.clear();
        (self.fetched, self.read_slot) = (0, 0);
        self.captures.skip();
        self.timing.clear();
    }

    fn push(&mut self, period: Period) -> Result<(), Underrun> {
        let (in_time, slot) = (self.is_in_time(), self.line.given());
        if period.pulse {
            self.line.extend(&[Equal {
                interval: period.ticks,
                steps: u32::from(period.repeats) + 1,
            }]);
        } else {
            self.line.extend_by_pause(period.ticks);
        }
        if !in_time {
            return Err(Underrun);
        }
        let sync = if period.sync {
            SYNC_TICKS.min(period.ticks - 1)
        } else {
            0
        };
        let pulse = if period.pulse { self.pulse_ticks } else { 0 };
        RING.end(slot.wrapping_add(1));
        RING.write(slot, period.repeats.into(), sync as u16, pulse);
        self.publish(slot, (period.ticks - 1) as u16, 1)
    }

    fn push_steps(&mut self, groups: &[Equal]) -> Result<(), Underrun> {
        let (in_time, first) = (self.is_in_time(), self.line.given());
        self.line.extend(groups);
        if !in_time {
            return Err(Underrun);
        }
        RING.end(first.wrapping_add(groups.len() as u32));
        RING.write_steps(first, groups, self.pulse_ticks);
        self.publish(
            first,
            groups[0].interval.wrapping_sub(1) as u16,
            groups.len() as i32,
        )
    }

    fn room(&self) -> u32 {
        (MAX_QUEUE - self.queue()).max(0).unsigned_abs()
    }

    fn waiting(&self) -> u32 {
        self.queue().max(0).unsigned_abs()
    }

    fn has_played_out(&self) -> bool {
        self.queue() <= -2
    }

    fn lead(&self) -> u32 {
        if self.queue() < 0 {
            return 0;
        }
        self.behind(2).ticks
    }

    fn waiting_pulses(&self) -> u32 {
        self.behind(3).pulses
    }

    fn queued_pulses(&self) -> u32 {
        self.behind(2).pulses
    }

    fn ticks_since_last_pulse(&self, unemitted: u32) -> Option<u32> {
        self.line.ticks_since_last_pulse(unemitted)
    }

    // Call it at least once per revolution of the ring.
    fn update(&mut self) {
        let remaining = u32::from(DMA2.st(STREAM).ndtr().read().ndt());
        let slot = (RING_WORDS - remaining) / WORDS as u32 % SLOTS as u32;
        let fetched = slot.wrapping_sub(self.read_slot) % SLOTS as u32;
        self.fetched = self.fetched.wrapping_add(fetched);
        self.read_slot = slot;
        // Without new words TIM1 would repeat its last slot for ever.
        if self.has_failed() {
            pins::cut_pulses();
        }
    }

    fn has_failed(&self) -> bool {
        self.running && !DMA2.st(STREAM).cr().read().en()
    }

    fn start(&mut self) -> Result<(), StartError> {
        let stream = DMA2.st(STREAM);
        clear_flags(DMA2, STREAM);
        stream.cr().write(|w| {
            w.set_chsel(DMA_CHANNEL);
            w.set_dir(pac::dma::vals::Dir::MEMORY_TO_PERIPHERAL);
            w.set_circ(true);
            w.set_minc(true);
            w.set_psize(pac::dma::vals::Size::BITS16);
            w.set_msize(pac::dma::vals::Size::BITS16);
            w.set_pl(pac::dma::vals::Pl::VERY_HIGH);
        });
        compiler_fence(Ordering::SeqCst);
        stream.cr().modify(|w| w.set_en(true));
        enable_requests(true);
        // The first update brings period 0 into the preload registers, the second one makes it active.
        for fetched in 1..=2 {
            TIM1.egr().write(|w| w.set_ug(true));
            let fetches = (0..FETCH_READS).any(|_| {
                self.update();
                self.fetched >= fetched
            });
            if !fetches {
                self.halt();
                return Err(StartError::NotFetched);
            }
        }
        TIM1.sr().write_value(ALL_BUT_BREAK);
        TIM1.bdtr().modify(|w| w.set_moe(true));
        // MOE reads back right only after a resynchronisation of some clocks (RM0383 section 12.3.12).
        let armed = (0..MOE_READS).any(|_| is_armed());
        // The break flag shows an opening that is already over.
        if !armed || TIM1.sr().read().bif(0) {
            self.halt();
            return Err(StartError::LoopOpen);
        }
        // An opening of the far limit since the order's check cut nothing: no pulses were armed.
        if pins::direction() == Direction::Away {
            pins::recheck_far_limit();
        }
        TIM1.cr1().modify(|w| w.set_cen(true));
        self.running = true;
        Ok(())
    }

    fn halt(&mut self) {
        self.cut_between_pulses();
        TIM1.cr1().modify(|w| w.set_cen(false));
        // A burst without its request would end halfway, and the timer might continue it with the next path's words.
        let whole = burst_is_whole();
        enable_requests(false);
        DMA2.st(STREAM).cr().modify(|w| w.set_en(false));
        let stopped = (0..STREAM_READS).any(|_| !DMA2.st(STREAM).cr().read().en());
        if !(whole && stopped) {
            TIMER_RESETS.fetch_add(1, Ordering::Relaxed);
            restart_timer();
        }
        count_errors(DMA2, STREAM);
        clear_flags(DMA2, STREAM);
        self.running = false;
    }

    fn enable_driver(&mut self) {
        pins::enable_driver();
    }

    fn set_direction(&mut self, direction: Direction) {
        pins::set_direction(direction);
        TIM2.cr1().modify(|w| {
            w.set_dir(match direction {
                Direction::Away => pac::timer::vals::Dir::UP,
                Direction::Home => pac::timer::vals::Dir::DOWN,
            })
        });
        if direction == Direction::Away {
            pins::recheck_far_limit();
        }
    }

    fn counted(&self) -> StepPosition {
        counted()
    }

    fn time_edges(&mut self, at_most: u32) -> bool {
        if self.timing.is_over() {
            return true;
        }
        let Some(instants) = self.captures.take(at_most as usize) else {
            self.timing.lose();
            return true;
        };
        self.timing.compare(&self.line, instants);
        INTERVALS.publish(self.timing.intervals());
        !self.captures.has_more()
    }

    fn timed(&self, whole: bool) -> Timed {
        match whole {
            true => self.timing.timed_whole(&self.line),
            false => self.timing.timed(),
        }
    }
}

/// Configures all registers of TIM1 that no path changes. The outputs are off.
fn configure_timer() {
    TIM1.psc().write_value(0);
    TIM1.cr1().write(|w| w.set_arpe(true));
    for channel in [0, 2] {
        TIM1.ccmr_output(channel / 2).modify(|w| {
            w.set_ocm(channel % 2, pac::timer::vals::Ocm::PWM_MODE1);
            w.set_ocpe(channel % 2, true);
        });
        TIM1.ccer().modify(|w| w.set_cce(channel, true));
    }
    TIM1.bdtr().write(|w| {
        w.set_ossi(pac::timer::vals::Ossi::IDLE_LEVEL); // MOE = 0 drives the idle level, low
        w.set_bke(0, true);
        w.set_bkp(0, pac::timer::vals::Bkp::ACTIVE_HIGH); // the loop is closed to ground: high = open = break
    });
    TIM1.dcr().write(|w| {
        w.set_dba(DBA_ARR);
        w.set_dbl(WORDS as u8 - 1);
    });
}

/// Resets TIM1 and configures it again, so that its burst begins at ARR.
fn restart_timer() {
    pac::RCC.apb2rstr().modify(|w| w.set_tim1rst(true));
    let _ = pac::RCC.apb2rstr().read();
    pac::RCC.apb2rstr().modify(|w| w.set_tim1rst(false));
    configure_timer();
    rearm_loop();
}

/// Waits until the burst in progress is complete: the stream then stays between two slots for longer than a request
/// needs. False if that does not happen.
fn burst_is_whole() -> bool {
    let between_slots = || u32::from(DMA2.st(STREAM).ndtr().read().ndt()) % WORDS as u32 == 0;
    (0..BURST_WAITS).any(|_| {
        let before = between_slots();
        cortex_m::asm::delay(REQUEST_CYCLES);
        before && between_slots()
    })
}

/// Position by the read-back counter.
pub fn counted() -> StepPosition {
    StepPosition(TIM2.cnt().read() as i32)
}

/// Sets the read-back counter. Only while no pulse can come.
pub fn set_counted(position: StepPosition) {
    let shift = position.0.wrapping_sub(counted().0);
    POSITION_SHIFT.fetch_add(shift, Ordering::Relaxed);
    TIM2.cnt().write_value(position.0 as u32);
}

/// Position by the read-back counter as if it had never been set: its changes are motion.
pub fn travelled() -> StepPosition {
    let shift = POSITION_SHIFT.load(Ordering::Relaxed);
    StepPosition(counted().0.wrapping_sub(shift))
}

/// The E-stop loop opened, or the clock security broke the timer; the hardware has already cleared MOE.
#[pac::interrupt]
fn TIM1_BRK_TIM9() {
    // Normally the NMI reports this first. Check here in case it is missed.
    if pac::RCC.cir().read().cssf() {
        clock_failed();
    }
    // Keep the flag: it blocks every start until the fault is acknowledged. Mask the interrupt until then.
    enable_break_interrupt(false);
    channels::pulses_were_cut(Event::LoopOpened);
}

/// Clears the latch of the E-stop loop. A loop that is still open is noticed at once.
pub fn rearm_loop() {
    TIM1.sr()
        .write_value(pac::timer::regs::SrAdv(!ALL_BUT_BREAK.0));
    enable_break_interrupt(true);
}

/// Enables or disables the break interrupt. Without interrupts: motion, control and the break's handler change DIER,
/// and so does `enable_requests`.
fn enable_break_interrupt(on: bool) {
    cortex_m::interrupt::free(|_| TIM1.dier().modify(|w| w.set_bie(on)));
}

/// Enables or disables the timer's DMA requests.
fn enable_requests(on: bool) {
    cortex_m::interrupt::free(|_| TIM1.dier().modify(|w| w.set_ude(on)));
}

/// The output is armed: pulses reach the pin.
pub fn is_armed() -> bool {
    TIM1.bdtr().read().moe()
}
