//! The run solver: sums, boundaries, refusals.

use motion::axis::{Axis, AxisError, Direction};
use motion::run::{Limits, RunError, RunPlan, RunRequest, Timing};
use motion::step_times::StepTimes;
use motion::units::{Micrometres, Ticks};
use proptest::prelude::*;

const LIMITS: Limits = Limits {
    max_speed_um_s: 100_000,
    max_accel_um_s2: 2_000_000,
    min_interval_ticks: 400,
    min_turnaround_ticks: 200,
};

const PAPER: RunRequest = RunRequest {
    cycles: 5,
    stroke_um: 130_000,
    timing: Timing::Total {
        total_us: 40_000_000,
        accel_um_s2: 100_000,
    },
    far_dwell_us: 0,
    home_dwell_us: 0,
    start_delay_us: 0,
};

fn solve(request: &RunRequest) -> Result<RunPlan, RunError> {
    RunPlan::solve(&Axis::REFERENCE, &LIMITS, request)
}

#[test]
fn the_papers_run_is_forty_seconds_to_the_tick() {
    let plan = solve(&PAPER).unwrap();
    assert_eq!(plan.total(), Ticks(4_000_000_000));
    assert_eq!(plan.edges(), 1_040_000);
    assert_eq!(plan.strokes(), 10);
    assert_eq!(plan.forward().duration(), Ticks(400_000_000));
    assert_eq!(plan.forward(), plan.return_());
    assert_eq!(plan.last_far_extra(), Ticks(0));
    for i in 0..10 {
        assert_eq!(
            plan.stroke_start(i),
            Some(Ticks(u64::from(i) * 400_000_000))
        );
    }
    assert_eq!(plan.direction(0), Some(Direction::Away));
    assert_eq!(plan.direction(9), Some(Direction::Home));
    assert_eq!(plan.direction(10), None);
    assert_eq!(plan.stroke_start(10), None);
}

/// FNV-1a written out here once more, over the bytes that the documentation names.
#[test]
fn the_hash_is_fnv_of_the_integers() {
    let plan = solve(&PAPER).unwrap();
    let p = plan.forward();
    let stroke = [u64::from(p.steps().0), p.duration().0, p.ramp().0];
    let words = [&[5][..], &stroke, &stroke, &[0, 0, 0, 0]].concat();
    let mut hash = 14_695_981_039_346_656_037_u64;
    for byte in words.iter().flat_map(|word| word.to_le_bytes()) {
        hash = (hash ^ u64::from(byte)).wrapping_mul(1_099_511_628_211);
    }
    assert_eq!(plan.hash(), hash);

    let slower = RunRequest {
        far_dwell_us: 1,
        ..PAPER
    };
    assert_ne!(solve(&slower).unwrap().hash(), hash);
}

fn requests() -> impl Strategy<Value = RunRequest> {
    let total =
        (100_000_u64..400_000_000, 1_000_u32..=2_000_000).prop_map(|(total_us, accel_um_s2)| {
            Timing::Total {
                total_us,
                accel_um_s2,
            }
        });
    let speeds = (
        1_000_u32..=100_000,
        1_000_u32..=100_000,
        1_000_u32..=2_000_000,
    )
        .prop_map(|(forward_um_s, return_um_s, accel_um_s2)| Timing::Speeds {
            forward_um_s,
            return_um_s,
            accel_um_s2,
        });
    (
        1_u16..=30,
        1_000_u32..=130_000,
        prop_oneof![3 => total, 1 => speeds],
        0_u32..3_000_000,
        0_u32..3_000_000,
        0_u32..3_000_000,
    )
        .prop_map(
            |(cycles, stroke_um, timing, far_dwell_us, home_dwell_us, start_delay_us)| RunRequest {
                cycles,
                stroke_um,
                timing,
                far_dwell_us,
                home_dwell_us,
                start_delay_us,
            },
        )
}

/// The same request with another total, another acceleration.
fn with(request: &RunRequest, total_us: u64, accel_um_s2: u32) -> RunRequest {
    RunRequest {
        timing: Timing::Total {
            total_us,
            accel_um_s2,
        },
        ..*request
    }
}

const fn unlimited() -> Limits {
    Limits {
        max_speed_um_s: u32::MAX,
        max_accel_um_s2: u32::MAX,
        min_interval_ticks: 0,
        min_turnaround_ticks: 0,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// A plan adds up when it is walked stroke by stroke; a refusal names the exact boundary.
    #[test]
    fn a_run_is_exact_or_refused_at_the_boundary(request in requests()) {
        let axis = Axis::REFERENCE;
        match (solve(&request), request.timing) {
            (Ok(plan), timing) => {
                let mut now = u64::from(request.start_delay_us) * 100;
                for i in 0..plan.strokes() {
                    prop_assert_eq!(plan.stroke_start(i), Some(Ticks(now)));
                    let stroke = plan.stroke(i).unwrap();
                    prop_assert_eq!(stroke.steps(), axis.steps_within(Micrometres(request.stroke_um)).unwrap());
                    now += stroke.duration().0;
                    let last = i + 1 == plan.strokes();
                    now += match plan.direction(i).unwrap() {
                        Direction::Away if i + 2 == plan.strokes() =>
                            plan.far_dwell().0 + plan.last_far_extra().0,
                        Direction::Away => plan.far_dwell().0,
                        Direction::Home if last => 0,
                        Direction::Home => plan.home_dwell().0,
                    };
                }
                prop_assert_eq!(plan.total(), Ticks(now));
                prop_assert!(plan.last_far_extra().0 < u64::from(plan.strokes()));
                for (stroke, dwell) in [(plan.forward(), plan.home_dwell()), (plan.return_(), plan.far_dwell())] {
                    prop_assert!(stroke.peak_um_s(&axis) <= LIMITS.max_speed_um_s);
                    prop_assert!(stroke.min_interval().0 >= u64::from(LIMITS.min_interval_ticks));
                    prop_assert!(dwell.0 + stroke.first_interval().0 >= u64::from(LIMITS.min_turnaround_ticks));
                }
                match timing {
                    Timing::Total { total_us, accel_um_s2 } => {
                        prop_assert_eq!(plan.total(), Ticks(total_us * 100));
                        prop_assert!(plan.forward().accel_um_s2(&axis) <= accel_um_s2);
                    }
                    Timing::Speeds { forward_um_s, return_um_s, accel_um_s2 } => {
                        prop_assert!(plan.forward().peak_um_s(&axis) <= forward_um_s);
                        prop_assert!(plan.return_().peak_um_s(&axis) <= return_um_s);
                        prop_assert!(plan.return_().accel_um_s2(&axis) <= accel_um_s2);
                    }
                }
            }
            (Err(RunError::TotalTooShort { minimal_total_us, minimal_accel_um_s2 }),
                Timing::Total { total_us, accel_um_s2 }) => {
                let feasible = |total, accel| !matches!(
                    RunPlan::solve(&axis, &unlimited(), &with(&request, total, accel)),
                    Err(RunError::TotalTooShort { .. })
                );
                prop_assert!(minimal_total_us > total_us);
                prop_assert!(feasible(minimal_total_us, accel_um_s2));
                prop_assert!(!feasible(minimal_total_us - 1, accel_um_s2));
                if let Some(least) = minimal_accel_um_s2.and_then(|least| u32::try_from(least).ok()) {
                    prop_assert!(least > accel_um_s2);
                    prop_assert!(feasible(total_us, least));
                    prop_assert!(!feasible(total_us, least - 1));
                }
            }
            (Err(RunError::PeakAboveLimit { minimal_total_us: Some(least), peak_um_s, .. }),
                Timing::Total { total_us, accel_um_s2 }) => {
                prop_assert!(peak_um_s >= LIMITS.max_speed_um_s);
                prop_assert!(least > total_us);
                let peak_fits = |total| !matches!(
                    solve(&with(&request, total, accel_um_s2)),
                    Err(RunError::PeakAboveLimit { .. } | RunError::TotalTooShort { .. })
                );
                prop_assert!(peak_fits(least));
                prop_assert!(!peak_fits(least - 1));
            }
            (Err(RunError::Profile(error)), _) => prop_assert!(
                matches!(error, motion::trapezoid::StrokeError::TooSlow { .. }
                    | motion::trapezoid::StrokeError::TooFast { .. }), "{error}"),
            (Err(other), _) => prop_assert!(false, "{other}"),
        }
    }
}

#[test]
fn refusals_say_what_to_do() {
    let refused = |request: RunRequest| solve(&request).unwrap_err();
    let none = refused(RunRequest { cycles: 0, ..PAPER });
    assert_eq!(none.to_string(), "0 cycles: use 1..=10000");
    let long = refused(RunRequest {
        stroke_um: 130_001,
        ..PAPER
    });
    assert_eq!(
        long.to_string(),
        "a stroke of 130.001 mm does not fit: use more than zero and at most 130.000 mm"
    );
    assert!(matches!(
        refused(RunRequest {
            stroke_um: 1,
            ..PAPER
        }),
        RunError::StrokeBelowOneStep { .. }
    ));
    let hurried = refused(with(&PAPER, 40_000_000, 32_499));
    assert_eq!(
        hurried,
        RunError::TotalTooShort {
            minimal_total_us: 40_000_616,
            minimal_accel_um_s2: Some(32_500)
        }
    );
    assert_eq!(
        hurried.to_string(),
        "too little time: allow at least 40.000616 s in total, or accelerate with at least 32500 um/s^2"
    );
    let resting = refused(RunRequest {
        far_dwell_us: 8_000_000,
        ..PAPER
    });
    assert!(matches!(
        resting,
        RunError::TotalTooShort {
            minimal_accel_um_s2: None,
            ..
        }
    ));
    assert!(matches!(
        refused(with(&PAPER, 40_000_000, 2_000_001)),
        RunError::AccelerationAboveLimit { .. }
    ));
    assert_eq!(
        refused(with(&PAPER, 40_000_000, 0)),
        RunError::Rate(AxisError::NoAcceleration)
    );
}

#[test]
fn the_step_rate_and_the_turn_are_limits_of_their_own() {
    let slow_driver = Limits {
        min_interval_ticks: 4_000,
        ..LIMITS
    };
    let error = RunPlan::solve(&Axis::REFERENCE, &slow_driver, &PAPER).unwrap_err();
    // 25,000 steps/s at 800 steps/mm.
    assert!(matches!(
        error,
        RunError::StepRate {
            max_um_s: 31_250,
            ..
        }
    ));

    let first = solve(&PAPER).unwrap().forward().first_interval().0;
    let turn = |dwell_us, extra| {
        let limits = Limits {
            min_turnaround_ticks: (first + extra) as u32,
            ..LIMITS
        };
        let request = RunRequest {
            far_dwell_us: dwell_us,
            home_dwell_us: dwell_us,
            timing: Timing::Speeds {
                forward_um_s: 32_500,
                return_um_s: 32_500,
                accel_um_s2: 100_000,
            },
            ..PAPER
        };
        RunPlan::solve(&Axis::REFERENCE, &limits, &request)
    };
    assert!(turn(0, 0).is_ok());
    let Err(RunError::Turnaround {
        minimal_dwell_us, ..
    }) = turn(0, 1_050)
    else {
        panic!("the turn is too short");
    };
    assert!(turn(minimal_dwell_us as u32, 1_050).is_ok());
    assert!(turn(minimal_dwell_us as u32 - 1, 1_050).is_err());
}

/// Every step of a run with uneven strokes is later than the one before, across the turns, and
/// the last one is the total.
#[test]
fn the_edges_of_a_run_are_one_timeline() {
    let request = RunRequest {
        cycles: 3,
        stroke_um: 7_777,
        timing: Timing::Total {
            total_us: 3_333_333,
            accel_um_s2: 150_000,
        },
        far_dwell_us: 1_001,
        home_dwell_us: 17,
        start_delay_us: 5,
    };
    let plan = solve(&request).unwrap();
    let (mut before, mut edges) = (0, 0);
    for i in 0..plan.strokes() {
        let start = plan.stroke_start(i).unwrap().0;
        for tick in StepTimes::new(*plan.stroke(i).unwrap()) {
            assert!(start + tick >= before + 100);
            before = start + tick;
            edges += 1;
        }
    }
    assert_eq!(before, 333_333_300);
    assert_eq!(edges, plan.edges());
}
