//! Control's decisions: requests, notices, button and clock in; orders, replies and events out. Pure: the
//! rest of the rig is a trait, so that the host tests run what the control task runs.

use crate::{
    commands::{Context, execute, press_button},
    execution::Order,
    machine::{Action, Actions, Command, Event, Machine, Now, PathEnd},
    settings::Settings,
};
use device::{
    common::{About, Change, Effect, Surroundings},
    retained::{EStop, Retained},
    service::Answers,
    settings::SettingsStore,
    store::StorageFailed,
};
use embedded_storage_async::nor_flash::NorFlash;
use motion::{axis::Axis, units::StepPosition};
use protocol::{
    error::Refusal,
    events::EventRing,
    rig::{RigEvent, RigFault, RigHardware, RigHealth, RigState},
    settings::SettingKey,
    system::{Clock, DeviceKind, ResetCause, Urgent, What},
    table::{Impact, Reply, Request},
};

/// Interval of [`Control::tick`].
pub const ROUND_US: u64 = 10_000;
/// Rounds that the start button must stay down to count as pressed: 30 ms, longer than its contact bounces.
const BUTTON_ROUNDS: u8 = 3;
/// A press within this time after a motion starts nothing, us: it was probably meant to stop the motion.
const MEANT_TO_STOP_US: u64 = 1_000_000;

/// The rest of the rig, as control sees it.
pub trait Rig {
    /// Time, position and inputs.
    fn now(&self) -> Now;
    /// The start button is down, not filtered.
    fn button_is_down(&self) -> bool;
    /// Stroke in progress, from 0.
    fn stroke(&self) -> u32;
    /// Counters of link, switches and stack; control fills in the others.
    fn health(&self) -> RigHealth;
    /// Findings about step timer, capture timer and pins.
    fn hardware(&self) -> RigHardware;
    /// Executes a path.
    fn start(&mut self, order: Order);
    /// Decelerates to rest.
    fn stop_path(&mut self);
    /// Ends the pulses at once.
    fn cut(&mut self);
    /// Clears the latch of the E-stop loop. A loop that is still open sets it again.
    fn rearm_loop(&mut self);
    /// Sets the read-back counter. Only while no pulse can come.
    fn set_position(&mut self, position: StepPosition);
    /// Sets how long a switch must keep its level, us.
    fn set_switch_filter(&mut self, filter_us: u32);
    /// The external clock that was missing at the start is running now.
    fn clock_has_come(&self) -> bool;
    /// Resets, to run with the external clock. The next start takes over the findings and the cause of this one.
    fn restart(&mut self, previous: &Retained, cause: ResetCause);
}

/// The state machine's data for telemetry and the LED.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Snapshot {
    pub state: RigState,
    /// Residual of the step-loss check, steps.
    pub residual_steps: i32,
    /// Converts steps to lengths.
    pub axis: Axis,
}

/// Owns the state machine, the settings and the events.
pub struct Control<R: Rig + Surroundings, F: NorFlash> {
    rig: R,
    machine: Machine,
    settings: SettingsStore<F>,
    events: EventRing,
    previous: Retained,
    reset_cause: ResetCause,
    image_hash: u32,
    underruns: u32,
    /// When the last round was due, and the largest delay of a round.
    round_us: u64,
    late_us: u32,
    /// Rounds in which the button was down, and when the last of them was.
    button_rounds: u8,
    button_us: u64,
    /// Time of the last round in which something moved, us.
    moved_us: Option<u64>,
}

impl<R: Rig + Surroundings, F: NorFlash> Control<R, F> {
    /// Creates control from the data of the previous start and from flash.
    pub fn new(rig: R, flash: F, previous: Retained, cause: ResetCause, image_hash: u32) -> Self {
        let fault = match (cause, previous.latched) {
            _ if rig.chip().clock == Clock::Internal => Some(RigFault::ClockMissing),
            (ResetCause::Panic, _) => Some(RigFault::Panic),
            (ResetCause::Watchdog, _) => Some(RigFault::Watchdog),
            (_, Some(EStop::Loop)) => Some(RigFault::EStopLoop),
            (_, Some(EStop::Frame)) => Some(RigFault::EStopFrame),
            (_, None) => previous.clock_failed.then_some(RigFault::ClockFailed),
        };
        let (store, usable) = SettingsStore::load(flash, |values| Settings::new(values).is_ok());
        let settings = Settings::new(store.values()).unwrap_or(Settings::REFERENCE);
        let round_us = rig.now_us();
        let mut control = Self {
            rig,
            machine: Machine::new(settings, fault, image_hash),
            settings: store,
            events: EventRing::new(),
            previous,
            reset_cause: cause,
            image_hash,
            underruns: 0,
            round_us,
            late_us: 0,
            // A button that is down at the start must be released first.
            button_rounds: BUTTON_ROUNDS,
            button_us: 0,
            moved_us: None,
        };
        control.emit(What::Booted(cause));
        if !usable {
            control.emit(What::Rig(RigEvent::SettingsUnusable));
        }
        control.apply_settings();
        let period_ms = control.settings.values().get(SettingKey::TelemetryMs) as u16;
        control.rig.set_telemetry(period_ms);
        control
    }

    /// The data for telemetry and the LED.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot {
            state: self.machine.state(),
            residual_steps: self.machine.residual(),
            axis: self.machine.settings().axis,
        }
    }

    pub fn rig(&mut self) -> &mut R {
        &mut self.rig
    }

    /// Passes the settings on to the other tasks.
    fn apply_settings(&mut self) {
        let filter_us = self.settings.values().get(SettingKey::SwitchFilterUs);
        self.rig.set_switch_filter(filter_us);
    }

    /// Takes a notice of the motion task or of an interrupt.
    pub fn event(&mut self, event: Event<'_>) {
        if let Event::PathEnded(PathEnd::Underrun, _) = event {
            self.underruns = self.underruns.saturating_add(1);
        }
        let estop = match event {
            Event::Command(Command::EStop) => Some(EStop::Frame),
            Event::LoopOpened => Some(EStop::Loop),
            _ => None,
        };
        let fault = self.machine.fault();
        let now = self.rig.now();
        let mut actions = Actions::default();
        self.machine.handle(&now, event, &mut actions);
        self.perform(&actions);
        // A fault that is latched already stays the reported one, but the stop must survive a reset.
        let is_estop = |fault| matches!(fault, RigFault::EStopLoop | RigFault::EStopFrame);
        if estop.is_some() && fault.is_some_and(|fault| !is_estop(fault)) {
            self.keep_latched(estop);
        }
    }

    /// Keeps an emergency stop for the next start, or forgets it.
    fn keep_latched(&mut self, estop: Option<EStop>) {
        self.previous.latched = estop;
        self.rig.keep_latched(estop);
    }

    /// Changes a setting, in flash first: the settings in force are always those that the next start will find.
    fn change(&mut self, change: Change<Settings>) -> Result<(), StorageFailed> {
        match change {
            Change::Value { setting, settings } => {
                self.settings.set(setting.key, setting.value)?;
                self.machine.set_settings(settings);
                self.emit(What::Rig(RigEvent::SettingChanged(setting.key)));
            }
            Change::Name(name) => self.settings.set_name(name)?,
            Change::Reset => {
                self.settings.reset()?;
                self.machine.set_settings(Settings::REFERENCE);
                self.emit(What::Rig(RigEvent::SettingsReset));
            }
        }
        self.apply_settings();
        Ok(())
    }

    fn health(&self) -> RigHealth {
        RigHealth {
            underruns: self.underruns,
            control_late_us: self.late_us,
            image_hash: self.image_hash,
            ..self.rig.health()
        }
    }

    /// Call it every 10 ms. Checks the button, time-outs, the E-stop loop at rest and a missing clock.
    pub fn tick(&mut self) {
        // Nothing moves without the clock, so a reset loses nothing.
        if self.machine.fault() == Some(RigFault::ClockMissing) && self.rig.clock_has_come() {
            self.rig.restart(&self.previous, self.reset_cause);
        }
        let now = self.rig.now();
        self.round_us += ROUND_US;
        let late_us = now.time_us.saturating_sub(self.round_us);
        self.late_us = self.late_us.max(late_us as u32);
        if self.moves() {
            self.moved_us = Some(now.time_us);
        }
        if !self.rig.button_is_down() {
            self.button_rounds = 0;
        } else if self.button_rounds < BUTTON_ROUNDS
            // After a stall the missed rounds run back to back; a glitch must not count in all of them.
            && now.time_us >= self.button_us.saturating_add(ROUND_US / 2)
        {
            self.button_rounds += 1;
            self.button_us = now.time_us;
            if self.button_rounds == BUTTON_ROUNDS {
                self.press_button();
            }
        }
        self.event(Event::Tick);
        // The break interrupt reports each opening. If its notice is lost, this check finds the loop open; while a
        // fault is latched it does so once.
        let is_known = self.machine.state() == RigState::Faulted && self.previous.latched.is_some();
        if self.rig.now().inputs.estop_loop && !is_known {
            self.event(Event::LoopOpened);
        }
        self.watch_link();
    }

    /// The supply is too low to begin a motion: a reset by brown-out would cut it and lose the position.
    fn is_too_weak(&self) -> bool {
        self.rig.chip().supply_low
    }

    fn moves(&self) -> bool {
        matches!(
            self.machine.state(),
            RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping
        )
    }

    fn press_button(&mut self) {
        let now = self.rig.now();
        let is_meant_to_stop = |moved_us: u64| now.time_us < moved_us + MEANT_TO_STOP_US;
        let may_start = !self.is_too_weak() && !self.moved_us.is_some_and(is_meant_to_stop);
        if !self.moves() && !may_start {
            return self.emit(What::Rig(RigEvent::ButtonIgnored));
        }
        let actions = press_button(&mut self.machine, self.settings.values(), &now);
        let refused = actions.refusal.is_some();
        self.perform(&actions);
        if refused {
            self.emit(What::Rig(RigEvent::ButtonIgnored));
        }
    }

    fn watch_link(&mut self) {
        let before = self.machine.state();
        let timeout_us = self.machine.settings().link_timeout_us;
        if self.moves() && u64::from(self.rig.silence_us()) > timeout_us {
            self.event(Event::LinkSilent);
            if self.machine.state() != before {
                self.emit(What::LinkLost);
            }
        }
    }

    fn perform(&mut self, actions: &Actions) {
        for action in &actions.list {
            match action {
                Action::Start { path, window } => {
                    let settings = self.machine.settings();
                    self.rig.start(Order {
                        path: path.clone(),
                        window: *window,
                        stop_accel: settings.stop_accel,
                        pulse_ticks: settings.pulse_ticks,
                    });
                }
                Action::StopPath => self.rig.stop_path(),
                Action::Cut => self.rig.cut(),
                Action::SetPosition(position) => self.rig.set_position(*position),
                Action::Emit(event) => {
                    if let RigEvent::Faulted(fault) = *event {
                        self.keep_latched(match fault {
                            RigFault::EStopLoop => Some(EStop::Loop),
                            RigFault::EStopFrame => Some(EStop::Frame),
                            _ => None,
                        });
                    }
                    self.emit(What::Rig(*event));
                }
            }
        }
    }

    fn emit(&mut self, what: What) {
        let event = self.events.record(self.rig.now_us(), what);
        self.rig.send_event(&event);
    }
}

impl<R: Rig + Surroundings, F: NorFlash> Answers for Control<R, F> {
    fn request(&mut self, request: Request) -> Reply {
        // Rearm first, so that an opening from now on is a new fault.
        if matches!(request, Request::Acknowledge(_)) {
            self.rig.rearm_loop();
        }
        let starts = match request.impact() {
            Impact::Motion => true,
            Impact::Pace => matches!(request, Request::Resume(_)),
            Impact::None | Impact::Fault | Impact::Flash => false,
        };
        if starts && self.is_too_weak() {
            return Reply::Refused(Refusal::SupplyLow);
        }
        let context = Context {
            now: self.rig.now(),
            stroke: self.rig.stroke(),
            about: About {
                kind: DeviceKind::Rig,
                events: &self.events,
                last_words: self.previous.last_words.as_deref().unwrap_or_default(),
                chip: self.rig.chip(),
                values: self.settings.values(),
                name: self.settings.name(),
            },
            health: matches!(request, Request::GetRigHealth(_)).then(|| self.health()),
            hardware: matches!(request, Request::GetRigHardware(_)).then(|| self.rig.hardware()),
        };
        let executed = execute(request, &mut self.machine, &context);
        let mut reply = executed.reply;
        match executed.effect {
            Effect::None => {}
            Effect::Telemetry { period_ms } => self.rig.set_telemetry(period_ms),
            Effect::Acknowledged => {
                self.keep_latched(None);
                self.emit(What::Acknowledged);
            }
            Effect::Store(change) => {
                if self.rig.chip().supply_low {
                    reply = Reply::Refused(Refusal::SupplyLow);
                } else if self.change(change).is_err() {
                    reply = Reply::Refused(Refusal::StorageFailed);
                }
            }
        }
        self.perform(&executed.actions);
        reply
    }

    fn stop(&mut self, urgent: Urgent) {
        self.event(Event::Command(match urgent {
            Urgent::Stop => &Command::Stop,
            Urgent::EStop => &Command::EStop,
        }));
    }
}
