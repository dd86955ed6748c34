//! The axis and its units: what it accepts, lengths in steps, positions and windows up to the ends of `i32`.

use motion::axis::{Axis, Direction, Position};
use motion::units::{Micrometres, StepPosition, Steps, Ticks, Window};
use proptest::prelude::*;

/// Every kind of axis, coarse and fine, long and short.
fn axes() -> impl Strategy<Value = Axis> {
    let lead = prop_oneof![500_u32..=50_000, Just(500), Just(50_000)];
    let stroke = prop_oneof![250_u32..=130_000, Just(130_000)];
    (lead, any::<bool>(), 0_u32..=8, stroke).prop_map(|(lead, fine, power, stroke)| {
        Axis::new(lead, if fine { 400 } else { 200 }, 1 << power, stroke).unwrap()
    })
}

#[test]
fn an_axis_is_what_was_asked_for() {
    let axis = Axis::new(5_000, 400, 32, 99_000).unwrap();
    assert_eq!(axis.lead(), Micrometres(5_000));
    assert_eq!(axis.microsteps(), 32);
    assert_eq!(axis.stroke(), Micrometres(99_000));
    assert_eq!(axis.steps_per_rev(), 12_800);
    assert_eq!(axis.stroke_steps(), Steps(253_440));
    // Twice the lead and twice the steps: the same speeds.
    let alike = Axis::new(10_000, 400, 64, 130_000).unwrap();
    assert_eq!(axis.speed(17), alike.speed(17));
    assert_eq!(axis.acceleration(19), alike.acceleration(19));
}

#[test]
fn the_reference_axis_has_800_steps_per_mm() {
    let axis = Axis::REFERENCE;
    assert_eq!(axis.steps_per_rev(), 3_200);
    assert_eq!(axis.stroke_steps(), Steps(104_000));
    assert_eq!(axis.steps_within(Micrometres(2)), Some(Steps(1)));
}

#[test]
fn an_axis_outside_its_bounds_is_refused_by_name() {
    for (lead, full, micro, stroke) in [
        (500, 200, 1, 130_000),
        (50_000, 400, 256, 1),
        (50_000, 200, 1, 250),
    ] {
        assert!(Axis::new(lead, full, micro, stroke).is_ok());
    }
    let refused = [
        (499, 200, 16, 1_000),
        (50_001, 200, 16, 1_000),
        (4_000, 300, 16, 1_000),
        (4_000, 200, 12, 1_000),
        (4_000, 200, 512, 1_000),
        (4_000, 200, 0, 1_000),
        (4_000, 200, 16, 0),
        (4_000, 200, 16, 130_001),
        (50_000, 200, 1, 249),
    ];
    let errors = refused
        .map(|(lead, full, micro, stroke)| Axis::new(lead, full, micro, stroke).unwrap_err())
        .into_iter()
        .chain([
            Axis::REFERENCE.speed(0).unwrap_err(),
            Axis::REFERENCE.acceleration(0).unwrap_err(),
        ]);
    let texts: Vec<_> = errors.map(|error| error.to_string()).collect();
    insta::assert_snapshot!("refused_axes", texts.join("\n"));
}

#[test]
fn steps_that_do_not_fit_32_bits_are_none() {
    let one_per_um = Axis::new(800, 200, 4, 1_000).unwrap();
    assert_eq!(
        one_per_um.steps_within(Micrometres(u32::MAX)),
        Some(Steps(u32::MAX))
    );
    // 1,024 steps in 5 um: 2^32 steps are 20,971,520 um.
    let fine = Axis::new(500, 400, 256, 130_000).unwrap();
    assert_eq!(
        fine.steps_within(Micrometres(20_971_519)),
        Some(Steps(4_294_967_091))
    );
    assert_eq!(fine.steps_within(Micrometres(20_971_520)), None);
    assert_eq!(fine.position_um(Micrometres(u32::MAX)), None);
}

#[test]
fn units_read_as_an_operator_does() {
    assert_eq!(Steps(7).to_string(), "7 steps");
    assert_eq!(StepPosition(-3).to_string(), "step -3");
    assert_eq!(Micrometres(12_034).to_string(), "12.034 mm");
    assert_eq!(Ticks(1_203_456_789).to_string(), "12.03456789 s");
}

#[test]
fn microseconds_are_rounded_as_they_say() {
    assert_eq!(Ticks::from_us(3), Some(Ticks(300)));
    assert_eq!(
        Ticks::from_us(u64::MAX / 100),
        Some(Ticks(u64::MAX / 100 * 100))
    );
    assert_eq!(Ticks::from_us(u64::MAX / 100 + 1), None);
    for (ticks, us) in [(0, 0), (1, 1), (100, 1), (101, 2), (300, 3)] {
        assert_eq!(Ticks(ticks).to_us_ceil(), us);
    }
}

proptest! {
    /// As many steps as fit, and the length of them to the nearest micrometre.
    #[test]
    fn steps_and_lengths_follow_from_the_lead(axis in axes(), um in any::<u32>(), shift in 0_u32..32, steps in 0..=i32::MAX) {
        let (per_rev, lead) = (u128::from(axis.steps_per_rev()), u128::from(axis.lead().0));
        let (um, steps) = (um >> shift, steps >> shift);
        match axis.steps_within(Micrometres(um)) {
            Some(fit) => {
                prop_assert!(u128::from(fit.0) * lead <= u128::from(um) * per_rev);
                prop_assert!((u128::from(fit.0) + 1) * lead > u128::from(um) * per_rev);
            }
            None => prop_assert!(u128::from(um) * per_rev >= lead << 32),
        }
        // Beyond 2^31 um it wraps. From the nearest nanometre, half up, to the nearest micrometre, half up.
        let exact = u128::from(steps.unsigned_abs()) * lead;
        if exact < per_rev << 31 {
            let twice_nm = 2_000 * u128::try_from(axis.um_from_home(StepPosition(steps))).unwrap();
            prop_assert!((twice_nm + 1_001) * per_rev > 2_000 * exact);
            prop_assert!(twice_nm * per_rev <= 2_000 * exact + 1_001 * per_rev);
        }
    }

    #[test]
    fn a_position_is_never_outside_the_stroke(
        axis in axes(), fraction in 0_u64..=2_000, beside in -2..=2_i32,
    ) {
        let (last, stroke) = (axis.stroke_steps(), axis.stroke());
        prop_assert_eq!(Some(last), axis.steps_within(stroke));
        prop_assert_eq!(Some(axis.far()), axis.position(last));

        // From home to twice the stroke, and close to its end.
        let part = |whole: u32| (u64::from(whole) * fraction / 1_000) as u32;
        for steps in [part(last.0), last.0.saturating_add_signed(beside)].map(Steps) {
            let expected = (steps <= last).then_some(steps);
            prop_assert_eq!(axis.position(steps).map(Position::steps), expected);
        }
        for um in [part(stroke.0), stroke.0.saturating_add_signed(beside)].map(Micrometres) {
            let expected = axis.steps_within(um).filter(|_| um <= stroke);
            prop_assert_eq!(axis.position_um(um).map(Position::steps), expected);
        }
    }
}

/// The middle and both ends of `i32` as likely as all the rest.
fn positions() -> impl Strategy<Value = StepPosition> {
    prop_oneof![
        any::<i32>(),
        -3..=3_i32,
        i32::MIN..=i32::MIN + 3,
        i32::MAX - 3..=i32::MAX,
    ]
    .prop_map(StepPosition)
}

/// A position close to another one, where it fits.
fn beside(position: StepPosition, by: i32) -> StepPosition {
    StepPosition(position.0.saturating_add(by))
}

fn directions() -> impl Strategy<Value = Direction> {
    prop_oneof![Just(Direction::Away), Just(Direction::Home)]
}

fn wide(position: StepPosition) -> i64 {
    i64::from(position.0)
}

#[test]
fn home_is_zero_and_away_is_positive() {
    assert_eq!(StepPosition::HOME, StepPosition(0));
    assert_eq!(StepPosition::default(), StepPosition::HOME);
    assert_eq!(Direction::Away.sign(), 1);
    assert_eq!(Direction::Home.sign(), -1);
}

#[test]
fn the_ends_of_the_counter_are_the_ends() {
    let (lowest, highest) = (StepPosition(i32::MIN), StepPosition(i32::MAX));
    assert_eq!(highest.moved(Direction::Away, Steps(1)), None);
    assert_eq!(lowest.moved(Direction::Home, Steps(1)), None);
    assert_eq!(
        lowest.moved(Direction::Away, Steps(u32::MAX)),
        Some(highest)
    );
    assert_eq!(
        highest.moved(Direction::Home, Steps(u32::MAX)),
        Some(lowest)
    );
    assert_eq!(highest.moved(Direction::Away, Steps(0)), Some(highest));
    assert_eq!(lowest.distance_to(highest), Steps(u32::MAX));
    assert_eq!(lowest.since(highest), 1);
    assert_eq!(highest.since(lowest), -1);
    let all = Window::between(highest, lowest);
    assert_eq!(all.room(lowest, Direction::Away), Steps(u32::MAX));
    assert_eq!(all.room(highest, Direction::Home), Steps(u32::MAX));
    assert_eq!(all.room(highest, Direction::Away), Steps(0));
    assert_eq!(all.room(lowest, Direction::Home), Steps(0));
}

#[test]
fn the_stroke_is_a_window() {
    for (axis, last) in [
        (Axis::REFERENCE, 104_000),
        (Axis::new(50_000, 200, 1, 250).unwrap(), 1),
        (Axis::new(500, 400, 256, 130_000).unwrap(), 26_624_000),
    ] {
        let window = axis.stroke_window();
        assert_eq!(window.first, StepPosition::HOME);
        assert_eq!(window.last, StepPosition(last));
        assert_eq!(StepPosition::from(axis.home()), window.first);
        assert_eq!(StepPosition::from(axis.far()), window.last);
        assert_eq!(axis.far().signed(), window.last);
    }
}

#[test]
fn a_reversed_window_is_empty() {
    let reversed = Window {
        first: StepPosition(2),
        last: StepPosition(-2),
    };
    for position in (-3..=3).map(StepPosition) {
        assert!(!reversed.contains(position));
        assert_eq!(reversed.room(position, Direction::Away), Steps(0));
        assert_eq!(reversed.room(position, Direction::Home), Steps(0));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]

    #[test]
    fn a_distance_is_the_difference_without_its_sign(a in positions(), b in positions(), by in -3..=3_i32) {
        for b in [b, beside(a, by)] {
            let difference = wide(a) - wide(b);
            prop_assert_eq!(i64::from(a.distance_to(b).0), difference.abs());
            let folded = (difference - i64::from(i32::MIN)).rem_euclid(1 << 32) + i64::from(i32::MIN);
            prop_assert_eq!(i64::from(a.since(b)), folded);
            let way = b.way_to(a);
            let sign = way.map_or(0, |(direction, _)| direction.sign());
            prop_assert_eq!(i64::from(sign), difference.signum());
            prop_assert_eq!(way.map_or(b, |(direction, steps)| b.moved(direction, steps).unwrap()), a);
        }
    }

    #[test]
    fn a_move_is_exact_or_does_not_fit(
        from in positions(), direction in directions(), by in prop_oneof![any::<u32>(), 0..4_u32],
    ) {
        let to = wide(from) + i64::from(direction.sign()) * i64::from(by);
        let moved = from.moved(direction, Steps(by));
        prop_assert_eq!(moved.map(wide), i32::try_from(to).ok().map(i64::from));
    }

    /// The room is where the window ends: the last of its steps is inside, the next one is not.
    #[test]
    fn room_ends_at_the_edge(
        a in positions(), b in positions(), position in positions(), by in -3..=3_i32, direction in directions(),
    ) {
        let window = Window::between(a, b);
        prop_assert_eq!(window, Window::between(b, a));
        prop_assert_eq!((window.first, window.last), (a.min(b), a.max(b)));
        for position in [position, beside(a, by), beside(b, by)] {
            let inside = (window.first..=window.last).contains(&position);
            prop_assert_eq!(window.contains(position), inside);
            let room = window.room(position, direction);
            if inside {
                let edge = position.moved(direction, room).unwrap();
                prop_assert!(window.contains(edge));
                prop_assert!(edge.moved(direction, Steps(1)).is_none_or(|beyond| !window.contains(beyond)));
            } else {
                prop_assert_eq!(room, Steps(0));
            }
        }
    }
}

#[test]
fn a_position_in_um_is_to_the_nearest_on_both_sides_of_home() {
    // 1.25 um per step.
    let axis = Axis::REFERENCE;
    for (steps, um) in [
        (0, 0),
        (1, 1),
        (2, 3),
        (3, 4),
        (800, 1_000),
        (104_000, 130_000),
        (-1, -1),
        (-2, -3),
        (-3, -4),
        (-800, -1_000),
    ] {
        assert_eq!(axis.um_from_home(StepPosition(steps)), um, "{steps}");
    }
}

#[test]
fn a_mean_speed_has_the_sign_of_its_steps() {
    let axis = Axis::REFERENCE;
    // 28,500 steps in a second are 35.625 mm; 285 in 10 ms as many.
    for (steps, time_us, um_s) in [
        (28_500, 1_000_000, 35_625),
        (285, 10_000, 35_625),
        (-285, 10_000, -35_625),
        (0, 10_000, 0),
        (1, 3, 416_666),
        (-1, 3, -416_666),
        (8, 0, 10_000_000),
        (i32::MAX, 1, i32::MAX),
        (i32::MIN, 1, -i32::MAX),
    ] {
        let speed = axis.mean_speed_um_s(steps, time_us);
        assert_eq!(speed, um_s, "{steps} in {time_us} us");
    }
}

/// A mean speed over 1 us shows the length in nanometres: 5/1,024 um a step here.
#[test]
fn a_length_is_rounded_to_the_nearest_nanometre() {
    let axis = Axis::new(500, 400, 256, 130_000).unwrap();
    for (steps, nm) in [(1, 5), (2, 10), (3, 15), (8, 39), (21, 103), (64, 313)] {
        assert_eq!(axis.mean_speed_um_s(steps, 1), nm * 1_000, "{steps}");
    }
}
