//! The line between host and machine: delays bytes, flips bits and loses frames.

use std::collections::VecDeque;

use protocol::frame::{Deframer, Frame, Kind};
use protocol::table::Request;

use super::Script;

/// Delay of a frame from the machine to the host, us.
pub const LATENCY_US: u64 = 2_000;

/// The line with its faults.
pub struct Line {
    flip_one_in: u64,
    noise: u64,
    deaf_to: Vec<(&'static str, u32)>,
    silent_events: Vec<u32>,
    dead: bool,
    /// Decodes the frames that go to the machine.
    outgoing: Deframer,
    /// Bytes since the last end of a frame, held back until the line knows which frame they belong to.
    block: Vec<u8>,
    /// Decodes the frames that come from the machine.
    incoming: Deframer,
    /// Bytes on their way to the host, with their time of arrival, us.
    carried: VecDeque<(u64, Vec<u8>)>,
}

impl Line {
    pub fn new(script: &Script) -> Self {
        Self {
            flip_one_in: script.flip_one_in,
            noise: script.seed | 1,
            deaf_to: script.deaf_to.clone(),
            silent_events: script.silent_events.clone(),
            dead: script.dead,
            outgoing: Deframer::new(),
            block: vec![],
            incoming: Deframer::new(),
            carried: VecDeque::new(),
        }
    }

    fn random(&mut self) -> u64 {
        self.noise ^= self.noise << 13;
        self.noise ^= self.noise >> 7;
        self.noise ^= self.noise << 17;
        self.noise
    }

    fn corrupt(&mut self, byte: u8) -> u8 {
        if self.flip_one_in == 0 {
            return byte;
        }
        (0..8).fold(byte, |byte, bit| {
            let flips = self.random().is_multiple_of(self.flip_one_in);
            byte ^ (u8::from(flips) << bit)
        })
    }

    /// Carries bytes from the host. Returns those that reach the machine and adds the names of their frames to
    /// `heard`.
    pub fn carry_to_machine(&mut self, bytes: &[u8], heard: &mut Vec<&'static str>) -> Vec<u8> {
        let mut arrived = vec![];
        for byte in bytes {
            let byte = self.corrupt(*byte);
            self.block.push(byte);
            let name = self.outgoing.push(byte).map(|frame| name(&frame));
            if byte != 0 {
                continue;
            }
            let lost = self.dead || name.is_some_and(|name| self.is_deaf_to(name));
            if !lost {
                heard.extend(name);
                arrived.append(&mut self.block);
            }
            self.block.clear();
        }
        arrived
    }

    fn is_deaf_to(&mut self, name: &str) -> bool {
        let mut deaf = self.deaf_to.iter_mut();
        let Some((_, remaining)) = deaf.find(|(deaf, remaining)| *deaf == name && *remaining > 0)
        else {
            return false;
        };
        *remaining -= 1;
        true
    }

    /// Carries a frame that the machine sends at `now_us`.
    pub fn carry_to_host(&mut self, now_us: u64, frame: &[u8]) {
        let mut event = None;
        for byte in frame {
            if let Some(frame) = self.incoming.push(*byte) {
                event = (frame.header.kind == Kind::Event).then_some(frame.header.seq);
            }
        }
        let lost = event.is_some_and(|index| self.silent_events.contains(&index.into()));
        if !lost {
            let bytes = frame.iter().map(|byte| self.corrupt(*byte)).collect();
            self.carried.push_back((now_us + LATENCY_US, bytes));
        }
    }

    /// Takes the bytes that have reached the host by now.
    pub fn arrived(&mut self, now_us: u64) -> Vec<u8> {
        let mut bytes = vec![];
        while let Some((_, frame)) = self.carried.pop_front_if(|(time_us, _)| *time_us <= now_us) {
            bytes.extend(frame);
        }
        bytes
    }

    /// When bytes next reach the host, us.
    pub fn next_us(&self) -> u64 {
        let next = self.carried.front();
        next.map_or(u64::MAX, |(time_us, _)| *time_us)
    }
}

fn name(frame: &Frame<'_>) -> &'static str {
    match frame.header.kind {
        Kind::Urgent => "Urgent",
        _ => frame
            .decode::<Request>()
            .map_or("?", |request| request.name()),
    }
}
