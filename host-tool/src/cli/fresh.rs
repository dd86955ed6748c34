//! Prepares virtual machines. A machine on the virtual bench exists for one command only, so it is neither homed nor
//! referenced. Commands that need this do it first. A real machine never moves without an order.

use client::Device;
use client::address::Address;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::trials::experiment;
use protocol::system::DeviceKind;

use crate::cli::screen::Screen;
use lab::operations::ending::homed_text;

/// Homes a new virtual rig or references a new virtual capsule.
pub(crate) fn prepare(
    kind: DeviceKind,
    device: &mut Device,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<(), Failure> {
    let created_on_open = |address: &Address| finder.connector.is_created_on_open(address);
    if !finder.address(kind).is_some_and(created_on_open) {
        return Ok(());
    }
    match kind {
        DeviceKind::Rig if !device.rig_status()?.homed => {
            screen.say("The virtual rig is made for this command and is new: it homes first.");
            let homed = experiment::home(device, &mut screen.live())?;
            screen.say(&homed_text(&homed));
        }
        DeviceKind::Capsule if !device.capsule_status()?.referenced => {
            screen.say(
                "The virtual capsule is made for this command and is new: it is referenced first.",
            );
            let accepted = device.reference()?;
            device.wait_actuation(&accepted, &mut screen.live())?;
        }
        DeviceKind::Rig | DeviceKind::Capsule => {}
    }
    Ok(())
}
