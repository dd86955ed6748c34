//! A DMA controller with a ring, see [`super::ring`], or with bursts that take time: the words of TIM1's burst come one
//! after the other, so a stop can fall within a burst. The emulator's own transfers take no time.

use rigless::device::{Device, DeviceContext, Level, RegisterFile, RequestChange};
use rigless::soc::st::tim::UPDATE_REQUEST;
use rigless::soc::stm32f427::generated::dma2::Register;
use rigless::soc::stm32f427::peripherals::dma::Dma;
use rigless::time::{EventId, VirtualNanos};

use super::delegate::delegate;
use super::ring::{Ring, StreamId, Streams};

/// Duration of a burst. The manuals give no figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BurstTiming {
    /// From the timer's update to the first word, ns.
    pub first_ns: u64,
    /// From one word to the next, ns.
    pub apart_ns: u64,
}

/// Token of stream 5's access to its peripheral, in the emulator's numbering.
const STORE_OF_STREAM_5: u64 = 11;
const TIMER: &str = "TIM1";

/// Wraps the controller and replaces it on the bus. Passes the timer's request on for one word at a time.
#[derive(Debug)]
pub(super) struct Paced {
    dma: Dma,
    burst_timing: Option<BurstTiming>,
    /// The timer requests words.
    requested: bool,
    /// The request is passed on to the controller.
    shown: bool,
    next_word: Option<EventId>,
    /// The bench's own streams. The first one can skip items.
    pub(super) rings: Vec<Ring>,
}

impl Paced {
    /// `dma` with its own streams only, and this timing of TIM1's bursts.
    pub(super) fn new(dma: Dma, burst_timing: Option<BurstTiming>) -> Self {
        Self {
            dma,
            burst_timing,
            rings: Vec::new(),
            requested: false,
            shown: false,
            next_word: None,
        }
    }

    /// Sets the duration of bursts from now on, unless they take none, as with a ring.
    pub(super) fn set_burst_timing(&mut self, burst_timing: BurstTiming) {
        let paced = self.burst_timing.replace(burst_timing);
        assert!(paced.is_some(), "bursts have to take time from the start");
    }

    /// Takes over the streams at `places`.
    pub(super) fn add_rings(&mut self, places: &[StreamId], streams: Streams) {
        let ring = |place: &StreamId| Ring::new(*place, streams);
        self.rings = places.iter().map(ring).collect();
    }

    /// Makes the emulator's controller, which drives all interrupts, check its flags again: by a write that clears
    /// none.
    pub(super) fn refresh(
        &mut self,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let take = |any, ring: &mut Ring| any | std::mem::take(&mut ring.flagged);
        if self.rings.iter_mut().fold(false, take) {
            Device::write(&mut self.dma, Register::Hifcr, 0, registers, context);
        }
    }

    fn show(
        &mut self,
        level: Level,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        self.shown = level == Level::High;
        let change = RequestChange {
            instance: TIMER,
            request: UPDATE_REQUEST,
            level,
        };
        Device::on_request(&mut self.dma, change, registers, context);
    }

    fn word_in(&mut self, ns: u64, context: &mut DeviceContext<'_>) {
        let at = VirtualNanos(context.now().0 + ns);
        self.next_word = Some(context.schedule(at));
    }
}

impl Device for Paced {
    type Register = Register;

    delegate!(dma: layout, read, peek, poll);

    fn write(
        &mut self,
        register: Register,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let mut rows = (self.rings.iter_mut()).filter_map(|ring| Some((ring.row(register)?, ring)));
        if let Some((row, ring)) = rows.next()
            && ring.write(row, registers, context)
        {
            if !ring.is_running() {
                // The emulator's stream has missed earlier requests.
                let change = ring.request_state();
                Device::on_request(&mut self.dma, change, registers, context);
            }
            return self.refresh(registers, context);
        }
        Device::write(&mut self.dma, register, value, registers, context);
    }

    fn on_refused(
        &mut self,
        token: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        if let Some(ring) = (self.rings.iter_mut()).find(|ring| ring.answers(token).is_some()) {
            ring.refused(registers);
            return self.refresh(registers, context);
        }
        Device::on_refused(&mut self.dma, token, registers, context);
    }

    fn on_event(
        &mut self,
        event: EventId,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        if self.next_word != Some(event) {
            return; // the controller schedules none itself: this one is out of date
        }
        self.next_word = None;
        if self.requested {
            self.show(Level::High, registers, context);
        }
    }

    fn on_request(
        &mut self,
        request: RequestChange,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        if let Some(ring) =
            (self.rings.iter_mut()).find(|ring| ring.hears(request.instance, request.request))
        {
            ring.request(request.level == Level::High, registers, context);
            if ring.is_running() {
                return;
            }
        }
        let Some(burst_timing) = self
            .burst_timing
            .filter(|_| request.instance == TIMER && request.request == UPDATE_REQUEST)
        else {
            return Device::on_request(&mut self.dma, request, registers, context);
        };
        self.requested = request.level == Level::High;
        if self.requested {
            self.word_in(burst_timing.first_ns, context);
        } else {
            self.next_word = None;
            if self.shown {
                self.show(Level::Low, registers, context);
            }
        }
    }

    fn on_access(
        &mut self,
        token: u64,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let mut answers =
            (self.rings.iter_mut()).filter_map(|ring| Some((ring.answers(token)?, ring)));
        if let Some((stored, ring)) = answers.next() {
            ring.answered(stored, value, registers, context);
            return self.refresh(registers, context);
        }
        let word = token == STORE_OF_STREAM_5 && self.burst_timing.is_some();
        if word && self.shown {
            self.show(Level::Low, registers, context);
        }
        Device::on_access(&mut self.dma, token, value, registers, context);
        if let Some(burst_timing) = self.burst_timing.filter(|_| word && self.requested) {
            self.word_in(burst_timing.apart_ns, context);
        }
    }

    fn reset(&mut self) {
        Device::reset(&mut self.dma);
        (self.requested, self.shown, self.next_word) = (false, false, None);
        self.rings.iter_mut().for_each(Ring::reset);
    }
}
