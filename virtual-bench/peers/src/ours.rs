//! Our own step times, called one by one and in batches.

use motion::step_times::{Equal, Share, StepTimes};
use motion::trapezoid::StrokeProfile;
use motion::units::{Steps, Ticks};

use crate::{Method, Move};

/// Most groups of a batch, as the image asks for them.
pub const BATCH: usize = 64;
/// Limits of a batch, as in the image: at most 8 ms, equal steps as the repetition counter can play them within 0.8 ms.
const SHARE: Share = Share {
    steps: u32::MAX,
    ticks: 800_000,
    equal: 1 << 8,
    equal_ticks: 80_000,
};

fn times(order: &Move) -> Option<StepTimes> {
    let ticks = |value: u32| Ticks(value.into());
    let (duration, ramp) = (ticks(order.duration_ticks), ticks(order.ramp_ticks));
    let profile = StrokeProfile::from_parts(Steps(order.steps), duration, ramp);
    profile.ok().map(StepTimes::new)
}

/// One step at a time.
pub struct Single(StepTimes);

impl Method for Single {
    fn new(order: &Move) -> Option<Self> {
        times(order).map(Self)
    }

    #[inline(never)]
    fn next_interval(&mut self) -> Option<u32> {
        self.0.advance().then(|| self.0.interval().0 as u32)
    }
}

/// Groups of equal steps, as the image fills its ring.
pub struct Batches {
    times: StepTimes,
    groups: [Equal; BATCH],
}

impl Batches {
    /// Gets ready for a move; `None` if its numbers do not fit.
    #[must_use]
    pub fn new(order: &Move) -> Option<Self> {
        Some(Self {
            times: times(order)?,
            groups: [Equal::default(); BATCH],
        })
    }

    /// The next groups; empty at the end.
    #[inline(never)]
    pub fn next_groups(&mut self) -> &[Equal] {
        let mut count = self.times.batch(&SHARE, &mut self.groups);
        // Some steps are left to `advance`.
        if count == 0 && self.times.advance() {
            self.groups[0] = Equal {
                interval: self.times.interval().0 as u32,
                steps: 1,
            };
            count = 1;
        }
        &self.groups[..count]
    }
}
