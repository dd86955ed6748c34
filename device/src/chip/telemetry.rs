//! Sends a sample at the interval that the host asked for.

use super::channels::{SESSION, TELEMETRY_CHANGED, TELEMETRY_MS, send_if_free};
use crate::due;
use core::sync::atomic::Ordering;
use embassy_time::{Duration, Instant, with_deadline};
use protocol::{
    frame::{Header, Kind, encode},
    table::Telemetry,
};

/// Sends the samples that `sample` returns, for ever. A sample that finds the line busy is dropped. Samples due while
/// no task runs, as during a write to flash, are skipped. The next sequence number shows the gap.
pub async fn run(mut sample: impl FnMut(Instant) -> Option<Telemetry>) -> ! {
    let mut seq = 0_u16;
    let mut next = Instant::now();
    loop {
        let period = TELEMETRY_MS.load(Ordering::Relaxed);
        next = match period {
            0 => Instant::MAX,
            _ => next + Duration::from_millis(u64::from(period)),
        };
        if with_deadline(next, TELEMETRY_CHANGED.wait()).await.is_ok() {
            next = Instant::now();
            continue;
        }
        let now = Instant::now();
        let skipped = due::skipped(next.as_micros(), now.as_micros(), u32::from(period) * 1_000);
        next += Duration::from_millis(u64::from(period) * u64::from(skipped));
        seq = seq.wrapping_add(skipped as u16);
        let Some(sample) = sample(now) else {
            continue;
        };
        let header = Header {
            kind: Kind::Telemetry,
            session: SESSION.load(Ordering::Relaxed),
            seq,
        };
        seq = seq.wrapping_add(1);
        if let Ok(frame) = encode(header, &sample) {
            send_if_free(frame);
        }
    }
}
