//! The processor with a bell: it reports when it falls asleep, and when it wakes, before it executes anything.
//!
//! While the processor sleeps only models and the board change memory or registers. The emulator does not report sleep.
//! So this wrapper stands between the emulator and its processor and signals each change by an access that no program
//! makes.
//!
//! It also fails accesses below the RAM, and hands the processor to the next machine when its own is dropped, see
//! [`super::spare`].

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rigless::emulator::{
    Access, AccessKind, CoreBus, CoreSpec, DataModel, Error, Exit, Processor, Queued,
};
use rigless::soc::{Endian, Width};
use rigless::time::VirtualNanos;

use super::map;
use super::spare::{self, Program, Usable};

/// Addresses whose reads signal falling asleep and waking: EXTI_IMR and EXTI_EMR. The bell's reads have no program
/// counter, unlike those of the firmware.
const SLEEP_AT: u64 = 0x4001_3C00;
const WAKE_AT: u64 = 0x4001_3C04;

/// A signal of the bell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ring {
    /// The processor waits for an interrupt or an event.
    Sleeps,
    /// It is about to execute its next instruction.
    Wakes,
}

/// The signal that `access` carries, if it comes from the bell.
pub(super) fn heard(access: &Access) -> Option<Ring> {
    match (access.program_counter, access.address) {
        (None, SLEEP_AT) => Some(Ring::Sleeps),
        (None, WAKE_AT) => Some(Ring::Wakes),
        _ => None,
    }
}

/// The signals that are listened to. Each one costs time, so only those asked for are sent.
#[derive(Clone, Debug, Default)]
pub(super) struct Bell(Arc<Asked>);

#[derive(Debug, Default)]
struct Asked {
    sleeps: AtomicBool,
    wakes: AtomicBool,
}

impl Bell {
    pub(super) fn ask_for_sleep(&self, asked: bool) {
        self.0.sleeps.store(asked, Ordering::Relaxed);
    }

    pub(super) fn ask_for_waking(&self, asked: bool) {
        self.0.wakes.store(asked, Ordering::Relaxed);
    }
}

/// Puts `bell` between the emulator and the processor that `spec` makes, or a spare one for `program`.
pub(super) fn with_bell(spec: &mut CoreSpec, bell: &Bell, program: Program) {
    let (make, bell) = (Arc::clone(&spec.processor), bell.clone());
    spec.processor = Arc::new(move |endian| {
        let spare = spare::take(&program);
        let knows_program = spare.is_some();
        let core = match spare {
            Some(spare) => spare,
            None => {
                let inner = make(endian)?;
                Usable {
                    fresh: inner.save(),
                    inner,
                    program,
                    mapped: Vec::new(),
                    changed: Vec::new(),
                    idle: Vec::new(),
                }
            }
        };
        Ok(Box::new(Belled {
            core: Some(Usable {
                mapped: Vec::new(),
                ..core
            }),
            bell: bell.clone(),
            knows_program,
            loading: true,
            altered: false,
        }) as Box<dyn Processor>)
    });
}

#[derive(Debug)]
struct Belled {
    /// Present until it is handed on.
    core: Option<Usable>,
    bell: Bell,
    /// It has translated this program for an earlier machine.
    knows_program: bool,
    /// The program is being loaded.
    loading: bool,
    /// It was changed in a way that another machine must not inherit.
    altered: bool,
}

impl Drop for Belled {
    fn drop(&mut self) {
        if let Some(core) = self.core.take()
            && !self.altered
            && !std::thread::panicking()
        {
            spare::keep(core);
        }
    }
}

impl Belled {
    fn inner(&self) -> &dyn Processor {
        &*self.core.as_ref().expect("until it is dropped").inner
    }

    fn inner_mut(&mut self) -> &mut dyn Processor {
        &mut *self.core.as_mut().expect("until it is dropped").inner
    }

    fn strike(&self, address: u64, bus: &mut dyn CoreBus) {
        let retired = self.inner().retired();
        let access = Access::new(AccessKind::Read, address, Width::W32, 0);
        bus.access(access.at(retired, bus.time(retired)), false);
    }
}

/// The bus, with errors where the chip has nothing. The emulator would read 0 there.
struct Failing<'a>(&'a mut dyn CoreBus);

impl CoreBus for Failing<'_> {
    fn access(&mut self, access: Access, from_code: bool) -> Option<u64> {
        if map::BELOW_RAM.contains(&access.address) {
            return None;
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

impl Processor for Belled {
    fn run(&mut self, budget: u32, bus: &mut dyn CoreBus) -> (Exit, u64) {
        let bus = &mut Failing(bus);
        if self.inner().waiting() && self.bell.0.wakes.load(Ordering::Relaxed) {
            // With a budget of 0 it enters a pending exception, but executes nothing.
            let slept = self.inner_mut().run(0, bus);
            if self.inner().waiting() {
                return slept;
            }
            self.strike(WAKE_AT, bus);
            // Return, because the next event may be due sooner now.
            return (Exit::Returned, slept.1);
        }
        let ran = self.inner_mut().run(budget, bus);
        let fell_asleep = ran.1 > 0 && self.inner().waiting();
        if fell_asleep && self.bell.0.sleeps.load(Ordering::Relaxed) {
            self.strike(SLEEP_AT, bus);
        }
        ran
    }

    // SAFETY: the caller keeps the promises that the inner processor requires; the inner one is dropped with this one.
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
            Queued::Invalidate(start, end) if spare::is_program(start, end) => {
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

    fn reset(&mut self) {
        self.inner_mut().reset();
    }

    fn take_reset_request(&mut self) -> bool {
        // The first call in a run comes after its program has been loaded.
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
