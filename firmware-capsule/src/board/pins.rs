//! The board, a NUCLEO-F411RE: pins, clocks, converter, interrupts. Which signal is at which pin is
//! [`wiring::capsule`]. `drive_train.rs` has the sequence of a reading and of a drive.
//!
//! | signal | what it does |
//! |---|---|
//! | IN1, IN2 | bridge, DRV8411 class; 80 kHz while it drives |
//! | nSLEEP | low = bridge asleep; pull-down on the board |
//! | nFAULT | low = the bridge reports a fault |
//! | A, B | encoder, four edges counted over 32 bits |
//! | current | motor current with its sign, 1 mV per mA, zero at half of the supply (README, "Shunt amplifier") |
//! | battery | through 1/2, filtered |
//! | sensors | supply of encoder and amplifier; high = on; pull-down on the board |
//! | serial | 115,200 baud |
//!
//! | IN1 | IN2 | bridge |
//! |---|---|---|
//! | 0 | 0 | motor open |
//! | 1 | 0 | winds |
//! | 0 | 1 | pays out |
//! | 1 | 1 | motor shorted |
//!
//! While driving, one input is high and the other one pulses. While both are high, both low sides conduct and the
//! current circulates through them (slow decay). So the motor has the mean voltage `D V` and the mean current `(D V -
//! e) / R`, whatever its inductance. At 80 kHz the current ripples by 0.17 A at most.
//!
//! Time driver: TIM4. Motor task: interrupt SPI5, whose peripheral is not used. Clock: the 16 MHz HSI for everything;
//! nothing here needs more, and the idle current is what the battery pays for.

#![allow(unsafe_code)]

use super::{drive_train::DriveTrain, timers};
use device::chip::{flash::Sectors, serial, start, supply};
use embassy_executor::InterruptExecutor;
use embassy_stm32::{
    Config,
    adc::AdcChannel,
    interrupt::{self, InterruptExt, Priority},
    mode::Async,
    pac,
    pac::gpio::vals::{Idr, Moder, Pupdr},
    peripherals,
    timer::{Ch1, Ch2, TimerPin},
    usart::{RingBufferedUartRx, UartTx},
    wdg::IndependentWatchdog,
};

pub(crate) use interrupt::SPI5 as MOTOR_INTERRUPT;

/// The chip's reference (RM0383 section 11.10).
pub(crate) const REFERENCE_CHANNEL: u8 = 17;
/// The factory's reading of the reference at 3.3 V (DS10314 table 75).
const FACTORY_WORD: *const u16 = 0x1FFF_7A2A as *const u16;
/// Loops of [`cortex_m::asm::delay`], about three cycles of 16 MHz each, until shortly before the end of a conversion:
/// 27 cycles of 8 MHz, and 124 for the reference. Waiting costs less than polling the status register, which occupies
/// the bus.
const CONVERTS: u32 = 14;
const CONVERTS_REFERENCE: u32 = 78;
/// Maximum polls for the end after that. A poll takes 8 cycles.
const ADC_PATIENCE: u32 = 200;

/// Pins of port A.
const ENCODER: [usize; 2] = [
    at('A', wiring::capsule::ENCODER[0]),
    at('A', wiring::capsule::ENCODER[1]),
];
const N_FAULT: usize = at('A', wiring::capsule::N_FAULT);
/// Pins of port B.
const IN1: usize = at('B', wiring::capsule::IN1);
const IN2: usize = at('B', wiring::capsule::IN2);
const N_SLEEP: usize = at('B', wiring::capsule::N_SLEEP);
const SENSORS: usize = at('B', wiring::capsule::SENSORS);

/// Pins that are named by the HAL's types below.
const _: () = {
    use wiring::capsule::{BATTERY, CURRENT, ENCODER, IN1, IN2, SERIAL};
    assert!(ENCODER[0].is('A', 0) && ENCODER[1].is('A', 1));
    assert!(IN1.is('B', 4) && IN2.is('B', 5));
    assert!(CURRENT.is('A', 4) && BATTERY.is('B', 0));
    assert!(SERIAL[0].is('A', 2) && SERIAL[1].is('A', 3));
};

/// A pin's number, if it is at this port.
const fn at(port: char, pin: wiring::Pin) -> usize {
    assert!(
        pin.port == port,
        "the registers below are those of another port"
    );
    pin.number
}

/// Runs the motor's task in [`MOTOR_INTERRUPT`].
pub(crate) static MOTOR_EXECUTOR: InterruptExecutor = InterruptExecutor::new();

#[embassy_stm32::interrupt]
unsafe fn SPI5() {
    // SAFETY: called from the interrupt that the executor was started with.
    unsafe { MOTOR_EXECUTOR.on_interrupt() }
}

pub(crate) struct Board {
    pub(crate) serial: (UartTx<'static, Async>, RingBufferedUartRx<'static>),
    pub(crate) sectors: Sectors,
    pub(crate) drive_train: DriveTrain,
    /// Not yet started.
    pub(crate) watchdog: IndependentWatchdog<'static, peripherals::IWDG>,
}

/// Clocks, pins and interrupts. The bridge stays asleep.
pub(crate) fn init() -> Board {
    // Default clocks: HSI, no PLL. 16 MHz / 115200 baud is 138.9: 0.08 % off, and the HSI 1 % at most at 25 C.
    let mut config = Config::default();
    // Clocks for a debugger that stay on in sleep cost the battery. A debugger that needs them sets the bits itself.
    config.enable_debug_during_sleep = false;
    let p = start::init_clearing_stale_flags(config);
    // Flash: no wait states at 16 MHz, so prefetch and caches would save nothing, and prefetch disturbs the ADC (ES0287,
    // docs/silicon.md). They stay off.
    //
    // Freeze nothing while a debugger halts the core (DBGMCU). A frozen TIM3 would hold its outputs at that instant's
    // level (it has no MOE), perhaps the motor at full voltage. A running one keeps the last duty, until the watchdog
    // resets the chip within 1.5 s; so that must run, too.

    supply::watch();
    enable_clocks();
    outputs_off();
    // The pin traits of the HAL prove the pairings and know the alternate functions.
    configure_pins(
        [
            TimerPin::<peripherals::TIM2, Ch1>::af_num(&*p.PA0),
            TimerPin::<peripherals::TIM2, Ch2>::af_num(&*p.PA1),
        ],
        [
            TimerPin::<peripherals::TIM3, Ch1>::af_num(&*p.PB4),
            TimerPin::<peripherals::TIM3, Ch2>::af_num(&*p.PB5),
        ],
    );
    // Sets the pins to analogue as well.
    let current = AdcChannel::<peripherals::ADC1>::degrade_adc(p.PA4).get_hw_channel();
    let battery = AdcChannel::<peripherals::ADC1>::degrade_adc(p.PB0).get_hw_channel();
    timers::configure_encoder();
    timers::configure_pulses();
    configure_adc(current, battery);

    // The motor's control runs above the serial port (7), the time base above both (2).
    MOTOR_INTERRUPT.set_priority(Priority::P6);
    // SAFETY: a half-word of the chip's system memory, which can always be read.
    let factory_word = unsafe { FACTORY_WORD.read_volatile() };
    Board {
        serial: serial::open(p.USART2, p.PA3, p.PA2, p.DMA1_CH6, p.DMA1_CH5),
        sectors: Sectors::new(p.FLASH),
        drive_train: DriveTrain::new(current, battery, factory_word, (p.TIM2, p.TIM3, p.ADC1)),
        watchdog: start::watchdog(p.IWDG),
    }
}

fn enable_clocks() {
    pac::RCC.ahb1enr().modify(|w| {
        w.set_gpioaen(true);
        w.set_gpioben(true);
    });
    pac::RCC.apb1enr().modify(|w| {
        w.set_tim2en(true);
        w.set_tim3en(true);
    });
    pac::RCC.apb2enr().modify(|w| w.set_adc1en(true));
    start::await_enabled_clocks();
}

/// Inputs and outputs, with the alternate functions of the encoder's and the bridge's pins.
fn configure_pins(encoder_functions: [u8; 2], bridge_functions: [u8; 2]) {
    let alternate_function = |port: pac::gpio::Gpio, pin: usize, function: u8| {
        port.afr(pin / 8).modify(|w| w.set_afr(pin % 8, function));
    };
    pac::GPIOB.moder().modify(|w| {
        w.set_moder(N_SLEEP, Moder::OUTPUT);
        w.set_moder(SENSORS, Moder::OUTPUT);
    });
    for pin in [N_FAULT, ENCODER[0], ENCODER[1]] {
        pac::GPIOA
            .pupdr()
            .modify(|w| w.set_pupdr(pin, Pupdr::PULL_UP));
    }
    for (pin, function) in ENCODER.into_iter().zip(encoder_functions) {
        alternate_function(pac::GPIOA, pin, function);
        pac::GPIOA
            .moder()
            .modify(|w| w.set_moder(pin, Moder::ALTERNATE));
    }
    for (pin, function) in [IN1, IN2].into_iter().zip(bridge_functions) {
        alternate_function(pac::GPIOB, pin, function);
    }
}

/// 8 MHz, 15 cycles of sampling and 12 of conversion. Switched on only for a reading at rest. The reference stays on,
/// because it needs 10 us to start, and is sampled for 14 us: at least 10 us are asked for (DS10314 table 74).
fn configure_adc(current: u8, battery: u8) {
    use pac::{adc::vals::SampleTime, adccommon::vals::Adcpre};
    pac::ADC1_COMMON.ccr().modify(|w| {
        w.set_adcpre(Adcpre::DIV2);
        w.set_tsvrefe(true);
    });
    pac::ADC1
        .smpr1()
        .modify(|w| w.set_smp(usize::from(REFERENCE_CHANNEL - 10), SampleTime::CYCLES112));
    pac::ADC1.smpr2().modify(|w| {
        for channel in [current, battery] {
            w.set_smp(usize::from(channel), SampleTime::CYCLES15);
        }
    });
}

/// Bridge asleep, motor open. Registers only: callable from anywhere, also from a panic or a processor fault.
pub(crate) fn outputs_off() {
    pac::GPIOB.bsrr().write(|w| {
        w.set_br(N_SLEEP, true);
        w.set_br(IN1, true);
        w.set_br(IN2, true);
    });
    set_bridge(Moder::OUTPUT);
    timers::run_pulses(false);
}

/// Wakes the bridge, with the pulses that were set.
pub(crate) fn wake_bridge() {
    timers::run_pulses(true);
    set_bridge(Moder::ALTERNATE);
    pac::GPIOB.bsrr().write(|w| w.set_bs(N_SLEEP, true));
}

fn set_bridge(mode: Moder) {
    pac::GPIOB.moder().modify(|w| {
        w.set_moder(IN1, mode);
        w.set_moder(IN2, mode);
    });
}

/// Whether the bridge reports a fault. The pin means nothing while the bridge sleeps.
pub(crate) fn fault_is_reported() -> bool {
    pac::GPIOA.idr().read().idr(N_FAULT) == Idr::LOW
}

/// Switches encoder and amplifier.
pub(crate) fn power_sensors(on: bool) {
    pac::GPIOB.bsrr().write(|w| match on {
        true => w.set_bs(SENSORS, true),
        false => w.set_br(SENSORS, true),
    });
}

/// Switches the ADC on, and waits until it converts; or off.
pub(crate) fn switch_adc(on: bool) {
    pac::ADC1.cr2().modify(|w| w.set_adon(on));
    if on {
        // 3 us to power up (DS10314 section 6.3.20).
        cortex_m::asm::delay(48);
    }
}

/// Reads a channel.
pub(crate) fn convert(channel: u8) -> u16 {
    pac::ADC1.sqr3().write(|w| w.set_sq(0, channel));
    pac::ADC1.sr().modify(|w| w.set_eoc(false));
    pac::ADC1.cr2().modify(|w| w.set_swstart(true));
    cortex_m::asm::delay(match channel {
        REFERENCE_CHANNEL => CONVERTS_REFERENCE,
        _ => CONVERTS,
    });
    for _ in 0..ADC_PATIENCE {
        if pac::ADC1.sr().read().eoc() {
            return pac::ADC1.dr().read().data();
        }
    }
    // Without readings and with a motor running: outputs off, reset.
    panic!("the ADC does not finish a conversion")
}
