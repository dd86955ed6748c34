//! From a requested run to its plan, and from the plan or its refusal back to the wire.

use motion::{
    axis::{self, Axis, AxisError},
    run::{Limits, RunError, RunPlan},
    trapezoid::StrokeError,
    units::Ticks,
};
use planning::{accepted, direction, refusal, solve, stroke};
use proptest::prelude::*;
use protocol::{
    error::{Field, Refusal},
    rig::{self, LinkLossPolicy, Run, RunAccepted, RunTiming, Stroke},
};

const AXIS: Axis = Axis::REFERENCE;

const LIMITS: Limits = Limits {
    max_speed_um_s: 49_000,
    max_accel_um_s2: 2_000_000,
    min_interval_ticks: 400,
    min_turnaround_ticks: 100_000,
};

const PAPER: Run = Run {
    cycles: 5,
    stroke_um: 130_000,
    timing: RunTiming::Total {
        total_us: 40_000_000,
        accel_um_s2: 100_000,
    },
    far_dwell_us: 0,
    home_dwell_us: 0,
    start_delay_us: 0,
    link_loss: LinkLossPolicy::Stop,
};

fn speeds(forward_um_s: u32, return_um_s: u32, accel_um_s2: u32) -> RunTiming {
    RunTiming::Speeds {
        forward_um_s,
        return_um_s,
        accel_um_s2,
    }
}

/// Ticks of a stroke of `um` at `um_s`, ramps of `ms` included.
fn ticks(um: u64, um_s: u64, ramp_ms: u64) -> u64 {
    um * 100_000_000 / um_s + ramp_ms * 100_000
}

fn solved(run: &Run) -> RunPlan {
    solve(run, &AXIS, &LIMITS).unwrap()
}

fn refused(run: &Run) -> Refusal {
    let error = solve(run, &AXIS, &LIMITS).unwrap_err();
    refusal(&error, run, &AXIS, &LIMITS)
}

#[test]
fn directions_have_the_same_names_on_both_sides() {
    assert_eq!(direction(rig::Direction::Away), axis::Direction::Away);
    assert_eq!(direction(rig::Direction::Home), axis::Direction::Home);
}

#[test]
fn the_papers_run_is_planned_exactly() {
    let plan = solved(&PAPER);
    // The shortest ramp r with r (T - r) >= n (100 MHz)^2 / (100 mm/s2 at 800 steps/mm) = 1.3e16.
    let stroke = Stroke {
        steps: 104_000,
        duration_ticks: 400_000_000,
        ramp_ticks: 35_683_233,
        peak_um_s: 35_683,
        accel_um_s2: 100_000,
    };
    let expected = RunAccepted {
        run: 17,
        requested: PAPER,
        forward: stroke,
        back: stroke,
        total_ticks: 4_000_000_000,
        edges: 1_040_000,
        plan_hash: plan.hash(),
    };
    assert_eq!(accepted(17, PAPER, &plan, &AXIS), expected);
}

/// Each value of a request has its own effect on the plan.
#[test]
fn every_value_of_a_request_is_in_its_plan() {
    let run = Run {
        cycles: 3,
        stroke_um: 1_000,
        timing: speeds(10_000, 20_000, 500_000),
        far_dwell_us: 3_000,
        home_dwell_us: 7_000,
        start_delay_us: 50_000,
        link_loss: LinkLossPolicy::Finish,
    };
    let plan = solved(&run);
    let reported = accepted(1, run, &plan, &AXIS);
    assert_eq!(reported.requested, run);
    let profile = |um_s: u32, ramp_ms: u64| Stroke {
        steps: 800,
        duration_ticks: ticks(1_000, um_s.into(), ramp_ms),
        ramp_ticks: ramp_ms * 100_000,
        peak_um_s: um_s,
        accel_um_s2: 500_000,
    };
    assert_eq!(reported.forward, profile(10_000, 20));
    assert_eq!(reported.back, profile(20_000, 40));
    assert_eq!(stroke(plan.forward(), &AXIS), reported.forward);
    assert_eq!(stroke(plan.return_(), &AXIS), reported.back);
    assert_eq!(reported.edges, 3 * 2 * 800);
    let strokes = 3 * (reported.forward.duration_ticks + reported.back.duration_ticks);
    let rests_us = 50_000 + 3 * 3_000 + 2 * 7_000;
    assert_eq!(reported.total_ticks, strokes + rests_us * 100);
    // Which dwell is where: after the delay comes the forward stroke, then the far dwell.
    let start = |stroke| plan.stroke_start(stroke).unwrap().0;
    assert_eq!(start(0), 5_000_000);
    assert_eq!(
        start(1) - start(0),
        reported.forward.duration_ticks + 300_000
    );
    assert_eq!(start(2) - start(1), reported.back.duration_ticks + 700_000);
    // A total counts delay and dwells in.
    let total = Run {
        timing: RunTiming::Total {
            total_us: 2_000_000,
            accel_um_s2: 500_000,
        },
        ..run
    };
    assert_eq!(solved(&total).total(), Ticks(200_000_000));
}

fn total(total_us: u64, accel_um_s2: u32) -> RunTiming {
    RunTiming::Total {
        total_us,
        accel_um_s2,
    }
}

/// The limit that each of these runs breaks, with the value that would be accepted.
#[test]
fn a_refusal_names_the_value_and_what_is_allowed() {
    let mut runs = Vec::new();
    // One step is 1.25 um.
    for stroke_um in [0, 1, 130_001, u32::MAX] {
        runs.push(Run { stroke_um, ..PAPER });
    }
    for cycles in [0, 10_001] {
        runs.push(Run { cycles, ..PAPER });
    }
    for timing in [
        speeds(10_000, 10_000, 2_000_001),
        speeds(10_000, 10_000, 0),
        speeds(0, 10_000, 100_000),
        speeds(10_000, 0, 100_000),
        speeds(0, 0, 100_000),
        speeds(10_000, 49_001, 100_000),
        speeds(49_001, 10_000, 100_000),
        total(40_000_000, 0),
        // Ten strokes of 130 mm at 49 mm/s, with a ramp of 0.49 s. In 1 s each, no acceleration keeps to that speed.
        total(10_000_000, 100_000),
        // With an acceleration that is enough for the time, the paper's stroke is too fast.
        total(10_000_000, 520_000),
        total(30_000_000, 100_000),
        total(u64::MAX, 100_000),
        total(u64::MAX / 100, 1),
        // Slow strokes have exact step times only with short ramps.
        total(700_000_000, 50),
    ] {
        runs.push(Run { timing, ..PAPER });
    }
    // 2 mm in 0.1 s, with a peak of 40 mm/s and at 0.8 m/s2.
    runs.push(Run {
        stroke_um: 2_000,
        timing: total(1_000_000, 100_000),
        ..PAPER
    });
    // Dwells that leave no time at all: no acceleration would do.
    runs.push(Run {
        far_dwell_us: 9_000_000,
        ..PAPER
    });
    let refusals: Vec<_> = runs
        .iter()
        .map(|run| format!("{run:?}\n    {:?}", refused(run)))
        .collect();
    insta::assert_snapshot!("refusals", refusals.join("\n"));
    // The speed that the refusals suggest works.
    let fastest = Run {
        timing: speeds(49_000, 49_000, 2_000_000),
        ..PAPER
    };
    assert!(solve(&fastest, &AXIS, &LIMITS).is_ok());
}

/// The shortest stroke is one step; what is short of a whole step is left out, and reported.
#[test]
fn a_stroke_of_one_step_is_planned() {
    for (stroke_um, steps) in [(2, 1), (3, 2), (4, 3), (5, 4)] {
        let run = Run {
            stroke_um,
            timing: speeds(10_000, 10_000, 200_000),
            ..PAPER
        };
        let reported = accepted(1, run, &solved(&run), &AXIS);
        assert_eq!(
            (reported.forward.steps, reported.back.steps),
            (steps, steps)
        );
        assert_eq!(reported.edges, 10 * u64::from(steps));
    }
}

/// The axis is in the numbers: 1/256 microsteps make 12,800 steps per mm.
#[test]
fn a_refusal_counts_in_the_steps_of_the_axis() {
    let fine = Axis::new(4_000, 200, 256, 100_000).unwrap();
    let refused = |run: &Run| {
        let error = solve(run, &fine, &LIMITS).unwrap_err();
        refusal(&error, run, &fine, &LIMITS)
    };
    let fast = Run {
        stroke_um: 100_000,
        timing: speeds(25_000, 25_000, 100_000),
        ..PAPER
    };
    let Refusal::StepRateLimit { needed_hz, max_hz } = refused(&fast) else {
        panic!("{:?}", refused(&fast))
    };
    // 25 mm/s are 320 kHz, in whole ticks.
    assert!((320_000..322_000).contains(&needed_hz), "{needed_hz}");
    assert_eq!(max_hz, 250_000);
    let dwells = |far_dwell_us, home_dwell_us| Run {
        stroke_um: 1_000,
        timing: speeds(10_000, 10_000, 2_000_000),
        far_dwell_us,
        home_dwell_us,
        ..PAPER
    };
    for (run, expected, requested) in [
        (dwells(3, 1_000), Field::FarDwellUs, 3),
        (dwells(1_000, 5), Field::HomeDwellUs, 5),
    ] {
        let refused = refused(&run);
        let Refusal::OutOfRange {
            field,
            requested: given,
            min,
            max,
        } = refused
        else {
            panic!("{refused:?}")
        };
        assert_eq!(
            (field, given, max),
            (expected, requested, u64::from(u32::MAX))
        );
        // 1 ms less the time of the first step: sqrt(2 * 78 nm / 2 m/s2) = 280 us.
        assert!((720..722).contains(&min), "{min}");
        let least = dwells(min as u32, min as u32);
        assert!(solve(&least, &fine, &LIMITS).is_ok());
    }
}

/// Values that the solver finds and no request above reaches, and divisors of 0.
#[test]
fn every_error_has_its_words() {
    // This request has speeds and no total.
    let paced = Run {
        timing: speeds(10_000, 10_000, 100_000),
        ..PAPER
    };
    let rate = |interval, min_interval| RunError::StepRate {
        interval: Ticks(interval),
        min_interval: Ticks(min_interval),
        max_um_s: 1,
    };
    let errors = [
        RunError::TotalTooShort {
            minimal_total_us: 7,
            minimal_accel_um_s2: Some(9),
        },
        rate(200, 400),
        rate(99_999, 100_000),
        rate(0, 0),
        rate(1, 1),
        RunError::TooLong,
        RunError::Profile(StrokeError::NoSteps),
        RunError::Rate(AxisError::NoAcceleration),
    ];
    let words = errors.map(|error| (error, refusal(&error, &paced, &AXIS, &LIMITS)));
    insta::assert_debug_snapshot!("errors", words);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// Whoever takes one of the two numbers of a refusal is not refused then; one that says that there is none is right.
    #[test]
    fn what_a_refusal_names_is_accepted(
        cycles in 1_u16..=30,
        stroke_um in 2_u32..=100_000,
        // Slow strokes and low accelerations, too.
        total_us in prop_oneof![3 => 1_000_u64..100_000_000, 1 => 100_000_000_u64..10_000_000_000],
        accel_um_s2 in prop_oneof![3 => 1_000_u32..=2_000_000, 1 => 1_u32..1_000],
        far_dwell_us in 0_u32..1_000_000,
        fine: bool,
        speed_um_s in 5_000_u32..=200_000,
        min_turnaround_ticks in 0_u32..10_000_000,
    ) {
        // With 1/256 microsteps the step rate ends at 19.5 mm/s.
        let axis = if fine { Axis::new(4_000, 200, 256, 100_000).unwrap() } else { AXIS };
        let limits = Limits { max_speed_um_s: speed_um_s, min_turnaround_ticks, ..LIMITS };
        let run = |total_us, accel_um_s2| Run {
            cycles,
            stroke_um,
            timing: RunTiming::Total { total_us, accel_um_s2 },
            far_dwell_us,
            ..PAPER
        };
        let solves = |total_us, accel_um_s2| solve(&run(total_us, accel_um_s2), &axis, &limits);
        let Err(error) = solves(total_us, accel_um_s2) else { return Ok(()) };
        let requested = run(total_us, accel_um_s2);
        let (min_us, min_accel_um_s2) = match refusal(&error, &requested, &axis, &limits) {
            Refusal::TooFast { min_us, min_accel_um_s2, .. } => (Some(min_us), min_accel_um_s2),
            Refusal::OutOfRange { field: Field::AccelUmS2, min, .. } => (None, min),
            _ => return Ok(()),
        };
        // Where only the acceleration is named, no total would do.
        let totals = [total_us, 2 * total_us, 100 * total_us];
        if min_us.is_none() {
            prop_assert!(totals.iter().all(|total_us| solves(*total_us, accel_um_s2).is_err()));
        }
        match min_us.map(|min_us| solves(min_us, accel_um_s2)) {
            // The time between the strokes is another matter, with a number of its own.
            None | Some(Ok(_) | Err(RunError::Turnaround { .. })) => {}
            Some(Err(other)) => prop_assert!(false, "{min_us:?} us: {other}"),
        }
        if min_accel_um_s2 == u64::MAX {
            let by_eights = (0..24).map(|power| (accel_um_s2 << 3).wrapping_shl(power) >> 3);
            let by_eights = by_eights.filter(|um_s2| (accel_um_s2..=2_000_000).contains(um_s2));
            let even = (accel_um_s2..2_000_000).step_by(50_000);
            for accel_um_s2 in even.chain(by_eights).chain([2_000_000]) {
                prop_assert!(solves(total_us, accel_um_s2).is_err(), "{accel_um_s2} um/s2 does it");
            }
        } else {
            let least = u32::try_from(min_accel_um_s2).unwrap();
            prop_assert!(solves(total_us, least).is_ok(), "{least} um/s2: {:?}", solves(total_us, least));
            prop_assert!(solves(total_us, least - 1).is_err(), "less than {least} um/s2 does it");
        }
    }
}

/// A peak that is hardly too high is rounded to the limit, and is still more than it.
#[test]
fn a_speed_above_the_limit_reads_as_more_than_the_limit() {
    let run = |total_us| Run {
        timing: RunTiming::Total {
            total_us,
            accel_um_s2: 100_000,
        },
        cycles: 1,
        ..PAPER
    };
    let mut near = 0;
    for total_us in (6_000_000..6_300_000).step_by(13) {
        if let Err(error) = solve(&run(total_us), &AXIS, &LIMITS)
            && let Refusal::SpeedLimit {
                needed_um_s,
                max_um_s,
            } = refusal(&error, &run(total_us), &AXIS, &LIMITS)
        {
            assert!(needed_um_s > max_um_s, "{total_us}: {needed_um_s}");
            near += u32::from(needed_um_s == max_um_s + 1);
        }
    }
    assert!(near > 0);
}
