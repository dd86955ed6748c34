//! The plan of a campaign: reads the TOML file that a person writes, and checks it before anything is measured.

use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;

use crate::trials::cue::Cue;
use crate::trials::plan;
use client::{decimal, wording};
use locomotion::roller;
use protocol::rig::{Direction, LinkLossPolicy, Run, RunTiming};
use protocol::system::SetTelemetry;
use serde::de::{Error, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use crate::campaign::CampaignError;
use crate::campaign::form::Form;

/// Version of the format; incremented when a key changes its meaning.
pub const FORMAT: u32 = 1;

/// Most readings of one width, and most repeats of one condition.
const MOST: u32 = 1_000;

/// Most cycles of a run with a displacement after each stroke, for which a person is asked.
const MOST_ASKED: u16 = 50;

/// Largest length that can be measured here: 1 m.
const WIDEST_UM: i64 = 1_000_000;

/// A length, written in millimetres and stored in micrometres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Millimetres {
    /// Micrometres.
    pub um: i64,
}

impl Millimetres {
    /// From micrometres.
    #[must_use]
    pub const fn from_um(um: i64) -> Self {
        Self { um }
    }

    /// The length in mm, for calculations.
    #[must_use]
    pub fn mm(self) -> f64 {
        self.um as f64 / 1_000.0
    }
}

impl fmt::Display for Millimetres {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&decimal::write_signed(self.um, 3))
    }
}

impl std::str::FromStr for Millimetres {
    type Err = decimal::DecimalError;
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse_thousandths(text).map(Self::from_um)
    }
}

impl Serialize for Millimetres {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Millimetres {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        thousandths(deserializer).map(Self::from_um)
    }
}

/// A number of at most three decimals, in thousandths: of millimetres, seconds or mm/s².
fn parse_thousandths(text: &str) -> Result<i64, decimal::DecimalError> {
    let (negative, digits) = match text.strip_prefix('-') {
        Some(digits) => (true, digits),
        None => (false, text),
    };
    // Cannot overflow: far below 2^63.
    let count = decimal::parse(digits, 3, 1_000_000_000_000)?.cast_signed();
    Ok(if negative { -count } else { count })
}

/// The same from a plan, where it may be a number or a text.
fn thousandths<'de, D: Deserializer<'de>>(deserializer: D) -> Result<i64, D::Error> {
    struct Number;
    impl Visitor<'_> for Number {
        type Value = i64;
        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a number, for example 130 or 12.5")
        }
        fn visit_str<E: Error>(self, text: &str) -> Result<i64, E> {
            parse_thousandths(text).map_err(E::custom)
        }
        fn visit_i64<E: Error>(self, value: i64) -> Result<i64, E> {
            self.visit_str(&value.to_string())
        }
        fn visit_u64<E: Error>(self, value: u64) -> Result<i64, E> {
            self.visit_str(&value.to_string())
        }
        // The shortest text of this float is what the person wrote.
        fn visit_f64<E: Error>(self, value: f64) -> Result<i64, E> {
            self.visit_str(&value.to_string())
        }
    }
    deserializer.deserialize_any(Number)
}

/// State of the intestine's wall.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Lubrication {
    /// Without soap. Comes first, because soap cannot be removed.
    Dry,
    /// With soapy water before each trial.
    Lubricated,
}

impl Lubrication {
    /// Name in plans and ledgers.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Dry => "dry",
            Self::Lubricated => "lubricated",
        }
    }
}

/// Figure of the paper that a trial is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Purpose {
    /// Displacement against indentation: figure 7.
    Series,
    /// Folded against unfolded: figure 8.
    FoldTest,
    /// One stroke of the rollers over a body that they meet relaxed, from home to the far end: from head to tail.
    AntegradePass,
    /// The same from the far end home: from tail to head.
    ReturningPass,
}

impl Purpose {
    /// Name in the ledger.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Series => "series",
            Self::FoldTest => "fold_test",
            Self::AntegradePass => "antegrade_pass",
            Self::ReturningPass => "returning_pass",
        }
    }

    /// Direction of the rollers, if it is a pass.
    #[must_use]
    pub const fn pass(self) -> Option<Direction> {
        match self {
            Self::Series | Self::FoldTest => None,
            Self::AntegradePass => Some(Direction::Away),
            Self::ReturningPass => Some(Direction::Home),
        }
    }
}

/// People, specimen and equipment, as free text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Metadata {
    /// The person who carries it out.
    pub operator: String,
    /// The body: origami, width, crescents.
    pub specimen: String,
    /// The walls of the intestine.
    pub silicone: String,
    /// The soapy water, and how much of it.
    pub soap: String,
    /// The camera, and what starts it.
    pub camera: String,
    /// The caliper.
    pub caliper: String,
    /// Resolution of the caliper; readings finer than this are asked again.
    pub caliper_resolution_mm: Millimetres,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RunTable {
    cycles: u16,
    stroke_mm: Millimetres,
    #[serde(rename = "duration_s", deserialize_with = "thousandths")]
    duration_ms: i64,
    #[serde(
        rename = "acceleration_mm_s2",
        default = "default_acceleration",
        deserialize_with = "thousandths"
    )]
    acceleration_um_s2: i64,
    #[serde(default = "default_telemetry_ms")]
    telemetry_ms: u16,
}

const fn default_acceleration() -> i64 {
    crate::trials::experiment::DEFAULT_ACCEL_UM_S2 as i64
}

const fn default_telemetry_ms() -> u16 {
    crate::trials::experiment::DEFAULT_TELEMETRY_MS
}

/// How to read the caliper.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Readings {
    /// Number of readings of each width, each at another place.
    pub count: u32,
    /// Largest difference between the least and the greatest reading that is accepted without a question.
    pub spread_mm: Millimetres,
    /// Approximate value of D. The virtual bench answers with it.
    pub width_about_mm: Option<Millimetres>,
}

/// A place of the rollers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Indentation {
    /// Its name: letters, digits, `-` and `_`.
    pub name: String,
    /// Approximate value of a_n. The virtual bench answers with it.
    pub about_mm: Option<Millimetres>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SeriesTable {
    lubrication: Vec<Lubrication>,
    indentation: Vec<String>,
    repeats: u32,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FoldTable {
    lubrication: Lubrication,
    indentation: String,
    repeats: u32,
    fold_at_cycle: Option<u16>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct PassesTable {
    lubrication: Vec<Lubrication>,
    indentation: Vec<String>,
    repeats: u32,
    tail_mm: Millimetres,
    body_mm: Millimetres,
}

/// Position of the body before each isolated pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Passes {
    /// Distance from the rollers' axes at the far end to the tip of the tail.
    pub tail_mm: Millimetres,
    /// Length of the body at rest.
    pub body_mm: Millimetres,
    /// Speed of the rollers between their ramps: that of the fastest stroke of the run.
    pub speed_um_s: u32,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct DisplacementTable {
    least_mm: Option<Millimetres>,
    greatest_mm: Option<Millimetres>,
    #[serde(default)]
    per_stroke: bool,
    uncertainty_mm: Option<Millimetres>,
}

/// Range and uncertainty of a displacement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Displacements {
    /// The least.
    pub least_mm: Millimetres,
    /// The greatest.
    pub greatest_mm: Millimetres,
    /// Whether it is also asked for after each stroke of a run with the unfolded body.
    pub per_stroke: bool,
    /// Standard deviation of one displacement, from reading and repetition together.
    pub uncertainty_mm: Option<Millimetres>,
}

impl Displacements {
    /// Why a value cannot be a displacement of this plan; none if it can.
    #[must_use]
    pub fn refusal(&self, value: Millimetres) -> Option<String> {
        let allowed = self.least_mm..=self.greatest_mm;
        (!allowed.contains(&value)).then(|| {
            format!(
                "{value} mm: the plan allows {} to {} mm",
                self.least_mm, self.greatest_mm
            )
        })
    }

    /// Largest difference between the displacement after the last stroke and the net one: three standard deviations.
    /// 0 without a stated uncertainty.
    #[must_use]
    pub fn agreement(&self) -> Millimetres {
        Millimetres::from_um(3 * self.uncertainty_mm.unwrap_or_default().um)
    }
}

/// Scatter that the virtual bench adds to its model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Virtual {
    /// Standard deviation of the scatter on displacements; 0 for none.
    #[serde(default)]
    pub scatter_mm: Millimetres,
    /// Seed of the scatter.
    #[serde(default)]
    pub seed: u32,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: u32,
    name: String,
    seed: u64,
    metadata: Metadata,
    run: RunTable,
    readings: Readings,
    indentation: Vec<Indentation>,
    series: Option<SeriesTable>,
    fold_test: Option<FoldTable>,
    passes: Option<PassesTable>,
    #[serde(default)]
    displacement: DisplacementTable,
    #[serde(default, rename = "virtual")]
    virtual_bench: Virtual,
}

/// Trials repeated under the same conditions, except for their indentations.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Group {
    /// State of the walls.
    pub lubrication: Lubrication,
    /// Names of indentations, as listed.
    pub indentations: Vec<String>,
    /// Figure that they are for, and shape of the body.
    #[serde(skip)]
    pub kinds: Vec<(Purpose, Form)>,
    /// Trials of each combination of indentation and kind.
    pub repeats: u32,
}

/// A plan that can be carried out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CampaignPlan {
    /// Its name: letters, digits, `-` and `_`.
    pub name: String,
    /// Seed of the order.
    pub seed: u64,
    /// People, specimen and equipment.
    pub metadata: Metadata,
    /// The run of every trial.
    pub run: Run,
    /// Interval of telemetry, ms.
    pub telemetry_ms: u16,
    /// How to read the caliper.
    pub readings: Readings,
    /// Places of the rollers, from the least indentation to the greatest.
    pub indentations: Vec<Indentation>,
    /// Groups of trials, dry ones first.
    pub groups: Vec<Group>,
    /// Where the body folds, for the runs in which it does.
    pub fold_at: Option<Cue>,
    /// Position of the body before each isolated pass; none without passes.
    pub passes: Option<Passes>,
    /// Range and uncertainty of a displacement.
    pub displacement: Displacements,
    /// Scatter of the virtual bench.
    pub virtual_bench: Virtual,
}

impl CampaignPlan {
    /// Reads the text of the file at `path`.
    ///
    /// # Errors
    /// The first defect, with advice.
    pub fn parse(text: &str, path: &Path) -> Result<Self, CampaignError> {
        let wrong = |why: String| {
            CampaignError::misuse(
                path,
                why,
                "correct the plan; `examples/paper.toml` and `examples/passes.toml` explain every key",
            )
        };
        let file: File = toml::from_str(text)
            .map_err(|error| wrong(format!("not a plan: {}", wording::unreadable(&error))))?;
        Self::from_file(file).map_err(wrong)
    }

    fn from_file(file: File) -> Result<Self, String> {
        if file.format != FORMAT {
            let format = file.format;
            return Err(format!("format {format}, this tool reads {FORMAT}"));
        }
        if i64::try_from(file.seed).is_err() {
            return Err("seed: too large".to_owned());
        }
        is_name("name", &file.name)?;
        check_metadata(&file.metadata)?;
        let (run, telemetry_ms) = run(&file.run)?;
        check_readings(&file.readings)?;
        let indentations = check_indentations(file.indentation, &file.readings)?;
        let known: BTreeSet<&str> = indentations.iter().map(|known| &*known.name).collect();
        let mut groups = vec![];
        let mut fold_at = None;
        if let Some(series) = file.series {
            let forms = [(Purpose::Series, Form::Unfolded)];
            groups = many_groups(
                "series",
                &series.lubrication,
                &series.indentation,
                series.repeats,
                &forms,
            )?;
        }
        if let Some(fold) = file.fold_test {
            repeats("fold_test.repeats", fold.repeats)?;
            let mut kinds = vec![
                (Purpose::FoldTest, Form::Unfolded),
                (Purpose::FoldTest, Form::Folded),
            ];
            if let Some(cycle) = fold.fold_at_cycle {
                // The models of the virtual bench know the folded body beside the rollers, not under them.
                let cue = Cue { cycle, at_um: None };
                cue.check(&run, telemetry_ms)
                    .map_err(|error| format!("fold_test.fold_at_cycle: {error}"))?;
                fold_at = Some(cue);
                kinds.push((Purpose::FoldTest, Form::Folding));
            }
            groups.push(Group {
                lubrication: fold.lubrication,
                indentations: vec![fold.indentation],
                kinds,
                repeats: fold.repeats,
            });
        }
        let mut passes = None;
        if let Some(table) = file.passes {
            let kinds = [
                (Purpose::AntegradePass, Form::Unfolded),
                (Purpose::ReturningPass, Form::Unfolded),
            ];
            groups.extend(many_groups(
                "passes",
                &table.lubrication,
                &table.indentation,
                table.repeats,
                &kinds,
            )?);
            passes = Some(check_passes(&table, &run)?);
        }
        if groups.is_empty() {
            return Err("nothing to do: it needs [series], [fold_test] or [passes]".to_owned());
        }
        for name in groups.iter().flat_map(|group| &group.indentations) {
            if !known.contains(&**name) {
                return Err(format!(
                    "`{name}` is not among the names of [[indentation]]: {}",
                    known.iter().copied().collect::<Vec<_>>().join(", ")
                ));
            }
        }
        // A stable sort: each lubrication keeps the listed order.
        groups.sort_by_key(|group| group.lubrication);
        let displacement = check_displacement(&file.displacement, &run)?;
        let scatter_mm = file.virtual_bench.scatter_mm;
        if !(0..=100_000).contains(&scatter_mm.um) {
            return Err(format!(
                "virtual.scatter_mm: {scatter_mm}; use 0 (none) to 100"
            ));
        }
        Ok(Self {
            name: file.name,
            seed: file.seed,
            metadata: file.metadata,
            run,
            telemetry_ms,
            readings: file.readings,
            indentations,
            groups,
            fold_at,
            passes,
            displacement,
            virtual_bench: file.virtual_bench,
        })
    }

    /// Index of an indentation in the order of depth.
    #[must_use]
    pub fn rank(&self, indentation: &str) -> Option<usize> {
        self.indentations
            .iter()
            .position(|known| known.name == indentation)
    }

    /// Whether some trial needs the capsule.
    #[must_use]
    pub fn needs_capsule(&self) -> bool {
        self.groups
            .iter()
            .flat_map(|group| &group.kinds)
            .any(|(purpose, _)| *purpose == Purpose::FoldTest)
    }

    /// Number of strokes after which such a trial asks for the displacement; none if it does not ask.
    #[must_use]
    pub fn strokes_of(&self, purpose: Purpose, form: Form) -> Option<usize> {
        let asked =
            self.displacement.per_stroke && purpose.pass().is_none() && form == Form::Unfolded;
        asked.then_some(2 * usize::from(self.run.cycles))
    }

    /// Duration of a run, ignoring the rounding of a solved plan, s.
    #[must_use]
    pub fn run_s(&self) -> f64 {
        match self.run.timing {
            RunTiming::Total { total_us, .. } => total_us as f64 / 1e6,
            RunTiming::Speeds { .. } => 0.0,
        }
    }
}

fn is_name(key: &str, text: &str) -> Result<(), String> {
    let fits = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_';
    if text.is_empty() || text.len() > 40 || !text.bytes().all(fits) {
        return Err(format!(
            "{key}: `{text}`; use 1 to 40 letters, digits, `-` and `_`"
        ));
    }
    Ok(())
}

fn repeats(key: &str, value: u32) -> Result<(), String> {
    if !(1..=MOST).contains(&value) {
        return Err(format!("{key}: {value}; use 1 to {MOST}"));
    }
    Ok(())
}

fn check_metadata(metadata: &Metadata) -> Result<(), String> {
    let Metadata {
        operator,
        specimen,
        silicone,
        soap,
        camera,
        caliper,
        caliper_resolution_mm,
    } = metadata;
    for (key, text) in [
        ("operator", operator),
        ("specimen", specimen),
        ("silicone", silicone),
        ("soap", soap),
        ("camera", camera),
        ("caliper", caliper),
    ] {
        if text.trim().is_empty() {
            return Err(format!(
                "metadata.{key} is empty: write what it is, or `none`"
            ));
        }
        if text.chars().any(char::is_control) {
            return Err(format!("metadata.{key}: in one line, please"));
        }
    }
    if !(1..=1_000).contains(&caliper_resolution_mm.um) {
        return Err(format!(
            "metadata.caliper_resolution_mm: {caliper_resolution_mm}; use 0.001 to 1"
        ));
    }
    Ok(())
}

fn run(table: &RunTable) -> Result<(Run, u16), String> {
    let field = |key: &str, value: i64| {
        u32::try_from(value).map_err(|_| {
            let written = decimal::write_signed(value, 3);
            format!("run.{key}: {written}; use 0 to {}", u32::MAX / 1_000)
        })
    };
    let run = Run {
        cycles: table.cycles,
        stroke_um: field("stroke_mm", table.stroke_mm.um)?,
        timing: RunTiming::Total {
            total_us: u64::from(field("duration_s", table.duration_ms)?) * 1_000,
            accel_um_s2: field("acceleration_mm_s2", table.acceleration_um_s2)?,
        },
        far_dwell_us: 0,
        home_dwell_us: 0,
        start_delay_us: 0,
        link_loss: LinkLossPolicy::Stop,
    };
    plan::check(&run).map_err(|error| format!("run: {}", error))?;
    let (least, most) = SetTelemetry::PERIOD_MS;
    if !(least..=most).contains(&table.telemetry_ms) {
        return Err(format!(
            "run.telemetry_ms: {}; use {least} to {most}",
            table.telemetry_ms
        ));
    }
    Ok((run, table.telemetry_ms))
}

fn check_readings(readings: &Readings) -> Result<(), String> {
    if !(1..=100).contains(&readings.count) {
        return Err(format!(
            "readings.count: {}; use 1 to 100, the paper takes 5",
            readings.count
        ));
    }
    if readings.spread_mm.um <= 0 || readings.spread_mm.um > WIDEST_UM {
        return Err(format!(
            "readings.spread_mm: {}; use a number above 0",
            readings.spread_mm
        ));
    }
    match readings.width_about_mm {
        Some(about) if about.um <= 0 || about.um > WIDEST_UM => Err(format!(
            "readings.width_about_mm: {about}; use a number above 0 and up to 1000"
        )),
        _ => Ok(()),
    }
}

fn check_indentations(
    list: Vec<Indentation>,
    readings: &Readings,
) -> Result<Vec<Indentation>, String> {
    if list.is_empty() {
        return Err("it needs at least one [[indentation]]".to_owned());
    }
    let mut names = BTreeSet::new();
    let mut before: Option<(&str, Millimetres)> = None;
    for Indentation { name, about_mm } in &list {
        is_name("indentation.name", name)?;
        if !names.insert(name.as_str()) {
            return Err(format!("two indentations are called `{name}`"));
        }
        let Some(about) = *about_mm else { continue };
        if about.um <= 0 {
            return Err(format!(
                "indentation {name}: about_mm is {about}; use a number above 0"
            ));
        }
        if let Some(width) = readings.width_about_mm
            && about.um * 2 >= width.um
        {
            return Err(format!(
                "indentation {name}: with {about} mm from both sides the walls of {width} mm meet"
            ));
        }
        if let Some((shallow, less)) = before
            && about <= less
        {
            return Err(format!(
                "indentation {name} is about {about} mm, and `{shallow}` before it {less} mm: list them from the least to the greatest"
            ));
        }
        before = Some((name, about));
    }
    Ok(list)
}

/// Splits a table with several states of the walls and several indentations: one group for each state.
fn many_groups(
    table: &str,
    lubrications: &[Lubrication],
    indentations: &[String],
    times: u32,
    kinds: &[(Purpose, Form)],
) -> Result<Vec<Group>, String> {
    repeats(&format!("{table}.repeats"), times)?;
    let twice = |what: &str, name: &str| format!("{table}.{what} has `{name}` twice");
    let mut seen = BTreeSet::new();
    for name in indentations {
        if !seen.insert(name) {
            return Err(twice("indentation", name));
        }
    }
    if indentations.is_empty() || lubrications.is_empty() {
        return Err(format!(
            "{table}: lubrication and indentation each need at least one name"
        ));
    }
    let mut seen = BTreeSet::new();
    let mut groups = vec![];
    for lubrication in lubrications {
        if !seen.insert(*lubrication) {
            return Err(twice("lubrication", lubrication.name()));
        }
        groups.push(Group {
            lubrication: *lubrication,
            indentations: indentations.to_vec(),
            kinds: kinds.to_vec(),
            repeats: times,
        });
    }
    Ok(groups)
}

/// Refuses passes that are not isolated: the rollers must touch the body neither before nor after a pass.
fn check_passes(table: &PassesTable, run: &Run) -> Result<Passes, String> {
    let PassesTable {
        tail_mm, body_mm, ..
    } = *table;
    // The reach of the rollers is at most their radius, at any depth.
    let reach = Millimetres::from_um((roller::Params::PAPER.radius_mm * 1e3) as i64);
    let stroke = Millimetres::from_um(run.stroke_um.into());
    if body_mm.um <= 0 {
        return Err(format!(
            "passes.body_mm: {body_mm}; write the length of the body at rest"
        ));
    }
    if tail_mm < reach {
        return Err(format!(
            "passes.tail_mm: {tail_mm}; at the far end the rollers reach {reach} mm towards the body: use {reach} or more"
        ));
    }
    let most = Millimetres::from_um(stroke.um - reach.um - body_mm.um);
    if tail_mm > most {
        return Err(format!(
            "passes.tail_mm: {tail_mm}; with a body of {body_mm} mm and rollers that reach {reach} mm a stroke of {stroke} mm leaves at most {most}"
        ));
    }
    let speed_um_s = plan::peak_um_s(run)
        .ok_or("passes: the run's strokes have no speed: correct run.duration_s")?;
    Ok(Passes {
        tail_mm,
        body_mm,
        speed_um_s,
    })
}

fn check_displacement(table: &DisplacementTable, run: &Run) -> Result<Displacements, String> {
    let stroke_um = i64::from(run.stroke_um);
    let displacement = Displacements {
        least_mm: table.least_mm.unwrap_or(Millimetres::from_um(-stroke_um)),
        greatest_mm: table.greatest_mm.unwrap_or(Millimetres::from_um(stroke_um)),
        per_stroke: table.per_stroke,
        uncertainty_mm: table.uncertainty_mm,
    };
    if displacement.least_mm >= displacement.greatest_mm {
        return Err(format!(
            "displacement: from {} to {} mm is no range",
            displacement.least_mm, displacement.greatest_mm
        ));
    }
    if let Some(uncertainty) = table.uncertainty_mm
        && !(1..=100_000).contains(&uncertainty.um)
    {
        return Err(format!(
            "displacement.uncertainty_mm: {uncertainty}; no measurement is exact: use 0.001 to 100"
        ));
    }
    if table.per_stroke && run.cycles > MOST_ASKED {
        return Err(format!(
            "displacement.per_stroke: {} values after each of the {} cycles' runs are more than a person enters; use at most {MOST_ASKED} cycles, or leave it out",
            2 * u32::from(run.cycles),
            run.cycles
        ));
    }
    Ok(displacement)
}
