//! One origami in numbers: its lengths, its shortening over the indentation, the admissible range of each angle, and
//! the paper's requirements.

use locomotion::kinematics::{
    BestAlpha, Design, RULES, best_alpha, printed_eq6_residual, repaired_eq6_residual,
};
use locomotion::range::OutOfRange;
use serde::Serialize;

/// The smallest alpha that worked in the paper, degrees. The limit comes from the material; the equations do not
/// contain it.
pub const LEAST_ALPHA_DEG: f64 = 12.53;
/// The paper's greatest indentation, mm.
pub const PAPER_INDENTATION_MM: f64 = 5.05;
/// Tolerance of "about", relative: the paper's own 12.53 degrees are 3.6 % below its "around 13".
pub const ABOUT: f64 = 0.05;
/// Diameter of a capsule endoscope, mm (section I).
pub const CAPSULE_MM: f64 = 13.0;

/// The design squeezed by one indentation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Squeezed {
    pub indentation_mm: f64,
    /// Eq. (4): psi, mm.
    pub spacing_mm: f64,
    /// Eq. (5): d0, mm.
    pub shortening_per_crescent_mm: f64,
    /// Eq. (7): d, mm: shortening of the core and travel of the thread.
    pub shortening_mm: f64,
    /// L(a), mm, the last wing included.
    pub length_mm: f64,
    pub width_mm: f64,
    /// d d0/d a, mm per mm.
    pub slope_by_indentation: f64,
    /// d d0/d alpha, mm per radian.
    pub slope_by_alpha_mm: f64,
    /// d d0/d beta, mm per radian.
    pub slope_by_beta_mm: f64,
}

/// One requirement of section II.A beside the design.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RuleRow {
    pub quantity: &'static str,
    /// The paper's target, which it calls approximate.
    pub target: f64,
    pub value: f64,
    /// Unit of value and target; empty for a pure number.
    pub unit: &'static str,
    /// Value over target, minus one.
    pub deviation: f64,
    /// The paper's objection to a value on this side; none within [`ABOUT`].
    pub objection: Option<&'static str>,
}

/// Eq. (6) at the indentation of the drawings. It has no root, so it yields no alpha.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Equation6 {
    /// Left minus right side as printed: a pure number minus a mixture of mm and 1/mm.
    pub printed_residual: f64,
    /// Left minus right side with the right side `((h-a)/h)^2`; above 0 for every alpha below 51.827 degrees.
    pub repaired_residual: f64,
    /// The derivative that Eq. (6) should set to zero: d d0/d alpha, mm per radian.
    pub true_derivative_mm: f64,
}

/// The best alpha of the admissible range.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Best {
    pub alpha_deg: f64,
    /// d with this alpha at the indentation of the drawings, mm.
    pub shortening_mm: f64,
    pub reason: &'static str,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    pub width_mm: f64,
    /// Width c of the core, mm.
    pub core_mm: f64,
    /// c/W: width of the core over the overall width.
    pub core_ratio: f64,
    /// h = (W-c)/2, mm: the largest indentation.
    pub half_gap_mm: f64,
    /// Short side to the transverse axis, degrees.
    pub alpha_deg: f64,
    /// Long side to the transverse axis, degrees.
    pub beta_deg: f64,
    pub crescents: u8,
    /// Eq. (1): l1, mm.
    pub long_side_mm: f64,
    /// Eq. (2): l2, mm.
    pub short_side_mm: f64,
    /// Eq. (3): phi, mm.
    pub spacing_mm: f64,
    /// m phi, mm.
    pub core_length_mm: f64,
    /// L(0), mm, the last wing included.
    pub length_mm: f64,
    /// d(h), mm: the longest thread that can be drawn in.
    pub largest_shortening_mm: f64,
    /// Thread that narrows the structure to a capsule of 13 mm, mm, if possible.
    pub thread_to_capsule_mm: Option<f64>,
    /// Range of alpha for the given beta, ends excluded, degrees.
    pub alpha_window_deg: (f64, f64),
    /// Range of beta for the given alpha, ends excluded, degrees.
    pub beta_window_deg: (f64, f64),
    /// The indentation of the drawings, mm.
    pub indentation_mm: f64,
    /// The design at indentations from 0 to h.
    pub squeezed: Vec<Squeezed>,
    pub rules: Vec<RuleRow>,
    /// None if this beta leaves no alpha that is known to work.
    pub best_alpha: Option<Best>,
    pub equation_6: Equation6,
}

/// All numbers of a design. `indentation_mm` is that of the drawings and is added to the table. `least_alpha_deg` is
/// the limit of the material, by default the paper's 12.53 degrees.
///
/// # Errors
/// An indentation outside `0..=h`; a given least alpha outside `0..beta`.
pub fn report(
    design: &Design<f64>,
    indentation_mm: Option<f64>,
    least_alpha_deg: Option<f64>,
) -> Result<Report, OutOfRange> {
    let h = design.half_gap_mm();
    let drawn_mm = drawn(design, indentation_mm);
    let (alpha_deg, beta_deg) = angles_deg(design);
    let largest_shortening_mm = design.shortening_mm(h)?;
    let to_capsule = (design.width_mm() - CAPSULE_MM) / 2.0;
    let thread_to_capsule_mm = (0.0..=h)
        .contains(&to_capsule)
        .then(|| design.shortening_mm(to_capsule))
        .transpose()?;
    let squeezed = indentations(h, drawn_mm)
        .into_iter()
        .map(|a| squeeze(design, a))
        .collect::<Result<_, _>>()?;
    let wanted = least_alpha_deg.or((LEAST_ALPHA_DEG < beta_deg).then_some(LEAST_ALPHA_DEG));
    let best = wanted
        .map(|least| best(design, beta_deg, least, drawn_mm))
        .transpose()?;
    Ok(Report {
        width_mm: design.width_mm(),
        core_mm: design.core_mm(),
        core_ratio: design.core_mm() / design.width_mm(),
        half_gap_mm: h,
        alpha_deg,
        beta_deg,
        crescents: design.crescents(),
        long_side_mm: design.long_side_mm(),
        short_side_mm: design.short_side_mm(),
        spacing_mm: design.spacing_mm(),
        core_length_mm: design.core_length_mm(0.0)?,
        length_mm: design.length_mm(0.0)?,
        largest_shortening_mm,
        thread_to_capsule_mm,
        alpha_window_deg: (0.0, beta_deg),
        beta_window_deg: (alpha_deg, 90.0),
        indentation_mm: drawn_mm,
        squeezed,
        rules: rules(design),
        best_alpha: best,
        equation_6: Equation6 {
            printed_residual: printed_eq6_residual(design, drawn_mm),
            repaired_residual: repaired_eq6_residual(design, drawn_mm),
            true_derivative_mm: design.slope_by_alpha_mm(drawn_mm)?,
        },
    })
}

/// The indentation of the drawings: as given, or the paper's, or half of h if the design is too narrow for the paper's.
fn drawn(design: &Design<f64>, asked_mm: Option<f64>) -> f64 {
    let h = design.half_gap_mm();
    asked_mm.unwrap_or(if PAPER_INDENTATION_MM <= h {
        PAPER_INDENTATION_MM
    } else {
        h / 2.0
    })
}

/// Alpha and beta to the transverse axis, degrees.
fn angles_deg(design: &Design<f64>) -> (f64, f64) {
    let deg = |tan: f64| tan.atan().to_degrees();
    (deg(design.tan_alpha()), deg(design.tan_beta()))
}

/// Whole millimetres, or tenths of a large h; plus the indentation of the drawings and h itself.
fn indentations(h: f64, drawn_mm: f64) -> Vec<f64> {
    let step = if h <= 12.0 { 1.0 } else { h / 10.0 };
    let mut all: Vec<_> = (0..=12u8)
        .map(|index| f64::from(index) * step)
        .take_while(|a| *a < h)
        .chain([drawn_mm, h])
        .collect();
    all.sort_by(f64::total_cmp);
    all.dedup();
    all
}

fn squeeze(design: &Design<f64>, a: f64) -> Result<Squeezed, OutOfRange> {
    Ok(Squeezed {
        indentation_mm: a,
        spacing_mm: design.squeezed_spacing_mm(a)?,
        shortening_per_crescent_mm: design.shortening_per_crescent_mm(a)?,
        shortening_mm: design.shortening_mm(a)?,
        length_mm: design.length_mm(a)?,
        width_mm: design.folded_width_mm(a)?,
        slope_by_indentation: design.slope_by_indentation(a)?,
        slope_by_alpha_mm: design.slope_by_alpha_mm(a)?,
        slope_by_beta_mm: design.slope_by_beta_mm(a)?,
    })
}

fn rules(design: &Design<f64>) -> Vec<RuleRow> {
    RULES
        .iter()
        .map(|rule| {
            let value = (rule.of)(design);
            let deviation = value / rule.target - 1.0;
            RuleRow {
                quantity: rule.quantity,
                target: rule.target,
                value,
                unit: rule.unit,
                deviation,
                objection: match deviation {
                    low if low < -ABOUT => Some(rule.too_small),
                    high if high > ABOUT => Some(rule.too_large),
                    _ => None,
                },
            }
        })
        .collect()
}

fn best(
    design: &Design<f64>,
    beta_deg: f64,
    least_deg: f64,
    a_mm: f64,
) -> Result<Best, OutOfRange> {
    let BestAlpha { alpha_deg, reason } = best_alpha(beta_deg, least_deg..=beta_deg.next_down())?;
    let (width, core, m) = (design.width_mm(), design.core_mm(), design.crescents());
    let alpha = alpha_deg.to_radians().tan();
    let with = Design::with_slopes(width, core, alpha, design.tan_beta(), m)?;
    Ok(Best {
        alpha_deg,
        shortening_mm: with.shortening_mm(a_mm)?,
        reason,
    })
}

/// Curves with their names: (angle in degrees, d in mm).
pub type Curves = Vec<(String, Vec<(f64, f64)>)>;

/// Shortening over both angles at one indentation.
#[derive(Clone, Debug, PartialEq)]
pub struct Maps {
    pub indentation_mm: f64,
    pub alpha_deg: f64,
    pub beta_deg: f64,
    pub shortening_mm: f64,
    /// Over alpha, for several beta.
    pub over_alpha: Curves,
    /// Over beta, for several alpha.
    pub over_beta: Curves,
}

/// Distances of the curves' fixed angles from the design's, degrees.
const NEIGHBOURS_DEG: [f64; 5] = [-10.0, -5.0, 0.0, 5.0, 10.0];
/// Distance of the curves from the ends of the angle's range, degrees.
const FROM_END_DEG: f64 = 0.5;

/// d over alpha for several beta, and over beta for several alpha, each over its whole range.
///
/// # Errors
/// An indentation outside `0..=h`.
pub fn maps(design: &Design<f64>, indentation_mm: Option<f64>) -> Result<Maps, OutOfRange> {
    let a_mm = drawn(design, indentation_mm);
    let (alpha_deg, beta_deg) = angles_deg(design);
    let shortening = |alpha: f64, beta: f64| {
        let (width, core, m) = (design.width_mm(), design.core_mm(), design.crescents());
        Design::new(width, core, alpha, beta, m)?.shortening_mm(a_mm)
    };
    let around = |centre: f64, high: f64| {
        NEIGHBOURS_DEG
            .map(|away| centre + away)
            .into_iter()
            .filter(move |angle| *angle > FROM_END_DEG && *angle < high)
    };
    // Sixty points from one end of the range to the other.
    let span = |low: f64, high: f64| {
        let (low, high) = (low + FROM_END_DEG, high - FROM_END_DEG);
        (0..=60u8)
            .map(move |index| low + (high - low) * f64::from(index) / 60.0)
            .filter(move |_| low < high)
    };
    let mut over_alpha = vec![];
    for beta in around(beta_deg, 90.0) {
        let points = span(0.0, beta)
            .map(|alpha| Ok((alpha, shortening(alpha, beta)?)))
            .collect::<Result<_, _>>()?;
        over_alpha.push((format!("beta {beta:.2} deg"), points));
    }
    let mut over_beta = vec![];
    for alpha in around(alpha_deg, 89.0) {
        let points = span(alpha, 80.0)
            .map(|beta| Ok((beta, shortening(alpha, beta)?)))
            .collect::<Result<_, _>>()?;
        over_beta.push((format!("alpha {alpha:.2} deg"), points));
    }
    Ok(Maps {
        indentation_mm: a_mm,
        alpha_deg,
        beta_deg,
        shortening_mm: design.shortening_mm(a_mm)?,
        over_alpha,
        over_beta,
    })
}
