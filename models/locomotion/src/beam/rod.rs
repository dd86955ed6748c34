//! The planar rod: inextensible, clamped at its root, with any rotation; discrete angles, Newton with line search.
//!
//! The rod is divided into N segments of equal length `ds` with the angles `theta_j`. Each joint between two segments
//! stores the bending energy `B (theta_(j+1) - theta_j)^2 / (2 ds)`. The joint between clamp and first segment is
//! half as long and stores `B (theta_1 - theta_0)^2 / ds`. Both rules are of the midpoint kind, so the error falls
//! with 1/N^2. A force at a node makes the stiffness tridiagonal plus a diagonal; contact adds a border of two
//! unknowns, the force's components.

use alloc::vec;
use alloc::vec::Vec;

use crate::beam::NoAnswer;
use crate::range::{Ends, check};

/// A vector in the plane: x outward along the unturned rod, y to its left.
pub type Vector = [f64; 2];

/// Largest number of segments.
const MOST_ELEMENTS: u16 = 2000;

/// Largest residual in equilibrium, relative to the rod's own forces.
const TOLERANCE: f64 = 1e-10;
const MOST_ITERATIONS: usize = 25;
/// A load that does not converge is divided, down to this share of itself.
const SMALLEST_STEP: f64 = 1.0 / 4096.0;

/// Properties of a rod.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Properties {
    /// Length, mm.
    pub length_mm: f64,
    /// Bending stiffness E I, N mm^2.
    pub bending_n_mm2: f64,
    /// Angle of the clamp to the x axis, radians.
    pub root_rad: f64,
    /// Number of segments, 2 to 2000.
    pub elements: u16,
    /// Angle of a guided tip, which may move but not turn, radians; `None` for a free tip.
    pub guided_tip_rad: Option<f64>,
}

/// An obstacle that presses against a node of the rod.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Wall {
    /// A plane at the distance `x_mm` from the root: the rod stays below it.
    Plane {
        /// Distance from the root, mm.
        x_mm: f64,
        /// Slope of the plane, dx/dy: with a positive slope the room grows towards +y.
        slope: f64,
    },
    /// The outside of a roller: the rod stays out of its circle.
    Roller {
        /// Centre, mm.
        centre_mm: Vector,
        /// Radius, mm.
        radius_mm: f64,
    },
}

impl Wall {
    /// Distance of a point from the wall, mm, negative inside it, and the unit normal that points out of the wall.
    fn gap(&self, [x, y]: Vector) -> (f64, Vector) {
        match *self {
            Self::Plane { x_mm, slope } => {
                let scale = 1.0 / libm::sqrt(1.0 + slope * slope);
                ((x_mm + slope * y - x) * scale, [-scale, slope * scale])
            }
            Self::Roller {
                centre_mm,
                radius_mm,
            } => {
                let (dx, dy) = (x - centre_mm[0], y - centre_mm[1]);
                let distance = libm::sqrt(dx * dx + dy * dy);
                (distance - radius_mm, [dx / distance, dy / distance])
            }
        }
    }

    /// Curvature of the wall, 1/mm: how fast the normal turns along the tangent.
    fn curvature(&self, point: Vector) -> f64 {
        match *self {
            Self::Plane { .. } => 0.0,
            Self::Roller { radius_mm, .. } => 1.0 / (radius_mm + self.gap(point).0),
        }
    }

    /// The same wall, moved along x.
    fn moved(self, by_mm: f64) -> Self {
        match self {
            Self::Plane { x_mm, slope } => Self::Plane {
                x_mm: x_mm + by_mm,
                slope,
            },
            Self::Roller {
                centre_mm: [x, y],
                radius_mm,
            } => Self::Roller {
                centre_mm: [x + by_mm, y],
                radius_mm,
            },
        }
    }
}

/// A rod in equilibrium with its load.
#[derive(Clone, Debug)]
pub struct Rod {
    properties: Properties,
    segment_mm: f64,
    /// Angles of the segments, radians.
    angles_rad: Vec<f64>,
    /// The acting force, N, and the point it acts on, in segments from the root.
    force_n: Vector,
    loaded_at: f64,
    /// Moment at the tip, N mm.
    moment_n_mm: f64,
}

impl Rod {
    /// A straight rod without load.
    ///
    /// # Errors
    /// The first property outside its range.
    pub fn new(properties: Properties) -> Result<Self, NoAnswer> {
        check(
            "rod length",
            "mm",
            properties.length_mm,
            (0.0, 1e4),
            Ends::OpenBelow,
            "it is a length",
        )?;
        check(
            "bending stiffness",
            "N mm^2",
            properties.bending_n_mm2,
            (0.0, 1e12),
            Ends::OpenBelow,
            "without stiffness nothing holds the rod",
        )?;
        check(
            "angle of the clamp",
            "rad",
            properties.root_rad,
            (-10.0, 10.0),
            Ends::Closed,
            "it is an angle",
        )?;
        check(
            "number of elements",
            "",
            properties.elements.into(),
            (2.0, MOST_ELEMENTS.into()),
            Ends::Closed,
            "one cannot bend, more cost time for nothing",
        )?;
        if let Some(angle) = properties.guided_tip_rad {
            check(
                "angle of the guided tip",
                "rad",
                angle,
                (-10.0, 10.0),
                Ends::Closed,
                "it is an angle",
            )?;
        }
        let n = usize::from(properties.elements);
        Ok(Self {
            properties,
            segment_mm: properties.length_mm / f64::from(properties.elements),
            angles_rad: vec![properties.root_rad; n],
            force_n: [0.0; 2],
            loaded_at: n as f64,
            moment_n_mm: 0.0,
        })
    }

    /// Loads the tip with a dead force and a moment, in as many steps as needed.
    ///
    /// # Errors
    /// A load that is not finite, or no equilibrium on the way.
    pub fn load_tip(&mut self, force_n: Vector, moment_n_mm: f64) -> Result<(), NoAnswer> {
        for value in [force_n[0], force_n[1], moment_n_mm] {
            check(
                "load",
                "N or N mm",
                value,
                (-1e9, 1e9),
                Ends::Closed,
                "it is a load",
            )?;
        }
        let (from, from_moment) = (self.force_n, self.moment_n_mm);
        self.loaded_at = self.angles_rad.len() as f64;
        let mix = |from: f64, to: f64, part: f64| from + (to - from) * part;
        self.in_steps(force_n[1], |rod, part| {
            rod.force_n = [
                mix(from[0], force_n[0], part),
                mix(from[1], force_n[1], part),
            ];
            rod.moment_n_mm = mix(from_moment, moment_n_mm, part);
            rod.newton(None)
        })
    }

    /// Presses the wall against the rod, from clear of it to `wall`. `friction` is the signed ratio of tangential to
    /// normal force: positive if the wall drags the rod towards +y, negative towards -y.
    ///
    /// The contact is at the node deepest inside the wall, at first the tip. A wall that does not reach the rod
    /// leaves it unloaded.
    ///
    /// # Errors
    /// A friction beyond 10, or no equilibrium on the way.
    pub fn press(&mut self, wall: Wall, friction: f64) -> Result<(), NoAnswer> {
        check(
            "friction coefficient",
            "",
            friction,
            (-10.0, 10.0),
            Ends::Closed,
            "it is a friction",
        )?;
        self.force_n = [0.0; 2];
        self.moment_n_mm = 0.0;
        self.angles_rad.fill(self.properties.root_rad);
        let (deepest, gap) = self.deepest(&wall);
        if gap >= 0.0 {
            return Ok(());
        }
        self.loaded_at = deepest as f64;
        // Bisect the shift along x at which the wall just touches the straight rod.
        let (mut low, mut high) = (0.0, 2.0 * self.properties.length_mm);
        for _ in 0..60 {
            let middle = (low + high) / 2.0;
            if self.deepest(&wall.moved(middle)).1 < 0.0 {
                low = middle;
            } else {
                high = middle;
            }
        }
        self.press_on(wall, high, friction)
    }

    /// Presses on from an equilibrium, with the same wall moved `by_mm` outward.
    ///
    /// # Errors
    /// No equilibrium on the way.
    pub(crate) fn press_on(
        &mut self,
        wall: Wall,
        by_mm: f64,
        friction: f64,
    ) -> Result<(), NoAnswer> {
        self.in_steps(by_mm, |rod, part| {
            rod.touch(wall.moved(by_mm * (1.0 - part)), friction)
        })
    }

    /// Finds the equilibrium with a wall that touches the rod at its deepest node. The error is the residual.
    fn touch(&mut self, wall: Wall, friction: f64) -> Result<(), f64> {
        let clear = -1e-9 * self.properties.length_mm;
        let mut outward = None;
        for _ in 0..2 * self.angles_rad.len() {
            self.newton(Some((wall, friction)))?;
            let (x, y) = (self.force_n[0], self.force_n[1]);
            let normal = wall.gap(self.point(self.loaded_at)).1;
            let pushed_n = x * normal[0] + y * normal[1];
            if pushed_n * self.properties.length_mm < -1e-6 * self.scale_n_mm() {
                return Err(1.0); // a wall does not pull
            }
            let (deepest, gap) = self.deepest(&wall);
            if gap > clear || deepest as f64 == self.loaded_at {
                return Ok(());
            }
            // Move one node at a time: if the contact jumped, the rod would snap through the wall behind it.
            let further = deepest as f64 > self.loaded_at;
            let node = libm::floor(self.loaded_at);
            let whole = node == self.loaded_at;
            if outward == Some(!further) {
                let inner = if further || !whole { node } else { node - 1.0 };
                return self.lie_on(wall, friction, inner as usize);
            }
            outward = Some(further);
            self.loaded_at = match (further, whole) {
                (true, _) => node + 1.0,
                (false, true) => node - 1.0,
                (false, false) => node,
            };
        }
        Err(1.0)
    }

    /// The wall touches the segment behind this node: finds the contact point at which both ends are equally far from
    /// it.
    fn lie_on(&mut self, wall: Wall, friction: f64, node: usize) -> Result<(), f64> {
        let nodes = [node as f64, (node + 1) as f64];
        // A contact nearer to the deeper end lifts that end out, so the difference of the gaps has one zero. Find it
        // by regula falsi with the halved weight that keeps either end from sticking (the Illinois rule).
        let mut ends: [Option<f64>; 2] = [None, None];
        let [mut low, mut high] = nodes;
        for _ in 0..40 {
            self.loaded_at = match ends {
                [Some(first), Some(last)] => low + (high - low) * first / (first - last),
                _ => (low + high) / 2.0,
            };
            self.newton(Some((wall, friction)))?;
            let [inner, outer] = nodes.map(|at| wall.gap(self.point(at)).0);
            let difference = inner - outer;
            if difference.abs() < 1e-6 * self.properties.length_mm || high - low < 1e-9 {
                break;
            }
            if difference < 0.0 {
                high = self.loaded_at;
                ends = [ends[0].map(|first| first / 2.0), Some(difference)];
            } else {
                low = self.loaded_at;
                ends = [Some(difference), ends[1].map(|last| last / 2.0)];
            }
        }
        Ok(())
    }

    /// Goes from share 0 to share 1 of a load; a failed step is repeated with half the width.
    fn in_steps(
        &mut self,
        at: f64,
        mut load: impl FnMut(&mut Self, f64) -> Result<(), f64>,
    ) -> Result<(), NoAnswer> {
        let (mut done, mut step): (f64, f64) = (0.0, 1.0);
        while done < 1.0 {
            let before = self.clone();
            let part = if done + step > 1.0 { 1.0 } else { done + step };
            match load(self, part) {
                Ok(()) => {
                    done = part;
                    step *= 1.5;
                }
                Err(residual) => {
                    *self = before;
                    step /= 4.0;
                    if step < SMALLEST_STEP {
                        return Err(NoAnswer::NoEquilibrium {
                            at: at * part,
                            residual,
                        });
                    }
                }
            }
        }
        Ok(())
    }

    /// Position of a point that lies `at` segments from the root, mm.
    fn point(&self, at: f64) -> Vector {
        let (mut x, mut y) = (0.0, 0.0);
        for (j, angle) in self.angles_rad.iter().enumerate() {
            let part_mm = self.segment_mm * part(at, j);
            x += part_mm * libm::cos(*angle);
            y += part_mm * libm::sin(*angle);
        }
        [x, y]
    }

    /// All nodes from root to tip, mm.
    pub fn nodes_mm(&self) -> Vec<Vector> {
        (0..=self.angles_rad.len())
            .map(|node| self.point(node as f64))
            .collect()
    }

    /// Position of the tip, mm.
    pub fn tip_mm(&self) -> Vector {
        self.point(self.angles_rad.len() as f64)
    }

    /// Angle at the tip, radians.
    pub fn tip_rad(&self) -> f64 {
        if let Some(angle) = self.properties.guided_tip_rad {
            return angle;
        }
        let last = self.angles_rad[self.angles_rad.len() - 1];
        last + self.moment_n_mm * self.segment_mm / (2.0 * self.properties.bending_n_mm2)
    }

    /// The force on the rod, N.
    pub fn force_n(&self) -> Vector {
        self.force_n
    }

    /// Bending moment at the clamp, N mm, positive if it turns the rod towards +y.
    pub fn root_moment_n_mm(&self) -> f64 {
        2.0 * self.properties.bending_n_mm2 * (self.angles_rad[0] - self.properties.root_rad)
            / self.segment_mm
    }

    /// Energy of bending, N mm.
    pub fn energy_n_mm(&self) -> f64 {
        let stiffness = self.properties.bending_n_mm2 / self.segment_mm;
        let first = self.angles_rad[0] - self.properties.root_rad;
        let joints = self
            .angles_rad
            .windows(2)
            .map(|pair| (pair[1] - pair[0]) * (pair[1] - pair[0]) / 2.0)
            .sum::<f64>();
        // The guide or the moment bends the last half segment as well.
        let last = self.tip_rad() - self.angles_rad[self.angles_rad.len() - 1];
        stiffness * (first * first + joints + last * last)
    }

    /// Whether the equilibrium is stable against small changes while the force keeps size and direction: all pivots
    /// of the stiffness are positive.
    pub fn is_stable_under_dead_load(&self) -> bool {
        let mut pivot = f64::INFINITY;
        let off = -self.properties.bending_n_mm2 / self.segment_mm;
        self.diagonal().iter().all(|diagonal| {
            pivot = diagonal - off * off / pivot;
            pivot > 0.0
        })
    }

    /// The node deepest inside the wall, and its gap, mm.
    fn deepest(&self, wall: &Wall) -> (usize, f64) {
        let (mut x, mut y) = (0.0, 0.0);
        let mut found = (self.angles_rad.len(), f64::INFINITY);
        for (index, angle) in self.angles_rad.iter().enumerate() {
            x += self.segment_mm * libm::cos(*angle);
            y += self.segment_mm * libm::sin(*angle);
            let gap = wall.gap([x, y]).0;
            if gap <= found.1 {
                found = (index + 1, gap);
            }
        }
        found
    }

    /// Gradient of the energy minus the work of the load.
    fn imbalance(&self) -> Vec<f64> {
        let n = self.angles_rad.len();
        let stiffness = self.properties.bending_n_mm2 / self.segment_mm;
        let mut gradient = vec![0.0; n];
        gradient[0] = 2.0 * stiffness * (self.angles_rad[0] - self.properties.root_rad);
        for j in 1..n {
            let moment = stiffness * (self.angles_rad[j] - self.angles_rad[j - 1]);
            gradient[j] += moment;
            gradient[j - 1] -= moment;
        }
        gradient[n - 1] -= self.moment_n_mm;
        if let Some(angle) = self.properties.guided_tip_rad {
            gradient[n - 1] += 2.0 * stiffness * (self.angles_rad[n - 1] - angle);
        }
        for (j, value) in gradient.iter_mut().enumerate() {
            let (sin, cos) = libm::sincos(self.angles_rad[j]);
            *value -= self.segment_mm
                * part(self.loaded_at, j)
                * (self.force_n[1] * cos - self.force_n[0] * sin);
        }
        gradient
    }

    fn diagonal(&self) -> Vec<f64> {
        let n = self.angles_rad.len();
        let stiffness = self.properties.bending_n_mm2 / self.segment_mm;
        let mut diagonal = vec![2.0 * stiffness; n];
        diagonal[0] = 3.0 * stiffness;
        diagonal[n - 1] += match self.properties.guided_tip_rad {
            Some(_) => stiffness,
            None => -stiffness,
        };
        for (j, value) in diagonal.iter_mut().enumerate() {
            let (sin, cos) = libm::sincos(self.angles_rad[j]);
            *value += self.segment_mm
                * part(self.loaded_at, j)
                * (self.force_n[0] * cos + self.force_n[1] * sin);
        }
        diagonal
    }

    /// Newton's method with a line search on the residual. The error is the remaining residual.
    fn newton(&mut self, contact: Option<(Wall, f64)>) -> Result<(), f64> {
        let mut residual = self.residual(contact);
        for _ in 0..MOST_ITERATIONS {
            if residual < TOLERANCE {
                return Ok(());
            }
            let (turn, force) = self.direction(contact).ok_or(residual)?;
            let start = (self.angles_rad.clone(), self.force_n);
            let mut width = 1.0;
            loop {
                for (angle, (from, by)) in self.angles_rad.iter_mut().zip(start.0.iter().zip(&turn))
                {
                    *angle = from + width * by;
                }
                self.force_n = [start.1[0] + width * force[0], start.1[1] + width * force[1]];
                let now = self.residual(contact);
                if now <= (1.0 - 0.1 * width) * residual || now < TOLERANCE {
                    residual = now;
                    break;
                }
                width /= 2.0;
                if width < 0.01 {
                    return Err(residual);
                }
            }
        }
        Err(residual)
    }

    /// Scale of the rod's own moment. Allows for the rounding in the joints, which are N times as stiff.
    fn scale_n_mm(&self) -> f64 {
        let fine = f64::from(self.properties.elements).max(16.0) / 16.0;
        fine * self.properties.bending_n_mm2 / self.properties.length_mm
    }

    /// Greatest imbalance, that of the contact included, relative to the rod's own moment `B/L`.
    fn residual(&self, contact: Option<(Wall, f64)>) -> f64 {
        let scale = self.scale_n_mm();
        let turn = self
            .imbalance()
            .iter()
            .fold(0.0, |most: f64, value| most.max(value.abs()));
        let contact = contact.map_or(0.0, |(wall, friction)| {
            let (gap, normal) = wall.gap(self.point(self.loaded_at));
            let edge = across(normal, friction);
            let off = edge[0] * self.force_n[0] + edge[1] * self.force_n[1];
            (gap.abs() / self.properties.length_mm)
                .max(off.abs() * self.properties.length_mm / scale)
        });
        contact.max(turn / scale)
    }

    /// The step of Newton's method: turn of each segment and change of the force.
    fn direction(&self, contact: Option<(Wall, f64)>) -> Option<(Vec<f64>, Vector)> {
        let off = -self.properties.bending_n_mm2 / self.segment_mm;
        let diagonal = self.diagonal();
        let minus: Vec<f64> = self.imbalance().iter().map(|value| -value).collect();
        let free = tridiagonal(&diagonal, off, minus)?;
        let Some((wall, friction)) = contact else {
            return Some((free, [0.0; 2]));
        };
        // Derivatives of the node's position by the angles.
        let n = self.angles_rad.len();
        let mut rows = [vec![0.0; n], vec![0.0; n]];
        for (j, angle) in self.angles_rad.iter().enumerate() {
            let (sin, cos) = libm::sincos(*angle);
            let part_mm = self.segment_mm * part(self.loaded_at, j);
            rows[0][j] = -part_mm * sin;
            rows[1][j] = part_mm * cos;
        }
        let by = [
            tridiagonal(&diagonal, off, rows[0].clone())?,
            tridiagonal(&diagonal, off, rows[1].clone())?,
        ];
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let moves = [dot(&rows[0], &free), dot(&rows[1], &free)];
        let compliance = [
            [dot(&rows[0], &by[0]), dot(&rows[0], &by[1])],
            [dot(&rows[1], &by[0]), dot(&rows[1], &by[1])],
        ];
        let place = self.point(self.loaded_at);
        let (gap, normal) = wall.gap(place);
        let edge = across(normal, friction);
        // Along the tangent the normal turns by the curvature, and so does the edge of the friction cone.
        let tangent = [-normal[1], normal[0]];
        let turned = across(tangent, friction);
        let swing =
            wall.curvature(place) * (turned[0] * self.force_n[0] + turned[1] * self.force_n[1]);
        let by_place = [normal, [swing * tangent[0], swing * tangent[1]]];
        let mut matrix = [[0.0; 2]; 2];
        let mut right = [
            -gap,
            -(edge[0] * self.force_n[0] + edge[1] * self.force_n[1]),
        ];
        for row in 0..2 {
            for column in 0..2 {
                matrix[row][column] = by_place[row][0] * compliance[0][column]
                    + by_place[row][1] * compliance[1][column];
            }
            right[row] -= by_place[row][0] * moves[0] + by_place[row][1] * moves[1];
        }
        matrix[1][0] += edge[0];
        matrix[1][1] += edge[1];
        let determinant = matrix[0][0] * matrix[1][1] - matrix[0][1] * matrix[1][0];
        let force = [
            (right[0] * matrix[1][1] - right[1] * matrix[0][1]) / determinant,
            (right[1] * matrix[0][0] - right[0] * matrix[1][0]) / determinant,
        ];
        if !(force[0].is_finite() && force[1].is_finite()) {
            return None;
        }
        let turn = free
            .iter()
            .zip(by[0].iter().zip(&by[1]))
            .map(|(free, (x, y))| free + force[0] * x + force[1] * y)
            .collect();
        Some((turn, force))
    }
}

/// Share of segment `j` between the root and a point `at` segments from it.
fn part(at: f64, j: usize) -> f64 {
    (at - j as f64).clamp(0.0, 1.0)
}

/// Perpendicular to the force of a normal and a signed friction: the force has no component along it.
fn across(normal: Vector, friction: f64) -> Vector {
    // A wall whose normal points inward, (-1, 0), drags the rod towards +y if the friction is positive.
    let tangent = [normal[1], -normal[0]];
    [
        tangent[0] - friction * normal[0],
        tangent[1] - friction * normal[1],
    ]
}

/// Solves a symmetric tridiagonal system with one value beside the diagonal. None if a pivot vanishes.
fn tridiagonal(diagonal: &[f64], off: f64, mut right: Vec<f64>) -> Option<Vec<f64>> {
    let n = diagonal.len();
    let mut pivots = diagonal.to_vec();
    for j in 1..n {
        let factor = off / pivots[j - 1];
        if !factor.is_finite() {
            return None;
        }
        pivots[j] -= factor * off;
        right[j] -= factor * right[j - 1];
    }
    for j in (0..n).rev() {
        let above = if j + 1 < n { off * right[j + 1] } else { 0.0 };
        right[j] = (right[j] - above) / pivots[j];
        if !right[j].is_finite() {
            return None;
        }
    }
    Some(right)
}
