//! Bodies that are not those of the model, for data that a fit has to doubt: a chain of its own, written from
//! `docs/science.md`, with wings that recover late and with play between body and wall.

use locomotion::body::FrictionRatio;
use locomotion::kinematics::Design;
use locomotion::model::Model;
use locomotion::roller::{Params, wall_mm};

/// Differences from the model.
#[derive(Clone, Copy, Debug)]
pub struct Unlike {
    /// Travel of the rollers in which a wing that the wave has left recovers to 1/e, mm; 0 as in the model.
    pub recovery_mm: f64,
    /// Displacement that the contact gives before it slips, mm; 0 as in the model.
    pub threshold_mm: f64,
}

pub const LIKE: Unlike = Unlike {
    recovery_mm: 0.0,
    threshold_mm: 0.0,
};

struct Body {
    rig: Params,
    unlike: Unlike,
    design: Design<f64>,
    ratio: f64,
    depth_mm: f64,
    core_mm: f64,
    pressed_mm: Vec<f64>,
    /// The tail as it is seen: it follows the chain only beyond the threshold.
    seen_mm: f64,
}

/// Middles of the links from the tail.
fn middles(design: &Design<f64>, pressed_mm: &[f64]) -> Vec<f64> {
    let mut end = 0.0;
    let middle = |a: &f64| {
        let link = design.squeezed_spacing_mm(*a).expect("covered");
        end += link;
        end - link / 2.0
    };
    pressed_mm.iter().map(middle).collect()
}

impl Body {
    fn new(model: &Model, depth_mm: f64, unlike: Unlike) -> Self {
        let rig = model.rig().expect("covered");
        let design = rig.body.design;
        let FrictionRatio::Fixed(ratio) = rig.body.friction_ratio else {
            panic!("a fixed ratio");
        };
        let core_mm = rig.body.tail_mm + design.wing_reach_mm(0.0).expect("covered");
        Self {
            rig,
            unlike,
            design,
            ratio,
            depth_mm,
            core_mm,
            pressed_mm: vec![0.0; design.crescents().into()],
            seen_mm: core_mm,
        }
    }

    fn roller_at(&mut self, roller_mm: f64, travel_mm: f64) {
        let before = middles(&self.design, &self.pressed_mm);
        let keeps = if self.unlike.recovery_mm > 0.0 {
            (-travel_mm / self.unlike.recovery_mm).exp()
        } else {
            0.0
        };
        let pressed = |(middle, was): (&f64, &f64)| {
            let off = self.core_mm + middle - roller_mm;
            let wall = wall_mm(self.depth_mm, self.rig.radius_mm, off);
            (self.rig.body.coupling * wall).max(keeps * was)
        };
        let now: Vec<f64> = before.iter().zip(&self.pressed_mm).map(pressed).collect();
        let after = middles(&self.design, &now);
        let held =
            |place: usize| self.rig.body.preload_mm + (now[place] + self.pressed_mm[place]) / 2.0;
        let shifts: Vec<(f64, f64)> = (0..now.len())
            .map(|place| (after[place] - before[place], held(place)))
            .collect();
        let work = |shift: f64| -> f64 {
            let one = |(delta, held): &(f64, f64)| {
                let slip = shift + delta;
                held * if slip > 0.0 { slip } else { -self.ratio * slip }
            };
            shifts.iter().map(one).sum()
        };
        let least = (shifts.iter().map(|(delta, _)| -delta))
            .min_by(|one, other| work(*one).total_cmp(&work(*other)));
        self.core_mm += least.unwrap_or(0.0);
        self.pressed_mm = now;
        let play = self.unlike.threshold_mm;
        self.seen_mm = self.seen_mm.clamp(self.core_mm - play, self.core_mm + play);
    }

    fn carriage(&mut self, from_mm: f64, to_mm: f64) {
        let steps = ((to_mm - from_mm).abs() / STEP_MM).round() as u32;
        let travel_mm = (to_mm - from_mm) / f64::from(steps);
        for step in 1..=steps {
            let carriage_mm = from_mm + travel_mm * f64::from(step);
            self.roller_at(self.rig.stroke_mm - carriage_mm, travel_mm.abs());
        }
    }
}

const STEP_MM: f64 = 0.05;

/// Displacements by an antegrade and by a returning isolated pass, and by a run of some cycles, mm.
pub fn displacements_mm(model: &Model, depth_mm: f64, unlike: Unlike, cycles: u16) -> [f64; 3] {
    let new = || Body::new(model, depth_mm, unlike);
    let start_mm = new().core_mm;
    let (mut antegrade, mut returning, mut run) = (new(), new(), new());
    let (stroke_mm, clear_mm) = (
        antegrade.rig.stroke_mm,
        antegrade.rig.stroke_mm + 2.0 * antegrade.rig.radius_mm,
    );
    antegrade.carriage(0.0, clear_mm);
    returning.carriage(clear_mm, 0.0);
    for _ in 0..cycles {
        run.carriage(0.0, stroke_mm);
        run.carriage(stroke_mm, 0.0);
    }
    [antegrade, returning, run].map(|body| body.seen_mm - start_mm)
}
