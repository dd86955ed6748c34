//! A timer whose inputs change often, and whose own events hardly anybody waits for.
//!
//! Its digital filters make an event of each edge of an input. The emulator stops for every event, although most change nothing
//! that anybody notices before the timer is looked at: and then it brings itself up to date first. So the edges are put in with a
//! context whose events lead nowhere, and only those that raise a request or an interrupt are waited for.

use rigless::device::{Device, DeviceContext, RegisterFile, RequestChange};
use rigless::soc::stm32f427::generated::tim2::Register;
use rigless::soc::stm32f427::peripherals::tim::{General, Tim};
use rigless::soc::{Bus, Cpu, Error, Peripheral};
use rigless::time::{EventId, VirtualNanos};

use super::forward::forward;

/// DIER with nothing but the DMA request of channel 2, CCER with nothing but its rising edges (RM0383 sections 13.4.4, 13.4.9).
const CAPTURE_REQUEST: u64 = 1 << 10;
const RISING_EDGES: u64 = 1 << 4;

/// The timer. It takes its place on the bus.
#[derive(Debug)]
pub(super) struct Quiet {
    tim: Tim<General>,
    /// A bus of its own, on which nobody listens.
    nowhere: Bus,
    /// Every event of the timer stops the emulator, as it does without this.
    every_event: bool,
    /// The event that is waited for, and when it comes.
    awaited: Option<(EventId, VirtualNanos)>,
    /// When the timer wanted to be woken last.
    unheard: VirtualNanos,
}

impl Quiet {
    pub(super) fn new(
        tim: Tim<General>,
        cpu: Cpu,
        peripheral: Peripheral,
        every_event: bool,
    ) -> Result<Self, Error> {
        Ok(Self {
            tim,
            nowhere: Bus::builder(cpu, &[], [peripheral]).build()?,
            every_event,
            awaited: None,
            unheard: VirtualNanos(0),
        })
    }

    /// Puts another timer in, as after a reset.
    pub(super) fn replace(&mut self, tim: Tim<General>) {
        self.tim = tim;
        self.awaited = None;
        self.unheard = VirtualNanos(0);
    }

    /// Something outside the chip changes at one of the inputs. To high, or to low.
    pub(super) fn edge(
        &mut self,
        high: bool,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
        change: impl FnOnce(&mut Tim<General>, &mut RegisterFile, &mut DeviceContext<'_>),
    ) {
        // While an event is awaited, the change itself may bring it about: then it must not lead nowhere.
        if self.every_event || self.awaited.is_some() {
            return change(&mut self.tim, registers, context);
        }
        let (_, mut nowhere) = self.nowhere.drive(context.now(), 0);
        change(&mut self.tim, registers, &mut nowhere);
        let Some(at) = self.nowhere.next_event() else {
            return;
        };
        self.nowhere.reset();
        self.unheard = at;
        if is_noticed(high, registers) {
            self.await_at(at, context);
        }
    }

    /// Takes its DMA requests away, or gives them back.
    pub(super) fn keep_from_dma(
        &mut self,
        kept: bool,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let asks_for = registers.get(Register::Dier);
        let value = if kept {
            asks_for & !CAPTURE_REQUEST
        } else {
            asks_for | CAPTURE_REQUEST
        };
        registers.set(Register::Dier, value);
        Device::write(self, Register::Dier, value, registers, context);
    }

    fn await_at(&mut self, at: VirtualNanos, context: &mut DeviceContext<'_>) {
        self.awaited = Some((context.schedule(at), at));
    }
}

/// Whether anybody but the timer itself may notice what follows from a change of an input.
fn is_noticed(high: bool, registers: &RegisterFile) -> bool {
    let asks_for = registers.get(Register::Dier);
    let at_rising_edges =
        asks_for == CAPTURE_REQUEST && registers.get(Register::Ccer) == RISING_EDGES;
    asks_for != 0 && (high || !at_rising_edges)
}

impl Device for Quiet {
    type Register = Register;

    forward!(tim: layout, peek, on_refused, poll);

    /// The status is looked at without bringing the timer up to date: an edge of this very instruction may be put in behind it, with
    /// its own instant.
    fn read(
        &mut self,
        register: Register,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) -> Option<u64> {
        if register == Register::Sr {
            let seen = Device::peek(&self.tim, register, registers, context.now());
            return Some(seen.unwrap_or_else(|| registers.get(register)));
        }
        Device::read(&mut self.tim, register, registers, context)
    }

    fn write(
        &mut self,
        register: Register,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        Device::write(&mut self.tim, register, value, registers, context);
        // What was of no interest may be noticed from now on.
        let pending = self.awaited.is_none() && self.unheard > context.now();
        if pending && is_noticed(true, registers) {
            self.await_at(self.unheard, context);
        }
    }

    fn on_event(
        &mut self,
        event: EventId,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        if self.awaited.is_none_or(|(awaited, _)| awaited != event) {
            return Device::on_event(&mut self.tim, event, registers, context);
        }
        self.awaited = None;
        // The timer does not know this event. Reading a register without side effects brings it up to date.
        Device::read(&mut self.tim, Register::Cr1, registers, context);
    }

    fn on_request(
        &mut self,
        request: RequestChange,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        Device::on_request(&mut self.tim, request, registers, context);
    }

    fn on_clock(&mut self, hz: u64, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        Device::on_clock(&mut self.tim, hz, registers, context);
    }

    fn on_access(
        &mut self,
        token: u64,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        Device::on_access(&mut self.tim, token, value, registers, context);
    }

    fn reset(&mut self) {
        Device::reset(&mut self.tim);
        self.awaited = None;
    }

    fn reset_line(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        Device::reset_line(&mut self.tim, registers, context);
        self.awaited = None;
    }
}
