//! One machine on the bench: the emulator on its own thread, in lock-step with the client that drives it.
//!
//! Virtual time passes only on request: in the `receive` of [`crate::link::VirtualLink`] or in [`Bench::advance_us`].
//! Between two such calls the machine is paused, and [`Bench::visit`] may inspect and change it. Nothing depends on the
//! wall clock or on how the host schedules its threads.
//!
//! The exception is a machine that is served: it runs in real time, on its own thread, until its last handle is
//! dropped.

use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use client::error::ClientError;
use rigless::emulator::{self, Driver, Host, Settled, Start, Stop};
use rigless::image::Image;
use rigless::mcu::Operate;
use rigless::session::Session;
use rigless::time::VirtualNanos;

use crate::bus::BusReport;
use crate::emulator::{BurstTiming, ChipOptions, CutAt, Emulator, Program, Wiring};
use crate::log::{Log, Tap};
use crate::pace::{Pace, Slow, Turn};
use crate::serial::Serial;

/// Why the bench could not be set up, or stopped working.
#[derive(Debug, thiserror::Error, miette::Diagnostic)]
pub enum BenchError {
    /// A machine refused or did not answer a request of the bench.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Client(#[from] ClientError),
    /// An image is missing.
    #[error(
        "no firmware image at {path}: run `cargo xtask images`, or name the folder in RETROGRADE_IMAGES ({why})"
    )]
    NoImage {
        path: PathBuf,
        /// The operating system's reason.
        why: std::io::Error,
    },
    /// The file is not an image of this firmware.
    #[error("{path} is not a usable firmware image: {why}")]
    BadImage {
        /// The file.
        path: PathBuf,
        /// Why it is unusable.
        why: String,
    },
    /// The emulator could not start or failed.
    #[error("the emulator ended: {0}")]
    Ended(String),
    /// A server could not be opened.
    #[error("cannot listen on {address}: {why}; `--rig 0 --capsule 0` takes free ports")]
    Listen {
        address: String,
        /// The operating system's reason.
        why: std::io::Error,
    },
}

/// How a machine is run.
#[derive(Clone, Debug)]
pub struct BenchOptions {
    pub chip: ChipOptions,
    /// Interval at which the machine can stop for its client, us. Bytes wait for the next such instant.
    pub quantum_us: u64,
    pub image: PathBuf,
    /// Contents of the whole flash to start from instead of the image, for example those after a power cut.
    pub flash: Option<Vec<u8>>,
}

impl BenchOptions {
    /// Defaults, with `image`.
    #[must_use]
    pub fn new(image: PathBuf) -> Self {
        Self {
            chip: ChipOptions::default(),
            quantum_us: 500,
            image,
            flash: None,
        }
    }
}

/// The folder of the firmware images: `RETROGRADE_IMAGES`, or the workspace's own build.
#[must_use]
pub fn images() -> PathBuf {
    std::env::var_os("RETROGRADE_IMAGES").map_or_else(
        || {
            PathBuf::from(env!("CARGO_MANIFEST_DIR"))
                .join("../target/thumbv7em-none-eabihf/firmware")
        },
        PathBuf::from,
    )
}

/// Access to the machine while it is paused.
pub struct Visit<'a, W: Wiring> {
    session: &'a mut Session<Emulator<W>>,
    host: &'a mut dyn Host,
    tap: &'a mut Tap,
    serial: &'a Mutex<Serial>,
    stop: Stop,
    epoch_ns: u64,
    earlier: &'a BusReport,
}

impl<W: Wiring> Visit<'_, W> {
    /// Now on the bench's clock, ns.
    #[must_use]
    pub fn now_ns(&self) -> u64 {
        self.epoch_ns + self.stop.at.0
    }

    /// Instructions executed since power-up.
    #[must_use]
    pub fn instructions(&self) -> u64 {
        self.stop.instruction_count
    }

    pub fn board(&mut self) -> &mut W {
        self.session.board_mut().wiring()
    }

    pub fn serial(&mut self) -> MutexGuard<'_, Serial> {
        self.serial.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The firmware's log so far.
    #[must_use]
    pub fn log(&self) -> Log {
        self.tap.log()
    }

    /// Accesses of the firmware to anything that the emulator or the chip lacks.
    #[must_use]
    pub fn bus(&self) -> BusReport {
        BusReport::of(self.session, self.earlier, self.epoch_ns)
    }

    /// Number of flash operations, stores and erases, since power-up.
    pub fn flash_operations(&mut self) -> u64 {
        self.session.board_mut().flash_operations()
    }

    /// Cuts the supply of the flash at flash operation number `operation` (from 0, since power-up). The flash does not
    /// change after that. [`Bench::power_cycle`] cuts the supply of the rest.
    pub fn cut_flash(&mut self, at: CutAt, operation: u64) {
        self.session.board_mut().cut_flash(at, operation);
    }

    /// Contents of the whole flash, for [`BenchOptions::flash`] of another bench.
    pub fn flash(&mut self) -> Vec<u8> {
        crate::emulator::read_out(self.host)
    }

    /// Whether the operation given to [`Visit::cut_flash`] has been reached.
    pub fn flash_is_cut(&mut self) -> bool {
        self.session.board_mut().flash_is_cut()
    }

    /// Overwrites the code at `address` as a debugger does, until the next reset.
    pub fn overwrite(&mut self, address: u64, code: &[u16]) {
        let emulator = self.session.board_mut();
        emulator.overwrite(address, code, self.host);
    }

    /// Sets the duration of the step timer's bursts. Call it while no burst is under way.
    ///
    /// # Panics
    /// On a machine that was started without [`ChipOptions::burst`].
    pub fn set_burst_timing(&mut self, burst_timing: BurstTiming) {
        self.session.board_mut().set_burst_timing(burst_timing);
    }

    /// Sets the chip's supply, mV, until the next power-up. The capsule's board sets its own.
    pub fn set_supply_mv(&mut self, millivolts: u32) {
        self.session.board_mut().set_supply_mv(millivolts);
    }

    /// Lets this fraction of the bytes that the chip receives arrive with a framing error, until the next call.
    pub fn set_framing_errors(&mut self, per_million: u32) {
        self.session.board_mut().set_framing_errors(per_million);
    }

    /// Stops the 8 MHz clock of the ST-LINK; it returns after `back_after_ns`, or never.
    pub fn fail_hse(&mut self, back_after_ns: Option<u64>) {
        let at = self.stop.at;
        let emulator = self.session.board_mut();
        emulator.fail_hse(at, back_after_ns, self.host);
    }

    /// Ends the step timer's DMA by an error of the bus.
    pub fn fail_step_stream(&mut self) {
        let at = self.stop.at;
        self.session.board_mut().fail_step_stream(at);
    }

    /// Keeps the processor from executing anything for `duration_us`. Timers and DMA continue.
    pub fn hold_up(&mut self, duration_us: u64) {
        let at = self.stop.at;
        let emulator = self.session.board_mut();
        emulator.hold_up(at, duration_us * 1_000, self.host);
    }

    /// Pulses the reset pin.
    pub fn reset(&mut self) {
        self.session
            .reset_by_pin(self.stop.at, self.stop.instruction_count, self.host);
    }

    /// The peripheral register at `address`, read without side effects; `None` if there is no register.
    pub fn register(&mut self, address: u32) -> Option<u32> {
        let at = self.stop.at;
        let mcu = self.session.mcu();
        let value = mcu.peek(at, u64::from(address), rigless::soc::Width::W32);
        value.ok().map(|value| value as u32)
    }

    /// Writes the peripheral register at `address`, as a debugger does through the bus.
    pub fn set_register(&mut self, address: u32, value: u32) {
        let at = self.stop.at;
        let mcu = self.session.mcu();
        let written = mcu.write(
            at,
            u64::from(address),
            rigless::soc::Width::W32,
            value.into(),
        );
        written.expect("a register");
    }

    /// The word at `address` in memory; `None` if there is no memory.
    pub fn word(&mut self, address: u32) -> Option<u32> {
        let word = self.host.read(u64::from(address), rigless::soc::Width::W32);
        word.ok().map(|word| word as u32)
    }
}

type Visitor<W> = Box<dyn FnOnce(&mut Visit<'_, W>) + Send>;

/// The outside world of a machine that runs in real time.
pub(crate) trait Outside<W>: Send {
    /// The machine has run for one turn and sent `bytes`. In all it has lost `lost_us` of real time.
    fn turn(&mut self, board: &W, bytes: &[u8], lost_us: u64);

    /// The computer was too slow for the machine.
    fn fell_behind(&mut self, slow: Slow);
}

/// State of a machine that runs in real time.
struct RealTime<W> {
    began: Instant,
    pace: Pace,
    outside: Box<dyn Outside<W>>,
}

impl<W> RealTime<W> {
    fn elapsed_us(&self) -> u64 {
        self.began.elapsed().as_micros() as u64
    }
}

/// Passes input to a machine that runs in real time.
pub(crate) struct Input<W: Wiring>(Sender<Job<W>>);

impl<W: Wiring> Input<W> {
    /// Wakes the machine with these bytes. Returns false if it is gone.
    pub(crate) fn send(&self, bytes: Vec<u8>) -> bool {
        self.0.send(Job::Input(bytes)).is_ok()
    }
}

enum Job<W: Wiring> {
    /// Put `bytes` on the line and run to `until_ns`. With `eager`, stop as soon as the machine has sent a whole frame;
    /// the host has no use for part of one.
    Run {
        until_ns: u64,
        eager: bool,
        bytes: Vec<u8>,
    },
    Visit(Visitor<W>),
    PowerCycle {
        off_ns: u64,
    },
    /// Run in real time from now on.
    RunInRealTime(Box<dyn Outside<W>>),
    /// Put these bytes on the line of a machine that runs in real time.
    Input(Vec<u8>),
}

enum Reply {
    Paused { at_ns: u64, bytes: Vec<(u64, u8)> },
    Visited,
    Ended(String),
}

struct Conductor<W: Wiring> {
    jobs: Receiver<Job<W>>,
    replies: Sender<Reply>,
    serial: Arc<Mutex<Serial>>,
    tap: Tap,
    quantum_ns: u64,
    until_ns: u64,
    eager: bool,
    epoch_ns: u64,
    /// Resets since power-up that were handled.
    resets: usize,
    /// Gaps and resets until the supply was last cut.
    earlier: BusReport,
    /// After a cut of the supply: the flash to restart from, and when.
    power_cycle: Option<(Vec<u8>, u64)>,
    real_time: Option<RealTime<W>>,
}

/// The next action after a job.
enum After {
    /// Wait for the next job.
    Wait,
    Run,
    End,
}

impl<W: Wiring> Conductor<W> {
    fn line(&self) -> MutexGuard<'_, Serial> {
        self.serial.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn next_instant(&self, now_ns: u64) -> VirtualNanos {
        let grid = (now_ns / self.quantum_ns + 1) * self.quantum_ns;
        VirtualNanos(grid.min(self.until_ns) - self.epoch_ns)
    }
}

impl<W: Wiring> Driver<Emulator<W>> for Conductor<W> {
    fn on_settled(
        &mut self,
        session: &mut Session<Emulator<W>>,
        host: &mut dyn Host,
        settled: Settled,
    ) {
        if let Settled::Stop(stop) = settled
            && session.resets().len() != self.resets
        {
            self.resets = session.resets().len();
            self.tap.restarted(host, self.epoch_ns + stop.at.0);
            crate::emulator::restarted(session, host);
        }
        crate::emulator::settled(session, host, settled);
    }

    fn on_stop(
        &mut self,
        session: &mut Session<Emulator<W>>,
        stop: Stop,
        host: &mut dyn Host,
    ) -> Option<VirtualNanos> {
        let now_ns = self.epoch_ns + stop.at.0;
        if stop.at == VirtualNanos(0) {
            // Each power-up has its own noise.
            crate::emulator::powered_up(host, now_ns);
        }
        self.tap.drain(host, now_ns);
        if now_ns < self.until_ns && !(self.eager && self.line().has_sent_frame()) {
            return Some(self.next_instant(now_ns));
        }
        if self.real_time.is_some() {
            return self.end_turn(session, stop, host, now_ns);
        }
        let bytes = self.line().take();
        let paused = Reply::Paused {
            at_ns: now_ns,
            bytes,
        };
        self.replies.send(paused).ok()?;
        loop {
            let job = self.jobs.recv().ok()?;
            match self.carry_out(job, session, stop, host, now_ns) {
                After::Wait => {}
                After::Run => return Some(self.next_instant(now_ns)),
                After::End => return None,
            }
            if self.real_time.is_some() {
                return self.end_turn(session, stop, host, now_ns);
            }
        }
    }
}

impl<W: Wiring> Conductor<W> {
    fn carry_out(
        &mut self,
        job: Job<W>,
        session: &mut Session<Emulator<W>>,
        stop: Stop,
        host: &mut dyn Host,
        now_ns: u64,
    ) -> After {
        match job {
            Job::Run {
                until_ns,
                eager,
                bytes,
            } => {
                self.line().put(&bytes);
                // Only real time moves the clock of a machine that runs in real time.
                if until_ns <= now_ns || self.real_time.is_some() {
                    let bytes = self.line().take();
                    let at_ns = now_ns;
                    return self.reply(Reply::Paused { at_ns, bytes });
                }
                self.until_ns = until_ns;
                self.eager = eager;
                After::Run
            }
            Job::Visit(visitor) => {
                session.board_mut().catch_up(stop.at, host);
                visitor(&mut Visit {
                    session,
                    host,
                    tap: &mut self.tap,
                    serial: &self.serial,
                    stop,
                    epoch_ns: self.epoch_ns,
                    earlier: &self.earlier,
                });
                session.board_mut().refresh(stop.at);
                self.reply(Reply::Visited)
            }
            Job::PowerCycle { off_ns } => {
                session.board_mut().catch_up(stop.at, host);
                let flash = crate::emulator::cut_supply(session, host);
                self.power_cycle = Some((flash, now_ns + off_ns));
                if self.real_time.is_some() {
                    // A served machine never pauses, so nothing waits for an answer at its next start.
                    let _ = self.replies.send(Reply::Visited);
                }
                After::End
            }
            Job::RunInRealTime(outside) => {
                self.eager = false;
                self.real_time = Some(RealTime {
                    began: Instant::now(),
                    pace: Pace::new(now_ns / 1_000),
                    outside,
                });
                self.reply(Reply::Visited)
            }
            Job::Input(bytes) => {
                self.line().put(&bytes);
                if let Some(real_time) = &mut self.real_time {
                    real_time.pace.hurry();
                }
                After::Wait
            }
        }
    }

    fn reply(&self, reply: Reply) -> After {
        match self.replies.send(reply) {
            Ok(()) => After::Wait,
            Err(_) => After::End,
        }
    }

    /// Ends a turn of a machine that runs in real time: passes the sent bytes on, and waits for the next turn or for a
    /// job. Returns when the machine must stop next.
    fn end_turn(
        &mut self,
        session: &mut Session<Emulator<W>>,
        stop: Stop,
        host: &mut dyn Host,
        now_ns: u64,
    ) -> Option<VirtualNanos> {
        let sent: Vec<u8> = self
            .line()
            .take()
            .into_iter()
            .map(|(_, byte)| byte)
            .collect();
        let real_time = self.real_time.as_mut()?;
        if !sent.is_empty() {
            real_time.pace.sent();
        }
        let lost_us = real_time.pace.lost_us();
        let board = session.board().wiring_ref();
        real_time.outside.turn(board, &sent, lost_us);
        let mut waited = None;
        loop {
            // First handle every job that has arrived.
            while let Some(job) = waited.take().or_else(|| self.jobs.try_recv().ok()) {
                match self.carry_out(job, session, stop, host, now_ns) {
                    After::Wait => {}
                    After::Run => return Some(self.next_instant(now_ns)),
                    After::End => return None,
                }
            }
            let real_time = self.real_time.as_mut()?;
            let elapsed_us = real_time.elapsed_us();
            let turn = real_time.pace.turn(elapsed_us, now_ns / 1_000);
            if let Some(slow) = real_time.pace.report(elapsed_us) {
                real_time.outside.fell_behind(slow);
            }
            match turn {
                Turn::Run(until_us) => {
                    // Turns are short enough for the line, so no stop is needed in between.
                    self.until_ns = until_us * 1_000;
                    return Some(VirtualNanos(self.until_ns - self.epoch_ns));
                }
                Turn::Rest(us) => match self.jobs.recv_timeout(Duration::from_micros(us)) {
                    Ok(job) => waited = Some(job),
                    Err(RecvTimeoutError::Timeout) => {}
                    Err(RecvTimeoutError::Disconnected) => return None,
                },
            }
        }
    }
}

/// Runs a machine until its client disconnects. The error is the reason of any other end.
fn conduct<W: Wiring>(
    mut wiring: W,
    options: &BenchOptions,
    elf: Image,
    mut conductor: Conductor<W>,
) -> Result<(), String> {
    let mut images = vec![elf];
    if let Some(flash) = &options.flash {
        images = vec![whole_flash(flash.clone())?];
    }
    loop {
        let epoch_ns = conductor.epoch_ns;
        let serial = Arc::clone(&conductor.serial);
        let program = Program::of(&images, options.chip.core_hz);
        let emulator =
            Emulator::new(wiring, options.chip, serial, epoch_ns, program).map_err(text)?;
        let session = Session::new(Box::new(emulator), 0, VirtualNanos(0)).map_err(text)?;
        let mut finished = emulator::run(session, &Start::new(&images), conductor).map_err(text)?;
        if let Some(error) = finished.session.take_error() {
            return Err(error.to_string());
        }
        conductor = finished.driver;
        let Some((flash, back_ns)) = conductor.power_cycle.take() else {
            return Ok(());
        };
        let Some(kept) = finished.session.board_mut().take_wiring() else {
            return Err("the board was lost".into());
        };
        wiring = kept;
        wiring.powered_off();
        conductor.earlier = BusReport::of(&finished.session, &conductor.earlier, epoch_ns);
        images = vec![whole_flash(flash)?];
        conductor.epoch_ns = back_ns;
        conductor.until_ns = back_ns;
        conductor.resets = 0;
        conductor.tap.powered_up(back_ns);
    }
}

fn whole_flash(bytes: Vec<u8>) -> Result<Image, String> {
    Image::new(
        std::path::Path::new("flash as it was"),
        bytes,
        Some(0x0800_0000),
    )
    .map_err(text)
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// The client's end of the lock-step.
pub(crate) struct Cable<W: Wiring> {
    jobs: Sender<Job<W>>,
    replies: Receiver<Reply>,
    now_ns: u64,
    outbox: Vec<u8>,
    inbox: std::collections::VecDeque<(u64, u8)>,
}

impl<W: Wiring> Cable<W> {
    pub(crate) fn now_ns(&self) -> u64 {
        self.now_ns
    }

    pub(crate) fn send(&mut self, bytes: &[u8]) {
        self.outbox.extend_from_slice(bytes);
    }

    pub(crate) fn take_received(&mut self, buffer: &mut [u8]) -> usize {
        let count = buffer.len().min(self.inbox.len());
        for (slot, (_, byte)) in buffer.iter_mut().zip(self.inbox.drain(..count)) {
            *slot = byte;
        }
        count
    }

    pub(crate) fn run(&mut self, until_ns: u64, eager: bool) -> Result<(), BenchError> {
        let bytes = std::mem::take(&mut self.outbox);
        self.ask(Job::Run {
            until_ns,
            eager,
            bytes,
        })
    }

    fn ask(&mut self, job: Job<W>) -> Result<(), BenchError> {
        // If the channel is closed, the reason is among the replies.
        let _ = self.jobs.send(job);
        self.answer()
    }

    fn answer(&mut self) -> Result<(), BenchError> {
        match self.replies.recv() {
            Ok(Reply::Paused { at_ns, bytes }) => {
                self.now_ns = at_ns;
                self.inbox.extend(bytes);
                Ok(())
            }
            Ok(Reply::Visited) => Ok(()),
            Ok(Reply::Ended(why)) => Err(BenchError::Ended(why)),
            Err(_) => Err(BenchError::Ended("its thread is gone".into())),
        }
    }
}

/// A machine on the bench. Clones are handles of the same machine.
pub struct Bench<W: Wiring> {
    pub(crate) cable: Arc<Mutex<Cable<W>>>,
}

impl<W: Wiring> Clone for Bench<W> {
    fn clone(&self) -> Self {
        Self {
            cable: Arc::clone(&self.cable),
        }
    }
}

impl<W: Wiring> Bench<W> {
    /// Powers a machine up. No virtual time has passed when this returns.
    ///
    /// # Errors
    /// A missing or unusable image.
    pub fn start(wiring: W, options: BenchOptions) -> Result<Self, BenchError> {
        let path = options.image.clone();
        let elf = std::fs::read(&path).map_err(|why| BenchError::NoImage {
            path: path.clone(),
            why,
        })?;
        let bad = |why: String| BenchError::BadImage {
            path: path.clone(),
            why,
        };
        let tap = Tap::new(&elf).map_err(bad)?;
        let image = Image::new(&path, elf, None).map_err(|why| bad(why.to_string()))?;
        let (jobs, queue) = channel();
        let (replying, replies) = channel();
        let conductor = Conductor {
            jobs: queue,
            replies: replying.clone(),
            serial: Arc::default(),
            tap,
            quantum_ns: options.quantum_us.max(1) * 1_000,
            until_ns: 0,
            eager: false,
            epoch_ns: 0,
            resets: 0,
            earlier: BusReport::default(),
            power_cycle: None,
            real_time: None,
        };
        thread::Builder::new()
            .name("emulator".into())
            .stack_size(16 << 20)
            .spawn(move || {
                if let Err(why) = conduct(wiring, &options, image, conductor) {
                    let _ = replying.send(Reply::Ended(why));
                }
            })
            .map_err(|why| BenchError::Ended(why.to_string()))?;
        let mut cable = Cable {
            jobs,
            replies,
            now_ns: 0,
            outbox: Vec::new(),
            inbox: std::collections::VecDeque::new(),
        };
        cable.answer()?;
        Ok(Self {
            cable: Arc::new(Mutex::new(cable)),
        })
    }

    pub(crate) fn cable(&self) -> MutexGuard<'_, Cable<W>> {
        self.cable.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Now on the bench's clock, ns.
    #[must_use]
    pub fn now_ns(&self) -> u64 {
        self.cable().now_ns
    }

    /// Lets `us` of virtual time pass. Bytes that the machine sends meanwhile are kept for the link.
    ///
    /// # Errors
    /// [`BenchError::Ended`] when the emulator has failed.
    pub fn advance_us(&self, us: u64) -> Result<(), BenchError> {
        let mut cable = self.cable();
        let until_ns = cable.now_ns + us * 1_000;
        cable.run(until_ns, false)
    }

    /// Gives `visitor` access to the paused machine.
    ///
    /// # Errors
    /// [`BenchError::Ended`] when the emulator has failed.
    pub fn visit<T: Send + 'static>(
        &self,
        visitor: impl FnOnce(&mut Visit<'_, W>) -> T + Send + 'static,
    ) -> Result<T, BenchError> {
        let (answer, answered) = channel();
        let visitor: Visitor<W> = Box::new(move |visit| {
            let _ = answer.send(visitor(visit));
        });
        self.cable().ask(Job::Visit(visitor))?;
        answered
            .recv()
            .map_err(|_| BenchError::Ended("the visit did not answer".into()))
    }

    /// Runs the machine in real time from now on, connected to `outside`, which is dropped when the machine ends. After
    /// this only visits, power cuts and bytes through the [`Input`] reach the machine.
    pub(crate) fn attach(&self, outside: Box<dyn Outside<W>>) -> Result<Input<W>, BenchError> {
        let mut cable = self.cable();
        cable.ask(Job::RunInRealTime(outside))?;
        Ok(Input(cable.jobs.clone()))
    }

    /// Cuts the supply for `off_us`: the flash keeps its contents, RAM and registers do not. The mechanics do not move.
    ///
    /// # Errors
    /// [`BenchError::Ended`] when the emulator has failed.
    pub fn power_cycle(&self, off_us: u64) -> Result<(), BenchError> {
        self.cable().ask(Job::PowerCycle {
            off_ns: off_us * 1_000,
        })
    }

    /// Pulses the reset pin.
    ///
    /// # Errors
    /// [`BenchError::Ended`] when the emulator has failed.
    pub fn reset(&self) -> Result<(), BenchError> {
        self.visit(|visit| visit.reset())
    }

    /// The firmware's log so far.
    ///
    /// # Errors
    /// [`BenchError::Ended`] when the emulator has failed.
    pub fn log(&self) -> Result<Log, BenchError> {
        self.visit(|visit| visit.log())
    }

    /// Accesses of the firmware to anything that the emulator or the chip lacks.
    ///
    /// # Errors
    /// [`BenchError::Ended`] when the emulator has failed.
    pub fn bus(&self) -> Result<BusReport, BenchError> {
        self.visit(|visit| visit.bus())
    }
}
