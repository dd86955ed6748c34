//! Tests of the rig's image at its pins.

use client::error::ClientError;

use crate::common::{
    Dice, LIMIT_NS, Recorder, exact, execute, faulted, home_quickly, homed, paper, quickly_homed,
    rig, rig_with, trials,
};
use protocol::{
    error::{Field, Refusal},
    rig::{LinkLossPolicy, RigFault, RigState, Run, RunOutcome, RunTiming},
    system::Urgent,
    table::Telemetry,
};
use virtual_bench::{
    faults::When,
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
    for sample in &recorder.samples {
        let Telemetry::Rig(sample) = sample else {
            panic!("{sample:?} of a rig");
        };
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
    rig.look(|rig| rig.forget_extremes());
    let (accepted, record) = execute(&mut rig, paper(5));
    let edges = rig.edges(first);
    let verdict = Verdict::of(&exact(5), &edges);
    verdict
        .check(LIMIT_NS)
        .unwrap_or_else(|why| panic!("{why}\n{}", rig.log()));
    assert_eq!(
        (verdict.edges, verdict.strokes),
        ((1_040_000, 1_040_000), 10)
    );
    assert_eq!((verdict.extremes, verdict.end), ((0, 104_000), 0));
    assert!(
        verdict.duration_ns.abs_diff(40_000_000_000) <= 1_000,
        "{verdict}"
    );
    // The firmware's own report.
    assert_eq!(
        (accepted.total_ticks, accepted.edges),
        (4_000_000_000, 1_040_000)
    );
    assert_eq!(record.outcome, RunOutcome::Complete);
    assert_eq!(
        (record.commanded_edges, record.counted_edges),
        (1_040_000, 1_040_000)
    );
    assert_eq!((record.ticks, record.strokes), (4_000_000_000, 10));
    assert_eq!(
        (
            record.min_steps,
            record.max_steps,
            record.worst_residual_steps
        ),
        (0, 104_000, 0)
    );
    // The mechanics.
    assert_eq!(
        rig.look(|rig| (rig.carriage(), rig.extremes(), rig.lost())),
        (0, (0, 104_000), 0)
    );
    // One sync pulse at each stroke's first step.
    let syncs = rig.look(|rig| rig.syncs().to_vec());
    let of_the_run: Vec<u64> = syncs
        .into_iter()
        .filter(|at| *at >= edges.iter().next().unwrap().at_ns - 10_000)
        .collect();
    let firsts = edges.iter().step_by(104_000).map(|edge| edge.at_ns);
    assert_eq!(of_the_run.len(), 10);
    for (sync, first) in of_the_run.into_iter().zip(firsts) {
        assert!(
            sync.abs_diff(first) <= 10_000,
            "sync at {sync} ns, first step at {first} ns"
        );
    }
    rig.check_clean(0);
}

#[test]
fn dwells_delay_and_separate_speeds_are_exact() {
    let mut rig = homed();
    let first = rig.edge_count();
    let run = Run {
        cycles: 2,
        stroke_um: 40_000,
        timing: RunTiming::Speeds {
            forward_um_s: 10_000,
            return_um_s: 30_000,
            accel_um_s2: 200_000,
        },
        far_dwell_us: 250_000,
        home_dwell_us: 0,
        start_delay_us: 100_000,
        link_loss: LinkLossPolicy::Stop,
    };
    let (accepted, record) = execute(&mut rig, run);
    assert_eq!(record.outcome, RunOutcome::Complete);
    let stroke = |stroke: protocol::rig::Stroke| virtual_bench::verdicts::Stroke {
        steps: u64::from(stroke.steps),
        duration_ticks: stroke.duration_ticks,
        ramp_ticks: stroke.ramp_ticks,
    };
    // Speed and acceleration must be as requested, within the resolution of a tick.
    for (stroke, um_s) in [(accepted.forward, 10_000), (accepted.back, 30_000)] {
        assert!(
            stroke.peak_um_s <= um_s && stroke.peak_um_s >= um_s - 1,
            "{stroke:?}"
        );
        assert!(
            stroke.accel_um_s2 <= 200_000 && stroke.accel_um_s2 >= 199_990,
            "{stroke:?}"
        );
    }
    let exact = virtual_bench::verdicts::Run {
        cycles: 2,
        forward: stroke(accepted.forward),
        back: stroke(accepted.back),
        far_dwell_ticks: 25_000_000,
        home_dwell_ticks: 0,
    };
    let verdict = Verdict::of(&exact, &rig.edges(first));
    verdict
        .check(LIMIT_NS)
        .unwrap_or_else(|why| panic!("{why}\n{}", rig.log()));
    assert_eq!(verdict.duration_ns / 10 + 10_000_000, accepted.total_ticks);
    rig.check_clean(0);
}

/// The fault's event is still on its way when the run's end is known. The next homing must not take that event as its
/// own.
#[test]
fn homing_right_after_a_fault_is_not_ended_by_its_late_event() {
    let mut rig = homed();
    let number = rig.edge_count() as u64 + 1_000;
    rig.look(move |rig| rig.plan(When::Edge(number), Action::EStop(true)));
    faulted(&mut rig, paper(1), RigFault::EStopLoop, "cut");
    rig.act(Action::EStop(false));
    rig.device.acknowledge().expect("the cause is gone");
    rig.home();
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
        let last = rig.look(|rig| rig.edges().iter().next_back().map_or(0, |edge| edge.at_ns));
        // Counted from the first bit at the pin: the 11 bytes alone take 0.95 ms.
        assert!(
            last.saturating_sub(sent_ns) <= 2_000_000,
            "trial {trial}: {} ns",
            last - sent_ns
        );
        rig.device.acknowledge().expect("the cause is gone");
        rig.home();
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
        rig.look(|rig| rig.forget_extremes());
        let accepted = rig.device.run(paper(1)).expect("the run is accepted");
        rig.idle(dice.roll(0..7_900_000));
        let sent_ns = rig.bench.now_ns();
        rig.device.urgent(Urgent::Stop).expect("an answer");
        let record = rig.ended(&accepted);
        assert_eq!(record.outcome, RunOutcome::Stopped, "trial {trial}");
        rig.idle(300_000);
        let status = rig.status();
        assert_eq!(
            (status.state, status.homed),
            (RigState::Ready, true),
            "trial {trial}\n{}",
            rig.log()
        );
        assert_eq!(
            i64::from(status.position_steps),
            rig.carriage(),
            "trial {trial}: position lost"
        );
        let edges: Vec<_> = rig.edges(first).iter().collect();
        if let Some(last) = edges.last() {
            let (after_ns, way) = (
                last.at_ns.saturating_sub(sent_ns),
                edges.iter().filter(|edge| edge.at_ns > sent_ns).count(),
            );
            assert!(
                after_ns <= 100_000_000 && way <= 4_000,
                "trial {trial}: {after_ns} ns, {way} steps"
            );
        }
        // It slows down: once the stop takes effect at cruise, no interval is shorter than the one before.
        let gaps: Vec<u64> = edges
            .windows(2)
            .map(|pair| pair[1].at_ns - pair[0].at_ns)
            .collect();
        let fastest = gaps.iter().copied().min().unwrap_or(u64::MAX);
        assert!(
            fastest >= 35_000,
            "trial {trial}: {fastest} ns between two steps"
        );
        if gaps.len() > 30_000 && gaps.len() < 70_000 {
            let braking = &gaps[gaps.len() - 20..];
            assert!(
                braking.windows(2).all(|pair| pair[1] + 20 >= pair[0]),
                "trial {trial}: {braking:?}"
            );
            assert!(
                braking[19] > 5 * fastest,
                "trial {trial}: no ramp, {braking:?}"
            );
        }
        let (low, high) = rig.look(|rig| rig.extremes());
        assert!(
            low >= 0 && high <= 104_000,
            "trial {trial}: left the window, {low} to {high}"
        );
        rig.home();
    }
    rig.check_clean(0);
}

fn refused<T: std::fmt::Debug>(result: Result<T, ClientError>, expected: Refusal) {
    match result {
        Err(ClientError::Refused { refusal, .. }) => assert_eq!(refusal, expected),
        other => panic!("expected {expected:?}, found {other:?}"),
    }
}

/// Samples; the library's tests have every refusal.
#[test]
fn what_cannot_be_done_is_refused_and_nothing_moves() {
    let mut rig = rig();
    refused(rig.device.run(paper(5)), Refusal::NotHomed);
    assert_eq!(rig.edge_count(), 0);
    rig.home();
    let edges = rig.edge_count();
    let run = |stroke_um, total_us| Run {
        stroke_um,
        timing: RunTiming::Total {
            total_us,
            accel_um_s2: 100_000,
        },
        ..paper(5)
    };
    let refusal = Refusal::OutOfRange {
        field: Field::StrokeUm,
        requested: 131_000,
        min: 2,
        max: 130_000,
    };
    refused(rig.device.run(run(131_000, 40_000_000)), refusal);
    // 130 mm in 1 s is above 49 mm/s at any acceleration.
    for total_us in [0, 10_000_000, u64::MAX] {
        let answer = rig.device.run(run(130_000, total_us));
        assert!(
            matches!(answer, Err(ClientError::Refused { .. })),
            "{answer:?}"
        );
    }
    rig.idle(100_000);
    assert_eq!(rig.edge_count(), edges, "a refused run moved the carriage");
    rig.check_clean(0);
}

#[test]
fn two_virtual_runs_are_identical_to_the_byte() {
    let record = || {
        let mut rig = homed();
        rig.device.set_telemetry(10).expect("telemetry");
        let mut recorder = Recorder::default();
        let accepted = rig.device.run(paper(1)).expect("the run is accepted");
        rig.device
            .wait_run(&accepted, &mut recorder)
            .expect("the run ends");
        assert_eq!(recorder.missed, 0, "telemetry was lost on a good line");
        assert!(
            recorder.samples.len() >= 790,
            "{} samples in 8 s at 100 Hz",
            recorder.samples.len()
        );
        (
            rig.look(|rig| rig.edges().sha256()),
            format!("{:?}", recorder.samples),
        )
    };
    let (first, second) = (record(), record());
    assert!(first.0 == second.0, "the edges differ");
    assert!(first.1 == second.1, "the telemetry differs");
}
