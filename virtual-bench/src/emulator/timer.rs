//! A timer that records the exact instant of each change of its outputs.

use super::forward::forward;
use rigless::device::{Device, DeviceContext, Level, RegisterFile, RequestChange};
use rigless::soc::Layout;
use rigless::soc::st::tim::{Channel, Family, Tim};
use rigless::time::EventId;

/// A change of one compare output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutputEdge {
    /// Instant on the emulator's clock, ns: that of the timer's event, not of the stop that handled it.
    pub at_ns: u64,
    /// Compare channel, 1 to 4.
    pub channel: u8,
    /// The level after the change. A pin that the timer does not drive counts as low.
    pub high: bool,
}

/// `tim` with a record of every change of the watched outputs. It takes the timer's place on the bus, because an event
/// reaches a device at its exact instant, but a stop of the core may come up to one instruction later.
#[derive(Debug)]
pub(super) struct Watched<F: Family> {
    pub(super) tim: Tim<F>,
    watched: &'static [u8],
    high: [bool; 4],
    pub(super) edges: Vec<OutputEdge>,
    /// Before this instant MOE reads as 0 although it is set.
    moe_reads_from_ns: u64,
    /// By the last write.
    moe_was_set: bool,
}

/// Offset of BDTR, and its bit MOE.
const BDTR: u32 = 0x44;
const MOE: u64 = 1 << 15;
/// How long MOE takes to read back: four clocks of the timer, longer than an instruction. The manual names no figure.
const MOE_DELAY_NS: u64 = 40;

fn is_bdtr<R: Layout>(register: R) -> bool {
    register.spec().offset == BDTR
}

impl<F: Family> Watched<F> {
    pub(super) fn new(tim: Tim<F>, watched: &'static [u8]) -> Self {
        Self {
            tim,
            watched,
            high: [false; 4],
            edges: Vec::new(),
            moe_reads_from_ns: 0,
            moe_was_set: false,
        }
    }

    pub(super) fn high(&self, channel: u8) -> bool {
        self.high[usize::from(channel) - 1]
    }

    pub(super) fn note(&mut self, registers: &RegisterFile, at_ns: u64) {
        for &number in self.watched {
            let Some(channel) = Channel::new(number) else {
                continue;
            };
            let high = self.tim.output(channel, registers) == Some(Level::High);
            let known = &mut self.high[usize::from(number) - 1];
            if high != *known {
                *known = high;
                self.edges.push(OutputEdge {
                    at_ns,
                    channel: number,
                    high,
                });
            }
        }
    }
}

impl<F: Family> Device for Watched<F> {
    type Register = F::Register;

    forward!(tim: layout, peek, on_refused, poll, reset);

    fn read(
        &mut self,
        register: F::Register,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) -> Option<u64> {
        let value = Device::read(&mut self.tim, register, registers, context);
        let now_ns = context.now().0;
        self.note(registers, now_ns);
        if now_ns < self.moe_reads_from_ns && is_bdtr(register) {
            return Some(value.unwrap_or_else(|| registers.get(register)) & !MOE);
        }
        value
    }

    fn write(
        &mut self,
        register: F::Register,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        Device::write(&mut self.tim, register, value, registers, context);
        let now_ns = context.now().0;
        self.note(registers, now_ns);
        if is_bdtr(register) {
            let set = value & MOE != 0;
            if set && !self.moe_was_set {
                self.moe_reads_from_ns = now_ns + MOE_DELAY_NS;
            }
            self.moe_was_set = set;
        }
    }

    fn on_event(
        &mut self,
        event: EventId,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        Device::on_event(&mut self.tim, event, registers, context);
        self.note(registers, context.now().0);
    }

    fn on_request(
        &mut self,
        request: RequestChange,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        Device::on_request(&mut self.tim, request, registers, context);
        self.note(registers, context.now().0);
    }

    fn on_clock(&mut self, hz: u64, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        Device::on_clock(&mut self.tim, hz, registers, context);
        self.note(registers, context.now().0);
    }

    fn on_access(
        &mut self,
        token: u64,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        Device::on_access(&mut self.tim, token, value, registers, context);
        self.note(registers, context.now().0);
    }

    fn reset_line(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        Device::reset_line(&mut self.tim, registers, context);
        self.note(registers, context.now().0);
    }
}
