//! The real client against the real session over a bad line that corrupts, repeats and delays, with resets of the
//! device.

use crate::parties::{Device, Noise};
use protocol::{
    client::{ATTEMPTS, Client, FLASH_ATTEMPTS, Output, Poll, RETRY_AFTER_US},
    error::{Refusal, WireError},
    frame::{Deframer, Encoded, Header, Kind, encode},
    system::{Hello, SetTelemetry, Urgent, Version},
    table::{Reply, Request, Response, SCHEMA_KEY},
};

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

    /// Runs until the pending request is answered or given up.
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

/// Sends numbered commands over a bad line: each is executed at most once, and none is confirmed without execution.
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

/// A million commands at each error rate if RETROGRADE_CAMPAIGN is set, otherwise the first quarter of them: `cargo
/// test -p protocol -- --ignored`.
#[test]
#[ignore = "a long series, a step of `cargo xtask ci`"]
fn no_command_of_a_long_series_is_executed_twice() {
    let seeds = match std::env::var_os("RETROGRADE_CAMPAIGN") {
        Some(_) => 100,
        None => 25,
    };
    for flip_one_in in [0, 10_000, 1_000] {
        for seed in 1..=seeds {
            executed_once(10_000, flip_one_in, 5, 100, seed);
        }
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
        let before = line.device.executions;
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
        assert_eq!(answers[0], answers[1], "{}", request.name());
        assert_eq!(answers[1], answers[2], "{}", request.name());
        assert_eq!(line.device.executions, before + 1, "{}", request.name());
    }
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
    // The sequence number wraps around.
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
            assert_eq!(refused, request.needs_match(), "{}", request.name());
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
    // A client that has never connected.
    let mut line = Line::new(6, 0, 0);
    line.client.urgent(Urgent::EStop);
    assert_eq!(line.settle(), Some(Output::UrgentDone(Urgent::EStop)));
    assert_eq!(line.device.stops, 1);
}

/// How often, and for how long, a client repeats a request without an answer.
fn until_given_up(client: &mut Client) -> (u8, u64) {
    let (mut now_us, mut sent) = (0, 0);
    loop {
        match client.poll(now_us) {
            Poll::Transmit(_) => sent += 1,
            Poll::WaitUntil(time) => now_us = time,
            Poll::TimedOut => return (sent, now_us),
        }
    }
}

#[test]
fn silence_is_reported_as_unknown_after_all_attempts() {
    let mut client = Client::new();
    client.hello(1).unwrap();
    let all = (ATTEMPTS, u64::from(ATTEMPTS) * RETRY_AFTER_US);
    assert_eq!(until_given_up(&mut client), all);
}

/// The device receives nothing while it erases, half a second or more.
#[test]
fn what_writes_flash_is_asked_for_longer() {
    for request in exemplars::requests().into_iter().skip(1) {
        let mut line = Line::new(5, 0, 0);
        line.connect();
        line.client.request(&request).unwrap();
        let writes_flash = ["SetSetting", "FactoryReset", "SetName"].contains(&request.name());
        let (sent, waited_us) = until_given_up(&mut line.client);
        let expected = if writes_flash {
            FLASH_ATTEMPTS
        } else {
            ATTEMPTS
        };
        assert_eq!(sent, expected, "{}", request.name());
        assert_eq!(waited_us, u64::from(sent) * RETRY_AFTER_US);
    }
}
