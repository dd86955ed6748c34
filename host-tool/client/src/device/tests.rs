//! The host beside a line that is dead, and beside a machine that answers as it is told.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use protocol::frame::{Deframer, Header, Kind, encode};
use protocol::rig::{self, RigEvent};
use protocol::session::{Decision, Session};
use protocol::settings::Setting;
use protocol::system::{BuildProfile, Done, Event, Events, KeepAlive, ResetCause, Revision, What};
use protocol::table::{Endpoint, Reply, Request};

use super::*;
use crate::device::waiting::tests::At;
use crate::error::Missing;

#[test]
fn a_line_that_was_given_up_is_like_a_pulled_cable() {
    let mut device = Device::new(Box::new(At(7)), 1);
    device.hang_up();
    assert_eq!((device.place(), device.now_us()), ("nowhere".to_owned(), 7));
    let sent = device.link.send(b"x").map(|()| 0);
    for result in [sent, device.link.receive(&mut [0; 8], 9)] {
        let said = result.expect_err("lost").to_string();
        assert!(
            said.contains("nowhere") && said.contains("given up"),
            "{said}"
        );
    }
}

/// A machine's reply to a request; none if it stays silent.
type Answers = fn(&Request) -> Option<Reply>;

/// A machine that answers as it is told, in time that passes when the host waits.
struct Machine {
    session: Session,
    deframer: Deframer,
    unread: VecDeque<u8>,
    now_us: u64,
    answers: Arc<Mutex<Answers>>,
    stops: bool,
    owner: Option<Owner>,
    /// Questions of another process.
    questions: Arc<Mutex<Vec<Question>>>,
}

impl Machine {
    fn say(&mut self, session: u8, seq: u16, reply: &Reply) {
        let header = Header {
            kind: Kind::Reply,
            session,
            seq,
        };
        let frame = encode(header, reply).expect("fits");
        self.unread.extend(frame.iter());
    }
}

const IDENTITY: Identity = Identity {
    device: DeviceKind::Rig,
    protocol: VERSION,
    schema_key: SCHEMA_KEY,
    uid: [7; 12],
    revision: Revision {
        commit: 1,
        dirty: false,
    },
    profile: BuildProfile::Firmware,
    boot_id: 1,
    reset_cause: ResetCause::PowerOn,
    session: 0,
};

impl Link for Machine {
    fn place(&self) -> String {
        "there".to_owned()
    }

    fn now_us(&self) -> u64 {
        self.now_us
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        for byte in bytes {
            let Some(frame) = self.deframer.push(*byte) else {
                continue;
            };
            let decision = self.session.receive(&frame);
            match decision {
                Decision::Greet { session, seq } => {
                    let hello = Response::Hello(Identity {
                        session,
                        ..IDENTITY
                    });
                    self.say(session, seq, &Reply::Accepted(hello));
                }
                Decision::Execute { request, ticket } => {
                    let answers = *self.answers.lock().expect("no panic");
                    if let Some(reply) = answers(&request) {
                        self.say(ticket.session, ticket.seq, &reply);
                    }
                }
                Decision::Urgent {
                    urgent,
                    session,
                    seq,
                } if self.stops => {
                    self.say(session, seq, &Reply::Urgent(urgent));
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        if self.unread.is_empty() {
            self.now_us = self.now_us.max(deadline_us);
        }
        let count = buffer.len().min(self.unread.len());
        for (slot, byte) in buffer.iter_mut().zip(self.unread.drain(..count)) {
            *slot = byte;
        }
        Ok(count)
    }

    fn owner(&self) -> Option<&Owner> {
        self.owner.as_ref()
    }

    fn question(&mut self) -> Option<Question> {
        self.questions.lock().expect("no panic").pop()
    }
}

/// Reply of every machine to the requests with which a host introduces itself.
fn usual(request: &Request) -> Option<Reply> {
    Some(Reply::Accepted(match request {
        Request::GetEvents(_) => Response::GetEvents(events(5, 5, &[])),
        Request::GetSetting(asked) => Response::GetSetting(Setting {
            key: asked.key,
            value: 1_000,
        }),
        Request::KeepAlive(_) => Response::KeepAlive(Done),
        _ => return None,
    }))
}

fn events(oldest: u32, next: u32, indices: &[u32]) -> Events {
    let event = |index: &u32| Event {
        index: *index,
        time_us: 0,
        what: What::Acknowledged,
    };
    Events {
        oldest,
        next,
        events: indices.iter().map(event).collect(),
    }
}

/// A host that is connected to a machine, and how that answers from now on.
fn connected(stops: bool, owner: Option<Owner>) -> (Device, Arc<Mutex<Answers>>) {
    let answers = Arc::new(Mutex::new(usual as Answers));
    let machine = Machine {
        session: Session::new(1),
        deframer: Deframer::new(),
        unread: VecDeque::new(),
        now_us: 1_000,
        answers: Arc::clone(&answers),
        stops,
        owner,
        questions: Arc::default(),
    };
    let device = Device::connect(Box::new(machine), DeviceKind::Rig, 9).expect("it answers");
    (device, answers)
}

#[test]
fn events_that_the_machine_has_dropped_are_counted_and_the_others_delivered_once() {
    let (mut device, answers) = connected(true, None);
    let indices = |device: &mut Device| -> Vec<u32> {
        let found = device.take_events().expect("answered");
        found.iter().map(|event| event.index).collect()
    };
    // The next one, 5, is the oldest that there is.
    *answers.lock().expect("no panic") = |request| match request {
        Request::GetEvents(from) => {
            let all: Vec<u32> = (from.from..7).collect();
            Some(Reply::Accepted(Response::GetEvents(events(5, 7, &all))))
        }
        other => usual(other),
    };
    assert_eq!(indices(&mut device), [5, 6]);
    assert_eq!(device.take_lost_events(), 0);
    // Of 7 to 19 the machine keeps the last five, and sends two at a time.
    *answers.lock().expect("no panic") = |request| match request {
        Request::GetEvents(from) => {
            let first = from.from.max(15);
            let some: Vec<u32> = (first..20).take(2).collect();
            Some(Reply::Accepted(Response::GetEvents(events(15, 20, &some))))
        }
        other => usual(other),
    };
    assert_eq!(indices(&mut device), [15, 16, 17, 18, 19]);
    assert_eq!(device.take_lost_events(), 8);
    assert_eq!(device.take_lost_events(), 0);
    assert!(indices(&mut device).is_empty());
}

#[test]
fn a_stop_that_is_not_confirmed_is_said_also_while_an_answer_is_awaited() {
    let (mut device, answers) = connected(false, None);
    *answers.lock().expect("no panic") = |_| None;
    device.post(rig::GetRigStatus).expect("sent");
    device.set_interrupt(Arc::new(|| Some(Urgent::Stop)));
    let later_us = device.now_us() + 60_000_000;
    let error = device.attend(later_us, &mut observer::Unobserved);
    let error = error.expect_err("no confirmation");
    assert!(
        matches!(
            error,
            ClientError::Unanswered {
                missing: Missing::Stop,
                ..
            }
        ),
        "{error:?}"
    );
    assert!(!device.is_posted());
}

#[test]
fn a_machine_that_promises_events_and_sends_none_is_not_asked_for_ever() {
    let (mut device, answers) = connected(true, None);
    *answers.lock().expect("no panic") = |request| match request {
        Request::GetEvents(_) => Some(Reply::Accepted(Response::GetEvents(events(5, 9, &[])))),
        other => usual(other),
    };
    assert_eq!(device.take_events().expect("answered"), []);
}

/// Of the events only those that say that it stands.
#[test]
fn an_event_that_is_no_end_leaves_a_machine_moving() {
    let resumed = |request: &Request| match request {
        Request::Resume(_) => Some(Reply::Accepted(Response::Resume(Done))),
        other => usual(other),
    };
    let stopped = What::Rig(RigEvent::Stopped { position_steps: 0 });
    for (what, moves) in [(What::Acknowledged, true), (stopped, false)] {
        let (mut device, answers) = connected(true, None);
        *answers.lock().expect("no panic") = resumed;
        device.call(rig::Resume).expect("resumed");
        let index = device.inbox.next;
        device.note_event(Event {
            index,
            time_us: 0,
            what,
        });
        assert_eq!(device.motion.reported, moves, "{what:?}");
        // An event that has been delivered is not delivered again.
        device.note_event(Event {
            index,
            time_us: 0,
            what,
        });
        assert_eq!(device.inbox.events.len(), 1);
    }
}

#[test]
fn an_order_for_the_owner_of_the_line_is_not_sent() {
    let owner = Owner::this_process();
    let (mut device, answers) = connected(true, Some(owner.clone()));
    *answers.lock().expect("no panic") = |request| panic!("{request:?}");
    let error = device.call(rig::Home).expect_err("another's");
    let ClientError::Owned {
        request, owner: by, ..
    } = error
    else {
        panic!("{error:?}");
    };
    assert_eq!((request, *by), ("Home", owner));
}

/// A command that the stop has cancelled ends when the stop is confirmed, and not before.
#[test]
fn a_command_that_a_stop_cancels_ends_with_the_confirmation() {
    for is_posted in [false, true] {
        let (mut device, answers) = connected(true, None);
        *answers.lock().expect("no panic") = |_| None;
        // The operator stops when the order is out.
        let polls = Arc::new(Mutex::new(0));
        device.set_interrupt(Arc::new(move || {
            let mut polls = polls.lock().expect("no panic");
            *polls += 1;
            (*polls > 3).then_some(Urgent::Stop)
        }));
        let error = if is_posted {
            device.post(rig::Home).expect("sent");
            let later_us = device.now_us() + 60_000_000;
            device.attend(later_us, &mut observer::Unobserved).err()
        } else {
            device.call(rig::Home).err()
        };
        assert!(
            matches!(error, Some(ClientError::Interrupted { request: "Home" })),
            "{error:?}"
        );
        assert!(!device.stop.unconfirmed && device.pending.is_none());
    }
}

#[test]
fn a_question_of_another_process_waits_for_a_session_and_for_a_stop() {
    let questions: Arc<Mutex<Vec<Question>>> = Arc::default();
    let (answer, answered) = std::sync::mpsc::channel();
    questions.lock().expect("no panic").push(Question::new(
        KeepAlive.into_request(),
        move |reply| {
            answer.send(reply).expect("heard");
        },
    ));
    let machine = Machine {
        session: Session::new(1),
        deframer: Deframer::new(),
        unread: VecDeque::new(),
        now_us: 0,
        answers: Arc::new(Mutex::new(usual as Answers)),
        stops: true,
        owner: None,
        questions: Arc::clone(&questions),
    };
    let mut device = Device::new(Box::new(machine), 1);
    device.serve().expect("nothing to do yet");
    // The stop goes first, also before the session.
    device.stop.unconfirmed = true;
    device.serve().expect("nothing to do yet");
    assert_eq!(answered.try_iter().count(), 0);
    device.stop.unconfirmed = false;
    device.hello(9).expect("it answers");
    device.serve().expect("answered");
    let reply = Reply::Accepted(Response::KeepAlive(Done));
    assert_eq!(answered.try_iter().collect::<Vec<_>>(), [Some(reply)]);
}

/// A line on which this comes, and then nothing more.
struct Says(&'static [u8]);

impl Link for Says {
    fn place(&self) -> String {
        "there".to_owned()
    }
    fn now_us(&self) -> u64 {
        0
    }
    fn send(&mut self, _: &[u8]) -> Result<(), LinkError> {
        Ok(())
    }
    fn receive(&mut self, buffer: &mut [u8], _: u64) -> Result<usize, LinkError> {
        let said = std::mem::take(&mut self.0);
        if said.is_empty() {
            return Err(LinkError::Lost {
                place: self.place(),
                why: "closed".to_owned(),
            });
        }
        buffer[..said.len()].copy_from_slice(said);
        Ok(said.len())
    }
}

#[test]
fn another_server_that_closes_the_connection_is_told_from_a_line_that_breaks() {
    for (said, is_told) in [
        (&b"HTTP/1.1 400 Bad Request\r\n"[..], true),
        (b"SSH-2.0-OpenSSH_9.2\r\n", true),
        (b"READY\r\n", true),
        (b"", false),
        (b"\x01\x82\xf3\x04", false),
    ] {
        let error = Device::new(Box::new(Says(said)), 1).hello(1);
        let error = error.expect_err("no machine");
        let found = matches!(error, ClientError::NoAnswer { .. });
        assert_eq!(found, is_told, "{error:?}");
    }
}
