//! Where links, nonces and the time of day come from. [`Ports`] takes them from this computer; the virtual bench has a
//! connector of its own.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

use jiff::Timestamp;
use protocol::system::DeviceKind;

use crate::commission::hands::Hands;
use crate::link::address::Address;
use crate::link::serial::{self, Serial};
use crate::link::tcp::Tcp;
use crate::link::{Link, OpenError};

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
const TO_STOP: Duration = Duration::from_secs(1);

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
        match address {
            Address::Serial(path) => Ok(Box::new(Serial::open(path, baud)?)),
            Address::Tcp(place) => Ok(Box::new(Tcp::open(place)?)),
            Address::Auto => Err(OpenError {
                place: address.to_string(),
                why: "it does not say where the machine is".to_owned(),
                remedy: "give a serial port or tcp:HOST:PORT".to_owned(),
            }),
            Address::Virtual => Err(OpenError {
                place: address.to_string(),
                why: "the virtual bench is not part of this program".to_owned(),
                remedy: "use `cargo xtask demo`, or the `virtual-bench` program, which has the same commands; it can also serve both machines on TCP".to_owned(),
            }),
        }
    }

    fn open_to_stop(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
    ) -> Result<Box<dyn Link>, OpenError> {
        match address {
            Address::Tcp(place) => Ok(Box::new(Tcp::open_within(place, TO_STOP)?)),
            _ => self.open(kind, address, baud),
        }
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
