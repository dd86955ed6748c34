//! Tests of the rig's image at its pins.

use crate::common::{
    Dice, Recorder, exact, execute, faulted, home_quickly, homed, paper, quickly_homed, rig_with,
    run_of, trials,
};
use protocol::{
    rig::{RigFault, RigState, Run, RunOutcome, RunTiming},
    system::Urgent,
};
use virtual_bench::{
    plants::rig::{Action, RigOptions},
    verdicts::Verdict,
};

/// The position is set anew where the flag is found, between two samples of the telemetry. That is no motion.
#[test]
fn telemetry_shows_no_impossible_speed_while_homing() {
    let mut rig = rig_with(RigOptions {
        carriage: 8_000,
        ..RigOptions::default()
    });
    home_quickly(&mut rig);
    rig.device.set_telemetry(20).expect("telemetry");
    let accepted = rig.device.home().expect("accepted");
    let mut recorder = Recorder::default();
    let homed = rig.device.wait_homing(&accepted, &mut recorder);
    homed.unwrap_or_else(|error| panic!("{error}\n{}", rig.log()));
    assert!(recorder.samples.len() > 20, "{}", recorder.samples.len());
    for sample in recorder.rigs() {
        // It seeks with 40 mm/s.
        assert!(sample.speed_um_s.unsigned_abs() <= 41_000, "{sample:?}");
    }
    rig.check_clean(0);
}

/// The paper's experiment: 5 cycles of 130 mm in 40 s.
#[test]
fn every_edge_of_the_papers_run_is_where_it_belongs() {
    let mut rig = homed();
    let first = rig.edge_count();
    rig.with(|rig| rig.forget_extremes());
    let (accepted, record) = execute(&mut rig, paper(5));
    let edges = rig.edges(first);
    rig.is_exact(&exact(5), first);
    let verdict = Verdict::of(&exact(5), &edges);
    assert_eq!(verdict.edges, (1_040_000, 1_040_000));
    assert_eq!(
        (verdict.strokes, verdict.extremes, verdict.end),
        (10, (0, 104_000), 0)
    );
    assert!(verdict.duration_ns.abs_diff(40_000_000_000) <= 1_000);
    // The firmware's own report.
    assert_eq!(accepted.total_ticks, 4_000_000_000);
    assert_eq!(
        (record.outcome, record.ticks),
        (RunOutcome::Complete, 4_000_000_000)
    );
    assert_eq!((record.strokes, record.worst_residual_steps), (10, 0));
    for edges in [accepted.edges, record.commanded_edges, record.counted_edges] {
        assert_eq!(edges, 1_040_000);
    }
    assert_eq!((record.min_steps, record.max_steps), (0, 104_000));
    // The mechanics.
    let mechanics = rig.with(|rig| (rig.carriage(), rig.extremes(), rig.lost()));
    assert_eq!(mechanics, (0, (0, 104_000), 0));
    // One sync pulse at each stroke's first step.
    let syncs = rig.with(|rig| rig.syncs().to_vec());
    let of_the_run: Vec<u64> = syncs
        .into_iter()
        .filter(|at| *at >= edges.iter().next().unwrap().at_ns - 10_000)
        .collect();
    let firsts = edges.iter().step_by(104_000).map(|edge| edge.at_ns);
    assert_eq!(of_the_run.len(), 10);
    for (sync, first) in of_the_run.into_iter().zip(firsts) {
        assert!(
            sync.abs_diff(first) <= 10_000,
            "sync at {sync} ns, not {first}"
        );
    }
    rig.check_clean(0);
}

#[test]
fn dwells_delay_and_separate_speeds_are_exact() {
    let mut rig = homed();
    let first = rig.edge_count();
    let run = Run {
        stroke_um: 40_000,
        timing: RunTiming::Speeds {
            forward_um_s: 10_000,
            return_um_s: 30_000,
            accel_um_s2: 200_000,
        },
        far_dwell_us: 250_000,
        start_delay_us: 100_000,
        ..paper(2)
    };
    let (accepted, record) = execute(&mut rig, run);
    assert_eq!(record.outcome, RunOutcome::Complete);
    // Speed and acceleration must be as requested, within the resolution of a tick.
    for (stroke, um_s) in [(accepted.forward, 10_000), (accepted.back, 30_000)] {
        assert!((um_s - 1..=um_s).contains(&stroke.peak_um_s), "{stroke:?}");
        assert!(
            (199_990..=200_000).contains(&stroke.accel_um_s2),
            "{stroke:?}"
        );
    }
    let exact = run_of(&run, &accepted);
    rig.is_exact(&exact, first);
    let verdict = Verdict::of(&exact, &rig.edges(first));
    assert_eq!(verdict.duration_ns / 10 + 10_000_000, accepted.total_ticks);
    rig.check_clean(0);
}

/// The fault's event is still on its way when the run's end is known. The next homing must not take that event as its
/// own.
#[test]
fn homing_right_after_a_fault_is_not_ended_by_its_late_event() {
    let mut rig = homed();
    rig.plan_at(1_000, Action::EStop(true));
    faulted(&mut rig, paper(1), RigFault::EStopLoop, "cut");
    rig.act(Action::EStop(false));
    rig.recover("the cause is gone");
}

#[test]
fn an_estop_frame_ends_the_pulses_within_2_ms() {
    let trials = trials(6, 10);
    let mut dice = Dice(0x5EED_0002);
    let mut rig = quickly_homed();
    for trial in 0..trials {
        rig.device.run(paper(1)).expect("the run is accepted");
        rig.idle(dice.roll(10_000..7_500_000));
        let sent_ns = rig.bench.now_ns();
        rig.device.urgent(Urgent::EStop).expect("an answer");
        rig.idle(50_000);
        // Counted from the first bit at the pin: the 11 bytes alone take 0.95 ms.
        let took_ns = rig.last_edge_ns().saturating_sub(sent_ns);
        assert!(took_ns <= 2_000_000, "trial {trial}: {took_ns} ns");
        rig.recover("the cause is gone");
    }
    // An immediate stop sometimes cuts a pulse.
    rig.check_clean_after(0, trials);
}

#[test]
fn a_stop_decelerates_and_keeps_the_position() {
    let mut dice = Dice(0x5EED_0003);
    let mut rig = quickly_homed();
    for trial in 0..trials(10, 20) {
        let first = rig.edge_count();
        // Homing passes position 0, a run does not.
        rig.with(|rig| rig.forget_extremes());
        let accepted = rig.device.run(paper(1)).expect("the run is accepted");
        rig.idle(dice.roll(0..7_900_000));
        let sent_ns = rig.bench.now_ns();
        rig.device.urgent(Urgent::Stop).expect("an answer");
        let record = rig.ended(&accepted);
        let what = format!("trial {trial}");
        assert_eq!(record.outcome, RunOutcome::Stopped, "{what}");
        rig.idle(300_000);
        let status = rig.status();
        let ready = (RigState::Ready, true);
        assert_eq!((status.state, status.homed), ready, "{what}\n{}", rig.log());
        assert_eq!(i64::from(status.position_steps), rig.carriage(), "{what}");
        let edges: Vec<u64> = rig.edges(first).iter().map(|edge| edge.at_ns).collect();
        if let Some(last_ns) = edges.last() {
            let after_ns = last_ns.saturating_sub(sent_ns);
            let way = edges.iter().filter(|at_ns| **at_ns > sent_ns).count();
            assert!(
                after_ns <= 100_000_000 && way <= 4_000,
                "{what}: {after_ns} ns, {way} steps"
            );
        }
        // It slows down: once the stop takes effect at cruise, no interval is shorter than the one before.
        let gaps: Vec<u64> = edges.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let fastest = gaps.iter().copied().min().unwrap_or(u64::MAX);
        assert!(fastest >= 35_000, "{what}: {fastest} ns between two steps");
        if (30_001..70_000).contains(&gaps.len()) {
            let braking = &gaps[gaps.len() - 20..];
            let slows = braking.windows(2).all(|pair| pair[1] + 20 >= pair[0]);
            assert!(slows && braking[19] > 5 * fastest, "{what}: {braking:?}");
        }
        let (low, high) = rig.with(|rig| rig.extremes());
        assert!(low >= 0 && high <= 104_000, "{what}: {low} to {high}");
        rig.home();
    }
    rig.check_clean(0);
}

#[test]
fn two_virtual_runs_are_identical_to_the_byte() {
    let record = || {
        let mut rig = homed();
        rig.device.set_telemetry(10).expect("telemetry");
        let mut recorder = Recorder::default();
        let accepted = rig.device.run(paper(1)).expect("the run is accepted");
        let ended = rig.device.wait_run(&accepted, &mut recorder);
        ended.expect("the run ends");
        assert_eq!(recorder.missed, 0, "telemetry was lost on a good line");
        let count = recorder.samples.len();
        assert!(count >= 790, "{count} samples in 8 s at 100 Hz");
        let edges = rig.with(|rig| rig.edges().sha256());
        (edges, format!("{:?}", recorder.samples))
    };
    let (first, second) = (record(), record());
    assert!(first.0 == second.0, "the edges differ");
    assert!(first.1 == second.1, "the telemetry differs");
}
