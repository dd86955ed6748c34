//! Commands that move the rig outside a recorded run, or hold one: hold, resume, jog, move, health.

use protocol::rig::{self, RigHealth, RigStatus, Sense};
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::args::{JogArgs, MoveArgs, Way};
use crate::cli::failure::Failure;
use crate::cli::finding::Finder;
use crate::cli::screen::Screen;
use crate::decimal;

/// A jog is renewed this often; the default dead-man time is 300 ms.
const RENEW_US: u64 = 100_000;

pub(crate) fn hold(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    rig.call(rig::Hold)?;
    let status = rig.wait_rest()?;
    screen.say(&format!(
        "Held at {} mm; `retrograde resume` goes on, `retrograde stop` ends the run.",
        millimetres(&status)
    ));
    Ok(json!({ "held": true, "status": status }))
}

pub(crate) fn resume(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    rig.call(rig::Resume)?;
    let status = rig.rig_status()?;
    screen.say(&format!(
        "The run goes on from {} mm. Its link-loss policy holds: if it is `stop`, it stops when nobody listens.",
        millimetres(&status)
    ));
    Ok(json!({ "resumed": true, "status": status }))
}

pub(crate) fn jog(
    args: &JogArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    let jog = rig::Jog {
        sense: match args.way {
            Way::Away => Sense::Away,
            Way::Home => Sense::Home,
        },
        speed_um_s: args.speed_mm_s.0,
    };
    let end_us = rig.now_us().saturating_add(args.for_s.0.into());
    rig.call(jog)?;
    while rig.now_us() < end_us {
        let left_us = end_us - rig.now_us();
        rig.idle(left_us.min(RENEW_US), &mut crate::client::Unobserved)?;
        if rig.rig_status()?.state != rig::RigState::Moving {
            break; // the end of the stroke
        }
        if rig.now_us() < end_us {
            rig.call(jog)?;
        }
    }
    rig.urgent(protocol::system::Urgent::Stop)?;
    let status = rig.wait_rest()?;
    screen.say(&format!("Stands at {} mm.", millimetres(&status)));
    Ok(json!({ "status": status }))
}

pub(crate) fn move_to(
    args: &MoveArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    let accepted = rig.call(rig::MoveTo {
        position_um: args.position_mm.0,
        speed_um_s: args.speed_mm_s.0,
    })?;
    screen.say(&format!(
        "{} steps in {} s, {} mm/s at most.",
        accepted.stroke.steps,
        decimal::seconds(accepted.stroke.duration_ticks),
        decimal::write(accepted.stroke.peak_um_s.into(), 3),
    ));
    let status = rig.wait_rest()?;
    if let Some(fault) = status.fault {
        return Err(crate::error::ClientError::Refused {
            place: rig.place(),
            request: "MoveTo",
            refusal: protocol::error::Refusal::RigFaulted(fault),
        }
        .into());
    }
    screen.say(&format!("Stands at {} mm.", millimetres(&status)));
    Ok(json!({ "accepted": accepted, "status": status }))
}

fn millimetres(status: &RigStatus) -> String {
    decimal::write_signed(status.position_um.into(), 3)
}

pub(crate) fn health(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    let health = rig.call(rig::GetRigHealth)?;
    screen.say(&health_text(&health));
    Ok(json!({ "health": health }))
}

fn health_text(health: &RigHealth) -> String {
    let glitches = |glitches: rig::Glitches| match glitches.count {
        0 => "none".to_owned(),
        count => format!(
            "{count}, the last one {} s after the start",
            decimal::write(glitches.last_us.into(), 6)
        ),
    };
    format!(
        "\
since the start of the device
false pulses:      home flag {}; far limit {}
serial line:       {} receptions failed, {} bad frames, {} unsent events or samples
step generator:    {} underruns
stack:             {} of {} bytes
control round:     {} us late at most
image:             {:08x}",
        glitches(health.home_flag),
        glitches(health.far_limit),
        health.uart_errors,
        health.bad_frames,
        health.unsent_frames,
        health.underruns,
        health.stack_used,
        health.stack_size,
        health.control_late_us,
        health.image_hash,
    )
}
