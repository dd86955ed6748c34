//! The highest step rate that the settings allow, with everything else active.

use client::Unobserved;

use crate::common::{RigRun, is_made, paper, quick, start, trials, with_chip};
use protocol::{
    rig::{RigFault, Run, RunOutcome, RunTiming},
    settings::SettingKey,
};
use virtual_bench::{
    plants::rig::RigOptions,
    verdicts::{self, Stroke, Verdict},
};

/// 1/32 microsteps at 156.2 mm/s are 249.9 kHz, with telemetry at 200 Hz.
const STEPS_PER_MM: i64 = 1_600;
const STROKE_US: u64 = 462_230;
/// Strokes this quick end too soon after their last step for DIR to change, so the run needs a dwell.
const DWELL_US: u32 = 1_000;

/// A homed rig with a screw and a driver for that rate.
pub fn quick_rig(rig: RigOptions, instructions_per_second: u64) -> RigRun {
    let bench = with_chip(|chip| chip.instructions_per_second = instructions_per_second);
    let mut rig = start(rig.with_steps_per_mm(STEPS_PER_MM), bench);
    rig.set(SettingKey::Microsteps, 32);
    rig.set(SettingKey::MaxSpeedUmS, 156_250);
    rig.home();
    rig.device.set_telemetry(5).expect("telemetry");
    rig
}

pub fn quick_run() -> (Run, verdicts::Run) {
    let request = Run {
        stroke_um: 60_000,
        timing: RunTiming::Total {
            total_us: 2 * STROKE_US + u64::from(DWELL_US),
            accel_um_s2: 2_000_000,
        },
        far_dwell_us: DWELL_US,
        ..paper(1)
    };
    let stroke = Stroke::within(96_000, STROKE_US * 100, 2_000 * STEPS_PER_MM as u64);
    let stroke = stroke.expect("feasible");
    let exact = verdicts::Run {
        cycles: 1,
        forward: stroke,
        back: stroke,
        far_dwell_ticks: u64::from(DWELL_US) * 100,
        ..verdicts::Run::paper()
    };
    (request, exact)
}

/// A processor that cannot keep up: the ring runs empty at some step of a ramp. Every edge before that is right, none
/// follows, and the position is known.
#[test]
fn a_ring_that_runs_dry_emits_no_wrong_edge() {
    let mut steps = std::collections::BTreeSet::new();
    let speeds = (8..20).step_by(trials(3, 1));
    let tried = speeds.clone().count();
    for million in speeds {
        let mut rig = quick_rig(RigOptions::REFERENCE, million * 1_000_000);
        let first = rig.edge_count();
        let (request, exact) = quick_run();
        let accepted = rig.device.run(request).expect("accepted");
        let ended = rig.device.wait_run(&accepted, &mut Unobserved);
        rig.pass(300_000);
        let edges = rig.edges(first);
        let verdict = Verdict::of(&exact, &edges);
        let what = format!("{million} M/s: {ended:?}\n{verdict}\n{}", rig.log());
        let status = rig.device.rig_status().expect(&what);
        assert_eq!(status.fault, Some(RigFault::Underrun), "{what}");
        assert_eq!(i64::from(status.position_steps), rig.carriage(), "{what}");
        assert_eq!(verdict.end, rig.carriage(), "{what}");
        assert_eq!((verdict.strokes, verdict.wrong_direction), (1, 0), "{what}");
        assert!(verdict.edges.0 < verdict.edges.1, "{what}");
        // The start's own resolution is one instruction.
        let limit_ns = 10.0 + 1e3 / million as f64;
        assert!(verdict.worst.0 <= limit_ns, "{what}");
        steps.insert(verdict.edges.0);
        // If the last period was fetched half-written, the counter stops in the last pulse, which is then cut.
        rig.check_clean_after(0, 1);
    }
    assert!(steps.len() * 3 > tried * 2, "{steps:?}");
}

/// Holds the processor up until the ring is nearly empty, while the last periods of a stroke are still to be pushed. A
/// zero fetched then stops the counter with periods left in the ring. The run must still end and report how.
#[test]
fn a_processor_that_is_held_up_at_the_end_of_a_stroke_leaves_no_run_without_an_end() {
    const STEPS: usize = 800;
    let mut rig = crate::common::quickly_homed();
    let short = quick(1, 1_000, 10_000, 100_000);
    let first = rig.edge_count();
    let begun_ns = rig.bench.now_ns();
    crate::common::execute(&mut rig, short);
    let last = rig.edges(first + STEPS - 1);
    let stroke_us = (last.iter().next().expect("a step").at_ns - begun_ns) / 1_000;
    let trials = (10..=24).step_by(2).flat_map(|before_ms| {
        (4..=22).map(move |held_up_ms| (before_ms * 1_000, held_up_ms * 1_000))
    });
    let mut outcomes = std::collections::BTreeSet::new();
    for (trial, (before_us, held_up_us)) in trials.enumerate() {
        if !is_made(trial, 3) {
            continue;
        }
        let what = format!("{before_us} us before the end, held up for {held_up_us} us");
        let begun_ns = rig.bench.now_ns();
        let accepted = rig.device.run(short).expect("accepted");
        let passed_us = (rig.bench.now_ns() - begun_ns) / 1_000;
        rig.pass(stroke_us - before_us - passed_us);
        rig.visit(move |visit| visit.hold_up(held_up_us));
        let record = rig.ended(&accepted);
        match record.outcome {
            RunOutcome::Complete => {}
            RunOutcome::Faulted(RigFault::Underrun) => {
                rig.position_is_right_but_not_trusted(&what);
                rig.recover(&what);
            }
            other => panic!("{what}: {other:?}"),
        }
        outcomes.insert(format!("{:?}", record.outcome));
    }
    assert_eq!(outcomes.len(), 2, "{outcomes:?}");
}

/// Noise on both switches may keep the processor for 150 us when a stroke ends, and motion looks every 100 us. The
/// shortest turn that a screw with steps of 1.25 um and 10 m/s2 allows is 500 us.
#[test]
fn a_processor_that_is_held_up_at_a_short_turn_still_takes_it() {
    const STEPS: usize = 800;
    let mut rig = crate::common::quickly_homed();
    rig.set(SettingKey::TurnaroundUs, 400);
    rig.set(SettingKey::MaxAccelUmS2, 10_000_000);
    let short = quick(1, 1_000, 10_000, 10_000_000);
    for held_up_us in [200, 250, 300, 340] {
        let before = rig.edge_count();
        let accepted = rig.device.run(short).expect("accepted");
        while rig.edge_count() < before + STEPS {
            rig.pass(10);
        }
        rig.visit(move |visit| visit.hold_up(held_up_us));
        let record = rig.ended(&accepted);
        assert_eq!(record.outcome, RunOutcome::Complete, "{held_up_us} us");
        assert_eq!(rig.edge_count(), before + 2 * STEPS);
    }
}
