//! Reads models from files and options, writes them, and describes them in words.

use std::fmt::Write;

use locomotion::model::{Model, Setting, Unsuitable, Value};
use toml::{Table, Value as Item};

use crate::figures::ModelName;

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ModelError {
    #[error("it cannot be read: {0}")]
    Syntax(String),
    #[error("there is no body {0:?}: choose {names}", names = names())]
    Body(String),
    #[error("there is no parameter {0}{near}", near = near(.0))]
    Unknown(String),
    /// The parameter cannot take this value.
    #[error("{key}: {why}")]
    Unsuitable { key: &'static str, why: Unsuitable },
    #[error("{0} and {1} set the same: give one of them")]
    Twice(&'static str, &'static str),
}

/// The names of the bodies as a list for people.
pub fn names() -> String {
    Model::ALL.map(|model| model.name).join(", ")
}

/// Suggestions for an unknown key: parameters with similar names.
fn near(key: &str) -> String {
    let (section, name) = key.rsplit_once('.').unwrap_or(("", key));
    let keys = |alike: &dyn Fn(&str, &str) -> bool| -> Vec<&str> {
        Setting::all()
            .filter(|setting| {
                setting
                    .key
                    .split_once('.')
                    .is_some_and(|(section, name)| alike(section, name))
            })
            .map(|setting| setting.key)
            .collect()
    };
    let mut alike = keys(&|_, other| other == name);
    if alike.is_empty() {
        alike = keys(&|other, _| other == section);
    }
    if alike.is_empty() {
        ": its sections are design, body, rig, tube and folded".to_owned()
    } else {
        format!(": choose {}", alike.join(", "))
    }
}

#[derive(Clone, Debug, PartialEq)]
pub enum Given {
    Number(f64),
    Word(String),
}

impl From<&str> for Given {
    fn from(text: &str) -> Self {
        text.parse()
            .map_or_else(|_| Self::Word(text.to_owned()), Self::Number)
    }
}

/// A parameter and the value written for it.
pub type Choice = (&'static Setting, Given);

#[derive(Clone, Debug, Default)]
pub struct ModelFile {
    pub body: Option<String>,
    pub choices: Vec<Choice>,
}

/// Key of the body that a file starts from. Not `body`, which is a section.
const FROM_BODY: &str = "from_body";

/// Reads a model file: `from_body = "one"`, and sections with the keys of the parameters. Refuses unknown keys.
pub fn read(text: &str) -> Result<ModelFile, ModelError> {
    let table: Table = text
        .parse()
        .map_err(|error: toml::de::Error| ModelError::Syntax(error.to_string()))?;
    let mut file = ModelFile::default();
    for (name, item) in table {
        match item {
            Item::String(body) if name == FROM_BODY => file.body = Some(body),
            Item::Table(section) => {
                for (key, item) in section {
                    file.choices.push(choice(&format!("{name}.{key}"), item)?);
                }
            }
            _ => return Err(ModelError::Unknown(name)),
        }
    }
    Ok(file)
}

fn choice(key: &str, item: Item) -> Result<Choice, ModelError> {
    let setting = Setting::named(key).ok_or_else(|| ModelError::Unknown(key.to_owned()))?;
    let given = match item {
        Item::Float(number) => Given::Number(number),
        Item::Integer(number) => Given::Number(number as f64),
        Item::String(word) => Given::Word(word),
        _ => {
            return Err(ModelError::Unsuitable {
                key: setting.key,
                why: Unsuitable::NotNumber,
            });
        }
    };
    Ok((setting, given))
}

/// A named body with some values replaced. Does not check ranges; [`Model::check`] does.
pub fn build(body: &str, choices: &[Choice]) -> Result<Model, ModelError> {
    let mut model = Model::named(body).ok_or_else(|| ModelError::Body(body.to_owned()))?;
    for (setting, given) in choices {
        if let Some(other) = setting.other_key()
            && choices.iter().any(|(setting, _)| setting.key == other)
        {
            return Err(ModelError::Twice(setting.key, other));
        }
        let value = match given {
            Given::Number(number) => Value::Number(*number),
            Given::Word(word) => Value::Word(word),
        };
        model
            .set(setting, value)
            .map_err(|why| ModelError::Unsuitable {
                key: setting.key,
                why,
            })?;
    }
    Ok(model)
}

pub fn write(model: &Model) -> String {
    let mut text = format!(
        "# Origin: {}\n# `retrograde simulate --model` reads this file. What is left out is that of the body.\n\
         {FROM_BODY} = \"{}\"\n",
        origin(model),
        model.name
    );
    let mut last = "";
    for row in model.parameters() {
        let (section, name) = row.name.split_once('.').unwrap_or(("", row.name));
        if section != last {
            let _ = write!(text, "\n[{section}]\n");
            last = section;
        }
        let value = match row.word {
            Some(word) => format!("\"{word}\""),
            None => format!("{:?}", row.value),
        };
        let unit = if row.unit.is_empty() {
            String::new()
        } else {
            format!("{}; ", row.unit)
        };
        let _ = writeln!(
            text,
            "{name} = {value} # {unit}{}: {}",
            row.label, row.source
        );
    }
    text
}

/// Origin of a model's values, in full.
pub fn origin(model: &Model) -> String {
    let changes: Vec<_> = model
        .changes()
        .map(|row| match row.word {
            Some(word) => format!("{} = {word}", row.name),
            None => format!("{} = {}", row.name, row.value),
        })
        .collect();
    let changed = match changes.is_empty() {
        true => String::new(),
        false => format!(
            "; changed since, so no longer calibrated: {}",
            changes.join(", ")
        ),
    };
    format!(
        "model: body {}, calibrated to {}{changed}; calculated, not a measurement",
        model.name, model.calibrated_to
    )
}

/// Number of changed values in words, or `unchanged`.
fn changes(model: &Model, unchanged: &str) -> String {
    match model.changes().count() {
        0 => unchanged.to_owned(),
        1 => ", 1 value changed".to_owned(),
        count => format!(", {count} values changed"),
    }
}

/// Origin of a model's values, in a few letters for each row of a table.
pub fn short_origin(model: &Model) -> String {
    format!("model {}{}", model.name, changes(model, ""))
}

pub fn name(model: &Model) -> ModelName {
    let changes = changes(model, ", a fit to words");
    ModelName {
        short: format!("model: body {}{changes}, no measurement", model.name),
        full: origin(model),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_model_is_read_back_to_the_bit() {
        for model in Model::ALL {
            let file = read(&write(&model)).expect("readable");
            let body = file.body.expect("named");
            assert_eq!(build(&body, &file.choices), Ok(model));
        }
        let odd = "from_body = \"rig\"\n[body]\nfriction_ratio = \"facets\"\npreload_mm = 1e-5\n[rig]\ncycles = 3\n";
        let file = read(odd).expect("readable");
        let model = build("rig", &file.choices).expect("a model");
        assert_eq!(model.changes().count(), 3);
        let again = read(&write(&model)).expect("readable");
        assert_eq!(build("rig", &again.choices), Ok(model));
        assert!(origin(&model).contains("body.friction_ratio = facets"));
        assert_eq!(short_origin(&model), "model rig, 3 values changed");
    }

    #[test]
    fn what_is_no_model_is_refused_with_what_to_write() {
        for (text, says) in [
            ("from_body = ", "cannot be read"),
            ("body = 3", "no parameter body"),
            ("coupling = 0.2", "choose body.coupling"),
            (
                "[body]\ncupling = 0.2",
                "choose body.coupling, body.friction",
            ),
            ("[wall]\npoisson = 0.4", "choose tube.poisson"),
            (
                "[wall]\nheight = 0.4",
                "sections are design, body, rig, tube and folded",
            ),
            (
                "[body]\ncoupling = true",
                "body.coupling: it has to be a number",
            ),
            (
                "[body.coupling]\nrig = 1.0",
                "body.coupling: it has to be a number",
            ),
            ("[body]\ncoupling = 1\ncoupling = 2", "duplicate"),
        ] {
            let why = read(text).expect_err(text).to_string();
            assert!(why.contains(says), "{text}: {why}");
        }
        let build = |text: &str| build("one", &read(text).expect(text).choices);
        for (text, says) in [
            (
                "[design]\ncrescents = 9.5",
                "design.crescents: 9.5 is not usable: it has to be a whole number",
            ),
            ("[body]\nfriction_ratio = \"high\"", "number or \"facets\""),
            ("[design]\nalpha_deg = 12\ntan_alpha = 0.2", "set the same"),
            ("[design]\nbeta_deg = 90", "above 0 and below 90 deg"),
        ] {
            let why = build(text).expect_err(text).to_string();
            assert!(why.contains(says), "{text}: {why}");
        }
        let why = super::build("two", &[]).expect_err("no body").to_string();
        assert!(why.contains("choose one, rig, tube"), "{why}");
    }
}
