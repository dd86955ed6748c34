//! Sends a sample at the interval that the host asked for.

use crate::channels::{OUTBOUND, SESSION, SNAPSHOT, TELEMETRY_CHANGED, TELEMETRY_MS};
use core::sync::atomic::Ordering;
use embassy_futures::select::{Either, select};
use embassy_time::{Duration, Instant, Timer};
use protocol::{
    capsule::CapsuleTelemetry,
    frame::{Header, Kind, encode},
    table::Telemetry,
};

/// A sample that finds the line busy is dropped, and its number shows the gap.
#[embassy_executor::task]
pub(crate) async fn telemetry() -> ! {
    let mut seq = 0_u16;
    let mut next = Instant::now();
    loop {
        let period_ms = TELEMETRY_MS.load(Ordering::Relaxed);
        if period_ms == 0 {
            TELEMETRY_CHANGED.wait().await;
            next = Instant::now();
            continue;
        }
        next = (next + Duration::from_millis(u64::from(period_ms))).max(Instant::now());
        if let Either::Second(()) = select(Timer::at(next), TELEMETRY_CHANGED.wait()).await {
            next = Instant::now();
            continue;
        }
        let session = SESSION.load(Ordering::Relaxed);
        let Some(snapshot) = SNAPSHOT.lock(|snapshot| snapshot.get()) else {
            continue;
        };
        let sample = CapsuleTelemetry {
            time_us: Instant::now().as_micros(),
            ..snapshot
        };
        let header = Header {
            kind: Kind::Telemetry,
            session,
            seq,
        };
        seq = seq.wrapping_add(1);
        if let Ok(frame) = encode(header, &Telemetry::Capsule(sample)) {
            let _ = OUTBOUND.try_send(frame);
        }
    }
}
