//! State shared by workers, requests and readers, and its JSON form.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use client::Interrupt;
use client::address::Address;
use client::broker::lock::LineFiles;
use client::identity::{IdentityRecord, Origin, kind_name, version};
use client::link::owner::StopMark;
use jiff::Timestamp;
use protocol::rig::RigStatus;
use protocol::system::{DeviceKind, Event, Identity, Urgent};
use protocol::table::Telemetry;
use serde_json::{Map, Value, json};
use tokio::sync::Notify;

use crate::actions::{Action, Actions};
use crate::orders::Work;
use crate::stream::Stream;
use lab::operations::failure::Failure;
use lab::operations::panel::{
    Contact, MOVES_ALREADY, Notice, Panel, event_text, in_run, remaining_s,
};
use lab::operations::stops::{Ask, Stops};

/// Telemetry is sent to readers in batches of this length.
const PORTION: Duration = Duration::from_millis(50);

/// Latest events of a machine that the state lists.
const SHOWN_EVENTS: usize = 12;

/// An order for a worker.
pub struct Order {
    pub action: u64,
    pub work: Work,
    /// Arrival time, by a clock that may stop while the computer sleeps and by one that may be set.
    pub at: (Instant, SystemTime),
    /// The last stop before this order: of this server, and of any process.
    pub after: (u64, StopMark),
}

impl Order {
    /// How long the order has waited: the longer time of the two clocks.
    pub fn waited(&self) -> Duration {
        let (at, time) = self.at;
        at.elapsed().max(time.elapsed().unwrap_or_default())
    }
}

/// A jog that continues only while it is renewed.
#[derive(Clone, Copy, Debug)]
pub struct Lease {
    pub action: u64,
    /// Number of the latest renewal.
    pub n: u64,
    pub renewed: Instant,
    /// The next renewal must come within this time.
    pub within: Duration,
    /// The latest renewal has not been passed on to the rig yet.
    pub due: bool,
}

pub struct Machine {
    pub kind: DeviceKind,
    pub address: Address,
    panel: Mutex<Panel>,
    /// Number of notices so far. It distinguishes notices with the same words.
    notices: AtomicU64,
    identity: Mutex<Option<(Identity, String)>>,
    pub stops: Arc<Stops>,
    /// Files of the machine's line, once a line is known.
    line_files: Mutex<Option<LineFiles>>,
    /// This server is moving the machine, or began a motion whose end it has not seen.
    pub acting: Arc<AtomicBool>,
    /// The run that this server began last; none if it began another motion afterwards.
    run: Mutex<Option<u32>>,
    pub orders: SyncSender<Order>,
    pub lease: Mutex<Option<Lease>>,
    samples: Mutex<(Vec<Value>, Instant)>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // No code panics while holding the lock; if it did, showing the data is still better than failing.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Withdraws the warning of a motion that no process here began, once the motion is over: a page opened later would
/// still show it.
fn withdraw_warning(panel: &mut Panel) {
    let warns = |notice: &mut Notice| matches!(notice, Notice::Bad(text) if text == MOVES_ALREADY);
    let _over = panel.notice.take_if(warns);
}

impl Machine {
    pub fn new(kind: DeviceKind, address: Address, orders: SyncSender<Order>) -> Self {
        Self {
            kind,
            panel: Mutex::new(Panel::new(kind, address.to_string())),
            address,
            notices: AtomicU64::new(0),
            identity: Mutex::default(),
            stops: Arc::default(),
            line_files: Mutex::default(),
            acting: Arc::default(),
            run: Mutex::default(),
            orders,
            lease: Mutex::default(),
            samples: Mutex::new((vec![], Instant::now())),
        }
    }

    pub fn panel(&self) -> MutexGuard<'_, Panel> {
        lock(&self.panel)
    }

    pub fn lease(&self) -> MutexGuard<'_, Option<Lease>> {
        lock(&self.lease)
    }

    pub fn meet(&self, identity: Option<&Identity>, place: String) {
        *lock(&self.identity) = identity.map(|identity| (*identity, place));
    }

    /// Call this before moving the machine.
    pub fn begin(&self) {
        *lock(&self.run) = None;
        withdraw_warning(&mut self.panel());
        self.acting.store(true, Ordering::SeqCst);
    }

    /// Notes that the rig has accepted this run of the server.
    pub fn runs(&self, run: u32) {
        *lock(&self.run) = Some(run);
    }

    /// Notes the end of a motion that this server began in an earlier connection, if the new status shows it. A run
    /// that finishes without its host continues. A motion of another owner of the line does not count.
    pub fn note_end(&self, is_owner: bool) {
        let mut panel = self.panel();
        if !panel.moves() {
            withdraw_warning(&mut panel);
        }
        let run = panel.rig.filter(in_run).map(|status| status.run);
        let goes_on = match is_owner {
            true => panel.moves() || run.is_some(),
            false => run.is_some() && run == *lock(&self.run),
        };
        drop(panel);
        if !goes_on {
            self.acting.store(false, Ordering::SeqCst);
        }
    }

    /// Sets the files of the machine's line.
    pub fn set_line_files(&self, line_files: Option<LineFiles>) {
        *lock(&self.line_files) = line_files;
    }

    /// Requests a stop. The worker sends it as soon as it sees the request: within 20 ms if there is a connection.
    pub fn stop(&self, urgent: Urgent) -> Ask {
        if let Some(line_files) = &*lock(&self.line_files) {
            line_files.mark_stop(urgent);
        }
        self.stops.with(|stops| stops.ask(urgent))
    }

    /// The latest stop; orders that arrive from now on are newer.
    pub fn last_stop(&self) -> (u64, StopMark) {
        (
            self.stops.with(|stops| stops.asked()),
            LineFiles::last_stops(lock(&self.line_files).as_ref()),
        )
    }

    /// An interrupt that returns requested stops, and Ctrl-C if this server moves the machine.
    pub fn interrupt(&self, pressed: Interrupt) -> Interrupt {
        let (stops, acting) = (Arc::clone(&self.stops), Arc::clone(&self.acting));
        Arc::new(move || {
            let pressed = match acting.load(Ordering::SeqCst) {
                true => pressed(),
                // Ctrl-C does not stop motions that other processes started.
                false => None,
            };
            stops.with(|stops| stops.wanted()).max(pressed)
        })
    }
}

pub struct SharedState {
    pub instance: String,
    pub machines: Vec<Machine>,
    pub actions: Actions,
    pub stream: Stream,
    /// Signals a change that readers should see soon.
    pub changed: Notify,
    /// Folder for the records.
    pub out: PathBuf,
    campaign: Mutex<Value>,
}

impl SharedState {
    pub fn new(instance: String, machines: Vec<Machine>, out: PathBuf) -> Self {
        Self {
            actions: Actions::new(instance.clone()),
            instance,
            machines,
            stream: Stream::default(),
            changed: Notify::new(),
            out,
            campaign: Mutex::new(Value::Null),
        }
    }

    pub fn machine(&self, kind: DeviceKind) -> Option<&Machine> {
        self.machines.iter().find(|machine| machine.kind == kind)
    }

    pub fn show_campaign(&self, campaign: Value) {
        *lock(&self.campaign) = campaign;
    }

    pub fn notice(&self, machine: &Machine, notice: Notice) {
        let mut panel = machine.panel();
        panel.notice = Some(notice);
        // Within the panel's lock, so that each notice has its own number.
        machine.notices.fetch_add(1, Ordering::Relaxed);
        drop(panel);
        self.changed.notify_one();
    }

    pub fn contact(&self, machine: &Machine, contact: Contact) {
        machine.panel().contact = contact;
        self.changed.notify_one();
    }

    /// Adds a sample, which is sent with the others of its batch.
    pub fn sample(&self, machine: &Machine, sample: &Telemetry, missed: u16) {
        let shown = {
            let mut panel = machine.panel();
            panel.sample(sample, missed, Instant::now());
            if !panel.moves() {
                withdraw_warning(&mut panel);
            }
            sample_json(sample, missed, panel.rig.as_ref())
        };
        lock(&machine.samples).0.push(shown);
        self.flush(machine, false);
    }

    /// Sends a complete batch; with `now` also an incomplete one.
    pub fn flush(&self, machine: &Machine, now: bool) {
        let mut samples = lock(&machine.samples);
        if samples.0.is_empty() || (!now && samples.1.elapsed() < PORTION) {
            return;
        }
        samples.1 = Instant::now();
        let portion = std::mem::take(&mut samples.0);
        drop(samples);
        let data = json!({ "samples": portion });
        self.stream.tell(kind_name(machine.kind), &data);
    }

    pub fn event(&self, machine: &Machine, event: &Event) {
        machine.panel().event(event);
        let data = json!({
            "machine": kind_name(machine.kind),
            "index": event.index,
            "time_us": event.time_us,
            "text": event_text(event),
            "what": event.what,
        });
        self.stream.tell("event", &data);
        self.changed.notify_one();
    }

    /// Records that the machine has accepted an action.
    pub fn accepted(&self, number: u64, accepted: Value) {
        let action = self.actions.update(number, |action| {
            action.status = crate::actions::ActionStatus::UnderWay;
            action.accepted = accepted;
        });
        self.tell_action(action);
    }

    pub fn ended(&self, number: u64, result: Value, failure: Option<&Failure>) {
        let action = self.actions.end(number, result, failure, Timestamp::now());
        self.tell_action(action);
    }

    fn tell_action(&self, action: Option<Action>) {
        if let Some(action) = action {
            self.stream.tell("action", &self.actions.json(&action));
            self.changed.notify_one();
        }
    }

    /// Sends the state to all readers.
    pub fn tell_state(&self) {
        if self.stream.is_read() {
            self.stream.tell("state", &self.json());
        }
    }

    pub fn json(&self) -> Value {
        let mut machines = Map::new();
        for machine in &self.machines {
            machines.insert(
                kind_name(machine.kind).to_owned(),
                self.machine_json(machine),
            );
        }
        json!({
            "instance": self.instance,
            "version": version(),
            "time_utc": Timestamp::now(),
            "machines": machines,
            "campaign": *lock(&self.campaign),
        })
    }

    fn machine_json(&self, machine: &Machine) -> Value {
        let now = Instant::now();
        let (panel, number) = {
            let panel = machine.panel();
            (panel.clone(), machine.notices.load(Ordering::Relaxed))
        };
        let (contact, contact_text) = match &panel.contact {
            Contact::Lost(why) => ("lost", why.clone()),
            Contact::Owned => ("owned", "this server owns the line".to_owned()),
            Contact::Broker(owner) => ("broker", format!("through {owner}")),
        };
        let met = lock(&machine.identity).clone();
        let origin = met.as_ref().map_or(Origin::Unknown, |(identity, place)| {
            Origin::of(identity, place)
        });
        let quality = &panel.quality;
        let notice = panel.notice.as_ref().map(|notice| match notice {
            Notice::Done(text) => json!({ "good": true, "text": text, "number": number }),
            Notice::Bad(text) => json!({ "good": false, "text": text, "number": number }),
        });
        let skipped = panel.events.len().saturating_sub(SHOWN_EVENTS);
        let events: Vec<_> = panel
            .events
            .iter()
            .skip(skipped)
            .map(|(time_us, text)| json!({ "time_us": time_us, "text": text }))
            .collect();
        let mut value = json!({
            "place": panel.place,
            "contact": contact,
            "contact_text": contact_text,
            "identity": met.as_ref().map(|(identity, place)| identity_json(identity, place)),
            "origin": origin,
            "link": {
                "samples_per_s": quality.samples_per_s(now),
                "missed_samples": quality.missed,
                "bad_frames": quality.bad_frames,
                "losses": quality.losses,
                "answer_ms": quality.round_trip.map(|time| time.as_millis() as u64),
                "silent_ms": quality.heard.map(|then| now.saturating_duration_since(then).as_millis() as u64),
            },
            "notice": notice,
            "events": events,
            "action": self.actions.latest(machine.kind),
        });
        let (status, fault, shown) = match (&panel.rig, &panel.capsule) {
            (Some(status), _) => (json!(status), fault_json(status.fault), &RIG[..]),
            (None, Some(status)) => (json!(status), fault_json(status.fault), &CAPSULE[..]),
            (None, None) => (Value::Null, Value::Null, &["state"][..]),
        };
        for name in shown {
            value[*name] = status[*name].clone();
        }
        if let Some(status) = &panel.rig {
            value["speed_um_s"] = json!(panel.speed_um_s(now));
            value["stroke_length_um"] = json!(status.stroke_um);
            value["run"] = run_json(status, panel.run_thousandths());
            with_inputs(&mut value, &json!(status.inputs));
        }
        if !status.is_null() {
            value["fault"] = fault;
            value["status"] = status;
        }
        value
    }
}

/// Fields of a status that are also fields of the state.
const RIG: [&str; 4] = ["state", "needs_acknowledge", "homed", "position_um"];
const CAPSULE: [&str; 6] = [
    "state",
    "needs_acknowledge",
    "referenced",
    "thread_um",
    "current_ma",
    "battery_mv",
];

/// Adds the switches and the E-stop loop of a rig, each as a field.
fn with_inputs(value: &mut Value, inputs: &Value) {
    for (name, is_open) in inputs.as_object().into_iter().flatten() {
        value[name.as_str()] = is_open.clone();
    }
}

fn fault_json(fault: Option<impl std::fmt::Display>) -> Value {
    fault.map_or(Value::Null, |fault| json!({ "text": fault.to_string() }))
}

fn identity_json(found: &Identity, place: &str) -> Value {
    let record = IdentityRecord::new(found, place);
    json!({
        "device": record.device,
        "protocol": record.protocol,
        "revision": record.firmware,
        "reset_cause": record.reset_cause,
        "uid": record.uid,
        "record": record,
    })
}

/// The run in progress, if any.
fn run_json(status: &RigStatus, thousandths: Option<u64>) -> Value {
    if !in_run(status) {
        return Value::Null;
    }
    let remaining_s = thousandths.and_then(|done| remaining_s(status, done));
    json!({
        "number": status.run,
        "stroke": status.stroke,
        "strokes": status.strokes,
        "elapsed_us": status.elapsed_us,
        "thousandths": thousandths,
        "remaining_s": remaining_s,
    })
}

fn sample_json(sample: &Telemetry, missed: u16, status: Option<&RigStatus>) -> Value {
    let mut value = match sample {
        Telemetry::Rig(sample) => {
            let mut value = json!(sample);
            with_inputs(&mut value, &json!(sample.inputs));
            value.as_object_mut().map(|fields| fields.remove("inputs"));
            // The panel has already computed the position with the screw of the rig's own status.
            value["position_um"] = json!(status.map(|status| status.position_um));
            value
        }
        Telemetry::Capsule(sample) => json!(sample),
    };
    value["missed"] = json!(missed);
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `Instant` stands on Linux while the computer sleeps.
    #[test]
    fn an_order_waits_while_the_computer_sleeps() {
        let hour = Duration::from_secs(3_600);
        let came = |time| Order {
            action: 1,
            work: Work::Home,
            at: (Instant::now(), time),
            after: (0, StopMark::default()),
        };
        assert!(came(SystemTime::now() - hour).waited() >= hour);
        assert!(
            came(SystemTime::now() + hour).waited() < hour,
            "it was set back"
        );
    }
}
