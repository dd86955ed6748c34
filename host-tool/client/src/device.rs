//! The client of one machine: typed requests, events without gaps, telemetry, waiting, stopping.
//!
//! [`protocol::client::Client`] handles retries, sequence numbers and the session; the [`Link`] carries the bytes and
//! has the clock. All times are on the link's clock, so that the same code runs in real and in virtual time. An urgent
//! stop is sent ahead of everything else.

mod bytes;
mod events;
pub(crate) mod observer;
mod requests;
pub(crate) mod waiting;

use protocol::VERSION;
use protocol::capsule::CapsuleState;
use protocol::client::{Client, Output};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{DeviceKind, Identity, Urgent};
use protocol::table::{Impact, Response, SCHEMA_KEY};

use crate::device::events::Inbox;
use crate::device::observer::{Clock, Interrupt, Pacer};
use crate::diagnosis::{self, Sign};
use crate::error::ClientError;
use crate::identity::Origin;
use crate::link::owner::{Owner, Question, StopMark};
use crate::link::{Link, LinkError};

/// Longest time between two requests while waiting, us. A moving device stops after 1 s without a request, or after the
/// rig's `link_timeout_ms`; a third of that applies if it is shorter than this.
pub const KEEP_ALIVE_US: u64 = 250_000;

/// Time for the owner of a line to answer a broker client's question, us. Its broker has answered, so the owner is
/// alive: it may be starting, or its computer may be busy.
const OWNER_PATIENCE_US: u64 = 3_000_000;

/// Whether a capsule in this state moves.
#[must_use]
pub fn moves(state: CapsuleState) -> bool {
    matches!(
        state,
        CapsuleState::Referencing
            | CapsuleState::Checking
            | CapsuleState::Folding
            | CapsuleState::Unfolding
    )
}

/// Whether the device speaks exactly this host's protocol.
#[must_use]
pub fn matches(identity: &Identity) -> bool {
    identity.protocol.major == VERSION.major && identity.schema_key == SCHEMA_KEY
}

/// A request that was sent and is not answered.
struct Pending {
    name: &'static str,
    impact: Impact,
    at_us: u64,
    /// A stop came after the request, so it must not be repeated.
    cancelled: bool,
    /// The question of another process, if the request is one; it gets the answer.
    question: Option<Question>,
}

/// The stop to send ahead of everything else.
#[derive(Default)]
struct StopState {
    /// The strongest stop that the operator or another process has requested so far.
    requested: Option<Urgent>,
    /// A stop was sent and not confirmed yet.
    unconfirmed: bool,
}

/// Known motion of the machine.
#[derive(Default)]
struct Motion {
    /// According to the device's last answer, something moves.
    reported: bool,
    /// An order to move was sent and is not answered.
    ordered: bool,
}

pub(crate) enum Turn {
    Nothing,
    Answered(Output),
    Unanswered,
    UrgentUnanswered,
}

/// Client of one machine at the end of a link.
pub struct Device {
    link: Box<dyn Link>,
    client: Client,
    identity: Option<Identity>,
    /// Time between two requests while waiting, us.
    keep_alive_us: u64,
    /// Time during which a question to the owner of the line is repeated, us.
    owner_patience_us: u64,
    interrupt: Option<Interrupt>,
    pacer: Option<Pacer>,
    stop: StopState,
    pending: Option<Pending>,
    /// Relation of the two clocks, from the last exchange that contained the device's time.
    clock: Option<Clock>,
    motion: Motion,
    inbox: Inbox,
    /// Bytes received since Hello was sent, until it is answered.
    overheard: Option<Vec<u8>>,
}

impl Device {
    /// A client without a session. [`Device::urgent`] works at once, everything else after [`Device::hello`]. Frames
    /// are numbered from the low bits of `nonce`, which should be new for every connection.
    #[must_use]
    pub fn new(link: Box<dyn Link>, nonce: u32) -> Self {
        Self {
            link,
            client: Client::numbering_from(nonce as u16),
            identity: None,
            keep_alive_us: KEEP_ALIVE_US,
            owner_patience_us: OWNER_PATIENCE_US,
            interrupt: None,
            pacer: None,
            stop: StopState::default(),
            pending: None,
            clock: None,
            motion: Motion::default(),
            inbox: Inbox::default(),
            overheard: None,
        }
    }

    /// Opens a session with the wanted machine and makes sure that both ends speak the same protocol. `nonce`
    /// should be new for every connection. Moves nothing.
    ///
    /// # Errors
    /// [`ClientError::NoAnswer`], [`ClientError::WrongMachine`], or the link's.
    pub fn connect(
        link: Box<dyn Link>,
        wanted: DeviceKind,
        nonce: u32,
    ) -> Result<Self, ClientError> {
        let mut device = Self::new(link, nonce);
        device.hello(nonce)?;
        device.require(wanted)?;
        Ok(device)
    }

    /// Opens a session with any machine. `nonce` should be new for every connection.
    ///
    /// # Errors
    /// [`ClientError::NoAnswer`], or the link's.
    pub fn hello(&mut self, nonce: u32) -> Result<Identity, ClientError> {
        self.overheard = Some(vec![]);
        let answer = self.asked(true, |client| client.hello(nonce));
        let sign = diagnosis::sign(&self.overheard.take().unwrap_or_default());
        let identity = match answer {
            Ok(Some(Output::Accepted(Response::Hello(identity)))) => identity,
            // Another kind of server identifies itself and closes the connection.
            Err(ClientError::Link(_)) if matches!(sign, Sign::Web | Sign::Ssh | Sign::Text(_)) => {
                return Err(self.no_answer("Hello", sign));
            }
            Err(error) => return Err(error),
            Ok(_) => return Err(self.no_answer("Hello", sign)),
        };
        self.identity = Some(identity);
        self.link.introduce(&identity);
        self.inbox.early.clear();
        if matches(&identity) {
            // Events from before this session are not reported.
            let next = self.events(u32::MAX)?.next;
            self.inbox.begin_at(next);
            self.keep_alive_us = self.asked_keep_alive_us()?;
        }
        Ok(identity)
    }

    /// Interval of requests that keeps this device moving, us: at most a third of its link timeout.
    fn asked_keep_alive_us(&mut self) -> Result<u64, ClientError> {
        let key = SettingKey::LinkTimeoutMs;
        let timeout_ms = self.call(GetSetting { key })?.value;
        Ok(KEEP_ALIVE_US.min(u64::from(timeout_ms) * 1_000 / 3))
    }

    /// Makes sure that this is the wanted machine and that both ends speak the same protocol.
    ///
    /// # Errors
    /// [`ClientError::WrongMachine`]; [`ClientError::NoAnswer`] before [`Device::hello`].
    pub fn require(&self, wanted: DeviceKind) -> Result<(), ClientError> {
        let place = self.place();
        let Some(found) = self.identity else {
            return Err(self.no_answer("Hello", Sign::Silence));
        };
        if found.device == wanted && matches(&found) {
            return Ok(());
        }
        Err(ClientError::WrongMachine {
            place,
            wanted,
            found: Box::new(found),
        })
    }

    /// The device's answer to Hello; `None` before [`Device::hello`].
    #[must_use]
    pub fn identity(&self) -> Option<&Identity> {
        self.identity.as_ref()
    }

    /// Name of the place that the link leads to.
    #[must_use]
    pub fn place(&self) -> String {
        self.link.place()
    }

    /// Whether it is a real machine; unknown before [`Device::hello`].
    #[must_use]
    pub fn origin(&self) -> Origin {
        self.identity().map_or(Origin::Unknown, |identity| {
            Origin::of(identity, &self.place())
        })
    }

    /// The process that owns the line, if it is not this one.
    #[must_use]
    pub fn owner(&self) -> Option<&Owner> {
        self.link.owner()
    }

    /// Asks the owner of the line to give it up. If it agrees, returns true, and the line can soon be opened again.
    pub fn want_line(&mut self) -> bool {
        self.link.want_line()
    }

    /// Whether another process wants the line that this one offers. It waits until this device is dropped.
    pub fn is_line_wanted(&mut self) -> bool {
        self.link.is_line_wanted()
    }

    /// Offers the line to other processes, or withdraws the offer. For an owner that alternates between observing and
    /// working.
    pub fn offer_line(&mut self, offered: bool) {
        self.link.offer_line(offered);
    }

    /// Drops the link, so that another one can be opened to the same port. Afterwards every request fails as with a
    /// pulled cable. The operator's stop is still noticed, and so is one that only the old link knew of.
    pub fn hang_up(&mut self) {
        self.poll_interrupt();
        let gone = Gone {
            place: self.link.place(),
            now_us: self.link.now_us(),
        };
        self.link = Box::new(gone);
    }

    /// The relation of the device's clock to the link's, from the last status.
    #[must_use]
    pub fn clock(&self) -> Option<Clock> {
        self.clock
    }

    /// The link's clock.
    #[must_use]
    pub fn now_us(&self) -> u64 {
        self.link.now_us()
    }

    /// Sets the last stop known when the next orders were given. After a newer stop they are not sent: commands end
    /// with [`ClientError::Interrupted`].
    pub fn ordered_at(&mut self, mark: StopMark) {
        self.link.ordered_at(mark);
    }

    /// Sets whether to ask the owner of the line only once, instead of repeating a question for seconds.
    pub fn ask_once(&mut self, once: bool) {
        self.owner_patience_us = if once { 0 } else { OWNER_PATIENCE_US };
    }

    /// Sets the interrupt. It is polled, and the stop that it returns is sent ahead of everything else.
    pub fn set_interrupt(&mut self, interrupt: Interrupt) {
        self.interrupt = Some(interrupt);
    }

    /// Sets the pacer, which is polled while waiting for the end of an action.
    pub fn set_pacer(&mut self, pacer: Pacer) {
        self.pacer = Some(pacer);
    }

    /// The strongest stop that the interrupt has returned so far.
    #[must_use]
    pub fn interrupted(&self) -> Option<Urgent> {
        self.stop.requested
    }

    /// Number of received blocks of bytes that were not valid frames.
    #[must_use]
    pub fn rejected_frames(&self) -> u32 {
        self.client.rejected_frames()
    }

    /// Takes the number of events that the device had dropped before they were fetched.
    pub fn take_lost_events(&mut self) -> u32 {
        std::mem::take(&mut self.inbox.lost)
    }

    /// Longest time between two requests while this device moves, us.
    #[must_use]
    pub fn keep_alive_us(&self) -> u64 {
        self.keep_alive_us
    }
}

/// Replaces a link that was dropped.
struct Gone {
    place: String,
    now_us: u64,
}

impl Gone {
    fn lost(&self) -> LinkError {
        LinkError::Lost {
            place: self.place.clone(),
            why: "it was given up".to_owned(),
        }
    }
}

impl Link for Gone {
    fn place(&self) -> String {
        self.place.clone()
    }

    fn now_us(&self) -> u64 {
        self.now_us
    }

    fn send(&mut self, _: &[u8]) -> Result<(), LinkError> {
        Err(self.lost())
    }

    fn receive(&mut self, _: &mut [u8], _: u64) -> Result<usize, LinkError> {
        Err(self.lost())
    }
}

#[cfg(test)]
mod tests;
