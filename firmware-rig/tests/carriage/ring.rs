//! A step ring in virtual time. It plays what the real one plays, round by round, and nothing faster.

use firmware_rig::{
    execution::{LoopOpen, Ring, Underrun},
    periods::Period,
};
use motion::{axis::Direction, units::StepPosition};
use std::collections::VecDeque;

/// How much is queued ahead.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ahead {
    /// Nothing: every period is asked for when it is due, so that a test can act between any two.
    Nothing,
    /// As on the board: up to 124 slots, of which one plays and one is prepared.
    Slots,
}

const SLOTS: usize = 124;

/// The ring, the counter and DIR.
#[derive(Debug)]
pub struct Slots {
    pub ahead: Ahead,
    /// The first one plays.
    periods: VecDeque<Period>,
    /// Rounds of the first period that have been played.
    played: u8,
    running: bool,
    ticks: u64,
    pulses: u32,
    pub direction: Direction,
    /// The read-back counter, if its jumper is there.
    pub counted: i32,
    pub loop_open: bool,
    pub armed: bool,
    /// Pulses that were queued and cut, since the start.
    pub cut: u64,
    /// Periods that were pushed when the reader was too near.
    pub underruns: u32,
}

impl Slots {
    pub fn new() -> Self {
        Self {
            ahead: Ahead::Nothing,
            periods: VecDeque::new(),
            played: 0,
            running: false,
            ticks: 0,
            pulses: 0,
            direction: Direction::Home,
            counted: 0,
            loop_open: false,
            armed: false,
            cut: 0,
            underruns: 0,
        }
    }

    pub fn is_empty(&self) -> bool {
        self.periods.is_empty()
    }

    /// Plays the next round: its ticks, and whether it begins with a pulse.
    pub fn play(&mut self) -> Option<(u32, bool)> {
        let period = *self.periods.front().filter(|_| self.running)?;
        if self.played == period.repeats {
            self.periods.pop_front();
            self.played = 0;
            let rounds = u32::from(period.repeats) + 1;
            self.ticks -= u64::from(period.ticks * rounds);
            self.pulses -= if period.pulse { rounds } else { 0 };
        } else {
            self.played += 1;
        }
        Some((period.ticks, period.pulse && self.armed))
    }

    /// Rounds of the period in progress that come whatever is ordered, unless they are cut.
    pub fn rounds_left(&self) -> u64 {
        match self.periods.front() {
            Some(period) if self.played > 0 => u64::from(period.repeats - self.played) + 1,
            _ => 0,
        }
    }

    fn pulses_left(&self) -> u64 {
        let played = match self.periods.front() {
            Some(period) if period.pulse => u64::from(self.played),
            _ => 0,
        };
        u64::from(self.pulses) - played
    }
}

impl Ring for Slots {
    fn clear(&mut self, _: u16) {
        self.halt();
    }

    fn push(&mut self, period: Period) -> Result<(), Underrun> {
        if self.ahead == Ahead::Slots && self.running && self.periods.len() < 4 {
            self.underruns += 1;
            return Err(Underrun);
        }
        let rounds = u32::from(period.repeats) + 1;
        self.ticks += u64::from(period.ticks * rounds);
        self.pulses += if period.pulse { rounds } else { 0 };
        self.periods.push_back(period);
        Ok(())
    }

    fn has_room(&self) -> bool {
        match self.ahead {
            Ahead::Nothing => self.periods.is_empty(),
            Ahead::Slots => self.periods.len() < SLOTS + 2,
        }
    }

    fn waiting(&self) -> u32 {
        match self.ahead {
            // Never short of anything.
            Ahead::Nothing => 60,
            Ahead::Slots => self.periods.len().saturating_sub(2) as u32,
        }
    }

    fn lead(&self) -> u32 {
        match self.ahead {
            Ahead::Nothing => 0,
            Ahead::Slots => self.ticks as u32,
        }
    }

    fn waiting_pulses(&self) -> u32 {
        self.pulses
    }

    fn has_played_out(&self) -> bool {
        self.periods.is_empty()
    }

    fn update(&mut self) {}

    fn start(&mut self) -> Result<(), LoopOpen> {
        if self.loop_open {
            self.halt();
            return Err(LoopOpen);
        }
        self.armed = true;
        self.running = true;
        Ok(())
    }

    fn cut(&mut self) {
        self.armed = false;
    }

    fn halt(&mut self) {
        self.cut += self.pulses_left();
        self.periods.clear();
        (self.played, self.ticks, self.pulses) = (0, 0, 0);
        (self.armed, self.running) = (false, false);
    }

    fn enable_driver(&mut self) {}

    fn set_direction(&mut self, direction: Direction) {
        assert!(
            !self.running || self.pulses == 0,
            "DIR changes while pulses wait"
        );
        self.direction = direction;
    }

    fn counted(&self) -> StepPosition {
        StepPosition(self.counted)
    }
}
