//! Target: messages of guests at the door of a line, of the machine and of the owner. Guests may bring stops to the
//! line and harmless questions to the owner, and nothing else.

use std::sync::OnceLock;

use crate::door::{Door, Guest};
use client::door::VERSION;
use client::door::server::GUESTS as MOST_LOOKERS;
use protocol::frame::Kind;
use protocol::rig::{GetRigStatus, Home};
use protocol::system::{DeviceKind, Done, Hello, Identity, ResetCause, Urgent};
use protocol::table::{Endpoint, Impact, Reply, Request, Response, SCHEMA_KEY};
use serde::{Deserialize, Serialize};

use crate::model::{self, Good, Once};
use crate::script::steps;

const TOKEN: &str = "secret";
/// Most steps of a script that are tried.
const MOST_STEPS: usize = 32;
/// Most guests at a time.
const GUESTS: usize = 3;
/// Time between two questions that the owner takes, us.
const BREATH_US: u64 = 10_000;

/// A step of a script.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Step {
    /// Somebody greets with these bytes.
    Greeting(Vec<u8>),
    /// A guest greets properly; true if it wants the line.
    Come(bool),
    /// A guest leaves.
    Leave(u8),
    /// A guest sends raw bytes.
    Noise(u8, Vec<u8>),
    /// A guest sends a Hello.
    Hello(u8, u32),
    /// A guest sends a request; its sequence number advances by this much.
    Request(u8, u16, Request),
    /// A guest sends a frame: kind, session, sequence number, body.
    Frame(u8, u8, u8, u16, Vec<u8>),
    /// A guest sends a stop.
    Urgent(u8, u16, Urgent),
    /// A guest sends its last frame again.
    Again(u8),
    /// This many ms pass.
    Wait(u16),
    /// The owner takes a question, and answers it if true.
    Answer(bool),
    /// The owner sends a request of its own.
    Order,
    /// The owner notices stops and continues.
    Notice,
    /// The machine sends raw bytes.
    Machine(Vec<u8>),
    /// The machine confirms the stop with this number on the line.
    Confirm(u16, Urgent),
    /// The machine sends an exemplar, by its index.
    Tell(u8),
    /// Silent guests come until the door has no room for another that looks.
    Crowd,
    /// The silent guests leave, but for this many.
    Thin(u8),
}

/// A guest, with the state to check it by.
struct Seat {
    guest: Guest,
    /// It came to a full door, and may only stop.
    stops_only: bool,
    said: Vec<u8>,
    once: Once,
    seq: u16,
    last: Vec<u8>,
}

struct Hall {
    door: Door,
    seats: Vec<Seat>,
    now_us: u64,
    /// Whether a stop is on the line that the owner has not noticed yet.
    unnoticed: bool,
    /// Questions in good frames from guests, and questions that reached the owner.
    asked: usize,
    taken: usize,
    /// Guests that say nothing, and may look.
    silent: Vec<Guest>,
}

/// Runs a script.
///
/// # Panics
/// The door violates what it promises.
pub fn target(data: &[u8]) {
    let mut hall = Hall::new();
    for step in steps::<Step>(data).take(MOST_STEPS) {
        hall.take(step);
    }
    hall.still_stops();
}

fn greeting(wants_line: bool) -> Vec<u8> {
    let text = format!(
        "{{\"retrograde_window\":{VERSION},\"token\":\"{TOKEN}\",\"wants_line\":{wants_line}}}\n"
    );
    text.into()
}

impl Hall {
    fn new() -> Self {
        let door = Door::new(TOKEN, true);
        door.introduce(identity());
        Self {
            door,
            seats: vec![],
            now_us: 0,
            unnoticed: false,
            asked: 0,
            taken: 0,
            silent: vec![],
        }
    }

    fn seat(&mut self, index: u8) -> Option<usize> {
        let count = self.seats.len();
        (count > 0).then(|| usize::from(index) % count)
    }

    fn take(&mut self, step: Step) {
        match step {
            Step::Greeting(bytes) => self.come(&bytes),
            Step::Come(wants_line) => self.come(&greeting(wants_line)),
            Step::Leave(at) => {
                if let Some(at) = self.seat(at) {
                    drop(self.seats.remove(at));
                }
            }
            Step::Noise(at, bytes) => self.say(at, &bytes),
            Step::Hello(at, nonce) => {
                let hello = Hello {
                    protocol: protocol::VERSION,
                    schema_key: SCHEMA_KEY,
                    nonce,
                };
                self.request(at, 1, &Request::Hello(hello));
            }
            Step::Request(at, ahead, request) => self.request(at, ahead, &request),
            Step::Frame(at, kind, session, seq, body) => {
                self.say(at, &model::frame(kind, session, seq, &body));
            }
            Step::Urgent(at, seq, urgent) => {
                let body = postcard::to_stdvec(&urgent).expect("short");
                self.say(at, &model::frame(Kind::Urgent as u8, 0, seq, &body));
            }
            Step::Again(at) => {
                if let Some(index) = self.seat(at) {
                    let last = self.seats[index].last.clone();
                    self.say(at, &last);
                }
            }
            Step::Wait(ms) => self.now_us += u64::from(ms) * 1_000,
            Step::Answer(answers) => self.answer(answers),
            Step::Order => self.order(),
            Step::Notice => {
                let stopped = self.door.stopped();
                assert!(!self.unnoticed || stopped.is_some());
                self.unnoticed = false;
                self.door.forget_stop();
                assert_eq!(self.door.stopped(), None);
            }
            Step::Machine(bytes) => self.door.hear(&bytes),
            Step::Confirm(seq, urgent) => {
                let body = postcard::to_stdvec(&Reply::Urgent(urgent)).expect("short");
                self.door
                    .hear(&model::frame(Kind::Reply as u8, 0, seq, &body));
            }
            Step::Tell(index) => {
                let frames = frames();
                self.door.hear(&frames[usize::from(index) % frames.len()]);
            }
            Step::Crowd => self.crowd(),
            Step::Thin(left) => self.silent.truncate(left.into()),
        }
        for seat in &self.seats {
            // Guests receive complete frames of a device only.
            let (frames, bad) = model::read(&seat.guest.told());
            assert_eq!(bad, 0);
            assert!(frames.iter().all(|frame| [2, 4, 5].contains(&frame.kind)));
        }
        assert!(self.door.written().is_empty(), "nobody has sent it");
    }

    fn come(&mut self, bytes: &[u8]) {
        if self.seats.len() == GUESTS {
            return;
        }
        let guest = self.door.greet(bytes);
        let knows = String::from_utf8_lossy(bytes).contains(TOKEN)
            || bytes.windows(2).any(|pair| pair == b"\\u");
        let Some((guest, welcome, rest)) = guest else {
            return;
        };
        assert!(knows, "let in without the token");
        assert_eq!(welcome.last(), Some(&b'\n'));
        let stops_only = is_told_full(&welcome);
        assert_eq!(stops_only, self.lookers() >= MOST_LOOKERS, "{welcome:?}");
        let rest = rest.to_vec();
        self.seats.push(Seat {
            guest,
            stops_only,
            said: vec![],
            once: Once::default(),
            seq: 0,
            last: vec![],
        });
        self.say((self.seats.len() - 1) as u8, &rest);
    }

    /// Guests that may look.
    fn lookers(&self) -> usize {
        let seated = self.seats.iter().filter(|seat| !seat.stops_only);
        self.silent.len() + seated.count()
    }

    fn crowd(&mut self) {
        while self.lookers() < MOST_LOOKERS {
            let greeting = greeting(false);
            let (guest, welcome, _) = self.door.greet(&greeting).expect("let in");
            assert!(!is_told_full(&welcome), "{} may look", self.lookers());
            self.silent.push(guest);
        }
    }

    fn request(&mut self, at: u8, ahead: u16, request: &Request) {
        let Some(index) = self.seat(at) else {
            return;
        };
        let seat = &mut self.seats[index];
        seat.seq = seat.seq.wrapping_add(ahead);
        let body = postcard::to_stdvec(request).expect("short");
        let frame = model::frame(Kind::Request as u8, seat.once.session(), seat.seq, &body);
        self.say(at, &frame);
    }

    /// Sends a guest's bytes, and checks that of these only stops reach the line, at once.
    fn say(&mut self, at: u8, bytes: &[u8]) {
        let Some(index) = self.seat(at) else {
            return;
        };
        let seat = &mut self.seats[index];
        seat.said.extend(bytes);
        let end = seat
            .said
            .iter()
            .rposition(|byte| *byte == 0)
            .map_or(0, |end| end + 1);
        let whole: Vec<u8> = seat.said.drain(..end).collect();
        seat.guest
            .say(bytes, self.now_us)
            .expect("the line is there");
        seat.last = bytes.to_vec();
        let (told, bad) = model::read(&seat.guest.told());
        assert_eq!(bad, 0);
        for frame in &told {
            if let Ok((Reply::Accepted(Response::Hello(_)), _)) =
                postcard::take_from_bytes(&frame.body)
            {
                seat.once.greeted(frame.session);
            }
        }
        let (said, _) = model::read(&whole);
        let stops: Vec<Urgent> = said.iter().filter_map(stop).collect();
        let stops_only = self.seats[index].stops_only;
        if stops_only {
            // A frame that cannot be read is answered as such.
            let accepts = |frame: &Good| {
                let reply = postcard::take_from_bytes::<Reply>(&frame.body);
                matches!(reply, Ok((Reply::Accepted(_), _)))
            };
            assert!(
                !told.iter().any(accepts),
                "it was told that it can only stop"
            );
        } else {
            self.asked += said.iter().filter(|frame| asks(frame)).count();
        }
        self.unnoticed |= !stops.is_empty();
        let (written, bad) = model::read(&self.door.written());
        assert_eq!(bad, 0);
        let written: Vec<_> = written
            .iter()
            .map(|frame| {
                assert_eq!(frame.session, 0);
                stop(frame).expect("a guest brings nothing but stops to the line")
            })
            .collect();
        assert_eq!(written, stops, "each stop, at once, in its order");
    }

    fn answer(&mut self, answers: bool) {
        self.now_us += BREATH_US;
        let Some(question) = self.door.question(self.now_us) else {
            return;
        };
        self.taken += 1;
        let request = &question.request;
        assert!(is_harmless(request), "{request:?} for the owner");
        assert!(self.taken <= self.asked, "a question that nobody has asked");
        let reply = Reply::Accepted(Response::KeepAlive(Done));
        question.answer(answers.then_some(reply));
    }

    /// Checks that the owner's request goes out unless there is an unnoticed stop.
    fn order(&mut self) {
        let body = postcard::to_stdvec(&Home.into_request()).expect("short");
        let frame = model::frame(Kind::Request as u8, 1, 1, &body);
        self.door.send(&frame).expect("the line is there");
        let written = self.door.written();
        match self.unnoticed {
            true => assert!(written.is_empty(), "it would start what was stopped"),
            false => assert_eq!(written, frame),
        }
    }

    /// Checks that a new guest's stop still reaches the line at once, also past a full door, and its question the
    /// owner when there is room.
    fn still_stops(&mut self) {
        self.seats.clear();
        self.crowd();
        self.come(&greeting(false));
        let body = postcard::to_stdvec(&Urgent::Stop).expect("short");
        self.say(0, &model::frame(Kind::Urgent as u8, 9, 9, &body));
        self.take(Step::Notice);
        self.seats.clear();
        self.silent.clear();
        self.come(&greeting(false));
        let body = postcard::to_stdvec(&Urgent::EStop).expect("short");
        self.say(0, &model::frame(Kind::Urgent as u8, 9, 9, &body));
        self.take(Step::Notice);
        self.take(Step::Hello(0, 1));
        self.take(Step::Request(0, 1, GetRigStatus.into_request()));
        let before = self.taken;
        for _ in 0..=self.asked {
            self.answer(false);
        }
        assert!(self.taken > before, "the question reached nobody");
    }
}

/// Whether a guest's welcome says that it can only stop.
fn is_told_full(welcome: &[u8]) -> bool {
    String::from_utf8_lossy(welcome).contains("\"full\":true")
}

/// Identity of the machine on the line.
fn identity() -> &'static Identity {
    static IDENTITY: OnceLock<Identity> = OnceLock::new();
    IDENTITY.get_or_init(|| {
        let uid = [7; 12];
        device::identity::identity(DeviceKind::Rig, uid, 1, ResetCause::PowerOn)
    })
}

/// Every exemplar as a frame.
fn frames() -> &'static [Vec<u8>] {
    static FRAMES: OnceLock<Vec<Vec<u8>>> = OnceLock::new();
    FRAMES.get_or_init(|| {
        let all = exemplars::frames::all().into_iter();
        all.map(|(_, frame)| frame.to_vec()).collect()
    })
}

fn stop(frame: &Good) -> Option<Urgent> {
    match postcard::take_from_bytes(&frame.body) {
        Ok((urgent, [])) if frame.kind == Kind::Urgent as u8 => Some(urgent),
        _ => None,
    }
}

/// Whether a request starts no motion, writes nothing, and leaves the owner's telemetry unchanged.
fn is_harmless(request: &Request) -> bool {
    match request.impact() {
        Impact::None => !matches!(request, Request::SetTelemetry(_)),
        Impact::Fault | Impact::Pace => true,
        Impact::Flash | Impact::Motion => false,
    }
}

/// Whether a frame is a question that may reach the owner.
fn asks(frame: &Good) -> bool {
    match postcard::take_from_bytes::<Request>(&frame.body) {
        Ok((request, [])) => frame.kind == Kind::Request as u8 && is_harmless(&request),
        _ => false,
    }
}
