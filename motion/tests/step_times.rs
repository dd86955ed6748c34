//! Step times and stops against the definition, on random axes and strokes.

use motion::axis::Axis;
use motion::step_times::StepTimes;
use motion::trapezoid::{MAX_INTERVAL, MIN_INTERVAL, StrokeError, StrokeProfile};
use motion::units::{Steps, TICK_HZ, Ticks};
use num_bigint::BigInt;
use proptest::prelude::*;

fn axes() -> impl Strategy<Value = Axis> {
    (500_u32..=50_000, prop::bool::ANY, 0_u32..=8).prop_map(|(lead, fine, power)| {
        Axis::new(lead, if fine { 400 } else { 200 }, 1 << power, 130_000).unwrap()
    })
}

/// From 2^low to 2^high, each octave as likely as the others.
fn octaves(low: u32, high: u32) -> impl Strategy<Value = u32> {
    (low..high).prop_flat_map(|bits| (1_u32 << bits)..(2_u32 << bits))
}

/// Profiles of every kind: from parts, from speed, from duration; slow, fast, short, long.
fn profiles(max_steps: u32) -> impl Strategy<Value = StrokeProfile> {
    let steps = || 1..=max_steps;
    let parts = (steps(), octaves(6, 20), 1_u32..=1_000_000).prop_filter_map(
        "refused",
        |(n, interval, share)| {
            let t = u64::from(n) * u64::from(interval);
            let r = (t / 2 * u64::from(share) / 1_000_000).max(1);
            StrokeProfile::from_parts(Steps(n), Ticks(t), Ticks(r)).ok()
        },
    );
    let speeds = (axes(), steps(), octaves(6, 18), octaves(8, 24)).prop_filter_map(
        "refused",
        |(axis, n, speed, accel)| {
            let (speed, accel) = (
                axis.speed(speed).unwrap(),
                axis.acceleration(accel).unwrap(),
            );
            StrokeProfile::from_speed(Steps(n), speed, accel).ok()
        },
    );
    prop_oneof![parts, speeds]
}

fn integers(p: &StrokeProfile) -> (BigInt, BigInt, BigInt) {
    (p.steps().0.into(), p.duration().0.into(), p.ramp().0.into())
}

/// Whether the edge is within half a tick of the definition, by comparing squares: no root is
/// taken and no division made, so that nothing is shared with the code under test.
fn is_nearest(p: &StrokeProfile, k: u32, tick: u64) -> bool {
    let (n, t, r) = integers(p);
    let square: BigInt = 2 * &r * (&t - &r);
    let limit = &n * &r * &r;
    let within = |j: BigInt, from_rest: BigInt| {
        // (2 u - 1)^2 n <= 4 j N <= (2 u + 1)^2 n
        let exact = 4 * j * &square;
        let low: BigInt = 2 * &from_rest - 1;
        let high: BigInt = 2 * &from_rest + 1;
        (low.sign() == num_bigint::Sign::Minus || &low * &low * &n <= exact)
            && exact <= &high * &high * &n
    };
    let (k, tick) = (BigInt::from(k), BigInt::from(tick));
    let j: BigInt = &n - &k;
    if &k * &square <= limit {
        within(k, tick)
    } else if &j * &square <= limit {
        tick <= t && within(j, t - tick)
    } else {
        let error: BigInt = 2 * &n * tick - (&n * &r + 2 * k * (t - r));
        error.magnitude() <= n.magnitude()
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]

    #[test]
    fn every_edge_is_within_half_a_tick(profile in profiles(1_500)) {
        let mut times = StepTimes::new(profile);
        let (mut before, mut first, mut k) = (0, None, 0);
        while let Some(tick) = times.next() {
            k += 1;
            prop_assert!(is_nearest(&profile, k, tick), "{profile:?} step {k} at {tick}");
            prop_assert_eq!(times.emitted(), Steps(k));
            prop_assert_eq!(times.remaining(), Steps(profile.steps().0 - k));
            prop_assert_eq!(times.tick(), Ticks(tick));
            prop_assert_eq!(times.interval(), Ticks(tick - before));
            prop_assert!(times.interval() >= profile.min_interval());
            prop_assert!(times.interval() <= MAX_INTERVAL);
            first.get_or_insert(tick);
            before = tick;
        }
        prop_assert_eq!(k, profile.steps().0);
        prop_assert_eq!(before, profile.duration().0);
        prop_assert_eq!(first, Some(profile.first_interval().0));
    }

    /// Taken together or one by one, the steps are the same; none of the cruise that could be taken is left.
    #[test]
    fn repeated_steps_are_those_that_would_follow(
        profile in profiles(5_000), limits in prop::collection::vec(prop_oneof![0_u32..10, Just(u32::MAX)], 1..20),
    ) {
        let (mut times, mut single) = (StepTimes::new(profile), StepTimes::new(profile));
        let ramp = profile.ramp_steps().0;
        let cruise = ramp + 1..profile.steps().0 - ramp;
        for &most in limits.iter().cycle() {
            let Some(tick) = times.next() else { break };
            prop_assert_eq!(single.next(), Some(tick));
            let interval = times.interval();
            let mut expected = 0;
            while expected < most && cruise.contains(&single.emitted().0) && cruise.contains(&(single.emitted().0 + 1)) {
                let mut ahead = single.clone();
                ahead.next();
                if ahead.interval() != interval {
                    break;
                }
                (single, expected) = (ahead, expected + 1);
            }
            prop_assert_eq!(times.repeat(most), expected);
            prop_assert_eq!(times.tick(), single.tick());
            prop_assert_eq!(times.interval(), interval);
            prop_assert_eq!(times.emitted(), single.emitted());
        }
        prop_assert_eq!(single.next(), None);
        prop_assert_eq!(times.tick(), profile.duration());
    }

    /// Long strokes on fine axes: the bounds of the hot path, sampled.
    #[test]
    fn long_strokes_stay_exact(profile in profiles(60_000), stride in 500_usize..1_500) {
        for (k, tick) in (1..).zip(StepTimes::new(profile)).step_by(stride) {
            prop_assert!(is_nearest(&profile, k, tick), "{profile:?} step {k} at {tick}");
        }
    }

    #[test]
    fn a_stop_rests_on_a_whole_step_inside_the_stroke(
        axis in axes(),
        profile in profiles(20_000),
        share in 0_u32..=1_000,
        um_s2 in octaves(10, 26),
    ) {
        let n = profile.steps().0;
        let at = (u64::from(n) * u64::from(share) / 1_000) as u32;
        let deceleration = axis.acceleration(um_s2).unwrap();
        let mut times = StepTimes::new(profile);
        let natural: Vec<u64> = times.clone().collect();
        if at > 0 {
            times.nth(at as usize - 1);
        }
        let (speed_interval, start) = (times.interval().0, times.tick().0);
        let stop = times.stop(deceleration);
        let braking: Vec<u64> = times.clone().collect();

        prop_assert_eq!(braking.len(), stop.steps.0 as usize);
        prop_assert!(at + stop.steps.0 <= n);
        prop_assert_eq!(times.left_out(), Steps(n - at - stop.steps.0));
        prop_assert_eq!(braking.last().copied().unwrap_or(start), if at == 0 { 0 } else { stop.rest.0 });
        if braking != natural[at as usize..] {
            // One ramp to rest: v = 1/d, 2 m d ticks for m steps, intervals never shrink by more
            // than the rounding of the ticks.
            let m = u64::from(stop.steps.0);
            prop_assert_eq!(stop.rest.0 - start, 2 * m * speed_interval);
            let mut before = (start, speed_interval);
            for &tick in &braking {
                let interval = tick - before.0;
                prop_assert!(interval + 1 >= before.1, "{interval} after {}", before.1);
                before = (tick, interval);
            }
            if let Some(first) = braking.first() {
                prop_assert!(first - start >= speed_interval);
            }
            // u_j^2 = 4 m d^2 j, nearest tick.
            for (i, &tick) in braking.iter().enumerate() {
                let j = BigInt::from(m) - (i + 1);
                let twice = 2 * BigInt::from(stop.rest.0 - tick);
                let exact = BigInt::from(16 * m) * speed_interval * speed_interval * j;
                let below: BigInt = &twice - 1;
                let low = below.max(BigInt::from(0));
                let high: BigInt = twice + 1;
                prop_assert!(&low * &low <= exact && exact <= &high * &high);
            }
            // v^2 / 2m at most the deceleration, in um/s^2, unless the end of the stroke or
            // the longest stop is nearer; and not a step more than that needs.
            let demand = |m: u64| BigInt::from(TICK_HZ) * TICK_HZ * axis.lead().0
                <= BigInt::from(2 * m) * speed_interval * speed_interval
                    * axis.steps_per_rev() * um_s2;
            let at_end = at + stop.steps.0 == n;
            let longest = 2 * (m + 1) * speed_interval >= 1 << 31;
            prop_assert!(m == 0 || demand(m) || at_end || longest);
            prop_assert!(m <= 1 || !demand(m - 1));
        }
    }

    /// A second stop while braking never lengthens the way, and a harder one shortens it.
    #[test]
    fn stopping_again_never_goes_further(
        axis in axes(), profile in profiles(5_000), share in 1_u32..1_000,
        gentle in octaves(10, 20), harder in octaves(10, 26), between in 0_usize..200,
    ) {
        let mut times = StepTimes::new(profile);
        let at = (u64::from(profile.steps().0) * u64::from(share) / 1_000) as usize;
        times.by_ref().take(at).for_each(drop);
        times.stop(axis.acceleration(gentle).unwrap());
        times.by_ref().take(between).for_each(drop);
        let before = times.remaining();
        let stop = times.stop(axis.acceleration(harder).unwrap());
        prop_assert!(stop.steps <= before);
        prop_assert_eq!(times.count(), stop.steps.0 as usize);
    }

    /// Speed and acceleration of the rest of a stroke are at most the stroke's own, exactly, and
    /// the rest is not slower than one tick in each of its two parts.
    #[test]
    fn a_resumed_stroke_keeps_speed_and_acceleration(profile in profiles(20_000), left in 1_u32..20_000) {
        if let Ok(rest) = profile.resumed(Steps(left)) {
            let (n, t, r) = integers(&profile);
            let (m, u, q) = integers(&rest);
            prop_assert!(&m * (&t - &r) <= &n * (&u - &q));
            prop_assert!(&m * &r * (&t - &r) <= &n * &q * (&u - &q));
            if left == profile.steps().0 {
                prop_assert!(rest.duration() <= profile.duration());
            }
        }
    }

    #[test]
    fn a_duration_is_met_or_refused_at_the_exact_boundary(
        axis in axes(), n in 1_u32..200_000, um_s2 in octaves(8, 24), span in octaves(6, 15),
    ) {
        let wanted = Ticks(u64::from(n) * u64::from(span));
        let acceleration = axis.acceleration(um_s2).unwrap();
        // n / (r (T - r)) <= a, multiplied out.
        let gentle_enough = |n: u32, t: u64, r: u64, um_s2: u64| {
            BigInt::from(n) * TICK_HZ * TICK_HZ * axis.lead().0
                <= BigInt::from(um_s2) * axis.steps_per_rev() * r * (t - r)
        };
        match StrokeProfile::from_duration(Steps(n), wanted, acceleration) {
            Ok(p) => {
                prop_assert_eq!(p.duration(), wanted);
                let (t, r) = (wanted.0, p.ramp().0);
                prop_assert!(gentle_enough(n, t, r, u64::from(um_s2)));
                prop_assert!(r == 1 || !gentle_enough(n, t, r - 1, u64::from(um_s2)));
            }
            Err(StrokeError::Infeasible { minimal_duration, minimal_accel_um_s2 }) => {
                let half = |t: u64| t / 2;
                let (t, least) = (minimal_duration.0, minimal_accel_um_s2);
                prop_assert!(gentle_enough(n, t, half(t), u64::from(um_s2)));
                prop_assert!(!gentle_enough(n, t - 1, half(t - 1), u64::from(um_s2)));
                prop_assert!(gentle_enough(n, wanted.0, half(wanted.0), least));
                prop_assert!(!gentle_enough(n, wanted.0, half(wanted.0), least - 1));
            }
            Err(StrokeError::TooFast { interval }) => prop_assert!(interval < MIN_INTERVAL),
            Err(other) => prop_assert!(matches!(other, StrokeError::TooSlow { .. }), "{other}"),
        }
    }

    /// From speed: neither limit is exceeded, and one tick less would exceed one of them.
    #[test]
    fn a_speed_is_the_shortest_within_both_limits(
        axis in axes(), n in 1_u32..200_000, um_s in octaves(8, 18), um_s2 in octaves(8, 24),
    ) {
        let (speed, acceleration) = (axis.speed(um_s).unwrap(), axis.acceleration(um_s2).unwrap());
        if let Ok(p) = StrokeProfile::from_speed(Steps(n), speed, acceleration) {
            prop_assert!(p.within(speed));
            prop_assert!(p.peak_um_s(&axis) <= um_s);
            prop_assert!(p.accel_um_s2(&axis) <= um_s2);
            // n / (r (T - r)) <= a, exactly.
            let (steps, t, r) = integers(&p);
            prop_assert!(
                steps * TICK_HZ * TICK_HZ * axis.lead().0
                    <= BigInt::from(um_s2) * axis.steps_per_rev() * &r * (t - &r)
            );
            let same = StrokeProfile::from_duration(Steps(n), p.duration(), acceleration).unwrap();
            prop_assert!(same.within(speed));
            let shorter = Ticks(p.duration().0 - 1);
            if let Ok(q) = StrokeProfile::from_duration(Steps(n), shorter, acceleration) {
                prop_assert!(!q.within(speed), "{p:?} is not the shortest: {q:?}");
            }
        }
    }
}

#[test]
fn a_stop_before_the_first_step_moves_nothing() {
    let axis = Axis::REFERENCE;
    let profile = StrokeProfile::from_parts(Steps(100), Ticks(1_000_000), Ticks(400_000)).unwrap();
    let mut times = StepTimes::new(profile);
    let stop = times.stop(axis.acceleration(1_000).unwrap());
    assert_eq!(stop.steps, Steps(0));
    assert_eq!(times.next(), None);
    assert_eq!(times.left_out(), Steps(100));
}

/// On the stroke's own final ramp, a deceleration that would not be at rest earlier changes nothing.
#[test]
fn a_gentle_stop_on_the_final_ramp_finishes_the_stroke_as_planned() {
    let axis = Axis::REFERENCE;
    let gentle = axis.acceleration(50_000).unwrap();
    let profile = StrokeProfile::from_duration(
        Steps(8_000),
        Ticks(100_000_000),
        axis.acceleration(100_000).unwrap(),
    )
    .unwrap();
    let planned: Vec<u64> = StepTimes::new(profile).collect();
    let down = planned.len() - profile.ramp_steps().0 as usize;
    for at in [down + 1, down + 100, planned.len() - 2] {
        let mut times = StepTimes::new(profile);
        times.by_ref().take(at).for_each(drop);
        let stop = times.stop(gentle);
        assert_eq!(stop.steps, Steps((planned.len() - at) as u32));
        assert_eq!(stop.rest, profile.duration());
        assert!(times.eq(planned[at..].iter().copied()));
    }
}

/// 20,000 steps at 80,000 steps/s^2: half a second up to 40,000 steps/s, half a second down.
#[test]
fn a_triangle_uses_the_acceleration_up() {
    let axis = Axis::REFERENCE;
    let (speed, acceleration) = (
        axis.speed(100_000).unwrap(),
        axis.acceleration(100_000).unwrap(),
    );
    let triangle = StrokeProfile::from_speed(Steps(20_000), speed, acceleration).unwrap();
    assert_eq!(triangle.duration(), Ticks(TICK_HZ));
    assert_eq!(triangle.ramp(), Ticks(TICK_HZ / 2));
    assert_eq!(triangle.peak_um_s(&axis), 50_000);
}

#[test]
fn the_bounds_refuse_what_they_say() {
    let parts = |n, t, r| StrokeProfile::from_parts(Steps(n), Ticks(t), Ticks(r));
    assert_eq!(parts(0, 100, 10), Err(StrokeError::NoSteps));
    assert!(matches!(
        parts(1 << 26, 1 << 40, 10),
        Err(StrokeError::TooManySteps { .. })
    ));
    assert!(matches!(
        parts(10, 10_000, 0),
        Err(StrokeError::Ramp { .. })
    ));
    assert!(matches!(
        parts(10, 10_001, 5_001),
        Err(StrokeError::Ramp { .. })
    ));
    assert!(parts(10, 10_001, 5_000).is_ok());
    // 1 MHz is allowed, and no more.
    assert!(parts(1_000, 100_500, 500).is_ok());
    assert!(matches!(
        parts(1_000, 100_499, 500),
        Err(StrokeError::TooFast { .. })
    ));
    // A triangle of 2^31.5 ticks and a single step of 2^30 are the slowest.
    assert!(parts(100_000, 3_037_000_498, 1_518_500_249).is_ok());
    assert!(matches!(
        parts(100_000, 3_037_000_500, 1_518_500_250),
        Err(StrokeError::TooSlow { .. })
    ));
    assert!(parts(1, (1 << 30) - 1, 1_000).is_ok());
    assert!(matches!(
        parts(1, 1 << 30, 1_000),
        Err(StrokeError::TooSlow { .. })
    ));
    assert!(matches!(
        parts(u32::MAX >> 7, u64::MAX, u64::MAX / 2),
        Err(StrokeError::TooSlow { .. })
    ));
}

/// Profiles close to each bound: where sums are largest.
#[test]
fn the_extremes_do_not_overflow() {
    for (n, t, r) in [
        (100_000, 3_037_000_498, 1_518_500_249),
        (1 << 25, (1_u64 << 59) / (1 << 25) - 1, 100_000_000),
        (1 << 25, (1 << 25) * 128, (1 << 25) * 16),
        (1, (1 << 30) - 1, (1 << 29) - 1),
        (2, (1 << 31) - 2, (1 << 30) - 1),
        (3, 2_600_000_000, 1_300_000_000),
    ] {
        let Ok(profile) = StrokeProfile::from_parts(Steps(n), Ticks(t), Ticks(r)) else {
            panic!("{n} {t} {r} refused");
        };
        let head = StepTimes::new(profile).take(3_000);
        for (k, tick) in (1..).zip(head) {
            assert!(is_nearest(&profile, k, tick), "{profile:?} step {k}");
        }
    }
}
