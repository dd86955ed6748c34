//! Captured edges against the periods that were given out: the comparison finds moved, missing and added edges.

use crate::runs::any_run;
use core::{iter, sync::atomic::AtomicU32};
use firmware_rig::{
    periods::{Item, Path, Period, Periods},
    settings::Settings,
};
use motion::{
    edge_timing::{EdgeTiming, Intervals, Timed},
    step_times::Equal,
    timeline::Timeline,
    units::{StepPosition, Window},
};
use proptest::prelude::*;

const EVERYWHERE: Window = Window {
    first: StepPosition(i32::MIN),
    last: StepPosition(i32::MAX),
};

/// All periods of a path.
fn periods(path: Path) -> Vec<Period> {
    let mut periods = Periods::new(path, StepPosition(0), EVERYWHERE).unwrap();
    let mut all = Vec::new();
    loop {
        let mut steps = [Equal::default(); 7];
        let count = periods.steps(&mut steps, u32::MAX);
        if count > 0 {
            all.extend(steps[..count].iter().copied().map(Period::from));
            continue;
        }
        match periods.next_item() {
            Item::Period(period) => all.push(period),
            Item::End => return all,
            Item::StrokeEnd { .. } | Item::Turn { .. } => {}
            Item::Guard => panic!("left the window"),
        }
    }
}

/// The edges of each period.
fn edges(periods: &[Period]) -> Vec<Vec<u64>> {
    let mut tick = 0;
    let of = |period: &Period| {
        let ticks = u64::from(period.ticks);
        let rounds = (0..=u64::from(period.repeats)).map(|round| tick + round * ticks);
        let edges = if period.pulse {
            rounds.collect()
        } else {
            Vec::new()
        };
        tick += ticks * (u64::from(period.repeats) + 1);
        edges
    };
    periods.iter().map(of).collect()
}

/// The step generator's data for a path.
#[derive(Default)]
struct Watch {
    line: Timeline,
    timing: EdgeTiming,
}

impl Watch {
    fn expect(&mut self, period: Period) {
        if period.pulse {
            self.line.extend(&[Equal {
                interval: period.ticks,
                steps: u32::from(period.repeats) + 1,
            }]);
        } else {
            self.line.extend_by_pause(period.ticks);
        }
    }

    fn compare(&mut self, instants: impl ExactSizeIterator<Item = u32>) {
        let instants: Vec<_> = instants.map(AtomicU32::new).collect();
        self.timing.compare(&self.line, &instants);
    }

    fn clear(&mut self) {
        self.line.clear();
        self.timing.clear();
    }

    fn timed(&self) -> Timed {
        self.timing.timed()
    }
}

/// Gives the periods out, and captures each edge when its period is over. `start` is the clock's value at the path's
/// start.
fn timed(periods: &[Period], edges: &[Vec<u64>], start: u32) -> Timed {
    let mut timing = Watch::default();
    for (period, edges) in periods.iter().zip(edges) {
        timing.expect(*period);
        timing.compare(edges.iter().map(|&edge| start.wrapping_add(edge as u32)));
    }
    timing.timed()
}

fn any_periods() -> impl Strategy<Value = Vec<Period>> {
    any_run(Settings::REFERENCE.limits, 300).prop_map(|plan| periods(Path::Run(plan)))
}

/// An edge by its number: the period that it belongs to, and its place there.
fn place(edges: &[Vec<u64>], mut number: usize) -> (usize, usize) {
    for (period, edges) in edges.iter().enumerate() {
        if number < edges.len() {
            return (period, number);
        }
        number -= edges.len();
    }
    panic!("no such edge");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn what_comes_as_planned_is_right(all in any_periods(), start: u32) {
        let edges = edges(&all);
        let count = edges.iter().map(Vec::len).sum::<usize>() as u32;
        let expected = Timed { edges: count.into(), worst_error_ticks: 0 };
        prop_assert_eq!(timed(&all, &edges, start), expected);
    }

    #[test]
    fn an_edge_that_is_moved_is_found(
        all in any_periods(), start: u32, which: prop::sample::Index, ticks in 1_u64..=100, later: bool
    ) {
        let mut edges = edges(&all);
        let count = edges.iter().map(Vec::len).sum::<usize>();
        prop_assume!(count > 1);
        let (period, nth) = place(&edges, which.index(count));
        let edge = &mut edges[period][nth];
        // The first one is a step's time behind the start, and no closer.
        *edge = if later { *edge + ticks } else { edge.wrapping_sub(ticks) };
        let expected = Timed { edges: count as u64, worst_error_ticks: ticks as u32 };
        prop_assert_eq!(timed(&all, &edges, start), expected);
    }

    #[test]
    fn a_missing_edge_is_found(all in any_periods(), start: u32, which: prop::sample::Index) {
        let mut edges = edges(&all);
        let count = edges.iter().map(Vec::len).sum::<usize>();
        prop_assume!(count > 2);
        let number = which.index(count);
        let (period, nth) = place(&edges, number);
        edges[period].remove(nth);
        let timed = timed(&all, &edges, start);
        prop_assert_eq!(timed.edges as usize, count - 1);
        let within = (1..count - 1).contains(&number);
        prop_assert!(!within || timed.worst_error_ticks > 0);
    }

    #[test]
    fn an_edge_that_is_added_is_found(all in any_periods(), start: u32, which: prop::sample::Index) {
        let mut edges = edges(&all);
        let count = edges.iter().map(Vec::len).sum::<usize>();
        let (period, nth) = place(&edges, which.index(count));
        let ticks = u64::from(all[period].ticks);
        let at = edges[period][nth] + ticks / 2;
        edges[period].insert(nth + 1, at);
        let timed = timed(&all, &edges, start);
        prop_assert_eq!(timed.edges as usize, count + 1);
        prop_assert!(timed.worst_error_ticks > 0);
    }
}

fn steps(ticks: u32, repeats: u8) -> Period {
    Period {
        ticks,
        repeats,
        pulse: true,
        sync: false,
    }
}

#[test]
fn an_edge_that_no_step_has_is_the_worst_error() {
    let mut timing = Watch::default();
    timing.compare(iter::once(7));
    let expected = Timed {
        edges: 1,
        worst_error_ticks: u32::MAX,
    };
    assert_eq!(timing.timed(), expected);
}

#[test]
fn what_came_before_counts_no_more() {
    let mut timing = Watch::default();
    timing.compare(iter::once(7));
    timing.expect(steps(100, 3));
    timing.clear();
    assert_eq!(timing.timed(), Timed::default());
    timing.expect(steps(50, 1));
    timing.compare([1_000, 1_050].into_iter());
    let expected = Timed {
        edges: 2,
        worst_error_ticks: 0,
    };
    assert_eq!(timing.timed(), expected);
}

/// No interval ends at an edge that does not come, so the last one is looked for at the end.
#[test]
fn a_last_step_without_an_edge_is_the_worst_error() {
    for (edges, worst) in [(0_u32, 0), (1, u32::MAX), (5, u32::MAX), (6, 0)] {
        let mut timing = Watch::default();
        timing.expect(steps(100, 3));
        timing.expect(steps(100, 1));
        timing.compare((0..edges).map(|edge| 1_000 + edge * 100));
        let expected = Timed {
            edges: edges.into(),
            worst_error_ticks: worst,
        };
        assert_eq!(timing.timing.timed_whole(&timing.line), expected);
        // A path that was cut has steps in the ring that never left.
        assert_eq!(timing.timed().worst_error_ticks, 0);
    }
    // After a loss nothing is known.
    let mut timing = Watch::default();
    timing.expect(steps(100, 3));
    timing.compare([1_000, 1_100].into_iter());
    timing.timing.lose();
    assert_eq!(timing.timing.timed_whole(&timing.line).worst_error_ticks, 0);
}

/// No captures arrive, so expected edges pile up. The comparison then reports nothing, rather than something wrong.
#[test]
fn without_the_jumper_nothing_is_timed() {
    let mut timing = Watch::default();
    for _ in 0..10_000 {
        timing.expect(steps(100, 0));
    }
    assert_eq!(timing.timed(), Timed::default());
    timing.compare(iter::once(7));
    assert_eq!(timing.timed(), Timed::default());
    assert!(timing.timing.is_over());
}

#[test]
fn after_a_loss_nothing_more_is_compared() {
    let mut timing = Watch::default();
    timing.expect(steps(100, 5));
    timing.compare([0, 100].into_iter());
    assert!(!timing.timing.is_over());
    timing.timing.lose();
    assert!(timing.timing.is_over());
    timing.compare(iter::once(900));
    let expected = Timed {
        edges: 2,
        worst_error_ticks: 0,
    };
    assert_eq!(timing.timed(), expected);
    timing.clear();
    assert!(!timing.timing.is_over());
    timing.expect(steps(100, 0));
    timing.compare(iter::once(5));
    assert_eq!(timing.timed().edges, 1);
}

/// The comparison remembers the periods waiting in the ring, and those of a whole ring played since the last look.
#[test]
fn a_look_may_come_a_ring_late() {
    let mut timing = Watch::default();
    for _ in 0..256 + 256 {
        timing.expect(steps(400, 0));
    }
    for edge in 0..256 + 256 {
        timing.compare(iter::once(edge * 400));
    }
    let expected = Timed {
        edges: 512,
        worst_error_ticks: 0,
    };
    assert_eq!(timing.timed(), expected);
}

/// More periods than the timeline remembers, as between two strokes.
#[test]
fn a_long_pause_is_passed_with_and_without_a_missing_edge() {
    for (missing, expected) in [
        (
            0,
            Timed {
                edges: 4,
                worst_error_ticks: 0,
            },
        ),
        (
            1,
            Timed {
                edges: 3,
                worst_error_ticks: 65_536_100,
            },
        ),
        // The comparison waits for the last but one, and the pause pushes it out of the timeline.
        (
            2,
            Timed {
                edges: 1,
                worst_error_ticks: u32::MAX,
            },
        ),
    ] {
        let mut timing = Watch::default();
        for _ in 0..3 {
            timing.expect(steps(100, 0));
        }
        timing.compare([1_000, 1_100, 1_200].into_iter().take(3 - missing));
        for _ in 0..1_000 {
            timing.expect(Period {
                pulse: false,
                ..steps(65_536, 0)
            });
            timing.compare(iter::empty());
        }
        timing.expect(steps(100, 0));
        timing.compare(iter::once(1_300 + 65_536_000));
        assert_eq!(timing.timed(), expected, "{missing} missing");
    }
}

/// Counts intervals by their error, over several paths. The first edge of a path ends no interval; an added edge
/// belongs to none.
#[test]
fn intervals_are_counted_by_their_error() {
    let mut timing = Watch::default();
    for _ in 0..2 {
        timing.clear();
        timing.expect(steps(100, 6));
        timing.compare([1_000, 1_100].into_iter());
        // 1 late, so the next one is 1 short; 2 early and back; 50 late.
        timing.compare([1_201, 1_300, 1_398, 1_500, 1_650, 1_700].into_iter());
    }
    // An edge before the first of its path is not taken for the first.
    timing.clear();
    timing.compare(iter::once(7));
    timing.expect(steps(100, 2));
    timing.compare([1_000, 1_100, 1_200].into_iter());
    let expected = Intervals {
        exact: 4,
        off: [4, 4, 2],
    };
    assert_eq!(timing.timing.intervals(), expected);
    assert_eq!(timing.timed().worst_error_ticks, u32::MAX);
}

/// Several edges that no step has may come in one look, as from a bouncing line: none of them ends an interval.
#[test]
fn added_edges_of_one_look_end_no_interval() {
    for added in [&[1_110][..], &[1_110, 1_111], &[1_110, 1_111, 1_200, 1_300]] {
        let mut timing = Watch::default();
        timing.expect(steps(100, 1));
        timing.compare([&[1_000, 1_100], added].concat().into_iter());
        let expected = Intervals {
            exact: 1,
            off: [0; 3],
        };
        assert_eq!(timing.timing.intervals(), expected, "{added:?}");
        assert_eq!(timing.timed().worst_error_ticks, u32::MAX);
    }
}
