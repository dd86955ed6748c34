//! Owns the state machine and the settings: requests, notices, button and clock in; orders, replies and events out.

use super::watchdog::{Client, check_in};
use crate::{
    board,
    channels::{
        BAD_FRAMES, CUT, GLITCHES, HOME_FLAG_OPEN, Inbound, LAST_FRAME_US, MOTION_WAKE, NOTICES,
        ORDERS, Order, REPLIES, REQUESTS, SESSION, SNAPSHOT, STOP, STROKE, SWITCH_FILTER_US,
        Snapshot, TELEMETRY_CHANGED, TELEMETRY_MS, UART_ERRORS, UNSENT_FRAMES, send_if_free,
    },
    image, panic, stepgen,
    storage::{Failed, Store},
};
use core::sync::atomic::Ordering;
use embassy_futures::select::{Either3, select3};
use embassy_time::{Duration, Instant, Ticker};
use firmware_rig::{
    commands::{Change, Context, Effect, execute, press_button},
    machine::{Action, Actions, Command, Event, Machine, PathEnd},
    periods::Path,
    settings::{NAME_RECORD, Settings, Values},
};
use heapless::String;
use protocol::{
    error::Refusal,
    events::EventRing,
    frame::{Header, Kind, encode},
    rig::{RigEvent, RigFault, RigHealth, RigInputs, RigState},
    settings::{MAX_NAME, SettingKey},
    system::{ResetCause, Urgent, What},
    table::{Reply, Request},
};

const ROUND: Duration = Duration::from_millis(10);
/// So many rounds must the start button be down.
const BUTTON_ROUNDS: u8 = 3;

/// What control knows from the start.
pub struct Start {
    /// Settings in flash.
    pub store: Store,
    /// Latched from the start when the last one ended badly.
    pub fault: Option<RigFault>,
    /// Why the chip was reset.
    pub reset_cause: ResetCause,
    /// Text of the last panic or processor fault.
    pub last_words: String<120>,
    /// Fingerprint of the image.
    pub image_hash: u32,
}

struct Control {
    machine: Machine,
    values: Values,
    name: String<MAX_NAME>,
    store: Store,
    ring: EventRing,
    last_words: String<120>,
    image_hash: u32,
    glitches_at_start: u32,
    underruns: u32,
    /// When the last round was due, and by how much one was late at most.
    round: Instant,
    late_us: u32,
    button_rounds: u8,
}

/// Every 10 ms and at every notice or request.
#[embassy_executor::task]
pub async fn control(start: Start) -> ! {
    let mut control = Control::new(start);
    let mut ticker = Ticker::every(ROUND);
    loop {
        check_in(Client::Control);
        control.publish();
        match select3(NOTICES.receive(), REQUESTS.wait(), ticker.next()).await {
            Either3::First(event) => control.event(event),
            Either3::Second(Inbound::Request(request)) => {
                let reply = control.request(request);
                REPLIES.signal(reply);
            }
            Either3::Second(Inbound::Urgent(urgent)) => {
                control.urgent(urgent);
                REPLIES.signal(Reply::Urgent(urgent));
            }
            Either3::Third(()) => control.tick(),
        }
    }
}

impl Control {
    fn new(start: Start) -> Self {
        let Start {
            mut store,
            fault,
            reset_cause,
            last_words,
            image_hash,
        } = start;
        let (mut values, mut name) = (Values::DEFAULT, String::new());
        let loaded = store.load(|number, record| match number {
            NAME_RECORD => {
                let text = core::str::from_utf8(record).unwrap_or_default();
                name = text.try_into().unwrap_or_default();
            }
            _ => values.load(number, record),
        });
        // A cut of the power within a reset to the defaults may leave values that do not go together.
        let settings = Settings::new(&values).ok().filter(|_| loaded.is_ok());
        let unusable = settings.is_none();
        if unusable {
            values = Values::DEFAULT;
        }
        let settings = settings.unwrap_or(Settings::REFERENCE);
        let mut control = Self {
            machine: Machine::new(settings, fault).with_image(image_hash),
            values,
            name,
            store,
            ring: EventRing::new(),
            last_words,
            image_hash,
            glitches_at_start: 0,
            underruns: 0,
            round: Instant::now(),
            late_us: 0,
            // A button that is down at the start has to be let go first.
            button_rounds: BUTTON_ROUNDS,
        };
        control.emit(What::Booted(reset_cause));
        if unusable {
            control.emit(What::Rig(RigEvent::SettingsUnusable));
        }
        control.apply();
        set_telemetry(control.values.get(SettingKey::TelemetryMs) as u16);
        control
    }

    /// Hands the settings that others need to them.
    fn apply(&self) {
        let filter = self.values.get(SettingKey::SwitchFilterUs);
        SWITCH_FILTER_US.store(filter, Ordering::Relaxed);
    }

    fn publish(&self) {
        let snapshot = Snapshot {
            state: self.machine.state(),
            residual_steps: self.machine.residual(),
            axis: self.machine.settings().axis,
        };
        SNAPSHOT.lock(|cell| cell.set(snapshot));
    }

    fn event(&mut self, event: Event) {
        self.machine
            .set_glitches(glitches().wrapping_sub(self.glitches_at_start));
        if let Event::PathEnded(PathEnd::Underrun, _) = event {
            self.underruns = self.underruns.saturating_add(1);
        }
        let actions = self.machine.event(event, inputs());
        self.perform(actions);
    }

    fn urgent(&mut self, urgent: Urgent) {
        let command = match urgent {
            Urgent::Stop => Command::Stop,
            Urgent::EStop => Command::EStop,
        };
        let mut actions = Actions::new();
        // Neither can be refused.
        let _ = self.machine.command(
            now_us(),
            command,
            stepgen::counted(),
            inputs(),
            &mut actions,
        );
        self.perform(actions);
    }

    fn request(&mut self, request: Request) -> Reply {
        let context = Context {
            now_us: now_us(),
            position: stepgen::counted(),
            inputs: inputs(),
            stroke: STROKE.load(Ordering::Relaxed),
            ring: &self.ring,
            last_words: &self.last_words,
            values: &self.values,
            name: &self.name,
            health: matches!(request, Request::GetRigHealth(_)).then(|| self.health()),
        };
        let mut actions = Actions::new();
        let (mut reply, effect) = execute(request, &mut self.machine, &context, &mut actions);
        match effect {
            Effect::None => {}
            Effect::Telemetry { period_ms } => set_telemetry(period_ms),
            Effect::Acknowledged => {
                panic::keep_latched(None);
                self.emit(What::Acknowledged);
            }
            Effect::Store(change) => {
                if self.change(change).is_err() {
                    reply = Reply::Refused(Refusal::StorageFailed);
                }
            }
        }
        self.perform(actions);
        reply
    }

    /// Flash first: what is in force is what the next start will find.
    fn change(&mut self, change: Change) -> Result<(), Failed> {
        match change {
            Change::Value {
                setting,
                values,
                settings,
            } => {
                let record = Values::record(setting.value);
                self.save(setting.key as u8, &record)?;
                self.values = values;
                self.machine.set_settings(settings);
                self.emit(What::Rig(RigEvent::SettingChanged(setting.key)));
            }
            Change::Name(name) => {
                self.save(NAME_RECORD, name.as_bytes())?;
                self.name = name;
            }
            Change::Reset => {
                if self.save_defaults().is_err() {
                    // The flash holds something that is no log.
                    self.store.erase()?;
                }
                self.name.clear();
                self.values = Values::DEFAULT;
                self.machine.set_settings(Settings::REFERENCE);
                self.emit(What::Rig(RigEvent::SettingsReset));
            }
        }
        self.apply();
        Ok(())
    }

    fn save_defaults(&mut self) -> Result<(), Failed> {
        for key in SettingKey::ALL {
            let default = key.range().default;
            if self.values.get(key) != default {
                self.save(key as u8, &Values::record(default))?;
            }
        }
        self.save(NAME_RECORD, &[])
    }

    /// Writes a record, and again before it those that would be dropped some day.
    fn save(&mut self, number: u8, content: &[u8]) -> Result<(), Failed> {
        while let Some(number) = self.store.overdue() {
            match SettingKey::from_number(number) {
                Some(key) => {
                    let record = Values::record(self.values.get(key));
                    self.store.save(number, &record)?;
                }
                None => self.store.save(number, self.name.as_bytes())?,
            }
        }
        self.store.save(number, content)
    }

    fn health(&self) -> RigHealth {
        let (stack_size, stack_used) = image::stack();
        RigHealth {
            home_flag: GLITCHES[0].get(),
            far_limit: GLITCHES[1].get(),
            uart_errors: UART_ERRORS.load(Ordering::Relaxed),
            bad_frames: BAD_FRAMES.load(Ordering::Relaxed),
            unsent_frames: UNSENT_FRAMES.load(Ordering::Relaxed),
            underruns: self.underruns,
            stack_used,
            stack_size,
            control_late_us: self.late_us,
            image_hash: self.image_hash,
        }
    }

    fn press_button(&mut self) {
        let mut actions = Actions::new();
        let pressed = press_button(
            &mut self.machine,
            &self.values,
            now_us(),
            stepgen::counted(),
            inputs(),
            &mut actions,
        );
        self.perform(actions);
        if pressed.is_err() {
            self.emit(What::Rig(RigEvent::ButtonIgnored));
        }
    }

    fn tick(&mut self) {
        self.round += ROUND;
        let late = Instant::now().saturating_duration_since(self.round);
        self.late_us = self.late_us.max(late.as_micros() as u32);
        if !board::button_is_down() {
            self.button_rounds = 0;
        } else if self.button_rounds < BUTTON_ROUNDS {
            self.button_rounds += 1;
            if self.button_rounds == BUTTON_ROUNDS {
                self.press_button();
            }
        }
        self.event(Event::Tick { now_us: now_us() });
        // The break interrupt reports an opening while pulses are armed; this one reports it at rest.
        if inputs().estop_loop && self.machine.state() != RigState::Faulted {
            self.event(Event::LoopOpened);
        }
        let moving = matches!(
            self.machine.state(),
            RigState::Homing | RigState::Running | RigState::Moving
        );
        let silence_us = (now_us() as u32).wrapping_sub(LAST_FRAME_US.load(Ordering::Relaxed));
        if moving && u64::from(silence_us) > self.machine.settings().link_timeout_us {
            let before = self.machine.state();
            self.event(Event::LinkSilent);
            if self.machine.state() != before {
                self.emit(What::LinkLost);
            }
        }
    }

    fn perform(&mut self, actions: Actions) {
        for action in actions {
            match action {
                Action::Start { path, window } => {
                    self.start(path, window);
                }
                Action::StopPath => {
                    STOP.store(true, Ordering::Release);
                    MOTION_WAKE.signal(());
                }
                Action::Cut => {
                    board::cut_pulses();
                    CUT.store(true, Ordering::Release);
                    MOTION_WAKE.signal(());
                }
                Action::SetPosition(position) => stepgen::set_counted(position),
                Action::Emit(event) => {
                    defmt::info!("{}", event);
                    if let RigEvent::Faulted(fault) = event {
                        panic::keep_latched(Some(fault));
                    }
                    self.emit(What::Rig(event));
                }
            }
        }
    }

    fn start(&mut self, path: Path, window: (i32, i32)) {
        let settings = self.machine.settings();
        let Ok(stop_accel) = settings.axis.acceleration(settings.stop_accel_um_s2) else {
            return; // its range excludes zero
        };
        if !matches!(path, Path::Rest { .. }) {
            self.glitches_at_start = glitches();
        }
        ORDERS.signal(Order {
            path,
            window,
            stop_accel,
            pulse_ticks: settings.pulse_ticks,
        });
        MOTION_WAKE.signal(());
    }

    fn emit(&mut self, what: What) {
        let event = self.ring.record(now_us(), what);
        let session = SESSION.load(Ordering::Relaxed);
        if session == 0 {
            return; // nobody to send it to; it stays in the ring
        }
        let header = Header {
            kind: Kind::Event,
            session,
            seq: event.index as u16,
        };
        if let Ok(frame) = encode(header, &event) {
            // If the line is busy the host fetches it again by its index.
            send_if_free(frame);
        }
    }
}

fn set_telemetry(period_ms: u16) {
    TELEMETRY_MS.store(period_ms, Ordering::Relaxed);
    TELEMETRY_CHANGED.signal(());
}

/// False pulses on both switches.
fn glitches() -> u32 {
    GLITCHES[0]
        .get()
        .count
        .wrapping_add(GLITCHES[1].get().count)
}

/// The inputs, with the home flag as filtered: one glitch must not choose how homing begins.
fn inputs() -> RigInputs {
    RigInputs {
        home_flag: HOME_FLAG_OPEN.load(Ordering::Relaxed),
        ..board::inputs()
    }
}

fn now_us() -> u64 {
    Instant::now().as_micros()
}
