//! Displacement against thread over uncertain inputs: declared ranges, a seed, and the paper's words as a condition.
//!
//! A draw is kept if the unfolded body moves headward and its returning strokes hardly move it (section III). The
//! behaviour of the folded body is not part of the condition, so its reversal is a result. The kept draws show how
//! little the inputs are known, not how likely a rig is to behave the same.

use alloc::vec::Vec;

use crate::beam::thread::{Params, ThreadedBody, run};
use crate::beam::{Modelled, NoAnswer};
use crate::chance::SplitMix64;

/// An uncertain input of the thread curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Uncertain {
    /// Name of the field of [`Params`].
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

/// The inputs that vary, all assumed except for the friction.
pub const INPUTS: [Uncertain; 7] = [
    Uncertain {
        name: "friction",
        low: 0.08,
        high: 0.20,
        unit: "",
        logarithmic: false,
        source: "II.B: between capsule and intestine",
    },
    Uncertain {
        name: "wall_n_mm2",
        low: 0.002,
        high: 0.05,
        unit: "N/mm^2",
        logarithmic: true,
        source: "0.07 MPa of a soft silicone, times 0.03 for a free sheet to 0.7 for a backed one",
    },
    Uncertain {
        name: "wing.modulus_mpa",
        low: 20.0,
        high: 80.0,
        unit: "MPa",
        logarithmic: true,
        source: "TPU of shore hardness 95 A",
    },
    Uncertain {
        name: "wing.thickness_mm",
        low: 0.65,
        high: 0.95,
        unit: "mm",
        logarithmic: false,
        source: "0.80 mm, printed to 0.15 mm",
    },
    Uncertain {
        name: "backed",
        low: 0.0,
        high: 1.0,
        unit: "",
        logarithmic: false,
        source: "nothing known: from the sheet alone to the tip alone",
    },
    Uncertain {
        name: "preload_mm",
        low: -0.15,
        high: 0.15,
        unit: "mm",
        logarithmic: false,
        source: "III: equally wide, printed to 0.15 mm",
    },
    Uncertain {
        name: "weight_n",
        low: 0.01,
        high: 0.05,
        unit: "N",
        logarithmic: true,
        source: "1 to 5 g; not in the text",
    },
];

/// The returning strokes "hardly" move the unfolded body if they move it by at most this share of the antegrade ones.
pub const HARDLY: f64 = 0.2;

/// One draw of [`INPUTS`], in their order, applied to `base`. The same seed and index give the same draw.
pub fn draw(base: Params, seed: u64, index: u64) -> Params {
    // Each draw has its own stream.
    let mut chance = SplitMix64::new(seed ^ index.wrapping_mul(0xD6E8_FEB8_6659_FD93));
    let mut values = INPUTS.iter().map(|input| {
        let part = chance.part();
        if input.logarithmic {
            input.low * libm::pow(input.high / input.low, part)
        } else {
            input.low + (input.high - input.low) * part
        }
    });
    let mut next = || values.next().unwrap_or(f64::NAN);
    let mut params = base;
    params.friction = next();
    params.wall_n_mm2 = next();
    params.wing.modulus_mpa = next();
    params.wing.thickness_mm = next();
    params.backed = next();
    params.preload_mm = next();
    params.weight_n = next();
    params
}

/// Whether the unfolded body behaves as in the paper: it moves headward, and hardly by the returning strokes.
///
/// # Errors
/// Fails as [`ThreadedBody::new`] does, or if the body does not come to rest.
pub fn does_as_the_paper_says(params: Params, indentation_mm: f64) -> Result<bool, NoAnswer> {
    let mut body = ThreadedBody::new(params, 0.0, indentation_mm)?;
    let (mut antegrade, mut returning) = (0.0, 0.0);
    for _ in 0..params.cycles {
        let start = body.displacement_mm();
        body.antegrade_stroke()?;
        let middle = body.displacement_mm();
        body.returning_stroke()?;
        antegrade += middle - start;
        returning += body.displacement_mm() - middle;
    }
    Ok(antegrade > 0.0 && returning.abs() <= HARDLY * antegrade)
}

/// Displacement of one draw at each length of thread, mm; `None` if the draw does not behave as in the paper.
///
/// # Errors
/// A thread out of the design's travel; a body that does not come to rest.
pub fn curve(
    params: Params,
    threads_mm: &[f64],
    indentation_mm: f64,
) -> Result<Option<Vec<f64>>, NoAnswer> {
    if !does_as_the_paper_says(params, indentation_mm)? {
        return Ok(None);
    }
    threads_mm
        .iter()
        .map(|thread_mm| Ok(run(params, *thread_mm, indentation_mm)?.value))
        .collect::<Result<_, _>>()
        .map(Some)
}

/// The band at one length of thread.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BandRow {
    /// Thread drawn in, mm.
    pub thread_mm: f64,
    /// 5 % of the kept draws lie below, mm.
    pub low_mm: f64,
    /// Median, mm.
    pub median_mm: f64,
    /// 5 % of the kept draws lie above, mm.
    pub high_mm: f64,
    /// Share of the kept draws that move tailward, more than 1 mm.
    pub reversed: f64,
}

/// The band of the kept curves. Each curve is one draw, with a value for each length of thread. Empty without curves.
pub fn band(threads_mm: &[f64], curves: &[Vec<f64>]) -> Modelled<Vec<BandRow>> {
    let rows = threads_mm.iter().enumerate().filter_map(|(i, thread_mm)| {
        let mut values: Vec<f64> = curves.iter().map(|curve| curve[i]).collect();
        values.sort_unstable_by(f64::total_cmp);
        let last = values.len().checked_sub(1)?;
        let at = |part: f64| values[libm::round(part * last as f64) as usize];
        let reversed = values.iter().filter(|value| **value < -1.0).count();
        Some(BandRow {
            thread_mm: *thread_mm,
            low_mm: at(0.05),
            median_mm: at(0.5),
            high_mm: at(0.95),
            reversed: reversed as f64 / values.len() as f64,
        })
    });
    Modelled::new(rows.collect())
}
