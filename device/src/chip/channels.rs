//! Channels and counters shared by the tasks of both images. Each image adds its own in its `channels.rs`.

use crate::{service::Inbound, supervision::CheckIns};
use core::sync::atomic::{AtomicU8, AtomicU16, AtomicU32, Ordering};
use embassy_sync::{
    blocking_mutex::raw::CriticalSectionRawMutex as Raw, channel::Channel, signal::Signal,
};
use protocol::{
    frame::{Encoded, Header, Kind, encode},
    system::Event,
    table::Reply,
};

/// Fed by link, drained by control; answered through [`REPLIES`].
pub static REQUESTS: Signal<Raw, Inbound> = Signal::new();
/// Fed by control, drained by link.
pub static REPLIES: Signal<Raw, Reply> = Signal::new();
/// Fed by control, link and telemetry, drained by transmit.
pub static OUTBOUND: Channel<Raw, Encoded, 4> = Channel::new();
/// Interval of telemetry in ms, 0 = none. Set by control, read by telemetry.
pub static TELEMETRY_MS: AtomicU16 = AtomicU16::new(0);
/// Wakes telemetry after a change of its interval.
pub static TELEMETRY_CHANGED: Signal<Raw, ()> = Signal::new();
/// Present session, for unsolicited frames. Set by link.
pub static SESSION: AtomicU8 = AtomicU8::new(0);
/// Low 32 bits of the time when the host that began the motion was last heard, us. Set by link, read by control.
pub static LAST_HEARD_US: AtomicU32 = AtomicU32::new(0);
/// Receptions that failed. Set by link.
pub static UART_ERRORS: AtomicU32 = AtomicU32::new(0);
/// Byte blocks that failed frame validation. Set by link.
pub static BAD_FRAMES: AtomicU32 = AtomicU32::new(0);
/// Frames that found the line busy. Set by their senders.
pub static UNSENT_FRAMES: AtomicU32 = AtomicU32::new(0);
/// Check-ins for the watchdog. Set by the clients, cleared by the watchdog's task.
pub static CHECK_INS: CheckIns = CheckIns::new();

/// Sends an unsolicited frame, unless the line is busy.
pub fn send_if_free(frame: Encoded) {
    if OUTBOUND.try_send(frame).is_err() {
        UNSENT_FRAMES.fetch_add(1, Ordering::Relaxed);
    }
}

/// Sends an event to the host, if one listens. The frame is lost when the line is busy; the host then fetches the
/// event by its index.
pub fn send_event(event: &Event) {
    let session = SESSION.load(Ordering::Relaxed);
    if session == 0 {
        return; // no host listens; the event stays in the ring
    }
    let header = Header {
        kind: Kind::Event,
        session,
        seq: event.index as u16,
    };
    if let Ok(frame) = encode(header, event) {
        send_if_free(frame);
    }
}
