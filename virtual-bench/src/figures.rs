//! `virtual-bench bench`: the load of the rig's image, the speed of the emulator and the sizes of the images, in one
//! table.

use std::path::Path;
use std::time::Instant;

use client::{Device, KEEP_ALIVE_US, Unobserved};
use object::{Object, ObjectSegment};
use protocol::rig::{LinkLossPolicy, Run, RunTiming};
use protocol::settings::{Setting, SettingKey};
use protocol::system::DeviceKind;

use crate::bench::{Bench, BenchError, BenchOptions};
use crate::boards::{capsule, rig};
use crate::emulator::ChipOptions;
use crate::link::VirtualLink;
use crate::plants::rig::{Rig, RigOptions};

/// One cycle of the paper's run: 3503.046 ticks a step in cruise.
const ONE_CYCLE: Run = Run {
    cycles: 1,
    stroke_um: 130_000,
    timing: RunTiming::Total {
        total_us: 8_000_000,
        accel_um_s2: 100_000,
    },
    far_dwell_us: 0,
    home_dwell_us: 0,
    start_delay_us: 0,
    link_loss: LinkLossPolicy::Stop,
};

/// 3502.493 ticks a step in cruise: hardly any two periods are equal.
const UNEVEN_CYCLE: Run = Run {
    timing: RunTiming::Total {
        total_us: 8_000_000,
        accel_um_s2: 99_855,
    },
    ..ONE_CYCLE
};

/// 20 mm there and back on a screw of 2 mm with 64 microsteps.
const fn fine(speed_um_s: u32) -> Run {
    Run {
        stroke_um: 20_000,
        timing: RunTiming::Speeds {
            forward_um_s: speed_um_s,
            return_um_s: speed_um_s,
            accel_um_s2: 2_000_000,
        },
        far_dwell_us: 1_000,
        ..ONE_CYCLE
    }
}

/// A row: its name, the run, the start of the measurement in the run, us, and the largest acceptable load without
/// telemetry, percent.
const LOADS: [(&str, Option<Run>, u64, u8); 6] = [
    ("at rest", None, 100_000, 1),
    ("paper's cruise, 28.5 kHz", Some(ONE_CYCLE), 600_000, 4),
    (
        "3502.493 ticks a step, 28.5 kHz",
        Some(UNEVEN_CYCLE),
        600_000,
        6,
    ),
    ("its ramp", Some(UNEVEN_CYCLE), 50_000, 6),
    (
        "1001.414 ticks a step, 99.9 kHz",
        Some(fine(15_603)),
        100_000,
        20,
    ),
    (
        "400.497 ticks a step, 249.7 kHz",
        Some(fine(39_014)),
        100_000,
        50,
    ),
];

/// Telemetry of the second column, ms.
const TELEMETRY_MS: u16 = 5;

/// Prints the table. A figure that misses its goal is not an error.
///
/// # Errors
/// The emulator or the link failed, or an image is missing.
pub fn run(say: &mut dyn FnMut(&str)) -> Result<(), BenchError> {
    let mut row = |what: &str, measured: [String; 2], goal: &str| {
        let [first, second] = measured;
        say(&format!("{what:<36} {first:<26} {second:<26} {goal}"));
    };
    let heads = ["no telemetry", "telemetry at 200 Hz"].map(str::to_owned);
    row("load, each step timed", heads, "goal without telemetry");
    for (what, run, after_us, goal) in LOADS {
        let mut rig = Homed::with(run)?;
        let quiet = rig.load(run, 0, after_us)?;
        let mut rig = Homed::with(run)?;
        let streaming = rig.load(run, TELEMETRY_MS, after_us)?;
        row(what, [quiet, streaming], &format!("<= {goal} %"));
    }
    let heads = ["edges counted", "each edge timed"].map(str::to_owned);
    row("virtual seconds per second", heads, "");
    let counted = Homed::new(RigOptions::REFERENCE, None)?.speed()?;
    let timed = Homed::new(RigOptions::WITH_BOTH_JUMPERS, None)?.speed()?;
    row(
        "paper's run",
        [counted, timed].map(|speed| format!("{speed:.1}")),
        ">= 20",
    );
    row("bytes of", ["flash", "RAM"].map(str::to_owned), "");
    for (what, image) in [
        ("firmware-rig", rig::image()),
        ("firmware-capsule", capsule::image()),
    ] {
        row(
            what,
            sizes(&image)?.map(|bytes| bytes.to_string()),
            "<= 196608 of flash",
        );
    }
    Ok(())
}

struct Homed {
    bench: Bench<rig::RigBoard>,
    device: Device,
}

impl Homed {
    /// Homes a rig whose mechanics fit `run`.
    fn with(run: Option<Run>) -> Result<Self, BenchError> {
        let fine = run.filter(|run| run.stroke_um < ONE_CYCLE.stroke_um);
        Self::new(RigOptions::WITH_BOTH_JUMPERS, fine)
    }

    fn new(mut plant: RigOptions, fine: Option<Run>) -> Result<Self, BenchError> {
        let mut settings = vec![
            (SettingKey::SeekUmS, 20_000),
            (SettingKey::LocateUmS, 10_000),
            (SettingKey::HomingAccelUmS2, 1_000_000),
            (SettingKey::PullOffUm, 1_000),
        ];
        if fine.is_some() {
            plant = plant.with_steps_per_mm(6_400);
            settings.extend([(SettingKey::LeadUm, 2_000), (SettingKey::Microsteps, 64)]);
        }
        let board = rig::RigBoard::new(Rig::new(plant));
        let bench = Bench::start(board, BenchOptions::new(rig::image()))?;
        let link = Box::new(VirtualLink::new(&bench, "virtual rig"));
        let mut device = Device::connect(link, DeviceKind::Rig, 1)?;
        for (key, value) in settings {
            device.call(Setting { key, value })?;
        }
        let accepted = device.home()?;
        device.wait_homing(&accepted, &mut Unobserved)?;
        Ok(Self { bench, device })
    }

    /// Load from `after_us` on, for as long as the host is silent between two keep-alives: a shorter window would count
    /// its requests too often.
    fn load(
        &mut self,
        run: Option<Run>,
        telemetry_ms: u16,
        after_us: u64,
    ) -> Result<String, BenchError> {
        self.device.set_telemetry(telemetry_ms)?;
        if let Some(run) = run {
            self.device.run(run)?;
        }
        self.device.idle(after_us, &mut Unobserved)?;
        let counts = |bench: &Bench<rig::RigBoard>| {
            bench.visit(|visit| (visit.instructions(), visit.board().rig.edges().len()))
        };
        let before = counts(&self.bench)?;
        self.device.idle(KEEP_ALIVE_US, &mut Unobserved)?;
        let after = counts(&self.bench)?;
        let instructions = (after.0 - before.0) as f64;
        let steps = (after.1 - before.1) as f64;
        let possible = ChipOptions::default().instructions_per_second as f64 * KEEP_ALIVE_US as f64;
        let percent = instructions / possible * 1e8;
        Ok(match run {
            Some(_) => format!("{:.0} per step, {percent:.1} %", instructions / steps),
            None => format!("{percent:.1} %"),
        })
    }

    /// Virtual seconds per second of this computer, in cruise of the paper's run.
    fn speed(&mut self) -> Result<f64, BenchError> {
        self.device.run(ONE_CYCLE)?;
        self.device.idle(1_000_000, &mut Unobserved)?;
        let begin = Instant::now();
        self.device.idle(2_000_000, &mut Unobserved)?;
        Ok(2.0 / begin.elapsed().as_secs_f64())
    }
}

/// Bytes of flash and of RAM that an image takes, without its stack.
fn sizes(path: &Path) -> Result<[u64; 2], BenchError> {
    let elf = std::fs::read(path).map_err(|why| BenchError::NoImage {
        path: path.to_owned(),
        why,
    })?;
    let file = object::File::parse(&*elf).map_err(|why| BenchError::BadImage {
        path: path.to_owned(),
        why: why.to_string(),
    })?;
    let mut bytes = [0; 2];
    for segment in file.segments() {
        bytes[0] += segment.file_range().1;
        if segment.address() >= 0x2000_0000 {
            bytes[1] += segment.size();
        }
    }
    Ok(bytes)
}
