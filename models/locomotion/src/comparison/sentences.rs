//! The sentences as data: each with its value as a formula of the figures of one body.

use crate::body::FrictionRatio;
use crate::comparison::figures::{DEEPEST_MM, Figures, design, uneven_mm};
use crate::comparison::{Chosen, Condition, Evidence, ROWS, frictions};
use crate::kinematics::{indentation_from_calipers_mm, repaired_eq6_residual};
use crate::paper::{INDENTATIONS_MM, pressures_pa};
use crate::prior::{ABOUT_1_MM, FASTER, HARDLY, LINEAR, Words};
use crate::range::OutOfRange;
use crate::trend;

/// The model's value for a sentence.
type Formula = fn(&Figures<'_>) -> Result<f64, OutOfRange>;

/// One sentence of the paper. The fields are those of [`Row`](crate::comparison::Row), with formulas for its numbers.
pub(super) struct Sentence {
    pub(super) section: &'static str,
    pub(super) sentence: &'static str,
    pub(super) quantity: &'static str,
    pub(super) paper: &'static str,
    pub(super) unit: &'static str,
    pub(super) evidence: Evidence,
    pub(super) world: Option<Words>,
    pub(super) value: Option<Formula>,
    pub(super) condition: Option<fn(&Figures<'_>) -> Condition>,
    pub(super) chosen: Option<Chosen>,
    pub(super) remark: &'static str,
}

/// "About 14 mm" and "about 15 mm": so many millimetres to either side [assumed].
const ABOUT_MM: f64 = 1.0;
/// Largest difference that counts as "not very different", "no obvious correlation" or "hardly" of a stroke
/// [assumed].
const LITTLE_MM: f64 = 1.0;
/// At an optimum the displacement of a crescent changes by less than this per radian [assumed].
const OPTIMUM_MM: f64 = 0.5;
/// `d = m d0` of the printed body at 5.05 mm, mm, as the row above it has it.
const M_D0_MM: f64 = 21.7;
/// "Greatly reduced": to this share or less [assumed].
const GREATLY: f64 = 0.5;
/// "From about 6000 Pa": so many pascals to either side [assumed], the step of the series.
const ABOUT_PA: f64 = 400.0;
/// "Slightly" indented: at most this share of the distance to the core [assumed].
const SLIGHTLY: f64 = 0.1;
/// "Severely shrunk": at least this share of the distance to the core [assumed].
const SEVERELY: f64 = 0.25;

macro_rules! given {
    () => {
        None
    };
    ($value:expr) => {
        Some($value)
    };
}

/// The rows, section by section: `sentence: quantity, paper's value, unit, evidence on world = model's value, wants
/// condition, chosen how, remark;`. World, model's value, condition, choice and remark are optional. Value and
/// condition see the figures by the name before the sections.
macro_rules! table {
    ($figures:ident; $($section:literal { $(
        $sentence:literal: $quantity:literal, $paper:literal, $unit:literal,
            $evidence:ident $(on $world:ident)? $(= $model:expr)? $(, wants $condition:expr)? $(, chosen $chosen:ident)?
            $(, $remark:literal)?;
    )* })*) => {
        [$($(Sentence {
            section: $section,
            sentence: $sentence,
            quantity: $quantity,
            paper: $paper,
            unit: $unit,
            evidence: Evidence::$evidence,
            world: given!($(Words::$world)?),
            value: given!($(|$figures| Ok($model))?),
            condition: given!($(|$figures| $condition)?),
            chosen: given!($(Chosen::$chosen)?),
            remark: concat!($($remark)?),
        }),*),*]
    };
}

/// Every sentence, in the paper's order.
#[expect(unused_variables, reason = "many values and conditions are constants")]
pub(super) static SENTENCES: [Sentence; ROWS] = table! { f;
    "I" {
        "15 to 18 peristaltic waves per minute":
            "waves per minute in the tube", "15 to 18", "1/min", Input = 60.0 / f.pipe.period_s,
            wants Condition::Within(15.0, 18.0),
            "a period of 10 s [assumed], of 3.3 to 4 s in the sentence: section II.B does not say which it uses";
        "15 to 18 peristaltic waves per minute":
            "displacement in 20 s at 7000 Pa, a wave every 4 s", "-", "mm", Outcome on Tube = f.often_mm()?,
            "the fit holds for a period of 10 s only";
    }
    "II" {
        "squeezed across, it contracts along its axis":
            "length at a = 5.05 mm over length at rest", "less than 1", "",
            Outcome = f.printed.length_mm(DEEPEST_MM)? / f.printed.length_mm(0.0)?,
            wants Condition::Below(1.0),
            "the negative Poisson's ratio of the text";
        "released, it restores the original shape":
            "length after release less length at rest", "0", "mm", Outcome on Rig = f.squeezed()?.released_mm,
            wants Condition::exactly(0.0),
            "an inextensible chain has no other shape";
        "the angles act like an anisotropic friction":
            "friction ratio r", "more than 1", "",
                Fitted on Rig = f.rig.body.friction_ratio.at(&f.body(), f.rig.body.friction)?,
            wants Condition::Above(1.0),
            "fitted to the retrograde waves of section III, not derived from the angles";
        "the angles act like an anisotropic friction":
            "(1 + mu tan beta)/(1 - mu tan beta), mu = 0.15", "more than 1", "",
            Outcome = FrictionRatio::Facets.at(&f.body(), 0.15)?,
            wants Condition::Above(1.0),
            "what the angles alone give: too little to hold against a returning roller";
    }
    "II.A" {
        "squeezed, the rear end shrinks forward":
            "tail forward by an even squeeze of 5.05 mm", "more than 0", "mm", Outcome on Rig = f.squeezed()?.tail_mm,
            wants Condition::Above(0.0),
            "follows from r above 1; of its length by the coupling";
        "released, it expands and moves forward":
            "head forward by the release", "more than 0", "mm", Outcome on Rig = f.squeezed()?.released_head_mm,
            wants Condition::Above(0.0),
            "the tail holds; follows from r above 1";
        "alpha should be around 13 deg":
            "d d0/d alpha at a = 3 mm", "0 at the optimum", "mm/rad", Outcome = f.printed.slope_by_alpha_mm(3.0)?,
            wants Condition::about(0.0, OPTIMUM_MM),
            "negative for every indentation, no optimum; the material sets the lower bound";
        "Eq. (6) gives the best alpha":
            "its left less its right side at 12.53 deg, a = 3 mm", "0", "",
                Outcome = repaired_eq6_residual(&f.printed, 3.0),
            wants Condition::exactly(0.0),
            "right side repaired to ((h-a)/h)^2; as printed it takes mm from 1/mm";
        "Eq. (6) gives the best alpha":
            "least root of the repaired form, any indentation", "12.53", "deg",
            Outcome = libm::atan(libm::sqrt((1.0 + libm::sqrt(5.0)) / 2.0)).to_degrees(),
            wants Condition::about(12.53, 0.005),
            "tan^2 alpha = the golden ratio";
        "alpha too large: less forward deformation":
            "d0 at alpha = 20 deg less d0, a = 3 mm", "less", "mm",
            Outcome = f.shortened_mm(design(20.0, 33.69, 0.2)?)?,
            wants Condition::Below(0.0);
        "alpha too small: the short side deforms backward": "side", "-", "", Outside, "rigid sides";
        "beta should be around 34 deg":
            "d d0/d beta at a = 3 mm", "0 at the optimum", "mm/rad", Outcome = f.printed.slope_by_beta_mm(3.0)?,
            wants Condition::about(0.0, OPTIMUM_MM),
            "positive for every indentation, no optimum; the kinematics set no upper bound";
        "beta too small: less forward deformation":
            "d0 at beta = 25 deg less d0, a = 3 mm", "less", "mm",
            Outcome = f.shortened_mm(design(12.53, 25.0, 0.2)?)?,
            wants Condition::Below(0.0);
        "beta too large: the spacing increases":
            "phi at beta = 45 deg less phi", "more", "mm",
            Outcome = design(12.53, 45.0, 0.2)?.spacing_mm() - f.printed.spacing_mm(),
            wants Condition::Above(0.0);
        "beta too large: fewer crescents under one wave":
            "wave's length over phi, beta = 45 less 33.69 deg, a = 5.05 mm", "less", "",
            Outcome = f.wave_mm() / f.as_long()?.spacing_mm() - f.wave_mm() / f.body().spacing_mm(),
            wants Condition::Below(0.0),
            "the rollers' arc touches 26.6 mm of the wall";
        "beta too large: less total displacement":
            "displacement in 40 s, beta = 45 deg, less with 33.69, a = 5.05 mm", "less", "mm",
            Outcome on Rig = f.run(f.steep(f.body().crescents())?)? - f.on_rig.roller_mm[4],
            wants Condition::Below(0.0),
            "nine crescents on 68 mm go farther than on 39 mm";
        "beta too large: less total displacement":
            "the same with as long a core", "less", "mm",
            Outcome on Rig = f.run(f.as_long()?)? - f.on_rig.roller_mm[4],
            wants Condition::Below(0.0),
            "5 crescents in 38.0 mm for 9 in 39.0 mm";
        "W is roughly the intestine's diameter":
            "W / D", "about 1", "", Input = f.body().width_mm() / f.block.intestine_mm,
            wants Condition::about(1.0, 0.05);
        "W too small: not stuck; too large: slower": "width", "-", "", Outside, "the models start from W = D";
        "c should be 1/5 of M": "c / W", "1/5", "", Input = f.body().core_mm() / f.body().width_mm(),
            wants Condition::about(0.2, 0.005), "M is W";
        "c too long: forward deformation greatly reduced":
            "d0 at c/W = 0.4 over d0, a = 3 mm", "greatly", "",
            Outcome = design(12.53, 33.69, 0.4)?.shortening_per_crescent_mm(3.0)?
                / f.printed.shortening_per_crescent_mm(3.0)?,
            wants Condition::AtMost(GREATLY),
            "the gap h is a quarter smaller";
        "c too short: easily bent": "core", "-", "", Outside, "rigid core";
        "the number m should be about 9":
            "m", "9", "", Input = f.body().crescents().into(),
            wants Condition::exactly(9.0), "n in the words, m in Eq. (7)";
        "m too small: hard to move":
            "displacement in 40 s with m = 5 less with 9, a = 5.05 mm", "less", "mm",
            Outcome on Rig = f.run(f.with_crescents(5)?)? - f.on_rig.roller_mm[4],
            wants Condition::Below(0.0),
            "fewer crescents, less of it";
        "m too large: less efficient":
            "displacement in 40 s with m = 13 less with 9, a = 5.05 mm", "less", "mm",
            Outcome on Rig = f.run(f.with_crescents(13)?)? - f.on_rig.roller_mm[4],
            wants Condition::Below(0.0),
            "a longer body goes farther";
        "m too large: less efficient":
            "displacement per crescent with m = 13 less with 9, a = 5.05 mm", "less", "mm",
            Outcome on Rig = f.run(f.with_crescents(13)?)? / 13.0 - f.on_rig.roller_mm[4] / f64::from(f.body().crescents()),
            wants Condition::Below(0.0),
            "efficient read as per crescent";
        "alpha = 12.53 deg works best":
            "alpha of tan = 2/9", "12.53", "deg", Input = libm::atan(2.0 / 9.0).to_degrees(),
            wants Condition::about(12.53, 0.005),
            "circular: the ratio was read from the printed angle";
        "beta = 33.69 deg works best":
            "beta of tan = 2/3", "33.69", "deg", Input = libm::atan(2.0 / 3.0).to_degrees(),
            wants Condition::about(33.69, 0.005),
            "circular: the ratio was read from the printed angle";
        "the total displacement is d = m d0":
            "d at a = 5.05 mm", "-", "mm", Outcome = f.printed.shortening_mm(DEEPEST_MM)?,
            "the number that Eq. (7) gives: the core's shortening";
        "the total displacement is d = m d0":
            "tail forward by an even squeeze of 5.05 mm", "21.7", "mm", Outcome on Rig = f.squeezed()?.tail_mm,
            wants Condition::about(M_D0_MM, 0.05),
            "the tips hook, but the coupling keeps less than half of it";
        "the total displacement is d = m d0":
            "overall shortening at a = 5.05 mm", "21.7", "mm",
            Outcome = f.printed.length_mm(0.0)? - f.printed.length_mm(DEEPEST_MM)?,
            wants Condition::about(M_D0_MM, 0.05),
            "the last wing lies back";
        "the larger d, the stronger the mobility":
            "rising steps of 4, a_1 to a_5", "all", "", Outcome on Rig = trend::rising(&f.on_rig.roller_mm) as f64,
            wants Condition::exactly(4.0), chosen Wholly,
            "on the rig; d rises with a";
    }
    "II.B" {
        "tube diameter 24.00 mm":
            "W in the tube", "24.00", "mm", Input = f.pipe.body.design.width_mm(),
            wants Condition::about(24.0, 0.005), "read as the inner diameter";
        "tube length 84.00 mm":
            "length", "84.00", "mm", Input = f64::from(f.pipe.segments) * f.pipe.segment_mm,
            wants Condition::about(84.0, 0.005), "10 segments of 8.4 mm";
        "thickness 2.40 mm, Young's modulus 1 MPa":
            "elastic indentation per kPa", "-", "mm/kPa", Input = f.pipe.compliance_mm_per_pa() * 1000.0,
            "thin ring, nu = 0.49 assumed";
        "density 1 g/mm^3, origami 1.4 g/mm^3":
            "density", "1; 1.4", "g/mm^3", Outside, "1000 times too large as printed; the models have no mass";
        "viscosity 5.35 MPa s": "viscosity", "5.35", "MPa s", Outside, "the wall follows its pressure at once";
        "changed to a cross shape":
            "pairs of crescents", "-", "", Outside, "the models have one: a second doubles every contact alike, and that cancels";
        "crescents 2.00 mm wide and 0.80 mm thick": "section", "2.00 x 0.80", "mm", Outside, "rigid sides";
        "shear modulus 0.6 MPa, bulk modulus 2.0 GPa": "moduli", "0.6; 2000", "MPa", Outside, "rigid sides";
        "10 segments of 8.4 mm, at 1 s intervals":
            "speed of the wave", "-", "mm/s", Outcome = f.pipe.segment_mm / f.pipe.delay_s,
            "the paper's source for the intestine: up to 10 mm/s";
        "3 s of pressure: up in 1.5 s, down in 1.5 s":
            "pulse", "3", "s", Input = f.pipe.pulse_s,
            wants Condition::exactly(3.0), "repeated every 10 s: assumed";
        "4000 Pa internal pressure":
            "4000 Pa + buckling pressure of the ring", "-", "Pa", Outcome = 4000.0 + f.ring_buckling_pa(),
            "near the 6000 Pa where the displacement becomes faster; not used in the model";
        "placed on the left side in the intestine":
            "spread over the placements at 7000 Pa", "-", "mm",
            Outcome on Tube = f.in_tube.pressure[10].range_mm.1 - f.in_tube.pressure[10].range_mm.0,
            "where against the segments is not in the text: every tube row is a mean over one segment";
        "displacement within 20 s": "length of a run", "20", "s", Input = f.pipe.duration_s,
            wants Condition::exactly(20.0);
        "friction series at 7000 Pa": "peristaltic pressure", "7000", "Pa", Input = 7000.0,
            wants Condition::exactly(7000.0);
        "friction coefficients 0.08 to 0.20, by 0.005":
            "number of runs", "25", "", Input = frictions().len() as f64, wants Condition::exactly(25.0);
        "pressures 3000 to 7000 Pa, by 400": "number of runs", "11", "",
                Input = pressures_pa().len() as f64, wants Condition::exactly(11.0);
        "pressure series at friction 0.15": "friction", "0.15", "", Input = f.pipe.body.friction,
            wants Condition::about(0.15, 0.005), "a fixed r makes it cancel";
        "from 3000 Pa the intestine indents slightly":
            "wall at 3000 Pa", "slightly", "mm", Fitted on Tube = f.pipe.wall_mm(3000.0),
            wants Condition::Within(0.0, SLIGHTLY * f.pipe.body.design.half_gap_mm());
        "above 7000 Pa it is severely shrunk": "wall at 7000 Pa", "severely", "mm",
                Fitted on Tube = f.pipe.wall_mm(7000.0),
            wants Condition::AtLeast(SEVERELY * f.pipe.body.design.half_gap_mm()),
            "of 9.6 mm to the core";
    }
    "II.C" {
        "about 14 mm in 20 s at each friction":
            "least over 0.08 to 0.20, 7000 Pa", "about 14", "mm", Fitted on Tube = f.in_tube.friction_mm.0,
            wants Condition::about(14.0, ABOUT_MM), chosen Partly,
            "fitted to about 14 and about 15 at once; one sentence, not 25 values";
        "no obvious correlation with friction":
            "greatest minus least, 7000 Pa", "none", "mm",
                Outcome on Tube = f.in_tube.friction_mm.1 - f.in_tube.friction_mm.0,
            wants Condition::about(0.0, LITTLE_MM),
            "r is fixed, so a common friction cancels";
        "no obvious correlation with friction":
            "least over 0.08 to 0.20, r of the facets, body `tube`", "about 14", "mm",
                Outcome on Tube = f.common.facets_mm.0,
            wants Condition::about(14.0, ABOUT_MM),
            "where r follows from the friction, friction matters";
        "no obvious correlation with friction":
            "greatest over 0.08 to 0.20, r of the facets, body `tube`", "about 14", "mm",
                Outcome on Tube = f.common.facets_mm.1,
            wants Condition::about(14.0, ABOUT_MM),
            "half as much again as the least";
        "from about 1 mm": "displacement of the tail at 3000 Pa", "about 1", "mm",
                Fitted on Tube = f.in_tube.pressure[0].tail_mm,
            wants Condition::Within(ABOUT_1_MM.0, ABOUT_1_MM.1), chosen Wholly,
            "calibrated to";
        "from about 1 mm": "displacement of the head at 3000 Pa", "about 1", "mm",
                Fitted on Tube = f.in_tube.pressure[0].head_mm,
            wants Condition::Within(ABOUT_1_MM.0, ABOUT_1_MM.1), chosen Partly,
            "the figures mark the head; the text does not say which end it means";
        "to about 15 mm": "displacement of the tail at 7000 Pa", "about 15", "mm",
                Fitted on Tube = f.in_tube.pressure[10].tail_mm,
            wants Condition::about(15.0, ABOUT_MM), chosen Partly,
            "calibrated to";
        "about 14 mm, and about 15 mm, for 7000 Pa at friction 0.15":
            "displacement of the tail in both", "14; 15", "mm", Fitted on Tube = f.in_tube.pressure[10].tail_mm,
            wants Condition::Within(15.0 - ABOUT_MM, 14.0 + ABOUT_MM), chosen Partly,
            "the paper has two values for one case; no value lies nearer than 0.5 mm to both";
        "significant positive curvature": "upward bends of 9", "all", "",
            Fitted on Tube = trend::convex(&f.in_tube.pressure_mm()) as f64,
            wants Condition::exactly(9.0), chosen Partly, "p_c is fitted";
        "the greater the pressure, the faster":
            "rising steps of 10", "all", "", Outcome on Tube = trend::rising(&f.in_tube.pressure_mm()) as f64,
            wants Condition::exactly(10.0), chosen Wholly;
    }
    "II.D" {
        "printing accuracy 0.15 mm, shore hardness 95 A":
            "fabrication", "0.15", "mm", Outside, "exact and rigid in the models";
    }
    "III" {
        "wave displacement restricted to 130 mm": "stroke", "130", "mm", Input = f.rig.stroke_mm,
            wants Condition::exactly(130.0);
        "structure 24.40 mm wide, as the intestine":
            "W on the rig", "24.40", "mm", Input = f.body().width_mm(),
            wants Condition::about(24.4, 0.005);
        "tail at the left end, rollers at the right":
            "tail at the start", "0", "mm", Input = f.rig.body.tail_mm,
            wants Condition::exactly(0.0), "the tip of the rearmost wing";
        "silicone Ecoflex 00-30": "shore hardness", "00-30", "", Outside, "the wall is the rollers' arc";
        "rollers of 40 mm diameter": "diameter", "40", "mm", Input = 2.0 * f.rig.radius_mm,
            wants Condition::exactly(40.0),
            "the wave is their arc; the silicone's own bending is left out";
        "width D = 24.40 mm, mean of 5 places": "D", "24.40", "mm", Input = f.block.intestine_mm,
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
            "greatest step less least step, a_1 to a_5", "0", "mm", Input = uneven_mm(),
            wants Condition::exactly(0.0),
            "the assumed 1, 2, 3, 4 mm; equal steps fix a_5 only, not the distance";
        "back and forth 5 times in 40 s":
            "mean speed of the carriage", "-", "mm/s", Outcome = f64::from(f.rig.cycles) * 2.0 * f.rig.stroke_mm / 40.0,
            "three times the intestine's wave; the models have no speed";
        "retrograde waves hardly cause displacement":
            "isolated return pass at 5.05 mm", "-", "mm", Fitted on Rig = f.on_rig.passes[4].returning_mm,
            "the next row has it as a share, the one after it an antegrade pass";
        "retrograde waves hardly cause displacement":
            "greatest share of an antegrade pass, a_1 to a_5", "hardly", "", Fitted on Rig = f.on_rig.worst_return(),
            wants Condition::AtMost(HARDLY), chosen Wholly,
            "at 2 mm of indentation";
        "the antegrade wave moves the structure":
            "isolated antegrade pass at 5.05 mm", "more than 0", "mm", Outcome on Rig = f.on_rig.passes[4].antegrade_mm,
            wants Condition::Above(0.0), chosen Wholly, "the text has no number";
        "10 experiments under each condition":
            "spread", "10", "", Outside, "the models have no scatter; a campaign repeats real trials";
    }
    "III.A" {
        "increases approximately linearly with the indentation":
            "R^2 of a line, 5 indentations", "about 1", "", Fitted on Rig = f.on_rig.linearity(false),
            wants Condition::AtLeast(LINEAR), chosen Wholly, "calibrated to";
        "increases approximately linearly with the indentation":
            "R^2 of a line, 5 indentations and the origin", "about 1", "", Fitted on Rig = f.on_rig.linearity(true),
            wants Condition::AtLeast(LINEAR), chosen Partly,
            "concave towards 0: the text does not say whether the line passes through it";
        "increases with the indentation":
            "rising steps of 4 from one indentation to the next", "all", "",
                Outcome on Rig = trend::rising(&f.on_rig.roller_mm) as f64,
            wants Condition::exactly(4.0), chosen Wholly;
        "increases with the indentation": "displacement in 40 s at 5.05 mm", "-", "mm",
                Outcome on Rig = f.on_rig.roller_mm[4],
            "the text gives no millimetres: see the next two rows";
        "increases with the indentation":
            "the same, 5 % of the bodies that agree with the words on the rig", "-", "mm", Outcome = f.common.band.low,
            "prior band: nothing in the text says where in it the body lies";
        "increases with the indentation":
            "the same, 95 % of these bodies", "-", "mm", Outcome = f.common.band.high,
            "prior band";
        "lubricated and unlubricated differ little":
            "greatest difference, friction 0.08 and 0.20", "not very different", "mm",
                Outcome on Rig = f.on_rig.lubrication_mm,
            wants Condition::about(0.0, LITTLE_MM),
            "r is fixed, so a common friction cancels";
        "low and high friction differ little in the simulation":
            "greatest difference, friction 0.08 and 0.20, all pressures", "no very", "mm",
            Outcome on Tube = f.in_tube.difference_mm,
            wants Condition::about(0.0, LITTLE_MM),
            "r is fixed, so a common friction cancels";
        "faster from about 6000 Pa":
            "mean slope 3000 to 5800 Pa", "-", "mm/kPa",
                Fitted on Tube = f.in_tube.slope_per_kpa(0, 7), "p_c is fitted";
        "faster from about 6000 Pa":
            "mean slope 5800 to 7000 Pa", "-", "mm/kPa",
                Fitted on Tube = f.in_tube.slope_per_kpa(7, 10), "p_c is fitted";
        "faster from about 6000 Pa":
            "the second slope over the first", "more than 1", "", Fitted on Tube = f.in_tube.faster(),
            wants Condition::AtLeast(FASTER), chosen Wholly, "p_c is fitted";
        "faster from about 6000 Pa":
            "bend of the two lines nearest to the series", "about 6000", "Pa", Fitted on Tube = f.in_tube.bend_pa(),
            wants Condition::about(6000.0, ABOUT_PA), "p_c of 7125 Pa bends it later; the prior has none below 7000";
        "folded, it moves in the opposite direction at 5.05 mm":
            "displacement in 40 s", "opposite", "mm", Outcome = f.pushed()?.antegrade_mm,
            wants Condition::Below(0.0),
            "a switch: whoever declares it folded gets a block that is pushed; laid down at mid-stroke (assumed)";
        "folded, it moves in the opposite direction at 5.05 mm":
            "the same with 0 mm of thread, declared folded", "-", "mm", Outcome = f.undrawn_mm()?,
            "the same body declared unfolded goes headward: the thread decides nothing but the width";
        "folded, recorded within 40 s": "cycles", "5", "", Input = f64::from(f.block.cycles),
            wants Condition::exactly(5.0), "5 cycles of 8 s";
        "the wave from left to right hardly moves it":
            "displacement by the return stroke", "hardly", "mm", Outcome = f.pushed()?.returning_mm,
            wants Condition::about(0.0, LITTLE_MM),
            "a pushed block lies ahead of the roller";
    }
};
