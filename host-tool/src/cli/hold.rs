//! `hold` and `resume`: pauses a run and continues it.

use lab::operations::connector::LinkPurpose;
use lab::operations::ending::{held, millimetres};
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use protocol::rig;
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

pub(crate) fn hold(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let status = held(&mut finder.connect(DeviceKind::Rig, LinkPurpose::Observe)?)?;
    screen.say(&format!(
        "Held at {} mm; `retrograde resume` continues the run, `retrograde stop` ends it.",
        millimetres(&status)
    ));
    Ok(json!({ "held": true, "status": status }))
}

pub(crate) fn resume(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig, LinkPurpose::Observe)?;
    rig.call(rig::Resume)?;
    let status = rig.rig_status()?;
    screen.say(&format!(
        "The run continues from {} mm. Its link-loss policy still applies: with `stop`, it stops when it does not hear a host.",
        millimetres(&status)
    ));
    Ok(json!({ "resumed": true, "status": status }))
}
