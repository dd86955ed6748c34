//! Step times and stops against the definition, on random axes and strokes.

use motion::axis::Axis;
use motion::step_times::{BatchLimits, Equal, LONGEST_TAKEN, StepTimes, Stop};
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

/// Profiles of every kind: from parts and from speeds; slow, fast, short, long.
fn profiles(max_steps: u32) -> impl Strategy<Value = StrokeProfile> {
    let steps = || prop_oneof![3 => 1..=max_steps, 1 => 1_u32..=20];
    let ratios = prop_oneof![1_u32..=1_000_000, octaves(0, 19), Just(1_000_000)];
    let parts =
        (steps(), octaves(6, 20), ratios).prop_filter_map("refused", |(n, interval, ratio)| {
            let t = u64::from(n) * u64::from(interval);
            let r = (t / 2 * u64::from(ratio) / 1_000_000).max(1);
            StrokeProfile::from_parts(Steps(n), Ticks(t), Ticks(r)).ok()
        });
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
/// taken and no division made, so that nothing is shared with the code under test. Below 2^125.
fn is_nearest(p: &StrokeProfile, k: u32, tick: u64) -> bool {
    let (n, t, r) = (
        i128::from(p.steps().0),
        i128::from(p.duration().0),
        i128::from(p.ramp().0),
    );
    let square = 2 * r * (t - r);
    let limit = n * r * r;
    let within = |j: i128, from_rest: i128| {
        // (2 u - 1)^2 n <= 4 j N <= (2 u + 1)^2 n
        let exact = 4 * j * square;
        let (low, high) = (2 * from_rest - 1, 2 * from_rest + 1);
        (low < 0 || low * low * n <= exact) && exact <= high * high * n
    };
    let (k, tick) = (i128::from(k), i128::from(tick));
    let j = n - k;
    if k * square <= limit {
        within(k, tick)
    } else if j * square <= limit {
        tick <= t && within(j, t - tick)
    } else {
        let error = 2 * n * tick - (n * r + 2 * k * (t - r));
        error.abs() <= n
    }
}

/// A place in a stroke: the phase, and how far into it in thousandths.
#[derive(Clone, Copy, Debug)]
struct Place(usize, u32);

fn places() -> impl Strategy<Value = Place> {
    (
        0_usize..3,
        prop_oneof![4 => 0_u32..=1_000, 1 => Just(0), 1 => Just(1_000)],
    )
        .prop_map(|(phase, fraction)| Place(phase, fraction))
}

impl Place {
    /// The step at this place: in the first ramp, the cruise or the last ramp, ends included.
    fn step(self, profile: &StrokeProfile) -> u32 {
        let (n, ramp) = (profile.steps().0, profile.ramp_steps().0);
        let ends = [0, ramp, n - ramp, n];
        let (first, last) = (ends[self.0], ends[self.0 + 1]);
        first + (u64::from(last - first) * u64::from(self.1) / 1_000) as u32
    }
}

/// Amounts taken at once: little, as the step generator does it, or everything.
fn batch_limits() -> impl Strategy<Value = (usize, BatchLimits)> {
    let count = || prop_oneof![0_u32..10, 0_u32..400, Just(u32::MAX)];
    let ticks = || prop_oneof![0_u32..5_000, 0_u32..1_000_000];
    (0_usize..70, count(), ticks(), count(), ticks()).prop_map(
        |(groups, steps, ticks, equal, equal_ticks)| {
            let limits = BatchLimits {
                steps,
                ticks,
                equal,
                equal_ticks,
            };
            (groups, limits)
        },
    )
}

/// The number n of a stroke's steps, and how many n-ths of a tick each step takes beyond whole ticks: any number, or one
/// close to a simple fraction of a tick, such as none, a half or a whole.
fn fractions() -> impl Strategy<Value = (u32, u32)> {
    let simple = (1_u32..=12, 0_u32..=12, -3_i32..=3);
    (
        2_000_u32..200_000,
        prop_oneof![Just(None), simple.prop_map(Some)],
        any::<u32>(),
    )
        .prop_map(|(n, simple, any)| {
            let fraction = match simple {
                None => any % n,
                Some((denominator, numerator, off)) => {
                    let near = u64::from(n) * u64::from(numerator.min(denominator))
                        / u64::from(denominator);
                    (near as u32).saturating_add_signed(off).min(n - 1)
                }
            };
            (n, fraction)
        })
}

/// A deceleration: um/s^2, or sixteenths of what the stroke itself accelerates with.
#[derive(Clone, Copy, Debug)]
enum Deceleration {
    Absolute(u32),
    Relative(u32),
}

fn decelerations() -> impl Strategy<Value = Deceleration> {
    prop_oneof![
        octaves(10, 26).prop_map(Deceleration::Absolute),
        octaves(1, 10).prop_map(Deceleration::Relative),
        Just(Deceleration::Absolute(1)),
    ]
}

impl Deceleration {
    fn um_s2(self, profile: &StrokeProfile, axis: &Axis) -> u32 {
        match self {
            Self::Absolute(um_s2) => um_s2,
            Self::Relative(fraction) => {
                let um_s2 = u64::from(profile.accel_um_s2(axis)) * u64::from(fraction) / 16;
                u32::try_from(um_s2).unwrap_or(u32::MAX).max(1)
            }
        }
    }
}

/// Whether a stop in `steps` from `interval` is this long before rest with `j` steps to go:
/// u^2 = 4 d^2 m j, to the nearest tick.
fn is_braking(steps: u32, interval: u64, j: u32, from_rest: u64) -> bool {
    let exact = 16 * u128::from(interval * interval) * u128::from(steps) * u128::from(j);
    let twice = 2 * u128::from(from_rest);
    (from_rest == 0 || (twice - 1) * (twice - 1) <= exact) && exact <= (twice + 1) * (twice + 1)
}

/// The steps in which a speed of one step per `interval` comes to rest: v^2 / 2a, at least one, and in
/// less than 2^31 ticks. None at rest.
fn expected_steps(axis: &Axis, um_s2: u32, interval: u64) -> u32 {
    if interval == 0 {
        return 0;
    }
    let speed = BigInt::from(TICK_HZ) * TICK_HZ * axis.lead().0;
    let braking = BigInt::from(2 * u64::from(um_s2)) * interval * interval * axis.steps_per_rev();
    let wanted: BigInt = (speed + &braking - 1) / braking;
    let longest = ((1 << 31) - 1) / (2 * interval);
    wanted
        .min(longest.into())
        .try_into()
        .unwrap_or(u32::MAX)
        .max(1)
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
            prop_assert_eq!(times.tick(), Ticks(tick));
            prop_assert_eq!(times.interval(), Ticks(tick - before));
            prop_assert_eq!(times.remaining(), Steps(profile.steps().0 - k));
            prop_assert!(times.interval() >= profile.min_interval());
            prop_assert!(times.interval() <= MAX_INTERVAL);
            first.get_or_insert(tick);
            before = tick;
        }
        prop_assert_eq!(k, profile.steps().0);
        prop_assert_eq!(before, profile.duration().0);
        prop_assert_eq!(first, Some(profile.first_interval().0));
    }

    /// Steps that are taken together are those that would follow one by one, whatever is asked for. In cruise the
    /// next group is another one, unless more may not be taken for equal.
    #[test]
    fn steps_taken_together_are_those_that_would_follow(
        profile in profiles(5_000), all_limits in prop::collection::vec(batch_limits(), 1..20),
        brakes in prop::option::of((0_u32..=1_000, octaves(10, 26))), axis in axes(),
    ) {
        let (mut times, mut single) = (StepTimes::new(profile), StepTimes::new(profile));
        let mut brake = brakes.map(|(place, um_s2)| (profile.steps().0 * place / 1_000, um_s2));
        for (groups, limits) in all_limits.iter().cycle() {
            if let Some((place, um_s2)) = brake
                && times.emitted().0 >= place
            {
                brake = None;
                let deceleration = axis.acceleration(um_s2).unwrap();
                prop_assert_eq!(times.stop(deceleration), single.stop(deceleration));
            }
            // One by one; then as many at once as are asked for.
            prop_assert_eq!(times.next(), single.next());
            let (mut steps, mut ticks) = (0, 0);
            let mut given = vec![Equal::default(); *groups];
            let taken = times.batch(limits, &mut given);
            for Equal { interval, steps: equal } in given.into_iter().take(taken) {
                prop_assert!(ticks < limits.ticks);
                prop_assert!(equal == 1 || equal <= limits.equal && equal * interval <= limits.equal_ticks);
                prop_assert!(interval <= LONGEST_TAKEN);
                for _ in 0..equal {
                    prop_assert!(single.advance());
                    prop_assert_eq!(single.interval(), Ticks(interval.into()));
                }
                (steps, ticks) = (steps + equal, ticks + interval * equal);
            }
            prop_assert!(steps <= limits.steps);
            prop_assert_eq!(times.tick(), single.tick());
            prop_assert_eq!(times.interval(), single.interval());
            prop_assert_eq!(times.emitted(), single.emitted());
            prop_assert_eq!(times.remaining(), single.remaining());
            if times.remaining() == Steps(0) {
                break;
            }
        }
        prop_assert_eq!(times.next(), None);
        prop_assert_eq!(times.tick(), times.rest());
    }

    /// At constant speed, over every fraction of a tick that a step can take: add, compare, subtract yields the
    /// nearest tick of the exact line, computed in integers without bounds.
    #[test]
    fn a_cruise_is_the_exact_line(
        (n, fraction) in fractions(), whole in prop_oneof![100_u64..5_000, 5_000_u64..60_000], ramp in 1_u64..3_000,
        start in 0_u32..1_000, (groups, limits) in batch_limits(),
    ) {
        // A ramp of few steps, then cruise with `whole` + fraction / n ticks a step, from the phase that the ramp
        // leaves.
        let span = u64::from(n) * whole + u64::from(fraction);
        let Ok(profile) = StrokeProfile::from_parts(Steps(n), Ticks(span + ramp), Ticks(ramp)) else {
            return Err(TestCaseError::reject("no such profile"));
        };
        let mut times = StepTimes::new(profile);
        let cruise = profile.ramp_steps().0 + 1..n - profile.ramp_steps().0;
        let first = cruise.start + start % (cruise.end - cruise.start).max(1);
        times.by_ref().take(first as usize).for_each(drop);
        let mut k = times.emitted().0;
        let mut tick = times.tick().0;
        let last = n.min(k + 3_000);
        while k < last {
            let mut given = vec![Equal::default(); groups];
            let taken = times.batch(&limits, &mut given);
            if taken == 0 {
                let Some(next) = times.next() else { break };
                (tick, k) = (next, k + 1);
                prop_assert!(is_nearest(&profile, k, tick), "step {k} at {tick}");
            }
            for Equal { interval, steps } in given.into_iter().take(taken) {
                for _ in 0..steps {
                    (tick, k) = (tick + u64::from(interval), k + 1);
                    prop_assert!(is_nearest(&profile, k, tick), "{profile:?} step {k} at {tick}");
                }
            }
        }
    }

    /// Samples of long strokes on fine axes.
    #[test]
    fn long_strokes_stay_exact(profile in profiles(60_000), stride in 500_usize..1_500) {
        for (k, tick) in (1..).zip(StepTimes::new(profile)).step_by(stride) {
            prop_assert!(is_nearest(&profile, k, tick), "{profile:?} step {k} at {tick}");
        }
    }

    /// A stop takes the fewest steps that its deceleration allows, every edge at its nearest tick, or it
    /// leaves the stroke's own final ramp as it is.
    #[test]
    fn a_stop_brakes_in_the_fewest_steps(
        axis in axes(), profile in profiles(20_000), place in places(), deceleration in decelerations(),
    ) {
        let (n, at) = (profile.steps().0, place.step(&profile));
        let um_s2 = deceleration.um_s2(&profile, &axis);
        let mut times = StepTimes::new(profile);
        times.by_ref().take(at as usize).for_each(drop);
        let (interval, start) = (times.interval().0, times.tick().0);
        let planned = times.clone();
        let stop = times.stop(axis.acceleration(um_s2).unwrap());

        let steps = expected_steps(&axis, um_s2, interval).min(n - at);
        let on_the_final_ramp = at >= n - profile.ramp_steps().0 && at > profile.ramp_steps().0;
        prop_assert_eq!(times.remaining(), stop.steps);
        prop_assert_eq!(times.rest(), stop.rest);
        if at == n || on_the_final_ramp && steps == n - at {
            prop_assert_eq!(stop, Stop { steps: Steps(n - at), rest: profile.duration() });
            prop_assert!(times.eq(planned), "the final ramp is not the planned one");
        } else {
            let rest = start + 2 * u64::from(steps) * interval;
            prop_assert_eq!(stop, Stop { steps: Steps(steps), rest: Ticks(rest) });
            let mut before = start;
            for j in (0..steps).rev() {
                let tick = times.next().unwrap();
                prop_assert!(is_braking(steps, interval, j, rest - tick), "{j} before rest at {tick}");
                // No step comes faster than the speed at which the stop began.
                prop_assert!(tick - before >= interval);
                prop_assert_eq!(times.interval(), Ticks(tick - before));
                before = tick;
            }
            prop_assert_eq!(before, rest);
            prop_assert_eq!(times.next(), None);
        }
    }

    /// A second stop while braking never lengthens the way.
    #[test]
    fn stopping_again_never_goes_further(
        axis in axes(), profile in profiles(5_000), fraction in 1_u32..1_000,
        gentle in octaves(10, 20), harder in octaves(10, 26), between in 0_usize..200,
    ) {
        let mut times = StepTimes::new(profile);
        let at = (u64::from(profile.steps().0) * u64::from(fraction) / 1_000) as usize;
        times.by_ref().take(at).for_each(drop);
        times.stop(axis.acceleration(gentle).unwrap());
        times.by_ref().take(between).for_each(drop);
        let before = times.remaining();
        let stop = times.stop(axis.acceleration(harder).unwrap());
        prop_assert!(stop.steps <= before);
        prop_assert_eq!(times.count(), stop.steps.0 as usize);
    }

    /// The rest of a stroke neither exceeds its speed nor its acceleration, and one tick less would.
    #[test]
    fn a_resumed_stroke_is_the_shortest_within_its_limits(profile in profiles(20_000), fraction in 0_u32..=1_000) {
        let remaining = (profile.steps().0 * fraction / 1_000).max(1);
        let rest = profile.resumed(Steps(remaining)).unwrap();
        prop_assert_eq!(rest.steps(), Steps(remaining));
        let (n, t, r) = integers(&profile);
        let (m, u, q) = integers(&rest);
        let slow_enough = |u: &BigInt, q: &BigInt| &m * (&t - &r) <= &n * (u - q);
        let gentle_enough = |u: &BigInt, q: &BigInt| &m * &r * (&t - &r) <= &n * q * (u - q);
        prop_assert!(slow_enough(&u, &q) && gentle_enough(&u, &q));
        // One tick less, with the gentlest ramp that still keeps the speed.
        let shorter: BigInt = &u - 1;
        let span: BigInt = (&m * (&t - &r) + &n - 1) / &n;
        let ramp = BigInt::min(&shorter / 2, &shorter - span);
        prop_assert!(ramp < BigInt::from(1) || !gentle_enough(&shorter, &ramp));
        if remaining == profile.steps().0 {
            prop_assert!(rest.duration() <= profile.duration());
        }
    }

    #[test]
    fn peak_and_acceleration_are_the_nearest_integers(axis in axes(), profile in profiles(60_000)) {
        let (n, t, r) = integers(&profile);
        let nearest = |found: u32, numerator: BigInt, denominator: BigInt| {
            let (numerator, denominator) = (numerator * axis.lead().0, denominator * axis.steps_per_rev());
            let error: BigInt = 2 * (BigInt::from(found) * &denominator - &numerator);
            let half = -&denominator < error && error <= denominator;
            let too_much = numerator >= denominator * u32::MAX;
            if found == u32::MAX { half || too_much } else { half }
        };
        let peak: BigInt = &n * TICK_HZ;
        prop_assert!(nearest(profile.peak_um_s(&axis), peak.clone(), &t - &r));
        prop_assert!(nearest(profile.accel_um_s2(&axis), peak * TICK_HZ, &r * (&t - &r)));
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
                prop_assert!(minimal_duration > wanted);
                prop_assert!(minimal_accel_um_s2 > u64::from(um_s2));
                let at_least = StrokeProfile::from_duration(Steps(n), minimal_duration, acceleration);
                let infeasible = matches!(at_least, Err(StrokeError::Infeasible { .. }));
                prop_assert!(!infeasible, "{at_least:?}");
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

    /// Within both limits; one tick less would exceed one of them.
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

/// The step generator takes its steps in batches, because one by one they cost it too much: only the first steps from
/// rest, the last ones and the first of a phase come singly.
#[test]
fn nearly_all_steps_of_a_fast_stroke_are_taken_together() {
    // 50 mm/s on the reference axis after 500 ms of ramp: from step 33 on less than 640 us apart.
    let profile = parts(104_000, 310_000_000, 50_000_000).unwrap();
    let limits = BatchLimits {
        steps: u32::MAX,
        ticks: 1_000_000,
        equal: u32::MAX,
        equal_ticks: 1_000_000,
    };
    let mut times = StepTimes::new(profile);
    let (mut groups, mut singly) = ([Equal::default(); 64], 0);
    while times.remaining() > Steps(0) {
        if times.batch(&limits, &mut groups) == 0 {
            singly += u32::from(times.next().is_some());
        }
    }
    assert!(singly < 100, "{singly} of 104,000 steps one by one");
}

/// At constant speed the steps between two that differ by a tick are one group, so a thousand steps cost as much as two
/// groups.
#[test]
fn steps_alike_are_one_group() {
    let limits = BatchLimits {
        steps: u32::MAX,
        ticks: u32::MAX,
        equal: u32::MAX,
        equal_ticks: u32::MAX,
    };
    // Of a thousand steps one is a tick longer, or all but one.
    for fraction in [1, 999] {
        let span = 500 * 100_000 + 100 * fraction;
        let mut times = StepTimes::new(parts(100_000, span + 1_000, 1_000).unwrap());
        times.by_ref().take(100).for_each(drop);
        let (before, mut groups) = (times.emitted().0, [Equal::default(); 100]);
        assert_eq!(times.batch(&limits, &mut groups), 100);
        let steps = times.emitted().0 - before;
        assert!(steps > 49_000, "{steps} in 100 groups of {fraction}");
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

/// The paper's stroke in 4 s as a triangle: 2 s up and 2 s down at 32.5 mm/s^2 exactly.
#[test]
fn the_least_acceleration_for_a_duration_is_a_triangle() {
    let axis = Axis::REFERENCE;
    let stroke = |um_s2| {
        let acceleration = axis.acceleration(um_s2).unwrap();
        StrokeProfile::from_duration(Steps(104_000), Ticks(4 * TICK_HZ), acceleration)
    };
    let triangle = stroke(32_500).unwrap();
    assert_eq!(triangle.ramp(), Ticks(2 * TICK_HZ));
    assert_eq!(triangle.span(), Ticks(2 * TICK_HZ));
    assert_eq!(triangle.ramp_steps(), Steps(52_000));
    assert_eq!(triangle.accel_um_s2(&axis), 32_500);
    assert_eq!(
        stroke(32_499),
        Err(StrokeError::Infeasible {
            minimal_duration: Ticks(400_006_154),
            minimal_accel_um_s2: 32_500
        })
    );
}

/// A stop from an interval of 2^16 ticks: 2^14 steps would last 2^31 ticks, one too many.
#[test]
fn the_longest_stop_is_less_than_21_5_seconds() {
    let steps = 40_000;
    let profile = StrokeProfile::from_parts(
        Steps(steps),
        Ticks(u64::from(steps) * 65_536 + 65_536),
        Ticks(65_536),
    )
    .unwrap();
    let mut times = StepTimes::new(profile);
    times.by_ref().take(1_000).for_each(drop);
    assert_eq!(times.interval(), Ticks(65_536));
    let start = times.tick().0;
    let stop = times.stop(Axis::REFERENCE.acceleration(1).unwrap());
    assert_eq!(stop.steps, Steps((1 << 14) - 1));
    assert_eq!(stop.rest, Ticks(start + (1 << 31) - (1 << 17)));
    assert_eq!(times.last(), Some(stop.rest.0));
}

fn parts(n: u32, t: u64, r: u64) -> Result<StrokeProfile, StrokeError> {
    StrokeProfile::from_parts(Steps(n), Ticks(t), Ticks(r))
}

/// Each bound: what is just within, just beyond, and what the refusal names.
#[test]
fn the_bounds_refuse_what_they_say() {
    let too_slow = |t: u64| Err(StrokeError::TooSlow { duration: Ticks(t) });
    let bad_ramp = |t: u64, r: u64| {
        Err(StrokeError::Ramp {
            duration: Ticks(t),
            ramp: Ticks(r),
        })
    };
    assert_eq!(parts(0, 100, 10), Err(StrokeError::NoSteps));
    let most = 1 << 25;
    assert!(parts(most, u64::from(most) * 128, 1_000).is_ok());
    assert_eq!(
        parts(most + 1, 1 << 40, 10),
        Err(StrokeError::TooManySteps { steps: most + 1 })
    );
    assert_eq!(parts(10, 10_000, 0), bad_ramp(10_000, 0));
    assert_eq!(parts(10, 10_001, 5_001), bad_ramp(10_001, 5_001));
    assert!(parts(10, 10_001, 5_000).is_ok());
    // 1 MHz is allowed, and no more.
    assert!(parts(1_000, 100_500, 500).is_ok());
    assert_eq!(
        parts(1_000, 100_499, 500),
        Err(StrokeError::TooFast {
            interval: Ticks(99)
        })
    );
    // 2 r (T - r) of 2^62: a triangle of 2^31.5 ticks.
    assert!(parts(100_000, 3_037_000_498, 1_518_500_249).is_ok());
    assert_eq!(
        parts(100_000, 3_037_000_500, 1_518_500_250),
        too_slow(3_037_000_500)
    );
    // 2 n T of 2^60.
    assert!(parts(most, (1 << 34) - 1, 100_000_000).is_ok());
    assert_eq!(parts(most, 1 << 34, 100_000_000), too_slow(1 << 34));
    // A single step of 2^30 ticks.
    assert!(parts(1, (1 << 30) - 1, 1_000).is_ok());
    assert_eq!(parts(1, 1 << 30, 1_000), too_slow(1 << 30));
    assert_eq!(
        parts(u32::MAX >> 7, u64::MAX, u64::MAX / 2),
        too_slow(u64::MAX)
    );
}

#[test]
fn constructors_refuse_moves_that_are_none_or_too_long() {
    let axis = Axis::REFERENCE;
    let (speed, acceleration) = (
        axis.speed(1_000).unwrap(),
        axis.acceleration(100_000).unwrap(),
    );
    let profile = StrokeProfile::from_speed(Steps(1_000), speed, acceleration).unwrap();
    for (steps, refusal) in [
        (0, StrokeError::NoSteps),
        (
            (1 << 25) + 1,
            StrokeError::TooManySteps {
                steps: (1 << 25) + 1,
            },
        ),
    ] {
        let steps = Steps(steps);
        let hour = Ticks(3_600 * TICK_HZ);
        assert_eq!(
            StrokeProfile::from_duration(steps, hour, acceleration),
            Err(refusal)
        );
        assert_eq!(
            StrokeProfile::from_speed(steps, speed, acceleration),
            Err(refusal)
        );
        assert_eq!(profile.resumed(steps), Err(refusal));
    }
    // Two steps, both as slow as a step may be. One alone, from rest to rest, would be slower.
    let slowest = parts(2, (1 << 31) - 2, (1 << 30) - 1).unwrap();
    assert!(slowest.resumed(Steps(2)).is_ok());
    assert!(matches!(
        slowest.resumed(Steps(1)),
        Err(StrokeError::TooSlow { .. })
    ));
}

#[test]
fn a_refused_stroke_says_what_to_do() {
    let acceleration = Axis::REFERENCE.acceleration(32_499).unwrap();
    let refused = [
        parts(0, 100, 10),
        parts(33_554_433, 1 << 40, 10),
        parts(10, 100_000_000, 60_000_000),
        parts(1_000, 100_499, 500),
        parts(100_000, 3_037_000_500, 1_518_500_250),
        StrokeProfile::from_duration(Steps(104_000), Ticks(4 * TICK_HZ), acceleration),
    ];
    let texts = refused.map(|refused| refused.unwrap_err().to_string());
    insta::assert_snapshot!("refused_strokes", texts.join("\n"));
}

/// Profiles close to each bound, where sums are largest.
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

/// At 1.25 mm/s one step of 1.25 um is the braking distance of 625 mm/s^2.
#[test]
fn a_deceleration_rests_within_a_step_up_to_exactly_one() {
    let span = 100 * 100_000;
    let profile =
        StrokeProfile::from_parts(Steps(100), Ticks(span + span / 10), Ticks(span / 10)).unwrap();
    let mut times = StepTimes::new(profile);
    times.nth(50);
    assert_eq!(times.interval(), Ticks(100_000));
    for (um_s2, rests) in [
        (1, false),
        (624_999, false),
        (625_000, true),
        (9_000_000, true),
    ] {
        let deceleration = Axis::REFERENCE.acceleration(um_s2).unwrap();
        assert_eq!(times.rests_within_a_step(deceleration), rests, "{um_s2}");
    }
}
