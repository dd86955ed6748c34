//! The paper's simulation (section II.B): a pressurised tube of ten segments. A triangular pressure pulse runs through
//! them one after the other, from the right.
//!
//! A segment's wall follows its pressure at once; between the middles of two segments the wall is straight. Viscosity
//! and inertia are left out, and the internal pressure enters only through the calibrated critical pressure.

use crate::body::{self, Chain, FrictionRatio};
use crate::kinematics::Design;
use crate::range::{Ends, OutOfRange, check};

/// Most parts of a time step. A wall that collapses at once would need more, without a gain in accuracy.
const MOST_PARTS: f64 = 1e4;

/// Most segments that a tube may have.
pub const MAX_SEGMENTS: usize = 32;

/// The tube, its wave and the body in it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Params {
    /// The unfolded body.
    pub body: body::Params,
    /// Number of segments, `2..=32`.
    pub segments: u32,
    /// Length of a segment, mm.
    pub segment_mm: f64,
    /// Radius of the tube before the wave, mm.
    pub radius_mm: f64,
    /// Thickness of its wall, mm.
    pub thickness_mm: f64,
    /// Young's modulus of the wall, Pa.
    pub modulus_pa: f64,
    /// Poisson's ratio of the wall.
    pub poisson: f64,
    /// p_c: critical pressure at which the wall collapses, Pa.
    pub critical_pa: f64,
    /// w0: scale of the wall's early buckling, mm.
    pub buckling_mm: f64,
    /// Duration of a pulse, from zero to its peak and back, s.
    pub pulse_s: f64,
    /// Delay of each segment after its right neighbour, s.
    pub delay_s: f64,
    /// Time between two pulses of a segment, s.
    pub period_s: f64,
    /// Duration of a run, s.
    pub duration_s: f64,
    /// Time between two rows of a record, s.
    pub step_s: f64,
    /// Largest movement of a wall between two evaluations of the body, mm, approximately: a time step in which a wall
    /// moves farther is divided.
    pub wall_step_mm: f64,
    /// Number of starting places of the tail, evenly spread over one segment, that [`averaged`] takes the mean of.
    pub placements: u32,
}

impl Params {
    /// The paper's simulation with the body `one` of [`crate::model`]; its settings say where each value comes from.
    pub const PAPER: Self = Self {
        body: body::Params {
            design: Design::paper_tube(),
            coupling: 0.15,
            friction: 0.15,
            friction_ratio: FrictionRatio::Fixed(40.0),
            preload_mm: 0.0007,
            tail_mm: 0.0,
        },
        segments: 10,
        segment_mm: 8.4,
        radius_mm: 12.0,
        thickness_mm: 2.4,
        modulus_pa: 1e6,
        poisson: 0.49,
        critical_pa: 7125.0,
        buckling_mm: 0.06,
        pulse_s: 3.0,
        delay_s: 1.0,
        period_s: 10.0,
        duration_s: 20.0,
        step_s: 0.05,
        wall_step_mm: 0.02,
        placements: 16,
    };

    /// C_H: inward movement of a linear elastic wall per pressure, mm/Pa: `(1-nu^2) R^2 / (E t)`.
    pub fn compliance_mm_per_pa(&self) -> f64 {
        (1.0 - self.poisson * self.poisson) * self.radius_mm * self.radius_mm
            / (self.modulus_pa * self.thickness_mm)
    }

    /// Inward indentation of a segment's wall under a pressure, mm: `C_H p + w0 q/(1-q)` with `q = p/p_c`, limited by
    /// the core. From p_c on the wall lies against the core.
    pub fn wall_mm(&self, pressure_pa: f64) -> f64 {
        let core_mm = self.body.design.half_gap_mm();
        let q = pressure_pa / self.critical_pa;
        if q >= 1.0 {
            return core_mm;
        }
        let free_mm = self.compliance_mm_per_pa() * pressure_pa + self.buckling_mm * q / (1.0 - q);
        if free_mm < core_mm { free_mm } else { core_mm }
    }

    /// Pressure of a segment, counted from the right, at a time since the start, as a fraction of the peak.
    fn pulse(&self, from_right: u32, time_s: f64) -> f64 {
        let since_s = time_s - f64::from(from_right) * self.delay_s;
        if since_s < 0.0 {
            return 0.0;
        }
        let phase_s = since_s - libm::floor(since_s / self.period_s) * self.period_s;
        let half_s = self.pulse_s / 2.0;
        if phase_s < half_s {
            phase_s / half_s
        } else if phase_s < self.pulse_s {
            (self.pulse_s - phase_s) / half_s
        } else {
            0.0
        }
    }
}

/// The tube with the unfolded body in it.
#[derive(Clone, Debug)]
pub struct Tube {
    params: Params,
    pressure_pa: f64,
    chain: Chain,
    steps: u32,
    /// Wall of each segment, left to right, mm.
    wall_mm: [f64; MAX_SEGMENTS],
}

impl Tube {
    /// The tube at rest, before the first pulse of `pressure_pa` at its peak.
    ///
    /// # Errors
    /// The first parameter outside its range; a pressure that is negative or NaN.
    pub fn new(params: Params, pressure_pa: f64) -> Result<Self, OutOfRange> {
        check(
            "peristaltic pressure",
            "Pa",
            pressure_pa,
            (0.0, 1e6),
            Ends::Closed,
            "the wave squeezes",
        )?;
        check(
            "number of segments",
            "",
            params.segments.into(),
            (2.0, MAX_SEGMENTS as f64),
            Ends::Closed,
            "the wave travels from segment to segment",
        )?;
        check(
            "number of placements",
            "",
            params.placements.into(),
            (1.0, 1e3),
            Ends::Closed,
            "the mean is taken over them",
        )?;
        for (quantity, unit, value, most) in [
            ("segment length", "mm", params.segment_mm, 1e3),
            ("tube radius", "mm", params.radius_mm, 1e3),
            ("wall thickness", "mm", params.thickness_mm, 1e3),
            ("Young's modulus", "Pa", params.modulus_pa, 1e12),
            ("critical pressure", "Pa", params.critical_pa, 1e6),
            ("pulse length", "s", params.pulse_s, params.period_s),
            ("pulse period", "s", params.period_s, 1e3),
            ("duration", "s", params.duration_s, 1e4),
            ("time step", "s", params.step_s, params.pulse_s),
            ("wall step", "mm", params.wall_step_mm, 1e3),
        ] {
            check(
                quantity,
                unit,
                value,
                (0.0, most),
                Ends::OpenBelow,
                "the model needs it positive and no larger",
            )?;
        }
        for (quantity, unit, value, most) in [
            ("Poisson's ratio", "", params.poisson, 0.5),
            ("buckling scale", "mm", params.buckling_mm, 100.0),
            ("delay between segments", "s", params.delay_s, 1e3),
        ] {
            check(
                quantity,
                unit,
                value,
                (0.0, most),
                Ends::Closed,
                "the model needs it no smaller and no larger",
            )?;
        }
        Ok(Self {
            params,
            pressure_pa,
            chain: Chain::new(params.body)?,
            steps: 0,
            wall_mm: [0.0; MAX_SEGMENTS],
        })
    }

    /// Advances by one time step, divided into parts as [`Params::wall_step_mm`] requires.
    ///
    /// # Errors
    /// None after a successful [`Tube::new`].
    pub fn step(&mut self) -> Result<(), OutOfRange> {
        let from_s = self.time_s();
        self.steps += 1;
        let to_s = self.time_s();
        let before = self.wall_mm;
        self.press(to_s);
        let moved_mm = before
            .iter()
            .zip(&self.wall_mm)
            .map(|(before, after)| libm::fabs(after - before))
            .fold(0.0, f64::max);
        let parts = libm::ceil(moved_mm / self.params.wall_step_mm).clamp(1.0, MOST_PARTS);
        for part in 1..parts as u32 {
            self.press(from_s + (to_s - from_s) * f64::from(part) / parts);
            self.squeeze()?;
        }
        self.press(to_s);
        self.squeeze()
    }

    /// Sets each segment's wall for a time.
    fn press(&mut self, time_s: f64) {
        let count = self.params.segments as usize;
        for (from_right, wall) in (0..).zip(self.wall_mm[..count].iter_mut().rev()) {
            let pulse = self.params.pulse(from_right, time_s);
            // A shortcut: without a pulse, as in most segments, the formula also gives exactly 0.
            *wall = if pulse == 0.0 {
                0.0
            } else {
                self.params.wall_mm(self.pressure_pa * pulse)
            };
        }
    }

    /// Moves the body according to the walls.
    fn squeeze(&mut self) -> Result<(), OutOfRange> {
        let count = self.params.segments as usize;
        let (walls, segment_mm) = (&self.wall_mm[..count], self.params.segment_mm);
        self.chain
            .step(|x| between_middles(walls, x / segment_mm - 0.5))
    }

    /// Time since the start, s.
    pub fn time_s(&self) -> f64 {
        f64::from(self.steps) * self.params.step_s
    }

    /// Inward indentation of each segment's wall, left to right, mm.
    pub fn walls_mm(&self) -> &[f64] {
        &self.wall_mm[..self.params.segments as usize]
    }

    /// Inward indentation of the wall at a place, mm from the tube's left end.
    pub fn wall_at_mm(&self, x_mm: f64) -> f64 {
        between_middles(self.walls_mm(), x_mm / self.params.segment_mm - 0.5)
    }

    /// Displacement of the tail since the start, mm; + is headward (retrograde).
    pub fn displacement_mm(&self) -> f64 {
        self.chain.displacement_mm()
    }

    /// Displacement of the head since the start, mm.
    pub fn head_displacement_mm(&self) -> f64 {
        self.chain.head_displacement_mm()
    }

    /// The body, for drawing.
    pub fn body(&self) -> &Chain {
        &self.chain
    }
}

/// Indentation of the wall at a place in segments from the middle of the leftmost one: linear between two middles,
/// constant beyond the outer ones.
fn between_middles(walls: &[f64], place: f64) -> f64 {
    let last = walls.len() - 1;
    if place <= 0.0 {
        return walls[0];
    }
    let below = place as usize;
    if below >= last {
        return walls[last];
    }
    let part = place - below as f64;
    (1.0 - part) * walls[below] + part * walls[below + 1]
}

/// Number of time steps of a run.
pub fn steps(params: &Params) -> u32 {
    libm::round(params.duration_s / params.step_s) as u32
}

/// One run from one starting place: displacement of the tail in mm after the whole duration, + headward.
///
/// # Errors
/// As [`Tube::new`].
pub fn run(params: Params, pressure_pa: f64) -> Result<f64, OutOfRange> {
    let mut tube = Tube::new(params, pressure_pa)?;
    for _ in 0..steps(&params) {
        tube.step()?;
    }
    Ok(tube.displacement_mm())
}

/// The starting places over which [`averaged`] takes the mean: the middles of equal parts of one segment, from
/// `params.body.tail_mm` on. The paper does not say where the body lay relative to the segments.
pub fn placed(params: Params) -> impl ExactSizeIterator<Item = Params> + Clone {
    (0..params.placements).map(move |place| {
        let part = (f64::from(place) + 0.5) / f64::from(params.placements);
        let mut placed = params;
        placed.body.tail_mm += part * params.segment_mm;
        placed
    })
}

/// Displacement after the whole duration, from several starting places.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Averaged {
    /// Mean displacement of the tail, mm, + headward.
    pub tail_mm: f64,
    /// Mean displacement of the head, mm. Less than that of the tail by the shortening of a body still squeezed at
    /// the end.
    pub head_mm: f64,
    /// Least and greatest displacement of the tail.
    pub range_mm: (f64, f64),
}

/// The paper's simulation: mean over the starting places of [`placed`].
///
/// # Errors
/// As [`Tube::new`].
pub fn averaged(params: Params, pressure_pa: f64) -> Result<Averaged, OutOfRange> {
    Tube::new(params, pressure_pa)?; // refuse bad parameters even without a placement
    let mut mean = Averaged {
        tail_mm: 0.0,
        head_mm: 0.0,
        range_mm: (f64::INFINITY, f64::NEG_INFINITY),
    };
    let fraction = 1.0 / f64::from(params.placements);
    for params in placed(params) {
        let mut tube = Tube::new(params, pressure_pa)?;
        for _ in 0..steps(&params) {
            tube.step()?;
        }
        let tail_mm = tube.displacement_mm();
        mean.tail_mm += fraction * tail_mm;
        mean.head_mm += fraction * tube.head_displacement_mm();
        mean.range_mm = (mean.range_mm.0.min(tail_mm), mean.range_mm.1.max(tail_mm));
    }
    Ok(mean)
}
