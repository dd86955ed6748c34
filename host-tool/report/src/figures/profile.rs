//! The exact course of a planned run, for drawing and for comparison.

use lab::trials::trial::{Achieved, Screw};
use protocol::rig::{Run, Stroke};

/// Points of the planned profile per ramp.
const RAMP_POINTS: u32 = 24;

/// Position and velocity of a plan over time: (s, mm) and (s, mm/s).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planned {
    /// (s, mm).
    pub position: Vec<(f64, f64)>,
    /// (s, mm/s).
    pub velocity: Vec<(f64, f64)>,
}

/// The exact continuous profile of a run, sampled finely enough to draw. Time 0 is the run's start.
#[must_use]
pub fn planned(screw: &Screw, run: &Run, achieved: &Achieved) -> Planned {
    let seconds = |ticks: u64| ticks as f64 * 1e-8;
    let (far, home) = (
        f64::from(run.far_dwell_us) * 1e-6,
        f64::from(run.home_dwell_us) * 1e-6,
    );
    let mut planned = Planned::default();
    let mut start = f64::from(run.start_delay_us) * 1e-6;
    for cycle in 0..run.cycles {
        stroke(&mut planned, screw, &achieved.forward, start, false);
        start += seconds(achieved.forward.duration_ticks) + far;
        if cycle + 1 == run.cycles {
            // The last dwell absorbs the remainder from the division of the total.
            start = seconds(achieved.total_ticks) - seconds(achieved.back.duration_ticks);
        }
        stroke(&mut planned, screw, &achieved.back, start, true);
        start += seconds(achieved.back.duration_ticks) + home;
    }
    planned
}

/// The exact position of a plan at `time_s` after the run's start, mm.
#[must_use]
pub fn position_at(screw: &Screw, run: &Run, achieved: &Achieved, time_s: f64) -> f64 {
    let seconds = |ticks: u64| ticks as f64 * 1e-8;
    let (far, home) = (
        f64::from(run.far_dwell_us) * 1e-6,
        f64::from(run.home_dwell_us) * 1e-6,
    );
    let mut start = f64::from(run.start_delay_us) * 1e-6;
    for cycle in 0..run.cycles {
        if time_s < start + seconds(achieved.forward.duration_ticks) + far {
            return way(screw, &achieved.forward, time_s - start);
        }
        start += seconds(achieved.forward.duration_ticks) + far;
        if cycle + 1 == run.cycles {
            start = seconds(achieved.total_ticks) - seconds(achieved.back.duration_ticks);
        }
        if time_s < start + seconds(achieved.back.duration_ticks) + home {
            let length = screw.mm(f64::from(achieved.back.steps));
            return length - way(screw, &achieved.back, time_s - start);
        }
        start += seconds(achieved.back.duration_ticks) + home;
    }
    0.0
}

/// Distance since the beginning of a stroke, mm; constant before and after it.
fn way(screw: &Screw, stroke: &Stroke, time_s: f64) -> f64 {
    let (t, r) = (
        stroke.duration_ticks as f64 * 1e-8,
        stroke.ramp_ticks as f64 * 1e-8,
    );
    let length = screw.mm(f64::from(stroke.steps));
    let speed = length / (t - r);
    match time_s {
        time if time <= 0.0 => 0.0,
        time if time >= t => length,
        time if time < r => speed / r * time * time / 2.0,
        time if time <= t - r => speed * (time - r / 2.0),
        time => length - speed / r * (t - time) * (t - time) / 2.0,
    }
}

fn stroke(planned: &mut Planned, screw: &Screw, stroke: &Stroke, start: f64, back: bool) {
    let steps = f64::from(stroke.steps);
    let (t, r) = (
        stroke.duration_ticks as f64 * 1e-8,
        stroke.ramp_ticks as f64 * 1e-8,
    );
    let length = screw.mm(steps);
    let (speed, acceleration) = (length / (t - r), length / (t - r) / r);
    let mut point = |time: f64, way: f64, speed: f64| {
        let (position, velocity) = if back {
            (length - way, -speed)
        } else {
            (way, speed)
        };
        planned.position.push((start + time, position));
        planned.velocity.push((start + time, velocity));
    };
    for index in 0..=RAMP_POINTS {
        let time = r * f64::from(index) / f64::from(RAMP_POINTS);
        point(time, acceleration * time * time / 2.0, acceleration * time);
    }
    point(t - r, length - speed * r / 2.0, speed);
    for index in (0..RAMP_POINTS).rev() {
        let left = r * f64::from(index) / f64::from(RAMP_POINTS);
        point(
            t - left,
            length - acceleration * left * left / 2.0,
            acceleration * left,
        );
    }
}

#[cfg(test)]
mod tests {
    use lab::trials::experiment::PAPER_RUN;
    use lab::trials::plan::{REFERENCE_LIMITS, summary};

    use super::*;
    use motion::axis::Axis;
    use planning::solve;

    #[test]
    fn the_planned_curve_goes_out_and_home_and_ends_with_the_run() {
        let plan = solve(&PAPER_RUN, &Axis::REFERENCE, &REFERENCE_LIMITS).expect("feasible");
        let summary = summary(&PAPER_RUN, &Axis::REFERENCE, &plan);
        let planned = planned(&summary.screw, &PAPER_RUN, &summary.achieved);
        let highest = planned
            .position
            .iter()
            .map(|point| point.1)
            .fold(0.0, f64::max);
        assert!((highest - 130.0).abs() < 1e-9, "{highest}");
        let (time, position) = planned.position.last().copied().expect("points");
        assert!(
            (time - 40.0).abs() < 1e-9 && position.abs() < 1e-9,
            "{time} {position}"
        );
        assert!(
            planned.position.is_sorted_by(|a, b| a.0 <= b.0),
            "time never steps back"
        );
        let fastest = planned
            .velocity
            .iter()
            .map(|point| point.1)
            .fold(0.0, f64::max);
        let peak = f64::from(summary.achieved.forward.peak_um_s) / 1e3;
        assert!((fastest - peak).abs() < 1e-3, "{fastest} {peak}");
    }

    #[test]
    fn the_position_of_a_plan_is_on_its_curve() {
        let run = Run {
            far_dwell_us: 300_000,
            home_dwell_us: 200_000,
            start_delay_us: 500_000,
            ..PAPER_RUN
        };
        let plan = solve(&run, &Axis::REFERENCE, &REFERENCE_LIMITS).expect("feasible");
        let summary = summary(&run, &Axis::REFERENCE, &plan);
        let curve = planned(&summary.screw, &run, &summary.achieved).position;
        for (time, position) in &curve {
            let at = position_at(&summary.screw, &run, &summary.achieved, *time);
            assert!((at - position).abs() < 1e-6, "{time}: {at} {position}");
        }
        for (pair, at) in curve
            .windows(2)
            .filter(|pair| pair[1].0 - pair[0].0 > 0.1)
            .map(|pair| {
                let middle = (pair[0].0 + pair[1].0) / 2.0;
                (
                    pair,
                    position_at(&summary.screw, &run, &summary.achieved, middle),
                )
            })
        {
            let straight = (pair[0].1 + pair[1].1) / 2.0;
            assert!((at - straight).abs() < 1e-6, "{pair:?}: {at}");
        }
        for time in [-1.0, 0.2, 41.0] {
            let at = position_at(&summary.screw, &run, &summary.achieved, time);
            assert_eq!(at, 0.0, "{time}");
        }
    }
}
