//! A timer whose inputs change often, but whose own events rarely matter.
//!
//! Its digital filters raise an event for each edge of an input, and the emulator stops for every event. Most of these
//! cannot be noticed before the timer is next read, and a read brings it up to date anyway. Edges are therefore applied
//! in the context of the null bus. The emulator stops only for those that raise a request or an interrupt.

use rigless::device::{Device, DeviceContext, RegisterFile};
use rigless::soc::stm32f427::generated::tim2::Register;
use rigless::soc::stm32f427::peripherals::tim::{General, Tim};
use rigless::soc::{Bus, Cpu, Error, Peripheral};
use rigless::time::{EventId, VirtualNanos};

use super::delegate::delegate;

/// Only the DMA request of channel 2 in DIER, and only its rising edges in CCER (RM0383 sections 13.4.4, 13.4.9).
const CAPTURE_REQUEST: u64 = 1 << 10;
const RISING_EDGES: u64 = 1 << 4;

/// CR1: counter enabled, counting down; SMCR: clocked by the external trigger, with any filter (RM0383 sections 13.4.1
/// and 13.4.3).
const COUNTS: u64 = 1 << 0;
const DOWN: u64 = 1 << 4;
const BY_TRIGGER: u64 = 1 << 14;
const FILTER: u64 = 0xF << 8;
/// Registers that keep their reset values in every use handled here.
const NOT_USED: [Register; 7] = [
    Register::Cr2,
    Register::Psc,
    Register::Ccmr2Input,
    Register::Ccr1,
    Register::Ccr3,
    Register::Ccr4,
    Register::Dcr,
];

/// Wraps the timer and replaces it on the bus.
#[derive(Debug)]
pub(super) struct Quiet {
    tim: Tim<General>,
    /// A bus without listeners.
    null_bus: Bus,
    /// Stop the emulator for every event of the timer, as without this wrapper.
    every_event: bool,
    /// The awaited event, and its instant.
    awaited: Option<(EventId, VirtualNanos)>,
    /// Instant of the last event that the timer scheduled on the null bus.
    withheld: VirtualNanos,
    /// When it was last called.
    seen: VirtualNanos,
    /// When an input last rose, and its delay through the filter, ns.
    filtered: Option<(u64, u64)>,
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
            null_bus: Bus::builder(cpu, &[], [peripheral]).build()?,
            every_event,
            awaited: None,
            withheld: VirtualNanos(0),
            seen: VirtualNanos(0),
            filtered: None,
        })
    }

    /// When it was last called. Edges before that can no longer be applied.
    pub(super) fn seen(&self) -> VirtualNanos {
        self.seen
    }

    /// Replaces the timer, as a reset does.
    pub(super) fn replace(&mut self, tim: Tim<General>) {
        self.tim = tim;
        self.awaited = None;
        self.withheld = VirtualNanos(0);
        self.seen = VirtualNanos(0);
        self.filtered = None;
    }

    /// Brings it up to date, as reading a register without side effects does.
    pub(super) fn settle(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        self.seen = context.now();
        Device::read(&mut self.tim, Register::Cr1, registers, context);
    }

    /// Applies a change of an input from outside the chip: to high or to low.
    pub(super) fn edge(
        &mut self,
        high: bool,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
        change: impl FnOnce(&mut Tim<General>, &mut RegisterFile, &mut DeviceContext<'_>),
    ) {
        self.seen = context.now();
        // While an event is awaited, this change may cause it. Then its events must reach the emulator.
        if self.every_event || self.awaited.is_some() {
            return change(&mut self.tim, registers, context);
        }
        let (_, mut null_bus) = self.null_bus.drive(context.now(), 0);
        change(&mut self.tim, registers, &mut null_bus);
        let Some(at) = self.null_bus.next_event() else {
            return;
        };
        self.null_bus.reset();
        self.withheld = at;
        if high {
            let now_ns = context.now().0;
            self.filtered = Some((now_ns, at.0 - now_ns));
        }
        if is_noticed(high, registers) {
            self.await_at(at, context);
        }
    }

    /// Withholds its DMA requests, or passes them on again.
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

    /// Whether it only counts rising edges of its external trigger, in all 32 bits.
    pub(super) fn counts_edges(&self, registers: &RegisterFile) -> bool {
        registers.get(Register::Cr1) & !DOWN == COUNTS
            && registers.get(Register::Smcr) & !FILTER == BY_TRIGGER
            && registers.get(Register::Arr) == u64::from(u32::MAX)
            && NOT_USED
                .iter()
                .all(|&register| registers.get(register) == 0)
            && registers.get(Register::Ccmr1Input) == 0
            && registers.get(Register::Dier) == 0
            && registers.get(Register::Ccer) == 0
            && self.awaited.is_none()
    }

    /// Remaining edges before the count comes near 0 or the end of its range.
    pub(super) fn edges_remaining(&self, registers: &RegisterFile, now: VirtualNanos) -> u64 {
        let count = self.count(registers, now);
        let room = match registers.get(Register::Cr1) & DOWN {
            0 => u64::from(u32::MAX) - count,
            _ => count,
        };
        // The next edge may bring the count to 0, and edges may still be in the filter.
        let margin = 8;
        let is_near_zero = count < margin || count > u64::from(u32::MAX) - margin;
        if is_near_zero {
            0
        } else {
            room.saturating_sub(margin)
        }
    }

    /// Whether it only captures rising edges at channel 2, for DMA. Returns the delay from edge to capture, ns, if it
    /// is known for edges in step with the last one.
    pub(super) fn captures_edges(
        &self,
        registers: &RegisterFile,
        edge_ns: u64,
        tick_ns: u64,
    ) -> Option<u64> {
        let (last_ns, after_ns) = self.filtered?;
        let captures = registers.get(Register::Cr1) == COUNTS
            && registers.get(Register::Smcr) == 0
            && registers.get(Register::Arr) == u64::from(u32::MAX)
            && NOT_USED
                .iter()
                .all(|&register| registers.get(register) == 0)
            && registers.get(Register::Ccmr1Input) & 0x0FFF == 0x0100
            && registers.get(Register::Dier) == CAPTURE_REQUEST
            && registers.get(Register::Ccer) == RISING_EDGES
            && self.awaited.is_none()
            && after_ns < 400
            && last_ns % tick_ns == edge_ns % tick_ns;
        captures.then_some(after_ns)
    }

    /// The count at `at`, which may lie in the future.
    pub(super) fn count(&self, registers: &RegisterFile, at: VirtualNanos) -> u64 {
        Device::peek(&self.tim, Register::Cnt, registers, at).unwrap_or(0)
    }

    /// Counts withheld edges. All of them must have passed the filter before `at`.
    pub(super) fn skip(&mut self, edges: u64, at: VirtualNanos, registers: &mut RegisterFile) {
        let (_, mut null) = self.null_bus.drive(at, 0);
        Device::read(&mut self.tim, Register::Cr1, registers, &mut null);
        let count = Device::peek(&self.tim, Register::Cnt, registers, at).unwrap_or(0);
        let count = match registers.get(Register::Cr1) & DOWN {
            0 => count + edges,
            _ => count - edges,
        };
        let kept = registers.get(Register::Cnt);
        Device::write(&mut self.tim, Register::Cnt, count, registers, &mut null);
        registers.set(Register::Cnt, kept);
        self.null_bus.reset();
    }

    /// Captures a withheld rising edge at `edge` that passes the filter at `at`. Its instant is in memory already.
    pub(super) fn capture(
        &mut self,
        edge: VirtualNanos,
        at: VirtualNanos,
        registers: &mut RegisterFile,
        change: impl FnOnce(&mut Tim<General>, &mut RegisterFile, &mut DeviceContext<'_>),
    ) {
        let (_, mut null) = self.null_bus.drive(edge, 0);
        change(&mut self.tim, registers, &mut null);
        let (_, mut null) = self.null_bus.drive(at, 0);
        Device::read(&mut self.tim, Register::Ccr2, registers, &mut null);
        self.null_bus.reset();
        self.withheld = at;
    }

    fn await_at(&mut self, at: VirtualNanos, context: &mut DeviceContext<'_>) {
        self.awaited = Some((context.schedule(at), at));
    }
}

/// Whether anything but the timer may notice the effect of a change at an input.
fn is_noticed(high: bool, registers: &RegisterFile) -> bool {
    let asks_for = registers.get(Register::Dier);
    let at_rising_edges =
        asks_for == CAPTURE_REQUEST && registers.get(Register::Ccer) == RISING_EDGES;
    asks_for != 0 && (high || !at_rising_edges)
}

impl Device for Quiet {
    type Register = Register;

    delegate!(tim: layout, peek, on_refused, on_request, on_clock, on_access, poll);

    /// Reads the status without bringing the timer up to date: an edge of this very instruction may still be applied
    /// after it, with its own instant.
    fn read(
        &mut self,
        register: Register,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) -> Option<u64> {
        self.seen = context.now();
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
        self.seen = context.now();
        Device::write(&mut self.tim, register, value, registers, context);
        // After this write a withheld event may be noticed.
        let pending = self.awaited.is_none() && self.withheld > context.now();
        if pending && is_noticed(true, registers) {
            self.await_at(self.withheld, context);
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
        // The timer does not know the number of this event, so bring it up to date instead.
        self.settle(registers, context);
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
