//! A DMA controller whose bursts take time: the words of TIM1's burst come one after the other, and whoever stops in
//! between has stopped within a burst. The emulator's own transfers all happen in one instant.

use rigless::device::{Device, DeviceContext, Level, RegisterFile, RequestChange};
use rigless::soc::st::tim::UPDATE_REQUEST;
use rigless::soc::stm32f427::generated::dma2::Register;
use rigless::soc::stm32f427::peripherals::dma::Dma;
use rigless::time::{EventId, VirtualNanos};

use super::forward::forward;

/// How long a burst takes. The manuals give no figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Beats {
    /// From the timer's update to the first word, ns.
    pub first_ns: u64,
    /// From one word to the next, ns.
    pub apart_ns: u64,
}

/// The access of stream 5 to its peripheral, in the emulator's numbering.
const STORE_OF_STREAM_5: u64 = 11;
const TIMER: &str = "TIM1";

/// The controller. It takes its place on the bus and shows it the timer's request for one word at a time.
#[derive(Debug)]
pub(super) struct Paced {
    dma: Dma,
    beats: Option<Beats>,
    /// The timer asks for words.
    requested: bool,
    /// The controller sees that it does.
    shown: bool,
    next_word: Option<EventId>,
}

impl Paced {
    pub(super) fn new(dma: Dma, beats: Option<Beats>) -> Self {
        Self {
            dma,
            beats,
            requested: false,
            shown: false,
            next_word: None,
        }
    }

    /// How long bursts take from now on.
    pub(super) fn set_beats(&mut self, beats: Option<Beats>) {
        self.beats = beats;
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

    forward!(dma: layout, read, peek, write, on_refused, poll, reset_line);

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
        let Some(beats) = self
            .beats
            .filter(|_| request.instance == TIMER && request.request == UPDATE_REQUEST)
        else {
            return Device::on_request(&mut self.dma, request, registers, context);
        };
        self.requested = request.level == Level::High;
        if self.requested {
            self.word_in(beats.first_ns, context);
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
        let word = token == STORE_OF_STREAM_5 && self.beats.is_some();
        if word && self.shown {
            self.show(Level::Low, registers, context);
        }
        Device::on_access(&mut self.dma, token, value, registers, context);
        if let Some(beats) = self.beats.filter(|_| word && self.requested) {
            self.word_in(beats.apart_ns, context);
        }
    }

    fn reset(&mut self) {
        Device::reset(&mut self.dma);
        (self.requested, self.shown, self.next_word) = (false, false, None);
    }
}
