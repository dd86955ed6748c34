//! Pins, clocks, timers and interrupts of the capsule; the only file that names them.
//!
//! | signal | pin | peripheral |
//! |---|---|---|
//! | bridge IN1, IN2 (DRV8833 class, IN/IN) | PB4, PB5 | TIM3_CH1, TIM3_CH2, 20 kHz |
//! | bridge nSLEEP (low = asleep; pull-down on the board) | PB10 | |
//! | bridge nFAULT (low = fault) | PA8 | |
//! | encoder A, B | PA0, PA1 | TIM2 in encoder mode, 32 bit |
//! | motor current's magnitude, 1 mV per mA (README, "Shunt amplifier") | PA4 | ADC1_IN4 |
//! | battery through 1/2 | PB0 | ADC1_IN8 |
//! | supply of encoder and amplifier (high = on; pull-down on the board) | PB1 | |
//! | serial | PA2, PA3 | USART2, DMA1 streams 6 and 5 |
//!
//! Time driver: TIM4. Motor task: interrupt SPI5, whose peripheral is not used. Clock: the 16 MHz HSI for everything;
//! nothing here needs more, and the idle current is what the battery pays for.
//!
//! | IN1 | IN2 | bridge |
//! |---|---|---|
//! | 0 | 0 | motor open |
//! | 1 | 0 | winds |
//! | 0 | 1 | pays out |
//! | 1 | 1 | motor shorted |
//!
//! While driving, one input carries pulses and the other one is low: between the pulses the motor runs free. The
//! usual alternative, shorting it between the pulses, would make the mean voltage independent of the load, but needs an
//! inductance to carry the current over: this motor's winding forgets its current within some 10 us of the 50 us, and
//! would brake itself with 0.3 A in every pause, all of it from the battery.

#![allow(unsafe_code)]

use device::chip::{flash::Sectors, start, supply};
use embassy_stm32::{
    Config,
    adc::AdcChannel,
    interrupt::{self, InterruptExt, Priority},
    mode::Async,
    pac,
    pac::gpio::vals::{Moder, Pupdr},
    peripherals,
    timer::{Ch1, Ch2, TimerPin},
    usart::{RingBufferedUartRx, UartTx},
    wdg::IndependentWatchdog,
};
use embassy_time::Duration;
use firmware_capsule::{
    detect::Sample,
    fold::Drive,
    mechanics::Counts,
    sense::{Offset, Reference, microvolts, millivolts},
};

/// 16 MHz / 800 = 20 kHz.
const PWM_TICKS: u16 = 800;
/// The chip's reference (RM0383 section 11.10).
const VREFINT: u8 = 17;
/// Where the factory has left its reading of the reference (DS10314 table 75).
const FACTORY_WORD: *const u16 = 0x1FFF_7A2A as *const u16;
/// The battery's divider is 1/2.
const BATTERY_RATIO: u32 = 2;
/// Readings per sample while driving, evenly over one PWM period: their mean is the period's, wherever in it the sample begins. The
/// samples are a whole number of periods apart, so a phase that is preferred would be preferred throughout a motion.
const ADC_PAIRS: u32 = 4;
const PAIR_TICKS: u16 = PWM_TICKS / ADC_PAIRS as u16;
/// From the supply of encoder and amplifier to their first valid levels (assumed of both; ask their data sheets).
pub(crate) const SENSORS_START: Duration = Duration::from_millis(1);
/// Looks at the counter until it is there: a period at 8 cycles each, twice.
const PHASE_PATIENCE: u32 = 200;
/// How often to look for the end of a conversion. It takes 27 cycles of 8 MHz, that of the reference 124; a look takes 8 of 16 MHz.
/// Two conversions have to end within [`PAIR_TICKS`], so nothing waits longer than it must.
const ADC_PATIENCE: u32 = 200;

const ENCODER: [usize; 2] = [0, 1];
const IN1: usize = 4;
const IN2: usize = 5;
const N_SLEEP: usize = 10;
const SENSORS: usize = 1;
const N_FAULT: usize = 8;

/// What the tasks own.
pub(crate) struct Board {
    /// Link.
    pub(crate) serial: (UartTx<'static, Async>, RingBufferedUartRx<'static>),
    /// The sectors of calibration and totals.
    pub(crate) sectors: Sectors,
    /// Motor, encoder, battery.
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
    // Nothing is frozen while a debugger halts the core (DBGMCU). TIM3 has no MOE: frozen, its outputs would stay at the
    // level of that instant, and the motor could stand under full voltage. Running, they keep the last duty, and the
    // watchdog, which must not be frozen for that reason, ends it within 1.5 s.

    supply::watch();
    pac::RCC.ahb1enr().modify(|w| {
        w.set_gpioaen(true);
        w.set_gpioben(true);
    });
    pac::RCC.apb1enr().modify(|w| {
        w.set_tim2en(true);
        w.set_tim3en(true);
    });
    pac::RCC.apb2enr().modify(|w| w.set_adc1en(true));
    outputs_off();
    pac::GPIOB.moder().modify(|w| {
        w.set_moder(N_SLEEP, Moder::OUTPUT);
        w.set_moder(SENSORS, Moder::OUTPUT);
    });
    pac::GPIOA
        .pupdr()
        .modify(|w| w.set_pupdr(N_FAULT, Pupdr::PULL_UP));

    // The pin traits of the HAL prove the pairings and know the alternate functions.
    let encoder_functions = [
        TimerPin::<peripherals::TIM2, Ch1>::af_num(&*p.PA0),
        TimerPin::<peripherals::TIM2, Ch2>::af_num(&*p.PA1),
    ];
    let bridge_functions = [
        TimerPin::<peripherals::TIM3, Ch1>::af_num(&*p.PB4),
        TimerPin::<peripherals::TIM3, Ch2>::af_num(&*p.PB5),
    ];
    for (pin, function) in ENCODER.into_iter().zip(encoder_functions) {
        alternate_function(pac::GPIOA, pin, function);
        pac::GPIOA
            .moder()
            .modify(|w| w.set_moder(pin, Moder::ALTERNATE));
    }
    for (pin, function) in [IN1, IN2].into_iter().zip(bridge_functions) {
        alternate_function(pac::GPIOB, pin, function);
    }
    // Sets the pins to analogue as well.
    let current = AdcChannel::<peripherals::ADC1>::degrade_adc(p.PA4).get_hw_channel();
    let battery = AdcChannel::<peripherals::ADC1>::degrade_adc(p.PB0).get_hw_channel();
    configure_encoder();
    configure_pwm();
    configure_adc(current, battery);

    // The motor's control runs above the serial port (7), the time base above both (2).
    interrupt::SPI5.set_priority(Priority::P6);
    Board {
        serial: start::open_serial(p.USART2, p.PA3, p.PA2, p.DMA1_CH6, p.DMA1_CH5),
        sectors: Sectors::new(p.FLASH),
        drive_train: DriveTrain {
            current,
            battery,
            reference: reference(),
            offset: Offset::default(),
            battery_mv: 0,
        },
        watchdog: start::watchdog(p.IWDG),
    }
}

fn alternate_function(port: pac::gpio::Gpio, pin: usize, function: u8) {
    port.afr(pin / 8).modify(|w| w.set_afr(pin % 8, function));
}

/// Counts all four edges of A and B, over the full 32 bits (RM0383 section 13.3.12). The inputs are filtered over
/// 8 clocks, 0.5 us; the motor's fastest edges are 57 us apart.
fn configure_encoder() {
    use pac::timer::vals::{CcmrInputCcs, FilterValue, Sms};
    for pin in ENCODER {
        pac::GPIOA
            .pupdr()
            .modify(|w| w.set_pupdr(pin, Pupdr::PULL_UP));
    }
    pac::TIM2.ccmr_input(0).modify(|w| {
        for channel in [0, 1] {
            w.set_ccs(channel, CcmrInputCcs::TI4);
            w.set_icf(channel, FilterValue::FCK_INT_N8);
        }
    });
    pac::TIM2.smcr().modify(|w| w.set_sms(Sms::ENCODER_MODE_3));
    // It counts only while the encoder is powered.
    pac::TIM2.arr().write_value(u32::MAX);
}

fn configure_pwm() {
    use pac::timer::vals::Ocm;
    pac::TIM3.psc().write_value(0);
    pac::TIM3.arr().write(|w| w.set_arr(PWM_TICKS - 1));
    pac::TIM3.ccmr_output(0).modify(|w| {
        for channel in [0, 1] {
            w.set_ocm(channel, Ocm::PWM_MODE1);
            w.set_ocpe(channel, true); // a new duty begins with a period
        }
    });
    pac::TIM3.ccer().modify(|w| {
        w.set_cce(0, true);
        w.set_cce(1, true);
    });
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
        .modify(|w| w.set_smp(usize::from(VREFINT - 10), SampleTime::CYCLES112));
    pac::ADC1.smpr2().modify(|w| {
        for channel in [current, battery] {
            w.set_smp(usize::from(channel), SampleTime::CYCLES15);
        }
    });
}

/// The chip's reference. A chip without the factory's word still tells its supply to 2.5 %.
fn reference() -> Reference {
    // SAFETY: a half-word of the chip's system memory, which can always be read.
    let word = unsafe { FACTORY_WORD.read_volatile() };
    Reference::from_factory(word).unwrap_or_else(|| {
        defmt::warn!("no reading of the reference by the factory: {=u16}", word);
        Reference::typical()
    })
}

/// Bridge asleep, motor open. Registers only: callable from anywhere, also from a panic or a processor fault.
pub(crate) fn outputs_off() {
    pac::GPIOB.bsrr().write(|w| {
        w.set_br(N_SLEEP, true);
        w.set_br(IN1, true);
        w.set_br(IN2, true);
    });
    pac::GPIOB.moder().modify(|w| {
        w.set_moder(IN1, Moder::OUTPUT);
        w.set_moder(IN2, Moder::OUTPUT);
    });
    pac::TIM3.cr1().modify(|w| w.set_cen(false));
}

/// Motor, encoder, current and battery.
pub(crate) struct DriveTrain {
    current: u8,
    battery: u8,
    reference: Reference,
    offset: Offset,
    battery_mv: u16,
}

impl DriveTrain {
    /// Sets the bridge. The duty comes from the last battery reading.
    pub(crate) fn set(&mut self, drive: Drive) {
        let (in1, in2) = match drive {
            Drive::Off => return outputs_off(),
            Drive::Brake => (PWM_TICKS, PWM_TICKS),
            Drive::Millivolts(millivolts) if millivolts >= 0 => (self.pulse(millivolts), 0),
            Drive::Millivolts(millivolts) => (0, self.pulse(millivolts)),
        };
        pac::TIM3.ccr(0).write(|w| w.set_ccr(in1));
        pac::TIM3.ccr(1).write(|w| w.set_ccr(in2));
        if !pac::TIM3.cr1().read().cen() {
            pac::TIM3.egr().write(|w| w.set_ug(true));
            pac::TIM3.cr1().modify(|w| w.set_cen(true));
            pac::GPIOB.moder().modify(|w| {
                w.set_moder(IN1, Moder::ALTERNATE);
                w.set_moder(IN2, Moder::ALTERNATE);
            });
            pac::GPIOB.bsrr().write(|w| w.set_bs(N_SLEEP, true));
        }
    }

    /// The encoder is powered and counted.
    pub(crate) fn counts(&self) -> bool {
        pac::TIM2.cr1().read().cen()
    }

    /// Powers encoder and amplifier, and counts after [`SENSORS_START`]. The counter keeps its value without them: the lines
    /// of an encoder that goes off or comes on are not counted, and the worm holds the motor meanwhile.
    pub(crate) fn power_sensors(&mut self) {
        pac::GPIOB.bsrr().write(|w| w.set_bs(SENSORS, true));
    }

    /// Counts from here: the powered encoder shows its lines.
    pub(crate) fn count(&mut self) {
        pac::TIM2.cr1().modify(|w| w.set_cen(true));
    }

    /// Switches encoder and amplifier off.
    pub(crate) fn cut_sensors(&mut self) {
        pac::TIM2.cr1().modify(|w| w.set_cen(false));
        pac::GPIOB.bsrr().write(|w| w.set_br(SENSORS, true));
    }

    /// Length of the pulse that is this share of the battery. No battery reading: no drive.
    fn pulse(&self, millivolts: i16) -> u16 {
        let full = u32::from(PWM_TICKS);
        let ticks = u32::from(millivolts.unsigned_abs()) * full;
        let ticks = ticks.checked_div(u32::from(self.battery_mv));
        ticks.map_or(0, |ticks| ticks.min(full) as u16)
    }

    /// Reads everything. nFAULT means nothing while the bridge sleeps.
    ///
    /// Without a supply that can be, the battery reads 0 mV: no drive, and refused as empty.
    pub(crate) fn sample(&mut self, now_us: u64) -> Sample {
        pac::ADC1.cr2().modify(|w| w.set_adon(true));
        // 3 us to power up (DS9716 section 6.3.20).
        cortex_m::asm::delay(48);
        let awake = pac::TIM3.cr1().read().cen();
        let pairs = if awake { ADC_PAIRS } else { 1 };
        let supply_mv = self.reference.supply_mv(convert(VREFINT)).unwrap_or(0);
        let (mut current, mut battery) = (0, 0);
        let began = pac::TIM3.cnt().read().cnt();
        for pair in 0..pairs as u16 {
            if awake {
                await_phase(began, pair * PAIR_TICKS);
            }
            current += u32::from(convert(self.current));
            battery += u32::from(convert(self.battery));
        }
        if !awake {
            pac::ADC1.cr2().modify(|w| w.set_adon(false));
        }
        let battery_mv = millivolts(battery, pairs, supply_mv) * BATTERY_RATIO;
        let reading_ua = microvolts(current, pairs, supply_mv); // 1 uV per uA
        let current_ua = self.offset.take_off(now_us, awake, reading_ua);
        self.battery_mv = u16::try_from(battery_mv).unwrap_or(u16::MAX);
        Sample {
            counts: Counts(pac::TIM2.cnt().read() as i32),
            current_ma: u16::try_from((current_ua + 500) / 1_000).unwrap_or(u16::MAX),
            current_ua,
            offset_ma: self.offset.offset_ma(),
            battery_mv: self.battery_mv,
            driver_fault: awake
                && pac::GPIOA.idr().read().idr(N_FAULT) == pac::gpio::vals::Idr::LOW,
        }
    }
}

/// Waits until the PWM's counter is so many ticks further than `began`, less than a period.
fn await_phase(began: u16, ticks: u16) {
    for _ in 0..PHASE_PATIENCE {
        let passed = (pac::TIM3.cnt().read().cnt() + PWM_TICKS - began) % PWM_TICKS;
        if passed >= ticks {
            return;
        }
    }
}

fn convert(channel: u8) -> u16 {
    pac::ADC1.sqr3().write(|w| w.set_sq(0, channel));
    pac::ADC1.sr().modify(|w| w.set_eoc(false));
    pac::ADC1.cr2().modify(|w| w.set_swstart(true));
    for _ in 0..ADC_PATIENCE {
        if pac::ADC1.sr().read().eoc() {
            return pac::ADC1.dr().read().data();
        }
    }
    // Blind, with a motor running: outputs off, reset.
    panic!("the ADC does not finish a conversion")
}
