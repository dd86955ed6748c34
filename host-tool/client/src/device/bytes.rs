//! Sends requests and receives answers: bytes, repetitions, and stops ahead of everything else.

use protocol::client::{Client, Output, Poll};
use protocol::error::WireError;
use protocol::rig::{RigState, RunOutcome};
use protocol::system::DeviceKind;
use protocol::table::{Endpoint, Impact, Reply, Request, Response};

use crate::broker;
use crate::device::observer::{Clock, Observer};
use crate::device::{Device, Pending, Turn, moves};
use crate::diagnosis::{OVERHEARD, Sign};
use crate::error::{ClientError, Missing};
use crate::link::LinkError;
use crate::link::owner::Question;

/// Answers the question of another process. Also returns errors that concern this process.
fn reply(question: Question, answer: Result<Response, ClientError>) -> Result<(), ClientError> {
    let (reply, result) = match answer {
        Ok(response) => (Some(Reply::Accepted(response)), Ok(())),
        Err(ClientError::Refused { refusal, .. }) => (Some(Reply::Refused(refusal)), Ok(())),
        Err(ClientError::NotUnderstood {
            error: Some(error), ..
        }) => (Some(Reply::Wire(error)), Ok(())),
        // The other process gets no answer. If the machine stays silent, this process notices it as well.
        Err(
            ClientError::Unanswered {
                missing: Missing::Reply | Missing::End | Missing::Outcome,
                ..
            }
            | ClientError::Interrupted { .. },
        ) => (None, Ok(())),
        Err(error) => (None, Err(error)),
    };
    question.answer(reply);
    result
}

/// Longest wait for bytes before the [`Interrupt`] is polled again, us.
const SLICE_US: u64 = 20_000;

/// Whether a stop cancels a pending request: one that moves something must not be repeated after a stop.
fn is_abandonable(impact: Impact) -> bool {
    !matches!(impact, Impact::None | Impact::Pace)
}

impl Device {
    /// Sends a request whose answer [`Device::attend`] returns. Send no other request before its answer.
    ///
    /// # Errors
    /// [`ClientError::Owned`], [`ClientError::Interrupted`] or [`ClientError::SessionLost`]; the request was not sent.
    pub fn post<E: Endpoint>(&mut self, request: E) -> Result<(), ClientError> {
        self.post_request(&request.into_request())
    }

    fn post_request(&mut self, request: &Request) -> Result<(), ClientError> {
        self.poll_interrupt();
        self.admit(request)?;
        if request.impact() != Impact::None && self.stop.requested.is_some() {
            return Err(ClientError::Interrupted {
                request: request.name(),
            });
        }
        self.note_request(request);
        if self.client.request(request).is_err() {
            self.pending = None;
            return Err(self.session_lost());
        }
        Ok(())
    }

    /// Notes a request before it is sent.
    fn note_request(&mut self, request: &Request) {
        let impact = request.impact();
        self.motion.ordered |= impact == Impact::Motion;
        self.pending = Some(Pending {
            name: request.name(),
            impact,
            at_us: self.now_us(),
            cancelled: false,
            question: None,
        });
    }

    /// Whether a posted request has no answer yet: this process's, or that of a client.
    #[must_use]
    pub fn is_posted(&self) -> bool {
        self.pending.is_some()
    }

    /// Sends and receives until `until_us` on the link's clock, or once if that time is past. Delivers everything that
    /// arrives, and returns the answer to a posted request if it has come.
    ///
    /// # Errors
    /// As [`Device::call`], for the posted request.
    pub fn attend(
        &mut self,
        until_us: u64,
        observer: &mut dyn Observer,
    ) -> Result<Option<Response>, ClientError> {
        // Post a client's question as well: a machine that does not answer it must not block a caller that serves two
        // machines.
        if self.pending.is_none()
            && let Some(question) = self.question()
        {
            match self.post_request(&question.request) {
                Ok(()) => {
                    if let Some(pending) = &mut self.pending {
                        pending.question = Some(question);
                    }
                }
                Err(error) => reply(question, Err(error))?,
            }
        }
        let answer = match self.posted_answer(until_us) {
            Ok(answer) => answer,
            Err(error) => {
                if let Some(question) = self.pending.take().and_then(|pending| pending.question) {
                    question.answer(None);
                }
                return Err(error);
            }
        };
        self.deliver(observer);
        let Some(answer) = answer else {
            return Ok(None);
        };
        let Some(mut pending) = self.pending.take() else {
            return Ok(None);
        };
        let question = pending.question.take();
        let answer = self.answered(pending, answer);
        match question {
            Some(question) => reply(question, answer).map(|()| None),
            None => answer.map(Some),
        }
    }

    /// Sends and receives until `until_us`, or until the posted request is answered. `Some(None)` if it will not be
    /// answered.
    fn posted_answer(&mut self, until_us: u64) -> Result<Option<Option<Output>>, ClientError> {
        // Take one more turn after the deadline: a turn either sends or receives.
        let mut last = false;
        while !last {
            last = self.now_us() >= until_us;
            let is_posted = self.pending.is_some();
            match self.turn(until_us)? {
                Turn::UrgentUnanswered => return Err(self.stop_unconfirmed()),
                Turn::Answered(output) if is_posted => return Ok(Some(Some(output))),
                Turn::Unanswered if is_posted => return Ok(Some(None)),
                Turn::Nothing if self.is_given_up() => return Ok(Some(None)),
                _ => {}
            }
        }
        Ok(None)
    }

    /// Whether a stop has cancelled the pending request and is itself confirmed.
    fn is_given_up(&self) -> bool {
        let cancelled = |pending: &Pending| pending.cancelled;
        self.pending.as_ref().is_some_and(cancelled) && !self.stop.unconfirmed
    }

    pub(crate) fn exchange(&mut self, request: &Request) -> Result<Response, ClientError> {
        self.poll_interrupt();
        let command = request.impact() != Impact::None;
        self.admit(request)?;
        if command && self.stop.requested.is_some() {
            self.settle()?;
            return Err(ClientError::Interrupted {
                request: request.name(),
            });
        }
        self.note_request(request);
        let answer = self.asked(!command, |client| client.request(request));
        match (answer, self.pending.take()) {
            (Ok(answer), Some(pending)) => self.answered(pending, answer),
            (Ok(_), None) => Err(self.wrong_response(request.name())),
            (Err(error), _) => Err(error),
        }
    }

    /// Refuses requests that the owner of the line would not send for this process.
    pub(crate) fn admit(&self, request: &Request) -> Result<(), ClientError> {
        match self.link.owner() {
            Some(owner) if !broker::admits(request) => Err(ClientError::Owned {
                place: self.place(),
                request: request.name(),
                owner: Box::new(owner.clone()),
                busy: false,
            }),
            _ => Ok(()),
        }
    }

    /// Converts the answer to a request, or its absence, to a result.
    fn answered(
        &mut self,
        pending: Pending,
        answer: Option<Output>,
    ) -> Result<Response, ClientError> {
        let (request_name, impact) = (pending.name, pending.impact);
        let place = self.place();
        let (command, has_owner) = (impact != Impact::None, self.link.owner().is_some());
        match answer {
            _ if pending.cancelled => Err(ClientError::Interrupted {
                request: request_name,
            }),
            Some(Output::Accepted(response)) => {
                self.note_clock(pending.at_us, &response);
                self.note_motion(impact, &response);
                self.motion.ordered = false;
                Ok(response)
            }
            Some(Output::Refused(refusal)) => {
                self.motion.ordered = false;
                Err(ClientError::Refused {
                    place,
                    request: request_name,
                    impact,
                    refusal,
                })
            }
            Some(Output::Rejected(WireError::NoSession)) => Err(self.session_lost()),
            // A stop came after it, so the owner has not sent it.
            Some(Output::Rejected(WireError::Stale)) if command && self.link.is_overtaken() => {
                Err(ClientError::Interrupted {
                    request: request_name,
                })
            }
            Some(Output::Rejected(error)) if error != WireError::Stale || !has_owner => {
                self.motion.ordered = false;
                Err(ClientError::NotUnderstood {
                    place,
                    request: request_name,
                    error: Some(error),
                })
            }
            Some(Output::Rejected(_)) => Err(self.no_answer(request_name, Sign::Silence)),
            _ if !command && has_owner => Err(self.no_answer(request_name, Sign::Silence)),
            _ => Err(match (command, self.motion.reported) {
                // A silent machine may still be moving, whatever was asked last.
                (false, true) => self.unanswered("a motion", Missing::End),
                (false, false) => self.unanswered(request_name, Missing::Reply),
                (true, _) => self.unanswered(request_name, Missing::Outcome),
            }),
        }
    }

    pub(crate) fn unanswered(&self, request: &'static str, missing: Missing) -> ClientError {
        ClientError::Unanswered {
            place: self.place(),
            request,
            missing,
        }
    }

    /// The error of a failed link. After the owner has given its line up, the line is free and the machine is not lost.
    fn cut(&self, link: LinkError) -> ClientError {
        match link {
            LinkError::Lost { place, why } if self.motion.reported || self.motion.ordered => {
                LinkError::Cut { place, why }.into()
            }
            link => link.into(),
        }
    }

    /// Notes the device's time if an answer contains it. The latest is best, because clocks drift.
    fn note_clock(&mut self, asked_us: u64, response: &Response) {
        let device_us = match response {
            Response::GetRigStatus(status) => status.time_us,
            Response::GetCapsuleStatus(status) => status.time_us,
            _ => return,
        };
        self.clock = Some(Clock::of(asked_us, device_us, self.now_us()));
    }

    /// Notes whether the machine moves, if an answer says so.
    fn note_motion(&mut self, impact: Impact, response: &Response) {
        self.motion.reported = match response {
            Response::GetRigStatus(status) => matches!(
                status.state,
                RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping
            ),
            Response::GetCapsuleStatus(status) => moves(status.state),
            Response::GetRunRecord(record) => record.outcome == RunOutcome::Running,
            Response::Resume(_) => true,
            _ => self.motion.reported || impact == Impact::Motion,
        };
    }

    /// Returns the latched fault after sending every stop of the operator. Another stop may be sent while the device
    /// answers, and an emergency stop loses the position even of a machine at rest.
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

    /// Sends a request and waits for the answer as [`Device::answer`] does. Repeats it while the owner of the line is
    /// busy: if `may_repeat` is set, or if the machine has certainly not seen the request and no stop came.
    pub(crate) fn asked<E>(
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
            let repeat = match answer {
                None => may_repeat,
                Some(Output::Rejected(WireError::Stale)) => may_repeat || !self.link.is_overtaken(),
                Some(_) => false,
            };
            let waited_us = self.link.now_us() - begin_us;
            if !repeat
                || self.link.owner().is_none()
                || self.stop.requested.is_some()
                || waited_us >= self.owner_patience_us
            {
                return Ok(answer);
            }
        }
    }

    /// Waits for the answer to the pending request; `None` if there was none, or if a stop has cancelled the request.
    pub(crate) fn answer(&mut self) -> Result<Option<Output>, ClientError> {
        loop {
            match self.turn(u64::MAX)? {
                Turn::Answered(output) => return Ok(Some(output)),
                Turn::Unanswered => return Ok(None),
                Turn::UrgentUnanswered => return Err(self.stop_unconfirmed()),
                Turn::Nothing if self.is_given_up() => return Ok(None),
                Turn::Nothing => {}
            }
        }
    }

    /// The question of another process, if it can be sent now.
    fn question(&mut self) -> Option<Question> {
        if self.stop.unconfirmed || !self.client.is_open() {
            return None;
        }
        self.link.question()
    }

    /// Sends the question of another process. Call it only while no request is pending.
    pub(crate) fn serve(&mut self) -> Result<(), ClientError> {
        let Some(question) = self.question() else {
            return Ok(());
        };
        let answer = self.exchange(&question.request);
        reply(question, answer)
    }

    /// As [`Device::turn`], while no request is pending.
    pub(crate) fn step(&mut self, deadline_us: u64) -> Result<(), ClientError> {
        self.serve()?;
        match self.turn(deadline_us)? {
            Turn::UrgentUnanswered => Err(self.stop_unconfirmed()),
            Turn::Nothing | Turn::Answered(_) | Turn::Unanswered => Ok(()),
        }
    }

    /// Sends the next frame that is due, or receives for at most [`SLICE_US`] and not beyond `deadline_us`.
    pub(crate) fn turn(&mut self, deadline_us: u64) -> Result<Turn, ClientError> {
        self.poll_interrupt();
        let now_us = self.link.now_us();
        let until_us = match self.client.poll(now_us) {
            Poll::Transmit(frame) => {
                let sent = self.link.send(&frame);
                sent.map_err(|link| self.cut(link))?;
                return Ok(Turn::Nothing);
            }
            // A pending request waits for the urgent stop, so this time-out is the stop's.
            Poll::TimedOut if self.stop.unconfirmed => {
                self.stop.unconfirmed = false;
                return Ok(Turn::UrgentUnanswered);
            }
            Poll::TimedOut => return Ok(Turn::Unanswered),
            Poll::WaitUntil(time_us) => time_us.min(deadline_us),
        };
        let mut bytes = [0; 512];
        let received = self
            .link
            .receive(&mut bytes, until_us.min(now_us.saturating_add(SLICE_US)));
        let count = received.map_err(|link| self.cut(link))?;
        if let Some(overheard) = &mut self.overheard {
            let room = OVERHEARD.saturating_sub(overheard.len());
            overheard.extend(&bytes[..count.min(room)]);
        }
        let mut turn = Turn::Nothing;
        for byte in &bytes[..count] {
            match self.client.receive(*byte) {
                None => {}
                Some(Output::Telemetry { missed, sample }) => {
                    self.inbox.sample(missed, sample);
                }
                Some(Output::Event(event)) => self.note_event(event),
                Some(Output::UrgentDone(_)) => {
                    self.stop.unconfirmed = false;
                }
                // Only one request is pending at a time, so there is only one answer.
                Some(output) => turn = Turn::Answered(output),
            }
        }
        Ok(turn)
    }

    pub(super) fn poll_interrupt(&mut self) {
        let wanted = self.interrupt.as_ref().and_then(|interrupt| interrupt());
        // A stop sent by another process counts as the operator's. Repeating it does no harm.
        let wanted = wanted.max(self.link.stopped());
        if let Some(urgent) = wanted
            && wanted > self.stop.requested
        {
            self.stop.requested = wanted;
            if let Some(pending) = &mut self.pending
                && is_abandonable(pending.impact)
                && !std::mem::replace(&mut pending.cancelled, true)
            {
                // A repetition after the stop would restart what the operator has just stopped. The session continues:
                // the operator still needs the result of the motion.
                self.client.forget();
            }
            self.client.urgent(urgent);
            self.stop.unconfirmed = true;
        }
    }

    pub(crate) fn session_lost(&self) -> ClientError {
        ClientError::SessionLost {
            place: self.place(),
        }
    }

    /// Error for a missing answer to Hello, or to a broker client's request whose owner is busy.
    pub(crate) fn no_answer(&self, request: &'static str, sign: Sign) -> ClientError {
        let place = self.place();
        match self.link.owner() {
            Some(owner) => ClientError::Owned {
                place,
                request,
                owner: Box::new(owner.clone()),
                busy: true,
            },
            None => ClientError::NoAnswer { place, sign },
        }
    }

    pub(crate) fn stop_unconfirmed(&self) -> ClientError {
        self.unanswered("the stop", Missing::Stop)
    }
}
