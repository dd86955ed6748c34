//! Speeds, means and trends over the last readings, against a list of all readings without running sums.

use firmware_capsule::{mechanics::Counts, sample::Sample, window::Window};
use proptest::prelude::*;

/// The readings that the window keeps.
const KEPT: usize = 32;

#[derive(Clone, Copy, Debug)]
struct Reading {
    at_us: u64,
    counts: i32,
    current_ma: i16,
    ordered_ma: Option<u16>,
    battery_mv: u16,
}

/// About a millisecond apart, at times much more; at times without pulses.
fn readings() -> impl Strategy<Value = Vec<Reading>> {
    let apart = prop_oneof![
        6 => 490..=1_510_u64,
        1 => 400_000..500_000_u64,
        1 => Just(0)
    ];
    let ordered = prop_oneof![9 => (0..=250_u16).prop_map(Some), 1 => Just(None)];
    let one = (
        apart,
        -40..=40_i32,
        -1_500..=1_500_i16,
        ordered,
        2_000..=4_300_u16,
    );
    (
        1_u64..1 << 40,
        any::<i32>(),
        prop::collection::vec(one, 0..80),
    )
        .prop_map(|(mut at_us, mut counts, steps)| {
            let reading = |(apart_us, step, current_ma, ordered_ma, battery_mv)| {
                at_us += apart_us;
                counts = i32::wrapping_add(counts, step);
                Reading {
                    at_us,
                    counts,
                    current_ma,
                    ordered_ma,
                    battery_mv,
                }
            };
            steps.into_iter().map(reading).collect()
        })
}

/// The mean, to the nearest.
fn nearest(sum: i32, count: usize) -> u16 {
    ((sum + count as i32 / 2) / count as i32) as u16
}

fn sum(readings: &[Reading], of: impl Fn(&Reading) -> i32) -> i32 {
    readings.iter().map(of).sum()
}

proptest! {
    #[test]
    fn a_window_of_readings_says_what_all_of_them_say(
        all in readings(), over in 1..KEPT, from in 0..KEPT + 8, to in 0..KEPT,
    ) {
        let mut window = Window::new();
        for reading in &all {
            let sample = Sample {
                counts: Counts(reading.counts),
                battery_mv: reading.battery_mv,
                ..Sample::default()
            };
            window.push(reading.at_us, &sample, reading.current_ma, reading.ordered_ma);
        }
        let kept = &all[all.len().saturating_sub(KEPT)..];
        let back = |age: usize| kept.len().checked_sub(1 + age).map(|index| kept[index]);
        let last = |count: usize| kept.len().checked_sub(count).map(|first| &kept[first..]);
        let driven = |part: &[Reading]| part.iter().all(|reading| reading.ordered_ma.is_some());
        let current = |reading: &Reading| i32::from(reading.current_ma);
        let ordered = |reading: &Reading| i32::from(reading.ordered_ma.unwrap_or(0));

        // The step before the oldest one that is kept is known, too.
        let step = to.checked_add(1).and_then(|before| {
            let index = all.len().checked_sub(1 + before)?;
            let apart_us = all[index + 1].at_us - all[index].at_us;
            let counts = all[index + 1].counts.wrapping_sub(all[index].counts);
            (500..=1_500).contains(&apart_us).then_some(counts)
        });
        prop_assert_eq!(window.step(to), step);

        let speed = || {
            let first = back(from.min(kept.len().checked_sub(1)?))?;
            let last = back(to)?;
            let elapsed_us = i64::try_from(last.at_us.checked_sub(first.at_us)?).ok()?;
            let counts = i64::from(last.counts.wrapping_sub(first.counts));
            (counts * 1_000_000).checked_div(elapsed_us)
        };
        prop_assert_eq!(i64::from(window.speed_cps(from, to)), speed().unwrap_or(0));

        let part = last(over);
        prop_assert_eq!(window.is_driven(over), part.is_some_and(driven));
        prop_assert_eq!(window.along_ma(over), part.map(|part| sum(part, current) / over as i32));
        let battery = part.map(|part| sum(part, |reading| reading.battery_mv.into()) / over as i32);
        prop_assert_eq!(window.battery_mv(over).map(i32::from), battery);
        let means = part.filter(|part| driven(part)).map(|part| {
            (nearest(sum(part, current).max(0), over), nearest(sum(part, ordered), over))
        });
        prop_assert_eq!(window.means_ma(over), means);
        let most = part.is_some_and(|part| {
            let now = part[over - 1].ordered_ma;
            driven(part) && part.iter().all(|reading| reading.ordered_ma <= now)
        });
        prop_assert_eq!(window.orders_most_now(over), most);

        // One reading more than its mean is over.
        let before = over - 1;
        let surge = part.filter(|part| before > 0 && driven(part)).map(|part| {
            let surplus = |reading: &Reading| current(reading) - ordered(reading);
            let (now, earlier) = part.split_last().unwrap();
            surplus(now) - sum(earlier, surplus) / before as i32
        });
        prop_assert_eq!(window.surge_ma(before), surge);
    }
}

/// A speed whose counts times a million do not fit 32 bits.
#[test]
fn a_long_way_has_its_speed_too() {
    for (counts, elapsed_us, cps) in [
        (3_000, 1_000_000, 3_000),
        (-3_000, 1_000_000, -3_000),
        (2_000_000_000, 1_000, i32::MAX),
        (-2_000_000_000, 1_000, i32::MIN),
        (2_000, 3_000_000_000, 0),
        (3_000, 3_000_000_000, 1),
    ] {
        let mut window = Window::new();
        for (at_us, counts) in [(5, 0), (5 + elapsed_us, counts)] {
            let sample = Sample {
                counts: Counts(counts),
                ..Sample::default()
            };
            window.push(at_us, &sample, 0, None);
        }
        assert_eq!(window.speed_cps(1, 0), cps, "{counts} in {elapsed_us} us");
    }
}

/// A full window has lost the reading before its oldest one.
#[test]
fn a_full_window_has_no_mean_of_all_its_readings() {
    let mut window = Window::new();
    for at_us in (1_000..=33_000).step_by(1_000) {
        window.push(at_us, &Sample::default(), 20, Some(30));
    }
    assert_eq!(window.means_ma(KEPT), None);
    assert_eq!(window.means_ma(KEPT - 1), Some((20, 30)));
}
