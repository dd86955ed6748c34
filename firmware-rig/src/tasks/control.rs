//! Owns the state machine: requests, notices and the clock in, orders, replies and events out.

use super::watchdog::{Client, check_in};
use crate::{
    board,
    channels::{
        CUT, GLITCHES, HOME_FLAG_OPEN, Inbound, LAST_FRAME_US, MOTION_WAKE, NOTICES, ORDERS,
        OUTBOUND, Order, REPLIES, REQUESTS, SESSION, SNAPSHOT, STOP, STROKE, Snapshot,
        TELEMETRY_CHANGED, TELEMETRY_MS,
    },
    stepgen,
};
use core::sync::atomic::Ordering;
use embassy_futures::select::{Either3, select3};
use embassy_time::{Duration, Instant, Ticker};
use firmware_rig::{
    commands::{Context, Effect, execute},
    machine::{Action, Actions, Event, Machine},
};
use heapless::String;
use protocol::{
    events::EventRing,
    frame::{Header, Kind, encode},
    rig::{RigInputs, RigState},
    system::{ResetCause, Urgent, What},
    table::Reply,
};

/// What control knows from the start.
pub struct Start {
    /// The machine with the fault of the last start, if any.
    pub machine: Machine,
    /// Why the chip was reset.
    pub reset_cause: ResetCause,
    /// Text of the last panic or processor fault.
    pub last_words: String<120>,
}

struct Control {
    machine: Machine,
    ring: EventRing,
    last_words: String<120>,
    glitches_at_start: u32,
}

/// Every 10 ms and at every notice or request.
#[embassy_executor::task]
pub async fn control(start: Start) -> ! {
    let Start {
        machine,
        reset_cause,
        last_words,
    } = start;
    let mut control = Control {
        machine,
        ring: EventRing::new(),
        last_words,
        glitches_at_start: 0,
    };
    control.emit(What::Booted(reset_cause));
    let mut ticker = Ticker::every(Duration::from_millis(10));
    loop {
        check_in(Client::Control);
        control.publish();
        match select3(NOTICES.receive(), REQUESTS.receive(), ticker.next()).await {
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
    fn publish(&self) {
        let snapshot = Snapshot {
            state: self.machine.state(),
            residual_steps: self.machine.residual(),
        };
        SNAPSHOT.lock(|cell| cell.set(snapshot));
    }

    fn event(&mut self, event: Event) {
        self.machine.set_glitches(
            GLITCHES
                .load(Ordering::Relaxed)
                .wrapping_sub(self.glitches_at_start),
        );
        let actions = self.machine.event(event, inputs());
        self.perform(actions);
    }

    fn urgent(&mut self, urgent: Urgent) {
        let command = match urgent {
            Urgent::Stop => firmware_rig::machine::Command::Stop,
            Urgent::EStop => firmware_rig::machine::Command::EStop,
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

    fn request(&mut self, request: protocol::table::Request) -> Reply {
        let context = Context {
            now_us: now_us(),
            position: stepgen::counted(),
            inputs: inputs(),
            stroke: STROKE.load(Ordering::Relaxed),
            ring: &self.ring,
            last_words: &self.last_words,
        };
        let mut actions = Actions::new();
        let (reply, effect) = execute(request, &mut self.machine, &context, &mut actions);
        match effect {
            Effect::None => {}
            Effect::Telemetry { period_ms } => {
                TELEMETRY_MS.store(period_ms, Ordering::Relaxed);
                TELEMETRY_CHANGED.signal(());
            }
            Effect::Acknowledged => self.emit(What::Acknowledged),
        }
        self.perform(actions);
        reply
    }

    fn tick(&mut self) {
        // The break interrupt reports an opening while pulses are armed; this one reports it at rest.
        if inputs().estop_loop && self.machine.state() != RigState::Faulted {
            self.event(Event::LoopOpened);
        }
        let moving = matches!(self.machine.state(), RigState::Homing | RigState::Running);
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
                    self.glitches_at_start = GLITCHES.load(Ordering::Relaxed);
                    ORDERS.signal(Order { path, window });
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
                    self.emit(What::Rig(event));
                }
            }
        }
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
            let _ = OUTBOUND.try_send(frame);
        }
    }
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
