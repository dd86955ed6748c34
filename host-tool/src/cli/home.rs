//! `home`: finds the rig's position.

use client::decimal;
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

/// The result of homing in one line.
#[must_use]
pub(crate) fn homed_text(homed: &client::Homed) -> String {
    format!(
        "Homed in {} s; the two passes differ by {} steps, the reference moved by {} steps.",
        decimal::write(homed.duration_us / 1_000, 3),
        homed.repeat_steps,
        homed.shift_steps
    )
}
