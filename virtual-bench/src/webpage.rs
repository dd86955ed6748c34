//! Tests `retrograde serve` with the image in real time: emergency stops over HTTP, timed to the pin, and the paper's
//! run with 50 readers, some slow and some stuck.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::browser::Browser;
use crate::processes::{DoorError, Rig, judge, record, stood, wrong};
use crate::server::Server;

/// Readers of the stream during a run: fast, slow, stuck.
const READERS: [usize; 3] = [40, 5, 5];
/// Bytes that a slow reader takes at a time, and its pause between: slower than the stream.
const SLOW: (usize, Duration) = (1_024, Duration::from_millis(500));
/// Allowed growth of the server's memory during the run, KiB: the write buffers of 50 connections, and a margin.
const GROWTH_KIB: u64 = 16 * 1_024;

/// How a stop is given.
#[derive(Clone, Debug)]
pub enum By {
    /// By a program over HTTP.
    Http,
    /// By the page in this Chromium.
    Page(PathBuf),
    /// By the Python package in this interpreter.
    Python(PathBuf),
}

/// An open connection of that kind.
enum Hand {
    Http,
    /// The page in a browser, and the position of its button: pressed by mouse and by key in turn.
    Page(Box<Browser>, (f64, f64)),
    Python(Python),
}

/// When a stop began, and when its sender was told that the machine has stopped, if that is observed.
type Given = (Instant, Option<Instant>);

impl Hand {
    fn new(by: &By, rig: &Rig, server: &Server) -> Result<Self, DoorError> {
        let program = match by {
            By::Http => return Ok(Self::Http),
            By::Python(program) => return Python::start(program, rig).map(Self::Python),
            By::Page(program) => program,
        };
        let url = format!("http://{}/#token={}", server.at, server.token);
        let folder = rig.folder.path().join("browser");
        let mut browser = Browser::open(program, &folder, &url)?;
        // The page shows the rig's state, so it is connected.
        browser.wait(
            "document.readyState === 'complete' && /Ready|Unhomed/.test(document.body.innerText)",
        )?;
        looked_over(&mut browser)?;
        let button = browser.middle_of("estop")?;
        Ok(Self::Page(Box::new(browser), button))
    }

    fn stop(&mut self, number: u32, server: &Server) -> Result<Given, DoorError> {
        match self {
            Self::Http => {
                let begin = Instant::now();
                let answer = server.request("POST /api/v1/estop", "")?;
                match answer["ok"] == true {
                    true => Ok((begin, Some(Instant::now()))),
                    false => Err(wrong(format!("not stopped: {answer}"))),
                }
            }
            Self::Page(browser, button) if number.is_multiple_of(2) => {
                Ok((browser.click(*button)?, None))
            }
            Self::Page(browser, _) => Ok((browser.press('e')?, None)),
            Self::Python(python) => {
                let begin = Instant::now();
                python.does("lab.estop()")?;
                Ok((begin, Some(Instant::now())))
            }
        }
    }

    fn name(&self) -> &'static str {
        match self {
            Self::Http => "E-stop over HTTP, from before its connection to the last edge of STEP",
            Self::Page(..) => {
                "E-stop on the page, by mouse and by key, from before it is pressed to the last edge of STEP"
            }
            Self::Python(_) => {
                "E-stop from Python, from before its interpreter hears of it to the last edge of STEP"
            }
        }
    }
}

/// Checks what only a browser shows: the page offers what the rig's state allows, keeps typed text over a reload,
/// reports errors in one place that is always in sight, and shows no keys on a phone.
fn looked_over(browser: &mut Browser) -> Result<(), DoorError> {
    const BUTTONS: &str = "(() => {
        const state = document.getElementById('rig-state').textContent;
        const run = document.querySelector('[data-submits=\"rig/run\"]');
        const home = document.querySelector('[data-command=\"rig/home\"]');
        return run.disabled === (state !== 'Ready') && home.classList.contains('main') === (state === 'Unhomed');
    })()";
    browser.wait(BUTTONS)?;
    browser.wait(
        "(() => {
            const cycles = document.querySelector('[name=cycles]');
            cycles.value = '7';
            cycles.dispatchEvent(new Event('input', { bubbles: true }));
            window.before = true;
            location.reload();
            return true;
        })()",
    )?;
    browser.wait("!window.before && document.querySelector('[name=cycles]').value === '7'")?;
    // The page sends no order before it has heard the server.
    browser.wait("/Ready|Unhomed/.test(document.body.innerText)")?;
    browser.wait(
        "(() => {
            scrollTo(0, document.body.scrollHeight);
            command('rig/move', { position_mm: '-4' });
            return true;
        })()",
    )?;
    browser.wait(
        "(() => {
            const told = Array.from(document.querySelectorAll('p, li, div.small'));
            const where = told.filter((at) => at.textContent.includes('negative'));
            return where.length === 1 && where[0].id === 'said' && where[0].getBoundingClientRect().top >= 0;
        })()",
    )?;
    for (width, shown) in [(390, false), (1_200, true)] {
        browser.resize(width)?;
        browser.wait(&format!(
            "Array.from(document.querySelectorAll('kbd')).every((key) => (key.getClientRects().length > 0) === {shown})"
        ))?;
    }
    shows_what_holds(browser)?;
    insists(browser)?;
    browser.wait("/Ready|Unhomed/.test(document.body.innerText)")
}

/// Checks what the page makes of states that this rig is not in, and of keys that this computer does not have.
fn shows_what_holds(browser: &mut Browser) -> Result<(), DoorError> {
    const OFFERS: &str = "(() => {
        const rig = { contact: 'owned', state: 'ready', status: { position_steps: 0 } };
        const [run, home] = ['[data-submits=\"rig/run\"]', '[data-command=\"rig/home\"]'].map((at) => document.querySelector(at));
        showButtons('rig', rig);
        const at_home = !run.disabled && run.classList.contains('main');
        showButtons('rig', { ...rig, status: { position_steps: 800 } });
        const away = run.disabled && home.classList.contains('main');
        showButtons('rig', { ...rig, estop_loop_open: true });
        beginJog(document.querySelector('[data-jog]'));
        return at_home && away && home.disabled && jog === null;
    })()";
    const SAYS: &str = "(() => {
        const text = (id) => document.getElementById(id).textContent;
        const hidden = (id) => document.getElementById(id).hidden;
        const run = { strokes: 2, stroke: 0, elapsed_us: 0 };
        const rig = { contact: 'owned', contact_text: '', state: 'running', run, link: { silent_ms: 2600 } };
        showRig(rig);
        const silent = text('rig-state').includes('not heard') && text('rig-link').includes('not heard for 2 s');
        showRig({ ...rig, contact: 'lost', estop_loop_open: false });
        const lost = text('inputs') === '-' && text('rig-fault').includes('old') && hidden('run');
        showState({ instance, time_utc: new Date().toISOString(), machines: {}, campaign: null });
        return silent && lost && hidden('rig') && hidden('runs');
    })()";
    const HEARS: &str = "(() => {
        const kept = [stop, command];
        let heard = '';
        stop = (name) => { heard += name; };
        command = (path) => { heard += path; };
        for (const [key, code] of [['у', 'KeyE'], ['ы', 'KeyS'], ['р', 'KeyH']]) {
            dispatchEvent(new KeyboardEvent('keydown', { key, code }));
        }
        [stop, command] = kept;
        return heard === 'estopstop';
    })()";
    browser.wait(OFFERS)?;
    browser.wait(SAYS)?;
    browser.wait(HEARS)
}

/// Checks that a stop goes on while the server is not reached, in a browser of 2022.
fn insists(browser: &mut Browser) -> Result<(), DoorError> {
    browser.wait(
        "(() => {
            AbortSignal.timeout = undefined;
            window.reached = window.fetch;
            window.tries = 0;
            window.fetch = () => { window.tries += 1; return Promise.reject(new TypeError('cut off')); };
            stop('stop');
            return true;
        })()",
    )?;
    browser.wait(
        "window.tries > 7 && document.getElementById('said').textContent.includes('NOT CONFIRMED')",
    )?;
    browser.wait("(() => { window.fetch = window.reached; return true; })()")?;
    browser.wait("document.getElementById('said').textContent.includes('rig: stopped')")
}

/// An interpreter connected to the server, which executes commands line by line.
struct Python {
    child: Child,
    hears: ChildStdin,
    says: BufReader<ChildStdout>,
}

impl Drop for Python {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Python {
    fn start(program: &Path, rig: &Rig) -> Result<Self, DoorError> {
        const READS: &str =
            "import sys\nfor line in sys.stdin: exec(line); print('done', flush=True)";
        let package = concat!(env!("CARGO_MANIFEST_DIR"), "/../python/src");
        let mut child = Command::new(program)
            .args(["-c", READS])
            .env("PYTHONPATH", package)
            .env("RETROGRADE_RUNTIME_DIR", rig.folder.path())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let (Some(hears), Some(says)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(wrong("Python has no pipes"));
        };
        let says = BufReader::new(says);
        let mut python = Self { child, hears, says };
        python.does("import retrograde; lab = retrograde.connect()")?;
        Ok(python)
    }

    fn does(&mut self, line: &str) -> Result<(), DoorError> {
        writeln!(self.hears, "{line}")?;
        let mut said = String::new();
        self.says.read_line(&mut said)?;
        match said.trim() {
            "done" => Ok(()),
            // Python has printed the reason on its error output.
            said => Err(wrong(format!("Python has not done `{line}`: {said}"))),
        }
    }
}

/// Times emergency stops during a run with a crowd connected; then, over HTTP, makes a run with readers. Prints the
/// measurements.
///
/// # Errors
/// [`DoorError`], also for a stop that came too late and for a server that grows.
pub fn run(stops: u32, by: &By, say: &mut dyn FnMut(String)) -> Result<(), DoorError> {
    let rig = Rig::start()?;
    rig.warm_up()?;
    rig.be_patient()?;
    let mut server = Server::start(&rig)?;
    let mut hand = Hand::new(by, &rig, &server)?;
    let mut crowd = server.crowd();
    let mut took = vec![];
    // Do not count the first one: the emulator is still translating the code of a stop.
    for number in 0..=stops {
        let homing = server.begin("home", &json!({}))?;
        server.end(&homing, "complete")?;
        let edges = rig.seen().edges;
        let body = json!({ "cycles": 1, "stroke_mm": 40, "duration_s": 8 });
        let running = server.begin("run", &body)?;
        // Stop somewhere in the first half second.
        let at = edges + 200 + (number as usize * 37) % 1_500;
        rig.wait("motion", |seen| seen.edges > at)?;
        crowd.press(&rig)?;
        let lost_us = rig.seen().lost_us;
        let (begin, told) = hand.stop(number, &server)?;
        server.end(&running, "faulted")?;
        let seen = rig.seen();
        let last = seen.last.unwrap_or(begin);
        stood(told.unwrap_or(last), last)?;
        if number > 0 {
            took.push((last.duration_since(begin), seen.lost_us - lost_us));
        }
        server.begin("ack", &json!({}))?;
    }
    let late = judge(
        &format!("{}, {}", hand.name(), crowd.described()),
        took,
        say,
    );
    drop(crowd);
    if !matches!(by, By::Http) {
        return late;
    }
    say(readers(&rig, &mut server)?);
    late
}

/// Data that a reader received.
#[derive(Default)]
struct Got {
    samples: u64,
    lost: u64,
}

/// The paper's run with 50 readers.
fn readers(rig: &Rig, server: &mut Server) -> Result<String, DoorError> {
    let homing = server.begin("home", &json!({}))?;
    server.end(&homing, "complete")?;
    let data = rig.folder.path().join("retrograde-data");
    // Delete the data of the stops.
    std::fs::remove_dir_all(&data)?;
    let resident = server.resident_kib();
    let before = rig.seen();
    let (mut reading, mut stuck) = (vec![], vec![]);
    let over = Arc::new(AtomicBool::new(false));
    for (kind, count) in READERS.into_iter().enumerate() {
        for _ in 0..count {
            let mut stream = TcpStream::connect(&server.at)?;
            let head = format!("GET /api/v1/stream HTTP/1.1\r\nHost: {}\r\n\r\n", server.at);
            stream.write_all(head.as_bytes())?;
            match kind {
                0 => reading.push((0, thread::spawn(move || read(stream)))),
                1 => {
                    let slow = Slow(stream, Arc::clone(&over));
                    reading.push((1, thread::spawn(move || read(slow))));
                }
                _ => stuck.push(stream),
            }
        }
    }
    let running = server.begin("run", &json!({}))?;
    let mut most = resident;
    let id = running["id"].clone();
    loop {
        let action = &server.get("/api/v1/state")?["machines"]["rig"]["action"];
        most = most.max(server.resident_kib());
        if action["id"] == id && action["state"] != "under_way" {
            break;
        }
        thread::sleep(Duration::from_millis(250));
    }
    server.end(&running, "complete")?;
    let (counted, missed) = counts(&data)?;
    let after = rig.seen();
    let driven = after.edges - before.edges;
    let lost_ms = (after.lost_us - before.lost_us) / 1_000;
    over.store(true, Ordering::Relaxed);
    // Give slow readers time to get the rest, and the report of their losses.
    thread::sleep(Duration::from_secs(3));
    // The streams end when the server does.
    let _ = server.process.child.kill();
    drop(stuck);
    let mut got = [(u64::MAX, 0), (u64::MAX, 0)];
    let mut all = vec![];
    for (kind, reader) in reading {
        let Ok(Got { samples, lost }) = reader.join() else {
            return Err(wrong("a reader failed"));
        };
        all.push(samples + lost);
        let (least, most) = &mut got[kind];
        *least = samples.min(*least);
        *most = lost.max(*most);
    }
    let [(fast, fast_lost), (slow, slow_lost)] = got;
    let growth = most.saturating_sub(resident);
    let text = format!(
        "the paper's run with {} readers that read, {} slow ones and {} that do not: {driven} edges at the pin, {counted} counted, {missed} samples missed in the record; each that reads got {fast} samples or more and lost {fast_lost} at most, a slow one got {slow} and was told of {slow_lost} lost; the server took {:.1} MiB before and {:.1} MiB at most; the emulator was {lost_ms} ms slower than time",
        READERS[0],
        READERS[1],
        READERS[2],
        resident as f64 / 1_024.0,
        most as f64 / 1_024.0,
    );
    // Samples received plus losses reported must be the same for each reader, but for one portion at the very end.
    let spread = all.iter().max().zip(all.iter().min());
    let told = spread.is_some_and(|(most, least)| most - least < 40);
    let exact = (driven, counted, missed) == (1_040_000, 1_040_000, 0);
    if exact && told && fast_lost == 0 && slow_lost > 0 && growth < GROWTH_KIB {
        Ok(text)
    } else {
        Err(wrong(text))
    }
}

/// Edges and missed samples of the only run; its record is closed shortly after the run's end.
fn counts(folder: &Path) -> Result<(u64, u64), DoorError> {
    let begin = Instant::now();
    loop {
        match record(folder) {
            Ok(counts) => return Ok(counts),
            Err(why) if begin.elapsed() > Duration::from_secs(5) => return Err(why),
            Err(_) => thread::sleep(Duration::from_millis(50)),
        }
    }
}

/// A slow reader: reads slower than the stream until the run is over.
struct Slow(TcpStream, Arc<AtomicBool>);

impl Read for Slow {
    fn read(&mut self, into: &mut [u8]) -> std::io::Result<usize> {
        if self.1.load(Ordering::Relaxed) {
            return self.0.read(into);
        }
        thread::sleep(SLOW.1);
        let most = into.len().min(SLOW.0);
        self.0.read(&mut into[..most])
    }
}

/// Reads a stream to its end.
fn read(from: impl Read) -> Got {
    let mut got = Got::default();
    let mut event = String::new();
    for line in BufReader::new(from).lines().map_while(Result::ok) {
        if let Some(name) = line.strip_prefix("event: ") {
            name.clone_into(&mut event);
        } else if let Some(data) = line.strip_prefix("data: ") {
            let Ok(data) = serde_json::from_str::<Value>(data) else {
                continue;
            };
            match event.as_str() {
                "rig" => {
                    got.samples += data["samples"].as_array().map_or(0, |all| all.len() as u64)
                }
                "lost" => got.lost += data["rig_samples"].as_u64().unwrap_or(0),
                _ => {}
            }
        }
    }
    got
}
