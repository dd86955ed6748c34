//! Target: HTTP requests into the real router, orders and workers of `retrograde serve`, with two machines that log
//! what reaches them. Without the token, nothing that moves or changes anything may reach them.

use std::collections::BTreeSet;
use std::fs;
use std::sync::OnceLock;

use crate::server::{self, Answer, INSTANCE, Server};
use client::address::Address;
use protocol::system::DeviceKind;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use serve::http::OPENAPI;
use serve::orders::RUN;
use simulated_machines::link::Memory;
use tempfile::TempDir;

use crate::bench::Bench;
use crate::exemplary::{Exemplary, SharedLog};
use crate::script::steps;

const TOKEN: &str = "0123456789abcdef0123456789abcdef";
const BEARER: &[u8] = b"Bearer 0123456789abcdef0123456789abcdef";

/// Most steps of a script that are executed.
const MOST_STEPS: usize = 8;

/// The machines and their behaviour.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Machines {
    /// Whether there is a capsule as well.
    pub both: bool,
    /// Whether the machines accept motions.
    pub willing: bool,
}

/// A request of the script: its origin, its line, its headers and its body.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RequestStep {
    /// Whether it comes from this computer.
    pub here: bool,
    /// Method and path.
    pub line: Target,
    /// Headers other than `Host`.
    pub headers: Vec<Header>,
    /// Its body.
    pub body: Body,
}

/// Method and path.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Target {
    /// An existing route, with this text appended.
    Route(u8, String),
    /// A command, by the names of machine and command.
    Command(String, String),
    /// Any method and path.
    Any(String, String),
}

/// A header.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Header {
    /// The correct token.
    Token,
    /// Any value of `Authorization`.
    Authorization(Vec<u8>),
    /// An idempotency key of this server, with this number.
    Key(u8),
    /// Any idempotency key.
    AnyKey(Vec<u8>),
    /// Content type JSON.
    Json,
    /// Marks a request that a page of another site has caused.
    Foreign,
    /// A host name that is not this computer's, as in DNS rebinding.
    Rebound,
    /// Any origin.
    Origin(Vec<u8>),
    /// A header that the server reads, with any value.
    Known(u8, Vec<u8>),
}

const KNOWN: [&str; 6] = [
    "content-type",
    "content-length",
    "transfer-encoding",
    "sec-fetch-site",
    "expect",
    "host",
];

/// A body.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Body {
    /// None.
    Empty,
    /// JSON fields.
    Fields(Vec<(Field, Content)>),
    /// Any text in place of JSON.
    Text(String),
    /// Any bytes, and how many times they are repeated.
    Bytes(Vec<u8>, u8),
    /// The renewal of the latest jog.
    Renewal(u64),
}

/// The name of a field.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Field {
    /// A field that some command has.
    Known(u8),
    /// Any name.
    Any(String),
}

/// Fields of other commands than the run.
const OTHER_FIELDS: [&str; 3] = ["position_mm", "direction", "machine"];

/// The value of a field.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Content {
    /// A number in thousandths.
    Thousandths(i32),
    /// A floating-point number.
    Float(f64),
    /// A text.
    Text(String),
    /// A text that some command accepts.
    Known(u8),
    /// Neither number nor text.
    Other(u8),
}

const TEXTS: [&str; 8] = [
    "away", "home", "finish", "stop", "paper", "rig", "capsule", "-0",
];

/// Runs a script.
///
/// # Panics
/// The server violates a property.
pub fn target(data: &[u8]) {
    let Ok((machines, data)) = postcard::take_from_bytes::<Machines>(data) else {
        return;
    };
    static OUT: OnceLock<TempDir> = OnceLock::new();
    let out = OUT
        .get_or_init(|| tempfile::tempdir().expect("a folder"))
        .path();
    let place = |name: &str| Address::Serial(name.to_owned());
    let mut places = vec![(DeviceKind::Rig, place("rig"))];
    if machines.both {
        places.push((DeviceKind::Capsule, place("capsule")));
    }
    let log = SharedLog::default();
    let bench = Bench(|kind| {
        let machine = Exemplary::new(kind, machines.willing, &log);
        Ok(Box::new(Memory::new("bench", machine)))
    });
    server::with(&bench, &places, TOKEN, out, |server| {
        let mut keys = BTreeSet::new();
        for step in steps::<RequestStep>(data).take(MOST_STEPS) {
            ask(server, &log, &step, &mut keys);
        }
        still_serves(server, &log);
    });
    // Remove the records: they are not needed, and many of them slow down later scripts.
    for entry in fs::read_dir(out).expect("a folder").flatten() {
        let _ = fs::remove_file(entry.path());
    }
}

/// A request as it is sent.
struct Sent {
    here: bool,
    method: String,
    uri: String,
    headers: Vec<(&'static str, Vec<u8>)>,
    body: Vec<u8>,
}

impl Sent {
    fn new(step: &RequestStep) -> Self {
        let (method, uri) = line(&step.line);
        let mut headers: Vec<_> = step.headers.iter().map(header).collect();
        if !headers.iter().any(|(name, _)| *name == "host") {
            headers.push(("host", b"127.0.0.1:7080".to_vec()));
        }
        Self {
            here: step.here,
            method,
            uri,
            headers,
            body: body(&step.body),
        }
    }

    /// Its headers, borrowed.
    fn headers(&self) -> Vec<(&str, &[u8])> {
        let headers = self.headers.iter();
        headers.map(|(name, value)| (*name, &**value)).collect()
    }

    fn http_request<'a>(&'a self, headers: &'a [(&'a str, &'a [u8])]) -> server::HttpRequest<'a> {
        server::HttpRequest {
            here: self.here,
            method: &self.method,
            uri: &self.uri,
            headers,
            body: &self.body,
        }
    }

    fn has(&self, name: &str, value: &[u8]) -> bool {
        self.headers().contains(&(name, value))
    }

    /// Whether it may move or change something.
    fn may_order(&self) -> bool {
        self.has("authorization", BEARER) && !self.is_foreign()
    }

    /// Whether it may stop a machine.
    fn may_stop(&self) -> bool {
        self.may_order() || self.here && !self.is_foreign()
    }

    fn is_foreign(&self) -> bool {
        self.has("origin", FOREIGN) || self.has("host", REBOUND)
    }

    fn key(&self) -> Option<Vec<u8>> {
        let mut headers = self.headers.iter();
        let key = headers.find(|(name, _)| *name == "idempotency-key");
        key.map(|(_, key)| key.clone())
    }
}

fn ask(server: &mut Server<'_>, log: &SharedLog, step: &RequestStep, keys: &mut BTreeSet<Vec<u8>>) {
    let sent = Sent::new(step);
    let before = log.lock().clone();
    let answer = server.ask(sent.http_request(&sent.headers()));
    let after = log.lock().clone();
    let Some(answer) = answer else {
        assert_eq!(
            after.changes.len() + after.stops.len(),
            before.changes.len() + before.stops.len()
        );
        return;
    };
    judge(&answer, &sent.method, &sent.uri);
    if !sent.may_order() {
        assert_eq!(
            after.changes[before.changes.len()..],
            [],
            "reached a machine without the token: {step:?}"
        );
    }
    if !sent.may_stop() {
        let stops = &after.stops[before.stops.len()..];
        assert_eq!(stops, [], "stopped by somebody who must not: {step:?}");
    }
    // The same key must not execute anything twice.
    if after.changes.len() > before.changes.len() {
        let key = sent.key().expect("no command without a key");
        assert!(keys.insert(key), "a second time: {step:?}");
    }
}

/// Checks that every answer has the right headers and is not an internal error of the server.
fn judge(answer: &Answer, method: &str, uri: &str) {
    let Answer {
        status,
        headers,
        body,
    } = answer;
    assert!(
        *status != 500,
        "{method} {uri}: {}",
        String::from_utf8_lossy(body)
    );
    for name in ["cache-control", "x-frame-options", "x-content-type-options"] {
        assert!(headers.contains_key(name), "no {name}: {headers:?}");
    }
    let is_json = headers
        .get("content-type")
        .is_some_and(|kind| kind == "application/json");
    // These are files, not JSON of the interface.
    let is_file = uri.starts_with("/openapi.json") || uri.starts_with("/api/v1/records/");
    if is_json && method != "HEAD" && !(is_file && *status == 200) && !body.is_empty() {
        let value: Value = serde_json::from_slice(body).expect("JSON");
        let is_good = value["ok"].as_bool().expect("ok");
        assert_eq!(is_good, (200..300).contains(status), "{status}: {value}");
        if !is_good {
            let message = value["error"]["message"].as_str().unwrap_or_default();
            assert!(!message.is_empty(), "a refusal without a reason: {value}");
        }
    }
}

/// Checks that a stop from this computer still reaches the machine, without a token.
fn still_serves(server: &mut Server<'_>, log: &SharedLog) {
    let before = log.lock().stops.len();
    let answer = server.ask(server::HttpRequest {
        here: true,
        method: "POST",
        uri: "/api/v1/estop",
        headers: &[("host", b"localhost")],
        body: b"",
    });
    let answer = answer.expect("a request");
    assert_eq!(
        answer.status,
        200,
        "{}",
        String::from_utf8_lossy(&answer.body)
    );
    assert!(log.lock().stops.len() > before, "the stop reached nobody");
}

const FOREIGN: &[u8] = b"https://elsewhere.example";
const REBOUND: &[u8] = b"elsewhere.example";

fn header(header: &Header) -> (&'static str, Vec<u8>) {
    match header {
        Header::Token => ("authorization", BEARER.to_vec()),
        Header::Authorization(value) => ("authorization", value.clone()),
        Header::Key(number) => ("idempotency-key", format!("{INSTANCE}-{number}").into()),
        Header::AnyKey(value) => ("idempotency-key", value.clone()),
        Header::Json => ("content-type", b"application/json".to_vec()),
        Header::Foreign => ("origin", FOREIGN.to_vec()),
        Header::Rebound => ("host", REBOUND.to_vec()),
        Header::Origin(value) => ("origin", value.clone()),
        Header::Known(index, value) => (KNOWN[usize::from(*index) % KNOWN.len()], value.clone()),
    }
}

/// All routes, in the order of the document: method and path.
pub fn routes() -> &'static [(String, String)] {
    static ROUTES: OnceLock<Vec<(String, String)>> = OnceLock::new();
    ROUTES.get_or_init(|| {
        let document: Value = serde_json::from_str(OPENAPI).expect("JSON");
        let paths = document["paths"].as_object().expect("paths");
        let of = |(path, methods): (&String, &Value)| {
            let methods = methods.as_object().expect("methods").keys();
            let routes = methods.map(|method| (method.clone(), path.clone()));
            routes.collect::<Vec<_>>()
        };
        paths.iter().flat_map(of).collect()
    })
}

fn line(line: &Target) -> (String, String) {
    match line {
        Target::Route(index, behind) => {
            let routes = routes();
            let (method, path) = &routes[usize::from(*index) % routes.len()];
            let path = path.replace("{id}", &format!("{INSTANCE}-1"));
            let path = path.replace("{name}", "run-19700101T000000Z.json");
            (method.to_uppercase(), path + behind)
        }
        Target::Command(machine, name) => ("POST".to_owned(), format!("/api/v1/{machine}/{name}")),
        Target::Any(method, uri) => (method.clone(), uri.clone()),
    }
}

fn body(body: &Body) -> Vec<u8> {
    match body {
        Body::Empty => vec![],
        Body::Fields(fields) => {
            let fields = fields.iter().map(|(field, content)| {
                let name = match field {
                    Field::Known(index) => {
                        let known = [&RUN[..], &OTHER_FIELDS].concat();
                        known[usize::from(*index) % known.len()]
                    }
                    Field::Any(name) => name,
                };
                (name.to_owned(), value(content))
            });
            Value::Object(fields.collect()).to_string().into()
        }
        Body::Text(text) => text.clone().into(),
        // Some of these exceed the limit.
        Body::Bytes(bytes, times) => bytes.repeat(usize::from(*times)),
        Body::Renewal(n) => format!("{{\"action\":\"{INSTANCE}-1\",\"n\":{n}}}").into(),
    }
}

fn value(content: &Content) -> Value {
    match content {
        Content::Thousandths(number) => Value::from(f64::from(*number) / 1e3),
        Content::Float(number) => Value::from(*number),
        Content::Text(text) => Value::from(text.clone()),
        Content::Known(index) => Value::from(TEXTS[usize::from(*index) % TEXTS.len()]),
        Content::Other(0) => Value::Null,
        Content::Other(1) => Value::Bool(true),
        Content::Other(2) => Value::Array(vec![]),
        Content::Other(number) => Value::from(*number),
    }
}
