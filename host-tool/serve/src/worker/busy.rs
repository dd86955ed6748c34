//! Observes an action: reports what the machine sends, and takes a hold or a resume.

use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use client::error::ClientError;
use client::{Begun, Observer, Pace, Progress};
use lab::operations::failure::Failure;
use lab::operations::panel::{self, Notice};
use lab::trials::trial::Achieved;
use protocol::error::Refusal;
use protocol::rig::RigEvent;
use protocol::system::{Event, What};
use protocol::table::Telemetry;
use serde_json::{Value, json};

use crate::orders::Work;
use crate::shared_state::{Machine, Order, SharedState};

/// A hold or a resume of a run that has not ended yet: its action, its kind, and whether it was sent.
pub(super) type Pacing = Arc<Mutex<Option<(u64, Pace, bool)>>>;

pub(super) fn held(pacing: &Pacing) -> MutexGuard<'_, Option<(u64, Pace, bool)>> {
    pacing.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Handles messages of the machine during an action, and takes orders.
pub(super) struct Busy<'a> {
    pub(super) shared: &'a SharedState,
    pub(super) machine: &'a Machine,
    pub(super) orders: &'a Receiver<Order>,
    pub(super) action: u64,
    pub(super) kind: &'static str,
    pub(super) pacing: Pacing,
}

impl Busy<'_> {
    /// Takes orders during an action: accepts a hold or a resume of a run, and nothing else.
    pub(super) fn take_orders(&mut self) {
        while let Ok(order) = self.orders.try_recv() {
            let pace = match order.work {
                Work::Hold => Some(Pace::Hold),
                Work::Resume => Some(Pace::Resume),
                _ => None,
            };
            let mut pacing = held(&self.pacing);
            match pace {
                Some(pace) if self.kind == "run" && pacing.is_none() => {
                    *pacing = Some((order.action, pace, false));
                }
                _ => {
                    drop(pacing);
                    let machine = client::identity::kind_name(self.machine.kind);
                    let failure = Failure::refused(
                        format!("the {machine} is busy: `{}` is under way", self.kind),
                        "nothing was moved by this request; wait for the end, or stop it",
                    );
                    self.shared.ended(order.action, Value::Null, Some(&failure));
                }
            }
        }
        self.shared.flush(self.machine, false);
    }

    /// Reports the end of the pending hold or resume.
    pub(super) fn paced(&self, end: Result<Value, &Failure>) {
        let Some((action, ..)) = held(&self.pacing).take() else {
            return;
        };
        let shared = self.shared;
        match end {
            Ok(result) => shared.ended(action, result, None),
            Err(failure) => {
                // Set the notice first, so that no state after the end shows the previous one.
                shared.notice(self.machine, Notice::Bad(failure.in_one_line()));
                shared.ended(action, Value::Null, Some(failure));
            }
        }
    }
}

impl Observer for Busy<'_> {
    fn begun(&mut self, begun: &Begun) {
        if let Begun::Run(accepted) = begun {
            self.machine.runs(accepted.run);
        }
        if let (Begun::Run(accepted), Some(status)) = (begun, &mut self.machine.panel().rig) {
            // The panel is otherwise stale until the next status request.
            status.run = accepted.run;
            status.strokes = u32::from(accepted.requested.cycles) * 2;
            status.elapsed_us = 0;
        }
        let accepted = match begun {
            Begun::Homing(accepted) => json!(accepted),
            Begun::Run(accepted) => json!(Achieved::from(accepted)),
            Begun::Actuation(accepted) => json!(accepted),
            Begun::Move(accepted) => json!(accepted),
        };
        self.shared.accepted(self.action, accepted);
    }

    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.shared.sample(self.machine, sample, missed);
    }

    fn event(&mut self, event: &Event) {
        self.shared.event(self.machine, event);
        let at = |steps: i32| {
            let status = self.machine.panel().rig;
            // The panel's own position is as old as the last sample.
            let position_um = status.map(|status| panel::position_um(&status, steps));
            json!({ "position_steps": steps, "position_um": position_um })
        };
        let waiting = held(&self.pacing).map(|(_, pace, _)| pace);
        match (event.what, waiting) {
            (What::Rig(RigEvent::Held { position_steps }), Some(Pace::Hold)) => {
                self.paced(Ok(at(position_steps)));
            }
            (What::Rig(RigEvent::Resumed), Some(Pace::Resume)) => {
                let steps = self
                    .machine
                    .panel()
                    .rig
                    .map_or(0, |status| status.position_steps);
                self.paced(Ok(at(steps)));
            }
            _ => {}
        }
    }

    fn progress(&mut self, progress: &Progress) {
        let shown = json!(progress);
        self.shared
            .actions
            .update(self.action, |action| action.progress = shown);
        {
            // The wait has requested the status; copy to the panel what telemetry does not contain.
            let mut panel = self.machine.panel();
            if let (
                Progress::Run {
                    elapsed_us,
                    strokes,
                    ..
                },
                Some(status),
            ) = (progress, &mut panel.rig)
            {
                status.elapsed_us = *elapsed_us;
                status.strokes = *strokes;
            }
        }
        self.take_orders();
    }

    fn unrecorded(&mut self, why: &str) {
        let notice = format!("NOT RECORDED from here on: {why}; the machine continues");
        self.shared.notice(self.machine, Notice::Bad(notice));
    }

    fn refused(&mut self, pace: Pace, refusal: &Refusal) {
        let failure = Failure::Client(ClientError::Refused {
            place: self.machine.address.to_string(),
            request: match pace {
                Pace::Hold => "Hold",
                Pace::Resume => "Resume",
            },
            impact: protocol::table::Impact::Pace,
            refusal: *refusal,
        });
        self.paced(Err(&failure));
    }

    fn turn(&mut self, _now_us: u64, _clock: Option<client::Clock>) {
        self.take_orders();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{SyncSender, sync_channel};
    use std::time::Instant;

    use client::address::Address;
    use protocol::system::DeviceKind;

    use super::*;
    use crate::actions::{Arrival, RequestedAction};
    use jiff::Timestamp;

    fn shared() -> (SharedState, SyncSender<Order>, Receiver<Order>) {
        let (orders, received) = sync_channel(8);
        let machine = Machine::new(DeviceKind::Rig, Address::Virtual, orders.clone());
        let shared = SharedState::new("i".to_owned(), vec![machine], "/nowhere".into());
        (shared, orders, received)
    }

    fn arrived(shared: &SharedState, key: &str, kind: &'static str) -> u64 {
        let action = RequestedAction {
            key: key.to_owned(),
            print: [0; 32],
            machine: DeviceKind::Rig,
            kind,
            requested: Value::Null,
        };
        match shared.actions.arrive(action, Timestamp::UNIX_EPOCH) {
            Arrival::New(number) => number,
            other => panic!("{other:?}"),
        }
    }

    fn busy<'a>(
        shared: &'a SharedState,
        orders: &'a Receiver<Order>,
        action: u64,
        kind: &'static str,
    ) -> Busy<'a> {
        Busy {
            shared,
            machine: &shared.machines[0],
            orders,
            action,
            kind,
            pacing: Pacing::default(),
        }
    }

    #[test]
    fn while_a_run_goes_on_one_hold_is_taken_and_nothing_else() {
        for (kind, taken) in [("run", true), ("home", false)] {
            let (shared, orders, received) = shared();
            let action = arrived(&shared, "a", kind);
            let mut busy = busy(&shared, &received, action, kind);
            let mut numbers = vec![];
            for (key, work) in [
                ("b", Work::Home),
                ("c", Work::Hold),
                ("d", Work::Resume),
                ("e", Work::Hold),
            ] {
                let number = arrived(&shared, key, work.kind());
                numbers.push(number);
                let order = Order {
                    action: number,
                    work,
                    at: (Instant::now(), std::time::SystemTime::now()),
                    after: Default::default(),
                };
                orders.send(order).expect("room");
            }
            busy.turn(0, None);
            let ended = numbers.iter().map(|number| {
                let action = shared.actions.get(*number).expect("known");
                action.status.is_over()
            });
            assert_eq!(ended.collect::<Vec<_>>(), [true, !taken, true, true]);
            let expected = taken.then_some((numbers[1], Pace::Hold, false));
            assert_eq!(*held(&busy.pacing), expected);
        }
    }
}
