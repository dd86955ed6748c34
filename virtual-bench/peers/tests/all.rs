//! Every method counts its steps, and ours is on the nearest tick, by arithmetic of this file alone.

use step_peers::ours::{Batches, Single};
use step_peers::{Method, Move, austin, ramp_maker, segments, stepgen};

/// The first stroke of the paper's run.
const PAPER: Move = Move {
    steps: 104_000,
    duration_ticks: 400_000_000,
    ramp_ticks: 35_683_161,
};
/// A short one: two of three steps are ramp.
const SHORT: Move = Move {
    steps: 2_000,
    duration_ticks: 35_000_000,
    ramp_ticks: 14_000_000,
};

fn ticks<M: Method>(order: &Move) -> Vec<u64> {
    let mut method = M::new(order).expect("it fits");
    let intervals = std::iter::from_fn(|| method.next_interval());
    summed(intervals.take(2 * order.steps as usize))
}

fn summed(intervals: impl Iterator<Item = u32>) -> Vec<u64> {
    let mut tick = 0;
    intervals
        .map(|interval| {
            tick += u64::from(interval);
            tick
        })
        .collect()
}

fn in_batches(order: &Move) -> Vec<u64> {
    let mut batches = Batches::new(order).expect("it fits");
    let mut intervals = vec![];
    loop {
        let groups = batches.next_groups();
        if groups.is_empty() {
            return summed(intervals.into_iter());
        }
        for group in groups {
            intervals.extend(std::iter::repeat_n(group.interval, group.steps as usize));
        }
    }
}

/// Whether step `k` belongs on this tick: the position half a tick before is at most `k`, half a tick after it at least.
/// Positions of the three pieces, times 8 r (T - r), are whole numbers.
fn is_nearest(order: &Move, k: u64, tick: u64) -> bool {
    let (n, duration) = (i128::from(order.steps), i128::from(order.duration_ticks));
    let ramp = i128::from(order.ramp_ticks);
    let position = |half_ticks: i128| {
        let left = 2 * duration - half_ticks;
        if half_ticks <= 2 * ramp {
            n * half_ticks * half_ticks
        } else if left >= 2 * ramp {
            4 * n * ramp * (half_ticks - ramp)
        } else {
            8 * n * ramp * (duration - ramp) - n * left.max(0) * left.max(0)
        }
    };
    let due = 8 * i128::from(k) * ramp * (duration - ramp);
    let half_ticks = 2 * i128::from(tick);
    position(half_ticks - 1) <= due && due <= position(half_ticks + 1)
}

#[test]
fn ours_is_on_the_nearest_tick() {
    for order in [PAPER, SHORT] {
        for ticks in [ticks::<Single>(&order), in_batches(&order)] {
            assert_eq!(ticks.len(), order.steps as usize);
            for (k, tick) in (1..).zip(ticks) {
                assert!(is_nearest(&order, k, tick), "step {k} at {tick}");
            }
        }
    }
}

/// Else the test above would prove nothing.
#[test]
fn a_tick_beside_the_nearest_is_seen() {
    let ticks = ticks::<Single>(&SHORT);
    let off = |by: i64| {
        let wrong = (1..).zip(&ticks);
        wrong
            .filter(|(k, tick)| !is_nearest(&SHORT, *k, tick.saturating_add_signed(by)))
            .count()
    };
    // Half-way between two ticks both are nearest; it happens.
    assert!(off(1) > 1_990 && off(-1) > 1_990, "{} {}", off(1), off(-1));
}

/// The others take all steps in about the time: no mistake in how they are called is measured as theirs. What they skip
/// at the beginning and the end of a ramp is a twentieth of the short move.
#[test]
fn the_others_make_the_move() {
    for order in [PAPER, SHORT] {
        let all = [
            ("ramp-maker, fixed", ticks::<ramp_maker::Fixed>(&order)),
            ("ramp-maker, float", ticks::<ramp_maker::Float>(&order)),
            ("stepgen", ticks::<stepgen::Delays>(&order)),
            ("austin", ticks::<austin::Delays>(&order)),
            ("segments", ticks::<segments::Intervals>(&order)),
        ];
        for (name, ticks) in all {
            let steps = order.steps as usize;
            let reached = ticks.last().copied().unwrap_or(0);
            let due = u64::from(order.duration_ticks);
            assert!(reached.abs_diff(due) < due / 20, "{name}: {reached}");
            assert_eq!(ticks.len(), steps, "{name}");
        }
    }
}

#[test]
fn numbers_that_do_not_fit_are_refused() {
    // A first step after 158 ms.
    let slow = Move {
        steps: 2_000,
        duration_ticks: 1_000_000_000,
        ramp_ticks: 500_000_000,
    };
    assert!(stepgen::Delays::new(&slow).is_none());
    assert!(Single::new(&slow).is_some());
}
