//! Commands that move the rig by hand, hold and resume a run, or show the rig's health.

use client::decimal;
use client::error::ClientError;
use client::{Device, Unobserved, while_moving};
use protocol::rig::{self, Direction, RigHardware, RigHealth, RigState, RigStatus};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{DeviceKind, Urgent};
use serde_json::{Value, json};
use trials::trial::Status;

use crate::cli::already;
use crate::cli::args::{JogArgs, MoveArgs};
use crate::cli::failure::Failure;
use crate::cli::finding::Finder;
use crate::cli::fresh;
use crate::cli::screen::Screen;

/// Interval at which a jog is renewed, us; shorter if the rig's dead-man time is less than three of these.
const RENEW_US: u64 = 100_000;

pub(crate) fn hold(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let status = held(&mut finder.connect(DeviceKind::Rig)?)?;
    screen.say(&format!(
        "Held at {} mm; `retrograde resume` continues the run, `retrograde stop` ends it.",
        millimetres(&status)
    ));
    Ok(json!({ "held": true, "status": status }))
}

/// Holds the run that goes on, and waits until the carriage stands.
pub(crate) fn held(rig: &mut Device) -> Result<RigStatus, Failure> {
    rig.call(rig::Hold)?;
    let status = rig.wait_rest()?;
    if status.state == RigState::Running {
        return Err(Failure::Refused {
            why: "the run was held, and goes on again: somebody has resumed it, the start button does that"
                .to_owned(),
            help: "`retrograde hold` holds it again, `retrograde stop` ends it".to_owned(),
        });
    }
    if status.state != RigState::Held {
        return Err(match Status::from(rig.run_record()?.outcome) {
            Status::Complete => Failure::Refused {
                why: "too late, the run is complete".to_owned(),
                help: format!("nothing is held; the rig is at {} mm", millimetres(&status)),
            },
            ending => ended("the run", ending, &status, None),
        });
    }
    Ok(status)
}

pub(crate) fn resume(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    rig.call(rig::Resume)?;
    let status = rig.rig_status()?;
    screen.say(&format!(
        "The run goes on from {} mm. Its link-loss policy still applies: with `stop`, it stops when it hears no host.",
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
    fresh::prepare(DeviceKind::Rig, &mut rig, finder, screen)?;
    let jog = rig::Jog {
        sense: args.direction,
        speed_um_s: args.speed_mm_s.0,
    };
    let dead_man = rig.call(GetSetting {
        key: SettingKey::DeadManMs,
    })?;
    let renew_us = RENEW_US.min(u64::from(dead_man.value) * 1_000 / 3);
    let end_us = rig.now_us().saturating_add(args.for_s.0.into());
    rig.call(jog)?;
    let mut early = false;
    while !early && rig.now_us() < end_us {
        let left_us = end_us - rig.now_us();
        let silent = |error| while_moving("the jog", error);
        rig.idle(left_us.min(renew_us), &mut Unobserved)
            .map_err(silent)?;
        early = rig.rig_status().map_err(silent)?.state != RigState::Moving;
        if !early && rig.now_us() < end_us {
            early = match rig.call(jog) {
                Ok(_) => false,
                // The jog has just ended; the status says how.
                Err(ClientError::Refused { .. }) => true,
                Err(error) => return Err(error.into()),
            };
        }
    }
    rig.urgent(Urgent::Stop)?;
    let status = rig.wait_rest()?;
    let step_um = status.lead_um.div_ceil(status.steps_per_rev.max(1));
    let at_the_end = match args.direction {
        Direction::Away => {
            i64::from(status.position_um) > i64::from(status.stroke_um) - i64::from(step_um)
        }
        Direction::Home => i64::from(status.position_um) < i64::from(step_um),
    };
    let as_asked = rig.interrupted().is_none() && (!early || at_the_end);
    if status.fault.is_some() || !as_asked {
        return Err(cut_short("the jog", &rig, &status));
    }
    screen.say(&format!("The carriage is at {} mm.", millimetres(&status)));
    Ok(json!({ "status": status }))
}

pub(crate) fn move_to(
    args: &MoveArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    fresh::prepare(DeviceKind::Rig, &mut rig, finder, screen)?;
    let accepted = match rig.call(rig::MoveTo {
        position_um: args.position_mm.0,
        speed_um_s: args.speed_mm_s.0,
    }) {
        Err(error) if already::is_there(&error) => {
            let status = rig.rig_status()?;
            screen.say(&format!(
                "The carriage is at {} mm already; nothing moved.",
                millimetres(&status)
            ));
            return Ok(json!({ "already": true, "status": status }));
        }
        accepted => accepted?,
    };
    screen.say(&format!(
        "{} steps in {} s, {} mm/s at most.",
        accepted.stroke.steps,
        decimal::seconds(accepted.stroke.duration_ticks),
        decimal::write(accepted.stroke.peak_um_s.into(), 3),
    ));
    let status = rig.wait_rest()?;
    if status.fault.is_some() || status.position_steps != accepted.to_steps {
        return Err(cut_short("the move", &rig, &status));
    }
    screen.say(&format!("The carriage is at {} mm.", millimetres(&status)));
    Ok(json!({ "accepted": accepted, "status": status }))
}

/// The failure of a motion that ended early.
pub(crate) fn cut_short(action: &'static str, rig: &Device, status: &RigStatus) -> Failure {
    let (ending, reason) = match (status.fault, rig.interrupted()) {
        (Some(_), _) => (Status::Faulted, None),
        (None, Some(_)) => (Status::Stopped, None),
        (None, None) => (
            Status::Stopped,
            Some("by the start button, or because the rig did not hear this tool in time"),
        ),
    };
    ended(action, ending, status, reason)
}

fn ended(
    action: &'static str,
    ending: Status,
    status: &RigStatus,
    reason: Option<&str>,
) -> Failure {
    let place = millimetres(status);
    Failure::Ended {
        action,
        status: ending,
        reason: status
            .fault
            .map(|fault| fault.to_string())
            .or(reason.map(str::to_owned)),
        help: if status.fault.is_some() {
            format!(
                "the carriage is at {place} mm by the step counter; `retrograde ack rig`, then `retrograde home`"
            )
        } else {
            format!("the carriage is at {place} mm")
        },
    }
}

pub(crate) fn millimetres(status: &RigStatus) -> String {
    decimal::write_signed(status.position_um.into(), 3)
}

pub(crate) fn health(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    let health = rig.call(rig::GetRigHealth)?;
    let hardware = rig.call(rig::GetRigHardware)?;
    screen.say(&health_text(&health, &hardware));
    Ok(json!({ "health": health, "hardware": hardware }))
}

fn health_text(health: &RigHealth, hardware: &RigHardware) -> String {
    let glitches = |glitches: rig::Glitches| match glitches.count {
        0 => "none".to_owned(),
        count => format!(
            "{count}, the last one {} s after the start, masked {} times",
            decimal::write(glitches.last_us.into(), 6),
            glitches.masked,
        ),
    };
    format!(
        "\
since the start of the device
false pulses:      home flag {}; far limit {}
serial line:       {} receptions failed, {} bad frames, {} unsent events or samples
step generator:    {} underruns, {} resets of its timer
steps, timed:      {} right, {} off by 10 ns, {} by 20 ns, {} by more; {} captures lost
DMA:               {} errors
stack:             {} of {} bytes
control round:     {} us late at most
image:             {:08x}",
        glitches(health.home_flag),
        glitches(health.far_limit),
        health.uart_errors,
        health.bad_frames,
        health.unsent_frames,
        health.underruns,
        hardware.timer_resets,
        hardware.intervals_exact,
        hardware.intervals_1_tick,
        hardware.intervals_2_ticks,
        hardware.intervals_more,
        hardware.lost_captures,
        hardware.dma_errors,
        health.stack_used,
        health.stack_size,
        health.control_late_us,
        health.image_hash,
    )
}
