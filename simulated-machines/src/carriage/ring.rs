//! A step ring in virtual time: plays queued periods round by round, as the board's timer and DMA do.

use firmware_rig::{
    execution::{Ring, StartError, Underrun},
    periods::Period,
};
use motion::{
    axis::Direction,
    edge_timing::{EdgeTiming, Timed},
    slots::SLOTS,
    step_times::Equal,
    timeline::Timeline,
    units::StepPosition,
};
use std::{collections::VecDeque, sync::atomic::AtomicU32};

/// How far the ring queues ahead.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Ahead {
    /// No period ahead: asks for each one when it is due, so that a test can act between any two.
    #[default]
    Nothing,
    /// By slots, as on the board.
    Slots,
}

/// Slots that stay empty: they keep the end mark away from the DMA's read position.
const RESERVED: u64 = 4;
/// Slots that the hardware has already taken: one plays, one is preloaded.
const TAKEN: u64 = 2;

/// Ring, read-back counter and DIR.
#[derive(Debug, Default)]
pub struct Slots {
    pub ahead: Ahead,
    /// Queued periods. The first one is playing if the ring runs.
    periods: VecDeque<Period>,
    /// Rounds of the first period that have begun.
    begun: u32,
    pub running: bool,
    /// Ticks of all queued periods, counting the first one in full.
    ticks: u64,
    pulses: u32,
    pub direction: Direction,
    /// The read-back counter.
    pub counted: i32,
    pub loop_open: bool,
    pub armed: bool,
    /// Width of a step pulse.
    pub pulse_ticks: u16,
    pub driver_on: bool,
    /// Pulses that were queued and then cut, since the start.
    pub cut: u64,
    /// Pulses that were queued after the playing period when the ring was halted.
    queued_at_halt: u32,
    /// The jumper to the capture input is missing.
    pub capture_cut: bool,
    captured: Vec<AtomicU32>,
    line: Timeline,
    timing: EdgeTiming,
}

/// The start of a round of the timer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Round {
    pub ticks: u32,
    /// A pulse leaves the pin at the start of this round.
    pub pulse: bool,
    pub sync: bool,
}

impl Slots {
    /// Captures a pulse at the pin, if the jumper is fitted.
    pub fn capture(&mut self, at: u64) {
        if !self.capture_cut {
            self.captured.push(AtomicU32::new(at as u32));
        }
    }

    /// A round is playing or ready to play.
    pub fn plays(&self) -> bool {
        self.running && !self.periods.is_empty()
    }

    pub fn is_empty(&self) -> bool {
        self.periods.is_empty()
    }

    /// Begins the next round, once the previous one has ended; none if nothing is left to play.
    pub fn begin_round(&mut self) -> Option<Round> {
        if !self.running {
            return None;
        }
        self.end_period();
        let period = *self.periods.front()?;
        self.begun += 1;
        Some(Round {
            ticks: period.ticks,
            pulse: period.pulse && self.armed,
            sync: period.sync && self.armed,
        })
    }

    /// Removes the first period if its last round has begun. Call this when that round has ended.
    pub fn end_period(&mut self) {
        let Some(period) = self.periods.front().copied() else {
            return;
        };
        let rounds = u32::from(period.repeats) + 1;
        if self.begun < rounds {
            return;
        }
        self.periods.pop_front();
        self.begun = 0;
        self.ticks -= u64::from(period.ticks) * u64::from(rounds);
        self.pulses -= if period.pulse { rounds } else { 0 };
    }

    /// Remaining rounds of the current period. They will play whatever is ordered, unless they are cut.
    pub fn rounds_remaining(&self) -> u64 {
        match self.periods.front() {
            Some(period) if self.begun > 0 => u64::from(u32::from(period.repeats) + 1 - self.begun),
            _ => 0,
        }
    }

    /// Queued pulses that are not emitted yet.
    pub fn pulses_remaining(&self) -> u64 {
        let begun = match self.periods.front() {
            Some(period) if period.pulse => self.begun,
            _ => 0,
        };
        u64::from(self.pulses - begun)
    }

    /// Appends periods that become valid together. As on the board, they belong to the path even if they are too late.
    fn append(&mut self, periods: &[Period]) -> Result<(), Underrun> {
        let too_late = self.ahead == Ahead::Slots && self.running && self.queue() < 2;
        for period in periods {
            self.note(*period);
        }
        if too_late {
            return Err(Underrun);
        }
        for &period in periods {
            assert!(self.room() > 0, "a slot that waits is overwritten");
            let rounds = u32::from(period.repeats) + 1;
            self.ticks += u64::from(period.ticks) * u64::from(rounds);
            self.pulses += if period.pulse { rounds } else { 0 };
            self.periods.push_back(period);
        }
        Ok(())
    }

    /// Notes a period that was given out.
    fn note(&mut self, period: Period) {
        let rounds = u32::from(period.repeats) + 1;
        if period.pulse {
            self.line.extend(&[Equal {
                interval: period.ticks,
                steps: rounds,
            }]);
        } else {
            self.line.extend_by_pause(period.ticks);
        }
    }

    /// Slots that wait to be played; negative while the last one plays and after it.
    fn queue(&self) -> i64 {
        let taken = if self.running { TAKEN } else { 0 };
        self.periods.len() as i64 - taken as i64
    }
}

impl Ring for Slots {
    fn clear(&mut self, pulse_ticks: u16) {
        self.halt();
        self.pulse_ticks = pulse_ticks;
        self.captured.clear();
        self.line.clear();
        self.timing.clear();
    }

    fn push(&mut self, period: Period) -> Result<(), Underrun> {
        self.append(&[period])
    }

    fn push_steps(&mut self, groups: &[Equal]) -> Result<(), Underrun> {
        assert!(!groups.is_empty());
        let periods: Vec<_> = groups.iter().copied().map(Period::from).collect();
        self.append(&periods)
    }

    fn room(&self) -> u32 {
        match self.ahead {
            Ahead::Nothing => u32::from(self.periods.is_empty()),
            Ahead::Slots => (SLOTS as i64 - RESERVED as i64 - self.queue()).max(0) as u32,
        }
    }

    fn waiting(&self) -> u32 {
        match self.ahead {
            Ahead::Nothing => 100, // never short of anything, and never full
            Ahead::Slots => self.queue().max(0) as u32,
        }
    }

    fn lead(&self) -> u32 {
        match (self.ahead, self.periods.front()) {
            (Ahead::Slots, Some(first)) if self.running => {
                let first = u64::from(first.ticks) * (u64::from(first.repeats) + 1);
                (self.ticks - first) as u32
            }
            (Ahead::Slots, _) => self.ticks as u32,
            (Ahead::Nothing, _) => 0,
        }
    }

    fn waiting_pulses(&self) -> u32 {
        self.pulses
    }

    fn queued_pulses(&self) -> u32 {
        self.queued_at_halt
    }

    fn ticks_since_last_pulse(&self, unemitted: u32) -> Option<u32> {
        self.line.ticks_since_last_pulse(unemitted)
    }

    fn has_played_out(&self) -> bool {
        self.running && self.periods.is_empty()
    }

    fn update(&mut self) {}

    fn start(&mut self) -> Result<(), StartError> {
        if self.loop_open {
            self.halt();
            return Err(StartError::LoopOpen);
        }
        (self.armed, self.running) = (true, true);
        Ok(())
    }

    fn halt(&mut self) {
        self.cut += self.pulses_remaining();
        let playing = match self.periods.front() {
            Some(period) if period.pulse && self.running => u32::from(period.repeats) + 1,
            _ => 0,
        };
        self.queued_at_halt = self.pulses - playing;
        self.periods.clear();
        (self.begun, self.ticks, self.pulses) = (0, 0, 0);
        (self.armed, self.running) = (false, false);
    }

    fn enable_driver(&mut self) {
        self.driver_on = true;
    }

    fn set_direction(&mut self, direction: Direction) {
        assert!(
            !self.running || self.pulses == 0,
            "DIR changes while a pulse waits"
        );
        self.direction = direction;
    }

    fn counted(&self) -> StepPosition {
        StepPosition(self.counted)
    }

    fn time_edges(&mut self, at_most: u32) -> bool {
        let count = self.captured.len().min(at_most as usize);
        self.timing.compare(&self.line, &self.captured[..count]);
        self.captured.drain(..count);
        self.captured.is_empty()
    }

    fn timed(&self, whole: bool) -> Timed {
        match whole {
            true => self.timing.timed_whole(&self.line),
            false => self.timing.timed(),
        }
    }
}
