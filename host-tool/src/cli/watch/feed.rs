//! Keeps one machine's panel up to date on a thread of its own, and sends the orders of the keys.

use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use client::address::Address;
use client::door::lock::Doorway;
use client::error::ClientError;
use client::link::LinkError;
use client::link::owner::StopMark;
use client::wording;
use client::{Device, Interrupt, Observer, Pace};
use lab::operations::connector::Purpose;
use lab::operations::delivery::{DO_NOW, Delivery, Told};
use lab::operations::failure::Failure;
use lab::operations::panel::{self, Contact, MOVES_ALREADY, Notice, Panel, TELEMETRY_MS};
use lab::operations::places::{Places, Target};
use lab::operations::stops::{self, Ask, Stops};
use protocol::rig;
use protocol::system::{DeviceKind, Event, Urgent};
use protocol::table::Telemetry;

/// Interval between two status requests, us. Each goes through the owner of the line.
const ASK_US: u64 = 250_000;

/// Longest wait for bytes before the keys are checked again, us.
const SLICE_US: u64 = 20_000;

/// Time for which a free line is left to other processes: its owner may have given it up for one that waits.
const LEFT_TO_OTHERS: Duration = Duration::from_millis(200);

/// Interval between two attempts to connect.
const AGAIN: Duration = Duration::from_millis(500);

/// Notice after a hold or a resumption without a connection.
const NOT_SENT: &str = "not sent: there is no contact; press the key again once there is";

/// Shared by the screen and the feed of one machine.
pub(crate) struct Shared {
    pub(crate) kind: DeviceKind,
    address: Address,
    panel: Mutex<Panel>,
    /// The line, as the last connection found it: to look its name up may take seconds, which no key waits for.
    doorway: Mutex<Option<Doorway>>,
    /// Holds and resumptions ordered by keys, each with the last stop before it.
    paces: Mutex<Vec<(Pace, StopMark)>>,
    /// Stops ordered by keys, with those that are not confirmed yet.
    stops: Arc<Stops>,
    asks: Mutex<Vec<Ask>>,
    /// Stops over lines of their own: begun and ended. Each leaves a mark, which a connection then meets.
    direct: [AtomicU32; 2],
    /// Stops that were given up, with their results.
    given_up: Mutex<Vec<(Ask, Told)>>,
}

impl Shared {
    pub(crate) fn new(kind: DeviceKind, address: Address) -> Self {
        Self {
            kind,
            panel: Mutex::new(Panel::new(kind, address.to_string())),
            address,
            doorway: Mutex::default(),
            paces: Mutex::default(),
            stops: Arc::default(),
            asks: Mutex::default(),
            direct: Default::default(),
            given_up: Mutex::default(),
        }
    }

    // If a thread has panicked while holding the lock, show what is there.
    pub(crate) fn panel(&self) -> MutexGuard<'_, Panel> {
        self.panel.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Orders a stop. The feed sends it within 20 ms.
    pub(crate) fn stop(&self, urgent: Urgent) {
        if let Some(doorway) = &*self.doorway() {
            doorway.mark_stop(urgent);
        }
        self.asks().push(self.stops.with(|stops| stops.ask(urgent)));
        self.tell(Notice::Done(format!("{} ...", stops::name(urgent))));
    }

    /// Orders a hold or a resumption, if there is a connection: a key must not act minutes later, when the machine is
    /// back.
    pub(crate) fn pace(&self, pace: Pace) {
        if matches!(self.panel().contact, Contact::Lost(_)) {
            self.tell(Notice::Bad(NOT_SENT.to_owned()));
            return;
        }
        let mark = Doorway::last_stops(self.doorway().as_ref());
        self.paces().push((pace, mark));
    }

    fn doorway(&self) -> MutexGuard<'_, Option<Doorway>> {
        self.doorway.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn paces(&self) -> MutexGuard<'_, Vec<(Pace, StopMark)>> {
        self.paces.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn asks(&self) -> MutexGuard<'_, Vec<Ask>> {
        self.asks.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn given_up(&self) -> MutexGuard<'_, Vec<(Ask, Told)>> {
        self.given_up.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The result of a stop that the machine has not confirmed, neither itself nor by a later one.
    pub(crate) fn unconfirmed(&self) -> Option<Told> {
        let is_open = |ask: &Ask| !self.stops.with(|stops| stops.is_confirmed(*ask));
        let given_up = self.given_up();
        let last = given_up.iter().rev().find(|(ask, _)| is_open(ask));
        last.map(|(_, told)| told.clone()).or_else(|| {
            self.asks().iter().any(is_open).then(|| Told {
                machine: self.target().to_string(),
                delivery: Delivery::NotConfirmed,
                why: "it was not answered in time".to_owned(),
            })
        })
    }

    fn target(&self) -> Target {
        Target {
            kind: Some(self.kind),
            address: Some(self.address.clone()),
        }
    }

    /// Notes that the machine has confirmed this stop. `asked` is the last order that the stop covers.
    fn confirmed(&self, urgent: Urgent, asked: u64) {
        self.stops.with(|stops| stops.confirm(urgent, asked));
        self.asks().retain(|ask| {
            self.stops.with(|stops| {
                let is_open = !stops.is_confirmed(*ask);
                if !is_open {
                    stops.withdraw(*ask);
                }
                is_open
            })
        });
    }

    fn tell(&self, notice: Notice) {
        self.panel().notice = Some(notice);
    }

    /// Sends an ordered stop over a line of its own, because there is no connection or it has not confirmed the stop.
    pub(crate) fn stop_directly(&self, places: &Places<'_>) {
        let (unconfirmed, asked) = self
            .stops
            .with(|stops| (stops.unconfirmed(), stops.asked()));
        let Some(urgent) = unconfirmed else {
            return;
        };
        let asks = self.asks().clone();
        let target = self.target();
        let [begun, ended] = &self.direct;
        begun.fetch_add(1, Ordering::SeqCst);
        let told = target.told(places.urgent(&target, urgent));
        ended.fetch_add(1, Ordering::SeqCst);
        if told.delivery == Delivery::Stopped {
            self.confirmed(urgent, asked);
            self.tell(confirmed(urgent));
            return;
        }
        let name = stops::name(urgent);
        let notice = format!("{name} NOT CONFIRMED: {DO_NOW} ({})", told.why);
        // Forget these orders: a stop must not go out by itself an hour later.
        self.asks().retain(|ask| !asks.contains(ask));
        for ask in asks {
            self.stops.with(|stops| stops.withdraw(ask));
            self.given_up().push((ask, told.clone()));
        }
        self.tell(Notice::Bad(notice));
    }

    /// Numbers of the stops by this program until now: ordered, begun and ended over a line of their own.
    fn own_stops(&self, asked: u64) -> (u64, [u32; 2]) {
        let direct = self.direct.each_ref();
        (asked, direct.map(|count| count.load(Ordering::SeqCst)))
    }

    fn interrupt(&self) -> Interrupt {
        let stops = Arc::clone(&self.stops);
        Arc::new(move || stops.with(|stops| stops.wanted()))
    }
}

/// Passes the device's news to the panel.
struct Seen<'a>(&'a Shared);

impl Observer for Seen<'_> {
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.0.panel().sample(sample, missed, Instant::now());
    }
    fn event(&mut self, event: &Event) {
        self.0.panel().event(event);
    }
}

/// One machine to watch.
pub(crate) struct Feed<'a> {
    pub(crate) places: &'a Places<'a>,
    pub(crate) shared: &'a Shared,
    /// The person leaves.
    pub(crate) leaving: &'a AtomicBool,
    /// Stops of this program that a connection has met. A new connection meets the mark of one that was confirmed over
    /// a line of its own.
    pub(crate) met: Cell<(u64, [u32; 2])>,
}

impl Feed<'_> {
    /// Watches until the person leaves. Then sends the last key's stop directly, if no connection has taken it.
    pub(crate) fn follow(&self) {
        self.keep_connected();
        self.shared.stop_directly(self.places);
    }

    /// Watches until the person leaves, and reconnects whenever the line is lost.
    fn keep_connected(&self) {
        while !self.is_leaving() {
            let failure = match self.connection() {
                Ok(()) if self.is_leaving() => return,
                // Another process waits for the line.
                Ok(()) => {
                    self.leave_line_for(AGAIN);
                    continue;
                }
                // The owner's command has ended, so the line is free.
                Err(Failure::Client(ClientError::Link(LinkError::OwnerGone { .. }))) => {
                    self.leave_line_for(LEFT_TO_OTHERS);
                    continue;
                }
                Err(failure) => failure,
            };
            // Said first: from now on a key sends its stop itself, while this thread may wait for another one.
            let mut panel = self.shared.panel();
            if !matches!(panel.contact, Contact::Lost(_)) {
                panel.quality.losses += 1;
            }
            panel.contact = Contact::Lost(failure.in_one_line());
            drop(panel);
            let begin = Instant::now();
            while begin.elapsed() < AGAIN && !self.is_leaving() {
                self.shared.stop_directly(self.places);
                thread::sleep(Duration::from_millis(10));
            }
        }
    }

    fn leave_line_for(&self, pause: Duration) {
        self.shared.stop_directly(self.places);
        thread::sleep(pause);
    }

    fn is_leaving(&self) -> bool {
        self.leaving.load(Ordering::Relaxed)
    }

    /// Connects and follows until the connection is lost, the person leaves, or another process needs the line.
    fn connection(&self) -> Result<(), Failure> {
        let places = self.places;
        // Not behind the lock: a key would wait for the look-up.
        let doorway = places.connector.doorway(&self.shared.address);
        *self.shared.doorway() = doorway;
        let mut device = places.open(self.shared.kind, &self.shared.address, Purpose::Watch)?;
        // Fail fast, so that keys are handled between two requests.
        device.ask_once(true);
        device.set_interrupt(self.shared.interrupt());
        device.hello(places.connector.nonce())?;
        device.require(self.shared.kind)?;
        places.require_name(&mut device)?;
        let owned = device.owner().is_none();
        if owned {
            device.set_telemetry(TELEMETRY_MS)?;
        }
        self.shared.panel().contact = match device.owner() {
            None => Contact::Owned,
            Some(owner) => Contact::Window(owner.to_string()),
        };
        let result = self.watch(&mut device);
        if owned && result.is_ok() {
            // Ignore an error: the line is given up in any case.
            let _ = device.set_telemetry(0);
        }
        result
    }

    fn watch(&self, device: &mut Device) -> Result<(), Failure> {
        if !std::mem::take(&mut *self.shared.paces()).is_empty() {
            self.shared.tell(Notice::Bad(NOT_SENT.to_owned()));
        }
        let mut asked_us = None;
        while !self.is_leaving() && !device.is_line_wanted() {
            let now_us = device.now_us();
            let due = asked_us.is_none_or(|asked_us| now_us >= asked_us + ASK_US);
            let first = asked_us.is_none();
            if self.shared.panel().take_changed() || due {
                asked_us = Some(now_us);
                match self.ask(device) {
                    // The owner is busy and will answer later.
                    Ok(()) | Err(ClientError::OwnerBusy { .. }) => {}
                    Err(error) => return Err(error.into()),
                }
            }
            self.settle(device)?;
            if first && device.owner().is_none() && self.shared.panel().moves() {
                self.shared.tell(Notice::Bad(MOVES_ALREADY.to_owned()));
            }
            for (pace, mark) in std::mem::take(&mut *self.shared.paces()) {
                device.ordered_at(mark);
                self.pace(device, pace)?;
            }
            device.observe(SLICE_US, &mut Seen(self.shared))?;
        }
        // Settle again: the last key may have been a stop.
        self.settle(device)?;
        Ok(())
    }

    fn ask(&self, device: &mut Device) -> Result<(), ClientError> {
        panel::ask(device, || self.shared.panel())
    }

    /// Waits until a sent stop is confirmed. Is then ready for the next one.
    fn settle(&self, device: &mut Device) -> Result<(), ClientError> {
        if device.interrupted().is_none() {
            return Ok(());
        }
        device.settle()?;
        // Drop keys that came before the stop: they must not undo it.
        self.shared.paces().clear();
        // The stop that was sent may be older or weaker than the last one ordered.
        let stops = &self.shared.stops;
        let (unconfirmed, asked) = stops.with(|stops| (stops.unconfirmed(), stops.asked()));
        let own = self.shared.own_stops(asked);
        let [begun, ended] = own.1;
        let is_own = self.met.replace(own) != own || begun != ended;
        if let Some(urgent) = unconfirmed {
            device.urgent(urgent)?;
            self.shared.confirmed(urgent, asked);
            self.shared.tell(confirmed(urgent));
        } else if let Some(urgent) = device.interrupted().filter(|_| !is_own) {
            let notice = format!("{} from another terminal", stops::name(urgent));
            self.shared.tell(Notice::Done(notice));
        }
        device.forget_stop();
        Ok(())
    }

    fn pace(&self, device: &mut Device, pace: Pace) -> Result<(), ClientError> {
        let (answer, done, not) = match pace {
            Pace::Hold => (device.call(rig::Hold), "hold accepted", "not held"),
            Pace::Resume => (device.call(rig::Resume), "resumed", "not resumed"),
        };
        let notice = match answer {
            Ok(_) => Notice::Done(done.to_owned()),
            Err(ClientError::Refused { refusal, .. }) => {
                Notice::Bad(format!("{not}: {}", wording::refusal(&refusal)))
            }
            Err(error @ (ClientError::OwnerBusy { .. } | ClientError::OutcomeUnknown { .. })) => {
                Notice::Bad(error.to_string())
            }
            // The stop that came in between reports itself.
            Err(ClientError::Interrupted { .. }) => return Ok(()),
            Err(error) => return Err(error),
        };
        self.shared.tell(notice);
        Ok(())
    }
}

fn confirmed(urgent: Urgent) -> Notice {
    Notice::Done(match urgent {
        Urgent::Stop => "stop confirmed".to_owned(),
        Urgent::EStop => {
            "EMERGENCY STOP latched; `retrograde ack` before anything moves".to_owned()
        }
    })
}
