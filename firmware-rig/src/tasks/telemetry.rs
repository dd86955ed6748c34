//! Sends a sample at the interval the host asked for.

use crate::{
    board,
    channels::{
        COMMANDED, SESSION, SNAPSHOT, STROKE, TELEMETRY_CHANGED, TELEMETRY_MS, send_if_free,
    },
    stepgen,
};
use core::sync::atomic::Ordering;
use embassy_time::{Duration, Instant, with_deadline};
use motion::{axis::Axis, units::Steps};
use protocol::{
    frame::{Header, Kind, encode},
    rig::RigTelemetry,
    table::Telemetry,
};

/// Lowest priority: a sample that finds the line busy is dropped, and its number shows the gap.
#[embassy_executor::task]
pub async fn telemetry() -> ! {
    let mut seq = 0_u16;
    let mut next = Instant::now();
    let mut last = (Instant::now(), stepgen::counted());
    loop {
        let period = TELEMETRY_MS.load(Ordering::Relaxed);
        next = match period {
            0 => Instant::MAX,
            _ => (next + Duration::from_millis(u64::from(period))).max(Instant::now()),
        };
        if with_deadline(next, TELEMETRY_CHANGED.wait()).await.is_ok() {
            next = Instant::now();
            continue;
        }
        let (now, position) = (Instant::now(), stepgen::counted());
        let snapshot = SNAPSHOT.lock(|snapshot| snapshot.get());
        let sample = RigTelemetry {
            time_us: now.as_micros(),
            state: snapshot.state,
            position_steps: position,
            commanded_steps: COMMANDED.load(Ordering::Relaxed),
            speed_um_s: speed_um_s(
                &snapshot.axis,
                position.wrapping_sub(last.1),
                now.saturating_duration_since(last.0),
            ),
            stroke: STROKE.load(Ordering::Relaxed),
            residual_steps: snapshot.residual_steps,
            inputs: board::inputs(),
        };
        last = (now, position);
        let header = Header {
            kind: Kind::Telemetry,
            session: SESSION.load(Ordering::Relaxed),
            seq,
        };
        seq = seq.wrapping_add(1);
        if let Ok(frame) = encode(header, &Telemetry::Rig(sample)) {
            send_if_free(frame);
        }
    }
}

fn speed_um_s(axis: &Axis, steps: i32, time: Duration) -> i32 {
    let nm = axis.length_of(Steps(steps.unsigned_abs())).0;
    let speed = nm.saturating_mul(1_000) / time.as_micros().max(1);
    let speed = i32::try_from(speed).unwrap_or(i32::MAX);
    if steps < 0 { -speed } else { speed }
}
