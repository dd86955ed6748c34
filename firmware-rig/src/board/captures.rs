//! The instants of the step edges: TIM5 captures each rising edge at its jumper, DMA keeps the instants in a ring.
//!
//! Channel 2 of TIM5 requests DMA1 stream 4, channel 6 (RM0383 table 27). TIM5 has 32 bits and runs at the step timer's
//! 100 MHz, so each interval has to equal the planned one to the tick. Another timer is the firmware's time base.

use super::channels::{DMA_ERRORS, FIFO_ERRORS, LOST_CAPTURES};
use core::sync::atomic::{AtomicU32, Ordering, compiler_fence};
use embassy_stm32::pac::{self, DMA1, TIM5, timer::regs::SrGp16};

/// Size of the capture ring: 8 ms at the highest step rate. Motion reads it every 4 ms.
const INSTANTS: usize = 2_048;
const STREAM: usize = 4;
/// TIM5_CH2 (RM0383 table 27).
const DMA_CHANNEL: u8 = 6;
/// Channel 2's index in the registers that channels 1 and 2 share.
const CHANNEL: usize = 1;

/// Written by the DMA controller only.
static RING: [AtomicU32; INSTANTS] = [const { AtomicU32::new(0) }; INSTANTS];

/// The captured instants; one exists.
pub struct Captures {
    /// The instant to be read next.
    next: usize,
    /// Captured instants from there on.
    unread: usize,
    /// DMA has passed the ring's end, but its flag was not raised yet.
    flag_to_come: bool,
}

impl Captures {
    /// Sets up TIM5 and its DMA stream. From now on every edge is captured.
    pub fn new() -> Self {
        // Eight equal samples at 100 MHz: spikes of less than 80 ns are ignored, and all edges are equally delayed.
        TIM5.ccmr_input(0).modify(|w| {
            w.set_ccs(CHANNEL, pac::timer::vals::CcmrInputCcs::TI4);
            w.set_icf(CHANNEL, pac::timer::vals::FilterValue::FCK_INT_N8);
        });
        TIM5.ccer().modify(|w| w.set_cce(CHANNEL, true));
        TIM5.dier().modify(|w| w.set_ccde(CHANNEL, true));

        start_stream();
        TIM5.cr1().modify(|w| w.set_cen(true));
        Self {
            next: 0,
            unread: 0,
            flag_to_come: false,
        }
    }

    /// Drops all instants captured so far.
    pub fn skip(&mut self) {
        let mut written = written();
        is_overcaptured();
        // An error of a transfer switches the stream off.
        if !DMA1.st(STREAM).cr().read().en() {
            start_stream();
            written.end = 0;
        }
        *self = Self {
            next: written.end,
            unread: 0,
            flag_to_come: false,
        };
    }

    /// Takes up to `at_most` unread instants, up to the ring's end. None if some have been overwritten, in the ring or
    /// in the capture register, or if DMA has stopped.
    pub fn take(&mut self, at_most: usize) -> Option<&'static [AtomicU32]> {
        let Written {
            end,
            at_end,
            stopped,
        } = written();
        // Check this after reading the ring: an instant captured after a lost one reaches the ring only after the flag
        // is set.
        if is_overcaptured() {
            LOST_CAPTURES.fetch_add(1, Ordering::Relaxed);
            return None;
        }
        if stopped {
            return None;
        }
        let seen = (self.next + self.unread) % INSTANTS;
        let mut new = (end + INSTANTS - seen) % INSTANTS;
        if end < seen {
            self.flag_to_come = !at_end;
        } else if at_end && !core::mem::take(&mut self.flag_to_come) {
            new += INSTANTS;
        }
        self.unread += new;
        if self.unread >= INSTANTS {
            return None;
        }
        let (_, from_next) = RING.split_at(self.next);
        let count = self.unread.min(at_most).min(from_next.len());
        self.next = (self.next + count) % INSTANTS;
        self.unread -= count;
        Some(&from_next[..count])
    }

    /// Instants seen by the last [`Captures::take`] that it did not take.
    pub fn has_more(&self) -> bool {
        self.unread > 0
    }
}

/// Begins at the start of the ring.
fn start_stream() {
    // Flags that are set would keep the stream from starting (RM0383 section 9.5.5).
    clear_flags(DMA1, STREAM);
    let stream = DMA1.st(STREAM);
    stream.par().write_value(TIM5.ccr(CHANNEL).as_ptr() as u32);
    stream.m0ar().write_value(RING.as_ptr() as u32);
    stream.ndtr().write(|w| w.set_ndt(INSTANTS as u16));
    stream.cr().write(|w| {
        w.set_chsel(DMA_CHANNEL);
        w.set_dir(pac::dma::vals::Dir::PERIPHERAL_TO_MEMORY);
        w.set_circ(true);
        w.set_minc(true);
        w.set_psize(pac::dma::vals::Size::BITS32);
        w.set_msize(pac::dma::vals::Size::BITS32);
    });
    stream.cr().modify(|w| w.set_en(true));
}

/// DMA's progress since the last poll.
struct Written {
    /// Index of the instant that DMA writes next.
    end: usize,
    /// DMA has reached the ring's end.
    at_end: bool,
    /// An error of a transfer has switched the stream off.
    stopped: bool,
}

/// Polls DMA, and counts its errors.
fn written() -> Written {
    let flags = count_errors(DMA1, STREAM);
    let at_end = flags.tcif(STREAM % 4);
    if at_end {
        DMA1.ifcr(STREAM / 4)
            .write(|w| w.set_tcif(STREAM % 4, true));
    }
    let remaining = usize::from(DMA1.st(STREAM).ndtr().read().ndt());
    compiler_fence(Ordering::SeqCst);
    Written {
        end: (INSTANTS - remaining) % INSTANTS,
        at_end,
        stopped: flags.teif(STREAM % 4),
    }
}

/// Counts and clears the errors of a stream. Returns its flags. In direct mode the FIFO holds one item and its errors
/// lose nothing (RM0383 section 9.3.18), so they are counted apart.
pub fn count_errors(controller: pac::dma::Dma, stream: usize) -> pac::dma::regs::Ixr {
    let flags = controller.isr(stream / 4).read();
    let nth = stream % 4;
    let (error, fifo) = (flags.teif(nth) || flags.dmeif(nth), flags.feif(nth));
    if error || fifo {
        controller.ifcr(stream / 4).write(|w| {
            w.set_teif(nth, error);
            w.set_dmeif(nth, error);
            w.set_feif(nth, fifo);
        });
        DMA_ERRORS.fetch_add(error.into(), Ordering::Relaxed);
        FIFO_ERRORS.fetch_add(fifo.into(), Ordering::Relaxed);
    }
    flags
}

/// Clears all flags of a stream.
pub fn clear_flags(controller: pac::dma::Dma, stream: usize) {
    controller.ifcr(stream / 4).write(|w| {
        w.set_htif(stream % 4, true);
        w.set_tcif(stream % 4, true);
        w.set_teif(stream % 4, true);
        w.set_dmeif(stream % 4, true);
        w.set_feif(stream % 4, true);
    });
}

/// The capture register was overwritten before DMA had fetched the instant in it (CC2OF, RM0383 section 13.4.5), since
/// the last call.
fn is_overcaptured() -> bool {
    let lost = TIM5.sr().read().ccof(CHANNEL);
    if lost {
        // In SR a written 0 clears a flag and a 1 leaves it.
        let mut all_but_this = SrGp16(u32::MAX);
        all_but_this.set_ccof(CHANNEL, false);
        TIM5.sr().write_value(all_but_this);
    }
    lost
}
