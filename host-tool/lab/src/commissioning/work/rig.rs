//! Commissioning session with a rig: motor supply, homing, moves and runs.

use client::decimal;
use client::error::ClientError;
use client::{Homed, Observer, Progress, Unobserved, homing_limit_us};
use protocol::error::Refusal;
use protocol::rig::{
    LinkLossPolicy, MoveTo, RigEvent, RigFault, RigInputs, RigState, RigStatus, Run, RunAccepted,
    RunOutcome, RunRecord, RunTiming,
};
use protocol::settings::SettingKey;
use protocol::system::{Event, Urgent, What};

use super::{POLL_US, Work};
use crate::commissioning::halt::{Halt, fault_text, homing_text, refused};
use crate::commissioning::operator::{Act, Part};

/// Time for an open E-stop loop to close by itself after an acknowledgement, us.
const LOOP_US: u64 = 500_000;

/// Longest wait for the effect of an act, us.
const SETTLE_US: u64 = 500_000;
/// Time that homing may exceed the announced duration by, us.
const HOMING_MARGIN_US: u64 = 3_000_000;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HomeEnd {
    Homed(Homed),
    /// A fault is latched; whether the far limit opened on the way.
    Fault(RigFault, bool),
}

impl Work<'_> {
    /// Requests an act whose effect `seen` detects. Returns the rig's status at that moment, or half a second after the
    /// act.
    pub fn ask(
        &mut self,
        part: Part,
        on: bool,
        mut seen: impl FnMut(&RigStatus) -> bool,
    ) -> Result<RigStatus, Halt> {
        let device = &mut self.device;
        let mut watch = || {
            if seen(&device.rig_status()?) {
                return Ok(true);
            }
            device.idle(POLL_US, &mut Unobserved)?;
            Ok(false)
        };
        self.operator
            .act(Act { part, on }, true, self.say, &mut watch)?;
        self.unless_aborted()?;
        self.until(SETTLE_US, seen)
    }

    /// Switches the motor supply, unless it is known to be in that state. Without supply the carriage can be moved by
    /// hand, so the rig must no longer trust its position.
    pub fn supply(&mut self, on: bool) -> Result<(), Halt> {
        if self.supply != Some(on) {
            self.hand(Part::Supply, on)?;
            self.supply = Some(on);
        }
        if on { Ok(()) } else { self.forget_position() }
    }

    /// Whether the motor supply was switched off and not on again.
    pub fn supply_is_off(&self) -> bool {
        self.supply == Some(false)
    }

    /// Makes the rig forget its position, by an emergency stop that is then acknowledged. Does nothing if the position
    /// is already unknown.
    fn forget_position(&mut self) -> Result<(), Halt> {
        if !self.status()?.homed {
            return Ok(());
        }
        self.device.urgent(Urgent::EStop)?;
        self.until(SETTLE_US, |status| status.fault.is_some())?;
        self.clear()
    }

    /// Carries out a run from 0 without motor supply. Afterwards the rig does not trust its position, however the run
    /// ended.
    pub fn run_without_power(&mut self, run: Run) -> Result<(RunAccepted, RunRecord), Halt> {
        self.at_home()?;
        self.hand(Part::Supply, false)?;
        self.supply = Some(false);
        let ran = self.start(run).and_then(|accepted| {
            let seconds = accepted.total_ticks / 100_000_000;
            self.say(&format!(
                "  {} strokes of {} mm, {} steps, about {seconds} s",
                u32::from(run.cycles) * 2,
                decimal::write(run.stroke_um.into(), 3),
                accepted.edges
            ));
            Ok((accepted, self.finish(&accepted)?))
        });
        let forgotten = match ran {
            // After the operator has quit, the rig takes stops only: the fault stays latched until the next session.
            Err(Halt::Aborted) => Ok(self.device.urgent(Urgent::EStop)?),
            _ => self.forget_position(),
        };
        let ran = ran?;
        forgotten.map(|()| ran)
    }

    pub fn to_the_middle(&mut self) -> Result<(), Halt> {
        self.supply(false)?;
        self.hand(Part::Carriage, true)
    }

    pub fn status(&mut self) -> Result<RigStatus, Halt> {
        let status = self.device.rig_status()?;
        self.unless_aborted()?;
        Ok(status)
    }

    /// Waits for `seen`, but no longer than `limit_us`; returns the last status.
    pub fn until(
        &mut self,
        limit_us: u64,
        mut seen: impl FnMut(&RigStatus) -> bool,
    ) -> Result<RigStatus, Halt> {
        let end_us = self.device.now_us().saturating_add(limit_us);
        loop {
            let status = self.status()?;
            if seen(&status) || self.device.now_us() >= end_us {
                return Ok(status);
            }
            self.pause(POLL_US)?;
        }
    }

    pub fn clear(&mut self) -> Result<(), Halt> {
        let status = self.status()?;
        if status.fault.is_none() && !status.needs_acknowledge {
            return Ok(());
        }
        match self.device.acknowledge() {
            Err(ClientError::Refused { refusal, .. }) => {
                let RigInputs {
                    home_flag,
                    far_limit,
                    estop_loop,
                } = status.inputs;
                let closes = |status: &RigStatus| !status.inputs.estop_loop;
                // A loop that was open a moment ago and closes by itself is noisy.
                let stays_open = estop_loop && !closes(&self.until(LOOP_US, closes)?);
                Err(Halt::Defect(match status.fault {
                    _ if stays_open => "the E-stop loop is open at rest: a button is pressed, an end-of-travel switch is actuated, or a wire of the loop is broken".to_owned(),
                    _ if estop_loop => fault_text(RigFault::EStopLoop),
                    _ if home_flag && far_limit => Refusal::BothSwitchesOpen.to_string(),
                    Some(fault) => fault_text(fault),
                    None => refused(&refusal),
                }))
            }
            other => Ok(other?),
        }
    }

    /// Homes and observes the far limit: a carriage that meets it moves the wrong way, and its pulses are cut.
    pub fn home(&mut self) -> Result<HomeEnd, Halt> {
        let before = self.status()?;
        self.device.take_events()?;
        let accepted = self.device.home()?;
        let start_us = self.device.now_us();
        let limit_us = homing_limit_us(&accepted) + HOMING_MARGIN_US;
        let mut seen = HomedEvent::default();
        let mut far = false;
        loop {
            self.device.idle(POLL_US, &mut seen)?;
            self.unless_aborted()?;
            let status = self.status()?;
            if status.inputs.far_limit && !before.inputs.far_limit && !far {
                far = true;
                self.device.urgent(Urgent::EStop)?;
            }
            if !matches!(status.state, RigState::Homing | RigState::Stopping) {
                self.device.idle(0, &mut seen)?;
                return match (seen.0, status.fault) {
                    (_, Some(fault)) => Ok(HomeEnd::Fault(fault, far)),
                    (Some((repeat_steps, shift_steps)), None) => Ok(HomeEnd::Homed(Homed {
                        repeat_steps,
                        shift_steps,
                        duration_us: self.device.now_us() - start_us,
                    })),
                    (None, None) if far => continue,
                    (None, None) => Err(Halt::Defect(
                        "homing was stopped by somebody else, the start button or another terminal"
                            .to_owned(),
                    )),
                };
            }
            if self.device.now_us() - start_us > limit_us {
                self.device.urgent(Urgent::Stop)?;
                return Err(Halt::Defect("homing does not end".to_owned()));
            }
        }
    }

    /// Brings the rig to 0, homed, with motor supply.
    pub fn at_home(&mut self) -> Result<(), Halt> {
        let moved_by_hand = self.supply != Some(true);
        self.clear()?;
        self.supply(true)?;
        let status = self.status()?;
        if !status.homed || moved_by_hand {
            return match self.home()? {
                HomeEnd::Homed(_) => Ok(()),
                HomeEnd::Fault(fault, far) => Err(Halt::Defect(homing_text(fault, far))),
            };
        }
        if status.position_steps != 0 {
            self.go_to(0)?;
        }
        Ok(())
    }

    /// Moves to a position at a cautious speed; a fault on the way is a defect.
    pub fn go_to(&mut self, position_um: u32) -> Result<RigStatus, Halt> {
        let status = self.try_to_go_to(position_um)?;
        match status.fault {
            Some(fault) => Err(Halt::Defect(fault_text(fault))),
            None => Ok(status),
        }
    }

    /// Moves to a position at a cautious speed; a fault on the way is in the status.
    pub fn try_to_go_to(&mut self, position_um: u32) -> Result<RigStatus, Halt> {
        let speed_um_s = 20_000.min(self.setting(SettingKey::MaxSpeedUmS));
        let accepted = self.device.call(MoveTo {
            position_um,
            speed_um_s,
        })?;
        let (_, status) = self.device.wait_move(&accepted, &mut Unobserved)?;
        self.unless_aborted()?;
        Ok(status)
    }

    /// Starts a slow run over a short stroke, for tests during a run.
    pub fn start_short_run(&mut self, cycles: u16) -> Result<RunAccepted, Halt> {
        let speed = 5_000.min(self.setting(SettingKey::MaxSpeedUmS));
        let accel = 100_000.min(self.setting(SettingKey::MaxAccelUmS2));
        let stroke_um = 10_000.min(self.setting(SettingKey::StrokeUm));
        self.start(by_speed(cycles, stroke_um, speed, accel))
    }

    /// Waits until a run is well in progress.
    pub fn under_way(&mut self) -> Result<(), Halt> {
        let status = self.until(5_000_000, |status| {
            status.fault.is_some() || status.position_um > 2_000
        })?;
        match status.fault {
            Some(fault) => Err(Halt::Defect(fault_text(fault))),
            None => Ok(()),
        }
    }

    pub fn start(&mut self, run: Run) -> Result<RunAccepted, Halt> {
        let accepted = self.device.run(run)?;
        self.unless_aborted()?;
        Ok(accepted)
    }

    pub fn finish(&mut self, accepted: &RunAccepted) -> Result<RunRecord, Halt> {
        let mut tenths = Tenths {
            say: &mut *self.say,
            shown: 0,
        };
        let record = self.device.wait_run(accepted, &mut tenths)?;
        self.unless_aborted()?;
        Ok(record)
    }

    /// Checks that a run ended with all its edges, and keeps the numbers.
    pub fn whole(&mut self, accepted: &RunAccepted, record: &RunRecord) -> Result<(), Halt> {
        self.note("strokes", record.strokes);
        self.note("planned_edges", accepted.edges);
        self.note("commanded_edges", record.commanded_edges);
        self.note("counted_edges", record.counted_edges);
        self.note("worst_residual_steps", record.worst_residual_steps);
        match record.outcome {
            RunOutcome::Complete => {}
            RunOutcome::Faulted(fault) => return Err(Halt::Defect(fault_text(fault))),
            other => {
                return Err(Halt::Defect(format!(
                    "the run did not end by itself: {other:?}"
                )));
            }
        }
        if record.commanded_edges != record.counted_edges
            || record.commanded_edges != accepted.edges
        {
            return Err(Halt::Defect(format!(
                "of {} planned edges {} were commanded and {} counted: noise on the STEP wire, or a loose jumper D2-A0",
                accepted.edges, record.commanded_edges, record.counted_edges
            )));
        }
        Ok(())
    }
}

/// A run by speed, equal in both directions, which stops when the host is silent.
pub fn by_speed(cycles: u16, stroke_um: u32, speed_um_s: u32, accel_um_s2: u32) -> Run {
    Run {
        cycles,
        stroke_um,
        timing: RunTiming::Speeds {
            forward_um_s: speed_um_s,
            return_um_s: speed_um_s,
            accel_um_s2,
        },
        far_dwell_us: 0,
        home_dwell_us: 0,
        start_delay_us: 0,
        link_loss: LinkLossPolicy::Stop,
    }
}

/// Extracts the result of homing from the events.
#[derive(Default)]
struct HomedEvent(Option<(i32, i32)>);

impl Observer for HomedEvent {
    fn event(&mut self, event: &Event) {
        if let What::Rig(RigEvent::Homed {
            repeat_steps,
            shift_steps,
        }) = event.what
        {
            self.0 = Some((repeat_steps, shift_steps));
        }
    }
}

/// Prints a line at each tenth of a long run.
struct Tenths<'a> {
    say: &'a mut dyn FnMut(&str),
    shown: u64,
}

/// Shorter runs need no progress, us.
const SHORT_RUN_US: u64 = 30_000_000;

impl Observer for Tenths<'_> {
    fn progress(&mut self, progress: &Progress) {
        if let Progress::Run {
            elapsed_us,
            total_us,
            stroke,
            strokes,
            ..
        } = *progress
        {
            let tenth = elapsed_us * 10 / total_us.max(1);
            if total_us > SHORT_RUN_US && tenth > self.shown {
                self.shown = tenth;
                (self.say)(&format!("  stroke {stroke} of {strokes}"));
            }
        }
    }
}
