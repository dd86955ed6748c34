//! Converts between wire and plan. A run is *requested* ([`protocol::rig::Run`]), *planned*
//! ([`motion::run::RunPlan`]) and *reported* ([`protocol::rig::RunAccepted`], [`protocol::error::Refusal`]). The rig
//! and the host tool use the same functions, so a plan made offline is the plan that the rig executes.
#![no_std]
#![forbid(unsafe_code)]

use motion::{
    axis::{self, Axis},
    run::{Limits, MAX_CYCLES, RunError, RunPlan, RunRequest, Timing},
    trapezoid::StrokeProfile,
    units::TICK_HZ,
};
use protocol::{
    error::{Field, Refusal},
    rig::{self, Run, RunAccepted, RunTiming, Stroke},
};

/// Converts a direction of the wire.
#[must_use]
pub fn direction(requested: rig::Direction) -> axis::Direction {
    match requested {
        rig::Direction::Away => axis::Direction::Away,
        rig::Direction::Home => axis::Direction::Home,
    }
}

/// Solves a requested run. A total duration includes the start delay.
///
/// # Errors
/// The limit that the run breaks and, where there is one, the value that would be accepted.
pub fn solve(run: &Run, axis: &Axis, limits: &Limits) -> Result<RunPlan, RunError> {
    let timing = match run.timing {
        RunTiming::Total {
            total_us,
            accel_um_s2,
        } => Timing::Total {
            total_us,
            accel_um_s2,
        },
        RunTiming::Speeds {
            forward_um_s,
            return_um_s,
            accel_um_s2,
        } => Timing::Speeds {
            forward_um_s,
            return_um_s,
            accel_um_s2,
        },
    };
    let request = RunRequest {
        cycles: run.cycles,
        stroke_um: run.stroke_um,
        timing,
        far_dwell_us: run.far_dwell_us,
        home_dwell_us: run.home_dwell_us,
        start_delay_us: run.start_delay_us,
    };
    RunPlan::solve(axis, limits, &request)
}

/// The answer to an accepted run: its number `run`, the run as requested, and the plan.
#[must_use]
pub fn accepted(run: u32, requested: Run, plan: &RunPlan, axis: &Axis) -> RunAccepted {
    RunAccepted {
        run,
        requested,
        forward: stroke(plan.forward(), axis),
        back: stroke(plan.return_(), axis),
        total_ticks: plan.total().0,
        edges: plan.edges(),
        plan_hash: plan.hash(),
    }
}

/// Converts a stroke's profile to the wire's type, speeds and accelerations in whole micrometres.
#[must_use]
pub fn stroke(profile: &StrokeProfile, axis: &Axis) -> Stroke {
    Stroke {
        steps: profile.steps().0,
        duration_ticks: profile.duration().0,
        ramp_ticks: profile.ramp().0,
        peak_um_s: profile.peak_um_s(axis),
        accel_um_s2: profile.accel_um_s2(axis),
    }
}

/// Converts the reason why a run is infeasible to the wire's refusal.
#[must_use]
pub fn refusal(error: &RunError, run: &Run, axis: &Axis, limits: &Limits) -> Refusal {
    let out_of_range = |field, requested: u64, min, max| Refusal::OutOfRange {
        field,
        requested,
        min,
        max,
    };
    match *error {
        RunError::Cycles { cycles } => {
            out_of_range(Field::Cycles, cycles.into(), 1, MAX_CYCLES.into())
        }
        RunError::Stroke { .. } | RunError::StrokeBelowOneStep { .. } => {
            // The shortest stroke is one step, in whole micrometres.
            let min = u64::from(axis.lead().0).div_ceil(u64::from(axis.steps_per_rev()));
            out_of_range(
                Field::StrokeUm,
                run.stroke_um.into(),
                min,
                axis.stroke().0.into(),
            )
        }
        RunError::AccelerationAboveLimit {
            accel_um_s2,
            max_um_s2,
        } => out_of_range(Field::AccelUmS2, accel_um_s2.into(), 1, max_um_s2.into()),
        RunError::AccelerationTooLow {
            accel_um_s2,
            minimal_um_s2,
            max_um_s2,
            ..
        } => out_of_range(
            Field::AccelUmS2,
            accel_um_s2.into(),
            minimal_um_s2.into(),
            max_um_s2.into(),
        ),
        RunError::SpeedAboveLimit {
            speed_um_s,
            max_um_s,
        } => Refusal::SpeedLimit {
            needed_um_s: speed_um_s.into(),
            max_um_s: max_um_s.into(),
        },
        RunError::PeakAboveLimit {
            peak_um_s,
            max_um_s,
            ..
        } => Refusal::SpeedLimit {
            // The peak is rounded. One just above the limit must not be reported as the limit itself.
            needed_um_s: u64::from(peak_um_s).max(u64::from(max_um_s) + 1),
            max_um_s: max_um_s.into(),
        },
        RunError::TotalTooShort {
            minimal_total_us,
            minimal_accel_um_s2,
        } => Refusal::TooFast {
            requested_us: match run.timing {
                RunTiming::Total { total_us, .. } => total_us,
                RunTiming::Speeds { .. } => 0,
            },
            min_us: minimal_total_us,
            min_accel_um_s2: minimal_accel_um_s2.map_or(u64::MAX, u64::from),
        },
        RunError::StepRate {
            interval,
            min_interval,
            ..
        } => Refusal::StepRateLimit {
            // Round up: a rate less than 1 Hz above the limit must not be reported as the limit.
            needed_hz: TICK_HZ.div_ceil(interval.0.max(1)),
            max_hz: TICK_HZ / min_interval.0.max(1),
        },
        RunError::Turnaround {
            before,
            minimal_dwell_us,
            ..
        } => {
            let (field, requested) = match before {
                axis::Direction::Home => (Field::FarDwellUs, run.far_dwell_us),
                axis::Direction::Away => (Field::HomeDwellUs, run.home_dwell_us),
            };
            out_of_range(field, requested.into(), minimal_dwell_us, u32::MAX.into())
        }
        // `Rate` means that a speed or an acceleration is zero: find out which.
        RunError::Rate(_) => match run.timing {
            RunTiming::Speeds {
                forward_um_s: 0, ..
            } => out_of_range(Field::ForwardUmS, 0, 1, limits.max_speed_um_s.into()),
            RunTiming::Speeds { return_um_s: 0, .. } => {
                out_of_range(Field::ReturnUmS, 0, 1, limits.max_speed_um_s.into())
            }
            _ => out_of_range(Field::AccelUmS2, 0, 1, limits.max_accel_um_s2.into()),
        },
        RunError::TooLong | RunError::Profile(_) => Refusal::TooSlow,
    }
}
