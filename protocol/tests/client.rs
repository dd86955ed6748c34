//! The host's client alone: the frames it accepts, the times it sends, and its counters.

use protocol::{
    client::{ATTEMPTS, Client, NotNow, Output, Poll, RETRY_AFTER_US},
    error::{Refusal, WireError},
    frame::{Deframer, Encoded, Header, Kind, encode},
    system::{Done, KeepAlive, Urgent},
    table::{Reply, Request, Response, Telemetry},
};
use serde::Serialize;

const KEEP_ALIVE: Request = Request::KeepAlive(KeepAlive);
const SESSION: u8 = 7;

/// Feeds a frame from the device; returns the client's output, if any.
fn hear<T: Serialize>(client: &mut Client, kind: Kind, seq: u16, body: &T) -> Option<Output> {
    let session = SESSION;
    let frame = encode(Header { kind, session, seq }, body).expect("it fits");
    let mut outputs = frame.iter().filter_map(|&byte| client.receive(byte));
    let output = outputs.next();
    assert_eq!(outputs.next(), None);
    output
}

fn header(frame: &Encoded) -> Header {
    let mut deframer = Deframer::new();
    let mut bytes = frame.iter();
    bytes
        .find_map(|&byte| deframer.push(byte).map(|frame| frame.header))
        .expect("a frame")
}

/// The stop in a frame.
fn urgent(frame: &Encoded) -> Option<Urgent> {
    let mut deframer = Deframer::new();
    let mut bytes = frame.iter();
    bytes.find_map(|&byte| deframer.push(byte)?.decode())
}

/// The frame that the client sends now.
fn sent(client: &mut Client, now_us: u64) -> Encoded {
    match client.poll(now_us) {
        Poll::Transmit(frame) => frame,
        other => panic!("{other:?} instead of a frame"),
    }
}

/// Answers the pending Hello.
fn greet(client: &mut Client, now_us: u64) {
    let hello = header(&sent(client, now_us));
    let identity = crate::parties::Device::new().identity(SESSION);
    let reply = Reply::Accepted(Response::Hello(identity));
    assert!(hear(client, Kind::Reply, hello.seq, &reply).is_some());
}

fn connected() -> Client {
    let mut client = Client::default();
    client.hello(1).expect("nothing is pending");
    greet(&mut client, 0);
    client
}

/// Number of samples reported as lost before this one; none if the sample was ignored.
fn missed(client: &mut Client, seq: u16) -> Option<u16> {
    let [sample, ..] = exemplars::telemetry()[..] else {
        panic!("no exemplar")
    };
    match hear(client, Kind::Telemetry, seq, &sample) {
        Some(Output::Telemetry {
            missed,
            sample: Telemetry::Rig(_),
        }) => Some(missed),
        None => None,
        other => panic!("{other:?} instead of a sample"),
    }
}

/// Whether the client passes an event on.
fn told(client: &mut Client) -> bool {
    let event = exemplars::events()[0];
    match hear(client, Kind::Event, 302, &event) {
        Some(output) => {
            assert_eq!(output, Output::Event(event));
            true
        }
        None => false,
    }
}

#[test]
fn without_a_session_nothing_is_asked_for_and_nothing_is_taken() {
    let mut client = Client::default();
    let deaf = |client: &mut Client| {
        assert!(!client.is_open());
        assert_eq!((missed(client, 5), told(client)), (None, false));
    };
    deaf(&mut client);
    assert_eq!(client.request(&KEEP_ALIVE), Err(NotNow));
    assert_eq!(client.poll(0), Poll::WaitUntil(u64::MAX));

    client.hello(1).unwrap();
    deaf(&mut client);
    greet(&mut client, 0);
    assert!(client.is_open());
    assert_eq!((missed(&mut client, 5), told(&mut client)), (Some(0), true));

    // A new greeting ends the session at once.
    client.hello(2).unwrap();
    deaf(&mut client);
}

#[test]
fn requests_carry_the_session_and_each_its_own_number() {
    let mut client = Client::default();
    client.hello(1).unwrap();
    let hello = header(&sent(&mut client, 0));
    assert_eq!((hello.kind, hello.session), (Kind::Request, 0));
    let mut client = connected();
    let mut before = hello.seq;
    for _ in 0..3 {
        client.request(&KEEP_ALIVE).unwrap();
        let header = header(&sent(&mut client, 0));
        assert_eq!((header.kind, header.session), (Kind::Request, SESSION));
        assert_eq!(header.seq, before + 1);
        before = header.seq;
        let done = Reply::Accepted(Response::KeepAlive(Done));
        let output = hear(&mut client, Kind::Reply, header.seq, &done);
        assert_eq!(output, Some(Output::Accepted(Response::KeepAlive(Done))));
    }
}

#[test]
fn one_request_is_pending_at_a_time() {
    let mut client = connected();
    client.request(&KEEP_ALIVE).unwrap();
    assert_eq!(client.request(&KEEP_ALIVE), Err(NotNow));
    assert_eq!(client.hello(2), Err(NotNow));
}

#[test]
fn an_answer_to_something_else_leaves_the_request_pending() {
    let mut client = connected();
    client.request(&KEEP_ALIVE).unwrap();
    let first = sent(&mut client, 0);
    let seq = header(&first).seq;
    for (kind, seq) in [(Kind::Reply, seq - 1), (Kind::Reply, seq + 1)] {
        let done = Reply::Accepted(Response::KeepAlive(Done));
        assert_eq!(hear(&mut client, kind, seq, &done), None);
    }
    // Ignores an echo of its own frame.
    assert_eq!(hear(&mut client, Kind::Request, seq, &KEEP_ALIVE), None);
    assert_eq!(sent(&mut client, RETRY_AFTER_US), first);

    let refused = Reply::Refused(Refusal::NotHomed);
    let output = hear(&mut client, Kind::Reply, seq, &refused);
    assert_eq!(output, Some(Output::Refused(Refusal::NotHomed)));
    // Accepts a reply once only.
    assert_eq!(hear(&mut client, Kind::Reply, seq, &refused), None);
    assert_eq!(client.poll(RETRY_AFTER_US), Poll::WaitUntil(u64::MAX));
}

#[test]
fn a_request_is_repeated_on_time_and_byte_for_byte() {
    let mut client = connected();
    client.request(&KEEP_ALIVE).unwrap();
    let first = sent(&mut client, 1_000);
    let again_us = 1_000 + RETRY_AFTER_US;
    for now_us in [1_000, again_us - 1] {
        assert_eq!(client.poll(now_us), Poll::WaitUntil(again_us));
    }
    assert_eq!(sent(&mut client, again_us), first);
    for attempt in 2..u64::from(ATTEMPTS) {
        assert_eq!(
            sent(&mut client, again_us + attempt * RETRY_AFTER_US),
            first
        );
    }
    let end_us = again_us + u64::from(ATTEMPTS) * RETRY_AFTER_US;
    assert_eq!(client.poll(end_us), Poll::TimedOut);
    // Reports the failure once; then the next request may follow.
    assert_eq!(client.poll(end_us), Poll::WaitUntil(u64::MAX));
    client.request(&KEEP_ALIVE).unwrap();
}

#[test]
fn only_an_unknown_session_closes_ours() {
    for error in [
        WireError::Malformed,
        WireError::SequenceReused,
        WireError::Stale,
        WireError::NoSession,
    ] {
        let mut client = connected();
        client.request(&KEEP_ALIVE).unwrap();
        let seq = header(&sent(&mut client, 0)).seq;
        let output = hear(&mut client, Kind::Reply, seq, &Reply::Wire(error));
        assert_eq!(output, Some(Output::Rejected(error)));
        assert_eq!(client.is_open(), error != WireError::NoSession, "{error:?}");
    }
}

#[test]
fn missed_telemetry_is_counted_within_a_session() {
    let mut client = connected();
    let seen = [65_533, 65_534, 1, 2, 300].map(|seq| missed(&mut client, seq));
    assert_eq!(seen, [0, 0, 2, 0, 297].map(Some));
    client.hello(2).unwrap();
    greet(&mut client, 0);
    assert_eq!(missed(&mut client, 40_000), Some(0));
}

/// A device that has started again sends with its own settings, before this end knows of it.
#[test]
fn what_is_sent_in_no_session_is_not_heard_in_one() {
    let mut client = connected();
    assert_eq!(missed(&mut client, 7), Some(0));
    let of = |kind| Header {
        kind,
        session: 0,
        seq: 0,
    };
    for frame in [
        encode(of(Kind::Telemetry), &exemplars::telemetry()[0]),
        encode(of(Kind::Event), &exemplars::events()[0]),
    ] {
        let frame = frame.expect("it fits");
        assert!(frame.iter().all(|&byte| client.receive(byte).is_none()));
    }
    assert_eq!(missed(&mut client, 8), Some(0));
}

#[test]
fn a_stop_goes_ahead_of_a_request_and_the_request_follows_it() {
    let mut client = connected();
    client.request(&KEEP_ALIVE).unwrap();
    let request = header(&sent(&mut client, 0));
    client.urgent(Urgent::Stop);
    let stop = header(&sent(&mut client, 10));
    assert_eq!((stop.kind, stop.seq), (Kind::Urgent, request.seq + 1));
    // The request is due, but waits for the stop.
    assert_eq!(
        client.poll(RETRY_AFTER_US),
        Poll::WaitUntil(10 + RETRY_AFTER_US)
    );
    let done = Reply::Urgent(Urgent::Stop);
    assert_eq!(hear(&mut client, Kind::Reply, request.seq, &done), None);
    let output = hear(&mut client, Kind::Reply, stop.seq, &done);
    assert_eq!(output, Some(Output::UrgentDone(Urgent::Stop)));
    assert_eq!(hear(&mut client, Kind::Reply, stop.seq, &done), None);
    assert_eq!(header(&sent(&mut client, RETRY_AFTER_US)), request);
}

/// Regression: a stop took the place of an emergency stop that nobody had confirmed.
#[test]
fn an_emergency_stop_that_is_not_confirmed_is_never_weakened() {
    use Urgent::{EStop, Stop};
    for [first, second, wanted] in [
        [Stop, Stop, Stop],
        [Stop, EStop, EStop],
        [EStop, Stop, EStop],
    ] {
        let mut client = connected();
        client.urgent(first);
        sent(&mut client, 0);
        client.urgent(second);
        let frame = sent(&mut client, 10);
        assert_eq!(urgent(&frame), Some(wanted));
        let seq = header(&frame).seq;
        // An answer to another stop confirms nothing, least of all a weaker one.
        let other = Reply::Urgent(if wanted == Stop { EStop } else { Stop });
        assert_eq!(hear(&mut client, Kind::Reply, seq, &other), None);
        let done = Reply::Urgent(wanted);
        let output = hear(&mut client, Kind::Reply, seq, &done);
        assert_eq!(output, Some(Output::UrgentDone(wanted)));
        // A confirmed one is over: the next is as weak as it says.
        client.urgent(Stop);
        assert_eq!(urgent(&sent(&mut client, 20)), Some(Stop));
    }
}

#[test]
fn a_stop_without_an_answer_is_given_up_before_the_request() {
    let mut client = connected();
    client.request(&KEEP_ALIVE).unwrap();
    let request = header(&sent(&mut client, 0));
    client.urgent(Urgent::EStop);
    for attempt in 0..u64::from(ATTEMPTS) {
        let frame = sent(&mut client, attempt * RETRY_AFTER_US);
        assert_eq!(header(&frame).kind, Kind::Urgent);
    }
    let end_us = u64::from(ATTEMPTS) * RETRY_AFTER_US;
    assert_eq!(client.poll(end_us), Poll::TimedOut);
    assert_eq!(header(&sent(&mut client, end_us)), request);
}

/// As when a stop has made it pointless: sent again it would start what was stopped. The session goes on.
#[test]
fn a_request_that_is_forgotten_is_not_sent_again_and_its_answer_not_told() {
    let mut client = connected();
    client.request(&KEEP_ALIVE).unwrap();
    let first = header(&sent(&mut client, 0));
    client.forget();
    assert_eq!(client.poll(RETRY_AFTER_US), Poll::WaitUntil(u64::MAX));
    client.request(&KEEP_ALIVE).expect("in the same session");
    let second = header(&sent(&mut client, RETRY_AFTER_US));
    assert_eq!(second.session, first.session);
    let reply = Reply::Accepted(Response::KeepAlive(Done));
    assert_eq!(hear(&mut client, Kind::Reply, first.seq, &reply), None);
    assert!(hear(&mut client, Kind::Reply, second.seq, &reply).is_some());
}

#[test]
fn bad_frames_are_counted() {
    let mut client = connected();
    assert_eq!(client.rejected_frames(), 0);
    for count in 1..=3 {
        for byte in [3, 1, 2, 3, 0] {
            assert_eq!(client.receive(byte), None);
        }
        assert_eq!(client.rejected_frames(), count);
    }
}

/// A late reply to an earlier connection confirms nothing here, least of all a stop. Only the sequence number
/// distinguishes it from a reply to this connection.
#[test]
fn a_late_reply_to_an_earlier_connection_confirms_nothing() {
    let done = Reply::Urgent(Urgent::EStop);
    let confirmed = Some(Output::UrgentDone(Urgent::EStop));
    let mut earlier = Client::numbering_from(41);
    earlier.urgent(Urgent::EStop);
    let late = header(&sent(&mut earlier, 0)).seq;
    let mut client = Client::numbering_from(7);
    client.urgent(Urgent::EStop);
    let own = header(&sent(&mut client, 0)).seq;
    assert_eq!(hear(&mut client, Kind::Reply, late, &done), None);
    assert_eq!(hear(&mut client, Kind::Reply, own, &done), confirmed);
    client.urgent(Urgent::EStop);
    let next = header(&sent(&mut client, 0)).seq;
    assert_eq!(hear(&mut client, Kind::Reply, own, &done), None);
    assert_eq!(hear(&mut client, Kind::Reply, next, &done), confirmed);
}
