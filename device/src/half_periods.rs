//! Keeps the time driver's clock right over a stall of the processor.
//!
//! The driver counts half-periods of its 16-bit timer, 32.768 ms each, by one flag for each half. A longer stall loses
//! some. After an odd number of lost ones the clock would step back 30 times a second. A 32-bit timer measures the
//! stall.

/// A half-period, ticks of 1 us.
const HALF_PERIOD: u32 = 1 << 15;
const PERIOD: u32 = 1 << 16;

/// Time reserved for handling the half-periods that a stall has lost. The handlers take far less.
const HANDLING_US: u16 = 1_000;

/// The time driver's timer, and a stopwatch. Interrupts are off.
pub trait Timers {
    /// Flags of half-periods that the driver has not counted yet, 0 to 2.
    fn flags(&self) -> u32;

    /// Count of the driver's timer, ticks of 1 us.
    fn count(&self) -> u16;

    /// Count of the stopwatch; it wraps after more than any stall.
    fn stopwatch(&self) -> u32;

    /// Ticks of the stopwatch in a microsecond.
    fn stopwatch_ticks_per_us(&self) -> u32;

    /// Raises one flag.
    fn raise(&self);

    /// Calls the driver's handler, which counts each flag that is set and clears it.
    fn handle(&self);
}

/// Runs `stall`, which keeps the processor from counting time, then makes the driver count the time that has passed.
pub fn keep_over<T>(timers: &impl Timers, stall: impl FnOnce() -> T) -> T {
    let (flags, from) = flags_and_count(timers);
    let watch_from = timers.stopwatch();
    let result = stall();
    // A half-period that begins between the reading of the flags and the handlers would be lost, because its flag is
    // already set. Wait until none is about to begin.
    while remaining_us(timers.count()) < HANDLING_US {}
    let watch_passed = timers.stopwatch().wrapping_sub(watch_from);
    let (flags_after, to) = flags_and_count(timers);
    let passed_us = passed_us(from, to, watch_passed / timers.stopwatch_ticks_per_us());
    timers.handle();
    for _ in 0..lost(from, passed_us, flags, flags_after) {
        timers.raise();
        timers.handle();
    }
    result
}

/// The flags, and a consistent count.
fn flags_and_count(timers: &impl Timers) -> (u32, u16) {
    loop {
        let (before, count) = (timers.flags(), timers.count());
        if timers.flags() == before {
            return (before, count);
        }
    }
}

/// Ticks that the timer took from one count to the other. `about_us` is another clock's estimate, within 32 ms.
pub const fn passed_us(from: u16, to: u16, about_us: u32) -> u32 {
    // Of all times with this difference of counts, take the one nearest to `about_us`.
    let within = to.wrapping_sub(from) as u32;
    let off = about_us.wrapping_sub(within).wrapping_add(HALF_PERIOD) & (PERIOD - 1);
    about_us.wrapping_sub(off).wrapping_add(HALF_PERIOD)
}

/// Half-periods that have begun but will not be counted from the timer's flags. `before` of them were flagged when the
/// stall began at the count `from`, `after` when it had ended.
pub const fn lost(from: u16, passed_us: u32, before: u32, after: u32) -> u32 {
    let from = from as u32;
    let begun = (from + passed_us) / HALF_PERIOD - from / HALF_PERIOD;
    (before + begun).saturating_sub(after)
}

/// Ticks until the present half-period ends, at this count of the timer.
pub const fn remaining_us(count: u16) -> u16 {
    HALF_PERIOD as u16 - count % HALF_PERIOD as u16
}
