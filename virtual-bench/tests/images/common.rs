//! Helpers shared by the tests on the images.
#![allow(missing_docs, dead_code, unreachable_pub)]

use std::fmt::Debug;
use std::path::Path;

use client::error::ClientError;
use client::link::Link;
use client::{Device, Observer, Unobserved};
use protocol::{
    error::Refusal,
    frame::{Header, Kind, encode},
    rig::{
        LinkLossPolicy, RigFault, RigStatus, RigTelemetry, Run, RunAccepted, RunOutcome, RunRecord,
        RunTiming, Stroke,
    },
    settings::{Setting, SettingKey},
    system::DeviceKind,
    table::{Endpoint, Request, Response, Telemetry},
};
use virtual_bench::{
    bench::{Bench, BenchOptions, Visit},
    boards::rig::{self, RigBoard},
    emulator::{ChipOptions, Streams, Wiring},
    fault_injection::{FaultInjection, Misbehaviour},
    faults::When,
    link::VirtualLink,
    pins::EdgeLog,
    plants::rig::{Action, Rig, RigOptions, Violations},
    verdicts,
};

/// One timer tick and one instruction slot of the emulator at 65 M instructions/s.
pub const LIMIT_NS: f64 = 10.0 + 1e9 / 65e6;

/// Deterministic random numbers for the instants of faults. The text of every failure includes the seed.
pub struct Dice(pub u64);
impl Dice {
    pub fn roll(&mut self, range: std::ops::Range<u64>) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        range.start + self.0 % (range.end - range.start)
    }
}

/// Number of trials in a campaign: `all` if RETROGRADE_CAMPAIGN is set, else `slice`. The trials are the same either
/// way: the first ones of a recorded seed.
pub fn trials<N>(slice: N, all: N) -> N {
    match std::env::var_os("RETROGRADE_CAMPAIGN") {
        Some(_) => all,
        None => slice,
    }
}

/// Whether to make this trial of a campaign: each if RETROGRADE_CAMPAIGN is set, else every nth.
pub fn is_made(trial: usize, nth: usize) -> bool {
    trial.is_multiple_of(trials(nth, 1))
}

/// A request of any row of the table.
pub struct Any(pub Request);

impl Endpoint for Any {
    type Response = Response;

    fn into_request(self) -> Request {
        self.0
    }

    fn from_response(response: Response) -> Option<Response> {
        Some(response)
    }
}

/// The refusal of a request that must be refused.
pub fn refusal<T: Debug>(answer: Result<T, ClientError>) -> Refusal {
    match answer {
        Err(ClientError::Refused { refusal, .. }) => refusal,
        other => panic!("{other:?}"),
    }
}

/// The firmware's log, for failures.
pub fn log_of<W: Wiring>(bench: &Bench<W>) -> String {
    bench.log().expect("the bench runs").to_string()
}

/// Operations of the flash since the start.
pub fn flash_operations<W: Wiring>(bench: &Bench<W>) -> u64 {
    let counted = bench.visit(|visit| visit.flash_operations());
    counted.expect("the bench runs")
}

/// Makes a client of the watchdog misbehave. Returns the instant, ns.
pub fn inject<W: Wiring>(bench: &Bench<W>, image: &Path, client: u8, deed: Misbehaviour) -> u64 {
    let injection = FaultInjection::new(image, client, deed).expect("an image with its symbols");
    let applied = bench.visit(move |visit| injection.apply(visit));
    applied.expect("the bench runs");
    bench.now_ns()
}

pub struct RigRun {
    pub bench: Bench<RigBoard>,
    pub device: Device,
}

/// A rig that is connected and not homed.
pub fn rig() -> RigRun {
    rig_with(RigOptions::default())
}

pub fn rig_with(options: RigOptions) -> RigRun {
    start(options, BenchOptions::new(rig::image()))
}

/// A rig whose chip is changed.
pub fn rig_with_chip(change: impl FnOnce(&mut ChipOptions)) -> RigRun {
    start(RigOptions::default(), with_chip(change))
}

/// The rig's image on a chip that is changed.
pub fn with_chip(change: impl FnOnce(&mut ChipOptions)) -> BenchOptions {
    let mut options = BenchOptions::new(rig::image());
    change(&mut options.chip);
    options
}

/// A rig whose flash holds this.
pub fn rig_from_flash(flash: Vec<u8>) -> RigRun {
    let options = BenchOptions {
        flash: Some(flash),
        ..BenchOptions::new(rig::image())
    };
    start(RigOptions::default(), options)
}

pub fn start(rig: RigOptions, options: BenchOptions) -> RigRun {
    let board = RigBoard::new(Rig::new(rig));
    connected(Bench::start(board, options).expect("the image boots"))
}

/// A host at a rig that runs.
pub fn connected(bench: Bench<RigBoard>) -> RigRun {
    let link = Box::new(VirtualLink::new(&bench, "virtual rig"));
    let device = Device::connect(link, DeviceKind::Rig, 1).expect("the rig answers");
    RigRun { bench, device }
}

/// The ways in which a DMA stream may go on that is switched off and on again and is not told where.
pub fn ways_to_go_on() -> [Streams; 4] {
    [(false, false), (false, true), (true, false), (true, true)].map(|(count, address)| Streams {
        keeps_count: count,
        keeps_address: address,
        ..Streams::default()
    })
}

/// A rig at position 0 that also homes quickly from now on.
pub fn quickly_homed() -> RigRun {
    rig().quickly_homed()
}

/// A rig at position 0.
pub fn homed() -> RigRun {
    let mut rig = rig();
    rig.home();
    rig
}

impl RigRun {
    /// The same at position 0; it homes quickly from now on.
    pub fn quickly_homed(mut self) -> Self {
        home_quickly(&mut self);
        self.home();
        self
    }

    pub fn set(&mut self, key: SettingKey, value: u32) {
        let set = self.device.call(Setting { key, value });
        set.unwrap_or_else(|error| panic!("{}: {error}", key.name()));
    }

    /// Resets it by its pin, and opens a new session.
    pub fn reset(&mut self, nonce: u32) {
        self.bench.reset().expect("the bench runs");
        self.pass(500_000);
        self.device.hello(nonce).expect("it answers again");
    }

    /// Cuts the supply for a second, and opens a new session.
    pub fn power_cycle(&mut self, nonce: u32) {
        self.bench.power_cycle(1_000_000).expect("the bench runs");
        self.pass(300_000);
        self.device.hello(nonce).expect("it answers again");
    }

    /// Clears the fault and homes.
    pub fn recover(&mut self, what: &str) {
        self.device.acknowledge().expect(what);
        self.home();
    }

    pub fn home(&mut self) {
        let accepted = self.device.home().expect("homing is accepted");
        let homed = self.device.wait_homing(&accepted, &mut Unobserved);
        homed.unwrap_or_else(|error| panic!("{error}\n{}", self.log()));
        assert_eq!(self.carriage(), 0, "homed, but not at 0");
    }

    pub fn carriage(&self) -> i64 {
        self.with(|rig| rig.carriage())
    }

    pub fn visit<T: Send + 'static>(
        &self,
        visit: impl FnOnce(&mut Visit<'_, RigBoard>) -> T + Send + 'static,
    ) -> T {
        self.bench.visit(visit).expect("the bench runs")
    }

    pub fn with<T: Send + 'static>(&self, read: impl FnOnce(&mut Rig) -> T + Send + 'static) -> T {
        self.visit(|visit| read(&mut visit.board().rig))
    }

    pub fn status(&mut self) -> RigStatus {
        self.device.rig_status().expect("a status")
    }

    /// Waits for the end of a run.
    pub fn ended(&mut self, accepted: &RunAccepted) -> RunRecord {
        let record = self.device.wait_run(accepted, &mut Unobserved);
        record.unwrap_or_else(|error| panic!("{error}\n{}", self.log()))
    }

    /// Checks that the edges since number `first` are those of `run`, each in its place.
    pub fn is_exact(&self, run: &verdicts::Run, first: usize) {
        let verdict = verdicts::Verdict::of(run, &self.edges(first)).check(LIMIT_NS);
        verdict.unwrap_or_else(|why| panic!("{why}\n{}", self.log()));
    }

    /// Lets time pass without a host.
    pub fn pass(&self, us: u64) {
        self.bench.advance_us(us).expect("the bench runs");
    }

    pub fn plan(&self, when: When, action: Action) {
        self.with(move |rig| rig.plan(when, action));
    }

    /// Plans `action` for an edge from now on, counted from 1. Returns its number.
    pub fn plan_at(&self, within: u64, action: Action) -> u64 {
        let number = self.edge_count() as u64 + within;
        self.plan(When::Edge(number), action);
        number
    }

    /// Applies `action` to the machine at once.
    pub fn act(&self, action: Action) {
        let now_ns = self.bench.now_ns();
        self.with(move |rig| rig.act(action, now_ns));
    }

    /// Puts a request on the line without waiting for its reply. `ahead` tells several of them apart.
    pub fn send(&self, request: &Request, ahead: u16) {
        let header = Header {
            kind: Kind::Request,
            session: self.device.identity().expect("a session").session,
            // Ahead of the client's own numbers, but not so far that it would wrap to behind them.
            seq: 20_000 + ahead,
        };
        let frame = encode(header, request).expect("it fits");
        let mut link = VirtualLink::new(&self.bench, "a second hand on the line");
        link.send(&frame).expect("the bench runs");
    }

    /// Lets time pass while the host keeps the link alive.
    pub fn idle(&mut self, us: u64) {
        let idled = self.device.idle(us, &mut Unobserved);
        idled.expect("the link stays");
    }

    /// Checks that the reported position is right to the step, but the rig still requires homing.
    pub fn position_is_right_but_not_trusted(&mut self, what: &str) {
        let status = self.device.rig_status().expect(what);
        assert_eq!(
            (i64::from(status.position_steps), status.homed),
            (self.carriage(), false),
            "{what}"
        );
    }

    /// Edges since edge number `first`.
    pub fn edges(&self, first: usize) -> EdgeLog {
        self.with(move |rig| rig.edges().since(first))
    }

    pub fn edge_count(&self) -> usize {
        self.with(|rig| rig.edges().len())
    }

    /// When the last step left the pin.
    pub fn last_edge_ns(&self) -> u64 {
        let last = self.edges(self.edge_count() - 1);
        last.iter().next().expect("a step").at_ns
    }

    /// The firmware's log, for failures.
    pub fn log(&self) -> String {
        log_of(&self.bench)
    }

    /// Checks that nothing absent was accessed and that no driver rule was broken. A reset may have cut the pulse in
    /// progress.
    pub fn check_clean(&self, resets: usize) {
        self.check_clean_after(resets, resets);
    }

    /// The same if `cuts` pulses were cut by stops or resets.
    pub fn check_clean_after(&self, resets: usize, cuts: usize) {
        self.bench
            .bus()
            .expect("the bench runs")
            .check(resets)
            .unwrap_or_else(|why| panic!("{why}\n{}", self.log()));
        let (found, cut) = self.with(|rig| (rig.violations(), rig.cut_pulses()));
        assert_eq!(found, Violations::default(), "{}", self.log());
        assert!(cut <= cuts as u64, "{cut} pulses cut\n{}", self.log());
    }
}

/// The paper's run, with another number of cycles at the same speed.
pub fn paper(cycles: u16) -> Run {
    Run {
        cycles,
        stroke_um: 130_000,
        timing: RunTiming::Total {
            total_us: u64::from(cycles) * 8_000_000,
            accel_um_s2: 100_000,
        },
        far_dwell_us: 0,
        home_dwell_us: 0,
        start_delay_us: 0,
        link_loss: LinkLossPolicy::Stop,
    }
}

/// The same run as the bench computes it.
pub fn exact(cycles: u16) -> verdicts::Run {
    verdicts::Run {
        cycles: u32::from(cycles),
        ..verdicts::Run::paper()
    }
}

/// An accepted run, as the bench computes it.
pub fn run_of(run: &Run, accepted: &RunAccepted) -> verdicts::Run {
    let stroke = |stroke: Stroke| verdicts::Stroke {
        steps: stroke.steps.into(),
        duration_ticks: stroke.duration_ticks,
        ramp_ticks: stroke.ramp_ticks,
    };
    verdicts::Run {
        cycles: run.cycles.into(),
        forward: stroke(accepted.forward),
        back: stroke(accepted.back),
        far_dwell_ticks: u64::from(run.far_dwell_us) * 100,
        home_dwell_ticks: u64::from(run.home_dwell_us) * 100,
    }
}

/// Keeps the telemetry as received.
#[derive(Default)]
pub struct Recorder {
    pub samples: Vec<Telemetry>,
    pub missed: u32,
}

impl Recorder {
    /// The samples, all of them a rig's.
    pub fn rigs(&self) -> impl Iterator<Item = &RigTelemetry> {
        self.samples.iter().map(|sample| match sample {
            Telemetry::Rig(sample) => sample,
            Telemetry::Capsule(_) => panic!("a capsule's sample"),
        })
    }
}

impl Observer for Recorder {
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.samples.push(*sample);
        self.missed += u32::from(missed);
    }
}

/// Starts a run and waits for its end. Returns the acceptance and the record.
pub fn execute(rig: &mut RigRun, run: Run) -> (RunAccepted, RunRecord) {
    let accepted = rig.device.run(run).expect("the run is accepted");
    let record = rig.ended(&accepted);
    (accepted, record)
}

/// Executes a run that ends with this fault.
pub fn faulted(rig: &mut RigRun, run: Run, fault: RigFault, what: &str) -> RunRecord {
    let accepted = rig.device.run(run).expect(what);
    let record = rig.ended(&accepted);
    let outcome = RunOutcome::Faulted(fault);
    assert_eq!(record.outcome, outcome, "{what}\n{}", rig.log());
    record
}

/// Sets `rig` up to home in a fraction of a second, for tests that home often.
pub fn home_quickly(rig: &mut RigRun) {
    for (key, value) in [
        (SettingKey::SeekUmS, 40_000),
        (SettingKey::LocateUmS, 10_000),
        (SettingKey::HomingAccelUmS2, 1_000_000),
        (SettingKey::PullOffUm, 1_000),
    ] {
        rig.set(key, value);
    }
}

/// A short, quick run by speeds.
pub fn quick(cycles: u16, stroke_um: u32, speed_um_s: u32, accel_um_s2: u32) -> Run {
    Run {
        stroke_um,
        timing: RunTiming::Speeds {
            forward_um_s: speed_um_s,
            return_um_s: speed_um_s,
            accel_um_s2,
        },
        ..paper(cycles)
    }
}
