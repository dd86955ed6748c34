//! The chip as its board sees and drives it: pins, inputs of timers, voltages.

use rigless::device::{DeviceContext, Level, RegisterFile};
use rigless::mcu::Mcu;
use rigless::soc::stm32f427::Stm32f427;
use rigless::soc::stm32f427::generated::{gpioa, tim1};
use rigless::soc::stm32f427::peripherals::adc;
use rigless::soc::stm32f427::peripherals::gpio::Gpio;
use rigless::soc::stm32f427::peripherals::tim::{Advanced, General};
use rigless::time::VirtualNanos;

use super::clocks::Clocked;
use super::exti::{Exti, Syscfg};
use super::quiet::Quiet;
use super::timer::Watched;
use super::{OutputEdge, Pin, Slots, supply};

/// The chip's pins during one call of [`super::Wiring::update`].
pub struct Pads<'a> {
    pub(super) part: &'a mut Stm32f427,
    pub(super) tim1: &'a mut Watched<Advanced>,
    pub(super) tim3: &'a mut Watched<General>,
    pub(super) tim2: &'a mut Quiet,
    pub(super) tim5: &'a mut Quiet,
    pub(super) rcc: &'a Clocked,
    pub(super) exti: &'a mut Exti,
    pub(super) slots: Slots,
    pub(super) at: VirtualNanos,
    pub(super) epoch_ns: u64,
    pub(super) wake: Option<u64>,
    pub(super) touched: bool,
}

impl Pads<'_> {
    /// Now on the bench's clock, ns.
    #[must_use]
    pub fn now_ns(&self) -> u64 {
        self.epoch_ns + self.at.0
    }

    /// Asks for another update at `at_ns` or before.
    pub fn wake_at(&mut self, at_ns: u64) {
        self.wake = Some(self.wake.map_or(at_ns, |wake| wake.min(at_ns)));
    }

    /// The alternate function that `pin` carries, if its mode is alternate function.
    #[must_use]
    pub fn function(&mut self, pin: Pin) -> Option<u8> {
        let (_, registers) = self.part.port(pin.nth().0);
        Gpio::function(pin.on_port(), registers)
    }

    /// The level that the firmware drives on `pin` as a plain output, or `None` if it drives none.
    #[must_use]
    pub fn output(&mut self, pin: Pin) -> Option<bool> {
        let (_, registers) = self.part.port(pin.nth().0);
        driven(registers, pin.index)
    }

    /// Whether `pin` is in analog mode.
    #[must_use]
    pub fn is_analog(&mut self, pin: Pin) -> bool {
        let (_, registers) = self.part.port(pin.nth().0);
        (registers.get(gpioa::Register::Moder) >> (2 * pin.index)) & 3 == 3
    }

    /// The level of `pin` now.
    #[must_use]
    pub fn is_high(&mut self, pin: Pin) -> bool {
        let (gpio, registers) = self.part.port(pin.nth().0);
        gpio.level(pin.on_port(), registers) == Level::High
    }

    /// Drives `pin` from outside, or releases it with `None`. Returns the resulting level, which the firmware's pull
    /// resistor sets when nothing drives the pin.
    pub fn drive(&mut self, pin: Pin, level: Option<bool>) -> bool {
        self.touched = true;
        let (port, index) = pin.nth();
        let at = self.at;
        let (before, high) = self.part.drive_port(at, port, |gpio, registers, context| {
            let before = gpio.level(pin.on_port(), registers);
            gpio.drive(pin.on_port(), level.map(Level::from), registers, context);
            let after = gpio.level(pin.on_port(), registers);
            (before == Level::High, after == Level::High)
        });
        if high == before {
            return high;
        }
        let routing = self.part.bus().slots()[self.slots.syscfg].registers();
        let selected = Syscfg::selected(routing, index);
        let (registers, mut context) = self.part.bus_mut().drive(at, self.slots.exti);
        if selected == port {
            self.exti.edge(index, high, registers, &mut context);
        }
        high
    }

    /// Changes of TIM1's outputs 1 and 3 since the last call, in order, with their exact instants.
    pub fn take_tim1_edges(&mut self) -> Vec<OutputEdge> {
        on_bench_clock(&mut self.tim1.edges, self.epoch_ns)
    }

    /// Changes of TIM3's outputs 1 and 2 since the last call, as for TIM1.
    pub fn take_tim3_edges(&mut self) -> Vec<OutputEdge> {
        on_bench_clock(&mut self.tim3.edges, self.epoch_ns)
    }

    /// TIM1's output `channel` now.
    #[must_use]
    pub fn tim1_high(&self, channel: u8) -> bool {
        self.tim1.high(channel)
    }

    /// Whether TIM1 drives its outputs at all: BDTR.MOE (RM0383 section 12.4.18).
    #[must_use]
    pub fn tim1_armed(&self) -> bool {
        let registers = self.part.bus().slots()[self.slots.tim1].registers();
        (registers.get(tim1::Register::Bdtr) >> 15) & 1 == 1
    }

    /// Whether the high-speed clock from outside has been switched on: RCC_CR.HSEON (RM0383 section 6.3.1).
    #[must_use]
    pub fn hse_is_on(&self) -> bool {
        let registers = self.part.bus().slots()[self.slots.rcc].registers();
        self.rcc.is_switched_on(registers)
    }

    /// TIM3's output `channel` now.
    #[must_use]
    pub fn tim3_high(&self, channel: u8) -> bool {
        self.tim3.high(channel)
    }

    /// Sets the level at TIM1's break input.
    pub fn drive_break(&mut self, high: bool) {
        self.touched = true;
        let (
            at,
            Self {
                part, tim1, slots, ..
            },
        ) = (self.at, self);
        let (registers, mut context) = part.bus_mut().drive(at, slots.tim1);
        tim1.tim
            .drive_break(Level::from(high), registers, &mut context);
        tim1.note(registers, at.0);
    }

    /// Sets the level at TIM2's external trigger input.
    pub fn drive_tim2_etr(&mut self, high: bool) {
        self.touched = true;
        let bus = self.part.bus_mut();
        let (registers, mut context) = bus.drive(self.at, self.slots.tim2);
        self.tim2
            .edge(high, registers, &mut context, |tim, registers, context| {
                tim.drive_etr(Level::from(high), registers, context);
            });
    }

    /// Sets the level at TIM2's input `channel`, 1 or 2, at this instant of the bench's clock, or when the timer was
    /// last called, if that is later.
    pub fn drive_tim2_input(&mut self, channel: u8, high: bool, at_ns: u64) {
        self.touched = true;
        let at = VirtualNanos(at_ns.saturating_sub(self.epoch_ns)).max(self.tim2.seen());
        let bus = self.part.bus_mut();
        let (registers, mut context) = bus.drive(at, self.slots.tim2);
        drive_input(self.tim2, channel, high, registers, &mut context);
    }

    /// Sets the level at TIM5's input `channel` at this instant of the bench's clock: that of the timer event being
    /// handled, or a few nanoseconds ahead.
    pub fn drive_tim5_input(&mut self, channel: u8, high: bool, at_ns: u64) {
        self.touched = true;
        let at = VirtualNanos(at_ns - self.epoch_ns);
        let bus = self.part.bus_mut();
        let (registers, mut context) = bus.drive(at, self.slots.tim5);
        drive_input(self.tim5, channel, high, registers, &mut context);
    }

    /// Withholds DMA from TIM5's captures, as a bus that is not granted does, or allows it again. While it is withheld,
    /// a capture overwrites the previous one.
    pub fn keep_tim5_from_dma(&mut self, kept: bool) {
        self.touched = true;
        let bus = self.part.bus_mut();
        let (registers, mut context) = bus.drive(self.at, self.slots.tim5);
        self.tim5.keep_from_dma(kept, registers, &mut context);
    }

    /// Sets the voltage at channel `number` of ADC1, mV.
    pub fn set_adc_mv(&mut self, number: u8, millivolts: u32) {
        let channel = adc::Channel::new(number).expect("a pin's channel");
        self.part.adc[0].set_input(channel, millivolts);
    }

    /// Sets the chip's supply, VDD and VDDA together, mV.
    pub fn set_supply_mv(&mut self, millivolts: u32) {
        supply(self.part, millivolts);
    }
}

/// The level that a port's `registers` drive on pin `index` as a plain output. A high open drain drives nothing
/// (RM0383 section 8.3.10).
fn driven(registers: &RegisterFile, index: u8) -> Option<bool> {
    let is_output = (registers.get(gpioa::Register::Moder) >> (2 * index)) & 3 == 1;
    let is_open_drain = (registers.get(gpioa::Register::Otyper) >> index) & 1 == 1;
    let high = (registers.get(gpioa::Register::Odr) >> index) & 1 == 1;
    (is_output && !(is_open_drain && high)).then_some(high)
}

fn drive_input(
    timer: &mut Quiet,
    channel: u8,
    high: bool,
    registers: &mut RegisterFile,
    context: &mut DeviceContext<'_>,
) {
    let channel = rigless::soc::st::tim::Channel::new(channel).expect("channel 1 to 4");
    timer.edge(high, registers, context, |tim, registers, context| {
        tim.drive_input(channel, Level::from(high), registers, context);
    });
}

fn on_bench_clock(edges: &mut Vec<OutputEdge>, epoch_ns: u64) -> Vec<OutputEdge> {
    let mut taken = std::mem::take(edges);
    for edge in &mut taken {
        edge.at_ns += epoch_ns;
    }
    taken
}

#[cfg(test)]
mod tests {
    use super::*;
    use gpioa::Register::{Moder, Odr, Otyper};

    #[test]
    fn a_high_open_drain_drives_nothing() {
        const INDEX: u8 = 9;
        let mut part = Stm32f427::new().expect("a part");
        let (_, registers) = part.port(0);
        let mut set = |output: u64, open_drain: u64, high: u64| {
            registers.set(Moder, output << (2 * INDEX));
            registers.set(Otyper, open_drain << INDEX);
            registers.set(Odr, high << INDEX);
            driven(registers, INDEX)
        };
        assert_eq!((set(1, 0, 0), set(1, 0, 1)), (Some(false), Some(true)));
        assert_eq!((set(1, 1, 0), set(1, 1, 1)), (Some(false), None));
        assert_eq!((set(0, 0, 1), set(2, 0, 1)), (None, None));
    }
}
