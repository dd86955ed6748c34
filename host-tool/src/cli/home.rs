//! `home`: finds the rig's position.

use lab::operations::connector::LinkPurpose;
use lab::operations::ending::homed_text;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::operations::panel::SETTINGS_UNUSABLE;
use lab::trials::experiment;
use protocol::rig::RigEvent;
use protocol::system::{DeviceKind, What};
use serde_json::{Value, json};

use crate::cli::screen::Screen;

pub(crate) fn home(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig, LinkPurpose::Own("home"))?;
    // Homing is the first motion after a start, so show the reason of that start.
    let (kept, _) = rig.kept_events()?;
    let last = kept.iter().rev().find_map(|event| match event.what {
        What::Rig(event) => matches!(
            event,
            RigEvent::SettingsUnusable | RigEvent::SettingChanged(_) | RigEvent::SettingsReset
        )
        .then_some(event),
        _ => None,
    });
    if last == Some(RigEvent::SettingsUnusable) {
        screen.hint(&format!(
            "{SETTINGS_UNUSABLE}; `retrograde settings list` shows what counts; `retrograde settings reset`, then `retrograde settings import FILE`, replaces them"
        ));
    }
    let homed = experiment::home(&mut rig, &mut screen.live())?;
    screen.say(&homed_text(&homed));
    Ok(json!({ "homed": homed }))
}
