//! How many half-periods of the time driver's 16-bit timer a stall has hidden from it.

/// A half-period, ticks of 1 us.
const HALF_PERIOD: u32 = 1 << 15;
/// A whole one.
const PERIOD: u32 = 1 << 16;

/// Ticks that have passed while the timer went from one count to the other, by another clock that is less than 32 ms off.
pub const fn passed_us(from: u16, to: u16, about_us: u32) -> u32 {
    // Of all times with this difference of the counts, the one next to `about_us`.
    let within = to.wrapping_sub(from) as u32;
    let off = about_us.wrapping_sub(within).wrapping_add(HALF_PERIOD) & (PERIOD - 1);
    about_us.wrapping_sub(off).wrapping_add(HALF_PERIOD)
}

/// Half-periods that have begun, and that the driver will not count from the timer's flags: `before` of them were flagged
/// when the stall began at the count `from`, `after` when it had ended.
pub const fn lost(from: u16, passed_us: u32, before: u32, after: u32) -> u32 {
    let from = from as u32;
    let begun = (from + passed_us) / HALF_PERIOD - from / HALF_PERIOD;
    (before + begun).saturating_sub(after)
}

/// Ticks until the half-period ends in which the timer is at this count.
pub const fn left_us(count: u16) -> u16 {
    HALF_PERIOD as u16 - count % HALF_PERIOD as u16
}
