//! Pins of the rig's signals at the chip.

use crate::{Pin, Signal, signal};

/// Step pulses to the driver.
pub const STEP: Pin = Pin::new('A', 10);
/// Direction, high = away from home.
pub const DIR: Pin = Pin::new('B', 4);
/// Enable input of the driver: on when low.
pub const ENABLE: Pin = Pin::new('A', 9);
/// E-stop and end-of-travel loop, normally closed to ground.
pub const ESTOP_LOOP: Pin = Pin::new('A', 6);
/// Counts the pulses that leave [`STEP`].
pub const READ_BACK: Pin = Pin::new('A', 0);
/// Times the pulses that leave [`STEP`].
pub const CAPTURE: Pin = Pin::new('A', 1);
/// Home flag, normally closed to ground.
pub const HOME_FLAG: Pin = Pin::new('C', 7);
/// Far limit, normally closed to ground.
pub const FAR_LIMIT: Pin = Pin::new('B', 6);
/// A pulse at the start of each stroke.
pub const SYNC: Pin = Pin::new('A', 8);
/// Start button, low = pressed.
pub const BUTTON: Pin = Pin::new('C', 13);
/// Status LED.
pub const LED: Pin = Pin::new('A', 5);
/// Serial port, from the chip and to it.
pub const SERIAL: [Pin; 2] = [Pin::new('A', 2), Pin::new('A', 3)];

/// All signals, in the manual's order.
pub const SIGNALS: [Signal; 13] = [
    signal("STEP", STEP),
    signal("DIR", DIR),
    signal("EN", ENABLE),
    signal("E-stop and end-of-travel loop", ESTOP_LOOP),
    signal("step read-back", READ_BACK),
    signal("step timing", CAPTURE),
    signal("home flag", HOME_FLAG),
    signal("far limit", FAR_LIMIT),
    signal("stroke sync", SYNC),
    signal("start button", BUTTON),
    signal("status LED", LED),
    signal("serial, out", SERIAL[0]),
    signal("serial, in", SERIAL[1]),
];
