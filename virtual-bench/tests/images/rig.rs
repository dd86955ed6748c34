//! Tests of the rig's image at its pins.

use client::Unobserved;
use client::error::ClientError;

use crate::common::{
    Dice, LIMIT_NS, Recorder, exact, execute, faulted, home_quickly, homed, paper, quick,
    quickly_homed, rig, rig_with, trials,
};
use protocol::{
    error::{Field, Refusal},
    rig::{LinkLossPolicy, MoveTo, RigFault, RigState, Run, RunOutcome, RunTiming},
    settings::{Setting, SettingKey},
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

/// Regression: after a homing whose last brake ended exactly at 0 the telemetry showed commanded steps of before, and a
/// record with such a sample contradicted itself.
#[test]
fn commanded_and_counted_steps_agree_after_every_homing() {
    let mut rig = homed();
    home_quickly(&mut rig);
    // One of these brakes ends at 0, where no way is left and no path follows.
    for flag_um in 85..=140 {
        let key = SettingKey::FlagUm;
        let set = Setting {
            key,
            value: flag_um,
        };
        rig.device.call(set).expect("set");
        let accepted = rig.device.home().expect("accepted");
        let homed = rig.device.wait_homing(&accepted, &mut Unobserved);
        homed.unwrap_or_else(|error| panic!("{error}\n{}", rig.log()));
        let mut recorder = Recorder::default();
        rig.device.set_telemetry(20).expect("telemetry");
        rig.device.idle(50_000, &mut recorder).expect("there");
        rig.device.set_telemetry(0).expect("off");
        for sample in &recorder.samples {
            let Telemetry::Rig(sample) = sample else {
                panic!("{sample:?} of a rig");
            };
            assert_eq!(sample.position_steps, 0);
            assert_eq!(sample.commanded_steps, 0, "flag at {flag_um} um");
        }
    }
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

/// A step is 1.25 um: 2 um contain one, 1 um contains none.
#[test]
fn a_stroke_and_a_move_of_one_step_are_made_and_less_is_refused() {
    let mut rig = quickly_homed();
    let first = rig.edge_count();
    let (accepted, record) = execute(&mut rig, quick(3, 2, 10_000, 200_000));
    assert_eq!((accepted.forward.steps, accepted.back.steps), (1, 1));
    let made = (record.outcome, record.commanded_edges, record.counted_edges);
    assert_eq!(made, (RunOutcome::Complete, 6, 6));
    assert_eq!((rig.edge_count() - first, rig.carriage()), (6, 0));
    let move_to = |position_um| MoveTo {
        position_um,
        speed_um_s: 10_000,
    };
    for (position_um, steps) in [(2, 1), (0, 0)] {
        rig.device.call(move_to(position_um)).expect("accepted");
        let status = rig.device.wait_rest(&mut Unobserved).expect("it rests");
        let found = (status.state, i64::from(status.position_steps));
        assert_eq!(found, (RigState::Ready, steps), "to {position_um} um");
        assert_eq!(rig.carriage(), steps, "to {position_um} um");
    }
    refused(
        rig.device.run(quick(1, 1, 10_000, 200_000)),
        Refusal::OutOfRange {
            field: Field::StrokeUm,
            requested: 1,
            min: 2,
            max: 130_000,
        },
    );
    refused(rig.device.call(move_to(1)), Refusal::AlreadyThere);
    assert_eq!(rig.edge_count() - first, 8);
    rig.check_clean(0);
}

/// The total includes the delay: the host asks for the time at which the run is over.
#[test]
fn a_start_delay_is_part_of_the_total() {
    let mut rig = homed();
    let first = rig.edge_count();
    let run = Run {
        cycles: 1,
        stroke_um: 40_000,
        timing: RunTiming::Total {
            total_us: 5_000_000,
            accel_um_s2: 200_000,
        },
        start_delay_us: 1_000_000,
        ..paper(1)
    };
    let asked_ns = rig.bench.now_ns();
    let (accepted, record) = execute(&mut rig, run);
    assert_eq!(
        (accepted.total_ticks, record.ticks),
        (500_000_000, 500_000_000)
    );
    let edges = rig.edges(first);
    let (start, end) = (
        edges.iter().next().expect("edges").at_ns,
        edges.iter().next_back().expect("edges").at_ns,
    );
    // The first step comes some milliseconds into a stroke, and the request takes a few to arrive.
    assert!(
        (1_000_000_000..1_030_000_000).contains(&(start - asked_ns)),
        "{start} after {asked_ns}"
    );
    assert!(
        (5_000_000_000..5_030_000_000).contains(&(end - asked_ns)),
        "{end} after {asked_ns}"
    );
}

#[test]
fn after_the_estop_no_edge_follows() {
    let trials = trials(10, 20);
    let mut dice = Dice(0x5EED_0001);
    let mut rig = quickly_homed();
    for trial in 0..trials {
        let number = rig.edge_count() as u64 + dice.roll(1..208_000);
        rig.look(move |rig| rig.plan(When::Edge(number), Action::EStop(true)));
        let what = format!("trial {trial}");
        faulted(&mut rig, paper(1), RigFault::EStopLoop, &what);
        rig.idle(50_000);
        assert_eq!(
            rig.edge_count() as u64,
            number,
            "trial {trial}: edges after the E-stop\n{}",
            rig.log()
        );
        rig.position_is_right_but_not_trusted(&what);
        // The E-stop latches. It cannot be acknowledged while pressed, and its release moves nothing.
        refused(rig.device.acknowledge(), Refusal::CauseStillPresent);
        rig.act(Action::EStop(false));
        rig.idle(50_000);
        refused(rig.device.home(), Refusal::RigFaulted(RigFault::EStopLoop));
        rig.device.acknowledge().expect("the cause is gone");
        refused(rig.device.run(paper(1)), Refusal::NotHomed);
        assert_eq!(
            rig.edge_count() as u64,
            number,
            "trial {trial}: released and moving"
        );
        rig.home();
    }
    rig.check_clean_after(0, trials);
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
        let record = rig
            .device
            .wait_run(&accepted, &mut Unobserved)
            .expect("a stop is no fault");
        assert_eq!(record.outcome, RunOutcome::Stopped, "trial {trial}");
        rig.idle(300_000);
        let status = rig.device.rig_status().expect("a status");
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

#[test]
fn what_cannot_be_done_is_refused_and_nothing_moves() {
    let mut rig = rig();
    refused(rig.device.run(paper(5)), Refusal::NotHomed);
    assert_eq!(rig.edge_count(), 0);
    rig.home();
    let edges = rig.edge_count();
    let out_of_range = |field, requested, min, max| Refusal::OutOfRange {
        field,
        requested,
        min,
        max,
    };
    let good = paper(5);
    let total = |total_us, accel_um_s2| RunTiming::Total {
        total_us,
        accel_um_s2,
    };
    refused(
        rig.device.run(Run {
            stroke_um: 131_000,
            ..good
        }),
        out_of_range(Field::StrokeUm, 131_000, 2, 130_000),
    );
    refused(
        rig.device.run(Run {
            stroke_um: u32::MAX,
            ..good
        }),
        out_of_range(Field::StrokeUm, u64::from(u32::MAX), 2, 130_000),
    );
    refused(
        rig.device.run(Run {
            stroke_um: 0,
            ..good
        }),
        out_of_range(Field::StrokeUm, 0, 2, 130_000),
    );
    refused(
        rig.device.run(Run { cycles: 0, ..good }),
        out_of_range(Field::Cycles, 0, 1, 10_000),
    );
    refused(
        rig.device.run(Run {
            cycles: u16::MAX,
            ..good
        }),
        out_of_range(Field::Cycles, 65_535, 1, 10_000),
    );
    match rig.device.run(Run {
        timing: total(10_000_000, 100_000),
        ..good
    }) {
        Err(ClientError::Refused {
            refusal:
                Refusal::TooFast {
                    requested_us,
                    min_us,
                    min_accel_um_s2,
                },
            ..
        }) => {
            // 130 mm in 1 s is above 49 mm/s at any acceleration.
            assert_eq!((requested_us, min_accel_um_s2), (10_000_000, u64::MAX));
            // At the set acceleration and at most 49 mm/s: 10 * (130 / 49 + 49 / 100) s.
            assert!((31_430_600..=31_430_640).contains(&min_us), "{min_us}");
        }
        other => panic!("{other:?}"),
    }
    match rig.device.run(Run {
        timing: total(10_000_000, 2_000_000),
        ..good
    }) {
        Err(ClientError::Refused {
            refusal:
                Refusal::SpeedLimit {
                    needed_um_s,
                    max_um_s: 49_000,
                },
            ..
        }) => {
            assert!(needed_um_s > 130_000, "{needed_um_s}");
        }
        other => panic!("{other:?}"),
    }
    for timing in [
        total(0, 100_000),
        total(u64::MAX, 100_000),
        total(40_000_000, 0),
        total(40_000_000, u32::MAX),
    ] {
        let answer = rig.device.run(Run { timing, ..good });
        assert!(
            matches!(answer, Err(ClientError::Refused { .. })),
            "{timing:?}: {answer:?}"
        );
    }
    rig.idle(100_000);
    assert_eq!(rig.edge_count(), edges, "a refused run moved the carriage");
    // The machine still works.
    let (_, record) = execute(
        &mut rig,
        Run {
            stroke_um: 5_000,
            timing: total(4_000_000, 200_000),
            ..good
        },
    );
    assert_eq!(record.outcome, RunOutcome::Complete);
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
