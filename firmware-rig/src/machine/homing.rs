//! Homing: five moves to the reference, and the faults of each.

use super::{Action, Actions, Machine, Now, State};
use crate::periods::Path;
use motion::{
    axis::Direction,
    trapezoid::StrokeProfile,
    units::{Micrometres, StepPosition, Steps, Window},
};
use protocol::{
    error::Refusal,
    rig::{HomingPhase, LinkLossPolicy, RigEvent, RigFault},
};

/// Largest distance between the switching points of two passes: several times the scatter of a good switch.
const FLAG_SCATTER: Micrometres = Micrometres(100);

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Homing {
    pub(super) phase: HomingPhase,
    pub(super) link_loss: LinkLossPolicy,
    pub(super) deadline_us: u64,
    /// Flag edge of the first pass.
    seek: Option<StepPosition>,
    /// Flag edge of the second pass.
    locate: Option<StepPosition>,
    /// State of the flag by its filtered edges. A single reading of the pin could catch a glitch.
    flag_open: bool,
    /// The position was trusted when homing began.
    was_homed: bool,
    /// Second pass minus the first, steps.
    repeat: i32,
    /// New reference minus the previous one, steps.
    shift: i32,
}

impl Homing {
    /// Handles an edge of the flag; true if it ends the present move.
    pub(super) fn flag_edge(&mut self, opening: bool, count: StepPosition) -> bool {
        self.flag_open = opening;
        let found = match self.phase {
            HomingPhase::Clear => return !opening,
            HomingPhase::Seek => &mut self.seek,
            HomingPhase::Locate => &mut self.locate,
            HomingPhase::PullOff | HomingPhase::ToZero => return false,
        };
        // Only the first edge counts: contacts bounce.
        if !opening || found.is_some() {
            return false;
        }
        *found = Some(count);
        true
    }
}

impl Machine {
    pub(super) fn home(
        &mut self,
        now: &Now,
        link_loss: LinkLossPolicy,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        self.refuse_unless_at_rest(&now.inputs)?;
        if !self.settings.homing_has_profiles() {
            return Err(Refusal::TooSlow);
        }
        let homing = Homing {
            phase: if now.inputs.home_flag {
                HomingPhase::Clear
            } else {
                HomingPhase::Seek
            },
            link_loss,
            deadline_us: now.time_us.saturating_add(self.settings.homing_timeout_us),
            seek: None,
            locate: None,
            flag_open: now.inputs.home_flag,
            was_homed: self.homed,
            repeat: 0,
            shift: 0,
        };
        self.homed = false;
        self.enter(homing, now.position, actions);
        Ok(())
    }

    /// Starts the move of a homing phase.
    fn enter(&mut self, homing: Homing, position: StepPosition, actions: &mut Actions) {
        let settings = &self.settings;
        let flag = settings.flag.distance_to(StepPosition::HOME).0;
        let (pull_off, overtravel) = (settings.pull_off.0, settings.overtravel.0);
        let (direction, distance, speed_um_s) = match homing.phase {
            // The flag is open from its edge to the end of travel on the home side.
            HomingPhase::Clear => (Direction::Away, flag + overtravel, settings.locate_um_s * 2),
            HomingPhase::Seek => {
                // If the position is known, travel no farther than needed.
                let from = if !homing.was_homed {
                    settings.axis.stroke_steps().0
                } else if position > StepPosition::HOME {
                    position.distance_to(StepPosition::HOME).0
                } else {
                    0
                };
                (Direction::Home, from + overtravel, settings.seek_um_s)
            }
            HomingPhase::PullOff => {
                let edge = homing.seek.unwrap_or(position);
                let begin = edge.moved(Direction::Away, settings.pull_off);
                let way = position.way_to(begin.unwrap_or(edge));
                let (direction, distance) = way.unwrap_or((Direction::Away, Steps(0)));
                (direction, distance.0, settings.seek_um_s)
            }
            HomingPhase::Locate => (Direction::Home, 2 * pull_off, settings.locate_um_s),
            HomingPhase::ToZero => {
                let Some((direction, distance)) = position.way_to(StepPosition::HOME) else {
                    return self.homed_at_zero(homing, actions);
                };
                (direction, distance.0, settings.seek_um_s)
            }
        };
        let profile = settings.axis.speed(speed_um_s).ok().and_then(|speed| {
            StrokeProfile::from_speed(Steps(distance), speed, settings.homing_accel).ok()
        });
        let end = position.moved(direction, Steps(distance));
        let (Some(profile), Some(end)) = (profile, end) else {
            // Never happens: `home` has checked the longest moves.
            return self.latch(RigFault::FlagNotFound(homing.phase), actions);
        };
        self.state = State::Homing(homing);
        let path = Path::Move { profile, direction };
        self.start_path(path, Window::between(position, end), actions);
    }

    fn homed_at_zero(&mut self, homing: Homing, actions: &mut Actions) {
        self.homed = true;
        self.rest = StepPosition::HOME;
        self.residual = 0;
        self.state = State::Ready;
        actions.emit(RigEvent::Homed {
            repeat_steps: homing.repeat,
            shift_steps: homing.shift,
        });
    }

    /// Whether both passes met the flag at the same position, within the larger of `max_residual_steps` and the
    /// scatter.
    fn passes_agree(&self, homing: &Homing) -> bool {
        let scatter = self.settings.axis.steps_within(FLAG_SCATTER);
        let within = scatter
            .map_or(0, |steps| steps.0)
            .max(self.settings.max_residual_steps);
        match (homing.seek, homing.locate) {
            (Some(seek), Some(locate)) => locate.since(seek).unsigned_abs() <= within,
            _ => true,
        }
    }

    pub(super) fn homing_move_ended(
        &mut self,
        now: &Now,
        mut homing: Homing,
        position: StepPosition,
        actions: &mut Actions,
    ) {
        let missing = match homing.phase {
            // The edge may come from unplugging the cable.
            _ if now.inputs.home_flag && now.inputs.far_limit => Some(RigFault::BothSwitchesOpen),
            HomingPhase::Clear | HomingPhase::PullOff => {
                homing.flag_open.then_some(RigFault::FlagStuck)
            }
            phase @ HomingPhase::Seek if homing.seek.is_none() => {
                Some(RigFault::FlagNotFound(phase))
            }
            phase @ HomingPhase::Locate if homing.locate.is_none() => {
                Some(RigFault::FlagNotFound(phase))
            }
            // The next move goes away from home, to the open limit.
            HomingPhase::Seek | HomingPhase::Locate if now.inputs.far_limit => {
                Some(RigFault::FarLimit)
            }
            // The carriage rests on the flag, so the flag must be open. Otherwise a disturbance would shift the zero.
            phase @ (HomingPhase::Seek | HomingPhase::Locate) if !homing.flag_open => {
                Some(RigFault::FlagNotFound(phase))
            }
            // A disturbance that outlasts the check above.
            phase @ HomingPhase::Locate if !self.passes_agree(&homing) => {
                Some(RigFault::FlagNotFound(phase))
            }
            HomingPhase::Seek | HomingPhase::Locate | HomingPhase::ToZero => None,
        };
        if let Some(fault) = missing {
            return self.latch(fault, actions);
        }
        homing.phase = match homing.phase {
            HomingPhase::Clear => HomingPhase::Seek,
            HomingPhase::Seek => HomingPhase::PullOff,
            HomingPhase::PullOff => HomingPhase::Locate,
            HomingPhase::Locate => HomingPhase::ToZero,
            HomingPhase::ToZero => return self.homed_at_zero(homing, actions),
        };
        let mut position = position;
        if homing.phase == HomingPhase::ToZero {
            let found = homing.locate.unwrap_or(position);
            let flag = self.settings.flag;
            homing.repeat = homing.seek.map_or(0, |seek| found.since(seek));
            if homing.was_homed {
                homing.shift = found.since(flag);
            }
            position = StepPosition(position.since(found) + flag.0);
            actions.push(Action::SetPosition(position));
        }
        self.enter(homing, position, actions);
    }
}
