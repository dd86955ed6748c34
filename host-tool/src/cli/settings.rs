//! Commands for the settings and the name of a machine. None writes to flash while the machine moves.

mod import;
mod values;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use client::{Device, identity};
use lab::operations::arguments::MachineKind;
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use protocol::settings::{FactoryReset, GetName, GetSetting, Name, Setting, SettingKey};
use protocol::system::DeviceKind;
use serde::Serialize;
use serde_json::{Value, json};

use crate::cli::calculation::Named;
use crate::cli::screen::Screen;
use crate::cli::settings::values::{Key, checked_name, value_of};

/// Subcommands of `settings`.
#[derive(Debug, clap::Subcommand)]
pub enum SettingsSubcommand {
    /// Show all settings with unit and range.
    List,
    /// Show one setting.
    Get {
        /// Its name.
        key: Key,
    },
    /// Change one setting and store it in flash. Refused while something moves.
    Set {
        /// Its name.
        key: Key,
        /// Its value, a whole number in the unit of its name.
        value: String,
    },
    /// Write all settings to a JSON file.
    Export {
        /// The file.
        file: PathBuf,
        /// Replace an existing file.
        #[arg(long)]
        force: bool,
    },
    /// Set all settings from a JSON file written by `export`, in its order.
    Import {
        /// The file.
        file: PathBuf,
    },
    /// Show the machine's name, or change it.
    Name {
        /// At most 24 bytes.
        name: Option<String>,
    },
    /// Set all settings and the name to their defaults.
    Reset {
        /// Do not ask for confirmation.
        #[arg(long)]
        yes: bool,
    },
}

/// Remedy for a name that a machine does not accept.
const NAME_HELP: &str = "use letters, digits and spaces, and shorten it to 24 letters; one that is not in ASCII counts as two or more";

/// Contents of a settings file.
#[derive(Debug, Serialize)]
struct Exported {
    name: String,
    settings: BTreeMap<String, u32>,
}

pub(crate) fn settings(
    of: Option<MachineKind>,
    subcommand: &SettingsSubcommand,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    // Check the arguments before searching for a machine.
    let kind = of.map_or(DeviceKind::Rig, DeviceKind::from);
    match subcommand {
        SettingsSubcommand::List => list(
            &mut finder.connect(kind, LinkPurpose::Observe)?,
            kind,
            screen,
        ),
        SettingsSubcommand::Get { key } => {
            let mut machine = finder.connect(owner(key.0, of)?, LinkPurpose::Observe)?;
            let value = machine.call(GetSetting { key: key.0 })?.value;
            screen.say(&value.to_string());
            Ok(json!({ key.0.name(): value }))
        }
        SettingsSubcommand::Set { key, value } => {
            let (key, value) = (key.0, value_of(key.0, value)?);
            let kind = owner(key, of)?;
            let mut machine = finder.connect(kind, LinkPurpose::Own("settings set"))?;
            let before = Basis::of(&mut machine, kind)?;
            let set = machine.call(Setting { key, value })?;
            screen.say(&format!("{} = {}", set.key.name(), set.value));
            before.tell_change(&mut machine, screen)?;
            Ok(json!({ set.key.name(): set.value }))
        }
        SettingsSubcommand::Export { file, force } => export(file, *force, kind, finder, screen),
        SettingsSubcommand::Import { file } => {
            let wanted = import::read(file, kind)?;
            let mut machine = finder.connect(kind, LinkPurpose::Own("settings import"))?;
            let before = Basis::of(&mut machine, kind)?;
            let changed = import::import(&mut machine, kind, file, wanted)?;
            for change in &changed {
                screen.say(change);
            }
            screen.say(&format!("{} settings changed", changed.len()));
            before.tell_change(&mut machine, screen)?;
            Ok(json!({ "changed": changed.len() }))
        }
        SettingsSubcommand::Name { name: None } => {
            let name = finder
                .connect(kind, LinkPurpose::Observe)?
                .call(GetName)?
                .name;
            screen.say(&name);
            Ok(json!({ "name": name.as_str() }))
        }
        SettingsSubcommand::Name { name: Some(name) } => {
            let name = checked_name(name).map_err(|why| Failure::input(why, NAME_HELP))?;
            let name = finder
                .connect(kind, LinkPurpose::Own("settings name"))?
                .call(Name { name })?;
            screen.say(&name.name);
            Ok(json!({ "name": name.name.as_str() }))
        }
        SettingsSubcommand::Reset { yes } => {
            let question = format!(
                "All settings of the {} go back to their defaults, and its name is removed.",
                identity::kind_name(kind)
            );
            if !yes && !screen.confirms(&question) {
                return Err(Failure::refused(
                    "a reset was not confirmed; nothing was changed",
                    match kind {
                        DeviceKind::Capsule => "`retrograde settings export --of capsule FILE` keeps what is there; then `retrograde settings reset --of capsule --yes`",
                        _ => "`retrograde settings export FILE` keeps what is there; then `retrograde settings reset --yes`",
                    }
                    .to_owned(),
                ));
            }
            let mut machine = finder.connect(kind, LinkPurpose::Own("settings reset"))?;
            let before = Basis::of(&mut machine, kind)?;
            machine.call(FactoryReset)?;
            screen.say("all settings and the name are at their defaults");
            before.tell_change(&mut machine, screen)?;
            Ok(json!({ "reset": true }))
        }
    }
}

/// The basis of a position: a rig's reference, or the force to which a capsule was calibrated.
enum Basis {
    Rig { homed: bool },
    Capsule { end_force_ma: u32 },
}

impl Basis {
    fn of(machine: &mut Device, kind: DeviceKind) -> Result<Self, Failure> {
        Ok(match kind {
            DeviceKind::Rig => Self::Rig {
                homed: machine.rig_status()?.homed,
            },
            DeviceKind::Capsule => {
                let key = SettingKey::EndForceMa;
                Self::Capsule {
                    end_force_ma: machine.call(GetSetting { key })?.value,
                }
            }
        })
    }

    /// Prints what to do if a change has invalidated it.
    fn tell_change(self, machine: &mut Device, screen: &mut Screen<'_>) -> Result<(), Failure> {
        match self {
            Self::Rig { homed } if homed && !machine.rig_status()?.homed => {
                screen.hint("positions mean something else now: `retrograde home`");
            }
            Self::Capsule { end_force_ma } => {
                let key = SettingKey::EndForceMa;
                if machine.call(GetSetting { key })?.value != end_force_ma {
                    screen.hint(
                        "the calibration was made with another end force: `retrograde unfold`, then `retrograde capsule calibrate`",
                    );
                }
            }
            Self::Rig { .. } => {}
        }
        Ok(())
    }
}

fn export(
    file: &Path,
    force: bool,
    kind: DeviceKind,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let [named] = Named::all([Some(file)], force)?;
    let exported = exported(&mut finder.connect(kind, LinkPurpose::Observe)?, kind)?;
    let text = serde_json::to_string_pretty(&exported).unwrap_or_default() + "\n";
    if let Some(named) = named {
        named.write(|out| out.write_all(text.as_bytes()))?;
    }
    screen.say(&format!(
        "{} settings in {}",
        exported.settings.len(),
        file.display()
    ));
    Ok(json!(exported))
}

fn list(rig: &mut Device, kind: DeviceKind, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let exported = exported(rig, kind)?;
    screen.say(&format!("name: {}", exported.name));
    for key in SettingKey::of(kind) {
        let value = exported.settings.get(key.name()).copied().unwrap_or(0);
        let range = key.range();
        let note = if value == range.default {
            String::new()
        } else {
            format!(", default {}", range.default)
        };
        screen.say(&format!(
            "{:<20} {value:>10} {:<10} {} to {}{note}",
            key.name(),
            key.unit(),
            range.min,
            range.max
        ));
    }
    Ok(json!(exported))
}

fn exported(rig: &mut Device, kind: DeviceKind) -> Result<Exported, Failure> {
    let name = rig.call(GetName)?.name.as_str().to_owned();
    let settings = rig.settings(kind)?;
    Ok(Exported { name, settings })
}

/// The machine that a setting belongs to: the named one, else the only one that has it, else the rig.
fn owner(key: SettingKey, of: Option<MachineKind>) -> Result<DeviceKind, Failure> {
    let kinds = [DeviceKind::Rig, DeviceKind::Capsule];
    let named = of.map(DeviceKind::from);
    let owner = kinds
        .into_iter()
        .find(|kind| key.is_of(*kind) && named.is_none_or(|named| named == *kind));
    owner.ok_or_else(|| {
        Failure::input(
            format!("{} is not a setting of this machine", key.name()),
            "nothing was sent; leave `--of` away",
        )
    })
}
