//! The plan of a campaign: reads the TOML file that a person writes, and checks it before anything is measured.

use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;

use crate::trials::cue::Cue;
use crate::trials::plan;
use client::{decimal, wording};
use protocol::rig::{LinkLossPolicy, Run, RunTiming};
use protocol::system::SetTelemetry;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};

use crate::campaign::CampaignError;
use crate::campaign::form::Form;

/// Version of the format; incremented when a key changes its meaning.
pub const FORMAT: u32 = 1;

/// Most readings of one width, and most repeats of one condition.
const MOST: u32 = 1_000;

/// Largest length that can be entered: 1 m.
const WIDEST_UM: i64 = 1_000_000;

/// A length, written in millimetres and stored in micrometres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Millimetres {
    pub um: i64,
}

impl Millimetres {
    pub const fn from_um(um: i64) -> Self {
        Self { um }
    }

    /// The length in mm, for calculations.
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

/// As [`parse_thousandths`], from a plan or a table, where the value may be a number or a text.
fn thousandths<'de, D: Deserializer<'de>>(deserializer: D) -> Result<i64, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "expected a number, for example 130 or 12.5")]
    enum Number {
        Whole(i64),
        // The shortest text of this float is the text in the file.
        Decimal(f64),
        Text(String),
    }
    let text = match Number::deserialize(deserializer)? {
        Number::Whole(value) => value.to_string(),
        Number::Decimal(value) => value.to_string(),
        Number::Text(text) => text,
    };
    parse_thousandths(&text).map_err(D::Error::custom)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Lubrication {
    /// Without soap. Comes first, because soap cannot be removed.
    Dry,
    /// With soapy water before each trial.
    Lubricated,
}

impl Lubrication {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Dry => "dry",
            Self::Lubricated => "lubricated",
        }
    }

    /// Friction coefficient of the wall: an end of the paper's range \[assumed\].
    pub const fn friction(self) -> f64 {
        match self {
            Self::Dry => 0.20,
            Self::Lubricated => 0.08,
        }
    }
}

/// Figure of the paper that a trial is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrialPurpose {
    /// Displacement against indentation: figure 7.
    Series,
    /// Folded against unfolded: figure 8.
    FoldTest,
}

impl TrialPurpose {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Series => "series",
            Self::FoldTest => "fold_test",
        }
    }
}

/// People, specimen and equipment, as free text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Metadata {
    pub operator: String,
    /// The body: origami, width, crescents.
    pub specimen: String,
    /// The walls of the intestine.
    pub silicone: String,
    /// The soapy water and its quantity.
    pub soap: String,
    /// The camera, and what starts it.
    pub camera: String,
    pub caliper: String,
    /// Resolution of the caliper; finer readings are asked for again.
    pub caliper_resolution_mm: Millimetres,
    /// Whatever else the records should say, under keys of the user's own.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    pub extra: Map<String, Value>,
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

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Readings {
    /// Number of readings of each width, each at a different place.
    pub count: u32,
    /// Largest difference between readings that is accepted without a question.
    pub spread_mm: Millimetres,
    /// Approximate value of D. The virtual bench answers with it.
    pub width_about_mm: Option<Millimetres>,
}

/// A position of the rollers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Indentation {
    /// Name: letters, digits, `-` and `_`.
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

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct DisplacementTable {
    least_mm: Option<Millimetres>,
    greatest_mm: Option<Millimetres>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Displacements {
    pub least_mm: Millimetres,
    pub greatest_mm: Millimetres,
}

impl Displacements {
    /// Why a value cannot be a displacement of this plan; none if it can.
    pub fn refusal(&self, value: Millimetres) -> Option<String> {
        let allowed = self.least_mm..=self.greatest_mm;
        (!allowed.contains(&value)).then(|| {
            format!(
                "{value} mm: the plan allows {} to {} mm",
                self.least_mm, self.greatest_mm
            )
        })
    }
}

/// Scatter that the virtual bench adds to its model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Virtual {
    /// Standard deviation of the scatter on displacements; 0 for none.
    #[serde(default)]
    pub scatter_mm: Millimetres,
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
    #[serde(default)]
    displacement: DisplacementTable,
    #[serde(default, rename = "virtual")]
    virtual_bench: Virtual,
}

/// Trials repeated under the same conditions, except for their indentations.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Group {
    pub lubrication: Lubrication,
    pub indentations: Vec<String>,
    /// Purpose, and shape of the body.
    #[serde(skip)]
    pub kinds: Vec<(TrialPurpose, Form)>,
    /// Trials of each combination of indentation and kind.
    pub repeats: u32,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CampaignPlan {
    /// Name: letters, digits, `-` and `_`.
    pub name: String,
    pub seed: u64,
    pub metadata: Metadata,
    pub run: Run,
    pub telemetry_ms: u16,
    pub readings: Readings,
    /// Positions of the rollers, from the least indentation to the greatest.
    pub indentations: Vec<Indentation>,
    pub groups: Vec<Group>,
    /// Where the body folds, in runs in which it does.
    pub fold_at: Option<Cue>,
    pub displacement: Displacements,
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
                "correct the plan; `examples/paper.toml` explains every key",
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
        let mut groups = match &file.series {
            Some(series) => series_groups(series)?,
            None => vec![],
        };
        let mut fold_at = None;
        if let Some(fold) = file.fold_test {
            fold_at = fold.cue(&run, telemetry_ms)?;
            groups.push(fold.group()?);
        }
        if groups.is_empty() {
            return Err("nothing to do: it needs [series] or [fold_test]".to_owned());
        }
        for name in groups.iter().flat_map(|group| &group.indentations) {
            if !known.contains(&**name) {
                return Err(format!(
                    "`{name}` is not among the names of [[indentation]]: {}",
                    known.iter().copied().collect::<Vec<_>>().join(", ")
                ));
            }
        }
        // The sort is stable: each lubrication keeps the listed order.
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
            displacement,
            virtual_bench: file.virtual_bench,
        })
    }

    /// Index of an indentation in the order of depth.
    pub fn rank(&self, indentation: &str) -> Option<usize> {
        self.indentations
            .iter()
            .position(|known| known.name == indentation)
    }

    pub fn needs_capsule(&self) -> bool {
        self.groups
            .iter()
            .flat_map(|group| &group.kinds)
            .any(|(purpose, _)| *purpose == TrialPurpose::FoldTest)
    }

    /// Duration of a run, ignoring the rounding of a solved plan, s.
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

/// Whether JSON can hold a value of a plan: a date of TOML, `nan` and `inf` it cannot.
fn is_json(value: &Value) -> bool {
    match value {
        Value::Null => false,
        Value::Array(all) => all.iter().all(is_json),
        Value::Object(of) => of
            .iter()
            .all(|(key, value)| !key.starts_with('$') && is_json(value)),
        Value::Bool(_) | Value::Number(_) | Value::String(_) => true,
    }
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
        extra,
    } = metadata;
    if let Some((key, _)) = extra.iter().find(|(_, value)| !is_json(value)) {
        return Err(format!(
            "metadata.extra.{key}: write a date in quotes, and no `nan` or `inf`"
        ));
    }
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
    plan::fits(&run, table.telemetry_ms).map_err(|why| format!("run.telemetry_ms: {why}"))?;
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

/// The groups of the series, one for each state of the walls.
fn series_groups(series: &SeriesTable) -> Result<Vec<Group>, String> {
    repeats("series.repeats", series.repeats)?;
    let (lubrication, indentation) = (&series.lubrication, &series.indentation);
    if indentation.is_empty() || lubrication.is_empty() {
        return Err("series: lubrication and indentation each need at least one name".to_owned());
    }
    let walls: Vec<String> = (lubrication.iter())
        .map(|wall| wall.name().to_owned())
        .collect();
    for (key, names) in [("lubrication", &walls), ("indentation", indentation)] {
        let mut seen = BTreeSet::new();
        if let Some(twice) = names.iter().find(|name| !seen.insert(*name)) {
            return Err(format!("series.{key} has `{twice}` twice"));
        }
    }
    let group = |lubrication: &Lubrication| Group {
        lubrication: *lubrication,
        indentations: indentation.clone(),
        kinds: vec![(TrialPurpose::Series, Form::Unfolded)],
        repeats: series.repeats,
    };
    Ok(lubrication.iter().map(group).collect())
}

impl FoldTable {
    /// Where the body folds, in runs in which it does.
    fn cue(&self, run: &Run, telemetry_ms: u16) -> Result<Option<Cue>, String> {
        // The models of the virtual bench know the folded body beside the rollers, not under them.
        let cue = |cycle| Cue { cycle, at_um: None };
        let Some(cue) = self.fold_at_cycle.map(cue) else {
            return Ok(None);
        };
        cue.check(run, telemetry_ms)
            .map_err(|error| format!("fold_test.fold_at_cycle: {error}"))?;
        Ok(Some(cue))
    }

    fn group(self) -> Result<Group, String> {
        repeats("fold_test.repeats", self.repeats)?;
        let mut forms = vec![Form::Unfolded, Form::Folded];
        forms.extend(self.fold_at_cycle.map(|_| Form::Folding));
        let kinds = forms.into_iter().map(|form| (TrialPurpose::FoldTest, form));
        Ok(Group {
            lubrication: self.lubrication,
            indentations: vec![self.indentation],
            kinds: kinds.collect(),
            repeats: self.repeats,
        })
    }
}

fn check_displacement(table: &DisplacementTable, run: &Run) -> Result<Displacements, String> {
    let stroke_um = i64::from(run.stroke_um);
    let displacement = Displacements {
        least_mm: table.least_mm.unwrap_or(Millimetres::from_um(-stroke_um)),
        greatest_mm: table.greatest_mm.unwrap_or(Millimetres::from_um(stroke_um)),
    };
    if displacement.least_mm >= displacement.greatest_mm {
        return Err(format!(
            "displacement: from {} to {} mm is not a range",
            displacement.least_mm, displacement.greatest_mm
        ));
    }
    Ok(displacement)
}
