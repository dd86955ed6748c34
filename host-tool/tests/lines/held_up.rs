//! A client of a broker whose owner takes its questions too late, as after the whole computer stood still: in memory,
//! with times that the test makes up.

use std::io::sink;
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use client::Device;
use client::broker::server::{ClientSession, Core, WAITING_FRAMES};
use client::error::ClientError;
use client::link::owner::Owner;
use client::link::{Link, LinkError};
use protocol::rig::RigState;
use protocol::system::{DeviceKind, Urgent};
use protocol::table::{Reply, Request, Response};
use simulated_machines::machine::{Log, Script, link};

/// Longer than a client waits for an answer.
const STILL: Duration = Duration::from_secs(2);

/// Longer than the pause that a broker makes between two questions.
const SOON: Duration = Duration::from_millis(20);

/// The client's link, with broker and owner behind it.
struct Late {
    core: Arc<Core>,
    session: ClientSession,
    frames: Receiver<Vec<u8>>,
    owner: Device,
    process: Owner,
    now_us: u64,
    /// The broker's clock.
    now: Instant,
    standstill: Arc<Mutex<Standstill>>,
}

/// How the broker is held up at the next acknowledgement.
#[derive(Default)]
struct Standstill {
    /// The owner takes it too late this many times.
    times: u32,
    /// Meanwhile somebody orders a stop.
    stop: bool,
    overtaken: bool,
}

impl Late {
    fn ask_owner(&mut self) {
        self.now += SOON;
        let Some(question) = self.core.question(self.now) else {
            return;
        };
        let response = match question.request {
            Request::GetEvents(get) => self.owner.call(get).map(Response::GetEvents),
            Request::GetSetting(get) => self.owner.call(get).map(Response::GetSetting),
            Request::Acknowledge(ack) => self.owner.call(ack).map(Response::Acknowledge),
            _ => unreachable!("the test asks nothing else"),
        };
        question.answer(response.ok().map(Reply::Accepted));
    }
}

impl Link for Late {
    fn place(&self) -> String {
        "late".to_owned()
    }
    fn now_us(&self) -> u64 {
        self.now_us
    }
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let taken = self.session.take(bytes, self.now);
        taken.expect("the rules are kept");
        let mut standstill = self.standstill.lock().expect("free");
        if standstill.times > 0 {
            standstill.times -= 1;
            standstill.overtaken = standstill.stop;
            drop(standstill);
            self.now += STILL;
            assert!(self.core.question(self.now).is_none(), "it is old");
        } else {
            drop(standstill);
            self.ask_owner();
        }
        Ok(())
    }
    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        let Ok(frame) = self.frames.try_recv() else {
            self.now_us = deadline_us;
            return Ok(0);
        };
        buffer[..frame.len()].copy_from_slice(&frame);
        Ok(frame.len())
    }
    fn owner(&self) -> Option<&Owner> {
        Some(&self.process)
    }
    fn is_overtaken(&self) -> bool {
        self.standstill.lock().expect("free").overtaken
    }
}

/// A client at a rig with a latched emergency stop.
fn client() -> (Device, Arc<Mutex<Standstill>>, Arc<Mutex<Log>>) {
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = true;
    let (line, log) = link(script);
    let mut owner = Device::connect(line, DeviceKind::Rig, 1).expect("a rig");
    owner.urgent(Urgent::EStop).expect("confirmed");
    assert_eq!(owner.rig_status().expect("status").state, RigState::Faulted);
    let core = Core::new(Box::new(sink()), false, None);
    core.introduce(owner.identity().expect("known"));
    let (sender, frames) = sync_channel(WAITING_FRAMES);
    let session = ClientSession::new(&core, Box::new(|| {}), sender).expect("a line");
    let standstill = Arc::<Mutex<Standstill>>::default();
    let late = Late {
        core,
        session,
        frames,
        owner,
        process: Owner::this_process(),
        now_us: 0,
        now: Instant::now(),
        standstill: Arc::clone(&standstill),
    };
    let client = Device::connect(Box::new(late), DeviceKind::Rig, 2).expect("a broker");
    (client, standstill, log)
}

fn acknowledgements(log: &Mutex<Log>) -> usize {
    let log = log.lock().expect("free");
    let all = log.executed.iter();
    all.filter(|name| **name == "Acknowledge").count()
}

#[test]
fn a_command_that_waited_too_long_is_asked_again_and_carried_out_once() {
    let (mut client, standstill, log) = client();
    standstill.lock().expect("free").times = 3;
    client.acknowledge().expect("carried out");
    assert_eq!(acknowledgements(&log), 1);
}

/// The order is older than the stop, and must not undo it.
#[test]
fn a_command_that_waited_too_long_is_not_asked_again_after_a_stop() {
    let (mut client, standstill, log) = client();
    let set = Standstill {
        times: 1,
        stop: true,
        overtaken: false,
    };
    *standstill.lock().expect("free") = set;
    let error = client.acknowledge().expect_err("stopped");
    // It was certainly not carried out.
    assert!(
        matches!(error, ClientError::Interrupted { .. }),
        "{error:?}"
    );
    assert_eq!(acknowledgements(&log), 0);
}
