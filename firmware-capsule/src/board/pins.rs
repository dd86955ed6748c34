//! The board that the image is built for: pins, clocks, timers, interrupts. Only this module's file for the board names
//! them. The sequence of a reading and of a drive is in `drive_train.rs`.
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

mod stm32f411re;
pub(crate) use stm32f411re::*;

use device::chip::flash::Sectors;
use embassy_executor::InterruptExecutor;
use embassy_stm32::{
    Peri,
    mode::Async,
    peripherals,
    usart::{RingBufferedUartRx, UartTx},
    wdg::IndependentWatchdog,
};

/// Peripherals, each owned by one task.
pub(crate) struct Board {
    /// Link.
    pub(crate) serial: (UartTx<'static, Async>, RingBufferedUartRx<'static>),
    /// The sectors of calibration and totals.
    pub(crate) sectors: Sectors,
    /// The drive train's inputs.
    pub(crate) adc: Adc,
    pub(crate) drive: DrivePeripherals,
    /// Not yet started.
    pub(crate) watchdog: IndependentWatchdog<'static, peripherals::IWDG>,
}

/// The ADC's inputs, and the factory's calibration of its reference.
pub(crate) struct Adc {
    /// Channel of the motor's current.
    pub(crate) current: u8,
    /// Channel of the battery.
    pub(crate) battery: u8,
    /// The factory's reading of the reference, if it left one.
    pub(crate) factory_word: u16,
    /// Supply during the factory's reading, mV.
    pub(crate) factory_mv: u32,
}

/// What the drive train drives by registers: nothing else can have it.
pub(crate) type DrivePeripherals = (
    Peri<'static, peripherals::TIM2>,
    Peri<'static, peripherals::TIM3>,
    Peri<'static, peripherals::ADC1>,
);

/// Runs the motor's task in the board's [`MOTOR_INTERRUPT`].
pub(crate) static MOTOR_EXECUTOR: InterruptExecutor = InterruptExecutor::new();
