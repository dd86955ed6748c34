//! Finds the machine that `--rig` or `--capsule` means, and opens a session with it.

use std::panic::resume_unwind;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use client::address::Address;
use client::broker::lock::LineFiles;
use client::error::{ClientError, Missing};
use client::identity;
use client::link::owner::{Began, StopMark};
use client::{Device, Interrupt};
use protocol::system::{DeviceKind, Identity, Urgent};

use crate::operations::arguments::Which;
use crate::operations::connector::{Candidate, Connector, LinkPurpose};
use crate::operations::delivery::{Delivery, StopReport};
use crate::operations::failure::Failure;
use crate::operations::interrupt;

pub const KINDS: [DeviceKind; 2] = [DeviceKind::Rig, DeviceKind::Capsule];

/// Maximum owners of a line that may exit while this process uses their brokers.
const OWNERS: u32 = 5;

/// Time for an owner that only observes to give up its line.
const YIELDING: Duration = Duration::from_secs(10);

/// Longest wait for another process that only observes briefly.
const SHORT_WAIT: Duration = Duration::from_millis(100);

/// Interval between attempts at a line that is about to be free.
const AGAIN: Duration = Duration::from_millis(10);

/// Polling interval of Ctrl-C while a command waits for the line.
const PRESSED: Duration = Duration::from_millis(20);

pub struct Found {
    pub candidate: Candidate,
    /// The machine that answered, or the reason why none did.
    pub answer: Result<Identity, Failure>,
}

pub struct Target {
    pub kind: Option<DeviceKind>,
    /// Address of the machine; none if it has to be found.
    pub address: Option<Address>,
}

impl Target {
    /// Name of the machine for messages.
    pub fn name(&self) -> &'static str {
        self.kind.map_or("machine", identity::kind_name)
    }

    /// Result of a stop of this machine.
    pub fn report(&self, result: Result<String, Failure>) -> StopReport {
        let (machine, delivery, why) = match result {
            Ok(place) => (place, Delivery::Stopped, String::new()),
            Err(failure) => (self.to_string(), delivery(&failure), failure.to_string()),
        };
        StopReport {
            machine,
            delivery,
            why,
        }
    }
}

/// Name and address, in the user's words.
impl std::fmt::Display for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.address {
            Some(address) => write!(f, "{} at {address}", self.name()),
            None => f.write_str(self.name()),
        }
    }
}

/// Result of a stop that failed this way. If the link broke, the stop may have been sent, so it counts as not
/// confirmed.
fn delivery(failure: &Failure) -> Delivery {
    match failure {
        Failure::Client(
            ClientError::Unanswered {
                missing: Missing::Stop,
                ..
            }
            | ClientError::Link(_),
        ) => Delivery::NotConfirmed,
        _ => Delivery::NotDelivered,
    }
}

/// The start of a command line: a stop since then is newer than its orders, however long the search for the machine
/// takes.
pub struct Beginning {
    began: Began,
    /// Whether the command line has already connected to rig and capsule.
    connected: [AtomicBool; 2],
}

impl Beginning {
    /// A command line that begins now.
    pub fn now() -> Self {
        Self {
            began: Began::now(),
            connected: Default::default(),
        }
    }

    /// The last stop that is older than the orders to this machine; `now` is the latest stop of all. A command line
    /// that reconnects continues after stops that were reported.
    fn mark(&self, kind: DeviceKind, now: StopMark) -> StopMark {
        let connected = &self.connected[usize::from(kind == DeviceKind::Capsule)];
        match connected.swap(true, Ordering::Relaxed) {
            true => now,
            false => now.before(self.began),
        }
    }
}

/// The addresses that the user gave, and the connector to open links to them.
pub struct Finder<'a> {
    pub rig: Option<Address>,
    pub capsule: Option<Address>,
    pub baud: u32,
    pub connector: &'a dyn Connector,
    pub beginning: Beginning,
}

impl Finder<'_> {
    /// The address that the user gave.
    pub fn address(&self, kind: DeviceKind) -> Option<&Address> {
        match kind {
            DeviceKind::Rig => self.rig.as_ref(),
            DeviceKind::Capsule => self.capsule.as_ref(),
        }
    }

    /// The machines for which the user gave an address.
    fn addressed(&self) -> Vec<DeviceKind> {
        KINDS
            .into_iter()
            .filter(|kind| self.address(*kind).is_some())
            .collect()
    }

    /// Opens a session with a machine that speaks the same protocol. From then on Ctrl-C stops the machine.
    pub fn connect(&self, kind: DeviceKind, need: LinkPurpose) -> Result<Device, Failure> {
        let device = self.greet(kind, need)?;
        device.require(kind)?;
        Ok(device)
    }

    /// Opens a session with a machine of this kind, whatever protocol version it speaks.
    pub fn greet(&self, kind: DeviceKind, need: LinkPurpose) -> Result<Device, Failure> {
        let address = self.resolve(kind)?;
        // Note the last stops before waiting for the line: a stop during the wait also applies to this command.
        let line_files = self.connector.line_files(&address);
        let now = LineFiles::last_stops(line_files.as_ref());
        let mark = self.beginning.mark(kind, now);
        let pressed = interrupt::install();
        let interrupt = marking(line_files, Arc::clone(&pressed));
        let mut device = self.open_stoppable(kind, &address, need, &pressed)?;
        // The owner of the line may exit during the request; the line is then free, and a new attempt succeeds.
        for attempt in 1.. {
            need.admit(&device)?;
            device.ordered_at(mark);
            device.set_interrupt(Arc::clone(&interrupt));
            match device.hello(self.connector.nonce()) {
                Err(ClientError::Link(_)) if device.owner().is_some() && attempt < OWNERS => {
                    device = self.open_stoppable(kind, &address, need, &pressed)?;
                }
                Err(error) => return Err(error.into()),
                Ok(_) => break,
            }
        }
        match device.require(kind) {
            Err(ClientError::WrongMachine { found, .. }) if found.device == kind => Ok(device),
            checked => Ok(checked.map(|()| device)?),
        }
    }

    /// Sends an urgent stop before anything else, without a session. Returns the place that confirmed it.
    pub fn urgent(&self, target: &Target, urgent: Urgent) -> Result<String, Failure> {
        let kind = target.kind.unwrap_or(DeviceKind::Rig);
        let address = match &target.address {
            Some(address) => address,
            None => &self.resolve(kind)?,
        };
        if let Some(line_files) = self.connector.line_files(address) {
            line_files.mark_stop(urgent);
        }
        for _ in 1..OWNERS {
            match self.stop_by(kind, address, urgent, LinkPurpose::Stop) {
                // The owner of the line has exited, so the line is free.
                (Err(Failure::Client(error)), _) if error.is_owner_gone() => {}
                (Err(failure), true) => {
                    let (past, _) = self.stop_by(kind, address, urgent, LinkPurpose::StopDirectly);
                    return past.map_err(|_| failure);
                }
                // Without an owner, the stop has already been sent directly.
                (result, _) => return result,
            }
        }
        self.stop_by(kind, address, urgent, LinkPurpose::StopDirectly)
            .0
    }

    /// Sends a stop one way; also returns whether it went through the owner of the line.
    fn stop_by(
        &self,
        kind: DeviceKind,
        address: &Address,
        urgent: Urgent,
        purpose: LinkPurpose,
    ) -> (Result<String, Failure>, bool) {
        let mut device = match self.open(kind, address, purpose) {
            Ok(device) => device,
            Err(failure) => return (Err(failure), false),
        };
        let result = device.urgent(urgent).map(|()| device.place());
        (result.map_err(Into::into), device.owner().is_some())
    }

    /// The targets of an urgent stop: the machines given by the user, or else every place that may be probed. Sends
    /// nothing, except to find a machine given as `auto`.
    pub fn targets_to_stop(&self, which: &Which) -> Vec<Target> {
        let kinds = match which.machine {
            Some(machine) => vec![machine.into()],
            None => self.addressed(),
        };
        if kinds.is_empty() {
            let candidates = self.connector.candidates().into_iter();
            return candidates
                .filter(|candidate| candidate.may_ask)
                .map(|candidate| Target {
                    kind: candidate.kind,
                    address: Some(candidate.address),
                })
                .collect();
        }
        let target = |kind| Target {
            kind: Some(kind),
            address: self
                .address(kind)
                .filter(|address| **address != Address::Auto)
                .cloned(),
        };
        kinds.into_iter().map(target).collect()
    }

    /// As [`Finder::open_for_command`], which may wait for seconds. Ctrl-C during the wait stops the machine at
    /// once, as `retrograde stop` does, because there is no session yet to send the stop.
    ///
    /// # Errors
    /// [`ClientError::Interrupted`] after a confirmed stop, [`Failure::Stops`] after any other.
    fn open_stoppable(
        &self,
        kind: DeviceKind,
        address: &Address,
        need: LinkPurpose,
        interrupt: &Interrupt,
    ) -> Result<Device, Failure> {
        // The session itself sends a stop that was pressed before.
        let before = interrupt();
        let pressed = || interrupt().filter(|urgent| Some(*urgent) != before);
        let target = Target {
            kind: Some(kind),
            address: Some(address.clone()),
        };
        let waits = AtomicBool::new(true);
        // The opened line, unless a stop came first.
        let opened = Mutex::new(None);
        let line = || opened.lock().unwrap_or_else(PoisonError::into_inner);
        thread::scope(|scope| {
            let stopper = thread::Builder::new().spawn_scoped(scope, || {
                let (mut sent, mut result) = (None, Ok(()));
                loop {
                    match pressed().filter(|urgent| sent != Some(*urgent)) {
                        Some(urgent) => {
                            sent = Some(urgent);
                            drop(line().take());
                            result = Err(self.stopped(&target, urgent, need));
                        }
                        None if waits.load(Ordering::Relaxed) => thread::park_timeout(PRESSED),
                        None => return result,
                    }
                }
            });
            // Send nothing while a stop would be impossible.
            let stopper = stopper.map_err(Failure::no_thread)?;
            let device = self.open_for_command(kind, address, need, &pressed);
            *line() = pressed().is_none().then_some(device);
            waits.store(false, Ordering::Relaxed);
            stopper.thread().unpark();
            stopper.join().unwrap_or_else(|why| resume_unwind(why))?;
            line().take().unwrap_or_else(|| Err(interrupted(need)))
        })
    }

    /// Stops the machine of a command without a session. Returns the failure of the command.
    fn stopped(&self, target: &Target, urgent: Urgent, need: LinkPurpose) -> Failure {
        let report = target.report(self.urgent(target, urgent));
        match report.delivery {
            Delivery::Stopped => interrupted(need),
            Delivery::NotConfirmed | Delivery::NotDelivered => Failure::Stops {
                reports: vec![report],
            },
        }
    }

    /// As [`Finder::open`]. If the command is for the owner of the line, an owner that only observes gives the
    /// line up. The wait for it ends when a stop is `pressed`.
    fn open_for_command(
        &self,
        kind: DeviceKind,
        address: &Address,
        need: LinkPurpose,
        pressed: &dyn Fn() -> Option<Urgent>,
    ) -> Result<Device, Failure> {
        let begin = Instant::now();
        loop {
            let mut device = self.open(kind, address, LinkPurpose::Observe)?;
            if need.of_owner().is_none() || device.owner().is_none() {
                return Ok(device);
            }
            let limit = if device.want_line() {
                YIELDING
            } else {
                SHORT_WAIT
            };
            if begin.elapsed() > limit || pressed().is_some() {
                return Ok(device);
            }
            drop(device);
            thread::sleep(AGAIN);
        }
    }

    /// The machine at this address, before Hello.
    pub fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        purpose: LinkPurpose,
    ) -> Result<Device, Failure> {
        let link = self.connector.open(kind, address, self.baud, purpose)?;
        Ok(Device::new(link, self.connector.nonce()))
    }

    /// Address of a machine: as given by the user, or the only place where such a machine answers.
    pub fn resolve(&self, kind: DeviceKind) -> Result<Address, Failure> {
        match self.address(kind) {
            Some(Address::Auto) | None => {}
            Some(address) => return Ok(address.clone()),
        }
        let found = self.survey(Some(kind));
        let mut matching = found
            .iter()
            .filter(|found| matches!(&found.answer, Ok(identity) if identity.device == kind));
        match (matching.next(), matching.next()) {
            (Some(one), None) => Ok(one.candidate.address.clone()),
            (None, _) => Err(Failure::NotFound {
                wanted: Some(kind),
                there: list(&found),
            }),
            (Some(_), Some(_)) => Err(Failure::Ambiguous {
                wanted: kind,
                there: list(&found),
            }),
        }
    }

    /// Asks every place that may be probed for its identity. With `wanted`, skips places known to belong to the other
    /// machine.
    pub fn survey(&self, wanted: Option<DeviceKind>) -> Vec<Found> {
        self.connector
            .candidates()
            .into_iter()
            .filter(|candidate| {
                wanted.is_none() || candidate.kind.is_none() || candidate.kind == wanted
            })
            .map(|candidate| {
                let answer = self.ask(&candidate, wanted);
                Found { candidate, answer }
            })
            .collect()
    }

    fn ask(&self, candidate: &Candidate, wanted: Option<DeviceKind>) -> Result<Identity, Failure> {
        if !candidate.may_ask {
            return Err(Failure::NotFound {
                wanted: None,
                there: "not asked: not an ST-LINK port".to_owned(),
            });
        }
        let kind = candidate.kind.or(wanted).unwrap_or(DeviceKind::Rig);
        let mut device = self.open(kind, &candidate.address, LinkPurpose::Observe)?;
        Ok(device.hello(self.connector.nonce())?)
    }

    /// The machines that a command addresses.
    pub fn machines(&self, which: &Which) -> Result<Vec<DeviceKind>, Failure> {
        if let Some(machine) = which.machine {
            return Ok(vec![machine.into()]);
        }
        let addressed = self.addressed();
        if !addressed.is_empty() {
            return Ok(addressed);
        }
        let found = self.survey(None);
        let there: Vec<_> = KINDS
            .into_iter()
            .filter(|kind| {
                found
                    .iter()
                    .any(|found| matches!(&found.answer, Ok(identity) if identity.device == *kind))
            })
            .collect();
        if there.is_empty() {
            return Err(Failure::NotFound {
                wanted: None,
                there: list(&found),
            });
        }
        Ok(there)
    }
}

/// The failure of a command that was stopped before it sent anything.
fn interrupted(need: LinkPurpose) -> Failure {
    let request = need.of_owner().unwrap_or("Hello");
    Failure::Client(ClientError::Interrupted { request })
}

/// This process's interrupt, extended to mark each stop for the other processes before it is sent.
fn marking(line_files: Option<LineFiles>, interrupt: Interrupt) -> Interrupt {
    let marked = [AtomicBool::new(false), AtomicBool::new(false)];
    Arc::new(move || {
        let wanted = interrupt();
        if let Some(urgent) = wanted
            && let Some(line_files) = &line_files
            && !marked[usize::from(urgent == Urgent::EStop)].swap(true, Ordering::Relaxed)
        {
            line_files.mark_stop(urgent);
        }
        wanted
    })
}

/// Uses the broker of a line's owner. Repeats if the owner exits, because the line is then free.
pub fn past_owners<T>(ask: impl Fn() -> Result<T, Failure>) -> Result<T, Failure> {
    let mut found = ask();
    for _ in 1..OWNERS {
        if !matches!(&found, Err(Failure::Client(error)) if error.is_owner_gone()) {
            break;
        }
        found = ask();
    }
    found
}

pub fn list(found: &[Found]) -> String {
    if found.is_empty() {
        return "there is no port with an ST-LINK".to_owned();
    }
    let lines: Vec<_> = found.iter().map(line).collect();
    format!("there is:\n  {}", lines.join("\n  "))
}

pub fn line(found: &Found) -> String {
    let candidate = &found.candidate;
    let who = match &found.answer {
        Ok(identity) => identity::line(identity),
        Err(Failure::NotFound { there, .. }) => there.clone(),
        Err(failure) => failure.to_string(),
    };
    format!("{} ({}): {who}", candidate.address, candidate.description)
}
