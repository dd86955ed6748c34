//! Measurements: displacements under stated conditions, and the combined repeats of a condition.

use std::collections::BTreeMap;
use std::fmt;

/// State of the intestine's wall.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Lubrication {
    /// Without soap.
    Dry,
    /// With soapy water.
    Lubricated,
}

impl fmt::Display for Lubrication {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Dry => "dry",
            Self::Lubricated => "lubricated",
        })
    }
}

/// Kinds of displacement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// Of a whole run of several back-and-forth cycles.
    Net {
        /// Its cycles.
        cycles: u16,
    },
    /// From the beginning of a run to the end of one of its strokes. [`Kind::after`] says which are no other kind.
    After {
        /// Strokes until then, those both ways.
        strokes: u16,
    },
    /// Of one stroke of a run: 1 is the first antegrade stroke, 2 the first way back.
    Stroke {
        /// Its number in the run, from 1.
        number: u16,
    },
    /// By one isolated pass from head to tail over a fresh body.
    AntegradePass,
    /// By one isolated pass from tail to head over a fresh body.
    ReturningPass,
}

impl Kind {
    /// From the beginning of a run to the end of its stroke `strokes`: what one reading gives. An even number of
    /// strokes is a net displacement, one stroke the first: each has one name, so that repeats of it meet.
    #[must_use]
    pub const fn after(strokes: u16) -> Self {
        match strokes {
            1 => Self::Stroke { number: 1 },
            _ if strokes.is_multiple_of(2) => Self::Net {
                cycles: strokes / 2,
            },
            _ => Self::After { strokes },
        }
    }

    /// How often the model's error in an antegrade and in a returning pass enters this displacement.
    ///
    /// The model makes the same error in each pass of one direction, so the errors of n cycles add up.
    #[must_use]
    pub fn errors(self) -> [f64; 2] {
        match self {
            Self::Net { cycles } => [f64::from(cycles); 2],
            Self::After { strokes } => [strokes.div_ceil(2), strokes / 2].map(f64::from),
            Self::Stroke { number } if number % 2 == 0 => [0.0, 1.0],
            Self::Stroke { .. } | Self::AntegradePass => [1.0, 0.0],
            Self::ReturningPass => [0.0, 1.0],
        }
    }

    /// Standard deviation of the model's error in this displacement, in multiples of that of one pass: the errors of
    /// the two directions are independent.
    #[must_use]
    pub fn discrepancies(self) -> f64 {
        let [antegrade, returning] = self.errors();
        libm::hypot(antegrade, returning)
    }

    /// Standard deviation of its measurement error, mm, if that of a reading is `reading_mm`. The body begins at its
    /// mark, so one reading gives a displacement; a stroke after the first is the difference of two.
    #[must_use]
    pub fn uncertainty_mm(self, reading_mm: f64) -> f64 {
        match self {
            Self::Stroke { number } if number > 1 => reading_mm * core::f64::consts::SQRT_2,
            _ => reading_mm,
        }
    }

    /// Whether the body is relaxed before and after it. Such a pass does not share the errors of a run: in a run the
    /// body lies under the rollers at the ends of the strokes.
    #[must_use]
    pub fn is_isolated(self) -> bool {
        matches!(self, Self::AntegradePass | Self::ReturningPass)
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Net { cycles: 1 } => f.pad("net of 1 cycle"),
            Self::Net { cycles } => f.pad(&format!("net of {cycles} cycles")),
            Self::After { strokes } => f.pad(&format!("net of {strokes} strokes")),
            Self::Stroke { number } => f.pad(&format!("stroke {number}")),
            Self::AntegradePass => f.pad("antegrade pass"),
            Self::ReturningPass => f.pad("returning pass"),
        }
    }
}

/// The inputs of a prediction: kind and indentation. Lubrication is not among them: it enters the model only through
/// the friction ratio, which is one unknown for both states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Case {
    /// Kind of displacement.
    pub kind: Kind,
    /// Indentation of the rollers, mm.
    pub indentation_mm: f64,
}

/// One measured displacement of the unfolded body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Kind of displacement.
    pub kind: Kind,
    /// State of the wall.
    pub lubrication: Lubrication,
    /// Indentation of the rollers, mm.
    pub indentation_mm: f64,
    /// The displacement of the tail, mm, + headward.
    pub displacement_mm: f64,
    /// Standard deviation of its measurement error, mm: from reading and repetition.
    pub uncertainty_mm: f64,
}

impl Observation {
    /// Displacements beside this net displacement of a run, from the readings of the tail after each of its strokes, mm
    /// from its mark. Each has an error of its own; the difference of two readings, a single stroke, would share its
    /// errors with its neighbours. The last reading is the net displacement again, and does not count twice.
    pub fn with_readings(&self, after_mm: &[f64]) -> impl Iterator<Item = Self> {
        let others = after_mm.len().saturating_sub(1);
        (1..).zip(&after_mm[..others]).map(|(strokes, mm)| Self {
            kind: Kind::after(strokes),
            displacement_mm: *mm,
            ..*self
        })
    }
}

/// Greatest difference of two indentations of one notch, um, assumed. Rollers that are clamped anew in their notch are
/// measured 0.02 to 0.1 mm apart, and the notches of the paper's series are 1 mm apart.
pub const SAME_NOTCH_UM: i64 = 200;

/// Whole micrometres, because differences of millimetres are not exact: 5.2 less 5.0 is more than 0.2.
fn micrometres(mm: f64) -> i64 {
    libm::round(1e3 * mm) as i64
}

/// The notches in which the rollers were clamped.
#[derive(Clone, Debug, PartialEq)]
pub struct Notches {
    /// The least indentation of each, um, in order.
    least_um: Vec<i64>,
}

impl Notches {
    /// Of all indentations, mm, of some trials. A notch holds its least indentation, and others up to
    /// [`SAME_NOTCH_UM`] beyond it.
    #[must_use]
    pub fn of(indentations_mm: impl Iterator<Item = f64>) -> Self {
        let mut least_um: Vec<i64> = indentations_mm.map(micrometres).collect();
        least_um.sort_unstable();
        least_um.dedup_by(|next_um, least_um| *next_um - *least_um <= SAME_NOTCH_UM);
        Self { least_um }
    }

    /// Number of an indentation's notch, from 0, that of the least indentation.
    #[must_use]
    pub fn number(&self, indentation_mm: f64) -> usize {
        let at_um = micrometres(indentation_mm);
        let begun = self.least_um.partition_point(|least_um| *least_um <= at_um);
        begun.saturating_sub(1)
    }
}

/// The repeats of one condition.
#[derive(Clone, Debug, PartialEq)]
pub struct Condition {
    /// Inputs of the prediction.
    pub case: Case,
    /// State of the wall.
    pub lubrication: Lubrication,
    /// Number of its notch among those of all conditions: [`Notches`].
    pub notch: usize,
    /// Number, from 0, of the conditions with which it shares the model's errors: nets and strokes in one notch and at
    /// one wall are displacements by the same passes, and so are isolated passes.
    pub family: usize,
    /// Number of repeats.
    pub repeats: usize,
    /// Their mean, weighted by their precision, mm.
    pub mean_mm: f64,
    /// Standard deviation of the measurement error of that mean, mm.
    pub uncertainty_mm: f64,
    /// Sum of the squared deviations of the repeats from their mean, each over the square of its uncertainty. If the
    /// stated uncertainties are true, this is chi-square with `repeats - 1` degrees of freedom.
    pub scatter: f64,
}

/// Why observations cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Unusable {
    /// There are none.
    #[error("there is nothing to fit: no displacement of the unfolded body counts")]
    Nothing,
    /// A number that is invalid.
    #[error("observation {number}: {quantity} = {value} mm is not usable: {why}")]
    Number {
        /// Its place, from 1.
        number: usize,
        /// Name of the number.
        quantity: &'static str,
        /// The number.
        value: f64,
        /// The requirement that it misses.
        why: &'static str,
    },
    /// An invalid count.
    #[error("observation {number}: {what}")]
    Count {
        /// Its place, from 1.
        number: usize,
        /// The defect.
        what: &'static str,
    },
}

/// Most cycles or strokes of a run that the model simulates.
pub const MOST_CYCLES: u16 = 1_000;

/// Refuses an observation that has no likelihood.
fn check(number: usize, observation: &Observation) -> Result<(), Unusable> {
    let refuse = |quantity, value, why| Unusable::Number {
        number,
        quantity,
        value,
        why,
    };
    let Observation {
        indentation_mm,
        displacement_mm,
        uncertainty_mm,
        ..
    } = *observation;
    if !(indentation_mm.is_finite() && indentation_mm > 0.0) {
        let why = "the rollers have to reach the wall: give a number above 0";
        return Err(refuse("indentation", indentation_mm, why));
    }
    if !displacement_mm.is_finite() {
        return Err(refuse("displacement", displacement_mm, "give a number"));
    }
    if !(uncertainty_mm.is_finite() && uncertainty_mm > 0.0) {
        let why = "no measurement is exact: give a standard deviation above 0";
        return Err(refuse("uncertainty", uncertainty_mm, why));
    }
    let what = match observation.kind {
        Kind::Net { cycles } if !(1..=MOST_CYCLES).contains(&cycles) => {
            "a run has 1 to 1000 cycles"
        }
        Kind::Stroke { number: strokes } | Kind::After { strokes }
            if !(1..=2 * MOST_CYCLES).contains(&strokes) =>
        {
            "the strokes of a run are numbered from 1 to at most 2000"
        }
        _ => return Ok(()),
    };
    Err(Unusable::Count { number, what })
}

/// The conditions of observations, sorted by kind, lubrication and indentation.
///
/// # Errors
/// The first observation that cannot be used; none at all.
pub fn conditions(observations: &[Observation]) -> Result<Vec<Condition>, Unusable> {
    // Sort by the bits of the floats: positive ones have the same order.
    let mut groups: BTreeMap<(Kind, Lubrication, u64), Vec<Observation>> = BTreeMap::new();
    for (number, observation) in (1..).zip(observations) {
        check(number, observation)?;
        let key = (
            observation.kind,
            observation.lubrication,
            observation.indentation_mm.to_bits(),
        );
        groups.entry(key).or_default().push(*observation);
    }
    if groups.is_empty() {
        return Err(Unusable::Nothing);
    }
    let notches = Notches::of(observations.iter().map(|one| one.indentation_mm));
    let mut families = vec![];
    let condition = |((kind, lubrication, bits), repeats): ((Kind, Lubrication, u64), Vec<_>)| {
        let indentation_mm = f64::from_bits(bits);
        let notch = notches.number(indentation_mm);
        let key = (kind.is_isolated(), lubrication, notch);
        let known = families.iter().position(|other| *other == key);
        let family = known.unwrap_or_else(|| {
            families.push(key);
            families.len() - 1
        });
        let weight = |one: &Observation| 1.0 / (one.uncertainty_mm * one.uncertainty_mm);
        let sum: f64 = repeats.iter().map(weight).sum();
        let weighted = repeats.iter().map(|one| weight(one) * one.displacement_mm);
        let mean_mm = weighted.sum::<f64>() / sum;
        let square = |one: &Observation| {
            let off = (one.displacement_mm - mean_mm) / one.uncertainty_mm;
            off * off
        };
        Condition {
            case: Case {
                kind,
                indentation_mm,
            },
            lubrication,
            notch,
            family,
            repeats: repeats.len(),
            mean_mm,
            uncertainty_mm: libm::sqrt(1.0 / sum),
            scatter: repeats.iter().map(square).sum(),
        }
    };
    Ok(groups.into_iter().map(condition).collect())
}
