//! A place of a run at which an actuation begins, and the record of when it did.

use client::decimal;
use protocol::rig::Run;
use serde::{Deserialize, Serialize};

/// A place of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cue {
    /// The cycle, from 1.
    pub cycle: u16,
    /// Where the carriage passes on its way away from home, um; none for the start of the cycle, after the dwell.
    pub at_um: Option<u32>,
}

/// Why a run has no such place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CueError {
    /// There are fewer cycles.
    #[error("there is no cycle {cycle}: the run has {cycles}, and they count from 1")]
    NoCycle {
        /// The one that was asked for.
        cycle: u16,
        /// Those of the run.
        cycles: u16,
    },
    /// The carriage does not pass there.
    #[error("the carriage does not pass {} mm: the stroke is {} mm", decimal::write((*at_um).into(), 3), decimal::write((*stroke_um).into(), 3))]
    NotPassed {
        /// The place that was asked for.
        at_um: u32,
        /// The stroke of the run.
        stroke_um: u32,
    },
    /// It would be noticed too late.
    #[error(
        "the rig tells its position every {telemetry_ms} ms: at a place of a stroke that is too seldom, {MOST_TELEMETRY_MS} ms at most"
    )]
    TooSeldom {
        /// Interval of the telemetry.
        telemetry_ms: u16,
    },
}

/// Longest interval of telemetry at which a place of a stroke is noticed soon enough, ms.
const MOST_TELEMETRY_MS: u16 = 10;

impl Cue {
    /// Whether the run comes there, and telemetry at this interval shows it.
    ///
    /// # Errors
    /// [`CueError`].
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

    /// The stroke away from home of that cycle, from 0.
    pub(crate) fn stroke(&self) -> u32 {
        2 * u32::from(self.cycle.saturating_sub(1))
    }
}

/// When it began, in the sidecar of the actuation. Where two numbers stand, the true one lies between them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Coordination {
    /// File name of the run's sidecar.
    pub run: String,
    /// Where it was to begin.
    pub cue: Cue,
    /// When the carriage was there, by the rig's clock, us; none if it did not get there.
    pub cue_time_us: Option<u64>,
    /// When the actuation began, by the capsule's clock, us; none if it did not.
    pub began_time_us: Option<u64>,
    /// The capsule's time less the rig's, us.
    pub capsule_ahead_us: Option<(i64, i64)>,
    /// From the carriage to the actuation, us.
    pub latency_us: Option<(i64, i64)>,
}
