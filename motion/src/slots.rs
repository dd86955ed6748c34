//! The ring of slots that DMA copies to the step timer: each is one period, or some equal ones, as the words of the
//! timer's registers.

use core::sync::atomic::{AtomicU16, Ordering, compiler_fence};

use crate::step_times::Equal;

/// Slots of the ring. If no two periods are equal, they last 9 ms at 28.5 kHz and 1 ms at 250 kHz.
pub const SLOTS: usize = 256;

/// Words of a slot: {ARR, RCR, CCR1, CCR2, CCR3} of an advanced timer (RM0383 section 12.4). ARR is the last tick of
/// a round, RCR the rounds after the first, CCR1 the width of the sync pulse, CCR3 that of the step pulse.
pub const WORDS: usize = 5;
const LAST_TICK: usize = 0;
const REPEATS: usize = 1;
const SYNC: usize = 2;
const PULSE: usize = 4;

/// The ring. A slot whose first word is zero blocks the counter: it ends the queue.
#[derive(Debug)]
pub struct Slots([[AtomicU16; WORDS]; SLOTS]);

impl Default for Slots {
    fn default() -> Self {
        Self::new()
    }
}

impl Slots {
    /// All slots empty.
    #[must_use]
    pub const fn new() -> Self {
        Self([const { [const { AtomicU16::new(0) }; WORDS] }; SLOTS])
    }

    /// Address from which DMA reads the words, slot by slot.
    #[must_use]
    pub const fn as_ptr(&self) -> *const AtomicU16 {
        self.0.as_ptr().cast()
    }

    /// The words of a slot. Slot numbers wrap at the end of the ring.
    #[inline]
    fn words(&self, slot: u32) -> &[AtomicU16; WORDS] {
        &self.0[slot as usize % SLOTS]
    }

    /// The last tick of a round of this slot; 0 if it is the end of the queue.
    #[must_use]
    pub fn last_tick(&self, slot: u32) -> u16 {
        self.words(slot)[LAST_TICK].load(Ordering::Relaxed)
    }

    /// Makes a slot the end of the queue. Writes its first word first, so that the counter stops before the pulse
    /// widths become 0.
    pub fn end(&self, slot: u32) {
        self.publish(slot, 0);
        self.write(slot, 0, 0, 0);
        compiler_fence(Ordering::SeqCst);
    }

    /// Writes all words of a slot but the first.
    #[inline]
    pub fn write(&self, slot: u32, repeats: u16, sync_ticks: u16, pulse_ticks: u16) {
        let words = self.words(slot);
        words[REPEATS].store(repeats, Ordering::Relaxed);
        words[SYNC].store(sync_ticks, Ordering::Relaxed);
        words[PULSE].store(pulse_ticks, Ordering::Relaxed);
    }

    /// Writes a slot for each group of steps, from `first` on, except the first word of the first one: the queue ends
    /// there until [`Slots::publish`] writes it.
    // Not inlined, so that the loop's state stays in registers.
    #[inline(never)]
    pub fn write_steps(&self, first: u32, groups: &[Equal], pulse_ticks: u16) {
        let mut slot = first;
        for &Equal { interval, steps } in groups {
            // Neither subtraction wraps: a group has at least one step, a step at least one tick.
            self.write(slot, steps.wrapping_sub(1) as u16, 0, pulse_ticks);
            if slot != first {
                let last_tick = interval.wrapping_sub(1) as u16;
                self.words(slot)[LAST_TICK].store(last_tick, Ordering::Relaxed);
            }
            slot = slot.wrapping_add(1);
        }
    }

    /// Writes the first word of a slot, after everything that was written before.
    pub fn publish(&self, slot: u32, last_tick: u16) {
        compiler_fence(Ordering::SeqCst);
        self.words(slot)[LAST_TICK].store(last_tick, Ordering::Relaxed);
        compiler_fence(Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(slots: &Slots, slot: u32) -> [u16; WORDS] {
        slots
            .words(slot)
            .each_ref()
            .map(|word| word.load(Ordering::Relaxed))
    }

    /// Across the end of the ring, with one slot ended before and after.
    #[test]
    fn steps_become_valid_with_the_first_word_of_the_first() {
        let slots = Slots::new();
        for slot in 0..SLOTS as u32 {
            slots.write(slot, 7, 7, 7);
            slots.publish(slot, 7);
        }
        let first = SLOTS as u32 - 1;
        slots.end(first);
        slots.end(first + 3);
        let groups = [(3_503, 1), (3_504, 20), (65_536, 256)];
        let groups = groups.map(|(interval, steps)| Equal { interval, steps });
        slots.write_steps(first, &groups, 200);
        assert_eq!(words(&slots, first), [0, 0, 0, 0, 200]);
        assert_eq!(words(&slots, 0), [3_503, 19, 0, 0, 200]);
        assert_eq!(words(&slots, 1), [65_535, 255, 0, 0, 200]);
        assert_eq!(words(&slots, 2), [0; WORDS]);
        assert_eq!(words(&slots, 3), [7, 7, 7, 0, 7]);
        slots.publish(first, 3_502);
        assert_eq!(slots.last_tick(first), 3_502);
        assert_eq!(words(&slots, first), [3_502, 0, 0, 0, 200]);
    }
}
