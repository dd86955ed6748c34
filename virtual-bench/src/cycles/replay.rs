//! Replays a run of the bench instruction by instruction. It puts the bytes of the host on the line at the same
//! instants, and nothing else reaches the machine, so the machine does the same again.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use client::link::{Link, LinkError};
use rigless::emulator::{Driver, HitKind, Host, Settled, Stop, Watch};
use rigless::image::Image;
use rigless::session::Session;
use rigless::time::VirtualNanos;

use super::core::{Code, Core};
use super::follow::follow;
use crate::bench::{Bench, BenchError, BenchOptions};
use crate::boards::rig::RigBoard;
use crate::emulator::Emulator;
use crate::link::VirtualLink;
use crate::serial::Serial;

/// The bytes that the host sent, each chunk with its instant, ns.
pub(super) type Script = Arc<Mutex<VecDeque<(u64, Vec<u8>)>>>;

/// A link that records what the host sends.
pub(super) struct Recorder {
    bench: Bench<RigBoard>,
    link: VirtualLink<RigBoard>,
    script: Script,
}

impl Recorder {
    pub(super) fn new(bench: &Bench<RigBoard>) -> (Self, Script) {
        let script = Script::default();
        let recorder = Self {
            bench: bench.clone(),
            link: VirtualLink::new(bench, "virtual rig"),
            script: Arc::clone(&script),
        };
        (recorder, script)
    }
}

impl Link for Recorder {
    fn place(&self) -> String {
        self.link.place()
    }

    fn now_us(&self) -> u64 {
        self.link.now_us()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let sent = (self.bench.now_ns(), bytes.to_vec());
        let mut script = self.script.lock().unwrap_or_else(PoisonError::into_inner);
        script.push_back(sent);
        self.link.send(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.link.receive(buffer, deadline_us)
    }
}

/// A run to replay, and the part of it to measure.
pub(super) struct Replay<'a> {
    pub(super) options: &'a BenchOptions,
    pub(super) board: RigBoard,
    pub(super) script: VecDeque<(u64, Vec<u8>)>,
    /// Window in which instructions are followed, ns.
    pub(super) window_ns: Range<u64>,
    /// The image's code.
    pub(super) code: Code,
    /// Cores that follow the instructions, one per variant.
    pub(super) cores: Vec<Core>,
}

/// The result of a replay.
pub(super) struct Seen {
    pub(super) cores: Vec<Core>,
    /// Instruction counts at the start and the end of the window, by the emulator.
    pub(super) counts: Range<u64>,
    /// Steps within the window.
    pub(super) steps: usize,
}

struct Follower {
    serial: Arc<Mutex<Serial>>,
    script: VecDeque<(u64, Vec<u8>)>,
    quantum_ns: u64,
    window_ns: Range<u64>,
    code: Code,
    cores: Vec<Core>,
    counts: Range<u64>,
    steps: Range<usize>,
    watches: bool,
}

impl Driver<Emulator<RigBoard>> for Follower {
    fn on_settled(
        &mut self,
        session: &mut Session<Emulator<RigBoard>>,
        host: &mut dyn Host,
        settled: Settled,
    ) {
        match settled {
            Settled::Hit(hit) if hit.kind == HitKind::Instruction => {
                for core in &mut self.cores {
                    core.execute(hit.address as u32, &self.code);
                }
                return;
            }
            Settled::Access { access, .. } if self.watches => {
                for core in &mut self.cores {
                    core.access(access.address);
                }
            }
            _ => {}
        }
        crate::emulator::settled(session, host, settled);
    }

    fn on_stop(
        &mut self,
        session: &mut Session<Emulator<RigBoard>>,
        stop: Stop,
        host: &mut dyn Host,
    ) -> Option<VirtualNanos> {
        let now_ns = stop.at.0;
        while self
            .script
            .front()
            .is_some_and(|(at_ns, _)| *at_ns <= now_ns)
        {
            let bytes = self.script.pop_front().map(|(_, bytes)| bytes);
            let mut line = self.serial.lock().unwrap_or_else(PoisonError::into_inner);
            line.put(&bytes.unwrap_or_default());
            let _ = line.take();
        }
        if now_ns >= self.window_ns.end {
            self.counts.end = stop.instruction_count;
            self.steps.end = session.board().seen_wiring().rig.edges().len();
            return None;
        }
        if now_ns >= self.window_ns.start && !self.watches {
            self.watches = true;
            self.counts.start = stop.instruction_count;
            self.steps.start = session.board().seen_wiring().rig.edges().len();
            for address in self.code.addresses() {
                host.watch(Watch::Instruction(address.into()));
            }
        }
        let grid = (now_ns / self.quantum_ns + 1) * self.quantum_ns;
        let edge = if self.watches {
            self.window_ns.end
        } else {
            self.window_ns.start
        };
        let sent = self.script.front().map_or(u64::MAX, |(at_ns, _)| *at_ns);
        Some(VirtualNanos(grid.min(edge).min(sent)))
    }
}

/// Replays a run.
///
/// # Errors
/// The emulator failed.
pub(super) fn replay(replay: Replay<'_>) -> Result<Seen, BenchError> {
    let ended = |why: &dyn std::fmt::Display| BenchError::Ended(why.to_string());
    let path = &replay.options.image;
    let elf = std::fs::read(path).map_err(|why| BenchError::NoImage {
        path: path.clone(),
        why,
    })?;
    let image = Image::new(path, elf, None).map_err(|why| ended(&why))?;
    let serial = Arc::<Mutex<Serial>>::default();
    let follower = Follower {
        serial: Arc::clone(&serial),
        script: replay.script,
        quantum_ns: replay.options.quantum_us.max(1) * 1_000,
        window_ns: replay.window_ns,
        code: replay.code,
        cores: replay.cores,
        counts: 0..0,
        steps: 0..0,
        watches: false,
    };
    let Follower {
        cores,
        counts,
        steps,
        ..
    } = follow(replay.board, replay.options.chip, image, serial, follower)?;
    Ok(Seen {
        cores,
        counts,
        steps: steps.len(),
    })
}
