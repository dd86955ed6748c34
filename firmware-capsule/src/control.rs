//! All decisions of control: takes readings, requests and the clock; returns drive, replies and events. Pure: a trait
//! stands for the rest of the capsule, so that host tests run the same code as the control task.

pub mod flash;

use crate::commands::Context;
use crate::known::Known;
use crate::machine::{Actions, Command, Drive, Event};
use crate::record::trace::Recording;
use crate::sample::Sample;
use crate::settings::Settings;
use crate::units::Counts;
use crate::{commands, machine};
use device::retained::{EStop, Retained};
use device::{
    common::{About, Change, Effect, Surroundings},
    last_words::LastWords,
    service::Answers,
    settings::SettingsStore,
    store::{MOST_AT_ONCE, StorageFailed},
};
use embedded_storage_async::nor_flash::NorFlash;
use flash::{KNOWN, Kept, TOTALS, Totals};
use protocol::{
    capsule::{CapsuleEvent, CapsuleFault, CapsuleTelemetry},
    error::Refusal,
    events::EventRing,
    settings::SettingKey,
    system::{DeviceKind, ResetCause, Urgent, What},
    table::{Reply, Request},
};

/// Standstill required before writing the flash. A motor coasts for 0.3 s if its bridge has failed and cannot brake.
const STANDS_US: u64 = 500_000;

/// Time after which a write that has failed is tried again: seldom, because each try may use flash up.
const AGAIN_US: u64 = 10_000_000;

/// Counts that do not mean motion: an encoder line that rests on its edge may flicker.
const FLICKER: u32 = 2;

/// The rest of the capsule, as control sees it.
pub trait Capsule {
    /// Sets the bridge, or repeats its present state.
    fn drive(&mut self, drive: Drive);
    /// Publishes this to telemetry.
    fn show(&mut self, telemetry: CapsuleTelemetry);
}

/// Owns the state machine, the events, the recording, and the data kept in flash.
pub struct Control<C: Capsule + Surroundings, F: NorFlash> {
    capsule: C,
    machine: machine::Capsule,
    store: SettingsStore<F, Kept>,
    /// Number and energy of the motions that are not in the totals yet.
    ended: (u32, u64),
    /// Time at which a failed write is tried again, us; 0 if none has failed.
    again_us: u64,
    /// Last position, and the time since which it is unchanged with the bridge asleep.
    resting: (Counts, u64),
    /// End of the last write before a motion, in which no host was heard.
    deaf_until_us: Option<u64>,
    recording: Recording,
    events: EventRing,
    last_words: LastWords,
}

impl<C: Capsule + Surroundings, F: NorFlash> Control<C, F> {
    /// Starts control from the previous run's retained memory and from flash.
    pub fn new(capsule: C, flash: F, left: Retained, reset_cause: ResetCause) -> Self {
        let (store, usable) =
            SettingsStore::<F, Kept>::load_with(flash, |values| Settings::new(values).is_ok());
        let settings = Settings::new(store.values()).unwrap_or(Settings::REFERENCE);
        let known = store.records().known;
        let fault = match (reset_cause, left.latched) {
            (ResetCause::Panic, _) => Some(CapsuleFault::Panic),
            (ResetCause::Watchdog, _) => Some(CapsuleFault::Watchdog),
            (_, Some(_)) => Some(CapsuleFault::EStopFrame),
            (_, None) => None,
        };
        let mut control = Self {
            capsule,
            machine: machine::Capsule::new(fault, known, settings),
            store,
            ended: (0, 0),
            again_us: 0,
            resting: (Counts(0), 0),
            deaf_until_us: None,
            recording: Recording::new(),
            events: EventRing::new(),
            last_words: left.last_words.unwrap_or_default(),
        };
        control.emit(What::Booted(reset_cause));
        if !usable {
            control.emit(What::Capsule(CapsuleEvent::SettingsUnusable));
        }
        let period_ms = control.store.values().get(SettingKey::TelemetryMs) as u16;
        control.capsule.set_telemetry(period_ms);
        control
    }

    /// The rest of the capsule.
    pub fn capsule(&mut self) -> &mut C {
        &mut self.capsule
    }

    /// Takes a reading.
    pub fn read(&mut self, at_us: u64, sample: Sample) {
        let recorded = self.machine.is_moving() || self.machine.drive != Drive::Off;
        let actions = self.machine.step(at_us, Event::Sample(sample));
        // Set the bridge first: the motor keeps its old drive until then.
        self.perform(&actions);
        if let Some(known) = actions.keep {
            self.keep_moving(known);
        }
        if recorded {
            let actuation = self.machine.actuation();
            self.recording.take(actuation, &sample, actions.drive);
        }
        self.watch_link();
        self.keep(at_us, sample.counts);
    }

    /// Writes pending data to flash, once the motor stands: the chip fetches no instruction during a write. Data that
    /// cannot be written stay valid until the next start, and pending: a cell that is too low for the flash may recover.
    fn keep(&mut self, at_us: u64, counts: Counts) {
        let (rests_at, since_us) = self.resting;
        let driven = self.machine.is_moving() || self.machine.drive != Drive::Off;
        let moved = (counts - rests_at).0.unsigned_abs() > FLICKER;
        if driven || moved {
            self.resting = (counts, at_us);
            return;
        }
        if at_us.saturating_sub(since_us) < STANDS_US || at_us < self.again_us {
            return;
        }
        // Both are tried, whatever becomes of the first.
        let kept = [self.keep_known(self.machine.resting()), self.keep_totals()];
        let failed = kept.contains(&Err(StorageFailed));
        if failed && self.again_us == 0 {
            self.emit(What::Capsule(CapsuleEvent::StorageFailed));
        }
        self.again_us = if failed {
            at_us.saturating_add(AGAIN_US)
        } else {
            0
        };
    }

    /// Writes what a start has to find, unless flash has it.
    fn keep_known(&mut self, known: Known) -> Result<(), StorageFailed> {
        let before = *self.store.records();
        if known.is_like(&before.known) {
            return Ok(());
        }
        self.store.keep(KNOWN, Kept { known, ..before })
    }

    /// Writes the motions that have ended, unless flash has them.
    fn keep_totals(&mut self) -> Result<(), StorageFailed> {
        let (actuations, energy_mj) = self.ended;
        if actuations == 0 {
            return Ok(());
        }
        let before = *self.store.records();
        let totals = Totals {
            actuations: before.totals.actuations.saturating_add(actuations),
            energy_mj: before.totals.energy_mj.saturating_add(energy_mj),
        };
        self.store.keep(TOTALS, Kept { totals, ..before })?;
        self.ended = (0, 0);
        Ok(())
    }

    /// Before the motor is driven: a power cut during the motion must find how far it may have come, and nothing may be
    /// erased on the way. The bridge sleeps or shorts the motor meanwhile, so nothing has to be watched.
    ///
    /// # Errors
    /// The flash cannot be written: the motion must not begin.
    fn begin_motion(&mut self, ordered_us: u64, known: Known) -> Result<(), StorageFailed> {
        self.store.make_room(MOST_AT_ONCE)?;
        self.keep_known(known)?;
        let now_us = self.capsule.now_us();
        if now_us > ordered_us {
            // An erasure takes up to half a second, in which the motor was not driven and no host was heard.
            self.deaf_until_us = Some(now_us);
            self.machine.begin_late(now_us);
        }
        Ok(())
    }

    /// Writes how far the motion may come before the next record. If that fails the motion ends: a cut would leave a place
    /// in flash where the thread is not.
    fn keep_moving(&mut self, known: Known) {
        let before = *self.store.records();
        if self
            .store
            .keep_moving(KNOWN, Kept { known, ..before })
            .is_ok()
        {
            return;
        }
        self.emit(What::Capsule(CapsuleEvent::StorageFailed));
        let event = match self.capsule.chip().supply_low {
            true => Event::SupplyLow,
            false => Event::Command(Command::Stop),
        };
        let actions = self.machine.step(self.capsule.now_us(), event);
        self.perform(&actions);
    }

    fn watch_link(&mut self) {
        let now_us = self.capsule.now_us();
        let heard_us = self
            .deaf_until_us
            .map(|until_us| now_us.saturating_sub(until_us));
        let silence_us = u64::from(self.capsule.silence_us());
        let silence_us = silence_us.min(heard_us.unwrap_or(u64::MAX));
        if self.machine.is_moving() && silence_us > u64::from(self.machine.settings.link_timeout_us)
        {
            self.emit(What::LinkLost);
            let actions = self.machine.step(now_us, Event::LinkSilent);
            self.perform(&actions);
        }
    }

    fn perform(&mut self, actions: &Actions) {
        self.capsule.drive(actions.drive);
        let telemetry = commands::telemetry(&self.machine, self.capsule.now_us());
        self.capsule.show(telemetry);
        for event in &actions.events {
            if let CapsuleEvent::Ended { .. } = event {
                let (actuations, energy_mj) = self.ended;
                let record = self.machine.record();
                self.ended = (actuations + 1, energy_mj + u64::from(record.energy_mj));
            }
            if let CapsuleEvent::Faulted(fault) = event {
                let estop = matches!(fault, CapsuleFault::EStopFrame);
                self.capsule.keep_latched(estop.then_some(EStop::Frame));
            }
            self.emit(What::Capsule(*event));
        }
    }

    /// Changes the flash first, so that the values in force are those that the next start finds.
    fn change(&mut self, change: Change<Settings>) -> Result<(), StorageFailed> {
        let (settings, event) = match change {
            Change::Value { setting, settings } => {
                self.store.set(setting.key, setting.value)?;
                (settings, CapsuleEvent::SettingChanged(setting.key))
            }
            Change::Name(name) => return self.store.set_name(name),
            Change::Reset => {
                self.store.reset()?;
                (Settings::REFERENCE, CapsuleEvent::SettingsReset)
            }
        };
        self.machine.settings = settings;
        self.emit(What::Capsule(event));
        Ok(())
    }

    fn emit(&mut self, what: What) {
        let event = self.events.record(self.capsule.now_us(), what);
        self.capsule.send_event(&event);
    }
}

impl<C: Capsule + Surroundings, F: NorFlash> Answers for Control<C, F> {
    #[inline(never)]
    fn request(&mut self, request: Request) -> Reply {
        let context = Context {
            recording: &self.recording,
            totals: &self.store.records().totals,
            rests: self.capsule.now_us().saturating_sub(self.resting.1) >= STANDS_US,
            now_us: self.capsule.now_us(),
            about: About {
                kind: DeviceKind::Capsule,
                events: &self.events,
                last_words: &self.last_words,
                chip: self.capsule.chip(),
                values: self.store.values(),
                name: self.store.name(),
            },
        };
        let ordered_us = context.now_us;
        let before = self.machine.clone();
        let executed = commands::execute(request, &mut self.machine, &context);
        if let Some(actions) = &executed.actions {
            if let Some(known) = actions.keep
                && self.begin_motion(ordered_us, known).is_err()
            {
                self.machine = before;
                return Reply::Refused(Refusal::StorageFailed);
            }
            self.perform(actions);
        }
        match executed.effect {
            Effect::None => {}
            Effect::Telemetry { period_ms } => self.capsule.set_telemetry(period_ms),
            Effect::Acknowledged => {
                self.capsule.keep_latched(None);
                self.emit(What::Acknowledged);
            }
            Effect::Store(change) => {
                if self.capsule.chip().supply_low {
                    return Reply::Refused(Refusal::SupplyLow);
                }
                if self.change(change).is_err() {
                    return Reply::Refused(Refusal::StorageFailed);
                }
            }
        }
        executed.reply
    }

    fn stop(&mut self, urgent: Urgent) {
        let command = Event::Command(match urgent {
            Urgent::Stop => Command::Stop,
            Urgent::EStop => Command::EStop,
        });
        let actions = self.machine.step(self.capsule.now_us(), command);
        self.perform(&actions);
        // A fault that is latched already, such as that of a crash, may keep its name; a reset must not undo the stop.
        if urgent == Urgent::EStop && actions.events.is_empty() {
            self.capsule.keep_latched(Some(EStop::Frame));
        }
    }
}
