//! The rig times its own steps through the second jumper, and finds each step that is not where it was planned.

use crate::common::{RigRun, execute, paper, quick, rig_with};
use crate::speed::{quick_rig, quick_run};
use protocol::{
    rig::{
        GetRigHardware, GetRigHealth, Hold, Resume, RigFault, RigHardware, RigState, Run,
        RunOutcome, RunRecord, RunTiming,
    },
    system::Urgent,
};
use virtual_bench::{
    faults::When,
    plants::{
        rig::{Action, RigOptions},
        wire::Fault,
    },
};

/// A rig with the jumper, at position 0.
fn timed_rig() -> RigRun {
    rig_with(RigOptions::WITH_BOTH_JUMPERS).quickly_homed()
}

/// 16,000 steps.
fn short() -> Run {
    quick(1, 10_000, 40_000, 500_000)
}

fn found(record: &RunRecord) -> (u64, u32) {
    (record.edges_timed, record.worst_interval_error_ticks)
}

#[test]
fn every_step_of_a_run_is_timed_and_right() {
    let mut rig = timed_rig();
    for run in [
        short(),
        paper(1),
        // Hardly any two intervals are equal.
        Run {
            timing: RunTiming::Total {
                total_us: 8_000_000,
                accel_um_s2: 99_855,
            },
            ..paper(1)
        },
        // A pause longer than the capture timer's 42.9 s.
        Run {
            far_dwell_us: 45_000_000,
            ..short()
        },
    ] {
        let (_, record) = execute(&mut rig, run);
        assert_eq!(record.outcome, RunOutcome::Complete, "{record:?}");
        assert_eq!(found(&record), (record.commanded_edges, 0), "{record:?}");
    }
    rig.check_clean(0);
}

/// Up to the highest step rate that the settings allow, on steep ramps too.
#[test]
fn every_step_at_the_highest_rate_is_timed() {
    let mut rig = quick_rig(RigOptions::WITH_BOTH_JUMPERS, 65_000_000);
    let first = rig.edge_count();
    let (request, exact) = quick_run();
    let (accepted, record) = execute(&mut rig, request);
    assert!(accepted.forward.peak_um_s > 156_150, "{accepted:?}");
    rig.is_exact(&exact, first);
    let health = rig.device.call(GetRigHealth).expect("it answers");
    assert_eq!(health.underruns, 0, "{health:?}");
    assert_eq!(record.outcome, RunOutcome::Complete, "{record:?}");
    assert_eq!(found(&record), (192_000, 0), "{record:?}");
    rig.check_clean(0);
}

#[test]
fn a_held_run_is_timed_as_a_whole() {
    let mut rig = timed_rig();
    let accepted = rig.device.run(paper(1)).expect("accepted");
    for _ in 0..2 {
        rig.idle(700_000);
        rig.device.call(Hold).expect("held");
        rig.idle(700_000);
        let state = rig.status().state;
        assert_eq!(state, RigState::Held);
        rig.device.call(Resume).expect("resumed");
    }
    let record = rig.ended(&accepted);
    assert_eq!((record.outcome, record.holds), (RunOutcome::Complete, 2));
    assert_eq!(found(&record), (208_000, 0), "{record:?}");
}

/// Steps that left the pin are timed; those that did not are no error.
#[test]
fn a_run_that_is_cut_is_timed_up_to_the_cut() {
    let mut rig = timed_rig();
    for after_us in [200_000, 401_234, 577_777] {
        let accepted = rig.device.run(short()).expect("accepted");
        rig.pass(after_us);
        rig.device.urgent(Urgent::EStop).expect("sent");
        let record = rig.ended(&accepted);
        let fault = RunOutcome::Faulted(RigFault::EStopFrame);
        assert_eq!(record.outcome, fault, "{record:?}");
        let (timed, worst) = found(&record);
        assert_eq!(worst, 0, "{record:?}");
        // The cut pulse may be too short for one of the two filters.
        assert!(timed.abs_diff(record.counted_edges) <= 1, "{record:?}");
        assert!(timed > 100, "{record:?}");
        rig.recover("the cause is gone");
    }
}

/// A run in which `fault` hits the pulse of step `number` on the wire; the steps themselves stay right.
fn with_at(number: u64, fault: Fault) -> RunRecord {
    let mut rig = timed_rig();
    // Trigger it at the step before.
    rig.plan_at(number - 1, Action::Capture(fault));
    let (_, record) = execute(&mut rig, short());
    assert_eq!(record.outcome, RunOutcome::Complete);
    assert_eq!(record.counted_edges, 16_000);
    rig.check_clean(0);
    record
}

/// 40 mm/s are 32 kHz: 3,125 ticks from step to step.
const INTERVAL: u32 = 3_125;

#[test]
fn a_step_that_is_not_where_it_was_planned_is_found() {
    assert_eq!(found(&with_at(5_000, Fault::Delay(20))), (16_000, 2));
    let (timed, worst) = found(&with_at(5_000, Fault::Skip));
    // From there on each interval is compared with its predecessor, and those at the turn differ most.
    assert!(timed == 15_999 && worst >= INTERVAL, "{timed} {worst}");
    // No interval ends at the last step, so the rig looks for it when all steps have left.
    assert_eq!(found(&with_at(16_000, Fault::Skip)), (15_999, u32::MAX));
    // The jumper falls off at the rising edge of step 4,999.
    assert_eq!(found(&with_at(5_000, Fault::Whole(false))), (4_998, 0));
    assert_eq!(found(&with_a_spike(300)), (16_001, u32::MAX));
    // The input's filter removes it.
    assert_eq!(found(&with_a_spike(60)), (16_000, 0));
}

fn hardware(rig: &mut RigRun) -> RigHardware {
    rig.device.call(GetRigHardware).expect("counters")
}

/// On a real pad sampling moves an edge by up to 10 ns: no fault, but the histogram counts it. 20 ns are a fault.
#[test]
fn jitter_is_counted_by_ticks() {
    let mut rig = timed_rig();
    for (ns, worst) in [(10, 1), (20, 2), (30, 3)] {
        rig.act(Action::Capture(Fault::Jitter(ns)));
        let before = hardware(&mut rig);
        let (_, record) = execute(&mut rig, short());
        assert_eq!(found(&record), (16_000, worst), "{record:?}");
        let after = hardware(&mut rig);
        let of = |counts: &RigHardware| {
            [
                counts.intervals_exact,
                counts.intervals_1_tick,
                counts.intervals_2_ticks,
                counts.intervals_more,
            ]
        };
        let pairs = of(&after).into_iter().zip(of(&before));
        let counts: Vec<u32> = pairs.map(|(now, was)| now - was).collect();
        assert_eq!(counts.iter().sum::<u32>(), 15_999, "{ns} ns: {counts:?}");
        // Jitter hits each edge at random, so half of the intervals keep their length.
        assert!((7_000..9_000).contains(&counts[0]), "{ns} ns: {counts:?}");
        let others = 15_999 - counts[0];
        assert_eq!(counts[worst as usize], others, "{ns} ns: {counts:?}");
    }
    rig.check_clean(0);
}

/// If an instant is overwritten before DMA fetches it, the comparison ends. The record reports a lost capture, not a
/// wrong step.
#[test]
fn a_lost_capture_is_told_as_one() {
    let mut rig = timed_rig();
    let before = hardware(&mut rig);
    rig.plan_at(4_999, Action::Capture(Fault::Lose));
    let (_, record) = execute(&mut rig, short());
    assert_eq!(record.outcome, RunOutcome::Complete);
    let (timed, worst) = found(&record);
    assert_eq!(worst, 0, "{record:?}");
    assert!((4_000..5_000).contains(&timed), "{record:?}");
    let after = hardware(&mut rig);
    assert_eq!(after.lost_captures - before.lost_captures, 1, "{after:?}");
    // The next run is timed completely.
    let (_, record) = execute(&mut rig, short());
    assert_eq!(found(&record), (16_000, 0), "{record:?}");
    rig.check_clean(0);
}

/// A run with a spike of this width on the wire, midway between two pulses at cruise.
fn with_a_spike(width_ns: u64) -> RunRecord {
    let mut rig = timed_rig();
    let accepted = rig.device.run(short()).expect("accepted");
    rig.pass(150_000);
    let pulses = rig.edges(rig.edge_count() - 2);
    let at_ns: Vec<u64> = pulses.iter().map(|edge| edge.at_ns).collect();
    let (before_ns, last_ns) = (at_ns[0], at_ns[1]);
    let interval_ns = last_ns - before_ns;
    assert_eq!(interval_ns, u64::from(INTERVAL) * 10, "it cruises");
    let between = last_ns + 100 * interval_ns + interval_ns / 2;
    let spike = Action::Capture(Fault::Spike(width_ns));
    rig.plan(When::At(between), spike);
    let record = rig.ended(&accepted);
    assert_eq!(record.outcome, RunOutcome::Complete);
    assert_eq!(record.counted_edges, 16_000);
    record
}

#[test]
fn without_the_jumper_the_record_says_not_timed() {
    let mut rig = rig_with(RigOptions::REFERENCE).quickly_homed();
    let (_, record) = execute(&mut rig, short());
    assert_eq!(found(&record), (0, 0), "{record:?}");
}
