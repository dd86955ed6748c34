//! Motor, encoder, current and battery: how the bridge is driven and what belongs to a reading.

use super::{
    pins,
    timers::{self, PWM_TICKS},
};
use embassy_stm32::{Peri, peripherals};
use firmware_capsule::{
    sense::{Counts, FINE, Reference, Sample, Zero, millivolts},
    speed::Drive,
};

/// The battery's divider is 1/2.
const BATTERY_RATIO: u32 = 2;
/// Readings per sample. The filters before both inputs leave 2 mA of the current's ripple; the readings spread over two
/// PWM periods and more, so that their mean has none of it, wherever the sample begins.
const ADC_PAIRS: u32 = 4;

/// What the drive train drives by registers: nothing else can have it.
type DrivePeripherals = (
    Peri<'static, peripherals::TIM2>,
    Peri<'static, peripherals::TIM3>,
    Peri<'static, peripherals::ADC1>,
);

pub(crate) struct DriveTrain {
    /// Channels of the converter.
    current: u8,
    battery: u8,
    reference: Reference,
    pub(crate) zero: Zero,
    battery_mv: u16,
}

impl DriveTrain {
    /// The drive train, with the channels of current and battery. Without the factory's word the typical reference is
    /// used: the supply is then known to 2.5 %.
    pub(crate) fn new(current: u8, battery: u8, factory_word: u16, _: DrivePeripherals) -> Self {
        let reference = Reference::from_factory(factory_word).unwrap_or_else(|| {
            defmt::warn!("no factory reading of the reference: {=u16}", factory_word);
            Reference::TYPICAL
        });
        Self {
            current,
            battery,
            reference,
            zero: Zero::default(),
            battery_mv: 0,
        }
    }

    /// Sets the bridge. The duty comes from the last battery reading.
    pub(crate) fn set(&mut self, drive: Drive) {
        let (in1, in2) = match drive {
            Drive::Off => return pins::outputs_off(),
            Drive::Brake => (PWM_TICKS, PWM_TICKS),
            Drive::Millivolts(millivolts) if millivolts >= 0 => (PWM_TICKS, self.pause(millivolts)),
            Drive::Millivolts(millivolts) => (self.pause(millivolts), PWM_TICKS),
        };
        timers::set_pulses(in1, in2);
        if !timers::pulses_run() {
            pins::wake_bridge();
        }
    }

    /// Ticks per period for which the motor is shorted, so that the rest gives this voltage. Without a battery reading
    /// there is no drive.
    fn pause(&self, millivolts: i16) -> u16 {
        let full = u32::from(PWM_TICKS);
        let battery_mv = u32::from(self.battery_mv);
        let ticks = u32::from(millivolts.unsigned_abs()) * full + battery_mv / 2;
        let pulse = ticks.checked_div(battery_mv).unwrap_or(0).min(full);
        PWM_TICKS - pulse as u16
    }

    /// Reads everything. nFAULT means nothing while the bridge sleeps.
    ///
    /// If the reference gives an impossible supply, the battery reads 0 mV: no drive, and refused as empty.
    pub(crate) fn sample(&mut self, now_us: u64) -> Sample {
        pins::switch_adc(true);
        let awake = timers::pulses_run();
        let pairs = if awake { ADC_PAIRS } else { 1 };
        let reading = pins::convert(pins::REFERENCE_CHANNEL);
        let supply_mv = self.reference.supply_mv(reading).unwrap_or(0);
        let (mut current, mut battery) = (0, 0);
        for _ in 0..pairs {
            current += u32::from(pins::convert(self.current));
            battery += u32::from(pins::convert(self.battery));
        }
        if !awake {
            pins::switch_adc(false);
        }
        let battery_mv = millivolts(battery, pairs, supply_mv) * BATTERY_RATIO;
        // At most 4,095 fine steps.
        let fine = (current * FINE as u32 / pairs) as i32;
        let current_ua = self.zero.take_off(now_us, awake, fine, supply_mv);
        self.battery_mv = u16::try_from(battery_mv).unwrap_or(u16::MAX);
        Sample {
            counts: Counts(timers::encoder_count()),
            current_ua,
            offset_ma: self.zero.offset_ma(supply_mv),
            battery_mv: self.battery_mv,
            driver_fault: awake && pins::fault_is_reported(),
        }
    }
}
