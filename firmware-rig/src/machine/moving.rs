//! Jog and move: single strokes on command.

use super::{Actions, Machine, Now, State};
use crate::periods::Path;
use motion::{
    axis::{Direction, Position, Speed},
    units::Window,
};
use protocol::{error::Refusal, rig::RigState};

/// A jog in progress. It ends at `until_us` unless it is renewed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Jog {
    direction: Direction,
    speed: Speed,
    pub(super) until_us: u64,
}

impl Machine {
    pub(super) fn jog(
        &mut self,
        now: &Now,
        direction: Direction,
        speed: Speed,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let jog = Jog {
            direction,
            speed,
            until_us: now.time_us.saturating_add(self.settings.dead_man_us),
        };
        if let State::Moving(Some(present)) = &mut self.state
            && (present.direction, present.speed) == (direction, speed)
        {
            *present = jog;
            return Ok(());
        }
        self.refuse_unless_ready(&now.inputs)?;
        if now.time_us < self.jog_stopped_until_us {
            return Err(Refusal::RigBusy(RigState::Stopping));
        }
        let target = match direction {
            Direction::Away => self.settings.axis.far(),
            Direction::Home => self.settings.axis.home(),
        };
        self.move_to(now, target, speed, Some(jog), actions)
    }

    pub(super) fn move_to(
        &mut self,
        now: &Now,
        target: Position,
        speed: Speed,
        jog: Option<Jog>,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        self.refuse_where_moved(now, actions)?;
        self.refuse_where_lost(now, actions)?;
        let to = target.signed();
        let Some((direction, distance)) = now.position.way_to(to) else {
            return Err(Refusal::AlreadyThere);
        };
        if now.inputs.far_limit && direction == Direction::Away {
            return Err(Refusal::FarLimitOpen);
        }
        let profile = self.settings.move_profile(distance, speed)?;
        self.state = State::Moving(jog);
        let path = Path::Move { profile, direction };
        self.start_path(path, Window::between(now.position, to), actions);
        Ok(())
    }
}
