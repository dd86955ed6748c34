//! Imports settings from a file: checks all of it first, then sets the values in the order of the file. Only the
//! machine knows which values are valid together.

use std::collections::BTreeSet;
use std::path::Path;

use client::error::ClientError;
use client::limited::{self, BY_HAND};
use client::pairs::Pairs;
use client::wording::word;
use client::{Device, identity, wording};
use lab::operations::failure::Failure;
use protocol::settings::{GetName, GetSetting, MAX_NAME, Name, Setting};
use protocol::system::DeviceKind;
use serde_json::Value;

use crate::cli::settings::values::{Key, checked_name, value_of};

/// The file. Unknown and repeated fields are errors.
#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    name: Value,
    settings: Pairs,
}

/// Settings requested by a file.
pub(super) struct Wanted {
    name: heapless::String<MAX_NAME>,
    settings: Vec<Setting>,
}

/// Reads and checks a file.
///
/// # Errors
/// [`Failure::Input`] with every mistake in the file.
pub(super) fn read(file: &Path, kind: DeviceKind) -> Result<Wanted, Failure> {
    let unusable = |why: String, help: &str| {
        Failure::input(
            format!("{}: {why}", file.display()),
            format!("nothing was sent; {help}"),
        )
    };
    let written = "give a file that `retrograde settings export` wrote";
    let text = limited::read_text(file, BY_HAND).map_err(|io| unusable(io.to_string(), written))?;
    let parsed: File = serde_json::from_str(&text)
        .map_err(|error| unusable(wording::unreadable(&error), written))?;
    let mut wrong = vec![];
    let name = match &parsed.name {
        Value::String(name) => checked_name(name),
        other => Err(format!("name: {other} is not text")),
    };
    let name = name.unwrap_or_else(|why| {
        wrong.push(why);
        heapless::String::new()
    });
    let keys: Vec<_> = (parsed.settings.0.iter())
        .filter_map(|(name, _)| name.parse().ok())
        .collect();
    let other = match kind {
        DeviceKind::Rig => DeviceKind::Capsule,
        DeviceKind::Capsule => DeviceKind::Rig,
    };
    let foreign = keys.iter().any(|Key(key)| !key.is_of(kind));
    if foreign && keys.iter().all(|Key(key)| key.is_of(other)) {
        let (other, own) = (identity::kind_name(other), identity::kind_name(kind));
        return Err(unusable(
            format!("these are the settings of a {other}, not of a {own}"),
            &format!(
                "`retrograde settings --of {other} import {}` takes them",
                word(file)
            ),
        ));
    }
    let mut settings = vec![];
    let mut names = BTreeSet::new();
    for (name, value) in &parsed.settings.0 {
        if !names.insert(name) {
            wrong.push(format!("{name} appears twice"));
        }
        match name.parse() {
            Ok(Key(key)) if !key.is_of(kind) => {
                let [own, other] = [kind, other].map(identity::kind_name);
                wrong.push(format!(
                    "{name} is a setting of the {other}, and this file has some of the {own}: give each machine a file of \
                     its own, as `retrograde settings --of {other} export FILE` writes one"
                ));
            }
            Ok(Key(key)) => match value_of(key, &value.to_string()) {
                Ok(value) => settings.push(Setting { key, value }),
                Err(failure) => wrong.push(failure.to_string()),
            },
            Err(why) => wrong.push(why),
        }
    }
    if wrong.is_empty() {
        Ok(Wanted { name, settings })
    } else {
        Err(unusable(
            wrong.join("; "),
            "correct the file, or use the host tool that wrote it",
        ))
    }
}

/// Sets the values that differ, in the order of the file, and the name last. Returns the changes.
///
/// # Errors
/// The first refusal or loss of the line; its text names what was set before.
pub(super) fn import(
    machine: &mut Device,
    kind: DeviceKind,
    file: &Path,
    wanted: Wanted,
) -> Result<Vec<String>, Failure> {
    let mut done = vec![];
    let set = set(machine, wanted, &mut done);
    set.map_err(|(setting, cause)| {
        let before = match done.is_empty() {
            true => "nothing was changed before".to_owned(),
            false => format!("before it these were set: {}", done.join(", ")),
        };
        let name = identity::kind_name(kind);
        let help = format!(
            "`retrograde settings --of {name} list` shows what counts now; correct the file or its order, or remove the cause, then again: what is set stays. `retrograde info {name}` shows whether positions have to be found again"
        );
        let why = format!("{}: {setting}: {cause}; {before}", file.display());
        Failure::new("retrograde::import", cause.exit_code(), why, help)
    })?;
    Ok(done)
}

fn set(
    machine: &mut Device,
    wanted: Wanted,
    done: &mut Vec<String>,
) -> Result<(), (&'static str, ClientError)> {
    for to in wanted.settings {
        let failed = |error| (to.key.name(), error);
        let from = machine
            .call(GetSetting { key: to.key })
            .map_err(failed)?
            .value;
        if from != to.value {
            machine.call(to).map_err(failed)?;
            done.push(format!("{} from {from} to {}", to.key.name(), to.value));
        }
    }
    let failed = |error| ("name", error);
    let from = machine.call(GetName).map_err(failed)?.name;
    if from != wanted.name {
        let name = wanted.name.clone();
        machine.call(Name { name }).map_err(failed)?;
        done.push(format!("name from {from:?} to {:?}", wanted.name));
    }
    Ok(())
}
