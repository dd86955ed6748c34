//! The model's options: `--body`, `--model`, and `--set` for the parameters in the table of the model. The option that
//! each parameter had before is hidden, and still understood for one version.

use std::fs;
use std::path::PathBuf;
use std::sync::LazyLock;

use clap::error::ErrorKind;
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches};
use lab::operations::failure::Failure;
use locomotion::model::{Model, Setting};
use report::science::model_file::{self, Choice, Given, ModelError};
use report::science::posterior::Posterior;

/// A model as given by options.
#[derive(Clone, Debug, Default)]
pub struct ModelArgs {
    body: Option<String>,
    file: Option<PathBuf>,
    choices: Vec<Choice>,
}

/// All parameters with the names of their hidden options, built once: the command line keeps references to them.
static PARAMETERS: LazyLock<Vec<(&'static Setting, String)>> = LazyLock::new(|| {
    Setting::all()
        .map(|setting| (setting, hidden_option(setting)))
        .collect()
});

/// Name of a parameter's hidden option. Drops the section for parameters of the body and its design.
fn hidden_option(setting: &Setting) -> String {
    let (section, name) = setting.key.split_once('.').unwrap_or(("", setting.key));
    let name = name.replace('_', "-");
    match section {
        "design" | "body" => name,
        _ => format!("{section}-{name}"),
    }
}

const HEADING: &str = "Model (`--help` lists all its parameters)";
const SET: &str = "model-set";
const SET_HELP: &str =
    "Sets a parameter of the model, as in `--set body.coupling=0.2`; may be repeated";

/// Help of `--set` with a line for each parameter.
fn all_parameters() -> String {
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
    format!("{SET_HELP}:{lines}")
}

/// Reads `KEY=VALUE`.
fn choice_of(text: &str) -> Result<Choice, String> {
    let (key, value) = text
        .split_once('=')
        .ok_or("give it as KEY=VALUE: body.coupling=0.2")?;
    let setting = Setting::named(key.trim())
        .ok_or_else(|| ModelError::Unknown(key.trim().to_owned()).to_string())?;
    Ok((setting, Given::from(value.trim())))
}

fn argument(id: &'static str, help: String) -> Arg {
    Arg::new(id)
        .global(true)
        .help_heading(HEADING)
        .help(help)
        .allow_hyphen_values(true)
}

impl Args for ModelArgs {
    fn augment_args(command: Command) -> Command {
        let body = argument(
            "model-body",
            format!(
                "The body to begin with: {}; `one` by default",
                model_file::names()
            ),
        );
        let file = argument(
            "model-file",
            "A file of parameters, as `simulate` writes it: model.toml".to_owned(),
        );
        let set = argument(SET, SET_HELP.to_owned())
            .long_help(all_parameters())
            .action(ArgAction::Append)
            .value_parser(choice_of);
        let command = command
            .arg(body.long("body").value_name("NAME"))
            .arg(
                file.long("model")
                    .value_name("FILE")
                    .value_parser(clap::value_parser!(PathBuf)),
            )
            .arg(set.long("set").value_name("KEY=VALUE"));
        PARAMETERS
            .iter()
            .fold(command, |command, (setting, option)| {
                command.arg(
                    argument(setting.key, setting.meaning.to_owned())
                        .long(option.as_str())
                        .value_name("VALUE")
                        .hide(true),
                )
            })
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for ModelArgs {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let text = |id: &str| matches.get_one::<String>(id);
        let hidden = Setting::all()
            .filter_map(|setting| Some((setting, Given::from(text(setting.key)?.as_str()))));
        let set = matches.get_many::<Choice>(SET).into_iter().flatten();
        let choices: Vec<Choice> = set.cloned().chain(hidden).collect();
        for (index, (setting, _)) in choices.iter().enumerate() {
            let again = |(other, _): &Choice| other.key == setting.key;
            if choices[..index].iter().any(again) {
                let why = format!("{} is set twice: leave one of them out\n", setting.key);
                return Err(clap::Error::raw(ErrorKind::ArgumentConflict, why));
            }
        }
        Ok(Self {
            body: text("model-body").cloned(),
            file: matches.get_one("model-file").cloned(),
            choices,
        })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl ModelArgs {
    /// The arguments of a file alone, if there is one.
    pub fn of_file(file: Option<PathBuf>) -> Self {
        Self {
            file,
            ..Self::default()
        }
    }

    /// Builds the model: the body, overridden by the file, overridden by the options.
    ///
    /// # Errors
    /// The file cannot be read or used, a value is impossible, or the model is out of range.
    pub fn model(&self) -> Result<Model, Failure> {
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
        if let Some(posterior) = &file.posterior {
            let fitted = |key: &str| posterior.of_body().iter().any(|of| of == key);
            if let Some((setting, _)) = self.choices.iter().find(|(set, _)| fitted(set.key)) {
                return Err(self.failure(&ModelError::Fitted(setting.key)));
            }
        }
        Ok(model)
    }

    /// The posterior in the file, if it has one.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn posterior(&self) -> Result<Option<Posterior>, Failure> {
        Ok(self.read()?.posterior)
    }

    /// The value given for a parameter, by an option or else by the file.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn number(&self, key: &str) -> Result<Option<f64>, Failure> {
        let file = self.read()?;
        let mut all = self.choices.iter().chain(&file.choices);
        Ok(all.find_map(|(setting, given)| match given {
            Given::Number(number) if setting.key == key => Some(*number),
            _ => None,
        }))
    }

    /// A file was given.
    pub fn has_file(&self) -> bool {
        self.file.is_some()
    }

    /// An option gives this parameter.
    pub fn names(&self, key: &str) -> bool {
        self.choices.iter().any(|(setting, _)| setting.key == key)
    }

    /// The first of these options on the command line.
    pub fn first(&self) -> Option<String> {
        let body = self.body.as_ref().map(|_| "--body".to_owned());
        let file = || self.file.as_ref().map(|_| "--model".to_owned());
        let choice = || {
            let (setting, _) = self.choices.first()?;
            Some(format!("--set {}", setting.key))
        };
        body.or_else(file).or_else(choice)
    }

    fn read(&self) -> Result<model_file::ModelFile, Failure> {
        let Some(path) = &self.file else {
            return Ok(model_file::ModelFile::default());
        };
        let text = fs::read_to_string(path).map_err(|io| {
            Failure::input(
                format!("{}: {io}", path.display()),
                "`--model FILE` takes a model as TOML, such as the `model.toml` of `retrograde fit`",
            )
        })?;
        model_file::read(&text).map_err(|error| self.failure(&error))
    }

    fn built(&self, body: &str, file: &[Choice]) -> Result<Model, Failure> {
        // Build from the file alone first, so that its own contradictions are reported as the file's.
        model_file::build(body, file).map_err(|error| self.failure(&error))?;
        model_file::build(body, &self.choices).map_err(|error| self.failure(&error))?;
        // An option overrides the file's value for the same quantity, however the file states it.
        let outweighed = |setting: &Setting| {
            self.names(setting.key) || setting.other_key().is_some_and(|key| self.names(key))
        };
        let kept = file.iter().filter(|(setting, _)| !outweighed(setting));
        let all: Vec<_> = kept.chain(&self.choices).cloned().collect();
        model_file::build(body, &all).map_err(|error| self.failure(&error))
    }

    fn failure(&self, error: &ModelError) -> Failure {
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
