//! Signed step positions and windows, up to the ends of `i32`.

use motion::axis::{Axis, Direction, MAX_STROKE_STEPS};
use motion::units::{StepPosition, Steps, Window};
use proptest::prelude::*;

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
    assert_eq!(StepPosition(-3).to_string(), "step -3");
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
    assert_eq!(MAX_STROKE_STEPS, Steps(26_624_000));
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
