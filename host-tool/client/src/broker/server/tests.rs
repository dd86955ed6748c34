//! The broker, its owner and its clients within one process.

use std::sync::mpsc::{Receiver, channel};

use protocol::rig;
use protocol::system::{BuildProfile, DeviceKind, Hello, ResetCause, Revision};
use protocol::table::{Endpoint, SCHEMA_KEY};

use super::*;

/// A line that keeps what is written to it.
struct Tap(std::sync::mpsc::Sender<Vec<u8>>);

impl Write for Tap {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let _ = self.0.send(bytes.to_vec());
        Ok(bytes.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn core() -> (Arc<Core>, Receiver<Vec<u8>>) {
    core_at(None)
}

fn core_at(line_files: Option<LineFiles>) -> (Arc<Core>, Receiver<Vec<u8>>) {
    let (tap, written) = channel();
    (Core::new(Box::new(Tap(tap)), false, line_files), written)
}

#[test]
fn a_line_that_is_no_longer_offered_is_given_to_nobody() {
    let (core, _written) = core();
    assert!(!core.want_line() && !core.is_line_wanted());
    core.offer_line(true);
    assert!(core.want_line() && core.is_line_wanted());
    // The owner begins to work: a client that wanted the line has to ask again.
    core.offer_line(false);
    assert!(!core.is_line_wanted() && !core.want_line());
    assert!(!core.is_line_wanted());
}

fn request(seq: u16) -> Encoded {
    let header = Header {
        kind: Kind::Request,
        session: 1,
        seq,
    };
    encode(header, &rig::Home.into_request()).expect("fits")
}

const STOP: Header = Header {
    kind: Kind::Urgent,
    session: 3,
    seq: 7,
};

#[test]
fn a_command_that_comes_after_a_stop_nobody_has_noticed_is_not_sent() {
    let (core, written) = core();
    core.send(&request(1)).expect("sent");
    assert_eq!(written.try_iter().count(), 1);
    core.stop(0, STOP, Urgent::Stop).expect("sent");
    assert_eq!(written.try_iter().count(), 1);
    core.send(&request(1)).expect("left out");
    assert_eq!(written.try_iter().count(), 0);
    assert_eq!(core.stopped(), Some(Urgent::Stop));
    core.send(&request(2)).expect("sent");
    assert_eq!(written.try_iter().count(), 1);
    // The owner's own stop never waits.
    core.stop(0, STOP, Urgent::EStop).expect("sent");
    let own = encode(STOP, &Urgent::EStop).expect("fits");
    core.send(&own).expect("sent");
    assert_eq!(written.try_iter().count(), 2);
    assert_eq!(core.stopped(), Some(Urgent::EStop));
}

#[test]
fn an_order_that_a_stop_has_removed_was_certainly_not_sent() {
    let folder = tempfile::tempdir().expect("a folder");
    let line_files = LineFiles::new(folder.path().to_owned(), "one", "one".to_owned());
    let (core, written) = core_at(Some(line_files.clone()));
    // A client that does not see the mark of the stop would send the order again.
    for is_marked in [false, true] {
        let (answers, answered) = channel();
        core.ask(Question::new(rig::Resume.into_request(), move |reply| {
            answers.send(reply).expect("heard");
        }));
        if is_marked {
            line_files.mark_stop(Urgent::Stop);
        }
        core.stop(0, STOP, Urgent::Stop).expect("sent");
        assert_eq!(written.try_iter().count(), 1);
        let not_sent = is_marked.then_some(Reply::Wire(WireError::Stale));
        assert_eq!(answered.try_iter().collect::<Vec<_>>(), [not_sent]);
    }
}

/// Regression: an acknowledgement that waited while the owner stopped the machine was sent after it.
#[test]
fn an_order_that_waited_through_the_owners_stop_is_not_sent() {
    let (core, _written) = core();
    let (answers, answered) = channel();
    core.ask(Question::new(rig::Resume.into_request(), move |reply| {
        answers.send(reply).expect("heard");
    }));
    core.forget_stop();
    assert!(core.question(Instant::now()).is_none());
    let stale = Reply::Wire(WireError::Stale);
    assert_eq!(answered.try_recv(), Ok(Some(stale)));
}

#[test]
fn a_question_that_waited_too_long_is_not_asked() {
    let (core, _written) = core();
    let (answers, answered) = channel();
    let question = |asked| {
        let answers = answers.clone();
        Question {
            request: rig::Resume.into_request(),
            asked,
            answer: Box::new(move |reply| answers.send(reply).expect("heard")),
        }
    };
    let long_ago = Instant::now() - STALE - Duration::from_millis(1);
    core.ask(question(long_ago));
    assert!(core.question(Instant::now()).is_none());
    let stale = Reply::Wire(WireError::Stale);
    assert_eq!(answered.try_recv(), Ok(Some(stale)));
    thread::sleep(QUESTION_INTERVAL);
    core.ask(question(Instant::now()));
    assert!(core.question(Instant::now()).is_some());
    // The next question has to wait, however often the owner observes.
    core.ask(question(Instant::now()));
    assert!(core.question(Instant::now()).is_none());
}

#[test]
fn a_stop_that_nobody_has_noticed_is_not_forgotten() {
    let (core, _written) = core();
    core.stop(0, STOP, Urgent::Stop).expect("sent");
    core.forget_stop();
    assert_eq!(core.stopped(), Some(Urgent::Stop));
    core.forget_stop();
    assert_eq!(core.stopped(), None);
}

#[test]
fn a_stop_does_not_hide_an_emergency_stop() {
    let (core, _written) = core();
    core.stop(0, STOP, Urgent::EStop).expect("sent");
    let later = Header { seq: 8, ..STOP };
    core.stop(0, later, Urgent::Stop).expect("sent");
    assert_eq!(core.stopped(), Some(Urgent::EStop));
}

#[test]
fn a_confirmation_goes_to_the_one_who_stopped() {
    let (core, written) = core();
    let come = || {
        let (frames, told) = sync_channel(WAITING_FRAMES);
        let (number, _) = core.admit(Box::new(|| {}), frames).expect("room");
        (number, told)
    };
    let ((one, to_one), (other, to_other)) = (come(), come());
    let [first, second] = [one, other].map(|client| {
        core.stop(client, STOP, Urgent::Stop).expect("sent");
        header(&written.recv().expect("written"))
            .expect("a frame")
            .seq
    });
    for (seq, urgent, told) in [
        (second, Urgent::Stop, (0, 1)),
        (first, Urgent::EStop, (0, 0)),
        // The owner's own.
        (first.wrapping_sub(1), Urgent::Stop, (0, 0)),
        (first, Urgent::Stop, (1, 0)),
    ] {
        core.confirmed(seq, urgent);
        let heard = (to_one.try_iter().count(), to_other.try_iter().count());
        assert_eq!(heard, told, "{seq} {urgent:?}");
    }
}

#[test]
fn a_stop_keeps_its_number_beside_those_of_others() {
    let (core, written) = core();
    let other = Header { seq: 8, ..STOP };
    let more = (100..100 + MAX_CLIENTS as u16).map(|seq| Header { seq, ..STOP });
    // The last one is so long ago that it is forgotten.
    let all = [STOP, other, STOP, other]
        .into_iter()
        .chain(more)
        .chain([STOP]);
    for header in all {
        core.stop(0, header, Urgent::Stop).expect("sent");
    }
    let numbers: Vec<_> = written
        .try_iter()
        .map(|frame| header(&frame).expect("a frame").seq)
        .collect();
    let after = |count| numbers[0].wrapping_add(count);
    assert_eq!(numbers[1..4], [after(1), after(0), after(1)]);
    assert_eq!(numbers.last(), Some(&after(2 + MAX_CLIENTS as u16)));
}

/// Regression: each opening of the line began at the same number, so a late answer to a stop of an earlier one
/// confirmed a stop that the machine had not heard.
#[test]
fn stops_are_numbered_anew_at_each_opening() {
    let [one, two, three] = [(); 3].map(|()| {
        let (core, written) = core();
        core.stop(0, STOP, Urgent::EStop).expect("sent");
        header(&written.recv().expect("written"))
            .expect("a frame")
            .seq
    });
    // They are random: two of them may be equal.
    assert!((one, two) != (two, three), "{one}");
}

/// An answer `Stale` would say that the machine has not seen it, and the client would ask again.
#[test]
fn a_question_without_an_answer_is_not_called_unseen() {
    let (core, _written) = core();
    core.introduce(&Identity {
        device: DeviceKind::Rig,
        protocol: protocol::VERSION,
        schema_key: SCHEMA_KEY,
        uid: [7; 12],
        revision: Revision {
            commit: 1,
            dirty: false,
        },
        profile: BuildProfile::Firmware,
        boot_id: 1,
        reset_cause: ResetCause::PowerOn,
        session: 1,
    });
    let (frames, told) = sync_channel(WAITING_FRAMES);
    let mut client = ClientSession::new(&core, Box::new(|| {}), frames).expect("a line");
    let frame = |session, seq, request: &Request| {
        let header = Header {
            kind: Kind::Request,
            session,
            seq,
        };
        encode(header, request).expect("fits")
    };
    let hello = Request::Hello(Hello {
        protocol: protocol::VERSION,
        schema_key: SCHEMA_KEY,
        nonce: 5,
    });
    let mut now = Instant::now();
    client.take(&frame(0, 1, &hello), now).expect("taken");
    let welcome = told.try_recv().expect("told");
    let session = header(&welcome).expect("a frame").session;
    let resume = frame(session, 2, &rig::Resume.into_request());
    client.take(&resume, now).expect("taken");
    now += QUESTION_INTERVAL;
    core.question(now).expect("asked").answer(None);
    now += QUESTION_INTERVAL;
    client.take(&resume, now).expect("taken");
    now += QUESTION_INTERVAL;
    assert!(core.question(now).is_none());
    assert!(told.try_recv().is_err(), "nothing is known of it");
}

#[test]
fn a_line_that_is_lost_ends_its_clients_and_says_why_to_its_owner() {
    let (core, _written) = core();
    let (shut, ended) = channel();
    let admit = || {
        let shut = shut.clone();
        let (frames, _) = sync_channel(1);
        core.admit(Box::new(move || shut.send(()).expect("heard")), frames)
    };
    assert!(admit().is_some());
    core.arrived(b"last");
    core.lost("the cable".to_owned());
    core.lost("another reason".to_owned());
    assert_eq!(ended.try_iter().count(), 2);
    assert!(admit().is_none());
    // The owner reads to the end first.
    let mut buffer = [0; 8];
    assert_eq!(core.receive(&mut buffer, Instant::now()), Ok(4));
    let lost = core.receive(&mut buffer, Instant::now());
    assert_eq!(lost, Err("the cable".to_owned()));
}
