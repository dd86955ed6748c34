//! Plans a run before it is sent, with the same arithmetic as the rig; gives a summary and all edges.

use std::io::{self, Write};

use client::{decimal, plain};
use motion::axis::{Axis, Direction};
use motion::run::{Limits, RunError, RunPlan};
use motion::step_times::StepTimes;
use motion::trapezoid::MIN_INTERVAL;
use motion::units::{TICK_HZ, TICKS_PER_US, Ticks};
use protocol::rig::{Run, RunTiming};
use protocol::settings::SettingKey;
use protocol::system::SetTelemetry;
use serde::Serialize;

use crate::trials::trial::{Achieved, Screw};

/// Limits of the default settings. A rig applies its own settings, which may differ.
pub const REFERENCE_LIMITS: Limits = Limits {
    max_speed_um_s: SettingKey::MaxSpeedUmS.range().default,
    max_accel_um_s2: SettingKey::MaxAccelUmS2.range().default,
    min_interval_ticks: (TICK_HZ as u32).div_ceil(SettingKey::MaxStepHz.range().default),
    min_turnaround_ticks: SettingKey::TurnaroundUs.range().default * TICKS_PER_US as u32,
};

/// Limits that no rig can exceed.
const WIDEST_LIMITS: Limits = Limits {
    max_speed_um_s: u32::MAX,
    max_accel_um_s2: u32::MAX,
    min_interval_ticks: MIN_INTERVAL.0 as u32,
    min_turnaround_ticks: 0,
};

/// Refuses, before a link is opened, what every rig would refuse. The rig itself checks what depends on its screw and
/// limits.
///
/// # Errors
/// The defect of the request, with advice.
pub fn check(run: &Run) -> Result<(), RunError> {
    match planning::solve(run, &Axis::REFERENCE, &WIDEST_LIMITS) {
        Err(
            RunError::StrokeBelowOneStep { .. }
            | RunError::StepRate { .. }
            | RunError::Turnaround { .. }
            | RunError::Profile(_),
        )
        | Ok(_) => Ok(()),
        // Propose an alternative that is possible on a rig with default settings, not only on the fastest one.
        Err(error @ RunError::TotalTooShort { .. }) => {
            match planning::solve(run, &Axis::REFERENCE, &REFERENCE_LIMITS) {
                Err(
                    delivered @ (RunError::TotalTooShort { .. }
                    | RunError::PeakAboveLimit {
                        minimal_total_us: Some(_),
                        ..
                    }),
                ) => Err(delivered),
                _ => Err(error),
            }
        }
        Err(error) => Err(error),
    }
}

/// Refuses a run whose telemetry would not fit into a record. A hold may still prolong it beyond that.
///
/// # Errors
/// The intervals that would fit.
pub fn fits(run: &Run, telemetry_ms: u16) -> Result<(), String> {
    let axis = &Axis::REFERENCE;
    let total_us = match (run.timing, planning::solve(run, axis, &WIDEST_LIMITS)) {
        (RunTiming::Total { total_us, .. }, _) => total_us,
        (_, Ok(plan)) => planning::accepted(0, *run, &plan, axis).total_ticks / TICKS_PER_US,
        _ => return Ok(()),
    };
    // Some samples come before the run and after it.
    let least = total_us.div_ceil(1_000 * (plain::ROWS - 10_000));
    if least <= telemetry_ms.into() {
        return Ok(());
    }
    let (rows, most) = (plain::ROWS, SetTelemetry::PERIOD_MS.1);
    let remedy = match least <= most.into() {
        true => format!("use {least} to {most}"),
        false => "shorten the run".to_owned(),
    };
    Err(format!(
        "more samples of {telemetry_ms} ms than the {rows} of a record: {remedy}"
    ))
}

/// The peak speed of the run, um/s, as solved for the reference rig; none if that rig cannot execute it.
#[must_use]
pub fn peak_um_s(run: &Run) -> Option<u32> {
    let axis = &Axis::REFERENCE;
    let plan = planning::solve(run, axis, &WIDEST_LIMITS).ok()?;
    Some(planning::accepted(0, *run, &plan, axis).forward.peak_um_s)
}

/// The numbers of a solved run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Summary {
    pub requested: Run,
    /// Screw and stroke that it was solved for.
    pub screw: Screw,
    pub achieved: Achieved,
    /// Strokes of the run.
    pub strokes: u32,
    /// Highest step rate, Hz, rounded up.
    pub peak_step_hz: u64,
}

#[must_use]
pub fn summary(run: &Run, axis: &Axis, plan: &RunPlan) -> Summary {
    let shortest = plan
        .forward()
        .min_interval()
        .min(plan.return_().min_interval());
    Summary {
        requested: *run,
        screw: Screw {
            lead_um: axis.lead().0,
            steps_per_rev: axis.steps_per_rev(),
            stroke_um: axis.stroke().0,
        },
        achieved: Achieved::from(&planning::accepted(0, *run, plan, axis)),
        strokes: plan.strokes(),
        peak_step_hz: TICK_HZ.div_ceil(shortest.0.max(1)),
    }
}

/// Writes every step edge of a plan as CSV: stroke from 0, position after the edge, and time since the start in ticks
/// of 10 ns and in seconds.
///
/// # Errors
/// Those of the writer.
pub fn write_edges(plan: &RunPlan, out: &mut dyn Write) -> io::Result<()> {
    writeln!(out, "stroke,position_steps,tick_10ns,time_s")?;
    for index in 0..plan.strokes() {
        let (Some(start), Some(profile), Some(direction)) = (
            plan.stroke_start(index),
            plan.stroke(index),
            plan.direction(index),
        ) else {
            break;
        };
        let steps = profile.steps().0;
        for (tick, done) in StepTimes::new(*profile).zip(1..) {
            let position = match direction {
                Direction::Away => done,
                Direction::Home => steps - done,
            };
            let Ticks(tick) = Ticks(start.0 + tick);
            writeln!(out, "{index},{position},{tick},{}", decimal::write(tick, 8))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trials::experiment::PAPER_RUN;
    use planning::solve;

    #[test]
    fn the_papers_run_is_solved_as_the_design_says() {
        let plan = solve(&PAPER_RUN, &Axis::REFERENCE, &REFERENCE_LIMITS).expect("feasible");
        let summary = summary(&PAPER_RUN, &Axis::REFERENCE, &plan);
        assert_eq!(summary.achieved.edges, 1_040_000);
        assert_eq!(summary.achieved.total_ticks, 4_000_000_000);
        assert_eq!(summary.achieved.forward.duration_ticks, 400_000_000);
        assert_eq!(summary.strokes, 10);
    }

    #[test]
    fn a_start_delay_is_part_of_the_total() {
        let delayed = Run {
            start_delay_us: 4_000_000,
            timing: RunTiming::Total {
                total_us: 44_000_000,
                accel_um_s2: 100_000,
            },
            ..PAPER_RUN
        };
        let plan = |run: &Run| {
            let plan = solve(run, &Axis::REFERENCE, &REFERENCE_LIMITS).expect("feasible");
            summary(run, &Axis::REFERENCE, &plan).achieved
        };
        let (now, later) = (plan(&PAPER_RUN), plan(&delayed));
        assert_eq!((now.forward, now.back), (later.forward, later.back));
        assert_eq!(later.total_ticks, now.total_ticks + 400_000_000);
    }

    #[test]
    fn every_edge_is_written_once_and_the_last_is_at_home_at_the_end() {
        let run = Run {
            cycles: 2,
            stroke_um: 1_000,
            timing: RunTiming::Total {
                total_us: 2_000_000,
                accel_um_s2: 100_000,
            },
            ..PAPER_RUN
        };
        let plan = solve(&run, &Axis::REFERENCE, &REFERENCE_LIMITS).expect("feasible");
        let mut text = vec![];
        write_edges(&plan, &mut text).expect("memory");
        let text = String::from_utf8(text).expect("ASCII");
        let rows: Vec<&str> = text.lines().skip(1).collect();
        assert_eq!(rows.len() as u64, plan.edges());
        assert_eq!(rows.last(), Some(&"3,0,200000000,2"));
        let ticks = rows.iter().map(|row| {
            row.split(',')
                .nth(2)
                .and_then(|tick| tick.parse::<u64>().ok())
        });
        assert!(ticks.clone().all(|tick| tick.is_some()));
        assert!(ticks.is_sorted_by(|a, b| a < b), "edges follow one another");
    }

    #[test]
    fn only_what_no_rig_can_do_is_refused_beforehand() {
        let refused = |run: Run| check(&run).is_err();
        assert!(!refused(PAPER_RUN));
        assert!(refused(Run {
            cycles: 0,
            ..PAPER_RUN
        }));
        assert!(refused(Run {
            stroke_um: 131_000,
            ..PAPER_RUN
        }));
        assert!(refused(Run {
            stroke_um: 0,
            ..PAPER_RUN
        }));
        assert!(refused(Run {
            start_delay_us: 1,
            timing: RunTiming::Total {
                total_us: u64::MAX,
                accel_um_s2: 1
            },
            ..PAPER_RUN
        }));
        let speed = |forward_um_s| Run {
            timing: RunTiming::Speeds {
                forward_um_s,
                return_um_s: 1_000,
                accel_um_s2: 100_000,
            },
            ..PAPER_RUN
        };
        assert!(refused(speed(0)));
        // Faster than the default settings allow, but the rig decides that.
        assert!(!refused(speed(60_000)));
    }
}
