//! Starts, extends and ends the fast-forward of the step timer while the processor sleeps, see [`super::fast_forward`].

use std::collections::VecDeque;

use rigless::device::Level;
use rigless::emulator::{Host, Memory};
use rigless::mcu::Mcu;
use rigless::soc::Width;
use rigless::time::VirtualNanos;

use super::dma::Paced;
use super::fast_forward::FastForward;
use super::map::TIM5_CCR2;
use super::ring::IdleRing;
use super::{Chip, OutputEdge, TIM5_CHANNEL, Wiring};

/// The board's answer on the step timer's edges, valid while the firmware changes nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unnoticed {
    /// Pulses at the step output that have no noticeable effect.
    pub pulses: u64,
    /// The sync output is routed to its pin.
    pub syncs: bool,
    /// The step output is wired to the external trigger of TIM2.
    pub counted: bool,
    /// The step output is wired to channel 2 of TIM5.
    pub captured: bool,
}

/// Longest time without a stop, ns; the board is asked again after it.
const LONGEST_NS: u64 = 5_000_000;
const STEP_CHANNEL: u8 = 3;

/// A fast-forward, and the edges that it has not passed to the inputs yet.
#[derive(Debug)]
pub(super) struct Asleep {
    forward: FastForward,
    leads: Unnoticed,
    /// When a pulse ended that had begun before the fast-forward.
    fell_ns: Option<u64>,
    pulses: u64,
    /// The last two pulses: when each began and ended.
    last: [(u64, Option<u64>); 2],
    /// Delay from an edge to its capture, ns, and the ring that the capture goes to.
    capture: Option<(u64, IdleRing)>,
    /// Edges not captured yet.
    to_capture: VecDeque<u64>,
    captures: u64,
}

impl Asleep {
    fn stepped(&mut self, edge: OutputEdge) {
        if edge.channel != STEP_CHANNEL {
            return;
        }
        if edge.high {
            self.pulses += 1;
            self.last = [self.last[1], (edge.at_ns, None)];
            if self.capture.is_some() {
                self.to_capture.push_back(edge.at_ns);
            }
        } else if self.pulses == 0 {
            self.fell_ns = Some(edge.at_ns);
        } else {
            self.last[1].1 = Some(edge.at_ns);
        }
    }

    /// Splits the pulses: the number of those to count at once, and those to pass to the inputs one by one. The latter
    /// are the last pulse, and the one before it while the last one's capture is pending.
    fn split(&self) -> (u64, &[(u64, Option<u64>)]) {
        let enough = if self.to_capture.is_empty() { 1 } else { 2 };
        let shown = self.pulses.min(enough);
        (self.pulses - shown, &self.last[2 - shown as usize..])
    }
}

impl<W: Wiring> Chip<W> {
    /// Begins a fast-forward, if possible, when the processor falls asleep.
    pub(super) fn falls_asleep(&mut self, at: VirtualNanos, host: &mut dyn Host) {
        if self.options.every_event || self.asleep.is_some() {
            return;
        }
        let soon = self.bus().next_event().is_some_and(|next| next <= at);
        let edges = !self.tim1.edges.is_empty() || !self.tim3.edges.is_empty();
        if soon || edges || self.unseen {
            return;
        }
        let slots = self.slots;
        let registers = self.part.bus().slots()[slots.tim1].registers();
        let Some((position, tick_ns)) = self.tim1.position(registers, at) else {
            self.hooks.report_sleep(false);
            return;
        };
        let Some(periods) = idle(&self.dma2, self.part.bus(), slots.dma2) else {
            return;
        };
        let forward = FastForward::new(position, periods, tick_ns, at.0);
        let to_timer = periods.from_memory && periods.bytes == 2;
        if !to_timer || !forward.begins_plainly() {
            return;
        }
        let Some(leads) = self
            .with_pads(at, |wiring, pads| wiring.unnoticed(pads))
            .flatten()
        else {
            return;
        };
        let registers = self.part.bus().slots()[slots.tim2].registers();
        if leads.counted && !self.tim2.counts_edges(registers) {
            return;
        }
        let mut capture = None;
        if leads.captured {
            let registers = self.part.bus().slots()[slots.tim5].registers();
            let after_ns = self
                .tim5
                .captures_edges(registers, position.begun_ns, tick_ns);
            let captures = idle(&self.dma1, self.part.bus(), slots.dma1).filter(|captures| {
                !captures.from_memory
                    && captures.bytes == 4
                    && captures.to_interrupt.is_none()
                    && captures.peripheral_at == TIM5_CCR2
            });
            capture = after_ns.zip(captures);
            if capture.is_none() {
                return;
            }
        }
        self.asleep = Some(Asleep {
            forward,
            leads,
            fell_ns: None,
            pulses: 0,
            last: [(0, None); 2],
            capture,
            to_capture: VecDeque::new(),
            captures: 0,
        });
        self.tim1.parked = true;
        self.hooks.report_waking(true);
        self.extend(at, host);
    }

    /// Extends the fast-forward while the processor sleeps.
    pub(super) fn extend(&mut self, at: VirtualNanos, host: &mut dyn Host) {
        self.follow(at);
        self.write_captures(host);
        let Some(mut asleep) = self.asleep.take() else {
            return;
        };
        let next = self.bus().next_event().unwrap_or(VirtualNanos(u64::MAX));
        let until_ns = next.0.min(at.0 + LONGEST_NS);
        let forward = &mut asleep.forward;
        if forward.end_ns.is_none() && forward.clear_ns < until_ns || forward.clear_ns <= at.0 {
            let noticed = self
                .with_pads(at, |wiring, pads| wiring.unnoticed(pads))
                .flatten();
            let mut pulses = noticed.map_or(0, |noticed| noticed.pulses);
            if asleep.leads.counted {
                let registers = self.part.bus().slots()[self.slots.tim2].registers();
                let remaining = self.tim2.edges_remaining(registers, at);
                pulses = pulses.min(remaining.saturating_sub(asleep.pulses));
            }
            forward.unnoticed = pulses;
            forward.look_ahead(until_ns, host);
            let stop_ns = forward.end_ns.unwrap_or(until_ns);
            if stop_ns < next.0 {
                let exti = self.slots.exti;
                let bus = self.part.bus_mut();
                bus.drive(at, exti).1.schedule(VirtualNanos(stop_ns));
            }
        }
        self.asleep = Some(asleep);
    }

    fn end_ns(&self) -> Option<u64> {
        self.asleep.as_ref()?.forward.end_ns
    }

    /// Whether the fast-forward ends now.
    pub(super) fn fast_forward_ends(&self, at: VirtualNanos) -> bool {
        self.end_ns().is_some_and(|end_ns| end_ns <= at.0)
    }

    /// Passes all edges up to now to the board.
    fn follow(&mut self, at: VirtualNanos) {
        if self.asleep.is_none() {
            return;
        }
        let taken = self.asleep.take().zip(self.wiring.take());
        let (mut asleep, mut wiring) = taken.expect("no update of the board is in progress");
        let mut edges = std::mem::take(&mut self.followed);
        asleep.forward.advance(at.0, &mut |edge| edges.push(edge));
        for edge in edges.drain(..) {
            asleep.stepped(edge);
            let on_bench = OutputEdge {
                at_ns: edge.at_ns + self.epoch_ns,
                ..edge
            };
            wiring.unseen_edge(on_bench, &asleep.leads);
        }
        self.followed = edges;
        self.wiring = Some(wiring);
        if let Some((after_ns, captures)) = asleep.capture {
            let registers = self.part.bus().slots()[self.slots.tim5].registers();
            while let Some(&edge_ns) = asleep.to_capture.front()
                && edge_ns + after_ns <= at.0
            {
                asleep.to_capture.pop_front();
                let instant = self.tim5.count(registers, VirtualNanos(edge_ns + after_ns));
                let item = (captures.next + asleep.captures) % captures.items;
                self.captured
                    .push((captures.base + item * captures.bytes, instant));
                asleep.captures += 1;
            }
        }
        self.asleep = Some(asleep);
    }

    /// Writes the instants captured during sleep to memory.
    pub(super) fn write_captures(&mut self, memory: &mut dyn Host) {
        for (address, instant) in self.captured.drain(..) {
            // The stream has written there before, so the address is valid.
            let _ = Memory::write(memory, address, Width::W32, instant);
        }
    }

    /// Brings the timers and streams up to date, before a register is read or the processor wakes.
    pub(super) fn catch_up(&mut self, at: VirtualNanos) {
        // The timer itself handles the event that ends the fast-forward.
        let to = (self.end_ns()).map_or(at, |end_ns| at.min(VirtualNanos(end_ns - 1)));
        self.follow(to);
        let Some(asleep) = self.asleep.take() else {
            return;
        };
        self.hooks.report_waking(false);
        let slots = self.slots;
        let bus = self.part.bus_mut();
        let (registers, mut context) = bus.drive(at, slots.tim1);
        self.tim1.resume(
            &asleep.forward,
            to,
            &mut self.null_bus,
            registers,
            &mut context,
        );
        let (registers, mut context) = bus.drive(at, slots.dma2);
        if let Some(periods) = self.dma2.rings.first_mut() {
            let items = asleep.forward.fetched * super::fast_forward::WORDS as u64;
            periods.skip(items, asleep.forward.held(), registers);
        }
        self.dma2.refresh(registers, &mut context);
        if asleep.leads.counted {
            self.count(&asleep);
        }
        if let Some((after_ns, _)) = asleep.capture {
            self.capture(&asleep, after_ns, to);
            let (registers, mut context) = self.part.bus_mut().drive(at, slots.dma1);
            if let Some(captures) = self.dma1.rings.first_mut() {
                captures.skip(asleep.captures, None, registers);
            }
            self.dma1.refresh(registers, &mut context);
        }
    }

    /// Passes the withheld edges to TIM2.
    fn count(&mut self, asleep: &Asleep) {
        let slot = self.slots.tim2;
        let (skipped, shown) = asleep.split();
        let fell = asleep.fell_ns.map(|at_ns| (at_ns, false));
        let mut edges: Vec<_> = fell.into_iter().collect();
        for &(rose_ns, fell_ns) in shown {
            edges.push((rose_ns, true));
            edges.extend(fell_ns.map(|at_ns| (at_ns, false)));
        }
        let bus = self.part.bus_mut();
        for (at_ns, high) in edges {
            let (registers, mut context) = bus.drive(VirtualNanos(at_ns), slot);
            if skipped > 0 && high && at_ns == shown[0].0 {
                self.tim2.skip(skipped, VirtualNanos(at_ns - 1), registers);
            }
            self.tim2
                .edge(high, registers, &mut context, |tim, registers, context| {
                    tim.drive_etr(Level::from(high), registers, context);
                });
        }
    }

    /// Passes the withheld edges to TIM5. Those captured by `to` have been written to memory.
    fn capture(&mut self, asleep: &Asleep, after_ns: u64, to: VirtualNanos) {
        let slot = self.slots.tim5;
        let bus = self.part.bus_mut();
        let channel = rigless::soc::st::tim::Channel::new(TIM5_CHANNEL).expect("channel 2");
        let mut drive = |at_ns: u64, high: bool| {
            let at = VirtualNanos(at_ns);
            let through = VirtualNanos(at_ns + after_ns);
            let (registers, mut context) = bus.drive(at, slot);
            if high && through <= to {
                self.tim5
                    .capture(at, through, registers, |tim, registers, context| {
                        tim.drive_input(channel, Level::High, registers, context);
                    });
            } else {
                self.tim5
                    .edge(high, registers, &mut context, |tim, registers, context| {
                        tim.drive_input(channel, Level::from(high), registers, context);
                    });
            }
        };
        if let Some(at_ns) = asleep.fell_ns {
            drive(at_ns, false);
        }
        for &(rose_ns, fell_ns) in asleep.split().1 {
            drive(rose_ns, true);
            if let Some(at_ns) = fell_ns {
                drive(at_ns, false);
            }
        }
    }
}

fn idle(controller: &Paced, bus: &rigless::soc::Bus, slot: usize) -> Option<IdleRing> {
    let registers = bus.slots()[slot].registers();
    controller.rings.first()?.idle(registers)
}
