//! The line of planned periods against one that forgets nothing.

use motion::step_times::Equal;
use motion::timeline::{Mark, REMEMBERED, Timeline};
use proptest::prelude::*;

/// A period with pulses, or a pause of this many ticks.
#[derive(Clone, Copy, Debug)]
enum Part {
    Pulses(Equal),
    Pause(u32),
}

fn parts() -> impl Strategy<Value = Vec<Part>> {
    let pulses = (1_u32..100_000, 1_u32..=256)
        .prop_map(|(interval, steps)| Part::Pulses(Equal { interval, steps }));
    let part = prop_oneof![4 => pulses, 1 => (1_u32..10_000_000).prop_map(Part::Pause)];
    // More periods than are remembered, and fewer.
    prop::collection::vec(part, 0..2 * REMEMBERED as usize)
}

/// The tick of every pulse, and the end of every period.
fn all(parts: &[Part]) -> (Vec<u64>, Vec<(u64, usize)>) {
    let (mut tick, mut pulses, mut ends) = (0, Vec::new(), Vec::new());
    for part in parts {
        match *part {
            Part::Pause(ticks) => tick += u64::from(ticks),
            Part::Pulses(Equal { interval, steps }) => {
                for _ in 0..steps {
                    pulses.push(tick);
                    tick += u64::from(interval);
                }
            }
        }
        ends.push((tick, pulses.len()));
    }
    (pulses, ends)
}

fn mark((tick, pulses): (u64, usize)) -> Mark {
    Mark {
        ticks: tick as u32,
        pulses: pulses as u32,
    }
}

proptest! {
    #[test]
    fn the_latest_periods_and_their_pulses_are_remembered(
        before in parts(), parts in parts(), unemitted in prop::collection::vec(any::<prop::sample::Index>(), 20),
    ) {
        let mut line = Timeline::default();
        let extend = |line: &mut Timeline, parts: &[Part]| {
            for part in parts {
                match *part {
                    Part::Pause(ticks) => line.extend_by_pause(ticks),
                    Part::Pulses(steps) => line.extend(&[steps]),
                }
            }
        };
        // Another path leaves nothing behind.
        extend(&mut line, &before);
        line.clear();
        extend(&mut line, &parts);

        let (pulses, ends) = all(&parts);
        let end = ends.last().copied().unwrap_or_default();
        prop_assert_eq!(line.given() as usize, parts.len());
        prop_assert_eq!(line.end(), mark(end));
        for (number, end) in (0..line.given()).zip(&ends).rev().take(REMEMBERED as usize) {
            prop_assert_eq!(line.at_end_of(number), mark(*end));
        }
        // Before the first period the progress is zero.
        if parts.len() < REMEMBERED as usize {
            prop_assert_eq!(line.at_end_of(line.given().wrapping_sub(parts.len() as u32 + 1)), Mark::default());
        }

        // The end before the oldest period that can be searched is remembered, too.
        let oldest = (parts.len() + 1).saturating_sub(REMEMBERED as usize);
        let forgotten = oldest.checked_sub(1).map_or(0, |number| ends[number].1);
        for unemitted in unemitted.into_iter().map(|index| index.index(pulses.len() + 1)) {
            let emitted = pulses.len() - unemitted;
            let expected = (emitted > forgotten).then(|| (end.0 - pulses[emitted - 1]) as u32);
            prop_assert_eq!(line.ticks_since_last_pulse(unemitted as u32), expected, "{} left", unemitted);
        }
    }

    #[test]
    fn a_difference_of_marks_is_exact_over_the_wrap(ticks: u32, pulses: u32, more in any::<(u32, u32)>()) {
        let before = Mark { ticks, pulses };
        let after = Mark { ticks: ticks.wrapping_add(more.0), pulses: pulses.wrapping_add(more.1) };
        prop_assert_eq!(after.since(before), Mark { ticks: more.0, pulses: more.1 });
    }
}
