//! The tick of every step of a stroke, nearest to the exact profile, without drift.
//!
//! The ramps follow t_k = sqrt(k N / n) by an exact remainder: for the nearest tick t,
//! (t - 1/2)^2 <= k N / n < (t + 1/2)^2, which in integers is
//!
//! ```text
//! 0 <= s < 2 n t    with    s = k N - n (t^2 - t) - ceil(n / 4)
//! ```
//!
//! Each step adds N, predicts its interval from the last interval D as D - 2 D / (4 k - 3), and then corrects the tick
//! by one while s is out of range, so no error accumulates. The deceleration is the same sequence in reverse, counted
//! back from the end. The cruise is Bresenham's line with denominator 2 n. A square root replaces the prediction near
//! rest, where the prediction is poor, and for slow steps, where there is time for it.

use crate::axis::Acceleration;
use crate::trapezoid::StrokeProfile;
use crate::units::{Steps, Ticks};

/// Number of steps from rest that use a square root, because the prediction is poor there.
const WARM_UP: u32 = 32;

/// After an interval of this many ticks (640 us) or more, a step uses a square root. A step predicted from a shorter
/// interval follows within [`LONGEST_TAKEN`].
const SLOW_INTERVAL: u32 = 64_000;

/// Longest interval in [`StepTimes::batch`], ticks: 655 us, the range of a 16-bit timer.
pub const LONGEST_TAKEN: u32 = 1 << 16;

/// Every stop takes fewer ticks than this (21.5 s), however low its deceleration.
const LONGEST_STOP: u64 = 1 << 31;

/// Iterator over the tick of each step, 1..=n, counted from the start of the stroke.
///
/// After any step, [`StepTimes::stop`] replaces the rest by a braking ramp. There are never more
/// steps than the profile has.
#[derive(Clone, Debug)]
pub struct StepTimes {
    phase: Phase,
    /// Steps emitted so far.
    emitted: u32,
    /// Steps emitted when the phase ends.
    phase_end: u32,
    /// Ticks between the last two steps.
    interval: u32,
    /// The tick of the last step.
    tick: u64,
    ramp: Ramp,
    cruise: Cruise,
    /// Steps emitted when at rest: the profile's, or fewer after a stop.
    last: u32,
    /// The tick of rest, from which the deceleration is counted back.
    end: u64,
    profile: StrokeProfile,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Accelerate,
    Cruise,
    Decelerate,
}

/// A group of steps with equal intervals.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Equal {
    /// Ticks from each step to the next.
    pub interval: u32,
    pub steps: u32,
}

/// Limits of the steps that [`StepTimes::batch`] takes.
#[derive(Clone, Copy, Debug)]
pub struct BatchLimits {
    /// Maximum steps.
    pub steps: u32,
    /// No further group begins once the groups take this many ticks together.
    pub ticks: u32,
    /// Maximum steps of one group.
    pub equal: u32,
    /// Maximum ticks of one group with more than one step.
    pub equal_ticks: u32,
}

impl BatchLimits {
    const ONE: Self = Self {
        steps: 1,
        ticks: 1,
        equal: 1,
        equal_ticks: 0,
    };
}

#[derive(Clone, Copy, Debug, Default)]
struct Taken {
    groups: usize,
    steps: u32,
    ticks: u32,
}

/// The rest of a stroke after a stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stop {
    /// Steps still to come.
    pub steps: Steps,
    /// The tick of the final step, counted from the start of the stroke.
    pub rest: Ticks,
}

impl StepTimes {
    /// The steps of a profile from its start.
    #[must_use]
    pub fn new(profile: StrokeProfile) -> Self {
        Self {
            phase: Phase::Accelerate,
            emitted: 0,
            phase_end: profile.ramp_steps().0,
            interval: 0,
            tick: 0,
            ramp: Ramp::new(profile.steps().0, profile.square()),
            cruise: Cruise::default(),
            last: profile.steps().0,
            end: profile.duration().0,
            profile,
        }
    }

    /// Steps emitted so far: the number of the last step.
    #[must_use]
    pub const fn emitted(&self) -> Steps {
        Steps(self.emitted)
    }

    /// Steps still to come until rest, braking included.
    #[must_use]
    pub const fn remaining(&self) -> Steps {
        Steps(self.last - self.emitted)
    }

    /// The tick of the last step, 0 before the first.
    #[must_use]
    pub const fn tick(&self) -> Ticks {
        Ticks(self.tick)
    }

    /// Ticks between the last two steps, or from the start to the first step; 0 before the first.
    #[must_use]
    pub const fn interval(&self) -> Ticks {
        Ticks(self.interval as u64)
    }

    /// The tick of the final step.
    #[must_use]
    pub const fn rest(&self) -> Ticks {
        Ticks(self.end)
    }

    /// Whether this deceleration brings the speed of the last step to rest within one step.
    #[must_use]
    pub fn rests_within_a_step(&self, deceleration: Acceleration) -> bool {
        deceleration.steps_to_rest(self.interval) <= 1
    }

    /// Brakes from the speed of the last step to rest on a whole step, with at most this deceleration. The iterator
    /// then yields the steps of the braking ramp.
    ///
    /// From an interval d the ramp takes m = ceil(v^2 / 2a) steps and 2 m d ticks, so that its first interval is not
    /// shorter than d. If the stroke's own final ramp needs no more steps than that, the stroke ends as planned. The
    /// stop is harder than requested if it would otherwise leave the stroke or take 21.5 s or more; the result shows
    /// this. Before the first step there is nothing to brake, and no step follows.
    pub fn stop(&mut self, deceleration: Acceleration) -> Stop {
        let remaining = self.last - self.emitted;
        if self.interval == 0 {
            self.brake(0);
        } else {
            let wanted = deceleration.steps_to_rest(self.interval);
            // At least 1 while steps remain: only the last interval exceeds MAX_INTERVAL.
            let longest = (LONGEST_STOP - 1) / (2 * u64::from(self.interval));
            let steps = wanted.min(u128::from(remaining)).min(u128::from(longest)) as u32;
            // Also true after the last step, when no steps remain.
            let soon_at_rest = self.phase == Phase::Decelerate && remaining <= steps;
            if !soon_at_rest {
                self.brake(steps);
            }
        }
        Stop {
            steps: self.remaining(),
            rest: self.rest(),
        }
    }

    /// Starts a ramp down of `steps` from the last interval d: with j steps to go it is
    /// 2 d sqrt(j steps) before rest.
    fn brake(&mut self, steps: u32) {
        let interval = u64::from(self.interval);
        let ticks = 2 * u64::from(steps) * interval;
        self.phase = Phase::Decelerate;
        self.last = self.emitted + steps;
        self.phase_end = self.last;
        self.end = self.tick + ticks;
        self.ramp = Ramp::new(1, 2 * interval * ticks);
        self.ramp.seed(steps);
    }

    /// Takes the next step; [`StepTimes::tick`] and [`StepTimes::interval`] then return its times. False at rest.
    pub fn advance(&mut self) -> bool {
        if self.emitted == self.phase_end && self.turn().is_none() {
            return false;
        }
        let tick = match self.phase {
            Phase::Accelerate => u64::from(self.ramp.up()),
            Phase::Cruise => self.cruise.advance(),
            Phase::Decelerate => self.end - u64::from(self.ramp.down()),
        };
        self.emitted += 1;
        // Fits: no interval of a profile or a stop is 2^32 ticks.
        self.interval = (tick - self.tick) as u32;
        self.tick = tick;
        true
    }

    /// Takes the next steps of this phase as groups of equal ones, and returns the number of groups. The ticks are the
    /// same as from [`StepTimes::advance`], one by one. Some steps are left to `advance`: the first of a phase, those
    /// that need a square root, and those further apart than [`LONGEST_TAKEN`].
    pub fn batch(&mut self, limits: &BatchLimits, groups: &mut [Equal]) -> usize {
        let most = limits.steps.min(self.phase_end - self.emitted);
        let taken = match self.phase {
            Phase::Accelerate => self.ramp.climb_all(limits, most, groups),
            Phase::Cruise => self.cruise.batch(limits, most, groups),
            Phase::Decelerate => self.ramp.descend_all(limits, most, groups),
        };
        if taken.groups > 0 {
            self.emitted += taken.steps;
            self.tick += u64::from(taken.ticks);
            self.interval = groups[taken.groups - 1].interval;
        }
        taken.groups
    }

    /// Enters the next phase that has steps; `None` at rest.
    #[inline(never)]
    fn turn(&mut self) -> Option<()> {
        while self.emitted == self.phase_end {
            match self.phase {
                Phase::Accelerate => {
                    self.phase = Phase::Cruise;
                    self.cruise = Cruise::new(&self.profile, self.emitted);
                    // Step n - ramp_steps is the first of the deceleration, the last one is
                    // exactly at T.
                    let down = self.last - self.profile.ramp_steps().0;
                    self.phase_end = (down - 1).max(self.emitted);
                }
                Phase::Cruise => {
                    self.phase = Phase::Decelerate;
                    self.phase_end = self.last;
                    self.ramp.seed(self.last - self.emitted);
                }
                Phase::Decelerate => return None,
            }
        }
        Some(())
    }
}

impl Iterator for StepTimes {
    type Item = u64;

    #[inline]
    fn next(&mut self) -> Option<u64> {
        self.advance().then_some(self.tick)
    }
}

/// The nearest tick to t_k = sqrt(k N / n), one step up or down at a time.
///
/// Bounds, from [`StrokeProfile::from_parts`]: N < 2^62, 2 n t < 2^60, t < 2^31, n <= 2^25; so
/// N + 2 n t and the products below fit `i64`.
#[derive(Clone, Debug)]
struct Ramp {
    steps: u32,
    k: u32,
    tick: u32,
    interval: u32,
    square: i64,
    /// The remainder s, see the module's documentation.
    rest: i64,
}

impl Ramp {
    fn new(steps: u32, square: u64) -> Self {
        Self {
            steps,
            k: 0,
            tick: 0,
            interval: SLOW_INTERVAL,
            square: square as i64,
            rest: -i64::from(steps.div_ceil(4)),
        }
    }

    /// Goes to step `k` by a square root. The next step has no interval to predict from, so it uses a square root too.
    #[inline(never)]
    fn seed(&mut self, k: u32) {
        let (n, square) = (u64::from(self.steps), self.square as u64);
        let (whole, part) = (square / n, u64::from(k) * (square % n));
        let (x, fraction) = (u64::from(k) * whole + part / n, part % n);
        // x <= t^2 < 2^62.
        let tick = (4 * x + 4 * fraction / n).isqrt().div_ceil(2);
        self.rest = n as i64 * (x as i64 - (tick * tick) as i64 + tick as i64) + fraction as i64
            - i64::from(self.steps.div_ceil(4));
        self.k = k;
        self.tick = tick as u32;
        self.interval = SLOW_INTERVAL;
    }

    /// Whether step `k` is predicted from the last interval; otherwise it uses a square root.
    #[inline(always)]
    fn predictable(&self, k: u32) -> bool {
        k > WARM_UP && self.interval < SLOW_INTERVAL
    }

    fn up(&mut self) -> u32 {
        if self
            .climb_all(&BatchLimits::ONE, 1, &mut [Equal::default()])
            .steps
            == 0
        {
            let before = self.tick;
            self.seed(self.k + 1);
            self.interval = self.tick - before;
        }
        self.tick
    }

    fn down(&mut self) -> u32 {
        if self
            .descend_all(&BatchLimits::ONE, 1, &mut [Equal::default()])
            .steps
            == 0
        {
            let before = self.tick;
            self.seed(self.k - 1);
            self.interval = before - self.tick;
        }
        self.tick
    }

    /// Takes up to `most` steps as [`StepTimes::batch`] does, until one needs a square root. Each step is one group.
    // Not inlined, so that its state stays in registers.
    #[inline(never)]
    fn climb_all(&mut self, limits: &BatchLimits, most: u32, groups: &mut [Equal]) -> Taken {
        // On the way up intervals shrink and k grows, so if the first step is predictable, all are.
        if !self.predictable(self.k + 1) {
            return Taken::default();
        }
        self.batch(limits, most, groups, |ramp| {
            let (before, k) = (ramp.tick, ramp.k + 1);
            let interval = shorter(ramp.interval, k);
            let passed = product(interval, 2 * before + interval - 1);
            ramp.settle(k, before + interval, ramp.square - ramp.times_steps(passed));
            ramp.interval = ramp.tick - before;
            true
        })
    }

    /// Like [`Ramp::climb_all`], on the way down.
    #[inline(never)]
    fn descend_all(&mut self, limits: &BatchLimits, most: u32, groups: &mut [Equal]) -> Taken {
        // The last steps to rest use square roots.
        let most = most.min(self.k.saturating_sub(WARM_UP + 1));
        self.batch(limits, most, groups, |ramp| {
            if ramp.interval >= SLOW_INTERVAL {
                return false;
            }
            let (before, k) = (ramp.tick, ramp.k - 1);
            let interval = longer(ramp.interval, k);
            let passed = product(interval, 2 * before - interval - 1);
            ramp.settle(k, before - interval, ramp.times_steps(passed) - ramp.square);
            ramp.interval = before - ramp.tick;
            true
        })
    }

    #[inline(always)]
    fn batch(
        &mut self,
        limits: &BatchLimits,
        most: u32,
        groups: &mut [Equal],
        step: impl Fn(&mut Self) -> bool,
    ) -> Taken {
        // Copy the fields one by one, so that they can stay in registers.
        let mut ramp = Self { ..*self };
        let (mut ticks, mut count) = (0, 0);
        let most = (most as usize).min(groups.len());
        for group in &mut groups[..most] {
            if ticks >= limits.ticks || !step(&mut ramp) {
                break;
            }
            *group = Equal {
                interval: ramp.interval,
                steps: 1,
            };
            ticks += ramp.interval;
            count += 1;
        }
        *self = ramp;
        Taken {
            groups: count as usize,
            steps: count,
            ticks,
        }
    }

    /// Corrects the predicted tick until it is the nearest one.
    // Runs once per step.
    #[inline(always)]
    fn settle(&mut self, k: u32, mut tick: u32, change: i64) {
        let double = 2 * self.steps;
        let mut rest = self.rest + change;
        while rest.is_negative() {
            tick -= 1;
            rest += product(double, tick) as i64;
        }
        loop {
            let range = product(double, tick) as i64;
            if rest < range {
                break;
            }
            rest -= range;
            tick += 1;
        }
        self.k = k;
        self.tick = tick;
        self.rest = rest;
    }

    /// `steps * passed`, which is within a few 2 n t of N and therefore fits. It wraps only to save the check: a
    /// checked 64-bit product would cost more than the rest of the step.
    #[inline]
    fn times_steps(&self, passed: u64) -> i64 {
        u64::from(self.steps).wrapping_mul(passed) as i64
    }
}

/// The interval that ends with step `k` of a ramp up, predicted from the one before it; off by at most a tick or two.
#[inline(always)]
fn shorter(interval: u32, k: u32) -> u32 {
    interval - 2 * interval / (4 * k - 3)
}

/// The interval that ends with step `k` of a ramp down, predicted from the one before it.
#[inline(always)]
fn longer(interval: u32, k: u32) -> u32 {
    interval + 2 * interval / (4 * k + 3)
}

#[inline]
fn product(a: u32, b: u32) -> u64 {
    u64::from(a) * u64::from(b)
}

/// The nearest tick to t_k with 2 n t_k = n r + 2 k (T - r): a line in integers.
#[derive(Clone, Debug, Default)]
struct Cruise {
    tick: u64,
    /// Whole ticks per step.
    interval: u32,
    /// Fraction of a tick per step, in 1 / (2 n).
    slope: u32,
    /// Fraction of a tick carried over to the next step, in 1 / (2 n).
    carry: u32,
    /// 2 n.
    double: u32,
}

impl Cruise {
    /// The line after step `k`, which has been emitted.
    fn new(profile: &StrokeProfile, k: u32) -> Self {
        let n = u64::from(profile.steps().0);
        let span = profile.span().0;
        let line = n * profile.ramp().0 + 2 * u64::from(k) * span + n;
        Self {
            tick: line / (2 * n),
            // Above MAX_INTERVAL only if no step is in cruise.
            interval: u32::try_from(span / n).unwrap_or(u32::MAX),
            slope: (2 * (span % n)) as u32,
            carry: (line % (2 * n)) as u32,
            double: 2 * profile.steps().0,
        }
    }

    #[inline]
    fn advance(&mut self) -> u64 {
        self.carry += self.slope;
        let mut interval = self.interval;
        if self.carry >= self.double {
            self.carry -= self.double;
            interval += 1;
        }
        self.tick += u64::from(interval);
        self.tick
    }

    /// Takes up to `most` steps as [`StepTimes::batch`] does.
    ///
    /// Each step adds the slope to the carry. A step that is one tick longer subtracts 2 n from the carry. A step
    /// therefore costs an addition, a comparison and a subtraction, and a division finds how many equal steps follow.
    #[inline(never)]
    fn batch(&mut self, limits: &BatchLimits, most: u32, groups: &mut [Equal]) -> Taken {
        let Self {
            interval,
            slope,
            double,
            mut carry,
            ..
        } = *self;
        if interval >= LONGEST_TAKEN {
            return Taken::default();
        }
        let back = double - slope;
        let most_alike = limits.equal.min(limits.equal_ticks / (interval + 1)).max(1) - 1;
        // No group begins after these steps. Counting them costs less than adding up the ticks.
        let begun = most.min(limits.ticks.div_ceil(interval + 1));
        let (mut steps, mut longer) = (0, 0);
        let most_groups = groups.len();
        let mut free = groups.iter_mut();
        while steps < begun {
            let Some(group) = free.next() else {
                break;
            };
            // Count the first step of the group, then the equal ones that follow it.
            steps += 1;
            let mut alike = 0;
            let mut ticks = interval;
            if carry < back {
                carry += slope;
                if carry < back {
                    // Each equal step adds a slope to the carry, as long as the carry is below `back`.
                    let more = (back - 1 - carry)
                        .checked_div(slope)
                        .map_or(u32::MAX, |more| more + 1);
                    alike = more.min(most_alike).min(most - steps);
                    carry += alike * slope;
                }
            } else {
                ticks += 1;
                carry -= back;
                if carry >= back {
                    alike = (carry / back).min(most_alike).min(most - steps);
                    carry -= alike * back;
                }
                longer += 1 + alike;
            }
            steps += alike;
            *group = Equal {
                interval: ticks,
                steps: 1 + alike,
            };
        }
        let count = most_groups - free.len();
        let ticks = interval * steps + longer;
        self.carry = carry;
        self.tick += u64::from(ticks);
        Taken {
            groups: count,
            steps,
            ticks,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// With n = 4 and N = m^2, step k = j^2 is at m j / 2: for odd m and j exactly between two ticks.
    #[test]
    fn half_a_tick_is_rounded_up() {
        let mut predicted = 0;
        for m in [100_001_u32, 1_000_001, 3_333_333] {
            for j in (7..99).step_by(2) {
                let (k, expected) = (j * j, (u64::from(m * j).div_ceil(2)) as u32);
                let mut ramp = Ramp::new(4, u64::from(m).pow(2));
                ramp.seed(k);
                assert_eq!(ramp.tick, expected);
                ramp.seed(k - 2);
                ramp.up();
                predicted += u32::from(ramp.predictable(k));
                assert_eq!(ramp.up(), expected);
                ramp.seed(k + 2);
                ramp.down();
                assert_eq!(ramp.down(), expected);
            }
        }
        assert!(predicted > 100);
    }
}
