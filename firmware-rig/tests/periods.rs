//! Timer periods against the step times from which they are made.

use crate::runs::{any_deceleration, any_run, first_stroke, strokes};
use firmware_rig::{
    periods::{Item, MAX_PERIOD, Path, Period, Periods},
    settings::Settings,
};
use motion::{
    axis::{Axis, Direction},
    run::{Limits, RunPlan, RunRequest, Timing},
    step_times::{Equal, StepTimes},
    trapezoid::StrokeProfile,
    units::{StepPosition, Steps, Ticks, Window},
};
use proptest::prelude::*;

const LIMITS: Limits = Settings::REFERENCE.limits;

/// Time for DIR to change between two strokes and for the ring to be filled again: 300 us.
const TURN_TICKS: u64 = 30_000;
/// Period of the last pulse of a stroke.
const LAST_PULSE: u64 = 1_000;

/// Repeated rounds cannot be recalled: 0.8 ms of them at most.
const LONGEST_REPETITION: u64 = 80_000;

const EVERYWHERE: Window = window(i32::MIN, i32::MAX);

const fn window(first: i32, last: i32) -> Window {
    Window {
        first: StepPosition(first),
        last: StepPosition(last),
    }
}

/// Walks a list and checks what holds for every list: lengths, cursor, position, sync.
struct Walk {
    periods: Periods,
    /// Ticks before what comes next.
    tick: u64,
    position: i32,
    window: Window,
    /// Pulses of the stroke in progress.
    pulses: u32,
    last_pulse: u64,
    /// Length of the last period without a pulse.
    last_blank: u32,
}

impl Walk {
    fn new(path: &Path, position: i32, window: Window) -> Self {
        Self {
            periods: Periods::new(path.clone(), StepPosition(position), window).unwrap(),
            tick: 0,
            position,
            window,
            pulses: 0,
            last_pulse: 0,
            last_blank: 0,
        }
    }

    fn next(&mut self) -> Item {
        let direction = self.periods.direction();
        let mut one = [Equal::default()];
        let item = match self.periods.steps(&mut one, 1) {
            0 => self.periods.next_item(),
            _ => Item::Period(one[0].into()),
        };
        match item {
            Item::Period(period) => {
                let Period {
                    ticks,
                    repeats,
                    pulse,
                    sync,
                } = period;
                assert!((2..=MAX_PERIOD).contains(&ticks), "{item:?}");
                assert_eq!(sync, pulse && self.pulses == 0, "{item:?}");
                assert!(repeats == 0 || pulse && !sync, "{item:?}");
                assert!(
                    u64::from(ticks) * (u64::from(repeats) + 1) <= LONGEST_REPETITION,
                    "{item:?}"
                );
                let further = u64::from(ticks) * u64::from(repeats);
                if !pulse {
                    self.last_blank = ticks;
                }
                if pulse {
                    self.position += direction.sign() * (1 + i32::from(repeats));
                    assert!(self.window.contains(StepPosition(self.position)));
                    self.pulses += 1 + u32::from(repeats);
                    self.last_pulse = self.tick + further;
                }
                self.tick += u64::from(ticks) + further;
                assert_eq!(self.periods.cursor(), self.tick);
            }
            Item::StrokeEnd { .. } => assert_eq!(self.tick - self.last_pulse, LAST_PULSE),
            Item::Turn { .. } => self.pulses = 0,
            Item::End => assert_eq!(self.periods.last_step(), self.last_pulse),
            Item::Guard => {}
        }
        assert_eq!(self.periods.position(), StepPosition(self.position));
        item
    }

    /// Advances to the next pulses: returns their ticks and their period.
    fn pulses(&mut self) -> (Vec<u64>, Period) {
        loop {
            let tick = self.tick;
            match self.next() {
                Item::Period(period) if period.pulse => {
                    let round = |index| tick + u64::from(index) * u64::from(period.ticks);
                    return ((0..=period.repeats).map(round).collect(), period);
                }
                Item::Period(_) => {}
                other => panic!("{other:?} instead of a pulse at {tick}"),
            }
        }
    }

    /// Advances past blank periods: returns the blanks, their ticks and the next item.
    fn blanks(&mut self) -> (usize, u64, Item) {
        let (before, mut count) = (self.tick, 0);
        loop {
            match self.next() {
                Item::Period(Period { pulse: false, .. }) => count += 1,
                other => return (count, self.tick - before, other),
            }
        }
    }
}

/// The whole list: every pulse at its absolute tick, every turn with time around it. Returns the pulses.
fn check_whole(path: &Path, shortest: u32) -> u64 {
    let strokes = strokes(path);
    let mut walk = Walk::new(path, 0, EVERYWHERE);
    let mut pulses = 0;
    for (index, (start, profile, direction)) in strokes.iter().enumerate() {
        assert_eq!(walk.periods.direction(), *direction);
        let number = first_stroke(path) + index;
        assert_eq!(walk.periods.stroke() as usize, number);
        let mut steps = StepTimes::new(*profile);
        while steps.remaining().0 > 0 {
            let (ticks, period) = walk.pulses();
            for tick in ticks {
                assert_eq!(Some(tick), steps.next().map(|step| start + step));
                pulses += 1;
            }
            assert!(period.ticks >= shortest, "{period:?}");
        }
        // The last pulse of a stroke has a period of its own: pulse and hold time of DIR.
        assert_eq!(walk.tick - walk.last_pulse, LAST_PULSE);
        if index + 1 < strokes.len() {
            let stroke = number as u32;
            assert_eq!(walk.next(), Item::StrokeEnd { stroke });
        }
        let (blanks, ticks, then) = walk.blanks();
        let last_blank = walk.last_blank;
        if let Some((start, profile, next)) = strokes.get(index + 1) {
            assert_eq!(then, Item::Turn { next: *next });
            assert!(blanks >= 2 && ticks >= TURN_TICKS, "{blanks}, {ticks}");
            // The turn comes while blanks play: the last one is short, so that it is not kept waiting.
            assert!((1_024..=2_048).contains(&last_blank), "{last_blank}");
            // No blank follows: the turn comes before the period that begins with the pulse.
            assert_eq!(walk.tick, start + profile.first_interval().0);
        } else {
            assert_eq!((blanks, then), (1, Item::End));
            assert_eq!(walk.next(), Item::End);
        }
    }
    let (start, profile, _) = strokes.last().unwrap();
    assert_eq!(walk.periods.last_step(), start + profile.duration().0);
    pulses
}

/// The rest of a run: a stroke from any step on, and all strokes after it.
fn any_rest() -> impl Strategy<Value = Path> {
    let part = (any::<prop::sample::Index>(), any::<prop::sample::Index>());
    (any_run(LIMITS, 600), part).prop_filter_map("not too slow", |(plan, (stroke, remaining))| {
        let stroke = stroke.index(plan.strokes() as usize) as u32;
        let profile = plan.stroke(stroke)?;
        let remaining = Steps(1 + remaining.index(profile.steps().0 as usize) as u32);
        let first = if remaining == profile.steps() {
            *profile
        } else {
            profile.resumed(remaining).ok()?
        };
        Some(Path::Rest {
            plan,
            stroke,
            first,
        })
    })
}

fn any_path() -> impl Strategy<Value = Path> {
    prop_oneof![
        3 => any_run(LIMITS, 600).prop_map(Path::Run),
        2 => any_rest(),
        1 => (any_run(LIMITS, 600), any::<bool>()).prop_map(|(plan, away)| Path::Move {
            profile: *plan.forward(),
            direction: if away { Direction::Away } else { Direction::Home },
        }),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(384))]

    #[test]
    fn every_pulse_has_the_tick_of_its_step(path in any_path()) {
        let steps: u64 = strokes(&path).iter().map(|(_, p, _)| u64::from(p.steps().0)).sum();
        prop_assert_eq!(check_whole(&path, LIMITS.min_interval_ticks), steps);
    }

    #[test]
    fn a_stop_decelerates_inside_the_stroke_and_ends(
        path in any_path(),
        at in 0.0..1.0_f64,
        deceleration in any_deceleration(),
        again in any::<bool>(),
    ) {
        let strokes = strokes(&path);
        let items = {
            let mut walk = Walk::new(&path, 0, EVERYWHERE);
            (0..).find(|_| walk.next() == Item::End).unwrap()
        };
        let mut walk = Walk::new(&path, 0, EVERYWHERE);
        for _ in 0..(at * f64::from(items)) as u32 {
            walk.next();
        }
        // A stop before the first pulse of a stroke, or before a slow one, lets no pulse follow; within it, at most the
        // stroke's rest.
        let remaining = if walk.pulses == 0 {
            0
        } else {
            let during = |(start, profile, _): &&(u64, StrokeProfile, Direction)| {
                (start + 1..=start + profile.duration().0).contains(&walk.last_pulse)
            };
            let profile = strokes.iter().find(during).unwrap().1;
            let mut announced = StepTimes::new(profile);
            announced.nth(walk.pulses as usize);
            let is_slow = announced.interval() > Ticks(10_000_000);
            if is_slow && announced.rests_within_a_step(deceleration) {
                0
            } else {
                profile.steps().0 - walk.pulses
            }
        };
        let end = walk.periods.cursor();
        walk.periods.stop(deceleration);
        prop_assert_eq!(walk.periods.cursor(), end);

        let (mut before, mut interval, mut emitted) = (walk.last_pulse, 0, 0);
        loop {
            let tick = walk.tick;
            match walk.next() {
                Item::Period(Period { pulse: true, ticks, repeats, .. }) => {
                    emitted += 1;
                    prop_assert_eq!(repeats, 0, "a ramp has no equal intervals");
                    // The first one was announced before the stop; all later ones are slower.
                    if emitted > 1 {
                        prop_assert!(tick - before + 1 >= interval, "{} {}", tick - before, interval);
                    }
                    (interval, before) = (tick - before, tick);
                    prop_assert!(ticks >= LIMITS.min_interval_ticks);
                    if again {
                        walk.periods.stop(deceleration);
                    }
                }
                Item::Period(_) => {}
                Item::End => break,
                // The stop came between the last pulse of a stroke and the stroke's end.
                Item::StrokeEnd { .. } => prop_assert_eq!((emitted, remaining), (0, 0)),
                other => prop_assert!(false, "{:?} after a stop", other),
            }
        }
        prop_assert!(emitted <= remaining);
        prop_assert_eq!(emitted == 0, remaining == 0);
        prop_assert_eq!(walk.next(), Item::End);
    }

    #[test]
    fn no_step_leaves_the_window(
        path in any_path(),
        below in 0..700_i32,
        above in 0..700_i32,
        position in prop_oneof![Just(0), Just(i32::MIN), Just(i32::MAX)],
        deceleration in any_deceleration(),
    ) {
        let (first, last) = (position.saturating_sub(below), position.saturating_add(above));
        // The path's end without the window, and the pulse at which it leaves the window.
        let mut at = i64::from(position);
        let mut allowed = 0;
        let leaves = strokes(&path).iter().any(|(_, profile, direction)| {
            (0..profile.steps().0).any(|_| {
                at += i64::from(direction.sign());
                let outside = at < i64::from(first) || at > i64::from(last);
                allowed += u32::from(!outside);
                outside
            })
        });
        let mut walk = Walk::new(&path, position, window(first, last));
        let mut pulses = 0;
        let end = loop {
            match walk.next() {
                Item::Period(Period { pulse: true, repeats, .. }) => pulses += 1 + u32::from(repeats),
                Item::Period(_) => {}
                Item::StrokeEnd { .. } | Item::Turn { .. } => {}
                end => break end,
            }
        };
        prop_assert_eq!(pulses, allowed);
        prop_assert_eq!(end, if leaves { Item::Guard } else { Item::End });
        walk.periods.stop(deceleration);
        prop_assert_eq!(walk.next(), end);
    }
}

/// The path that the machine orders after a hold: the rest of the incomplete stroke.
fn rest_of(plan: &RunPlan, stroke: u32, position: i32) -> Option<Path> {
    let steps = plan.stroke(stroke)?.steps().0;
    let remaining = match plan.direction(stroke)? {
        Direction::Away => steps - position as u32,
        Direction::Home => position as u32,
    };
    if remaining == 0 {
        return rest_of(plan, stroke + 1, position);
    }
    let profile = plan.stroke(stroke)?;
    let first = if remaining == steps {
        *profile
    } else {
        profile.resumed(Steps(remaining)).unwrap()
    };
    Some(Path::Rest {
        plan: *plan,
        stroke,
        first,
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(384))]

    /// Held at random, any number of times: every position once per stroke in its order, ticks that grow, no
    /// interval under the limit, no speed above the planned one.
    #[test]
    fn a_run_in_pieces_has_the_edges_of_the_run(
        plan in any_run(LIMITS, 600),
        holds in prop::collection::vec(1..700_u32, 0..6),
        deceleration in any_deceleration(),
    ) {
        let last = plan.forward().steps().0 as i32;
        let mut path = Some(Path::Run(plan));
        let (mut position, mut stroke, mut positions) = (0, 0, Vec::new());
        let mut holds = holds.into_iter();
        while let Some(piece) = path.take() {
            let mut walk = Walk::new(&piece, position, window(0, last));
            stroke = first_stroke(&piece) as u32;
            let mut items = holds.next();
            let mut before = None;
            loop {
                if items == Some(0) {
                    walk.periods.stop(deceleration);
                }
                items = items.map(|items| items.saturating_sub(1));
                let tick = walk.tick;
                match walk.next() {
                    Item::Period(Period { pulse: true, ticks, repeats, .. }) => {
                        prop_assert!(ticks >= LIMITS.min_interval_ticks);
                        // The first and last interval of a stroke are the longest; in between the profile's peak.
                        if let Some(before) = before {
                            let interval = tick - before;
                            let peak = plan.stroke(stroke).unwrap().min_interval().0;
                            prop_assert!(interval + 1 >= peak, "{interval} {peak}");
                        }
                        before = Some(walk.last_pulse);
                        let back = plan.direction(stroke).unwrap().sign();
                        positions.extend((0..=i32::from(repeats)).rev().map(|more| walk.position - more * back));
                    }
                    Item::Period(_) => {}
                    Item::StrokeEnd { stroke: ended } => {
                        prop_assert_eq!(ended, stroke);
                        (stroke, before) = (ended + 1, None);
                    }
                    Item::Turn { .. } => {}
                    Item::End => break,
                    Item::Guard => prop_assert!(false, "outside at {}", walk.position),
                }
            }
            position = walk.position;
            path = rest_of(&plan, stroke, position);
        }
        prop_assert_eq!((position, stroke), (0, plan.strokes() - 1));
        let planned: Vec<i32> = (0..plan.strokes())
            .flat_map(|stroke| match plan.direction(stroke).unwrap() {
                Direction::Away => (1..=last).collect::<Vec<_>>(),
                Direction::Home => (0..last).rev().collect(),
            })
            .collect();
        prop_assert_eq!(positions, planned);
    }
}

/// The pieces of a pause of this length.
fn pieces(ticks: u64) -> Vec<u32> {
    let profile = StrokeProfile::from_parts(Steps(1), Ticks(ticks), Ticks(ticks / 2)).unwrap();
    let path = Path::Move {
        profile,
        direction: Direction::Away,
    };
    let mut walk = Walk::new(&path, 0, window(0, 1));
    let blanks = std::iter::from_fn(|| match walk.next() {
        Item::Period(period) if !period.pulse => Some(period.ticks),
        _ => None,
    });
    let pieces = blanks.collect();
    assert_eq!(walk.last_pulse, ticks);
    pieces
}

/// None is too short and none too long: the longest period, that plus the shortest piece, and one tick more or less.
#[test]
fn pieces_of_a_pause_are_long() {
    for ticks in (400..70_000).chain(98_000..99_000).chain(131_000..197_000) {
        let short = |piece: &u32| u64::from(*piece) < ticks.min(32_768);
        assert!(!pieces(ticks).iter().any(short), "{ticks}");
    }
    assert_eq!(pieces(65_536), [65_536]);
    assert_eq!(pieces(65_537), [32_768, 32_769]);
    assert_eq!(pieces(98_303), [49_151, 49_152]);
    assert_eq!(pieces(98_304), [65_536, 32_768]);
    assert_eq!(pieces(131_072), [65_536, 65_536]);
}

/// Before a turn a pause of one longest period is halved too, down to 2,048 ticks.
#[test]
fn pieces_before_a_turn_at_their_bounds() {
    let limits = Limits {
        min_turnaround_ticks: 40_000,
        ..LIMITS
    };
    let axis = Axis::new(4_000, 200, 256, 130_000).unwrap();
    let mut found = std::collections::BTreeSet::new();
    // Choose accelerations whose first step time makes the pause a whole number of microseconds.
    for accel_um_s2 in (400_000..2_000_000).step_by(997) {
        let request = |far_dwell_us| RunRequest {
            cycles: 1,
            stroke_um: 1_000,
            timing: Timing::Speeds {
                forward_um_s: 5_000,
                return_um_s: 5_000,
                accel_um_s2,
            },
            far_dwell_us,
            home_dwell_us: 0,
            start_delay_us: 0,
        };
        let solve = |dwell_us| {
            let request = request(dwell_us);
            RunPlan::solve(&axis, &limits, &request).unwrap()
        };
        let first = solve(1_000).return_().first_interval().0;
        for (pause, pieces) in [
            (
                65_536_u64,
                &[32_768, 16_384, 8_192, 4_096, 2_048, 2_048][..],
            ),
            (65_537, &[32_768, 16_384, 8_192, 4_096, 2_048, 1_024, 1_025]),
            (65_535, &[32_767, 16_384, 8_192, 4_096, 2_048, 2_048]),
        ] {
            // The last pulse has its period first.
            let Some(dwell) = (pause + 1_000).checked_sub(first) else {
                continue;
            };
            if !dwell.is_multiple_of(100) {
                continue;
            }
            found.insert(pause);
            let path = Path::Run(solve((dwell / 100) as u32));
            let mut walk = Walk::new(&path, 0, window(0, 12_800));
            let mut blanks = Vec::new();
            loop {
                match walk.next() {
                    Item::Turn { .. } => break,
                    Item::StrokeEnd { .. } => {}
                    Item::Period(period) if period.pulse => blanks.clear(),
                    Item::Period(period) => blanks.push(period.ticks),
                    other => panic!("{other:?}"),
                }
            }
            assert_eq!(blanks, pieces, "{pause}");
        }
    }
    assert_eq!(found.len(), 3, "{found:?}");
}

#[test]
fn the_papers_run_is_1040000_pulses_in_forty_seconds() {
    let settings = Settings::REFERENCE;
    let request = RunRequest {
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
    let plan = RunPlan::solve(&settings.axis, &settings.limits, &request).unwrap();
    let path = Path::Run(plan);
    assert_eq!(check_whole(&path, LIMITS.min_interval_ticks), 1_040_000);
    let mut walk = Walk::new(&path, 0, window(0, 104_000));
    let mut items = 0;
    while walk.next() != Item::End {
        items += 1;
    }
    // 101,860 steps lie in ramps; in cruise 3503 ticks come 20 times or 21 times in a row, then 3504 once.
    assert!(items < 200_000, "{items} items");
    assert_eq!(walk.last_pulse, 4_000_000_000);
    assert_eq!(walk.periods.last_step(), 4_000_000_000);
    assert_eq!(walk.position, 0);
}

/// In a dwell, and before the first step, a stop ends the path without another pulse. Its last step is the last one
/// queued.
#[test]
fn a_stop_at_rest_emits_nothing() {
    let settings = Settings::REFERENCE;
    let request = RunRequest {
        cycles: 2,
        stroke_um: 100,
        timing: Timing::Speeds {
            forward_um_s: 10_000,
            return_um_s: 20_000,
            accel_um_s2: 1_000_000,
        },
        far_dwell_us: 100_000,
        home_dwell_us: 100_000,
        start_delay_us: 100_000,
    };
    let plan = RunPlan::solve(&settings.axis, &settings.limits, &request).unwrap();
    let deceleration = settings.axis.acceleration(1_000).unwrap();
    for (pulses, position) in [(0, 0), (80, 80), (160, 0), (240, 80), (320, 0)] {
        for blanks in 0..3 {
            let mut walk = Walk::new(&Path::Run(plan), 0, window(0, 80));
            let mut seen = 0;
            while seen < pulses {
                if let Item::Period(Period {
                    pulse: true,
                    repeats,
                    ..
                }) = walk.next()
                {
                    seen += 1 + i32::from(repeats);
                }
            }
            for _ in 0..blanks {
                walk.next();
            }
            walk.periods.stop(deceleration);
            let (_, mut ticks, mut end) = walk.blanks();
            // The end of the stroke is reported, whether it came before the stop or not.
            if let Item::StrokeEnd { .. } = end {
                let (_, more, then) = walk.blanks();
                (ticks, end) = (ticks + more, then);
            }
            assert_eq!((end, walk.position), (Item::End, position), "{pulses}");
            // The path ends 10 us after the queued periods, not after the rest of the dwell.
            assert!(ticks <= 1_000, "{ticks}");
            assert_eq!(walk.next(), Item::End);
        }
    }
    // After the turn, when the first step of the next stroke is due at once.
    let mut walk = Walk::new(&Path::Run(plan), 0, window(0, 80));
    while !matches!(walk.next(), Item::Turn { .. }) {}
    walk.periods.stop(deceleration);
    assert_eq!(walk.blanks().2, Item::End);
    assert_eq!(walk.position, 80);
}

/// Only steps longer than 0.1 s are so slow that the next one does not come: at exactly that interval it still does.
#[test]
fn a_step_of_a_tenth_of_a_second_is_not_slow() {
    let deceleration = Axis::REFERENCE.acceleration(1_000_000).unwrap();
    for (interval, follow) in [(10_000_000, true), (10_000_001, false)] {
        let (span, ramp) = (20 * interval, 5 * interval);
        let profile =
            StrokeProfile::from_parts(Steps(20), Ticks(span + ramp), Ticks(ramp)).unwrap();
        let path = Path::Move {
            profile,
            direction: Direction::Away,
        };
        let mut walk = Walk::new(&path, 0, EVERYWHERE);
        while walk.pulses < 10 {
            walk.next();
        }
        walk.periods.stop(deceleration);
        let mut items =
            std::iter::repeat_with(|| walk.next()).take_while(|item| *item != Item::End);
        let follows = items.any(|item| matches!(item, Item::Period(Period { pulse: true, .. })));
        assert_eq!(follows, follow, "{interval}");
    }
}
