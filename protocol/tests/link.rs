//! The real client against the real session over a bad line that corrupts, repeats and delays, with resets of the
//! device.

use crate::parties::{Device, Noise};
use protocol::{
    client::{ATTEMPTS, Client, FLASH_ATTEMPTS, Output, Poll, RETRY_AFTER_US},
    error::WireError,
    frame::Encoded,
    system::{SetTelemetry, Urgent},
    table::{Request, Response},
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
            client: Client::default(),
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

/// A million commands at each error rate if RETROGRADE_CAMPAIGN is set, otherwise the first quarter of them.
#[test]
fn no_command_is_executed_twice() {
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
