//! Waits for the end of a motion and reports its progress.

use protocol::capsule::{self, ActuationAccepted, ActuationRecord, CapsuleEvent};
use protocol::rig::{
    self, HomeAccepted, MoveAccepted, RigEvent, RigState, RigStatus, RunAccepted, RunOutcome,
    RunRecord, Stroke,
};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{Event, Urgent, What};

use crate::device::observer::{Begun, Clock, Homed, Observer, Pace, Progress, Unobserved};
use crate::device::{Device, moves};
use crate::error::{ClientError, Missing};

/// Interval between status requests during a move, us.
const POLL_US: u64 = 50_000;

/// Interval between reads of the record after an actuation has ended, us: several readings of the capsule.
const BRAKING_US: u64 = 20_000;

/// Longest braking time of any rig, us: from the highest speed with the least deceleration that settings allow.
const LONGEST_STOP_US: u64 = 1_000_000 * SettingKey::MaxSpeedUmS.range().max as u64
    / SettingKey::StopAccelUmS2.range().min as u64;

/// Time past the announced end after which an action is stopped as overdue, us.
const OVERDUE_US: u64 = 3_000_000;
/// Greatest factor by which a device's clock may be slower than the link's. An emulator on a busy computer may reach
/// it; a clock that is slower still has stopped.
const SLOWEST: u64 = 20;

/// Upper limit of the readings in a recording. A capsule keeps the last 4,200, so a longer recording than this limit
/// is not from a capsule.
const MOST_POINTS: usize = 10_000;

/// Converts an error that occurred while something may be moving: an unanswered request changes nothing, but the state
/// of the machine is unknown.
pub fn while_moving(action: &'static str, error: ClientError) -> ClientError {
    match error {
        ClientError::Unanswered {
            place,
            missing: Missing::Reply | Missing::End,
            ..
        } => ClientError::Unanswered {
            place,
            request: action,
            missing: Missing::End,
        },
        error => error,
    }
}

/// Upper limit for the duration of homing, us: both passes over the whole permitted travel, plus a margin.
#[must_use]
pub fn homing_limit_us(accepted: &HomeAccepted) -> u64 {
    let travel_us = |um: u64, um_s: u32| um * 1_000_000 / u64::from(um_s.max(1));
    let travel_um = u64::from(accepted.max_travel_um);
    // The slow pass only covers the distance back from the first pass, a small part of the travel.
    2 * travel_us(travel_um, accepted.seek_um_s)
        + travel_us(travel_um / 4, accepted.locate_um_s)
        + 5_000_000
}

/// The recording of an actuation, its readings 1 ms apart.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Recorded {
    /// Number of the actuation; 0 if there was none.
    pub actuation: u32,
    /// The last [`protocol::capsule::KEPT_TRACE_POINTS`] readings.
    pub points: Vec<capsule::TracePoint>,
}

/// State of an action during a wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ActionState {
    Running,
    /// Held: the time limit is suspended.
    Paused,
    /// A hold prolongs the announced duration by this time, us.
    Extended(u64),
    Ended,
}

impl From<bool> for ActionState {
    fn from(ended: bool) -> Self {
        if ended { Self::Ended } else { Self::Running }
    }
}

impl Device {
    /// Waits until homing ends.
    ///
    /// # Errors
    /// [`ClientError::NotHomed`], [`ClientError::Overdue`], or as [`Device::call`].
    pub fn wait_homing(
        &mut self,
        accepted: &HomeAccepted,
        observer: &mut dyn Observer,
    ) -> Result<Homed, ClientError> {
        observer.begun(&Begun::Homing(*accepted));
        let start_us = self.now_us();
        let (mut found, mut link_lost) = (None, false);
        let at_most_us = homing_limit_us(accepted);
        self.wait("homing", at_most_us, observer, |device, event, observer| {
            if let Some(event) = event {
                link_lost |= event.what == What::LinkLost;
                return Ok(match event.what {
                    What::Rig(RigEvent::Homed {
                        repeat_steps,
                        shift_steps,
                    }) => {
                        found = Some((repeat_steps, shift_steps));
                        true
                    }
                    // The event may be an older one still in transit, so the status decides.
                    What::Rig(RigEvent::Faulted(_) | RigEvent::Stopped { .. }) => !matches!(
                        device.rig_status()?.state,
                        RigState::Homing | RigState::Stopping
                    ),
                    _ => false,
                });
            }
            let status = device.rig_status()?;
            observer.progress(&Progress::Homing {
                elapsed_us: device.now_us() - start_us,
                at_most_us,
                position_um: status.position_um,
            });
            Ok(!matches!(
                status.state,
                RigState::Homing | RigState::Stopping
            ))
        })?;
        match found {
            Some((repeat_steps, shift_steps)) => Ok(Homed {
                repeat_steps,
                shift_steps,
                duration_us: self.now_us() - start_us,
            }),
            None => Err(ClientError::NotHomed {
                fault: self.rig_status()?.fault,
                link_lost,
            }),
        }
    }

    /// Waits until a run ends, however it ends, and returns the device's record of it.
    ///
    /// # Errors
    /// [`ClientError::Overdue`], [`Missing::Record`], or as [`Device::call`].
    pub fn wait_run(
        &mut self,
        accepted: &RunAccepted,
        observer: &mut dyn Observer,
    ) -> Result<RunRecord, ClientError> {
        observer.begun(&Begun::Run(*accepted));
        let total_us = accepted.total_ticks.div_ceil(100);
        let (mut elapsed_us, mut paused_us, mut held_since_us) = (0, 0_u64, None);
        // Whether the present hold has already extended the time limit.
        let mut granted = false;
        self.wait("the run", total_us, observer, |device, event, observer| {
            if let Some(event) = event {
                return Ok(match event.what {
                    What::Rig(RigEvent::RunEnded { run, .. }) if run == accepted.run => {
                        ActionState::Ended
                    }
                    What::Rig(RigEvent::Held { .. }) => {
                        held_since_us = Some(event.time_us);
                        ActionState::Running
                    }
                    What::Rig(RigEvent::Resumed) => {
                        let held_us = held_since_us
                            .take()
                            .map_or(0, |since_us| event.time_us.saturating_sub(since_us));
                        paused_us = paused_us.saturating_add(held_us);
                        match std::mem::take(&mut granted) {
                            true => ActionState::Running,
                            false => ActionState::Extended(device.detour_us(accepted)?),
                        }
                    }
                    _ => ActionState::Running,
                });
            }
            let status = device.rig_status()?;
            if status.run != accepted.run {
                return Ok(ActionState::Ended);
            }
            if status.state == RigState::Running && held_since_us.is_none() {
                elapsed_us = status.elapsed_us.saturating_sub(paused_us).min(total_us);
            }
            observer.progress(&Progress::Run {
                elapsed_us,
                total_us,
                stroke: status.stroke,
                strokes: u32::from(accepted.requested.cycles) * 2,
                position_um: status.position_um,
                held: status.state == RigState::Held,
            });
            Ok(match status.state {
                RigState::Stopping if !granted => {
                    granted = true;
                    ActionState::Extended(device.detour_us(accepted)?)
                }
                RigState::Running | RigState::Stopping => ActionState::Running,
                RigState::Held => ActionState::Paused,
                _ => ActionState::Ended,
            })
        })?;
        let record = self.run_record()?;
        if record.run != accepted.run || record.outcome != RunOutcome::Complete {
            self.deliver_last(observer);
        }
        // While this process was suspended, the start button may have begun another run.
        if record.run != accepted.run {
            let (run, last) = (accepted.run, record.run);
            return Err(self.unanswered("the run", Missing::Record { run, last }));
        }
        Ok(record)
    }

    /// Longest delay of a run by a hold, us, without the hold itself: braking with the rig's deceleration, and
    /// accelerating again as the run does.
    fn detour_us(&mut self, accepted: &RunAccepted) -> Result<u64, ClientError> {
        let key = SettingKey::StopAccelUmS2;
        let stop_um_s2 = self.call(GetSetting { key })?.value;
        let strokes = [accepted.forward, accepted.back];
        let longest = |of: fn(&Stroke) -> u64| strokes.iter().map(of).max().unwrap_or(0);
        let peak_um_s = longest(|stroke| stroke.peak_um_s.into());
        let brakes_us = peak_um_s * 1_000_000 / u64::from(stop_um_s2.max(1));
        Ok(brakes_us + longest(|stroke| stroke.ramp_ticks) / 100)
    }

    /// Delivers the events after the end of a motion: the rig reports the end first, then its cause, such as a fault.
    /// An error is left to the next request.
    fn deliver_last(&mut self, observer: &mut dyn Observer) {
        let _ = self.fetch_events();
        self.deliver(observer);
    }

    /// Waits until a move ends, successfully or not, and returns its result and the rig's status. The move is complete
    /// only if nothing has moved the carriage since: while this process was suspended, the rig may have stopped, and
    /// its start button may have homed it.
    ///
    /// # Errors
    /// [`ClientError::Overdue`], or as [`Device::call`].
    pub fn wait_move(
        &mut self,
        accepted: &MoveAccepted,
        observer: &mut dyn Observer,
    ) -> Result<(RunOutcome, RigStatus), ClientError> {
        observer.begun(&Begun::Move(*accepted));
        let begun_us = self.now_us();
        let total_us = accepted.stroke.duration_ticks.div_ceil(100);
        let (mut link_lost, mut last) = (false, None);
        self.wait("the move", total_us, observer, |device, event, observer| {
            link_lost |= event.is_some_and(|event| event.what == What::LinkLost);
            last = event.map_or(last, |event| match event.what {
                What::Rig(
                    what @ (RigEvent::Moved { .. }
                    | RigEvent::Stopped { .. }
                    | RigEvent::Homed { .. }
                    | RigEvent::RunStarted { .. }),
                ) => Some(what),
                _ => last,
            });
            // Events only trigger an early check: an older one may still be in transit.
            let status = device.rig_status()?;
            observer.progress(&Progress::Run {
                elapsed_us: (device.now_us() - begun_us).min(total_us),
                total_us,
                stroke: 0,
                strokes: 1,
                position_um: status.position_um,
                held: false,
            });
            Ok(!matches!(
                status.state,
                RigState::Moving | RigState::Stopping
            ))
        })?;
        let status = self.rig_status()?;
        let is_last = last.is_none_or(|last| matches!(last, RigEvent::Moved { .. }));
        let outcome = match status.fault {
            Some(fault) => RunOutcome::Faulted(fault),
            None if is_last && status.position_steps == accepted.to_steps => RunOutcome::Complete,
            None if link_lost => RunOutcome::LinkLost,
            None => RunOutcome::Stopped,
        };
        if outcome != RunOutcome::Complete {
            self.deliver_last(observer);
        }
        Ok((outcome, status))
    }

    /// Waits until the carriage has braked and returns the rig's status. Does not wait for the end of a run.
    ///
    /// # Errors
    /// [`ClientError::Overdue`], or as [`Device::call`].
    pub fn wait_rest(&mut self, observer: &mut dyn Observer) -> Result<RigStatus, ClientError> {
        self.wait("the stop", LONGEST_STOP_US, observer, |device, _, _| {
            let state = device.rig_status()?.state;
            Ok(!matches!(state, RigState::Moving | RigState::Stopping))
        })?;
        self.rig_status()
    }

    /// Fetches the recording of the capsule's last actuation. Waits for the end of the actuation, because the recording
    /// grows until then.
    pub fn trace(&mut self) -> Result<Recorded, ClientError> {
        let mut recorded = Recorded::default();
        while moves(self.capsule_status()?.state) {
            self.idle(POLL_US, &mut Unobserved)?;
        }
        loop {
            let from = recorded.points.len() as u32;
            let part = self.call(capsule::GetTrace { from })?;
            if part.actuation != recorded.actuation && from > 0 {
                recorded = Recorded::default();
                continue;
            }
            recorded.actuation = part.actuation;
            if part.points.is_empty() {
                return Ok(recorded);
            }
            recorded.points.extend(part.points);
            if recorded.points.len() > MOST_POINTS {
                return Err(self.wrong_response("GetTrace"));
            }
        }
    }

    /// Waits until an actuation of the capsule has ended, successfully or not, and its motor is at rest. Returns the
    /// device's record of it.
    ///
    /// # Errors
    /// [`ClientError::Overdue`], or as [`Device::call`].
    pub fn wait_actuation(
        &mut self,
        accepted: &ActuationAccepted,
        observer: &mut dyn Observer,
    ) -> Result<ActuationRecord, ClientError> {
        observer.begun(&Begun::Actuation(*accepted));
        let start_us = self.now_us();
        let at_most_us = u64::from(accepted.timeout_ms) * 1_000;
        self.wait(
            "the actuation",
            at_most_us,
            observer,
            |device, event, observer| {
                if let Some(event) = event {
                    return Ok(matches!(
                        event.what,
                        What::Capsule(CapsuleEvent::Ended { actuation, .. })
                            if actuation == accepted.actuation
                    ));
                }
                let status = device.capsule_status()?;
                observer.progress(&Progress::Actuation {
                    elapsed_us: device.now_us() - start_us,
                    at_most_us,
                    thread_um: status.thread_um,
                    current_ma: status.current_ma,
                });
                Ok(!moves(status.state))
            },
        )?;
        self.final_record(observer)
            .map_err(|error| while_moving("the actuation", error))
    }

    /// Returns the record of the actuation that has just ended, once it no longer changes: while braking, the motor
    /// still winds a tenth of a millimetre of thread.
    fn final_record(
        &mut self,
        observer: &mut dyn Observer,
    ) -> Result<ActuationRecord, ClientError> {
        let mut record = self.actuation_record()?;
        loop {
            self.idle(BRAKING_US, observer)?;
            let later = self.actuation_record()?;
            if later == record || later.actuation != record.actuation {
                return Ok(record);
            }
            record = later;
        }
    }

    /// Waits for `duration_us` of link time with keep-alives; passes telemetry and events to the observer.
    pub fn idle(
        &mut self,
        duration_us: u64,
        observer: &mut dyn Observer,
    ) -> Result<(), ClientError> {
        let end_us = self.now_us().saturating_add(duration_us);
        while self.now_us() < end_us {
            let until_us = self.now_us().saturating_add(self.keep_alive_us).min(end_us);
            self.listen(until_us)?;
            self.keep_alive()?;
            self.deliver(observer);
        }
        self.fetch_events()?;
        self.deliver(observer);
        Ok(())
    }

    /// Receives for `duration_us` of link time without sending requests of its own, and delivers everything that
    /// arrives. Questions from other processes are still sent.
    pub fn observe(
        &mut self,
        duration_us: u64,
        observer: &mut dyn Observer,
    ) -> Result<(), ClientError> {
        let end_us = self.now_us().saturating_add(duration_us);
        while self.now_us() < end_us {
            self.step(end_us)?;
            if !self.inbox.early.is_empty() {
                self.fetch_events()?;
            }
            self.deliver(observer);
        }
        Ok(())
    }

    /// Waits until the last stop, if any, is confirmed.
    ///
    /// # Errors
    /// [`Missing::Stop`] if the device did not confirm, or the link's.
    pub fn settle(&mut self) -> Result<(), ClientError> {
        while self.stop.unconfirmed {
            self.step(u64::MAX)?;
        }
        Ok(())
    }

    /// Forgets the stop requested by the interrupt or by another process, so that commands are sent again. For a
    /// process that continues after a stop, once it is settled.
    pub fn forget_stop(&mut self) {
        self.stop.requested = None;
        self.link.forget_stop();
    }

    /// Sends nothing for `duration_us` of link time, as if the host had disappeared, except the operator's stop.
    ///
    /// # Errors
    /// The link's, or [`Missing::Stop`].
    pub fn fall_silent(&mut self, duration_us: u64) -> Result<(), ClientError> {
        self.listen(self.now_us().saturating_add(duration_us))
    }

    /// As [`Device::wait_for`], but reports a silent link as a machine that may be moving.
    fn wait<C: Into<ActionState>>(
        &mut self,
        action: &'static str,
        at_most_us: u64,
        observer: &mut dyn Observer,
        state: impl FnMut(&mut Self, Option<&Event>, &mut dyn Observer) -> Result<C, ClientError>,
    ) -> Result<(), ClientError> {
        let waited = self.wait_for(action, at_most_us, observer, state);
        // Record what came before an error, too.
        self.deliver_telemetry(observer);
        waited.map_err(|error| while_moving(action, error))
    }

    /// Waits until `state` returns [`ActionState::Ended`]. It is called with each event, and every `keep_alive_us`
    /// without one, when it requests the device's status. The request is also the keep-alive, and shows the end even if
    /// its event was lost.
    fn wait_for<C: Into<ActionState>>(
        &mut self,
        action: &'static str,
        at_most_us: u64,
        observer: &mut dyn Observer,
        mut state: impl FnMut(&mut Self, Option<&Event>, &mut dyn Observer) -> Result<C, ClientError>,
    ) -> Result<(), ClientError> {
        let start_us = self.now_us();
        let mut start_clock = self.clock;
        let mut limit_us = at_most_us.saturating_add(OVERDUE_US);
        let mut asked_us = start_us;
        let mut over = false;
        loop {
            if !self.inbox.early.is_empty() {
                self.fetch_events()?;
            }
            while let Some(event) = self.inbox.events.pop_front() {
                observer.event(&event);
                match state(self, Some(&event), observer)?.into() {
                    ActionState::Ended => over = true,
                    ActionState::Extended(us) => limit_us = limit_us.saturating_add(us),
                    ActionState::Running | ActionState::Paused => {}
                }
            }
            self.deliver_telemetry(observer);
            if over {
                return Ok(());
            }
            self.pace(observer)?;
            observer.turn(self.now_us(), self.clock);
            let now_us = self.now_us();
            if now_us >= asked_us.saturating_add(self.keep_alive_us) {
                match state(self, None, observer)?.into() {
                    ActionState::Ended => {
                        // The action has ended, so an event that has not arrived by now was lost.
                        over = true;
                        self.fetch_events()?;
                        continue;
                    }
                    ActionState::Paused => limit_us = limit_us.saturating_add(now_us - asked_us),
                    ActionState::Extended(us) => limit_us = limit_us.saturating_add(us),
                    ActionState::Running => {}
                }
                asked_us = now_us;
                start_clock = start_clock.or(self.clock);
                // Compare the time of the request: the observer may have taken long since the answer.
                if self.passed_us(start_us, start_clock, now_us) > limit_us {
                    self.urgent(Urgent::Stop)?;
                    return Err(ClientError::Overdue {
                        place: self.place(),
                        action,
                        limit_ms: limit_us / 1_000,
                    });
                }
            }
            self.step(asked_us.saturating_add(self.keep_alive_us))?;
        }
    }

    /// Time until `now_us` since the link's clock was at `start_us` and the device's at `start_clock`, us. It counts by
    /// the device's clock, so that a slow emulated device is not overdue. A clock slower than [`SLOWEST`] counts as
    /// broken.
    fn passed_us(&self, start_us: u64, start_clock: Option<Clock>, now_us: u64) -> u64 {
        let passed_us = now_us - start_us;
        let behind_us = start_clock
            .zip(self.clock)
            .map_or(0, |(then, now)| now.behind_us(then));
        passed_us.saturating_sub(behind_us).max(passed_us / SLOWEST)
    }

    /// Sends the pacer's request. After a stop it is dropped, because a hold or a resume then has no effect.
    pub(crate) fn pace(&mut self, observer: &mut dyn Observer) -> Result<(), ClientError> {
        let Some(pace) = self.pacer.as_mut().and_then(|pacer| pacer()) else {
            return Ok(());
        };
        let answer = match pace {
            Pace::Hold => self.call(rig::Hold),
            Pace::Resume => self.call(rig::Resume),
        };
        match answer {
            Ok(_) | Err(ClientError::Interrupted { .. }) => Ok(()),
            Err(ClientError::Refused { refusal, .. }) => {
                observer.refused(pace, &refusal);
                Ok(())
            }
            Err(error) => Err(error),
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::link::{Link, LinkError};

    /// A link whose clock shows this, us.
    pub struct At(pub u64);

    impl Link for At {
        fn place(&self) -> String {
            "nowhere".to_owned()
        }
        fn now_us(&self) -> u64 {
            self.0
        }
        fn send(&mut self, _: &[u8]) -> Result<(), LinkError> {
            Ok(())
        }
        fn receive(&mut self, _: &mut [u8], _: u64) -> Result<usize, LinkError> {
            Ok(0)
        }
    }

    #[test]
    fn a_clock_that_stands_makes_no_action_endless() {
        let clock = |ahead_us: i64| {
            Some(Clock {
                ahead_us: (ahead_us, ahead_us),
            })
        };
        let mut device = Device::new(Box::new(At(1_000_000)), 1);
        assert_eq!(device.passed_us(0, None, 1_000_000), 1_000_000);
        for (behind_us, passed_us) in [
            (0, 1_000_000),
            (600_000, 400_000),
            (950_000, 50_000),
            (1_000_000, 50_000),
        ] {
            device.clock = clock(behind_us);
            assert_eq!(
                device.passed_us(0, clock(0), 1_000_000),
                passed_us,
                "{behind_us}"
            );
        }
    }
}
