//! `retrograde serve` as a process, over simulated machines on TCP. It admits only its clients, does nothing twice,
//! never delays a stop, lets a jog live on renewals alone, and shares the line.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::bench::Bench;
use crate::support::server::{self, Killed};
use client::Device;
use client::link::tcp::Tcp;
use protocol::rig::MoveTo;
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

    fn message(&self) -> String {
        let json = self.json();
        json["error"]["message"]
            .as_str()
            .unwrap_or_default()
            .to_owned()
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
    if !headers.iter().any(|(name, _)| *name == "Host") {
        text.push_str("Host: 127.0.0.1\r\n");
    }
    for (name, value) in headers {
        text.push_str(&format!("{name}: {value}\r\n"));
    }
    if !body.is_empty() {
        text.push_str("Content-Type: application/json\r\n");
    }
    text + &format!("Content-Length: {}\r\n\r\n{body}", body.len())
}

impl Server {
    fn start(bench: &Bench) -> Self {
        Self::start_with(bench, &[])
    }

    fn start_with(bench: &Bench, more: &[&str]) -> Self {
        let (process, at, token) = server::start(bench, more);
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

    fn get(&self, path: &str) -> Answer {
        send(&self.at, &request("GET", path, &[], ""))
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

    fn post_as(&self, key: &str, path: &str, body: &Value) -> Answer {
        let bearer = format!("Bearer {}", self.token);
        let headers = [("Authorization", &*bearer), ("Idempotency-Key", key)];
        send(
            &self.at,
            &request("POST", path, &headers, &body.to_string()),
        )
    }

    fn post(&self, path: &str, body: &Value) -> Answer {
        self.post_as(&self.key(), path, body)
    }

    /// Starts an action and returns its final state.
    fn done(&self, path: &str, body: &Value) -> Value {
        let answer = self.post(path, body);
        assert!(answer.status < 300, "{}", answer.body);
        self.end_of(&answer.json()["action"])
    }

    fn end_of(&self, action: &Value) -> Value {
        let id = action["id"].as_str().expect("an id");
        let answer = self.get(&format!("/api/v1/actions/{id}?wait_s=60"));
        answer.json()["action"].clone()
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
    let name = match kind {
        DeviceKind::Rig => "rig",
        DeviceKind::Capsule => "capsule",
    };
    state["machines"][name]["contact"]
        .as_str()
        .unwrap_or("lost")
}

fn rig_state(state: &Value) -> &str {
    state["machines"]["rig"]["state"].as_str().unwrap_or("-")
}

const MOTIONS: [&str; 7] = [
    "Home",
    "Run",
    "MoveTo",
    "Jog",
    "Hold",
    "Resume",
    "Acknowledge",
];

fn moved(bench: &Bench) -> usize {
    MOTIONS.iter().map(|name| bench.count(name)).sum()
}

#[test]
fn a_cross_site_page_a_rebound_name_and_a_missing_token_move_nothing() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let bearer = format!("Bearer {}", server.token);
    let token = ("Authorization", &*bearer);
    let wrong = ("Authorization", "Bearer 00000000000000000000000000000000");
    let rebound = ("Host", "evil.example");
    let cross = ("Origin", "https://evil.example");
    let notebook = ("Origin", "http://localhost:8888");
    let fetched = ("Sec-Fetch-Site", "cross-site");
    let commands = [
        "rig/home",
        "rig/run",
        "rig/move",
        "rig/jog",
        "rig/jog/renew",
        "rig/hold",
        "rig/resume",
        "rig/ack",
    ];
    for command in commands {
        let path = format!("/api/v1/{command}");
        for (headers, status) in [
            (&[][..], 401),
            (&[wrong], 401),
            (&[rebound, token], 403),
            (&[rebound], 403),
            (&[cross, token], 403),
            (&[notebook, token], 403),
            (&[("Origin", "null"), token], 403),
            (&[fetched, token], 403),
        ] {
            let key = server.key();
            let headers = [headers, &[("Idempotency-Key", &*key)]].concat();
            let answer = send(
                &server.at,
                &request(
                    "POST",
                    &path,
                    &headers,
                    "{\"position_mm\":1,\"direction\":\"away\"}",
                ),
            );
            assert_eq!(
                answer.status, status,
                "{command} {headers:?}: {}",
                answer.body
            );
            assert!(
                answer.message().contains("nothing was done"),
                "{}",
                answer.body
            );
        }
        // A request that a foreign page can send without a preflight.
        let plain = format!(
            "POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\nContent-Type: text/plain\r\nOrigin: https://evil.example\r\nContent-Length: 2\r\n\r\n{{}}"
        );
        assert_eq!(send(&server.at, &plain).status, 403);
        let preflight = [cross, ("Access-Control-Request-Method", "POST")];
        let answer = send(&server.at, &request("OPTIONS", &path, &preflight, ""));
        assert!(
            answer.status >= 400 && !answer.head.contains("access-control-allow"),
            "{}",
            answer.head
        );
    }
    // Nor may such requests stop the machines or read anything.
    for headers in [&[cross][..], &[rebound], &[fetched]] {
        for (method, path) in [
            ("POST", "/api/v1/estop"),
            ("GET", "/api/v1/state"),
            ("GET", "/api/v1/stream"),
        ] {
            assert_eq!(
                send(&server.at, &request(method, path, headers, "")).status,
                403
            );
        }
    }
    assert_eq!(
        send(&server.at, &request("GET", "/", &[rebound], "")).status,
        403
    );
    assert_eq!((moved(&bench), bench.urgent()), (0, vec![]));
    // A stop from this computer needs neither a token nor a sensible body.
    for body in ["", "{}", "no JSON", "{\"machine\":\"rig\"}"] {
        let answer = send(&server.at, &request("POST", "/api/v1/stop", &[], body));
        assert_eq!(answer.status, 200, "{}", answer.body);
    }
    assert!(bench.urgent().contains(&Urgent::Stop));
    // A stop forwarded from another computer does need a token.
    let passed_on = [("X-Forwarded-For", "10.0.0.9")];
    assert_eq!(
        send(&server.at, &request("POST", "/api/v1/stop", &passed_on, "")).status,
        401
    );
    let answer = send(&server.at, &request("GET", "/api/v1/state", &passed_on, ""));
    assert_eq!(answer.status, 401);
    assert!(
        answer.head.contains("www-authenticate: bearer"),
        "{}",
        answer.head
    );
}

#[test]
fn the_page_is_one_file_that_loads_nothing_and_may_not_be_framed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let page = server.get("/");
    let policy = page
        .head
        .lines()
        .find(|line| line.starts_with("content-security-policy"));
    let policy = policy.expect("a policy");
    assert!(policy.contains("default-src 'none'") && policy.contains("frame-ancestors 'none'"));
    assert!(!policy.contains("unsafe"));
    let nonce = policy
        .split("script-src 'nonce-")
        .nth(1)
        .and_then(|rest| rest.split('\'').next());
    let nonce = nonce.expect("a nonce");
    assert_eq!(page.body.matches(&format!("nonce=\"{nonce}\"")).count(), 2);
    assert!(!page.body.contains("@NONCE@") && !page.body.contains(&server.token));
    for foreign in [
        "https://", " src=", "@import", "url(", " style=", " onclick",
    ] {
        assert!(!page.body.contains(foreign), "{foreign}");
    }
    let other = server.get("/");
    assert!(!other.body.contains(nonce), "each page has its own");
    // Programs of the same user find the server by its file.
    let server_file =
        std::fs::read_to_string(bench.locks().join("serve.json")).expect("a server file");
    let server_file: Value = serde_json::from_str(&server_file).expect("JSON");
    assert_eq!(server_file["token"], server.token.as_str());
    assert_eq!(server_file["url"], format!("http://{}/", server.at));
    let locks = bench.locks();
    assert_eq!(server.interrupt(), Some(0));
    assert!(!locks.join("serve.json").exists());
}

#[test]
fn every_route_of_the_document_is_served() {
    let document: Value = serde_json::from_str(OPENAPI).expect("JSON");
    let paths = document["paths"].as_object().expect("paths");
    let routes = paths.iter().flat_map(|(path, methods)| {
        let methods = methods.as_object().expect("methods").keys();
        methods.map(move |method| (method.as_str(), path.as_str()))
    });
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    assert_eq!(server.get("/openapi.json").body, OPENAPI);
    let manual = std::fs::read_to_string("../docs/serve.md").expect("the manual");
    let state = server.state();
    for (name, _) in state["machines"]["rig"]["link"].as_object().expect("it") {
        assert!(manual.contains(name), "{name}");
    }
    for (method, path) in routes {
        if path == "/api/v1/stream" {
            continue;
        }
        // Too many connections, and a body that does not come.
        let responses = &paths[path][method]["responses"];
        let is_stop = path.ends_with("stop");
        assert_eq!(responses["503"].is_null(), is_stop, "{method} {path}");
        let reads_body = method == "post" && !is_stop;
        assert_ne!(responses["408"].is_null(), reads_body, "{method} {path}");
        let path = path.replace("{id}", "none").replace("{name}", "none");
        let bearer = format!("Bearer {}", server.token);
        let answer = send(
            &server.at,
            &request(
                &method.to_uppercase(),
                &path,
                &[("Authorization", &bearer)],
                "",
            ),
        );
        assert_ne!(answer.status, 405, "{method} {path}");
        if answer.status == 404 {
            let why = answer.message();
            assert!(
                why.contains("no such action")
                    || why.contains("no such record")
                    || why.contains("no capsule"),
                "{method} {path}: {why}"
            );
        }
        let last = path.rsplit('/').next().expect("a name");
        assert!(
            last == "none" || manual.contains(last),
            "{path} is not in docs/serve.md"
        );
    }
    assert_eq!(moved(&bench), 0);
    for (method, path, status) in [
        ("GET", "/api/v2/state", 404),
        ("POST", "/api/v1/rig/flash", 404),
        ("GET", "/api/v1/rig/home", 405),
        ("DELETE", "/api/v1/state", 405),
        ("GET", "/api/v1/actions/%FF", 400),
        ("GET", "/api/v1/records/%FF", 400),
        ("POST", "/api/v1/rig/%FF", 400),
    ] {
        let bearer = format!("Bearer {}", server.token);
        let answer = send(
            &server.at,
            &request(method, path, &[("Authorization", &bearer)], ""),
        );
        assert_eq!(answer.status, status, "{method} {path}: {}", answer.body);
        assert_eq!(answer.json()["ok"], false);
    }
}

#[test]
fn a_request_that_is_repeated_is_executed_once() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let key = server.key();
    let body = json!({ "position_mm": 3 });
    // Send all at once, as an impatient network does.
    let answers: Vec<_> = thread::scope(|scope| {
        let all: Vec<_> = (0..8)
            .map(|_| scope.spawn(|| server.post_as(&key, "/api/v1/rig/move", &body)))
            .collect();
        all.into_iter()
            .map(|one| one.join().expect("answered"))
            .collect()
    });
    let ids: BTreeSet<_> = answers
        .iter()
        .map(|answer| answer.json()["action"]["id"].to_string())
        .collect();
    assert_eq!(ids.len(), 1, "{ids:?}");
    assert_eq!(bench.count("MoveTo"), 1);
    let ended = server.end_of(&answers[0].json()["action"]);
    assert_eq!(
        (
            ended["state"].as_str(),
            ended["result"]["position_um"].as_i64()
        ),
        (Some("complete"), Some(3_000))
    );
    // The same answer must come after the end of the move.
    let again = server.post_as(&key, "/api/v1/rig/move", &body);
    assert_eq!((again.status, &again.json()["action"]), (200, &ended));
    // A key belongs to one request and must not serve another.
    assert_eq!(
        server
            .post_as(&key, "/api/v1/rig/move", &json!({ "position_mm": 4 }))
            .status,
        422
    );
    assert_eq!(
        server.post_as(&key, "/api/v1/rig/home", &json!({})).status,
        422
    );
    // Without a key, or with one from before a restart, nothing is executed.
    for bad in [
        "",
        "x",
        "0123456789ab-1",
        &format!("{}-", server.instance),
        &format!("{}-a b", server.instance),
    ] {
        let answer = server.post_as(bad, "/api/v1/rig/move", &json!({ "position_mm": 5 }));
        assert_eq!(answer.status, 428, "{bad}: {}", answer.body);
    }
    assert_eq!(bench.count("MoveTo"), 1);
}

#[test]
fn bad_input_is_refused_with_the_texts_of_the_command_line() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    for (path, body, status, text) in [
        (
            "rig/run",
            json!({ "stroke_mm": -1 }),
            400,
            "negative: use a number of at least 0",
        ),
        ("rig/run", json!({ "cycles": 0 }), 400, "use 1 to 10000"),
        (
            "rig/run",
            json!({ "duration_s": 1 }),
            409,
            "too little time",
        ),
        ("rig/run", json!({ "colour": 1 }), 400, "no field `colour`"),
        (
            "rig/run",
            json!({ "duration_s": 40, "preset": "paper" }),
            400,
            "cannot be used with",
        ),
        (
            "rig/move",
            json!({ "position_mm": 130.5 }),
            409,
            "the position is 130.5 mm, allowed is 0 to 130 mm",
        ),
        ("rig/move", json!({}), 400, "required arguments"),
        (
            "rig/hold",
            json!({}),
            409,
            "no run is moving that could be held",
        ),
        ("rig/ack", json!({}), 409, "no fault is latched"),
        ("capsule/fold", json!({}), 404, "no capsule"),
        (
            "rig/jog/renew",
            json!({ "action": "x", "n": 1 }),
            409,
            "this jog has ended",
        ),
        ("rig/jog/renew", json!({ "n": 1 }), 400, "fields `action`"),
    ] {
        let answer = server.post(&format!("/api/v1/{path}"), &body);
        assert_eq!(answer.status, status, "{path} {body}: {}", answer.body);
        // A program in Python knows a refusal by its exit code.
        let is_refusal = answer.json()["exit_code"] == 3;
        assert_eq!(is_refusal, status == 409, "{path} {body}: {}", answer.body);
        assert!(
            answer.message().contains(text),
            "{path} {body}: {}",
            answer.body
        );
    }
    let bearer = format!("Bearer {}", server.token);
    let key = server.key();
    let headers = [("Authorization", &*bearer), ("Idempotency-Key", &*key)];
    for (body, status) in [("{", 400), ("[]", 400), (&*"9".repeat(20_000), 413)] {
        let answer = send(
            &server.at,
            &request("POST", "/api/v1/rig/run", &headers, body),
        );
        assert_eq!(answer.status, status, "{}", answer.body);
    }
    let form = format!(
        "POST /api/v1/rig/home HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nAuthorization: {bearer}\r\nContent-Length: 3\r\n\r\na=b"
    );
    assert_eq!(send(&server.at, &form).status, 415);
    assert_eq!(
        bench.count("Run") + bench.count("Home") + bench.count("Jog"),
        0
    );
    let plan = server.post("/api/v1/plan", &json!({})).json();
    assert_eq!(plan["plan"]["achieved"]["edges"], 1_040_000);
}

/// An order that waited in a dead link says when it was given.
#[test]
fn a_late_order_moves_nothing() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let bearer = format!("Bearer {}", server.token);
    let now_ms = || {
        let since = std::time::UNIX_EPOCH.elapsed().expect("after 1970");
        since.as_millis()
    };
    let order = |key: &str, sent: &str| {
        let headers = [
            ("Authorization", &*bearer),
            ("Idempotency-Key", key),
            ("Retrograde-Sent", sent),
        ];
        let body = "{\"position_mm\":3}";
        send(
            &server.at,
            &request("POST", "/api/v1/rig/move", &headers, body),
        )
    };
    let late = (now_ms() - 6_000).to_string();
    for sent in [&*late, "yesterday", ""] {
        let answer = order(&server.key(), sent);
        assert_eq!(answer.status, 409, "{sent}: {}", answer.body);
        assert!(answer.message().contains("late"), "{}", answer.body);
    }
    assert_eq!(moved(&bench), 0);
    let key = server.key();
    let answer = order(&key, &now_ms().to_string());
    assert!(answer.status < 300, "{}", answer.body);
    let ended = server.end_of(&answer.json()["action"]);
    // A repetition comes late, and is told what has become of the order.
    assert_eq!(order(&key, &late).json()["action"], ended);
    assert_eq!(bench.count("MoveTo"), 1);
}

/// The page has to show the second one, and a program that has seen the end must not see the notice before.
#[test]
fn a_second_notice_with_the_same_words_has_another_number() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let numbers: Vec<_> = (0..2)
        .map(|_| {
            server.done("/api/v1/rig/home", &json!({}));
            let notice = server.state()["machines"]["rig"]["notice"].clone();
            assert_eq!(notice["text"], "home: done");
            notice["number"].as_u64().expect("a number")
        })
        .collect();
    assert!(numbers[0] < numbers[1], "{numbers:?}");
}

/// A page that is opened later read that something moves, and no stop ended it.
#[test]
fn a_page_that_opens_at_rest_is_not_told_that_something_moves() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let place = bench.address.trim_start_matches("tcp:");
    let link = Tcp::open_within(place, SOON).expect("a line");
    let mut rig = Device::connect(Box::new(link), DeviceKind::Rig, 1).expect("a rig");
    let to = MoveTo {
        position_um: 40_000,
        speed_um_s: 10_000,
    };
    rig.call(to).expect("accepted");
    drop(rig);
    let server = Server::start(&bench);
    let notice = |state: &Value| state["machines"]["rig"]["notice"].clone();
    let moving = server.until("the warning", |state| notice(state) != Value::Null);
    let text = notice(&moving)["text"].clone();
    let text = text.as_str().expect("a text");
    assert!(text.starts_with("SOMETHING MOVES"), "{text}");
    assert_eq!(rig_state(&moving), "moving");
    // The first state that shows the machine at rest has it no more.
    let rest = server.until("rest", |state| rig_state(state) == "ready");
    assert_eq!(notice(&rest), Value::Null, "{rest:#}");
    // Nor has one while a motion of this server's own is under way.
    let begun = server.post(
        "/api/v1/rig/move",
        &json!({ "position_mm": 60, "speed_mm_s": 10 }),
    );
    assert!(begun.status < 300, "{}", begun.body);
    let state = server.until("a motion", |state| rig_state(state) == "moving");
    assert_eq!(notice(&state), Value::Null, "{state:#}");
    server.end_of(&begun.json()["action"]);
}

/// Regression: it was told anew four times a second, and took the place of every other message.
#[test]
fn a_held_run_of_a_process_that_was_killed_is_told_once() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&["--cycles", "1", "--stroke-mm", "130", "--duration-s", "600"]);
    bench.wait_for("Run");
    let (code, _, err) = bench.retrograde(&["hold"]);
    assert_eq!(code, Some(0), "{err}");
    run.kill().expect("killed");
    run.wait().expect("ends");
    let server = Server::start(&bench);
    let notice = |state: &Value| state["machines"]["rig"]["notice"].clone();
    let is_told = |state: &Value| {
        let notice = notice(state);
        notice["text"]
            .as_str()
            .is_some_and(|text| text.contains("is not over"))
    };
    let number = |state: &Value| notice(state)["number"].as_u64().expect("a number");
    let told = number(&server.until("the held run", is_told));
    thread::sleep(Duration::from_secs(1));
    // A computer that stood still has lost the line, and tells it once more.
    assert!(number(&server.state()) <= told + 1);
}

/// The paper's run, much shortened.
fn short_run() -> Value {
    json!({ "cycles": 1, "stroke_mm": 20, "duration_s": 6, "note": "short" })
}

#[test]
fn a_run_is_held_resumed_recorded_and_followed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let mut stream = Events::open(&server.at);
    let begun = server.post("/api/v1/rig/run", &short_run());
    assert_eq!(begun.status, 202, "{}", begun.body);
    let action = begun.json()["action"].clone();
    assert_eq!(action["accepted"]["edges"], 32_000);
    // Another motion is refused with the reason.
    let busy = server.post("/api/v1/rig/home", &json!({}));
    assert_eq!(busy.status, 409);
    assert!(
        busy.message()
            .contains("the rig is busy: `run` is under way"),
        "{}",
        busy.body
    );
    let held = server.done("/api/v1/rig/hold", &json!({}));
    assert_eq!(held["state"], "complete");
    assert!(held["result"]["position_um"].as_i64() > Some(0), "{held}");
    assert_eq!(
        rig_state(&server.until("a hold", |state| rig_state(state) == "held")),
        "held"
    );
    assert_eq!(server.post("/api/v1/rig/hold", &json!({})).status, 409);
    // Other commands of the same user work beside the server.
    let (code, out, err) = bench.retrograde(&["info", "rig"]);
    assert_eq!((code, out.contains("Held")), (Some(0), true), "{out}{err}");
    let (code, _, err) = bench.retrograde(&["home"]);
    assert_eq!(code, Some(3), "{err}");
    assert!(err.contains("serve"), "{err}");
    assert!(server.get("/api/v1/rig/health").json()["health"]["underruns"].is_u64());
    // Lists only the rig's settings.
    let settings = server.get("/api/v1/rig/settings").json();
    let names: Vec<_> = settings["settings"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|one| one["name"].clone())
        .collect();
    assert!(
        names.contains(&"stroke_um".into()) && !names.contains(&"end_force_ma".into()),
        "{settings}"
    );
    let resumed = server.done("/api/v1/rig/resume", &json!({}));
    assert_eq!(resumed["state"], "complete", "{resumed}");
    let ended = server.end_of(&action);
    assert_eq!(ended["state"], "complete", "{ended}");
    assert_eq!(ended["result"]["counted_edges"], 32_000);
    assert_eq!(ended["result"]["holds"], 1);
    let csv = ended["files"]["csv"].as_str().expect("a record");
    let listed = server.get("/api/v1/records").json();
    assert_eq!(listed["records"][0]["csv"], csv);
    assert_eq!(listed["records"][0]["note"], "short");
    let record = server.get(&format!("/api/v1/records/{csv}"));
    assert!(
        record.body.contains("time_us,state,position_mm"),
        "{}",
        record.head
    );
    let (rows, missed) = bench.telemetry();
    assert_eq!(missed, 0);
    // The stream has reported the same, each sample once and in order.
    let told = stream.until(|event, data| {
        event == "action" && data["id"] == ended["id"] && data["state"] == "complete"
    });
    let samples: usize = told
        .iter()
        .filter(|(event, _)| event == "rig")
        .map(|(_, data)| data["samples"].as_array().map_or(0, Vec::len))
        .sum();
    assert!(samples >= rows, "{samples} of {rows}");
    let mut next = None;
    for (_, data) in told.iter().filter(|(event, _)| event == "rig") {
        let first = data["first"].as_u64().expect("a number");
        assert!(next.is_none_or(|next| next == first));
        next = Some(first + data["samples"].as_array().expect("samples").len() as u64);
    }
    assert!(told.iter().any(|(event, data)| {
        event == "event"
            && data["text"]
                .as_str()
                .is_some_and(|text| text.contains("held"))
    }));
    assert!(told.iter().all(|(event, _)| event != "lost"));
}

/// The position was that of the last sample, which may be a second old.
#[test]
fn a_hold_says_where_its_step_is() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let mut run = short_run();
    run["telemetry_ms"] = json!(1_000);
    assert_eq!(server.post("/api/v1/rig/run", &run).status, 202);
    thread::sleep(Duration::from_millis(600));
    let held = server.done("/api/v1/rig/hold", &json!({}));
    let result = &held["result"];
    let steps = result["position_steps"].as_i64().expect("a number");
    // 800 steps for each mm.
    let position_um = (steps * 1_250 + 500) / 1_000;
    assert!(steps > 0, "{held}");
    assert_eq!(result["position_um"], position_um, "{held}");
    let resumed = server.done("/api/v1/rig/resume", &json!({}));
    assert_eq!(resumed["state"], "complete", "{resumed}");
}

/// As `nc -N` or a button on a microcontroller does.
#[test]
fn a_stop_counts_whose_sender_closes_the_connection_at_once() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let ways = [
        ("stop", "", Shutdown::Write, Urgent::Stop),
        (
            "stop",
            r#"{"machine":"rig"}"#,
            Shutdown::Write,
            Urgent::Stop,
        ),
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
fn a_browser_that_goes_away_stops_nothing_and_a_stop_ends_a_run() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let stream = Events::open(&server.at);
    let bearer = format!("Bearer {}", server.token);
    let key = server.key();
    let headers = [("Authorization", &*bearer), ("Idempotency-Key", &*key)];
    let mut browser = TcpStream::connect(&server.at).expect("a server");
    browser
        .write_all(
            request(
                "POST",
                "/api/v1/rig/run",
                &headers,
                &short_run().to_string(),
            )
            .as_bytes(),
        )
        .expect("sent");
    bench.wait_for("Run");
    browser.shutdown(Shutdown::Both).expect("gone");
    drop((browser, stream));
    server.until("motion", |state| {
        state["machines"]["rig"]["position_um"].as_i64() > Some(2_000)
    });
    assert_eq!(bench.urgent(), []);
    // The answer stays available to a repeated request.
    let again = server.post_as(&key, "/api/v1/rig/run", &short_run());
    assert_eq!(again.status, 202, "{}", again.body);
    assert_eq!(bench.count("Run"), 1);
    let stopped = send(&server.at, &request("POST", "/api/v1/stop", &[], ""));
    assert_eq!(
        (stopped.status, &stopped.json()["machines"][0]["outcome"]),
        (200, &json!("stopped"))
    );
    let ended = server.end_of(&again.json()["action"]);
    assert_eq!(ended["state"], "stopped", "{ended}");
    assert!(
        ended["error"]["message"]
            .as_str()
            .expect("why")
            .contains("stopped on request")
    );
    assert_eq!(rig_state(&server.state()), "ready");
    assert_eq!(bench.count("Run"), 1);
}

#[test]
fn an_emergency_stop_works_in_every_state_and_is_latched_until_acknowledged() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let estop = || send(&server.at, &request("POST", "/api/v1/estop", &[], ""));
    let acknowledge = || {
        server.until("a fault", |state| rig_state(state) == "faulted");
        assert_eq!(server.post("/api/v1/rig/home", &json!({})).status, 409);
        assert_eq!(
            server.done("/api/v1/rig/ack", &json!({}))["state"],
            "complete"
        );
        assert_eq!(
            server.done("/api/v1/rig/home", &json!({}))["state"],
            "complete"
        );
    };
    // Emergency stop at rest.
    assert_eq!(estop().status, 200);
    acknowledge();
    // Emergency stop while the rig homes, moves, jogs, runs and is held.
    for (path, body) in [
        ("rig/move", json!({ "position_mm": 100 })),
        ("rig/jog", json!({ "direction": "away" })),
        ("rig/home", json!({})),
        ("rig/run", short_run()),
        ("rig/run hold", short_run()),
    ] {
        let (path, hold) = path
            .split_once(' ')
            .map_or((path, false), |(path, _)| (path, true));
        let begun = server.post(&format!("/api/v1/{path}"), &body);
        assert_eq!(begun.status, 202, "{path}: {}", begun.body);
        if hold {
            server.done("/api/v1/rig/hold", &json!({}));
        }
        assert_eq!(estop().status, 200);
        let ended = server.end_of(&begun.json()["action"]);
        assert!(
            matches!(ended["state"].as_str(), Some("faulted" | "stopped")),
            "{path}: {ended}"
        );
        if path == "rig/run" {
            // Homing is refused until then.
            let help = ended["error"]["help"].as_str().unwrap_or_default();
            let way_on = "once the cause is gone acknowledge it, then home";
            assert!(help.ends_with(way_on), "{ended}");
        }
        acknowledge();
    }
    // Many at once are all confirmed.
    let all: Vec<_> = thread::scope(|scope| {
        let all: Vec<_> = (0..40).map(|_| scope.spawn(estop)).collect();
        all.into_iter()
            .map(|one| one.join().expect("answered").status)
            .collect()
    });
    assert!(all.iter().all(|status| *status == 200), "{all:?}");
    acknowledge();
}

#[test]
fn a_jog_lives_on_renewals_alone() {
    let mut script = crate::support::bench::ready(DeviceKind::Rig);
    // A busy computer may delay a browser or a server by half a second.
    script.settings.push((SettingKey::DeadManMs, 1_800));
    let bench = Bench::on_tcp_as(&script, 1);
    let server = Server::start(&bench);
    let begun = server.post(
        "/api/v1/rig/jog",
        &json!({ "direction": "away", "speed_mm_s": 10 }),
    );
    assert_eq!(begun.status, 202, "{}", begun.body);
    let action = begun.json()["action"].clone();
    assert_eq!(action["accepted"]["renew_within_ms"], 1_500);
    let renew = |n: u64| {
        server
            .post(
                "/api/v1/rig/jog/renew",
                &json!({ "action": action["id"], "n": n }),
            )
            .status
    };
    let begin = Instant::now();
    let mut n = 0;
    let at_um = || {
        let state = server.state();
        let at_um = &state["machines"]["rig"]["position_um"];
        at_um.as_i64().expect("a place")
    };
    // Without renewals it would end at 18 mm. By its place, because a busy computer slows the rig's clock.
    while at_um() < 21_000 {
        n += 1;
        assert_eq!(renew(n), 200);
        assert!(begin.elapsed() < Duration::from_secs(60), "it stands");
        thread::sleep(Duration::from_millis(40));
    }
    assert_eq!(rig_state(&server.state()), "moving");
    // Each renewal reaches the rig at most once, and nothing else does.
    let passed_on = bench.count("Jog");
    assert!(
        passed_on > 5 && passed_on <= n as usize + 1,
        "{passed_on} of {n}"
    );
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
        renew(n);
        assert!(last.elapsed() < Duration::from_secs(4), "it goes on");
        thread::sleep(Duration::from_millis(20));
    }
    let ended = server.end_of(&action);
    assert_eq!(ended["state"], "complete", "{ended}");
    // A late renewal does not start the jog again.
    let jogs = bench.count("Jog");
    for late in 1..4 {
        assert_eq!(renew(n + late), 409);
    }
    thread::sleep(Duration::from_millis(1_900));
    assert_eq!(bench.count("Jog"), jogs);
    assert_eq!(rig_state(&server.state()), "ready");
    assert!((21_000..60_000).contains(&at_um()), "{}", at_um());
    // A stop ends a jog at once, renewed or not.
    let begun = server
        .post("/api/v1/rig/jog", &json!({ "direction": "home" }))
        .json();
    let stopped = send(&server.at, &request("POST", "/api/v1/stop", &[], ""));
    assert_eq!(stopped.status, 200);
    server.end_of(&begun["action"]);
    let late = server.post(
        "/api/v1/rig/jog/renew",
        &json!({ "action": begun["action"]["id"], "n": 1 }),
    );
    assert_eq!(late.status, 409);
}

#[test]
fn a_jog_ends_when_the_server_is_killed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut server = Server::start(&bench);
    let begun = server.post(
        "/api/v1/rig/jog",
        &json!({ "direction": "away", "speed_mm_s": 10 }),
    );
    assert_eq!(begun.status, 202, "{}", begun.body);
    server.process.0.kill().expect("mine");
    server.process.0.wait().expect("mine");
    // Wait for the rig's own dead-man time, 0.3 s, and the braking.
    thread::sleep(Duration::from_secs(1));
    let log = bench.log.lock().expect("log");
    let on_us = log.driven_us.saturating_sub(log.heard_us);
    drop(log);
    assert!(
        on_us < 700_000,
        "driven for {on_us} us after the last frame"
    );
    let (_, out, _) = bench.retrograde(&["info", "rig"]);
    assert!(out.contains("Ready"), "{out}");
}

#[test]
fn it_gives_the_line_to_a_command_that_moves_and_shows_it() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let server = Server::start(&bench);
    let mut run = bench.run(&["--cycles", "1", "--stroke-mm", "20", "--duration-s", "6"]);
    let state = server.until("a window", |state| {
        contact(state, DeviceKind::Rig) == "window"
    });
    let text = state["machines"]["rig"]["contact_text"]
        .as_str()
        .expect("a text");
    assert!(text.contains("retrograde run"), "{text}");
    server.until("the run", |state| {
        state["machines"]["rig"]["run"]["stroke"].is_u64()
    });
    // Only the owner may start motions. Hold, resume and stop are open to others.
    let refused = server.post("/api/v1/rig/home", &json!({}));
    assert_eq!(refused.status, 409);
    assert!(
        refused.message().contains("belongs to process"),
        "{}",
        refused.body
    );
    assert_eq!(
        server.done("/api/v1/rig/hold", &json!({}))["state"],
        "complete"
    );
    assert_eq!(
        server.done("/api/v1/rig/resume", &json!({}))["state"],
        "complete"
    );
    assert_eq!(
        send(&server.at, &request("POST", "/api/v1/stop", &[], "")).status,
        200
    );
    assert_eq!(run.wait().expect("ended").code(), Some(130));
    server.until("the line", |state| {
        contact(state, DeviceKind::Rig) == "owned"
    });
    assert_eq!(
        server.done("/api/v1/rig/home", &json!({}))["state"],
        "complete"
    );
    // A stop from another process ends this server's motion.
    let begun = server.post("/api/v1/rig/run", &short_run()).json();
    assert_eq!(bench.retrograde(&["stop"]).0, Some(0));
    assert_eq!(server.end_of(&begun["action"])["state"], "stopped");
    // Ctrl-C ends it, too, before the server ends.
    assert_eq!(
        server.done("/api/v1/rig/home", &json!({}))["state"],
        "complete"
    );
    assert_eq!(server.post("/api/v1/rig/run", &short_run()).status, 202);
    assert_eq!(server.interrupt(), Some(0));
    let (_, out, _) = bench.retrograde(&["info", "rig"]);
    assert!(out.contains("Ready"), "{out}");
}

#[test]
fn the_capsule_is_folded_once_and_says_when_it_was_so_already() {
    let bench = Bench::on_tcp(DeviceKind::Capsule);
    let server = Server::start(&bench);
    let folded = server.done("/api/v1/capsule/fold", &json!({ "note": "first" }));
    assert_eq!(folded["state"], "complete", "{folded}");
    assert!(
        folded["result"]["thread_um"].as_i64() > Some(1_000),
        "{folded}"
    );
    let again = server.post("/api/v1/capsule/fold", &json!({}));
    assert_eq!(
        (again.status, &again.json()["action"]["result"]["already"]),
        (200, &json!(true))
    );
    assert_eq!(bench.count("Fold"), 1);
    assert_eq!(
        server.done("/api/v1/capsule/unfold", &json!({}))["state"],
        "complete"
    );
    let partly = server.done("/api/v1/capsule/fold", &json!({ "thread_mm": 12.5 }));
    let thread_um = partly["result"]["thread_um"].as_i64().expect("a length");
    assert!((thread_um - 12_500).abs() < 150, "{partly}");
    assert_eq!(partly["requested"], json!({ "thread_um": 12_500 }));
    assert_eq!((bench.count("Fold"), bench.count("FoldTo")), (1, 1));
    for (body, why) in [
        (json!({ "thread_mm": -1 }), "negative"),
        (
            json!({ "thread_mm": 5, "indentation_mm": 2 }),
            "cannot be used",
        ),
        (json!({ "indentation_mm": 1_000 }), "indentation"),
    ] {
        let refused = server.post("/api/v1/capsule/fold", &body);
        assert_eq!(refused.status, 400, "{body}");
        let said = refused.json().to_string();
        assert!(said.contains(why), "{said}");
    }
    assert_eq!(bench.count("FoldTo"), 1);
    assert_eq!(
        server.done("/api/v1/capsule/unfold", &json!({}))["state"],
        "complete"
    );
    let settings = server.get("/api/v1/capsule/settings").json();
    let names = settings["settings"].as_array().expect("a list").iter();
    let names: Vec<_> = names.map(|setting| setting["name"].clone()).collect();
    assert!(names.contains(&json!("end_force_ma")) && !names.contains(&json!("lead_um")));
    let state = server.state();
    assert_eq!(state["machines"]["capsule"]["state"], "unfolded");
    assert!(state["machines"]["rig"].is_null());
}

/// The page shows the campaign of `--campaign`, and says why it cannot be read if its ledger is damaged.
#[test]
fn the_state_of_a_campaign_is_shown_until_it_cannot_be_read() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let folder = bench.folder.path().join("shown");
    let folder = folder.to_str().expect("UTF-8");
    let plan = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/paper.toml");
    bench.retrograde(&["campaign", "new", plan, "--out", folder]);
    let server = Server::start_with(&bench, &["--campaign", folder]);
    let state = server.until("a campaign", |state| state["campaign"]["name"] == "paper");
    let shown = &state["campaign"];
    assert_eq!(shown["done"], 0);
    assert!(shown["trials"].as_u64() > Some(0), "{shown}");
    let next = shown["next"].as_str().expect("a step");
    assert!(next.starts_with("trial 1: "), "{next}");
    assert!(shown["left_text"].is_string(), "{shown}");
    std::fs::write(format!("{folder}/trials.csv"), "damaged").expect("written");
    let state = server.until("an error", |state| !state["campaign"]["error"].is_null());
    assert_eq!(state["campaign"]["folder"], folder);
    assert_eq!(
        state["campaign"].as_object().map(serde_json::Map::len),
        Some(2)
    );
}

#[test]
fn an_address_that_is_taken_and_a_bad_token_file_are_said() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let at = taken.local_addr().expect("bound").to_string();
    let (code, _, err) = bench.retrograde(&["serve", "--listen", &at]);
    assert_eq!(code, Some(2), "{err}");
    assert!(
        err.contains("cannot listen at") && err.contains("port 0 takes a free one"),
        "{err}"
    );
    let file = bench.folder.path().join("token");
    std::fs::write(&file, "short").expect("written");
    let serve = ["serve", "--listen", "127.0.0.1:0", "--token-file", "token"];
    let open_to = |mode| {
        let mode = std::os::unix::fs::PermissionsExt::from_mode(mode);
        std::fs::set_permissions(&file, mode).expect("mine");
        bench.retrograde(&serve)
    };
    let (code, _, err) = open_to(0o644);
    assert_eq!(code, Some(2), "{err}");
    assert!(
        err.contains("other users can read or change this file"),
        "{err}"
    );
    let (code, _, err) = open_to(0o600);
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("at least 16 letters and digits"), "{err}");
    std::fs::write(&file, "0123456789abcdefghij\n").expect("written");
    let server = Server::start_with(&bench, &["--token-file", "token"]);
    assert_eq!(server.token, "0123456789abcdefghij");
}

/// A reader of the event stream.
struct Events {
    from: BufReader<TcpStream>,
}

impl Events {
    fn open(at: &str) -> Self {
        let mut stream = TcpStream::connect(at).expect("a server");
        stream.set_read_timeout(Some(SOON)).expect("set");
        stream
            .write_all(b"GET /api/v1/stream HTTP/1.1\r\nHost: localhost\r\n\r\n")
            .expect("sent");
        Self {
            from: BufReader::new(stream),
        }
    }

    /// Reads all events up to this one.
    fn until(&mut self, is: impl Fn(&str, &Value) -> bool) -> Vec<(String, Value)> {
        let (mut all, mut event) = (vec![], String::new());
        loop {
            let mut line = String::new();
            assert_ne!(
                self.from.read_line(&mut line).expect("more"),
                0,
                "the stream ended"
            );
            if let Some(name) = line.strip_prefix("event: ") {
                name.trim().clone_into(&mut event);
            } else if let Some(data) = line.strip_prefix("data: ") {
                let data = serde_json::from_str(data).expect("JSON");
                let last = is(&event, &data);
                all.push((event.clone(), data));
                if last {
                    return all;
                }
            }
        }
    }
}
