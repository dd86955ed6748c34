//! Owns the state machine: readings, requests and the clock in, orders, replies and events out.

use crate::{
    channels::{
        Inbound, LAST_FRAME_US, ORDER, ORDER_CHANGED, OUTBOUND, Order, READINGS, REPLIES, REQUESTS,
        SESSION, SNAPSHOT, TELEMETRY_CHANGED, TELEMETRY_MS,
    },
    watchdog::{CHECK_IN, Client, check_in},
};
use core::sync::atomic::Ordering;
use embassy_futures::select::{Either3, select3};
use embassy_time::{Instant, Timer};
use firmware_capsule::{
    commands::{self, Context, Effect},
    fold::{Actions, Capsule, Event},
};
use heapless::String;
use protocol::{
    events::EventRing,
    frame::{Header, Kind, encode},
    system::{ResetCause, What},
    table::{Reply, Request},
};

/// A moving capsule stops when no valid frame has come for this long.
const LINK_TIMEOUT_US: u32 = 1_000_000;

/// What control knows from the start.
pub(crate) struct Start {
    /// The machine, with the fault of the last start, if any.
    pub(crate) capsule: Capsule,
    /// Why the chip was reset.
    pub(crate) reset_cause: ResetCause,
    /// Text of the last panic or processor fault.
    pub(crate) last_words: String<120>,
}

struct Control {
    capsule: Capsule,
    ring: EventRing,
    last_words: String<120>,
    order: Order,
}

/// At every reading (1 ms while moving, else 100 ms) and at every request.
#[embassy_executor::task]
pub(crate) async fn control(start: Start) -> ! {
    let Start {
        capsule,
        reset_cause,
        last_words,
    } = start;
    let mut control = Control {
        capsule,
        ring: EventRing::new(),
        last_words,
        order: ORDER.lock(|order| order.get()),
    };
    control.emit(What::Booted(reset_cause));
    loop {
        check_in(Client::Control);
        match select3(REQUESTS.receive(), READINGS.wait(), Timer::after(CHECK_IN)).await {
            Either3::First(Inbound::Request(request)) => {
                let reply = control.request(request);
                REPLIES.signal(reply);
            }
            Either3::First(Inbound::Urgent(urgent)) => {
                let actions = commands::urgent(urgent, &mut control.capsule, now_us());
                control.perform(&actions);
                REPLIES.signal(Reply::Urgent(urgent));
            }
            Either3::Second(reading) => {
                let actions = control
                    .capsule
                    .step(reading.at_us, Event::Sample(reading.sample));
                control.perform(&actions);
                control.watch_link();
            }
            // Motor is silent; the watchdog will see to it.
            Either3::Third(()) => {}
        }
    }
}

impl Control {
    fn request(&mut self, request: Request) -> Reply {
        let context = Context {
            now_us: now_us(),
            ring: &self.ring,
            last_words: &self.last_words,
        };
        let executed = commands::execute(request, &mut self.capsule, &context);
        if let Some(actions) = &executed.actions {
            self.perform(actions);
        }
        match executed.effect {
            Effect::None => {}
            Effect::Telemetry { period_ms } => {
                TELEMETRY_MS.store(period_ms, Ordering::Relaxed);
                TELEMETRY_CHANGED.signal(());
            }
            Effect::Acknowledged => self.emit(What::Acknowledged),
        }
        executed.reply
    }

    fn watch_link(&mut self) {
        // Whole differences of the low 32 bits: right also after 71 minutes.
        let silence_us = (now_us() as u32).wrapping_sub(LAST_FRAME_US.load(Ordering::Relaxed));
        if self.capsule.is_moving() && silence_us > LINK_TIMEOUT_US {
            defmt::warn!("link silent for {=u32} us", silence_us);
            self.emit(What::LinkLost);
            let actions = self.capsule.step(now_us(), Event::LinkSilent);
            self.perform(&actions);
        }
    }

    fn perform(&mut self, actions: &Actions) {
        let changed = actions.drive != self.order.drive;
        self.order = Order {
            drive: actions.drive,
            confirmed_us: now_us(),
        };
        ORDER.lock(|order| order.set(self.order));
        if changed {
            ORDER_CHANGED.signal(());
        }
        let telemetry = commands::telemetry(&self.capsule, now_us());
        SNAPSHOT.lock(|snapshot| snapshot.set(Some(telemetry)));
        for event in &actions.events {
            defmt::info!("{}: {}", self.capsule.state(), event);
            self.emit(What::Capsule(*event));
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

fn now_us() -> u64 {
    Instant::now().as_micros()
}
