//! Turns step times into timer periods: one uninterrupted list for a whole move or run.
//!
//! A period is one round of the step timer, or some equal ones; a pulse, if it has one, sits at its start. The list
//! begins with blank periods up to the first step. Between two strokes comes one [`Item::StrokeEnd`], right behind
//! the last pulse, and one [`Item::Turn`]: DIR may change only after all pulses before it, and must change before all
//! pulses after it. The periods of the pause come before the turn, so that the time line has no gap.

use motion::{
    axis::{Acceleration, Direction},
    run::RunPlan,
    step_times::{BatchLimits, Equal, LONGEST_TAKEN, StepTimes},
    trapezoid::StrokeProfile,
    units::{StepPosition, Steps, Window},
};

/// Longest period of the 16-bit step timer.
pub const MAX_PERIOD: u32 = 65_536;
const _: () = assert!(
    LONGEST_TAKEN <= MAX_PERIOD,
    "steps taken at once fit the timer"
);
/// Shortest piece of a long pause, so that the queue always holds some time.
const MIN_PIECE: u64 = 32_768;
/// Longest piece of a pause that is not halved before a turn, 20 us.
const TURN_PIECE: u64 = 2_048;
/// Period of the last pulse of a stroke: the pulse and the hold time of DIR, 10 us.
const LAST_PULSE: u64 = 1_000;
/// Blank period after the very last pulse, 10 us.
const TAIL: u64 = 1_000;
/// Longest total of repeated rounds, 0.8 ms: a queued period cannot be recalled.
const LONGEST_REPETITION: u32 = 80_000;
/// Longest interval after which a stop still makes the pending step, 100 ms, and ends with a braking step. Without
/// these steps a stop near the end of a stroke would come to rest a step or two before it.
const SLOW_STEP: u64 = 10_000_000;

/// Most rounds that the 8-bit repetition counter can play.
const MOST_EQUAL: u32 = 1 << 8;

/// Equal rounds of the step timer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Period {
    /// Length of a round, 2..=[`MAX_PERIOD`].
    pub ticks: u32,
    /// Rounds after the first one.
    pub repeats: u8,
    /// A step pulse at the start of each.
    pub pulse: bool,
    /// A sync pulse at its start: the first step of a stroke.
    pub sync: bool,
}

impl From<Equal> for Period {
    /// Converts a group from [`Periods::steps`], which holds at most `MOST_EQUAL` steps.
    fn from(steps: Equal) -> Self {
        Self {
            ticks: steps.interval,
            repeats: (steps.steps - 1) as u8,
            pulse: true,
            sync: false,
        }
    }
}

/// An entry of the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Item {
    Period(Period),
    /// The previous period was the last pulse of a stroke, and another stroke follows.
    StrokeEnd {
        /// The stroke, from 0.
        stroke: u32,
    },
    /// The pause is over: change DIR once the last pulse is emitted.
    Turn {
        next: Direction,
    },
    End,
    /// The next step would leave the window: the list ends.
    Guard,
}

/// One stroke, or several with turns between them.
// One exists at a time, in the motion task.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
pub enum Path {
    /// A single stroke.
    Move {
        profile: StrokeProfile,
        direction: Direction,
    },
    /// A whole run, from position 0.
    Run(RunPlan),
    /// The rest of a run that was held.
    Rest {
        plan: RunPlan,
        stroke: u32,
        first: StrokeProfile,
    },
}

impl Path {
    pub fn first_stroke(&self) -> u32 {
        match self {
            Path::Move { .. } | Path::Run(_) => 0,
            Path::Rest { stroke, .. } => *stroke,
        }
    }

    /// Tick of its last step.
    pub fn last_tick(&self) -> u64 {
        let last = match self {
            Path::Move { .. } => 0,
            Path::Run(plan) | Path::Rest { plan, .. } => plan.strokes().saturating_sub(1),
        };
        self.stroke(last)
            .map_or(0, |(start, profile, _)| start + profile.duration().0)
    }

    /// Start, profile and direction of a stroke; none after the last one.
    fn stroke(&self, index: u32) -> Option<(u64, StrokeProfile, Direction)> {
        match self {
            Path::Move { profile, direction } => (index == 0).then_some((0, *profile, *direction)),
            Path::Run(plan) => Some((
                plan.stroke_start(index)?.0,
                *plan.stroke(index)?,
                plan.direction(index)?,
            )),
            Path::Rest {
                plan,
                stroke,
                first,
            } => {
                if index == *stroke {
                    return Some((0, *first, plan.direction(index)?));
                }
                let held = plan.stroke_start(*stroke)?.0 + plan.stroke(*stroke)?.duration().0;
                Some((
                    plan.stroke_start(index)?.0 - held + first.duration().0,
                    *plan.stroke(index)?,
                    plan.direction(index)?,
                ))
            }
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum After {
    Pulse,
    /// The end of a stroke; the pause before the next one follows.
    StrokeEnd {
        pause: u64,
    },
    Turn,
    End,
    Ended,
    Guarded,
}

/// The list of periods of a path, with the position that it leads to.
#[derive(Clone, Debug)]
pub struct Periods {
    path: Path,
    stroke: u32,
    times: StepTimes,
    direction: Direction,
    /// Tick up to which periods have been given out.
    cursor: u64,
    /// Ticks from the cursor to the entry in `after`.
    gap: u64,
    after: After,
    /// A pulse sits at the cursor and goes into the next period.
    pulse: bool,
    sync: bool,
    /// The next period is the last pulse of a stroke: keep it short.
    short: bool,
    stopping: bool,
    position: StepPosition,
    last_step: u64,
    window: Window,
}

impl Periods {
    /// The periods of `path`, begun at `position`. No step leaves `window`, even if the path would. A path without
    /// strokes has no periods.
    pub fn new(path: Path, position: StepPosition, window: Window) -> Option<Self> {
        let stroke = path.first_stroke();
        let (start, profile, direction) = path.stroke(stroke)?;
        let mut times = StepTimes::new(profile);
        let first = times.next()?;
        Some(Self {
            path,
            stroke,
            times,
            direction,
            cursor: 0,
            gap: start + first,
            after: After::Pulse,
            pulse: false,
            sync: true,
            short: false,
            stopping: false,
            position,
            last_step: 0,
            window,
        })
    }

    /// Direction of the stroke in progress.
    pub fn direction(&self) -> Direction {
        self.direction
    }

    /// Position after everything given out so far.
    pub fn position(&self) -> StepPosition {
        self.position
    }

    /// Tick up to which periods have been given out, from the start of the path.
    pub fn cursor(&self) -> u64 {
        self.cursor
    }

    /// Stroke in progress, from 0.
    pub fn stroke(&self) -> u32 {
        self.stroke
    }

    /// Tick of the last step given out so far, 0 before the first.
    pub fn last_step(&self) -> u64 {
        self.last_step
    }

    /// Decelerates to rest after the periods given out so far. Between two strokes, before the first step, or if the
    /// next step is far off and needs no braking, no step follows.
    pub fn stop(&mut self, deceleration: Acceleration) {
        match self.after {
            After::Ended | After::Guarded | After::End => {}
            After::Turn => self.end_here(),
            After::StrokeEnd { .. } => self.stopping = true,
            // The next step is not given out yet: drop it.
            After::Pulse if self.times.emitted().0 <= 1 || self.stands(deceleration) => {
                self.end_here();
            }
            After::Pulse => {
                self.stopping = true;
                self.times.stop(deceleration);
            }
        }
    }

    /// The steps are so slow that the carriage practically rests between two of them.
    fn stands(&self, deceleration: Acceleration) -> bool {
        self.times.interval().0 > SLOW_STEP && self.times.rests_within_a_step(deceleration)
    }

    fn end_here(&mut self) {
        self.stopping = true;
        self.gap = TAIL;
        self.after = After::End;
    }

    pub fn next_item(&mut self) -> Item {
        loop {
            if self.gap > 0 {
                return Item::Period(self.piece());
            }
            match self.after {
                After::Pulse => {
                    let Some(next) = self.next_position() else {
                        self.after = After::Guarded;
                        return Item::Guard;
                    };
                    self.position = next;
                    self.last_step = self.cursor;
                    if self.times.advance() {
                        self.gap = self.times.interval().0;
                    } else {
                        self.plan_turn();
                    }
                    self.pulse = true;
                }
                After::StrokeEnd { pause } => {
                    if self.stopping {
                        self.end_here();
                    } else {
                        self.gap = pause;
                        self.after = After::Turn;
                    }
                    let stroke = self.stroke - 1;
                    return Item::StrokeEnd { stroke };
                }
                After::Turn => {
                    self.after = After::Pulse;
                    self.sync = true;
                    let next = self.direction;
                    return Item::Turn { next };
                }
                After::End => {
                    self.after = After::Ended;
                    return Item::End;
                }
                After::Ended => return Item::End,
                After::Guarded => return Item::Guard,
            }
        }
    }

    /// Where the next step leads, if that is inside the window.
    fn next_position(&self) -> Option<StepPosition> {
        let next = self.position.moved(self.direction, Steps(1))?;
        self.window.contains(next).then_some(next)
    }

    /// Fills `groups` with the next steps of the stroke in progress, and returns how many groups. None begins after
    /// `ticks`. When it returns 0, call [`Periods::next_item`], which handles everything else
    /// and would give the same pulses for these steps.
    pub fn steps(&mut self, groups: &mut [Equal], ticks: u32) -> usize {
        if self.gap > 0 || self.after != After::Pulse || self.sync {
            return 0;
        }
        let limits = BatchLimits {
            steps: self.window.room(self.position, self.direction).0,
            ticks,
            equal: MOST_EQUAL,
            equal_ticks: LONGEST_REPETITION,
        };
        let (before, emitted) = (self.times.tick().0, self.times.emitted().0);
        let filled = self.times.batch(&limits, groups);
        if filled > 0 {
            // Inside the window, so within the range of positions.
            let steps = self.times.emitted().0 - emitted;
            self.position.0 += steps as i32 * self.direction.sign();
            self.cursor += self.times.tick().0 - before;
            self.last_step = self.cursor - self.times.interval().0;
        }
        filled
    }

    /// Plans what follows the last pulse of a stroke: the turn, or the end. The pulse is at the cursor.
    fn plan_turn(&mut self) {
        self.short = true;
        let next = if self.stopping {
            None
        } else {
            self.path.stroke(self.stroke + 1)
        };
        let Some((start, profile, direction)) = next else {
            self.gap = LAST_PULSE + TAIL;
            self.after = After::End;
            return;
        };
        let mut times = StepTimes::new(profile);
        // A profile has at least one step.
        let first = times.next().unwrap_or(0);
        self.gap = LAST_PULSE;
        // Does not wrap: a turnaround is far longer than the last pulse.
        let pause = start + first - self.cursor - LAST_PULSE;
        self.after = After::StrokeEnd { pause };
        (self.stroke, self.direction, self.times) = (self.stroke + 1, direction, times);
    }

    /// The next piece of a gap, with the pulse at its start if there is one.
    fn piece(&mut self) -> Period {
        let turn_pending = self.after == After::Turn;
        let ticks = if self.short {
            LAST_PULSE.min(self.gap)
        } else if turn_pending && self.gap > TURN_PIECE && self.gap <= u64::from(MAX_PERIOD) {
            // The ring cannot take a turn once its last three blank periods play, so these have to be short: that
            // leaves 350 us of the shortest turn, 400 us.
            self.gap / 2
        } else {
            part(self.gap)
        };
        let period = Period {
            ticks: ticks as u32,
            repeats: 0,
            pulse: self.pulse,
            sync: self.pulse && self.sync,
        };
        self.short = false;
        if self.pulse {
            self.sync = false;
        }
        self.pulse = false;
        self.gap -= ticks;
        self.cursor += ticks;
        period
    }
}

/// The first piece of a pause, which may be longer than the timer can count.
fn part(gap: u64) -> u64 {
    let max = u64::from(MAX_PERIOD);
    if gap <= max {
        gap
    } else if gap >= max + MIN_PIECE {
        max
    } else {
        gap / 2
    }
}
