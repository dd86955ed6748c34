//! Target: any bytes into the device's receiver, from the first byte to the answer, compared with a second
//! implementation.

use std::sync::OnceLock;

use device::identity::identity;
use device::service::{Inbound, Incoming, Service};
use protocol::error::Refusal;
use protocol::frame::{Deframer, Kind};
use protocol::system::{DeviceKind, Done, Hello, Identity, KeepAlive, ResetCause, Urgent};
use protocol::table::{Reply, Request, Response, SCHEMA_KEY};
use serde::{Deserialize, Serialize};

use crate::model::{self, AnsweredOnce, Good};
use crate::script::steps;

/// Most steps of a script that are executed.
const MOST_STEPS: usize = 32;

/// A step of a script.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum StreamStep {
    /// Raw bytes.
    Noise(Vec<u8>),
    /// A Hello of this host.
    Hello(u32),
    /// A request of the session; the sequence number advances by this much.
    Request(u16, Request),
    /// A frame with a good checksum: kind, session, sequence number, body.
    Frame(u8, u8, u16, Vec<u8>),
    /// A stop.
    Urgent(u16, Urgent),
    /// The last frame again, with these bits inverted in one byte; 0 is a plain repetition.
    Again(u8, u8),
}

/// A device and its expected behaviour.
struct DeviceLine {
    service: Service,
    once: AnsweredOnce,
    seq: u16,
    last: Vec<u8>,
    /// Bytes since the last delimiter, and number of blocks that were not frames.
    block: Vec<u8>,
    bad: u32,
    now_us: u32,
}

/// Runs a script.
///
/// # Panics
/// The device violates the protocol.
pub fn target(data: &[u8]) {
    let mut line = DeviceLine::new();
    line.receive(data);
    line.receive(&[0]);
    for step in steps::<StreamStep>(data).take(MOST_STEPS) {
        let bytes = match step {
            StreamStep::Noise(bytes) => bytes,
            StreamStep::Hello(nonce) => line.greeting(nonce),
            StreamStep::Request(ahead, request) => line.request(ahead, &request),
            StreamStep::Frame(kind, session, seq, body) => model::frame(kind, session, seq, &body),
            StreamStep::Urgent(seq, urgent) => {
                let body = postcard::to_stdvec(&urgent).expect("short");
                model::frame(Kind::Urgent as u8, line.once.session(), seq, &body)
            }
            StreamStep::Again(at, mask) => {
                let mut bytes = line.last.clone();
                if let Some(byte) = bytes.get_mut(usize::from(at)) {
                    *byte ^= mask;
                }
                line.receive(&bytes);
                continue;
            }
        };
        line.receive(&bytes);
        line.last = bytes;
    }
    line.still_serves();
}

impl DeviceLine {
    fn new() -> Self {
        static IDENTITY: OnceLock<Identity> = OnceLock::new();
        let identity =
            IDENTITY.get_or_init(|| identity(DeviceKind::Rig, [7; 12], 1, ResetCause::PowerOn));
        Self {
            service: Service::new(*identity),
            once: AnsweredOnce::default(),
            seq: 0,
            last: vec![],
            block: vec![],
            bad: 0,
            now_us: 0,
        }
    }

    fn greeting(&mut self, nonce: u32) -> Vec<u8> {
        let hello = Request::Hello(Hello {
            protocol: protocol::VERSION,
            schema_key: SCHEMA_KEY,
            nonce,
        });
        self.request(1, &hello)
    }

    fn request(&mut self, ahead: u16, request: &Request) -> Vec<u8> {
        self.seq = self.seq.wrapping_add(ahead);
        let body = postcard::to_stdvec(request).expect("short");
        let session = self.once.session();
        model::frame(Kind::Request as u8, session, self.seq, &body)
    }

    fn receive(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.block.push(*byte);
            let heard_us = self.service.heard_us();
            self.now_us = self.now_us.wrapping_add(1);
            let received = self.service.receive(*byte, self.now_us);
            if *byte != 0 {
                assert_eq!(received, None, "a frame before its end");
                continue;
            }
            let (good, bad) = model::read(&self.block);
            self.block.clear();
            self.bad += bad;
            match (received, good.into_iter().next()) {
                (None, None) => {}
                (Some(received), Some(good)) => self.judge(received, &good, heard_us),
                (found, expected) => panic!("{found:?} for {expected:?}"),
            }
        }
        assert_eq!(
            self.service.bad_frames(),
            self.bad,
            "blocks that are no frames"
        );
    }

    /// Checks that every request and every stop gets one answer, and frames that only devices send get none.
    fn judge(&mut self, received: Incoming, good: &Good, heard_us: u32) {
        let is_for_us = good.kind == Kind::Request as u8 || good.kind == Kind::Urgent as u8;
        let frame = match received {
            Incoming::Ignore => {
                assert!(!is_for_us, "no answer to {good:?}");
                assert_eq!(self.service.heard_us(), heard_us, "a sign of life");
                return;
            }
            Incoming::Send(frame) => frame,
            Incoming::Ask(inbound, to) => {
                let reply = self.carry_out(&inbound, good);
                self.service.answer(to, &reply).expect("every reply fits")
            }
        };
        assert!(is_for_us, "an answer to {good:?}");
        let mut deframer = Deframer::new();
        let mut bytes = frame.iter();
        let (header, reply) = bytes
            .find_map(|byte| {
                let frame = deframer.push(*byte)?;
                Some((frame.header, frame.decode::<Reply>()))
            })
            .expect("a whole frame");
        assert_eq!((header.kind, header.seq), (Kind::Reply, good.seq));
        match reply.expect("a reply") {
            Reply::Accepted(Response::Hello(identity)) => {
                assert_eq!(identity.session, header.session);
                self.once.greeted(header.session);
            }
            Reply::Refused(Refusal::Incompatible) => {
                assert_eq!(header.session, good.session);
                self.once.refused(good.seq);
            }
            _ => assert_eq!(header.session, good.session),
        }
    }

    fn carry_out(&mut self, inbound: &Inbound, good: &Good) -> Reply {
        match inbound {
            Inbound::Urgent(urgent) => {
                let body = postcard::take_from_bytes::<Urgent>(&good.body);
                assert_eq!(body, Ok((*urgent, &[][..])), "another stop");
                Reply::Urgent(*urgent)
            }
            Inbound::Request(request) => {
                let body = postcard::take_from_bytes::<Request>(&good.body);
                assert_eq!(body, Ok((request.clone(), &[][..])), "another request");
                self.once.executed(good.session, good.seq);
                Reply::Accepted(Response::KeepAlive(Done))
            }
        }
    }

    /// Checks that a new host still gets a session, and its request is executed once.
    fn still_serves(&mut self) {
        self.receive(&[0]);
        // Try two: one may be the nonce of the present host.
        for nonce in [u32::MAX, u32::MAX - 1] {
            let hello = self.greeting(nonce);
            self.receive(&hello);
        }
        let request = self.request(1, &Request::KeepAlive(KeepAlive));
        self.once.newest_is(None);
        self.receive(&request);
        self.once.newest_is(Some(self.seq));
        self.receive(&request);
    }
}
