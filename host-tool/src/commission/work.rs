//! A session with a machine in commissioning: what all measurements need.

use std::path::PathBuf;

use protocol::error::Refusal;
use protocol::rig::{
    self, LinkLossPolicy, MoveTo, RigEvent, RigFault, RigInputs, RigState, RigStatus, Run,
    RunAccepted, RunRecord, RunTiming,
};
use protocol::settings::SettingKey;
use protocol::system::{Event, Urgent, What};
use serde_json::{Map, Value};

use crate::client::{Device, Homed, Observer, Progress, homing_limit_us};
use crate::commission::hands::{Act, Hands, Part, Reading};
use crate::commission::record::Subject;
use crate::decimal;
use crate::error::ClientError;

/// Interval between two looks at the machine, us.
pub(crate) const LOOK_US: u64 = 50_000;
/// An effect that has not come in this time after the act does not come, us.
const SETTLE_US: u64 = 500_000;
/// How much longer than announced homing may take, us.
const HOMING_MARGIN_US: u64 = 3_000_000;
/// For so long a board that was reset or plugged in again is looked for, us.
const RETURN_US: u64 = 30_000_000;

/// Why a measurement ended before its end.
#[derive(Debug)]
pub enum Halt {
    /// The operator left.
    Left,
    /// Nothing can be said, for this reason.
    NotShown(String),
    /// Something is wrong, and this is what.
    Defect(String),
    /// The machine or the link to it.
    Client(ClientError),
    /// The bench's hands are gone.
    NoHands(String),
}

impl From<ClientError> for Halt {
    fn from(error: ClientError) -> Self {
        match error {
            ClientError::Interrupted { .. } => Self::Left,
            ClientError::Refused { refusal, .. } => Self::Defect(refused(&refusal)),
            ClientError::Overdue { .. } => Self::Defect(error.to_string()),
            error => Self::Client(error),
        }
    }
}

/// A refusal that nobody expected here.
fn refused(refusal: &Refusal) -> String {
    match refusal {
        Refusal::RigFaulted(fault) => fault_text(*fault),
        refusal => format!("the machine refuses: {refusal}"),
    }
}

/// What a fault says about a new machine.
#[must_use]
pub fn fault_text(fault: RigFault) -> String {
    match fault {
        RigFault::ReadBack { commanded, counted } => format!(
            "the read-back does not count the steps ({} of {}): the jumper D2-A0 is missing or loose",
            counted.unsigned_abs(),
            commanded.unsigned_abs()
        ),
        RigFault::EStopLoop => {
            "the E-stop loop opened, and nobody was asked to open it: noise on its wire, a loose contact, or the carriage on an end-of-travel switch".to_owned()
        }
        fault => fault.to_string(),
    }
}

/// What the measurements may be told.
#[derive(Clone, Debug)]
pub struct Options {
    /// Cycles of the read-back test, of two strokes each.
    pub read_back_cycles: u16,
    /// Cycles of the run at the end.
    pub cycles: u16,
    /// How long the clocks are compared, us.
    pub clock_us: u64,
    /// The image that should be on the board.
    pub image: Option<PathBuf>,
}

/// Opens the machine again after it was reset or unplugged; the text says why not.
pub type Reopen<'a> = dyn Fn() -> Result<Device, String> + 'a;

/// How homing ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HomeEnd {
    /// At 0.
    Homed(Homed),
    /// With a latched fault; whether the far limit opened under way.
    Fault(RigFault, bool),
}

/// A session with a machine.
pub struct Work<'a> {
    /// The machine.
    pub device: Device,
    /// What it is.
    pub subject: Subject,
    /// What the user wants.
    pub options: Options,
    hands: &'a mut dyn Hands,
    say: &'a mut dyn FnMut(&str),
    reopen: &'a Reopen<'a>,
    /// The motor supply, as far as it is known.
    supply: Option<bool>,
    /// What the present step has measured so far.
    measured: Map<String, Value>,
}

impl<'a> Work<'a> {
    /// A new session.
    pub fn new(
        device: Device,
        subject: Subject,
        options: Options,
        hands: &'a mut dyn Hands,
        say: &'a mut dyn FnMut(&str),
        reopen: &'a Reopen<'a>,
    ) -> Self {
        Self {
            device,
            subject,
            options,
            hands,
            say,
            reopen,
            supply: None,
            measured: Map::new(),
        }
    }

    /// Whether somebody is at the machine.
    #[must_use]
    pub fn has_hands(&self) -> bool {
        self.hands.present()
    }

    /// Prints a line.
    pub fn say(&mut self, text: &str) {
        (self.say)(text);
    }

    /// Keeps a measured number; its name has the unit.
    pub fn note(&mut self, name: &str, value: impl Into<Value>) {
        self.measured.insert(name.to_owned(), value.into());
    }

    /// What was measured since the last call.
    pub fn take_measured(&mut self) -> Map<String, Value> {
        std::mem::take(&mut self.measured)
    }

    /// Puts back what [`Work::take_measured`] took.
    pub fn set_measured(&mut self, measured: Map<String, Value>) {
        self.measured = measured;
    }

    /// Value of a setting.
    #[must_use]
    pub fn setting(&self, key: SettingKey) -> u32 {
        self.subject.setting(key)
    }

    /// Number of the board's starts: a new one tells that it was reset.
    #[must_use]
    pub fn boot_id(&self) -> Option<u32> {
        self.device.identity().map(|identity| identity.boot_id)
    }

    /// Lets time pass.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn pause(&mut self, duration_us: u64) -> Result<(), Halt> {
        self.device
            .idle(duration_us, &mut crate::client::Unobserved)?;
        self.unless_left()
    }

    /// Ends a measurement whose operator has left.
    ///
    /// # Errors
    /// [`Halt::Left`]
    pub fn unless_left(&self) -> Result<(), Halt> {
        match self.device.interrupted() {
            Some(_) => Err(Halt::Left),
            None => Ok(()),
        }
    }

    // Hands.

    /// Has something done that no input shows.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn hand(&mut self, part: Part, on: bool) -> Result<(), Halt> {
        let device = &mut self.device;
        let mut keep = || {
            device.idle(LOOK_US, &mut crate::client::Unobserved)?;
            Ok(false)
        };
        self.hands
            .act(Act { part, on }, false, self.say, &mut keep)?;
        self.unless_left()
    }

    /// Has something done whose effect `seen` sees; returns the rig as it was then, or half a second after the act.
    ///
    /// # Errors
    /// [`Halt`]
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
            device.idle(LOOK_US, &mut crate::client::Unobserved)?;
            Ok(false)
        };
        self.hands
            .act(Act { part, on }, true, self.say, &mut watch)?;
        self.unless_left()?;
        self.until(SETTLE_US, seen)
    }

    /// Has something measured.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn read(&mut self, reading: Reading) -> Result<i64, Halt> {
        let value = self.hands.read(reading, self.say)?;
        self.unless_left()?;
        Ok(value)
    }

    /// Switches the motor supply, unless it is known to be so. Without it the carriage can be moved by hand, and the rig
    /// must not trust its position any more.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn supply(&mut self, on: bool) -> Result<(), Halt> {
        if self.supply != Some(on) {
            self.hand(Part::Supply, on)?;
            self.supply = Some(on);
        }
        if on { Ok(()) } else { self.forget_position() }
    }

    /// The motor supply was switched off and not on again.
    #[must_use]
    pub fn supply_is_off(&self) -> bool {
        self.supply == Some(false)
    }

    /// Makes the rig forget where it is: an emergency stop by command, acknowledged. A rig that does not know it anyway
    /// is left alone.
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
    ///
    /// # Errors
    /// [`Halt`]
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
            // Of one who leaves, the rig takes stops only: the fault stays latched until the next session.
            Err(Halt::Left) => Ok(self.device.urgent(Urgent::EStop)?),
            _ => self.forget_position(),
        };
        let ran = ran?;
        forgotten.map(|()| ran)
    }

    /// The carriage in the middle of its travel, without motor supply.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn to_the_middle(&mut self) -> Result<(), Halt> {
        self.supply(false)?;
        self.hand(Part::Carriage, true)
    }

    /// Pulls the cable, plugs it in again and finds the board.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn pull_the_cable(&mut self) -> Result<(), Halt> {
        let device = &mut self.device;
        let mut gone = || {
            Ok(device
                .idle(LOOK_US, &mut crate::client::Unobserved)
                .is_err())
        };
        let act = |on| Act {
            part: Part::Cable,
            on,
        };
        self.hands.act(act(false), true, self.say, &mut gone)?;
        self.hands
            .act(act(true), false, self.say, &mut || Ok(false))
            .and_then(|()| self.unless_left())?;
        self.find_again()
    }

    /// Opens the machine again.
    ///
    /// # Errors
    /// [`Halt::Defect`] if it does not come back.
    pub fn find_again(&mut self) -> Result<(), Halt> {
        // A port is opened exclusively.
        self.device.hang_up();
        let begin = std::time::Instant::now();
        loop {
            match (self.reopen)() {
                Ok(device) => {
                    self.device = device;
                    return self.unless_left();
                }
                Err(why) if begin.elapsed().as_micros() > RETURN_US.into() => {
                    return Err(Halt::Defect(format!("the board does not come back: {why}")));
                }
                Err(_) => {
                    // Fails, but asks whether the operator wants to leave.
                    let _ = self.device.keep_alive();
                    self.unless_left()?;
                    std::thread::sleep(std::time::Duration::from_millis(300));
                }
            }
        }
    }

    // The rig.

    /// The rig's status.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn status(&mut self) -> Result<RigStatus, Halt> {
        let status = self.device.rig_status()?;
        self.unless_left()?;
        Ok(status)
    }

    /// Waits for `seen`, but no longer than `limit_us`; returns the last status.
    ///
    /// # Errors
    /// [`Halt`]
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
            self.pause(LOOK_US)?;
        }
    }

    /// Acknowledges what is latched.
    ///
    /// # Errors
    /// [`Halt::Defect`] if its cause is still there.
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
                Err(Halt::Defect(match status.fault {
                    _ if estop_loop => "the E-stop loop is open at rest: a button is pressed, an end-of-travel switch is actuated, or a wire of the loop is broken".to_owned(),
                    _ if home_flag && far_limit => Refusal::BothSwitchesOpen.to_string(),
                    Some(fault) => fault_text(fault),
                    None => refused(&refusal),
                }))
            }
            other => Ok(other?),
        }
    }

    /// Homes, and watches the far limit meanwhile: a carriage that meets it goes the wrong way, and is cut.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn home(&mut self) -> Result<HomeEnd, Halt> {
        let before = self.status()?;
        self.device.take_events()?;
        let accepted = self.device.home()?;
        let start_us = self.device.now_us();
        let limit_us = homing_limit_us(&accepted) + HOMING_MARGIN_US;
        let mut seen = HomedEvent::default();
        let mut far = false;
        loop {
            self.device.idle(LOOK_US, &mut seen)?;
            self.unless_left()?;
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

    /// The rig homed and at 0, with motor supply.
    ///
    /// # Errors
    /// [`Halt`]
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

    /// Moves to a position at a cautious speed; a fault under way is a defect.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn go_to(&mut self, position_um: u32) -> Result<RigStatus, Halt> {
        let status = self.try_to_go_to(position_um)?;
        match status.fault {
            Some(fault) => Err(Halt::Defect(fault_text(fault))),
            None => Ok(status),
        }
    }

    /// Moves to a position at a cautious speed; a fault under way is in the status.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn try_to_go_to(&mut self, position_um: u32) -> Result<RigStatus, Halt> {
        let speed_um_s = 20_000.min(self.setting(SettingKey::MaxSpeedUmS));
        self.device.call(MoveTo {
            position_um,
            speed_um_s,
        })?;
        let status = self.device.wait_rest()?;
        self.unless_left()?;
        Ok(status)
    }

    /// Starts a slow run over a short stroke, for things that happen within it.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn start_short_run(&mut self, cycles: u16) -> Result<RunAccepted, Halt> {
        let speed = 5_000.min(self.setting(SettingKey::MaxSpeedUmS));
        let accel = 100_000.min(self.setting(SettingKey::MaxAccelUmS2));
        let stroke_um = 10_000.min(self.setting(SettingKey::StrokeUm));
        self.start(by_speed(cycles, stroke_um, speed, accel))
    }

    /// Waits until a run is well under way.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn under_way(&mut self) -> Result<(), Halt> {
        let status = self.until(5_000_000, |status| {
            status.fault.is_some() || status.position_um > 2_000
        })?;
        match status.fault {
            Some(fault) => Err(Halt::Defect(fault_text(fault))),
            None => Ok(()),
        }
    }

    /// Starts a run.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn start(&mut self, run: Run) -> Result<RunAccepted, Halt> {
        let accepted = self.device.run(run)?;
        self.unless_left()?;
        Ok(accepted)
    }

    /// Waits for the end of a run.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn finish(&mut self, accepted: &RunAccepted) -> Result<RunRecord, Halt> {
        let mut tenths = Tenths {
            say: &mut *self.say,
            shown: 0,
        };
        let record = self.device.wait_run(accepted, &mut tenths)?;
        self.unless_left()?;
        Ok(record)
    }

    /// A run that has to end with all its edges; the numbers are kept.
    ///
    /// # Errors
    /// [`Halt`]
    pub fn whole(&mut self, accepted: &RunAccepted, record: &RunRecord) -> Result<(), Halt> {
        self.note("strokes", record.strokes);
        self.note("planned_edges", accepted.edges);
        self.note("commanded_edges", record.commanded_edges);
        self.note("counted_edges", record.counted_edges);
        self.note("worst_residual_steps", record.worst_residual_steps);
        match record.outcome {
            rig::RunOutcome::Complete => {}
            rig::RunOutcome::Faulted(fault) => return Err(Halt::Defect(fault_text(fault))),
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

/// What an end of homing says about a new rig.
#[must_use]
pub fn homing_text(fault: RigFault, met_far_limit: bool) -> String {
    if met_far_limit {
        return "the motor is reversed: homing took the carriage to the left, to the far limit. Motor supply off, turn one motor coil around".to_owned();
    }
    match fault {
        RigFault::EStopLoop => "the E-stop loop opened while homing. If the carriage stands at its left end, the motor is reversed: turn one motor coil around; at its right end, the home flag is not ahead of the end-of-travel switch".to_owned(),
        RigFault::FlagNotFound(_) => format!("{fault}; motor supply, driver current, coupling"),
        fault => fault_text(fault),
    }
}

/// A run by speed, alike in both directions, which stops when it hears no host.
#[must_use]
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

/// Picks the result of homing out of the events.
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

/// Runs shorter than this need no progress, us.
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
