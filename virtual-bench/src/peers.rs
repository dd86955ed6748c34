//! The step generator beside its peers: each way to time the steps of a move, run on the same emulated core, counted by
//! the same model of its cycles, judged by the same exact profile, in one table.
//!
//! A peer is measured without its caller: its interrupt's entry and return (22 to 34 cycles) are added to its share and
//! its rate, everything else that a machine needs is not. A separate row has the firmware's cost of all that together.

mod follow;
mod klipper;

use std::ops::Range;
use std::path::Path;

use self::follow::{Cost, Followed, Peers};
use self::klipper::Compressor;
use crate::bench::images;
use crate::boards::rig;
use crate::cycles::{Accelerator, CORE_HZ, EXCEPTION, FLASH_ACR};
use crate::plants::rig::RigOptions;
use crate::unmeasured::FigureError;
use crate::verdicts::{Stroke, TICK_HZ};

/// Thousandths of a tick per microsecond.
const PARTS_PER_US: f64 = 1e5;
/// Rates at which shares are stated, Hz.
const RATES_HZ: [f64; 3] = [28_500.0, 100_000.0, 250_000.0];
/// Most alarms per step for refilling the ring: one when half of 232 entries of at least one step have played.
const RING_ALARMS: f64 = 1.0 / 116.0;

/// A way to time steps: its number in the image, and what follows from its design.
struct Method {
    number: u32,
    name: &'static str,
    interrupts_per_step: f64,
    /// When a stop with a ramp begins.
    stops: &'static str,
}

const STEP: &str = "next step";
const RING: &str = "ring, 8 ms";
const METHODS: [Method; 7] = [
    Method::of(1, "ours, in batches as the image", RING_ALARMS, RING),
    Method::of(2, "ours, one by one", 1.0, STEP),
    Method::of(3, "ramp-maker 0.2, its fixed point", 1.0, STEP),
    Method::of(4, "ramp-maker 0.2, f32", 1.0, STEP),
    Method::of(5, "stepgen 0.1.3", 1.0, STEP),
    Method::of(6, "Austin, AVR446", 1.0, STEP),
    Method::of(7, "segments of 10 ms", 1.0, "segment, 10 ms"),
];

impl Method {
    const fn of(
        number: u32,
        name: &'static str,
        interrupts_per_step: f64,
        stops: &'static str,
    ) -> Self {
        Self {
            number,
            name,
            interrupts_per_step,
            stops,
        }
    }
}

/// The firmware's image, as the figures before this table measured it.
#[derive(Clone, Debug)]
pub struct Image {
    /// Rising edges of the first stroke of the paper's run, ticks.
    pub ticks: Vec<u64>,
    /// In the ramp, the paper's cruise, with hardly any two periods equal: steps, instructions, least and most cycles.
    pub costs: [(u64, u64, [u64; 2]); 3],
    /// Share of the processor's time at 28.5, 99.9 and 249.7 kHz, hardly any two periods equal: most.
    pub shares: [f64; 3],
    /// Most cycles per step at 249.7 kHz.
    pub cycles_at_most: f64,
}

/// How far edges are from the exact profile, us.
#[derive(Clone, Copy, Debug)]
struct Errors {
    /// Largest, with the origin of time that makes it smallest: the time from the start of a move to its first step
    /// does not matter.
    largest: f64,
    /// Root of the mean square, about the mean.
    rms: f64,
    /// Largest from the start of the move.
    from_start: f64,
    /// Steps too few (negative) or too many.
    surplus: i64,
}

impl Errors {
    fn of(order: &Stroke, ticks: impl Iterator<Item = u64>) -> Self {
        let (mut least, mut most, mut sum, mut squares) = (f64::MAX, f64::MIN, 0.0, 0.0);
        let mut given = 0_u64;
        for tick in ticks {
            given += 1;
            if given > order.steps {
                continue;
            }
            let exact = order.instant(given) as i128;
            let off = (i128::from(tick) * 1_000 - exact) as f64 / PARTS_PER_US;
            (least, most) = (least.min(off), most.max(off));
            sum += off;
            squares += off * off;
        }
        let count = given.min(order.steps).max(1) as f64;
        let mean = sum / count;
        Self {
            largest: (most - least) / 2.0,
            rms: (squares / count - mean * mean).max(0.0).sqrt(),
            from_start: least.abs().max(most.abs()),
            surplus: given as i64 - order.steps as i64,
        }
    }

    fn of_followed(order: &Stroke, followed: &Followed) -> Self {
        let mut tick = 0;
        let intervals = followed.intervals.iter();
        let each =
            intervals.flat_map(|(interval, steps)| std::iter::repeat_n(*interval, *steps as usize));
        Self::of(
            order,
            each.map(|interval| {
                tick += u64::from(interval);
                tick
            }),
        )
    }
}

/// A row of the table.
struct Row {
    name: String,
    paper: Errors,
    /// Largest error at 249.7 kHz, as text.
    quick: String,
    /// None if the steps are timed by another computer.
    costs: Option<Costs>,
    bytes: Option<u64>,
    stops: &'static str,
}

/// Costs of timing for the microcontroller.
struct Costs {
    ramp: Cost,
    cruise: Cost,
    /// A cruise with hardly any two intervals equal.
    worst: Cost,
    interrupts_per_step: f64,
    shares: [f64; 3],
    most_hz: f64,
}

/// Heading of the table, in `docs/performance.md` too.
pub const HEAD: &str = "\
| method | largest error, us | rms, us | largest from the start, us | largest at 249.7 kHz, us \
| instructions per step: ramp, cruise, worst fraction | cycles: ramp | cruise | worst fraction | interrupts per step \
| share at most at 28.5, 100, 250 kHz, % | kHz at most | bytes of code | ramped stop begins after |";

fn us(value: f64) -> String {
    if value < 1.0 {
        format!("{value:.4}")
    } else {
        format!("{value:.0}")
    }
}

impl Cost {
    fn instructions_per_step(&self) -> f64 {
        self.instructions as f64 / self.steps as f64
    }

    fn cycles_per_step(&self) -> [f64; 2] {
        self.cycles.map(|cycles| cycles as f64 / self.steps as f64)
    }

    fn shown(&self) -> String {
        let [least, most] = self.cycles_per_step();
        format!("{least:.0} to {most:.0}")
    }
}

impl Row {
    fn shown(&self) -> String {
        let mut line = format!("| {} |", self.name);
        let mut cell = |text: String| line.push_str(&format!(" {text} |"));
        let surplus = match self.paper.surplus {
            0 => String::new(),
            surplus => format!(" ({surplus:+} steps)"),
        };
        cell(us(self.paper.largest) + &surplus);
        cell(us(self.paper.rms));
        cell(us(self.paper.from_start));
        cell(self.quick.clone());
        match &self.costs {
            Some(costs) => costs.shown().map(&mut cell),
            None => [(); Costs::CELLS].map(|()| cell("-".into())),
        };
        cell(self.bytes.map_or("-".into(), |bytes| bytes.to_string()));
        cell(self.stops.into());
        line
    }
}

impl Costs {
    const CELLS: usize = 7;

    fn shown(&self) -> [String; Self::CELLS] {
        let costs = [self.ramp, self.cruise, self.worst];
        let instructions = costs.map(|cost| format!("{:.0}", cost.instructions_per_step()));
        let shares = self.shares.map(|share| format!("{:.1}", share * 1e2));
        [
            instructions.join(", "),
            self.ramp.shown(),
            self.cruise.shown(),
            self.worst.shown(),
            format!("{:.4}", self.interrupts_per_step),
            shares.join(", "),
            format!("{:.0}", self.most_hz / 1e3),
        ]
    }
}

/// The first stroke of the paper's run.
fn paper() -> Stroke {
    Stroke::within(104_000, 4 * TICK_HZ, 80_000).expect("feasible")
}

/// The same with 99.855 mm/s2: in cruise a step takes 3502.493 ticks.
fn uneven() -> Stroke {
    Stroke::within(104_000, 4 * TICK_HZ, 79_884).expect("feasible")
}

/// 20 mm on a screw of 2 mm with 64 microsteps, 2 m/s2: 400.497 ticks a step.
const QUICK: Stroke = Stroke {
    steps: 128_000,
    duration_ticks: 51_263_616 + 1_950_700,
    ramp_ticks: 1_950_700,
};

/// A move whose steps are all followed, for the size of the code that they take.
const SHORT: Stroke = Stroke {
    steps: 2_000,
    duration_ticks: 35_000_000,
    ramp_ticks: 14_000_000,
};

/// The part of it that is followed; setting up comes before the first step.
const NEARLY_ALL: Range<u64> = 1..SHORT.steps - 1;

/// Steps of the cruise that are followed.
const CRUISE: Range<u64> = 30_000..34_000;

/// Windows in both ramps of a move, without the first and last steps: these take longest, but also have most time.
fn ramps(order: &Stroke) -> [Range<u64>; 2] {
    let (n, ramp) = (order.steps, order.ramp_ticks);
    let steps = n * ramp / (2 * (order.duration_ticks - ramp));
    [steps / 8..steps - 400, n - steps + 400..n - steps / 8]
}

fn row(peers: &Peers, method: &Method) -> Result<Option<Row>, FigureError> {
    let (paper, uneven) = (paper(), uneven());
    let [up, down] = ramps(&paper);
    let Some(followed) = peers.run(method.number, &paper, &[up, CRUISE, down])? else {
        return Ok(None);
    };
    let Some(worst) = peers.run(method.number, &uneven, &[CRUISE])? else {
        return Ok(None);
    };
    let quick = peers.run(method.number, &QUICK, &[])?;
    let short = peers.run(method.number, &SHORT, &[NEARLY_ALL])?;
    let (ramp, cruise) = (followed.costs[0] + followed.costs[2], followed.costs[1]);
    let worst = worst.costs[0];
    let with_entry =
        |cost: Cost| cost.cycles_per_step()[1] + method.interrupts_per_step * EXCEPTION[1] as f64;
    let core_hz = CORE_HZ as f64;
    Ok(Some(Row {
        name: method.name.to_owned(),
        paper: Errors::of_followed(&paper, &followed),
        quick: quick.map_or("refused".into(), |followed| {
            us(Errors::of_followed(&QUICK, &followed).largest)
        }),
        costs: Some(Costs {
            ramp,
            cruise,
            worst,
            interrupts_per_step: method.interrupts_per_step,
            shares: RATES_HZ.map(|rate| with_entry(worst) * rate / core_hz),
            most_hz: core_hz / with_entry(worst).max(with_entry(ramp)),
        }),
        bytes: short.map(|followed| followed.code_bytes),
        stops: method.stops,
    }))
}

fn image_row(image: &Image) -> Row {
    let cost = |(steps, instructions, cycles)| Cost {
        steps,
        instructions,
        cycles,
    };
    let [ramp, cruise, worst] = image.costs.map(cost);
    Row {
        name: "ours, the whole image, each step timed".into(),
        paper: Errors::of(&paper(), image.ticks.iter().copied()),
        quick: "-".into(),
        costs: Some(Costs {
            ramp,
            cruise,
            worst,
            interrupts_per_step: RING_ALARMS,
            shares: image.shares,
            most_hz: CORE_HZ as f64 / image.cycles_at_most,
        }),
        bytes: None,
        stops: RING,
    }
}

/// Klipper's compressor, from its sources in this folder.
fn klipper_row(sources: &Path) -> Result<Row, FigureError> {
    let compressor = Compressor::build(sources)?;
    let (ticks, commands) = compressor.run(&paper())?;
    let (quick, _) = compressor.run(&QUICK)?;
    Ok(Row {
        name: format!("Klipper, planned by a host in {commands} commands"),
        paper: Errors::of(&paper(), ticks.into_iter()),
        quick: us(Errors::of(&QUICK, quick.into_iter()).largest),
        costs: None,
        bytes: None,
        stops: "a host's plan",
    })
}

/// The flash as the firmware sets it.
fn accelerator() -> Result<Accelerator, FigureError> {
    let bench = rig::start(RigOptions::REFERENCE)?;
    bench.advance_us(100_000)?;
    let register = bench.visit(|visit| visit.register(FLASH_ACR))?;
    Ok(Accelerator::of_register(register.unwrap_or(0)))
}

/// The first two lines of a table.
pub(crate) fn table_head(head: &str) -> Vec<String> {
    let columns = head.matches(" | ").count() + 1;
    vec![head.to_owned(), format!("|{}", "---|".repeat(columns))]
}

/// Measures all peers. Returns the table, with a row of the image if its figures are given, and of Klipper if the folder
/// of its sources is.
///
/// # Errors
/// An image is missing, the emulator failed, or Klipper's sources cannot be compiled or run.
pub fn table(image: Option<&Image>, klipper: Option<&Path>) -> Result<String, FigureError> {
    let peers = Peers::read(&images().join("step-peers"), accelerator()?)?;
    let mut lines = table_head(HEAD);
    lines.extend(image.map(|image| image_row(image).shown()));
    for method in &METHODS {
        lines.push(match row(&peers, method)? {
            Some(row) => row.shown(),
            None => format!("| {} | refuses the move |", method.name),
        });
    }
    if let Some(sources) = klipper {
        lines.push(klipper_row(sources)?.shown());
    }
    Ok(lines.join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nearest(order: &Stroke) -> Vec<u64> {
        let instants = (1..=order.steps).map(|k| order.instant(k));
        instants
            .map(|parts| ((parts + 500) / 1_000) as u64)
            .collect()
    }

    #[test]
    fn the_nearest_ticks_are_half_a_tick_off_and_a_late_half_shows() {
        let order = paper();
        let mut ticks = nearest(&order);
        let errors = Errors::of(&order, ticks.iter().copied());
        assert!(
            errors.largest <= 0.005 && errors.from_start <= 0.005_01,
            "{errors:?}"
        );
        assert!((0.002..0.004).contains(&errors.rms), "{errors:?}");
        ticks[52_000..].iter_mut().for_each(|tick| *tick += 200);
        let errors = Errors::of(&order, ticks.into_iter());
        assert!((0.99..1.01).contains(&errors.largest), "{errors:?}");
        assert!((0.99..1.01).contains(&errors.rms), "{errors:?}");
        assert!((1.99..2.01).contains(&errors.from_start), "{errors:?}");
    }

    /// An origin of time of its own is nobody's error; a missing step is told.
    #[test]
    fn the_best_origin_counts() {
        let order = paper();
        let late = nearest(&order).into_iter().map(|tick| tick + 1_000);
        let errors = Errors::of(&order, late.take(103_999));
        assert!(errors.largest <= 0.005, "{errors:?}");
        assert!((9.99..10.01).contains(&errors.from_start), "{errors:?}");
        assert_eq!(errors.surplus, -1);
    }

    /// The numbers of the methods are those of the image, and each row fills the table.
    #[test]
    fn every_method_has_a_row() {
        let image = include_str!("../peers/src/main.rs");
        for (method, number) in METHODS.iter().zip(1..) {
            assert_eq!(method.number, number);
            assert!(
                image.contains(&format!("            {number} => ")),
                "{number}"
            );
        }
        assert!(!image.contains(&format!("            {} => ", METHODS.len() + 1)));
        let columns = HEAD.matches('|').count();
        let image = Image {
            ticks: nearest(&paper()),
            costs: [(100, 6_000, [8_000, 10_000]); 3],
            shares: [0.1, 0.2, 0.6],
            cycles_at_most: 250.0,
        };
        let row = image_row(&image).shown();
        assert_eq!(row.matches('|').count(), columns, "{row}");
        assert!(row.contains("| 60, 60, 60 | 80 to 100 |"), "{row}");
        assert!(row.contains("| 400 |"), "{row}");
        let elsewhere = Row {
            costs: None,
            ..image_row(&image)
        };
        let row = elsewhere.shown();
        assert_eq!(row.matches('|').count(), columns, "{row}");
    }
}
