//! Imports settings from a file: all of them or none. Checks the whole file first. Only the rig knows which values
//! are valid together; if it refuses one, the import restores those already changed.

use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;
use std::sync::Arc;

use client::error::ClientError;
use client::limited::{self, BY_HAND};
use client::wording::word;
use client::{Device, identity, wording};
use lab::operations::failure::Failure;
use protocol::settings::{GetName, GetSetting, MAX_NAME, Name, Setting};
use protocol::system::DeviceKind;
use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use serde_json::Value;

use crate::cli::failure::Own;
use crate::cli::settings::values::{Key, checked_name, value_of};

/// The file. Unknown and repeated fields are errors.
#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    name: Value,
    settings: Pairs,
}

/// The members of an object, including repeated ones, which a map would drop.
struct Pairs(Vec<(String, Value)>);

impl<'de> Deserialize<'de> for Pairs {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Members;
        impl<'de> Visitor<'de> for Members {
            type Value = Pairs;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the object `settings` of names and whole numbers")
            }
            fn visit_map<M: MapAccess<'de>>(self, mut map: M) -> Result<Pairs, M::Error> {
                let mut pairs = vec![];
                while let Some(pair) = map.next_entry()? {
                    pairs.push(pair);
                }
                Ok(Pairs(pairs))
            }
        }
        deserializer.deserialize_map(Members)
    }
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

/// A setting or the name, with its value.
enum Entry {
    Setting(Setting),
    Name(heapless::String<MAX_NAME>),
}

impl Entry {
    fn name(&self) -> &'static str {
        match self {
            Self::Setting(setting) => setting.key.name(),
            Self::Name(_) => "name",
        }
    }

    fn write(&self, rig: &mut Device) -> Result<(), ClientError> {
        match self {
            Self::Setting(setting) => rig.call(*setting).map(drop),
            Self::Name(name) => rig.call(Name { name: name.clone() }).map(drop),
        }
    }
}

impl fmt::Display for Entry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Setting(setting) => write!(f, "{}", setting.value),
            Self::Name(name) => write!(f, "{name:?}"),
        }
    }
}

struct Change {
    from: Entry,
    to: Entry,
}

/// Changes made by an import.
pub(super) struct Imported {
    /// Number of settings.
    pub(super) changed: usize,
    /// The name before and after, if they differ.
    pub(super) renamed: Option<(String, String)>,
}

/// Sets the values that differ.
///
/// # Errors
/// [`Own::Import`], which lists the changes that could not be undone.
pub(super) fn import(
    rig: &mut Device,
    machine: DeviceKind,
    file: &Path,
    wanted: Wanted,
) -> Result<Imported, Failure> {
    let mut changes = vec![];
    for to in wanted.settings {
        let from = rig.call(GetSetting { key: to.key })?;
        if from != to {
            let (from, to) = (Entry::Setting(from), Entry::Setting(to));
            changes.push(Change { from, to });
        }
    }
    let changed = changes.len();
    let name = rig.call(GetName)?.name;
    let differs = name != wanted.name;
    let renamed = differs.then(|| (name.to_string(), wanted.name.to_string()));
    if differs {
        let (from, to) = (Entry::Name(name), Entry::Name(wanted.name));
        changes.push(Change { from, to });
    }
    let mut done = vec![];
    match apply(rig, changes, &mut done) {
        Ok(()) => Ok(Imported { changed, renamed }),
        Err((setting, cause)) => Err(Own::Import {
            machine,
            file: file.to_owned(),
            setting,
            cause: Box::new(cause),
            changed: put_back(rig, done),
        }
        .into()),
    }
}

/// Sets the values in passes. The rig checks each against the others that it holds at the time, so a refused value is
/// tried again after the rest, until a pass changes nothing.
fn apply(
    rig: &mut Device,
    mut left: Vec<Change>,
    done: &mut Vec<Change>,
) -> Result<(), (&'static str, ClientError)> {
    while !left.is_empty() {
        let (count, mut refused, mut why) = (left.len(), vec![], None);
        for change in left {
            let name = change.to.name();
            match change.to.write(rig) {
                Ok(()) => done.push(change),
                Err(error @ ClientError::Refused { .. }) => {
                    refused.push(change);
                    why.get_or_insert((name, error));
                }
                Err(error) => {
                    // The rig may have changed it, so it must be undone, too.
                    done.push(change);
                    return Err((name, error));
                }
            }
        }
        if let Some(why) = why.filter(|_| refused.len() == count) {
            return Err(why);
        }
        left = refused;
    }
    Ok(())
}

/// Undoes the changes in reverse order, so that the rig only meets combinations that it has accepted before. Returns
/// the changes that remain. If a stop has interrupted the import, it is confirmed first; then the changes are undone all
/// the same.
fn put_back(rig: &mut Device, done: Vec<Change>) -> Vec<String> {
    let mut changed = vec![];
    if rig.settle().is_ok() {
        rig.set_interrupt(Arc::new(|| None));
        rig.forget_stop();
    }
    for Change { from, to } in done.into_iter().rev() {
        if from.write(rig).is_err() {
            changed.push(format!("{} from {from} to {to}", to.name()));
        }
    }
    changed.reverse();
    changed
}
