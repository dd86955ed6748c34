//! `virtual-bench bench`: performance of the rig's image, measured on the emulator in instructions and virtual time.

use std::fs;
use std::path::Path;
use std::time::Instant;

use client::error::ClientError;
use client::link::Link as _;
use client::{Device, KEEP_ALIVE_US, Unobserved};
use lab::trials::experiment::PAPER_RUN;
use protocol::frame::{Header, Kind, encode};
use protocol::rig::{GetRigHealth, Run as RunRequest, RunTiming};
use protocol::settings::{Setting, SettingKey};
use protocol::system::{DeviceKind, Urgent};
use protocol::table::Request;

use crate::bench::{Bench, BenchOptions};
use crate::boards::rig::{self, RigBoard};
use crate::budget;
use crate::cycles;
use crate::faults::When;
use crate::link::VirtualLink;
use crate::peers::{self, table_head};
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

/// Instructions per second of virtual time that the emulator executes. By the cycle model, the chip executes 42 to 71
/// million, depending on the code.
const IPS: u64 = 65_000_000;

struct Homed {
    bench: Bench<RigBoard>,
    device: Device,
    ips: u64,
}

fn homed(ips: u64) -> Result<Homed, FigureError> {
    homed_on(RigOptions::REFERENCE, ips)
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
    /// Virtual seconds per second of this computer, in the middle of a run's first stroke.
    fn speed(&mut self) -> Result<f64, FigureError> {
        self.device.idle(1_000_000, &mut Unobserved)?;
        let wall = Instant::now();
        self.device.idle(2_000_000, &mut Unobserved)?;
        Ok(2.0 / wall.elapsed().as_secs_f64())
    }

    /// Most instructions without sleep within `us`, with a resolution of 10 us. No task takes more, interrupts
    /// included.
    fn longest_awake(&mut self, us: u64) -> Result<u64, FigureError> {
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
        Ok(longest * self.ips / 1_000_000)
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

/// Measures all figures and prints each with its goal. `klipper` is the folder of Klipper's sources, for its row in the
/// table of the peers; `page` a page of the manual, whose tables of cycles and peers are written anew.
///
/// # Errors
/// The emulator or the link failed, Klipper's sources cannot be compiled or run, or the page has no such tables. A
/// figure that misses its goal is not an error.
pub fn run(
    klipper: Option<&Path>,
    page: Option<&Path>,
    say: &mut dyn FnMut(&str),
) -> Result<(), FigureError> {
    let mut line =
        |what: &str, value: String, goal: &str| say(&format!("{what:<58} {value:<28} {goal}"));
    line("figure", "measured".into(), "goal, or best seen elsewhere");

    let mut rig = homed(IPS)?;
    let first = rig.edges()?.0;
    let accepted = rig.device.run(ONE_CYCLE)?;
    let speed = rig.speed()?;
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

    let mut timed = homed_on(RigOptions::WITH_BOTH_JUMPERS, IPS)?;
    timed.device.run(ONE_CYCLE)?;
    line(
        "    each step timed",
        format!("{:.1}", timed.speed()?),
        ">= 20",
    );

    let health = rig.device.call(GetRigHealth)?;
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

    let mut awake = homed(IPS)?;
    awake.device.set_telemetry(5)?;
    let at_rest = awake.longest_awake(200_000)?;
    awake.send(&Request::Run(ONE_CYCLE))?;
    let begun = awake.longest_awake(50_000)?;
    awake.bench.advance_us(1_000_000)?;
    let stepping = awake.longest_awake(200_000)?;
    let moved = awake.edges()?.0 > 10_000;
    line(
        "most instructions without sleep, telemetry at 200 Hz: at rest",
        at_rest.to_string(),
        "",
    );
    line(
        "    a run is asked for, solved, begun, answered",
        begun.to_string(),
        "",
    );
    line(
        "    at 28.5 kHz",
        if moved {
            stepping.to_string()
        } else {
            "the rig did not move".into()
        },
        "the ring holds 330,000",
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

    let mut rig = homed(IPS)?;
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
            "the chip has 42 or more",
        );
    }
    budget::run(&mut line)?;
    let (costs, cycles) = cycles_of_cases()?;
    let peers = peers::table(Some(&image(&edges, costs)), klipper)?;
    for table in [&cycles, &peers] {
        say("");
        say(table);
    }
    if let Some(page) = page {
        write_into(page, &[&cycles, &peers])?;
    }
    Ok(())
}

/// Puts tables into a page, each in place of the one with the same heading.
fn write_into(page: &Path, tables: &[&str]) -> Result<(), FigureError> {
    let failed = |what: String| FigureError::Page { what };
    let text = fs::read_to_string(page).map_err(|error| failed(error.to_string()))?;
    let text = tables.iter().try_fold(text, |text, table| {
        replaced(&text, table).ok_or_else(|| failed("it has no table with this heading".into()))
    })?;
    fs::write(page, text).map_err(|error| failed(error.to_string()))
}

/// The page with this table in place of the one with the same heading.
fn replaced(page: &str, table: &str) -> Option<String> {
    let head = table.lines().next()?;
    let start = page.find(&format!("\n{head}\n"))? + 1;
    let rows = page[start..].split_inclusive('\n');
    let length: usize = rows
        .take_while(|line| line.starts_with('|'))
        .map(str::len)
        .sum();
    Some(format!(
        "{}{table}\n{}",
        &page[..start],
        &page[start + length..]
    ))
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

/// Name, settings, steps per millimetre, run, start of the window in the run in us, and goal in percent, 0 for none.
type CycleCase<'a> = (
    &'a str,
    &'a [(SettingKey, u32)],
    i64,
    Option<RunRequest>,
    u64,
    u8,
);

/// Heading of the table of cycles, in `docs/performance.md` too.
const CYCLES_HEAD: &str = "\
| run | telemetry | instructions per step | cycles per step | share of the processor | the same with wait states only \
| goal |";

/// A row of the table: goal in percent, 0 for none.
fn cycles_row(what: &str, telemetry: &str, cost: &cycles::Cost, goal: u8) -> String {
    let percent = |[least, most]: [f64; 2]| format!("{:.1} to {:.1} %", least * 1e2, most * 1e2);
    let (instructions, per_step) = if cost.steps > 0 {
        let steps = cost.steps as f64;
        let [least, most] = cost.cycles.map(|cycles| cycles as f64 / steps);
        (
            format!("{:.0}", cost.instructions as f64 / steps),
            format!("{least:.0} to {most:.0}"),
        )
    } else {
        ("-".to_owned(), "-".to_owned())
    };
    let goal = match goal {
        0 => String::new(),
        goal if cost.shares()[1] * 1e2 > f64::from(goal) => format!(" **{goal} %, missed**"),
        goal => format!(" {goal} %"),
    };
    format!(
        "| {what} | {telemetry} | {instructions} | {per_step} | {} | {} |{goal} |",
        percent(cost.shares()),
        percent(cost.shares_without_accelerator())
    )
}

/// Cycles of the worst cases by the model, each step timed. Each case is followed for as long as the host is silent
/// between two signs of life: a shorter window would count its requests too often. Returns the costs without telemetry,
/// and the table.
fn cycles_of_cases() -> Result<([cycles::Cost; CASES], String), FigureError> {
    let mut costs = Vec::with_capacity(CASES);
    let fine = [(SettingKey::LeadUm, 2_000), (SettingKey::Microsteps, 64)];
    let cases: [CycleCase<'_>; CASES] = [
        ("at rest", &[], 800, None, 100_000, 0),
        (
            "the paper's cruise, 28.5 kHz",
            &[],
            800,
            Some(ONE_CYCLE),
            600_000,
            4,
        ),
        (
            "3502.493 ticks a step, 28.5 kHz",
            &[],
            800,
            Some(UNEVEN_CYCLE),
            600_000,
            6,
        ),
        ("its ramp", &[], 800, Some(UNEVEN_CYCLE), 50_000, 0),
        (
            "1001.414 ticks a step, 99.9 kHz",
            &fine,
            6_400,
            Some(FINE),
            100_000,
            0,
        ),
        (
            "400.497 ticks a step, 249.7 kHz",
            &fine,
            6_400,
            Some(FINEST),
            100_000,
            50,
        ),
    ];
    let mut rows = table_head(CYCLES_HEAD);
    for (what, settings, steps_per_mm, run, after_us, goal) in cases {
        for (telemetry_ms, how_often) in [(0, "none"), (5, "200 Hz")] {
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
            rows.push(cycles_row(what, how_often, &cost, goal));
            if telemetry_ms == 0 {
                costs.push(cost);
            }
        }
    }
    let costs = costs.try_into().expect("one for each case");
    Ok((costs, rows.join("\n")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_takes_the_place_of_the_one_with_its_heading() {
        let page = "text\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\nmore\n| c |\n";
        let new = "| a | b |\n|---|---|\n| 3 | 4 |\n| 5 | 6 |";
        let page = replaced(page, new).expect("found");
        assert_eq!(
            page,
            "text\n\n| a | b |\n|---|---|\n| 3 | 4 |\n| 5 | 6 |\n\nmore\n| c |\n"
        );
        // Written again, it is the same.
        assert_eq!(replaced(&page, new).as_ref(), Some(&page));
        assert_eq!(replaced(&page, "| b | a |\n|---|---|"), None);
    }

    /// The page has both tables, so that `bench --page` finds them.
    #[test]
    fn the_manual_has_the_tables() {
        let page = include_str!("../../docs/performance.md");
        for head in [CYCLES_HEAD, peers::HEAD] {
            assert!(
                replaced(page, &table_head(head).join("\n")).is_some(),
                "{head}"
            );
        }
    }
}
