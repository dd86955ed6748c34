//! Each sentence of the paper's sections II and III that states a number or a trend, beside a model's result.
//!
//! The rows are data for reports; [`Table`] prints them as the Markdown table of `docs/science.md`. A [`Condition`]
//! says what a sentence requires of the value; [`odds`] counts how many of several bodies meet it.

mod condition;
mod odds;
mod print;
mod runs;

use core::fmt;

pub use condition::Condition;
pub use odds::{Asked, Odds, Share, Values, odds};
pub use print::{Bodies, Table};

use crate::body::{Chain, FrictionRatio};
use crate::kinematics::{Design, indentation_from_calipers_mm, repaired_eq6_residual};
use crate::model::Model;
use crate::paper::{INDENTATIONS_MM, pressures_pa};
use crate::prior::{self, ABOUT_1_MM, Band, FASTER, HARDLY, LINEAR, Words};
use crate::range::OutOfRange;
use crate::{folded, roller, trend, tube};

use runs::{RigRuns, TubeRuns};

/// The value of an agreement between model and sentence as evidence.
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

/// How a sentence selects the bodies that agree with the words ([`crate::prior::agrees`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Chosen {
    /// A body that misses the row's condition is rejected.
    Wholly,
    /// A body has to meet only a weaker form of the row's condition.
    Partly,
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
    /// The condition that the sentence puts on the value; none if it states neither number nor trend.
    pub condition: Option<Condition>,
    /// The world whose runs give the value; none if it needs no run of the unfolded body.
    pub world: Option<Words>,
    /// Whether this sentence selects the bodies that agree with the words. Those bodies then meet it always, or more
    /// often, and that is no evidence.
    pub chosen: Option<Chosen>,
    /// Value of an agreement as evidence.
    pub evidence: Evidence,
    /// Comment; may be empty.
    pub remark: &'static str,
}

/// Number of rows.
pub const ROWS: usize = 90;

/// Default number of prior draws behind each probability: enough to know a share to 0.07.
pub const BODIES: u16 = 200;

/// The friction coefficients of section II.B: 0.08, 0.085 ... 0.20.
pub fn frictions() -> impl ExactSizeIterator<Item = f64> + Clone {
    (0..25u8).map(|i| f64::from(80 + 5 * u16::from(i)) / 1000.0)
}

/// "About 14 mm" and "about 15 mm": so many millimetres to either side [assumed].
const ABOUT_MM: f64 = 1.0;
/// Largest difference that counts as "not very different", "no obvious correlation" or "hardly" of a stroke
/// [assumed].
const LITTLE_MM: f64 = 1.0;
/// At an optimum the displacement of a crescent changes by less than this per radian [assumed].
const OPTIMUM_MM: f64 = 0.5;
/// "Slightly" indented: at most this share of the distance to the core [assumed].
const SLIGHTLY: f64 = 0.1;
/// "Severely shrunk": at least this share of the distance to the core [assumed].
const SEVERELY: f64 = 0.25;

/// The rows, section by section: `sentence: quantity, paper's value, unit, evidence on world = model's value, wants
/// condition, chosen how, remark;`. World, model's value, condition, choice and remark are optional. A value is
/// computed only if the question wants it.
macro_rules! table {
    ($asked:ident; $($section:literal { $(
        $sentence:literal: $quantity:literal, $paper:literal, $unit:literal,
            $evidence:ident $(on $world:ident)? $(= $model:expr)? $(, wants $condition:expr)? $(, chosen $chosen:ident)?
            $(, $remark:literal)?;
    )* })*) => {
        [$($({
            let condition = None$(.or(Some($condition)))?;
            let world = None$(.or(Some(Words::$world)))?;
            let value = || -> Result<Option<f64>, OutOfRange> { Ok(None$(.or(Some($model)))?) };
            Row {
                section: $section,
                sentence: $sentence,
                quantity: $quantity,
                paper: $paper,
                model: if $asked.wants(world, condition) { value()? } else { None },
                unit: $unit,
                condition,
                world,
                chosen: None$(.or(Some(Chosen::$chosen)))?,
                evidence: Evidence::$evidence,
                remark: concat!($($remark)?),
            }
        }),*),*]
    };
}

/// Displacement in 40 s at the deepest indentation, over the draws that agree with the words on the rig.
fn band_on_rig(model: &Model) -> Result<Band, OutOfRange> {
    let mut values = [0.0; prior::DRAWS as usize];
    let mut count = 0;
    for (slot, draw) in values.iter_mut().zip(prior::agreeing(Words::Rig)) {
        let mut params = draw.apply(model).rig()?;
        params.step_mm = BAND_STEP_MM;
        *slot = roller::run(params, INDENTATIONS_MM[4])?;
        count += 1;
    }
    Band::of(&mut values[..count]).ok_or(OutOfRange {
        quantity: "number of draws",
        value: 0.0,
        min: 1.0,
        max: prior::DRAWS.into(),
        unit: "",
        ends: crate::range::Ends::Closed,
        because: "a band needs draws that agree with the words",
    })
}

/// Step of the roller in the band, mm: its error of at most 0.3 mm is invisible there.
const BAND_STEP_MM: f64 = 0.25;

/// Every sentence of sections II and III with a number or a trend, and two of section I, in the paper's order, each
/// with the model's value.
///
/// # Errors
/// A model with a value outside its range.
pub fn rows(model: &Model) -> Result<[Row; ROWS], OutOfRange> {
    Ok(Sheet::new(model)?.rows)
}

/// The rows of one model, kept with the values that are needed to evaluate other bodies.
#[derive(Clone, Debug, PartialEq)]
pub struct Sheet {
    /// The rows.
    pub rows: [Row; ROWS],
    /// Values that do not depend on the body.
    common: Common,
}

impl Sheet {
    /// Evaluates every row for a model.
    ///
    /// # Errors
    /// A model with a value outside its range.
    pub fn new(model: &Model) -> Result<Self, OutOfRange> {
        let common = Common {
            facets_mm: runs::over_frictions(Model::TUBE.tube()?)?,
            band: band_on_rig(model)?,
        };
        let asked = Questions {
            worlds: &[Words::Rig, Words::Tube],
            roughly: false,
        };
        let rows = evaluate(model, &asked, &common)?;
        Ok(Self { rows, common })
    }

    /// Values of another body for the rows with a condition, in these worlds. Computed with the same coarse steps as
    /// the selection of the bodies that agree with the words.
    ///
    /// # Errors
    /// A model with a value outside its range.
    pub fn values(&self, model: &Model, worlds: &[Words]) -> Result<Values, OutOfRange> {
        let asked = Questions {
            worlds,
            roughly: true,
        };
        Ok(evaluate(model, &asked, &self.common)?.map(|row| row.model))
    }
}

/// Values of the rows that do not depend on the body.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Common {
    /// Least and greatest displacement over the frictions at 7000 Pa, for the body `tube`, whose friction ratio
    /// follows from the friction.
    facets_mm: (f64, f64),
    /// Prior band on the rig.
    band: Band,
}

/// The rows to compute.
struct Questions<'a> {
    /// Rows of these worlds, and rows that belong to no world.
    worlds: &'a [Words],
    /// With coarse steps, and only the rows with a condition.
    roughly: bool,
}

impl Questions<'_> {
    fn wants(&self, world: Option<Words>, condition: Option<Condition>) -> bool {
        world.is_none_or(|world| self.worlds.contains(&world))
            && (condition.is_some() || !self.roughly)
    }
}

fn evaluate(
    model: &Model,
    asked: &Questions<'_>,
    common: &Common,
) -> Result<[Row; ROWS], OutOfRange> {
    let (mut rig, mut pipe) = (model.rig()?, model.tube()?);
    if asked.roughly {
        (rig, pipe) = (prior::rough_rig(rig), prior::rough_tube(pipe));
    }
    let block = model.folded(None)?;
    let on_rig = if asked.worlds.contains(&Words::Rig) {
        RigRuns::new(rig, asked.roughly)?
    } else {
        RigRuns::NOT_ASKED
    };
    let in_tube = if asked.worlds.contains(&Words::Tube) {
        TubeRuns::new(pipe, asked.roughly)?
    } else {
        TubeRuns::NOT_ASKED
    };
    let Common { facets_mm, band } = *common;
    let design = Design::paper_printed();
    let deepest_mm = INDENTATIONS_MM[4];
    let deepest = on_rig.passes[4];
    let mut pushed = folded::FoldedBody::new(block, deepest_mm)?;
    pushed.carriage_to(block.stroke_mm)?;
    let antegrade_mm = pushed.displacement_mm();
    pushed.carriage_to(0.0)?;
    let returning_mm = pushed.displacement_mm() - antegrade_mm;
    let undrawn_mm = folded::run(model.folded(Some(0.0))?, deepest_mm)?;
    let ring_pa = ring_buckling_pa(&pipe);
    let d0_mm = design.shortening_per_crescent_mm(3.0)?;
    let with = |alpha_deg: f64, beta_deg: f64, core_ratio: f64| {
        Design::new(24.40, core_ratio * 24.40, alpha_deg, beta_deg, 9)
    };
    let body = rig.body.design;
    let other = |tan_beta: f64, crescents: u8| {
        Design::with_slopes(
            body.width_mm(),
            body.core_mm(),
            body.tan_alpha(),
            tan_beta,
            crescents,
        )
    };
    let run = |design: Design<f64>| {
        let mut params = rig;
        params.body.design = design;
        roller::run(params, deepest_mm)
    };
    // At 45 deg, take the number of crescents that comes nearest to the length of the core.
    let steep = other(1.0, 1)?;
    let as_long = libm::round(body.core_length_mm(0.0)? / steep.spacing_mm());
    let steep = other(1.0, as_long.clamp(1.0, 32.0) as u8)?;
    let (few, many) = (other(body.tan_beta(), 5)?, other(body.tan_beta(), 13)?);
    let per_crescent = |mm: f64, design: Design<f64>| mm / f64::from(design.crescents());
    let wave_mm = 2.0 * libm::sqrt(deepest_mm * (2.0 * rig.radius_mm - deepest_mm));
    let mut chain = Chain::new(rig.body)?;
    let at_rest_mm = chain.head_mm() - chain.core_tail_mm();
    chain.step(|_| deepest_mm)?;
    let (squeezed_tail_mm, squeezed_head_mm) =
        (chain.displacement_mm(), chain.head_displacement_mm());
    chain.step(|_| 0.0)?;
    let released_mm = chain.head_mm() - chain.core_tail_mm() - at_rest_mm;
    let released_head_mm = chain.head_displacement_mm() - squeezed_head_mm;
    let often = tube::Params {
        period_s: 4.0,
        ..pipe
    };
    let steps = INDENTATIONS_MM.windows(2).map(|pair| pair[1] - pair[0]);
    let (least, most) = (
        steps.clone().fold(f64::INFINITY, f64::min),
        steps.fold(0.0, f64::max),
    );
    Ok(table! { asked;
        "I" {
            "15 to 18 peristaltic waves per minute":
                "waves per minute in the tube", "15 to 18", "1/min", Input = 60.0 / pipe.period_s,
                wants Condition::Within(15.0, 18.0),
                "missed: a period of 10 s [assumed], of 3.3 to 4 s in the sentence: section II.B does not say which it uses";
            "15 to 18 peristaltic waves per minute":
                "displacement in 20 s at 7000 Pa, a wave every 4 s", "-", "mm", Outcome on Tube = tube::averaged(often, 7000.0)?.tail_mm,
                "the fit holds for a period of 10 s only";
        }
        "II" {
            "squeezed across, it contracts along its axis":
                "length at a = 5.05 mm over length at rest", "less than 1", "",
                Outcome = design.length_mm(deepest_mm)? / design.length_mm(0.0)?,
                wants Condition::Below(1.0),
                "the negative Poisson's ratio of the text";
            "released, it restores the original shape":
                "length after release less length at rest", "0", "mm", Built on Rig = released_mm,
                wants Condition::exactly(0.0),
                "an inextensible chain has no other shape";
            "the angles act like an anisotropic friction":
                "friction ratio r", "more than 1", "", Fitted on Rig = rig.body.friction_ratio.at(&body, rig.body.friction)?,
                wants Condition::Above(1.0),
                "fitted to the retrograde waves of section III, not derived from the angles";
            "the angles act like an anisotropic friction":
                "(1 + mu tan beta)/(1 - mu tan beta), mu = 0.15", "more than 1", "",
                Outcome = FrictionRatio::Facets.at(&body, 0.15)?,
                wants Condition::Above(1.0),
                "what the angles alone give: too little to hold against a returning roller";
        }
        "II.A" {
            "squeezed, the rear end shrinks forward":
                "tail forward by an even squeeze of 5.05 mm", "more than 0", "mm", Outcome on Rig = squeezed_tail_mm,
                wants Condition::Above(0.0),
                "follows from r above 1; of its length by the coupling";
            "released, it expands and moves forward":
                "head forward by the release", "more than 0", "mm", Outcome on Rig = released_head_mm,
                wants Condition::Above(0.0),
                "the tail holds; follows from r above 1";
            "alpha should be around 13 deg":
                "d d0/d alpha at a = 3 mm", "0 at the optimum", "mm/rad", Outcome = design.slope_by_alpha_mm(3.0)?,
                wants Condition::about(0.0, OPTIMUM_MM),
                "missed: negative for every indentation, no optimum; the material sets the lower bound";
            "Eq. (6) gives the best alpha":
                "its left less its right side at 12.53 deg, a = 3 mm", "0", "", Outcome = repaired_eq6_residual(&design, 3.0),
                wants Condition::exactly(0.0),
                "missed: right side repaired to ((h-a)/h)^2; as printed it takes mm from 1/mm";
            "Eq. (6) gives the best alpha":
                "least root of the repaired form, any indentation", "12.53", "deg",
                Outcome = libm::atan(libm::sqrt((1.0 + libm::sqrt(5.0)) / 2.0)).to_degrees(),
                wants Condition::about(12.53, 0.005),
                "missed: tan^2 alpha = the golden ratio";
            "alpha too large: less forward deformation":
                "d0 at alpha = 20 deg less d0, a = 3 mm", "less", "mm",
                Outcome = with(20.0, 33.69, 0.2)?.shortening_per_crescent_mm(3.0)? - d0_mm,
                wants Condition::Below(0.0);
            "alpha too small: the short side deforms backward": "side", "-", "", Outside, "rigid sides";
            "beta should be around 34 deg":
                "d d0/d beta at a = 3 mm", "0 at the optimum", "mm/rad", Outcome = design.slope_by_beta_mm(3.0)?,
                wants Condition::about(0.0, OPTIMUM_MM),
                "missed: positive for every indentation, no optimum; the kinematics set no upper bound";
            "beta too small: less forward deformation":
                "d0 at beta = 25 deg less d0, a = 3 mm", "less", "mm",
                Outcome = with(12.53, 25.0, 0.2)?.shortening_per_crescent_mm(3.0)? - d0_mm,
                wants Condition::Below(0.0);
            "beta too large: the spacing increases":
                "phi at beta = 45 deg less phi", "more", "mm",
                Outcome = with(12.53, 45.0, 0.2)?.spacing_mm() - design.spacing_mm(),
                wants Condition::Above(0.0);
            "beta too large: fewer crescents under one wave":
                "wave's length over phi, beta = 45 less 33.69 deg, a = 5.05 mm", "less", "",
                Outcome = wave_mm / steep.spacing_mm() - wave_mm / body.spacing_mm(),
                wants Condition::Below(0.0),
                "the rollers' arc touches 26.6 mm of the wall";
            "beta too large: less total displacement":
                "displacement in 40 s, beta = 45 deg and as long a core, less with 33.69, a = 5.05 mm", "less", "mm",
                Outcome on Rig = run(steep)? - on_rig.roller_mm[4],
                wants Condition::Below(0.0),
                "5 crescents in 38.0 mm for 9 in 39.0 mm; with 9 on 68 mm it would go farther";
            "W is roughly the intestine's diameter":
                "W / D", "about 1", "", Input = body.width_mm() / block.intestine_mm,
                wants Condition::about(1.0, 0.05);
            "W too small: not stuck; too large: slower": "width", "-", "", Outside, "the models start from W = D";
            "c should be 1/5 of M": "c / W", "1/5", "", Input = body.core_mm() / body.width_mm(),
                wants Condition::about(0.2, 0.005), "M is W";
            "c too long: much less forward deformation":
                "d0 at c/W = 0.4 less d0, a = 3 mm", "less", "mm",
                Outcome = with(12.53, 33.69, 0.4)?.shortening_per_crescent_mm(3.0)? - d0_mm,
                wants Condition::Below(0.0),
                "a fifth less; the gap h is a quarter smaller";
            "c too short: easily bent": "core", "-", "", Outside, "rigid core";
            "the number m should be about 9":
                "m", "9", "", Input = body.crescents().into(),
                wants Condition::exactly(9.0), "n in the words, m in Eq. (7)";
            "m too small: hard to move":
                "displacement in 40 s with m = 5 less with 9, a = 5.05 mm", "less", "mm",
                Outcome on Rig = run(few)? - on_rig.roller_mm[4],
                wants Condition::Below(0.0),
                "fewer crescents, less of it";
            "m too large: less efficient":
                "displacement per crescent with m = 13 less with 9, a = 5.05 mm", "less", "mm",
                Outcome on Rig = per_crescent(run(many)?, many) - per_crescent(on_rig.roller_mm[4], body),
                wants Condition::Below(0.0),
                "efficient read as per crescent; in all a longer body goes farther";
            "alpha = 12.53 deg works best":
                "alpha of tan = 2/9", "12.53", "deg", Input = libm::atan(2.0 / 9.0).to_degrees(),
                wants Condition::about(12.53, 0.005),
                "circular: the ratio was read from the printed angle";
            "beta = 33.69 deg works best":
                "beta of tan = 2/3", "33.69", "deg", Input = libm::atan(2.0 / 3.0).to_degrees(),
                wants Condition::about(33.69, 0.005),
                "circular: the ratio was read from the printed angle";
            "the tail moves forward by d = m d0":
                "d at a = 5.05 mm", "more than 0", "mm", Outcome = design.shortening_mm(deepest_mm)?,
                wants Condition::Above(0.0),
                "this is the core's shortening";
            "the tail moves forward by d = m d0":
                "overall shortening at a = 5.05 mm", "more than 0", "mm",
                Outcome = design.length_mm(0.0)? - design.length_mm(deepest_mm)?,
                wants Condition::Above(0.0),
                "less than d: the last wing lies back";
            "the larger d, the stronger the mobility":
                "rising steps of 4, a_1 to a_5", "all", "", Outcome on Rig = trend::rising(&on_rig.roller_mm) as f64,
                wants Condition::exactly(4.0), chosen Wholly,
                "on the rig; d rises with a";
        }
        "II.B" {
            "tube diameter 24.00 mm":
                "W in the tube", "24.00", "mm", Input = pipe.body.design.width_mm(),
                wants Condition::about(24.0, 0.005), "read as the inner diameter";
            "tube length 84.00 mm":
                "length", "84.00", "mm", Input = f64::from(pipe.segments) * pipe.segment_mm,
                wants Condition::about(84.0, 0.005), "10 segments of 8.4 mm";
            "thickness 2.40 mm, Young's modulus 1 MPa":
                "elastic indentation per kPa", "-", "mm/kPa", Input = pipe.compliance_mm_per_pa() * 1000.0,
                "thin ring, nu = 0.49 assumed";
            "density 1 g/mm^3, origami 1.4 g/mm^3":
                "density", "1; 1.4", "g/mm^3", Outside, "1000 times too large as printed; the models have no mass";
            "viscosity 5.35 MPa s": "viscosity", "5.35", "MPa s", Outside, "the wall follows its pressure at once";
            "changed to a cross shape":
    "pairs of crescents", "-", "", Outside, "the models have one: a second doubles every contact alike, and that cancels";
            "crescents 2.00 mm wide and 0.80 mm thick": "section", "2.00 x 0.80", "mm", Outside, "rigid sides";
            "shear modulus 0.6 MPa, bulk modulus 2.0 GPa": "moduli", "0.6; 2000", "MPa", Outside, "rigid sides";
            "10 segments of 8.4 mm, at 1 s intervals":
                "speed of the wave", "-", "mm/s", Outcome = pipe.segment_mm / pipe.delay_s,
                "the paper's source for the intestine: up to 10 mm/s";
            "3 s of pressure: up in 1.5 s, down in 1.5 s":
                "pulse", "3", "s", Input = pipe.pulse_s,
                wants Condition::exactly(3.0), "repeated every 10 s: assumed";
            "4000 Pa internal pressure":
                "4000 Pa + buckling pressure of the ring", "-", "Pa", Outcome = 4000.0 + ring_pa,
                "near the 6000 Pa where the displacement becomes faster; not used in the model";
            "placed on the left side in the intestine":
                "spread over the placements at 7000 Pa", "-", "mm",
                Outcome on Tube = in_tube.pressure[10].range_mm.1 - in_tube.pressure[10].range_mm.0,
                "where against the segments is not in the text: every tube row is a mean over one segment";
            "displacement within 20 s": "length of a run", "20", "s", Input = pipe.duration_s,
                wants Condition::exactly(20.0);
            "friction series at 7000 Pa": "peristaltic pressure", "7000", "Pa", Input = 7000.0,
                wants Condition::exactly(7000.0);
            "friction coefficients 0.08 to 0.20, by 0.005":
                "number of runs", "25", "", Input = frictions().len() as f64, wants Condition::exactly(25.0);
            "pressures 3000 to 7000 Pa, by 400": "number of runs", "11", "", Input = pressures_pa().len() as f64, wants Condition::exactly(11.0);
            "pressure series at friction 0.15": "friction", "0.15", "", Input = pipe.body.friction,
                wants Condition::about(0.15, 0.005), "a fixed r makes it cancel";
            "from 3000 Pa the intestine indents slightly":
                "wall at 3000 Pa", "slightly", "mm", Fitted on Tube = pipe.wall_mm(3000.0),
                wants Condition::Within(0.0, SLIGHTLY * pipe.body.design.half_gap_mm());
            "above 7000 Pa it is severely shrunk": "wall at 7000 Pa", "severely", "mm", Fitted on Tube = pipe.wall_mm(7000.0),
                wants Condition::AtLeast(SEVERELY * pipe.body.design.half_gap_mm()),
                "of 9.6 mm to the core";
        }
        "II.C" {
            "about 14 mm in 20 s at each friction":
                "least over 0.08 to 0.20, 7000 Pa", "about 14", "mm", Fitted on Tube = in_tube.friction_mm.0,
                wants Condition::about(14.0, ABOUT_MM), chosen Partly,
                "missed: fitted to about 14 and about 15 at once; one sentence, not 25 values";
            "no obvious correlation with friction":
                "greatest minus least, 7000 Pa", "none", "mm", Built on Tube = in_tube.friction_mm.1 - in_tube.friction_mm.0,
                wants Condition::about(0.0, LITTLE_MM),
                "r is fixed, so a common friction cancels";
            "no obvious correlation with friction":
                "least over 0.08 to 0.20, r of the facets, body `tube`", "about 14", "mm", Outcome on Tube = facets_mm.0,
                wants Condition::about(14.0, ABOUT_MM),
                "missed: where r follows from the friction, friction matters";
            "no obvious correlation with friction":
                "greatest over 0.08 to 0.20, r of the facets, body `tube`", "about 14", "mm", Outcome on Tube = facets_mm.1,
                wants Condition::about(14.0, ABOUT_MM),
                "missed: half as much again as the least";
            "from about 1 mm": "displacement of the tail at 3000 Pa", "about 1", "mm", Fitted on Tube = in_tube.pressure[0].tail_mm,
                wants Condition::Within(ABOUT_1_MM.0, ABOUT_1_MM.1), chosen Wholly,
                "calibrated to";
            "from about 1 mm": "displacement of the head at 3000 Pa", "about 1", "mm", Fitted on Tube = in_tube.pressure[0].head_mm,
                wants Condition::Within(ABOUT_1_MM.0, ABOUT_1_MM.1), chosen Partly,
                "the figures mark the head; the text does not say which end it means";
            "to about 15 mm": "displacement of the tail at 7000 Pa", "about 15", "mm", Fitted on Tube = in_tube.pressure[10].tail_mm,
                wants Condition::about(15.0, ABOUT_MM), chosen Partly,
                "calibrated to";
            "about 14 mm, and about 15 mm, for 7000 Pa at friction 0.15":
                "displacement of the tail in both", "14; 15", "mm", Fitted on Tube = in_tube.pressure[10].tail_mm,
                wants Condition::Within(15.0 - ABOUT_MM, 14.0 + ABOUT_MM), chosen Partly,
                "missed: the paper has two values for one case; no value lies nearer than 0.5 mm to both";
            "significant positive curvature": "upward bends of 9", "all", "",
                Fitted on Tube = trend::convex(&in_tube.pressure_mm()) as f64,
                wants Condition::exactly(9.0), chosen Partly, "p_c is fitted";
            "the greater the pressure, the faster":
                "rising steps of 10", "all", "", Outcome on Tube = trend::rising(&in_tube.pressure_mm()) as f64,
                wants Condition::exactly(10.0), chosen Wholly;
        }
        "II.D" {
            "printing accuracy 0.15 mm, shore hardness 95 A":
                "fabrication", "0.15", "mm", Outside, "exact and rigid in the models";
        }
        "III" {
            "wave displacement restricted to 130 mm": "stroke", "130", "mm", Input = rig.stroke_mm,
                wants Condition::exactly(130.0);
            "structure 24.40 mm wide, as the intestine":
                "W on the rig", "24.40", "mm", Input = body.width_mm(),
                wants Condition::about(24.4, 0.005);
            "tail at the left end, rollers at the right":
                "tail at the start", "0", "mm", Input = rig.body.tail_mm,
                wants Condition::exactly(0.0), "the tip of the rearmost wing";
            "silicone Ecoflex 00-30": "shore hardness", "00-30", "", Outside, "the wall is the rollers' arc";
            "rollers of 40 mm diameter": "diameter", "40", "mm", Input = 2.0 * rig.radius_mm,
                wants Condition::exactly(40.0),
                "the wave is their arc; the silicone's own bending is left out";
            "width D = 24.40 mm, mean of 5 places": "D", "24.40", "mm", Input = block.intestine_mm,
                wants Condition::about(24.4, 0.005);
            "a_n = (D - i_n)/2, i_n from 5 places":
                "a for i = 14.30 mm", "5.05", "mm", Input = indentation_from_calipers_mm(24.40, 14.30)?,
                wants Condition::about(5.05, 0.005),
                "circular: i_5 was worked out from a_5; a_1 to a_4 are not in the text";
            "peristaltic indentation a_1 to a_5":
                "number of indentations", "5", "", Input = INDENTATIONS_MM.len() as f64,
                wants Condition::exactly(5.0),
                "1, 2, 3, 4 mm [assumed] and 5.05 mm";
            "one zigzag distance from each indentation to the next":
                "greatest step less least step, a_1 to a_5", "0", "mm", Input = most - least,
                wants Condition::exactly(0.0),
                "missed by the assumed 1, 2, 3, 4 mm; equal steps fix a_5 only, not the distance";
            "back and forth 5 times in 40 s":
                "mean speed of the carriage", "-", "mm/s", Outcome = f64::from(rig.cycles) * 2.0 * rig.stroke_mm / 40.0,
                "three times the intestine's wave; the models have no speed";
            "retrograde waves hardly cause displacement":
                "isolated return pass at 5.05 mm", "-", "mm", Fitted on Rig = deepest.returning_mm,
                "the next row has it as a share, the one after it an antegrade pass";
            "retrograde waves hardly cause displacement":
                "greatest share of an antegrade pass, a_1 to a_5", "hardly", "", Fitted on Rig = on_rig.worst_return(),
                wants Condition::AtMost(HARDLY), chosen Wholly,
                "at 2 mm of indentation";
            "the antegrade wave moves the structure":
                "isolated antegrade pass at 5.05 mm", "more than 0", "mm", Outcome on Rig = deepest.antegrade_mm,
                wants Condition::Above(0.0), chosen Wholly, "the text has no number";
            "10 experiments under each condition":
                "spread", "10", "", Outside, "the models have no scatter; a campaign repeats real trials";
        }
        "III.A" {
            "increases approximately linearly with the indentation":
                "R^2 of a line, 5 indentations", "about 1", "", Fitted on Rig = on_rig.linearity(false),
                wants Condition::AtLeast(LINEAR), chosen Wholly, "calibrated to";
            "increases approximately linearly with the indentation":
                "R^2 of a line, 5 indentations and the origin", "about 1", "", Fitted on Rig = on_rig.linearity(true),
                wants Condition::AtLeast(LINEAR), chosen Partly,
                "concave towards 0: the text does not say whether the line passes through it";
            "increases with the indentation":
                "rising steps of 4 from one indentation to the next", "all", "", Outcome on Rig = trend::rising(&on_rig.roller_mm) as f64,
                wants Condition::exactly(4.0), chosen Wholly;
            "increases with the indentation": "displacement in 40 s at 5.05 mm", "-", "mm", Outcome on Rig = on_rig.roller_mm[4],
                "the text gives no millimetres: see the next two rows";
            "increases with the indentation":
                "the same, 5 % of the bodies that agree with the words on the rig", "-", "mm", Outcome = band.low,
                "prior band: nothing in the text says where in it the body lies";
            "increases with the indentation":
                "the same, 95 % of these bodies", "-", "mm", Outcome = band.high,
                "prior band";
            "lubricated and unlubricated differ little":
                "greatest difference, friction 0.08 and 0.20", "not very different", "mm", Built on Rig = on_rig.lubrication_mm,
                wants Condition::about(0.0, LITTLE_MM),
                "r is fixed, so a common friction cancels";
            "low and high friction differ little in the simulation":
                "greatest difference, friction 0.08 and 0.20, all pressures", "no very", "mm",
                Built on Tube = in_tube.difference_mm,
                wants Condition::about(0.0, LITTLE_MM),
                "r is fixed, so a common friction cancels";
            "faster from about 6000 Pa":
                "mean slope 3000 to 5800 Pa", "-", "mm/kPa", Fitted on Tube = in_tube.slope_per_kpa(0, 7), "p_c is fitted";
            "faster from about 6000 Pa":
                "mean slope 5800 to 7000 Pa", "-", "mm/kPa", Fitted on Tube = in_tube.slope_per_kpa(7, 10), "p_c is fitted";
            "faster from about 6000 Pa":
                "the second slope over the first", "more than 1", "", Fitted on Tube = in_tube.faster(),
                wants Condition::AtLeast(FASTER), chosen Wholly, "p_c is fitted";
            "folded, it moves in the opposite direction at 5.05 mm":
                "displacement in 40 s", "opposite", "mm", Built = antegrade_mm,
                wants Condition::Below(0.0),
                "a switch: whoever declares it folded gets a block that is pushed; laid down at mid-stroke (assumed)";
            "folded, it moves in the opposite direction at 5.05 mm":
                "the same with 0 mm of thread, declared folded", "-", "mm", Built = undrawn_mm,
                "the same body declared unfolded goes headward: the thread decides nothing but the width";
            "folded, recorded within 40 s": "cycles", "5", "", Input = f64::from(block.cycles),
                wants Condition::exactly(5.0), "5 cycles of 8 s";
            "the wave from left to right hardly moves it":
                "displacement by the return stroke", "hardly", "mm", Built = returning_mm,
                wants Condition::about(0.0, LITTLE_MM),
                "a pushed block lies ahead of the roller";
        }
    })
}

/// Buckling pressure of a free elastic ring under outer pressure, Pa: `E t^3 / (4 (1-nu^2) R^3)`, with R to the
/// middle of the wall.
fn ring_buckling_pa(params: &tube::Params) -> f64 {
    let ratio = params.thickness_mm / (params.radius_mm + params.thickness_mm / 2.0);
    params.modulus_pa * ratio * ratio * ratio / (4.0 * (1.0 - params.poisson * params.poisson))
}
