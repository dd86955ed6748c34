//! Where links, nonces and the time of day come from. [`Ports`] takes them from this computer; the virtual bench has a
//! connector of its own.

use std::hash::{BuildHasher, RandomState};
use std::thread;
use std::time::{Duration, Instant};

use client::address::Address;
use client::door::lock::Doorway;
use client::door::server::GUESTS;
use client::door::shared::Shared;
use client::door::window::Window;
use client::link::halves::Halves;
use client::link::serial::{self, Serial};
use client::link::tcp::Tcp;
use client::link::{Link, OpenError, Reason};
use commissioning::hands::Hands;
use jiff::Timestamp;
use protocol::system::DeviceKind;

/// A place where a machine may be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Candidate {
    /// Its address.
    pub address: Address,
    /// The kind of machine, if it is known without asking.
    pub kind: Option<DeviceKind>,
    /// What the system says about the place.
    pub description: String,
    /// Hello may be sent there without disturbing some other instrument.
    pub may_ask: bool,
}

/// What a link is opened for; it decides how long it may take, and what becomes of a line that somebody else has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Whatever a machine can do.
    Work,
    /// Only to look, for as long as somebody likes: as the owner of the line it offers it to others from the beginning, see
    /// [`Link::is_line_wanted`].
    Watch,
    /// To look once, soon: a place that does not answer by then is told as such.
    Look,
    /// Nothing but a stop, which does not wait for a place that does not answer.
    Stop,
    /// The same past the owner of the line, who has not brought it to the machine.
    StopDirectly,
}

/// Opens links. Several threads may, so that a stop goes to all machines at once.
pub trait Connector: Sync {
    /// Opens a link to a machine; sends nothing. Does not search: the caller finds the address behind [`Address::Auto`].
    ///
    /// # Errors
    /// [`OpenError`] with what to do about it.
    fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
        purpose: Purpose,
    ) -> Result<Box<dyn Link>, OpenError>;

    /// The machine there is made when it is opened: it is neither homed nor referenced, and nobody is near it.
    fn is_made_anew(&self, address: &Address) -> bool {
        let _ = address;
        false
    }

    /// Lock and door of the line there, where several processes share it.
    fn doorway(&self, address: &Address) -> Option<Doorway> {
        let _ = address;
        None
    }

    /// The places where a machine may be, for `auto` and `devices`.
    fn candidates(&self) -> Vec<Candidate>;

    /// A nonce for the next session, different from the last one.
    fn nonce(&self) -> u32;

    /// The time of day, for records.
    fn now(&self) -> Timestamp;

    /// Hands at the machine of this kind and address, where they are part of this program. A board needs those of a
    /// person.
    fn hands(&self, kind: DeviceKind, address: Option<&Address>) -> Option<Box<dyn Hands>> {
        let _ = (kind, address);
        None
    }
}

/// How long each of the ways may take.
struct Patience {
    /// A connection.
    connect: Duration,
    /// An owner of the line whose door is open, with its answer to a knock.
    answer: Duration,
    /// A line that is taken, without a door: its owner comes or goes, and its disk may be slow.
    change: Duration,
}

impl Purpose {
    fn patience(self) -> Patience {
        let [connect, answer, change] = match self {
            Self::Work | Self::Watch => [5_000, 2_000, 5_000],
            // A diagnosis is there within 1 s, of which a silent machine takes 0.8 s to be called so.
            Self::Look => [200, 500, 500],
            // Whoever waits longer should be at the button.
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

/// Interval between two attempts at a line whose owner comes or goes.
const AGAIN: Duration = Duration::from_millis(5);

/// Opens the line as its owner, or a window to it if another process has it.
fn way_in(
    doorway: &Doorway,
    purpose: Purpose,
    halves: &dyn Fn() -> Result<Halves, OpenError>,
) -> Result<Box<dyn Link>, OpenError> {
    let (patience, yields) = (purpose.patience(), purpose == Purpose::Watch);
    let begin = Instant::now();
    loop {
        if let Some(lock) = doorway.claim()? {
            lock.announce()?;
            return Ok(Box::new(Shared::new(lock, halves()?, yields)?));
        }
        let owner = doorway.owner();
        let limit = if owner.is_some() && doorway.is_open() {
            patience.answer
        } else {
            patience.change
        };
        let left = limit.saturating_sub(begin.elapsed());
        if left.is_zero() {
            let who = owner.map_or_else(
                || "another `retrograde`".to_owned(),
                |owner| owner.to_string(),
            );
            return Err(OpenError {
                place: doorway.place().to_owned(),
                reason: Reason::OwnerSilent,
                why: format!("it belongs to {who}, which does not answer"),
                remedy: "wait until that process ends, or end it with Ctrl-C in its terminal; one that hangs ends with `kill -9`, and the rig stops by itself 1 s later".to_owned(),
            });
        }
        if let Ok(window) = Window::open(doorway, left) {
            if window.is_full() && purpose != Purpose::Stop {
                return Err(OpenError {
                    place: doorway.place().to_owned(),
                    reason: Reason::Busy,
                    why: format!("{GUESTS} other processes look at it already"),
                    remedy: "close a `watch` or a page that nobody needs; a stop goes through all the same".to_owned(),
                });
            }
            return Ok(Box::new(window));
        }
        thread::sleep(AGAIN);
    }
}

/// Opens the line for two threads.
fn halves(address: &Address, baud: u32, limit: Duration) -> Result<Halves, OpenError> {
    let opened = match address {
        Address::Serial(path) => Serial::open(path, baud)?.halves(),
        Address::Tcp(place) => Tcp::open_within(place, limit)?.halves(),
        Address::Auto | Address::Virtual => return Err(nowhere(address)),
    };
    opened.map_err(|why| OpenError {
        place: address.to_string(),
        reason: Reason::Other,
        why: why.to_string(),
        remedy: "try again; `retrograde devices` lists the ports".to_owned(),
    })
}

/// Opens the line without regard to others.
fn direct(address: &Address, baud: u32, limit: Duration) -> Result<Box<dyn Link>, OpenError> {
    match address {
        Address::Serial(path) => Ok(Box::new(Serial::open(path, baud)?)),
        Address::Tcp(place) => Ok(Box::new(Tcp::open_within(place, limit)?)),
        Address::Auto | Address::Virtual => Err(nowhere(address)),
    }
}

/// An address without a line.
fn nowhere(address: &Address) -> OpenError {
    let (why, remedy) = if *address == Address::Virtual {
        (
            "the virtual bench is not part of this program",
            "use `cargo xtask demo`, or the `virtual-bench` program, which has the same commands; it can also serve both machines on TCP",
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

/// Serial ports and TCP, random nonces, the computer's clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct Ports;

impl Connector for Ports {
    fn open(
        &self,
        _kind: DeviceKind,
        address: &Address,
        baud: u32,
        purpose: Purpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        let limit = purpose.patience().connect;
        let through =
            |doorway: &Doorway| way_in(doorway, purpose, &|| halves(address, baud, limit));
        let doorway = match (Doorway::of(address), purpose) {
            // Whatever is wrong with lock or door, a stop goes the direct way.
            (Err(_), Purpose::Stop | Purpose::StopDirectly) => None,
            (doorway, _) => doorway?,
        };
        match (doorway, purpose) {
            (Some(doorway), Purpose::Stop) => {
                if let Ok(link) = through(&doorway) {
                    return Ok(link);
                }
            }
            (Some(_), Purpose::StopDirectly) | (None, _) => {}
            (Some(doorway), _) => return through(&doorway),
        }
        direct(address, baud, limit)
    }

    fn doorway(&self, address: &Address) -> Option<Doorway> {
        // Opening the line says what is wrong with its lock.
        Doorway::of(address).ok().flatten()
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
        // The keys of the standard library's hasher are the only source of randomness without a dependency.
        RandomState::new().hash_one(Timestamp::now().as_nanosecond()) as u32
    }

    fn now(&self) -> Timestamp {
        Timestamp::now()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slow disk or a slow port may lie between an owner's name and its door.
    #[test]
    fn an_owner_without_a_door_is_waited_for_longer_than_one_that_does_not_answer() {
        let folder = tempfile::tempdir().expect("a folder");
        let doorway = Doorway::new(folder.path().to_owned(), "line", "line".to_owned());
        let owned = doorway.claim().expect("possible").expect("free");
        owned.announce().expect("possible");
        assert!(doorway.owner().is_some() && !doorway.is_open());
        let leaves = thread::spawn(move || {
            thread::sleep(Purpose::Work.patience().answer + Duration::from_millis(500));
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
        let error = way_in(&doorway, Purpose::Work, &opened).err();
        leaves.join().expect("it left");
        assert_eq!(
            error.map(|error| error.why).as_deref(),
            Some("it was free at last")
        );
    }
}
