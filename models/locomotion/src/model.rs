//! The models: named bodies, and one table of all parameters with their sources.
//!
//! A model is one body in two set-ups: under the rig's rollers and in the paper's tube. Its name says what its free
//! parameters were fitted to. A model with changed parameters lists them ([`Model::changes`]).

use crate::body::FrictionRatio;
use crate::kinematics::Design;
use crate::parameter::{Label, Parameter};
use crate::range::OutOfRange;
use crate::{folded, roller, tube};

/// All parameters of all models.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Model {
    /// Name of the body that it started from.
    pub name: &'static str,
    /// Observations that the free parameters of that body were fitted to.
    pub calibrated_to: &'static str,
    width_mm: f64,
    core_ratio: f64,
    tan_alpha: f64,
    tan_beta: f64,
    crescents: f64,
    /// Body, rig and rollers. Its design is set only by [`Model::rig`], from the fields above.
    rig: roller::Params,
    tube: tube::Params,
    folded: folded::Params,
    thread_mm: f64,
}

impl Model {
    /// One body for rig and tube: the default. It was fitted by hand, so no number in the paper's text tests it.
    pub const ONE: Self = Self::of(
        "one",
        "words on the rig (III, III.A) and on the tube (II.C), one body for both",
        Body {
            coupling: 0.15,
            friction_ratio: FrictionRatio::Fixed(40.0),
            preload_mm: 0.0007,
            critical_pa: 7125.0,
            buckling_mm: 0.06,
        },
    );

    /// The older body of the rig. It was not fitted to the tube; there it has the wall of `one`.
    pub const RIG: Self = Self::of(
        "rig",
        "words on the rig (III, III.A) only",
        Body {
            coupling: 0.15,
            friction_ratio: FrictionRatio::Fixed(20.0),
            preload_mm: 0.005,
            critical_pa: 7125.0,
            buckling_mm: 0.06,
        },
    );

    /// The older body of the tube: rigid facets, so its friction ratio follows from the friction coefficient.
    pub const TUBE: Self = Self::of(
        "tube",
        "words on the tube (II.C) only",
        Body {
            coupling: 1.0,
            friction_ratio: FrictionRatio::Facets,
            preload_mm: 0.17,
            critical_pa: 7100.0,
            buckling_mm: 0.09,
        },
    );

    /// Every named body, the default first.
    pub const ALL: [Self; 3] = [Self::ONE, Self::RIG, Self::TUBE];

    /// The model with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name == name)
    }

    const fn of(name: &'static str, calibrated_to: &'static str, body: Body) -> Self {
        let mut rig = roller::Params::PAPER;
        rig.body.coupling = body.coupling;
        rig.body.friction_ratio = body.friction_ratio;
        rig.body.preload_mm = body.preload_mm;
        let mut tube = tube::Params::PAPER;
        tube.critical_pa = body.critical_pa;
        tube.buckling_mm = body.buckling_mm;
        Self {
            name,
            calibrated_to,
            width_mm: 24.40,
            core_ratio: 0.2,
            tan_alpha: 2.0 / 9.0,
            tan_beta: 2.0 / 3.0,
            crescents: 9.0,
            rig,
            tube,
            folded: folded::Params::PAPER,
            thread_mm: 21.0,
        }
    }

    /// The design on the rig.
    ///
    /// # Errors
    /// The first value outside its range.
    pub fn design(&self) -> Result<Design<f64>, OutOfRange> {
        self.design_as_wide_as(self.width_mm)
    }

    fn design_as_wide_as(&self, width_mm: f64) -> Result<Design<f64>, OutOfRange> {
        // `set` checks that the number is whole; a number that does not fit into a byte counts as zero crescents.
        let crescents = if self.crescents >= 0.0 && self.crescents <= 255.0 {
            self.crescents as u8
        } else {
            0
        };
        Design::with_ratio(
            width_mm,
            self.core_ratio,
            self.tan_alpha,
            self.tan_beta,
            crescents,
        )
    }

    /// The unfolded body under the rollers.
    ///
    /// # Errors
    /// The first value outside its range.
    pub fn rig(&self) -> Result<roller::Params, OutOfRange> {
        let mut params = self.rig;
        params.body.design = self.design()?;
        roller::UnfoldedBody::new(params, 0.0)?;
        Ok(params)
    }

    /// The same body in the tube, as wide as the tube (II.B: "the same as the inner diameter").
    ///
    /// # Errors
    /// The first value outside its range.
    pub fn tube(&self) -> Result<tube::Params, OutOfRange> {
        let mut params = self.tube;
        let tail_mm = params.body.tail_mm;
        params.body = self.rig.body;
        params.body.tail_mm = tail_mm;
        params.body.design = self.design_as_wide_as(2.0 * params.radius_mm)?;
        tube::Tube::new(params, 0.0)?;
        Ok(params)
    }

    /// The folded body under the rollers, with `thread_mm` of thread drawn in; `None` takes the model's own value.
    ///
    /// # Errors
    /// The first value outside its range.
    pub fn folded(&self, thread_mm: Option<f64>) -> Result<folded::Params, OutOfRange> {
        let mut params = self
            .folded
            .folded_by(&self.design()?, thread_mm.unwrap_or(self.thread_mm))?;
        params.stroke_mm = self.rig.stroke_mm;
        params.radius_mm = self.rig.radius_mm;
        params.cycles = self.rig.cycles;
        folded::FoldedBody::new(params, 0.0)?;
        Ok(params)
    }

    /// Refuses a model with a value outside its range, in either set-up. Checks the folded body's default thread only
    /// where it is used: a short body has less thread to draw in, and its other runs need none.
    ///
    /// # Errors
    /// The first value outside its range.
    pub fn check(&self) -> Result<(), OutOfRange> {
        self.rig()?;
        self.tube()?;
        if self.changes().any(|row| row.name.starts_with("folded.")) {
            self.folded(None)?;
        }
        Ok(())
    }

    /// Every parameter with its value and its source. Those that differ from the named body are labelled as given.
    pub fn parameters(&self) -> impl Iterator<Item = Parameter> + use<> {
        let (model, base) = (*self, Self::named(self.name).unwrap_or(Self::ONE));
        SETTINGS.iter().map(move |setting| {
            let (value, word) = (setting.value(&model), setting.word(&model));
            let given = value != setting.value(&base) || word != setting.word(&base);
            let (label, source) = match (given, setting.of_body(model.name)) {
                (true, _) => (Label::Given, "set for this calculation"),
                (false, Some(of_body)) => of_body,
                (false, None) => (setting.label, setting.source),
            };
            Parameter {
                name: setting.key,
                value,
                word,
                unit: setting.unit,
                label,
                source,
            }
        })
    }

    /// The parameters that differ from the named body's.
    pub fn changes(&self) -> impl Iterator<Item = Parameter> + use<> {
        self.parameters()
            .filter(|parameter| parameter.label == Label::Given)
    }

    /// Sets one parameter. Ranges are those of [`Model::check`], because some depend on other parameters.
    ///
    /// # Errors
    /// A word where the parameter needs a number, a part where it needs a whole number.
    pub fn set(&mut self, setting: &Setting, value: Value<'_>) -> Result<(), Unsuitable> {
        match (value, setting.access) {
            (Value::Number(deg), Access::Number(..))
                if setting.unit == "deg" && !(deg > 0.0 && deg < 90.0) =>
            {
                return Err(Unsuitable::NotAngle(deg));
            }
            (Value::Number(number), Access::Number(_, set)) => set(self, number),
            (Value::Number(number), Access::Whole(_, set)) => {
                if !(number >= 0.0
                    && number <= f64::from(u32::MAX)
                    && libm::floor(number) == number)
                {
                    return Err(Unsuitable::NotWhole(number));
                }
                set(self, number);
            }
            (Value::Number(ratio), Access::Ratio) => {
                self.rig.body.friction_ratio = FrictionRatio::Fixed(ratio);
            }
            (Value::Word(FACETS), Access::Ratio) => {
                self.rig.body.friction_ratio = FrictionRatio::Facets;
            }
            (Value::Word(_), Access::Ratio) => return Err(Unsuitable::NotRatio),
            (Value::Word(_), _) => return Err(Unsuitable::NotNumber),
        }
        Ok(())
    }
}

/// The free parameters of a named body.
struct Body {
    coupling: f64,
    friction_ratio: FrictionRatio,
    preload_mm: f64,
    critical_pa: f64,
    buckling_mm: f64,
}

/// The word for [`FrictionRatio::Facets`] in model files.
pub const FACETS: &str = "facets";

/// A value as written by a person.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// A number.
    Number(f64),
    /// A word.
    Word(&'a str),
}

/// Why a parameter cannot take a value, whatever the other parameters are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Unsuitable {
    /// It has to be a number.
    NotNumber,
    /// It has to be a whole number, 0 or more.
    NotWhole(f64),
    /// It has to be a number or [`FACETS`].
    NotRatio,
    /// It has to be an angle between the axes, degrees.
    NotAngle(f64),
}

impl core::fmt::Display for Unsuitable {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::NotNumber => f.write_str("it has to be a number"),
            Self::NotWhole(number) => {
                write!(
                    f,
                    "{number} is not usable: it has to be a whole number, 0 or more"
                )
            }
            Self::NotAngle(deg) => write!(
                f,
                "{deg} deg is not usable: choose an angle above 0 and below 90 deg"
            ),
            Self::NotRatio => write!(f, "it has to be a number or \"{FACETS}\""),
        }
    }
}

/// How to read and to set a parameter.
#[derive(Clone, Copy, Debug)]
enum Access {
    Number(fn(&Model) -> f64, fn(&mut Model, f64)),
    Whole(fn(&Model) -> f64, fn(&mut Model, f64)),
    /// The friction ratio: a number or the word [`FACETS`].
    Ratio,
}

/// A parameter that can be set.
#[derive(Clone, Copy, Debug)]
pub struct Setting {
    /// Section and name, as in a model file: `body.coupling`.
    pub key: &'static str,
    /// Unit; empty for a pure number.
    pub unit: &'static str,
    /// How far the default can be trusted.
    label: Label,
    /// Where the default comes from.
    source: &'static str,
    /// Description for help texts.
    pub meaning: &'static str,
    access: Access,
}

impl Setting {
    /// Every key that a model file may set.
    pub fn all() -> impl Iterator<Item = &'static Self> {
        SETTINGS.iter().chain(&ANGLES)
    }

    /// The parameter with this key.
    pub fn named(key: &str) -> Option<&'static Self> {
        Self::all().find(|setting| setting.key == key)
    }

    /// The other key for the same parameter, if there is one.
    pub fn other_key(&self) -> Option<&'static str> {
        let pairs = [
            ("design.alpha_deg", "design.tan_alpha"),
            ("design.beta_deg", "design.tan_beta"),
        ];
        pairs.iter().find_map(|(one, other)| {
            if self.key == *one {
                Some(*other)
            } else {
                (self.key == *other).then_some(*one)
            }
        })
    }

    /// Its value in a model. For a friction ratio that follows from the friction, the value at that friction.
    pub fn value(&self, model: &Model) -> f64 {
        match self.access {
            Access::Number(get, _) | Access::Whole(get, _) => get(model),
            Access::Ratio => {
                let body = model.rig.body;
                let design = model.design().unwrap_or(body.design);
                body.friction_ratio
                    .at(&design, body.friction)
                    .unwrap_or(f64::NAN)
            }
        }
    }

    /// The word that sets it in a model, if a word does.
    pub fn word(&self, model: &Model) -> Option<&'static str> {
        let by_word = matches!(self.access, Access::Ratio)
            && model.rig.body.friction_ratio == FrictionRatio::Facets;
        by_word.then_some(FACETS)
    }

    /// Label and source where those of a named body differ from the default's.
    fn of_body(&self, name: &str) -> Option<(Label, &'static str)> {
        use Label::{Assumed, Calibrated, Derived};
        Some(match (name, self.key) {
            ("tube", "body.coupling") => (
                Assumed,
                "the tube's wall lies on the wing along its whole rim",
            ),
            ("tube", "body.friction_ratio") => (
                Derived,
                "Coulomb friction on facets at beta: (1 + mu tan beta)/(1 - mu tan beta)",
            ),
            ("tube", "body.preload_mm") => (
                Calibrated,
                "II.C: about 1 mm at 3000 Pa, about 15 mm at 7000 Pa",
            ),
            ("rig", "tube.critical_pa" | "tube.buckling_mm") => {
                (Assumed, "as of `one`: this body was not fitted to the tube")
            }
            _ => return None,
        })
    }
}

macro_rules! settings {
    ($($key:literal [$unit:literal] $label:ident $kind:ident $(($($field:ident).+))?,
        $meaning:literal, $source:literal;)*) => {
        [$(Setting {
            key: $key,
            unit: $unit,
            label: Label::$label,
            source: $source,
            meaning: $meaning,
            access: settings!(@ $kind $(($($field).+))?),
        }),*]
    };
    (@ number ($($field:ident).+)) => {
        Access::Number(|model| model.$($field).+, |model, value| model.$($field).+ = value)
    };
    (@ whole ($($field:ident).+)) => {
        Access::Whole(|model| f64::from(model.$($field).+), |model, value| model.$($field).+ = value as _)
    };
    (@ ratio) => { Access::Ratio };
}

/// Every parameter of the models, section by section.
pub static SETTINGS: [Setting; 34] = settings! {
    "design.width_mm" ["mm"] Paper number (width_mm),
        "overall width W on the rig; in the tube it is twice tube.radius_mm",
        "III: the structure is as wide as the intestine";
    "design.core_ratio" [""] Paper number (core_ratio), "width of the core over the overall width, c/W",
        "II.A: c is 1/5 of the width";
    "design.tan_alpha" [""] Derived number (tan_alpha), "tangent of the short side's angle, from the transverse axis",
        "2/9: II.A prints 12.53 deg, its arctangent";
    "design.tan_beta" [""] Derived number (tan_beta), "tangent of the long side's angle, from the transverse axis",
        "2/3: II.A prints 33.69 deg, its arctangent";
    "design.crescents" [""] Paper whole (crescents), "number m of crescents", "II.A: m = 9";
    "body.coupling" [""] Calibrated number (rig.body.coupling),
        "chi: fraction of the wall's indentation that reaches a crescent",
        "III.A: displacement rises approximately linearly; II.C: about 1 to about 15 mm";
    "body.friction" [""] Paper number (rig.body.friction), "friction coefficient mu",
        "II.B: 0.15 in the pressure series; the rig's is not given";
    "body.friction_ratio" [""] Calibrated ratio,
        "r: friction against the wings over friction with them; or `facets`: (1 + mu tan beta)/(1 - mu tan beta)",
        "III: retrograde waves hardly move it; fixed at every friction, not derived from it";
    "body.preload_mm" ["mm"] Calibrated number (rig.body.preload_mm),
        "delta0: indentation that holds a crescent that the wave does not touch",
        "III: structure and intestine are equally wide; retrograde waves hardly move it";
    "rig.tail_mm" ["mm"] Paper number (rig.body.tail_mm), "start of the tail from the intestine's left mark",
        "III: tail at the marked left end";
    "rig.stroke_mm" ["mm"] Paper number (rig.stroke_mm), "travel of the carriage",
        "III: wave displacement restricted to 130 mm";
    "rig.radius_mm" ["mm"] Paper number (rig.radius_mm), "radius of the rollers", "III: rollers of 40 mm diameter";
    "rig.step_mm" ["mm"] Assumed number (rig.step_mm), "travel between two evaluations of the model",
        "converged: 0.01 mm changes the roller series by less than 0.05 mm";
    "rig.cycles" [""] Paper whole (rig.cycles), "back-and-forth cycles of a run", "III: back and forth 5 times";
    "tube.tail_mm" ["mm"] Assumed number (tube.body.tail_mm), "leftmost start of the tail",
        "II.B says no more than: on the left side in the intestine";
    "tube.placements" [""] Assumed whole (tube.placements),
        "starting places of the tail over one segment, whose mean is taken",
        "where the body lay against the segments is not in the text";
    "tube.segments" [""] Paper whole (tube.segments), "number of segments", "II.B: 10 segments";
    "tube.segment_mm" ["mm"] Paper number (tube.segment_mm), "length of a segment",
        "II.B: of 8.4 mm, 84 mm in all";
    "tube.radius_mm" ["mm"] Paper number (tube.radius_mm), "radius of the tube before the wave",
        "II.B: diameter 24.00 mm, read as the inner one";
    "tube.thickness_mm" ["mm"] Paper number (tube.thickness_mm), "thickness of the wall", "II.B";
    "tube.modulus_pa" ["Pa"] Paper number (tube.modulus_pa), "Young's modulus of the wall", "II.B: 1 MPa";
    "tube.poisson" [""] Assumed number (tube.poisson), "Poisson's ratio of the wall", "nearly incompressible tissue";
    "tube.critical_pa" ["Pa"] Calibrated number (tube.critical_pa), "p_c: pressure at which the wall collapses",
        "II.B: above 7000 Pa the wall is severely shrunk; II.C: about 15 mm at 7000 Pa";
    "tube.buckling_mm" ["mm"] Calibrated number (tube.buckling_mm), "w0: scale of the wall's early buckling",
        "II.C: about 1 mm at 3000 Pa, about 15 mm at 7000 Pa";
    "tube.pulse_s" ["s"] Paper number (tube.pulse_s), "length of a pulse", "II.B: up in 1.5 s and down in 1.5 s";
    "tube.delay_s" ["s"] Paper number (tube.delay_s), "delay of each segment against its right neighbour",
        "II.B: at 1 s intervals from the right end";
    "tube.period_s" ["s"] Assumed number (tube.period_s), "time between two pulses of a segment",
        "one wave follows the other: 10 segments at 1 s; section I has 15 to 18 waves per minute, 3.3 to 4 s";
    "tube.duration_s" ["s"] Paper number (tube.duration_s), "duration of a run", "II.B: within 20 s";
    "tube.step_s" ["s"] Assumed number (tube.step_s), "time between two rows of a record",
        "it only decides which moments are listed: see tube.wall_step_mm";
    "tube.wall_step_mm" ["mm"] Assumed number (tube.wall_step_mm),
        "movement of a wall between two evaluations of the model",
        "converged: a quarter of it, and four times the placements, change the mean by less than 0.05 mm";
    "folded.intestine_mm" ["mm"] Paper number (folded.intestine_mm), "width D of the rig's intestine",
        "III: caliper mean, D = 24.40 mm";
    "folded.thread_mm" ["mm"] Assumed number (thread_mm), "thread drawn in, Eq. (7)",
        "the fold's nominal travel";
    "folded.friction" [""] Assumed number (folded.friction), "friction coefficient of the folded body",
        "II.B gives 0.08 to 0.20 for a capsule in the intestine";
    "folded.tail_mm" ["mm"] Assumed number (folded.tail_mm), "start of the folded body's tail",
        "Fig. 8's start is not in the text: middle of the stroke";
};

/// Other keys for parameters of [`SETTINGS`]: the angles themselves.
pub static ANGLES: [Setting; 2] = [
    Setting {
        key: "design.alpha_deg",
        unit: "deg",
        label: Label::Derived,
        source: "II.A prints 12.53 deg",
        meaning: "angle of the short side from the transverse axis, instead of design.tan_alpha",
        access: Access::Number(
            |model| libm::atan(model.tan_alpha).to_degrees(),
            |model, deg| model.tan_alpha = libm::tan(deg.to_radians()),
        ),
    },
    Setting {
        key: "design.beta_deg",
        unit: "deg",
        label: Label::Derived,
        source: "II.A prints 33.69 deg",
        meaning: "angle of the long side from the transverse axis, instead of design.tan_beta",
        access: Access::Number(
            |model| libm::atan(model.tan_beta).to_degrees(),
            |model, deg| model.tan_beta = libm::tan(deg.to_radians()),
        ),
    },
];
