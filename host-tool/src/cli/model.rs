//! The model's options: `--body`, `--model`, and `--set` for the parameters in the table of the model.

use std::path::PathBuf;
use std::sync::LazyLock;

use clap::Args;
use client::limited;
use lab::operations::failure::Failure;
use locomotion::model::{Model, Setting};
use report::science::model_file::{self, Choice, Given, ModelError, ModelFile};

/// A model as given by options.
#[derive(Clone, Debug, Default, Args)]
#[command(next_help_heading = "Model (`--help` lists all its parameters)")]
pub struct ModelArgs {
    /// The body to start from: one, rig or tube; `one` by default.
    #[arg(long, global = true, value_name = "NAME")]
    body: Option<String>,
    /// A file of parameters, as `simulate` writes it: model.toml.
    #[arg(id = "model", long = "model", global = true, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Sets a parameter of the model, as in `--set body.coupling=0.2`; may be repeated.
    #[arg(id = "set", long = "set", global = true, value_name = "KEY=VALUE", value_parser = choice_of,
        allow_hyphen_values = true, long_help = ALL_PARAMETERS.as_str())]
    choices: Vec<Choice>,
}

/// Help of `--set` with a line for each parameter.
static ALL_PARAMETERS: LazyLock<String> = LazyLock::new(|| {
    let width = Setting::all().map(|setting| setting.key.len()).max();
    let width = width.unwrap_or(0);
    let line = |setting: &Setting| {
        let unit = match setting.unit {
            "" => String::new(),
            unit => format!(", {unit}"),
        };
        format!("\n  {:<width$}  {}{unit}", setting.key, setting.meaning)
    };
    let lines: String = Setting::all().map(line).collect();
    format!(
        "Sets a parameter of the model, as in `--set body.coupling=0.2`; may be repeated:{lines}"
    )
});

/// Splits `KEY=VALUE` into the parameter and its value.
pub(crate) fn key_and_value(text: &str) -> Result<(&'static Setting, &str), String> {
    let (key, value) = text
        .split_once('=')
        .ok_or("give it as KEY=VALUE: body.coupling=0.2")?;
    let setting = Setting::named(key.trim())
        .ok_or_else(|| ModelError::Unknown(key.trim().to_owned()).to_string())?;
    Ok((setting, value.trim()))
}

fn choice_of(text: &str) -> Result<Choice, String> {
    let (setting, value) = key_and_value(text)?;
    Ok((setting, Given::from(value)))
}

impl ModelArgs {
    /// Arguments with only a file, if there is one.
    pub fn of_file(file: Option<PathBuf>) -> Self {
        Self {
            file,
            ..Self::default()
        }
    }

    /// Builds the model: the body, overridden by the file, overridden by the options.
    pub fn model(&self) -> Result<Model, Failure> {
        for (index, (setting, _)) in self.choices.iter().enumerate() {
            if self.choices[..index]
                .iter()
                .any(|(other, _)| other.key == setting.key)
            {
                return Err(Failure::input(
                    format!("{} is set twice", setting.key),
                    "leave one of them out",
                ));
            }
        }
        let file = self.read()?;
        let body = match (&self.body, &file.body) {
            (Some(asked), Some(written)) if asked != written => {
                return Err(Failure::input(
                    format!("--body says {asked}, the file of --model says {written}"),
                    "leave one of them out: the file's values belong to its body",
                ));
            }
            (Some(body), _) | (None, Some(body)) => body,
            (None, None) => Model::ONE.name,
        };
        let model = self.built(body, &file.choices)?;
        model.check()?;
        Ok(model)
    }

    /// Whether an option sets this parameter, by this key or by another key for the same quantity.
    pub fn names(&self, setting: &Setting) -> bool {
        let keys = [Some(setting.key), setting.other_key()];
        (self.choices.iter()).any(|(chosen, _)| keys.contains(&Some(chosen.key)))
    }

    fn read(&self) -> Result<ModelFile, Failure> {
        let Some(path) = &self.file else {
            return Ok(ModelFile::default());
        };
        let text = limited::read_text(path, limited::BY_HAND).map_err(|io| {
            Failure::input(
                format!("{}: {io}", path.display()),
                "`--model FILE` takes a model as TOML, such as the `model.toml` of `retrograde simulate`",
            )
        })?;
        model_file::read(&text).map_err(|error| self.failure(&error))
    }

    fn built(&self, body: &str, file: &[Choice]) -> Result<Model, Failure> {
        // Build from the file alone first, so that its own contradictions are reported as the file's.
        let build = |choices: &[Choice]| {
            model_file::build(body, choices).map_err(|error| self.failure(&error))
        };
        build(file)?;
        build(&self.choices)?;
        // An option overrides the file's value for the same quantity, however the file states it.
        let kept = file.iter().filter(|(setting, _)| !self.names(setting));
        build(&kept.chain(&self.choices).cloned().collect::<Vec<_>>())
    }

    /// The failure for a model that cannot be built.
    pub(crate) fn failure(&self, error: &ModelError) -> Failure {
        let help = match &self.file {
            Some(path) => format!(
                "in {} or in the options; `retrograde simulate pressure --help` lists the parameters",
                path.display()
            ),
            None => "`retrograde simulate pressure --help` lists the parameters".to_owned(),
        };
        Failure::input(format!("the model: {error}"), help)
    }
}
