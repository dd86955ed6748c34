//! One crescent's wing as a beam: force against indentation, its lever, and the least alpha.
//!
//! The wing is the short side, clamped to the core at its angle from the transverse axis. The thread turns the
//! creases, so a wing that `thread` has drawn in by `a_t` starts straight at `acos((h - a_t)/l2)` (assumed). The long
//! side ties the tip of the wing to the next root; the model ignores that this stiffens the tip.
//!
//! # The lever
//! A wall that presses the tip inward with V and drags it along the axis with X bends the root by `V y - X x`. With
//! the lever `T = y/x`, `V = V0 T/(T - X/V)` for the same indentation. Dragged tailward, the wing closes and V falls.
//! Dragged headward, it opens and V rises without limit as `X/V` approaches T: there it locks like a pawl.

use alloc::vec::Vec;

use crate::beam::rod::{Properties, Rod, Vector, Wall};
use crate::beam::{Modelled, NoAnswer};
use crate::kinematics::Design;
use crate::range::{Ends, check};

/// First mode of a strut that is clamped at one end and pinned at the other: `tan(k) = k`, `P = k^2 B/L^2`.
const CLAMPED_PINNED: f64 = 20.190_728_556_426_627;

/// Material and section of a wing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wing {
    /// The body's geometry.
    pub design: Design<f64>,
    /// Young's modulus, MPa.
    pub modulus_mpa: f64,
    /// Thickness, mm.
    pub thickness_mm: f64,
    /// Width across the plane, mm.
    pub width_mm: f64,
    /// Number of beam elements.
    pub elements: u16,
}

impl Wing {
    /// The paper's geometry in TPU; modulus and width are assumed, the thickness is that of the paper's simulation.
    pub const PAPER: Self = Self {
        design: Design::paper_ratios(),
        modulus_mpa: 50.0,
        thickness_mm: 0.8,
        width_mm: 10.0,
        elements: 32,
    };

    /// Bending stiffness E I, N mm^2.
    ///
    /// # Errors
    /// Modulus, thickness or width outside their ranges.
    pub fn bending_n_mm2(&self) -> Result<f64, NoAnswer> {
        for (quantity, unit, value, most) in [
            ("Young's modulus", "MPa", self.modulus_mpa, 1e6),
            ("wing thickness", "mm", self.thickness_mm, 10.0),
            ("wing width", "mm", self.width_mm, 1e3),
        ] {
            check(
                quantity,
                unit,
                value,
                (0.0, most),
                Ends::OpenBelow,
                "the wing is a beam of this material and section",
            )?;
        }
        let cube = self.thickness_mm * self.thickness_mm * self.thickness_mm;
        Ok(self.modulus_mpa * self.width_mm * cube / 12.0)
    }

    /// Angle of the wing from the transverse axis after the thread has drawn it in by `drawn_mm`, radians.
    ///
    /// # Errors
    /// `drawn_mm` outside `0..=h`.
    pub fn rest_rad(&self, drawn_mm: f64) -> Result<f64, NoAnswer> {
        let reach = self.design.wing_reach_mm(drawn_mm)?;
        Ok(libm::atan2(reach, self.design.half_gap_mm() - drawn_mm))
    }

    /// The wing without load, with the root at the origin, x outward and y tailward.
    fn rod(&self, root_rad: f64) -> Result<Rod, NoAnswer> {
        Rod::new(Properties {
            length_mm: self.design.short_side_mm(),
            bending_n_mm2: self.bending_n_mm2()?,
            root_rad,
            elements: self.elements,
            guided_tip_rad: None,
        })
    }

    /// Presses a wall of this shape `indentation_mm` deep onto the tip of a wing that is drawn in by `drawn_mm`.
    ///
    /// # Errors
    /// Values outside their ranges; a wing that would reach into its core; no equilibrium.
    pub fn squeezed(
        &self,
        drawn_mm: f64,
        indentation_mm: f64,
        shape: Shape,
        friction: f64,
    ) -> Result<Modelled<Squeezed>, NoAnswer> {
        let height = self.design.half_gap_mm() - drawn_mm;
        check(
            "indentation of the wing",
            "mm",
            indentation_mm,
            (0.0, height),
            Ends::Closed,
            "deeper the wall reaches the core",
        )?;
        let root_rad = self.rest_rad(drawn_mm)?;
        let mut rod = self.rod(root_rad)?;
        let tip = rod.tip_mm();
        let x_mm = height - indentation_mm;
        rod.press(shape.wall(x_mm, tip[1])?, friction)?;
        let nodes_mm = rod.nodes_mm();
        clear_of_core(&nodes_mm)?;
        let [x, y] = rod.force_n();
        Ok(Modelled::new(Squeezed {
            inward_n: -x,
            tailward_n: y,
            tip_slide_mm: rod.tip_mm()[1] - tip[1],
            energy_n_mm: rod.energy_n_mm(),
            nodes_mm,
        }))
    }

    /// The wing's answer to indentation: force without friction, and lever, in `steps` equal steps up to `deepest_mm`.
    ///
    /// # Errors
    /// As [`Wing::squeezed`].
    pub fn law(&self, drawn_mm: f64, deepest_mm: f64, steps: u8) -> Result<Law, NoAnswer> {
        check(
            "deepest indentation of the wing",
            "mm",
            deepest_mm,
            (0.0, self.design.half_gap_mm() - drawn_mm),
            Ends::OpenBelow,
            "deeper the wall reaches the core",
        )?;
        let root_rad = self.rest_rad(drawn_mm)?;
        let length = self.design.short_side_mm();
        let bending = self.bending_n_mm2()?;
        let sin = libm::sin(root_rad);
        let mut law = Law {
            step_mm: deepest_mm / f64::from(steps.max(1)),
            // Small deflection: T = tan.
            force_n: Vec::from([0.0]),
            lever: Vec::from([libm::tan(root_rad)]),
            lock_n: CLAMPED_PINNED * bending / (length * length) * sin,
        };
        let mut rods = [0.0, PROBE].map(|friction| (self.rod(root_rad), friction));
        for step in 1..=steps.max(1) {
            let deep = law.step_mm * f64::from(step);
            let wall = Wall::Plane {
                x_mm: self.design.half_gap_mm() - drawn_mm - deep,
                slope: 0.0,
            };
            let mut inward_n = [0.0; 2];
            for ((rod, friction), inward_n) in rods.iter_mut().zip(&mut inward_n) {
                let rod = rod.as_mut().map_err(|error| *error)?;
                if step == 1 {
                    rod.press(wall, *friction)?;
                } else {
                    rod.press_on(wall, law.step_mm, *friction)?;
                }
                clear_of_core(&rod.nodes_mm())?;
                *inward_n = -rod.force_n()[0];
            }
            let [free, drag] = inward_n;
            law.lever.push(PROBE * drag / (free - drag));
            law.force_n.push(free);
        }
        Ok(law)
    }

    /// The least alpha. Below it, the wall pressed against the tip of the short side turns the wing backward
    /// (headward) or finds it stuck, because the friction that opposes the tip's tailward slide outweighs its slant.
    ///
    /// `slope` is that of the wall, positive where it helps: on the side from which an antegrade wave comes.
    /// `imperfection_mm` is how far the tip may lie headward of its nominal place.
    ///
    /// # Errors
    /// Friction or imperfection outside their ranges; a wing that does not slide tailward even at 80 deg.
    pub fn least_alpha_deg(
        &self,
        friction: f64,
        slope: f64,
        imperfection_mm: f64,
    ) -> Result<Modelled<f64>, NoAnswer> {
        check(
            "friction coefficient",
            "",
            friction,
            (0.0, 2.0),
            Ends::Closed,
            "it is a friction",
        )?;
        check(
            "imperfection",
            "mm",
            imperfection_mm,
            (0.0, 2.0),
            Ends::Closed,
            "it is the error of a print",
        )?;
        let half_gap = self.design.half_gap_mm();
        let slides = |alpha_deg: f64| -> Result<bool, NoAnswer> {
            let alpha = alpha_deg.to_radians();
            let length = half_gap / libm::cos(alpha);
            let root_rad = alpha - libm::asin(imperfection_mm / length);
            let mut rod = Rod::new(Properties {
                length_mm: length,
                bending_n_mm2: self.bending_n_mm2()?,
                root_rad,
                elements: self.elements,
                guided_tip_rad: None,
            })?;
            let tip = rod.tip_mm();
            let x_mm = tip[0] - slope * tip[1] - FIRST_TOUCH_MM;
            let pressed = rod.press(Wall::Plane { x_mm, slope }, -friction);
            // Where friction outweighs the slant, there is no equilibrium, or one that bends headward or pulls.
            Ok(pressed.is_ok() && rod.root_moment_n_mm() > 0.0 && rod.force_n()[0] < 0.0)
        };
        let (mut low, mut high) = (0.01, 80.0);
        check(
            "alpha at which the wing slides tailward",
            "deg",
            if slides(high)? { high } else { 90.0 },
            (0.0, high),
            Ends::Closed,
            "friction and slope leave no usable alpha; choose less friction or a flatter wall",
        )?;
        while high - low > 1e-4 {
            let middle = (low + high) / 2.0;
            if slides(middle)? {
                high = middle;
            } else {
                low = middle;
            }
        }
        Ok(Modelled::new(high))
    }
}

/// Refuses a wing with a node below the core's surface.
fn clear_of_core(nodes_mm: &[Vector]) -> Result<(), NoAnswer> {
    let lowest = nodes_mm
        .iter()
        .fold(f64::INFINITY, |least, node| least.min(node[0]));
    Ok(check(
        "distance of the bent wing from the core",
        "mm",
        lowest,
        (-1e-6, f64::INFINITY),
        Ends::Closed,
        "the wing would reach into its core; choose a smaller indentation",
    )?)
}

/// Friction that probes the lever: small, and tailward, where an equilibrium always exists.
const PROBE: f64 = 0.02;

/// Indentation at which the first touch is evaluated, mm.
const FIRST_TOUCH_MM: f64 = 1e-3;

/// Shape of the wall over the tip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Parallel to the axis.
    Flat,
    /// A roller of this radius, its axis `behind_mm` tailward of the unbent tip.
    Roller {
        /// Radius, mm.
        radius_mm: f64,
        /// Place of the axis, mm.
        behind_mm: f64,
    },
}

impl Shape {
    fn wall(self, x_mm: f64, tip_y_mm: f64) -> Result<Wall, NoAnswer> {
        match self {
            Self::Flat => Ok(Wall::Plane { x_mm, slope: 0.0 }),
            Self::Roller {
                radius_mm,
                behind_mm,
            } => {
                check(
                    "roller radius",
                    "mm",
                    radius_mm,
                    (1.0, 1e4),
                    Ends::Closed,
                    "the wing is 10 mm long",
                )?;
                check(
                    "place of the roller's axis",
                    "mm",
                    behind_mm,
                    (-radius_mm, radius_mm),
                    Ends::Closed,
                    "the roller lies over the tip",
                )?;
                Ok(Wall::Roller {
                    centre_mm: [x_mm + radius_mm, tip_y_mm + behind_mm],
                    radius_mm,
                })
            }
        }
    }
}

/// A wing in equilibrium under a wall.
#[derive(Clone, Debug, PartialEq)]
pub struct Squeezed {
    /// Force of the wall on the wing towards the axis, N.
    pub inward_n: f64,
    /// Force of the wall on the wing towards the tail, N.
    pub tailward_n: f64,
    /// How far the tip slid towards the tail, mm.
    pub tip_slide_mm: f64,
    /// Energy of bending, N mm.
    pub energy_n_mm: f64,
    /// The bent wing from its root, x outward and y tailward, mm.
    pub nodes_mm: Vec<Vector>,
}

/// Force and lever of a wing over its indentation.
#[derive(Clone, Debug)]
pub struct Law {
    step_mm: f64,
    force_n: Vec<f64>,
    lever: Vec<f64>,
    lock_n: f64,
}

impl Law {
    /// Force without friction, N, at an indentation within the law.
    pub fn force_n(&self, indentation_mm: f64) -> f64 {
        self.between(&self.force_n, indentation_mm)
    }

    /// The lever T at an indentation within the law.
    pub fn lever(&self, indentation_mm: f64) -> f64 {
        self.between(&self.lever, indentation_mm)
    }

    /// Axial force at which a locked wing buckles, N: that of a clamped and pinned strut.
    pub fn lock_n(&self) -> f64 {
        self.lock_n
    }

    /// Deepest indentation of the law, mm.
    pub fn deepest_mm(&self) -> f64 {
        self.step_mm * (self.force_n.len() - 1) as f64
    }

    fn between(&self, values: &[f64], at_mm: f64) -> f64 {
        let place = at_mm / self.step_mm;
        let index = (place as usize).min(values.len() - 2);
        let part = place - index as f64;
        values[index] + (values[index + 1] - values[index]) * part
    }
}
