//! Controls one machine, on its own thread. It owns the line or goes through the broker of its owner, executes orders,
//! and reports what happens. Stops do not pass through here; this thread only notices them.

mod busy;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::thread;
use std::time::{Duration, Instant};

use client::error::{ClientError, Missing};
use client::{Device, Interrupt, Observer, while_moving};
use lab::commissioning::warning;
use lab::operations::arguments::{DATA_FOLDER, RecordArgs};
use lab::operations::connector::LinkPurpose;
use lab::operations::delivery::{Delivery, StopReport};
use lab::operations::failure::{Failure, NO_DEVICE, UNKNOWN};
use lab::operations::finder::{Finder, Target};
use lab::operations::panel::{self, Contact, MOVES_ALREADY, Notice, TELEMETRY_MS};
use lab::operations::{ending, reached};
use lab::trials::experiment::{self, Actuation, ExperimentError};
use lab::trials::trial::Status;
use protocol::rig::{self, RigState, RigStatus, RunOutcome};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{Event, Urgent};
use protocol::table::Telemetry;
use serde_json::{Value, json};

use crate::orders::Work;
use crate::shared_state::{Lease, Machine, Order, SharedState};
use crate::worker::busy::{Busy, Pacing, held};

/// Interval between status requests, us.
const ASK_US: u64 = 250_000;

/// Longest wait for bytes before checking for orders again, us.
const SLICE_US: u64 = 10_000;

/// Interval between status requests during a motion, us.
const POLL_US: u64 = 50_000;

/// Maximum age of an order. After that time the operator no longer expects the machine to move.
const STALE: Duration = Duration::from_secs(5);

/// Time for an owner that only observes to give up its line.
const YIELDING: Duration = Duration::from_secs(3);

/// Time for which a freed line is left to others: it may have been given up for a process that waits.
const LEFT_TO_OTHERS: Duration = Duration::from_millis(200);

/// Interval between attempts to connect.
const AGAIN: Duration = Duration::from_millis(500);

struct ActionResult {
    result: Value,
    files: Value,
    failure: Option<Failure>,
}

impl ActionResult {
    fn failed(result: Value, failure: impl Into<Option<Failure>>) -> Self {
        Self {
            result,
            files: Value::Null,
            failure: failure.into(),
        }
    }
}

impl From<Value> for ActionResult {
    fn from(result: Value) -> Self {
        Self::failed(result, None)
    }
}

pub struct Worker<'a> {
    pub finder: &'a Finder<'a>,
    pub shared: &'a SharedState,
    pub machine: &'a Machine,
    pub orders: Receiver<Order>,
    /// Set when the server shuts down.
    pub leaving: &'a AtomicBool,
    pub pressed: Interrupt,
}

impl Worker<'_> {
    /// Controls the machine until the server shuts down, and reconnects whenever the line is lost. Returns the result
    /// of the last stop if a motion that this server began may continue.
    pub fn work(&self) -> Option<StopReport> {
        // An order that waits until this server owns the line.
        let mut waiting = None;
        let mut last = None;
        while !self.is_leaving() {
            last = None;
            let failure = match self.connection(&mut waiting) {
                Ok(()) if self.is_leaving() => break,
                Ok(()) => {
                    // Another process waits for the line, or this server waits for it.
                    let soon = Duration::from_millis(20);
                    self.pause(waiting.as_ref().map_or(AGAIN, |_| soon), None);
                    continue;
                }
                Err(Failure::Client(error)) if error.is_owner_gone() => {
                    // The owner has finished its command, so the line is free.
                    self.pause(LEFT_TO_OTHERS, None);
                    continue;
                }
                Err(failure) => failure,
            };
            let mut panel = self.machine.panel();
            if !matches!(panel.contact, Contact::Lost(_)) {
                panel.quality.losses += 1;
            }
            drop(panel);
            self.shared
                .contact(self.machine, Contact::Lost(failure.in_one_line()));
            if let Some(order) = waiting.take() {
                self.refuse(&order, &lost(&failure));
            }
            self.pause(AGAIN, Some(&failure));
            last = Some(failure);
        }
        let report = self.stop_what_goes_on(last.as_ref());
        self.shared.flush(self.machine, true);
        for order in waiting.into_iter().chain(self.orders.try_iter()) {
            self.refuse(&order, &server_ends());
        }
        report
    }

    /// Stops a motion that this server began and whose end it has not seen: its line was lost, or its stop was not
    /// confirmed. `last` is the failure of the last connection. Returns the result unless the machine has confirmed it.
    fn stop_what_goes_on(&self, last: Option<&Failure>) -> Option<StopReport> {
        let machine = self.machine;
        let target = Target {
            kind: Some(machine.kind),
            address: Some(machine.address.clone()),
        };
        let (mut sent, mut report) = (None, None);
        while machine.acting.load(Ordering::SeqCst) {
            // Ctrl-C, pressed again, is the emergency stop.
            let Some(urgent) = (self.pressed)().filter(|urgent| sent != Some(*urgent)) else {
                break;
            };
            sent = Some(urgent);
            report = Some(target.report(self.finder.urgent(&target, urgent)));
        }
        machine.acting.store(false, Ordering::SeqCst);
        let mut report = report.filter(|report| report.delivery != Delivery::Stopped)?;
        // Report the failure of the first stop: it contains the position of the carriage.
        if let Some(Failure::Client(error) | Failure::Experiment(ExperimentError::Client(error))) =
            last
            && matches!(
                error,
                ClientError::Unanswered {
                    missing: Missing::Stop,
                    ..
                }
            )
        {
            report.delivery = Delivery::NotConfirmed;
            report.why = error.to_string();
        }
        Some(report)
    }

    fn is_leaving(&self) -> bool {
        self.leaving.load(Ordering::Relaxed)
    }

    /// Waits; orders that arrive without a connection are refused.
    fn pause(&self, limit: Duration, failure: Option<&Failure>) {
        let begin = Instant::now();
        while begin.elapsed() < limit && !self.is_leaving() {
            if let Some(failure) = failure {
                while let Ok(order) = self.orders.try_recv() {
                    self.refuse(&order, &lost(failure));
                }
            }
            thread::sleep(Duration::from_millis(5));
        }
    }

    fn refuse(&self, order: &Order, failure: &Failure) {
        self.shared.ended(order.action, Value::Null, Some(failure));
    }

    /// Connects, and controls the machine until the connection is lost, the server shuts down, or another process needs
    /// the line.
    fn connection(&self, waiting: &mut Option<Order>) -> Result<(), Failure> {
        let (finder, machine) = (self.finder, self.machine);
        machine.set_line_files(finder.connector.line_files(&machine.address));
        let mut device = finder.open(machine.kind, &machine.address, LinkPurpose::Watch)?;
        device.ask_once(true);
        device.set_interrupt(machine.interrupt(Arc::clone(&self.pressed)));
        device.hello(finder.connector.nonce())?;
        device.require(machine.kind)?;
        machine.meet(device.identity(), device.place());
        let owned = device.owner().is_none();
        if owned {
            device.set_telemetry(TELEMETRY_MS)?;
        }
        // Request the status before the first sample: the carriage's position depends on the screw in the status.
        self.ask(&mut device)?;
        self.shared.contact(
            machine,
            match device.owner() {
                None => Contact::Owned,
                Some(owner) => Contact::Broker(owner.to_string()),
            },
        );
        if owned && self.machine.panel().moves() {
            self.shared
                .notice(self.machine, Notice::Bad(MOVES_ALREADY.to_owned()));
        }
        let result = self.watch(&mut device, waiting);
        if owned && result.is_ok() {
            // Ignore failures: the line is given up in any case.
            let _ = device.set_telemetry(0);
        }
        result
    }

    fn watch(&self, device: &mut Device, waiting: &mut Option<Order>) -> Result<(), Failure> {
        let mut asked_us = None;
        while !self.is_leaving() && !device.is_line_wanted() {
            let now_us = device.now_us();
            let due = asked_us.is_none_or(|asked_us| now_us >= asked_us + ASK_US);
            if self.machine.panel().take_changed() || due {
                asked_us = Some(now_us);
                match self.ask(device) {
                    // The owner is busy and answers later.
                    Ok(()) | Err(ClientError::Owned { busy: true, .. }) => {}
                    Err(error) => return Err(error.into()),
                }
            }
            self.settle(device)?;
            let order = waiting.take().or_else(|| self.orders.try_recv().ok());
            if let Some(order) = order {
                asked_us = None;
                if self.needs_line(device, &order) {
                    *waiting = Some(order);
                    return Ok(());
                }
                self.carry_out(device, order)?;
            }
            device.observe(SLICE_US, &mut Seen(self))?;
            self.shared.flush(self.machine, false);
        }
        // The last request may have been a stop.
        self.settle(device)?;
        Ok(())
    }

    /// Whether the order requires owning the line, and the line's owner gives it up.
    fn needs_line(&self, device: &mut Device, order: &Order) -> bool {
        device.owner().is_some()
            && order.work.is_for_owner()
            && order.waited() < YIELDING
            && device.want_line()
    }

    fn ask(&self, device: &mut Device) -> Result<(), ClientError> {
        panel::ask(device, || self.machine.panel())?;
        // After a lost connection, the status shows whether an earlier motion continues.
        self.machine.note_end(device.owner().is_none());
        Ok(())
    }

    /// Waits until a stop that was sent is confirmed; then the machine is ready for the next order.
    fn settle(&self, device: &mut Device) -> Result<(), ClientError> {
        let stops = &self.machine.stops;
        if device.interrupted().is_none() {
            return Ok(());
        }
        device.settle()?;
        // The stop that was sent may be older than the one that a request waits for.
        let (unconfirmed, asked) = stops.with(|stops| (stops.unconfirmed(), stops.asked()));
        if let Some(urgent) = unconfirmed {
            device.urgent(urgent)?;
            stops.with(|stops| stops.confirm(urgent, asked));
        }
        let Some(urgent) = device.interrupted() else {
            return Ok(());
        };
        self.shared.notice(
            self.machine,
            Notice::Done(match urgent {
                Urgent::Stop => "stop confirmed".to_owned(),
                Urgent::EStop => {
                    "EMERGENCY STOP latched; acknowledge it before anything moves".to_owned()
                }
            }),
        );
        device.forget_stop();
        Ok(())
    }

    /// Executes an order. After an error, the connection has to be made again.
    fn carry_out(&self, device: &mut Device, order: Order) -> Result<(), Failure> {
        if let Some(failure) = self.overtaken(&order) {
            self.refuse(&order, &failure);
            return Ok(());
        }
        let acting = order.work.is_for_owner();
        // A motion that this server began before may continue, whatever happens to this order.
        let goes_on = self.machine.acting.load(Ordering::SeqCst);
        if acting {
            device.offer_line(false);
            self.machine.begin();
        }
        let result = self.wait(device, &order);
        let lost = (result.as_ref().err())
            .is_some_and(|failure| matches!(failure.exit_code(), NO_DEVICE | UNKNOWN));
        let outcome = result.unwrap_or_else(|failure| ActionResult::failed(Value::Null, failure));
        // Send all samples first, so that readers have them when the action ends.
        self.shared.flush(self.machine, true);
        let settled = match lost {
            // The motion may continue.
            true => Ok(()),
            false => self.settle(device).and_then(|()| {
                self.machine.acting.store(goes_on, Ordering::SeqCst);
                self.ask(device)
            }),
        };
        self.report(&order, &outcome);
        settled?;
        if lost {
            return Err(outcome.failure.unwrap_or_else(server_ends));
        }
        if acting {
            device.offer_line(true);
            if device.owner().is_none() {
                device.set_telemetry(TELEMETRY_MS)?;
            }
        }
        Ok(())
    }

    /// Why an order must not be executed any more: a stop came after it, or it has waited too long.
    fn overtaken(&self, order: &Order) -> Option<Failure> {
        let (stop, mark) = order.after;
        let (_, last) = self.machine.last_stop();
        let stopped = self.machine.stops.with(|stops| stops.since(stop)).is_some();
        if stopped || last.since(mark).is_some() {
            return Some(Failure::refused(
                "a stop came after this order",
                "nothing was moved by this order; look at the machine, then order it again",
            ));
        }
        let waited = order.waited();
        (waited > STALE).then(|| {
            Failure::refused(
                format!(
                    "the order came too late: the server was busy with the line for {} s",
                    waited.as_secs()
                ),
                "nothing was moved by this order; look at the machine, then try again",
            )
        })
    }

    /// Sends an order to the machine and waits for its end.
    fn wait(&self, device: &mut Device, order: &Order) -> Result<ActionResult, Failure> {
        let (stop, mark) = order.after;
        let stops = &self.machine.stops;
        // From here on, a stop is noticed between any two frames.
        stops.with(|stops| stops.order(Some(stop)));
        device.ordered_at(mark);
        // Repeat questions to a busy owner, because a request waits for this result. A missed status request does not
        // matter.
        device.ask_once(false);
        let result = self.act(device, order.action, &order.work);
        device.ask_once(true);
        stops.with(|stops| stops.order(None));
        result
    }

    /// Reports how an order ended.
    fn report(&self, order: &Order, outcome: &ActionResult) {
        let (action, kind) = (order.action, order.work.kind());
        self.shared.actions.update(action, |action| {
            if !outcome.files.is_null() {
                action.files.clone_from(&outcome.files);
            }
        });
        // Set the notice first, so that no state after the end shows the previous one.
        self.shared.notice(
            self.machine,
            match &outcome.failure {
                None => Notice::Done(format!("{kind}: done")),
                Some(failure) => Notice::Bad(failure.in_one_line()),
            },
        );
        self.shared
            .ended(action, outcome.result.clone(), outcome.failure.as_ref());
    }

    fn act(&self, device: &mut Device, action: u64, work: &Work) -> Result<ActionResult, Failure> {
        if work.is_for_owner() {
            LinkPurpose::Own(work.kind()).admit(device)?;
        }
        let mut busy = Busy {
            shared: self.shared,
            machine: self.machine,
            orders: &self.orders,
            action,
            kind: work.kind(),
            pacing: Pacing::default(),
        };
        match work {
            Work::Home => {
                let homed = experiment::home(device, &mut busy)?;
                Ok(json!(homed).into())
            }
            Work::Run(run, record) => self.run(device, *run, record, busy),
            Work::Actuate(motion, record) => self.actuate(device, *motion, record, busy),
            Work::Move(to) => self.move_to(device, *to, &mut busy),
            Work::Jog(jog) => {
                let result = self.jog(device, action, *jog, &mut busy);
                // However the jog ended, further renewals do not count.
                *self.machine.lease() = None;
                result
            }
            Work::Hold => {
                let status = ending::held(device)?;
                Ok(json!({ "position_um": status.position_um }).into())
            }
            Work::Resume => {
                device.call(rig::Resume)?;
                let status = device.rig_status()?;
                Ok(json!({ "position_um": status.position_um }).into())
            }
            Work::Acknowledge => {
                device.acknowledge()?;
                Ok(json!({ "acknowledged": true }).into())
            }
        }
    }

    fn run(
        &self,
        rig: &mut Device,
        run: rig::Run,
        record: &RecordArgs,
        mut busy: Busy<'_>,
    ) -> Result<ActionResult, Failure> {
        let folders = [self.shared.out.clone(), DATA_FOLDER.into()];
        if let Some(warning) = warning::of_record(rig, &folders)? {
            self.shared
                .notice(self.machine, Notice::Bad(format!("warning: {warning}")));
        }
        let pacing = Arc::clone(&busy.pacing);
        rig.set_pacer(Box::new(move || {
            let mut pacing = held(&pacing);
            let (_, pace, sent) = pacing.as_mut()?;
            (!std::mem::replace(sent, true)).then_some(*pace)
        }));
        let now = self.finder.connector.now();
        let recording = record.recording(&self.shared.out, "run", now);
        let trial = experiment::run(rig, run, &recording, &mut busy);
        rig.set_pacer(Box::new(|| None));
        // Fail a hold that came too late for this run.
        let too_late = Failure::refused(
            "too late, the run has ended",
            "nothing is held; the state says where the rig is",
        );
        busy.paced(Err(&too_late));
        let trial = trial?;
        let at = trial.sidecar.display();
        let way_on = match trial.trial.status {
            Status::Faulted => "once the cause is removed acknowledge it, then home",
            _ => "a new run has to start at 0: home first",
        };
        let help = format!("the data is in {at}; {way_on}");
        let failure = ending::completed("the run", &trial.trial, help).err();
        Ok(ActionResult {
            result: json!(trial.trial.action)["executed"].clone(),
            files: files(&trial.csv, &trial.sidecar),
            failure,
        })
    }

    fn actuate(
        &self,
        capsule: &mut Device,
        motion: Actuation,
        record: &RecordArgs,
        mut busy: Busy<'_>,
    ) -> Result<ActionResult, Failure> {
        let kind = motion.kind;
        if let Some((status, _)) = reached::reached(kind, capsule)? {
            return Ok(json!({ "already": true, "thread_um": status.thread_um }).into());
        }
        let now = self.finder.connector.now();
        let recording = record.recording(&self.shared.out, experiment::stem(kind), now);
        let trial = experiment::actuate(capsule, motion, &recording, &mut busy)?;
        let help = format!("the data is in {}", trial.sidecar.display());
        let failure = ending::completed(experiment::doing(kind), &trial.trial, help).err();
        Ok(ActionResult {
            result: json!(trial.record),
            files: files(&trial.csv, &trial.sidecar),
            failure,
        })
    }

    fn move_to(
        &self,
        rig: &mut Device,
        to: rig::MoveTo,
        busy: &mut Busy<'_>,
    ) -> Result<ActionResult, Failure> {
        let accepted = match rig.call(to) {
            Err(error) if reached::is_there(&error) => {
                let status = rig.rig_status()?;
                let mut result = place(&status);
                result["already"] = json!(true);
                return Ok(result.into());
            }
            accepted => accepted?,
        };
        let (outcome, status) = rig.wait_move(&accepted, busy)?;
        if outcome != RunOutcome::Complete {
            let failure = ending::cut_short("the move", rig, &status);
            return Ok(ActionResult::failed(place(&status), failure));
        }
        Ok(place(&status).into())
    }

    /// Passes each renewal on to the rig once. Nothing else keeps the jog moving, so that it ends by itself wherever
    /// the chain from the browser to the rig breaks.
    fn jog(
        &self,
        rig: &mut Device,
        action: u64,
        jog: rig::Jog,
        busy: &mut Busy<'_>,
    ) -> Result<ActionResult, Failure> {
        let key = SettingKey::DeadManMs;
        let dead_man_ms = u64::from(rig.call(GetSetting { key })?.value);
        // Shorter than the rig's own limit: a renewal after that limit would begin a new jog.
        let within = Duration::from_millis(dead_man_ms * 5 / 6);
        rig.call(jog)?;
        *self.machine.lease() = Some(Lease {
            action,
            n: 0,
            renewed: Instant::now(),
            within,
            due: false,
        });
        let accepted =
            json!({ "renew_within_ms": within.as_millis() as u64, "dead_man_ms": dead_man_ms });
        self.shared.accepted(action, accepted);
        let silent = |error| while_moving("the jog", error);
        let mut asked_us = rig.now_us();
        loop {
            rig.observe(SLICE_US, busy).map_err(silent)?;
            busy.take_orders();
            if rig.interrupted().is_some() {
                break;
            }
            let renewal = {
                let mut lease = self.machine.lease();
                match lease.as_mut() {
                    Some(lease) if lease.renewed.elapsed() < lease.within => {
                        std::mem::take(&mut lease.due)
                    }
                    // No renewal came in time; from now on renewals are refused.
                    _ => {
                        *lease = None;
                        break;
                    }
                }
            };
            // Check the state before each renewal: this computer may have slept since the renewal arrived, which no
            // clock here shows. The jog has ended then, and a renewal would begin another one.
            if renewal || rig.now_us() >= asked_us + POLL_US {
                asked_us = rig.now_us();
                let status = rig.rig_status().map_err(silent)?;
                self.machine.panel().rig_status(&status, Instant::now());
                if status.state != RigState::Moving {
                    break;
                }
            }
            if renewal {
                match rig.call(jog) {
                    Ok(_) => {}
                    // The jog has just ended; the status shows how.
                    Err(ClientError::Refused { .. } | ClientError::Interrupted { .. }) => break,
                    Err(error) => return Err(error.into()),
                }
            }
        }
        *self.machine.lease() = None;
        rig.urgent(Urgent::Stop)?;
        let status = rig.wait_rest(busy)?;
        let emergency = rig.interrupted() == Some(Urgent::EStop);
        let failure = (status.fault.is_some() || emergency)
            .then(|| ending::cut_short("the jog", rig, &status));
        Ok(ActionResult::failed(place(&status), failure))
    }
}

/// Handles what the machine sends while no order is executed.
struct Seen<'a>(&'a Worker<'a>);

impl Observer for Seen<'_> {
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.0.shared.sample(self.0.machine, sample, missed);
    }
    fn event(&mut self, event: &Event) {
        self.0.shared.event(self.0.machine, event);
    }
}

fn place(status: &RigStatus) -> Value {
    json!({ "position_um": status.position_um, "position_steps": status.position_steps })
}

fn files(csv: &Path, sidecar: &Path) -> Value {
    let name = |path: &Path| {
        path.file_name()
            .map(|name| name.to_string_lossy().into_owned())
    };
    json!({ "csv": name(csv), "sidecar": name(sidecar) })
}

/// Failure of an order that arrives without a connection.
fn lost(failure: &Failure) -> Failure {
    Failure::Unreached {
        why: format!("nothing was sent, there is no contact: {failure}"),
        help: failure.remedy(),
    }
}

/// Failure of an order when the server shuts down.
fn server_ends() -> Failure {
    Failure::refused(
        "the server ends",
        "nothing was moved by this order; start the server again",
    )
}
