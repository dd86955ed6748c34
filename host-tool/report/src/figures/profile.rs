//! The exact motion of a planned run, for drawing and for comparison.

use lab::trials::trial::{Achieved, Screw};
use protocol::rig::{Run, Stroke};

/// Points of the planned profile per ramp.
const RAMP_POINTS: u32 = 24;

/// Position and velocity of a plan over time: (s, mm) and (s, mm/s).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planned {
    pub position: Vec<(f64, f64)>,
    pub velocity: Vec<(f64, f64)>,
}

fn seconds(ticks: u64) -> f64 {
    ticks as f64 * 1e-8
}

/// The strokes of a run in their order: start of each, s after the run's start, and whether it goes home.
fn strokes<'a>(
    run: &Run,
    achieved: &'a Achieved,
) -> impl Iterator<Item = (f64, &'a Stroke, bool)> + use<'a> {
    let (forward, back) = (&achieved.forward, &achieved.back);
    let delay_s = f64::from(run.start_delay_us) * 1e-6;
    let far_s = seconds(forward.duration_ticks) + f64::from(run.far_dwell_us) * 1e-6;
    let cycle_s = far_s + seconds(back.duration_ticks) + f64::from(run.home_dwell_us) * 1e-6;
    let last_s = seconds(achieved.total_ticks) - seconds(back.duration_ticks);
    let cycles = run.cycles;
    (0..cycles).flat_map(move |cycle| {
        let start_s = delay_s + f64::from(cycle) * cycle_s;
        // The last dwell absorbs the remainder from the division of the total.
        let home_s = match cycle + 1 == cycles {
            true => last_s,
            false => start_s + far_s,
        };
        [(start_s, forward, false), (home_s, back, true)]
    })
}

/// The exact continuous profile of a run, sampled finely enough to draw. Time 0 is the run's start.
pub fn planned(screw: &Screw, run: &Run, achieved: &Achieved) -> Planned {
    let mut planned = Planned::default();
    for (start_s, stroke, home) in strokes(run, achieved) {
        let (t, r) = (seconds(stroke.duration_ticks), seconds(stroke.ramp_ticks));
        let part = |index: u32| r * f64::from(index) / f64::from(RAMP_POINTS);
        let up = (0..=RAMP_POINTS).map(part);
        let down = (0..=RAMP_POINTS).rev().map(|index| t - part(index));
        for time_s in up.chain(down) {
            let (position, speed) = course(screw, stroke, home, time_s);
            planned.position.push((start_s + time_s, position));
            planned.velocity.push((start_s + time_s, speed));
        }
    }
    planned
}

/// The exact position of a plan at `time_s` after the run's start, mm.
pub fn position_at(screw: &Screw, run: &Run, achieved: &Achieved, time_s: f64) -> f64 {
    let begun = strokes(run, achieved).take_while(|(start_s, ..)| *start_s <= time_s);
    begun.last().map_or(0.0, |(start_s, stroke, home)| {
        course(screw, stroke, home, time_s - start_s).0
    })
}

/// Position, mm, and velocity, mm/s, at a time since the start of a stroke; at rest after it.
fn course(screw: &Screw, stroke: &Stroke, home: bool, time_s: f64) -> (f64, f64) {
    let (t, r) = (seconds(stroke.duration_ticks), seconds(stroke.ramp_ticks));
    let length = screw.mm(f64::from(stroke.steps));
    let speed = length / (t - r);
    let ramp = |time: f64| (speed / r * time * time / 2.0, speed * time / r);
    let (way, speed) = match time_s {
        time if time >= t => (length, 0.0),
        time if time < r => ramp(time),
        time if time <= t - r => (speed * (time - r / 2.0), speed),
        time => {
            let (distance, speed) = ramp(t - time);
            (length - distance, speed)
        }
    };
    match home {
        true => (length - way, -speed),
        false => (way, speed),
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
        let most = |points: &[(f64, f64)]| points.iter().map(|point| point.1).fold(0.0, f64::max);
        let highest = most(&planned.position);
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
        let fastest = most(&planned.velocity);
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
        for pair in curve.windows(2).filter(|pair| pair[1].0 - pair[0].0 > 0.1) {
            let middle = f64::midpoint(pair[0].0, pair[1].0);
            let at = position_at(&summary.screw, &run, &summary.achieved, middle);
            let straight = f64::midpoint(pair[0].1, pair[1].1);
            assert!((at - straight).abs() < 1e-6, "{pair:?}: {at}");
        }
        for time in [-1.0, 0.2, 41.0] {
            let at = position_at(&summary.screw, &run, &summary.achieved, time);
            assert_eq!(at, 0.0, "{time}");
        }
    }
}
