//! The paper's stroke, every edge: 130 mm at 800 steps per mm in 4 s, 100 mm/s^2.

use motion::axis::Axis;
use motion::step_times::StepTimes;
use motion::trapezoid::StrokeProfile;
use motion::units::{Steps, Ticks};
use num_bigint::BigInt;

fn paper() -> StrokeProfile {
    let axis = Axis::REFERENCE;
    StrokeProfile::from_duration(
        axis.stroke_steps(),
        Ticks(400_000_000),
        axis.acceleration(100_000).unwrap(),
    )
    .unwrap()
}

#[test]
fn the_stroke_is_the_papers() {
    let (axis, profile) = (Axis::REFERENCE, paper());
    assert_eq!(profile.steps(), Steps(104_000));
    assert_eq!(profile.duration(), Ticks(400_000_000));
    assert_eq!(profile.accel_um_s2(&axis), 100_000);
    assert_eq!(profile.peak_um_s(&axis), 35_683);
}

/// Every tick again from the definition, by one big square root or division per step.
#[test]
fn every_edge_is_the_nearest_tick() {
    let profile = paper();
    let (n, t, r) = (
        u64::from(profile.steps().0),
        profile.duration().0,
        profile.ramp().0,
    );
    let square = BigInt::from(2 * r) * (t - r);
    let from_rest = |k: u64| (BigInt::from(4 * k) * &square / n).sqrt();
    let mut count = 0_u64;
    for (k, tick) in (1..).zip(StepTimes::new(profile)) {
        let expected: BigInt = if BigInt::from(k) * &square <= BigInt::from(n) * r * r {
            (from_rest(k) + 1) / 2
        } else if BigInt::from(n - k) * &square <= BigInt::from(n) * r * r {
            BigInt::from(t) - (from_rest(n - k) + 1) / 2
        } else {
            (BigInt::from(n * r + n) + BigInt::from(2 * k) * (t - r)) / (2 * n)
        };
        assert_eq!(BigInt::from(tick), expected, "step {k}");
        count += 1;
    }
    assert_eq!(count, n);
}

#[test]
fn the_last_edge_ends_the_stroke() {
    let mut times = StepTimes::new(paper());
    let last = times.by_ref().last();
    assert_eq!(last, Some(400_000_000));
    assert_eq!(times.tick(), Ticks(400_000_000));
    assert_eq!(times.remaining(), Steps(0));
    assert_eq!(times.next(), None);
}
