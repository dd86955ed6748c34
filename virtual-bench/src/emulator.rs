//! An STM32F411RE: the emulator's STM32F427 with the smaller part's memories, requests and peripherals, an external
//! interrupt controller, a flash array, and the wires of a board soldered to its pins.
//!
//! A board implements [`Wiring`]: it reads the pins after everything that may have changed them, and drives its outputs
//! in turn. The emulator's clock starts at 0 with each power-up. All public times are those of the bench's clock.

mod array;
mod asleep;
mod clocks;
mod core;
mod delegate;
mod dma;
mod enabled;
mod exti;
mod fast_forward;
mod framing;
mod map;
mod pads;
mod pool;
mod quiet;
mod ring;
mod timer;

use std::fmt;
use std::num::{NonZeroU32, NonZeroU64};
use std::sync::{Arc, Mutex, PoisonError};

use rigless::chip::uart::Rate;
use rigless::cpu::armv7m;
use rigless::device::{ErasedDevice, ResetCause};
use rigless::emulator::{Access, AccessKind, CoreSpec, Host, Settled, StopReason};
use rigless::machine::armv7m as machine;
use rigless::machine::{Board, Target};
use rigless::mcu::Mcu;
use rigless::session::Session;
use rigless::snapshot::Store;
use rigless::soc::stm32f427::Stm32f427;
use rigless::soc::stm32f427::generated::{flash, rcc};
use rigless::soc::stm32f427::peripherals::gpio::{Gpio, Pin as PortPin};
use rigless::soc::stm32f427::peripherals::rcc::Rcc;
use rigless::soc::stm32f427::peripherals::tim::{Advanced, General, Tim};
use rigless::soc::stm32f427::peripherals::{ADVANCED_TIMERS, TIMERS};
use rigless::soc::{Bus, Width};
use rigless::time::VirtualNanos;

use crate::serial::{Serial, Wire};
pub use timer::OutputEdge;

pub use array::CutAt;
use array::{Array, BUSY, Effect};
use asleep::Asleep;
pub use asleep::Unnoticed;
use clocks::Clocked;
use core::CoreHooks;
pub use dma::BurstTiming;
use dma::Paced;
use enabled::Enabled;
use exti::{Exti, Syscfg};
pub use pads::Pads;
pub(crate) use pool::Program;
use quiet::Quiet;
pub use ring::Streams;
use timer::Watched;

const TARGET: &str = "stm32f411re";
/// Indices of the part's fields.
const TIM1: usize = 0;
const TIM2: usize = 0;
const TIM3: usize = 1;
const TIM5: usize = 3;
/// The channel of TIM5 that captures.
const TIM5_CHANNEL: u8 = 2;
const USART2: usize = 1;
/// The alternate function that carries USART2 on PA2 and PA3 (DS10314 table 9).
const AF_SERIAL: u8 = 7;
/// High-speed clock that the ST-LINK of the board feeds in, Hz (UM1724 section 7.7.1).
const HSE_HZ: u64 = 8_000_000;
/// Duration of a store into the flash (DS10314 table 47, typical), ns.
const STORE_NS: u64 = 16_000;
/// Supply, mV, unless the board sets another.
const SUPPLY_MV: u32 = 3300;

/// A pin of ports A to C.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Pin {
    port: u8,
    index: u8,
}

impl Pin {
    /// Pin `index` (0 to 15) of `port` ('A' to 'C').
    ///
    /// # Panics
    /// On any other port or index; meant for constants.
    #[must_use]
    pub const fn new(port: char, index: u8) -> Self {
        let port = match port {
            'A' => 0,
            'B' => 1,
            'C' => 2,
            _ => panic!("ports A to C"),
        };
        assert!(index < 16, "16 pins");
        Self { port, index }
    }

    fn nth(self) -> (usize, usize) {
        (usize::from(self.port), usize::from(self.index))
    }

    fn on_port(self) -> PortPin {
        PortPin::new(self.index).expect("checked at construction")
    }
}

impl fmt::Display for Pin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "P{}{}", char::from(b'A' + self.port), self.index)
    }
}

/// A board around the chip: what is connected to its pins.
pub trait Wiring: fmt::Debug + Send + 'static {
    /// An update has no effect unless a pin has changed since the last one, the instant given to [`Pads::wake_at`] has
    /// come, or the board was changed from outside. If true, all other updates are skipped.
    const ON_CHANGES_ONLY: bool = false;

    /// Reads the pins and drives them. Called after every timer event and every register access that can change a pin,
    /// and repeated until no pin changes.
    fn update(&mut self, pads: &mut Pads<'_>);

    /// Tells which of the step timer's next edges need no update; `None` if each of them does. Called while the
    /// processor sleeps.
    fn unnoticed(&self, pads: &mut Pads<'_>) -> Option<Unnoticed> {
        let _ = pads;
        None
    }

    /// Reports an edge of TIM1 that [`Wiring::unnoticed`] allowed: without an update, in order, but after its instant.
    fn unseen_edge(&mut self, edge: OutputEdge, leads: &Unnoticed) {
        let _ = (edge, leads);
    }

    /// The chip was reset or powered up, and drives no pin.
    fn restarted(&mut self);

    /// A store into the flash has begun, or an erasure: no instruction is executed until it ends.
    fn flash_began(&mut self, erases: bool);

    /// The supply was cut: the chip drives no pin until [`Wiring::restarted`].
    fn powered_off(&mut self);
}

fn supply(part: &mut Stm32f427, millivolts: u32) {
    part.set_supply(millivolts);
    part.adc[0].set_reference(millivolts);
}

#[derive(Clone, Copy, Debug)]
struct Slots {
    tim1: usize,
    tim3: usize,
    tim2: usize,
    tim5: usize,
    dma1: usize,
    dma2: usize,
    rcc: usize,
    exti: usize,
    syscfg: usize,
    flash: usize,
    usart2: usize,
    /// Devices whose state [`Pads`] shows to the board. Timers are not among them, because they report changes of their
    /// outputs.
    seen: [usize; 4],
}

/// The chip with a board around it.
#[derive(Debug)]
struct Chip<W> {
    part: Stm32f427,
    tim1: Watched<Advanced>,
    tim3: Watched<General>,
    tim2: Quiet,
    tim5: Quiet,
    dma1: Paced,
    dma2: Paced,
    rcc: Clocked,
    exti: Exti,
    syscfg: Syscfg,
    slots: Slots,
    options: ChipOptions,
    serial: Arc<Mutex<Serial>>,
    epoch_ns: u64,
    /// When the next update is scheduled, on the emulator's clock.
    wake: Option<VirtualNanos>,
    /// Something that the board can see may have changed since its last update.
    unseen: bool,
    /// State of the step timer's fast-forward while the processor sleeps.
    asleep: Option<Asleep>,
    hooks: CoreHooks,
    /// A bus without listeners, for TIM1.
    null_bus: Bus,
    /// Buffer for edges, kept to avoid allocations.
    followed: Vec<OutputEdge>,
    /// Captured instants that are not in memory yet: address and instant.
    captured: Vec<(u64, u64)>,
    /// Boxed because it is taken out for each update.
    wiring: Option<Box<W>>,
}

impl<W: Wiring> Chip<W> {
    fn new(
        wiring: W,
        options: ChipOptions,
        serial: Arc<Mutex<Serial>>,
        epoch_ns: u64,
    ) -> Result<Self, rigless::soc::Error> {
        let mut part = Stm32f427::new()?;
        part.rcc.attach_crystals(HSE_HZ, 0);
        part.rcc.calibrate_lsi(options.lsi_hz);
        supply(&mut part, SUPPLY_MV);
        part.usart[USART2].attach(Wire::new(Arc::clone(&serial), epoch_ns));
        let bus = part.bus();
        let slots = Slots {
            tim1: bus.slot("TIM1")?,
            tim3: bus.slot("TIM3")?,
            tim2: bus.slot("TIM2")?,
            tim5: bus.slot("TIM5")?,
            dma1: bus.slot("DMA1")?,
            dma2: bus.slot("DMA2")?,
            rcc: bus.slot("RCC")?,
            exti: bus.slot("EXTI")?,
            syscfg: bus.slot("SYSCFG")?,
            flash: bus.slot("FLASH")?,
            usart2: bus.slot("USART2")?,
            seen: [
                bus.slot("GPIOA")?,
                bus.slot("GPIOB")?,
                bus.slot("GPIOC")?,
                bus.slot("RCC")?,
            ],
        };
        let quiet = |slot: usize, nth: usize| {
            let peripheral = *bus.slots()[slot].peripheral();
            Quiet::new(
                placeholder_timer(nth),
                bus.cpu(),
                peripheral,
                options.every_event,
            )
        };
        let null_bus = null_bus(bus, slots.tim1)?;
        let mut chip = Self {
            asleep: None,
            hooks: CoreHooks::default(),
            null_bus,
            followed: Vec::new(),
            captured: Vec::new(),
            tim2: quiet(slots.tim2, TIM2)?,
            tim5: quiet(slots.tim5, TIM5)?,
            tim1: Watched::new(placeholder_advanced(), &[1, 3], !options.every_event),
            tim3: Watched::new(placeholder_timer(TIM3), &[1, 2], false),
            dma1: Paced::new(map::placeholder_dma(), None),
            dma2: Paced::new(map::placeholder_dma(), None),
            rcc: Clocked::new(placeholder_clocks(options.lsi_hz), None),
            options,
            part,
            exti: Exti::default(),
            syscfg: Syscfg,
            slots,
            serial,
            epoch_ns,
            wake: None,
            unseen: true,
            wiring: Some(Box::new(wiring)),
        };
        chip.adopt();
        chip.update(VirtualNanos(0));
        Ok(chip)
    }

    /// Installs the bench's own devices in a part that was just reset.
    fn adopt(&mut self) {
        let part = &mut self.part;
        let [dma1, dma2] = map::controllers();
        part.dma = [map::placeholder_dma(), map::placeholder_dma()];
        let by_itself = self.options.every_event || self.options.burst.is_some();
        let streams = self.options.streams;
        self.dma1 = Paced::new(dma1, None);
        self.dma2 = Paced::new(dma2, self.options.burst);
        if !by_itself {
            (self.dma1).add_rings(&[map::CAPTURES, map::RECEIVED], streams);
            self.dma2.add_rings(&[map::PERIODS], streams);
        }
        let rcc = std::mem::replace(&mut part.rcc, placeholder_clocks(self.options.lsi_hz));
        let from = self.options.hse_after_ns.map(VirtualNanos);
        self.rcc = Clocked::new(rcc, from);
        let tim1 = std::mem::replace(&mut part.advanced[TIM1], placeholder_advanced());
        let tim3 = std::mem::replace(&mut part.tim[TIM3], placeholder_timer(TIM3));
        for (quiet, nth) in [(&mut self.tim2, TIM2), (&mut self.tim5, TIM5)] {
            let tim = std::mem::replace(&mut part.tim[nth], placeholder_timer(nth));
            quiet.replace(tim);
        }
        self.tim1 = Watched::new(tim1, &[1, 3], !self.options.every_event);
        let tim3 = Watched::new(tim3, &[1, 2], false);
        let null_bus = null_bus(self.part.bus(), self.slots.tim3).ok();
        self.tim3 = match null_bus.filter(|_| !self.options.every_event) {
            Some(null_bus) => tim3.with_deferred_events(null_bus),
            None => tim3,
        };
        self.exti = Exti::default();
        self.wake = None;
        self.serial_pins();
        if let Some(wiring) = &mut self.wiring {
            wiring.restarted();
        }
    }

    /// Updates whether the pins carry USART2: serial bytes pass only then.
    fn serial_pins(&mut self) {
        let (_, registers) = self.part.port(0);
        let carried = |index| {
            Gpio::function(PortPin::new(index).expect("a pin"), registers) == Some(AF_SERIAL)
        };
        let (sends, hears) = (carried(2), carried(3));
        let mut serial = self.serial.lock().unwrap_or_else(PoisonError::into_inner);
        serial.sends = sends;
        serial.hears = hears;
    }

    /// Lends the board its pins, unless an update is in progress.
    fn with_pads<T>(
        &mut self,
        at: VirtualNanos,
        use_pads: impl FnOnce(&mut W, &mut Pads<'_>) -> T,
    ) -> Option<T> {
        let mut wiring = self.wiring.take()?;
        let mut pads = Pads {
            part: &mut self.part,
            tim1: &mut self.tim1,
            tim3: &mut self.tim3,
            tim2: &mut self.tim2,
            tim5: &mut self.tim5,
            rcc: &self.rcc,
            exti: &mut self.exti,
            slots: self.slots,
            at,
            epoch_ns: self.epoch_ns,
            wake: None,
            touched: false,
        };
        let seen = use_pads(&mut wiring, &mut pads);
        self.wiring = Some(wiring);
        Some(seen)
    }

    /// Updates the board until no pin changes: an input that the board drives may cut a pulse short.
    fn update(&mut self, at: VirtualNanos) -> bool {
        let mut touched = false;
        let (registers, _) = self.part.bus_mut().drive(at, self.slots.tim3);
        self.tim3.handle_deferred(registers, at);
        self.wake.take_if(|wake| *wake <= at);
        loop {
            let updated = self.with_pads(at, |wiring, pads| {
                wiring.update(pads);
                (pads.touched, pads.wake)
            });
            let Some((has_touched, wake)) = updated else {
                return false;
            };
            touched |= has_touched;
            if let Some(wake) = wake {
                let wake = VirtualNanos(wake.saturating_sub(self.epoch_ns)).max(at);
                // One scheduled update is enough: each update asks for the next one.
                if self.wake.is_none_or(|asked| wake < asked) {
                    self.wake = Some(wake);
                    let bus = self.part.bus_mut();
                    bus.drive(at, self.slots.exti).1.schedule(wake);
                }
            }
            if self.tim1.edges.is_empty() && self.tim3.edges.is_empty() {
                break;
            }
        }
        self.unseen = false;
        touched
    }

    /// Updates the board, unless it would see no change.
    fn update_if_changed(&mut self, at: VirtualNanos) -> bool {
        let due = self.wake.is_some_and(|wake| wake <= at);
        let edges = !self.tim1.edges.is_empty() || !self.tim3.edges.is_empty();
        if W::ON_CHANGES_ONLY && !self.unseen && !edges && !due && !self.fast_forward_ends(at) {
            return false;
        }
        self.catch_up(at);
        if !self.tim1.edges.is_empty() {
            self.hooks.report_sleep(true);
        }
        self.update(at)
    }

    /// Updates the board outside the emulator's polling. If that drives a pin, schedules a stop so that it takes
    /// effect.
    fn update_between(&mut self, at: VirtualNanos) {
        if self.update_if_changed(at) {
            self.part
                .bus_mut()
                .drive(at, self.slots.exti)
                .1
                .schedule(at);
        }
    }
}

fn placeholder_advanced() -> Tim<Advanced> {
    Tim::with_clock(0, ADVANCED_TIMERS[TIM1].counter)
}

/// A bus without listeners, for a timer whose events must not reach the emulator.
fn null_bus(bus: &Bus, slot: usize) -> Result<Bus, rigless::soc::Error> {
    let peripheral = *bus.slots()[slot].peripheral();
    Bus::builder(bus.cpu(), &[], [peripheral]).build()
}

/// Placeholder in the part for the clock tree. After a reset the part makes the next clock tree from it.
fn placeholder_clocks(lsi_hz: u64) -> Rcc {
    let mut rcc = Rcc::new();
    rcc.attach_crystals(HSE_HZ, 0);
    rcc.calibrate_lsi(lsi_hz);
    rcc
}

fn placeholder_timer(nth: usize) -> Tim<General> {
    Tim::with_clock(0, TIMERS[nth].counter)
}

impl<W: Wiring> Mcu for Chip<W> {
    fn bus(&self) -> &Bus {
        self.part.bus()
    }

    fn bus_mut(&mut self) -> &mut Bus {
        self.part.bus_mut()
    }

    fn reset(&mut self, at: VirtualNanos, cause: ResetCause) {
        self.catch_up(at);
        self.part.reset(at, cause);
        self.adopt();
        self.update(at);
    }

    fn poll(&mut self, now: VirtualNanos) {
        // Of all models only the serial ones use the outside world, and only this one has something connected.
        let (bus, serial) = self.part.split(self.slots.usart2);
        if let Some(serial) = serial {
            let (registers, mut context) = bus.drive(now, self.slots.usart2);
            serial.poll(registers, &mut context);
        }
        self.update_if_changed(now);
    }

    fn split(&mut self, slot: usize) -> (&mut Bus, Option<&mut dyn ErasedDevice>) {
        // Every access to a device and every event of a device passes here. While the processor sleeps none of them
        // changes a pin.
        self.unseen |= self.asleep.is_none() && self.slots.seen.contains(&slot);
        let Slots {
            tim1,
            tim3,
            tim2,
            tim5,
            dma1,
            dma2,
            rcc,
            exti,
            syscfg,
            ..
        } = self.slots;
        let device: &mut dyn ErasedDevice = match slot {
            slot if slot == tim1 => &mut self.tim1,
            slot if slot == tim3 => &mut self.tim3,
            slot if slot == tim2 => &mut self.tim2,
            slot if slot == tim5 => &mut self.tim5,
            slot if slot == dma1 => &mut self.dma1,
            slot if slot == dma2 => &mut self.dma2,
            slot if slot == rcc => &mut self.rcc,
            slot if slot == exti => &mut self.exti,
            slot if slot == syscfg => &mut self.syscfg,
            slot => return self.part.split(slot),
        };
        let bus = self.part.bus_mut();
        (bus, Some(device))
    }
}

/// Describes the core: the STM32F411's memories and the part's peripherals. It is never accessed.
#[derive(Debug)]
struct Shell {
    bus: Bus,
}

impl Mcu for Shell {
    fn bus(&self) -> &Bus {
        &self.bus
    }

    fn bus_mut(&mut self) -> &mut Bus {
        &mut self.bus
    }

    fn reset(&mut self, _at: VirtualNanos, _cause: ResetCause) {}

    fn poll(&mut self, _now: VirtualNanos) {}

    fn split(&mut self, _slot: usize) -> (&mut Bus, Option<&mut dyn ErasedDevice>) {
        (&mut self.bus, None)
    }
}

/// How the chip runs.
#[derive(Clone, Copy, Debug)]
pub struct ChipOptions {
    /// The core's clock, Hz.
    pub core_hz: u64,
    /// Instructions per second of virtual time: 65 for 100 cycles is a cautious estimate for this core.
    pub instructions_per_second: u64,
    /// The chip's unique number.
    pub uid: [u8; 12],
    /// How long the bursts of the step timer take; none = no time, which is quicker to emulate.
    pub burst: Option<BurstTiming>,
    /// Undocumented behaviour of the DMA streams; not with `burst` or `every_event`.
    pub streams: Streams,
    /// Delay from power-up to the 8 MHz clock of the ST-LINK, ns; `None` if it never starts.
    pub hse_after_ns: Option<u64>,
    /// The oscillator of the watchdog, Hz: 17,000 to 47,000 (DS10314 table 40).
    pub lsi_hz: u64,
    /// How long an erase takes, ns; not less than the emulator's 250 ms.
    pub erase_ns: u64,
    /// Stop for every event of every timer, even if it cannot be noticed. The result is the same, but slower.
    pub every_event: bool,
}

impl Default for ChipOptions {
    fn default() -> Self {
        Self {
            core_hz: 100_000_000,
            instructions_per_second: 65_000_000,
            uid: *b"virtual rig\0",
            burst: None,
            streams: Streams::default(),
            hse_after_ns: Some(0),
            lsi_hz: 32_000,
            erase_ns: 0,
            every_event: false,
        }
    }
}

/// The emulated chip on its board.
#[derive(Debug)]
pub struct Emulator<W> {
    chip: Chip<W>,
    shell: Shell,
    options: ChipOptions,
    program: Program,
    array: Array,
    /// The flash is busy with a store until this instant.
    storing_until: VirtualNanos,
    /// The core is waiting for the flash.
    stalled: bool,
    /// Overwritten code: addresses and original contents.
    overwritten: Vec<(u64, u64)>,
    absent: Vec<u64>,
    enabled: Enabled,
    /// Mistakes in the serial port's settings.
    line_mistakes: Vec<String>,
    flash_refused: u64,
}

/// Nothing is stored: runs start from reset or from a flash, never from a snapshot.
impl<W: Wiring> Store for Emulator<W> {}

impl<W: Wiring> Emulator<W> {
    pub(crate) fn new(
        wiring: W,
        options: ChipOptions,
        serial: Arc<Mutex<Serial>>,
        epoch_ns: u64,
        program: Program,
    ) -> Result<Self, rigless::soc::Error> {
        let chip = Chip::new(wiring, options, serial, epoch_ns)?;
        let peripherals: Vec<_> = chip.bus().peripherals().copied().collect();
        let bus = Bus::builder(chip.bus().cpu(), &map::MEMORY, peripherals).build()?;
        Ok(Self {
            chip,
            shell: Shell { bus },
            options,
            program,
            array: Array::default(),
            storing_until: VirtualNanos(0),
            stalled: false,
            overwritten: Vec::new(),
            absent: Vec::new(),
            enabled: Enabled::default(),
            line_mistakes: Vec::new(),
            flash_refused: 0,
        })
    }

    /// The board.
    ///
    /// # Panics
    /// Only during an update, when it cannot be called.
    pub fn wiring(&mut self) -> &mut W {
        self.chip.unseen = true;
        self.chip.wiring.as_mut().expect("between two updates")
    }

    /// The board, for reading only.
    ///
    /// # Panics
    /// As [`Emulator::wiring`].
    pub(crate) fn wiring_ref(&self) -> &W {
        self.chip.wiring.as_ref().expect("between two updates")
    }

    pub(crate) fn take_wiring(&mut self) -> Option<W> {
        self.chip.wiring.take().map(|wiring| *wiring)
    }

    /// Updates the board after it was changed from outside.
    pub(crate) fn refresh(&mut self, at: VirtualNanos) {
        self.chip.unseen = true;
        self.chip.update_between(at);
    }

    /// Accessed peripheral addresses that an STM32F411 does not have.
    pub(crate) fn absent(&self) -> &[u64] {
        &self.absent
    }

    /// Accesses to peripherals that may be lost, because their clocks were enabled just before.
    pub(crate) fn too_soon(&self) -> &[String] {
        &self.enabled.gaps
    }

    /// Mistakes in the serial port's settings, as found whenever one of its registers was written.
    pub(crate) fn line_mistakes(&self) -> &[String] {
        &self.line_mistakes
    }

    /// Number of stores into the flash that the chip would have refused.
    pub(crate) fn flash_refused(&self) -> u64 {
        self.flash_refused
    }

    /// Where the image changed flash outside the settings' sectors.
    pub(crate) fn flash_foreign(&self) -> &[u64] {
        self.array.foreign()
    }

    /// Number of flash operations, stores and erases, since power-up.
    pub(crate) fn flash_operations(&self) -> u64 {
        self.array.operations()
    }

    /// Cuts the supply of the flash at flash operation number `operation` (from 0, since power-up). The flash does not
    /// change after that.
    pub(crate) fn cut_flash(&mut self, at: CutAt, operation: u64) {
        self.array.fail(at, operation);
    }

    /// Whether the operation given to [`Emulator::cut_flash`] has been reached.
    pub(crate) fn flash_is_cut(&self) -> bool {
        self.array.has_failed()
    }

    pub(crate) fn set_supply_mv(&mut self, millivolts: u32) {
        supply(&mut self.chip.part, millivolts);
    }

    /// Stops the 8 MHz clock; it returns after `back_after_ns`, or never. Without the clock security system the chip is
    /// not notified, and a core that runs on this clock stops.
    pub(crate) fn fail_hse(
        &mut self,
        at: VirtualNanos,
        back_after_ns: Option<u64>,
        host: &mut dyn Host,
    ) {
        let chip = &mut self.chip;
        chip.options.hse_after_ns = back_after_ns.map(|ns| at.0 + ns);
        chip.rcc
            .set_from(chip.options.hse_after_ns.map(VirtualNanos));
        let (registers, mut context) = chip.part.bus_mut().drive(at, chip.slots.rcc);
        let cr = registers.get(rcc::Register::Cr);
        if rcc::cr::CSSON.is_set(cr) {
            chip.rcc.rcc.fail_hse(registers, &mut context);
            chip.hooks.raise_nmi();
        } else if rcc::cr::PLLON.is_set(cr) && rcc::cr::HSERDY.is_set(cr) {
            self.hold_up(at, back_after_ns.unwrap_or(u64::MAX / 2), host);
        } else if rcc::cr::HSEON.is_set(cr) {
            chip.rcc.pause(registers, &mut context);
        }
    }

    /// Lets the bus refuse an access of the step timer's stream, which switches it off.
    pub(crate) fn fail_step_stream(&mut self, at: VirtualNanos) {
        let dma2 = &mut self.chip.dma2;
        let (registers, mut context) = self.chip.part.bus_mut().drive(at, self.chip.slots.dma2);
        for ring in &mut dma2.rings {
            ring.refused(registers);
        }
        dma2.refresh(registers, &mut context);
    }

    /// Lets this fraction of the received bytes arrive with a framing error.
    pub(crate) fn set_framing_errors(&mut self, per_million: u32) {
        let rate = Rate {
            name: "framing",
            per_million,
        };
        self.chip.part.usart[USART2].errors_mut().framing = rate;
    }

    /// Sets the duration of the step timer's bursts. Call it between two of them.
    pub(crate) fn set_burst_timing(&mut self, burst_timing: BurstTiming) {
        self.chip.dma2.set_burst_timing(burst_timing);
    }

    /// Overwrites code as a debugger does, bypassing the flash interface, until the next reset.
    pub(crate) fn overwrite(&mut self, address: u64, code: &[u16], host: &mut dyn Host) {
        for (address, half) in (address..).step_by(2).zip(code) {
            let was = host.read(address, Width::W16).unwrap_or(0);
            self.overwritten.push((address, was));
            let _ = host.program(address, Width::W16, u64::from(*half));
        }
    }

    fn restore_code(&mut self, host: &mut dyn Host) {
        for (address, was) in self.overwritten.drain(..).rev() {
            let _ = host.program(address, Width::W16, was);
        }
    }

    fn control_and_status(&self) -> (u64, u64) {
        let registers = self.chip.part.bus().slots()[self.chip.slots.flash].registers();
        (
            registers.get(flash::Register::Cr),
            registers.get(flash::Register::Sr),
        )
    }

    /// Stalls the core: it cannot fetch code while the flash is busy (RM0383 section 3.5). Time, peripherals and DMA
    /// continue.
    fn stall(&mut self, erases: bool, host: &mut dyn Host) {
        self.stalled = true;
        host.hold(true);
        self.wiring().flash_began(erases);
    }

    /// Marks the flash as busy until `until`, and schedules a stop there.
    fn busy_until(&mut self, until: VirtualNanos, now: VirtualNanos) {
        self.storing_until = until;
        let exti = self.chip.slots.exti;
        let bus = self.chip.part.bus_mut();
        bus.drive(now, exti).1.schedule(until);
    }

    /// Keeps the core from executing for a while, as a busy bus or a debugger can.
    pub(crate) fn hold_up(&mut self, at: VirtualNanos, duration_ns: u64, host: &mut dyn Host) {
        self.busy_until(VirtualNanos(at.0 + duration_ns), at);
        self.stalled = true;
        host.hold(true);
    }

    /// Lets the core continue once the flash is ready.
    fn unstall(&mut self, at: VirtualNanos, host: &mut dyn Host) {
        let busy = self.control_and_status().1 & BUSY != 0 || at < self.storing_until;
        if self.stalled && !busy {
            self.array.finish(host);
            self.stalled = false;
            host.hold(false);
        }
    }

    /// Brings all devices up to date, before one is inspected or changed from outside.
    pub(crate) fn catch_up(&mut self, at: VirtualNanos, host: &mut dyn Host) {
        self.wakes(at, host);
        let Chip {
            part,
            tim2,
            tim5,
            slots,
            ..
        } = &mut self.chip;
        for (quiet, slot) in [(tim2, slots.tim2), (tim5, slots.tim5)] {
            let (registers, mut context) = part.bus_mut().drive(at, slot);
            quiet.settle(registers, &mut context);
        }
    }

    fn wakes(&mut self, at: VirtualNanos, host: &mut dyn Host) {
        self.chip.catch_up(at);
        self.chip.write_captures(host);
    }

    fn accessed(&mut self, access: &Access, host: &mut dyn Host) {
        match core::sleep_change(access) {
            Some(core::SleepChange::Sleeps) => {
                return self.chip.falls_asleep(access.virtual_time, host);
            }
            Some(core::SleepChange::Wakes) => return self.wakes(access.virtual_time, host),
            None => {}
        }
        if map::absent(access.address)
            && self.absent.len() < 64
            && !self.absent.contains(&access.address)
        {
            self.absent.push(access.address);
        }
        self.enabled.accessed(access, host);
        let registers = self.control_and_status();
        let now = access.virtual_time;
        match self.array.settled(access, registers, host) {
            Effect::Nothing => {}
            Effect::Stored => {
                self.busy_until(VirtualNanos(now.0 + STORE_NS), now);
                self.stall(false, host);
            }
            Effect::EraseBegan => {
                self.busy_until(VirtualNanos(now.0 + self.options.erase_ns), now);
                self.stall(true, host);
            }
            Effect::Refused => self.flash_refused += 1,
        }
        if access.kind == AccessKind::Write && USART2_BLOCK.contains(&access.address) {
            let bus = self.chip.part.bus().slots();
            let [port, clocks] = [self.chip.slots.usart2, self.chip.slots.rcc];
            let bus_hz = self.chip.rcc.rcc.pclk1(bus[clocks].registers());
            let mistake = framing::mistake(bus[port].registers(), bus_hz);
            let new = mistake.filter(|mistake| !self.line_mistakes.contains(mistake));
            self.line_mistakes.extend(new);
        }
        if access.kind == AccessKind::Write && moves_pins(access.address) {
            self.chip.serial_pins();
            self.chip.update_between(access.virtual_time);
        }
        // Update the board first: the converter must sample the present voltage, not that at the bridge's last edge.
        if access.kind == AccessKind::Write && access.address == ADC1_SQR3 {
            self.chip.update_between(access.virtual_time);
        }
    }
}

/// The registers of the serial port.
const USART2_BLOCK: std::ops::Range<u64> = 0x4000_4400..0x4000_4800;
/// Selects the channel of the next conversion.
const ADC1_SQR3: u64 = 0x4001_2034;

/// Whether a write to `address` can change a pin without a timer event: ports A to C, TIM1, TIM3.
fn moves_pins(address: u64) -> bool {
    matches!(address, 0x4002_0000..0x4002_0C00 | 0x4001_0000..0x4001_0400 | 0x4000_0400..0x4000_0800)
}

/// Updates the chip and its board after every settled access and stop; called by the run's driver.
pub(crate) fn settled<W: Wiring>(
    session: &mut Session<Emulator<W>>,
    host: &mut dyn Host,
    settled: Settled,
) {
    let emulator = session.board_mut();
    match settled {
        Settled::Access { access, .. } => emulator.accessed(&access, host),
        Settled::Stop(stop) => {
            emulator.unstall(stop.at, host);
            let chip = &mut emulator.chip;
            chip.update_between(stop.at);
            chip.write_captures(host);
            if chip.asleep.is_some() {
                chip.extend(stop.at, host);
            } else if stop.reason == StopReason::Idle {
                chip.falls_asleep(stop.at, host);
            }
        }
        _ => {}
    }
}

/// Fills the RAM as it may be after power-up, before anything is executed: with noise, which `seed` determines.
pub(crate) fn powered_up(host: &mut dyn Host, seed: u64) {
    let mut state = seed;
    for address in map::RAM.step_by(8) {
        // SplitMix64: its words are well mixed for any seed.
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        let _ = host.write(address, Width::W64, mixed ^ (mixed >> 31));
    }
}

/// Updates the emulator after the chip was reset, before it executes anything. Memory is kept.
pub(crate) fn restarted<W: Wiring>(session: &mut Session<Emulator<W>>, host: &mut dyn Host) {
    let emulator = session.board_mut();
    emulator.array.cut(host);
    emulator.enabled.reset();
    emulator.restore_code(host);
    emulator.storing_until = VirtualNanos(0);
    emulator.stalled = false;
    host.hold(false);
}

/// Contents of the whole flash.
pub(crate) fn read_out(host: &mut dyn Host) -> Vec<u8> {
    array::read_out(host)
}

/// Ends a run as a cut of the supply does. Returns the contents of the flash.
pub(crate) fn cut_supply<W: Wiring>(
    session: &mut Session<Emulator<W>>,
    host: &mut dyn Host,
) -> Vec<u8> {
    restarted(session, host);
    array::read_out(host)
}

impl<W: Wiring> Board for Emulator<W> {
    fn name(&self) -> &'static str {
        TARGET
    }

    fn target_names(&self) -> Vec<&'static str> {
        vec![TARGET]
    }

    fn mcu(&mut self, target: usize) -> Option<&mut dyn Mcu> {
        (target == 0).then_some(&mut self.chip)
    }

    fn targets(&mut self) -> Vec<Target<'_>> {
        let core = machine::Core {
            variant: machine::Variant::M4,
            clock_hz: NonZeroU64::new(self.options.core_hz).unwrap_or(NonZeroU64::MIN),
            interrupt_lines: NonZeroU32::new(map::INTERRUPT_LINES).expect("lines"),
            priority_bits: 4,
            refclk_divider: NonZeroU32::new(8).expect("a divider divides"),
            instructions_per_second: NonZeroU64::new(self.options.instructions_per_second)
                .unwrap_or(NonZeroU64::MIN),
            boot: "flash",
        };
        let windows = armv7m::windows(self.chip.part.bus());
        let mut spec: CoreSpec =
            core.spec_with_parts(&windows, machine::Fpu::FpV4Sp, machine::MpuRegions::Eight);
        if !self.options.every_event {
            core::with_hooks(&mut spec, &self.chip.hooks, self.program);
        }
        spec.factory_images = map::factory_image(self.options.uid).into_iter().collect();
        vec![Target::new(TARGET, &mut self.shell, spec)]
    }
}
