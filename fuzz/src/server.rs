//! The server in this process, without sockets and threads, for tests: requests go through the router, orders and stops through
//! the real workers and direct requests, each to its end before the answer is read. Time is that of the links.

use std::collections::BTreeMap;
use std::future::{Future, poll_fn};
use std::path::Path;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel, sync_channel};
use std::sync::{Arc, OnceLock};
use std::task::Poll;
use std::time::Duration;

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::header::{CONTENT_TYPE, HeaderValue};
use client::address::Address;
use client::link::serial::DEFAULT_BAUD;
use client::link::{Link, LinkError, OpenError};
use jiff::Timestamp;
use protocol::system::DeviceKind;
use tokio::runtime::{Builder, Runtime};
use tower_service::Service as _;

use lab::operations::connector::{Candidate, Connector, LinkPurpose};
use lab::operations::finder::{Beginning, Finder};
use serve::ORDERS;
use serve::access::{Access, Peer};
use serve::direct::{self, DirectRequest};
use serve::http::{self, App};
use serve::shared_state::{Machine, SharedState};
use serve::worker::Worker;

/// The instance of this server: what keys of its commands begin with.
pub const INSTANCE: &str = "i";

/// No order takes so long, us of its link.
const LONGEST_US: u64 = 24 * 3_600 * 1_000_000;

/// The answer to a request.
#[derive(Clone, Debug)]
pub struct Answer {
    /// Its status.
    pub status: u16,
    /// Its headers.
    pub headers: BTreeMap<String, String>,
    /// Its body; empty for a stream, which would not end.
    pub body: Vec<u8>,
}

/// A request.
#[derive(Clone, Copy, Debug)]
pub struct HttpRequest<'a> {
    /// It comes from this computer.
    pub here: bool,
    /// Method.
    pub method: &'a str,
    /// Path, with what follows it.
    pub uri: &'a str,
    /// Names and values.
    pub headers: &'a [(&'a str, &'a [u8])],
    /// Its body.
    pub body: &'a [u8],
}

/// A request that is being answered.
type Answering = Pin<Box<dyn Future<Output = Answer>>>;

/// A server.
pub struct Server<'a> {
    router: Router,
    shared: &'a SharedState,
    finder: &'a Finder<'a>,
    workers: Vec<Worker<'a>>,
    direct: Receiver<DirectRequest>,
    leaving: &'a AtomicBool,
}

/// Ends the worker when nothing is ordered any more.
struct Ends<'a> {
    connector: &'a dyn Connector,
    shared: Arc<SharedState>,
    leaving: Arc<AtomicBool>,
}

impl Connector for Ends<'_> {
    fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
        purpose: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        match self.connector.open(kind, address, baud, purpose) {
            Ok(link) => Ok(Box::new(EndingLink {
                kind,
                link,
                shared: Arc::clone(&self.shared),
                leaving: Arc::clone(&self.leaving),
            })),
            Err(error) => {
                self.leaving.store(true, Ordering::SeqCst);
                Err(error)
            }
        }
    }

    fn candidates(&self) -> Vec<Candidate> {
        self.connector.candidates()
    }

    fn nonce(&self) -> u32 {
        self.connector.nonce()
    }

    fn now(&self) -> Timestamp {
        self.connector.now()
    }
}

struct EndingLink {
    kind: DeviceKind,
    link: Box<dyn Link>,
    shared: Arc<SharedState>,
    leaving: Arc<AtomicBool>,
}

impl Drop for EndingLink {
    fn drop(&mut self) {
        // There is no second attempt here to wait for.
        self.leaving.store(true, Ordering::SeqCst);
    }
}

impl Link for EndingLink {
    fn place(&self) -> String {
        self.link.place()
    }

    fn now_us(&self) -> u64 {
        self.link.now_us()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.link.send(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        let received = self.link.receive(buffer, deadline_us);
        assert!(self.now_us() < LONGEST_US, "an order without an end");
        if received.is_err() || self.shared.actions.are_over(self.kind) && matches!(received, Ok(0))
        {
            self.leaving.store(true, Ordering::SeqCst);
        }
        received
    }
}

/// Lets `act` ask a new server for these machines, which keeps its records in `out`.
pub fn with<R>(
    connector: &dyn Connector,
    machines: &[(DeviceKind, Address)],
    token: &str,
    out: &Path,
    act: impl FnOnce(&mut Server<'_>) -> R,
) -> R {
    let (mut kept, mut orders) = (vec![], vec![]);
    for (kind, address) in machines {
        let (sender, receiver) = sync_channel(ORDERS);
        kept.push(Machine::new(*kind, address.clone(), sender));
        orders.push(receiver);
    }
    let shared = Arc::new(SharedState::new(INSTANCE.to_owned(), kept, out.to_owned()));
    let leaving = Arc::new(AtomicBool::new(true));
    let connector = Ends {
        connector,
        shared: Arc::clone(&shared),
        leaving: Arc::clone(&leaving),
    };
    let finder = Finder {
        rig: Some(Address::Auto),
        capsule: Some(Address::Auto),
        baud: DEFAULT_BAUD,
        connector: &connector,
        beginning: Beginning::now(),
    };
    let (sender, direct) = channel();
    let workers = shared
        .machines
        .iter()
        .zip(orders)
        .map(|(machine, orders)| Worker {
            finder: &finder,
            shared: &shared,
            machine,
            orders,
            leaving: &leaving,
            pressed: Arc::new(|| None),
        });
    let mut server = Server {
        router: http::router(Arc::new(App::new(
            Arc::clone(&shared),
            Access::new(token.to_owned(), vec![]),
            sender,
        ))),
        shared: &shared,
        finder: &finder,
        workers: workers.collect(),
        direct,
        leaving: &leaving,
    };
    act(&mut server)
}

/// The runtime in which requests wait and read files.
fn runtime() -> &'static Runtime {
    static RUNTIME: OnceLock<Runtime> = OnceLock::new();
    RUNTIME.get_or_init(|| {
        let mut builder = Builder::new_current_thread();
        builder.enable_time().build().expect("memory")
    })
}

impl Server<'_> {
    /// The answer, and all that is done for it; `None` if this cannot be a request.
    pub fn ask(&mut self, sent: HttpRequest<'_>) -> Option<Answer> {
        let mut answering = self.answering(sent)?;
        let answer = runtime().block_on(poll_fn(|context| {
            loop {
                if let Poll::Ready(answer) = answering.as_mut().poll(context) {
                    return Poll::Ready(answer);
                }
                if !self.work() {
                    return Poll::Pending;
                }
            }
        }));
        self.work();
        Some(answer)
    }

    fn answering(&self, sent: HttpRequest<'_>) -> Option<Answering> {
        let mut request = Request::builder().method(sent.method).uri(sent.uri);
        for (name, value) in sent.headers {
            request = request.header(*name, *value);
        }
        let peer = Peer { here: sent.here };
        let body = Body::from(sent.body.to_vec());
        let request = request.extension(peer).body(body).ok()?;
        let mut router = self.router.clone();
        Some(Box::pin(async move {
            let Ok(response) = router.call(request).await;
            let (head, body) = response.into_parts();
            let text = |value: &HeaderValue| value.to_str().unwrap_or("?").to_owned();
            let headers = head.headers.iter();
            let headers = headers.map(|(name, value)| (name.to_string(), text(value)));
            let headers: BTreeMap<_, _> = headers.collect();
            let is_stream = head
                .headers
                .get(CONTENT_TYPE)
                .is_some_and(|kind| kind == "text/event-stream");
            let body = match is_stream {
                true => vec![],
                false => to_bytes(body, usize::MAX).await.unwrap_or_default().into(),
            };
            Answer {
                status: head.status.as_u16(),
                headers,
                body,
            }
        }))
    }

    /// Does what was asked for; false if that was nothing.
    fn work(&self) -> bool {
        let mut worked = false;
        for request in self.direct.try_iter() {
            worked = true;
            match request {
                DirectRequest::Stop {
                    machine,
                    urgent,
                    wait,
                } => {
                    if let Some(machine) = self.shared.machine(machine) {
                        // The real worker confirms it on its own thread. Here there is one thread, so wait for nothing.
                        let (finder, shared) = (self.finder, self.shared);
                        direct::stop(finder, shared, machine, urgent, vec![wait], Duration::ZERO);
                    }
                }
                DirectRequest::Ask {
                    question, reply, ..
                } => {
                    let _ = reply.send(direct::ask(self.finder, self.shared, question));
                }
                DirectRequest::End => {}
            }
        }
        for worker in &self.workers {
            let is_over = || self.shared.actions.are_over(worker.machine.kind);
            if !is_over() {
                worked = true;
                self.leaving.store(false, Ordering::SeqCst);
                worker.work();
                assert!(is_over(), "an order that nobody takes");
            }
        }
        worked
    }
}
