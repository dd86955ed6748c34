//! Random runs, and the strokes of a path.

use firmware_rig::periods::Path;
use motion::{
    axis::{Acceleration, Axis, Direction},
    run::{Limits, RunPlan, RunRequest, Timing},
    trapezoid::StrokeProfile,
};
use proptest::prelude::*;

/// Start, profile and direction of each stroke.
pub type Strokes = Vec<(u64, StrokeProfile, Direction)>;

pub fn strokes(path: &Path) -> Strokes {
    let planned = |plan: &RunPlan| -> Strokes {
        let stroke = |index| {
            (
                plan.stroke_start(index).unwrap().0,
                *plan.stroke(index).unwrap(),
                plan.direction(index).unwrap(),
            )
        };
        (0..plan.strokes()).map(stroke).collect()
    };
    match path {
        Path::Move { profile, direction } => vec![(0, *profile, *direction)],
        Path::Run(plan) => planned(plan),
        // The rest of the stroke begins at once; later strokes keep their distance from its end.
        Path::Rest {
            plan,
            stroke,
            first,
        } => {
            let mut rest = planned(plan).split_off(*stroke as usize);
            let end = rest[0].0 + rest[0].1.duration().0;
            for (start, ..) in &mut rest[1..] {
                *start = *start - end + first.duration().0;
            }
            (rest[0].0, rest[0].1) = (0, *first);
            rest
        }
    }
}

/// Number of its first stroke.
pub fn first_stroke(path: &Path) -> usize {
    match path {
        Path::Move { .. } | Path::Run(_) => 0,
        Path::Rest { stroke, .. } => *stroke as usize,
    }
}

/// Any allowed axis; strokes of up to the given steps that take 1 ms to 3 s.
pub fn any_run(limits: Limits, longest: u32) -> impl Strategy<Value = RunPlan> {
    let axis = (500_u32..=50_000, any::<bool>(), 0_u32..=8);
    let rests = prop_oneof![Just([0, 0, 0]), any::<[u16; 3]>()];
    let shape = (1..=longest, 10.0..21.5_f64, 0.05..1.0_f64, 0.5..2.0_f64);
    (axis, rests, shape, 1_u16..=3, any::<bool>()).prop_filter_map(
        "feasible",
        move |((lead, fine, micro), rests, (steps, log_us, ramp, ratio), cycles, total)| {
            let full = if fine { 400 } else { 200 };
            let axis = Axis::new(lead, full, 1 << micro, 130_000).unwrap();
            let stroke_um = (steps * lead).div_ceil(axis.steps_per_rev()).min(130_000);
            let (um, us) = (f64::from(stroke_um), log_us.exp2());
            let speed = um / us * 1e6;
            let accel = (speed / (us * ramp / 2.0) * 1e6 * 2.5).ceil() as u32;
            let accel_um_s2 = accel.clamp(1, limits.max_accel_um_s2);
            let [far, home, start_delay_us] = rests.map(u32::from);
            let timing = if total {
                let rests = u64::from(start_delay_us)
                    + u64::from(cycles) * u64::from(far)
                    + u64::from(cycles - 1) * u64::from(home);
                Timing::Total {
                    total_us: (2.0 * f64::from(cycles) * us) as u64 + rests,
                    accel_um_s2,
                }
            } else {
                Timing::Speeds {
                    forward_um_s: speed.ceil() as u32,
                    return_um_s: (speed * ratio).ceil() as u32,
                    accel_um_s2,
                }
            };
            let request = RunRequest {
                cycles,
                stroke_um,
                timing,
                far_dwell_us: far,
                home_dwell_us: home,
                start_delay_us,
            };
            RunPlan::solve(&axis, &limits, &request).ok()
        },
    )
}

pub fn any_deceleration() -> impl Strategy<Value = Acceleration> {
    (10.0..21.0_f64).prop_map(|log| Axis::REFERENCE.acceleration(log.exp2() as u32).unwrap())
}
