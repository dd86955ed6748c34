//! Motor, encoder, current and battery on any board: how the bridge is driven and what belongs to a reading.

use super::{
    pins::{self, Adc, DrivePeripherals},
    timers::{self, PWM_TICKS},
};
use embassy_time::Duration;
use firmware_capsule::{
    machine::Drive,
    sample::Sample,
    sense::{FINE, Reference, Zero, millivolts},
    units::Counts,
};

/// The battery's divider is 1/2.
const BATTERY_RATIO: u32 = 2;
/// Readings per sample. The filters before both inputs leave 2 mA of the current's ripple; the readings spread over two
/// PWM periods and more, so that their mean has none of it, wherever the sample begins.
const ADC_PAIRS: u32 = 4;
/// Time from power-up of encoder and amplifier to valid levels: 0.5 ms for both, assumed, so check their data sheets; then
/// the filter behind the amplifier charges, 1 kohm and 160 nF, to 0.2 mA within nine of its time constants.
pub(crate) const SENSORS_START: Duration = Duration::from_millis(2);

/// Motor, encoder, current and battery.
pub(crate) struct DriveTrain {
    current: u8,
    battery: u8,
    reference: Reference,
    zero: Zero,
    battery_mv: u16,
}

impl DriveTrain {
    /// Without the factory's word the typical reference is used: the supply is then known to 2.5 %.
    pub(crate) fn new(adc: Adc, _: DrivePeripherals) -> Self {
        let Adc {
            current,
            battery,
            factory_word,
            factory_mv,
        } = adc;
        let reference = Reference::from_factory(factory_word, factory_mv).unwrap_or_else(|| {
            defmt::warn!(
                "no reading of the reference by the factory: {=u16}",
                factory_word
            );
            Reference::typical()
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
        pins::PULSES.set(in1, in2);
        if !pins::PULSES.run() {
            pins::wake_bridge();
        }
    }

    /// The encoder is powered and counted.
    pub(crate) fn counts(&self) -> bool {
        timers::encoder_is_counted()
    }

    /// Powers encoder and amplifier; call `count` after [`SENSORS_START`]. The counter keeps its value meanwhile: edges
    /// from switching the encoder are not counted, and the worm holds the motor.
    pub(crate) fn power_sensors(&mut self) {
        pins::power_sensors(true);
    }

    /// Starts counting; the powered encoder now gives valid levels.
    pub(crate) fn count(&mut self) {
        timers::count_encoder(true);
    }

    /// Switches encoder and amplifier off.
    pub(crate) fn cut_sensors(&mut self) {
        timers::count_encoder(false);
        pins::power_sensors(false);
    }

    /// The amplifier's zero needs another reading soon.
    pub(crate) fn doubts_zero(&self) -> bool {
        self.zero.is_doubted()
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
        pins::switch_adc_on();
        let awake = pins::PULSES.run();
        let pairs = if awake { ADC_PAIRS } else { 1 };
        let reading = pins::convert(pins::REFERENCE_CHANNEL);
        let supply_mv = self.reference.supply_mv(reading).unwrap_or(0);
        let (mut current, mut battery) = (0, 0);
        for _ in 0..pairs {
            current += u32::from(pins::convert(self.current));
            battery += u32::from(pins::convert(self.battery));
        }
        if !awake {
            pins::switch_adc_off();
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
