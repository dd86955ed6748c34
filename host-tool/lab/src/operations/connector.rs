//! Sources of links, nonces and the time of day. [`Ports`] takes them from this computer; the virtual bench has another
//! connector.

use std::hash::{BuildHasher, RandomState};
use std::thread;
use std::time::{Duration, Instant};

use crate::commissioning::operator::Operator;
use client::Device;
use client::address::Address;
use client::broker::client::BrokerClient;
use client::broker::lock::LineFiles;
use client::broker::server::MAX_CLIENTS;
use client::broker::shared::Shared;
use client::error::ClientError;
use client::link::halves::{Direct, Halves};
use client::link::owner::Owner;
use client::link::{Link, OpenError, Reason, serial, tcp};
use jiff::Timestamp;
use protocol::system::DeviceKind;

/// A place where there may be a machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Candidate {
    pub address: Address,
    /// The kind of machine, if it is known without asking.
    pub kind: Option<DeviceKind>,
    /// The system's description of the place.
    pub description: String,
    /// Whether Hello may be sent there without disturbing another instrument.
    pub may_ask: bool,
}

/// Purpose of a link. It decides how long opening may take, and what happens if another process owns the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkPurpose {
    /// Reading, holding, acknowledging: the owner of the line does this for other processes as well.
    Observe,
    /// Moving something, writing settings, or using the whole line: only for the owner. The text is the command's
    /// name.
    Own(&'static str),
    /// Observing for as long as the user likes. As the owner of the line it offers the line to others from the start,
    /// see [`Link::is_line_wanted`].
    Watch,
    /// One brief observation; a place that does not answer in time is reported as such.
    Glance,
    /// A stop only, which does not wait for a place that does not answer.
    Stop,
    /// A stop that bypasses the owner of the line, because the owner has not passed it on to the machine.
    StopDirectly,
}

/// Opens links. Several threads may call it, so that a stop goes to all machines at once.
pub trait Connector: Sync {
    /// Opens a link to a machine; sends nothing. It does not search: the caller resolves [`Address::Auto`].
    fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
        purpose: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError>;

    /// Whether the machine there is created when it is opened: it is neither homed nor referenced, and nobody is near
    /// it.
    fn is_created_on_open(&self, address: &Address) -> bool {
        let _ = address;
        false
    }

    /// Files of the line there, if several processes can share it.
    fn line_files(&self, address: &Address) -> Option<LineFiles> {
        let _ = address;
        None
    }

    /// The places where there may be a machine, for `auto` and `doctor`.
    fn candidates(&self) -> Vec<Candidate> {
        vec![]
    }

    /// A nonce for the next session, different from the last one.
    fn nonce(&self) -> u32;

    fn now(&self) -> Timestamp;

    /// The fixture at the machine of this kind and address, if this program simulates one. A board needs a
    /// person.
    fn fixture(&self, kind: DeviceKind, address: Option<&Address>) -> Option<Box<dyn Operator>> {
        let _ = (kind, address);
        None
    }
}

/// Time limits for the steps of opening a line.
struct Patience {
    /// For a connection.
    connect: Duration,
    /// For an owner that listens to answer a greeting.
    answer: Duration,
    /// For a taken line without a socket: its owner is starting or exiting, and its disk may be slow.
    change: Duration,
}

impl LinkPurpose {
    /// The command, if only the owner of the line may send it.
    pub(crate) fn of_owner(self) -> Option<&'static str> {
        match self {
            Self::Own(command) => Some(command),
            _ => None,
        }
    }

    /// Refuses a command for the owner before anything is sent or recorded.
    ///
    /// # Errors
    /// Another process owns the line, and only the owner may send the command.
    pub fn admit(self, device: &Device) -> Result<(), ClientError> {
        match (device.owner(), self.of_owner()) {
            (Some(owner), Some(request)) => Err(ClientError::Owned {
                place: device.place(),
                request,
                owner: Box::new(owner.clone()),
                busy: false,
            }),
            _ => Ok(()),
        }
    }

    fn patience(self) -> Patience {
        let [connect, answer, change] = match self {
            Self::Observe | Self::Own(_) | Self::Watch => [5_000, 2_000, 5_000],
            // A diagnosis should take at most 1 s. Detecting a silent machine takes 0.8 s of that.
            Self::Glance => [200, 500, 500],
            // After this time the user should be at the emergency stop button.
            Self::Stop | Self::StopDirectly => [1_000, 250, 250],
        }
        .map(Duration::from_millis);
        Patience {
            connect,
            answer,
            change,
        }
    }
}

/// Interval between attempts at a line whose owner is starting or exiting.
const AGAIN: Duration = Duration::from_millis(5);

/// Opens the line as its owner, or connects to its owner's broker if another process has it.
fn open_shared(
    line_files: &LineFiles,
    purpose: LinkPurpose,
    halves: &dyn Fn() -> Result<Halves, OpenError>,
) -> Result<Box<dyn Link>, OpenError> {
    let (patience, yields) = (purpose.patience(), purpose == LinkPurpose::Watch);
    let begin = Instant::now();
    loop {
        if let Some(lock) = line_files.claim()? {
            lock.announce()?;
            return Ok(Box::new(Shared::new(lock, halves()?, yields)?));
        }
        let owner = line_files.owner();
        let limit = if owner.is_some() && line_files.is_open() {
            patience.answer
        } else {
            patience.change
        };
        let remaining = limit.saturating_sub(begin.elapsed());
        if remaining.is_zero() {
            return Err(silent(line_files, owner));
        }
        if let Ok(client) = BrokerClient::open(line_files, remaining) {
            if client.is_full() && purpose != LinkPurpose::Stop {
                return Err(OpenError {
                    place: line_files.place().to_owned(),
                    reason: Reason::Busy,
                    why: format!("{MAX_CLIENTS} other processes observe it already"),
                    remedy: "close an unused `watch` or page; stops still go through".to_owned(),
                });
            }
            return Ok(Box::new(client));
        }
        thread::sleep(AGAIN);
    }
}

/// Opens the line for a stop: through its owner, or else directly. If the owner has the port exclusively, there is no
/// other way; on a busy computer it may need longer than usual, so it is asked again while `may_wait`.
fn open_for_stop<L>(
    through: impl Fn() -> Result<L, OpenError>,
    direct: impl Fn() -> Result<L, OpenError>,
    may_wait: impl Fn() -> bool,
) -> Result<L, OpenError> {
    loop {
        if let Ok(link) = through() {
            return Ok(link);
        }
        match direct() {
            Err(error) if error.reason == Reason::Busy && may_wait() => {}
            opened => return opened,
        }
    }
}

/// Error for an owner of the line that does not answer. If this server is the owner, the advice is not to end it.
fn silent(line_files: &LineFiles, owner: Option<Owner>) -> OpenError {
    let (why, remedy) = match owner {
        Some(owner) if owner.pid == std::process::id() => {
            ("this server is busy with it".to_owned(), "try again")
        }
        owner => {
            let who = owner.map_or_else(
                || "another `retrograde`".to_owned(),
                |owner| owner.to_string(),
            );
            (
                format!("it belongs to {who}, which does not answer"),
                "wait until that process ends, or end it with Ctrl-C in its terminal; one that hangs ends with `kill -9`, and the rig stops by itself 1 s later",
            )
        }
    };
    OpenError {
        place: line_files.place().to_owned(),
        reason: Reason::OwnerSilent,
        why,
        remedy: remedy.to_owned(),
    }
}

/// Opens the line, split for two threads.
fn halves(address: &Address, baud: u32, limit: Duration) -> Result<Halves, OpenError> {
    match address {
        Address::Serial(path) => serial::open(path, baud),
        Address::Tcp(place) => tcp::open(place, limit),
        Address::Auto | Address::Virtual => Err(nowhere(address)),
    }
}

/// Opens the line without lock or broker, whatever other processes do.
fn direct(address: &Address, baud: u32, limit: Duration) -> Result<Box<dyn Link>, OpenError> {
    let halves = halves(address, baud, limit)?;
    Ok(Box::new(Direct::new(address.to_string(), halves)))
}

/// The error for an address without a line.
fn nowhere(address: &Address) -> OpenError {
    let (why, remedy) = if *address == Address::Virtual {
        (
            "the program `virtual-bench` is not beside this one",
            "build it where this one was built: `cargo build -p virtual-bench --ignore-rust-version`, and the images by `cargo xtask images`; `cargo xtask demo` does all of it",
        )
    } else {
        (
            "it does not say where the machine is",
            "give a serial port or tcp:HOST:PORT",
        )
    };
    OpenError {
        place: address.to_string(),
        reason: Reason::Absent,
        why: why.to_owned(),
        remedy: remedy.to_owned(),
    }
}

/// Takes links from serial ports and TCP, nonces from random numbers, and the time from the computer's clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct Ports;

impl Connector for Ports {
    fn open(
        &self,
        _kind: DeviceKind,
        address: &Address,
        baud: u32,
        purpose: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        let limit = purpose.patience().connect;
        let through = |line_files: &LineFiles| {
            open_shared(line_files, purpose, &|| halves(address, baud, limit))
        };
        let line_files = match (LineFiles::of(address), purpose) {
            // If lock or broker fail, send a stop directly.
            (Err(_), LinkPurpose::Stop | LinkPurpose::StopDirectly) => None,
            (line_files, _) => line_files?,
        };
        match (line_files, purpose) {
            (Some(line_files), LinkPurpose::Stop) => {
                let begin = Instant::now();
                return open_for_stop(
                    || through(&line_files),
                    || direct(address, baud, limit),
                    || begin.elapsed() < limit,
                );
            }
            (Some(_), LinkPurpose::StopDirectly) | (None, _) => {}
            (Some(line_files), _) => return through(&line_files),
        }
        direct(address, baud, limit)
    }

    fn line_files(&self, address: &Address) -> Option<LineFiles> {
        // Ignore errors of the lock: opening the line reports them.
        LineFiles::of(address).ok().flatten()
    }

    fn candidates(&self) -> Vec<Candidate> {
        serial::ports()
            .into_iter()
            .map(|port| Candidate {
                address: Address::Serial(port.path),
                kind: None,
                description: port.description,
                may_ask: port.stlink,
            })
            .collect()
    }

    fn nonce(&self) -> u32 {
        // The standard library's hasher keys are the only source of randomness without a dependency.
        RandomState::new().hash_one(Timestamp::now().as_nanosecond()) as u32
    }

    fn now(&self) -> Timestamp {
        Timestamp::now()
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    /// The owner of a port is the only way to its machine, and was given up as soon as it had been slow once.
    #[test]
    fn a_stop_asks_the_owner_of_a_port_again_while_it_may_wait() {
        let closed = |reason| OpenError {
            place: "line".to_owned(),
            reason,
            why: String::new(),
            remedy: String::new(),
        };
        for (answers_at, reason, patience, wanted, asked) in [
            (1, Reason::Busy, 9, Ok("owner"), 1),
            (4, Reason::Busy, 9, Ok("owner"), 4),
            (9, Reason::Busy, 3, Err(Reason::Busy), 4),
            (9, Reason::Absent, 9, Err(Reason::Absent), 1),
        ] {
            let (asks, waits) = (Cell::new(0), Cell::new(0));
            let through = || {
                asks.set(asks.get() + 1);
                match asks.get() < answers_at {
                    true => Err(closed(Reason::OwnerSilent)),
                    false => Ok("owner"),
                }
            };
            let may_wait = || {
                waits.set(waits.get() + 1);
                waits.get() <= patience
            };
            let opened = open_for_stop(through, || Err(closed(reason)), may_wait);
            assert_eq!(opened.map_err(|error| error.reason), wanted);
            assert_eq!(asks.get(), asked);
        }
        // The owner has left, and the port is free.
        let silent = || Err(closed(Reason::OwnerSilent));
        let opened = open_for_stop(silent, || Ok("port"), || true);
        assert_eq!(opened.ok(), Some("port"));
    }

    /// A slow disk or port may delay an owner between writing its name and listening.
    #[test]
    fn an_owner_without_a_socket_is_waited_for_longer_than_one_that_does_not_answer() {
        let folder = tempfile::tempdir().expect("a folder");
        let line_files = LineFiles::new(folder.path().to_owned(), "line", "line".to_owned());
        let owned = line_files.claim().expect("possible").expect("free");
        owned.announce().expect("possible");
        assert!(line_files.owner().is_some() && !line_files.is_open());
        let leaves = thread::spawn(move || {
            thread::sleep(LinkPurpose::Observe.patience().answer + Duration::from_millis(500));
            drop(owned);
        });
        let opened = || {
            Err(OpenError {
                place: "line".to_owned(),
                reason: Reason::Absent,
                why: "it was free at last".to_owned(),
                remedy: String::new(),
            })
        };
        let error = open_shared(&line_files, LinkPurpose::Observe, &opened).err();
        leaves.join().expect("it left");
        assert_eq!(
            error.map(|error| error.why).as_deref(),
            Some("it was free at last")
        );
    }
}
