//! All decisions of control: takes readings, requests and the clock; returns drive, replies and events. Pure: a trait
//! stands for the rest of the capsule, so that host tests run the same code as the control task.

pub mod flash;

use crate::commands::Context;
use crate::known::Known;
use crate::machine::{Actions, Event};
use crate::record::trace::Recording;
use crate::sense::{Counts, Sample};
use crate::settings::Settings;
use crate::speed::Drive;
use crate::units::Thread;
use crate::{commands, machine};
use device::retained::{EStop, Retained};
use device::{
    common::{About, Change, Effect, Executed, Surroundings},
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
/// Change of the thread that is no motion: a line of the encoder that rests on its edge may flicker.
const FLICKER: Thread = Thread(6);

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
    /// Includes the motions that flash does not have yet.
    totals: Totals,
    /// Time at which a failed write is tried again, us; 0 if none has failed.
    again_us: u64,
    /// Last position, and the time since which it is unchanged with the bridge asleep.
    resting: (Counts, u64),
    /// End of the last write before a motion, in which no host was heard.
    deaf_until_us: u64,
    recording: Recording,
    events: EventRing,
    last_words: LastWords,
}

impl<C: Capsule + Surroundings, F: NorFlash> Control<C, F> {
    /// Starts control from the previous run's retained memory and from flash.
    pub fn new(capsule: C, flash: F, previous: Retained, reset_cause: ResetCause) -> Self {
        let (store, usable) =
            SettingsStore::<F, Kept>::load_with(flash, |values| Settings::new(values).is_ok());
        let settings = Settings::new(store.values()).unwrap_or(Settings::REFERENCE);
        let Kept { known, totals } = *store.records();
        let fault = match (reset_cause, previous.latched) {
            (ResetCause::Panic, _) => Some(CapsuleFault::Panic),
            (ResetCause::Watchdog, _) => Some(CapsuleFault::Watchdog),
            (_, Some(_)) => Some(CapsuleFault::EStopFrame),
            (_, None) => None,
        };
        let mut control = Self {
            capsule,
            machine: machine::Capsule::new(fault, known, settings),
            store,
            totals,
            again_us: 0,
            resting: (Counts(0), 0),
            deaf_until_us: 0,
            recording: Recording::default(),
            events: EventRing::new(),
            last_words: previous.last_words.unwrap_or_default(),
        };
        control.emit(What::Booted(reset_cause));
        if !usable {
            control.emit(What::Capsule(CapsuleEvent::SettingsUnusable));
        }
        let period_ms = control.store.values().get(SettingKey::TelemetryMs) as u16;
        control.capsule.set_telemetry(period_ms);
        control
    }

    pub fn capsule(&mut self) -> &mut C {
        &mut self.capsule
    }

    pub fn read(&mut self, at_us: u64, sample: Sample) {
        let recorded = !self.machine.rests();
        let actions = self.give(at_us, Event::Sample(sample));
        if let Some(known) = actions.keep {
            self.keep_moving(known);
        }
        if recorded {
            let actuation = self.machine.actuation();
            self.recording.take(actuation, &sample, self.machine.drive);
        }
        self.watch_link();
        self.keep(at_us, sample.counts);
    }

    /// Writes pending data to flash, once the motor stands: the chip fetches no instruction during a write. Data that
    /// cannot be written remain in force and pending: a cell that is too low for the flash may recover.
    fn keep(&mut self, at_us: u64, counts: Counts) {
        let (rests_at, since_us) = self.resting;
        let moved = (counts - rests_at).thread().0.abs() > FLICKER.0;
        if !self.machine.rests() || moved {
            self.resting = (counts, at_us);
            return;
        }
        if at_us.saturating_sub(since_us) < STANDS_US || at_us < self.again_us {
            return;
        }
        // Try both, even if the first fails.
        let kept = [
            self.keep_known(self.machine.known.resting(self.machine.sample.counts)),
            self.keep_totals(),
        ];
        let failed = kept.contains(&Err(StorageFailed));
        if failed && self.again_us == 0 {
            self.emit(What::Capsule(CapsuleEvent::StorageFailed));
        }
        self.again_us = if failed { at_us + AGAIN_US } else { 0 };
    }

    /// Writes this record, unless flash has it.
    fn keep_known(&mut self, known: Known) -> Result<(), StorageFailed> {
        let before = *self.store.records();
        if known.is_like(&before.known, FLICKER) {
            return Ok(());
        }
        self.store.keep(KNOWN, Kept { known, ..before })
    }

    /// Writes the motions that have ended, unless flash has them.
    fn keep_totals(&mut self) -> Result<(), StorageFailed> {
        let before = *self.store.records();
        if self.totals == before.totals {
            return Ok(());
        }
        let totals = self.totals;
        self.store.keep(TOTALS, Kept { totals, ..before })
    }

    /// Prepares the flash for a motion: a start after a power cut has to find how far it may have come, and nothing may
    /// be erased on the way. An erasure takes up to half a second, in which no host is heard.
    ///
    /// # Errors
    /// The flash cannot be written: the motion must not begin.
    fn prepare(&mut self, known: Known) -> Result<(), StorageFailed> {
        self.store.make_room(MOST_AT_ONCE)?;
        self.keep_known(known)?;
        self.deaf_until_us = self.capsule.now_us();
        Ok(())
    }

    /// Writes how far the motion may come before the next record. If that fails the motion ends: after a power cut the
    /// flash would have a wrong place.
    fn keep_moving(&mut self, known: Known) {
        let kept = Kept {
            known,
            ..*self.store.records()
        };
        if self.store.keep_moving(KNOWN, kept).is_ok() {
            return;
        }
        self.emit(What::Capsule(CapsuleEvent::StorageFailed));
        let battery_mv = self.machine.sample.battery_mv;
        let event = match self.capsule.chip().supply_low {
            true => Event::Fail(CapsuleFault::LowBattery { battery_mv }),
            false => Event::Stop,
        };
        self.give(self.capsule.now_us(), event);
    }

    fn watch_link(&mut self) {
        let now_us = self.capsule.now_us();
        let heard_us = now_us.saturating_sub(self.deaf_until_us);
        let silence_us = heard_us.min(self.capsule.silence_us().into());
        if self.machine.is_moving() && silence_us > u64::from(self.machine.settings.link_timeout_us)
        {
            self.emit(What::LinkLost);
            self.give(now_us, Event::LinkSilent);
        }
    }

    fn give(&mut self, now_us: u64, event: Event) -> Actions {
        let actions = self.machine.step(now_us, event);
        self.perform(&actions);
        actions
    }

    fn perform(&mut self, actions: &Actions) {
        // First: the motor keeps its old drive until then.
        self.capsule.drive(self.machine.drive);
        let telemetry = commands::telemetry(&self.machine, self.capsule.now_us());
        self.capsule.show(telemetry);
        for event in &actions.events {
            if let CapsuleEvent::Ended { .. } = event {
                let energy_mj = self.machine.record().energy_mj;
                let totals = &mut self.totals;
                totals.actuations = totals.actuations.saturating_add(1);
                totals.energy_mj = totals.energy_mj.saturating_add(energy_mj.into());
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

    fn execute(
        &self,
        request: &Request,
        machine: &mut machine::Capsule,
    ) -> Executed<Option<Actions>, Settings> {
        let now_us = self.capsule.now_us();
        let context = Context {
            recording: &self.recording,
            totals: &self.store.records().totals,
            rests: now_us.saturating_sub(self.resting.1) >= STANDS_US,
            now_us,
            about: About {
                kind: DeviceKind::Capsule,
                events: &self.events,
                last_words: &self.last_words,
                chip: self.capsule.chip(),
                values: self.store.values(),
                name: self.store.name(),
            },
        };
        commands::execute(request, machine, &context)
    }
}

impl<C: Capsule + Surroundings, F: NorFlash> Answers for Control<C, F> {
    #[inline(never)]
    fn request(&mut self, request: Request) -> Reply {
        let mut machine = self.machine.clone();
        let mut executed = self.execute(&request, &mut machine);
        if let Some(known) = executed.actions.as_ref().and_then(|actions| actions.keep) {
            if self.prepare(known).is_err() {
                return Reply::Refused(Refusal::StorageFailed);
            }
            // Begin only now: the write took time in which the motor was not driven.
            machine = self.machine.clone();
            executed = self.execute(&request, &mut machine);
        }
        self.machine = machine;
        if let Some(actions) = &executed.actions {
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
        let event = match urgent {
            Urgent::Stop => Event::Stop,
            Urgent::EStop => Event::Fail(CapsuleFault::EStopFrame),
        };
        let actions = self.give(self.capsule.now_us(), event);
        // A fault that is latched already, such as that of a crash, may keep its name; a reset must not undo the stop.
        if urgent == Urgent::EStop && actions.events.is_empty() {
            self.capsule.keep_latched(Some(EStop::Frame));
        }
    }
}
