//! `move`: moves the rig to a position.

use client::error::ClientError;
use client::{Unobserved, decimal};
use lab::operations::arguments::MoveArgs;
use lab::operations::connector::LinkPurpose;
use lab::operations::ending::{cut_short, millimetres};
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::operations::reached::is_there;
use protocol::rig::{self, RunOutcome};
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::fresh;
use crate::cli::screen::Screen;

pub(crate) fn move_to(
    args: &MoveArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig, LinkPurpose::Own("move"))?;
    fresh::prepare(DeviceKind::Rig, &mut rig, finder, screen)?;
    let accepted = match rig.call(rig::MoveTo {
        position_um: args.position_mm.0,
        speed_um_s: args.speed_mm_s.0,
    }) {
        Err(error) if is_there(&error) => {
            let status = rig.rig_status()?;
            screen.say(&format!(
                "The carriage is at {} mm already; nothing moved.",
                millimetres(&status)
            ));
            return Ok(json!({ "already": true, "status": status }));
        }
        // If the move has begun, it brakes.
        Err(ClientError::Interrupted { .. }) => {
            let status = rig.wait_rest(&mut Unobserved)?;
            return Err(cut_short("the move", &rig, &status));
        }
        accepted => accepted?,
    };
    screen.say(&format!(
        "{} steps in {} s, {} mm/s at most.",
        accepted.stroke.steps,
        decimal::seconds(accepted.stroke.duration_ticks),
        decimal::write(accepted.stroke.peak_um_s.into(), 3),
    ));
    let (outcome, status) = rig.wait_move(&accepted, &mut Unobserved)?;
    if outcome != RunOutcome::Complete {
        return Err(cut_short("the move", &rig, &status));
    }
    screen.say(&format!("The carriage is at {} mm.", millimetres(&status)));
    Ok(json!({ "accepted": accepted, "status": status }))
}
