//! The crescent as a beam: force against indentation, the least alpha, displacement against thread with its band.

use locomotion::beam::NoAnswer;
use locomotion::beam::band::{BandRow, INPUTS, Uncertain, band};
use locomotion::beam::crescent::{Shape, Wing};
use locomotion::roller;
use serde::Serialize;

/// Frictions for the least alpha: the ends of the paper's range, and its middle, which the forces use.
const FRICTIONS: [f64; 3] = [0.08, 0.15, 0.20];

/// Print error for the least alpha, mm (section II.D).
pub const PRINT_MM: f64 = 0.15;

/// Force on one wing at one indentation, N.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ForceRow {
    /// How deep the roller presses over the tip, mm.
    pub indentation_mm: f64,
    /// Without friction.
    pub force_n: f64,
    /// The tip drags tailward on a wall with friction 0.15, as when the body moves headward.
    pub easy_n: f64,
    /// The tip drags headward, as when the body moves tailward.
    pub hard_n: f64,
    /// Energy of bending without friction, N mm.
    pub energy_n_mm: f64,
}

/// Forces of the paper's wing under a roller over its tip, from 0.05 to 5.05 mm.
///
/// # Errors
/// No equilibrium.
pub fn forces() -> Result<Vec<ForceRow>, NoAnswer> {
    let shape = Shape::Roller {
        radius_mm: roller::Params::PAPER.radius_mm,
        behind_mm: 0.0,
    };
    let at = |indentation_mm: f64| {
        let squeezed = |friction| Wing::PAPER.squeezed(0.0, indentation_mm, shape, friction);
        let free = squeezed(0.0)?;
        Ok(ForceRow {
            indentation_mm,
            force_n: free.value.inward_n,
            easy_n: squeezed(FRICTIONS[1])?.value.inward_n,
            hard_n: squeezed(-FRICTIONS[1])?.value.inward_n,
            energy_n_mm: free.value.energy_n_mm,
        })
    };
    (0..=50).map(|i| at(0.05 + 0.1 * f64::from(i))).collect()
}

/// The least alpha at one friction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AlphaRow {
    /// Friction coefficient.
    pub friction: f64,
    /// Of a perfect wing, degrees.
    pub least_alpha_deg: f64,
    /// Of a wing whose tip is printed 0.15 mm too far headward, degrees.
    pub least_alpha_printed_deg: f64,
}

/// The least alpha over friction.
///
/// # Errors
/// As [`Wing::least_alpha_deg`].
pub fn least_alphas() -> Result<Vec<AlphaRow>, NoAnswer> {
    FRICTIONS
        .iter()
        .map(|friction| {
            let perfect = Wing::PAPER.least_alpha_deg(*friction, 0.0, 0.0)?;
            let printed = Wing::PAPER.least_alpha_deg(*friction, 0.0, PRINT_MM)?;
            Ok(AlphaRow {
                friction: *friction,
                least_alpha_deg: perfect.value,
                least_alpha_printed_deg: printed.value,
            })
        })
        .collect()
}

/// The band of the displacement at one length of thread.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ThreadRow {
    /// Thread drawn in, mm.
    pub thread_mm: f64,
    /// 5 % of the kept draws lie below, mm.
    pub low_mm: f64,
    /// Median, mm.
    pub median_mm: f64,
    /// 5 % of the kept draws lie above, mm.
    pub high_mm: f64,
    /// Share of the kept draws that move tailward.
    pub reversed: f64,
}

/// Thread lengths of the curve, mm.
#[must_use]
pub fn threads_mm() -> Vec<f64> {
    (0..=22).map(f64::from).collect()
}

/// The band of the curves.
#[must_use]
pub fn thread_rows(curves: &[Vec<f64>]) -> Vec<ThreadRow> {
    let rows = band(&threads_mm(), curves);
    let row = |row: BandRow| ThreadRow {
        thread_mm: row.thread_mm,
        low_mm: row.low_mm,
        median_mm: row.median_mm,
        high_mm: row.high_mm,
        reversed: row.reversed,
    };
    rows.value.iter().copied().map(row).collect()
}

/// An uncertain input of the curve over thread.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct InputRow {
    /// Name of the parameter.
    pub name: &'static str,
    /// Least value.
    pub low: f64,
    /// Greatest value.
    pub high: f64,
    /// Unit; empty for a pure number.
    pub unit: &'static str,
    /// Whether the logarithm is uniform, instead of the value.
    pub logarithmic: bool,
    /// Reason for the range.
    pub source: &'static str,
}

/// The uncertain inputs that the draws vary.
#[must_use]
pub fn inputs() -> Vec<InputRow> {
    let row = |input: &Uncertain| InputRow {
        name: input.name,
        low: input.low,
        high: input.high,
        unit: input.unit,
        logarithmic: input.logarithmic,
        source: input.source,
    };
    INPUTS.iter().map(row).collect()
}
