//! The events that the bench skips must have no effect: seeded scenarios, with and without skipping.

use std::fmt::Debug;

use crate::common::{Dice, Recorder, RigRun, home_quickly, quick, start, trials};
use protocol::{
    rig::{Hold, LinkLossPolicy, Resume, Run},
    system::Urgent,
};
use sha2::{Digest, Sha256};
use virtual_bench::{
    bench::BenchOptions,
    boards::rig as board,
    faults::When,
    pins::{EdgeLog, Fingerprint},
    plants::{
        rig::{Action, RigOptions, Switch},
        wire::Fault,
    },
};

const SEED: u64 = 0x0028_57E9;
/// The chip's RAM.
const RAM: std::ops::Range<u32> = 0x2000_0000..0x2002_0000;

/// All results of a scenario.
#[derive(Debug, PartialEq, Eq)]
struct Left {
    /// The actions, for the text of a failure.
    story: String,
    edges: Fingerprint,
    syncs: Vec<u64>,
    /// Records, telemetry, log, and the bench's own counts.
    reported: String,
    /// Registers and RAM, at some instants within the run and at the end.
    chip: Vec<(Vec<Option<u32>>, Fingerprint)>,
    now_ns: u64,
}

/// Registers of the step timer, its read-back and capture, and of both DMA controllers' status and streams 4 and 5.
fn registers() -> impl Iterator<Item = u32> {
    let timers = [0x4001_0000, 0x4000_0000, 0x4000_0C00_u32];
    let timers = timers.into_iter().flat_map(|at| (at..at + 0x50).step_by(4));
    let controllers = [0x4002_6000, 0x4002_6400_u32];
    let controllers = controllers
        .into_iter()
        .flat_map(|at| (at..at + 8).chain(at + 0x70..at + 0xA0).step_by(4));
    timers.chain(controllers)
}

fn chip(rig: &RigRun) -> (Vec<Option<u32>>, Fingerprint) {
    let seen = rig.bench.visit(|visit| {
        let mut hash = Sha256::new();
        for address in RAM.step_by(4) {
            hash.update(visit.word(address).unwrap_or_default().to_le_bytes());
        }
        let seen = registers().map(|address| visit.register(address)).collect();
        (seen, Fingerprint(hash.finalize().into()))
    });
    seen.expect("the bench runs")
}

fn scenario(number: u64, options: BenchOptions) -> Left {
    let mut dice = Dice(SEED ^ number.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    for _ in 0..8 {
        dice.roll(0..2);
    }
    let rig = RigOptions {
        carriage: dice.roll(1_000..20_000) as i64,
        ..[RigOptions::WITH_BOTH_JUMPERS, RigOptions::REFERENCE][usize::from(number % 4 == 3)]
    };
    let mut options = options;
    options.chip.instructions_per_second =
        [65_000_000, 65_000_000, 100_000_000, 30_000_000][dice.roll(0..4) as usize];
    let mut rig = start(rig, options);
    home_quickly(&mut rig);
    rig.home();
    if dice.roll(0..3) > 0 {
        let period_ms = dice.roll(5..60) as u16;
        rig.device.set_telemetry(period_ms).expect("telemetry");
    }
    let (run, mishap, later) = (
        plan(&mut dice),
        mishap(number, &mut dice, &rig),
        dice.roll(0..4),
    );
    let story = format!("{number}: {run:?}, {mishap:?}, {later}");
    if let Some((when, action)) = mishap {
        rig.with(move |rig| rig.plan(when, action));
    }
    let accepted = rig.device.run(run).expect(&story);
    let at_us = dice.roll(10_000..700_000);
    let mut reported = Vec::new();
    let mut tell = |what: &dyn Debug| reported.push(format!("{what:?}"));
    tell(&accepted);
    let mut snapshots = Vec::new();
    for _ in 0..dice.roll(0..6) {
        rig.bench.advance_us(dice.roll(1..40_000)).expect(&story);
        snapshots.push(chip(&rig));
    }
    match number % 5 {
        0 => {
            rig.bench.advance_us(at_us).expect(&story);
            tell(&rig.device.urgent(Urgent::EStop));
        }
        1 => {
            rig.bench.advance_us(at_us).expect(&story);
            tell(&rig.device.call(Hold));
            rig.idle(dice.roll(1_000..600_000));
            tell(&rig.device.call(Resume));
        }
        2 if later == 0 => {
            rig.bench.advance_us(at_us).expect(&story);
            tell(&rig.device.urgent(Urgent::Stop));
        }
        _ => {}
    }
    let mut recorder = Recorder::default();
    tell(&rig.device.wait_run(&accepted, &mut recorder));
    tell(&recorder.samples);
    tell(&rig.device.rig_status());
    if later == 1 {
        rig.bench.reset().expect(&story);
        rig.bench.advance_us(200_000).expect(&story);
    }
    tell(&rig.bench.bus().expect(&story).resets);
    tell(&rig.with(|rig| {
        (
            rig.carriage(),
            rig.extremes(),
            rig.lost(),
            rig.cut_pulses(),
            rig.violations(),
        )
    }));
    reported.push(rig.log());
    snapshots.push(chip(&rig));
    Left {
        story,
        edges: rig.edges(0).sha256(),
        syncs: rig.with(|rig| rig.syncs().to_vec()),
        reported: reported.join("\n"),
        chip: snapshots,
        now_ns: rig.bench.now_ns(),
    }
}

/// A run of about half a second.
fn plan(dice: &mut Dice) -> Run {
    let mut run = quick(
        dice.roll(1..3) as u16,
        dice.roll(2_000..9_000) as u32,
        dice.roll(5_000..45_000) as u32,
        dice.roll(200_000..2_000_000) as u32,
    );
    run.far_dwell_us = dice.roll(0..20_000) as u32;
    run.start_delay_us = dice.roll(0..20_000) as u32;
    run.link_loss = LinkLossPolicy::Finish;
    run
}

/// A random mishap for the rig, and its instant.
fn mishap(number: u64, dice: &mut Dice, rig: &RigRun) -> Option<(When, Action)> {
    let edge = When::Edge(rig.edge_count() as u64 + dice.roll(1..4_000));
    let at = When::At(rig.bench.now_ns() + dice.roll(10_000_000..600_000_000));
    let when = [edge, at][dice.roll(0..2) as usize];
    Some((
        when,
        match number % 14 {
            0 => Action::EStop(true),
            1 => Action::Stick(Switch::Far, Some(true)),
            2 => Action::Stick(Switch::Home, Some(true)),
            3 => Action::LoseSteps(dice.roll(1..200)),
            4 => Action::ReadBack(Fault::Spike(dice.roll(50..900))),
            5 => Action::ReadBack(Fault::Skip),
            6 => Action::ReadBack(Fault::Whole(false)),
            7 => Action::Capture(Fault::Spike(dice.roll(20..900))),
            8 => Action::Capture(Fault::Delay(dice.roll(1..900))),
            9 => Action::Capture(Fault::Whole(false)),
            10 => Action::Disturb(Switch::EStop, dice.roll(50..900)),
            11 => Action::Capture(Fault::Lose),
            12 => Action::Capture(Fault::Jitter(10 * dice.roll(1..4))),
            _ => return None,
        },
    ))
}

/// Edges with their instants, records, telemetry, log and RAM are the same whether the emulator stops for every event
/// of every timer or only for those that something may notice.
#[test]
fn what_is_left_out_is_noticed_by_nobody() {
    let mut stories = 0;
    // Always include the scenarios with a lost capture and with jitter.
    for number in (0..trials(3, 60)).chain([25, 26]) {
        eprintln!("scenario {number}");
        let every_event = |every_event| {
            let mut options = BenchOptions::new(board::image());
            options.chip.every_event = every_event;
            options
        };
        let (actual, expected) = (
            scenario(number, every_event(false)),
            scenario(number, every_event(true)),
        );
        assert_eq!(actual, expected, "{}", expected.story);
        stories += usize::from(actual.edges != EdgeLog::default().sha256());
    }
    assert!(stories >= 5, "{stories} of them with steps");
}
