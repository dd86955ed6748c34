//! The origami squeezed by the wall: Eqs. (1)-(5), (7) and (8) of the paper, derivatives and lengths.
//!
//! With `h = (W-c)/2`, a wall that has moved in by `a` leaves a gap `u = h-a` to the core, and the two sides of a
//! crescent reach `s1 = sqrt(l1^2-u^2)` and `s2 = sqrt(l2^2-u^2)` along the axis. With `q = a(2h-a)` and
//! `s^2 = h^2 tan^2 + q`, every difference in the printed equations becomes a sum of positive terms:
//!
//! ```text
//! psi = s1 - s2   = h^2 (tan beta - tan alpha)(tan beta + tan alpha) / (s1 + s2)
//! d0  = phi - psi = q (phi + psi) / [(s1 + h tan beta)(s2 + h tan alpha)]
//! ```
//!
//! These forms are accurate in `f32`, too, where the printed form of Eq. (5) loses up to 7e-4 of a small `d0`.

use core::fmt::Debug;
use core::ops::{Add, Div, Mul, RangeInclusive, Sub};

use crate::range::{Ends, OutOfRange, check};

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// `f32` (the capsule's own arithmetic) or `f64` (the host's).
pub trait Real:
    sealed::Sealed
    + Copy
    + Debug
    + PartialOrd
    + From<u8>
    + Into<f64>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
{
    /// The nearest value.
    fn from_f64(x: f64) -> Self;
    /// Square root, correctly rounded.
    fn sqrt(self) -> Self;
    /// Tangent of an angle in degrees.
    fn tan_deg(self) -> Self;
}

impl Real for f32 {
    fn from_f64(x: f64) -> Self {
        x as f32
    }
    fn sqrt(self) -> Self {
        libm::sqrtf(self)
    }
    fn tan_deg(self) -> Self {
        libm::tanf(self.to_radians())
    }
}

impl Real for f64 {
    fn from_f64(x: f64) -> Self {
        x
    }
    fn sqrt(self) -> Self {
        libm::sqrt(self)
    }
    fn tan_deg(self) -> Self {
        libm::tan(self.to_radians())
    }
}

/// Most crescents that a design may have.
pub const MAX_CRESCENTS: u8 = 32;

/// One origami: width, core, the two angles and the number of crescents, all checked on construction.
///
/// Both angles are measured from the **transverse** axis, as Eqs. (1) and (2) need them; the paper's text says
/// longitudinal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Design<T> {
    width_mm: T,
    core_mm: T,
    half_gap_mm: T,
    tan_alpha: T,
    tan_beta: T,
    crescents: u8,
}

impl Design<f64> {
    /// The paper's design with the angles as printed: 12.53 and 33.69 degrees (section II.A).
    pub fn paper_printed() -> Self {
        let degrees = |deg: f64| deg.tan_deg();
        Self::paper_with(degrees(12.53), degrees(33.69))
    }

    /// The paper's design with `tan alpha = 2/9` and `tan beta = 2/3`: the printed angles are these ratios' to two
    /// decimals. Then `phi = 4h/9`.
    pub const fn paper_ratios() -> Self {
        Self::paper_with(2.0 / 9.0, 2.0 / 3.0)
    }

    /// The design of the paper's simulation: 24.00 mm wide (section II.B), otherwise as [`Design::paper_ratios`].
    pub const fn paper_tube() -> Self {
        Self {
            width_mm: 24.00,
            core_mm: 4.80,
            half_gap_mm: (24.00 - 4.80) / 2.0,
            ..Self::paper_ratios()
        }
    }

    const fn paper_with(tan_alpha: f64, tan_beta: f64) -> Self {
        Self {
            width_mm: 24.40,
            core_mm: 4.88,
            half_gap_mm: (24.40 - 4.88) / 2.0,
            tan_alpha,
            tan_beta,
            crescents: 9,
        }
    }
}

impl<T: Real> Design<T> {
    /// A design from angles in degrees from the transverse axis, `0 < alpha < beta < 90`.
    ///
    /// # Errors
    /// The first value outside its range: `width > 0`, `0 < core < width`, the angles as above, `1..=32` crescents.
    pub fn new(
        width_mm: T,
        core_mm: T,
        alpha_deg: T,
        beta_deg: T,
        crescents: u8,
    ) -> Result<Self, OutOfRange> {
        check(
            "beta",
            "deg",
            beta_deg.into(),
            (0.0, 90.0),
            Ends::Open,
            "l1 = h/cos(beta) has no value at 90 deg",
        )?;
        check(
            "alpha",
            "deg",
            alpha_deg.into(),
            (0.0, beta_deg.into()),
            Ends::Open,
            "the short side must lean less than the long one, and not backward",
        )?;
        Self::with_slopes(
            width_mm,
            core_mm,
            alpha_deg.tan_deg(),
            beta_deg.tan_deg(),
            crescents,
        )
    }

    /// A design from the tangents of its angles, `0 < tan_alpha < tan_beta`.
    ///
    /// # Errors
    /// As [`Design::new`].
    pub fn with_slopes(
        width_mm: T,
        core_mm: T,
        tan_alpha: T,
        tan_beta: T,
        crescents: u8,
    ) -> Result<Self, OutOfRange> {
        check(
            "width W",
            "mm",
            width_mm.into(),
            (0.0, 1000.0),
            Ends::OpenBelow,
            "the structure needs a width",
        )?;
        check(
            "core c",
            "mm",
            core_mm.into(),
            (0.0, width_mm.into()),
            Ends::Open,
            "the crescents stand between core and wall",
        )?;
        check(
            "tan beta",
            "",
            tan_beta.into(),
            (0.0, 1e6),
            Ends::OpenBelow,
            "l1 = h/cos(beta) has no value at 90 deg",
        )?;
        check(
            "tan alpha",
            "",
            tan_alpha.into(),
            (0.0, tan_beta.into()),
            Ends::Open,
            "the short side must lean less than the long one, and not backward",
        )?;
        check(
            "number of crescents m",
            "",
            crescents.into(),
            (1.0, MAX_CRESCENTS.into()),
            Ends::Closed,
            "the body is a chain of that many links",
        )?;
        Ok(Self {
            width_mm,
            core_mm,
            half_gap_mm: (width_mm - core_mm) / T::from(2),
            tan_alpha,
            tan_beta,
            crescents,
        })
    }

    /// A design from the ratio c/W of core to width, `0 < ratio < 1`, and the tangents of its angles.
    ///
    /// # Errors
    /// As [`Design::new`].
    pub fn with_ratio(
        width_mm: T,
        core_ratio: T,
        tan_alpha: T,
        tan_beta: T,
        crescents: u8,
    ) -> Result<Self, OutOfRange> {
        check(
            "core ratio c/W",
            "",
            core_ratio.into(),
            (0.0, 1.0),
            Ends::Open,
            "the crescents stand between core and wall",
        )?;
        Self::with_slopes(
            width_mm,
            // Divided, not multiplied: a fifth of 24 mm is then 4.8 mm to the last bit.
            width_mm / (T::from(1) / core_ratio),
            tan_alpha,
            tan_beta,
            crescents,
        )
    }

    /// Overall width W, mm.
    pub const fn width_mm(&self) -> T {
        self.width_mm
    }
    /// Width c of the core, mm.
    pub const fn core_mm(&self) -> T {
        self.core_mm
    }
    /// `h = (W-c)/2`, mm: distance from the core to the wall at rest, and the largest indentation.
    pub const fn half_gap_mm(&self) -> T {
        self.half_gap_mm
    }
    /// Tangent of the short side's angle from the transverse axis.
    pub const fn tan_alpha(&self) -> T {
        self.tan_alpha
    }
    /// Tangent of the long side's angle from the transverse axis.
    pub const fn tan_beta(&self) -> T {
        self.tan_beta
    }
    /// Number m of crescents.
    pub const fn crescents(&self) -> u8 {
        self.crescents
    }

    /// Eq. (1): length l1 of the long side, mm.
    pub fn long_side_mm(&self) -> T {
        self.half_gap_mm * self.secant(self.tan_beta)
    }
    /// Eq. (2): length l2 of the short side, mm.
    pub fn short_side_mm(&self) -> T {
        self.half_gap_mm * self.secant(self.tan_alpha)
    }
    /// Eq. (3): distance phi between unsqueezed crescents, mm.
    pub fn spacing_mm(&self) -> T {
        self.half_gap_mm * (self.tan_beta - self.tan_alpha)
    }

    /// Eq. (4): distance psi between crescents squeezed by `a`, mm.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn squeezed_spacing_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        Ok(self.squeezed(a_mm)?.psi)
    }

    /// Eq. (5): shortening d0 of one crescent squeezed by `a`, mm. Strictly increasing and concave in `a`.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn shortening_per_crescent_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        Ok(self.d0(&self.squeezed(a_mm)?))
    }

    /// Eq. (7): shortening `d = m d0` of the core, mm. The thread that folds the structure travels the same distance.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn shortening_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        Ok(self.m() * self.shortening_per_crescent_mm(a_mm)?)
    }

    /// Length of the core at indentation `a`, `m psi(a)`, mm (not in the paper).
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn core_length_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        Ok(self.m() * self.squeezed(a_mm)?.psi)
    }

    /// Overall length `L(a) = m psi(a) + s2(a)`, mm: the core and the last wing behind it (not in the paper). It
    /// shortens less than the core, because the wing folds back.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn length_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        let s = self.squeezed(a_mm)?;
        Ok(self.m() * s.psi + s.s2)
    }

    /// How far the tip of a wing lies behind its root at indentation `a`, `s2(a)`, mm.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn wing_reach_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        Ok(self.squeezed(a_mm)?.s2)
    }

    /// `d d0 / d a`, mm per mm: `u psi / (s1 s2)`, from `h/s2 - h/s1` at 0 down to 0 at `a = h`.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn slope_by_indentation(&self, a_mm: T) -> Result<T, OutOfRange> {
        let s = self.squeezed(a_mm)?;
        Ok((self.half_gap_mm - a_mm) * s.psi / (s.s1 * s.s2))
    }

    /// `d d0 / d alpha`, mm per radian: `h sec^2(alpha) [h tan(alpha)/s2 - 1]`. Eq. (6) should have been this.
    /// Negative for every `a > 0`, so d0 has no maximum within the range of alpha.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn slope_by_alpha_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        let s = self.squeezed(a_mm)?;
        Ok(self.zero() - self.slope_by_angle(self.tan_alpha, s.s2, s.q))
    }

    /// `d d0 / d beta`, mm per radian: `h sec^2(beta) [1 - h tan(beta)/s1]`, positive for every `a > 0`.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn slope_by_beta_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        let s = self.squeezed(a_mm)?;
        Ok(self.slope_by_angle(self.tan_beta, s.s1, s.q))
    }

    /// The indentation at which the core has shortened by `thread_mm`: the inverse of Eq. (7), by bisection to the
    /// last bit.
    ///
    /// # Errors
    /// `thread_mm` outside `0..=d(h)`, or NaN.
    pub fn indentation_for_thread_mm(&self, thread_mm: T) -> Result<T, OutOfRange> {
        check(
            "thread travel",
            "mm",
            thread_mm.into(),
            (0.0, self.shortening_mm(self.half_gap_mm)?.into()),
            Ends::Closed,
            "at the longest travel the wings lie against the core",
        )?;
        let (mut low, mut high) = (self.zero(), self.half_gap_mm);
        loop {
            let middle = (low + high) / T::from(2);
            if middle <= low || middle >= high {
                return Ok(high);
            }
            if self.shortening_mm(middle)? < thread_mm {
                low = middle;
            } else {
                high = middle;
            }
        }
    }

    /// Width `W - 2a` that remains when the wings are drawn in by `a`, mm.
    ///
    /// # Errors
    /// `a` outside `0..=h`, or NaN.
    pub fn folded_width_mm(&self, a_mm: T) -> Result<T, OutOfRange> {
        self.check_indentation(a_mm)?;
        Ok(self.width_mm - T::from(2) * a_mm)
    }

    fn check_indentation(&self, a_mm: T) -> Result<(), OutOfRange> {
        check(
            "indentation a",
            "mm",
            a_mm.into(),
            (0.0, self.half_gap_mm.into()),
            Ends::Closed,
            "the wall moves inward, and at a = h it reaches the core",
        )
    }

    fn squeezed(&self, a_mm: T) -> Result<Squeezed<T>, OutOfRange> {
        self.check_indentation(a_mm)?;
        let h = self.half_gap_mm;
        let q = a_mm * (T::from(2) * h - a_mm);
        let reach = |tan: T| (h * tan * (h * tan) + q).sqrt();
        let (s1, s2) = (reach(self.tan_beta), reach(self.tan_alpha));
        let psi = self.spacing_mm() * (h * (self.tan_beta + self.tan_alpha)) / (s1 + s2);
        Ok(Squeezed { q, s1, s2, psi })
    }

    fn d0(&self, s: &Squeezed<T>) -> T {
        let h = self.half_gap_mm;
        s.q * (self.spacing_mm() + s.psi)
            / ((s.s1 + h * self.tan_beta) * (s.s2 + h * self.tan_alpha))
    }

    fn slope_by_angle(&self, tan: T, reach: T, q: T) -> T {
        let h = self.half_gap_mm;
        h * (T::from(1) + tan * tan) * q / (reach * (reach + h * tan))
    }

    fn secant(&self, tan: T) -> T {
        (T::from(1) + tan * tan).sqrt()
    }
    fn m(&self) -> T {
        self.crescents.into()
    }
    fn zero(&self) -> T {
        T::from(0)
    }
}

struct Squeezed<T> {
    q: T,
    s1: T,
    s2: T,
    psi: T,
}

/// Eq. (8): the wave's amplitude `a_n = (D - i_n)/2` from two caliper readings, mm: the intestine's width D and the
/// distance i_n between the crests of the wave.
///
/// # Errors
/// `D` not positive, or `i_n` outside `0..=D`.
pub fn indentation_from_calipers_mm<T: Real>(
    width_mm: T,
    between_crests_mm: T,
) -> Result<T, OutOfRange> {
    check(
        "intestine width D",
        "mm",
        width_mm.into(),
        (0.0, 1000.0),
        Ends::OpenBelow,
        "it is a caliper reading",
    )?;
    check(
        "distance between crests i_n",
        "mm",
        between_crests_mm.into(),
        (0.0, width_mm.into()),
        Ends::Closed,
        "a wave narrows the intestine",
    )?;
    Ok((width_mm - between_crests_mm) / T::from(2))
}

/// Result of [`best_alpha`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BestAlpha {
    /// The admissible alpha with the largest d0, degrees.
    pub alpha_deg: f64,
    /// The reason in words.
    pub reason: &'static str,
}

/// The alpha in an admissible range that gives the largest d0: the lower bound, for any beta and any indentation.
///
/// # Errors
/// A range outside `0 < alpha < beta < 90`, or one whose ends are swapped.
pub fn best_alpha(
    beta_deg: f64,
    admissible_deg: RangeInclusive<f64>,
) -> Result<BestAlpha, OutOfRange> {
    let (low, high) = (*admissible_deg.start(), *admissible_deg.end());
    check(
        "beta",
        "deg",
        beta_deg,
        (0.0, 90.0),
        Ends::Open,
        "l1 = h/cos(beta) has no value at 90 deg",
    )?;
    check(
        "largest alpha",
        "deg",
        high,
        (0.0, beta_deg),
        Ends::Open,
        "the short side must lean less than the long one",
    )?;
    check(
        "smallest alpha",
        "deg",
        low,
        (0.0, high),
        Ends::OpenBelow,
        "the short side must not lean backward",
    )?;
    Ok(BestAlpha {
        alpha_deg: low,
        reason: "d d0/d alpha < 0 for every indentation, so d0 has no maximum inside the range; the lower bound is set \
                 by the material: below about 13 deg the short side deforms backward (paper, section II.A)",
    })
}

/// Eq. (6) as printed, left side minus right side, with `k = 2/(W-c)`:
/// `sec^2(alpha) [1 - (2 - sec^2(alpha))^2 tan^2(alpha)] - k^2 (k - a)^2`.
///
/// Kept to show that it is unusable. The right side subtracts millimetres from reciprocal millimetres, and neither
/// this form nor the repaired one ([`repaired_eq6_residual`]) has a root near the paper's 12.53 degrees.
pub fn printed_eq6_residual(design: &Design<f64>, a_mm: f64) -> f64 {
    let k = 1.0 / design.half_gap_mm;
    let (k_squared, rest) = (k * k, k - a_mm);
    eq6_left(design.tan_alpha * design.tan_alpha) - k_squared * rest * rest
}

/// Eq. (6) with the right side repaired to the pure number `((h-a)/h)^2`, left side minus right side.
///
/// With `t = tan^2(alpha)` the left side is `1 + t^2 + t^3 - t^4`, which is above 1 until t reaches the golden ratio.
/// Therefore every root for `0 <= a <= h` lies at alpha >= 51.827 degrees.
pub fn repaired_eq6_residual(design: &Design<f64>, a_mm: f64) -> f64 {
    let rest = (design.half_gap_mm - a_mm) / design.half_gap_mm;
    eq6_left(design.tan_alpha * design.tan_alpha) - rest * rest
}

fn eq6_left(t: f64) -> f64 {
    let sec_squared = 1.0 + t;
    let rest = 2.0 - sec_squared;
    sec_squared * (1.0 - rest * rest * t)
}

/// A design requirement of section II.A: a target, and the drawback of smaller and larger values.
#[derive(Clone, Copy, Debug)]
pub struct Rule {
    /// Name of the quantity.
    pub quantity: &'static str,
    /// The paper's target ("about").
    pub target: f64,
    /// Unit of the target; empty for a pure number.
    pub unit: &'static str,
    /// The paper's objection to smaller values.
    pub too_small: &'static str,
    /// The paper's objection to larger values.
    pub too_large: &'static str,
    /// Computes the quantity for a design.
    pub of: fn(&Design<f64>) -> f64,
}

/// The five design requirements of section II.A. The target of W is the intestine's width, 24.40 mm on the rig.
pub const RULES: [Rule; 5] = [
    Rule {
        quantity: "alpha",
        target: 13.0,
        unit: "deg",
        too_small: "the short side deforms backward",
        too_large: "less forward deformation",
        of: |d| libm::atan(d.tan_alpha).to_degrees(),
    },
    Rule {
        quantity: "beta",
        target: 34.0,
        unit: "deg",
        too_small: "crescents too narrow, less forward deformation",
        too_large: "fewer crescents under one wave",
        of: |d| libm::atan(d.tan_beta).to_degrees(),
    },
    Rule {
        quantity: "W",
        target: 24.40,
        unit: "mm",
        too_small: "no hold on the intestine",
        too_large: "slower",
        of: |d| d.width_mm,
    },
    Rule {
        quantity: "c/W",
        target: 0.2,
        unit: "",
        too_small: "bends too easily",
        too_large: "less forward deformation",
        of: |d| d.core_mm / d.width_mm,
    },
    Rule {
        quantity: "m",
        target: 9.0,
        unit: "",
        too_small: "too few contacts",
        too_large: "more friction",
        of: |d| d.crescents.into(),
    },
];
