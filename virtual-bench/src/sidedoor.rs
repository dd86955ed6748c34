//! The side door at the image, in real time: a run in one process, stops from another, over a pseudo-terminal.

use std::fs::{File, Permissions};
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use host_tool::link::Link;
use rustix::fs::{OFlags, fcntl_setfl};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

use crate::bench::{Bench, BenchError};
use crate::boards::rig::{self, RigBoard};
use crate::link::VirtualLink;
use crate::plants::rig::RigOptions;

/// Emergency stops unless told.
pub const STOPS: u32 = 50;
/// From the start of the process that stops to the pin.
const LIMIT: Duration = Duration::from_millis(50);
/// Interval between two exchanges with the terminal, and two looks at the pin.
const TURN_US: u64 = 1_000;
/// Everything that is waited for has happened by then.
const SOON: Duration = Duration::from_secs(120);

/// Why it could not be measured, or what is not as it has to be.
#[derive(Debug, thiserror::Error, miette::Diagnostic)]
pub enum DoorError {
    /// The bench.
    #[error(transparent)]
    #[diagnostic(code(bench::failed))]
    Bench(#[from] BenchError),
    /// A terminal, a process or a file.
    #[error(transparent)]
    #[diagnostic(code(bench::system))]
    System(#[from] std::io::Error),
    /// A terminal.
    #[error(transparent)]
    #[diagnostic(code(bench::system))]
    Terminal(#[from] rustix::io::Errno),
    /// Not as it has to be.
    #[error("{0}")]
    #[diagnostic(code(bench::door))]
    Wrong(String),
}

/// What is seen of the rig.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    /// STEP edges so far.
    edges: usize,
    /// When the last of them was seen.
    last: Option<Instant>,
}

/// A process that does not outlive this value.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A rig at the end of a terminal, in real time.
struct Rig {
    port: String,
    seen: Arc<Mutex<Seen>>,
    folder: tempfile::TempDir,
    program: PathBuf,
}

impl Rig {
    fn start() -> Result<Self, DoorError> {
        let bench = rig::start(RigOptions::WITH_BOTH_JUMPERS)?;
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let port = ptsname(&master, vec![])?.to_string_lossy().into_owned();
        fcntl_setfl(&master, OFlags::NONBLOCK)?;
        let seen = Arc::new(Mutex::new(Seen::default()));
        let shown = Arc::clone(&seen);
        // It ends with the process.
        thread::spawn(move || serve(&bench, master, &shown));
        Ok(Self {
            port,
            seen,
            folder: tempfile::Builder::new()
                .permissions(Permissions::from_mode(0o700))
                .tempdir()?,
            program: std::env::current_exe()?,
        })
    }

    fn seen(&self) -> Seen {
        *self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn spawn(&self, args: &[&str]) -> Result<Process, DoorError> {
        let child = Command::new(&self.program)
            .args(args)
            .env("RETROGRADE_RIG", &self.port)
            .env_remove("RETROGRADE_CAPSULE")
            .env("RETROGRADE_RUNTIME_DIR", self.folder.path())
            .env(
                "RETROGRADE_CONFIG",
                self.folder.path().join("machines.toml"),
            )
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        Ok(Process(child))
    }

    /// Its exit code must be `wanted`.
    fn retrograde(&self, args: &[&str], wanted: i32) -> Result<(), DoorError> {
        ends(self.spawn(args)?, args, wanted)
    }

    fn wait(&self, what: &str, until: impl Fn(&Seen) -> bool) -> Result<Seen, DoorError> {
        let begin = Instant::now();
        loop {
            let seen = self.seen();
            if until(&seen) {
                return Ok(seen);
            }
            if begin.elapsed() > SOON {
                return Err(DoorError::Wrong(format!("no {what} within {SOON:?}")));
            }
            thread::sleep(Duration::from_millis(1));
        }
    }
}

fn ends(mut process: Process, args: &[&str], wanted: i32) -> Result<(), DoorError> {
    let status = process.0.wait()?;
    if status.code() == Some(wanted) {
        return Ok(());
    }
    Err(DoorError::Wrong(format!(
        "`{}` ended with {status}",
        args.join(" ")
    )))
}

/// Lets the rig live in real time, for ever.
fn serve(bench: &Bench<RigBoard>, master: OwnedFd, shown: &Mutex<Seen>) -> Result<(), BenchError> {
    let ended = |why: &dyn std::fmt::Display| BenchError::Ended(why.to_string());
    let mut link = VirtualLink::new(bench, "virtual rig");
    let mut terminal = File::from(master);
    let (began, epoch_us) = (Instant::now(), link.now_us());
    let mut bytes = [0; 4_096];
    loop {
        if let Ok(count @ 1..) = terminal.read(&mut bytes) {
            link.send(&bytes[..count]).map_err(|why| ended(&why))?;
        }
        let due_us = epoch_us + began.elapsed().as_micros() as u64;
        // Late or not, the pin is looked at after each millisecond of the machine's.
        while link.now_us() < due_us {
            let turn_us = due_us.min(link.now_us() + TURN_US);
            let count = link
                .receive(&mut bytes, turn_us)
                .map_err(|why| ended(&why))?;
            // What nobody reads is lost, as at a port.
            let _ = terminal.write(&bytes[..count]);
            let edges = bench.visit(|visit| visit.board().rig.edges().len())?;
            let mut seen = shown.lock().unwrap_or_else(PoisonError::into_inner);
            if seen.edges != edges {
                seen.last = Some(Instant::now());
            }
            seen.edges = edges;
        }
        thread::sleep(Duration::from_micros(200));
    }
}

/// Emergency stops by a second process while a run is at work; prints what was measured.
///
/// # Errors
/// [`DoorError`]; a stop that came too late is one.
pub fn run(stops: u32, say: &mut dyn FnMut(String)) -> Result<(), DoorError> {
    let rig = Rig::start()?;
    // The emulator translates the image as it goes: at first it is slower than real time.
    let begin = Instant::now();
    while let Err(why) = rig.retrograde(&["info", "rig"], 0) {
        if begin.elapsed() > SOON {
            return Err(why);
        }
    }
    let mut took = vec![];
    // The first one is not counted: the emulator translates what a stop executes.
    for number in 0..=stops {
        rig.retrograde(&["home"], 0)?;
        let args = [
            "run",
            "--cycles",
            "1",
            "--stroke-mm",
            "40",
            "--duration-s",
            "8",
        ];
        let edges = rig.seen().edges;
        let run = rig.spawn(&args)?;
        // Somewhere in the first half second.
        let at = edges + 200 + (number as usize * 37) % 1_500;
        rig.wait("motion", |seen| seen.edges > at)?;
        let begin = Instant::now();
        let stop = rig.spawn(&["estop"])?;
        ends(stop, &["estop"], 0)?;
        ends(run, &args, 6)?;
        let last = rig.seen().last.unwrap_or(begin);
        if number > 0 {
            took.push(last.duration_since(begin));
        }
        rig.retrograde(&["ack"], 0)?;
    }
    took.sort();
    let (median, most) = (took.get(took.len() / 2), took.last());
    let late = took.iter().filter(|took| **took > LIMIT).count();
    if let (Some(median), Some(most)) = (median, most) {
        say(format!(
            "E-stop by a second process, from its start to the last edge of STEP: {} of {stops} within {} ms; median {:.1} ms, latest {:.1} ms",
            took.len() - late,
            LIMIT.as_millis(),
            median.as_secs_f64() * 1e3,
            most.as_secs_f64() * 1e3,
        ));
    }
    if late > 0 {
        return Err(DoorError::Wrong(format!("{late} stops came late")));
    }
    Ok(())
}
