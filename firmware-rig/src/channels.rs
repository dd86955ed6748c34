//! Everything that tasks and interrupts share; the only global state.

use core::sync::atomic::{AtomicBool, AtomicI32, AtomicU8, AtomicU16, AtomicU32, Ordering};
use embassy_sync::{
    blocking_mutex::{Mutex, raw::CriticalSectionRawMutex as Raw},
    channel::Channel,
    signal::Signal,
};
use embassy_time::Instant;
use firmware_rig::{machine::Event, periods::Path};
use motion::axis::{Acceleration, Axis};
use protocol::{
    frame::Encoded,
    rig::RigState,
    settings::SettingKey,
    system::Urgent,
    table::{Reply, Request},
};

/// A path for the motion task.
pub struct Order {
    /// What to execute.
    pub path: Path,
    /// First and last allowed position.
    pub window: (i32, i32),
    /// Of a stop.
    pub stop_accel: Acceleration,
    /// Width of a step pulse.
    pub pulse_ticks: u16,
}

/// A request for the control task.
pub enum Inbound {
    /// From the session.
    Request(Request),
    /// Valid at any time.
    Urgent(Urgent),
}

/// What telemetry shows of the state machine.
#[derive(Clone, Copy)]
pub struct Snapshot {
    /// State.
    pub state: RigState,
    /// Ledger.
    pub residual_steps: i32,
    /// What a step is in um.
    pub axis: Axis,
}

/// Fed by interrupts and motion, drained by control.
pub static NOTICES: Channel<Raw, Event, 16> = Channel::new();
/// Fed by link, drained by control; answered through [`REPLIES`].
pub static REQUESTS: Signal<Raw, Inbound> = Signal::new();
/// Fed by control, drained by link.
pub static REPLIES: Signal<Raw, Reply> = Signal::new();
/// Fed by control, drained by motion.
pub static ORDERS: Signal<Raw, Order> = Signal::new();
/// Fed by control: decelerate. Drained by motion.
pub static STOP: AtomicBool = AtomicBool::new(false);
/// The pulses of the present path were cut. Set by interrupts, link and control; cleared by motion at a start.
pub static CUT: AtomicBool = AtomicBool::new(false);
/// Wakes motion: the ring has room, or a stop is wanted.
pub static MOTION_WAKE: Signal<Raw, ()> = Signal::new();
/// Fed by control, link and telemetry, drained by transmit.
pub static OUTBOUND: Channel<Raw, Encoded, 4> = Channel::new();
/// Set by control, read by telemetry.
pub static SNAPSHOT: Mutex<Raw, core::cell::Cell<Snapshot>> =
    Mutex::new(core::cell::Cell::new(Snapshot {
        state: RigState::Unhomed,
        residual_steps: 0,
        axis: Axis::REFERENCE,
    }));
/// Telemetry interval in ms, 0 = none. Set by control, read by telemetry.
pub static TELEMETRY_MS: AtomicU16 = AtomicU16::new(0);
/// Wakes telemetry after a change of its interval.
pub static TELEMETRY_CHANGED: Signal<Raw, ()> = Signal::new();
/// Present session, for unsolicited frames. Set by link.
pub static SESSION: AtomicU8 = AtomicU8::new(0);
/// Low 32 bits of the time of the last good frame, us. Set by link, read by control.
pub static LAST_FRAME_US: AtomicU32 = AtomicU32::new(0);
/// Position by the generator. Set by motion.
pub static COMMANDED: AtomicI32 = AtomicI32::new(0);
/// Stroke in progress. Set by motion.
pub static STROKE: AtomicU32 = AtomicU32::new(0);
/// False pulses on home flag and far limit, and when the last one was. Set by the switch interrupt.
pub static GLITCHES: [Glitches; 2] = [const { Glitches::new() }; 2];
/// How long a switch must keep its level, us. Set by control, read by the switch interrupt.
pub static SWITCH_FILTER_US: AtomicU32 = AtomicU32::new(SettingKey::SwitchFilterUs.range().default);
/// Receptions that failed, frames that were bad, frames that found the line busy. Set by link and senders.
pub static UART_ERRORS: AtomicU32 = AtomicU32::new(0);
/// See [`UART_ERRORS`].
pub static BAD_FRAMES: AtomicU32 = AtomicU32::new(0);
/// See [`UART_ERRORS`].
pub static UNSENT_FRAMES: AtomicU32 = AtomicU32::new(0);
/// Filtered state of the switches. Set by the switch interrupt and control.
pub static HOME_FLAG_OPEN: AtomicBool = AtomicBool::new(false);
/// Check-ins of the tasks; see `tasks::watchdog`.
pub static CHECK_INS: AtomicU8 = AtomicU8::new(0);

/// False pulses on one switch.
pub struct Glitches {
    count: AtomicU32,
    last_us: AtomicU32,
}

impl Glitches {
    const fn new() -> Self {
        Self {
            count: AtomicU32::new(0),
            last_us: AtomicU32::new(0),
        }
    }

    /// One more.
    pub fn add(&self) {
        self.count.fetch_add(1, Ordering::Relaxed);
        let now = Instant::now().as_micros() as u32;
        self.last_us.store(now, Ordering::Relaxed);
    }

    /// As on the wire.
    pub fn get(&self) -> protocol::rig::Glitches {
        protocol::rig::Glitches {
            count: self.count.load(Ordering::Relaxed),
            last_us: self.last_us.load(Ordering::Relaxed),
        }
    }
}

/// Sends a frame that nobody waits for, unless the line is busy.
pub fn send_if_free(frame: Encoded) {
    if OUTBOUND.try_send(frame).is_err() {
        UNSENT_FRAMES.fetch_add(1, Ordering::Relaxed);
    }
}

/// Tells motion and control that the pulses were cut.
pub fn pulses_were_cut(why: Event) {
    CUT.store(true, Ordering::Release);
    MOTION_WAKE.signal(());
    // 16 notices cannot pile up within control's 10 ms; and if one did get lost, the path's end says that it was cut.
    let _ = NOTICES.try_send(why);
}
