//! The client of one machine: typed requests, events without gaps, telemetry, waiting, stopping.
//!
//! [`protocol::client::Client`] handles retries, sequence numbers and the session; the [`Link`] carries the bytes and
//! has the clock. All times are on the link's clock, so that the same code runs in real and in virtual time. An urgent
//! stop is sent ahead of everything else.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use protocol::VERSION;
use protocol::capsule::{
    self, ActuationAccepted, ActuationRecord, CapsuleEvent, CapsuleState, CapsuleStatus,
};
use protocol::client::{Client, Output, Poll};
use protocol::error::{Refusal, WireError};
use protocol::rig::{
    self, HomeAccepted, MoveAccepted, RigEvent, RigState, RigStatus, RunAccepted, RunOutcome,
    RunRecord,
};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{
    Acknowledge, DeviceKind, Event, Events, GetEvents, GetLastWords, Identity, KeepAlive,
    SetTelemetry, Urgent, What,
};
use protocol::table::{Endpoint, Impact, Reply, Request, Response, SCHEMA_KEY, Telemetry};

use crate::diagnosis::{self, OVERHEARD, Sign};
use crate::door::lock::StopMark;
use crate::door::{self, Owner};
use crate::error::ClientError;
use crate::identity::Origin;
use crate::link::{Link, LinkError};

/// The longest time between two requests while waiting, us. A moving device stops after 1 s without one, or after the
/// rig's `link_timeout_ms`: three requests go out in that time, should it be shorter.
pub const KEEP_ALIVE_US: u64 = 250_000;

/// Interval between two requests for the status of a move, us.
const POLL_US: u64 = 50_000;

/// The longest wait for bytes before the [`Interrupt`] is polled again, us.
const SLICE_US: u64 = 20_000;

/// Interval between two looks at the record of an actuation that has ended, us: several readings of the capsule.
const BRAKING_US: u64 = 20_000;

/// How long the owner of a line may leave a question unanswered before a window gives up, us. Its door has answered, so
/// it lives: it is setting up, or its computer is.
const OWNER_PATIENCE_US: u64 = 3_000_000;

/// How much later than announced an action may end before it is stopped as overdue, us.
const OVERDUE_US: u64 = 3_000_000;
/// Factor by which a device's clock may be slower than the link's: an emulator on a busy computer, not a time base that stands.
const SLOWEST: u64 = 20;

/// Returns the stop that the operator wants; polled at least every 20 ms of link time. It is a level, not an edge: once
/// it has returned a stop it keeps doing so, and may only escalate to an emergency stop.
pub type Interrupt = Arc<dyn Fn() -> Option<Urgent> + Send + Sync>;

/// What the operator may want during a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// Hold it.
    Hold,
    /// Resume it.
    Resume,
}

/// Returns what the operator wants next; polled at least every 20 ms of link time while waiting. Each answer is sent
/// once, and the device accepts or refuses it.
pub type Pacer = Box<dyn FnMut() -> Option<Pace> + Send>;

/// An action that was accepted and has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
pub enum Begun {
    /// Homing.
    Homing(HomeAccepted),
    /// A run.
    Run(RunAccepted),
    /// Referencing, folding or unfolding.
    Actuation(ActuationAccepted),
    /// A move to a position.
    Move(MoveAccepted),
}

/// How far an action has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Homing.
    Homing {
        /// Since its acceptance, us.
        elapsed_us: u64,
        /// It ends within this time, us, successfully or with a fault.
        at_most_us: u64,
        /// Position, um; meaningful only if the rig was homed before.
        position_um: i32,
    },
    /// A run; a move is one stroke.
    Run {
        /// Into the run, us, without the time it was held; at most `total_us`, although a hold and a resume make the
        /// run a little longer.
        elapsed_us: u64,
        /// Duration of the whole run, us.
        total_us: u64,
        /// Stroke in progress, from 0.
        stroke: u32,
        /// Strokes of the run.
        strokes: u32,
        /// Position by the read-back counter, um.
        position_um: i32,
        /// It is held there.
        held: bool,
    },
    /// Referencing, folding or unfolding.
    Actuation {
        /// Since its acceptance, us.
        elapsed_us: u64,
        /// It ends within this time, us, successfully or with a fault.
        at_most_us: u64,
        /// Thread wound up, um.
        thread_um: i32,
        /// Motor current, mA.
        current_ma: u16,
    },
}

/// Sees what happens during a wait. By default every method does nothing.
pub trait Observer {
    /// An action has begun.
    fn begun(&mut self, begun: &Begun) {
        let _ = begun;
    }
    /// A telemetry sample; `missed` samples were lost just before it.
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        let _ = (sample, missed);
    }
    /// An event. Each comes once and in order; one that is lost on the link is fetched again.
    fn event(&mut self, event: &Event) {
        let _ = event;
    }
    /// Called about four times a second, more often if the rig wants to hear the host more often.
    fn progress(&mut self, progress: &Progress) {
        let _ = progress;
    }
    /// The record cannot be written; the machine goes on, and so does the wait.
    fn unrecorded(&mut self, why: &str) {
        let _ = why;
    }
    /// The device refused what the [`Pacer`] wanted; the wait goes on.
    fn refused(&mut self, pace: Pace, refusal: &Refusal) {
        let _ = (pace, refusal);
    }
    /// Called in each turn of the wait for a run or an actuation, at least every 20 ms while no request is pending, with
    /// the link's clock. It must not take long: until it returns, nobody listens to the device.
    fn turn(&mut self, now_us: u64, clock: Option<Clock>) {
        let _ = (now_us, clock);
    }
}

/// How a device's clock stands to that of its link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clock {
    /// Link's time less device's, us: at least, at most. The device has read its clock between a request and its answer.
    pub ahead_us: (i64, i64),
}

impl Clock {
    /// What an exchange shows in which the device said `device_us`.
    fn of(asked_us: u64, device_us: u64, answered_us: u64) -> Self {
        // A device that says it has run for 300,000 years must not end its host.
        let ahead = |link_us: u64| {
            link_us
                .cast_signed()
                .saturating_sub(device_us.cast_signed())
        };
        Self {
            ahead_us: (ahead(asked_us), ahead(answered_us)),
        }
    }

    /// Time that has passed on the link but not for the device since it was `then`, us, at least.
    fn behind_us(self, then: Self) -> u64 {
        let behind_us = self.ahead_us.0.saturating_sub(then.ahead_us.1);
        u64::try_from(behind_us).unwrap_or(0)
    }
}

/// Passes everything to two observers.
pub struct Both<'a>(pub &'a mut dyn Observer, pub &'a mut dyn Observer);

impl Observer for Both<'_> {
    fn begun(&mut self, begun: &Begun) {
        self.0.begun(begun);
        self.1.begun(begun);
    }
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.0.telemetry(sample, missed);
        self.1.telemetry(sample, missed);
    }
    fn event(&mut self, event: &Event) {
        self.0.event(event);
        self.1.event(event);
    }
    fn progress(&mut self, progress: &Progress) {
        self.0.progress(progress);
        self.1.progress(progress);
    }
    fn unrecorded(&mut self, why: &str) {
        self.0.unrecorded(why);
        self.1.unrecorded(why);
    }
    fn refused(&mut self, pace: Pace, refusal: &Refusal) {
        self.0.refused(pace, refusal);
        self.1.refused(pace, refusal);
    }
    fn turn(&mut self, now_us: u64, clock: Option<Clock>) {
        self.0.turn(now_us, clock);
        self.1.turn(now_us, clock);
    }
}

/// Ignores everything.
#[derive(Clone, Copy, Debug)]
pub struct Unobserved;
impl Observer for Unobserved {}

/// Result of homing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Homed {
    /// Position of the flag in the second pass, relative to the first pass, steps.
    pub repeat_steps: i32,
    /// Shift of the reference since the previous homing, steps; 0 if the position was not trusted before.
    pub shift_steps: i32,
    /// From the acceptance of the request to the end, us.
    pub duration_us: u64,
}

/// State of an action that is waited for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ActionState {
    Running,
    /// Held: its time limit moves on.
    Paused,
    /// Running again after a hold, which makes it this much longer than announced, us.
    Extended(u64),
    Ended,
}

impl From<bool> for ActionState {
    fn from(ended: bool) -> Self {
        if ended { Self::Ended } else { Self::Running }
    }
}

/// A request whose answer comes in [`Device::attend`].
#[derive(Clone, Copy, Debug)]
struct Posted {
    name: &'static str,
    impact: Impact,
    at_us: u64,
}

enum Turn {
    Nothing,
    Answered(Output),
    Unanswered,
    UrgentUnanswered,
}

/// One machine at the end of a link.
pub struct Device {
    link: Box<dyn Link>,
    client: Client,
    identity: Option<Identity>,
    /// Time between two requests while waiting, us.
    keep_alive_us: u64,
    /// How long a question to the owner of the line is repeated, us.
    owner_patience_us: u64,
    interrupt: Option<Interrupt>,
    pacer: Option<Pacer>,
    /// The strongest urgent stop that the interrupt has returned so far.
    interrupted: Option<Urgent>,
    urgent_pending: bool,
    /// A command is pending that must not be repeated after a stop.
    commanding: bool,
    /// A request whose answer is not waited for.
    posted: Option<Posted>,
    /// By the last exchange that told the device's time.
    clock: Option<Clock>,
    /// Something moves, by what the device has answered last.
    moves: bool,
    /// Index of the next event to deliver.
    next_event: u32,
    /// Events that arrived before an earlier one.
    early: BTreeMap<u32, Event>,
    events: VecDeque<Event>,
    lost_events: u32,
    telemetry: VecDeque<(u16, Telemetry)>,
    /// What came since Hello was sent, until it is answered.
    overheard: Option<Vec<u8>>,
}

/// Samples that are kept until somebody takes them; beyond that the oldest are dropped.
const TELEMETRY_INBOX: usize = 4_096;

/// Readings of a recording, beyond which it is that of no capsule: they keep the last 2,000.
const MOST_POINTS: usize = 10_000;

/// Whether a stop makes the host forget it: once the operator has stopped, it must not be repeated.
fn is_abandonable(impact: Impact) -> bool {
    !matches!(impact, Impact::None | Impact::Pace)
}

fn moves(state: CapsuleState) -> bool {
    matches!(
        state,
        CapsuleState::Referencing
            | CapsuleState::Checking
            | CapsuleState::Folding
            | CapsuleState::Unfolding
    )
}

/// The recording of an actuation, its readings 1 ms apart.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Recorded {
    /// Number of the actuation; 0 if there was none.
    pub actuation: u32,
    /// The last [`protocol::capsule::KEPT_TRACE_POINTS`] readings.
    pub points: Vec<capsule::TracePoint>,
}

impl Device {
    /// A client without a session: [`Device::urgent`] works at once, everything else after
    /// [`Device::hello`]. It numbers its frames from the low bits of `nonce`, which should be new for every connection.
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
            interrupted: None,
            urgent_pending: false,
            commanding: false,
            posted: None,
            clock: None,
            moves: false,
            next_event: 0,
            early: BTreeMap::new(),
            events: VecDeque::new(),
            lost_events: 0,
            telemetry: VecDeque::new(),
            overheard: None,
        }
    }

    /// Opens a session with the wanted machine and makes sure that both ends speak the same protocol. `nonce`
    /// should be new for every connection. Moves nothing.
    ///
    /// # Errors
    /// [`ClientError::NoAnswer`], [`ClientError::WrongDevice`], [`ClientError::Mismatch`], or the link's.
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

    /// Opens a session with whatever machine is there. `nonce` should be new for every connection.
    ///
    /// # Errors
    /// [`ClientError::NoAnswer`], or the link's.
    pub fn hello(&mut self, nonce: u32) -> Result<Identity, ClientError> {
        self.overheard = Some(vec![]);
        let answer = self.asked(true, |client| client.hello(nonce));
        let sign = diagnosis::sign(&self.overheard.take().unwrap_or_default());
        let identity = match answer {
            Ok(Some(Output::Accepted(Response::Hello(identity)))) => identity,
            // A server of another kind says what it is, and ends the connection.
            Err(ClientError::Link(_)) if matches!(sign, Sign::Web | Sign::Ssh | Sign::Text(_)) => {
                return Err(self.no_answer(sign));
            }
            Err(error) => return Err(error),
            Ok(_) => return Err(self.no_answer(sign)),
        };
        self.identity = Some(identity);
        self.link.introduce(&identity);
        self.early.clear();
        if matches(&identity) {
            // Events from before this session are not reported.
            self.next_event = self.events(u32::MAX)?.next;
            // One that came before the answer will be fetched, and would be reported twice.
            let next = self.next_event;
            self.events.retain(|event| event.index < next);
            self.keep_alive_us = self.asked_keep_alive_us()?;
        }
        Ok(identity)
    }

    /// How often this device wants to hear the host while it moves, us.
    fn asked_keep_alive_us(&mut self) -> Result<u64, ClientError> {
        let key = SettingKey::LinkTimeoutMs;
        let timeout_ms = self.call(GetSetting { key })?.value;
        Ok(KEEP_ALIVE_US.min(u64::from(timeout_ms) * 1_000 / 3))
    }

    /// Makes sure that this is the wanted machine and that both ends speak the same protocol.
    ///
    /// # Errors
    /// [`ClientError::WrongDevice`], [`ClientError::Mismatch`]; [`ClientError::NoAnswer`] before
    /// [`Device::hello`].
    pub fn require(&self, wanted: DeviceKind) -> Result<(), ClientError> {
        let place = self.place();
        let Some(found) = self.identity else {
            return Err(self.no_answer(Sign::Silence));
        };
        let found = Box::new(found);
        if found.device != wanted {
            return Err(ClientError::WrongDevice {
                place,
                wanted,
                found,
            });
        }
        if !matches(&found) {
            return Err(ClientError::Mismatch { place, found });
        }
        Ok(())
    }

    /// The device's answer to Hello; none before [`Device::hello`].
    #[must_use]
    pub fn identity(&self) -> Option<&Identity> {
        self.identity.as_ref()
    }

    /// What the link leads to.
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

    /// Asks the owner of the line to give it up. True if it does that: then the line can be opened again soon.
    pub fn want_line(&mut self) -> bool {
        self.link.want_line()
    }

    /// Another process wants the line, which was offered: it waits until this device is dropped.
    pub fn is_line_wanted(&mut self) -> bool {
        self.link.is_line_wanted()
    }

    /// From now on other processes may have the line, or no longer: an owner that works at times and only looks at others.
    pub fn offer_line(&mut self, offered: bool) {
        self.link.offer_line(offered);
    }

    /// Gives the link up, so that another one can be opened to the same port. From now on everything fails as with a
    /// pulled cable; the operator's stop is still noticed.
    pub fn hang_up(&mut self) {
        let gone = Gone {
            place: self.link.place(),
            now_us: self.link.now_us(),
        };
        self.link = Box::new(gone);
    }

    /// From now on, what happens is recorded in this file: whoever has the line after a process that was killed finds it
    /// there. With `None` nothing is left to be ended.
    pub fn records(&mut self, sidecar: Option<&Path>) {
        self.link.records(sidecar);
    }

    /// The record of a process that had the line before this one, and was killed.
    #[must_use]
    pub fn left_record(&self) -> Option<PathBuf> {
        self.link.left_record()
    }

    /// How the device's clock stands to the link's, by the last status.
    #[must_use]
    pub fn clock(&self) -> Option<Clock> {
        self.clock
    }

    /// The link's clock.
    #[must_use]
    pub fn now_us(&self) -> u64 {
        self.link.now_us()
    }

    /// What is ordered from now on was wanted when this was the last stop on the line. After a newer one it is not sent:
    /// commands end with [`ClientError::Interrupted`].
    pub fn ordered_at(&mut self, mark: StopMark) {
        self.link.ordered_at(mark);
    }

    /// Asks the owner of the line once instead of for seconds.
    pub fn expect_haste(&mut self) {
        self.owner_patience_us = 0;
    }

    /// Polls `interrupt` from now on and sends the stop it returns ahead of everything else.
    pub fn set_interrupt(&mut self, interrupt: Interrupt) {
        self.interrupt = Some(interrupt);
    }

    /// Polls `pacer` from now on while waiting for the end of an action.
    pub fn set_pacer(&mut self, pacer: Pacer) {
        self.pacer = Some(pacer);
    }

    /// The strongest stop that the interrupt has returned so far.
    #[must_use]
    pub fn interrupted(&self) -> Option<Urgent> {
        self.interrupted
    }

    /// Number of received blocks of bytes that were not valid frames.
    #[must_use]
    pub fn rejected_frames(&self) -> u32 {
        self.client.rejected_frames()
    }

    /// Number of events that the device had dropped before they could be fetched again.
    #[must_use]
    pub fn lost_events(&self) -> u32 {
        self.lost_events
    }

    // One method per row of the table.

    /// Sends any request of the table and unwraps its response.
    ///
    /// # Errors
    /// [`ClientError`]; [`ClientError::OutcomeUnknown`] if a command was sent and not answered.
    pub fn call<E: Endpoint>(&mut self, request: E) -> Result<E::Response, ClientError> {
        let request = request.into_request();
        let name = request.name();
        let response = self.exchange(&request)?;
        E::from_response(response).ok_or_else(|| ClientError::WrongResponse {
            place: self.place(),
            request: name,
        })
    }

    /// Tells the device that the host is there.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn keep_alive(&mut self) -> Result<(), ClientError> {
        self.call(KeepAlive).map(|_| ())
    }

    /// Text of the last panic or processor fault; empty if there was none.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn last_words(&mut self) -> Result<String, ClientError> {
        Ok(self.call(GetLastWords)?.text.as_str().to_owned())
    }

    /// Sets the interval of telemetry in ms, 5..=1000, or 0 for none.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn set_telemetry(&mut self, period_ms: u16) -> Result<(), ClientError> {
        self.call(SetTelemetry { period_ms }).map(|_| ())
    }

    /// Some events from the device's ring, from index `from` on.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn events(&mut self, from: u32) -> Result<Events, ClientError> {
        self.call(GetEvents { from })
    }

    /// Clears a latched fault after its cause was removed. Moves nothing.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn acknowledge(&mut self) -> Result<(), ClientError> {
        self.call(Acknowledge).map(|_| ())
    }

    /// Status of the rig.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn rig_status(&mut self) -> Result<RigStatus, ClientError> {
        self.call(rig::GetRigStatus)
    }

    /// Begins homing; [`Device::wait_homing`] waits for its end.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn home(&mut self) -> Result<HomeAccepted, ClientError> {
        self.call(rig::Home)
    }

    /// Begins a run; [`Device::wait_run`] waits for its end. Nothing is checked here: the device decides.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn run(&mut self, run: rig::Run) -> Result<RunAccepted, ClientError> {
        self.call(run)
    }

    /// Record of the last run.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn run_record(&mut self) -> Result<RunRecord, ClientError> {
        self.call(rig::GetRunRecord)
    }

    /// Status of the capsule.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn capsule_status(&mut self) -> Result<CapsuleStatus, ClientError> {
        self.call(capsule::GetCapsuleStatus)
    }

    /// Begins to find the thread's zero; [`Device::wait_actuation`] waits for its end.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn reference(&mut self) -> Result<ActuationAccepted, ClientError> {
        self.call(capsule::Reference)
    }

    /// Begins to fold; [`Device::wait_actuation`] waits for its end.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn fold(&mut self) -> Result<ActuationAccepted, ClientError> {
        self.call(capsule::Fold)
    }

    /// Begins to unfold; [`Device::wait_actuation`] waits for its end.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn unfold(&mut self) -> Result<ActuationAccepted, ClientError> {
        self.call(capsule::Unfold)
    }

    /// Record of the last actuation.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn actuation_record(&mut self) -> Result<ActuationRecord, ClientError> {
        self.call(capsule::GetActuationRecord)
    }

    // Stops.

    /// Stops the machine, ahead of everything else; needs no session and no matching protocol.
    ///
    /// # Errors
    /// [`ClientError::StopUnconfirmed`] if the device did not confirm, or the link's.
    pub fn urgent(&mut self, urgent: Urgent) -> Result<(), ClientError> {
        self.client.urgent(urgent);
        self.urgent_pending = true;
        while self.urgent_pending {
            self.step(u64::MAX)?;
        }
        Ok(())
    }

    // Waiting.

    /// Waits until homing ends.
    ///
    /// # Errors
    /// [`ClientError::NotHomed`], [`ClientError::Overdue`], or as [`Device::call`].
    pub fn wait_homing(
        &mut self,
        accepted: &HomeAccepted,
        observer: &mut dyn Observer,
    ) -> Result<Homed, ClientError> {
        observer.begun(&Begun::Homing(*accepted));
        let start_us = self.now_us();
        let mut found = None;
        let at_most_us = homing_limit_us(accepted);
        self.wait("homing", at_most_us, observer, |device, event, observer| {
            if let Some(event) = event {
                return Ok(match event.what {
                    What::Rig(RigEvent::Homed {
                        repeat_steps,
                        shift_steps,
                    }) => {
                        found = Some((repeat_steps, shift_steps));
                        true
                    }
                    // The event may be an older one that was still in transit, so the status decides.
                    What::Rig(RigEvent::Faulted(_) | RigEvent::Stopped { .. }) => !matches!(
                        device.rig_status()?.state,
                        RigState::Homing | RigState::Stopping
                    ),
                    _ => false,
                });
            }
            let status = device.rig_status()?;
            observer.progress(&Progress::Homing {
                elapsed_us: device.now_us() - start_us,
                at_most_us,
                position_um: status.position_um,
            });
            Ok(!matches!(
                status.state,
                RigState::Homing | RigState::Stopping
            ))
        })?;
        match found {
            Some((repeat_steps, shift_steps)) => Ok(Homed {
                repeat_steps,
                shift_steps,
                duration_us: self.now_us() - start_us,
            }),
            None => Err(ClientError::NotHomed {
                fault: self.rig_status()?.fault,
            }),
        }
    }

    /// Waits until a run ends, however it ends, and returns the device's record of it.
    ///
    /// # Errors
    /// [`ClientError::Overdue`], or as [`Device::call`].
    pub fn wait_run(
        &mut self,
        accepted: &RunAccepted,
        observer: &mut dyn Observer,
    ) -> Result<RunRecord, ClientError> {
        observer.begun(&Begun::Run(*accepted));
        let total_us = accepted.total_ticks.div_ceil(100);
        // Braking and accelerating again take no longer than the ramps of a stroke.
        let detour_us = accepted.forward.ramp_ticks.max(accepted.back.ramp_ticks) / 50;
        let (mut elapsed_us, mut paused_us, mut held_since_us) = (0, 0_u64, None);
        self.wait("the run", total_us, observer, |device, event, observer| {
            if let Some(event) = event {
                return Ok(match event.what {
                    What::Rig(RigEvent::RunEnded { run, .. }) if run == accepted.run => {
                        ActionState::Ended
                    }
                    What::Rig(RigEvent::Held { .. }) => {
                        held_since_us = Some(event.time_us);
                        ActionState::Running
                    }
                    What::Rig(RigEvent::Resumed) => {
                        let held_us = held_since_us
                            .take()
                            .map_or(0, |since_us| event.time_us.saturating_sub(since_us));
                        paused_us = paused_us.saturating_add(held_us);
                        ActionState::Extended(detour_us)
                    }
                    _ => ActionState::Running,
                });
            }
            let status = device.rig_status()?;
            if status.state == RigState::Running && held_since_us.is_none() {
                elapsed_us = status.elapsed_us.saturating_sub(paused_us).min(total_us);
            }
            observer.progress(&Progress::Run {
                elapsed_us,
                total_us,
                stroke: status.stroke,
                strokes: u32::from(accepted.requested.cycles) * 2,
                position_um: status.position_um,
                held: status.state == RigState::Held,
            });
            Ok(match status.state {
                RigState::Running | RigState::Stopping => ActionState::Running,
                RigState::Held => ActionState::Paused,
                _ => ActionState::Ended,
            })
        })?;
        self.run_record()
    }

    /// Waits until a move ends, however it ends, and returns how it did and the rig's status then.
    ///
    /// # Errors
    /// [`ClientError::Overdue`], or as [`Device::call`].
    pub fn wait_move(
        &mut self,
        accepted: &MoveAccepted,
        observer: &mut dyn Observer,
    ) -> Result<(RunOutcome, RigStatus), ClientError> {
        observer.begun(&Begun::Move(*accepted));
        let begun_us = self.now_us();
        let total_us = accepted.stroke.duration_ticks.div_ceil(100);
        let mut link_lost = false;
        self.wait("the move", total_us, observer, |device, event, observer| {
            link_lost |= event.is_some_and(|event| event.what == What::LinkLost);
            // Events only hasten the look: an older one may still be in transit.
            let status = device.rig_status()?;
            observer.progress(&Progress::Run {
                elapsed_us: (device.now_us() - begun_us).min(total_us),
                total_us,
                stroke: 0,
                strokes: 1,
                position_um: status.position_um,
                held: false,
            });
            Ok(!matches!(
                status.state,
                RigState::Moving | RigState::Stopping
            ))
        })?;
        let status = self.rig_status()?;
        let outcome = match status.fault {
            Some(fault) => RunOutcome::Faulted(fault),
            None if status.position_steps == accepted.to_steps => RunOutcome::Complete,
            None if link_lost => RunOutcome::LinkLost,
            None => RunOutcome::Stopped,
        };
        Ok((outcome, status))
    }

    /// Waits for the end of a move or a stop and returns the rig's status. Does not wait for the end of a run.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn wait_rest(&mut self) -> Result<RigStatus, ClientError> {
        loop {
            let status = self
                .rig_status()
                .map_err(|error| while_moving("the motion", error))?;
            if !matches!(status.state, RigState::Moving | RigState::Stopping) {
                return Ok(status);
            }
            self.idle(POLL_US, &mut Unobserved)
                .map_err(|error| while_moving("the motion", error))?;
        }
    }

    /// Fetches the recording of the capsule's last actuation, once it has ended: until then it grows.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn trace(&mut self) -> Result<Recorded, ClientError> {
        let mut recorded = Recorded::default();
        while moves(self.capsule_status()?.state) {
            self.idle(POLL_US, &mut Unobserved)?;
        }
        loop {
            let from = recorded.points.len() as u32;
            let part = self.call(capsule::GetTrace { from })?;
            if part.actuation != recorded.actuation && from > 0 {
                recorded = Recorded::default();
                continue;
            }
            recorded.actuation = part.actuation;
            if part.points.is_empty() {
                return Ok(recorded);
            }
            recorded.points.extend(part.points);
            if recorded.points.len() > MOST_POINTS {
                return Err(ClientError::WrongResponse {
                    place: self.place(),
                    request: "GetTrace",
                });
            }
        }
    }

    /// Waits until an actuation of the capsule ends, however it ends, and its motor stands, and returns the device's
    /// record of it.
    ///
    /// # Errors
    /// [`ClientError::Overdue`], or as [`Device::call`].
    pub fn wait_actuation(
        &mut self,
        accepted: &ActuationAccepted,
        observer: &mut dyn Observer,
    ) -> Result<ActuationRecord, ClientError> {
        observer.begun(&Begun::Actuation(*accepted));
        let start_us = self.now_us();
        let at_most_us = u64::from(accepted.timeout_ms) * 1_000;
        self.wait(
            "the actuation",
            at_most_us,
            observer,
            |device, event, observer| {
                if let Some(event) = event {
                    return Ok(matches!(
                        event.what,
                        What::Capsule(CapsuleEvent::Ended { actuation, .. })
                            if actuation == accepted.actuation
                    ));
                }
                let status = device.capsule_status()?;
                observer.progress(&Progress::Actuation {
                    elapsed_us: device.now_us() - start_us,
                    at_most_us,
                    thread_um: status.thread_um,
                    current_ma: status.current_ma,
                });
                Ok(!moves(status.state))
            },
        )?;
        self.final_record(observer)
            .map_err(|error| while_moving("the actuation", error))
    }

    /// The record of the actuation that has just ended, when it no longer changes: while the motor is braked, it runs
    /// on for a tenth of a millimetre of thread.
    fn final_record(
        &mut self,
        observer: &mut dyn Observer,
    ) -> Result<ActuationRecord, ClientError> {
        let mut record = self.actuation_record()?;
        loop {
            self.idle(BRAKING_US, observer)?;
            let later = self.actuation_record()?;
            if later == record || later.actuation != record.actuation {
                return Ok(record);
            }
            record = later;
        }
    }

    /// Waits for `duration_us` of link time with keep-alives; passes telemetry and events to the observer.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn idle(
        &mut self,
        duration_us: u64,
        observer: &mut dyn Observer,
    ) -> Result<(), ClientError> {
        let end_us = self.now_us().saturating_add(duration_us);
        while self.now_us() < end_us {
            let until_us = self.now_us().saturating_add(self.keep_alive_us).min(end_us);
            self.listen(until_us)?;
            self.keep_alive()?;
            self.hand_out(observer);
        }
        self.fetch_events()?;
        self.hand_out(observer);
        Ok(())
    }

    /// Receives for `duration_us` of link time without a request of its own, and hands out what comes as it comes. What
    /// another process asks through the door is asked.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn observe(
        &mut self,
        duration_us: u64,
        observer: &mut dyn Observer,
    ) -> Result<(), ClientError> {
        let end_us = self.now_us().saturating_add(duration_us);
        while self.now_us() < end_us {
            self.step(end_us)?;
            if !self.early.is_empty() {
                self.fetch_events()?;
            }
            self.hand_out(observer);
        }
        Ok(())
    }

    /// Waits until the stop that was sent is confirmed, if one was.
    ///
    /// # Errors
    /// [`ClientError::StopUnconfirmed`] if the device did not confirm, or the link's.
    pub fn settle(&mut self) -> Result<(), ClientError> {
        while self.urgent_pending {
            self.step(u64::MAX)?;
        }
        Ok(())
    }

    /// Forgets the stop that the interrupt or another process has wanted: commands are sent again. For a process that goes
    /// on after a stop, once it is settled.
    pub fn forget_stop(&mut self) {
        self.interrupted = None;
        self.link.forget_stop();
    }

    /// Sends nothing for `duration_us` of link time, as a host that is gone. The operator's stop goes out all the same.
    ///
    /// # Errors
    /// The link's, or [`ClientError::StopUnconfirmed`].
    pub fn fall_silent(&mut self, duration_us: u64) -> Result<(), ClientError> {
        self.listen(self.now_us().saturating_add(duration_us))
    }

    /// As [`Device::wait_for`]; a link that falls silent meanwhile is no small matter.
    fn wait<C: Into<ActionState>>(
        &mut self,
        action: &'static str,
        at_most_us: u64,
        observer: &mut dyn Observer,
        state: impl FnMut(&mut Self, Option<&Event>, &mut dyn Observer) -> Result<C, ClientError>,
    ) -> Result<(), ClientError> {
        self.wait_for(action, at_most_us, observer, state)
            .map_err(|error| while_moving(action, error))
    }

    /// Waits until `state` returns [`ActionState::Ended`]. It is called with each event, and every
    /// `keep_alive_us` without one. Then it requests the device's status, which is also the keep-alive and shows the end even if its
    /// event was lost.
    fn wait_for<C: Into<ActionState>>(
        &mut self,
        action: &'static str,
        at_most_us: u64,
        observer: &mut dyn Observer,
        mut state: impl FnMut(&mut Self, Option<&Event>, &mut dyn Observer) -> Result<C, ClientError>,
    ) -> Result<(), ClientError> {
        let start_us = self.now_us();
        let mut start_clock = self.clock;
        let mut limit_us = at_most_us.saturating_add(OVERDUE_US);
        let mut asked_us = start_us;
        let mut over = false;
        loop {
            if !self.early.is_empty() {
                self.fetch_events()?;
            }
            while let Some(event) = self.events.pop_front() {
                observer.event(&event);
                match state(self, Some(&event), observer)?.into() {
                    ActionState::Ended => over = true,
                    ActionState::Extended(us) => limit_us = limit_us.saturating_add(us),
                    ActionState::Running | ActionState::Paused => {}
                }
            }
            self.hand_out_telemetry(observer);
            if over {
                return Ok(());
            }
            self.pace(observer)?;
            observer.turn(self.now_us(), self.clock);
            let now_us = self.now_us();
            if now_us >= asked_us.saturating_add(self.keep_alive_us) {
                match state(self, None, observer)?.into() {
                    ActionState::Ended => {
                        // The action has ended: an event that has not arrived by now was lost.
                        over = true;
                        self.fetch_events()?;
                        continue;
                    }
                    ActionState::Paused => limit_us = limit_us.saturating_add(now_us - asked_us),
                    ActionState::Running | ActionState::Extended(_) => {}
                }
                asked_us = now_us;
                start_clock = start_clock.or(self.clock);
                if self.passed_us(start_us, start_clock) > limit_us {
                    self.urgent(Urgent::Stop)?;
                    return Err(ClientError::Overdue {
                        place: self.place(),
                        action,
                        limit_ms: limit_us / 1_000,
                    });
                }
            }
            self.step(asked_us.saturating_add(self.keep_alive_us))?;
        }
    }

    /// Time since the link's clock was at `start_us` and the device's at `start_clock`, us. The device's clock counts, so
    /// that an emulated device that cannot keep up is not overdue; a clock slower than [`SLOWEST`] is broken.
    fn passed_us(&self, start_us: u64, start_clock: Option<Clock>) -> u64 {
        let passed_us = self.now_us() - start_us;
        let behind_us = start_clock
            .zip(self.clock)
            .map_or(0, |(then, now)| now.behind_us(then));
        passed_us.saturating_sub(behind_us).max(passed_us / SLOWEST)
    }

    /// Sends what the pacer returns. After a stop it no longer matters that this is not sent.
    fn pace(&mut self, observer: &mut dyn Observer) -> Result<(), ClientError> {
        let Some(pace) = self.pacer.as_mut().and_then(|pacer| pacer()) else {
            return Ok(());
        };
        let answer = match pace {
            Pace::Hold => self.call(rig::Hold),
            Pace::Resume => self.call(rig::Resume),
        };
        match answer {
            Ok(_) | Err(ClientError::Interrupted { .. }) => Ok(()),
            Err(ClientError::Refused { refusal, .. }) => {
                observer.refused(pace, &refusal);
                Ok(())
            }
            Err(error) => Err(error),
        }
    }

    // Without waiting.

    /// Sends a request; [`Device::attend`] returns the answer. One at a time, and no other request before its answer.
    ///
    /// # Errors
    /// [`ClientError::Owned`], [`ClientError::Interrupted`] or [`ClientError::SessionLost`]; then it was not sent.
    pub fn post<E: Endpoint>(&mut self, request: E) -> Result<(), ClientError> {
        let request = request.into_request();
        self.ask_interrupt();
        self.admit(&request)?;
        let (name, impact) = (request.name(), request.impact());
        if impact != Impact::None && self.interrupted.is_some() {
            return Err(ClientError::Interrupted { request: name });
        }
        self.commanding = is_abandonable(impact);
        if self.client.request(&request).is_err() {
            return Err(self.session_lost());
        }
        self.posted = Some(Posted {
            name,
            impact,
            at_us: self.now_us(),
        });
        Ok(())
    }

    /// Whether a posted request has no answer yet.
    #[must_use]
    pub fn is_posted(&self) -> bool {
        self.posted.is_some()
    }

    /// Sends and receives what is there until `until_us` on the link's clock, at once if that is past; hands out what comes.
    /// Returns the answer to what was posted, if it has come.
    ///
    /// # Errors
    /// As [`Device::call`] of what was posted.
    pub fn attend(
        &mut self,
        until_us: u64,
        observer: &mut dyn Observer,
    ) -> Result<Option<Response>, ClientError> {
        if self.posted.is_none() {
            self.serve()?;
        }
        let mut answer = None;
        // Once more after the end: a turn either sends or receives.
        let mut last = false;
        while !last && answer.is_none() {
            last = self.now_us() >= until_us;
            let pending = self.posted;
            answer = match (self.turn(until_us)?, pending) {
                (Turn::UrgentUnanswered, _) => return Err(self.stop_unconfirmed()),
                (Turn::Answered(output), Some(posted)) => Some((posted, Some(output))),
                (Turn::Unanswered, Some(posted)) => Some((posted, None)),
                (Turn::Nothing, Some(posted))
                    if is_abandonable(posted.impact) && !self.commanding =>
                {
                    Some((posted, None))
                }
                _ => None,
            };
        }
        self.hand_out(observer);
        let Some((posted, answer)) = answer else {
            return Ok(None);
        };
        self.posted = None;
        self.answered(posted, answer).map(Some)
    }

    /// Telemetry since the last call, oldest first, each sample with the number of those lost before it.
    pub fn take_telemetry(&mut self) -> Vec<(u16, Telemetry)> {
        self.telemetry.drain(..).collect()
    }

    /// Events since the last call, in order and without gaps.
    ///
    /// # Errors
    /// As [`Device::call`]: missing events are fetched again.
    pub fn take_events(&mut self) -> Result<Vec<Event>, ClientError> {
        self.fetch_events()?;
        Ok(self.events.drain(..).collect())
    }

    fn hand_out(&mut self, observer: &mut dyn Observer) {
        for event in self.events.drain(..) {
            observer.event(&event);
        }
        self.hand_out_telemetry(observer);
    }

    fn hand_out_telemetry(&mut self, observer: &mut dyn Observer) {
        for (missed, sample) in self.telemetry.drain(..) {
            observer.telemetry(&sample, missed);
        }
    }

    /// Receives until `until_us` without a request.
    fn listen(&mut self, until_us: u64) -> Result<(), ClientError> {
        while self.now_us() < until_us {
            self.step(until_us)?;
        }
        Ok(())
    }

    // Events.

    fn note_event(&mut self, event: Event) {
        // The largest index is that of no event: whoever asks for it gets none.
        if event.index >= self.next_event && event.index != u32::MAX {
            self.early.insert(event.index, event);
        }
        while let Some(event) = self.early.remove(&self.next_event) {
            self.next_event += 1;
            self.moves &= !is_end(&event);
            self.events.push_back(event);
        }
    }

    /// Fetches all events that the device has and this client has not.
    fn fetch_events(&mut self) -> Result<(), ClientError> {
        loop {
            let from = self.next_event;
            let piece = self.events(from)?;
            if piece.oldest > self.next_event {
                self.lost_events = self
                    .lost_events
                    .saturating_add(piece.oldest - self.next_event);
                self.next_event = piece.oldest;
                self.early = self.early.split_off(&piece.oldest);
            }
            for event in &piece.events {
                self.note_event(*event);
            }
            if self.next_event >= piece.next || self.next_event == from {
                return Ok(());
            }
        }
    }

    // Bytes.

    fn exchange(&mut self, request: &Request) -> Result<Response, ClientError> {
        let (name, impact) = (request.name(), request.impact());
        self.ask_interrupt();
        let command = impact != Impact::None;
        self.admit(request)?;
        if command && self.interrupted.is_some() {
            while self.urgent_pending {
                self.step(u64::MAX)?;
            }
            return Err(ClientError::Interrupted { request: name });
        }
        self.commanding = is_abandonable(impact);
        let at_us = self.now_us();
        let answer = self.asked(!command, |client| client.request(request));
        let answer = match answer {
            Ok(answer) => answer,
            Err(error) => {
                self.commanding = false;
                return Err(error);
            }
        };
        let posted = Posted {
            name,
            impact,
            at_us,
        };
        self.answered(posted, answer)
    }

    /// Refuses what the owner of the line would not do for this process.
    fn admit(&self, request: &Request) -> Result<(), ClientError> {
        match self.link.owner() {
            Some(owner) if !door::admits(request) => Err(ClientError::Owned {
                place: self.place(),
                request: request.name(),
                owner: Box::new(owner.clone()),
            }),
            _ => Ok(()),
        }
    }

    /// What the answer to a request means, or its absence.
    fn answered(
        &mut self,
        posted: Posted,
        answer: Option<Output>,
    ) -> Result<Response, ClientError> {
        let Posted {
            name: request_name,
            impact,
            at_us,
        } = posted;
        let place = self.place();
        let command = impact != Impact::None;
        let abandoned = is_abandonable(impact) && !std::mem::take(&mut self.commanding);
        match answer {
            _ if abandoned => Err(ClientError::Interrupted {
                request: request_name,
            }),
            Some(Output::Accepted(response)) => {
                self.note_clock(at_us, &response);
                self.note_motion(impact, &response);
                Ok(response)
            }
            Some(Output::Refused(refusal)) => Err(ClientError::Refused {
                place,
                request: request_name,
                impact,
                refusal,
            }),
            Some(Output::Rejected(WireError::NoSession)) => Err(self.session_lost()),
            Some(Output::Rejected(error)) => Err(ClientError::Rejected {
                place,
                request: request_name,
                error,
            }),
            _ if !command && self.link.owner().is_some() => Err(ClientError::OwnerBusy {
                place,
                request: request_name,
                owner: self
                    .link
                    .owner()
                    .map(ToString::to_string)
                    .unwrap_or_default(),
            }),
            // What was asked last says nothing about what moves.
            _ if !command && self.moves => Err(ClientError::Silent {
                place,
                action: "a motion",
            }),
            _ if command => Err(ClientError::OutcomeUnknown {
                place,
                request: request_name,
            }),
            _ => Err(ClientError::NoReply {
                place,
                request: request_name,
            }),
        }
    }

    /// Notes the device's time, if an answer tells it. The last one counts: clocks drift.
    fn note_clock(&mut self, asked_us: u64, response: &Response) {
        let device_us = match response {
            Response::GetRigStatus(status) => status.time_us,
            Response::GetCapsuleStatus(status) => status.time_us,
            _ => return,
        };
        self.clock = Some(Clock::of(asked_us, device_us, self.now_us()));
    }

    /// Notes what an answer says of the motion.
    fn note_motion(&mut self, impact: Impact, response: &Response) {
        self.moves = match response {
            Response::GetRigStatus(status) => matches!(
                status.state,
                RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping
            ),
            Response::GetCapsuleStatus(status) => moves(status.state),
            Response::GetRunRecord(record) => record.outcome == RunOutcome::Running,
            Response::Resume(_) => true,
            _ => self.moves || impact == Impact::Motion,
        };
    }

    /// The fault that is latched after everything that the operator has asked for: another stop may go out while the device
    /// answers, and an emergency stop costs the position also of a machine that stands already.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn latched_fault(&mut self) -> Result<Option<String>, ClientError> {
        loop {
            let asked = self.interrupted();
            let fault = match self.identity.map(|identity| identity.device) {
                Some(DeviceKind::Capsule) => self.capsule_status()?.fault.map(|f| f.to_string()),
                _ => self.rig_status()?.fault.map(|fault| fault.to_string()),
            };
            if self.interrupted() == asked {
                return Ok(fault);
            }
        }
    }

    /// Asks, and waits for the answer as [`Device::answer`] does. What `may_repeat` is asked again while the owner of the
    /// line is busy.
    fn asked<E>(
        &mut self,
        may_repeat: bool,
        ask: impl Fn(&mut Client) -> Result<(), E>,
    ) -> Result<Option<Output>, ClientError> {
        let begin_us = self.link.now_us();
        loop {
            if ask(&mut self.client).is_err() {
                return Err(self.session_lost());
            }
            let answer = self.answer()?;
            let waited_us = self.link.now_us() - begin_us;
            if answer.is_some()
                || !may_repeat
                || self.link.owner().is_none()
                || self.interrupted.is_some()
                || waited_us >= self.owner_patience_us
            {
                return Ok(answer);
            }
        }
    }

    /// Waits for the answer to the pending request; `None` if there was none, or if a stop has cancelled it.
    fn answer(&mut self) -> Result<Option<Output>, ClientError> {
        let commanding = self.commanding;
        loop {
            match self.turn(u64::MAX)? {
                Turn::Answered(output) => return Ok(Some(output)),
                Turn::Unanswered => return Ok(None),
                Turn::UrgentUnanswered => return Err(self.stop_unconfirmed()),
                Turn::Nothing if commanding && !self.commanding && !self.urgent_pending => {
                    return Ok(None);
                }
                Turn::Nothing => {}
            }
        }
    }

    /// Asks what another process wants to know, while no request is pending.
    fn serve(&mut self) -> Result<(), ClientError> {
        if self.urgent_pending || !self.client.is_open() {
            return Ok(());
        }
        let Some(question) = self.link.question() else {
            return Ok(());
        };
        let (reply, result) = match self.exchange(&question.request) {
            Ok(response) => (Some(Reply::Accepted(response)), Ok(())),
            Err(ClientError::Refused { refusal, .. }) => (Some(Reply::Refused(refusal)), Ok(())),
            Err(ClientError::Rejected { error, .. }) => (Some(Reply::Wire(error)), Ok(())),
            // The other process finds silence. So will this one, if it lasts.
            Err(
                ClientError::NoReply { .. }
                | ClientError::OutcomeUnknown { .. }
                | ClientError::Interrupted { .. },
            ) => (None, Ok(())),
            Err(error) => (None, Err(error)),
        };
        question.answer(reply);
        result
    }

    /// As [`Device::turn`], while no request is pending.
    fn step(&mut self, deadline_us: u64) -> Result<(), ClientError> {
        self.serve()?;
        match self.turn(deadline_us)? {
            Turn::UrgentUnanswered => Err(self.stop_unconfirmed()),
            Turn::Nothing | Turn::Answered(_) | Turn::Unanswered => Ok(()),
        }
    }

    /// Sends what is due, or receives for [`SLICE_US`] at most, and not beyond `deadline_us`.
    fn turn(&mut self, deadline_us: u64) -> Result<Turn, ClientError> {
        self.ask_interrupt();
        let now_us = self.link.now_us();
        let until_us = match self.client.poll(now_us) {
            Poll::Transmit(frame) => {
                self.link.send(&frame)?;
                return Ok(Turn::Nothing);
            }
            // A pending request waits until the urgent stop is done, so this time-out is the stop's.
            Poll::TimedOut if self.urgent_pending => {
                self.urgent_pending = false;
                return Ok(Turn::UrgentUnanswered);
            }
            Poll::TimedOut => return Ok(Turn::Unanswered),
            Poll::WaitUntil(time_us) => time_us.min(deadline_us),
        };
        let mut bytes = [0; 512];
        let count = self
            .link
            .receive(&mut bytes, until_us.min(now_us.saturating_add(SLICE_US)))?;
        if let Some(overheard) = &mut self.overheard {
            let room = OVERHEARD.saturating_sub(overheard.len());
            overheard.extend(&bytes[..count.min(room)]);
        }
        let mut turn = Turn::Nothing;
        for byte in &bytes[..count] {
            match self.client.receive(*byte) {
                None => {}
                Some(Output::Telemetry { missed, sample }) => {
                    if self.telemetry.len() == TELEMETRY_INBOX {
                        self.telemetry.pop_front();
                    }
                    self.telemetry.push_back((missed, sample));
                }
                Some(Output::Event(event)) => self.note_event(event),
                Some(Output::UrgentDone(_)) => {
                    self.urgent_pending = false;
                }
                // Only one request is pending at a time, so there is only one answer.
                Some(output) => turn = Turn::Answered(output),
            }
        }
        Ok(turn)
    }

    fn ask_interrupt(&mut self) {
        let wanted = self.interrupt.as_ref().and_then(|interrupt| interrupt());
        // A stop that came from elsewhere is the operator's as well. It is sent again, which does no harm.
        let wanted = match (wanted, self.link.stopped()) {
            (Some(Urgent::EStop), _) | (_, Some(Urgent::EStop)) => Some(Urgent::EStop),
            (here, elsewhere) => here.or(elsewhere),
        };
        let stronger = match (self.interrupted, wanted) {
            (None, Some(urgent)) => Some(urgent),
            (Some(Urgent::Stop), Some(Urgent::EStop)) => Some(Urgent::EStop),
            _ => None,
        };
        if let Some(urgent) = stronger {
            self.interrupted = Some(urgent);
            if std::mem::take(&mut self.commanding) {
                // Repeated after the stop, the command would start what the operator has just stopped. Only a new
                // client forgets it. That also ends the session, which a stop does not need.
                self.client = self.client.renewed();
            }
            self.client.urgent(urgent);
            self.urgent_pending = true;
        }
    }

    fn session_lost(&self) -> ClientError {
        ClientError::SessionLost {
            place: self.place(),
        }
    }

    fn no_answer(&self, sign: Sign) -> ClientError {
        if let Some(owner) = self.link.owner() {
            return ClientError::OwnerBusy {
                place: self.place(),
                request: "Hello",
                owner: owner.to_string(),
            };
        }
        ClientError::NoAnswer {
            place: self.place(),
            sign,
        }
    }

    fn stop_unconfirmed(&self) -> ClientError {
        ClientError::StopUnconfirmed {
            place: self.place(),
        }
    }
}

/// What an error means while something may move: a request without an answer changes nothing, but nobody knows what the
/// machine does.
pub fn while_moving(action: &'static str, error: ClientError) -> ClientError {
    match error {
        ClientError::NoReply { place, .. } | ClientError::Silent { place, .. } => {
            ClientError::Silent { place, action }
        }
        error => error,
    }
}

/// After this event the machine stands, or brakes.
fn is_end(event: &Event) -> bool {
    matches!(
        event.what,
        What::Rig(
            RigEvent::Homed { .. }
                | RigEvent::RunEnded { .. }
                | RigEvent::Stopped { .. }
                | RigEvent::Faulted(_)
        ) | What::Capsule(CapsuleEvent::Ended { .. })
    )
}

/// What is left of a link that was given up.
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

/// Whether the device speaks exactly this host's protocol.
#[must_use]
pub fn matches(identity: &Identity) -> bool {
    identity.protocol.major == VERSION.major && identity.schema_key == SCHEMA_KEY
}

/// Upper limit for the duration of homing, us: both passes over the whole allowed travel, with a margin.
#[must_use]
pub fn homing_limit_us(accepted: &HomeAccepted) -> u64 {
    let travel_us = |um: u64, um_s: u32| um * 1_000_000 / u64::from(um_s.max(1));
    let travel_um = u64::from(accepted.max_travel_um);
    // The slow pass only covers the distance back from the first pass, a small part of the travel.
    2 * travel_us(travel_um, accepted.seek_um_s)
        + travel_us(travel_um / 4, accepted.locate_um_s)
        + 5_000_000
}
