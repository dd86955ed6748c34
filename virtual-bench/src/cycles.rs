//! Counts cycles of the rig's processor, with a model of its core and flash that follows the instructions executed by
//! the emulator.
//!
//! | what | how |
//! |---|---|
//! | sequence of instructions, interrupts included | exact: the emulator's, one by one |
//! | cycles of each instruction without waiting (ARM DDI 0439, section 3.3) | exact, but for those below |
//! | refill of the pipeline after a branch | between 1 and 3 |
//! | division | between 2 and 12; its operands are ignored |
//! | a load behind a load or store | 1 to 2: their phases overlap or not |
//! | entry into an interrupt and return | between 22 and 34, a wait for its vector included |
//! | flash as FLASH_ACR sets it: lines, order, wait states (RM0383 section 3.4) | exact; two readings where it is silent |
//! | constants in flash that are loaded relative to the program counter | each as a read of the flash, not kept |
//! | other loads from flash (tables, texts) | not counted as such: like loads from memory |
//! | registers on APB1, APB2, AHB, in the core | bounds: 2 to 8, 1 to 4, 0 to 2, 0 to 1 cycles more |
//! | DMA's share of the bus | at most 2 cycles per transfer, six transfers per step: a slot and a captured instant |
//! | the bytes of the serial line, the same way | ignored: 11,520 a second at most, 0.02 % |
//!
//! Shares of the processor's time refer to its 100 MHz. A board has the last word: the on-target tests read its cycle
//! counter.

mod core;
mod follow;
mod replay;
mod thumb;

use std::path::Path;

use client::{Device, Unobserved};
use object::{Object, ObjectSection, SectionKind};
use protocol::rig::Run;
use protocol::settings::{Setting, SettingKey};
use protocol::system::DeviceKind;

pub use self::core::Accelerator;
pub(crate) use self::core::{Code, Core, EXCEPTION};
pub(crate) use self::follow::follow;
use self::replay::{Recorder, Replay, replay};
use crate::bench::{Bench, BenchError, BenchOptions};
use crate::boards::rig::{self, RigBoard};
use crate::plants::rig::{Rig, RigOptions};
use crate::unmeasured::FigureError;

/// The core's clock, Hz.
pub const CORE_HZ: u64 = 100_000_000;
/// FLASH_ACR (RM0383 section 3.8.1).
pub(crate) const FLASH_ACR: u32 = 0x4002_3C00;
/// Transfers of DMA per step: a slot of the step timer and a captured instant.
const TRANSFERS_PER_STEP: u64 = 6;
/// Most cycles that one of them can hold the core up: in memory and at the timer's bus.
const CYCLES_PER_TRANSFER: u64 = 2;

/// The case to measure.
#[derive(Clone, Debug)]
pub struct Case {
    /// Settings that differ from the defaults.
    pub settings: Vec<Setting>,
    /// Steps per mm of the mechanics for these settings.
    pub steps_per_mm: i64,
    /// Whether the jumper for timing the steps is fitted.
    pub timed: bool,
    /// Period of the telemetry, ms; 0 for none.
    pub telemetry_ms: u16,
    /// The run; `None` for a machine at rest.
    pub run: Option<Run>,
    /// Start of the measurement, us after the run was accepted.
    pub after_us: u64,
    /// Duration of the measurement, us.
    pub lasts_us: u64,
}

/// The measured cost.
#[derive(Clone, Copy, Debug)]
pub struct Cost {
    /// Instructions executed.
    pub instructions: u64,
    /// Least and most cycles, with the accelerator as the image sets it.
    pub cycles: [u64; 2],
    /// The same with wait states only, the accelerator off.
    pub without_accelerator: [u64; 2],
    /// Interrupts and other exceptions.
    pub exceptions: u64,
    /// Steps that left the pin.
    pub steps: u64,
    /// Duration, ns.
    pub lasted_ns: u64,
    /// The accelerator as the image has set it.
    pub accelerator: Accelerator,
}

impl Cost {
    /// Least and greatest share of the processor's time.
    #[must_use]
    pub fn shares(&self) -> [f64; 2] {
        self.cycles.map(|cycles| self.share(cycles))
    }

    /// The same with wait states only.
    #[must_use]
    pub fn shares_without_accelerator(&self) -> [f64; 2] {
        self.without_accelerator.map(|cycles| self.share(cycles))
    }

    fn share(&self, cycles: u64) -> f64 {
        cycles as f64 / (self.lasted_ns as f64 * CORE_HZ as f64 * 1e-9)
    }
}

/// Measures a case.
///
/// # Errors
/// The emulator or the link failed, or a setting or the run was refused.
pub fn measure(case: &Case) -> Result<Cost, FigureError> {
    let options = BenchOptions::new(rig::image());
    let plant = if case.timed {
        RigOptions::WITH_BOTH_JUMPERS
    } else {
        RigOptions::REFERENCE
    };
    let plant = plant.with_steps_per_mm(case.steps_per_mm);
    let board = || RigBoard::new(Rig::new(plant));
    let bench = Bench::start(board(), options.clone())?;
    let (recorder, script) = Recorder::new(&bench);
    let mut device = Device::connect(Box::new(recorder), DeviceKind::Rig, 1)?;
    let quickly = [
        (SettingKey::SeekUmS, 20_000),
        (SettingKey::LocateUmS, 10_000),
        (SettingKey::HomingAccelUmS2, 1_000_000),
        (SettingKey::PullOffUm, 1_000),
    ];
    for (key, value) in quickly {
        device.call(Setting { key, value })?;
    }
    for setting in &case.settings {
        device.call(*setting)?;
    }
    let accepted = device.home()?;
    device.wait_homing(&accepted, &mut Unobserved)?;
    device.set_telemetry(case.telemetry_ms)?;
    if let Some(run) = case.run {
        device.run(run)?;
    }
    device.idle(case.after_us, &mut Unobserved)?;
    let (begun_ns, acr) = (
        bench.now_ns(),
        bench.visit(|visit| visit.register(FLASH_ACR))?,
    );
    let before = bench.visit(|visit| visit.instructions())?;
    device.idle(case.lasts_us, &mut Unobserved)?;
    let ended_ns = bench.now_ns();
    let executed = bench.visit(|visit| visit.instructions())? - before;
    drop(device);

    let accelerator = Accelerator::of_register(acr.unwrap_or(0));
    let script = std::mem::take(
        &mut *script
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner),
    );
    let seen = replay(Replay {
        options: &options,
        board: board(),
        script,
        window_ns: begun_ns..ended_ns,
        code: code(&options.image)?,
        cores: vec![Core::new(accelerator), Core::new(accelerator.off())],
    })?;
    let [core, bare] = &seen.cores[..] else {
        return Err(BenchError::Ended("a core is missing".into()).into());
    };
    let counted = seen.counts.end - seen.counts.start;
    if counted != executed || core.instructions != executed {
        let why = format!(
            "{executed} instructions were executed, {counted} in the replay, {} seen",
            core.instructions
        );
        return Err(BenchError::Ended(why).into());
    }
    let dma = seen.steps as u64 * TRANSFERS_PER_STEP * CYCLES_PER_TRANSFER;
    let with_dma = |[least, most]: [u64; 2]| [least, most + dma];
    Ok(Cost {
        instructions: executed,
        cycles: with_dma(core.cycles()),
        without_accelerator: with_dma(bare.cycles()),
        exceptions: core.exceptions,
        steps: seen.steps as u64,
        lasted_ns: ended_ns - begun_ns,
        accelerator,
    })
}

/// The code of the image: its largest section of instructions.
pub(crate) fn code(path: &Path) -> Result<Code, BenchError> {
    let bad = |why: String| BenchError::BadImage {
        path: path.to_owned(),
        why,
    };
    let file = std::fs::read(path).map_err(|why| bad(why.to_string()))?;
    let file = object::File::parse(&*file).map_err(|why| bad(why.to_string()))?;
    let sections = file
        .sections()
        .filter(|section| section.kind() == SectionKind::Text);
    let text = sections.max_by_key(|section| section.size());
    let text = text.ok_or_else(|| bad("it has no code".into()))?;
    let bytes = text.data().map_err(|why| bad(why.to_string()))?;
    Ok(Code {
        base: text.address() as u32,
        bytes: bytes.to_vec(),
    })
}
