//! A position of a run at which an actuation begins, and the record of its timing.

use client::decimal;
use protocol::rig::Run;
use serde::{Deserialize, Serialize};

/// A position of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Cue {
    /// The cycle, from 1.
    pub cycle: u16,
    /// Position that the carriage passes on its way away from home, um; none for the start of the cycle, after the
    /// dwell.
    pub at_um: Option<u32>,
}

/// Why a run cannot have this cue.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CueError {
    /// The cycle is beyond the run.
    #[error("there is no cycle {cycle}: the run has {cycles}, and they count from 1")]
    NoCycle { cycle: u16, cycles: u16 },
    /// The carriage does not pass this position.
    #[error("the carriage does not pass {} mm: the stroke is {} mm", decimal::write((*at_um).into(), 3), decimal::write((*stroke_um).into(), 3))]
    NotPassed { at_um: u32, stroke_um: u32 },
    /// The telemetry is too slow to detect the position in time.
    #[error(
        "the rig tells its position every {telemetry_ms} ms: at a place of a stroke that is too seldom, {MOST_TELEMETRY_MS} ms at most"
    )]
    TooSeldom { telemetry_ms: u16 },
}

/// Longest telemetry interval that detects a position of a stroke in time, ms.
const MOST_TELEMETRY_MS: u16 = 10;

impl Cue {
    /// Checks that the run reaches the cue, and that telemetry at this interval shows it.
    pub fn check(&self, run: &Run, telemetry_ms: u16) -> Result<(), CueError> {
        if !(1..=run.cycles).contains(&self.cycle) {
            return Err(CueError::NoCycle {
                cycle: self.cycle,
                cycles: run.cycles,
            });
        }
        match self.at_um {
            Some(at_um) if at_um == 0 || at_um > run.stroke_um => Err(CueError::NotPassed {
                at_um,
                stroke_um: run.stroke_um,
            }),
            Some(_) if telemetry_ms > MOST_TELEMETRY_MS => {
                Err(CueError::TooSeldom { telemetry_ms })
            }
            _ => Ok(()),
        }
    }

    /// Number of the stroke away from home of that cycle, from 0.
    pub(crate) fn stroke(&self) -> u32 {
        2 * u32::from(self.cycle.saturating_sub(1))
    }
}

/// Timing of the actuation, in its sidecar. A pair of numbers is a range that contains the true value.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Coordination {
    /// File name of the run's sidecar.
    pub run: String,
    pub cue: Cue,
    /// When the carriage was at the cue, by the rig's clock, us; none if it was not reached.
    pub cue_time_us: Option<u64>,
    /// When the actuation began, by the capsule's clock, us; none if it did not.
    pub began_time_us: Option<u64>,
    /// The capsule's time minus the rig's, us.
    pub capsule_ahead_us: Option<(i64, i64)>,
    /// From the cue to the start of the actuation, us.
    pub latency_us: Option<(i64, i64)>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::rig::{LinkLossPolicy, RunTiming};

    #[test]
    fn a_cue_is_at_a_place_that_the_carriage_passes() {
        let run = Run {
            cycles: 3,
            stroke_um: 10_000,
            timing: RunTiming::Total {
                total_us: 6_000_000,
                accel_um_s2: 100_000,
            },
            far_dwell_us: 0,
            home_dwell_us: 0,
            start_delay_us: 0,
            link_loss: LinkLossPolicy::Stop,
        };
        let none = |cycle| Err(CueError::NoCycle { cycle, cycles: 3 });
        let not_passed = |at_um| {
            Err(CueError::NotPassed {
                at_um,
                stroke_um: 10_000,
            })
        };
        let too_seldom = Err(CueError::TooSeldom { telemetry_ms: 11 });
        for (cycle, at_um, telemetry_ms, expected) in [
            (0, None, 10, none(0)),
            (1, None, 1_000, Ok(())),
            (3, None, 10, Ok(())),
            (4, None, 10, none(4)),
            (1, Some(0), 10, not_passed(0)),
            (1, Some(1), 10, Ok(())),
            (1, Some(10_000), 10, Ok(())),
            (1, Some(10_001), 10, not_passed(10_001)),
            (1, Some(5_000), 11, too_seldom),
        ] {
            let checked = Cue { cycle, at_um }.check(&run, telemetry_ms);
            assert_eq!(checked, expected, "{cycle} {at_um:?}");
        }
        assert_eq!(
            [1, 2, 3].map(|cycle| Cue { cycle, at_um: None }.stroke()),
            [0, 2, 4]
        );
    }
}
