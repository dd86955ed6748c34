//! The capsule's wiring: the same chip, an H-bridge, an encoder and two voltages.
//!
//! | pin | signal | electrically |
//! |---|---|---|
//! | PB4, PB5 | IN1, IN2 of the bridge | TIM3_CH1 and CH2 as AF2, or plain outputs; the bridge pulls both low |
//! | PB10 | nSLEEP | plain output; the bridge pulls it low |
//! | PA8 | nFAULT | open drain, high through the chip's pull-up |
//! | PA0, PA1 | encoder A, B | TIM2 in encoder mode, AF1 |
//! | PA4 | motor current | ADC1 channel 4, 1 mV per mA, zero at half of the supply |
//! | PB0 | battery | ADC1 channel 8, half its voltage |
//! | PB1 | supply of encoder and amplifier | plain output; the board pulls it low |
//! | VDD, VDDA | a linear regulator's 3.3 V, or less from an empty battery | supply, and reference of ADC1 |

use std::path::PathBuf;

use crate::bench::{Bench, BenchError, BenchOptions, images};
use crate::emulator::{ChipOptions, Pads, Pin, Wiring};
use crate::plants::capsule::{Capsule, Parameters};

const IN1: Pin = Pin::new('B', 4);
const IN2: Pin = Pin::new('B', 5);
const SLEEP: Pin = Pin::new('B', 10);
const SENSORS: Pin = Pin::new('B', 1);
const FAULT: Pin = Pin::new('A', 8);
const ENCODER: [Pin; 2] = [Pin::new('A', 0), Pin::new('A', 1)];
const CURRENT: (Pin, u8) = (Pin::new('A', 4), 4);
const BATTERY: (Pin, u8) = (Pin::new('B', 0), 8);
/// Delay from supply to valid outputs of encoder and amplifier, ns [assumed].
const SENSORS_START_NS: u64 = 500_000;
/// Time constant of the filter between the amplifier and its input, ns: 1 kohm and 160 nF (docs/capsule.md, wire 5).
const FILTER_NS: f64 = 160_000.0;
/// Time after which the filter is charged to within the converter's resolution, ns.
const CHARGED_NS: u64 = 1_600_000;
/// Interval between updates of its voltage until then, ns.
const CHARGE_STEP_NS: u64 = 20_000;
/// The alternate functions for TIM3 and TIM2 (DS10314 table 9).
const AF_BRIDGE: Option<u8> = Some(2);
const AF_ENCODER: Option<u8> = Some(1);

/// The board with the capsule's mechanics on it.
#[derive(Debug)]
pub struct CapsuleBoard {
    pub capsule: Capsule,
    inputs: [bool; 2],
    encoder: [Option<bool>; 2],
    fault: Option<bool>,
    voltages: [Option<u32>; 2],
    supply_mv: Option<u32>,
    sensors: Sensors,
}

/// Encoder and amplifier, which are powered by a pin.
#[derive(Clone, Copy, Debug, Default)]
struct Sensors {
    since_ns: Option<u64>,
    powered_ns: u64,
}

impl Sensors {
    fn power(&mut self, at_ns: u64, on: bool) {
        match self.since_ns {
            None if on => self.since_ns = Some(at_ns),
            Some(since_ns) if !on => {
                self.powered_ns += at_ns - since_ns;
                self.since_ns = None;
            }
            _ => {}
        }
    }

    /// When their outputs become valid.
    fn valid_from_ns(&self) -> Option<u64> {
        self.since_ns.map(|since_ns| since_ns + SENSORS_START_NS)
    }

    fn are_valid(&self, at_ns: u64) -> bool {
        self.valid_ns(at_ns).is_some()
    }

    /// For how long the outputs have been valid.
    fn valid_ns(&self, at_ns: u64) -> Option<u64> {
        at_ns.checked_sub(self.valid_from_ns()?)
    }

    /// Fraction of the amplifier's voltage to which the filter has charged, from zero.
    fn charge(&self, at_ns: u64) -> f64 {
        let valid_ns = self.valid_ns(at_ns).unwrap_or(0);
        1.0 - (-(valid_ns as f64) / FILTER_NS).exp()
    }

    /// When outputs or filter change next.
    fn next_ns(&self, at_ns: u64) -> Option<u64> {
        match self.valid_ns(at_ns) {
            None => self.valid_from_ns(),
            Some(valid_ns) => (valid_ns < CHARGED_NS).then_some(at_ns + CHARGE_STEP_NS),
        }
    }
}

impl CapsuleBoard {
    /// `capsule` on its board.
    #[must_use]
    pub fn new(capsule: Capsule) -> Self {
        Self {
            capsule,
            inputs: [false; 2],
            encoder: [None; 2],
            fault: None,
            voltages: [None; 2],
            supply_mv: None,
            sensors: Sensors::default(),
        }
    }

    /// Total time until `now_ns` for which encoder and amplifier were powered, ns.
    #[must_use]
    pub fn sensors_powered_ns(&self, now_ns: u64) -> u64 {
        let present = self
            .sensors
            .since_ns
            .map_or(0, |since_ns| now_ns - since_ns);
        self.sensors.powered_ns + present
    }

    /// Advances the mechanics to `at_ns` and passes the encoder's edges to the chip.
    fn advance(&mut self, at_ns: u64, pads: &mut Pads<'_>) {
        let (encoder, valid) = (&mut self.encoder, self.sensors.are_valid(at_ns));
        self.capsule.advance(at_ns, |(a, b), at_ns| {
            if valid {
                drive_encoder(encoder, [a, b], at_ns, pads);
            }
        });
    }

    fn drive_bridge(&mut self, awake: bool) {
        self.capsule.drive(awake, self.inputs[0], self.inputs[1]);
    }
}

fn drive_encoder(
    driven: &mut [Option<bool>; 2],
    levels: [bool; 2],
    at_ns: u64,
    pads: &mut Pads<'_>,
) {
    for (channel, ((level, pin), known)) in
        (1_u8..).zip(levels.into_iter().zip(ENCODER).zip(driven))
    {
        let seen = level && pads.function(pin) == AF_ENCODER;
        if known.replace(seen) != Some(seen) {
            pads.drive_tim2_input(channel, seen, at_ns);
        }
    }
}

impl Wiring for CapsuleBoard {
    fn restarted(&mut self) {
        self.encoder = [None; 2];
        self.fault = None;
        self.voltages = [None; 2];
        self.supply_mv = None;
        self.sensors.since_ns = None;
    }

    fn update(&mut self, pads: &mut Pads<'_>) {
        let now_ns = pads.now_ns();
        let by_timer = [IN1, IN2].map(|pin| pads.function(pin) == AF_BRIDGE);
        let awake = pads.output(SLEEP).unwrap_or(false);
        for edge in pads.take_tim3_edges() {
            let input = usize::from(edge.channel - 1);
            if by_timer[input] && self.inputs[input] != edge.high {
                self.advance(edge.at_ns, pads);
                self.inputs[input] = edge.high;
                let was_awake = self.capsule.is_awake();
                self.drive_bridge(was_awake);
            }
        }
        self.advance(now_ns, pads);
        for (input, pin) in [IN1, IN2].into_iter().enumerate() {
            self.inputs[input] = if by_timer[input] {
                pads.tim3_high(input as u8 + 1)
            } else {
                pads.output(pin).unwrap_or(false)
            };
        }
        self.drive_bridge(awake);
        self.sensors
            .power(now_ns, pads.output(SENSORS).unwrap_or(false));
        let valid = self.sensors.are_valid(now_ns);
        // Outputs that are not valid float, and the chip's pull-ups hold them high.
        let (a, b) = if valid {
            self.capsule.encoder()
        } else {
            (true, true)
        };
        drive_encoder(&mut self.encoder, [a, b], now_ns, pads);
        let sound = self.capsule.fault_high();
        if self.fault.replace(sound) != Some(sound) {
            pads.drive(FAULT, (!sound).then_some(false));
        }
        let voltages = [
            (
                CURRENT,
                self.capsule.sense_mv() * self.sensors.charge(now_ns),
            ),
            (BATTERY, self.capsule.battery_mv()),
        ];
        for (((pin, channel), mv), known) in voltages.into_iter().zip(&mut self.voltages) {
            let mv = if pads.is_analog(pin) {
                mv.round() as u32
            } else {
                0
            };
            if known.replace(mv) != Some(mv) {
                pads.set_adc_mv(channel, mv);
            }
        }
        let supply_mv = self.capsule.supply_mv().round() as u32;
        if self.supply_mv.replace(supply_mv) != Some(supply_mv) {
            pads.set_supply_mv(supply_mv);
        }
        let sensors = self.sensors.next_ns(now_ns);
        if let Some(next_ns) = self.capsule.next_ns().into_iter().chain(sensors).min() {
            pads.wake_at(next_ns);
        }
    }

    fn flash_began(&mut self, erases: bool) {
        self.capsule.flash_began(erases);
    }

    /// The bridge pulls its inputs low, so the motor coasts.
    fn powered_off(&mut self) {
        self.inputs = [false; 2];
        self.drive_bridge(false);
    }
}

/// Path of the capsule's image.
#[must_use]
pub fn image() -> PathBuf {
    images().join("firmware-capsule")
}

/// Instructions per second at 16 MHz: 65 per 100 cycles, as a 100 MHz chip executes with wait states.
pub const INSTRUCTIONS_PER_SECOND: u64 = 10_400_000;

/// How the capsule's image runs.
#[must_use]
pub fn options() -> BenchOptions {
    let mut options = BenchOptions::new(image());
    // The capsule runs on the 16 MHz oscillator.
    options.chip = ChipOptions {
        core_hz: 16_000_000,
        instructions_per_second: INSTRUCTIONS_PER_SECOND,
        uid: *b"virtual caps",
        ..ChipOptions::default()
    };
    options
}

/// Starts a capsule on the bench with the image that would be flashed.
///
/// # Errors
/// A missing or unusable image.
pub fn start(capsule: Parameters) -> Result<Bench<CapsuleBoard>, BenchError> {
    Bench::start(CapsuleBoard::new(Capsule::new(capsule)), options())
}
