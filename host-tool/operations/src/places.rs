//! Finds the machine that `--rig` or `--capsule` means, and opens a session with it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use client::address::Address;
use client::door::lock::Doorway;
use client::error::ClientError;
use client::identity;
use client::link::LinkError;
use client::{Device, Interrupt, matches};
use protocol::settings::GetName;
use protocol::system::{DeviceKind, Identity, Urgent};

use crate::arguments::Which;
use crate::connector::{Candidate, Connector, Purpose};
use crate::delivery::{Delivery, Told};
use crate::failure::Failure;
use crate::interrupt;
use crate::left;
use crate::names::Names;

/// When this process began: a stop since then is newer than its command, however long it has looked for the machine.
pub static BEGAN: LazyLock<SystemTime> = LazyLock::new(SystemTime::now);

/// This process has connected to rig and capsule before.
static CONNECTED: [AtomicBool; 2] = [AtomicBool::new(false), AtomicBool::new(false)];

/// Both machines.
pub const KINDS: [DeviceKind; 2] = [DeviceKind::Rig, DeviceKind::Capsule];

/// How many owners of a line may end while this process looks through their doors.
const OWNERS: u32 = 5;

/// How long an owner that only looks may take to give its line up.
const YIELDING: Duration = Duration::from_secs(10);

/// How soon a short look of another process is over.
const SHORT_LOOK: Duration = Duration::from_millis(100);

/// Interval between two attempts at a line that is about to be free.
const AGAIN: Duration = Duration::from_millis(10);

/// A place and the answer from it.
pub struct Found {
    /// The place.
    pub candidate: Candidate,
    /// Who answered there, or why nobody did.
    pub answer: Result<Identity, Failure>,
}

/// A machine to stop.
pub struct Target {
    /// Its kind, if it is known.
    pub kind: Option<DeviceKind>,
    /// Its place, unless it has to be found.
    pub address: Option<Address>,
}

impl Target {
    /// What the machine is called.
    #[must_use]
    pub fn name(&self) -> &'static str {
        self.kind.map_or("machine", identity::kind_name)
    }

    /// What became of a stop of this machine.
    #[must_use]
    pub fn told(&self, result: Result<String, Failure>) -> Told {
        let (delivery, why) = match &result {
            Ok(_) => (Delivery::Stopped, String::new()),
            Err(failure) => (delivery(failure), failure.to_string()),
        };
        let machine = match (&result, &self.address) {
            (Ok(place), _) => place.clone(),
            (Err(_), Some(address)) => format!("{} at {address}", self.name()),
            (Err(_), None) => self.name().to_owned(),
        };
        Told {
            machine,
            delivery,
            why,
        }
    }
}

/// As the user would name it.
impl std::fmt::Display for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.address {
            Some(address) => write!(f, "{} at {address}", self.name()),
            None => f.write_str(self.name()),
        }
    }
}

/// What a failure leaves of a stop. A link that breaks may have carried it: that counts as not confirmed.
fn delivery(failure: &Failure) -> Delivery {
    match failure {
        Failure::Client(ClientError::StopUnconfirmed { .. } | ClientError::Link(_)) => {
            Delivery::NotConfirmed
        }
        _ => Delivery::NotDelivered,
    }
}

/// What a command needs of the line to its machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// To read, to stop, to hold: the owner of the line does it for others, too.
    Look,
    /// To read or change the machine's name, which need not be the one by which the machine was called. The text is the
    /// command's name, if it changes the name.
    Name(Option<&'static str>),
    /// To move something, to write settings, or the whole line: only its owner may. The text is the command's name.
    Own(&'static str),
}

impl Need {
    /// The command that only the owner of the line may send.
    fn of_owner(self) -> Option<&'static str> {
        match self {
            Self::Look => None,
            Self::Name(command) => command,
            Self::Own(command) => Some(command),
        }
    }

    /// Refuses a command of the owner before anything is sent or recorded.
    fn admit(self, device: &Device) -> Result<(), ClientError> {
        match (device.owner(), self.of_owner()) {
            (Some(owner), Some(request)) => Err(ClientError::Owned {
                place: device.place(),
                request,
                owner: Box::new(owner.clone()),
            }),
            _ => Ok(()),
        }
    }
}

/// Where the machines are, as the user said, and the way to open a link to them.
pub struct Places<'a> {
    /// The rig's address, if one was given.
    pub rig: Option<Address>,
    /// The capsule's address, if one was given.
    pub capsule: Option<Address>,
    /// The names by which the two were given.
    pub names: Names,
    /// Speed of serial ports.
    pub baud: u32,
    /// What opens links.
    pub connector: &'a dyn Connector,
}

impl Places<'_> {
    /// The address that the user gave.
    #[must_use]
    pub fn address(&self, kind: DeviceKind) -> Option<&Address> {
        match kind {
            DeviceKind::Rig => self.rig.as_ref(),
            DeviceKind::Capsule => self.capsule.as_ref(),
        }
    }

    /// Makes sure that a rig that was called by name carries this name. A capsule carries none.
    ///
    /// # Errors
    /// [`Failure::WrongName`], and those of the line.
    pub fn require_name(&self, device: &mut Device) -> Result<(), Failure> {
        let Some(identity) = device.identity().copied().filter(matches) else {
            return Ok(());
        };
        let name = self.names.of(identity.device);
        let Some(name) = name.filter(|_| identity.device == DeviceKind::Rig) else {
            return Ok(());
        };
        let carried = device.call(GetName)?.name;
        if carried == name {
            return Ok(());
        }
        Err(Failure::WrongName {
            place: device.place(),
            name: name.to_owned(),
            carried: carried.as_str().to_owned(),
        })
    }

    /// The machines that the user gave an address for.
    fn addressed(&self) -> Vec<DeviceKind> {
        KINDS
            .into_iter()
            .filter(|kind| self.address(*kind).is_some())
            .collect()
    }

    /// Opens a session with a machine that speaks the same protocol. From now on Ctrl-C stops it.
    pub fn connect(&self, kind: DeviceKind, need: Need) -> Result<Device, Failure> {
        let device = self.greet(kind, need)?;
        device.require(kind)?;
        Ok(device)
    }

    /// Opens a session with a machine of this kind, whatever protocol version it speaks.
    pub fn greet(&self, kind: DeviceKind, need: Need) -> Result<Device, Failure> {
        let address = self.resolve(kind)?;
        // Before the line is waited for: a stop that comes meanwhile is meant for this command, too.
        let doorway = self.connector.doorway(&address);
        let now = Doorway::last_stops(doorway.as_ref());
        // The search for the machine may have taken seconds. Whoever connects again goes on after a stop that was told.
        let again =
            CONNECTED[usize::from(kind == DeviceKind::Capsule)].swap(true, Ordering::Relaxed);
        let mark = if again { now } else { now.at(*BEGAN) };
        let interrupt = told(doorway, interrupt::install());
        let mut device = self.open_for_command(kind, &address, need)?;
        // The owner of the line may end while it is asked; then the line is free.
        for attempt in 1.. {
            need.admit(&device)?;
            device.ordered_at(mark);
            device.set_interrupt(Arc::clone(&interrupt));
            match device.hello(self.connector.nonce()) {
                Err(ClientError::Link(_)) if device.owner().is_some() && attempt < OWNERS => {
                    device = self.open_for_command(kind, &address, need)?;
                }
                Err(error) => return Err(error.into()),
                Ok(_) => break,
            }
        }
        if let Err(error @ ClientError::WrongDevice { .. }) = device.require(kind) {
            return Err(error.into());
        }
        if device.left_record().is_some()
            && device.require(kind).is_ok()
            && let Some(said) = left::end_record(&mut device)?
        {
            eprintln!("{said}");
        }
        // Whoever gives it a name does not need it to have one.
        if !matches!(need, Need::Name(_)) {
            self.require_name(&mut device)?;
        }
        Ok(device)
    }

    /// Sends an urgent stop before anything else, without a session. Returns the place that confirmed it.
    pub fn urgent(&self, target: &Target, urgent: Urgent) -> Result<String, Failure> {
        let kind = target.kind.unwrap_or(DeviceKind::Rig);
        let address = match &target.address {
            Some(address) => address,
            None => &self.resolve(kind)?,
        };
        if let Some(doorway) = self.connector.doorway(address) {
            doorway.mark_stop(urgent);
        }
        for _ in 1..OWNERS {
            match self.stop_by(kind, address, urgent, Purpose::Stop) {
                // The owner of the line has ended; then the line is free.
                (Err(Failure::Client(ClientError::Link(LinkError::OwnerGone { .. }))), _) => {}
                (Err(failure), true) => {
                    let (past, _) = self.stop_by(kind, address, urgent, Purpose::StopDirectly);
                    return past.map_err(|_| failure);
                }
                // What was sent without an owner was sent as directly as can be.
                (result, _) => return result,
            }
        }
        self.stop_by(kind, address, urgent, Purpose::StopDirectly).0
    }

    /// Sends a stop one way; also tells whether that led through the owner of the line.
    fn stop_by(
        &self,
        kind: DeviceKind,
        address: &Address,
        urgent: Urgent,
        purpose: Purpose,
    ) -> (Result<String, Failure>, bool) {
        let link = match self.connector.open(kind, address, self.baud, purpose) {
            Ok(link) => link,
            Err(error) => return (Err(error.into()), false),
        };
        let mut device = Device::new(link, self.connector.nonce());
        let result = device.urgent(urgent).map(|()| device.place());
        (result.map_err(Into::into), device.owner().is_some())
    }

    /// Where to send an urgent stop: to the machines given by the user, or else to every place that may be probed.
    /// Sends nothing; only the place of a machine given as `auto` has to be found by asking.
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

    /// As [`Places::open`]; if the command is for the owner of the line, and the present one only looks, that one gives it up.
    fn open_for_command(
        &self,
        kind: DeviceKind,
        address: &Address,
        need: Need,
    ) -> Result<Device, Failure> {
        let begin = Instant::now();
        loop {
            let mut device = self.open(kind, address)?;
            if need.of_owner().is_none() || device.owner().is_none() {
                return Ok(device);
            }
            let limit = if device.want_line() {
                YIELDING
            } else {
                SHORT_LOOK
            };
            if begin.elapsed() > limit {
                return Ok(device);
            }
            drop(device);
            thread::sleep(AGAIN);
        }
    }

    fn open(&self, kind: DeviceKind, address: &Address) -> Result<Device, Failure> {
        let baud = self.baud;
        let link = self.connector.open(kind, address, baud, Purpose::Work)?;
        Ok(Device::new(link, self.connector.nonce()))
    }

    /// The address of a machine: as given by the user, or the only one where such a machine answers.
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
                wanted: kind,
                there: list(&found),
            }),
            (Some(_), Some(_)) => Err(Failure::Ambiguous {
                wanted: kind,
                there: list(&found),
            }),
        }
    }

    /// Asks for an identity at every place that may be probed. With `wanted`, places known to belong to the other
    /// machine are left out.
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
            return Err(Failure::NothingFound {
                there: "not asked: not an ST-LINK port".to_owned(),
            });
        }
        let kind = candidate.kind.or(wanted).unwrap_or(DeviceKind::Rig);
        let mut device = self.open(kind, &candidate.address)?;
        Ok(device.hello(self.connector.nonce())?)
    }

    /// The machines a command is for.
    ///
    /// # Errors
    /// No address was given and no machine is found.
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
            return Err(Failure::NothingFound {
                there: list(&found),
            });
        }
        Ok(there)
    }
}

/// The operator's stop of this process, which is told to the others before it is sent.
fn told(doorway: Option<Doorway>, interrupt: Interrupt) -> Interrupt {
    let told = [AtomicBool::new(false), AtomicBool::new(false)];
    Arc::new(move || {
        let wanted = interrupt();
        if let Some(urgent) = wanted
            && let Some(doorway) = &doorway
            && !told[usize::from(urgent == Urgent::EStop)].swap(true, Ordering::Relaxed)
        {
            doorway.mark_stop(urgent);
        }
        wanted
    })
}

/// Looks through the door of a line's owner, and again if the owner ends meanwhile: then the line is free.
pub fn past_owners<T>(look: impl Fn() -> Result<T, Failure>) -> Result<T, Failure> {
    let mut found = look();
    for _ in 1..OWNERS {
        if !matches!(
            found,
            Err(Failure::Client(ClientError::Link(
                LinkError::OwnerGone { .. }
            )))
        ) {
            break;
        }
        found = look();
    }
    found
}

/// One line per place.
pub fn list(found: &[Found]) -> String {
    if found.is_empty() {
        return "there is no port with an ST-LINK".to_owned();
    }
    let lines: Vec<_> = found.iter().map(line).collect();
    format!("there is:\n  {}", lines.join("\n  "))
}

/// A place and what is known about it.
pub fn line(found: &Found) -> String {
    let candidate = &found.candidate;
    let who = match &found.answer {
        Ok(identity) => identity::line(identity),
        Err(Failure::NothingFound { there }) => there.clone(),
        Err(failure) => failure.to_string(),
    };
    format!("{} ({}): {who}", candidate.address, candidate.description)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_kind_is_called_a_machine() {
        let target = |kind| Target {
            kind,
            address: Some("COM3".parse().expect("an address")),
        };
        assert_eq!(target(None).to_string(), "machine at COM3");
        let rig = Some(DeviceKind::Rig);
        assert_eq!(target(rig).to_string(), "rig at COM3");
    }
}
