//! The paper's simulation (section II.B): a pressurised tube of ten segments. A triangular pressure pulse runs through
//! them one after the other, from the right.
//!
//! A segment's wall follows its pressure at once; between the middles of two segments the wall is straight. Viscosity
//! and inertia are left out, and the internal pressure enters only through the calibrated critical pressure.

use crate::body::{self, Chain};
use crate::kinematics::Design;
use crate::parameter::{Label, Parameter, row};
use crate::range::{Ends, OutOfRange, check};

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
    /// Delay of each segment against its right neighbour, s.
    pub delay_s: f64,
    /// Time between two pulses of a segment, s.
    pub period_s: f64,
    /// Duration of a run, s.
    pub duration_s: f64,
    /// Time step of the model, s.
    pub step_s: f64,
}

impl Params {
    /// The paper's simulation; `PARAMETERS` says where each value comes from.
    pub const PAPER: Self = Self {
        body: body::Params {
            design: Design::paper_tube(),
            coupling: 1.0,
            friction: 0.15,
            friction_ratio: 1.222,
            preload_mm: 0.17,
            tail_mm: 0.0,
        },
        segments: 10,
        segment_mm: 8.4,
        radius_mm: 12.0,
        thickness_mm: 2.4,
        modulus_pa: 1e6,
        poisson: 0.49,
        critical_pa: 7100.0,
        buckling_mm: 0.09,
        pulse_s: 3.0,
        delay_s: 1.0,
        period_s: 10.0,
        duration_s: 20.0,
        step_s: 0.05,
    };

    /// C_H: inward movement of a linear elastic wall per pressure, mm/Pa: `(1-nu^2) R^2 / (E t)`.
    pub fn compliance_mm_per_pa(&self) -> f64 {
        (1.0 - self.poisson * self.poisson) * self.radius_mm * self.radius_mm
            / (self.modulus_pa * self.thickness_mm)
    }

    /// Inward indentation of a segment's wall under a pressure, mm: `C_H p + w0 q/(1-q)` with `q = p/p_c`, at most to
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

    /// Pressure of a segment, counted from the right, at a time after the start, as a fraction of the peak.
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

/// Each parameter of [`Params::PAPER`], its label and its source.
pub const PARAMETERS: [Parameter; 23] = {
    use Label::{Assumed, Calibrated, Derived, Paper};
    let p = Params::PAPER;
    let d = p.body.design;
    [
        row(
            "body.design.width_mm",
            d.width_mm(),
            "mm",
            Paper,
            "II.B: as wide as the tube's inner diameter",
        ),
        row(
            "body.design.core_mm",
            d.core_mm(),
            "mm",
            Derived,
            "II.A: c is 1/5 of the width",
        ),
        row(
            "body.design.tan_alpha",
            d.tan_alpha(),
            "",
            Derived,
            "2/9: II.A prints 12.53 deg, its arctangent",
        ),
        row(
            "body.design.tan_beta",
            d.tan_beta(),
            "",
            Derived,
            "2/3: II.A prints 33.69 deg, its arctangent",
        ),
        row(
            "body.design.crescents",
            d.crescents() as f64,
            "",
            Paper,
            "II.A: m = 9",
        ),
        row(
            "body.coupling",
            p.body.coupling,
            "",
            Assumed,
            "the tube's wall lies on the wing along its whole rim",
        ),
        row(
            "body.friction",
            p.body.friction,
            "",
            Paper,
            "II.B: 0.15 in the pressure series; it cancels",
        ),
        row(
            "body.friction_ratio",
            p.body.friction_ratio,
            "",
            Assumed,
            "fixed, not fitted; 1 + tan(alpha) to three decimals",
        ),
        row(
            "body.preload_mm",
            p.body.preload_mm,
            "mm",
            Calibrated,
            "II.C: about 1 mm at 3000 Pa, about 15 mm at 7000 Pa",
        ),
        row(
            "body.tail_mm",
            p.body.tail_mm,
            "mm",
            Paper,
            "II.B: on the left side in the intestine",
        ),
        row(
            "segments",
            p.segments as f64,
            "",
            Paper,
            "II.B: 10 segments",
        ),
        row(
            "segment_mm",
            p.segment_mm,
            "mm",
            Paper,
            "II.B: of 8.4 mm, 84 mm in all",
        ),
        row(
            "radius_mm",
            p.radius_mm,
            "mm",
            Paper,
            "II.B: diameter 24.00 mm, read as the inner one",
        ),
        row("thickness_mm", p.thickness_mm, "mm", Paper, "II.B"),
        row("modulus_pa", p.modulus_pa, "Pa", Paper, "II.B: 1 MPa"),
        row(
            "poisson",
            p.poisson,
            "",
            Assumed,
            "nearly incompressible tissue",
        ),
        row(
            "critical_pa",
            p.critical_pa,
            "Pa",
            Calibrated,
            "II.B: above 7000 Pa the wall is severely shrunk",
        ),
        row(
            "buckling_mm",
            p.buckling_mm,
            "mm",
            Calibrated,
            "II.C: about 1 mm at 3000 Pa, about 15 mm at 7000 Pa",
        ),
        row(
            "pulse_s",
            p.pulse_s,
            "s",
            Paper,
            "II.B: up in 1.5 s and down in 1.5 s",
        ),
        row(
            "delay_s",
            p.delay_s,
            "s",
            Paper,
            "II.B: at 1 s intervals from the right end",
        ),
        row(
            "period_s",
            p.period_s,
            "s",
            Assumed,
            "one wave follows the other: 10 segments at 1 s",
        ),
        row("duration_s", p.duration_s, "s", Paper, "II.B: within 20 s"),
        row("step_s", p.step_s, "s", Assumed, "resolution of the model"),
    ]
};

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

    /// Advances by one time step.
    ///
    /// # Errors
    /// None after a successful [`Tube::new`].
    pub fn step(&mut self) -> Result<(), OutOfRange> {
        self.steps += 1;
        let time_s = self.time_s();
        let count = self.params.segments as usize;
        for (from_right, wall) in (0..).zip(self.wall_mm[..count].iter_mut().rev()) {
            *wall = self
                .params
                .wall_mm(self.pressure_pa * self.params.pulse(from_right, time_s));
        }
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

    /// How far the tail has moved since the start, mm; + is headward (retrograde).
    pub fn displacement_mm(&self) -> f64 {
        self.chain.displacement_mm()
    }

    /// The body, for drawing.
    pub fn body(&self) -> &Chain {
        &self.chain
    }
}

/// Wall at a place that is counted in segments from the middle of the leftmost one: straight between two middles, level
/// beyond the outer ones.
fn between_middles(walls: &[f64], place: f64) -> f64 {
    let last = walls.len() - 1;
    if place <= 0.0 {
        return walls[0];
    }
    let left = place as usize;
    if left >= last {
        return walls[last];
    }
    let part = place - left as f64;
    (1.0 - part) * walls[left] + part * walls[left + 1]
}

/// The paper's simulation: displacement of the tail in mm after the whole duration, + headward.
///
/// # Errors
/// As [`Tube::new`].
pub fn run(params: Params, pressure_pa: f64) -> Result<f64, OutOfRange> {
    let mut tube = Tube::new(params, pressure_pa)?;
    let steps = libm::round(params.duration_s / params.step_s) as u32;
    for _ in 0..steps {
        tube.step()?;
    }
    Ok(tube.displacement_mm())
}
