//! What a bad line can do: damage, garbage, repetition, resets. The real client against the real session.

#[allow(missing_docs, dead_code, unreachable_pub)]
mod exemplars;

use proptest::prelude::*;
use protocol::{
    client::{ATTEMPTS, Client, Output, Poll, RETRY_AFTER_US},
    error::{Refusal, WireError},
    frame::{Deframer, Encoded, Header, Kind, encode},
    session::{Decision, Session},
    system::{
        BuildProfile, DeviceKind, Done, Hello, Identity, ResetCause, Revision, SetTelemetry,
        Urgent, Version,
    },
    table::{Reply, Request, Response, Retry, SCHEMA_KEY, TABLE},
};

/// Deterministic noise.
struct Noise(u64);
impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }
    /// True once in `n` on average.
    fn one_in(&mut self, n: u64) -> bool {
        self.next().is_multiple_of(n)
    }
}

/// The device of these tests: counts what it executes.
struct Device {
    deframer: Deframer,
    session: Session,
    executed: Vec<u16>,
    stops: u32,
    boots: u32,
}

impl Device {
    fn new() -> Self {
        Self {
            deframer: Deframer::new(),
            session: Session::new(1),
            executed: vec![],
            stops: 0,
            boots: 1,
        }
    }

    fn reset(&mut self) {
        self.boots += 1;
        self.session = Session::new(self.boots);
        self.deframer = Deframer::new();
    }

    fn identity(&self, session: u8) -> Identity {
        Identity {
            device: DeviceKind::Rig,
            protocol: protocol::VERSION,
            schema_key: SCHEMA_KEY,
            uid: [0; 12],
            revision: Revision {
                commit: 1,
                dirty: false,
            },
            profile: BuildProfile::Firmware,
            boot_id: self.boots,
            reset_cause: ResetCause::Pin,
            session,
        }
    }

    fn receive(&mut self, byte: u8) -> Option<Encoded> {
        let frame = self.deframer.push(byte)?;
        let reply = |session, seq, reply: &Reply| {
            encode(
                Header {
                    kind: Kind::Reply,
                    session,
                    seq,
                },
                reply,
            )
            .ok()
        };
        match self.session.receive(&frame) {
            Decision::Greet { session, seq } => reply(
                session,
                seq,
                &Reply::Accepted(Response::Hello(self.identity(session))),
            ),
            Decision::Execute { request, ticket } => {
                let response = match request {
                    Request::SetTelemetry(set) => {
                        self.executed.push(set.period_ms);
                        Response::SetTelemetry(set)
                    }
                    _ => Response::KeepAlive(Done),
                };
                let frame = reply(ticket.session, ticket.seq, &Reply::Accepted(response))?;
                self.session.remember(ticket, &frame);
                Some(frame)
            }
            Decision::Urgent {
                urgent,
                session,
                seq,
            } => {
                self.stops += 1;
                reply(session, seq, &Reply::Urgent(urgent))
            }
            Decision::Resend(frame) => Some(frame),
            Decision::Refuse { refusal, ticket } => {
                reply(ticket.session, ticket.seq, &Reply::Refused(refusal))
            }
            Decision::Reject {
                error,
                session,
                seq,
            } => reply(session, seq, &Reply::Wire(error)),
            Decision::Ignore => None,
        }
    }
}

/// A line in virtual time that flips bits.
struct Line {
    client: Client,
    device: Device,
    noise: Noise,
    now_us: u64,
    flip_one_in: u64,
    late_one_in: u64,
    late: Vec<Encoded>,
}

impl Line {
    fn new(seed: u64, flip_one_in: u64, late_one_in: u64) -> Self {
        Self {
            client: Client::new(),
            device: Device::new(),
            noise: Noise(seed | 1),
            now_us: 0,
            flip_one_in,
            late_one_in,
            late: vec![],
        }
    }

    fn carry(&mut self, byte: u8) -> u8 {
        let mut byte = byte;
        for bit in 0..8 {
            if self.flip_one_in > 0 && self.noise.one_in(self.flip_one_in) {
                byte ^= 1 << bit;
            }
        }
        byte
    }

    fn give_client(&mut self, frame: &Encoded) -> Option<Output> {
        let mut output = None;
        for byte in frame {
            let byte = self.carry(*byte);
            output = self.client.receive(byte).or(output);
        }
        output
    }

    /// Runs until the pending request ends.
    fn settle(&mut self) -> Option<Output> {
        loop {
            match self.client.poll(self.now_us) {
                Poll::TimedOut => return None,
                Poll::WaitUntil(u64::MAX) => return None,
                Poll::WaitUntil(time) => {
                    self.now_us = time;
                    for frame in std::mem::take(&mut self.late) {
                        if let Some(output) = self.give_client(&frame) {
                            return Some(output);
                        }
                    }
                }
                Poll::Transmit(frame) => {
                    let mut replies = vec![];
                    for byte in &frame {
                        let byte = self.carry(*byte);
                        replies.extend(self.device.receive(byte));
                    }
                    for reply in replies {
                        if self.late_one_in > 0 && self.noise.one_in(self.late_one_in) {
                            self.late.push(reply);
                        } else if let Some(output) = self.give_client(&reply) {
                            return Some(output);
                        }
                    }
                }
            }
        }
    }

    fn connect(&mut self) {
        loop {
            let nonce = self.noise.next() as u32;
            self.client.hello(nonce).expect("nothing is pending");
            if let Some(Output::Accepted(Response::Hello(_))) = self.settle() {
                return;
            }
        }
    }
}

/// At most once, and never acknowledged without execution: commands with a number in them over bad lines.
fn executed_once(commands: u16, flip_one_in: u64, late_one_in: u64, reset_one_in: u64, seed: u64) {
    let mut line = Line::new(seed, flip_one_in, late_one_in);
    line.connect();
    let mut unknown = 0;
    for number in 1..=commands {
        let before = line.device.executed.len();
        if line
            .client
            .request(&Request::SetTelemetry(SetTelemetry { period_ms: number }))
            .is_err()
        {
            line.connect();
            line.client
                .request(&Request::SetTelemetry(SetTelemetry { period_ms: number }))
                .unwrap();
        }
        let answer = line.settle();
        let times = line.device.executed[before..]
            .iter()
            .filter(|done| **done == number)
            .count();
        assert!(
            times <= 1,
            "seed {seed}: command {number} was executed {times} times"
        );
        match answer {
            Some(Output::Accepted(Response::SetTelemetry(set))) => {
                assert_eq!(
                    (set.period_ms, times),
                    (number, 1),
                    "seed {seed}: acknowledged but not executed"
                );
            }
            Some(Output::Rejected(WireError::NoSession)) | None => unknown += 1,
            other => panic!("seed {seed}: {other:?}"),
        }
        if reset_one_in > 0 && line.noise.one_in(reset_one_in) {
            line.device.reset();
        }
    }
    let all: std::collections::BTreeSet<_> = line.device.executed.iter().collect();
    assert_eq!(
        all.len(),
        line.device.executed.len(),
        "seed {seed}: executed twice after a reset"
    );
    assert!(
        unknown < commands / 2,
        "seed {seed}: the line carried nothing, {unknown} of {commands} unknown"
    );
}

#[test]
fn no_command_is_executed_twice() {
    for (index, flip_one_in) in [0, 10_000, 1_000].into_iter().enumerate() {
        for seed in 1..=4 {
            executed_once(2_000, flip_one_in, 5, 100, seed * 1_000 + index as u64);
        }
    }
}

/// A million commands at each error rate: `cargo test --release -p protocol -- --ignored`.
#[test]
#[ignore = "minutes in a debug build"]
fn no_command_of_a_million_is_executed_twice() {
    for flip_one_in in [0, 10_000, 1_000] {
        for seed in 1..=100 {
            executed_once(10_000, flip_one_in, 5, 100, seed);
        }
    }
}

#[test]
fn a_frame_after_garbage_is_found() {
    let mut noise = Noise(4711);
    let frame = encode(
        Header {
            kind: Kind::Request,
            session: 1,
            seq: 7,
        },
        &exemplars::requests()[8],
    )
    .unwrap();
    let mut deframer = Deframer::new();
    for trial in 0..20_000 {
        for _ in 0..noise.next() % 300 {
            deframer.push(noise.next() as u8);
        }
        let found = frame
            .iter()
            .filter(|byte| deframer.push(**byte).is_some())
            .count();
        assert_eq!(found, 1, "trial {trial}");
    }
}

#[test]
fn no_damaged_frame_is_accepted() {
    let mut noise = Noise(815);
    let good = encode(
        Header {
            kind: Kind::Request,
            session: 1,
            seq: 7,
        },
        &exemplars::requests()[8],
    )
    .unwrap();
    for trial in 0..50_000 {
        let mut bytes = good.clone();
        for _ in 0..=noise.next() % 4 {
            let at = noise.next() as usize % bytes.len();
            bytes[at] ^= 1 << (noise.next() % 8);
        }
        let mut deframer = Deframer::new();
        let found = bytes.iter().any(|byte| deframer.push(*byte).is_some());
        assert!(
            !found || bytes == good || bytes[0] != 0,
            "trial {trial}: {bytes:02x?}"
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..2_000)) {
        let mut device = Device::new();
        let mut client = Client::new();
        for byte in bytes {
            device.receive(byte);
            client.receive(byte);
        }
        prop_assert!(device.executed.is_empty());
    }

    /// Frames with a good CRC and any body: nothing panics, and nothing runs without a session.
    #[test]
    fn any_body_is_survived(body in proptest::collection::vec(any::<u8>(), 0..150), kind in 1..=5_u8, session in any::<u8>()) {
        let kind = [Kind::Request, Kind::Reply, Kind::Urgent, Kind::Telemetry, Kind::Event][usize::from(kind) - 1];
        let frame = encode(Header { kind, session, seq: 3 }, &Raw(body)).unwrap();
        let mut device = Device::new();
        let mut client = Client::new();
        for byte in &frame {
            device.receive(*byte);
            client.receive(*byte);
        }
        prop_assert!(device.executed.is_empty());
    }
}

/// Bytes without a length in front of them.
struct Raw(Vec<u8>);
impl serde::Serialize for Raw {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeTuple;
        let mut tuple = serializer.serialize_tuple(self.0.len())?;
        self.0
            .iter()
            .try_for_each(|byte| tuple.serialize_element(byte))?;
        tuple.end()
    }
}

#[test]
fn every_row_is_served_once_per_sequence_number() {
    for request in exemplars::requests() {
        if matches!(request, Request::Hello(_)) {
            continue;
        }
        let mut line = Line::new(5, 0, 0);
        line.connect();
        let session = line.device.session.number();
        let frame = encode(
            Header {
                kind: Kind::Request,
                session,
                seq: 100,
            },
            &request,
        )
        .unwrap();
        let answers: Vec<_> = (0..3)
            .map(|_| {
                frame
                    .iter()
                    .filter_map(|byte| line.device.receive(*byte))
                    .next()
                    .expect("an answer")
            })
            .collect();
        assert_eq!(
            answers[0],
            answers[1],
            "{:?} {:?}",
            request.row().name,
            request.row().retry
        );
        assert_eq!(answers[1], answers[2]);
        assert!(line.device.executed.len() <= 1);
    }
    assert!(TABLE.iter().any(|row| row.retry == Retry::Deduplicated));
}

fn answer(device: &mut Device, session: u8, seq: u16, request: &Request) -> Reply {
    let frame = encode(
        Header {
            kind: Kind::Request,
            session,
            seq,
        },
        request,
    )
    .unwrap();
    let reply = frame
        .iter()
        .filter_map(|byte| device.receive(*byte))
        .next()
        .expect("an answer");
    let mut deframer = Deframer::new();
    let mut found = None;
    for byte in &reply {
        if let Some(frame) = deframer.push(*byte) {
            found = frame.decode();
        }
    }
    found.expect("a reply")
}

#[test]
fn reused_and_stale_numbers_are_told_apart() {
    let mut line = Line::new(5, 0, 0);
    line.connect();
    let session = line.device.session.number();
    let set = |period_ms| Request::SetTelemetry(SetTelemetry { period_ms });
    assert!(matches!(
        answer(&mut line.device, session, 10, &set(1)),
        Reply::Accepted(_)
    ));
    assert_eq!(
        answer(&mut line.device, session, 10, &set(2)),
        Reply::Wire(WireError::SequenceReused)
    );
    for seq in 11..20 {
        assert!(matches!(
            answer(&mut line.device, session, seq, &set(seq)),
            Reply::Accepted(_)
        ));
    }
    assert_eq!(
        answer(&mut line.device, session, 10, &set(1)),
        Reply::Wire(WireError::Stale)
    );
    assert_eq!(
        answer(&mut line.device, session.wrapping_add(1), 30, &set(9)),
        Reply::Wire(WireError::NoSession)
    );
    // The number wraps round.
    for seq in (20..=u16::MAX).step_by(8_000).chain([u16::MAX, 0, 1]) {
        assert!(
            matches!(
                answer(&mut line.device, session, seq, &set(seq)),
                Reply::Accepted(_)
            ),
            "{seq}"
        );
    }
}

#[test]
fn a_mismatch_refuses_all_rows_that_need_a_match() {
    for (protocol, schema_key) in [
        (protocol::VERSION, SCHEMA_KEY ^ 1),
        (
            Version {
                major: protocol::VERSION.major + 1,
                minor: 0,
            },
            SCHEMA_KEY,
        ),
    ] {
        let mut device = Device::new();
        let hello = Request::Hello(Hello {
            protocol,
            schema_key,
            nonce: 1,
        });
        let Reply::Accepted(Response::Hello(identity)) = answer(&mut device, 0, 0, &hello) else {
            panic!("Hello is always answered")
        };
        for (seq, request) in (1..).zip(exemplars::requests().into_iter().skip(1)) {
            let reply = answer(&mut device, identity.session, seq, &request);
            let refused = reply == Reply::Refused(Refusal::Incompatible);
            assert_eq!(refused, request.row().needs_match, "{}", request.row().name);
        }
    }
}

#[test]
fn a_stop_goes_first_and_needs_no_session() {
    let mut line = Line::new(5, 0, 0);
    line.connect();
    let run = exemplars::requests()[8].clone();
    line.client.request(&run).unwrap();
    line.client.urgent(Urgent::Stop);
    assert_eq!(line.settle(), Some(Output::UrgentDone(Urgent::Stop)));
    assert!(line.device.executed.is_empty());
    // A client that never connected.
    let mut line = Line::new(6, 0, 0);
    line.client.urgent(Urgent::EStop);
    assert_eq!(line.settle(), Some(Output::UrgentDone(Urgent::EStop)));
    assert_eq!(line.device.stops, 1);
}

#[test]
fn silence_is_reported_as_unknown_after_all_attempts() {
    let mut client = Client::new();
    client.hello(1).unwrap();
    let (mut now_us, mut sent) = (0, 0);
    loop {
        match client.poll(now_us) {
            Poll::Transmit(_) => sent += 1,
            Poll::WaitUntil(time) => now_us = time,
            Poll::TimedOut => break,
        }
    }
    assert_eq!(
        (sent, now_us),
        (ATTEMPTS, u64::from(ATTEMPTS) * RETRY_AFTER_US)
    );
}
