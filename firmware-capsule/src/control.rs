//! Everything that control decides: readings, requests and the clock in; drive, replies and events out. Pure: the rest
//! of the capsule is a trait, so that the host tests run what the control task runs.

use crate::{
    commands::{self, Context},
    detect::Sample,
    fold::{self, Actions, Command, Drive, Event},
};
use device::retained::{EStop, Retained};
use device::{
    common::{About, Effect, Surroundings},
    last_words::LastWords,
    service::Answers,
};
use protocol::{
    capsule::{CapsuleEvent, CapsuleFault, CapsuleTelemetry},
    events::EventRing,
    system::{ResetCause, Urgent, What},
    table::{Reply, Request},
};

/// A moving capsule stops when no good frame has come for this long.
const LINK_TIMEOUT_US: u32 = 1_000_000;

/// The rest of the capsule, as control sees it.
pub trait Capsule {
    /// Sets the bridge, or confirms what it is set to.
    fn drive(&mut self, drive: Drive);
    /// Shows this to telemetry.
    fn show(&mut self, telemetry: CapsuleTelemetry);
}

/// Owns the state machine and the events.
pub struct Control<C: Capsule + Surroundings> {
    capsule: C,
    machine: fold::Capsule,
    events: EventRing,
    last_words: LastWords,
}

impl<C: Capsule + Surroundings> Control<C> {
    /// Control after a start, from what the previous one left.
    pub fn new(capsule: C, left: Retained, reset_cause: ResetCause) -> Self {
        let fault = match (reset_cause, left.latched) {
            (ResetCause::Panic, _) => Some(CapsuleFault::Panic),
            (ResetCause::Watchdog, _) => Some(CapsuleFault::Watchdog),
            (_, Some(_)) => Some(CapsuleFault::EStopFrame),
            (_, None) => None,
        };
        let mut control = Self {
            capsule,
            machine: fold::Capsule::new(fault),
            events: EventRing::new(),
            last_words: left.last_words.unwrap_or_default(),
        };
        control.emit(What::Booted(reset_cause));
        control
    }

    /// The rest of the capsule.
    pub fn capsule(&mut self) -> &mut C {
        &mut self.capsule
    }

    /// Takes a reading.
    pub fn read(&mut self, at_us: u64, sample: Sample) {
        let actions = self.machine.step(at_us, Event::Sample(sample));
        self.perform(&actions);
        self.watch_link();
    }

    fn watch_link(&mut self) {
        if self.machine.is_moving() && self.capsule.silence_us() > LINK_TIMEOUT_US {
            self.emit(What::LinkLost);
            let actions = self.machine.step(self.capsule.now_us(), Event::LinkSilent);
            self.perform(&actions);
        }
    }

    fn perform(&mut self, actions: &Actions) {
        self.capsule.drive(actions.drive);
        let telemetry = commands::telemetry(&self.machine, self.capsule.now_us());
        self.capsule.show(telemetry);
        for event in &actions.events {
            if let CapsuleEvent::Faulted(fault) = event {
                let estop = matches!(fault, CapsuleFault::EStopFrame);
                self.capsule.keep_latched(estop.then_some(EStop::Frame));
            }
            self.emit(What::Capsule(*event));
        }
    }

    fn emit(&mut self, what: What) {
        let event = self.events.record(self.capsule.now_us(), what);
        self.capsule.tell(&event);
    }
}

impl<C: Capsule + Surroundings> Answers for Control<C> {
    #[inline(never)]
    fn request(&mut self, request: Request) -> Reply {
        let context = Context {
            now_us: self.capsule.now_us(),
            about: About {
                events: &self.events,
                last_words: &self.last_words,
                chip: self.capsule.chip(),
            },
        };
        let executed = commands::execute(request, &mut self.machine, &context);
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
    }
}
