//! The step timer's course while the processor sleeps: only the ring in memory decides it, and nothing can change that.
//!
//! The timer, the stream that feeds it, the read-back and the capture stand still meanwhile. Their edges follow from
//! the ring, each at its exact instant, and the board gets them in order. When the processor wakes, or somebody looks,
//! they are set to where they would be now: [`Course::advance`] computes how far they have come.
//!
//! The course ends before anything that could be noticed at once: the ring's interrupts, its end, and the events that
//! the board names.

use std::collections::VecDeque;

use rigless::emulator::Memory;
use rigless::soc::Width;

use super::OutputEdge;
use super::ring::Rest;

/// Words of a burst {ARR, RCR, CCR1, CCR2, CCR3}.
pub(super) const WORDS: usize = 5;
/// The words of one burst.
pub(super) type Words = [u64; WORDS];

/// Shortest level of an output, ns: longer than the filters of the inputs that it leads to.
const SHORTEST_NS: u64 = 500;
/// Channels of the sync output and of the step output.
const OUTPUTS: [u8; 2] = [1, 3];

/// One slot of the ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Slot(pub(super) Words);

impl Slot {
    fn ticks(self) -> u64 {
        self.0[0] + 1
    }

    /// Rounds after the first one; the repetition counter has eight bits.
    fn repeats(self) -> u64 {
        self.0[1] & 0xFF
    }

    /// Ticks for which an output is high at the beginning of a round.
    fn high(self, channel: u8) -> u64 {
        self.0[usize::from(channel) + 1]
    }

    /// Whether the counter moves at all, and each level at the pin lasts long enough for the inputs that see it.
    fn is_plain(self, tick_ns: u64) -> bool {
        let shortest = SHORTEST_NS / tick_ns;
        let is_long = |channel| {
            let high = self.high(channel);
            high == 0 || high >= shortest && high + shortest <= self.ticks()
        };
        self.0[0] != 0 && self.0[3] == 0 && is_long(1) && is_long(3)
    }
}

/// The timer's position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Standing {
    pub(super) playing: Slot,
    pub(super) preloaded: Slot,
    /// When the present round began, on the emulator's clock.
    pub(super) begun_ns: u64,
    /// Rounds left after it.
    pub(super) left: u64,
}

impl Standing {
    fn round_ns(&self, tick_ns: u64) -> u64 {
        self.playing.ticks() * tick_ns
    }
}

/// The course since the processor fell asleep.
#[derive(Debug)]
pub(super) struct Course {
    pub(super) tick_ns: u64,
    pub(super) from_ns: u64,
    /// All edges up to this instant have been reported.
    told_ns: u64,
    pub(super) at: Standing,
    /// The round in which the processor fell asleep.
    pub(super) first_ns: u64,
    /// Slots fetched since.
    pub(super) fetched: u64,
    /// Slots read from the ring and not fetched yet.
    ahead: VecDeque<Slot>,
    ring: Rest,
    /// Slots read since.
    read: u64,
    /// Latest end. The course stops before the event at this instant.
    pub(super) end_ns: Option<u64>,
    /// Nothing happens before this instant.
    pub(super) clear_ns: u64,
    /// Pulses from now on that the board need not see one by one.
    pub(super) unnoticed: u64,
}

impl Course {
    pub(super) fn new(at: Standing, ring: Rest, tick_ns: u64, now_ns: u64) -> Self {
        Self {
            tick_ns,
            from_ns: now_ns,
            told_ns: now_ns,
            at,
            first_ns: at.begun_ns,
            fetched: 0,
            ahead: VecDeque::new(),
            ring,
            read: 0,
            end_ns: None,
            clear_ns: now_ns,
            unnoticed: 0,
        }
    }

    /// Whether both slots already in the timer are plain.
    pub(super) fn begins_plainly(&self) -> bool {
        self.at.playing.is_plain(self.tick_ns) && self.at.preloaded.is_plain(self.tick_ns)
    }

    /// The item of the ring that the stream has read ahead by now.
    pub(super) fn held(&self) -> Option<u64> {
        match self.fetched {
            0 => self.ring.held,
            _ => self.ahead.front().map(|slot| slot.0[0]),
        }
    }

    /// Reports every edge up to `to_ns`.
    pub(super) fn advance(&mut self, to_ns: u64, tell: &mut dyn FnMut(OutputEdge)) {
        loop {
            let Standing {
                playing, begun_ns, ..
            } = self.at;
            let mut falls = OUTPUTS.map(|channel| {
                let high = playing.high(channel);
                (begun_ns + high * self.tick_ns, channel, high > 0)
            });
            if falls[0].0 > falls[1].0 {
                falls.swap(0, 1);
            }
            for (at_ns, channel, is_high) in falls {
                if is_high && at_ns > self.told_ns && at_ns <= to_ns {
                    tell(OutputEdge {
                        at_ns,
                        channel,
                        high: false,
                    });
                }
            }
            let end_ns = begun_ns + self.at.round_ns(self.tick_ns);
            if end_ns > to_ns {
                break;
            }
            self.next_round(end_ns);
            self.told_ns = end_ns;
            for channel in OUTPUTS {
                if self.at.playing.high(channel) > 0 {
                    tell(OutputEdge {
                        at_ns: end_ns,
                        channel,
                        high: true,
                    });
                }
            }
        }
        self.told_ns = self.told_ns.max(to_ns);
    }

    fn next_round(&mut self, at_ns: u64) {
        self.at.begun_ns = at_ns;
        if self.at.left > 0 {
            self.at.left -= 1;
            return;
        }
        self.at.playing = self.at.preloaded;
        self.at.left = self.at.playing.repeats();
        self.at.preloaded = self.ahead.pop_front().expect("looked ahead as far as that");
        self.fetched += 1;
    }

    /// Computes how far the course goes on undisturbed, at most until `until_ns`. Sets [`Course::clear_ns`], before
    /// which nothing happens, and [`Course::end_ns`] if the course ends there.
    pub(super) fn look_ahead(&mut self, until_ns: u64, memory: &mut dyn Memory) {
        let mut at = self.at;
        let mut pulses = self.unnoticed;
        let mut next = 0;
        let end_ns = loop {
            let round_ns = at.round_ns(self.tick_ns);
            // The pulse of the present round has been played.
            let rounds = if at.playing.high(3) > 0 {
                pulses.min(at.left)
            } else {
                at.left
            };
            let end_ns = at.begun_ns + (rounds + 1) * round_ns;
            if end_ns > until_ns {
                self.clear_ns = until_ns;
                self.end_ns = None;
                return;
            }
            if rounds < at.left {
                break end_ns;
            }
            if at.playing.high(3) > 0 {
                pulses -= at.left;
            }
            let fetches = self.fetched + next as u64 + 1;
            let interrupts = self
                .ring
                .to_interrupt
                .is_some_and(|items| fetches * WORDS as u64 >= items);
            // One slot more than is fetched: the stream reads an item ahead.
            let known = self.known(next + 1, memory);
            let Some(fetched) = self.ahead.get(next).copied().filter(|_| known) else {
                break end_ns;
            };
            let pulse = u64::from(at.preloaded.high(3) > 0);
            if interrupts || !fetched.is_plain(self.tick_ns) || pulses < pulse {
                break end_ns;
            }
            pulses -= pulse;
            at = Standing {
                playing: at.preloaded,
                preloaded: fetched,
                begun_ns: end_ns,
                left: at.preloaded.repeats(),
            };
            next += 1;
        };
        self.clear_ns = end_ns;
        self.end_ns = Some(end_ns);
    }

    /// Reads slots until the `nth` of those not fetched yet is known.
    fn known(&mut self, nth: usize, memory: &mut dyn Memory) -> bool {
        while self.ahead.len() <= nth {
            let Some(slot) = self.read_slot(memory) else {
                return false;
            };
            self.ahead.push_back(slot);
            self.read += 1;
        }
        true
    }

    fn read_slot(&self, memory: &mut dyn Memory) -> Option<Slot> {
        let mut words = [0; WORDS];
        for (nth, word) in words.iter_mut().enumerate() {
            let item = self.ring.next + self.read * WORDS as u64 + nth as u64;
            let address = self.ring.base + item % self.ring.items * self.ring.bytes;
            *word = match self.ring.held {
                Some(held) if item == self.ring.next => held,
                _ => memory.read(address, Width::W16).ok()?,
            };
        }
        Some(Slot(words))
    }
}

#[cfg(test)]
mod tests {
    use rigless::emulator::Error;

    use super::*;

    /// A ring of half-words.
    struct Ram(Vec<u64>);

    impl Memory for Ram {
        fn read(&mut self, address: u64, width: Width) -> Result<u64, Error> {
            self.0
                .get(address as usize / 2)
                .copied()
                .ok_or(Error::Memory { address, width })
        }

        fn write(&mut self, address: u64, width: Width, _: u64) -> Result<(), Error> {
            Err(Error::Memory { address, width })
        }
    }

    const PLAYING: Slot = Slot([999, 2, 0, 0, 200]);
    const PRELOADED: Slot = Slot([1_999, 0, 300, 0, 200]);
    const NEXT: [u64; 5] = [899, 1, 0, 0, 200];

    fn course(to_interrupt: Option<u64>) -> (Course, Ram) {
        let ring = Rest {
            from_memory: true,
            bytes: 2,
            base: 0,
            items: 20,
            next: 5,
            held: Some(NEXT[0]),
            to_interrupt,
            peripheral_at: 0,
        };
        let at = Standing {
            playing: PLAYING,
            preloaded: PRELOADED,
            begun_ns: 10_000,
            left: 1,
        };
        let mut ram = vec![0; 5];
        for _ in 0..3 {
            ram.extend(NEXT);
        }
        let mut course = Course::new(at, ring, 10, 11_000);
        course.unnoticed = 1_000;
        (course, Ram(ram))
    }

    fn edges(course: &mut Course, to_ns: u64) -> Vec<(u64, u8, bool)> {
        let mut edges = Vec::new();
        course.advance(to_ns, &mut |edge| {
            edges.push((edge.at_ns, edge.channel, edge.high));
        });
        edges
    }

    #[test]
    fn rounds_and_slots_follow_each_other() {
        let (mut course, mut ram) = course(None);
        course.look_ahead(45_000, &mut ram);
        assert_eq!((course.end_ns, course.clear_ns), (None, 45_000));
        let first = [(12_000, 3, false), (20_000, 3, true), (22_000, 3, false)];
        assert_eq!(edges(&mut course, 29_999), first);
        assert_eq!((course.fetched, course.held()), (0, Some(899)));
        let second = [
            (30_000, 1, true),
            (30_000, 3, true),
            (32_000, 3, false),
            (33_000, 1, false),
        ];
        assert_eq!(edges(&mut course, 45_000), second);
        assert_eq!((course.fetched, course.held()), (1, Some(899)));
        assert_eq!(course.at.preloaded, Slot(NEXT));
    }

    #[test]
    fn it_ends_with_the_fetch_that_interrupts_and_with_the_end_of_the_ring() {
        let (mut course, mut ram) = course(Some(10));
        course.look_ahead(1_000_000, &mut ram);
        assert_eq!(course.end_ns, Some(50_000));
        let (mut course, mut ram) = self::course(None);
        // The second slot after the next one is the end.
        ram.0[10] = 0;
        course.look_ahead(1_000_000, &mut ram);
        assert_eq!(course.end_ns, Some(50_000));
    }

    /// An end beyond the horizon does not count: nothing would stop there.
    #[test]
    fn it_ends_before_the_pulse_that_is_noticed_but_not_beyond_the_look() {
        let (mut course, mut ram) = course(None);
        course.unnoticed = 0;
        course.look_ahead(19_999, &mut ram);
        assert_eq!((course.end_ns, course.clear_ns), (None, 19_999));
        course.look_ahead(20_000, &mut ram);
        assert_eq!(course.end_ns, Some(20_000));
        course.unnoticed = 2;
        course.look_ahead(1_000_000, &mut ram);
        assert_eq!(course.end_ns, Some(50_000));
    }
}
