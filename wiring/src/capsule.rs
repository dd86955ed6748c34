//! Pins of the capsule's signals at the chip of the development board.

use crate::{Pin, Signal, signal};

/// Inputs of the bridge.
pub const IN1: Pin = Pin::new('B', 4);
pub const IN2: Pin = Pin::new('B', 5);
/// Sleep input of the bridge: asleep when low.
pub const N_SLEEP: Pin = Pin::new('B', 10);
/// Fault output of the bridge: low on a fault.
pub const N_FAULT: Pin = Pin::new('A', 8);
/// Lines A and B of the motor's encoder.
pub const ENCODER: [Pin; 2] = [Pin::new('A', 0), Pin::new('A', 1)];
/// Output of the current amplifier.
pub const CURRENT: Pin = Pin::new('A', 4);
/// Half the cell's voltage.
pub const BATTERY: Pin = Pin::new('B', 0);
/// Supply of encoder and amplifier, high = on.
pub const SENSORS: Pin = Pin::new('B', 1);
/// Serial port, from the chip and to it.
pub const SERIAL: [Pin; 2] = [Pin::new('A', 2), Pin::new('A', 3)];

/// All signals, in the manual's order.
pub const SIGNALS: [Signal; 11] = [
    signal("IN1", IN1),
    signal("IN2", IN2),
    signal("nSLEEP", N_SLEEP),
    signal("nFAULT", N_FAULT),
    signal("encoder A", ENCODER[0]),
    signal("encoder B", ENCODER[1]),
    signal("motor current", CURRENT),
    signal("battery", BATTERY),
    signal("sensors", SENSORS),
    signal("serial, out", SERIAL[0]),
    signal("serial, in", SERIAL[1]),
];
