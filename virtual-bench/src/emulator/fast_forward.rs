//! Fast-forward of the step timer while the processor sleeps: only the ring in memory decides its edges then, so they
//! are computed from it, without a stop of the emulator for each.
//!
//! ```text
//! processor  runs | sleeps                                                | runs
//! emulator        | timer, stream, read-back and capture are frozen       | they go on
//!                 ^ new         advance: edges to the board, in order     ^ catch_up
//! timeline   -----+--_-_-_-_-_-_-_-_-_-_-_------------+-------------------+----> ns
//!              from_ns      reported_ns ^     clear_ns, end_ns
//! ```
//!
//! [`FastForward::advance`] reports the edges, each with its exact instant. [`FastForward::look_ahead`] finds until
//! when nothing can be noticed (`clear_ns`), and where the fast-forward has to end (`end_ns`): before an interrupt of
//! the ring, its end, or a pulse that the board has to see. `catch_up` sets the frozen devices to their present state.

use std::collections::VecDeque;

use rigless::emulator::Memory;
use rigless::soc::Width;

use super::OutputEdge;
use super::ring::IdleRing;

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

    /// Ticks for which an output is high at the start of a round.
    fn high(self, channel: u8) -> u64 {
        self.0[usize::from(channel) + 1]
    }

    /// Whether the counter counts, and each level at the pin outlasts the filters of the inputs that see it.
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
pub(super) struct Position {
    pub(super) playing: Slot,
    pub(super) preloaded: Slot,
    /// When the present round began, on the emulator's clock.
    pub(super) begun_ns: u64,
    /// Rounds after the present one.
    pub(super) rounds_left: u64,
}

impl Position {
    fn round_ns(&self, tick_ns: u64) -> u64 {
        self.playing.ticks() * tick_ns
    }
}

/// Progress since the processor fell asleep.
#[derive(Debug)]
pub(super) struct FastForward {
    pub(super) tick_ns: u64,
    pub(super) from_ns: u64,
    /// All edges up to this instant have been reported.
    reported_ns: u64,
    pub(super) at: Position,
    /// The round in which the processor fell asleep.
    pub(super) first_ns: u64,
    /// Slots fetched since.
    pub(super) fetched: u64,
    /// Slots read from memory that the stream has not fetched yet.
    ahead: VecDeque<Slot>,
    ring: IdleRing,
    /// Slots read since.
    read: u64,
    /// The fast-forward has to end before the event at this instant.
    pub(super) end_ns: Option<u64>,
    /// No event before this instant can be noticed.
    pub(super) clear_ns: u64,
    /// Pulses from now on that the board need not see one by one.
    pub(super) unnoticed: u64,
}

impl FastForward {
    pub(super) fn new(at: Position, ring: IdleRing, tick_ns: u64, now_ns: u64) -> Self {
        Self {
            tick_ns,
            from_ns: now_ns,
            reported_ns: now_ns,
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

    /// The item of the ring that the stream has read ahead.
    pub(super) fn held(&self) -> Option<u64> {
        match self.fetched {
            0 => self.ring.held,
            _ => self.ahead.front().map(|slot| slot.0[0]),
        }
    }

    /// Reports every edge up to `to_ns`.
    pub(super) fn advance(&mut self, to_ns: u64, report: &mut dyn FnMut(OutputEdge)) {
        loop {
            let Position {
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
                if is_high && at_ns > self.reported_ns && at_ns <= to_ns {
                    report(OutputEdge {
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
            self.reported_ns = end_ns;
            for channel in OUTPUTS {
                if self.at.playing.high(channel) > 0 {
                    report(OutputEdge {
                        at_ns: end_ns,
                        channel,
                        high: true,
                    });
                }
            }
        }
        self.reported_ns = self.reported_ns.max(to_ns);
    }

    fn next_round(&mut self, at_ns: u64) {
        self.at.begun_ns = at_ns;
        if self.at.rounds_left > 0 {
            self.at.rounds_left -= 1;
            return;
        }
        self.at.playing = self.at.preloaded;
        self.at.rounds_left = self.at.playing.repeats();
        self.at.preloaded = self.ahead.pop_front().expect("looked ahead as far as that");
        self.fetched += 1;
    }

    /// Computes until when no event can be noticed, at most until `until_ns`. Sets [`FastForward::clear_ns`] to that,
    /// and [`FastForward::end_ns`] if the fast-forward has to end there.
    pub(super) fn look_ahead(&mut self, until_ns: u64, memory: &mut dyn Memory) {
        let mut at = self.at;
        let mut pulses = self.unnoticed;
        let mut next = 0;
        let end_ns = loop {
            let round_ns = at.round_ns(self.tick_ns);
            // The pulse of the present round has been output.
            let rounds = if at.playing.high(3) > 0 {
                pulses.min(at.rounds_left)
            } else {
                at.rounds_left
            };
            let end_ns = at.begun_ns + (rounds + 1) * round_ns;
            if end_ns > until_ns {
                self.clear_ns = until_ns;
                self.end_ns = None;
                return;
            }
            if rounds < at.rounds_left {
                break end_ns;
            }
            if at.playing.high(3) > 0 {
                pulses -= at.rounds_left;
            }
            let fetches = self.fetched + next as u64 + 1;
            let interrupts = self
                .ring
                .to_interrupt
                .is_some_and(|items| fetches * WORDS as u64 >= items);
            // Know one slot more than is fetched: the stream reads an item ahead.
            let known = self.known(next + 1, memory);
            let Some(fetched) = self.ahead.get(next).copied().filter(|_| known) else {
                break end_ns;
            };
            let pulse = u64::from(at.preloaded.high(3) > 0);
            if interrupts || !fetched.is_plain(self.tick_ns) || pulses < pulse {
                break end_ns;
            }
            pulses -= pulse;
            at = Position {
                playing: at.preloaded,
                preloaded: fetched,
                begun_ns: end_ns,
                rounds_left: at.preloaded.repeats(),
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

    fn forward(to_interrupt: Option<u64>) -> (FastForward, Ram) {
        let ring = IdleRing {
            from_memory: true,
            bytes: 2,
            base: 0,
            items: 20,
            next: 5,
            held: Some(NEXT[0]),
            to_interrupt,
            peripheral_at: 0,
        };
        let at = Position {
            playing: PLAYING,
            preloaded: PRELOADED,
            begun_ns: 10_000,
            rounds_left: 1,
        };
        let mut ram = vec![0; 5];
        for _ in 0..3 {
            ram.extend(NEXT);
        }
        let mut forward = FastForward::new(at, ring, 10, 11_000);
        forward.unnoticed = 1_000;
        (forward, Ram(ram))
    }

    fn edges(forward: &mut FastForward, to_ns: u64) -> Vec<(u64, u8, bool)> {
        let mut edges = Vec::new();
        forward.advance(to_ns, &mut |edge| {
            edges.push((edge.at_ns, edge.channel, edge.high));
        });
        edges
    }

    #[test]
    fn rounds_and_slots_follow_each_other() {
        let (mut forward, mut ram) = forward(None);
        forward.look_ahead(45_000, &mut ram);
        assert_eq!((forward.end_ns, forward.clear_ns), (None, 45_000));
        let first = [(12_000, 3, false), (20_000, 3, true), (22_000, 3, false)];
        assert_eq!(edges(&mut forward, 29_999), first);
        assert_eq!((forward.fetched, forward.held()), (0, Some(899)));
        let second = [
            (30_000, 1, true),
            (30_000, 3, true),
            (32_000, 3, false),
            (33_000, 1, false),
        ];
        assert_eq!(edges(&mut forward, 45_000), second);
        assert_eq!((forward.fetched, forward.held()), (1, Some(899)));
        assert_eq!(forward.at.preloaded, Slot(NEXT));
    }

    #[test]
    fn it_ends_with_the_fetch_that_interrupts_and_with_the_end_of_the_ring() {
        let (mut forward, mut ram) = forward(Some(10));
        forward.look_ahead(1_000_000, &mut ram);
        assert_eq!(forward.end_ns, Some(50_000));
        let (mut forward, mut ram) = self::forward(None);
        // The second slot after the next one is the end.
        ram.0[10] = 0;
        forward.look_ahead(1_000_000, &mut ram);
        assert_eq!(forward.end_ns, Some(50_000));
    }

    /// An end beyond the horizon is ignored: the emulator does not stop there.
    #[test]
    fn it_ends_before_a_pulse_that_is_noticed_but_not_beyond_the_horizon() {
        let (mut forward, mut ram) = forward(None);
        forward.unnoticed = 0;
        forward.look_ahead(19_999, &mut ram);
        assert_eq!((forward.end_ns, forward.clear_ns), (None, 19_999));
        forward.look_ahead(20_000, &mut ram);
        assert_eq!(forward.end_ns, Some(20_000));
        forward.unnoticed = 2;
        forward.look_ahead(1_000_000, &mut ram);
        assert_eq!(forward.end_ns, Some(50_000));
    }
}
