//! Target: requests to `retrograde serve` that come at once, orders and stops among each other, to machines that may
//! be absent, fall silent or lose their line at any moment.

use std::collections::BTreeSet;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};

use client::address::Address;
use client::link::{Link, LinkError};
use protocol::system::DeviceKind;
use protocol::table::Impact;
use serde::{Deserialize, Serialize};
use simulated_machines::link::Memory;
use std::sync::Arc;
use tempfile::TempDir;

use crate::bench::{Bench, Opened, absent};
use crate::exemplary::{Asked, Exemplary};
use crate::http::{self, Body, Machines, Sent, TOKEN};
use crate::script::steps;
use crate::server::{self, Server};

/// Most crowds of a script that are tried.
const MOST_CROWDS: usize = 4;
/// Most requests of a crowd that are tried.
const MOST_REQUESTS: usize = 6;

/// The machines, and how they fail.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Start {
    /// The machines.
    pub machines: Machines,
    /// How they fail.
    pub fate: Fate,
}

/// How the machines fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Fate {
    /// They live.
    Live,
    /// There are none.
    Absent,
    /// They hear so many frames, and nothing more.
    Silent(u8),
    /// Their lines break after so many frames.
    Lost(u8),
}

/// Requests that come at once.
pub type Crowd = Vec<http::Step>;

struct Here {
    asked: Asked,
    willing: bool,
    fate: Fate,
    /// Frames that have been sent to the machines.
    frames: Arc<AtomicU32>,
}

/// A line whose machine may die.
struct Mortal {
    line: Memory<Exemplary>,
    fate: Fate,
    frames: Arc<AtomicU32>,
}

impl Mortal {
    fn lost(&self) -> Result<(), LinkError> {
        match self.fate {
            Fate::Lost(after) if self.frames.load(Ordering::Relaxed) > after.into() => {
                Err(LinkError::Lost {
                    place: self.place(),
                    why: "its cable was pulled".to_owned(),
                })
            }
            _ => Ok(()),
        }
    }
}

impl Link for Mortal {
    fn place(&self) -> String {
        self.line.place()
    }

    fn now_us(&self) -> u64 {
        self.line.now_us()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let before = self.frames.fetch_add(1, Ordering::Relaxed);
        self.lost()?;
        match self.fate {
            Fate::Silent(after) if before >= after.into() => Ok(()),
            _ => self.line.send(bytes),
        }
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.lost()?;
        self.line.receive(buffer, deadline_us)
    }
}

impl Here {
    fn open(&self, kind: DeviceKind) -> Opened {
        if self.fate == Fate::Absent {
            return Err(absent());
        }
        let machine = Exemplary::new(kind, self.willing, &self.asked);
        Ok(Box::new(Mortal {
            line: Memory::new("bench", machine),
            fate: self.fate,
            frames: Arc::clone(&self.frames),
        }))
    }
}

/// Runs a script.
///
/// # Panics
/// The server violates what it promises.
pub fn target(data: &[u8]) {
    let Ok((start, data)) = postcard::take_from_bytes::<Start>(data) else {
        return;
    };
    static OUT: OnceLock<TempDir> = OnceLock::new();
    let out = OUT.get_or_init(|| tempfile::tempdir().expect("a folder"));
    let place = |name: &str| Address::Serial(name.to_owned());
    let mut places = vec![(DeviceKind::Rig, place("rig"))];
    if start.machines.both {
        places.push((DeviceKind::Capsule, place("capsule")));
    }
    let here = Here {
        asked: Asked::default(),
        willing: start.machines.willing,
        fate: start.fate,
        frames: Arc::default(),
    };
    let bench = Bench(|kind| here.open(kind));
    server::with(&bench, &places, TOKEN, out.path(), |server| {
        let mut keys = BTreeSet::new();
        let machines = if start.machines.both { 2 } else { 1 };
        for crowd in steps::<Crowd>(data).take(MOST_CROWDS) {
            ask(server, &here, &crowd, &mut keys);
        }
        still_serves(server, &here, machines);
    });
    http::tidy(out.path());
}

/// Sends the requests of a crowd at once, and judges what has reached the machines by all of them.
fn ask(server: &mut Server<'_>, here: &Here, crowd: &Crowd, keys: &mut BTreeSet<Vec<u8>>) {
    let crowd = &crowd[..crowd.len().min(MOST_REQUESTS)];
    let sent: Vec<_> = crowd.iter().map(Sent::new).collect();
    let headers: Vec<_> = sent.iter().map(Sent::headers).collect();
    let asked: Vec<_> = sent
        .iter()
        .zip(&headers)
        .map(|(sent, headers)| sent.asked(headers))
        .collect();
    let before = here.asked.notes().clone();
    let answers = server.ask_together(&asked);
    let after = here.asked.notes().clone();
    let changes = &after.changes[before.changes.len()..];
    let stops = &after.stops[before.stops.len()..];
    for (sent, answer) in sent.iter().zip(&answers) {
        let Some(answer) = answer else { continue };
        http::judge(answer, &sent.method, &sent.uri);
        // A stop is confirmed only if a machine got one.
        if is_stop(sent) && answer.status == 200 {
            assert!(
                !stops.is_empty(),
                "told of a stop that nobody got: {crowd:?}"
            );
        }
    }
    if !sent.iter().any(Sent::may_stop) {
        assert_eq!(stops, [], "stopped by somebody who must not: {crowd:?}");
    }
    // At least one key must be new: nothing was executed for it before. If only one was sent, it is known which.
    let may = sent.iter().filter(|sent| sent.may_order());
    let may: BTreeSet<_> = may.filter_map(Sent::key).collect();
    if !changes.is_empty() {
        let is_new = may.iter().any(|key| !keys.contains(key));
        assert!(is_new, "without a token, or again: {crowd:?}");
        if may.len() == 1 {
            keys.extend(may);
        }
    }
    // Orders from before a stop are refused, wherever they waited.
    let last = sent.iter().zip(crowd).zip(&answers).next_back();
    if let Some(((sent, step), Some(answer))) = last
        && is_stop(sent)
        && matches!(step.body, Body::Empty)
        && answer.status == 200
    {
        let moves = |change: &&(DeviceKind, _)| motion(&change.1);
        assert_eq!(changes.iter().find(moves), None, "after a stop: {crowd:?}");
    }
}

fn motion(request: &protocol::table::Request) -> bool {
    request.impact() == Impact::Motion
}

fn is_stop(sent: &Sent) -> bool {
    sent.method == "POST" && ["/api/v1/stop", "/api/v1/estop"].contains(&&*sent.uri)
}

/// Checks that a stop from this computer is confirmed only if each machine got it.
fn still_serves(server: &mut Server<'_>, here: &Here, machines: usize) {
    let before = here.asked.notes().stops.len();
    let answer = server.ask(server::Asked {
        here: true,
        method: "POST",
        uri: "/api/v1/estop",
        headers: &[("host", b"localhost")],
        body: b"",
    });
    let answer = answer.expect("a request");
    http::judge(&answer, "POST", "/api/v1/estop");
    let notes = here.asked.notes();
    let stopped: BTreeSet<_> = notes.stops[before..]
        .iter()
        .map(|stop| stop.0 as u8)
        .collect();
    let got = stopped.len() == machines;
    assert_eq!(
        answer.status == 200,
        got,
        "{}",
        String::from_utf8_lossy(&answer.body)
    );
    assert!(got || here.fate != Fate::Live, "the stop reached nobody");
}
