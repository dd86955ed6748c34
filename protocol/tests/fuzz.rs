//! Device and client survive any input: noise, corrupted frames, and frames with a good CRC but nonsense in them.
//! `RETROGRADE_CAMPAIGN=full` feeds ten times as much.

use crate::parties::{Device, Noise, Raw};
use proptest::prelude::*;
use protocol::{
    client::Client,
    frame::{Deframer, Encoded, Frame, Header, Kind, encode},
    system::{Event, Hello, SetTelemetry, Urgent},
    table::{Reply, Request, SCHEMA_KEY, Telemetry},
};
use serde::Serialize;

const KINDS: [Kind; 5] = [
    Kind::Request,
    Kind::Reply,
    Kind::Urgent,
    Kind::Telemetry,
    Kind::Event,
];

fn frame<T: Serialize>(kind: Kind, session: u8, seq: u16, body: &T) -> Encoded {
    encode(Header { kind, session, seq }, body).expect("it fits")
}

/// Whether its body is exactly one message of its kind.
fn is_message(frame: &Frame<'_>) -> bool {
    match frame.header.kind {
        Kind::Request => frame.decode::<Request>().is_some(),
        Kind::Reply => frame.decode::<Reply>().is_some(),
        Kind::Urgent => frame.decode::<Urgent>().is_some(),
        Kind::Telemetry => frame.decode::<Telemetry>().is_some(),
        Kind::Event => frame.decode::<Event>().is_some(),
    }
}

/// Applies `look` to the frame in these bytes, if there is one.
fn take<T>(bytes: &[u8], observe: impl Fn(Frame<'_>) -> T) -> Option<T> {
    let mut deframer = Deframer::new();
    let mut bytes = bytes.iter();
    bytes.find_map(|&byte| deframer.push(byte).map(&observe))
}

/// Kind and body of every exemplar.
fn messages() -> Vec<(Kind, Vec<u8>)> {
    let parts = |frame: Frame<'_>| (frame.header.kind, frame.body().to_vec());
    let frames = exemplars::frames::all().into_iter();
    frames
        .map(|(name, bytes)| take(&bytes, parts).expect(&name))
        .collect()
}

/// A device and a client in mid-session, so that both decode every frame they can.
struct Pair {
    client: Client,
    device: Device,
    session: u8,
    nonce: u32,
}

impl Pair {
    fn new() -> Self {
        let mut pair = Self {
            client: Client::default(),
            device: Device::new(),
            session: 0,
            nonce: 0,
        };
        pair.client.hello(0).expect("nothing is pending");
        pair.greet();
        pair
    }

    fn hear(&mut self, bytes: &[u8]) -> Vec<Encoded> {
        let mut replies = Vec::new();
        for &byte in bytes {
            replies.extend(self.device.receive(byte));
            self.client.receive(byte);
        }
        replies
    }

    /// Begins a new session.
    fn greet(&mut self) {
        self.nonce += 1;
        let hello = Request::Hello(Hello {
            protocol: protocol::VERSION,
            schema_key: SCHEMA_KEY,
            nonce: self.nonce,
        });
        // Ends any incomplete frame.
        self.hear(&[0]);
        let replies = self.hear(&frame(Kind::Request, 0, 1, &hello));
        let [reply] = &replies[..] else {
            panic!("{} replies to a greeting", replies.len());
        };
        let session = take(reply, |frame| frame.header.session);
        self.session = session.expect("a whole frame");
    }

    /// Checks that a command still gets through, once.
    fn check(&mut self) {
        self.greet();
        let before = self.device.executed.len();
        let command = Request::SetTelemetry(SetTelemetry { period_ms: 50 });
        let command = frame(Kind::Request, self.session, 2, &command);
        self.hear(&command);
        self.hear(&command);
        assert_eq!(self.device.executed.len(), before + 1);
    }
}

/// Damages bytes in one to four ways, as a bad line or a faulty program might.
fn corrupt(noise: &mut Noise, bytes: &mut Vec<u8>) {
    for _ in 0..=noise.next() % 4 {
        let at = noise.next() as usize % bytes.len().max(1);
        match noise.next() % 7 {
            0 | 1 if !bytes.is_empty() => bytes[at] ^= 1 << (noise.next() % 8),
            2 if !bytes.is_empty() => bytes[at] = noise.next() as u8,
            3 => bytes.insert(at.min(bytes.len()), noise.next() as u8),
            4 if !bytes.is_empty() => drop(bytes.remove(at)),
            5 => bytes.truncate(at),
            // Claims a long varint or length.
            6 if !bytes.is_empty() => bytes[at] = 0xFF,
            _ => {}
        }
    }
}

/// Frames corrupted on the wire: none is taken for another one, and the next good one is found.
fn corrupted_frames(runs: u32, seed: u64) {
    let mut noise = Noise(seed | 1);
    let mut pair = Pair::new();
    let frames: Vec<_> = messages()
        .into_iter()
        .map(|(kind, body)| frame(kind, pair.session, 0x1234, &Raw(body)))
        .collect();
    let mut deframer = Deframer::new();
    for run in 0..runs {
        let good = &frames[noise.next() as usize % frames.len()];
        let mut bytes = good.to_vec();
        corrupt(&mut noise, &mut bytes);
        deframer.push(0);
        for &byte in bytes.iter().chain(&[0]) {
            if let Some(found) = deframer.push(byte) {
                let again = frame(
                    found.header.kind,
                    found.header.session,
                    found.header.seq,
                    &Raw(found.body().to_vec()),
                );
                assert!(
                    &again == good || !is_message(&found),
                    "run {run}: {bytes:02x?} for {good:02x?}"
                );
            }
        }
        pair.hear(&bytes);
        if run % 1_000 == 0 {
            pair.check();
        }
    }
}

/// Frames whose content is corrupted before the CRC is computed, with any session and sequence number.
fn corrupted_bodies(runs: u32, seed: u64) {
    let mut noise = Noise(seed | 1);
    let mut pair = Pair::new();
    let messages = messages();
    for run in 0..runs {
        let (kind, body) = &messages[noise.next() as usize % messages.len()];
        let mut body = body.clone();
        corrupt(&mut noise, &mut body);
        body.truncate(protocol::frame::MAX_BODY);
        let kind = match noise.next() % 16 {
            0 => KINDS[noise.next() as usize % KINDS.len()],
            _ => *kind,
        };
        let session = match noise.next() % 4 {
            0 => noise.next() as u8,
            _ => pair.session,
        };
        let sent = frame(kind, session, noise.next() as u16, &Raw(body));
        pair.hear(&sent);
        if run % 1_000 == 0 {
            pair.check();
        }
    }
}

/// Noise of any length, then a frame, which is always found.
fn frames_after_garbage(runs: u32, seed: u64) {
    let mut noise = Noise(seed | 1);
    let good = frame(Kind::Request, 1, 7, &exemplars::requests()[8]);
    let mut deframer = Deframer::new();
    for run in 0..runs {
        for _ in 0..noise.next() % 300 {
            deframer.push(noise.next() as u8);
        }
        let found = good.iter().filter(|&&b| deframer.push(b).is_some()).count();
        assert_eq!(found, 1, "run {run}");
    }
}

/// No message is a prefix of another.
#[test]
fn a_byte_more_or_less_is_no_message() {
    let check = |kind, body: &[u8]| {
        let sent = frame(kind, 1, 2, &Raw(body.to_vec()));
        take(&sent, |found| is_message(&found)).expect("its CRC is good")
    };
    for (kind, body) in messages() {
        assert!(check(kind, &body));
        for len in 0..body.len() {
            assert!(!check(kind, &body[..len]), "{kind:?} {body:02x?}, {len}");
        }
        for more in 0..=u8::MAX {
            let longer = [&body[..], &[more]].concat();
            let fits = longer.len() <= protocol::frame::MAX_BODY;
            assert!(!fits || !check(kind, &longer), "{kind:?} {longer:02x?}");
        }
    }
}

/// With the first byte of the CRC complemented and 0xFF appended, the frame is one byte longer and its CRC is
/// correct. Only the rule above rejects it.
#[test]
fn what_no_crc_detects_is_no_message() {
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);
    for (kind, body) in messages() {
        let mut raw = vec![kind as u8, 1, 0x34, 0x12];
        raw.extend(&body);
        let [first, rest @ ..] = crc.checksum(&raw).to_le_bytes();
        let raw = [&raw[..], &[!first], &rest, &[0xFF]].concat();
        let mut block = vec![0; raw.len() + 2];
        let length = cobs::encode(&raw, &mut block);
        block[length] = 0;
        let taken = take(&block[..=length], |found| is_message(&found));
        assert_eq!(taken, Some(false), "{raw:02x?}");
    }
}

/// The whole series if RETROGRADE_CAMPAIGN is set, otherwise its first tenth.
fn tenth_of(all: u32) -> u32 {
    match std::env::var_os("RETROGRADE_CAMPAIGN") {
        Some(_) => all,
        None => all / 10,
    }
}

#[test]
fn a_frame_after_garbage_is_found() {
    frames_after_garbage(tenth_of(1_000_000), 4712);
}

#[test]
fn no_corrupted_frame_is_accepted() {
    corrupted_frames(tenth_of(10_000_000), 817);
}

#[test]
fn corrupted_bodies_are_survived() {
    corrupted_bodies(tenth_of(10_000_000), 818);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..2_000)) {
        let mut device = Device::new();
        let mut client = Client::default();
        for byte in bytes {
            device.receive(byte);
            client.receive(byte);
        }
        prop_assert!(device.executed.is_empty());
    }

    /// Frames with a good CRC and any body: nothing panics, and nothing is executed without a session.
    #[test]
    fn any_body_is_survived(body in proptest::collection::vec(any::<u8>(), 0..150), kind in 0..5_usize, session in any::<u8>()) {
        let sent = frame(KINDS[kind], session, 3, &Raw(body));
        let mut device = Device::new();
        let mut client = Client::default();
        for byte in &sent {
            device.receive(*byte);
            client.receive(*byte);
        }
        prop_assert!(device.executed.is_empty());
    }
}
