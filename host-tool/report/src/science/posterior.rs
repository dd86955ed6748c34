//! The posterior in a model file: bodies drawn by `retrograde fit`, and the trials behind them.

use std::fmt::Write;

use calibration::prior::{OF_BODY, unknowns};
use client::identity::Origin;
use locomotion::model::{Model, Setting, Value};
use serde::{Deserialize, Serialize};

use crate::science::observations::{LeftOut, SourceFile};

/// Version of the format.
pub const FORMAT: u32 = 1;
/// The section of a model file.
pub const SECTION: &str = "posterior";

/// Trials from one source.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceRecord {
    /// Folder or file, as given.
    pub path: String,
    /// Where its values come from.
    pub origin: Origin,
    /// SHA-256 of each file that was read.
    pub sha256: Vec<String>,
    /// The trials or rows that were used.
    pub used: Vec<String>,
    /// The trials or rows that were not used, and the reasons.
    pub left_out: Vec<String>,
}

impl SourceRecord {
    /// Collects the record of a source.
    #[must_use]
    pub fn new(
        path: &str,
        origin: Origin,
        files: &[SourceFile],
        used: Vec<String>,
        left_out: &[LeftOut],
    ) -> Self {
        let hash = |file: &SourceFile| format!("{}  {}", file.sha256, file.path);
        let left = |one: &LeftOut| format!("{}: {}", one.place, one.why);
        Self {
            path: path.to_owned(),
            origin,
            sha256: files.iter().map(hash).collect(),
            used,
            left_out: left_out.iter().map(left).collect(),
        }
    }
}

/// A posterior as it is in a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Posterior {
    /// [`FORMAT`].
    pub format: u32,
    /// Where the displacements come from.
    pub origin: Origin,
    /// Program and versions that made it.
    pub made_by: String,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Description of the sampling.
    pub sampler: String,
    /// Greatest R-hat among the unknowns.
    pub r_hat: f64,
    /// Least effective sample size among the unknowns, in the bulk or in the tails.
    pub ess: f64,
    /// False if `reasons` has an entry.
    pub reliable: bool,
    /// Reasons why it is not reliable, a sentence each.
    #[serde(default)]
    pub reasons: Vec<String>,
    /// Reasons to doubt it, a sentence each.
    #[serde(default)]
    pub doubts: Vec<String>,
    /// Chi-square of the trials without the discrepancy, at the body nearest to them.
    #[serde(default)]
    pub chi_square: Option<f64>,
    /// Its degrees of freedom.
    #[serde(default)]
    pub degrees: Option<usize>,
    /// Number, from 1, of the sample whose values the file has: the one nearest to the medians.
    pub point: usize,
    /// Names of the columns of `samples`.
    pub parameters: Vec<String>,
    /// The bodies, evenly taken from all draws.
    pub samples: Vec<Vec<f64>>,
    /// The trials it was fitted to.
    pub source: Vec<SourceRecord>,
}

impl Posterior {
    /// Reads the section of a file.
    ///
    /// # Errors
    /// The first defect, for people.
    pub fn read(item: toml::Value) -> Result<Self, String> {
        let this: Self = item
            .try_into()
            .map_err(|error: toml::de::Error| error.message().to_owned())?;
        if this.format != FORMAT {
            return Err(format!("format {}, this tool reads {FORMAT}", this.format));
        }
        let names: Vec<&str> = unknowns().iter().map(|unknown| unknown.key).collect();
        if this.parameters != names {
            return Err(format!("its parameters have to be {}", names.join(", ")));
        }
        if this.samples.is_empty() {
            return Err("it has no samples".to_owned());
        }
        if this.reliable && !this.reasons.is_empty() {
            return Err("it is reliable and has reasons why it is not".to_owned());
        }
        for (number, sample) in (1..).zip(&this.samples) {
            if sample.len() != names.len() {
                return Err(format!(
                    "sample {number} has to have {} numbers",
                    names.len()
                ));
            }
        }
        if !(1..=this.samples.len()).contains(&this.point) {
            return Err(format!("there is no sample {}", this.point));
        }
        for body in this.bodies(&Model::ONE) {
            body.check().map_err(|error| format!("a sample: {error}"))?;
        }
        Ok(this)
    }

    /// Formats the section of a file.
    #[must_use]
    pub fn text(&self) -> String {
        let mut text = format!("\n[{SECTION}]\n");
        let list = |items: &[String]| {
            let items: Vec<_> = items.iter().map(|item| quoted(item)).collect();
            format!("[{}]", items.join(", "))
        };
        let _ = write!(
            text,
            "format = {}\norigin = {}\nmade_by = {}\nseed = {}\nsampler = {}\n\
             r_hat = {:?}\ness = {:?}\nreliable = {}\nreasons = {}\ndoubts = {}\n",
            self.format,
            quoted(self.origin.name()),
            quoted(&self.made_by),
            self.seed,
            quoted(&self.sampler),
            self.r_hat,
            self.ess,
            self.reliable,
            list(&self.reasons),
            list(&self.doubts),
        );
        if let (Some(chi_square), Some(degrees)) = (self.chi_square, self.degrees) {
            let _ = writeln!(text, "chi_square = {chi_square:?}\ndegrees = {degrees}");
        }
        let _ = write!(
            text,
            "point = {}\nparameters = {}\nsamples = [\n",
            self.point,
            list(&self.parameters),
        );
        for sample in &self.samples {
            let numbers: Vec<_> = sample.iter().map(|number| format!("{number:?}")).collect();
            let _ = writeln!(text, "    [{}],", numbers.join(", "));
        }
        text += "]\n";
        for source in &self.source {
            let _ = write!(
                text,
                "\n[[{SECTION}.source]]\npath = {}\norigin = {}\nsha256 = {}\nused = {}\nleft_out = {}\n",
                quoted(&source.path),
                quoted(source.origin.name()),
                list(&source.sha256),
                list(&source.used),
                list(&source.left_out),
            );
        }
        text
    }

    /// The model with each of the bodies.
    #[must_use]
    pub fn bodies(&self, model: &Model) -> Vec<Model> {
        let body = |sample: &Vec<f64>| {
            let mut body = *model;
            for (key, value) in self.parameters.iter().zip(sample).take(OF_BODY) {
                if let Some(setting) = Setting::named(key) {
                    // Cannot fail: all are numbers, and `read` has checked the names.
                    let _ = body.set(setting, Value::Number(*value));
                }
            }
            body
        };
        self.samples.iter().map(body).collect()
    }

    /// The parameters of the body that it determines.
    #[must_use]
    pub fn of_body(&self) -> &[String] {
        &self.parameters[..OF_BODY]
    }

    /// Describes a band of it in a sentence.
    #[must_use]
    pub fn meaning(&self) -> String {
        format!("5 to 95 % of {}", self.what())
    }

    /// Describes its bodies, for use in a sentence.
    #[must_use]
    pub fn what(&self) -> String {
        let trials: usize = self.source.iter().map(|source| source.used.len()).sum();
        format!(
            "{} bodies of the posterior of {trials} displacements; their origin: {}{}",
            self.samples.len(),
            self.origin.meaning(),
            self.verdict()
        )
    }

    /// The verdict on it, for the end of a sentence: empty if nothing speaks against it.
    #[must_use]
    pub fn verdict(&self) -> String {
        let (word, reasons) = match (self.reliable, self.reasons.as_slice()) {
            (false, []) => return "; NOT RELIABLE".to_owned(),
            (false, reasons) => ("NOT RELIABLE", reasons),
            (true, _) if self.doubts.is_empty() => return String::new(),
            (true, _) => ("DOUBTED", self.doubts.as_slice()),
        };
        format!("; {word}: {}", reasons.join("; "))
    }

    /// The verdict in a word, for a figure: empty if nothing speaks against it.
    #[must_use]
    pub fn word(&self) -> &'static str {
        match (self.reliable, self.doubts.as_slice()) {
            (false, _) => " NOT RELIABLE",
            (true, []) => "",
            (true, _) => " DOUBTED",
        }
    }

    /// The discrepancy of each of the bodies, mm.
    #[must_use]
    pub fn discrepancies_mm(&self) -> Vec<f64> {
        self.samples.iter().map(|sample| sample[OF_BODY]).collect()
    }
}

/// Formats a TOML string: TOML reads JSON's escapes the same way, and no other control character remains.
fn quoted(text: &str) -> String {
    let text: String = text
        .chars()
        .map(|char| if char.is_control() { ' ' } else { char })
        .collect();
    serde_json::Value::String(text).to_string()
}
