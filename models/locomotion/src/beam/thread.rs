//! Displacement of the body against the thread drawn in: one model from unfolded to folded, without a switch.
//!
//! The thread draws every wing in by the same `a_t`, the inverse of Eq. (7). A wall that comes `e` deeper than the
//! tips shares `e` with the wing: `V0(f) = k_w g (1 + g T/2t)`, `g = e - f`. The left side is the wing's law. On the
//! right the wall yields locally and in proportion, to the edge t and to the flank of a wing of the slope T. The link
//! is then psi(a_t + f), and the tip lies on a wall with `f/e` times the roller's slope. This gives, for each
//! crescent, the axial force that moves the body either way, by the lever of [`crate::beam::crescent`]:
//!
//! ```text
//! X(w) = V0 T w/(T - w),   w = tan(+-atan mu - slope's angle)
//! ```
//!
//! * An upright wing has a small T. It is hard to drag tailward, easy headward, and stiff, so that it dents the wall
//!   and feels little of its slope. It is squeezed and released: retrograde motion.
//! * A wing that is drawn back has a large T. It is about equally hard either way, and soft, so that it takes the
//!   wall's slope. Only the roller touches it, and pushes it along.
//!
//! The body makes the shift that costs the least work, as in [`crate::body`]. Where the wall pushes harder than
//! friction holds, the body drifts until it holds.

use alloc::vec::Vec;

use crate::beam::crescent::{Law, Wing};
use crate::beam::{Modelled, NoAnswer};
use crate::body::{LINKS, middles};
use crate::parameter::{Label, Parameter, row};
use crate::range::{Ends, OutOfRange, check};
use crate::roller::wall_mm;

/// The body, its wall and the rig's run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Params {
    /// Geometry, material and section of the wings.
    pub wing: Wing,
    /// Friction coefficient between tip and wall.
    pub friction: f64,
    /// Stiffness of the wall against one tip, per width of the wing, N/mm^2.
    pub wall_n_mm2: f64,
    /// Share of the roller's slope that reaches a tip through its dent in the sheet, 0 to 1.
    pub backed: f64,
    /// How far the wall at rest overlaps the tips of the unfolded body, mm; negative for a gap.
    pub preload_mm: f64,
    /// Weight of the body, N: its friction holds the body wherever nothing else does.
    pub weight_n: f64,
    /// Where the body's core begins, mm from the intestine's left mark.
    pub core_tail_mm: f64,
    /// Travel of the carriage, mm.
    pub stroke_mm: f64,
    /// Radius of the rollers, mm.
    pub radius_mm: f64,
    /// Travel of the carriage between two evaluations, mm.
    pub step_mm: f64,
    /// Back-and-forth cycles of a run.
    pub cycles: u32,
}

impl Params {
    /// The paper's fold experiment; `PARAMETERS` says where each value comes from.
    pub const PAPER: Self = Self {
        wing: Wing::PAPER,
        friction: 0.18,
        wall_n_mm2: 0.005,
        backed: 0.3,
        preload_mm: 0.05,
        weight_n: 0.03,
        core_tail_mm: 45.0,
        stroke_mm: 130.0,
        radius_mm: 20.0,
        step_mm: 0.5,
        cycles: 5,
    };

    /// Refuses the first value outside its range.
    fn check(&self, indentation_mm: f64) -> Result<(), OutOfRange> {
        let gap_mm = self.wing.design.half_gap_mm();
        for (quantity, unit, value, range, because) in [
            (
                "friction coefficient",
                "",
                self.friction,
                (0.0, 2.0),
                "it is a friction",
            ),
            (
                "stiffness of the wall",
                "N/mm^2",
                self.wall_n_mm2,
                (1e-4, 1e4),
                "the wall is an elastic sheet",
            ),
            (
                "share of the roller's slope",
                "",
                self.backed,
                (0.0, 1.0),
                "it is a share",
            ),
            (
                "preload",
                "mm",
                self.preload_mm,
                (-1.0, 1.0),
                "the body is about as wide as the intestine",
            ),
            ("weight", "N", self.weight_n, (0.0, 10.0), "it is a weight"),
            (
                "start of the core",
                "mm",
                self.core_tail_mm,
                (-1e3, 1e3),
                "the intestine is a tenth of that",
            ),
            (
                "stroke",
                "mm",
                self.stroke_mm,
                (1.0, 1e3),
                "the carriage has to travel",
            ),
            (
                "roller step",
                "mm",
                self.step_mm,
                (0.01, 5.0),
                "finer costs time for nothing, coarser jumps over crescents",
            ),
            (
                "roller radius",
                "mm",
                self.radius_mm,
                (gap_mm, 1e3),
                "the wave is an arc of the roller, no deeper than its radius",
            ),
            (
                "indentation a",
                "mm",
                indentation_mm,
                (0.0, gap_mm - 1.1),
                "the wall moves inward, and the bent wing needs room before the core",
            ),
        ] {
            check(quantity, unit, value, range, Ends::Closed, because)?;
        }
        Ok(())
    }
}

/// Each parameter of [`Params::PAPER`], except for those of the roller and the design, with its label and its source.
pub const PARAMETERS: [Parameter; 10] = {
    use Label::{Assumed, Paper};
    let p = Params::PAPER;
    [
        row(
            "wing.modulus_mpa",
            p.wing.modulus_mpa,
            "MPa",
            Assumed,
            "II.D: TPU of shore hardness 95 A; no modulus in the text",
        ),
        row(
            "wing.thickness_mm",
            p.wing.thickness_mm,
            "mm",
            Paper,
            "II.B: that of the simulation; the print's is not in the text",
        ),
        row(
            "wing.width_mm",
            p.wing.width_mm,
            "mm",
            Assumed,
            "scales the forces, not the displacement",
        ),
        row(
            "wing.elements",
            p.wing.elements as f64,
            "",
            Assumed,
            "0.05 % of the deflection at 60 deg",
        ),
        row(
            "friction",
            p.friction,
            "",
            Assumed,
            "II.B gives 0.08 to 0.20 for a capsule in the intestine",
        ),
        row(
            "wall_n_mm2",
            p.wall_n_mm2,
            "N/mm^2",
            Assumed,
            "a soft sheet, 0.07 MPa, dented by an edge",
        ),
        row(
            "backed",
            p.backed,
            "",
            Assumed,
            "0: the sheet alone carries the roller's slope, 1: the tip does",
        ),
        row(
            "preload_mm",
            p.preload_mm,
            "mm",
            Assumed,
            "III: equally wide; the print is accurate to 0.15 mm",
        ),
        row(
            "weight_n",
            p.weight_n,
            "N",
            Assumed,
            "about 3 g; not in the text",
        ),
        row(
            "core_tail_mm",
            p.core_tail_mm,
            "mm",
            Assumed,
            "Fig. 8's start is not in the text: middle of the stroke",
        ),
    ]
};

/// Largest drift between two evaluations, mm.
const DRIFT_MM: f64 = 0.1;
const MOST_DRIFTS: usize = 4000;
/// Points of a law, and of the table that shares a depth between wing and wall.
const LAW_STEPS: u8 = 10;
const SHARES: usize = 24;

/// State of a crescent for one depth of the wall over its tip.
#[derive(Clone, Copy, Debug, Default)]
struct Touch {
    /// Indentation of the wing, mm.
    felt_mm: f64,
    /// Force without friction, N.
    force_n: f64,
    lever: f64,
}

/// A body with the thread drawn in, under the rig's rollers.
#[derive(Clone, Debug)]
pub struct ThreadedBody {
    params: Params,
    indentation_mm: f64,
    drawn_mm: f64,
    lock_n: f64,
    depth_step_mm: f64,
    touches: Vec<Touch>,
    core_tail_mm: f64,
    link_mm: [f64; LINKS],
    roller_mm: f64,
}

impl ThreadedBody {
    /// The body at `params.core_tail_mm` with `thread_mm` of thread drawn in, and the rollers at home.
    ///
    /// # Errors
    /// A value outside its range; an indentation for which the wing has no equilibrium.
    pub fn new(params: Params, thread_mm: f64, indentation_mm: f64) -> Result<Self, NoAnswer> {
        params.check(indentation_mm)?;
        let design = params.wing.design;
        let drawn_mm = design.indentation_for_thread_mm(thread_mm)?;
        let rest_mm = design.squeezed_spacing_mm(drawn_mm)?;
        let mut body = Self {
            params,
            indentation_mm,
            drawn_mm,
            lock_n: 0.0,
            depth_step_mm: 1.0,
            touches: Vec::new(),
            core_tail_mm: params.core_tail_mm,
            link_mm: [rest_mm; LINKS],
            roller_mm: params.stroke_mm,
        };
        let deepest_mm = indentation_mm + params.preload_mm - drawn_mm;
        if deepest_mm > 0.0 {
            let law = params.wing.law(drawn_mm, deepest_mm, LAW_STEPS)?;
            body.lock_n = law.lock_n();
            body.depth_step_mm = deepest_mm / SHARES as f64;
            let wall_n_mm = params.wall_n_mm2 * params.wing.width_mm;
            body.touches = (0..=SHARES)
                .map(|i| {
                    let depth_mm = body.depth_step_mm * i as f64;
                    touch(&law, wall_n_mm, params.wing.thickness_mm, depth_mm)
                })
                .collect();
        }
        body.roll_to(params.stroke_mm)?;
        Ok(body)
    }

    /// Moves the roller straight to `roller_mm`, in steps of at most `step_mm`.
    fn roll_to(&mut self, roller_mm: f64) -> Result<(), NoAnswer> {
        let way = roller_mm - self.roller_mm;
        let steps = libm::ceil(way.abs() / self.params.step_mm - 1e-9).max(1.0);
        let from = self.roller_mm;
        for i in 1..=steps as u32 {
            self.roller_mm = from + way * f64::from(i) / steps;
            self.settle()?;
        }
        Ok(())
    }

    /// From the right end to the left: the antegrade wave.
    ///
    /// # Errors
    /// The body does not come to rest.
    pub fn antegrade_stroke(&mut self) -> Result<(), NoAnswer> {
        self.roll_to(0.0)
    }

    /// Back home, to the right end.
    ///
    /// # Errors
    /// The body does not come to rest.
    pub fn returning_stroke(&mut self) -> Result<(), NoAnswer> {
        self.roll_to(self.params.stroke_mm)
    }

    /// Displacement of the core's tail end since the start, mm; + is headward (retrograde).
    pub fn displacement_mm(&self) -> f64 {
        self.core_tail_mm - self.params.core_tail_mm
    }

    fn m(&self) -> usize {
        self.params.wing.design.crescents().into()
    }

    /// The wall's effect on a crescent at x: its touch and the slope that it feels, positive if it pushes tailward.
    fn touch_at(&self, x_mm: f64) -> (Touch, f64) {
        let Params {
            radius_mm,
            preload_mm,
            ..
        } = self.params;
        let away_mm = x_mm - self.roller_mm;
        let wave_mm = wall_mm(self.indentation_mm, radius_mm, away_mm);
        let depth_mm = wave_mm + preload_mm - self.drawn_mm;
        if depth_mm <= 0.0 || self.touches.is_empty() {
            return (Touch::default(), 0.0);
        }
        let place = depth_mm / self.depth_step_mm;
        let index = (place as usize).min(SHARES - 1);
        let part = place - index as f64;
        let (low, high) = (self.touches[index], self.touches[index + 1]);
        let mix = |low: f64, high: f64| low + (high - low) * part;
        let touch = Touch {
            felt_mm: mix(low.felt_mm, high.felt_mm),
            force_n: mix(low.force_n, high.force_n),
            lever: mix(low.lever, high.lever),
        };
        let slope = if wave_mm > 0.0 {
            -away_mm / libm::sqrt(radius_mm * radius_mm - away_mm * away_mm)
        } else {
            0.0
        };
        // The dent passes on a share of the slope; the roller behind the sheet adds to it.
        let dent = touch.felt_mm / depth_mm;
        let backed = self.params.backed;
        (touch, slope * (backed + (1.0 - backed) * dent))
    }

    /// Axial forces, N, headward positive, of a crescent on a body that moves tailward (first) or headward (second).
    fn holds(&self, touch: Touch, slope: f64) -> (f64, f64) {
        let friction = self.params.friction;
        let weight_n = friction * self.params.weight_n / self.m() as f64;
        let force = |drag: f64| {
            let pull = (drag - slope) / (1.0 + drag * slope);
            // Beyond its lever the wing locks like a pawl, and holds until it buckles.
            let open = touch.lever - pull;
            if touch.force_n == 0.0 {
                0.0
            } else if pull > 0.0 && touch.force_n * touch.lever * pull >= self.lock_n * open {
                self.lock_n
            } else {
                touch.force_n * touch.lever * pull / open
            }
        };
        (force(friction) + weight_n, force(-friction) - weight_n)
    }

    /// Follows the wall to its present position, until the body holds.
    fn settle(&mut self) -> Result<(), NoAnswer> {
        let m = self.m();
        let design = self.params.wing.design;
        let rest_mm = design.squeezed_spacing_mm(self.drawn_mm)?;
        for _ in 0..MOST_DRIFTS {
            let old_mm = middles(&self.link_mm[..m]);
            let mut link_mm = self.link_mm;
            let mut holds = [(0.0, 0.0); LINKS];
            for i in 0..m {
                let (touch, slope) = self.touch_at(self.core_tail_mm + old_mm[i]);
                link_mm[i] = if touch.felt_mm > 0.0 {
                    design.squeezed_spacing_mm(self.drawn_mm + touch.felt_mm)?
                } else {
                    rest_mm
                };
                holds[i] = self.holds(touch, slope);
            }
            let new_mm = middles(&link_mm[..m]);
            let mut points = [(0.0, 0.0, 0.0); LINKS];
            for i in 0..m {
                points[i] = (new_mm[i] - old_mm[i], holds[i].0, holds[i].1);
            }
            self.link_mm = link_mm;
            match least_work_shift(&mut points[..m]) {
                Shift::To(by_mm) => {
                    self.core_tail_mm += by_mm;
                    return Ok(());
                }
                Shift::Tailward => self.core_tail_mm -= DRIFT_MM,
                Shift::Headward => self.core_tail_mm += DRIFT_MM,
            }
        }
        Err(NoAnswer::NoRest {
            roller_mm: self.roller_mm,
        })
    }
}

/// Divides a depth between the indentation of the wing and the dent in the wall.
fn touch(law: &Law, wall_n_mm: f64, thickness_mm: f64, depth_mm: f64) -> Touch {
    let (mut low, mut high) = (0.0, depth_mm);
    for _ in 0..60 {
        let middle = (low + high) / 2.0;
        let dent_mm = depth_mm - middle;
        // An upright wing dents the wall with its edge, a slanted one with its flank as well.
        let wide = 1.0 + dent_mm * law.lever(middle) / (2.0 * thickness_mm);
        if law.force_n(middle) < wall_n_mm * dent_mm * wide {
            low = middle;
        } else {
            high = middle;
        }
    }
    Touch {
        felt_mm: low,
        force_n: law.force_n(low),
        lever: law.lever(low),
    }
}

/// Movement of a body, as [`least_work_shift`] finds it.
enum Shift {
    To(f64),
    Tailward,
    Headward,
}

/// The shift S of least work. Each point is its own shift, the force if it moves tailward, and that if it moves
/// headward. The sum takes the tailward force of points with `S + delta < 0` and the headward force of the others; it
/// falls as S rises, and the result is where it changes its sign.
fn least_work_shift(points: &mut [(f64, f64, f64)]) -> Shift {
    points.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
    let mut force_n: f64 = points.iter().map(|point| point.1).sum();
    if force_n < 0.0 {
        return Shift::Tailward;
    }
    for (delta_mm, tailward_n, headward_n) in points.iter() {
        force_n += headward_n - tailward_n;
        if force_n <= 0.0 {
            return Shift::To(-delta_mm);
        }
    }
    Shift::Headward
}

/// Displacement after a whole run, mm, + headward.
///
/// # Errors
/// As [`ThreadedBody::new`]; a body that does not come to rest.
pub fn run(params: Params, thread_mm: f64, indentation_mm: f64) -> Result<Modelled<f64>, NoAnswer> {
    let mut body = ThreadedBody::new(params, thread_mm, indentation_mm)?;
    for _ in 0..params.cycles {
        body.antegrade_stroke()?;
        body.returning_stroke()?;
    }
    Ok(Modelled::new(body.displacement_mm()))
}
