//! The time driver's half-periods across a stall of any length, begun at any count.

use device::half_periods::{left_us, lost, passed_us};

#[test]
fn every_half_period_of_a_stall_is_found() {
    for from in (0..=u16::MAX).step_by(61) {
        for ms in 0..=800_u32 {
            let passed = ms * 1_000 + u32::from(from) % 997;
            let to = from.wrapping_add(passed as u16);
            let end = u32::from(from) + passed;
            // The flags can hold one overflow and one half each.
            let begun: Vec<u32> = (u32::from(from) / 32_768 + 1..=end / 32_768).collect();
            let flagged = |half| begun.iter().any(|number| number % 2 == half);
            let after = u32::from(flagged(0)) + u32::from(flagged(1));
            for off_us in [-2_000, -500, 0, 700, 2_000] {
                let about = passed.saturating_add_signed(off_us);
                if off_us < 0 && passed < 2_000 {
                    continue; // the other clock does not run backwards
                }
                assert_eq!(
                    passed_us(from, to, about),
                    passed,
                    "{from} {passed} {off_us}"
                );
            }
            assert_eq!(
                lost(from, passed, 0, after),
                begun.len() as u32 - after,
                "{from} {passed}"
            );
        }
    }
}

/// A flag that stood before the stall and was raised again in it is one flag for two half-periods.
#[test]
fn a_flag_that_stood_already_counts_too() {
    // An overflow just before; then 70 ms with one half and one overflow more.
    assert_eq!(lost(10, 70_000, 1, 2), 1);
    // The flag of a half stood; nothing more came.
    assert_eq!(lost(40_000, 1_000, 1, 1), 0);
}

#[test]
fn a_half_period_ends_where_the_timer_flags_it() {
    let lefts = [0, 1, 32_767, 32_768, 65_535].map(left_us);
    assert_eq!(lefts, [32_768, 32_767, 1, 32_768, 1]);
}
