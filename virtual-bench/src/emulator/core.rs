//! Hooks into the processor: report when it falls asleep, and when it wakes, before it executes anything.
//!
//! While the processor sleeps only models and the board change memory or registers. The emulator does not report sleep.
//! This wrapper therefore sits between the emulator and its processor and signals each change by an access that no
//! program makes.
//!
//! It also fails accesses beside the RAM, raises the NMI, delays the ports' inputs, and puts the processor into the
//! pool when its machine is dropped, see [`super::pool`].

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use rigless::emulator::{
    Access, AccessKind, CoreBus, CoreSpec, DataModel, Error, Exit, Processor, Queued,
};
use rigless::soc::{Endian, Width};
use rigless::time::VirtualNanos;

use super::map;
use super::pool::{self, PooledProcessor, Program};

/// Addresses whose reads signal falling asleep and waking: EXTI_IMR and EXTI_EMR. The hooks' reads have no program
/// counter, unlike those of the firmware.
const SLEEP_AT: u64 = 0x4001_3C00;
const WAKE_AT: u64 = 0x4001_3C04;

/// A change that the hooks signal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SleepChange {
    /// The processor waits for an interrupt or an event.
    Sleeps,
    /// It is about to execute its next instruction.
    Wakes,
}

/// The change that `access` signals, if it comes from the hooks.
pub(super) fn sleep_change(access: &Access) -> Option<SleepChange> {
    match (access.program_counter, access.address) {
        (None, SLEEP_AT) => Some(SleepChange::Sleeps),
        (None, WAKE_AT) => Some(SleepChange::Wakes),
        _ => None,
    }
}

/// The enabled signals, and requests to the processor. Each signal costs time, so only enabled ones are sent.
#[derive(Clone, Debug, Default)]
pub(super) struct CoreHooks(Arc<HookState>);

#[derive(Debug, Default)]
struct HookState {
    sleeps: AtomicBool,
    wakes: AtomicBool,
    nmi: AtomicBool,
    /// Ports whose clock is on, and those of them whose inputs have not been read since, by bit; and the instruction
    /// that switched the last clock on.
    clocked: AtomicU64,
    unread: AtomicU64,
    since: AtomicU64,
}

impl CoreHooks {
    pub(super) fn report_sleep(&self, asked: bool) {
        self.0.sleeps.store(asked, Ordering::Relaxed);
    }

    pub(super) fn report_waking(&self, asked: bool) {
        self.0.wakes.store(asked, Ordering::Relaxed);
    }

    /// Raises the NMI, for which the emulator has no line.
    pub(super) fn raise_nmi(&self) {
        self.0.nmi.store(true, Ordering::Relaxed);
    }

    /// Notes a write to RCC_AHB1ENR.
    fn clocks(&self, value: u64, instruction: u64) {
        let before = self.0.clocked.swap(value, Ordering::Relaxed);
        self.0.unread.store(value & !before, Ordering::Relaxed);
        self.0.since.store(instruction, Ordering::Relaxed);
    }

    /// Whether this is the first read of the port's inputs since its clock was enabled, and soon after.
    fn is_early(&self, port: u64, instruction: u64) -> bool {
        let unread = self.0.unread.fetch_and(!(1 << port), Ordering::Relaxed) >> port & 1 == 1;
        unread && instruction - self.0.since.load(Ordering::Relaxed) <= STALE_READ_INSTRUCTIONS
    }
}

/// RCC_AHB1ENR, and the ports' IDR (RM0383 sections 6.3.9, 8.4.5).
const AHB1ENR: u64 = 0x4002_3830;
const PORTS: std::ops::Range<u64> = 0x4002_0000..0x4002_2000;
const IDR: u64 = 0x10;
/// Instructions in which a port's inputs may still be those of the reset.
const STALE_READ_INSTRUCTIONS: u64 = 8;
/// Interrupt control and state, and its bit NMIPENDSET (DDI 0403E.e B3.2.4).
const ICSR: u64 = 0xE000_ED04;
const NMIPENDSET: u64 = 1 << 31;

/// DEMCR, the only register in use that a reset keeps, except the bits of the debug monitor (DDI 0403E.e C1.6.5).
const DEMCR: u64 = 0xE000_EDFC;
const MONITOR: u64 = 0xF_0000;

/// Reads DEMCR, or writes `value` to it.
fn debug_register(core: &mut dyn Processor, value: Option<u64>) -> Option<u64> {
    core.debugger_access(value, DEMCR, Width::W32, VirtualNanos(0))
}

/// `fresh`, the state of a new processor, but with the number of `retired` instructions, which a reset does not clear.
/// `None` if the state does not end with this number as the emulator's version writes it, a postcard varint.
fn after_reset(fresh: &[u8], mut retired: u64) -> Option<Vec<u8>> {
    let Some((0, state)) = fresh.split_last() else {
        return None;
    };
    let mut state = state.to_vec();
    while retired >= 0x80 {
        state.push(retired as u8 | 0x80);
        retired >>= 7;
    }
    state.push(retired as u8);
    Some(state)
}

/// Puts `hooks` between the emulator and the processor that `spec` makes, or a pooled one for `program`.
pub(super) fn with_hooks(spec: &mut CoreSpec, hooks: &CoreHooks, program: Program) {
    let (make, hooks) = (Arc::clone(&spec.processor), hooks.clone());
    spec.processor = Arc::new(move |endian| {
        let pool = pool::take(&program);
        let knows_program = pool.is_some();
        let core = match pool {
            Some(pool) => pool,
            None => {
                let mut inner = make(endian)?;
                inner.reset();
                PooledProcessor {
                    fresh: inner.save(),
                    inner,
                    program,
                    mapped: Vec::new(),
                    changed: Vec::new(),
                    idle: Vec::new(),
                }
            }
        };
        Ok(Box::new(HookedProcessor {
            core: Some(PooledProcessor {
                mapped: Vec::new(),
                ..core
            }),
            hooks: hooks.clone(),
            knows_program,
            loading: true,
            altered: false,
        }) as Box<dyn Processor>)
    });
}

#[derive(Debug)]
struct HookedProcessor {
    /// Present until it goes into the pool.
    core: Option<PooledProcessor>,
    hooks: CoreHooks,
    /// It has translated this program for an earlier machine.
    knows_program: bool,
    /// The program is being loaded.
    loading: bool,
    /// It was changed, so another machine must not use it.
    altered: bool,
}

impl Drop for HookedProcessor {
    fn drop(&mut self) {
        if let Some(core) = self.core.take()
            && !self.altered
            && !std::thread::panicking()
        {
            pool::keep(core);
        }
    }
}

impl HookedProcessor {
    fn inner(&self) -> &dyn Processor {
        &*self.core.as_ref().expect("until it is dropped").inner
    }

    fn inner_mut(&mut self) -> &mut dyn Processor {
        &mut *self.core.as_mut().expect("until it is dropped").inner
    }

    fn signal(&self, address: u64, bus: &mut dyn CoreBus) {
        let retired = self.inner().retired();
        let access = Access::new(AccessKind::Read, address, Width::W32, 0);
        bus.access(access.at(retired, bus.time(retired)), false);
    }
}

/// The bus, with errors at unmapped addresses (the emulator would read 0 there), and with ports whose first read
/// returns the reset value if it comes soon after their clock was enabled.
struct FaultingBus<'a>(&'a mut dyn CoreBus, CoreHooks);

impl CoreBus for FaultingBus<'_> {
    fn access(&mut self, access: Access, from_code: bool) -> Option<u64> {
        if map::BESIDE_RAM
            .iter()
            .any(|no| no.contains(&access.address))
        {
            return None;
        }
        match access.kind {
            AccessKind::Write if access.address == AHB1ENR => {
                self.1.clocks(access.value, access.instruction_count);
            }
            AccessKind::Read
                if PORTS.contains(&access.address)
                    && access.address & 0x3FF == IDR
                    && (self.1).is_early(
                        (access.address - PORTS.start) >> 10,
                        access.instruction_count,
                    ) =>
            {
                return Some(0);
            }
            _ => {}
        }
        self.0.access(access, from_code)
    }

    fn time(&self, instructions: u64) -> VirtualNanos {
        self.0.time(instructions)
    }

    fn queued(&mut self) -> Vec<Queued> {
        self.0.queued()
    }

    fn carry_on(&mut self, instructions: u64, event: Option<VirtualNanos>) -> Option<u32> {
        self.0.carry_on(instructions, event)
    }

    fn stops_before(&mut self, access: &Access) -> bool {
        self.0.stops_before(access)
    }

    fn send_trace(&mut self, bytes: &[u8]) {
        self.0.send_trace(bytes);
    }
}

impl Processor for HookedProcessor {
    fn run(&mut self, budget: u32, bus: &mut dyn CoreBus) -> (Exit, u64) {
        let bus = &mut FaultingBus(bus, self.hooks.clone());
        if self.hooks.0.nmi.swap(false, Ordering::Relaxed) {
            self.inner_mut()
                .debugger_access(Some(NMIPENDSET), ICSR, Width::W32, VirtualNanos(0));
        }
        if self.inner().waiting() && self.hooks.0.wakes.load(Ordering::Relaxed) {
            // With a budget of 0 it enters a pending exception, but executes nothing.
            let slept = self.inner_mut().run(0, bus);
            if self.inner().waiting() {
                return slept;
            }
            self.signal(WAKE_AT, bus);
            // Return, because the next event may be due sooner now.
            return (Exit::Returned, slept.1);
        }
        let ran = self.inner_mut().run(budget, bus);
        let fell_asleep = ran.1 > 0 && self.inner().waiting();
        if fell_asleep && self.hooks.0.sleeps.load(Ordering::Relaxed) {
            self.signal(SLEEP_AT, bus);
        }
        ran
    }

    // SAFETY: the caller meets the requirements of the inner processor, which is dropped with this one.
    #[allow(unsafe_code)]
    unsafe fn map(&mut self, start: u64, length: u64, host: *mut u8, writable: bool) {
        // SAFETY: as above.
        unsafe { self.inner_mut().map(start, length, host, writable) }
        let core = self.core.as_mut().expect("until it is dropped");
        core.mapped.push((start, length, writable));
    }

    fn retired(&self) -> u64 {
        self.inner().retired()
    }

    fn ask(&mut self, queued: Queued) {
        match queued {
            Queued::Invalidate(start, end) if pool::is_program(start, end) => {
                if self.loading && self.knows_program {
                    return;
                }
                let core = self.core.as_mut().expect("until it is dropped");
                if !self.loading {
                    core.changed.push((start, end));
                }
            }
            Queued::Route(_) => self.altered = true,
            _ => {}
        }
        self.inner_mut().ask(queued);
    }

    fn maps(&self, start: u64, length: u64) -> bool {
        self.inner().maps(start, length)
    }

    fn page_size(&self) -> u64 {
        self.inner().page_size()
    }

    fn boot(&mut self, table: u64, read: &dyn Fn(u64, Width) -> Option<u64>) {
        self.inner_mut().boot(table, read);
    }

    /// Loads the state after a reset. The emulator's own reset would also drop all translations of the unchanged
    /// program, and repeating them took 38 % of the tests' processor time.
    fn reset(&mut self) {
        self.hooks.clocks(0, 0);
        let core = self.core.as_mut().expect("until it is dropped");
        let retired = core.inner.retired();
        let catches = debug_register(&mut *core.inner, None);
        // The firmware's request for this reset is not part of the state.
        core.inner.take_reset_request();
        let state = after_reset(&core.fresh, retired);
        let loaded = state.is_some_and(|state| core.inner.load(&state).is_ok());
        if !loaded || core.inner.retired() != retired {
            core.inner.reset();
            return;
        }
        if let Some(catches) = catches {
            debug_register(&mut *core.inner, Some(catches & !MONITOR));
        }
    }

    fn take_reset_request(&mut self) -> bool {
        // The first call in a run follows the loading of its program.
        self.loading = false;
        self.inner_mut().take_reset_request()
    }

    fn next_event(&self) -> Option<VirtualNanos> {
        self.inner().next_event()
    }

    fn on_event(&mut self, now: VirtualNanos) {
        self.inner_mut().on_event(now);
    }

    fn waiting(&self) -> bool {
        self.inner().waiting()
    }

    fn pc(&self) -> u64 {
        self.inner().pc()
    }

    fn add_breakpoint(&mut self, address: u64) -> bool {
        self.altered = true;
        self.inner_mut().add_breakpoint(address)
    }

    fn remove_breakpoint(&mut self, address: u64) {
        self.inner_mut().remove_breakpoint(address);
    }

    fn pass_breakpoint(&mut self, address: u64) {
        self.inner_mut().pass_breakpoint(address);
    }

    fn data_model(&self) -> DataModel {
        self.inner().data_model()
    }

    fn byte_order(&self, address: u64) -> Endian {
        self.inner().byte_order(address)
    }

    fn save(&self) -> Vec<u8> {
        self.inner().save()
    }

    fn load(&mut self, bytes: &[u8]) -> Result<(), Error> {
        self.inner_mut().load(bytes)
    }

    fn own_ranges(&self) -> Vec<std::ops::Range<u64>> {
        self.inner().own_ranges()
    }
}

#[cfg(test)]
mod tests {
    use std::num::{NonZeroU32, NonZeroU64};

    use rigless::machine::armv7m::{Core, Fpu, MpuRegions, Variant};

    use super::*;

    const PROGRAM: u64 = 0x0800_0000;
    /// Sets DEMCR, BASEPRI and registers, then counts for ever.
    const CODE: [u16; 14] = [
        0xF64E, 0x50FC, // movw r0, #0xEDFC
        0xF2CE, 0x0000, // movt r0, #0xE000
        0xF240, 0x71F1, // movw r1, #0x7F1
        0xF2C0, 0x1101, // movt r1, #0x101
        0x6001, // str r1, [r0]
        0x2207, // movs r2, #7
        0xF380, 0x8811, // msr basepri, r0
        0x3301, // adds r3, #1
        0xE7FD, // b to the addition
    ];

    struct Nothing;

    impl CoreBus for Nothing {
        fn access(&mut self, _: Access, _: bool) -> Option<u64> {
            None
        }

        fn time(&self, instructions: u64) -> VirtualNanos {
            VirtualNanos(instructions * 10)
        }

        fn queued(&mut self) -> Vec<Queued> {
            Vec::new()
        }

        fn carry_on(&mut self, _: u64, _: Option<VirtualNanos>) -> Option<u32> {
            None
        }
    }

    fn processor(hooks: bool) -> Box<dyn Processor> {
        let core = Core {
            variant: Variant::M4,
            clock_hz: NonZeroU64::new(100_000_000).expect("a rate"),
            interrupt_lines: NonZeroU32::new(map::INTERRUPT_LINES).expect("lines"),
            priority_bits: 4,
            refclk_divider: NonZeroU32::new(8).expect("a divider divides"),
            instructions_per_second: NonZeroU64::new(65_000_000).expect("a rate"),
            boot: "flash",
        };
        let mut spec = core.spec_with_parts(&[], Fpu::FpV4Sp, MpuRegions::Eight);
        if hooks {
            with_hooks(&mut spec, &CoreHooks::default(), Program::of(&[], 1));
        }
        (spec.processor)(Endian::Little).expect("a processor")
    }

    /// The state of a processor that has executed `CODE` and was reset, and the instructions that it has retired.
    fn reset_after_a_run(hooks: bool) -> (Vec<u8>, u64) {
        let mut page = vec![0_u8; 8_192];
        let start = page.as_ptr().align_offset(4_096);
        for (at, word) in CODE.iter().enumerate() {
            page[start + 2 * at..][..2].copy_from_slice(&word.to_le_bytes());
        }
        let mut core = processor(hooks);
        // SAFETY: `page` has 4,096 bytes from `start`, and outlives the processor's last run.
        #[allow(unsafe_code)]
        unsafe {
            core.map(PROGRAM, 4_096, page.as_mut_ptr().add(start), false);
        }
        let read = |address, _| {
            Some(if address == PROGRAM {
                0x2000_1000
            } else {
                PROGRAM | 1
            })
        };
        core.boot(PROGRAM, &read);
        for _ in 0..10 {
            core.run(100, &mut Nothing);
        }
        let before = core.save();
        core.reset();
        assert_ne!(core.save(), before);
        let retired = core.retired();
        (core.save(), retired)
    }

    #[test]
    fn a_reset_gives_the_state_of_the_emulators_own_reset() {
        let (shortened, retired) = reset_after_a_run(true);
        let (real, the_same) = reset_after_a_run(false);
        assert!(retired > 200);
        assert_eq!(retired, the_same);
        assert_eq!(shortened, real);
    }
}
