//! `virtual-bench bench`: performance of the rig's image, measured on the emulator in instructions and virtual time.

use std::time::Instant;

use client::error::ClientError;
use client::link::Link as _;
use client::{Device, KEEP_ALIVE_US, Unobserved};
use protocol::frame::{Header, Kind, encode};
use protocol::rig::{GetRigHealth, Run as RunRequest, RunTiming};
use protocol::settings::{Setting, SettingKey};
use protocol::system::{DeviceKind, Urgent};
use protocol::table::Request;
use trials::experiment::PAPER_RUN;

use crate::bench::{Bench, BenchOptions};
use crate::boards::rig::{self, RigBoard};
use crate::budget;
use crate::cycles;
use crate::faults::When;
use crate::link::VirtualLink;
use crate::peers;
use crate::pins::EdgeLog;
use crate::plants::rig::{Action, Rig, RigOptions, Switch};
use crate::unmeasured::FigureError;
use crate::verdicts::{Run, TICK_NS, Verdict};

/// One cycle of the paper's run.
const ONE_CYCLE: RunRequest = RunRequest {
    cycles: 1,
    timing: RunTiming::Total {
        total_us: 8_000_000,
        accel_um_s2: 100_000,
    },
    ..PAPER_RUN
};

/// The same with another acceleration: in cruise a step takes 3502.493 ticks, so hardly any two periods are equal.
const UNEVEN_CYCLE: RunRequest = RunRequest {
    timing: RunTiming::Total {
        total_us: 8_000_000,
        accel_um_s2: 99_855,
    },
    ..ONE_CYCLE
};

struct Homed {
    bench: Bench<RigBoard>,
    device: Device,
    ips: u64,
}

fn homed(ips: u64) -> Result<Homed, FigureError> {
    homed_on(RigOptions::REFERENCE, ips)
}

/// A rig that times its steps, at the processor speed for which loads are stated.
fn timed() -> Result<Homed, FigureError> {
    homed_on(RigOptions::WITH_BOTH_JUMPERS, 65_000_000)
}

fn homed_on(rig: RigOptions, ips: u64) -> Result<Homed, FigureError> {
    let mut options = BenchOptions::new(rig::image());
    options.chip.instructions_per_second = ips;
    let bench = Bench::start(RigBoard::new(Rig::new(rig)), options)?;
    let mut device = Device::connect(
        Box::new(VirtualLink::new(&bench, "virtual rig")),
        DeviceKind::Rig,
        1,
    )?;
    let accepted = device.home()?;
    device.wait_homing(&accepted, &mut Unobserved)?;
    Ok(Homed { bench, device, ips })
}

impl Homed {
    /// Fraction of the processor's time that it is awake, measured over `us`.
    fn load(&mut self, us: u64) -> Result<f64, FigureError> {
        let before = (
            self.bench.visit(|visit| visit.instructions())?,
            self.bench.now_ns(),
        );
        self.device.idle(us, &mut Unobserved)?;
        let after = (
            self.bench.visit(|visit| visit.instructions())?,
            self.bench.now_ns(),
        );
        let seconds = (after.1 - before.1) as f64 * 1e-9;
        Ok((after.0 - before.0) as f64 / (seconds * self.ips as f64))
    }

    /// The load in the middle of a run's first stroke, and virtual seconds per wall second.
    fn load_in(&mut self, run: RunRequest) -> Result<(f64, f64), FigureError> {
        self.device.run(run)?;
        self.device.idle(1_000_000, &mut Unobserved)?;
        let wall = Instant::now();
        let load = self.load(2_000_000)?;
        Ok((load, 2.0 / wall.elapsed().as_secs_f64()))
    }

    /// The longest time without sleep within `us`, to 10 us. No task takes longer, interrupts included.
    fn longest_awake_us(&mut self, us: u64) -> Result<u64, FigureError> {
        const STEP_US: u64 = 10;
        // Allow for single instructions that fall beyond the end of a step.
        let awake = self.ips * STEP_US / 1_000_000 * 49 / 50;
        let (mut longest, mut present) = (0, 0);
        let mut before = self.bench.visit(|visit| visit.instructions())?;
        for _ in 0..us / STEP_US {
            self.bench.advance_us(STEP_US)?;
            let now = self.bench.visit(|visit| visit.instructions())?;
            present = if now - before >= awake {
                present + STEP_US
            } else {
                0
            };
            longest = longest.max(present);
            before = now;
        }
        Ok(longest)
    }

    /// Sends a request without waiting for its answer.
    fn send(&mut self, request: &Request) -> Result<(), FigureError> {
        let header = Header {
            kind: Kind::Request,
            session: self.device.identity().map_or(0, |it| it.session),
            // Ahead of the client's own numbers, but not so far that it would wrap to behind them.
            seq: 20_000,
        };
        let frame = encode(header, request).expect("every message fits");
        let mut link = VirtualLink::new(&self.bench, "virtual rig");
        Ok(link.send(&frame).map_err(ClientError::from)?)
    }

    fn edges(&self) -> Result<(usize, u64), FigureError> {
        Ok(self.bench.visit(|visit| {
            let edges = visit.board().rig.edges();
            (
                edges.len(),
                edges.iter().next_back().map_or(0, |edge| edge.at_ns),
            )
        })?)
    }
}

/// The load in the cruise of the highest step rate that the settings allow: 1/32 microsteps at 156.2 mm/s.
fn load_at_the_highest_rate() -> Result<f64, FigureError> {
    let mut rig = homed_on(
        RigOptions::WITH_BOTH_JUMPERS.with_steps_per_mm(1_600),
        65_000_000,
    )?;
    for (key, value) in [
        (SettingKey::Microsteps, 32),
        (SettingKey::MaxSpeedUmS, 156_250),
    ] {
        rig.device.call(Setting { key, value })?;
    }
    let accepted = rig.device.home()?;
    rig.device.wait_homing(&accepted, &mut Unobserved)?;
    rig.device.run(RunRequest {
        timing: RunTiming::Speeds {
            forward_um_s: 156_200,
            return_um_s: 156_200,
            accel_um_s2: 2_000_000,
        },
        far_dwell_us: 1_000,
        ..ONE_CYCLE
    })?;
    rig.device.idle(200_000, &mut Unobserved)?;
    rig.load(500_000)
}

/// Measures all figures and prints each with its goal.
///
/// # Errors
/// The emulator or the link failed. A figure that misses its goal is not an error.
pub fn run(say: &mut dyn FnMut(&str)) -> Result<(), FigureError> {
    let mut line =
        |what: &str, value: String, goal: &str| say(&format!("{what:<58} {value:<28} {goal}"));
    line("figure", "measured".into(), "goal, or best seen elsewhere");

    let mut rig = homed(65_000_000)?;
    line(
        "CPU load at rest (65 M instructions/s)",
        format!("{:.2} %", rig.load(1_000_000)? * 1e2),
        "",
    );
    let first = rig.edges()?.0;
    let accepted = rig.device.run(ONE_CYCLE)?;
    rig.device.idle(1_000_000, &mut Unobserved)?;
    let wall = Instant::now();
    let load = rig.load(2_000_000)?;
    let speed = 2.0 / wall.elapsed().as_secs_f64();
    line(
        "CPU load at 28.5 kHz",
        format!("{:.2} %", load * 1e2),
        "< 3 %",
    );
    line(
        "instructions per step at 28.5 kHz, all tasks together",
        format!("{:.0}", load * 65e6 / 28_547.0),
        "Klipper 46 cycles, without planning",
    );
    line(
        "virtual seconds per wall second while stepping",
        format!("{speed:.1}"),
        ">= 4",
    );
    rig.device.wait_run(&accepted, &mut Unobserved)?;
    let edges = rig
        .bench
        .visit(move |visit| visit.board().rig.edges().since(first))?;
    let verdict = Verdict::of(
        &Run {
            cycles: 1,
            ..Run::paper()
        },
        &edges,
    );
    line(
        "longest deviation of an edge",
        format!("{:.2} ns", verdict.worst.0),
        "<= 10 ns; Klipper 25 us",
    );

    let (load, _) = homed(65_000_000)?.load_in(UNEVEN_CYCLE)?;
    line(
        "CPU load at 28.5 kHz, hardly any two periods equal",
        format!("{:.2} %", load * 1e2),
        "",
    );

    let (load, speed) = timed()?.load_in(ONE_CYCLE)?;
    line(
        "CPU load at 28.5 kHz, each step timed",
        format!("{:.2} %", load * 1e2),
        "< 6 %; nobody else times them",
    );
    line(
        "    virtual seconds per wall second",
        format!("{speed:.1}"),
        "",
    );
    let load = timed()?.load_in(UNEVEN_CYCLE)?.0;
    line(
        "    hardly any two periods equal",
        format!("{:.2} %", load * 1e2),
        "",
    );

    let health = rig.device.call(GetRigHealth)?;
    let quickest = load_at_the_highest_rate()?;
    line(
        "CPU load at 249.9 kHz, each step timed",
        format!("{:.2} %", quickest * 1e2),
        "",
    );
    line(
        "longest delay of control, homing and one cycle",
        format!("{} us", health.control_late_us),
        "its round is 10 ms",
    );
    line(
        "stack used, of",
        format!("{} of {} bytes", health.stack_used, health.stack_size),
        "",
    );

    let mut awake = homed(65_000_000)?;
    awake.device.set_telemetry(5)?;
    let at_rest = awake.longest_awake_us(200_000)?;
    awake.send(&Request::Run(ONE_CYCLE))?;
    let begun = awake.longest_awake_us(50_000)?;
    awake.bench.advance_us(1_000_000)?;
    let stepping = awake.longest_awake_us(200_000)?;
    let moved = awake.edges()?.0 > 10_000;
    line(
        "longest time awake, telemetry at 200 Hz: at rest",
        format!("{at_rest} us"),
        "",
    );
    line(
        "    a run is asked for, solved, begun, answered",
        format!("{begun} us"),
        "",
    );
    line(
        "    at 28.5 kHz",
        if moved {
            format!("{stepping} us")
        } else {
            "the rig did not move".into()
        },
        "the ring holds 8,000 us",
    );

    // The far limit opens in the middle of a stroke.
    let number = rig.edges()?.0 as u64 + 50_000;
    rig.bench.visit(move |visit| {
        visit
            .board()
            .rig
            .plan(When::Edge(number), Action::Stick(Switch::Far, Some(true)))
    })?;
    let accepted = rig.device.run(ONE_CYCLE)?;
    rig.device.wait_run(&accepted, &mut Unobserved)?;
    let (opened_ns, last_ns) = rig.bench.visit(move |visit| {
        let edges = visit.board().rig.edges();
        let opened = edges
            .iter()
            .nth(number as usize - 1)
            .map_or(0, |edge| edge.at_ns);
        (
            opened,
            edges.iter().next_back().map_or(0, |edge| edge.at_ns),
        )
    })?;
    line(
        "far limit to last edge",
        format!("{:.1} us", (last_ns - opened_ns) as f64 / 1e3),
        "<= 50 us; Klipper >= 45 us",
    );

    let mut rig = homed(65_000_000)?;
    rig.device.run(ONE_CYCLE)?;
    rig.device.idle(2_000_000, &mut Unobserved)?;
    let sent_ns = rig.bench.now_ns();
    rig.device.urgent(Urgent::EStop)?;
    rig.device.idle(20_000, &mut Unobserved)?;
    let after_us = rig.edges()?.1.saturating_sub(sent_ns) as f64 / 1e3;
    line(
        "E-stop frame's first bit to last edge, 115200 baud",
        format!("{after_us:.1} us"),
        "<= 2 ms",
    );

    for ips in [40, 25, 16, 12, 8] {
        let result = (|| {
            let mut rig = homed(ips * 1_000_000)?;
            let first = rig.edges()?.0;
            let accepted = rig.device.run(ONE_CYCLE)?;
            rig.device.wait_run(&accepted, &mut Unobserved)?;
            let edges = rig
                .bench
                .visit(move |visit| visit.board().rig.edges().since(first))?;
            Ok::<_, FigureError>(Verdict::of(
                &Run {
                    cycles: 1,
                    ..Run::paper()
                },
                &edges,
            ))
        })();
        let value = match result {
            Ok(verdict) if verdict.edges.0 == verdict.edges.1 => {
                format!("{:.2} ns off", verdict.worst.0)
            }
            Ok(verdict) => format!("stopped at edge {}", verdict.edges.0),
            Err(error) => format!("failed: {error}"),
        };
        line(
            &format!("one cycle at {ips} M instructions/s"),
            value,
            "margin below 65",
        );
    }
    let costs = cycles_of_cases(&mut line)?;
    budget::run(&mut line)?;
    peers::run(Some(&image(&edges, costs)), say)
}

/// The image's row in the table of the peers: the edges of a stroke, and the costs without telemetry.
fn image(edges: &EdgeLog, costs: [cycles::Cost; CASES]) -> peers::Image {
    let [_, cruise, uneven, ramp, fine, quickest] = costs;
    let per_case = |cost: cycles::Cost| (cost.steps, cost.instructions, cost.cycles);
    let first = edges.iter().next().map_or(0, |edge| edge.at_ns);
    let stroke = Run::paper().forward;
    // The only origin of time is the first edge's nearest tick.
    let origin = ((stroke.instant(1) + 500) / 1_000) as u64;
    let ticks = edges
        .iter()
        .take(stroke.steps as usize)
        .map(|edge| (edge.at_ns - first) / TICK_NS + origin);
    peers::Image {
        ticks: ticks.collect(),
        costs: [ramp, cruise, uneven].map(per_case),
        shares: [uneven, fine, quickest].map(|cost| cost.shares()[1]),
        cycles_at_most: quickest.cycles[1] as f64 / quickest.steps as f64,
    }
}

/// 20 mm there and back on a screw of 2 mm with 64 microsteps: 400.497 ticks a step.
const FINEST: RunRequest = RunRequest {
    cycles: 1,
    stroke_um: 20_000,
    timing: RunTiming::Speeds {
        forward_um_s: 39_014,
        return_um_s: 39_014,
        accel_um_s2: 2_000_000,
    },
    far_dwell_us: 1_000,
    ..PAPER_RUN
};

/// The same at 99.9 kHz: 1001.414 ticks a step.
const FINE: RunRequest = RunRequest {
    timing: RunTiming::Speeds {
        forward_um_s: 15_603,
        return_um_s: 15_603,
        accel_um_s2: 2_000_000,
    },
    ..FINEST
};

/// Number of cases below.
const CASES: usize = 6;

/// Name, settings, steps per millimetre, run, start of the window in the run in us, and goal.
type CycleCase<'a> = (
    &'a str,
    &'a [(SettingKey, u32)],
    i64,
    Option<RunRequest>,
    u64,
    &'a str,
);

/// Cycles of the worst cases by the model, each step timed. Each case is followed for as long as the host is silent
/// between two signs of life: a shorter window would count its requests too often. Returns the costs without telemetry.
fn cycles_of_cases(
    line: &mut dyn FnMut(&str, String, &str),
) -> Result<[cycles::Cost; CASES], FigureError> {
    let mut costs = Vec::with_capacity(CASES);
    let fine = [(SettingKey::LeadUm, 2_000), (SettingKey::Microsteps, 64)];
    let cases: [CycleCase<'_>; CASES] = [
        ("at rest", &[], 800, None, 100_000, ""),
        (
            "paper's cruise, 28.5 kHz",
            &[],
            800,
            Some(ONE_CYCLE),
            600_000,
            "< 4 %",
        ),
        (
            "28.5 kHz, 3502.493 ticks a step",
            &[],
            800,
            Some(UNEVEN_CYCLE),
            600_000,
            "< 6 %",
        ),
        ("ramp of the same", &[], 800, Some(UNEVEN_CYCLE), 50_000, ""),
        (
            "99.9 kHz, 1001.414 ticks a step",
            &fine,
            6_400,
            Some(FINE),
            100_000,
            "",
        ),
        (
            "249.7 kHz, 400.497 ticks a step",
            &fine,
            6_400,
            Some(FINEST),
            100_000,
            "< 50 %",
        ),
    ];
    for (what, settings, steps_per_mm, run, after_us, goal) in cases {
        for (telemetry_ms, how_often) in [(0, "no telemetry"), (5, "at 200 Hz")] {
            let settings = settings.iter().map(|&(key, value)| Setting { key, value });
            let cost = cycles::measure(&cycles::Case {
                settings: settings.collect(),
                steps_per_mm,
                timed: true,
                telemetry_ms,
                run,
                after_us,
                lasts_us: KEEP_ALIVE_US,
            })?;
            if telemetry_ms == 0 {
                costs.push(cost);
            }
            let percent =
                |[least, most]: [f64; 2]| format!("{:.1} to {:.1} %", least * 1e2, most * 1e2);
            line(
                &format!("cycles, {how_often}: {what}"),
                percent(cost.shares()),
                goal,
            );
            let bare = percent(cost.shares_without_accelerator());
            line("    with wait states only", bare, "");
            if cost.steps > 0 {
                let steps = cost.steps as f64;
                let [least, most] = cost.cycles.map(|cycles| cycles as f64 / steps);
                let instructions = cost.instructions as f64 / steps;
                let per_step = format!("{instructions:.0}; {least:.0} to {most:.0}");
                line(
                    "    instructions; cycles per step, all tasks together",
                    per_step,
                    "",
                );
            }
        }
    }
    Ok(costs.try_into().expect("one for each case"))
}
