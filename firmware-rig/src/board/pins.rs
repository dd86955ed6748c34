//! Pins, clocks, timers and interrupts of the rig; the only file that sets them up.
//!
//! [`wiring::rig`] assigns the signals to the pins.
//!
//! Step timer: TIM1 with DMA2 stream 5 channel 6 (RM0383 table 28). Time driver: TIM4. All inputs have pull-ups:
//! an open contact and a cut wire read the same, high.

#![allow(unsafe_code)]

use super::channels::ENABLE_HIGH_AT_START;
use core::sync::atomic::Ordering;
use device::chip::{clock, flash::Sectors, serial, start};
use embassy_stm32::{
    Config, Peri,
    gpio::{Level, Output, Speed},
    interrupt::{self, InterruptExt, Priority},
    mode::Async,
    pac, peripherals, rcc,
    time::Hertz,
    usart::{RingBufferedUartRx, UartTx},
    wdg::IndependentWatchdog,
};
use motion::axis::Direction;
use protocol::{rig::RigInputs, system::Clock};
use wiring::{
    Pin,
    rig::{
        BUTTON, CAPTURE, DIR, ENABLE, ESTOP_LOOP, FAR_LIMIT, HOME_FLAG, LED, READ_BACK, SERIAL,
        STEP, SYNC,
    },
};

/// AF1 carries TIM1 and TIM2 on every pin used here, AF2 TIM5 (DS10314 table 9).
const AF_TIMER: u8 = 1;
const AF_CAPTURE: u8 = 2;

/// Peripherals that the tasks own.
pub struct Board {
    pub serial: (UartTx<'static, Async>, RingBufferedUartRx<'static>),
    pub led: Output<'static>,
    /// Not yet started.
    pub watchdog: IndependentWatchdog<'static, peripherals::IWDG>,
    pub sectors: Sectors,
    pub timers: Timers,
}

/// Peripherals whose registers the step generator uses; it takes them, so that nothing else can.
pub type Timers = (
    Peri<'static, peripherals::TIM1>,
    Peri<'static, peripherals::DMA2_CH5>,
    Peri<'static, peripherals::TIM2>,
    Peri<'static, peripherals::TIM5>,
    Peri<'static, peripherals::DMA1_CH4>,
);

/// Driver off and no step: EN high, DIR and STEP low. Call it before anything else. Until then the driver's own
/// resistor decides, which on a DRV8825 means "on", and the clocks may take long to start. The HAL later enables the
/// ports once more, but does not reset them. Registers only.
pub fn make_outputs_safe() {
    use pac::gpio::vals::Moder;
    pac::RCC.ahb1enr().modify(|w| {
        w.set_gpioaen(true);
        w.set_gpioben(true);
    });
    start::await_enabled_clocks();
    // The first read after enabling a port's clock may return the reset value.
    let _ = is_high(ENABLE);
    ENABLE_HIGH_AT_START.store(is_high(ENABLE), Ordering::Relaxed);
    // First the levels, then the modes.
    set(ENABLE, true);
    set(STEP, false);
    set(DIR, false);
    for pin in [ENABLE, STEP, DIR] {
        port(pin)
            .moder()
            .modify(|w| w.set_moder(pin.number, Moder::OUTPUT));
    }
}

/// Clocks, pins and interrupts. The driver stays off and no output is armed.
pub fn init() -> Board {
    let p = clock::init_with_either_clock(clocks(Clock::External), clocks(Clock::Internal));
    accelerate_flash();
    stop_pulses_while_halted();
    enable_peripherals();
    outputs_off();
    configure_pins();
    configure_priorities();
    Board {
        serial: serial::open(p.USART2, p.PA3, p.PA2, p.DMA1_CH6, p.DMA1_CH5),
        led: Output::new(p.PA5, Level::Low, Speed::Low),
        watchdog: start::watchdog(p.IWDG),
        sectors: Sectors::new(p.FLASH),
        timers: (p.TIM1, p.DMA2_CH5, p.TIM2, p.TIM5, p.DMA1_CH4),
    }
}

/// PLL at 100 MHz, and both timer clocks at 100 MHz. Source: 8 MHz of the ST-LINK (or a crystal), or the chip's own 16
/// MHz, which is accurate enough for the link but not for steps.
fn clocks(source: Clock) -> Config {
    use rcc::{
        AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPDiv, PllPreDiv, PllQDiv,
        PllSource, Sysclk,
    };
    let mut config = Config::default();
    let prediv = match source {
        Clock::External => {
            config.rcc.hse = Some(Hse {
                freq: Hertz(8_000_000),
                mode: HseMode::Bypass,
            });
            config.rcc.pll_src = PllSource::HSE;
            PllPreDiv::DIV4
        }
        Clock::Internal => {
            config.rcc.pll_src = PllSource::HSI;
            PllPreDiv::DIV8
        }
    };
    // 2 MHz * 100 / 2 = 100 MHz; VCO 200 MHz (RM0383 section 6.3.2: 100..432 MHz).
    config.rcc.pll = Some(Pll {
        prediv,
        mul: PllMul::MUL100,
        divp: Some(PllPDiv::DIV2),
        // 40 MHz, unused. Without it the HAL would write 0, which RM0383 section 6.3.2 forbids.
        divq: Some(PllQDiv::DIV5),
        divr: None,
    });
    config.rcc.sys = Sysclk::PLL1_P;
    config.rcc.ahb_pre = AHBPrescaler::DIV1;
    config.rcc.apb1_pre = APBPrescaler::DIV2; // 50 MHz; timers run at twice that
    config.rcc.apb2_pre = APBPrescaler::DIV1; // 100 MHz
    config
}

/// Switches prefetch and instruction cache on (RM0383 section 3.4.2); the HAL sets the wait states only. Without them
/// code runs from flash with three wait states for every eight half-words. Prefetch off is also a condition of the
/// erratum on a WFE with wait states (docs/silicon.md).
///
/// The data cache stays off: nothing flushes it after the settings are written, so it would return stale data. Code is
/// never written, so the instruction cache needs one flush only, here, where it is still off.
fn accelerate_flash() {
    let acr = pac::FLASH.acr();
    acr.modify(|w| {
        w.set_icen(false);
        w.set_dcen(false);
    });
    acr.modify(|w| w.set_icrst(true));
    acr.modify(|w| w.set_icrst(false));
    acr.modify(|w| {
        w.set_prften(true);
        w.set_icen(true);
    });
}

/// Stops TIM1 and switches its outputs off, as MOE = 0 does, when a debugger halts the core (RM0383 section 23.16.5).
/// Otherwise the prepared steps would play on.
///
/// The watchdog keeps running, so a halt ends the motion: the watchdog's reset switches the driver off within 1.5 s
/// and is latched as a fault. A frozen watchdog would leave the driver on for as long as the halt lasts, and the steps
/// would continue at full speed afterwards. TIM4 keeps running too, so that device time includes the halt.
fn stop_pulses_while_halted() {
    pac::DBGMCU.apb2fzr().modify(|w| w.set_tim1(true));
}

/// Enables the clocks of the peripherals that are used without the HAL.
fn enable_peripherals() {
    pac::RCC.ahb1enr().modify(|w| {
        w.set_gpioaen(true);
        w.set_gpioben(true);
        w.set_gpiocen(true);
        w.set_dma1en(true);
        w.set_dma2en(true);
    });
    pac::RCC.apb1enr().modify(|w| {
        w.set_tim2en(true);
        w.set_tim5en(true);
    });
    pac::RCC.apb2enr().modify(|w| {
        w.set_tim1en(true);
        w.set_syscfgen(true);
    });
    start::await_enabled_clocks();
}

fn configure_pins() {
    use pac::gpio::vals::{Moder, Pupdr};
    let pull = |pin: Pin, to| {
        port(pin).pupdr().modify(|w| w.set_pupdr(pin.number, to));
    };
    for pin in [HOME_FLAG, FAR_LIMIT, BUTTON] {
        pull(pin, Pupdr::PULL_UP);
        port(pin)
            .moder()
            .modify(|w| w.set_moder(pin.number, Moder::INPUT));
    }
    pull(ESTOP_LOOP, Pupdr::PULL_UP);
    // STEP and sync rest low while the timer does not drive them.
    for pin in [READ_BACK, CAPTURE, STEP, SYNC] {
        pull(pin, Pupdr::PULL_DOWN);
    }
    // The outputs keep their lowest speed from the reset: edges of at most 100 ns (DS10314 table 57, 50 pF) ring less
    // on the wires than fast ones, and the shortest pulse is 1 us.
    for (pin, function) in [
        (READ_BACK, AF_TIMER),
        (CAPTURE, AF_CAPTURE),
        (ESTOP_LOOP, AF_TIMER),
        (SYNC, AF_TIMER),
        (STEP, AF_TIMER),
    ] {
        port(pin)
            .afr(pin.number / 8)
            .modify(|w| w.set_afr(pin.number % 8, function));
        port(pin)
            .moder()
            .modify(|w| w.set_moder(pin.number, Moder::ALTERNATE));
    }
    // EXTI7 from port C, EXTI6 from port B, both edges.
    pac::SYSCFG.exticr(1).modify(|w| {
        w.set_exti(3, 2);
        w.set_exti(2, 1);
    });
    for line in [HOME_LINE, FAR_LINE] {
        pac::EXTI.rtsr(0).modify(|w| w.set_line(line, true));
        pac::EXTI.ftsr(0).modify(|w| w.set_line(line, true));
        pac::EXTI.pr(0).write(|w| w.set_line(line, true));
        pac::EXTI.imr(0).modify(|w| w.set_line(line, true));
    }
}

/// EXTI line of the home flag.
pub const HOME_LINE: usize = HOME_FLAG.number;
/// EXTI line of the far limit.
pub const FAR_LINE: usize = FAR_LIMIT.number;

/// Ties `wiring::rig` to the names used below: the HAL's pins, and the ports that the switches' EXTI lines select.
const _: () = assert!(
    LED.is('A', 5)
        && SERIAL[0].is('A', 2)
        && SERIAL[1].is('A', 3)
        && HOME_FLAG.is('C', 7)
        && FAR_LIMIT.is('B', 6)
);

/// The registers of a pin's port.
const fn port(pin: Pin) -> pac::gpio::Gpio {
    match pin.port {
        'A' => pac::GPIOA,
        'B' => pac::GPIOB,
        _ => pac::GPIOC,
    }
}

/// Sets an output.
#[inline(always)]
fn set(pin: Pin, high: bool) {
    port(pin).bsrr().write(|w| {
        if high {
            w.set_bs(pin.number, true);
        } else {
            w.set_br(pin.number, true);
        }
    });
}

#[inline(always)]
fn is_high(pin: Pin) -> bool {
    port(pin).idr().read().idr(pin.number) == pac::gpio::vals::Idr::HIGH
}

/// Sets the interrupt priorities. Highest first: the break, the time base at 2 (the switch filter reads it), the
/// switches, the step ring's producer. The serial port is lowest, at 7.
fn configure_priorities() {
    interrupt::TIM1_BRK_TIM9.set_priority(Priority::P1);
    interrupt::EXTI9_5.set_priority(Priority::P3);
    interrupt::SPI5.set_priority(Priority::P6);
    // SAFETY: the handlers are in `switches.rs` and `step_generator.rs`; nothing they use is initialised later than
    // this.
    unsafe {
        interrupt::EXTI9_5.enable();
    }
}

/// No pulse, driver off. Registers only: callable from anywhere, also from a panic or a processor fault.
pub fn outputs_off() {
    pac::TIM1.bdtr().modify(|w| w.set_moe(false));
    set(ENABLE, true);
}

/// No further pulse, from this instruction on; the driver keeps holding. Registers only.
pub fn cut_pulses() {
    pac::TIM1.bdtr().modify(|w| w.set_moe(false));
}

pub fn step_is_high() -> bool {
    is_high(STEP)
}

/// Driver on: the motor holds.
pub fn enable_driver() {
    set(ENABLE, false);
}

pub fn driver_is_on() -> bool {
    port(ENABLE).odr().read().odr(ENABLE.number) == pac::gpio::vals::Odr::LOW
}

pub fn set_direction(direction: Direction) {
    set(DIR, direction == Direction::Away);
}

/// Raises the far limit's interrupt if it is open. An opening on the way home or before a start stops nothing, and
/// raises no further interrupt when the carriage turns away from home or starts.
pub fn recheck_far_limit() {
    if inputs().far_limit {
        pac::EXTI.swier(0).write(|w| w.set_line(FAR_LINE, true));
    }
}

/// DIR's present output level.
pub fn direction() -> Direction {
    match port(DIR).odr().read().odr(DIR.number) {
        pac::gpio::vals::Odr::HIGH => Direction::Away,
        pac::gpio::vals::Odr::LOW => Direction::Home,
    }
}

/// The inputs now, not filtered; true = open.
pub fn inputs() -> RigInputs {
    RigInputs {
        home_flag: is_high(HOME_FLAG),
        far_limit: is_high(FAR_LIMIT),
        estop_loop: is_high(ESTOP_LOOP),
    }
}

/// The start button is down, not filtered.
pub fn button_is_down() -> bool {
    !is_high(BUTTON)
}
