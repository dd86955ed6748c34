//! A timer that records the exact instant of each change of its outputs.

use super::delegate::delegate;
use rigless::device::{Device, DeviceContext, Level, RegisterFile, RequestChange};
use rigless::soc::st::tim::{Channel, Family, Tim, UPDATE_REQUEST};
use rigless::soc::stm32f427::generated::tim1;
use rigless::soc::stm32f427::peripherals::tim::Advanced;
use rigless::soc::{Bus, Layout};
use rigless::time::{EventId, VirtualNanos};

use super::fast_forward::{FastForward, Position, Slot, WORDS, Words};

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
    /// Until this instant MOE reads as 0 although it is set.
    moe_reads_from_ns: u64,
    /// Whether the last write set MOE.
    moe_was_set: bool,
    /// The shortcut for bursts; `None` disables it.
    burst: Option<Burst<F::Register>>,
    /// The shortcut for pulses; `None` disables it.
    deferred: Option<Deferred<F::Register>>,
    /// It is frozen during a fast-forward, see [`super::fast_forward`].
    pub(super) parked: bool,
    /// An event scheduled on behalf of the timer, which does not know its number.
    awaited: Option<EventId>,
    /// Instant of an event that came while it was frozen.
    missed: Option<VirtualNanos>,
}

/// Offsets of registers (RM0383 section 12.4).
const CR1: u32 = 0x00;
const CCMR1: u32 = 0x18;
const CCMR2: u32 = 0x1C;
const ARR: u32 = 0x2C;
const DCR: u32 = 0x48;
const DMAR: u32 = 0x4C;
const BURST: u64 = ((WORDS as u64 - 1) << 8) | (ARR as u64 / 4);
/// Index of the word for CCR2: its channel is unused, and the word is always the same.
const NOT_PRELOADED: usize = 3;
/// CR1.ARPE and CEN, the preload bit in CCMRx, and the bits of CCMRx that make a channel an input.
const PRELOADED_PERIOD: u64 = 1 << 7;
const COUNTS: u64 = 1 << 0;
const PRELOADED_ODD_CHANNEL: u64 = 1 << 3;
const INPUTS: u64 = 0x0303;

/// The bursts that load the next period. Each of their words makes the timer compute its events again, four times,
/// although preloaded registers change nothing before the next update. If all of them are preloaded, the words
/// therefore bypass the timer and go straight to its registers. The timer gets the last word only.
#[derive(Debug)]
struct Burst<R> {
    cr1: R,
    ccmr1: R,
    ccmr2: R,
    dcr: R,
    targets: [R; WORDS],
    /// Index of the next word, whether DMA or the processor writes it.
    next: u64,
    /// The burst in progress bypasses the timer.
    past: bool,
    /// The last words that bypassed the timer.
    words: Option<Words>,
    /// The words before those, and the instant of the update that made them the current period. None if the processor
    /// has intervened.
    playing: Option<(Words, u64)>,
    /// Bursts that bypassed it since the processor last wrote one of these registers.
    undisturbed: u64,
}

fn register_at<R: Layout>(offset: u32) -> Option<R> {
    (0..)
        .map_while(R::from_index)
        .find(|register| register.spec().offset == offset)
}

impl<R: Layout> Burst<R> {
    fn new() -> Option<Self> {
        let target = |nth: u32| register_at(ARR + 4 * nth);
        Some(Self {
            cr1: register_at(CR1)?,
            ccmr1: register_at(CCMR1)?,
            ccmr2: register_at(CCMR2)?,
            dcr: register_at(DCR)?,
            targets: [target(0)?, target(1)?, target(2)?, target(3)?, target(4)?],
            next: 0,
            past: false,
            words: None,
            playing: None,
            undisturbed: 0,
        })
    }

    /// Whether a burst that begins now may bypass the timer.
    fn may_pass(&self, registers: &RegisterFile) -> bool {
        let is_preloaded =
            |control: u64| control & (PRELOADED_ODD_CHANNEL | INPUTS) == PRELOADED_ODD_CHANNEL;
        registers.get(self.dcr) == BURST
            && registers.get(self.cr1) & PRELOADED_PERIOD != 0
            && is_preloaded(registers.get(self.ccmr1))
            && is_preloaded(registers.get(self.ccmr2))
    }

    /// The next word's index, and whether it bypasses the timer.
    fn next(&mut self, registers: &RegisterFile) -> (usize, bool) {
        let length = (registers.get(self.dcr) >> 8 & 0x1F) + 1;
        let index = self.next;
        self.next = (index + 1) % length;
        if index == 0 {
            self.past = self.may_pass(registers);
        }
        (index as usize, self.past)
    }

    /// Index of the word in a burst that goes into `register`.
    fn word_of(&self, register: R) -> Option<usize> {
        let nth = register.spec().offset.checked_sub(ARR)? / 4;
        (nth < WORDS as u32).then_some(nth as usize)
    }

    fn reset(&mut self) {
        (self.next, self.past, self.words) = (0, false, None);
        (self.playing, self.undisturbed) = (None, 0);
    }
}

/// Registers through which others than the board notice an event of the timer: interrupts and DMA requests, the trigger
/// output, and the inputs that control the counter.
const CR2: u32 = 0x04;
const SMCR: u32 = 0x08;
const DIER: u32 = 0x0C;

/// Pulses that only the board sees. Their events go to the null bus, so the emulator does not stop for them. They are
/// handled later, each at its exact instant, before the timer or its outputs are read.
#[derive(Debug)]
struct Deferred<R> {
    null_bus: Bus,
    cr1: R,
    /// The last written value of each register, by offset over 4. A write reaches the register before the timer is
    /// called, and must not change the pulses before it.
    written: [Option<u64>; 32],
}

/// Registers that the timer itself changes, by offset over 4: SR, EGR, CNT.
const CHANGED_BY_TIMER: [usize; 3] = [4, 5, 9];

/// Offset of BDTR, and its bit MOE.
const BDTR: u32 = 0x44;
const MOE: u64 = 1 << 15;
/// Delay until MOE reads back: four clocks of the timer, longer than an instruction. The manual gives no figure.
const MOE_DELAY_NS: u64 = 40;

fn is_bdtr<R: Layout>(register: R) -> bool {
    register.spec().offset == BDTR
}

impl<F: Family> Watched<F> {
    pub(super) fn new(tim: Tim<F>, watched: &'static [u8], shortens_bursts: bool) -> Self {
        Self {
            burst: shortens_bursts.then(Burst::new).flatten(),
            deferred: None,
            tim,
            watched,
            high: [false; 4],
            edges: Vec::new(),
            moe_reads_from_ns: 0,
            moe_was_set: false,
            parked: false,
            awaited: None,
            missed: None,
        }
    }

    /// Defers the timer's events until it is read. `null_bus` has no listeners.
    pub(super) fn with_deferred_events(mut self, null_bus: Bus) -> Self {
        self.deferred = register_at(CR1).map(|cr1| Deferred {
            null_bus,
            cr1,
            written: [None; 32],
        });
        self
    }

    /// Handles the deferred events until `at`.
    pub(super) fn handle_deferred(&mut self, registers: &mut RegisterFile, at: VirtualNanos) {
        while let Some(deferred) = &mut self.deferred
            && let Some(due) = deferred.null_bus.next_event().filter(|due| *due <= at)
        {
            deferred.null_bus.reset();
            let (_, mut null) = deferred.null_bus.drive(due, 0);
            // Reading a register without side effects brings the timer up to date.
            Device::read(&mut self.tim, deferred.cr1, registers, &mut null);
            self.note(registers, due.0);
        }
    }

    /// Handles the deferred events until now, with the value of a register before the write that has just changed it.
    fn handle_deferred_before_write(
        &mut self,
        register: F::Register,
        registers: &mut RegisterFile,
        at: VirtualNanos,
    ) {
        let nth = register.spec().offset as usize / 4;
        let Some(deferred) = self
            .deferred
            .as_mut()
            .filter(|_| !CHANGED_BY_TIMER.contains(&nth))
        else {
            return self.handle_deferred(registers, at);
        };
        let now = registers.get(register);
        let before = deferred.written[nth].replace(now);
        registers.set(register, before.unwrap_or(register.spec().reset));
        self.handle_deferred(registers, at);
        registers.set(register, now);
    }

    /// Passes its events to the emulator from now on.
    fn stop_deferring(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        self.handle_deferred(registers, context.now());
        if let Some(late) = self.deferred.take() {
            self.awaited = (late.null_bus.next_event()).map(|at| context.schedule(at));
        }
    }

    /// Handles the deferred events, then calls the timer with the context that its events have to reach.
    fn call<T>(
        &mut self,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
        call: impl FnOnce(&mut Tim<F>, &mut RegisterFile, &mut DeviceContext<'_>) -> T,
    ) -> T {
        self.handle_deferred(registers, context.now());
        let Some(deferred) = &mut self.deferred else {
            return call(&mut self.tim, registers, context);
        };
        let (_, mut null) = deferred.null_bus.drive(context.now(), 0);
        call(&mut self.tim, registers, &mut null)
    }

    pub(super) fn high(&self, channel: u8) -> bool {
        self.high[usize::from(channel) - 1]
    }

    /// Writes a word of a burst to its register, if it bypasses the timer.
    fn pass(
        &mut self,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) -> bool {
        let Some(burst) = &mut self.burst else {
            return false;
        };
        let (index, past) = burst.next(registers);
        if !past {
            (burst.playing, burst.undisturbed) = (None, 0);
            return false;
        }
        let target = burst.targets[index];
        let before = registers.get(target);
        registers.write_over_bus(target, value);
        if index == NOT_PRELOADED && registers.get(target) != before {
            Device::write(&mut self.tim, target, value, registers, context);
        }
        if index == WORDS - 1 {
            let arrived = burst.targets.map(|target| registers.get(target));
            let counts = registers.get(burst.cr1) & COUNTS != 0;
            let before = burst.words.replace(arrived);
            let is_known = counts && burst.undisturbed > 0;
            burst.playing = before
                .filter(|_| is_known)
                .map(|words| (words, context.now().0));
            burst.undisturbed += 1;
            // Clear DCR for a moment: the timer takes an acknowledgement of its request only in a burst of one word.
            let dcr = registers.get(burst.dcr);
            registers.set(burst.dcr, 0);
            self.tim.acknowledge(UPDATE_REQUEST, registers, context);
            registers.set(burst.dcr, dcr);
        }
        true
    }

    /// Prepares a write of the processor to a register that bursts also write. The timer brings itself up to date from
    /// the old register contents, but has seen only those that did not bypass it.
    fn before_write(
        &mut self,
        register: F::Register,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let Some(burst) = &mut self.burst else { return };
        let Some(nth) = burst.word_of(register) else {
            return;
        };
        (burst.playing, burst.undisturbed) = (None, 0);
        let Some(words) = burst.words else { return };
        let landed = registers.get(register);
        registers.set(register, words[nth]);
        Device::read(&mut self.tim, burst.cr1, registers, context);
        registers.set(register, landed);
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

/// Registers of the step timer as a fast-forward requires them: it counts up on its internal clock, each output is high
/// at the start of a period, and only DMA is notified of an update (RM0383 section 12.4).
const AS_STEP_TIMER: [(tim1::Register, u64); 7] = [
    (tim1::Register::Cr1, PRELOADED_PERIOD | COUNTS),
    (tim1::Register::Cr2, 0),
    (tim1::Register::Smcr, 0),
    (tim1::Register::Psc, 0),
    (tim1::Register::Ccmr1Output, 0x68),
    (tim1::Register::Ccmr2Output, 0x68),
    (tim1::Register::Ccer, 0x101),
];
/// DIER: the DMA request on update, and the break interrupt that may be enabled beside it.
const REQUESTS: u64 = 1 << 8;
const BREAK_INTERRUPT: u64 = 1 << 7;
/// SR after a whole period: the flags of the update and of all channels; and the break's.
const ALL_FLAGS: u64 = 0x1F;
const BROKEN: u64 = 1 << 7;
/// BDTR.AOE: clear, an update does not set MOE.
const AOE: u64 = 1 << 14;
/// EGR.UG: begins a period at once.
const UPDATE: u64 = 1 << 0;
const OF_BURST: [tim1::Register; WORDS] = [
    tim1::Register::Arr,
    tim1::Register::Rcr,
    tim1::Register::Ccr1,
    tim1::Register::Ccr2,
    tim1::Register::Ccr3,
];

impl Watched<Advanced> {
    /// The timer's position and the length of its ticks, ns, if the ring alone decides its edges.
    pub(super) fn position(
        &self,
        registers: &RegisterFile,
        now: VirtualNanos,
    ) -> Option<(Position, u64)> {
        let burst = self.burst.as_ref()?;
        let ((playing, updated_ns), preloaded) = burst.playing.zip(burst.words)?;
        let bdtr = registers.get(tim1::Register::Bdtr);
        let is_step_timer = AS_STEP_TIMER
            .iter()
            .all(|&(register, value)| registers.get(register) == value)
            && registers.get(tim1::Register::Dier) & !BREAK_INTERRUPT == REQUESTS
            && registers.get(tim1::Register::Sr) & (ALL_FLAGS | BROKEN) == ALL_FLAGS
            && bdtr & (MOE | AOE) == MOE
            && burst.next == 0;
        if !is_step_timer || now.0 < updated_ns {
            return None;
        }
        let count = |at_ns: u64| {
            let at = VirtualNanos(at_ns);
            Device::peek(&self.tim, tim1::Register::Cnt, registers, at)
        };
        // Only ticks of whole nanoseconds are supported.
        let in_us = count(now.0 + 1_000)?.checked_sub(count(now.0)?)?;
        let tick_ns = 1_000_u64
            .checked_div(in_us)
            .filter(|tick_ns| tick_ns * in_us == 1_000)?;
        let (playing, preloaded) = (Slot(playing), Slot(preloaded));
        let round_ns = (playing.0[0] + 1) * tick_ns;
        let round = (now.0 - updated_ns) / round_ns;
        let position = Position {
            playing,
            preloaded,
            begun_ns: updated_ns + round * round_ns,
            rounds_left: (playing.0[1] & 0xFF).checked_sub(round)?,
        };
        let counted = (now.0 - position.begun_ns) / tick_ns;
        (count(now.0) == Some(counted)).then_some((position, tick_ns))
    }

    /// Sets the timer to the position of the fast-forward at `to`; `null_bus` has no listeners.
    pub(super) fn resume(
        &mut self,
        forward: &FastForward,
        to: VirtualNanos,
        null_bus: &mut Bus,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let Position {
            playing,
            preloaded,
            begun_ns,
            rounds_left,
        } = forward.at;
        if begun_ns != forward.first_ns {
            let kept = [tim1::Register::Dier, tim1::Register::Sr]
                .map(|register| (register, registers.get(register)));
            registers.set(tim1::Register::Dier, 0);
            // A period of 0 blocks the counter until the present round begins.
            let present = [
                playing.0[0],
                rounds_left,
                playing.0[2],
                playing.0[3],
                playing.0[4],
            ];
            for (words, at_ns) in [([0; WORDS], forward.from_ns), (present, begun_ns)] {
                for (register, word) in OF_BURST.into_iter().zip(words) {
                    registers.set(register, word);
                }
                null_bus.reset();
                let (_, mut null) = null_bus.drive(VirtualNanos(at_ns), 0);
                Device::write(
                    &mut self.tim,
                    tim1::Register::Egr,
                    UPDATE,
                    registers,
                    &mut null,
                );
            }
            for (register, value) in kept {
                registers.set(register, value);
            }
            for (register, word) in OF_BURST.into_iter().zip(preloaded.0) {
                registers.write_over_bus(register, word);
            }
            if let Some(burst) = &mut self.burst {
                let round_ns = (playing.0[0] + 1) * forward.tick_ns;
                let updated_ns = begun_ns - ((playing.0[1] & 0xFF) - rounds_left) * round_ns;
                burst.playing = Some((playing.0, updated_ns));
                burst.words = Some(preloaded.0);
            }
        }
        let planned = null_bus.next_event();
        null_bus.reset();
        let (_, mut null) = null_bus.drive(to, 0);
        Device::read(&mut self.tim, tim1::Register::Cr1, registers, &mut null);
        // If the timer plans no event, it waits for an earlier one, which it may have missed while frozen.
        let missed = self.missed.take();
        let next = null_bus.next_event().or(planned).or(missed);
        null_bus.reset();
        self.awaited = next.map(|at| context.schedule(at)).or(self.awaited);
        self.parked = false;
        for &number in self.watched {
            let channel = Channel::new(number).expect("a channel");
            let high = self.tim.output(channel, registers) == Some(Level::High);
            self.high[usize::from(number) - 1] = high;
        }
    }
}

impl<F: Family> Device for Watched<F> {
    type Register = F::Register;

    delegate!(tim: layout, peek, on_refused, poll);

    fn read(
        &mut self,
        register: F::Register,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) -> Option<u64> {
        assert!(!self.parked, "a frozen timer is read");
        if register.spec().offset == DMAR {
            // The firmware never reads DMAR. A read advances the burst, which the shortcut does not follow: drop it.
            self.burst = None;
        }
        let value = self.call(registers, context, |tim, registers, context| {
            Device::read(tim, register, registers, context)
        });
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
        assert!(!self.parked, "a frozen timer is written");
        if register.spec().offset == DMAR {
            if !self.pass(value, registers, context) {
                Device::write(&mut self.tim, register, value, registers, context);
            }
        } else {
            self.before_write(register, registers, context);
            self.handle_deferred_before_write(register, registers, context.now());
            if value != 0 && matches!(register.spec().offset, CR2 | SMCR | DIER) {
                self.stop_deferring(registers, context);
            }
            self.call(registers, context, |tim, registers, context| {
                Device::write(tim, register, value, registers, context);
            });
        }
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
        if self.parked {
            self.missed = Some(context.now());
            return;
        }
        if self.awaited == Some(event) {
            self.awaited = None;
            // Reading a register without side effects brings the timer up to date.
            let first = F::Register::from_index(0).expect("a register");
            Device::read(&mut self.tim, first, registers, context);
        } else {
            Device::on_event(&mut self.tim, event, registers, context);
        }
        self.note(registers, context.now().0);
    }

    fn on_request(
        &mut self,
        request: RequestChange,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        self.call(registers, context, |tim, registers, context| {
            Device::on_request(tim, request, registers, context);
        });
        self.note(registers, context.now().0);
    }

    fn on_clock(&mut self, hz: u64, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        self.call(registers, context, |tim, registers, context| {
            Device::on_clock(tim, hz, registers, context);
        });
        self.note(registers, context.now().0);
    }

    fn on_access(
        &mut self,
        token: u64,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        self.call(registers, context, |tim, registers, context| {
            Device::on_access(tim, token, value, registers, context);
        });
        self.note(registers, context.now().0);
    }

    fn reset(&mut self) {
        Device::reset(&mut self.tim);
        (self.parked, self.awaited, self.missed) = (false, None, None);
        if let Some(burst) = &mut self.burst {
            burst.reset();
        }
        if let Some(deferred) = &mut self.deferred {
            deferred.null_bus.reset();
            deferred.written = [None; 32];
        }
    }

    fn reset_line(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        (self.parked, self.awaited, self.missed) = (false, None, None);
        if let Some(burst) = &mut self.burst {
            burst.reset();
        }
        self.call(registers, context, |tim, registers, context| {
            Device::reset_line(tim, registers, context);
        });
        if let Some(deferred) = &mut self.deferred {
            deferred.written = [None; 32];
        }
        self.note(registers, context.now().0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rigless::mcu::Mcu;
    use rigless::soc::stm32f427::Stm32f427;
    use rigless::soc::stm32f427::generated::tim2::Register;
    use rigless::soc::stm32f427::peripherals::TIMERS;
    use rigless::soc::stm32f427::peripherals::tim::General;

    const TIM3: usize = 1;
    const HZ: u64 = 16_000_000;
    /// Writes of the firmware: two channels with preloaded pulses, changing duties, a stop and a start.
    const WRITES: [(u64, Register, u64); 14] = [
        (1_000, Register::Arr, 199),
        (1_010, Register::Ccmr1Output, 0x6868),
        (1_020, Register::Ccer, 0x11),
        (1_030, Register::Ccr1, 60),
        (1_040, Register::Ccr2, 200),
        (1_050, Register::Egr, 1),
        (1_060, Register::Cr1, 1),
        (30_007, Register::Ccr1, 150),
        (30_020, Register::Ccr2, 60),
        (55_000, Register::Ccr1, 0),
        (90_000, Register::Cr1, 0),
        (120_000, Register::Egr, 1),
        (120_100, Register::Cr1, 1),
        (150_000, Register::Ccr1, 199),
    ];

    /// A bus with this timer only.
    fn null_bus() -> Bus {
        let part = Stm32f427::new().expect("a part");
        let slot = part.bus().slot("TIM3").expect("a timer");
        super::super::null_bus(part.bus(), slot).expect("a bus")
    }

    fn timer() -> Watched<General> {
        let tim = Tim::with_clock(HZ, TIMERS[TIM3].counter);
        Watched::new(tim, &[1, 2], false)
    }

    /// The writes, and a read of the timer at each of `reads`. The context's own events are not delivered.
    fn written(mut timer: Watched<General>, reads: impl Iterator<Item = u64>) -> Vec<OutputEdge> {
        let mut bus = null_bus();
        let mut writes = WRITES.into_iter().peekable();
        for read_ns in reads {
            while let Some((at_ns, register, value)) = writes.next_if(|write| write.0 <= read_ns) {
                let (registers, mut context) = bus.drive(VirtualNanos(at_ns), 0);
                // As the bus does before it calls the device.
                registers.write_over_bus(register, value);
                Device::write(&mut timer, register, value, registers, &mut context);
            }
            let (registers, mut context) = bus.drive(VirtualNanos(read_ns), 0);
            Device::read(&mut timer, Register::Cr1, registers, &mut context);
        }
        timer.edges
    }

    #[test]
    fn deferred_pulses_are_those_of_a_timer_that_is_read_each_nanosecond() {
        let always = written(timer(), 0..200_000);
        assert!(always.len() > 30, "{always:?}");
        for every_ns in [7, 1_000, 12_500, 49_000, 200_000] {
            let late = timer().with_deferred_events(null_bus());
            let reads = (0..200_000).step_by(every_ns).chain([200_000]);
            assert_eq!(written(late, reads), always, "a read every {every_ns} ns");
        }
    }

    #[test]
    fn an_enabled_interrupt_is_not_deferred() {
        let mut bus = null_bus();
        let mut deferred = timer().with_deferred_events(null_bus());
        for (at_ns, register, value) in WRITES.into_iter().take(7) {
            let (registers, mut context) = bus.drive(VirtualNanos(at_ns), 0);
            registers.write_over_bus(register, value);
            Device::write(&mut deferred, register, value, registers, &mut context);
        }
        assert_eq!(bus.next_event(), None);
        let (registers, mut context) = bus.drive(VirtualNanos(5_000), 0);
        registers.write_over_bus(Register::Dier, 1);
        Device::write(&mut deferred, Register::Dier, 1, registers, &mut context);
        // The period began with the clock before 1,060 ns, and lasts 12.5 us.
        assert_eq!(bus.next_event(), Some(VirtualNanos(13_500)));
    }
}
