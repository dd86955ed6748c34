//! What the tasks of both machines share on the board (`device::chip`): frames on their way out, telemetry's interval,
//! when the host was heard last.

use protocol::frame::{Encoded, Header, Kind, encode};
use protocol::system::Event;
use protocol::table::Telemetry;
use serde::Serialize;

/// Times are the device's, us.
#[derive(Default)]
pub struct Port {
    /// Number of the present session, 0 before the first.
    pub session: u8,
    /// When the last good frame came.
    pub heard_us: u64,
    telemetry_us: u64,
    next_telemetry_us: Option<u64>,
    telemetry_seq: u16,
    /// Frames, and when they were sent.
    pub outbound: Vec<(u64, Encoded)>,
}

impl Port {
    fn send(&mut self, now_us: u64, kind: Kind, seq: u16, body: &impl Serialize) {
        let header = Header {
            kind,
            session: self.session,
            seq,
        };
        let frame = encode(header, body).expect("every message fits");
        self.outbound.push((now_us, frame));
    }

    /// Sends an event, if somebody listens.
    pub fn tell(&mut self, now_us: u64, event: &Event) {
        if self.session != 0 {
            self.send(now_us, Kind::Event, event.index as u16, event);
        }
    }

    pub fn silence_us(&self, now_us: u64) -> u32 {
        (now_us - self.heard_us) as u32
    }

    /// Sets the interval of telemetry, ms; 0 = none.
    pub fn set_telemetry(&mut self, now_us: u64, period_ms: u16) {
        self.telemetry_us = u64::from(period_ms) * 1_000;
        self.next_telemetry_us = (period_ms > 0).then_some(now_us + self.telemetry_us);
    }

    /// When the next sample is due.
    pub fn telemetry_due_us(&self) -> u64 {
        self.next_telemetry_us.unwrap_or(u64::MAX)
    }

    /// Sends the sample that is due, if there is anything to show.
    pub fn sample(&mut self, now_us: u64, sample: Option<Telemetry>) {
        self.next_telemetry_us = Some(now_us + self.telemetry_us);
        if let Some(sample) = sample {
            self.send(now_us, Kind::Telemetry, self.telemetry_seq, &sample);
            self.telemetry_seq = self.telemetry_seq.wrapping_add(1);
        }
    }
}
