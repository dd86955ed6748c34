//! Each sentence of the paper's sections II and III that states a number or a trend, beside the models' result.
//!
//! The rows are data for reports; [`Table`] prints them as the Markdown table of `docs/science.md`.

use core::fmt;

use crate::body::Chain;
use crate::kinematics::{Design, indentation_from_calipers_mm};
use crate::range::OutOfRange;
use crate::{folded, roller, tube};

/// What it proves if a model agrees with a sentence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// The paper's number is an input of the model; the value only shows that.
    Input,
    /// A parameter was fitted to this sentence: agreement is no evidence.
    Fitted,
    /// True of every model of this class: agreement is no evidence.
    Built,
    /// Follows from the equations or the models, and could have come out differently.
    Outcome,
    /// The models have nothing to compare.
    Outside,
}

impl fmt::Display for Evidence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Input => "input",
            Self::Fitted => "fitted",
            Self::Built => "built in",
            Self::Outcome => "result",
            Self::Outside => "outside",
        })
    }
}

/// One sentence of the paper beside the models' result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Section of the paper.
    pub section: &'static str,
    /// The sentence, paraphrased.
    pub sentence: &'static str,
    /// The quantity that is compared.
    pub quantity: &'static str,
    /// The paper's value or trend, in its own rounding.
    pub paper: &'static str,
    /// The model's value, if it has one.
    pub model: Option<f64>,
    /// Unit of both values; empty for a pure number.
    pub unit: &'static str,
    /// What it proves if both values agree.
    pub evidence: Evidence,
    /// Comment; may be empty.
    pub remark: &'static str,
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            section,
            sentence,
            quantity,
            paper,
            unit,
            evidence,
            remark,
            ..
        } = self;
        write!(f, "| {section} | {sentence} | {quantity} | {paper} | ")?;
        match self.model {
            // Adding zero turns -0 into 0.
            Some(value) => write!(f, "{}", Rounded(value + 0.0))?,
            None => write!(f, "-")?,
        }
        write!(f, " | {unit} | {evidence} | {remark} |")
    }
}

/// Prints a whole number as such and any other with three decimals.
struct Rounded(f64);

impl fmt::Display for Rounded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nearest = libm::round(self.0);
        if libm::fabs(self.0 - nearest) < 1e-9 {
            write!(f, "{nearest:.0}")
        } else {
            write!(f, "{:.3}", self.0)
        }
    }
}

/// All rows, printed as a Markdown table.
#[derive(Clone, Copy, Debug)]
pub struct Table<'a>(pub &'a [Row]);

impl fmt::Display for Table<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "| section | the paper says | quantity | paper | model | unit | worth | remark |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|")?;
        self.0.iter().try_for_each(|row| writeln!(f, "{row}"))
    }
}

/// Number of rows.
pub const ROWS: usize = 69;

/// The friction coefficients of section II.B: 0.08, 0.085 ... 0.20.
pub fn frictions() -> impl ExactSizeIterator<Item = f64> + Clone {
    (0..25u8).map(|i| f64::from(80 + 5 * u16::from(i)) / 1000.0)
}

/// The pressures of section II.B, Pa: 3000, 3400 ... 7000.
pub fn pressures_pa() -> impl ExactSizeIterator<Item = f64> + Clone {
    (0..11u8).map(|i| f64::from(3000 + 400 * u16::from(i)))
}

/// The indentations of the roller series, mm. The paper gives only the largest, a_5; the others are assumed.
pub const INDENTATIONS_MM: [f64; 5] = [1.0, 2.0, 3.0, 4.0, 5.05];

/// The rows, section by section: `sentence: quantity, paper's value, unit, evidence = model's value, remark;`. The
/// model's value and the remark may be left out.
macro_rules! table {
    ($($section:literal { $(
        $sentence:literal: $quantity:literal, $paper:literal, $unit:literal,
            $evidence:ident $(= $model:expr)? $(, $remark:literal)?;
    )* })*) => {
        [$($(Row {
            section: $section,
            sentence: $sentence,
            quantity: $quantity,
            paper: $paper,
            model: None$(.or(Some($model)))?,
            unit: $unit,
            evidence: Evidence::$evidence,
            remark: concat!($($remark)?),
        }),*),*]
    };
}

/// Results of the model runs that the rows draw on.
struct Runs {
    /// Displacement at each pressure, friction 0.15.
    pressure_mm: [f64; 11],
    /// Least and greatest displacement over the frictions at 7000 Pa.
    friction_mm: (f64, f64),
    /// Greatest difference at any pressure between the lowest and the highest friction.
    tube_friction_mm: f64,
    /// Displacement at each indentation.
    roller_mm: [f64; 5],
    /// Greatest difference at any indentation between the lowest and the highest friction.
    lubrication_mm: f64,
}

impl Runs {
    fn new() -> Result<Self, OutOfRange> {
        let mut pressure_mm = [0.0; 11];
        let (mut slippery, mut rough) = (tube::Params::PAPER, tube::Params::PAPER);
        slippery.body.friction = 0.08;
        rough.body.friction = 0.20;
        let mut tube_friction_mm = 0.0f64;
        for (mm, pressure) in pressure_mm.iter_mut().zip(pressures_pa()) {
            *mm = tube::run(tube::Params::PAPER, pressure)?;
            let difference = tube::run(rough, pressure)? - tube::run(slippery, pressure)?;
            tube_friction_mm = tube_friction_mm.max(libm::fabs(difference));
        }
        let mut friction_mm = (f64::INFINITY, f64::NEG_INFINITY);
        for friction in frictions() {
            let mut params = tube::Params::PAPER;
            params.body.friction = friction;
            let mm = tube::run(params, 7000.0)?;
            friction_mm = (friction_mm.0.min(mm), friction_mm.1.max(mm));
        }
        let (mut wet, mut dry) = (roller::Params::PAPER, roller::Params::PAPER);
        wet.body.friction = 0.08;
        dry.body.friction = 0.20;
        let mut roller_mm = [0.0; 5];
        let mut lubrication_mm = 0.0f64;
        for (mm, indentation) in roller_mm.iter_mut().zip(INDENTATIONS_MM) {
            *mm = roller::run(wet, indentation)?;
            let difference = roller::run(dry, indentation)? - *mm;
            lubrication_mm = lubrication_mm.max(libm::fabs(difference));
        }
        Ok(Self {
            pressure_mm,
            friction_mm,
            tube_friction_mm,
            roller_mm,
            lubrication_mm,
        })
    }

    /// How many steps of a series rise.
    fn rising(series: &[f64]) -> f64 {
        series.windows(2).filter(|w| w[1] > w[0]).count() as f64
    }

    /// How many bends of a series turn upward.
    fn convex(series: &[f64]) -> f64 {
        series
            .windows(3)
            .filter(|w| w[2] - w[1] > w[1] - w[0])
            .count() as f64
    }

    /// R^2 of the straight line through the roller series.
    fn linearity(&self) -> f64 {
        let n = INDENTATIONS_MM.len() as f64;
        let mean_x = INDENTATIONS_MM.iter().sum::<f64>() / n;
        let mean_y = self.roller_mm.iter().sum::<f64>() / n;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for (x, y) in INDENTATIONS_MM.iter().zip(self.roller_mm) {
            let (dx, dy) = (x - mean_x, y - mean_y);
            xx += dx * dx;
            xy += dx * dy;
            yy += dy * dy;
        }
        xy * xy / (xx * yy)
    }

    /// Mean slope of the pressure series between two of its members, mm/kPa.
    fn slope_per_kpa(&self, from: usize, to: usize) -> f64 {
        (self.pressure_mm[to] - self.pressure_mm[from]) / ((to - from) as f64 * 0.4)
    }
}

/// Every quantitative sentence of sections II and III, in the paper's order.
///
/// # Errors
/// None for the parameters in this crate.
pub fn rows() -> Result<[Row; ROWS], OutOfRange> {
    let runs = Runs::new()?;
    let design = Design::paper_printed();
    let rig = roller::Params::PAPER;
    let pipe = tube::Params::PAPER;
    let block = folded::Params::PAPER;
    let deepest_mm = INDENTATIONS_MM[4];
    let fine = roller::Params {
        step_mm: 0.1,
        ..rig
    };
    let pass = roller::isolated_pass(fine, deepest_mm)?;
    let shallow = roller::isolated_pass(fine, INDENTATIONS_MM[0])?;
    let mut pushed = folded::FoldedBody::new(block, deepest_mm)?;
    pushed.carriage_to(block.stroke_mm)?;
    let antegrade_mm = pushed.displacement_mm();
    pushed.carriage_to(0.0)?;
    let returning_mm = pushed.displacement_mm() - antegrade_mm;
    let ring_pa = ring_buckling_pa(&pipe);
    let d0_mm = design.shortening_per_crescent_mm(3.0)?;
    let with = |alpha_deg: f64, beta_deg: f64, core_ratio: f64| {
        Design::new(24.40, core_ratio * 24.40, alpha_deg, beta_deg, 9)
    };
    let other = |tan_beta: f64, crescents: u8| {
        let paper = rig.body.design;
        let mut params = rig;
        params.body.design = Design::with_slopes(
            paper.width_mm(),
            paper.core_mm(),
            paper.tan_alpha(),
            tan_beta,
            crescents,
        )?;
        roller::run(params, deepest_mm)
    };
    let steep_mm = other(1.0, 9)?;
    let tan_beta = rig.body.design.tan_beta();
    let (few_mm, many_mm) = (other(tan_beta, 5)?, other(tan_beta, 13)?);
    let mut body = Chain::new(rig.body)?;
    let at_rest_mm = body.head_mm() - body.core_tail_mm();
    body.step(|_| deepest_mm)?;
    body.step(|_| 0.0)?;
    let released_mm = body.head_mm() - body.core_tail_mm() - at_rest_mm;
    Ok(table! {
        "II" {
            "squeezed across, it contracts along its axis":
                "length at a = 5.05 mm over length at rest", "less than 1", "",
                Outcome = design.length_mm(deepest_mm)? / design.length_mm(0.0)?,
                "the negative Poisson's ratio of the text";
            "released, it restores the original shape":
                "length after release less length at rest", "0", "mm", Built = released_mm,
                "an inextensible chain has no other shape";
            "the angles act like an anisotropic friction":
                "friction ratio r on the rig", "more than 1", "", Fitted = rig.body.friction_ratio,
                "fitted to the retrograde waves of section III; in the tube 1.222 [assumed]";
        }
        "II.A" {
            "alpha should be around 13 deg":
                "d d0/d alpha at a = 3 mm", "0 at the optimum", "mm/rad", Outcome = design.slope_by_alpha_mm(3.0)?,
                "negative for every indentation: no optimum, the material sets the lower bound";
            "alpha too large: less forward deformation":
                "d0 at alpha = 20 deg less d0, a = 3 mm", "less", "mm",
                Outcome = with(20.0, 33.69, 0.2)?.shortening_per_crescent_mm(3.0)? - d0_mm;
            "alpha too small: the short side deforms backward": "side", "-", "", Outside, "rigid sides";
            "beta should be around 34 deg":
                "d d0/d beta at a = 3 mm", "0 at the optimum", "mm/rad", Outcome = design.slope_by_beta_mm(3.0)?,
                "positive for every indentation: the kinematics set no upper bound";
            "beta too small: less forward deformation":
                "d0 at beta = 25 deg less d0, a = 3 mm", "less", "mm",
                Outcome = with(12.53, 25.0, 0.2)?.shortening_per_crescent_mm(3.0)? - d0_mm;
            "beta too large: the spacing increases":
                "phi at beta = 45 deg less phi", "more", "mm",
                Outcome = with(12.53, 45.0, 0.2)?.spacing_mm() - design.spacing_mm();
            "beta too large: less total displacement":
                "displacement in 40 s with beta = 45 deg less with 33.69, a = 5.05 mm", "less", "mm",
                Outcome = steep_mm - runs.roller_mm[4],
                "missed: with nine crescents either way, the longer strokes outweigh that fewer lie under a wave";
            "W is roughly the intestine's diameter":
                "W / D", "about 1", "", Input = design.width_mm() / block.intestine_mm;
            "W too small: not stuck; too large: slower": "width", "-", "", Outside, "the models start from W = D";
            "c should be 1/5 of M": "c", "1/5", "mm", Input = design.core_mm(), "M is W";
            "c too long: much less forward deformation":
                "d0 at c/W = 0.4 less d0, a = 3 mm", "less", "mm",
                Outcome = with(12.53, 33.69, 0.4)?.shortening_per_crescent_mm(3.0)? - d0_mm,
                "a fifth less; the gap h is a quarter smaller";
            "c too short: easily bent": "core", "-", "", Outside, "rigid core";
            "the number m should be about 9":
                "m", "9", "", Input = design.crescents().into(), "n in the words, m in Eq. (7)";
            "m too small: hard to move":
                "displacement in 40 s with m = 5 less with 9, a = 5.05 mm", "less", "mm",
                Outcome = few_mm - runs.roller_mm[4],
                "fewer crescents, less of it";
            "m too large: less efficient":
                "displacement in 40 s with m = 13 less with 9, a = 5.05 mm", "less", "mm",
                Outcome = many_mm - runs.roller_mm[4],
                "missed: a common friction cancels, and a longer body goes farther";
            "alpha = 12.53 deg works best":
                "alpha of tan = 2/9", "12.53", "deg", Outcome = libm::atan(2.0 / 9.0).to_degrees(),
                "the printed angle is this ratio's";
            "beta = 33.69 deg works best":
                "beta of tan = 2/3", "33.69", "deg", Outcome = libm::atan(2.0 / 3.0).to_degrees(),
                "the printed angle is this ratio's";
            "the tail moves forward by d = m d0":
                "d at a = 5.05 mm", "-", "mm", Outcome = design.shortening_mm(deepest_mm)?,
                "this is the core's shortening";
            "the tail moves forward by d = m d0":
                "overall shortening at a = 5.05 mm", "-", "mm",
                Outcome = design.length_mm(0.0)? - design.length_mm(deepest_mm)?,
                "less than d: the last wing lies back";
            "the larger d, the stronger the mobility":
                "rising steps of 4, a_1 to a_5", "all", "", Outcome = Runs::rising(&runs.roller_mm),
                "on the rig; d rises with a";
        }
        "II.B" {
            "tube diameter 24.00 mm":
                "W in the tube", "24.00", "mm", Input = pipe.body.design.width_mm(), "read as the inner diameter";
            "tube length 84.00 mm":
                "length", "84.00", "mm", Input = f64::from(pipe.segments) * pipe.segment_mm, "10 segments of 8.4 mm";
            "thickness 2.40 mm, Young's modulus 1 MPa":
                "elastic indentation per kPa", "-", "mm/kPa", Input = pipe.compliance_mm_per_pa() * 1000.0,
                "thin ring, nu = 0.49 assumed";
            "density 1 g/mm^3, origami 1.4 g/mm^3":
                "density", "1; 1.4", "g/mm^3", Outside, "1000 times too large as printed; the models have no mass";
            "viscosity 5.35 MPa s": "viscosity", "5.35", "MPa s", Outside, "the wall follows its pressure at once";
            "crescents 2.00 mm wide and 0.80 mm thick": "section", "2.00 x 0.80", "mm", Outside, "rigid sides";
            "shear modulus 0.6 MPa, bulk modulus 2.0 GPa": "moduli", "0.6; 2000", "MPa", Outside, "rigid sides";
            "10 segments of 8.4 mm, at 1 s intervals":
                "speed of the wave", "-", "mm/s", Outcome = pipe.segment_mm / pipe.delay_s,
                "the paper's source for the intestine: up to 10 mm/s";
            "3 s of pressure: up in 1.5 s, down in 1.5 s":
                "pulse", "3", "s", Input = pipe.pulse_s, "repeated every 10 s: assumed";
            "4000 Pa internal pressure":
                "4000 Pa + buckling pressure of the ring", "-", "Pa", Outcome = 4000.0 + ring_pa,
                "near the 6000 Pa where the displacement becomes faster; not used in the model";
            "displacement within 20 s": "length of a run", "20", "s", Input = pipe.duration_s;
            "friction series at 7000 Pa": "peristaltic pressure", "7000", "Pa", Input = 7000.0;
            "friction coefficients 0.08 to 0.20, by 0.005":
                "number of runs", "25", "", Input = frictions().len() as f64;
            "pressures 3000 to 7000 Pa, by 400": "number of runs", "11", "", Input = pressures_pa().len() as f64;
            "pressure series at friction 0.15": "friction", "0.15", "", Input = pipe.body.friction, "it cancels";
            "from 3000 Pa the intestine indents slightly":
                "wall at 3000 Pa", "slightly", "mm", Fitted = pipe.wall_mm(3000.0);
            "above 7000 Pa it is severely shrunk": "wall at 7000 Pa", "severely", "mm", Fitted = pipe.wall_mm(7000.0),
                "of 9.6 mm to the core; p_c = 7100 Pa";
        }
        "II.C" {
            "about 14 mm in 20 s at each friction":
                "least over 0.08 to 0.20, 7000 Pa", "about 14", "mm", Fitted = runs.friction_mm.0,
                "the displacement is fitted";
            "no obvious correlation with friction":
                "greatest minus least, 7000 Pa", "none", "mm", Built = runs.friction_mm.1 - runs.friction_mm.0,
                "a common friction cancels";
            "from about 1 mm": "displacement at 3000 Pa", "about 1", "mm", Fitted = runs.pressure_mm[0];
            "to about 15 mm": "displacement at 7000 Pa", "about 15", "mm", Fitted = runs.pressure_mm[10],
                "depends on the start phase and the time step";
            "significant positive curvature": "upward bends of 9", "all", "", Fitted = Runs::convex(&runs.pressure_mm),
                "ripple of nine tips on a convex trend";
            "the greater the pressure, the faster":
                "rising steps of 10", "all", "", Outcome = Runs::rising(&runs.pressure_mm);
        }
        "II.D" {
            "printing accuracy 0.15 mm, shore hardness 95 A":
                "fabrication", "0.15", "mm", Outside, "exact and rigid in the models";
        }
        "III" {
            "wave displacement restricted to 130 mm": "stroke", "130", "mm", Input = rig.stroke_mm;
            "structure 24.40 mm wide, as the intestine":
                "W on the rig", "24.40", "mm", Input = rig.body.design.width_mm();
            "tail at the left end, rollers at the right":
                "tail at the start", "0", "mm", Input = rig.body.tail_mm, "the tip of the rearmost wing";
            "silicone Ecoflex 00-30": "shore hardness", "00-30", "", Outside, "the wall is the rollers' arc";
            "rollers of 40 mm diameter": "diameter", "40", "mm", Input = 2.0 * rig.radius_mm,
                "the wave is their arc; the silicone's own bending is left out";
            "width D = 24.40 mm, mean of 5 places": "D", "24.40", "mm", Input = block.intestine_mm;
            "a_n = (D - i_n)/2, i_n from 5 places":
                "a for i = 14.30 mm", "5.05", "mm", Outcome = indentation_from_calipers_mm(24.40, 14.30)?,
                "i_5 follows from a_5; a_1 to a_4 are not in the text";
            "peristaltic indentation a_1 to a_5":
                "number of indentations", "5", "", Input = INDENTATIONS_MM.len() as f64,
                "1, 2, 3, 4 mm [assumed] and 5.05 mm";
            "back and forth 5 times in 40 s":
                "mean speed of the carriage", "-", "mm/s", Outcome = f64::from(rig.cycles) * 2.0 * rig.stroke_mm / 40.0,
                "three times the intestine's wave; the models have no speed";
            "retrograde waves hardly cause displacement":
                "isolated return pass at 5.05 mm", "hardly", "mm", Fitted = pass.returning_mm,
                "roller step 0.1 mm; an antegrade pass gives the next row";
            "retrograde waves hardly cause displacement":
                "isolated return pass at 1 mm", "hardly", "mm", Outcome = shallow.returning_mm,
                "a third of the antegrade pass, 2.710 mm: at small indentations the sentence is missed";
            "the antegrade wave moves the structure":
                "isolated antegrade pass at 5.05 mm", "-", "mm", Outcome = pass.antegrade_mm, "no number in the text";
            "10 experiments under each condition":
                "spread", "10", "", Outside, "the models have no scatter; a campaign repeats real trials";
        }
        "III.A" {
            "increases approximately linearly with the indentation":
                "R^2 of a line, 5 indentations", "about 1", "", Fitted = runs.linearity(), "chi is fitted to this";
            "increases with the indentation": "displacement in 40 s at 5.05 mm", "-", "mm", Outcome = runs.roller_mm[4],
                "a prediction: the text gives no millimetres";
            "lubricated and unlubricated differ little":
                "greatest difference, friction 0.08 and 0.20", "not very different", "mm", Built = runs.lubrication_mm,
                "a common friction cancels";
            "low and high friction differ little in the simulation":
                "greatest difference, friction 0.08 and 0.20, all pressures", "no very", "mm",
                Built = runs.tube_friction_mm,
                "a common friction cancels";
            "faster from about 6000 Pa":
                "mean slope 3000 to 5800 Pa", "-", "mm/kPa", Fitted = runs.slope_per_kpa(0, 7), "p_c is fitted";
            "faster from about 6000 Pa":
                "mean slope 5800 to 7000 Pa", "more", "mm/kPa", Fitted = runs.slope_per_kpa(7, 10), "p_c is fitted";
            "folded, it moves in the opposite direction at 5.05 mm":
                "displacement in 40 s", "opposite", "mm", Outcome = antegrade_mm,
                "21 mm of thread, laid down at mid-stroke (assumed); below 14.3 mm of width it would not be touched";
            "folded, recorded within 40 s": "cycles", "40 s", "", Input = f64::from(block.cycles), "5 cycles of 8 s";
            "the wave from left to right hardly moves it":
                "displacement by the return stroke", "hardly", "mm", Built = returning_mm,
                "a pushed block lies ahead of the roller";
        }
    })
}

/// Buckling pressure of a free elastic ring under outer pressure, Pa: `E t^3 / (4 (1-nu^2) R^3)`, R to the middle of
/// the wall.
fn ring_buckling_pa(params: &tube::Params) -> f64 {
    let ratio = params.thickness_mm / (params.radius_mm + params.thickness_mm / 2.0);
    params.modulus_pa * ratio * ratio * ratio / (4.0 * (1.0 - params.poisson * params.poisson))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_step_does_not_rise_and_a_straight_series_does_not_bend() {
        for (series, rising, convex) in [
            (&[1.0, 2.0, 3.0, 4.0][..], 3.0, 0.0),
            (&[1.0, 1.0, 2.0, 2.0], 1.0, 1.0),
            (&[4.0, 5.0, 7.0, 6.0], 2.0, 1.0),
            (&[8.0, 4.0, 2.0, 1.0], 0.0, 2.0),
        ] {
            assert_eq!(Runs::rising(series), rising, "{series:?}");
            assert_eq!(Runs::convex(series), convex, "{series:?}");
        }
    }
}
