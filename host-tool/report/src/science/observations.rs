//! Displacements for a calibration: from the folder of a verified campaign, and from CSV files that people write.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use calibration::observation::{Kind, Lubrication, MOST_CYCLES, Observation};
use client::identity::Origin;
use client::limited;
use lab::campaign::CampaignError;
use lab::campaign::contents::Campaign;
use lab::campaign::differences::Finding;
use lab::campaign::files::TRIALS;
use lab::campaign::form::Form;
use lab::campaign::ledger::{Standing, TrialState};
use lab::campaign::manifest::{self, hex};
use lab::campaign::plan::{self, CampaignPlan, Purpose};
use lab::campaign::verify::verify;
use serde::Serialize;

/// A file that a calibration uses.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct SourceFile {
    /// Its path, as given.
    pub path: String,
    /// Its SHA-256.
    pub sha256: String,
}

/// An observation and its place in the source.
#[derive(Clone, Debug, PartialEq)]
pub struct Measured {
    /// The displacement.
    pub observation: Observation,
    /// `trial 7` of a campaign, `row 3` of a file.
    pub place: String,
}

/// A displacement that is not used, and the reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LeftOut {
    /// `trial 7` of a campaign, `row 3` of a file.
    pub place: String,
    /// The reason.
    pub why: String,
}

/// Content of one folder or file.
#[derive(Clone, Debug, PartialEq)]
pub struct Trials {
    /// Its path, as given.
    pub path: PathBuf,
    /// Usable displacements.
    pub measured: Vec<Measured>,
    /// Displacements that are not used.
    pub left_out: Vec<LeftOut>,
    /// Hashes of the files read.
    pub files: Vec<SourceFile>,
    /// Where the values come from.
    pub origin: Origin,
    /// Stroke of the rollers, mm, if the source states it.
    pub stroke_mm: Option<f64>,
    /// The uncertainty that the source states, if another one was given and replaced it, mm.
    pub overridden_mm: Option<f64>,
}

impl Trials {
    /// Of no source, and with nothing in it.
    const EMPTY: Self = Self {
        path: PathBuf::new(),
        measured: vec![],
        left_out: vec![],
        files: vec![],
        origin: Origin::Unknown,
        stroke_mm: None,
        overridden_mm: None,
    };

    /// Whether the other holds the same displacements, byte for byte: it is the same source, or a copy of it.
    #[must_use]
    pub fn is_same(&self, other: &Self) -> bool {
        let hash = |of: &Self| of.files.first().map(|file| file.sha256.clone());
        hash(self) == hash(other)
    }

    /// Adds a trial of a campaign: its displacements, and everything that is not used.
    fn add(&mut self, trial: &TrialState, plan: &CampaignPlan, uncertainty_mm: f64) {
        let place = format!("trial {}", trial.planned.trial);
        let mut leave = |why: String| {
            self.left_out.push(LeftOut {
                place: place.clone(),
                why,
            });
        };
        // List every attempt that did not count, even if a later one does.
        for attempt in trial.attempts.iter().filter(|attempt| !attempt.stands()) {
            let how = attempt
                .outcome
                .map_or("not ended", |outcome| outcome.name());
            let why = attempt.given_up.as_deref().or(attempt.reason.as_deref());
            let why = why.map_or(String::new(), |why| format!(": {why}"));
            leave(format!("attempt {} {how}{why}", attempt.number));
        }
        let (displacement_mm, indentation_mm) = match usable(trial) {
            Ok(values) => values,
            Err(why) => return leave(why),
        };
        let planned = &trial.planned;
        let observation = Observation {
            kind: match planned.purpose {
                Purpose::Series | Purpose::FoldTest => Kind::Net {
                    cycles: plan.run.cycles,
                },
                Purpose::AntegradePass => Kind::AntegradePass,
                Purpose::ReturningPass => Kind::ReturningPass,
            },
            lubrication: match planned.lubrication {
                plan::Lubrication::Dry => Lubrication::Dry,
                plan::Lubrication::Lubricated => Lubrication::Lubricated,
            },
            indentation_mm,
            displacement_mm,
            uncertainty_mm,
        };
        let strokes = plan.strokes_of(planned.purpose, planned.shape);
        let after = strokes.map(|count| {
            trial
                .attempt()
                .and_then(|attempt| attempt.all_strokes(count))
        });
        if after == Some(None) {
            leave("its displacements per stroke: they were not entered".to_owned());
        }
        let after = after.flatten().unwrap_or_default();
        let after_mm: Vec<f64> = after.iter().map(|after| after.mm()).collect();
        for (stroke, observation) in (1..).zip(observation.with_readings(&after_mm)) {
            self.measured.push(Measured {
                observation,
                place: format!("{place}, after stroke {stroke}"),
            });
        }
        self.measured.push(Measured { observation, place });
    }
}

/// Displacement and indentation of a trial, mm, or the reason for which it is left out.
fn usable(trial: &TrialState) -> Result<(f64, f64), String> {
    let because = |why: &Option<String>| why.clone().unwrap_or_default();
    match trial.standing() {
        Standing::Done => {}
        Standing::Excluded => return Err(format!("excluded: {}", because(&trial.excluded))),
        Standing::Skipped => return Err(format!("skipped: {}", because(&trial.skipped))),
        Standing::Open | Standing::UnderWay | Standing::Unmeasured => {
            return Err("not done".to_owned());
        }
    }
    if trial.planned.shape != Form::Unfolded {
        return Err(FOLDED.to_owned());
    }
    let indentation = trial.attempt().and_then(|attempt| attempt.indentation_mm);
    match (trial.counted(), indentation) {
        (Some(displacement), Some(indentation)) => Ok((displacement.value.mm(), indentation.mm())),
        _ => Err("its indentation is not known".to_owned()),
    }
}

/// Why a source cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TrialsError {
    /// The folder is no campaign, or cannot be read.
    #[error(transparent)]
    Campaign(#[from] CampaignError),
    /// The folder was changed since it was written.
    #[error("{folder} was changed", folder = folder.display())]
    Changed {
        /// The folder.
        folder: PathBuf,
        /// The changes found.
        findings: Vec<Finding>,
    },
    /// The CSV file cannot be used.
    #[error("{path}: {why}", path = path.display())]
    Csv {
        /// The file.
        path: PathBuf,
        /// The reason, with the number of the row.
        why: String,
    },
    /// The campaign's plan does not state the uncertainty of its displacements.
    #[error("{path} does not say how exact its displacements are", path = .0.display())]
    NoUncertainty(PathBuf),
}

const FOLDED: &str = "folded: the folded block's model has none of the parameters that are fitted";

/// Reads the displacements of a folder or file. `uncertainty_mm` is the standard deviation of each of them. For a
/// folder it replaces the value of the plan; for a file it applies to rows without one.
///
/// # Errors
/// The first defect of the source.
pub fn read(path: &Path, uncertainty_mm: Option<f64>) -> Result<Trials, TrialsError> {
    if path.is_dir() {
        campaign(path, uncertainty_mm)
    } else {
        csv_file(path, uncertainty_mm)
    }
}

fn campaign(path: &Path, uncertainty_mm: Option<f64>) -> Result<Trials, TrialsError> {
    let verified = verify(path)?;
    if !verified.findings.is_empty() {
        return Err(TrialsError::Changed {
            folder: path.to_owned(),
            findings: verified.findings,
        });
    }
    let campaign = Campaign::read(path)?;
    let stated_mm = (campaign.plan.displacement.uncertainty_mm).map(plan::Millimetres::mm);
    let overridden_mm = stated_mm.filter(|stated| uncertainty_mm.is_some_and(|mm| mm != *stated));
    let uncertainty_mm = (uncertainty_mm.or(stated_mm))
        .ok_or_else(|| TrialsError::NoUncertainty(path.to_owned()))?;
    let mut trials = Trials {
        path: path.to_owned(),
        files: listed_files(path)?,
        origin: campaign.origin().unwrap_or_default(),
        stroke_mm: Some(f64::from(campaign.plan.run.stroke_um) / 1e3),
        overridden_mm,
        ..Trials::EMPTY
    };
    for trial in &campaign.state.trials {
        trials.add(trial, &campaign.plan, uncertainty_mm);
    }
    Ok(trials)
}

/// The files of a campaign that are read here, with their hashes.
fn listed_files(path: &Path) -> Result<Vec<SourceFile>, CampaignError> {
    let listed = path.join(manifest::NAME);
    let files = [TRIALS.into(), manifest::NAME.to_owned()];
    let files = files.map(|name| {
        let file = path.join(&name);
        let hash = manifest::hash_file(&file)
            .map_err(|io| CampaignError::new(&listed, io, "make it readable, then again"))?;
        Ok(SourceFile {
            path: name,
            sha256: hex(&hash),
        })
    });
    files.into_iter().collect()
}

/// Columns of a CSV file of trials. The first four are required.
pub const COLUMNS: [&str; 10] = [
    "kind",
    "indentation_mm",
    "lubrication",
    "displacement_mm",
    "uncertainty_mm",
    "cycles",
    "stroke",
    "thread_mm",
    "origin",
    "excluded",
];
const REQUIRED: usize = 4;

fn csv_file(path: &Path, uncertainty_mm: Option<f64>) -> Result<Trials, TrialsError> {
    let wrong = |why: String| TrialsError::Csv {
        path: path.to_owned(),
        why,
    };
    let bytes = limited::read(path, limited::RECORD).map_err(|io| wrong(io.to_string()))?;
    let mut trials = parse(&bytes, uncertainty_mm).map_err(wrong)?;
    trials.path = path.to_owned();
    trials.files = vec![SourceFile {
        path: path.display().to_string(),
        sha256: hex(&hmac_sha256::Hash::hash(&bytes)),
    }];
    Ok(trials)
}

/// Reads the bytes of a CSV file of trials.
///
/// # Errors
/// The first defect, with the number of the row: 1 is the one after the header.
pub fn parse(bytes: &[u8], uncertainty_mm: Option<f64>) -> Result<Trials, String> {
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_reader(bytes);
    let header = reader
        .headers()
        .map_err(|error| format!("it cannot be read: {error}"))?
        .clone();
    let mut columns = BTreeMap::new();
    for (place, name) in header.iter().enumerate() {
        let Some(known) = COLUMNS.iter().find(|known| **known == name) else {
            return Err(format!(
                "there is no column {name:?}: choose {}",
                COLUMNS.join(", ")
            ));
        };
        if columns.insert(*known, place).is_some() {
            return Err(format!("the column {name} is there twice"));
        }
    }
    for name in &COLUMNS[..REQUIRED] {
        if !columns.contains_key(name) {
            return Err(format!("the column {name} is missing"));
        }
    }
    let mut trials = Trials::EMPTY;
    let mut origins = vec![];
    for (number, record) in (1..).zip(reader.records()) {
        let record = record.map_err(|error| format!("row {number}: {error}"))?;
        let text = |name: &str| {
            let place = columns.get(name)?;
            record.get(*place).filter(|text| !text.is_empty())
        };
        let row =
            row(&Fields(&text), uncertainty_mm).map_err(|why| format!("row {number}: {why}"))?;
        let place = format!("row {number}");
        origins.extend(row.origin);
        match row.used {
            Ok(observation) => trials.measured.push(Measured { observation, place }),
            Err(why) => trials.left_out.push(LeftOut { place, why }),
        }
    }
    if let Some(first) = origins.first() {
        if origins.iter().any(|origin| origin != first) {
            return Err(
                "rows of different origin: measured and simulated values are never fitted together; \
                 put them into files of their own"
                    .to_owned(),
            );
        }
        trials.origin = *first;
    }
    Ok(trials)
}

/// A trial as it was read.
struct ReadTrial {
    used: Result<Observation, String>,
    /// None if an excluded trial does not say it.
    origin: Option<Origin>,
}

/// The fields of a row by the name of their column; none if a field is empty.
struct Fields<'a>(&'a dyn Fn(&str) -> Option<&'a str>);

impl<'a> Fields<'a> {
    fn text(&self, name: &str) -> Option<&'a str> {
        self.0(name)
    }

    fn number(&self, name: &str) -> Result<Option<f64>, String> {
        let Some(text) = self.text(name) else {
            return Ok(None);
        };
        match text.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(Some(number)),
            _ => Err(format!(
                "{name}: {text:?} is no number; write for example 12.5"
            )),
        }
    }

    fn required(&self, name: &str) -> Result<f64, String> {
        self.number(name)?.ok_or_else(|| format!("{name} is empty"))
    }

    fn count(&self, name: &str, most: u16) -> Result<Option<u16>, String> {
        let Some(text) = self.text(name) else {
            return Ok(None);
        };
        match text.parse::<u16>() {
            Ok(count) if (1..=most).contains(&count) => Ok(Some(count)),
            _ => Err(format!(
                "{name}: {text:?}; write a whole number from 1 to {most}"
            )),
        }
    }

    fn kind(&self) -> Result<Kind, String> {
        let cycles = self.count("cycles", MOST_CYCLES)?;
        let stroke = self.count("stroke", 2 * MOST_CYCLES)?;
        let kind = match self.text("kind") {
            Some("net") => Kind::Net {
                cycles: cycles.ok_or("net: write the number of cycles of the run into `cycles`")?,
            },
            Some("stroke") => Kind::Stroke {
                number: stroke
                    .ok_or("stroke: write its number in the run, from 1, into `stroke`")?,
            },
            Some("antegrade_pass") => Kind::AntegradePass,
            Some("returning_pass") => Kind::ReturningPass,
            other => {
                return Err(format!(
                    "kind: {:?}; write net, stroke, antegrade_pass or returning_pass",
                    other.unwrap_or_default()
                ));
            }
        };
        if cycles.is_some() && !matches!(kind, Kind::Net { .. }) {
            return Err("`cycles` is for net only: leave it empty".to_owned());
        }
        if stroke.is_some() && !matches!(kind, Kind::Stroke { .. }) {
            return Err("`stroke` is for stroke only: leave it empty".to_owned());
        }
        Ok(kind)
    }

    fn lubrication(&self) -> Result<Lubrication, String> {
        match self.text("lubrication") {
            Some("dry") => Ok(Lubrication::Dry),
            Some("lubricated") => Ok(Lubrication::Lubricated),
            other => {
                let other = other.unwrap_or_default();
                Err(format!("lubrication: {other:?}; write dry or lubricated"))
            }
        }
    }

    fn origin(&self) -> Result<Origin, String> {
        match self.text("origin") {
            None | Some("unknown") => Ok(Origin::Unknown),
            Some("board") => Ok(Origin::Board),
            Some("virtual") => Ok(Origin::Virtual),
            Some(other) => Err(format!(
                "origin: {other:?}; write board, virtual or unknown"
            )),
        }
    }

    /// Why the trial is excluded; none if it is not.
    fn exclusion(&self) -> Result<Option<String>, String> {
        let Some(text) = self.text("excluded") else {
            return Ok(None);
        };
        match text.to_lowercase().as_str() {
            "false" | "no" | "0" => Ok(None),
            "true" | "yes" | "1" => Ok(Some("excluded".to_owned())),
            // A single word may be a no in another language or spelling.
            _ if text.contains(char::is_whitespace) => Ok(Some(format!("excluded: {text}"))),
            _ => Err(format!(
                "excluded: {text:?}; write true or false, or why it is excluded in two words or more"
            )),
        }
    }

    fn is_folded(&self) -> Result<bool, String> {
        match self.number("thread_mm")? {
            Some(mm) if mm < 0.0 => Err(format!(
                "thread_mm: {mm}; write 0 or more, the thread drawn in"
            )),
            Some(mm) => Ok(mm > 0.0),
            None => Ok(false),
        }
    }
}

fn row(fields: &Fields<'_>, uncertainty_mm: Option<f64>) -> Result<ReadTrial, String> {
    if let Some(why) = fields.exclusion()? {
        // It may be incomplete: what is missing is often the reason. Only what it says of its origin has to be true.
        let stated = fields.text("origin").map(|_| fields.origin());
        return Ok(ReadTrial {
            used: Err(why),
            origin: stated.transpose()?,
        });
    }
    let kind = fields.kind()?;
    let lubrication = fields.lubrication()?;
    let origin = fields.origin()?;
    let indentation_mm = fields.required("indentation_mm")?;
    if indentation_mm <= 0.0 {
        return Err(format!(
            "indentation_mm: {indentation_mm}; write a number above 0"
        ));
    }
    let displacement_mm = fields.required("displacement_mm")?;
    let uncertainty_mm = fields.number("uncertainty_mm")?.or(uncertainty_mm).ok_or(
        "uncertainty_mm is empty: write the standard deviation of the displacement, or give --uncertainty-mm",
    )?;
    if uncertainty_mm <= 0.0 {
        return Err(format!(
            "uncertainty_mm: {uncertainty_mm}; no measurement is exact: write a number above 0"
        ));
    }
    let folded = fields.is_folded()?;
    let used = match folded {
        true => Err(FOLDED.to_owned()),
        false => Ok(Observation {
            kind,
            lubrication,
            indentation_mm,
            displacement_mm,
            uncertainty_mm,
        }),
    };
    let origin = Some(origin);
    Ok(ReadTrial { used, origin })
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "kind,cycles,stroke,indentation_mm,lubrication,thread_mm,displacement_mm,uncertainty_mm,origin,excluded\n";

    #[test]
    fn every_kind_is_read() {
        let text = format!(
            "{HEADER}net,5,,5.05,dry,,46.3,1,virtual,\n\
             stroke,,2,1,lubricated,0,-0.1,0.2,virtual,\n\
             antegrade_pass,,,2,dry,,4.9,,virtual,\n\
             returning_pass,,,2,dry,,-0.5,0.2,virtual,camera fell\n\
             net,5,,5.05,lubricated,21,-98,1,virtual,\n"
        );
        let trials = parse(text.as_bytes(), Some(0.3)).expect("readable");
        let kinds: Vec<Kind> = trials
            .measured
            .iter()
            .map(|one| one.observation.kind)
            .collect();
        assert_eq!(
            kinds,
            [
                Kind::Net { cycles: 5 },
                Kind::Stroke { number: 2 },
                Kind::AntegradePass
            ]
        );
        let uncertainties = trials
            .measured
            .iter()
            .map(|one| one.observation.uncertainty_mm);
        assert_eq!(uncertainties.collect::<Vec<_>>(), [1.0, 0.2, 0.3]);
        assert_eq!(trials.origin, Origin::Virtual);
        let left: Vec<_> = trials
            .left_out
            .iter()
            .map(|one| (&*one.place, &*one.why))
            .collect();
        assert_eq!(
            left,
            [("row 4", "excluded: camera fell"), ("row 5", FOLDED)]
        );
    }

    /// `False` excluded its row.
    #[test]
    fn the_words_for_excluded_mean_what_they_say() {
        let read = |word: &str| {
            let text = format!("{HEADER}net,5,,5.05,dry,,46.3,1,board,{word}\n");
            parse(text.as_bytes(), None)
        };
        for word in ["", "false", "False", "FALSE", "no", "No", "0"] {
            let trials = read(word).expect(word);
            assert_eq!(
                (trials.measured.len(), trials.left_out.len()),
                (1, 0),
                "{word}"
            );
        }
        for (word, why) in [
            ("true", "excluded"),
            ("True", "excluded"),
            ("YES", "excluded"),
            ("1", "excluded"),
            ("the camera fell", "excluded: the camera fell"),
        ] {
            let trials = read(word).expect(word);
            assert!(trials.measured.is_empty(), "{word}");
            assert_eq!(trials.left_out[0].why, why);
        }
        for word in ["n", "nein", "2", "-", "f"] {
            let why = read(word).expect_err(word);
            let says =
                format!("row 1: excluded: {word:?}; write true or false, or why it is excluded");
            assert!(why.starts_with(&says), "{why}");
        }
    }

    /// A trial that failed has no displacement, which is why it is excluded.
    #[test]
    fn an_excluded_row_may_be_incomplete() {
        let text = format!(
            "{HEADER}net,5,,5.05,dry,,46.3,1,board,no\n\
             net,,,,,,,,,yes\n\
             ,,,2,,,lost,,,the tail was caught\n"
        );
        let trials = parse(text.as_bytes(), None).expect("readable");
        assert_eq!((trials.measured.len(), trials.origin), (1, Origin::Board));
        let left = trials.left_out.iter().map(|one| (&*one.place, &*one.why));
        assert_eq!(
            left.collect::<Vec<_>>(),
            [
                ("row 2", "excluded"),
                ("row 3", "excluded: the tail was caught")
            ]
        );
        // Its origin has to agree with the other rows all the same.
        let text = format!("{HEADER}net,5,,5,dry,,4,1,board,\n,,,,,,,,virtual,yes\n");
        let why = parse(text.as_bytes(), None).expect_err("two origins");
        assert!(why.starts_with("rows of different origin"), "{why}");
    }

    #[test]
    fn bad_rows_are_refused_with_their_number_and_what_to_write() {
        let good = "net,5,,5.05,dry,,46.3,1,,\n";
        for (row, says) in [
            (
                "net,5,,5.05,dry,,much,1,,",
                "row 2: displacement_mm: \"much\" is no number",
            ),
            (
                "net,5,,5.05,dry,,NaN,1,,",
                "row 2: displacement_mm: \"NaN\" is no number",
            ),
            ("net,5,,5.05,dry,,,1,,", "row 2: displacement_mm is empty"),
            (
                "net,5,,0,dry,,1,1,,",
                "row 2: indentation_mm: 0; write a number above 0",
            ),
            (
                "net,5,,1,wet,,1,1,,",
                "row 2: lubrication: \"wet\"; write dry or lubricated",
            ),
            (
                "net,,,1,dry,,1,1,,",
                "row 2: net: write the number of cycles",
            ),
            (
                "net,2.5,,1,dry,,1,1,,",
                "row 2: cycles: \"2.5\"; write a whole number from 1",
            ),
            (
                "stroke,,,1,dry,,1,1,,",
                "row 2: stroke: write its number in the run",
            ),
            (
                "antegrade_pass,5,,1,dry,,1,1,,",
                "row 2: `cycles` is for net only",
            ),
            ("net,5,1,1,dry,,1,1,,", "row 2: `stroke` is for stroke only"),
            (
                "pass,,,1,dry,,1,1,,",
                "row 2: kind: \"pass\"; write net, stroke, antegrade_pass",
            ),
            (
                "net,5,,1,dry,,1,0,,",
                "row 2: uncertainty_mm: 0; no measurement is exact",
            ),
            ("net,5,,1,dry,,1,,,", "or give --uncertainty-mm"),
            ("net,5,,1,dry,-2,1,1,,", "row 2: thread_mm: -2"),
            (
                "net,5,,1,dry,,1,1,lab,",
                "row 2: origin: \"lab\"; write board",
            ),
            ("net,5,,1,dry,,1,1,board,", "rows of different origin"),
            ("net,5,,1,dry,,1", "row 2:"),
        ] {
            let text = format!("{HEADER}{good}{row}\n");
            let why = parse(text.as_bytes(), None).expect_err(row);
            assert!(why.contains(says), "{row}: {why}");
        }
        for (header, says) in [
            (
                "kind,indentation_mm,lubrication\n",
                "the column displacement_mm is missing",
            ),
            ("kind,weight_g\n", "no column \"weight_g\": choose kind"),
            ("kind,kind\n", "the column kind is there twice"),
        ] {
            let why = parse(header.as_bytes(), None).expect_err(header);
            assert!(why.contains(says), "{header}: {why}");
        }
    }
}
