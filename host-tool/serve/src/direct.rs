//! Direct requests bypass the worker, each on its own thread: stops, which wait for nothing, and questions. Questions
//! go through the broker like those of other processes, so they are answered while the worker is busy.

use std::sync::mpsc::{Receiver, channel};
use std::thread::{self, Scope};
use std::time::{Duration, Instant};

use client::identity::kind_name;
use protocol::rig;
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{DeviceKind, Urgent};
use serde_json::{Value, json};
use tokio::sync::{OwnedSemaphorePermit, oneshot};

use crate::shared_state::{Machine, SharedState};
use lab::operations::connector::LinkPurpose;
use lab::operations::delivery::{DO_NOW, Delivery, StopReport};
use lab::operations::failure::Failure;
use lab::operations::finder::{Finder, Target, past_owners};
use lab::operations::panel::Notice;
use lab::operations::stops::{self, Ask};

/// Time for the worker to confirm a stop that failed directly.
const WORKER_TIME: Duration = Duration::from_secs(1);

/// A question to a machine.
#[derive(Clone, Copy, Debug)]
pub enum Question {
    Health,
    Settings(DeviceKind),
}

impl Question {
    fn about(self) -> DeviceKind {
        match self {
            Self::Health => DeviceKind::Rig,
            Self::Settings(kind) => kind,
        }
    }
}

/// A request that waits for a stop.
pub struct Wait {
    pub ask: Ask,
    pub reply: oneshot::Sender<StopReport>,
}

/// A task that bypasses the worker.
pub enum DirectRequest {
    Stop {
        machine: DeviceKind,
        urgent: Urgent,
        wait: Wait,
    },
    Ask {
        question: Question,
        reply: oneshot::Sender<Result<Value, Failure>>,
        /// Permit that limits the questions in progress.
        place: OwnedSemaphorePermit,
    },
    /// The server is shutting down.
    End,
}

/// Dispatches direct requests until the server shuts down.
pub fn run<'scope>(
    scope: &'scope Scope<'scope, '_>,
    finder: &'scope Finder<'scope>,
    shared: &'scope SharedState,
    direct: &Receiver<DirectRequest>,
) {
    // One thread per kind of stop, so that an emergency stop never waits for an ordinary one.
    let mut couriers = vec![];
    for machine in &shared.machines {
        for urgent in [Urgent::Stop, Urgent::EStop] {
            let (waits, waiting) = channel();
            let courier = thread::Builder::new().spawn_scoped(scope, move || {
                while let Ok(first) = waiting.recv() {
                    let all = std::iter::once(first).chain(waiting.try_iter()).collect();
                    stop(finder, shared, machine, urgent, all, WORKER_TIME);
                }
            });
            if courier.is_ok() {
                couriers.push((machine.kind, urgent, waits));
            }
        }
    }
    for request in direct {
        match request {
            DirectRequest::End => return,
            DirectRequest::Stop {
                machine,
                urgent,
                wait,
            } => {
                let courier = couriers
                    .iter()
                    .find(|courier| (courier.0, courier.1) == (machine, urgent));
                if let Some((.., waits)) = courier {
                    // Cannot fail: the receiving thread lives as long as this one.
                    let _ = waits.send(wait);
                } else if let Some(machine) = shared.machine(machine) {
                    // No thread could be started: stop one machine after the other.
                    stop(finder, shared, machine, urgent, vec![wait], WORKER_TIME);
                }
            }
            DirectRequest::Ask {
                question,
                reply,
                place,
            } => {
                // Without a thread the question gets no answer, and the client receives an error.
                let _ = thread::Builder::new().spawn_scoped(scope, move || {
                    // The client may have disconnected.
                    let _ = reply.send(ask(finder, shared, question));
                    drop(place);
                });
            }
        }
    }
}

/// Stops a machine once for all requests that wait for it. The stop goes through the broker of the line's owner
/// (usually the worker) or over a separate line. If that fails, waits up to `patience` for the worker, which sends the
/// stop as well.
pub fn stop(
    finder: &Finder<'_>,
    shared: &SharedState,
    machine: &Machine,
    urgent: Urgent,
    waits: Vec<Wait>,
    patience: Duration,
) {
    let target = Target {
        kind: Some(machine.kind),
        address: Some(machine.address.clone()),
    };
    let stops = &machine.stops;
    // Every waiting request has been counted by now.
    let asked = stops.with(|stops| stops.asked());
    let report = target.report(finder.urgent(&target, urgent));
    if report.delivery == Delivery::Stopped {
        stops.with(|stops| stops.confirm(urgent, asked));
    } else {
        let begin = Instant::now();
        let is_open = |wait: &Wait| !stops.with(|stops| stops.is_confirmed(wait.ask));
        while begin.elapsed() < patience && waits.iter().any(is_open) {
            thread::sleep(Duration::from_millis(5));
        }
        if waits.iter().any(is_open) {
            let name = stops::name(urgent);
            let notice = format!("{name} NOT CONFIRMED: {DO_NOW} ({})", report.why);
            shared.notice(machine, Notice::Bad(notice));
        }
    }
    for Wait { ask, reply } in waits {
        let mut report = report.clone();
        if stops.with(|stops| stops.is_confirmed(ask)) {
            report.delivery = Delivery::Stopped;
            report.why = String::new();
        }
        stops.with(|stops| stops.withdraw(ask));
        // The waiting client may have disconnected.
        let _ = reply.send(report);
    }
}

pub fn ask(
    finder: &Finder<'_>,
    shared: &SharedState,
    question: Question,
) -> Result<Value, Failure> {
    let Some(machine) = shared.machine(question.about()) else {
        let name = kind_name(question.about());
        return Err(Failure::input(
            format!("this server has no {name}"),
            format!("start it with `--{name} WHERE`"),
        ));
    };
    past_owners(|| {
        let mut device = finder.open(machine.kind, &machine.address, LinkPurpose::Glance)?;
        device.hello(finder.connector.nonce())?;
        device.require(machine.kind)?;
        match question {
            Question::Health => Ok(json!({
                "health": device.call(rig::GetRigHealth)?,
                "hardware": device.call(rig::GetRigHardware)?,
            })),
            Question::Settings(kind) => {
                let settings = SettingKey::of(kind)
                    .map(|key| {
                        let value = device.call(GetSetting { key })?.value;
                        let range = key.range();
                        Ok(json!({
                            "name": key.name(), "value": value, "unit": key.unit(),
                            "min": range.min, "max": range.max, "default": range.default,
                            "purpose": key.doc(),
                        }))
                    })
                    .collect::<Result<Vec<_>, Failure>>()?;
                Ok(json!({ "settings": settings }))
            }
        }
    })
}
