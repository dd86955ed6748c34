//! The time driver's count of half-periods, across a stall of any length that begins at any count.

use core::cell::Cell;
use device::half_periods::{Timers, keep_over, lost, passed_us, remaining_us};

/// A simulated timer whose time advances with each access.
struct Simulated {
    /// Time, and duration of an access, in quarters of a microsecond.
    now: Cell<u64>,
    access: u64,
    /// Flags of the half-period and of the overflow.
    flags: [Cell<bool>; 2],
    /// Half-periods counted by the driver's handler.
    counted: Cell<u64>,
}

impl Simulated {
    fn at(now_us: u64, access: u64) -> Self {
        Self {
            now: Cell::new(now_us * 4),
            access,
            flags: Default::default(),
            counted: Cell::new(0),
        }
    }

    fn half_periods(&self) -> u64 {
        self.now.get() / 4 / 32_768
    }

    fn pass(&self, quarters: u64) {
        let before = self.half_periods();
        self.now.set(self.now.get() + quarters);
        for half in before + 1..=self.half_periods() {
            self.flags[half as usize % 2].set(true);
        }
    }

    fn standing(&self) -> u64 {
        self.flags.iter().map(|flag| u64::from(flag.get())).sum()
    }
}

impl Timers for Simulated {
    fn flags(&self) -> u32 {
        self.pass(self.access);
        self.standing() as u32
    }

    fn count(&self) -> u16 {
        self.pass(self.access);
        (self.now.get() / 4) as u16
    }

    fn stopwatch(&self) -> u32 {
        self.pass(self.access);
        (self.now.get() * 25) as u32
    }

    fn stopwatch_ticks_per_us(&self) -> u32 {
        100
    }

    fn raise(&self) {
        self.pass(self.access);
        self.flags[1].set(true);
    }

    fn handle(&self) {
        self.pass(self.access);
        let standing = [0, 1].map(|flag| self.flags[flag].take());
        // Flags raised from here on belong to the next call.
        self.pass(self.access);
        let counted = standing.into_iter().map(u64::from).sum::<u64>();
        self.counted.set(self.counted.get() + counted);
    }
}

/// Stalls that begin at any count and end around the end of a half-period: none is missed, none counted twice.
#[test]
fn no_half_period_is_missed_by_the_driver() {
    for from_us in [100, 20_000, 32_760, 40_000, 65_530] {
        for halves in 0..=16 {
            for access in [1, 3, 10] {
                for around in 0..2_400_u64 {
                    let timers = Simulated::at(from_us, access);
                    let begun = timers.half_periods();
                    let end = (from_us / 32_768 + 1 + halves) * 4 * 32_768 + around;
                    let end = end.saturating_sub(1_200);
                    keep_over(&timers, || {
                        timers.pass(end.saturating_sub(timers.now.get()));
                    });
                    let begun = timers.half_periods() - begun;
                    let known = timers.counted.get() + timers.standing();
                    assert_eq!(known, begun, "from {from_us} us, {end} quarters, {access}");
                }
            }
        }
    }
}

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

/// A flag that was set before the stall and raised again during it is one flag for two half-periods.
#[test]
fn a_flag_that_stood_already_counts_too() {
    // An overflow just before; then 70 ms with one half and another overflow.
    assert_eq!(lost(10, 70_000, 1, 2), 1);
    // The flag of a half was set; nothing more came.
    assert_eq!(lost(40_000, 1_000, 1, 1), 0);
}

#[test]
fn a_half_period_ends_where_the_timer_flags_it() {
    let lefts = [0, 1, 32_767, 32_768, 65_535].map(remaining_us);
    assert_eq!(lefts, [32_768, 32_767, 1, 32_768, 1]);
}
