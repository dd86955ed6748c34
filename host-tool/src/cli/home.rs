//! `home`: finds the rig's position.

use operations::ending::homed_text;
use operations::failure::Failure;
use operations::places::{Need, Places};
use protocol::system::DeviceKind;
use serde_json::{Value, json};
use trials::experiment;

use crate::cli::screen::Screen;

pub(crate) fn home(places: &Places<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = places.connect(DeviceKind::Rig, Need::Own("home"))?;
    let homed = experiment::home(&mut rig, &mut screen.live())?;
    screen.say(&homed_text(&homed));
    Ok(json!({ "homed": homed }))
}
