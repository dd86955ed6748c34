//! The device's session alone: greetings, repetitions, sequence numbers.

use protocol::{
    VERSION,
    error::{Refusal, WireError},
    events::{EventRing, RING},
    frame::{Deframer, Encoded, Header, Kind, encode},
    session::{CACHED_REPLIES, Decision, Session, Ticket},
    settings::Name,
    system::{Event, Hello, KeepAlive, SetTelemetry, Urgent, Version, What},
    table::{Request, SCHEMA_KEY},
};
use serde::Serialize;

fn receive<T: Serialize>(
    device: &mut Session,
    kind: Kind,
    session: u8,
    seq: u16,
    body: &T,
) -> Decision {
    let bytes = encode(Header { kind, session, seq }, body).expect("it fits");
    let mut deframer = Deframer::new();
    let mut bytes = bytes.iter();
    bytes
        .find_map(|&byte| deframer.push(byte).map(|frame| device.receive(&frame)))
        .expect("a frame")
}

fn request(device: &mut Session, session: u8, seq: u16, request: &Request) -> Decision {
    receive(device, Kind::Request, session, seq, request)
}

/// Sends a Hello; returns the number of the session.
fn greet(device: &mut Session, nonce: u32) -> u8 {
    let hello = Request::Hello(Hello {
        protocol: VERSION,
        schema_key: SCHEMA_KEY,
        nonce,
    });
    match request(device, 0, 9, &hello) {
        Decision::Greet { session, seq: 9 } => session,
        other => panic!("{other:?} instead of a greeting"),
    }
}

fn set(period_ms: u16) -> Request {
    Request::SetTelemetry(SetTelemetry { period_ms })
}

fn execute(device: &mut Session, session: u8, seq: u16, what: &Request) -> Ticket {
    match request(device, session, seq, what) {
        Decision::Execute { request, ticket } => {
            assert_eq!(&request, what);
            ticket
        }
        other => panic!("{other:?} instead of an execution"),
    }
}

/// Executes a request and remembers `answer`.
fn served(device: &mut Session, session: u8, seq: u16, what: &Request, answer: u8) {
    let ticket = execute(device, session, seq, what);
    device.remember(ticket, &reply(answer));
}

fn reply(byte: u8) -> Encoded {
    Encoded::from_slice(&[byte; 12]).expect("it fits")
}

fn rejected(decision: &Decision) -> Option<WireError> {
    match decision {
        Decision::Reject { error, .. } => Some(*error),
        _ => None,
    }
}

#[test]
fn a_new_greeting_begins_a_new_session() {
    let mut device = Session::new(17);
    assert_eq!(device.number(), 0);
    let first = greet(&mut device, 1);
    assert_eq!(device.number(), first);
    served(&mut device, first, 100, &set(1), 1);

    let second = greet(&mut device, 2);
    assert_ne!(second, first);
    assert_eq!(device.number(), second);
    let old = request(&mut device, first, 101, &set(2));
    assert_eq!(rejected(&old), Some(WireError::NoSession));
    // A new session accepts any first sequence number, and never repeats an answer of the old one.
    execute(&mut device, second, 100, &set(1));
}

#[test]
fn a_repeated_greeting_goes_on_with_its_session() {
    let mut device = Session::new(17);
    let session = greet(&mut device, 5);
    served(&mut device, session, 100, &set(1), 1);
    assert_eq!(greet(&mut device, 5), session);
    let again = request(&mut device, session, 100, &set(1));
    assert_eq!(again, Decision::Resend(reply(1)));
    let stale = request(&mut device, session, 99, &set(2));
    assert_eq!(rejected(&stale), Some(WireError::Stale));
}

#[test]
fn session_numbers_go_round_without_zero() {
    let mut device = Session::new(0);
    let numbers: Vec<_> = (1..=600).map(|nonce| greet(&mut device, nonce)).collect();
    assert!(!numbers.contains(&0));
    for window in numbers.windows(255) {
        let different: std::collections::BTreeSet<_> = window.iter().collect();
        assert_eq!(different.len(), 255);
    }
}

#[test]
fn a_restarted_device_begins_with_another_number() {
    let first = |boot| greet(&mut Session::new(boot), 1);
    for boot in [0, 1, 254, 255, 256, u32::MAX - 1] {
        assert_ne!(first(boot), first(boot + 1), "{boot}");
    }
}

/// A program that has not noticed the switching-on must not speak in the session of the next one.
#[test]
fn two_programs_get_different_numbers_from_a_device_that_was_switched_on_twice() {
    let numbers: std::collections::BTreeSet<_> = (0..254)
        .map(|nonce| greet(&mut Session::new(1), nonce))
        .collect();
    assert_eq!(numbers.len(), 254);
}

/// Whoever held the number that followed from the boot id at the last switching-on must not find it in use again.
#[test]
fn the_first_nonce_leads_to_any_number_but_the_last_one() {
    for boot in [0, 1, 253, 254, 255, 1_000] {
        let last = (boot % 255) as u8 + 1;
        let mut numbers: Vec<_> = (0..254)
            .map(|nonce| greet(&mut Session::new(boot), nonce))
            .collect();
        numbers.sort_unstable();
        let all_others: Vec<_> = (1..=255).filter(|&number| number != last).collect();
        assert_eq!(numbers, all_others, "{boot}");
    }
}

/// Before the first greeting there is no session, whatever number a frame has.
#[test]
fn nothing_runs_before_a_greeting() {
    for session in 0..=u8::MAX {
        let mut device = Session::new(3);
        let early = request(&mut device, session, 1, &Request::KeepAlive(KeepAlive));
        assert_eq!(rejected(&early), Some(WireError::NoSession), "{session}");
    }
}

#[test]
fn the_last_answers_are_kept() {
    let mut device = Session::new(1);
    let session = greet(&mut device, 1);
    let newest = 20_u8;
    for number in 1..=newest {
        let seq = number.into();
        served(&mut device, session, seq, &set(seq), number);
    }
    for number in 1..=newest {
        let seq = number.into();
        let again = request(&mut device, session, seq, &set(seq));
        if usize::from(newest - number) < CACHED_REPLIES {
            assert_eq!(again, Decision::Resend(reply(number)));
        } else {
            assert_eq!(rejected(&again), Some(WireError::Stale), "{number}");
        }
    }
}

#[test]
fn an_answer_that_comes_after_a_new_greeting_is_not_kept() {
    let mut device = Session::new(1);
    let old = greet(&mut device, 1);
    let late = execute(&mut device, old, 100, &set(1));
    let session = greet(&mut device, 2);
    device.remember(late, &reply(1));
    execute(&mut device, session, 100, &set(1));
}

/// A single different bit makes it another request.
#[test]
fn a_number_is_good_for_one_body() {
    let name = "a bench by the window".try_into().expect("it fits");
    let first = Request::SetName(Name { name });
    let mut device = Session::new(1);
    let session = greet(&mut device, 1);
    served(&mut device, session, 100, &first, 1);

    let frame = encode(
        Header {
            kind: Kind::Request,
            session,
            seq: 100,
        },
        &first,
    )
    .unwrap();
    let mut deframer = Deframer::new();
    let body = frame
        .iter()
        .find_map(|&byte| deframer.push(byte).map(|frame| frame.body().to_vec()))
        .expect("a frame");
    for bit in 0..8 * body.len() {
        let mut other: [u8; 23] = body[..].try_into().expect("kind, length and 21 letters");
        other[bit / 8] ^= 1 << (bit % 8);
        // An array is encoded as its bytes alone.
        let again = receive(&mut device, Kind::Request, session, 100, &other);
        assert_eq!(
            rejected(&again),
            Some(WireError::SequenceReused),
            "bit {bit}"
        );
    }
    let again = request(&mut device, session, 100, &first);
    assert_eq!(again, Decision::Resend(reply(1)));
}

/// Only the number matters, and it goes round.
#[test]
fn sequence_numbers_go_round() {
    let mut device = Session::new(1);
    let session = greet(&mut device, 1);
    for seq in (20..=u16::MAX).step_by(8_000).chain([u16::MAX, 0, 1]) {
        execute(&mut device, session, seq, &set(seq));
    }
}

#[test]
fn a_mismatch_refuses_all_rows_that_need_a_match() {
    let other = Version {
        major: VERSION.major + 1,
        minor: 0,
    };
    for (protocol, schema_key) in [(VERSION, SCHEMA_KEY ^ 1), (other, SCHEMA_KEY)] {
        let mut device = Session::new(1);
        let hello = Request::Hello(Hello {
            protocol,
            schema_key,
            nonce: 1,
        });
        let Decision::Greet { session, .. } = request(&mut device, 0, 9, &hello) else {
            panic!("Hello is always answered")
        };
        for (seq, asked) in (1..).zip(exemplars::requests().into_iter().skip(1)) {
            let decision = request(&mut device, session, seq, &asked);
            let refused = matches!(
                decision,
                Decision::Refuse {
                    refusal: Refusal::Incompatible,
                    ..
                }
            );
            assert_eq!(refused, asked.needs_match(), "{}", asked.name());
        }
    }
}

#[test]
fn what_is_no_message_is_malformed_and_uses_no_number() {
    let mut device = Session::new(1);
    let session = greet(&mut device, 1);
    let nonsense = receive(&mut device, Kind::Request, session, 100, &[0xEE_u8; 3]);
    assert_eq!(rejected(&nonsense), Some(WireError::Malformed));
    execute(&mut device, session, 100, &set(1));
    let nonsense = receive(&mut device, Kind::Urgent, session, 7, &[0xEE_u8; 3]);
    let expected = Decision::Reject {
        error: WireError::Malformed,
        session,
        seq: 7,
    };
    assert_eq!(nonsense, expected);
}

#[test]
fn a_stop_is_taken_in_any_session() {
    for session in [0, 1, 200] {
        let mut device = Session::new(1);
        let stop = receive(&mut device, Kind::Urgent, session, 7, &Urgent::EStop);
        let expected = Decision::Urgent {
            urgent: Urgent::EStop,
            session,
            seq: 7,
        };
        assert_eq!(stop, expected);
    }
}

#[test]
fn a_device_ignores_what_devices_send() {
    let mut device = Session::new(1);
    let session = greet(&mut device, 1);
    let event = Event {
        index: 0,
        time_us: 1,
        what: What::Acknowledged,
    };
    for kind in [Kind::Reply, Kind::Telemetry, Kind::Event] {
        let decision = receive(&mut device, kind, session, 1, &event);
        assert_eq!(decision, Decision::Ignore, "{kind:?}");
    }
}

#[test]
fn old_events_give_way_and_the_answer_says_so() {
    let mut ring = EventRing::new();
    for time_us in 0..RING as u64 + 5 {
        ring.record(time_us, What::LinkLost);
    }
    let events = ring.since(0);
    assert_eq!((events.oldest, events.next), (5, RING as u32 + 5));
    let indices: Vec<_> = events.events.iter().map(|event| event.index).collect();
    assert_eq!(indices, [5, 6, 7]);
    assert!(ring.since(RING as u32 + 5).events.is_empty());
}
