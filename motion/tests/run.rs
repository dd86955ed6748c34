//! The run solver: sums, boundaries, refusals.

use motion::axis::{Axis, Direction};
use motion::run::{Limits, RunError, RunPlan, RunRequest, Timing};
use motion::step_times::StepTimes;
use motion::trapezoid::StrokeError;
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

/// FNV-1a, written out again, over the bytes that the documentation names.
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

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// A plan adds up stroke by stroke; a refusal names the exact limit.
    #[test]
    fn a_run_is_exact_or_refused_at_the_boundary(request in requests()) {
        let axis = Axis::REFERENCE;
        match (solve(&request), request.timing) {
            (Ok(plan), timing) => {
                prop_assert_eq!(plan.cycles(), request.cycles);
                prop_assert_eq!(plan.strokes(), 2 * u32::from(request.cycles));
                let ticks = |us: u32| u64::from(us) * 100;
                let (far, home) = (ticks(request.far_dwell_us), ticks(request.home_dwell_us));
                let mut now = ticks(request.start_delay_us);
                for i in 0..plan.strokes() {
                    let start = plan.stroke_start(i).unwrap().0;
                    if i + 1 == plan.strokes() {
                        // The rest of the total, less than a tick per stroke.
                        prop_assert!((now..now + u64::from(plan.strokes())).contains(&start));
                        now = start;
                    }
                    prop_assert_eq!(start, now);
                    let stroke = plan.stroke(i).unwrap();
                    prop_assert_eq!(stroke, [plan.forward(), plan.return_()][i as usize % 2]);
                    prop_assert_eq!(stroke.steps(), axis.steps_within(Micrometres(request.stroke_um)).unwrap());
                    now += stroke.duration().0;
                    let last = i + 1 == plan.strokes();
                    now += match plan.direction(i).unwrap() {
                        Direction::Away => far,
                        Direction::Home if last => 0,
                        Direction::Home => home,
                    };
                }
                prop_assert_eq!(plan.total(), Ticks(now));
                for (stroke, dwell) in [(plan.forward(), home), (plan.return_(), far)] {
                    prop_assert!(stroke.peak_um_s(&axis) <= LIMITS.max_speed_um_s);
                    prop_assert!(stroke.min_interval().0 >= u64::from(LIMITS.min_interval_ticks));
                    prop_assert!(dwell + stroke.first_interval().0 >= u64::from(LIMITS.min_turnaround_ticks));
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
                let accepted = |total, accel| solve(&with(&request, total, accel)).is_ok();
                prop_assert!(minimal_total_us > total_us);
                prop_assert!(accepted(minimal_total_us, accel_um_s2));
                prop_assert!(!accepted(minimal_total_us - 1, accel_um_s2));
                match minimal_accel_um_s2 {
                    Some(least) => {
                        prop_assert!(least > accel_um_s2);
                        prop_assert!(accepted(total_us, least));
                        prop_assert!(!accepted(total_us, least - 1));
                    }
                    None => {
                        let mut harder = (0..=64).map(|part| accel_um_s2 + (LIMITS.max_accel_um_s2 - accel_um_s2) / 64 * part);
                        prop_assert!(!harder.any(|accel| accepted(total_us, accel)));
                        prop_assert!(!accepted(total_us, LIMITS.max_accel_um_s2));
                    }
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
                matches!(error, StrokeError::TooSlow { .. }
                    | StrokeError::TooFast { .. }), "{error}"),
            (Err(other), _) => prop_assert!(false, "{other}"),
        }
    }
}

/// Each refusal of [`RunPlan::solve`], as an operator reads it.
#[test]
fn refusals_say_what_to_do() {
    let cycles = |cycles| RunRequest { cycles, ..PAPER };
    let stroke = |stroke_um| RunRequest { stroke_um, ..PAPER };
    let resting = RunRequest {
        far_dwell_us: 8_000_000,
        ..PAPER
    };
    let no_rest_at_home = RunRequest {
        far_dwell_us: 10_000,
        ..speeds(30_000, 30_000, 100_000)
    };
    // No stroke within 1 um/s has exact step times.
    let [slow, slowest] = [35_000, 1].map(|max_speed_um_s| Limits {
        max_speed_um_s,
        ..LIMITS
    });
    let driver = Limits {
        min_interval_ticks: 4_000,
        ..LIMITS
    };
    let turns = Limits {
        min_turnaround_ticks: 650_000,
        ..LIMITS
    };
    let requests = [
        (LIMITS, cycles(0)),
        (LIMITS, cycles(10_001)),
        (LIMITS, stroke(0)),
        (LIMITS, stroke(130_001)),
        (LIMITS, stroke(1)),
        (LIMITS, with(&PAPER, 40_000_000, 32_499)),
        (LIMITS, resting),
        (LIMITS, with(&PAPER, 40_000_000, 2_000_001)),
        (LIMITS, with(&PAPER, 40_000_000, 0)),
        (LIMITS, speeds(100_001, 1_000, 100_000)),
        (LIMITS, speeds(1_000, 100_001, 100_000)),
        (LIMITS, speeds(1_000, 0, 100_000)),
        (LIMITS, speeds(1_000, 1_000, 2_000_001)),
        (LIMITS, with(&PAPER, u64::MAX, 100_000)),
        (LIMITS, with(&PAPER, 1_000_000_000_000, 100_000)),
        (slow, PAPER),
        (slowest, PAPER),
        (driver, PAPER),
        (turns, PAPER),
        (turns, no_rest_at_home),
    ];
    let texts = requests.map(|(limits, request)| {
        let error = RunPlan::solve(&Axis::REFERENCE, &limits, &request).unwrap_err();
        format!("{limits:?}\n{request:?}\n    {error}")
    });
    insta::assert_snapshot!("refused_runs", texts.join("\n"));
}

fn speeds(forward_um_s: u32, return_um_s: u32, accel_um_s2: u32) -> RunRequest {
    RunRequest {
        timing: Timing::Speeds {
            forward_um_s,
            return_um_s,
            accel_um_s2,
        },
        ..PAPER
    }
}

/// A request that equals a limit is allowed: cycles, speed, acceleration, step rate.
#[test]
fn a_limit_may_be_reached() {
    assert!(
        solve(&RunRequest {
            cycles: 10_000,
            ..speeds(100_000, 100_000, 2_000_000)
        })
        .is_ok()
    );
    assert!(solve(&with(&PAPER, 40_000_000, 2_000_000)).is_ok());
    // At 35,683 um/s the paper's steps are 3,503 ticks apart.
    let exact = Limits {
        min_interval_ticks: 3_503,
        ..LIMITS
    };
    assert!(RunPlan::solve(&Axis::REFERENCE, &exact, &PAPER).is_ok());
}

/// No acceleration helps where delay and dwells leave a stroke a single tick, or where a stroke without any ramps would
/// be too fast.
#[test]
fn an_acceleration_is_suggested_only_where_it_helps() {
    for (total_us, least) in [
        // Strokes of 130 mm in 1 s are above 100 mm/s with any ramps, in 1.3 s with any but none.
        (10_000_000, None),
        (13_000_000, None),
        // Ramps of 50 ms to 100 mm/s: the most that the machine may. A microsecond less per stroke is too little.
        (13_500_000, Some(2_000_000)),
        (13_499_990, None),
        // Ramps of 0.3 s.
        (16_000_000, Some(333_334)),
    ] {
        let Err(RunError::TotalTooShort {
            minimal_accel_um_s2,
            ..
        }) = solve(&with(&PAPER, total_us, 100_000))
        else {
            panic!("in {total_us} us");
        };
        assert_eq!(minimal_accel_um_s2, least, "{total_us} us");
    }
    for cycles in [25, 50, 51] {
        let request = RunRequest {
            cycles,
            stroke_um: 2,
            ..with(&PAPER, 1, 100_000)
        };
        let Err(RunError::TotalTooShort {
            minimal_accel_um_s2,
            ..
        }) = solve(&request)
        else {
            panic!("{cycles} cycles in a microsecond");
        };
        assert_eq!(minimal_accel_um_s2, None);
    }
}

/// The speed that a refusal suggests is slow enough for the driver, and no slower than need be.
#[test]
fn a_step_rate_above_the_limit_names_a_speed() {
    let (axis, driver) = (
        Axis::REFERENCE,
        Limits {
            min_interval_ticks: 3_999,
            ..LIMITS
        },
    );
    let run = |um_s| RunPlan::solve(&axis, &driver, &speeds(um_s, um_s, 100_000));
    let Err(RunError::StepRate {
        interval,
        min_interval,
        max_um_s,
    }) = run(33_000)
    else {
        panic!("33 mm/s is too fast for steps of 3,999 ticks");
    };
    assert_eq!((interval, min_interval), (Ticks(3_787), Ticks(3_999)));
    assert_eq!(max_um_s, 31_257);
    assert!(run(max_um_s as u32).is_ok());
    assert!(run(max_um_s as u32 + 1).is_err());
}

/// The dwell that a refusal suggests is the shortest that suffices, at both turns.
#[test]
fn a_turn_needs_a_dwell() {
    let first = solve(&PAPER).unwrap().forward().first_interval().0;
    let run = |cycles, far_dwell_us, home_dwell_us, extra| {
        let limits = Limits {
            min_turnaround_ticks: (first + extra) as u32,
            ..LIMITS
        };
        let request = RunRequest {
            cycles,
            far_dwell_us,
            home_dwell_us,
            ..speeds(32_500, 32_500, 100_000)
        };
        RunPlan::solve(&Axis::REFERENCE, &limits, &request)
    };
    let refused = |before, dwell, minimal_dwell_us| {
        Err(RunError::Turnaround {
            before,
            dwell: Ticks(dwell),
            minimal_dwell_us,
        })
    };
    assert!(run(5, 0, 0, 0).is_ok());
    // 1,050 ticks more than the first interval: 11 us.
    assert_eq!(run(5, 3, 11, 1_050), refused(Direction::Home, 300, 11));
    assert_eq!(run(5, 10, 11, 1_050), refused(Direction::Home, 1_000, 11));
    assert_eq!(run(5, 11, 3, 1_050), refused(Direction::Away, 300, 11));
    assert_eq!(run(5, 11, 10, 1_050), refused(Direction::Away, 1_000, 11));
    assert!(run(5, 11, 11, 1_050).is_ok());
    // A single cycle does not turn at home; two do.
    assert!(run(1, 11, 0, 1_050).is_ok());
    assert_eq!(run(2, 11, 0, 1_050), refused(Direction::Away, 0, 11));
    assert_eq!(run(1, 0, 0, 1_050), refused(Direction::Home, 0, 11));
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
