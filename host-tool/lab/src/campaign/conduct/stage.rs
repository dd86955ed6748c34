//! Moves the rollers to the start of a trial while the body is out of their way. In a plan with isolated passes the
//! rollers stop at either end after a trial, and the body lies between the ends.

use std::path::Path;

use crate::trials::experiment;
use crate::trials::trial::{Screw, Status};
use client::Unobserved;
use client::error::ClientError;
use protocol::error::Refusal;
use protocol::rig::{Direction, MoveTo, RigState, RigStatus};

use crate::campaign::conduct::{Broken, Conduct, Then};
use crate::campaign::order::Planned;
use crate::campaign::prompts::{Answer, Question, clearing};
use crate::campaign::resumption;

/// Speed of the carriage on its way to the start of a trial, um/s.
const STAGE_UM_S: u32 = 20_000;

impl Conduct<'_> {
    /// Makes sure that the rollers are at the start of the trial before the body is laid in.
    pub(super) fn stage(&mut self, planned: &Planned) -> Result<Then, Broken> {
        if self.is_staged(planned)? {
            return Ok(Then::Go);
        }
        let todo = clearing(planned);
        match self.ask(&Question::Prepare { todo })? {
            None => return Ok(Then::Leave),
            Some(Answer::Enter | Answer::Yes) => {}
            Some(_) => {
                self.desk.say("  that is not for now");
                return Ok(Then::Look);
            }
        }
        match self.may_move()? {
            Then::Go => {}
            then => return Ok(then),
        }
        let begins_um = self.begins_um(planned);
        match self.drive_to(planned.block, begins_um) {
            // No attempt has begun, so there is nothing to record.
            Err(_) if self.machines.rig.interrupted().is_some() => Ok(Then::Leave),
            Err(broken) => Err(broken),
            Ok(()) => Ok(Then::Look),
        }
    }

    /// Whether the rollers are at the start of the trial, and were homed in this session and block. Always true in a
    /// plan without passes: its carriage goes to 0 within the attempt.
    pub(super) fn is_staged(&mut self, planned: &Planned) -> Result<bool, Broken> {
        if self.folder.campaign().plan.passes.is_none() {
            return Ok(true);
        }
        // The next question also waits for a rig that is gone.
        if self.gone {
            return Ok(false);
        }
        let status = self.machines.rig.rig_status()?;
        no_fault(&status, &self.folder.campaign().folder)?;
        let begins = Screw::from(&status).steps(self.begins_um(planned));
        Ok(status.homed
            && status.state == RigState::Ready
            && self.homed_in == Some(planned.block)
            && status.position_steps == begins)
    }

    /// Position of the carriage at the start of a trial.
    fn begins_um(&self, planned: &Planned) -> u32 {
        match planned.purpose.pass() {
            Some(Direction::Home) => self.folder.campaign().plan.run.stroke_um,
            Some(Direction::Away) | None => 0,
        }
    }

    /// Moves the carriage to a position. Homes first in each block and each session: handling the rollers may have
    /// turned the screw.
    pub(super) fn drive_to(&mut self, block: u32, position_um: u32) -> Result<(), Broken> {
        let status = self.machines.rig.rig_status()?;
        no_fault(&status, &self.folder.campaign().folder)?;
        if !status.homed || self.homed_in != Some(block) {
            let mut observer = self.desk.observer();
            let homed = experiment::home(&mut self.machines.rig, &mut *observer)?;
            drop(observer);
            self.machines.homed = Some((self.desk.now(), homed));
            self.homed_in = Some(block);
            if position_um == 0 {
                return Ok(());
            }
        }
        let to = MoveTo {
            position_um,
            speed_um_s: STAGE_UM_S,
        };
        let rig = &mut self.machines.rig;
        let status = match rig.call(to) {
            Ok(accepted) => rig.wait_move(&accepted, &mut Unobserved)?.1,
            Err(ClientError::Refused {
                refusal: Refusal::AlreadyThere,
                ..
            }) => rig.rig_status()?,
            Err(error) => return Err(error.into()),
        };
        let wanted = Screw::from(&status).steps(position_um);
        if status.position_steps != wanted || status.fault.is_some() {
            return Err(match self.machines.rig.interrupted() {
                Some(_) => Broken::Ended {
                    action: "the move to where the trial begins",
                    status: Status::Stopped,
                    reason: None,
                },
                None => Broken::NotReady {
                    why: format!(
                        "the carriage is at {} steps after the move to {wanted}",
                        status.position_steps
                    ),
                    help: format!(
                        "`retrograde info rig` says what is wrong; then {}",
                        resumption(&self.folder.campaign().folder)
                    ),
                },
            });
        }
        Ok(())
    }
}

fn no_fault(status: &RigStatus, folder: &Path) -> Result<(), Broken> {
    match status.fault {
        None => Ok(()),
        Some(fault) => Err(Broken::NotReady {
            why: format!("the rig has a fault: {fault}"),
            help: format!(
                "remove its cause, `retrograde ack rig`, then {}",
                resumption(folder)
            ),
        }),
    }
}
