//! `retrograde serve` as a process, over simulated machines on TCP. It admits only its clients, does nothing twice,
//! never delays a stop, lets a jog live on renewals alone, and shares the line.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant, UNIX_EPOCH};

use crate::support::bench::{Bench, limited, ready};
use crate::support::server::{self, Killed};
use client::identity::kind_name;
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Urgent};
use serde_json::{Value, json};
use serve::http::OPENAPI;

const SOON: Duration = Duration::from_secs(30);

/// A server process.
struct Server {
    process: Killed,
    at: String,
    token: String,
    instance: String,
    keys: AtomicU32,
}

struct Answer {
    status: u16,
    head: String,
    body: String,
}

impl Answer {
    fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|why| panic!("{why}: {}", self.body))
    }

    /// The same, if it has this status.
    #[track_caller]
    fn with(self, status: u16) -> Self {
        assert_eq!(self.status, status, "{}", self.body);
        self
    }

    fn message(&self) -> String {
        let json = self.json();
        let message = json["error"]["message"].as_str();
        message.unwrap_or_default().to_owned()
    }
}

/// Sends a raw request and reads the whole answer.
fn send(at: &str, request: &str) -> Answer {
    let mut stream = TcpStream::connect(at).expect("a server");
    stream.set_read_timeout(Some(SOON)).expect("set");
    stream.write_all(request.as_bytes()).expect("sent");
    let mut text = String::new();
    stream.read_to_string(&mut text).expect("an answer");
    let (head, body) = text.split_once("\r\n\r\n").expect("a head");
    let status = head.split(' ').nth(1).and_then(|code| code.parse().ok());
    Answer {
        status: status.expect("a status"),
        head: head.to_lowercase(),
        body: body.to_owned(),
    }
}

fn request(method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> String {
    let mut text = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
    let defaults = [("Host", "127.0.0.1"), ("Content-Type", "application/json")];
    let is_given = |name| headers.iter().any(|(given, _)| *given == name);
    let defaults = defaults.into_iter().filter(|(name, _)| !is_given(*name));
    for (name, value) in headers.iter().copied().chain(defaults) {
        text.push_str(&format!("{name}: {value}\r\n"));
    }
    text + &format!("Content-Length: {}\r\n\r\n{body}", body.len())
}

impl Server {
    fn start(bench: &Bench) -> Self {
        Self::start_with(bench, &[])
    }

    fn start_with(bench: &Bench, more: &[&str]) -> Self {
        Self::of(server::start(bench, more), bench)
    }

    fn of((process, at, token): (Killed, String, String), bench: &Bench) -> Self {
        let mut server = Self {
            process,
            at,
            token,
            instance: String::new(),
            keys: AtomicU32::new(0),
        };
        let state = server.until("a connection", |state| contact(state, bench.kind) != "lost");
        server.instance = state["instance"].as_str().expect("an instance").to_owned();
        server
    }

    fn ask(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> Answer {
        send(&self.at, &request(method, path, headers, body))
    }

    fn get(&self, path: &str) -> Answer {
        self.ask("GET", path, &[], "")
    }

    fn state(&self) -> Value {
        self.get("/api/v1/state").json()
    }

    fn until(&self, what: &str, is: impl Fn(&Value) -> bool) -> Value {
        let begin = Instant::now();
        loop {
            let state = self.state();
            if is(&state) {
                return state;
            }
            assert!(begin.elapsed() < SOON, "no {what}: {state:#}");
            thread::sleep(Duration::from_millis(10));
        }
    }

    fn key(&self) -> String {
        let number = self.keys.fetch_add(1, Ordering::Relaxed);
        format!("{}-{number}", self.instance)
    }

    fn bearer(&self) -> String {
        format!("Bearer {}", self.token)
    }

    fn post_as(&self, key: &str, command: &str, body: &Value) -> Answer {
        let bearer = self.bearer();
        let headers = [("Authorization", &*bearer), ("Idempotency-Key", key)];
        let path = format!("/api/v1/{command}");
        self.ask("POST", &path, &headers, &body.to_string())
    }

    fn post(&self, command: &str, body: &Value) -> Answer {
        self.post_as(&self.key(), command, body)
    }

    /// Starts an action and returns its final state.
    fn done(&self, command: &str, body: &Value) -> Value {
        let answer = self.post(command, body);
        assert!(answer.status < 300, "{}", answer.body);
        self.end_of(&answer.json()["action"])
    }

    fn complete(&self, command: &str) {
        let ended = self.done(command, &json!({}));
        assert_eq!(ended["state"], "complete", "{ended}");
    }

    fn end_of(&self, action: &Value) -> Value {
        let id = action["id"].as_str().expect("an id");
        let answer = self.get(&format!("/api/v1/actions/{id}?wait_s=60"));
        answer.json()["action"].clone()
    }

    /// A stop, without a token.
    fn stop(&self, name: &str) -> u16 {
        self.ask("POST", &format!("/api/v1/{name}"), &[], "").status
    }

    /// Sends Ctrl-C and returns the exit code.
    fn interrupt(mut self) -> Option<i32> {
        let child = rustix::process::Pid::from_child(&self.process.0);
        rustix::process::kill_process(child, rustix::process::Signal::INT).expect("sent");
        let begin = Instant::now();
        loop {
            if let Some(status) = self.process.0.try_wait().expect("mine") {
                return status.code();
            }
            assert!(begin.elapsed() < SOON, "it does not end");
            thread::sleep(Duration::from_millis(10));
        }
    }
}

fn contact(state: &Value, kind: DeviceKind) -> &str {
    let contact = state["machines"][kind_name(kind)]["contact"].as_str();
    contact.unwrap_or("lost")
}

fn rig_state(state: &Value) -> &str {
    state["machines"]["rig"]["state"].as_str().unwrap_or("-")
}

fn moved(bench: &Bench) -> usize {
    let motions = "Home Run MoveTo Jog Hold Resume Acknowledge".split(' ');
    motions.map(|name| bench.count(name)).sum()
}

/// The paper's run, much shortened.
fn short_run() -> Value {
    json!({ "cycles": 1, "stroke_mm": 20, "duration_s": 6, "note": "short" })
}

/// One sample for each reason of `access`, which has the tables.
#[test]
fn a_cross_site_page_a_rebound_name_and_a_missing_token_move_nothing() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let bearer = server.bearer();
    let token = ("Authorization", &*bearer);
    let cross = ("Origin", "https://evil.example");
    let rebound = ("Host", "evil.example");
    let site = ("Sec-Fetch-Site", "cross-site");
    let wrong = ("Authorization", "Bearer 0000");
    // A foreign page can send this without a preflight.
    let plain = ("Content-Type", "text/plain");
    for (method, path, headers, status) in [
        ("POST", "rig/home", &[][..], 401),
        ("POST", "rig/run", &[wrong], 401),
        ("POST", "rig/home", &[cross, token], 403),
        ("POST", "rig/run", &[rebound, token], 403),
        ("POST", "rig/jog/renew", &[site, token], 403),
        ("POST", "rig/home", &[cross, plain], 403),
        ("OPTIONS", "rig/home", &[cross], 403),
        ("POST", "estop", &[cross], 403),
        ("GET", "state", &[rebound], 403),
        ("GET", "stream", &[cross], 403),
    ] {
        let key = server.key();
        let headers = [headers, &[("Idempotency-Key", &*key)]].concat();
        let answer = server.ask(method, &format!("/api/v1/{path}"), &headers, "{}");
        let (why, head) = (answer.message(), answer.with(status).head);
        assert!(why.contains("nothing was done"), "{why}");
        assert!(!head.contains("access-control-allow"), "{head}");
        let asks_for_token = head.contains("www-authenticate: bearer");
        assert_eq!(asks_for_token, status == 401, "{head}");
    }
    server.ask("GET", "/", &[rebound], "").with(403);
    assert_eq!((moved(&bench), bench.urgent()), (0, vec![]));
    // A stop from this computer needs neither a token nor a sensible body.
    for body in ["", "{}", "no JSON", "{\"machine\":\"rig\"}"] {
        server.ask("POST", "/api/v1/stop", &[], body).with(200);
    }
    assert!(bench.urgent().contains(&Urgent::Stop));
}

/// Connections that only wait, and readers of the stream, take up every place.
#[test]
fn a_stop_passes_a_crowd_that_takes_up_every_place() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let begun = server.post("rig/run", &short_run()).with(202);
    let crowd: Vec<_> = (0..300)
        .map(|number| match number % 2 {
            0 => follow(&server.at).into_inner(),
            _ => TcpStream::connect(&server.at).expect("a server"),
        })
        .collect();
    let begin = Instant::now();
    while server.get("/api/v1/state").status != 503 {
        assert!(begin.elapsed() < Duration::from_secs(5), "room for all");
    }
    let begin = Instant::now();
    let stopped = server.ask("POST", "/api/v1/stop", &[], "").json();
    assert_eq!(stopped["machines"][0]["outcome"], "stopped");
    let took = begin.elapsed();
    assert!(took < Duration::from_secs(10), "{took:?}");
    assert!(bench.urgent().contains(&Urgent::Stop));
    // When the crowd leaves, there is room again.
    drop(crowd);
    let begin = Instant::now();
    while server.get("/api/v1/state").status != 200 {
        assert!(begin.elapsed() < SOON, "no room");
    }
    assert_eq!(server.end_of(&begun.json()["action"])["state"], "stopped");
}

/// Regression: connections that only wait took up every open file, and the stop waited until they had ended.
#[test]
fn a_stop_passes_a_crowd_that_takes_up_every_open_file() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let command = bench.command(&["serve", "--listen", "127.0.0.1:0"]);
    let started = server::start_of(&mut limited(&command, "ulimit -n 128"));
    let server = Server::of(started, &bench);
    let _crowd: Vec<_> = (0..400)
        .map(|_| TcpStream::connect(&server.at).expect("a server"))
        .collect();
    let begin = Instant::now();
    let stopped = server.ask("POST", "/api/v1/stop", &[], "").json();
    assert_eq!(stopped["machines"][0]["outcome"], "stopped");
    let took = begin.elapsed();
    assert!(took < Duration::from_secs(10), "{took:?}");
}

#[test]
fn the_page_is_one_file_that_loads_nothing_and_may_not_be_framed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let page = server.get("/");
    let mut lines = page.head.lines();
    let policy = lines.find(|line| line.starts_with("content-security-policy"));
    let policy = policy.expect("a policy");
    assert!(policy.contains("default-src 'none'") && policy.contains("frame-ancestors 'none'"));
    assert!(!policy.contains("unsafe"));
    let (_, nonce) = policy.split_once("script-src 'nonce-").expect("a nonce");
    let nonce = nonce.split('\'').next().expect("its end");
    assert_eq!(page.body.matches(&format!("nonce=\"{nonce}\"")).count(), 2);
    assert!(!page.body.contains("@NONCE@") && !page.body.contains(&server.token));
    for foreign in [
        "https://", " src=", "@import", "url(", " style=", " onclick",
    ] {
        assert!(!page.body.contains(foreign), "{foreign}");
    }
    let other = server.get("/").body;
    assert!(!other.contains(nonce), "each page has its own");
    // Programs of the same user find the server by its file.
    let file = bench.locks().join("serve.json");
    let found: Value = serde_json::from_slice(&std::fs::read(&file).expect("it")).expect("JSON");
    assert_eq!(found["token"], server.token.as_str());
    assert_eq!(found["url"], format!("http://{}/", server.at));
    assert_eq!(server.interrupt(), Some(0));
    assert!(!file.exists());
}

#[test]
fn every_route_of_the_document_is_served() {
    let document: Value = serde_json::from_str(OPENAPI).expect("JSON");
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let bearer = server.bearer();
    let token = [("Authorization", &*bearer)];
    assert_eq!(server.get("/openapi.json").body, OPENAPI);
    let manual = std::fs::read_to_string("../docs/serve.md").expect("the manual");
    let paths = document["paths"].as_object().expect("paths");
    let routes = paths.iter().flat_map(|(path, methods)| {
        let methods = methods.as_object().expect("methods").iter();
        methods.map(move |(method, about)| (path, method, &about["responses"]))
    });
    for (path, method, responses) in routes.filter(|(path, ..)| !path.ends_with("stream")) {
        let is_stop = path.ends_with("stop");
        assert_eq!(responses["503"].is_null(), is_stop, "{method} {path}");
        let reads_body = method == "post" && !is_stop;
        assert_ne!(responses["408"].is_null(), reads_body, "{method} {path}");
        let path = path.replace("{id}", "none").replace("{name}", "none");
        let answer = server.ask(&method.to_uppercase(), &path, &token, "");
        assert_ne!(answer.status, 405, "{method} {path}");
        if answer.status == 404 {
            let why = answer.message();
            let known = ["no such action", "no such record", "no capsule"];
            let is_known = known.iter().any(|known| why.contains(known));
            assert!(is_known, "{path}: {why}");
        }
        let last = path.rsplit('/').next().expect("a name");
        let is_there = last == "none" || manual.contains(last);
        assert!(is_there, "not in docs/serve.md: {path}");
    }
    assert_eq!(moved(&bench), 0);
    for (path, status) in [
        ("/api/v2/state", 404),
        ("/api/v1/rig/home", 405),
        ("/api/v1/actions/%FF", 400),
    ] {
        assert_eq!(server.get(path).with(status).json()["ok"], false);
    }
}

#[test]
fn a_request_that_is_repeated_is_executed_once() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let key = server.key();
    let body = json!({ "position_mm": 3 });
    // A browser that goes away ends nothing. Then all at once, as an impatient network does.
    let bearer = server.bearer();
    let headers = [("Authorization", &*bearer), ("Idempotency-Key", &*key)];
    let order = request("POST", "/api/v1/rig/move", &headers, &body.to_string());
    let mut browser = TcpStream::connect(&server.at).expect("a server");
    browser.write_all(order.as_bytes()).expect("sent");
    bench.wait_for("MoveTo");
    drop(browser);
    let answers: Vec<_> = thread::scope(|scope| {
        let send = || server.post_as(&key, "rig/move", &body).json()["action"].clone();
        let all: Vec<_> = (0..8).map(|_| scope.spawn(send)).collect();
        let all = all.into_iter().map(|one| one.join().expect("answered"));
        all.collect()
    });
    let ids: BTreeSet<_> = answers
        .iter()
        .map(|action| action["id"].to_string())
        .collect();
    assert_eq!(ids.len(), 1, "{ids:?}");
    assert_eq!(bench.count("MoveTo"), 1);
    let ended = server.end_of(&answers[0]);
    assert_eq!(ended["state"], "complete");
    assert_eq!(ended["result"]["position_um"], 3_000);
    // The same answer comes after the end of the move.
    let again = server.post_as(&key, "rig/move", &body).with(200);
    assert_eq!(again.json()["action"], ended);
    // A key belongs to one request, and to this server since its start.
    let other = json!({ "position_mm": 4 });
    let space = format!("{}-a b", server.instance);
    for (key, command, status) in [
        (&*key, "rig/move", 422),
        (&key, "rig/home", 422),
        ("", "rig/move", 428),
        ("0123456789ab-1", "rig/move", 428),
        (&space, "rig/move", 428),
    ] {
        let body = if command == "rig/home" {
            &json!({})
        } else {
            &other
        };
        server.post_as(key, command, body).with(status);
    }
    // An order that waited in a dead link says when it was given.
    let late = UNIX_EPOCH.elapsed().expect("after 1970").as_millis() - 6_000;
    for (key, sent, status) in [
        (server.key(), late.to_string(), 409),
        (server.key(), "yesterday".to_owned(), 409),
        // A repetition is told what has become of the order.
        (key, late.to_string(), 200),
    ] {
        let token = ("Authorization", &*bearer);
        let headers = [token, ("Idempotency-Key", &key), ("Retrograde-Sent", &sent)];
        let answer = server.ask("POST", "/api/v1/rig/move", &headers, &body.to_string());
        assert_eq!(answer.status, status, "{sent}: {}", answer.body);
    }
    assert_eq!(moved(&bench), 1);
}

/// One sample for each way in which a request is refused; `orders` has the texts.
#[test]
fn bad_input_is_refused_and_moves_nothing() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let long = "9".repeat(20_000);
    for (command, body, status, text) in [
        ("rig/run", r#"{"stroke_mm":-1}"#, 400, "negative"),
        ("rig/run", r#"{"duration_s":1}"#, 409, "too little time"),
        ("rig/move", r#"{"position_mm":131}"#, 409, "0 to 130 mm"),
        ("rig/hold", "{}", 409, "no run is in progress"),
        ("rig/ack", "{}", 409, "no fault is latched"),
        ("capsule/fold", "{}", 404, "no capsule"),
        ("rig/jog/renew", r#"{"action":"x","n":1}"#, 409, "has ended"),
        ("rig/jog/renew", r#"{"n":1}"#, 400, "fields `action`"),
        ("rig/run", "{", 400, "cannot be read"),
        ("rig/run", "[]", 400, "expected a JSON object"),
        (
            "rig/run",
            "{\"cycles\": 5, \"cycles\": 1}",
            400,
            "cycles is there twice",
        ),
        ("rig/run", &long, 413, "longer than 16 KiB"),
    ] {
        let (bearer, key) = (server.bearer(), server.key());
        let headers = [("Authorization", &*bearer), ("Idempotency-Key", &*key)];
        let answer = server.ask("POST", &format!("/api/v1/{command}"), &headers, body);
        let answer = answer.with(status);
        // A program in Python knows a refusal by its exit code.
        let is_refusal = answer.json()["exit_code"] == 3;
        assert_eq!(is_refusal, status == 409, "{}", answer.body);
        assert!(answer.message().contains(text), "{}", answer.body);
    }
    let bearer = server.bearer();
    let form = [("Authorization", &*bearer), ("Content-Type", "text/plain")];
    server
        .ask("POST", "/api/v1/rig/home", &form, "a=b")
        .with(415);
    let tried = ["Run", "Home", "Jog"].map(|name| bench.count(name));
    assert_eq!(tried, [0; 3]);
    let plan = server.post("plan", &json!({})).json();
    assert_eq!(plan["plan"]["achieved"]["edges"], 1_040_000);
}

#[test]
fn a_run_is_held_resumed_recorded_and_followed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let mut stream = follow(&server.at);
    let begun = server.post("rig/run", &short_run()).with(202);
    let action = begun.json()["action"].clone();
    assert_eq!(action["accepted"]["edges"], 32_000);
    // Another motion is refused with the reason.
    let why = server.post("rig/home", &json!({})).with(409).message();
    assert!(why.contains("the rig is busy: `run` is under way"), "{why}");
    let held = server.done("rig/hold", &json!({}));
    assert_eq!(held["state"], "complete");
    let steps = held["result"]["position_steps"].as_i64().expect("it");
    // The position is that of the hold's own step, 800 for each mm, and not that of the last sample.
    assert!(steps > 0, "{held}");
    assert_eq!(held["result"]["position_um"], (steps * 1_250 + 500) / 1_000);
    server.until("a hold", |state| rig_state(state) == "held");
    server.post("rig/hold", &json!({})).with(409);
    // Other commands of the same user work beside the server.
    let (code, out, err) = bench.retrograde(&["info", "rig"]);
    assert_eq!((code, out.contains("Held")), (Some(0), true), "{out}{err}");
    let (code, _, err) = bench.retrograde(&["home"]);
    assert_eq!((code, err.contains("serve")), (Some(3), true), "{err}");
    assert!(server.get("/api/v1/rig/health").json()["health"]["underruns"].is_u64());
    let settings = server.get("/api/v1/rig/settings").body;
    assert!(settings.contains("\"stroke_um\"") && !settings.contains("\"end_force_ma\""));
    server.complete("rig/resume");
    let ended = server.end_of(&action);
    assert_eq!(ended["state"], "complete", "{ended}");
    assert_eq!(ended["result"]["counted_edges"], 32_000);
    assert_eq!(ended["result"]["holds"], 1);
    // The second notice with the same words has another number, so that the page shows it.
    let notices = [(); 2].map(|()| {
        server.complete("rig/home");
        server.state()["machines"]["rig"]["notice"].clone()
    });
    assert_eq!(notices[0]["text"], notices[1]["text"]);
    assert!(notices[0]["number"].as_u64() < notices[1]["number"].as_u64());
    let csv = ended["files"]["csv"].as_str().expect("a record");
    let listed = server.get("/api/v1/records").json();
    assert_eq!(listed["records"][0]["csv"], csv);
    assert_eq!(listed["records"][0]["note"], "short");
    let record = server.get(&format!("/api/v1/records/{csv}"));
    assert!(record.body.contains("time_us,state,position_mm"));
    let (rows, missed) = bench.telemetry();
    assert_eq!(missed, 0);
    // The stream has reported the same.
    let id = ended["id"].as_str().expect("an id");
    let told = read_until(&mut stream, [id, "\"complete\""]);
    let data = told.iter().filter_map(|line| line.strip_prefix("data: "));
    let data = data.map(|line| serde_json::from_str::<Value>(line).expect("JSON"));
    let samples: Vec<_> = data
        .filter_map(|data| data["samples"].as_array().cloned())
        .flatten()
        .collect();
    let in_order = samples.is_sorted_by_key(|sample| sample["time_us"].as_u64());
    let count = samples.len();
    assert!(count >= rows && in_order, "{count} of {rows}");
    assert!(told.iter().any(|line| line.contains("held at")));
    assert!(told.iter().all(|line| !line.starts_with("event: lost")));
}

/// As `nc -N` or a button on a microcontroller does.
#[test]
fn a_stop_counts_whose_sender_closes_the_connection_at_once() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let rig = r#"{"machine":"rig"}"#;
    let ways = [
        ("stop", "", Shutdown::Write, Urgent::Stop),
        ("stop", rig, Shutdown::Write, Urgent::Stop),
        ("stop", "", Shutdown::Both, Urgent::Stop),
        ("estop", "", Shutdown::Write, Urgent::EStop),
    ];
    for (path, body, how, urgent) in ways.into_iter().cycle().take(80) {
        let before = bench.urgent().len();
        let mut sender = TcpStream::connect(&server.at).expect("a server");
        let request = request("POST", &format!("/api/v1/{path}"), &[], body);
        sender.write_all(request.as_bytes()).expect("sent");
        sender.shutdown(how).expect("closed");
        server.until("the stop", |_| bench.urgent()[before..].contains(&urgent));
    }
}

#[test]
fn an_emergency_stop_works_in_every_state_and_is_latched_until_acknowledged() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let acknowledge = || {
        server.until("a fault", |state| rig_state(state) == "faulted");
        assert_eq!(server.post("rig/home", &json!({})).status, 409);
        server.complete("rig/ack");
        server.complete("rig/home");
    };
    // Emergency stop at rest.
    assert_eq!(server.stop("estop"), 200);
    acknowledge();
    // Emergency stop while the rig homes, moves, jogs, runs and is held.
    for (command, body, hold) in [
        ("rig/move", json!({ "position_mm": 100 }), false),
        ("rig/jog", json!({ "direction": "away" }), false),
        ("rig/home", json!({}), false),
        ("rig/run", short_run(), false),
        ("rig/run", short_run(), true),
    ] {
        let begun = server.post(command, &body).with(202);
        if hold {
            server.complete("rig/hold");
        }
        assert_eq!(server.stop("estop"), 200);
        let ended = server.end_of(&begun.json()["action"]);
        let is_cut = ended["state"] == "faulted" || ended["state"] == "stopped";
        assert!(is_cut, "{command}: {ended}");
        if command == "rig/run" && !hold {
            // Homing is refused until then.
            let help = ended["error"]["help"].as_str().unwrap_or_default();
            let way_on = "once the cause is removed acknowledge it, then home";
            assert!(help.ends_with(way_on), "{ended}");
        }
        acknowledge();
    }
}

#[test]
fn a_jog_lives_on_renewals_alone() {
    let mut script = ready(DeviceKind::Rig);
    // A busy computer may delay a browser or a server by half a second.
    script.settings.push((SettingKey::DeadManMs, 1_800));
    let bench = Bench::on_tcp_as(&script, 1);
    let server = Server::start(&bench);
    let away = json!({ "direction": "away", "speed_mm_s": 10 });
    let begun = server.post("rig/jog", &away).with(202);
    let action = begun.json()["action"].clone();
    assert_eq!(action["accepted"]["renew_within_ms"], 1_500);
    let renew = |action: &Value, n: u64| {
        let renewal = json!({ "action": action["id"], "n": n });
        server.post("rig/jog/renew", &renewal).status
    };
    let at_um = || {
        let state = server.state();
        let at_um = &state["machines"]["rig"]["position_um"];
        at_um.as_i64().expect("a place")
    };
    let begin = Instant::now();
    let mut n = 0;
    // Without renewals it would end at 18 mm. By its place, because a busy computer slows the rig's clock.
    while at_um() < 21_000 {
        n += 1;
        assert_eq!(renew(&action, n), 200);
        assert!(begin.elapsed() < 2 * SOON, "it stands");
        thread::sleep(Duration::from_millis(40));
    }
    assert_eq!(rig_state(&server.state()), "moving");
    // Each renewal reaches the rig at most once, and nothing else does.
    let passed_on = bench.count("Jog");
    let passed = 6..=n as usize + 1;
    assert!(passed.contains(&passed_on), "{passed_on} of {n}");
    // The rig is looked at before each: one that comes after the end of the jog would begin another.
    let executed = bench.executed();
    let jog = |name: &&str| *name == "Jog";
    let first = executed.iter().position(jog).expect("the order");
    for pair in executed[first..].windows(2).filter(|pair| jog(&pair[1])) {
        assert_eq!(pair[0], "GetRigStatus");
    }
    // A repeated renewal renews nothing.
    let last = Instant::now();
    while server.state()["machines"]["rig"]["action"]["state"] == "under_way" {
        renew(&action, n);
        assert!(last.elapsed() < Duration::from_secs(4), "it goes on");
        thread::sleep(Duration::from_millis(20));
    }
    let ended = server.end_of(&action);
    assert_eq!(ended["state"], "complete", "{ended}");
    // A late renewal does not start the jog again.
    let jogs = bench.count("Jog");
    for late in 1..4 {
        assert_eq!(renew(&action, n + late), 409);
    }
    thread::sleep(Duration::from_millis(1_900));
    assert_eq!(bench.count("Jog"), jogs);
    assert_eq!(rig_state(&server.state()), "ready");
    assert!((21_000..60_000).contains(&at_um()), "{}", at_um());
}

#[test]
fn a_jog_ends_when_the_server_is_killed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut server = Server::start(&bench);
    let away = json!({ "direction": "away", "speed_mm_s": 10 });
    server.post("rig/jog", &away).with(202);
    server.process.0.kill().expect("mine");
    server.process.0.wait().expect("mine");
    // Wait for the rig's own dead-man time, 0.3 s, and the braking.
    thread::sleep(Duration::from_secs(1));
    let log = bench.log.lock().expect("log");
    let on_us = log.driven_us.saturating_sub(log.heard_us);
    drop(log);
    assert!(on_us < 700_000, "driven {on_us} us after the last frame");
    let (_, out, _) = bench.retrograde(&["info", "rig"]);
    assert!(out.contains("Ready"), "{out}");
}

#[test]
fn it_gives_the_line_to_a_command_that_moves_and_shows_it() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let is_contact = |name| move |state: &Value| contact(state, DeviceKind::Rig) == name;
    let mut run = bench.run(&["--cycles", "1", "--stroke-mm", "20", "--duration-s", "6"]);
    let state = server.until("a broker", is_contact("broker"));
    let text = state["machines"]["rig"]["contact_text"].to_string();
    assert!(text.contains("retrograde run"), "{text}");
    server.until("the run", |state| {
        state["machines"]["rig"]["run"]["stroke"].is_u64()
    });
    // Only the owner may start motions. Hold, resume and stop are open to others.
    let why = server.post("rig/home", &json!({})).with(409).message();
    assert!(why.contains("belongs to process"), "{why}");
    server.complete("rig/hold");
    server.complete("rig/resume");
    assert_eq!(server.stop("stop"), 200);
    assert_eq!(run.wait().expect("ended").code(), Some(130));
    server.until("the line", is_contact("owned"));
    server.complete("rig/home");
    // A stop from another process ends this server's motion.
    let begun = server.post("rig/run", &short_run()).json();
    assert_eq!(bench.retrograde(&["stop"]).0, Some(0));
    assert_eq!(server.end_of(&begun["action"])["state"], "stopped");
    // Ctrl-C ends it, too, before the server ends.
    server.complete("rig/home");
    assert_eq!(server.post("rig/run", &short_run()).status, 202);
    assert_eq!(server.interrupt(), Some(0));
    let (_, out, _) = bench.retrograde(&["info", "rig"]);
    assert!(out.contains("Ready"), "{out}");
}

#[test]
fn the_capsule_is_folded_once_and_says_when_it_was_so_already() {
    let bench = Bench::on_tcp(DeviceKind::Capsule);
    let server = Server::start(&bench);
    let thread_um = |action: &Value| action["result"]["thread_um"].as_i64().expect("a length");
    let folded = server.done("capsule/fold", &json!({ "note": "first" }));
    assert_eq!(folded["state"], "complete", "{folded}");
    assert!(thread_um(&folded) > 1_000, "{folded}");
    let again = server.done("capsule/fold", &json!({}));
    assert_eq!(again["result"]["already"], true);
    server.complete("capsule/unfold");
    let partly = server.done("capsule/fold", &json!({ "thread_mm": 12.5 }));
    assert!((thread_um(&partly) - 12_500).abs() < 150, "{partly}");
    assert_eq!(partly["requested"], json!({ "thread_um": 12_500 }));
    server
        .post("capsule/fold", &json!({ "indentation_mm": 1_000 }))
        .with(400);
    assert_eq!((bench.count("Fold"), bench.count("FoldTo")), (1, 1));
    server.complete("capsule/unfold");
    let settings = server.get("/api/v1/capsule/settings").body;
    assert!(settings.contains("\"end_force_ma\"") && !settings.contains("\"lead_um\""));
    let state = server.state();
    assert_eq!(state["machines"]["capsule"]["state"], "unfolded");
    assert!(state["machines"]["rig"].is_null());
}

#[test]
fn the_options_for_campaign_token_and_address_are_followed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let folder = bench.folder.path().join("shown");
    let folder = folder.to_str().expect("UTF-8");
    let plan = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/paper.toml");
    bench.retrograde(&["campaign", "new", plan, "--out", folder]);
    let options = ["--campaign", folder, "--token-file", "token"];
    let server = Server::start_with(&bench, &options);
    let state = server.until("a campaign", |state| state["campaign"]["name"] == "paper");
    let next = state["campaign"]["next"].as_str().expect("a step");
    assert!(next.starts_with("trial 1: "), "{next}");
    let (code, _, err) = bench.retrograde(&["serve", "--listen", &server.at]);
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("port 0 takes a free one"), "{err}");
    let token = server.token.clone();
    assert_eq!(server.interrupt(), Some(0));
    assert_eq!(Server::start_with(&bench, &options).token, token);
}

/// Opens the stream of events.
fn follow(at: &str) -> BufReader<TcpStream> {
    let mut stream = TcpStream::connect(at).expect("a server");
    stream.set_read_timeout(Some(SOON)).expect("set");
    let request = b"GET /api/v1/stream HTTP/1.1\r\nHost: localhost\r\n\r\n";
    stream.write_all(request).expect("sent");
    BufReader::new(stream)
}

/// Reads all lines up to one that has these words.
fn read_until(stream: &mut BufReader<TcpStream>, words: [&str; 2]) -> Vec<String> {
    let mut all: Vec<String> = vec![];
    let is_last = |line: &String| words.iter().all(|word| line.contains(word));
    while !all.last().is_some_and(is_last) {
        let mut line = String::new();
        let read = stream.read_line(&mut line).expect("more");
        assert_ne!(read, 0, "the stream ended");
        all.push(line);
    }
    all
}
