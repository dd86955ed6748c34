//! A rig's image in real time behind a pseudo-terminal, the tool's processes at it, and judgements of their stops.

use std::fs::{File, Permissions};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use client::door::lock::Doorway;
use rustix::fs::{OFlags, fcntl_setfl};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use serde_json::Value;

use crate::bench::{BenchError, Ear, Outside};
use crate::boards::rig::{self, RigBoard};
use crate::pace::Slow;
use crate::plants::rig::RigOptions;

/// Time limit from the start of the stopping process to the pin.
const LIMIT: Duration = Duration::from_millis(50);
/// Time for which the rig goes on without its host.
const LINK_TIMEOUT_MS: &str = "10000";
/// Delay from an edge to the emulator's turn that shows it.
const TURN: Duration = Duration::from_millis(5);
/// Time limit for everything that is waited for.
pub(crate) const SOON: Duration = Duration::from_secs(120);

/// Why the measurement failed, or which result is wrong.
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
    /// A result is wrong.
    #[error("{0}")]
    #[diagnostic(code(bench::door))]
    Wrong(String),
}

/// Observations of the rig.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Seen {
    /// STEP edges so far.
    pub(crate) edges: usize,
    /// When the last of them was seen.
    pub(crate) last: Option<Instant>,
    /// When the last byte for the rig arrived.
    pub(crate) heard: Option<Instant>,
    /// Total time that the machine has lost, us.
    pub(crate) lost_us: u64,
}

/// A process and its output. Dropping this value ends the process.
pub(crate) struct Process {
    pub(crate) child: Child,
    said: File,
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A rig at the end of a terminal, in real time.
pub(crate) struct Rig {
    port: String,
    seen: Arc<Mutex<Seen>>,
    pub(crate) folder: tempfile::TempDir,
    program: PathBuf,
}

impl Rig {
    pub(crate) fn start() -> Result<Self, DoorError> {
        let bench = rig::start(RigOptions::WITH_BOTH_JUMPERS)?;
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let port = ptsname(&master, vec![])?.to_string_lossy().into_owned();
        fcntl_setfl(&master, OFlags::NONBLOCK)?;
        let seen = Arc::new(Mutex::new(Seen::default()));
        let line = File::from(master);
        let typed = line.try_clone()?;
        let heard = Arc::clone(&seen);
        let ear = bench.live(Box::new(Terminal {
            line,
            seen: Arc::clone(&seen),
        }))?;
        // This thread ends with the process. Until then its handle keeps the rig alive.
        thread::spawn(move || {
            hear(typed, &ear, &heard);
            drop(bench);
        });
        Ok(Self {
            port,
            seen,
            folder: tempfile::Builder::new()
                .permissions(Permissions::from_mode(0o700))
                .tempdir()?,
            program: std::env::current_exe()?,
        })
    }

    /// Warms the emulator up: it translates the image as it runs, so it is slower than real time at first.
    pub(crate) fn warm_up(&self) -> Result<(), DoorError> {
        let begin = Instant::now();
        while let Err(why) = self.retrograde(&["info", "rig"], 0) {
            if begin.elapsed() > SOON {
                return Err(why);
            }
        }
        Ok(())
    }

    /// Raises the link's time-out: a busy computer may starve a process for a second, and that must not end the
    /// measurement.
    pub(crate) fn be_patient(&self) -> Result<(), DoorError> {
        self.retrograde(&["settings", "set", "link_timeout_ms", LINK_TIMEOUT_MS], 0)
    }

    /// The location of the door for this line.
    pub(crate) fn doorway(&self) -> Result<Doorway, DoorError> {
        let line = self.port.parse().ok();
        let doorway = line.and_then(|line| Doorway::within(self.folder.path(), &line));
        doorway.ok_or_else(|| DoorError::Wrong(format!("{} is no line", self.port)))
    }

    pub(crate) fn seen(&self) -> Seen {
        *self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn spawn(&self, args: &[&str]) -> Result<Process, DoorError> {
        let said = tempfile::tempfile()?;
        let child = Command::new(&self.program)
            .args(args)
            .env("RETROGRADE_RIG", &self.port)
            .env_remove("RETROGRADE_CAPSULE")
            .env("RETROGRADE_RUNTIME_DIR", self.folder.path())
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(said.try_clone()?)
            .spawn()?;
        Ok(Process { child, said })
    }

    /// Runs the tool; its exit code must be `wanted`.
    pub(crate) fn retrograde(&self, args: &[&str], wanted: i32) -> Result<(), DoorError> {
        ends(self.spawn(args)?, args, wanted)
    }

    pub(crate) fn wait(
        &self,
        what: &str,
        until: impl Fn(&Seen) -> bool,
    ) -> Result<Seen, DoorError> {
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

pub(crate) fn ends(mut process: Process, args: &[&str], wanted: i32) -> Result<(), DoorError> {
    let status = process.child.wait()?;
    if status.code() == Some(wanted) {
        return Ok(());
    }
    let mut said = String::new();
    process.said.rewind()?;
    process.said.read_to_string(&mut said)?;
    Err(DoorError::Wrong(format!(
        "`{}` ended with {status}: {said}",
        args.join(" ")
    )))
}

/// The rig's end of the terminal.
struct Terminal {
    line: File,
    seen: Arc<Mutex<Seen>>,
}

impl Outside<RigBoard> for Terminal {
    fn turn(&mut self, board: &RigBoard, bytes: &[u8], lost_us: u64) {
        if !bytes.is_empty() {
            // As at a serial port, bytes without a reader are lost.
            let _ = self.line.write(bytes);
        }
        let edges = board.rig.edges().len();
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        if seen.edges != edges {
            seen.last = Some(Instant::now());
        }
        seen.edges = edges;
        seen.lost_us = lost_us;
    }

    /// Ignored here: `lost_us` in the figures covers it.
    fn fell_behind(&mut self, _: Slow) {}
}

/// Passes bytes from the line to the rig, forever.
fn hear(mut line: File, ear: &Ear<RigBoard>, seen: &Mutex<Seen>) {
    let mut bytes = [0; 4_096];
    loop {
        match line.read(&mut bytes) {
            Ok(count @ 1..) => {
                seen.lock().unwrap_or_else(PoisonError::into_inner).heard = Some(Instant::now());
                if !ear.hear(bytes[..count].to_vec()) {
                    return;
                }
            }
            // The terminal is not open, or has no data.
            _ => thread::sleep(Duration::from_micros(200)),
        }
    }
}

/// An error with this text.
pub(crate) fn wrong(why: impl std::fmt::Display) -> DoorError {
    DoorError::Wrong(why.to_string())
}

/// Checks that no edge followed the confirmation of a stop.
pub(crate) fn stood(told: Instant, last: Instant) -> Result<(), DoorError> {
    if last > told + TURN {
        let late_ms = (last - told).as_millis();
        return Err(DoorError::Wrong(format!(
            "an edge {late_ms} ms after the stop was confirmed"
        )));
    }
    Ok(())
}

/// Prints how long stops have taken, each with the time in us that the emulator lost meanwhile. A stop that came too
/// late is an error.
pub(crate) fn judge(
    what: &str,
    mut took: Vec<(Duration, u64)>,
    say: &mut dyn FnMut(String),
) -> Result<(), DoorError> {
    let late: Vec<String> = (1..)
        .zip(&took)
        .filter(|(_, (took, _))| *took > LIMIT)
        .map(|(number, (took, lost_us))| {
            let took_ms = took.as_secs_f64() * 1e3;
            let lost_ms = lost_us / 1_000;
            format!("{number} ({took_ms:.1} ms, the emulator lost {lost_ms} ms)")
        })
        .collect();
    took.sort();
    let (median, most) = (took.get(took.len() / 2), took.last());
    if let (Some((median, _)), Some((most, _))) = (median, most) {
        say(format!(
            "{what}: {} of {} within {} ms; median {:.1} ms, latest {:.1} ms",
            took.len() - late.len(),
            took.len(),
            LIMIT.as_millis(),
            median.as_secs_f64() * 1e3,
            most.as_secs_f64() * 1e3,
        ));
    }
    if !late.is_empty() {
        let which = late.join(", ");
        return Err(DoorError::Wrong(format!("stops came late: {which}")));
    }
    Ok(())
}

/// Counted edges and missed samples of the one trial in a folder.
pub(crate) fn record(folder: &Path) -> Result<(u64, u64), DoorError> {
    let (mut counted, mut missed) = (None, 0);
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let text = std::fs::read_to_string(&path)?;
        match path.extension().and_then(|kind| kind.to_str()) {
            Some("json") => {
                let trial: Value = serde_json::from_str(&text).map_err(std::io::Error::from)?;
                counted = trial["action"]["executed"]["counted_edges"].as_u64();
            }
            Some("csv") => {
                let last = |line: &str| {
                    line.rsplit(',')
                        .next()
                        .and_then(|text| text.parse::<u64>().ok())
                };
                missed = text.lines().skip(1).filter_map(last).sum();
            }
            _ => {}
        }
    }
    let counted = counted.ok_or_else(|| DoorError::Wrong("the run left no record".to_owned()))?;
    Ok((counted, missed))
}
