//! Faults around the rig: resets, power cuts, lost steps, bad switches.

use std::sync::mpsc::channel;
use std::thread;
use std::time::Duration;

use client::link::halves::Direct;
use client::link::tcp;
use client::{Device, Unobserved};

use crate::common::{
    Dice, Recorder, execute, homed, paper, quick, quickly_homed, refusal, rig, rig_from_flash,
    trials,
};
use protocol::{
    error::Refusal,
    rig::{MoveTo, RigFault, RigState, Run, RunOutcome, RunTiming},
    settings::{FactoryReset, GetSetting, Setting, SettingKey},
    system::{DeviceKind, ResetCause, Urgent},
};
use virtual_bench::bench::{Bench, BenchOptions};
use virtual_bench::boards::rig::{RigBoard, image};
use virtual_bench::fixture::Plug;
use virtual_bench::plants::rig::{Action, Rig, RigOptions};
use virtual_bench::plants::wire::Fault;
use virtual_bench::serve::Server;

/// 10 mm there and back.
fn short(cycles: u16) -> Run {
    Run {
        stroke_um: 10_000,
        timing: RunTiming::Total {
            total_us: u64::from(cycles) * 1_500_000,
            accel_um_s2: 100_000,
        },
        ..paper(cycles)
    }
}

/// Afterwards the rig has stopped, reports that its position is lost, and can be homed.
#[test]
fn a_reset_or_a_power_cut_moves_nothing_and_forgets_the_position() {
    let mut rig = homed();
    for (nonce, cause) in [(2, ResetCause::Pin), (3, ResetCause::PowerOn)] {
        rig.device.run(short(1)).expect("the run is accepted");
        rig.idle(500_000);
        assert!(rig.carriage() > 1_000, "it is on its way");
        // A reset releases DIR at once, so wait until no pulse is in progress.
        while rig.bench.now_ns() < rig.last_edge_ns() + 5_000 {
            rig.pass(1);
        }
        let (edges, before_ns) = (rig.edge_count(), rig.bench.now_ns());
        if cause == ResetCause::Pin {
            rig.reset(nonce);
        } else {
            rig.power_cycle(nonce);
            assert!(rig.bench.now_ns() > before_ns + 1_000_000_000);
        }
        assert_eq!(rig.edge_count(), edges, "it moved by itself\n{}", rig.log());
        let identity = rig.device.identity().expect("a session");
        assert_eq!(identity.reset_cause, cause);
        let status = rig.status();
        assert_eq!((status.state, status.homed), (RigState::Unhomed, false));
        rig.home();
    }
    rig.check_clean(1);
}

/// A machine that is served runs in real time and does not pause for whoever cuts its supply.
#[test]
fn a_served_rig_comes_back_after_a_power_cut() {
    let bench = rig().bench;
    let server = Server::listen(0).expect("a free port");
    let address = format!("127.0.0.1:{}", server.port());
    let served = bench.clone();
    thread::spawn(move || server.serve(&served, "rig", &Plug::default()));
    let halves = tcp::open(&address, Duration::from_secs(5)).expect("it listens");
    let link = Box::new(Direct::new(address.clone(), halves));
    let mut device = Device::connect(link, DeviceKind::Rig, 1).expect("it is served");
    let (cut, answered) = channel();
    thread::spawn(move || cut.send(bench.power_cycle(100_000)));
    let answer = answered.recv_timeout(Duration::from_secs(60));
    answer.expect("an answer").expect("the bench runs");
    // It needs time to boot, on a busy computer more.
    let back = (2..60).find_map(|nonce| device.hello(nonce).ok());
    let back = back.expect("it answers again");
    assert_eq!((back.reset_cause, back.boot_id), (ResetCause::PowerOn, 1));
}

/// After power-up the RAM holds anything, another thing each time. A reset keeps what it holds.
#[test]
fn ram_holds_noise_after_power_up() {
    // Nothing is executed before time passes.
    let options = BenchOptions::new(image());
    let board = RigBoard::new(Rig::new(RigOptions::default()));
    let bench = Bench::start(board, options).expect("the image boots");
    let observe = |bench: &Bench<RigBoard>| {
        let words = bench.visit(|visit| {
            let read = |at: u32| visit.word(0x2000_0000 + 4 * at);
            (0..0x8000).map(read).collect::<Option<Vec<u32>>>()
        });
        words.expect("the bench runs").expect("RAM")
    };
    let first = observe(&bench);
    let ones = first.iter().map(|word| word.count_ones()).sum::<u32>();
    assert!(ones.abs_diff(16 * 0x8000) < 5_000, "{ones} ones");
    bench.power_cycle(1_000_000).expect("the bench runs");
    let second = observe(&bench);
    let same = first.iter().zip(&second).filter(|(one, two)| one == two);
    assert!(same.count() < 5);
    bench.advance_us(1_000).expect("the bench runs");
    let used = observe(&bench);
    assert_ne!(used, second, "the image writes");
    bench.reset().expect("the bench runs");
    assert_eq!(observe(&bench), used);
}

/// Steps lost away from home and towards it. Up to the limit the run goes on and reports their number; beyond it the
/// run ends at the flag.
#[test]
fn lost_steps_are_counted_and_beyond_the_limit_end_the_run() {
    let limit = u64::from(SettingKey::MaxResidualSteps.range().default);
    let mut rig = quickly_homed();
    rig.device.set_telemetry(5).expect("telemetry");
    for lost in [1, 2, limit - 1, limit, limit + 1, 16, 64] {
        for homewards in [false, true] {
            lose(&mut rig, lost, homewards, lost > limit);
        }
    }
    rig.check_clean(0);
}

/// One run of two cycles with `lost` steps missing from its first one; the rig is homed before and after.
fn lose(rig: &mut crate::common::RigRun, lost: u64, homewards: bool, beyond: bool) {
    const STROKE: u64 = 3_200;
    // Stop distance at 20 mm/s: two times 160 steps, for control's period of 10 ms and for braking at 1 m/s2, and a
    // margin.
    const STOP: i64 = 160 + 160 + 5;
    let what = format!("{lost} lost, homewards: {homewards}");
    let place = 1_000 + if homewards { STROKE } else { 0 };
    let before = rig.with(|rig| rig.lost());
    rig.plan_at(place, Action::LoseSteps(lost));
    // After a loss on the way out the carriage meets the flag early; after one on the way back, late.
    let residual = lost as i32 * if homewards { -1 } else { 1 };
    let (_, record) = execute(rig, quick(2, 4_000, 20_000, 500_000));
    let status = rig.device.rig_status().expect(&what);
    let mut recorder = Recorder::default();
    rig.device.idle(20_000, &mut recorder).expect(&what);
    let reported = recorder.rigs().last().map(|sample| sample.residual_steps);
    assert_eq!(reported, Some(residual), "{what}");
    assert_eq!(record.worst_residual_steps, residual, "{what}");
    assert_eq!(rig.with(|rig| rig.lost()) - before, lost, "{what}");
    if beyond {
        let fault = RigFault::LostSteps {
            residual_steps: residual,
        };
        assert_eq!((status.fault, status.homed), (Some(fault), false), "{what}");
        let ended = (record.outcome, record.strokes);
        assert_eq!(ended, (RunOutcome::Faulted(fault), 1), "{what}");
        let past = 800 - rig.carriage();
        assert!(
            (0..=STOP).contains(&past),
            "{what}: {past} steps past the flag"
        );
        return rig.recover(&what);
    }
    let ended = (record.outcome, record.strokes);
    assert_eq!(ended, (RunOutcome::Complete, 4), "{what}");
    assert_eq!((status.fault, record.counted_edges), (None, 4 * STROKE));
    assert_eq!(rig.carriage(), i64::from(-residual), "{what}");
    // Homing finds the reference displaced by the same number of steps, and corrects it.
    let accepted = rig.device.home().expect(&what);
    let homed = rig.device.wait_homing(&accepted, &mut Unobserved);
    let homed = homed.expect(&what);
    assert_eq!((homed.shift_steps, rig.carriage()), (residual, 0), "{what}");
}

/// The flag opens while the rig brakes for a stop: the count is wrong all the same.
#[test]
fn steps_that_were_lost_before_a_stop_are_found() {
    let mut rig = quickly_homed();
    let before = rig.edge_count();
    rig.plan_at(1_000, Action::LoseSteps(64));
    let run = quick(1, 4_000, 20_000, 500_000);
    rig.device.run(run).expect("the run is accepted");
    // Step 1,000 of 3,200 on the way home. It brakes over 160 steps, begins within 150, and meets the flag at 864.
    while rig.edge_count() < before + 3_200 + 2_200 {
        rig.idle(500);
    }
    rig.device.urgent(Urgent::Stop).expect("it is heard");
    rig.idle(100_000);
    let status = rig.status();
    let fault = RigFault::LostSteps { residual_steps: 64 };
    assert_eq!((status.fault, status.homed), (Some(fault), false));
}

/// Regression: noise on the read-back at rest moved the counter, and every motion after it went as much too far, up to
/// the far end and beyond.
#[test]
fn a_count_that_noise_has_moved_at_rest_is_a_fault_before_anything_moves() {
    let mut rig = homed();
    let first = rig.edge_count();
    for _ in 0..9 {
        rig.act(Action::ReadBack(Fault::Spike(1_000)));
        rig.pass(100);
    }
    let to = MoveTo {
        position_um: 0,
        speed_um_s: 10_000,
    };
    let (commanded, counted) = (0, -9);
    let fault = RigFault::ReadBack { commanded, counted };
    assert_eq!(refusal(rig.device.call(to)), Refusal::RigFaulted(fault));
    let status = rig.status();
    assert_eq!((status.fault, status.homed), (Some(fault), false));
    rig.pass(100_000);
    assert_eq!(rig.edge_count(), first);
    rig.recover("the count is known");
    rig.check_clean(0);
}

/// Cuts the jumper at rest or at an edge, on the way out and on the way back. The carriage must stop long before the
/// stroke ends, and the fault must name both counts.
#[test]
fn a_cut_jumper_is_found_within_a_few_hundred_steps() {
    // Steps until the stop at 14 kHz: 8 ms of prepared steps, with the repeats of the ring's last entry, before the
    // first miss shows; as many before the stop takes effect; then braking.
    const NOTICED: u64 = 128 + 128 + 80;
    for (cut, counted) in [(0, 0), (5_000, 4_999), (11_000, 5_001)] {
        let mut rig = homed();
        let first = rig.edge_count() as u64;
        let jumper = Action::ReadBack(Fault::Whole(false));
        if cut == 0 {
            rig.act(jumper);
        } else {
            rig.plan_at(cut, jumper);
        }
        let (_, record) = execute(&mut rig, short(2));
        let status = rig.status();
        let fault = RigFault::ReadBack {
            commanded: rig.carriage() as i32,
            counted,
        };
        assert_eq!((status.fault, status.homed), (Some(fault), false), "{cut}");
        assert_eq!(record.outcome, RunOutcome::Faulted(fault), "{cut}");
        let edges = rig.edge_count() as u64 - first;
        assert!(
            edges <= cut + NOTICED,
            "cut at edge {cut}, stopped at {edges}"
        );
        rig.check_clean(0);
    }
}

/// At the paper's cruise speed 20 ms may pass before braking starts: the prepared steps, one round of the task, and the
/// prepared steps again.
#[test]
fn a_cut_jumper_brakes_the_papers_run_within_20_ms() {
    const CUT: usize = 50_000;
    const CRUISE_NS: u64 = 35_040;
    let mut rig = homed();
    let first = rig.edge_count();
    rig.plan_at(CUT as u64, Action::ReadBack(Fault::Whole(false)));
    let (_, record) = execute(&mut rig, paper(1));
    assert!(matches!(
        record.outcome,
        RunOutcome::Faulted(RigFault::ReadBack { .. })
    ));
    let edges: Vec<u64> = rig.edges(first).iter().map(|edge| edge.at_ns).collect();
    let after = &edges[CUT - 1..];
    let mut pairs = after.windows(2);
    let braking = pairs.find(|pair| pair[1] - pair[0] > CRUISE_NS);
    let braking = braking.expect("it stops before the end");
    let waited_ns = braking[0] - after[0];
    assert!(waited_ns <= 20_000_000, "{waited_ns} ns");
    // Braking from 35.7 mm/s takes 0.64 mm: 510 steps, rounded up.
    let braked = edges.len() - edges.partition_point(|&at| at <= braking[0]);
    assert!(braked <= 511, "{braked} steps");
    rig.check_clean(0);
}

/// With noise instead of settings the rig starts with the defaults. A sector is erased by the first change at the
/// latest, and the core stands still meanwhile; if nothing looks like a log, the reset to the defaults erases it.
#[test]
fn a_flash_full_of_noise_starts_with_the_defaults_and_is_erased() {
    const SETTINGS: std::ops::Range<usize> = 0x4000..0x1_0000;
    const ERASE_NS: u64 = 250_000_000;
    let blank = rig().visit(|visit| visit.flash());
    let mut resets = Vec::new();
    for seed in 0..trials(4, 12) {
        let mut flash = blank.clone();
        let mut dice = Dice(0xF1A5_4005 + 7919 * seed);
        flash[SETTINGS].fill_with(|| dice.roll(0..256) as u8);
        let mut rig = rig_from_flash(flash);
        for key in SettingKey::of(DeviceKind::Rig) {
            let found = rig.device.call(GetSetting { key }).expect("it answers");
            assert_eq!(found.value, key.range().default, "{}", key.name());
        }
        let (key, value) = (SettingKey::SeekUmS, 15_000);
        let answer = rig.device.call(Setting { key, value });
        if answer.is_err() {
            assert_eq!(refusal(answer), Refusal::StorageFailed, "seed {seed}");
            rig.device.call(FactoryReset).expect("it erases");
            rig.set(key, value);
            resets.push(seed);
        }
        let instructions = rig.visit(|visit| visit.instructions());
        let ns = rig.bench.now_ns();
        assert!(ns >= ERASE_NS, "nothing was erased within {ns} ns");
        // A polling core would execute 65 instructions per microsecond.
        let most = ns / 1_000 * 65 / 2;
        assert!(
            instructions < most,
            "{instructions} instructions in {ns} ns"
        );
        rig.power_cycle(9);
        let kept = rig.device.call(GetSetting { key }).expect("it answers");
        assert_eq!(kept.value, value, "seed {seed}");
        rig.home();
        rig.check_clean(0);
    }
    // In all other cases the change is accepted directly.
    assert_eq!(resets, [1]);
}
