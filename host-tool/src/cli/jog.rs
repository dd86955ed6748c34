//! `jog`: moves the rig for as long as the command runs.

use client::error::ClientError;
use client::{Unobserved, while_moving};
use lab::operations::arguments::JogArgs;
use lab::operations::connector::LinkPurpose;
use lab::operations::ending::{cut_short, millimetres};
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use protocol::rig::{self, Direction, RigState};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{DeviceKind, Urgent};
use serde_json::{Value, json};

use crate::cli::fresh;
use crate::cli::screen::Screen;

/// Interval at which a jog is renewed, us. Shorter if three of these exceed the rig's dead-man time.
const RENEW_US: u64 = 100_000;

pub(crate) fn jog(
    args: &JogArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig, LinkPurpose::Own("jog"))?;
    fresh::prepare(DeviceKind::Rig, &mut rig, finder, screen)?;
    let jog = rig::Jog {
        direction: args.direction,
        speed_um_s: args.speed_mm_s.0,
    };
    let dead_man = rig.call(GetSetting {
        key: SettingKey::DeadManMs,
    })?;
    let renew_us = RENEW_US.min(u64::from(dead_man.value) * 1_000 / 3);
    let end_us = rig.now_us().saturating_add(args.for_s.0.into());
    // A stop came before the answer. If the jog has begun, it brakes.
    let mut early = match rig.call(jog) {
        Ok(_) => false,
        Err(ClientError::Interrupted { .. }) => true,
        Err(error) => return Err(error.into()),
    };
    while !early && rig.now_us() < end_us {
        let left_us = end_us - rig.now_us();
        let silent = |error| while_moving("the jog", error);
        rig.idle(left_us.min(renew_us), &mut Unobserved)
            .map_err(silent)?;
        early = rig.rig_status().map_err(silent)?.state != RigState::Moving;
        if !early && rig.now_us() < end_us {
            early = match rig.call(jog) {
                Ok(_) => false,
                // The jog has just ended, or was stopped. The status shows why.
                Err(ClientError::Refused { .. } | ClientError::Interrupted { .. }) => true,
                Err(error) => return Err(error.into()),
            };
        }
    }
    rig.urgent(Urgent::Stop)?;
    let status = rig.wait_rest(&mut Unobserved)?;
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
