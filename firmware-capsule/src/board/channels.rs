//! Everything that the capsule's tasks share beyond `device::chip::channels`; the only global state.

use core::cell::Cell;
use embassy_sync::{
    blocking_mutex::{Mutex, raw::CriticalSectionRawMutex as Raw},
    signal::Signal,
};
use firmware_capsule::{sense::Sample, speed::Drive};
use protocol::capsule::CapsuleTelemetry;

/// Control's order to the motor task, and its age.
#[derive(Clone, Copy)]
pub(crate) struct Order {
    /// Wanted drive.
    pub(crate) drive: Drive,
    /// When control last confirmed it.
    pub(crate) confirmed_us: u64,
}

/// Device time in us and what the sensors read. Fed by motor, drained by control; the newest one counts.
pub(crate) static READINGS: Signal<Raw, (u64, Sample)> = Signal::new();
/// Set by control, read by motor.
pub(crate) static ORDER: Mutex<Raw, Cell<Order>> = Mutex::new(Cell::new(Order {
    drive: Drive::Off,
    confirmed_us: 0,
}));
/// Fed by control, drained by motor: the order has changed.
pub(crate) static ORDER_CHANGED: Signal<Raw, ()> = Signal::new();
/// Set by control, read by telemetry.
pub(crate) static SNAPSHOT: Mutex<Raw, Cell<Option<CapsuleTelemetry>>> =
    Mutex::new(Cell::new(None));
