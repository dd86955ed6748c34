//! The device's end of the link: sessions, repetitions, urgent stops, damaged bytes; and the requests that every
//! device answers in the same way.

use device::{
    common::{About, Effect},
    identity::identity,
    service::{Answers, Inbound, Incoming, Return, Service},
    settings::Values,
};
use proptest::prelude::*;
use protocol::{
    VERSION,
    error::Refusal,
    events::EventRing,
    frame::{Deframer, Encoded, Header, Kind, encode},
    rig::{GetRigStatus, Hold, Home, Resume},
    settings::{FactoryReset, GetName, GetSetting, Name, Setting, SettingKey, SettingRule},
    system::{
        BrownOut, Chip, Clock, DeviceKind, GetChip, GetEvents, GetLastWords, Hello, Identity,
        KeepAlive, ResetCause, SetTelemetry, Urgent, What,
    },
    table::{Reply, Request, Response, SCHEMA_KEY},
};

const UID: [u8; 12] = *b"0123456789ab";

fn this_device() -> Identity {
    identity(DeviceKind::Capsule, UID, 7, ResetCause::Watchdog)
}

/// A device's end with an open session.
struct Link {
    service: Service,
    session: u8,
    now_us: u32,
}

impl Link {
    fn open() -> Self {
        Self::open_with(1)
    }

    fn open_with(nonce: u32) -> Self {
        let service = Service::new(this_device());
        let mut link = Self {
            service,
            session: 0,
            now_us: 0,
        };
        link.session = link.greet(nonce, SCHEMA_KEY);
        link
    }

    /// Says Hello; returns the number of the session in the answer.
    fn greet(&mut self, nonce: u32, schema_key: u64) -> u8 {
        let hello = Request::Hello(Hello {
            protocol: VERSION,
            schema_key,
            nonce,
        });
        let (header, reply) = self.sent(&request(0, 5, &hello));
        let Reply::Accepted(Response::Hello(identity)) = reply else {
            panic!("{reply:?}")
        };
        assert_eq!((header.session, header.seq), (identity.session, 5));
        let expected = Identity {
            session: identity.session,
            ..this_device()
        };
        assert_eq!(identity, expected);
        identity.session
    }

    fn receive(&mut self, bytes: &[u8]) -> Vec<Incoming> {
        self.now_us = self.now_us.wrapping_add(1_000);
        let take = |byte: &u8| self.service.receive(*byte, self.now_us);
        bytes.iter().filter_map(take).collect()
    }

    /// Whether these bytes, once answered, count as a sign of life of the host that began the motion.
    fn shows_life(&mut self, bytes: &[u8]) -> bool {
        self.shows_life_if(bytes, &reply(10))
    }

    /// As [`Link::shows_life`], with this answer of control.
    fn shows_life_if(&mut self, bytes: &[u8], answer: &Reply) -> bool {
        if let Incoming::Ask(_, to) = self.one(bytes) {
            self.service.answer(to, answer).unwrap();
        }
        self.service.heard_us() == self.now_us
    }

    /// The single request in these bytes.
    fn one(&mut self, bytes: &[u8]) -> Incoming {
        let mut incoming = self.receive(bytes);
        assert_eq!(incoming.len(), 1, "{incoming:?}");
        incoming.remove(0)
    }

    /// The reply that is sent at once.
    fn sent(&mut self, bytes: &[u8]) -> (Header, Reply) {
        match self.one(bytes) {
            Incoming::Send(frame) => decoded(&frame),
            other => panic!("{other:?}"),
        }
    }

    fn asked(&mut self, bytes: &[u8]) -> (Inbound, Return) {
        match self.one(bytes) {
            Incoming::Ask(inbound, to) => (inbound, to),
            other => panic!("{other:?}"),
        }
    }
}

fn request(session: u8, seq: u16, request: &Request) -> Encoded {
    let kind = Kind::Request;
    encode(Header { kind, session, seq }, request).unwrap()
}

fn urgent(session: u8, seq: u16, urgent: Urgent) -> Encoded {
    let kind = Kind::Urgent;
    encode(Header { kind, session, seq }, &urgent).unwrap()
}

/// Decodes a reply as the host would.
fn decoded(frame: &Encoded) -> (Header, Reply) {
    let mut deframer = Deframer::new();
    for byte in frame {
        if let Some(frame) = deframer.push(*byte) {
            assert_eq!(frame.header.kind, Kind::Reply);
            return (frame.header, frame.decode().unwrap());
        }
    }
    panic!("no frame")
}

fn set(period_ms: u16) -> Request {
    Request::SetTelemetry(SetTelemetry { period_ms })
}

fn reply(period_ms: u16) -> Reply {
    Reply::Accepted(Response::SetTelemetry(SetTelemetry { period_ms }))
}

/// The device's end hears this: what it has carried out, and what it answers.
fn heard(service: &mut Service, bytes: &[u8]) -> String {
    let shown = |frame: &Encoded| match decoded(frame) {
        // An identity names the revision that the test was built from.
        (header, Reply::Accepted(Response::Hello(_))) => format!("{header:?} greeting"),
        (header, reply) => format!("{header:?} {reply:?}"),
    };
    let incoming = bytes.iter().filter_map(|byte| service.receive(*byte, 0));
    match incoming.collect::<Vec<_>>().pop() {
        Some(Incoming::Send(frame)) => format!("answers {}", shown(&frame)),
        Some(Incoming::Ask(inbound, to)) => {
            let answer = match inbound {
                Inbound::Request(_) => reply(10),
                Inbound::Urgent(urgent) => Reply::Urgent(urgent),
            };
            let frame = service.answer(to, &answer).unwrap();
            format!("carries out {inbound:?}, answers {}", shown(&frame))
        }
        Some(Incoming::Ignore) => "ignores it".to_owned(),
        None => "hears nothing".to_owned(),
    }
}

/// Repetitions and refused frames carry nothing out; a stop is valid in any session and without one, and each copy is
/// carried out, because a stop has to get through.
#[test]
fn a_conversation() {
    let other_schema = Request::Hello(Hello {
        protocol: VERSION,
        schema_key: SCHEMA_KEY ^ 1,
        nonce: 3,
    });
    let session = |nonce| Link::open_with(nonce).session;
    let [first, second] = [session(1), session(1) + 1];
    let home = Request::Home(Home);
    let body = |kind, seq| {
        let session = second;
        encode(Header { kind, session, seq }, &[0xFF_u8; 3]).unwrap()
    };
    let mut damaged = request(first, 2, &set(20));
    damaged[3] ^= 0x40;
    let mut frames = vec![
        ("before any greeting", request(first, 1, &set(10))),
        ("a greeting", request(0, 5, &hello(1))),
    ];
    for seq in 1..=5 {
        frames.push(("a request", request(first, seq, &set(10 * seq))));
    }
    frames.extend([
        ("the fifth again", request(first, 5, &set(50))),
        ("the second again", request(first, 2, &set(20))),
        ("the first, too long ago", request(first, 1, &set(10))),
        ("its number with another body", request(first, 5, &set(11))),
        ("a damaged frame", damaged),
        ("a good one after it", request(first, 6, &set(20))),
        ("a greeting of another host", request(0, 5, &hello(2))),
        ("the first host", request(first, 7, &set(10))),
        ("the second host", request(second, 1, &set(10))),
        ("its greeting again", request(0, 6, &hello(2))),
        ("no request", body(Kind::Request, 2)),
        ("no stop", body(Kind::Urgent, 2)),
        ("what devices send", body(Kind::Reply, 3)),
        ("what devices send", body(Kind::Telemetry, 3)),
        ("what devices send", body(Kind::Event, 3)),
        ("another protocol", request(0, 5, &other_schema)),
        ("its request", request(second + 1, 1, &home)),
        ("again", request(second + 1, 1, &home)),
    ]);
    for session in [0, first, second + 1] {
        frames.push(("a stop", urgent(session, 3, Urgent::Stop)));
        frames.push(("an emergency stop", urgent(session, 3, Urgent::EStop)));
        frames.push(("again", urgent(session, 3, Urgent::EStop)));
    }
    let mut service = Service::new(this_device());
    let mut text = String::new();
    for (what, frame) in frames {
        text += &format!("{what}: {}\n", heard(&mut service, &frame));
    }
    assert_eq!(service.bad_frames(), 1);
    insta::assert_snapshot!("conversation", text);
}

/// It is sent with the old session's number, and is no answer in the new session.
#[test]
fn a_late_answer_belongs_to_the_old_session() {
    let mut link = Link::open();
    let old = link.session;
    let (_, to) = link.asked(&request(old, 1, &set(10)));
    let new = link.greet(2, SCHEMA_KEY);
    let late = link.service.answer(to, &reply(10)).unwrap();
    assert_eq!(decoded(&late).0.session, old);
    let (inbound, _) = link.asked(&request(new, 1, &set(10)));
    assert_eq!(inbound, Inbound::Request(set(10)));
}

/// A machine's control that logs its requests.
#[derive(Default)]
struct Control {
    requests: Vec<Request>,
    stops: Vec<Urgent>,
}

impl Answers for Control {
    fn request(&mut self, request: Request) -> Reply {
        self.requests.push(request);
        reply(10)
    }

    fn stop(&mut self, urgent: Urgent) {
        self.stops.push(urgent);
    }
}

#[test]
fn every_question_reaches_control_and_is_answered() {
    let mut control = Control::default();
    assert_eq!(control.answer(Inbound::Request(set(10))), reply(10));
    assert_eq!(
        (control.requests.as_slice(), control.stops.len()),
        (&[set(10)][..], 0)
    );
    for urgent in [Urgent::Stop, Urgent::EStop] {
        let answer = control.answer(Inbound::Urgent(urgent));
        assert_eq!(answer, Reply::Urgent(urgent));
    }
    assert_eq!(control.stops, [Urgent::Stop, Urgent::EStop]);
    assert_eq!(control.requests.len(), 1);
}

fn hello(nonce: u32) -> Request {
    Request::Hello(Hello {
        protocol: VERSION,
        schema_key: SCHEMA_KEY,
        nonce,
    })
}

/// These frames are no sign of life: an echo of the device's own, a frame of a host that was replaced, a body that is
/// no request, and a stop.
#[test]
fn a_sign_of_life_comes_from_the_host_that_began_the_motion() {
    let mut link = Link::open();
    let old = link.session;
    let session = link.greet(2, SCHEMA_KEY);
    assert_ne!(old, session);
    // No motion has begun, so there is nothing to keep alive.
    assert!(!link.shows_life(&request(session, 1, &set(10))));
    assert!(link.shows_life(&request(session, 2, &Request::Home(Home))));
    assert!(link.shows_life(&request(session, 3, &set(10))));
    assert!(link.shows_life(&request(session, 3, &set(10))), "repeated");
    // The same host greets again.
    assert!(link.shows_life(&request(0, 1, &hello(2))));
    // A stop, in any session.
    assert!(!link.shows_life(&urgent(session, 1, Urgent::Stop)));
    assert!(!link.shows_life(&urgent(0, 1, Urgent::EStop)));
    // In order: a replaced host's request, one before any session, nonsense, a reused number, a number that is too
    // old.
    assert!(!link.shows_life(&request(old, 7, &set(10))));
    assert!(!link.shows_life(&request(0, 8, &set(10))));
    let header = |kind, seq| Header { kind, session, seq };
    assert!(!link.shows_life(&encode(header(Kind::Request, 4), &[0xFF_u8; 3]).unwrap()));
    assert!(!link.shows_life(&encode(header(Kind::Urgent, 4), &[0xFF_u8; 3]).unwrap()));
    assert!(link.shows_life(&request(session, 9, &set(10))));
    assert!(!link.shows_life(&request(session, 8, &set(10))));
    // Frames that only devices send.
    for kind in [Kind::Reply, Kind::Telemetry, Kind::Event] {
        assert!(!link.shows_life(&encode(header(kind, 9), &0_u8).unwrap()));
    }
}

/// A `watch` or a server that takes over the line sends requests four times a second. They must not keep a dead
/// host's motion going.
#[test]
fn whoever_takes_the_line_over_keeps_nothing_moving_that_it_did_not_begin() {
    let busy = Reply::Refused(Refusal::RigBusy(protocol::rig::RigState::Running));
    let mut link = Link::open();
    assert!(link.shows_life(&request(link.session, 1, &Request::Home(Home))));
    let begun_us = link.service.heard_us();
    let session = link.greet(2, SCHEMA_KEY);
    assert!(!link.shows_life(&request(0, 1, &hello(2))), "again");
    for (seq, asked) in [
        (1, Request::KeepAlive(KeepAlive)),
        (2, Request::GetRigStatus(GetRigStatus)),
        (3, Request::Hold(Hold)),
    ] {
        assert!(
            !link.shows_life(&request(session, seq, &asked)),
            "{asked:?}"
        );
    }
    // While the machine moves, a request to move is refused, and is no sign of life either.
    for (seq, asked) in [(4, Request::Home(Home)), (5, Request::Resume(Resume))] {
        assert!(!link.shows_life_if(&request(session, seq, &asked), &busy));
        assert_eq!(link.service.heard_us(), begun_us, "{asked:?}");
        // While control works on the request, a motion that it begins must not find its host silent.
        let Incoming::Ask(_, to) = link.one(&request(session, seq + 10, &asked)) else {
            panic!("{asked:?}")
        };
        assert_eq!(link.service.heard_us(), link.now_us);
        link.service.answer(to, &busy).unwrap();
    }
    // From its own motion on it counts, even if it only resumes a run that another host has left held.
    assert!(link.shows_life(&request(session, 20, &Request::Resume(Resume))));
    assert!(link.shows_life(&request(session, 21, &set(10))));
    // A refused request counts as well.
    assert!(link.shows_life_if(&request(session, 22, &Request::Home(Home)), &busy));
    // An answer after a newer greeting begins nothing for the new host.
    let (_, to) = link.asked(&request(session, 23, &Request::Home(Home)));
    let newest = link.greet(3, SCHEMA_KEY);
    link.service.answer(to, &reply(10)).unwrap();
    assert!(!link.shows_life(&request(newest, 1, &set(10))));
}

proptest! {
    /// Only good frames lead to requests, whatever comes before them.
    #[test]
    fn noise_asks_for_nothing(
        noise in prop::collection::vec(any::<u8>(), 0..400),
        place in any::<prop::sample::Index>(),
        flip in 1..=255_u8,
    ) {
        let mut link = Link::open();
        prop_assert_eq!(link.receive(&noise), []);
        let good = request(link.session, 1, &set(10));
        let mut damaged = good.clone();
        damaged[place.index(good.len())] ^= flip;
        let whole = [&[0][..], &damaged].concat();
        // If only the delimiters are damaged, the frame itself is still good.
        for incoming in link.receive(&whole) {
            let asks = matches!(&incoming, Incoming::Ask(Inbound::Request(asked), _) if *asked == set(10));
            prop_assert!(asks, "{incoming:?}");
        }
        let mut link = Link::open();
        link.receive(&noise);
        let seq = request(link.session, 2, &set(20));
        let (inbound, _) = link.asked(&seq);
        prop_assert_eq!(inbound, Inbound::Request(set(20)));
    }
}

/// A rig's answer, where its settings may be changed now or not, and follow like this.
fn answer(
    request: &Request,
    may_change: Result<(), Refusal>,
    settings: Result<u8, SettingRule>,
) -> Result<Option<(Response, Effect<u8>)>, Refusal> {
    let mut events = EventRing::new();
    for time_us in 0..5 {
        events.record(time_us, What::Booted(ResetCause::Pin));
    }
    let about = About {
        kind: DeviceKind::Rig,
        events: &events,
        last_words: "tasks/link.rs:1: oh",
        chip: Chip {
            clock: Clock::Internal,
            brown_out: BrownOut::Level1,
            supply_low: true,
            option_bytes: 0x00FF_AAE9,
        },
        values: &Values::DEFAULT,
        name: "left bench",
    };
    about.answer(request, || may_change, |_| settings)
}

/// Requests that both machines answer alike; none where the request is of the machine itself. What changes a setting or
/// the name is refused while it may not.
#[test]
fn common_requests_have_one_answer_for_all_devices() {
    let (key, other) = (SettingKey::LeadUm, SettingKey::MotorMohm);
    let set = |key, value| Request::SetSetting(Setting { key, value });
    let name = |name: &str| {
        let name = name.try_into().unwrap();
        Request::SetName(Name { name })
    };
    let mut requests = vec![
        Request::KeepAlive(KeepAlive),
        Request::GetLastWords(GetLastWords),
        Request::GetChip(GetChip),
        Request::GetEvents(GetEvents { from: 1 }),
        Request::GetRigStatus(GetRigStatus),
        Request::GetName(GetName),
        Request::GetSetting(GetSetting { key }),
        Request::GetSetting(GetSetting { key: other }),
        set(other, 16),
        set(key, 5_000),
        set(key, key.range().max + 1),
        Request::FactoryReset(FactoryReset),
        name("c-1"),
        // A terminal would obey an escape sequence.
        name("\u{1b}[2J"),
        name("two\nlines"),
        name("bell\x07"),
        name("c1 \u{9b}2J"),
        name("\x7f"),
    ];
    for period_ms in [0, 5, 1_000, 1, 4, 1_001, u16::MAX] {
        requests.push(Request::SetTelemetry(SetTelemetry { period_ms }));
    }
    let mut table = String::new();
    for request in requests {
        let free = answer(&request, Ok(()), Ok(7));
        table += &format!("{request:?}\n    {free:?}\n");
        let busy = answer(&request, Err(Refusal::NotHomed), Ok(7));
        if busy != free {
            table += &format!("    while nothing may change: {busy:?}\n");
        }
    }
    insta::assert_snapshot!("common_requests", table);
    for rule in SettingRule::ALL {
        let refusal = Refusal::SettingRule { key, rule };
        assert_eq!(answer(&set(key, 5_000), Ok(()), Err(rule)), Err(refusal));
    }
}
