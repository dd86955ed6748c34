//! Everything that the tasks share; the only global state.

use core::{
    cell::Cell,
    sync::atomic::{AtomicU8, AtomicU16, AtomicU32},
};
use embassy_sync::{
    blocking_mutex::{Mutex, raw::CriticalSectionRawMutex as Raw},
    channel::Channel,
    signal::Signal,
};
use firmware_capsule::{detect::Sample, fold::Drive};
use protocol::{
    capsule::CapsuleTelemetry,
    frame::Encoded,
    system::Urgent,
    table::{Reply, Request},
};

/// A request for the control task.
pub(crate) enum Inbound {
    /// From the session.
    Request(Request),
    /// Valid at any time.
    Urgent(Urgent),
}

/// What the motor task should do, and how old that is.
#[derive(Clone, Copy)]
pub(crate) struct Order {
    /// What.
    pub(crate) drive: Drive,
    /// When control last confirmed it.
    pub(crate) confirmed_us: u64,
}

/// A reading with its time.
#[derive(Clone, Copy)]
pub(crate) struct Reading {
    /// When.
    pub(crate) at_us: u64,
    /// What.
    pub(crate) sample: Sample,
}

/// Fed by motor, drained by control; the newest one counts.
pub(crate) static READINGS: Signal<Raw, Reading> = Signal::new();
/// Set by control, read by motor.
pub(crate) static ORDER: Mutex<Raw, Cell<Order>> = Mutex::new(Cell::new(Order {
    drive: Drive::Off,
    confirmed_us: 0,
}));
/// Fed by control, drained by motor: the order has changed.
pub(crate) static ORDER_CHANGED: Signal<Raw, ()> = Signal::new();
/// Fed by link, drained by control; answered through [`REPLIES`].
pub(crate) static REQUESTS: Channel<Raw, Inbound, 1> = Channel::new();
/// Fed by control, drained by link.
pub(crate) static REPLIES: Signal<Raw, Reply> = Signal::new();
/// Fed by link, control and telemetry, drained by transmit.
pub(crate) static OUTBOUND: Channel<Raw, Encoded, 4> = Channel::new();
/// Set by control, read by telemetry.
pub(crate) static SNAPSHOT: Mutex<Raw, Cell<Option<CapsuleTelemetry>>> =
    Mutex::new(Cell::new(None));
/// Telemetry interval in ms, 0 = none. Set by control, read by telemetry.
pub(crate) static TELEMETRY_MS: AtomicU16 = AtomicU16::new(0);
/// Fed by control, drained by telemetry: the interval has changed.
pub(crate) static TELEMETRY_CHANGED: Signal<Raw, ()> = Signal::new();
/// Present session, for unsolicited frames. Set by link, read by control and telemetry.
pub(crate) static SESSION: AtomicU8 = AtomicU8::new(0);
/// Low 32 bits of the time of the last good frame, us. Set by link, read by control.
pub(crate) static LAST_FRAME_US: AtomicU32 = AtomicU32::new(0);
/// Check-ins of the tasks; see `watchdog.rs`.
pub(crate) static CHECK_INS: AtomicU8 = AtomicU8::new(0);
