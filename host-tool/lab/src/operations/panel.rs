//! The known state of one machine, for `watch` and `serve`.

use std::collections::VecDeque;
use std::sync::MutexGuard;
use std::time::{Duration, Instant};

use crate::trials::trial::Screw;
use client::Device;
use client::decimal;
use client::error::ClientError;
use protocol::capsule::{CapsuleEvent, CapsuleStatus};
use protocol::rig::{RigEvent, RigStatus};
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Event, What};
use protocol::table::Telemetry;

/// Interval of telemetry while a machine is observed and nothing is recorded: that of the drawings, ms.
pub const TELEMETRY_MS: u16 = 50;

/// Events kept for the screen.
const KEPT_EVENTS: usize = 60;

/// Time over which samples are counted, and for which a sample's speed stays valid.
const WINDOW: Duration = Duration::from_secs(2);

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Contact {
    /// Not connected; the reason, with the remedy.
    Lost(String),
    /// This process owns the line.
    Owned,
    /// Connected through the broker of this owner.
    Broker(String),
}

/// The last message to the user, such as a confirmed stop or a failed order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Notice {
    Done(String),
    /// Failure or unknown outcome.
    Bad(String),
}

#[derive(Clone, Debug, Default)]
pub struct Quality {
    /// Time from a request to its answer.
    pub round_trip: Option<Duration>,
    /// Time of the last message from the machine.
    pub heard: Option<Instant>,
    /// Arrival times of the latest telemetry samples.
    samples: VecDeque<Instant>,
    /// Samples lost since this program began to watch.
    pub missed: u64,
    /// Blocks of bytes that were not valid frames, in this connection.
    pub bad_frames: u32,
    /// Connections lost since this program began to watch.
    pub losses: u32,
}

impl Quality {
    pub fn samples_per_s(&self, at: Instant) -> usize {
        let recent = self
            .samples
            .iter()
            .filter(|then| at.saturating_duration_since(**then) < WINDOW);
        recent.count() / WINDOW.as_secs() as usize
    }
}

#[derive(Clone, Debug)]
pub struct Panel {
    pub kind: DeviceKind,
    pub place: String,
    pub contact: Contact,
    /// Status of a rig, kept up to date by its telemetry.
    pub rig: Option<RigStatus>,
    /// Status of a capsule, kept up to date by its telemetry.
    pub capsule: Option<CapsuleStatus>,
    /// The farthest position in the present run, um. It shows the length of the strokes once the carriage has turned.
    reach: Option<(u32, i32)>,
    /// A sample has shown another state than the status, so the rest of the status may be outdated.
    changed: bool,
    /// Speed of the carriage, positive away from home, and the time of its measurement.
    speed: Option<(i32, Instant)>,
    pub quality: Quality,
    /// Device time in us and text of the latest events, newest last.
    pub events: VecDeque<(u64, String)>,
    pub notice: Option<Notice>,
}

/// The warning for a user who takes a line over while the machine moves.
pub const MOVES_ALREADY: &str = "SOMETHING MOVES that no process here has begun: the one that did has ended, or it was the start button. It stops by itself within 1 s, except a run that was to finish without its host; a stop works as ever";

impl Panel {
    /// The panel before the first connection.
    pub fn new(kind: DeviceKind, place: String) -> Self {
        Self {
            kind,
            place,
            contact: Contact::Lost("connecting".to_owned()),
            rig: None,
            capsule: None,
            reach: None,
            changed: false,
            speed: None,
            quality: Quality::default(),
            events: VecDeque::new(),
            notice: None,
        }
    }

    /// Whether something moves, according to the machine's last message.
    pub fn moves(&self) -> bool {
        use protocol::rig::RigState::{Homing, Moving, Running, Stopping};
        let rig = self.rig.as_ref().map(|status| status.state);
        let capsule = self.capsule.as_ref().map(|status| status.state);
        matches!(rig, Some(Homing | Running | Moving | Stopping))
            || capsule.is_some_and(client::moves)
    }

    /// Adds a sample; `missed` were lost before it.
    pub fn sample(&mut self, sample: &Telemetry, missed: u16, at: Instant) {
        self.quality.missed += u64::from(missed);
        self.quality.heard = Some(at);
        self.quality.samples.push_back(at);
        while let Some(first) = self.quality.samples.front()
            && at.saturating_duration_since(*first) >= WINDOW
        {
            self.quality.samples.pop_front();
        }
        match (sample, &mut self.rig, &mut self.capsule) {
            (Telemetry::Rig(sample), Some(status), _) => {
                self.changed |= status.state != sample.state;
                status.time_us = sample.time_us;
                status.state = sample.state;
                status.inputs = sample.inputs;
                status.stroke = sample.stroke;
                status.position_steps = sample.position_steps;
                status.position_um = position_um(status, sample.position_steps);
                self.speed = Some((sample.speed_um_s, at));
                self.note_reach();
            }
            (Telemetry::Capsule(sample), _, Some(status)) => {
                self.changed |= status.state != sample.state;
                status.time_us = sample.time_us;
                status.state = sample.state;
                status.thread_um = sample.thread_um;
                status.current_ma = sample.current_ma;
                status.battery_mv = sample.battery_mv;
            }
            _ => {}
        }
    }

    /// Updates the panel with a rig's status.
    pub fn rig_status(&mut self, status: &RigStatus, at: Instant) {
        // Without telemetry, derive the speed from two positions.
        if self.quality.samples_per_s(at) == 0
            && let Some(before) = &self.rig
            && let Some(us @ 1..) = status.time_us.checked_sub(before.time_us)
        {
            let way_um = i64::from(status.position_um) - i64::from(before.position_um);
            let speed = way_um * 1_000_000 / i64::try_from(us).unwrap_or(i64::MAX);
            self.speed = i32::try_from(speed).ok().map(|speed| (speed, at));
        }
        self.rig = Some(*status);
        self.quality.heard = Some(at);
        self.note_reach();
    }

    fn note_reach(&mut self) {
        let Some(status) = self.rig.filter(in_run) else {
            return;
        };
        let before = self.reach.filter(|(run, _)| *run == status.run);
        let farthest = before.map_or(0, |(_, um)| um);
        self.reach = Some((status.run, farthest.max(status.position_um)));
    }

    /// Whether the state has changed since the last call. If so, it is time to request the status.
    pub fn take_changed(&mut self) -> bool {
        std::mem::take(&mut self.changed)
    }

    /// Progress of the present run, in thousandths of a stroke.
    pub fn run_thousandths(&self) -> Option<u64> {
        let status = self.rig.filter(in_run)?;
        // The length of the strokes is known after the first reversal.
        let length_um = match self.reach {
            Some((run, um)) if run == status.run && status.stroke > 0 => i64::from(um),
            _ => i64::from(status.stroke_um),
        };
        let away = i64::from(status.position_um).max(0) * 1_000 / length_um.max(1);
        let part = match status.stroke % 2 {
            0 => away.min(1_000),
            _ => 1_000 - away.min(1_000),
        };
        Some(u64::from(status.stroke) * 1_000 + part.unsigned_abs())
    }

    /// Updates the panel with a capsule's status.
    pub fn capsule_status(&mut self, status: &CapsuleStatus, at: Instant) {
        self.capsule = Some(*status);
        self.quality.heard = Some(at);
    }

    pub fn event(&mut self, event: &Event) {
        if self.events.len() == KEPT_EVENTS {
            self.events.pop_front();
        }
        self.events.push_back((event.time_us, event_text(event)));
    }

    /// Speed of the carriage in um/s, if known at this moment.
    pub fn speed_um_s(&self, at: Instant) -> Option<i32> {
        let (speed, then) = self.speed?;
        (at.saturating_duration_since(then) < WINDOW).then_some(speed)
    }

    /// State and numbers in one line, for a reader without a terminal.
    pub fn line(&self, at: Instant) -> String {
        let mut parts = vec![];
        if let Contact::Lost(why) = &self.contact {
            parts.push(format!("no contact: {why}"));
        } else if let Some(status) = &self.rig {
            parts.push(format!("{:?}", status.state));
            if !status.homed {
                parts.push("not homed".to_owned());
            }
            parts.push(format!("{} mm", millimetres(status.position_um)));
            if let Some(speed) = self.speed_um_s(at) {
                parts.push(format!("{} mm/s", millimetres(speed)));
            }
            if in_run(status) {
                parts.push(run_text(status));
            }
            parts.extend(status.fault.map(|fault| format!("fault: {fault}")));
        } else if let Some(status) = &self.capsule {
            parts.push(format!("{:?}", status.state));
            parts.push(format!("{} mm of thread", millimetres(status.thread_um)));
            parts.push(format!("{} mA", status.current_ma));
            parts.push(format!(
                "battery {} V",
                decimal::write(status.battery_mv.into(), 3)
            ));
            parts.extend(status.fault.map(|fault| format!("fault: {fault}")));
        }
        if self.quality.missed > 0 {
            parts.push(format!("{} samples missed", self.quality.missed));
        }
        format!(
            "{}: {}",
            client::identity::kind_name(self.kind),
            parts.join(", ")
        )
    }
}

/// Micrometres as millimetres with three decimals.
pub fn millimetres(um: i32) -> String {
    decimal::fixed(um.into(), 3)
}

/// Position of the carriage at this step, with the screw of the rig's status. Rounded as the rig does, half away from
/// home.
pub fn position_um(status: &RigStatus, position_steps: i32) -> i32 {
    let nm = Screw::from(status).nm(position_steps.unsigned_abs().into());
    let um = i32::try_from((nm + 500) / 1_000).unwrap_or(i32::MAX);
    position_steps.signum() * um
}

pub fn in_run(status: &RigStatus) -> bool {
    use protocol::rig::RigState::{Held, Running, Stopping};
    matches!(status.state, Running | Held | Stopping) && status.strokes > 0
}

pub fn run_text(status: &RigStatus) -> String {
    let tenths = status.elapsed_us / 100_000;
    format!(
        "run {}, stroke {} of {}, {}.{} s",
        status.run,
        status.stroke.saturating_add(1).min(status.strokes),
        status.strokes,
        tenths / 10,
        tenths % 10
    )
}

/// Approximate remaining time of the run, s; known from its first stroke on.
pub fn remaining_s(status: &RigStatus, thousandths: u64) -> Option<u64> {
    let all = u64::from(status.strokes) * 1_000;
    if thousandths < 1_000 || thousandths > all || status.state != protocol::rig::RigState::Running
    {
        return None;
    }
    let left_us = status.elapsed_us.saturating_mul(all - thousandths) / thousandths;
    Some(left_us.div_ceil(1_000_000))
}

pub fn event_text(event: &Event) -> String {
    match event.what {
        What::Booted(cause) => format!("the device started: {cause:?}"),
        What::Acknowledged => "fault acknowledged".to_owned(),
        What::LinkLost => "the device has not heard from the host for too long".to_owned(),
        What::Rig(event) => rig_text(event),
        What::Capsule(CapsuleEvent::Started { actuation, kind }) => {
            format!("actuation {actuation} began: {kind:?}")
        }
        What::Capsule(CapsuleEvent::Ended { actuation, outcome }) => {
            format!("actuation {actuation} ended: {outcome:?}")
        }
        What::Capsule(CapsuleEvent::Faulted(fault)) => format!("fault: {fault}"),
        What::Capsule(CapsuleEvent::StorageFailed) => "the flash could not be written".to_owned(),
        What::Capsule(CapsuleEvent::SettingChanged(key)) => setting_changed(key),
        What::Capsule(CapsuleEvent::SettingsReset) => SETTINGS_RESET.to_owned(),
        What::Capsule(CapsuleEvent::SettingsUnusable) => SETTINGS_UNUSABLE.to_owned(),
    }
}

const SETTINGS_RESET: &str = "all settings are at their defaults";
/// The warning for a machine whose stored settings are unusable.
pub const SETTINGS_UNUSABLE: &str = "stored settings cannot be used: defaults are in force instead";

fn setting_changed(key: SettingKey) -> String {
    format!("setting {} changed", key.name())
}

fn rig_text(event: RigEvent) -> String {
    match event {
        RigEvent::Homed {
            repeat_steps,
            shift_steps,
        } => format!("homed; passes differ by {repeat_steps} steps, shift {shift_steps} steps"),
        RigEvent::RunStarted { run } => format!("run {run} began"),
        RigEvent::StrokeDone {
            stroke,
            residual_steps,
        } => format!(
            "stroke {} done, residual {residual_steps} steps",
            stroke.saturating_add(1)
        ),
        RigEvent::RunEnded { run, outcome } => format!("run {run} ended: {outcome:?}"),
        RigEvent::Stopped { position_steps } => format!("stopped at {position_steps} steps"),
        RigEvent::Faulted(fault) => format!("fault: {fault}"),
        RigEvent::Held { position_steps } => format!("held at {position_steps} steps"),
        RigEvent::Resumed => "resumed".to_owned(),
        RigEvent::Moved { position_steps } => format!("moved to {position_steps} steps"),
        RigEvent::SettingChanged(key) => setting_changed(key),
        RigEvent::SettingsReset => SETTINGS_RESET.to_owned(),
        RigEvent::SettingsUnusable => SETTINGS_UNUSABLE.to_owned(),
        RigEvent::ButtonIgnored => "the start button was pressed; nothing could start".to_owned(),
    }
}

/// Requests the machine's status, and updates the panel with it and with the round-trip time. Does not lock the panel
/// while waiting.
pub fn ask<'a>(
    device: &mut Device,
    panel: impl Fn() -> MutexGuard<'a, Panel>,
) -> Result<(), ClientError> {
    let begin_us = device.now_us();
    let kind = panel().kind;
    match kind {
        DeviceKind::Rig => {
            let status = device.rig_status()?;
            panel().rig_status(&status, Instant::now());
        }
        DeviceKind::Capsule => {
            let status = device.capsule_status()?;
            panel().capsule_status(&status, Instant::now());
        }
    }
    let mut panel = panel();
    panel.quality.round_trip = Some(Duration::from_micros(device.now_us() - begin_us));
    panel.quality.bad_frames = device.rejected_frames();
    Ok(())
}
