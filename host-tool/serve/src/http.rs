//! HTTP/1.1 interface with JSON. docs/serve.md describes it for people, docs/openapi.json for programs.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::future::{Future, ready};
use std::io::Read;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, TrySendError};
use std::time::{Duration, Instant, SystemTime};

use axum::Router;
use axum::body::{Body, Bytes, to_bytes};
use axum::extract::rejection::PathRejection;
use axum::extract::{Extension, Path, Request, State};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, HeaderName, HeaderValue, REFERRER_POLICY,
    WWW_AUTHENTICATE, X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, StatusCode};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use client::identity::kind_name;
use client::limited;
use futures_util::stream::unfold;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use jiff::Timestamp;
use lab::operations::delivery::{Delivery, StopReport};
use lab::operations::failure::Failure;
use lab::trials::plan::{self, REFERENCE_LIMITS};
use motion::axis::Axis;
use protocol::system::{DeviceKind, Urgent};
use serde_json::{Map, Value, json};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};
use tokio::task::AbortHandle;
use tokio::time::{Instant as At, timeout, timeout_at};
use tower_service::Service as _;

use crate::access::{Access, Demand, Peer, demand};
use crate::actions::{Action, ActionStatus, Arrival, RequestedAction};
use crate::answers::{Instead, answer, bad, closing, good, refused, status, typed};
use crate::bodies::{LONGEST_BODY, fields, object};
use crate::direct::{DirectRequest, Question, Wait};
use crate::open_files::Connections;
use crate::orders::{self, Work};
use crate::records::{is_record, list, open};
use crate::shared_state::{Order, SharedState};

/// The interface description for programs.
pub const OPENAPI: &str = include_str!("../../../docs/openapi.json");
const PAGE: &str = include_str!("page.html");
/// Placeholder in the page for the nonce that allows the page's own script and style, and no others.
const NONCE: &str = "@NONCE@";

const OPENER_POLICY: HeaderName = HeaderName::from_static("cross-origin-opener-policy");
const RESOURCE_POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");
/// Where the response to an unknown request refers to.
const ALL_REQUESTS: &str = "docs/serve.md and /openapi.json list all requests";
/// Time limit for the head of a request on a connection beyond the limit; short, so that idle ones do not use up the
/// system's open files.
const HEAD_OF_STOP: Duration = Duration::from_secs(1);
/// Maximum questions in progress.
const QUESTIONS: usize = 4;
/// Time that a stop waits for the body that names the machine; short, because a late body must not delay a stop.
const STOP_BODY: Duration = Duration::from_millis(20);
/// Time limit for the head of a request, and for the next request on an open connection.
const HEAD: Duration = Duration::from_secs(10);
/// Write buffer of a connection, bytes.
const BUFFER: usize = 64 * 1024;
/// Longest wait for the end of an action, s.
const LONGEST_WAIT_S: u64 = 60;
/// Maximum age of an order, ms. An older one has waited in a broken connection, and the operator no longer expects a
/// motion.
const LATE_MS: i64 = 5_000;
/// A stop is confirmed or reported as failed within this time.
const STOPPING: Duration = Duration::from_secs(10);

/// State shared by all requests.
pub struct App {
    /// State of the machines.
    pub shared: Arc<SharedState>,
    access: Access,
    /// Queue for stops and questions.
    direct: Sender<DirectRequest>,
    /// Limits the questions in progress.
    asking: Arc<Semaphore>,
    /// Limits listings of records to one at a time.
    listing: Semaphore,
    /// Limits plans to one at a time.
    planning: Semaphore,
}

impl App {
    #[must_use]
    pub fn new(shared: Arc<SharedState>, access: Access, direct: Sender<DirectRequest>) -> Self {
        Self {
            shared,
            access,
            direct,
            asking: Arc::new(Semaphore::new(QUESTIONS)),
            listing: Semaphore::new(1),
            planning: Semaphore::new(1),
        }
    }
}

type Shared = State<Arc<App>>;
type Answered = Result<Response, Instead>;
/// The named parts of a path; an error if they are not UTF-8.
type Parts<T> = Result<Path<T>, PathRejection>;

fn not_utf8() -> Instead {
    let why = "the path is not UTF-8; nothing was done";
    refused(StatusCode::BAD_REQUEST, why, ALL_REQUESTS)
}

/// Routes all requests.
pub fn router(app: Arc<App>) -> Router {
    Router::new()
        .route("/", get(page))
        .route("/openapi.json", get(openapi))
        .route("/api/v1/state", get(state))
        .route("/api/v1/stream", get(stream))
        .route("/api/v1/actions", get(actions))
        .route("/api/v1/actions/{id}", get(action))
        .route("/api/v1/records", get(records))
        .route("/api/v1/records/{name}", get(record))
        .route("/api/v1/rig/health", get(health))
        .route("/api/v1/{machine}/settings", get(settings))
        .route("/api/v1/plan", post(plan_run))
        .route(
            "/api/v1/stop",
            post(|app, body| stop(app, Urgent::Stop, body)),
        )
        .route(
            "/api/v1/estop",
            post(|app, body| stop(app, Urgent::EStop, body)),
        )
        .route("/api/v1/rig/jog/renew", post(renew))
        .route("/api/v1/{machine}/{command}", post(command))
        .fallback(nothing_there)
        .method_not_allowed_fallback(wrong_method)
        .layer(from_fn_with_state(Arc::clone(&app), guard))
        .with_state(app)
}

/// Serves connections until the task ends. Beyond the limit, the oldest connection that has not requested a stop is
/// closed.
pub(crate) async fn listen(listener: TcpListener, router: Router, connections: Connections) {
    let places = Arc::new(Semaphore::new(connections.full));
    let mut further = VecDeque::<(AbortHandle, Arc<AtomicBool>)>::new();
    loop {
        let Ok((stream, peer)) = listener.accept().await else {
            // Most likely there are too many open files; wait until some are closed.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let peer = Peer {
            here: peer.ip().to_canonical().is_loopback(),
        };
        // Send at once: a stop must not wait for more data.
        let _ = stream.set_nodelay(true);
        let place = Arc::clone(&places).try_acquire_owned().ok();
        let (is_further, stops) = (place.is_none(), Arc::<AtomicBool>::default());
        let served = connection(stream, peer, place, Arc::clone(&stops), router.clone());
        let task = tokio::spawn(served).abort_handle();
        if is_further {
            further.retain(|(task, _)| !task.is_finished());
            further.push_back((task, stops));
            let idle = |(_, stops): &(_, Arc<AtomicBool>)| !stops.load(Ordering::Relaxed);
            if further.len() > connections.further
                && let Some(oldest) = further.iter().position(idle)
                && let Some((task, _)) = further.remove(oldest)
            {
                task.abort();
            }
        }
    }
}

type Answering = Pin<Box<dyn Future<Output = Result<Response, Infallible>> + Send>>;

/// Serves one connection; beyond the limit it serves stops only. Sets `stops` when a stop was requested.
async fn connection(
    stream: TcpStream,
    peer: Peer,
    place: Option<OwnedSemaphorePermit>,
    stops: Arc<AtomicBool>,
    router: Router,
) {
    let has_place = place.is_some();
    let service = service_fn(move |request: hyper::Request<hyper::body::Incoming>| {
        let mut request = request.map(Body::new);
        request.extensions_mut().insert(peer);
        let is_stop = demand(request.method(), request.uri().path()) == Demand::Stop;
        let answer = router.clone().call(request);
        // When a client closes its connection, the response is dropped, even before it begins. A stop must be carried
        // out nevertheless, so it begins here.
        let answering: Answering = if is_stop {
            stops.store(true, Ordering::Relaxed);
            let begun = tokio::spawn(answer);
            Box::pin(async { begun.await.unwrap_or_else(|_| Ok(unknown())) })
        } else if has_place {
            Box::pin(answer)
        } else {
            Box::pin(ready(Ok(full())))
        };
        answering
    });
    // A browser that disconnects is not an error.
    let _ = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(if has_place { HEAD } else { HEAD_OF_STOP })
        .max_buf_size(BUFFER)
        .serve_connection(TokioIo::new(stream), service)
        .await;
    drop(place);
}

/// The response to requests other than stops when there are too many connections.
fn full() -> Response {
    closing(bad(
        StatusCode::SERVICE_UNAVAILABLE,
        "too many connections at once; nothing was done",
        "close unused pages and programs; stops are still accepted",
    ))
}

/// The response to a stop whose result is unknown.
fn unknown() -> Response {
    closing(bad(
        StatusCode::INTERNAL_SERVER_ERROR,
        "the stop failed in the server; it is not known whether the machines have stopped",
        "press the E-stop at the machine",
    ))
}

/// Checks access, and adds the headers that tell browsers how the response may be used.
async fn guard(
    State(app): Shared,
    Extension(peer): Extension<Peer>,
    request: Request,
    next: Next,
) -> Response {
    let demand = demand(request.method(), request.uri().path());
    let checked = app
        .access
        .check(peer, demand, request.uri(), request.headers());
    let mut response = match checked {
        Ok(()) => next.run(request).await,
        Err(denied) => closing(denied.into_response()),
    };
    let is_unauthorized = response.status() == StatusCode::UNAUTHORIZED;
    let headers = response.headers_mut();
    if is_unauthorized {
        headers.insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    }
    for (name, value) in [
        (CACHE_CONTROL, "no-store"),
        (REFERRER_POLICY, "no-referrer"),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (X_FRAME_OPTIONS, "DENY"),
        (OPENER_POLICY, "same-origin"),
        (RESOURCE_POLICY, "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    if demand != Demand::Page {
        let nothing = HeaderValue::from_static("default-src 'none'; frame-ancestors 'none'");
        headers.insert(CONTENT_SECURITY_POLICY, nothing);
    }
    response
}

async fn nothing_there(request: Request) -> Response {
    let why = format!("there is nothing at {}", request.uri().path());
    bad(StatusCode::NOT_FOUND, &why, ALL_REQUESTS)
}

async fn wrong_method(request: Request) -> Response {
    let why = format!(
        "{} cannot be done with {}",
        request.method(),
        request.uri().path()
    );
    bad(StatusCode::METHOD_NOT_ALLOWED, &why, ALL_REQUESTS)
}

async fn page() -> Response {
    let nonce = crate::access::new_token();
    let mut response = typed("text/html; charset=utf-8", PAGE.replace(NONCE, &nonce));
    let policy = format!(
        "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    );
    if let Ok(policy) = HeaderValue::from_str(&policy) {
        let headers = response.headers_mut();
        headers.insert(CONTENT_SECURITY_POLICY, policy);
    }
    response
}

async fn openapi() -> Response {
    typed("application/json", OPENAPI)
}

async fn state(State(app): Shared) -> Response {
    good(app.shared.json())
}

async fn stream(State(app): Shared) -> Response {
    let events = app.shared.stream.body(|| app.shared.json());
    typed("text/event-stream", events)
}

async fn actions(State(app): Shared) -> Response {
    good(json!({ "actions": app.shared.actions.all() }))
}

async fn action(State(app): Shared, id: Parts<String>, request: Request) -> Answered {
    let Path(id) = id.map_err(|_| not_utf8())?;
    let wait_s = wait_s(request.uri().query().unwrap_or_default())
        .map_err(|why| refused(StatusCode::BAD_REQUEST, &why, "nothing was done"))?;
    let unknown = || {
        refused(
            StatusCode::NOT_FOUND,
            "there is no such action: it is too old, or the server was restarted",
            "`GET /api/v1/actions` lists those that are known",
        )
    };
    let actions = &app.shared.actions;
    let number = actions.number(&id).ok_or_else(unknown)?;
    let over = wait(&app.shared, number, |action| action.status.is_over());
    // The action may not have ended by then.
    let _ = timeout(Duration::from_secs(wait_s), over).await;
    let action = actions.get(number).ok_or_else(unknown)?;
    Ok(good(json!({ "action": actions.json(&action) })))
}

fn wait_s(query: &str) -> Result<u64, String> {
    let mut given = None;
    for pair in query.split('&').filter(|pair| !pair.is_empty()) {
        let value = pair
            .strip_prefix("wait_s=")
            .ok_or("the only parameter is `wait_s`")?;
        let wait_s = value
            .parse()
            .ok()
            .filter(|wait_s| *wait_s <= LONGEST_WAIT_S)
            .ok_or_else(|| format!("wait_s is a whole number from 0 to {LONGEST_WAIT_S}"))?;
        if given.replace(wait_s).is_some() {
            return Err("`wait_s` is there twice".to_owned());
        }
    }
    Ok(given.unwrap_or(0))
}

/// Waits until an action meets the condition; `None` if the action is unknown.
async fn wait(
    shared: &SharedState,
    number: u64,
    until: impl Fn(&Action) -> bool,
) -> Option<Action> {
    let mut changes = shared.actions.changes();
    loop {
        changes.borrow_and_update();
        let action = shared.actions.get(number)?;
        if until(&action) {
            return Some(action);
        }
        changes.changed().await.ok()?;
    }
}

async fn health(State(app): Shared) -> Answered {
    ask(&app, Question::Health).await
}

async fn settings(State(app): Shared, machine: Parts<String>) -> Answered {
    let Path(machine) = machine.map_err(|_| not_utf8())?;
    let kind = machine_of(&machine).ok_or_else(unknown_command)?;
    ask(&app, Question::Settings(kind)).await
}

async fn ask(app: &App, question: Question) -> Answered {
    let place = Arc::clone(&app.asking).try_acquire_owned();
    let place = place.map_err(|_| Failure::Unreached {
        why: "too many questions at once".to_owned(),
        help: "ask again".to_owned(),
    })?;
    let (reply, answered) = oneshot::channel();
    let _ = app.direct.send(DirectRequest::Ask {
        question,
        reply,
        place,
    });
    Ok(good(answered.await.map_err(|_| ends())??))
}

fn ends() -> Instead {
    let why = "the server ends";
    refused(StatusCode::SERVICE_UNAVAILABLE, why, "start it again")
}

async fn plan_run(State(app): Shared, headers: HeaderMap, body: Body) -> Answered {
    let body = object(&headers, body).await?;
    let _one = app.planning.acquire().await.map_err(|_| ends())?;
    // Plan on a separate thread: here it could delay a stop.
    let planned = tokio::task::spawn_blocking(move || planned(&body)).await;
    let summary = planned.map_err(|_| ends())??;
    Ok(good(json!({ "plan": summary })))
}

fn planned(body: &Map<String, Value>) -> Result<Value, Failure> {
    let run = orders::run(body)?;
    let axis = Axis::REFERENCE;
    let plan = planning::solve(&run, &axis, &REFERENCE_LIMITS)?;
    Ok(json!(plan::summary(&run, &axis, &plan)))
}

async fn records(State(app): Shared) -> Answered {
    let _one = app.listing.acquire().await.map_err(|_| ends())?;
    let folder = app.shared.out.clone();
    let listed = tokio::task::spawn_blocking(move || list(&folder)).await;
    Ok(good(listed.map_err(|_| ends())?))
}

async fn record(name: Parts<String>, State(app): Shared) -> Answered {
    let Path(name) = name.map_err(|_| not_utf8())?;
    let kind = if name.ends_with(".csv") {
        "text/csv"
    } else {
        "application/json"
    };
    let path = app.shared.out.join(&name);
    let opened = tokio::task::spawn_blocking(move || is_record(&name).then(|| open(&path))?);
    let file = opened.await.ok().flatten().ok_or_else(|| {
        refused(
            StatusCode::NOT_FOUND,
            "there is no such record",
            "`GET /api/v1/records` lists all",
        )
    })?;
    // Stream in pieces: a record of a whole day is too large for memory.
    let pieces = unfold(Some(file), |file| async {
        let file = file?;
        let read = tokio::task::spawn_blocking(move || {
            let mut file = file;
            let mut piece = vec![0; BUFFER];
            let count = file.read(&mut piece)?;
            piece.truncate(count);
            Ok::<_, std::io::Error>((file, piece))
        });
        match read.await.map_err(std::io::Error::other).flatten() {
            Ok((_, piece)) if piece.is_empty() => None,
            Ok((file, piece)) => Some((Ok(Bytes::from(piece)), Some(file))),
            Err(why) => Some((Err(why), None)),
        }
    });
    Ok(typed(kind, Body::from_stream(pieces)))
}

async fn stop(State(app): Shared, urgent: Urgent, body: Body) -> Answered {
    // A body that is invalid or late stops every machine.
    let body = timeout(STOP_BODY, to_bytes(body, LONGEST_BODY)).await;
    let only = body
        .ok()
        .and_then(Result::ok)
        .and_then(|body| fields(limited::utf8(&body).ok()?).ok())
        .and_then(|body| machine_of(body.get("machine")?.as_str()?));
    let mut waiting = vec![];
    for machine in &app.shared.machines {
        if only.is_some_and(|only| only != machine.kind) {
            continue;
        }
        let (reply, report) = oneshot::channel();
        // Send the stop through the worker and directly, at the same time.
        let wait = Wait {
            ask: machine.stop(urgent),
            reply,
        };
        let machine = machine.kind;
        let _ = app.direct.send(DirectRequest::Stop {
            machine,
            urgent,
            wait,
        });
        waiting.push((machine, report));
    }
    if waiting.is_empty() {
        return Err(no_machine(only.unwrap_or(DeviceKind::Rig)));
    }
    let mut reports = vec![];
    let until = At::now() + STOPPING;
    for (kind, reply) in waiting {
        reports.push(match timeout_at(until, reply).await {
            Ok(Ok(report)) => report,
            _ => StopReport {
                machine: kind_name(kind).to_owned(),
                delivery: Delivery::NotConfirmed,
                why: "no answer within 10 s".to_owned(),
            },
        });
    }
    if reports
        .iter()
        .any(|report| report.delivery != Delivery::Stopped)
    {
        return Err(Failure::Stops { reports }.into());
    }
    let machines: Vec<_> = reports.iter().map(StopReport::json).collect();
    Ok(good(json!({ "machines": machines })))
}

fn machine_of(name: &str) -> Option<DeviceKind> {
    match name {
        "rig" => Some(DeviceKind::Rig),
        "capsule" => Some(DeviceKind::Capsule),
        _ => None,
    }
}

fn no_machine(kind: DeviceKind) -> Instead {
    let name = kind_name(kind);
    refused(
        StatusCode::NOT_FOUND,
        &format!("this server has no {name}"),
        &format!("start it with `--{name} WHERE`"),
    )
}

fn unknown_command() -> Instead {
    let why = "there is no such command; nothing was done";
    refused(StatusCode::NOT_FOUND, why, ALL_REQUESTS)
}

/// The key of a command, if it belongs to this server instance.
fn key(headers: &HeaderMap, instance: &str) -> Result<String, Instead> {
    let denied = |why: &str| {
        refused(
            StatusCode::PRECONDITION_REQUIRED,
            why,
            "send `Idempotency-Key: INSTANCE-ANYTHING`: INSTANCE is in `GET /api/v1/state`, ANYTHING is new for each command, so that none is executed twice",
        )
    };
    let mut keys = headers.get_all("idempotency-key").iter();
    let (Some(key), None) = (keys.next(), keys.next()) else {
        return Err(denied("the command has not one key; nothing was done"));
    };
    let key = key.to_str().unwrap_or_default();
    let own = |c: char| c.is_ascii_alphanumeric() || c == '-';
    match key
        .strip_prefix(instance)
        .and_then(|rest| rest.strip_prefix('-'))
    {
        Some(rest) if (1..=64).contains(&rest.len()) && rest.chars().all(own) => Ok(key.to_owned()),
        Some(_) => Err(denied(
            "the key has to end in 1 to 64 letters, digits and `-`; nothing was done",
        )),
        None => Err(denied(
            "the key is from before the server's restart; nothing was done, look at the machine first",
        )),
    }
}

/// Whether an order's own time is too old by this computer's clock, or unreadable.
fn is_late(headers: &HeaderMap) -> bool {
    headers.get_all("retrograde-sent").iter().any(|sent| {
        let sent_ms: Option<i64> = sent.to_str().ok().and_then(|text| text.parse().ok());
        let now_ms = Timestamp::now().as_millisecond();
        sent_ms.is_none_or(|sent_ms| now_ms.saturating_sub(sent_ms) > LATE_MS)
    })
}

async fn command(
    State(app): Shared,
    path: Parts<(String, String)>,
    headers: HeaderMap,
    body: Body,
) -> Answered {
    let Path((machine, name)) = path.map_err(|_| not_utf8())?;
    let kind = machine_of(&machine).ok_or_else(unknown_command)?;
    let shared = &app.shared;
    let worker = shared.machine(kind).ok_or_else(|| no_machine(kind))?;
    // Note the last stop before waiting for the body, so that a stop during the wait overtakes this order.
    let after = worker.last_stop();
    let body = object(&headers, body).await?;
    let work = Work::read(kind, &name, &body).ok_or_else(unknown_command)??;
    let request = format!("{machine}/{name} {}", Value::Object(body));
    let command = RequestedAction {
        key: key(&headers, &shared.instance)?,
        print: hmac_sha256::Hash::hash(request.as_bytes()),
        machine: kind,
        kind: work.kind(),
        requested: work.requested(),
    };
    // Hold, resume and acknowledge take little time, so respond after they have ended.
    let short = !work.is_for_owner();
    let number = match shared.actions.arrive(command, Timestamp::now()) {
        Arrival::Again(number) => number,
        Arrival::Contradiction => {
            return Err(refused(
                StatusCode::UNPROCESSABLE_ENTITY,
                "this key was used for another request; nothing was done",
                "make a new key for each command",
            ));
        }
        Arrival::New(number) => {
            let order = Order {
                action: number,
                work,
                at: (Instant::now(), SystemTime::now()),
                after,
            };
            if is_late(&headers) {
                let failure = Failure::refused(
                    "the order is late: its `Retrograde-Sent` is more than 5 s ago, or no whole number of ms since 1970",
                    "nothing was moved by this order; look at the machine, then try again",
                );
                shared.ended(number, Value::Null, Some(&failure));
            } else if let Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) =
                worker.orders.try_send(order)
            {
                let failure = Failure::Unreached {
                    why: format!("too many orders for the {machine} at once"),
                    help: "this one was not sent; send it again when the others are done"
                        .to_owned(),
                };
                shared.ended(number, Value::Null, Some(&failure));
            }
            number
        }
    };
    let until = |action: &Action| {
        action.status.is_over() || (!short && action.status == ActionStatus::UnderWay)
    };
    let action = wait(shared, number, until).await.ok_or_else(ends)?;
    let mut value = json!({ "ok": true, "action": shared.actions.json(&action) });
    let code = match &action.failure {
        None if action.status.is_over() => StatusCode::OK,
        None => StatusCode::ACCEPTED,
        Some((code, error)) => {
            value["ok"] = json!(false);
            value["exit_code"] = json!(code);
            value["error"] = error.clone();
            status(*code)
        }
    };
    Ok(answer(code, &value))
}

async fn renew(State(app): Shared, headers: HeaderMap, body: Body) -> Answered {
    let body = object(&headers, body).await?;
    let (id, n) = (body.get("action"), body.get("n").and_then(Value::as_u64));
    let (Some(id), Some(n)) = (id.and_then(Value::as_str), n) else {
        return Err(refused(
            StatusCode::BAD_REQUEST,
            "a renewal has the fields `action`, the id of the jog, and `n`, 1, 2, 3 and so on; nothing was done",
            "the jog ends unless it is renewed",
        ));
    };
    let number = app.shared.actions.number(id);
    let rig = app.shared.machine(DeviceKind::Rig);
    let machine = rig.ok_or_else(|| no_machine(DeviceKind::Rig))?;
    let mut lease = machine.lease();
    match lease.as_mut() {
        Some(lease) if Some(lease.action) == number && lease.renewed.elapsed() < lease.within => {
            // A repeated or late renewal does not count.
            if n > lease.n {
                lease.n = n;
                lease.renewed = Instant::now();
                lease.due = true;
            }
            Ok(good(json!({})))
        }
        _ => Err(Failure::refused(
            "this jog has ended; nothing was moved by this request",
            "begin a new one",
        )
        .into()),
    }
}

#[cfg(test)]
mod tests;
