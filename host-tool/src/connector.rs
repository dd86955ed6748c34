//! Where links, nonces and the time of day come from. [`Ports`] takes them from this computer; the virtual bench has a
//! connector of its own.

use std::hash::{BuildHasher, RandomState};
use std::thread;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use protocol::system::DeviceKind;

use crate::commission::hands::Hands;
use crate::door::lock::Doorway;
use crate::door::window::Window;
use crate::link::address::Address;
use crate::link::serial::{self, Serial};
use crate::link::shared::{Halves, Shared};
use crate::link::tcp::Tcp;
use crate::link::{Link, OpenError, Reason};

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
    ) -> Result<Box<dyn Link>, OpenError>;

    /// As [`Connector::open`], for nothing but a stop, which does not wait for a place that does not answer.
    ///
    /// # Errors
    /// As [`Connector::open`].
    fn open_to_stop(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
    ) -> Result<Box<dyn Link>, OpenError> {
        self.open(kind, address, baud)
    }

    /// As [`Connector::open`], for a program that only looks: as the owner of the line it offers it to others from the
    /// beginning, see [`Link::is_line_wanted`].
    ///
    /// # Errors
    /// As [`Connector::open`].
    fn open_to_watch(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
    ) -> Result<Box<dyn Link>, OpenError> {
        self.open(kind, address, baud)
    }

    /// As [`Connector::open`], for a look that has to end soon: it waits no longer than `limit` for the place.
    ///
    /// # Errors
    /// As [`Connector::open`].
    fn open_within(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
        limit: Duration,
    ) -> Result<Box<dyn Link>, OpenError> {
        let _ = limit;
        self.open(kind, address, baud)
    }

    /// The machine there is made when it is opened: it is neither homed nor referenced, and nobody is near it.
    fn is_made_anew(&self, address: &Address) -> bool {
        let _ = address;
        false
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

/// How long a connection for a stop may take. Whoever waits longer should be at the button.
const CONNECT_TO_STOP: Duration = Duration::from_secs(1);

/// How long a connection may take otherwise.
const CONNECT: Duration = Duration::from_secs(5);

/// How somebody wants a line that others may have.
struct Wish {
    /// How long an owner that has said who it is may leave a knock without an answer.
    answer: Duration,
    /// How long a line may be taken by somebody who has not said so yet: it comes or goes, and its disk may be slow.
    change: Duration,
    /// As its owner, to give the line up to whoever wants it.
    yields: bool,
}

const TO_WORK: Wish = Wish {
    answer: Duration::from_secs(1),
    change: CONNECT,
    yields: false,
};

const TO_WATCH: Wish = Wish {
    yields: true,
    ..TO_WORK
};

/// A look that has to end soon.
const TO_LOOK: Wish = Wish {
    answer: Duration::from_millis(500),
    change: Duration::from_millis(500),
    yields: false,
};

/// A stop goes the direct way soon.
const TO_STOP: Wish = Wish {
    answer: Duration::from_millis(250),
    change: Duration::from_millis(250),
    yields: false,
};

/// Interval between two attempts at a line whose owner comes or goes.
const AGAIN: Duration = Duration::from_millis(5);

/// Opens the line as its owner, or a window to it if another process has it.
fn way_in(
    doorway: &Doorway,
    wish: &Wish,
    halves: &dyn Fn() -> Result<Halves, OpenError>,
) -> Result<Box<dyn Link>, OpenError> {
    let begin = Instant::now();
    loop {
        if let Some(lock) = doorway.claim()? {
            lock.announce()?;
            return Ok(Box::new(Shared::new(lock, halves()?, wish.yields)?));
        }
        let owner = doorway.owner();
        let limit = match owner {
            Some(_) => wish.answer,
            None => wish.change,
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
    ) -> Result<Box<dyn Link>, OpenError> {
        let Some(doorway) = Doorway::of(address)? else {
            return direct(address, baud, CONNECT);
        };
        way_in(&doorway, &TO_WORK, &|| halves(address, baud, CONNECT))
    }

    fn open_to_watch(
        &self,
        _kind: DeviceKind,
        address: &Address,
        baud: u32,
    ) -> Result<Box<dyn Link>, OpenError> {
        let Some(doorway) = Doorway::of(address)? else {
            return direct(address, baud, CONNECT);
        };
        way_in(&doorway, &TO_WATCH, &|| halves(address, baud, CONNECT))
    }

    fn open_within(
        &self,
        _kind: DeviceKind,
        address: &Address,
        baud: u32,
        limit: Duration,
    ) -> Result<Box<dyn Link>, OpenError> {
        let Some(doorway) = Doorway::of(address)? else {
            return direct(address, baud, limit);
        };
        way_in(&doorway, &TO_LOOK, &|| halves(address, baud, limit))
    }

    fn open_to_stop(
        &self,
        _kind: DeviceKind,
        address: &Address,
        baud: u32,
    ) -> Result<Box<dyn Link>, OpenError> {
        // Whatever is wrong with lock or door, the stop goes the direct way.
        if let Ok(Some(doorway)) = Doorway::of(address)
            && let Ok(link) = way_in(&doorway, &TO_STOP, &|| {
                halves(address, baud, CONNECT_TO_STOP)
            })
        {
            return Ok(link);
        }
        direct(address, baud, CONNECT_TO_STOP)
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
