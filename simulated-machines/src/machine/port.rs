//! The surroundings of control in both machines: clock, retained RAM, and the port with its outgoing frames.

use std::sync::{Arc, Mutex, MutexGuard};

use device::common::Surroundings;
use device::retained::{self, EStop, Retained, WORDS, Words};
use protocol::frame::{Encoded, Header, Kind, encode};
use protocol::system::{BrownOut, Chip, Clock, Event};
use protocol::table::Telemetry;
use serde::Serialize;

/// Clones share one port. Times are the device's, us.
#[derive(Clone)]
pub struct Port(Arc<Mutex<PortState>>);

struct PortState {
    now_us: u64,
    /// Number of the present session (0 before the first), and when the host that began the motion was last heard.
    session: u8,
    heard_us: u32,
    telemetry_us: u64,
    next_telemetry_us: Option<u64>,
    telemetry_seq: u16,
    /// Frames with the times at which they were sent.
    outbound: Vec<(u64, Encoded)>,
    retained: [u32; WORDS],
}

impl Words for PortState {
    fn get(&self, index: usize) -> u32 {
        self.retained[index]
    }

    fn set(&mut self, index: usize, value: u32) {
        self.retained[index] = value;
    }
}

impl PortState {
    fn new(retained: [u32; WORDS]) -> Self {
        Self {
            now_us: 0,
            session: 0,
            heard_us: 0,
            telemetry_us: 0,
            next_telemetry_us: None,
            telemetry_seq: 0,
            outbound: vec![],
            retained,
        }
    }

    fn send(&mut self, kind: Kind, seq: u16, body: &impl Serialize) {
        let header = Header {
            kind,
            session: self.session,
            seq,
        };
        let frame = encode(header, body).expect("every message fits");
        self.outbound.push((self.now_us, frame));
    }
}

impl Port {
    /// The port of a machine that has never been started.
    pub fn new() -> Self {
        Self(Arc::new(Mutex::new(PortState::new([0; WORDS]))))
    }

    fn state(&self) -> MutexGuard<'_, PortState> {
        self.0.lock().expect("no test panics while it sends")
    }

    /// Starts the device; only the retained RAM survives.
    pub fn start(&self) -> Retained {
        let mut state = self.state();
        *state = PortState::new(state.retained);
        retained::start(&mut *state)
    }

    pub fn now_us(&self) -> u64 {
        self.state().now_us
    }

    pub fn set_now_us(&self, now_us: u64) {
        self.state().now_us = now_us;
    }

    /// Notes that a good frame has arrived or been answered.
    pub fn hear(&self, session: u8, heard_us: u32) {
        let mut state = self.state();
        state.session = session;
        state.heard_us = heard_us;
    }

    pub fn reply(&self, frame: Encoded) {
        let mut state = self.state();
        let now_us = state.now_us;
        state.outbound.push((now_us, frame));
    }

    /// Takes the frames sent since the last call, with their times.
    pub fn sent(&self) -> Vec<(u64, Encoded)> {
        std::mem::take(&mut self.state().outbound)
    }

    /// When the next sample of telemetry is due.
    pub fn sample_us(&self) -> u64 {
        self.state().next_telemetry_us.unwrap_or(u64::MAX)
    }

    /// Sends the telemetry sample that is due, if there is one.
    pub fn send_sample(&self, sample: Option<Telemetry>) {
        let mut state = self.state();
        state.next_telemetry_us = Some(state.now_us + state.telemetry_us);
        if let Some(sample) = sample {
            let seq = state.telemetry_seq;
            state.send(Kind::Telemetry, seq, &sample);
            state.telemetry_seq = seq.wrapping_add(1);
        }
    }
}

/// A machine's board, with its port.
pub struct At<B> {
    pub port: Port,
    pub board: B,
}

impl<B> Surroundings for At<B> {
    fn now_us(&self) -> u64 {
        self.port.now_us()
    }

    fn chip(&self) -> Chip {
        Chip {
            clock: Clock::External,
            brown_out: BrownOut::Off,
            supply_low: false,
            option_bytes: 0x00FF_AAED,
        }
    }

    fn silence_us(&self) -> u32 {
        let state = self.port.state();
        (state.now_us as u32).wrapping_sub(state.heard_us)
    }

    fn set_telemetry(&mut self, period_ms: u16) {
        let mut state = self.port.state();
        state.telemetry_us = u64::from(period_ms) * 1_000;
        state.next_telemetry_us = (period_ms > 0).then_some(state.now_us + state.telemetry_us);
    }

    fn keep_latched(&mut self, estop: Option<EStop>) {
        retained::keep_latched(&mut *self.port.state(), estop);
    }

    fn send_event(&mut self, event: &Event) {
        let mut state = self.port.state();
        // Before the first session, no host listens.
        if state.session != 0 {
            state.send(Kind::Event, event.index as u16, event);
        }
    }
}
