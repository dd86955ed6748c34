//! Commands for the rig's settings and its name. Nothing is written to flash while something moves.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use protocol::settings::{FactoryReset, GetName, GetSetting, MAX_NAME, Name, Setting, SettingKey};
use protocol::system::DeviceKind;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::cli::args::SettingsCommand;
use crate::cli::failure::Failure;
use crate::cli::finding::Finder;
use crate::cli::screen::Screen;
use crate::client::Device;
use crate::error::ClientError;

/// Settings as a file.
#[derive(Debug, Serialize, Deserialize)]
struct Exported {
    name: String,
    settings: BTreeMap<String, u32>,
}

pub(crate) fn settings(
    command: &SettingsCommand,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    // What is wrong with the words is said before a machine is looked for.
    let imported = match command {
        SettingsCommand::Import { file } => Some(read(file)?),
        _ => None,
    };
    let mut rig = finder.connect(DeviceKind::Rig)?;
    match command {
        SettingsCommand::List => list(&mut rig, screen),
        SettingsCommand::Get { key } => {
            let value = rig.call(GetSetting { key: key.0 })?.value;
            screen.say(&value.to_string());
            Ok(json!({ key.0.name(): value }))
        }
        SettingsCommand::Set { key, value } => {
            let setting = Setting {
                key: key.0,
                value: *value,
            };
            let set = rig.call(setting)?;
            screen.say(&format!("{} = {}", set.key.name(), set.value));
            Ok(json!({ set.key.name(): set.value }))
        }
        SettingsCommand::Export { file } => {
            let exported = exported(&mut rig)?;
            let text = serde_json::to_string_pretty(&exported).unwrap_or_default() + "\n";
            fs::write(file, text).map_err(|io| Failure::File {
                path: file.clone(),
                io,
            })?;
            screen.say(&format!(
                "{} settings in {}",
                exported.settings.len(),
                file.display()
            ));
            Ok(json!(exported))
        }
        SettingsCommand::Import { .. } => {
            let (name, wanted) = imported.unwrap_or_default();
            let changed = import(&mut rig, &wanted)?;
            if rig.call(GetName)?.name != name {
                rig.call(Name { name })?;
            }
            screen.say(&format!("{changed} settings changed"));
            Ok(json!({ "changed": changed }))
        }
        SettingsCommand::Name { name: None } => {
            let name = rig.call(GetName)?.name;
            screen.say(&name);
            Ok(json!({ "name": name.as_str() }))
        }
        SettingsCommand::Name { name: Some(name) } => {
            let name = rig.call(Name {
                name: checked_name(name)?,
            })?;
            screen.say(&name.name);
            Ok(json!({ "name": name.name.as_str() }))
        }
        SettingsCommand::Reset => {
            rig.call(FactoryReset)?;
            screen.say("all settings and the name are at their defaults");
            Ok(json!({ "reset": true }))
        }
    }
}

fn list(rig: &mut Device, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let exported = exported(rig)?;
    screen.say(&format!("name: {}", exported.name));
    for key in SettingKey::ALL {
        let value = exported.settings.get(key.name()).copied().unwrap_or(0);
        let range = key.range();
        let note = if value == range.default {
            String::new()
        } else {
            format!(", default {}", range.default)
        };
        screen.say(&format!(
            "{:<20} {value:>10} {:<10} {}..={}{note}",
            key.name(),
            key.unit(),
            range.min,
            range.max
        ));
    }
    Ok(json!(exported))
}

fn exported(rig: &mut Device) -> Result<Exported, Failure> {
    let name = rig.call(GetName)?.name.as_str().to_owned();
    let mut settings = BTreeMap::new();
    for key in SettingKey::ALL {
        let value = rig.call(GetSetting { key })?.value;
        settings.insert(key.name().to_owned(), value);
    }
    Ok(Exported { name, settings })
}

type Wanted = (heapless::String<MAX_NAME>, Vec<Setting>);

fn read(file: &Path) -> Result<Wanted, Failure> {
    let text = fs::read_to_string(file).map_err(|io| Failure::Input {
        why: format!("{}: {io}", file.display()),
        help: "give a file that `retrograde settings export` wrote".to_owned(),
    })?;
    let exported: Exported = serde_json::from_str(&text).map_err(|error| Failure::Input {
        why: format!("{}: {error}", file.display()),
        help: "give a file that `retrograde settings export` wrote".to_owned(),
    })?;
    let wanted = exported.settings.iter().map(|(name, value)| {
        let key = key_of(name).map_err(|why| Failure::Input {
            why: format!("{}: {why}", file.display()),
            help: "remove the line, or use the host tool that wrote it".to_owned(),
        })?;
        Ok(Setting { key, value: *value })
    });
    Ok((
        checked_name(&exported.name)?,
        wanted.collect::<Result<_, Failure>>()?,
    ))
}

/// Each value is checked against the others at every moment: what is refused is tried again after the rest, as
/// long as that helps.
fn import(rig: &mut Device, wanted: &[Setting]) -> Result<usize, Failure> {
    let mut left = vec![];
    for setting in wanted {
        if rig.call(GetSetting { key: setting.key })?.value != setting.value {
            left.push(*setting);
        }
    }
    let changed = left.len();
    while !left.is_empty() {
        let mut refused = vec![];
        let mut why = None;
        let before = left.len();
        for setting in left {
            match rig.call(setting) {
                Ok(_) => {}
                Err(error @ ClientError::Refused { .. }) => {
                    refused.push(setting);
                    why = Some(error);
                }
                Err(error) => return Err(error.into()),
            }
        }
        if let Some(error) = why.filter(|_| refused.len() == before) {
            return Err(error.into());
        }
        left = refused;
    }
    Ok(changed)
}

fn checked_name(name: &str) -> Result<heapless::String<MAX_NAME>, Failure> {
    name.try_into().map_err(|_| Failure::Input {
        why: format!("the name has {} bytes", name.len()),
        help: format!("use at most {MAX_NAME} bytes"),
    })
}

/// The key with this name.
pub(crate) fn key_of(name: &str) -> Result<SettingKey, String> {
    SettingKey::ALL
        .into_iter()
        .find(|key| key.name() == name)
        .ok_or_else(|| {
            format!("there is no setting `{name}`: `retrograde settings list` shows all")
        })
}
