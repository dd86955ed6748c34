//! The owner's side of a broker: clients, their stops and questions, and the traffic passed on to them.

mod stops;

use std::collections::{HashMap, VecDeque};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, Read, Write};
use std::net::Shutdown;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use protocol::error::WireError;
use protocol::frame::{Deframer, Encoded, Frame, Header, Kind, encode};
use protocol::session::{Decision, Session, Ticket};
use protocol::system::{Done, Identity, Urgent};
use protocol::table::{Impact, Reply, Request, Response};

use crate::broker::lock::LineFiles;
use crate::broker::server::stops::StopBook;
use crate::broker::stream::read_line;
use crate::broker::{Greeting, LONGEST_LINE, VERSION, Welcome, admits};
use crate::link::owner::{Owner, Question, StopMark};

/// Buffer for an owner that does not read, bytes: 90 s of a fully used line. New bytes beyond that are lost.
const UNREAD: usize = 1 << 20;

/// Maximum age of a question before the owner sends it. The client has then stopped waiting, unless the whole computer
/// was suspended.
const STALE: Duration = Duration::from_millis(600);

/// Minimum time between two questions, so that clients cannot saturate the line.
const QUESTION_INTERVAL: Duration = Duration::from_millis(10);

/// Maximum clients that observe. Clients that only stop are not limited.
pub const MAX_CLIENTS: usize = 32;

/// Frames buffered for a client that does not read; it misses those beyond this number.
pub const WAITING_FRAMES: usize = 512;

/// Time limit for a client's greeting, and longest silence of a client that can only stop.
const GREETING_TIME: Duration = Duration::from_secs(2);

/// Stack of a client's thread, bytes; small, because many clients may connect at once.
const CLIENT_STACK: usize = 256 * 1024;

/// State shared by the owner, the thread that reads the line, and the clients.
pub struct Core {
    state: Mutex<BrokerState>,
    woken: Condvar,
    out: Mutex<Out>,
    closing: AtomicBool,
    /// The owner gives the line up to any process that wants it.
    yields: AtomicBool,
    wanted: AtomicBool,
    /// Where processes mark stops that do not go through this broker.
    line_files: Option<LineFiles>,
}

#[derive(Default)]
struct BrokerState {
    /// Bytes from the machine for the owner.
    unread: VecDeque<u8>,
    lost: Option<String>,
    /// A wake-up without data is pending.
    nudged: bool,
    identity: Option<Identity>,
    questions: VecDeque<Question>,
    last_question: Option<Instant>,
    stops: StopBook,
    clients: HashMap<u64, Client>,
    next_client: u64,
}

impl BrokerState {
    /// Removes and returns the clients' commands when a stop comes: executed later, they would undo the stop.
    fn take_orders(&mut self) -> VecDeque<Question> {
        let observes = |question: &Question| question.request.impact() == Impact::None;
        let (look, orders) = self.questions.drain(..).partition(observes);
        self.questions = look;
        orders
    }
}

struct Client {
    /// Receives the machine's messages and may ask questions.
    observes: bool,
    frames: SyncSender<Vec<u8>>,
    shut: Box<dyn Fn() + Send>,
}

/// Output side of the line. A thread locks it while writing a frame.
struct Out {
    line: Box<dyn Write + Send>,
    /// The last stop that the owner knows of, among those of all processes on this line.
    mark: StopMark,
}

impl Core {
    /// The owner's side of the line that `line` writes to. With `yields` it gives the line up when another process
    /// wants it.
    pub fn new(
        line: Box<dyn Write + Send>,
        yields: bool,
        line_files: Option<LineFiles>,
    ) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(BrokerState {
                // Random: a late answer to a stop that was sent before this line was opened confirms no other.
                stops: StopBook::numbering_from(RandomState::new().hash_one(0) as u16),
                ..BrokerState::default()
            }),
            woken: Condvar::new(),
            out: Mutex::new(Out {
                line,
                mark: LineFiles::last_stops(line_files.as_ref()),
            }),
            closing: AtomicBool::new(false),
            yields: AtomicBool::new(yields),
            wanted: AtomicBool::new(false),
            line_files,
        })
    }

    // No code panics while holding these locks; if it did, a stop must still be sent.
    fn state(&self) -> MutexGuard<'_, BrokerState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn out(&self) -> MutexGuard<'_, Out> {
        self.out.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the owner is closing the broker.
    pub fn is_closing(&self) -> bool {
        self.closing.load(Ordering::Relaxed)
    }

    /// Ends all threads that wait for clients.
    pub fn close(&self) {
        self.closing.store(true, Ordering::Relaxed);
        // Client threads may run for a moment longer. Close the line now, because another process is about to open it.
        self.out().line = Box::new(Closed);
        for client in self.state().clients.values() {
            (client.shut)();
        }
        self.woken.notify_all();
    }

    // Methods for the owner of the line.

    /// Writes the owner's frame. Drops a request that follows a stop which the owner has not noticed yet: it might
    /// restart what was stopped. The client repeats the request if it still wants it.
    pub fn send(&self, bytes: &[u8]) -> io::Result<()> {
        let request = header(bytes).is_some_and(|header| header.kind == Kind::Request);
        let mut out = self.out();
        if request && self.state().stops.unnoticed {
            return Ok(());
        }
        out.line.write_all(bytes)
    }

    /// Sets the last stop known when the next orders were given. The owner has not noticed later stops yet.
    pub fn ordered_at(&self, mark: StopMark) {
        self.out().mark = mark;
    }

    /// Waits for bytes until `deadline`. Returns 0 then, or on a wake-up without data.
    pub fn receive(&self, into: &mut [u8], deadline: Instant) -> Result<usize, String> {
        let mut state = self.state();
        loop {
            if !state.unread.is_empty() {
                let count = into.len().min(state.unread.len());
                for (slot, byte) in into.iter_mut().zip(state.unread.drain(..count)) {
                    *slot = byte;
                }
                return Ok(count);
            }
            if let Some(why) = &state.lost {
                return Err(why.clone());
            }
            let now = Instant::now();
            if std::mem::take(&mut state.nudged) || now >= deadline {
                return Ok(0);
            }
            (state, _) = self
                .woken
                .wait_timeout(state, deadline - now)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Notes the identity of the machine that the owner has connected to.
    pub fn introduce(&self, identity: &Identity) {
        self.state().identity = Some(*identity);
    }

    /// The strongest stop sent so far by clients, and by processes that bypassed this broker.
    pub fn stopped(&self) -> Option<Urgent> {
        let mut out = self.out();
        let mark = LineFiles::last_stops(self.line_files.as_ref());
        let elsewhere = mark.since(std::mem::replace(&mut out.mark, mark));
        self.state().stops.notice(elsewhere)
    }

    /// Whether a client wants the line.
    pub fn is_line_wanted(&self) -> bool {
        self.wanted.load(Ordering::Relaxed)
    }

    /// Offers the line to others or withdraws the offer. Clients that wanted it before have to ask again.
    pub fn offer_line(&self, offered: bool) {
        let _state = self.state();
        self.yields.store(offered, Ordering::Relaxed);
        if !offered {
            self.wanted.store(false, Ordering::Relaxed);
        }
    }

    /// Notes that a client wants the line; false if it is not offered.
    fn want_line(&self) -> bool {
        let mut state = self.state();
        let offered = self.yields.load(Ordering::Relaxed);
        if offered {
            self.wanted.store(true, Ordering::Relaxed);
            state.nudged = true;
            self.woken.notify_all();
        }
        offered
    }

    /// Forgets the stops that the owner has noticed; others remain. Clients' orders that are still queued are not sent:
    /// a client whose order is newer than the stop asks again.
    pub fn forget_stop(&self) {
        let mut state = self.state();
        if !state.stops.forget() {
            return;
        }
        let older = state.take_orders();
        drop(state);
        for question in older {
            question.answer(Some(Reply::Wire(WireError::Stale)));
        }
    }

    /// The next question from a client to the machine.
    pub fn question(&self, now: Instant) -> Option<Question> {
        let mut state = self.state();
        let early = |last: Instant| now.duration_since(last) < QUESTION_INTERVAL;
        if state.questions.is_empty() || state.last_question.is_some_and(early) {
            return None;
        }
        let mut stale = vec![];
        let question = loop {
            match state.questions.pop_front() {
                Some(question) if now.duration_since(question.asked) > STALE => {
                    stale.push(question);
                }
                question => break question,
            }
        };
        state.last_question = Some(now);
        drop(state);
        for question in stale {
            // The machine has not seen it. A client that still waits may ask again.
            question.answer(Some(Reply::Wire(WireError::Stale)));
        }
        question
    }

    // Methods for the thread that reads the line.

    /// Passes the machine's bytes to the owner.
    pub fn arrived(&self, bytes: &[u8]) {
        let mut state = self.state();
        if state.unread.len() + bytes.len() <= UNREAD {
            state.unread.extend(bytes);
        }
        self.woken.notify_all();
    }

    /// Disconnects all clients, because the line is lost.
    pub fn lost(&self, why: String) {
        let mut state = self.state();
        state.lost.get_or_insert(why);
        // Without the line a client has nothing to observe.
        for client in state.clients.values() {
            (client.shut)();
        }
        self.woken.notify_all();
    }

    /// Passes a frame of the machine to every client concerned; `wire` is its encoded form.
    pub fn passed(&self, frame: &Frame<'_>, wire: &[u8]) {
        match frame.header.kind {
            Kind::Telemetry | Kind::Event => {
                for client in self
                    .state()
                    .clients
                    .values()
                    .filter(|client| client.observes)
                {
                    // A client that does not read misses frames, as on a bad line.
                    let _ = client.frames.try_send(wire.to_vec());
                }
            }
            Kind::Reply => {
                if let Some(Reply::Urgent(urgent)) = frame.decode() {
                    self.confirmed(frame.header.seq, urgent);
                }
            }
            Kind::Request | Kind::Urgent => {}
        }
    }

    fn confirmed(&self, seq: u16, urgent: Urgent) {
        let state = self.state();
        if let Some(stop) = state.stops.find(seq, urgent)
            && let Some(client) = state.clients.get(&stop.client)
            && let Some(frame) = reply(stop.header, &Reply::Urgent(urgent))
        {
            let _ = client.frames.try_send(frame.to_vec());
        }
    }

    // Calls by clients.

    /// Writes a client's stop to the line at once. A repetition is sent again under the same number.
    fn stop(&self, client: u64, header: Header, urgent: Urgent) -> io::Result<()> {
        let mut out = self.out();
        let mut state = self.state();
        let seq = state.stops.send(client, header, urgent);
        let older = state.take_orders();
        state.nudged = true;
        drop(state);
        // Stops need no session.
        let header = Header {
            kind: Kind::Urgent,
            session: 0,
            seq,
        };
        let frame = encode(header, &urgent).map_err(|_| io::ErrorKind::InvalidData)?;
        let written = out.line.write_all(&frame);
        let is_marked = LineFiles::last_stops(self.line_files.as_ref()).since(out.mark);
        drop(out);
        self.woken.notify_all();
        for question in older {
            // It was not sent. Say so only if the mark of the stop is visible: a client that does not see the mark
            // would send it again.
            question.answer(is_marked.map(|_| Reply::Wire(WireError::Stale)));
        }
        written
    }

    fn ask(&self, question: Question) {
        let mut state = self.state();
        state.questions.push_back(question);
        state.nudged = true;
        self.woken.notify_all();
    }

    /// Admits a client, even if only for stops; `None` if the line is lost.
    fn admit(
        &self,
        shut: Box<dyn Fn() + Send>,
        frames: SyncSender<Vec<u8>>,
    ) -> Option<(u64, bool)> {
        let mut state = self.state();
        if state.lost.is_some() || self.is_closing() {
            return None;
        }
        let number = state.next_client;
        state.next_client += 1;
        let observes = state
            .clients
            .values()
            .filter(|client| client.observes)
            .count()
            < MAX_CLIENTS;
        let client = Client {
            observes,
            frames,
            shut,
        };
        state.clients.insert(number, client);
        Some((number, observes))
    }

    fn remove(&self, client: u64) {
        self.state().clients.remove(&client);
    }
}

/// Replaces a line that was closed.
struct Closed;

impl Write for Closed {
    fn write(&mut self, _: &[u8]) -> io::Result<usize> {
        Err(io::ErrorKind::NotConnected.into())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Accepts clients until the core closes.
pub fn serve(listener: &UnixListener, owner: &Owner, core: &Arc<Core>) {
    loop {
        let stream = listener.accept();
        if core.is_closing() {
            return;
        }
        let Ok((stream, _)) = stream else {
            // Most likely there are too many open files; wait until some are closed.
            thread::sleep(Duration::from_millis(50));
            continue;
        };
        let (core, owner) = (Arc::clone(core), owner.clone());
        let host = thread::Builder::new()
            .name("client".to_owned())
            .stack_size(CLIENT_STACK);
        // Without a thread for it, the client's connection closes.
        let _ = host.spawn(move || {
            // A client that disconnects or breaks the protocol affects no other.
            let _ = receive_client(stream, &owner, &core);
        });
    }
}

fn receive_client(mut stream: UnixStream, owner: &Owner, core: &Arc<Core>) -> io::Result<()> {
    stream.set_read_timeout(Some(GREETING_TIME))?;
    stream.set_write_timeout(Some(GREETING_TIME))?;
    let greeting = serde_json::from_slice(&read_line(&mut stream, LONGEST_LINE)?)?;
    let (frames, waiting) = sync_channel::<Vec<u8>>(WAITING_FRAMES);
    let shut = stream.try_clone()?;
    // Admit the client before the welcome: after the welcome it must be able to stop the machine.
    let Some(mut session) = ClientSession::new(core, Box::new(move || close(&shut)), frames) else {
        return Ok(());
    };
    stream.write_all(&session.welcome(&greeting, owner)?)?;
    if session.observes {
        stream.set_read_timeout(None)?;
    }
    let mut to_client = stream.try_clone()?;
    // Ends when the last sender is dropped: core, session and pending questions hold one each.
    let writer = thread::Builder::new()
        .name("client's frames".to_owned())
        .stack_size(CLIENT_STACK);
    let writing = writer.spawn(move || {
        for frame in waiting {
            if to_client.write_all(&frame).is_err() {
                close(&to_client);
                return;
            }
        }
    });
    let result = match writing {
        Ok(_) => session.receive(&mut stream),
        Err(why) => Err(why),
    };
    drop(session);
    close(&stream);
    result
}

/// An error means that the connection is already closed.
fn close(stream: &UnixStream) {
    let _ = stream.shutdown(Shutdown::Both);
}

/// Protocol state of a client's session.
struct SessionState {
    session: Session,
    /// The owner is working on a question.
    pending: bool,
    /// Sequence number of the last question that the owner left unanswered. Repetitions of it get no answer either.
    unanswered: Option<u16>,
}

/// An admitted client; dropping this value removes it.
pub struct ClientSession {
    core: Arc<Core>,
    number: u64,
    /// May do more than stop.
    observes: bool,
    frames: SyncSender<Vec<u8>>,
    asking: Arc<Mutex<SessionState>>,
    deframer: Deframer,
}

impl Drop for ClientSession {
    fn drop(&mut self) {
        self.core.remove(self.number);
    }
}

impl ClientSession {
    /// `None` if the line is lost.
    pub fn new(
        core: &Arc<Core>,
        shut: Box<dyn Fn() + Send>,
        frames: SyncSender<Vec<u8>>,
    ) -> Option<Self> {
        let (number, observes) = core.admit(shut, frames.clone())?;
        Some(Self {
            core: Arc::clone(core),
            number,
            observes,
            frames,
            asking: Arc::new(Mutex::new(SessionState {
                session: Session::new(number as u32),
                pending: false,
                unanswered: None,
            })),
            deframer: Deframer::new(),
        })
    }

    /// The first line sent to the client.
    pub fn welcome(&self, greeting: &Greeting, owner: &Owner) -> io::Result<Vec<u8>> {
        if greeting.wants_line {
            self.core.want_line();
        }
        let welcome = Welcome {
            retrograde_broker: VERSION,
            owner: owner.clone(),
            yields: self.core.yields.load(Ordering::Relaxed),
            full: !self.observes,
        };
        let mut line = serde_json::to_vec(&welcome)?;
        line.push(b'\n');
        Ok(line)
    }

    fn receive(&mut self, stream: &mut UnixStream) -> io::Result<()> {
        let mut bytes = [0; 512];
        loop {
            let count = match stream.read(&mut bytes) {
                Ok(0) => return Ok(()),
                Ok(count) => count,
                Err(why) if why.kind() == io::ErrorKind::Interrupted => continue,
                Err(why) => return Err(why),
            };
            self.take(&bytes[..count], Instant::now())?;
        }
    }

    /// Processes the client's bytes.
    pub fn take(&mut self, bytes: &[u8], now: Instant) -> io::Result<()> {
        let mut deframer = std::mem::take(&mut self.deframer);
        let frames = bytes
            .iter()
            .try_for_each(|byte| match deframer.push(*byte) {
                Some(frame) => self.frame(&frame, now),
                None => Ok(()),
            });
        self.deframer = deframer;
        frames
    }

    fn frame(&self, frame: &Frame<'_>, now: Instant) -> io::Result<()> {
        let mut asking = self.asking.lock().unwrap_or_else(PoisonError::into_inner);
        let was_unanswered = asking.unanswered == Some(frame.header.seq);
        if (asking.pending || was_unanswered || !self.observes)
            && frame.header.kind == Kind::Request
        {
            // Either the question repeats an unanswered one, or the welcome said that this client can only stop.
            return Ok(());
        }
        let header = |session, seq| Header {
            kind: Kind::Reply,
            session,
            seq,
        };
        match asking.session.receive(frame) {
            Decision::Urgent { urgent, .. } => {
                drop(asking);
                return self.core.stop(self.number, frame.header, urgent);
            }
            // Until the owner knows the machine's identity, the client has to repeat its Hello.
            Decision::Greet { session, seq } => {
                let identity = self.core.state().identity;
                if let Some(identity) = identity {
                    let hello = Response::Hello(Identity {
                        session,
                        ..identity
                    });
                    self.say(reply(header(session, seq), &Reply::Accepted(hello)));
                }
            }
            // Only the owner keeps the machine alive; a client cannot.
            Decision::Execute {
                request: Request::KeepAlive(_),
                ticket,
            } => {
                let done = Reply::Accepted(Response::KeepAlive(Done));
                self.say(remembered(&mut asking.session, ticket, &done));
            }
            Decision::Execute { request, ticket } if admits(&request) => {
                asking.pending = true;
                drop(asking);
                self.ask(request, ticket, now);
            }
            Decision::Execute { ticket, .. } => {
                let no = Reply::Wire(WireError::Malformed);
                self.say(remembered(&mut asking.session, ticket, &no));
            }
            Decision::Refuse { refusal, ticket } => {
                let no = Reply::Refused(refusal);
                self.say(remembered(&mut asking.session, ticket, &no));
            }
            Decision::Reject {
                error,
                session,
                seq,
            } => self.say(reply(header(session, seq), &Reply::Wire(error))),
            Decision::Resend(frame) => self.say(Some(frame)),
            Decision::Ignore => {}
        }
        Ok(())
    }

    fn ask(&self, request: Request, ticket: Ticket, now: Instant) {
        let (asking, frames) = (Arc::clone(&self.asking), self.frames.clone());
        self.core.ask(Question {
            request,
            asked: now,
            answer: Box::new(move |answer| {
                let mut asking = asking.lock().unwrap_or_else(PoisonError::into_inner);
                asking.pending = false;
                asking.unanswered = answer.is_none().then_some(ticket.seq);
                let frame =
                    answer.and_then(|answer| remembered(&mut asking.session, ticket, &answer));
                if let Some(frame) = frame {
                    let _ = frames.try_send(frame.to_vec());
                }
            }),
        });
    }

    fn say(&self, frame: Option<Encoded>) {
        if let Some(frame) = frame {
            // A client that does not read loses the answer and asks again.
            let _ = self.frames.try_send(frame.to_vec());
        }
    }
}

fn reply(header: Header, reply: &Reply) -> Option<Encoded> {
    let header = Header {
        kind: Kind::Reply,
        ..header
    };
    // Every message of the protocol fits into a frame.
    encode(header, reply).ok()
}

fn remembered(session: &mut Session, ticket: Ticket, answer: &Reply) -> Option<Encoded> {
    let header = Header {
        kind: Kind::Reply,
        session: ticket.session,
        seq: ticket.seq,
    };
    let frame = reply(header, answer)?;
    session.remember(ticket, &frame);
    Some(frame)
}

fn header(bytes: &[u8]) -> Option<Header> {
    let mut deframer = Deframer::new();
    bytes
        .iter()
        .find_map(|byte| deframer.push(*byte).map(|frame| frame.header))
}

#[cfg(test)]
mod tests;
