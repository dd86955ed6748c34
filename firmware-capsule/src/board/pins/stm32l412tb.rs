//! A board with an STM32L412TB, which is 2.6 x 3.1 mm. Nobody has one: this compiles, and has not run.
//!
//! | signal | pin | peripheral |
//! |---|---|---|
//! | IN1, IN2 | PA8, PA9 | TIM1_CH1, TIM1_CH2 |
//! | nSLEEP | PB6 | |
//! | nFAULT | PA6 | could be TIM1_BKIN |
//! | A, B | PA0, PA1 | TIM2 in encoder mode |
//! | current | PA4 | ADC1_IN9 |
//! | battery | PB0 | ADC1_IN15 |
//! | sensors | PB1 | |
//! | serial | PA2, PA3 | LPUART1, DMA2 channels 6 and 7 |
//!
//! Time driver: TIM15. Motor task: interrupt SPI1, whose peripheral is not used. Clock: the 16 MHz HSI for everything, as on the other
//! board, so that all times in ticks are the same.
//!
//! TIM1's break is not used. The bridge switches itself off when it reports a fault; a motor that the break had stopped would be called
//! `BridgeSilent`, and nFAULT, which means nothing while the bridge sleeps, would have to be masked while it wakes.

#![allow(unsafe_code)]

use super::{Adc, Board, MOTOR_EXECUTOR};
use crate::board::timers::{self, Pulses};
use device::chip::{
    flash::{self, Sectors},
    serial, start, supply,
};
use embassy_stm32::{
    Config,
    adc::AdcChannel,
    interrupt::{self, InterruptExt, Priority},
    pac,
    pac::gpio::vals::{Moder, Pupdr},
    peripherals,
    rcc::{Sysclk, mux::Lpuart1sel},
    timer::{Ch1, Ch2, TimerPin},
};

pub(crate) use interrupt::SPI1 as MOTOR_INTERRUPT;

/// The chip's reference: ADC1_IN0 (RM0394, ADC channels).
pub(crate) const REFERENCE_CHANNEL: u8 = 0;
/// Where the factory has left its reading of the reference, and the supply that it had then (DS12469, internal voltage reference).
const FACTORY_WORD: *const u16 = 0x1FFF_75AA as *const u16;
const FACTORY_MV: u32 = 3_000;
/// How often to look for the end of a conversion. It takes 25 cycles of 8 MHz, that of the reference 105; a look takes 8 of 16 MHz.
/// Nothing waits longer than it must.
const ADC_PATIENCE: u32 = 200;
/// How often to look whether the ADC is calibrated, on or off: some 120 of its cycles at most.
const ADC_SWITCH_PATIENCE: u32 = 1_000;

/// Of the bridge's pulses.
// SAFETY: TIM1 has the registers of a general-purpose timer, and more.
pub(crate) const PULSES: Pulses =
    Pulses(unsafe { pac::timer::TimGp16::from_ptr(pac::TIM1.as_ptr()) });

const ENCODER: [usize; 2] = [0, 1];
const IN1: usize = 8;
const IN2: usize = 9;
const N_SLEEP: usize = 6;
const SENSORS: usize = 1;
const N_FAULT: usize = 6;

#[embassy_stm32::interrupt]
unsafe fn SPI1() {
    // SAFETY: called from the interrupt that the executor was started with.
    unsafe { MOTOR_EXECUTOR.on_interrupt() }
}

/// A double word of the flash whose check code does not fit.
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() {
    if !flash::explains_the_nmi() {
        outputs_off();
        flash::die_of_a_damaged_image()
    }
}

/// Clocks, pins and interrupts. The bridge stays asleep.
pub(crate) fn init() -> Board {
    let mut config = Config::default();
    // The HSI for everything: no PLL, no MSI, no clock for USB. No wait states at 16 MHz in voltage range 1, which is that after a reset.
    config.rcc.hsi = true;
    config.rcc.msi = None;
    config.rcc.hsi48 = None;
    config.rcc.sys = Sysclk::HSI;
    config.rcc.mux.lpuart1sel = Lpuart1sel::HSI;
    config.enable_debug_during_sleep = false;
    let p = start::init_clearing_stale_flags(config);

    supply::watch();
    pac::RCC.ahb2enr().modify(|w| {
        w.set_gpioaen(true);
        w.set_gpioben(true);
        w.set_adcen(true);
    });
    pac::RCC.apb1enr1().modify(|w| w.set_tim2en(true));
    pac::RCC.apb2enr().modify(|w| w.set_tim1en(true));
    start::let_clocks_come();
    outputs_off();
    pac::GPIOB.moder().modify(|w| {
        w.set_moder(N_SLEEP, Moder::OUTPUT);
        w.set_moder(SENSORS, Moder::OUTPUT);
    });
    pac::GPIOA
        .pupdr()
        .modify(|w| w.set_pupdr(N_FAULT, Pupdr::PULL_UP));
    pac::GPIOA
        .moder()
        .modify(|w| w.set_moder(N_FAULT, Moder::INPUT));

    // The pin traits of the HAL prove the pairings and know the alternate functions.
    let functions = [
        (
            ENCODER[0],
            TimerPin::<peripherals::TIM2, Ch1>::af_num(&*p.PA0),
        ),
        (
            ENCODER[1],
            TimerPin::<peripherals::TIM2, Ch2>::af_num(&*p.PA1),
        ),
        (IN1, TimerPin::<peripherals::TIM1, Ch1>::af_num(&*p.PA8)),
        (IN2, TimerPin::<peripherals::TIM1, Ch2>::af_num(&*p.PA9)),
    ];
    for (pin, function) in functions {
        pac::GPIOA
            .afr(pin / 8)
            .modify(|w| w.set_afr(pin % 8, function));
    }
    // Sets the pins to analogue as well.
    let current = AdcChannel::<peripherals::ADC1>::degrade_adc(p.PA4).get_hw_channel();
    let battery = AdcChannel::<peripherals::ADC1>::degrade_adc(p.PB0).get_hw_channel();
    for pin in ENCODER {
        pac::GPIOA
            .pupdr()
            .modify(|w| w.set_pupdr(pin, Pupdr::PULL_UP));
        pac::GPIOA
            .moder()
            .modify(|w| w.set_moder(pin, Moder::ALTERNATE));
    }
    // TIM2 needs the 16 MHz, which run as long as nothing stops; LPTIM1 would count in stop mode, to 16 bits.
    timers::configure_encoder();
    PULSES.configure();
    configure_adc(current, battery);

    // The motor's control runs above the serial port (7), the time base above both (2).
    MOTOR_INTERRUPT.set_priority(Priority::P6);
    // SAFETY: a half-word of the chip's system memory, which can always be read.
    let factory_word = unsafe { FACTORY_WORD.read_volatile() };
    Board {
        serial: serial::open(p.LPUART1, p.PA3, p.PA2, p.DMA2_CH6, p.DMA2_CH7),
        sectors: Sectors::new(p.FLASH),
        adc: Adc {
            current,
            battery,
            factory_word,
            factory_mv: FACTORY_MV,
        },
        watchdog: start::watchdog(p.IWDG),
    }
}

/// 8 MHz, 12.5 cycles of sampling and 12.5 of conversion. Its regulator and the reference stay on, because they need 20 us and 12 us to
/// start (DS12469, ADC characteristics and internal voltage reference); the ADC is on only for a reading. The reference is sampled
/// for 11.6 us: at least 4 us are asked for.
fn configure_adc(current: u8, battery: u8) {
    use pac::adc::vals::SampleTime;
    pac::ADC12_COMMON.ccr().modify(|w| {
        w.set_ckmode(0b10); // the bus clock, halved
        w.set_vrefen(true);
    });
    pac::ADC1.cr().write(|w| w.set_deeppwd(false));
    order_adc(|_| ());
    cortex_m::asm::delay(2 * 20 * 16);
    let sampled = [
        (REFERENCE_CHANNEL, SampleTime::CYCLES92_5),
        (current, SampleTime::CYCLES12_5),
        (battery, SampleTime::CYCLES12_5),
    ];
    for (channel, time) in sampled {
        let channel = usize::from(channel);
        pac::ADC1
            .smpr(channel / 10)
            .modify(|w| w.set_smp(channel % 10, time));
    }
    order_adc(|w| w.set_adcal(true));
    await_adc(|| !pac::ADC1.cr().read().adcal());
}

/// Bridge asleep, motor open. Registers only: callable from anywhere, also from a panic or a processor fault.
pub(crate) fn outputs_off() {
    pac::GPIOB.bsrr().write(|w| w.set_br(N_SLEEP, true));
    pac::GPIOA.bsrr().write(|w| {
        w.set_br(IN1, true);
        w.set_br(IN2, true);
    });
    pac::GPIOA.moder().modify(|w| {
        w.set_moder(IN1, Moder::OUTPUT);
        w.set_moder(IN2, Moder::OUTPUT);
    });
    pac::TIM1.bdtr().modify(|w| w.set_moe(false));
    PULSES.stop();
}

/// Wakes the bridge, with the pulses that were set.
pub(crate) fn wake_bridge() {
    PULSES.start();
    pac::TIM1.bdtr().modify(|w| w.set_moe(true));
    pac::GPIOA.moder().modify(|w| {
        w.set_moder(IN1, Moder::ALTERNATE);
        w.set_moder(IN2, Moder::ALTERNATE);
    });
    pac::GPIOB.bsrr().write(|w| w.set_bs(N_SLEEP, true));
}

/// The bridge reports a fault. Means nothing while it sleeps.
pub(crate) fn fault_is_reported() -> bool {
    pac::GPIOA.idr().read().idr(N_FAULT) == pac::gpio::vals::Idr::LOW
}

/// Switches encoder and amplifier.
pub(crate) fn power_sensors(on: bool) {
    pac::GPIOB.bsrr().write(|w| {
        if on {
            w.set_bs(SENSORS, true);
        } else {
            w.set_br(SENSORS, true);
        }
    });
}

/// Switches the ADC on, and waits until it converts. It may be on.
pub(crate) fn switch_adc_on() {
    if pac::ADC1.cr().read().aden() {
        return;
    }
    pac::ADC1.isr().write(|w| w.set_adrdy(true));
    order_adc(|w| w.set_aden(true));
    await_adc(|| pac::ADC1.isr().read().adrdy());
}

/// Switches the ADC off.
pub(crate) fn switch_adc_off() {
    order_adc(|w| w.set_addis(true));
    await_adc(|| !pac::ADC1.cr().read().aden());
}

/// Sets a bit of ADC_CR, the regulator on. Bits that the ADC clears by itself keep their state when written as 0, and must not be
/// repeated (RM0394, ADC_CR).
fn order_adc(bit: impl Fn(&mut pac::adc::regs::Cr)) {
    pac::ADC1.cr().write(|w| {
        w.set_advregen(true);
        bit(w);
    });
}

fn await_adc(done: impl Fn() -> bool) {
    if !(0..ADC_SWITCH_PATIENCE).any(|_| done()) {
        panic!("the ADC is neither on nor off")
    }
}

/// Reads a channel.
pub(crate) fn convert(channel: u8) -> u16 {
    pac::ADC1.sqr1().write(|w| w.set_sq(0, channel));
    pac::ADC1.isr().write(|w| w.set_eoc(true));
    order_adc(|w| w.set_adstart(true));
    for _ in 0..ADC_PATIENCE {
        if pac::ADC1.isr().read().eoc() {
            return pac::ADC1.dr().read().regular_data();
        }
    }
    // Blind, with a motor running: outputs off, reset.
    panic!("the ADC does not finish a conversion")
}
