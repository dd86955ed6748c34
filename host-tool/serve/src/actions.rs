//! Actions: commands and their results. Each command is executed once, however often it is requested.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use client::identity::kind_name;
use jiff::Timestamp;
use protocol::system::DeviceKind;
use serde::Serialize;
use serde_json::{Value, json};
use tokio::sync::watch;

use lab::operations::failure::{FAULT, Failure, NO_DEVICE, REFUSED, STOPPED, UNKNOWN};

/// Actions kept in memory; the oldest finished ones are removed first.
pub const KEPT: usize = 512;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionStatus {
    /// The machine has not answered yet.
    Starting,
    /// The machine has accepted it.
    UnderWay,
    Complete,
    Stopped,
    /// Stopped by the machine, because it did not hear the server.
    LinkLost,
    Faulted,
    /// Refused; the action did not begin.
    Refused,
    /// Failed to begin, or its record could not be written.
    Failed,
    Unknown,
}

impl ActionStatus {
    pub fn is_over(self) -> bool {
        !matches!(self, Self::Starting | Self::UnderWay)
    }

    /// State of an action that ended with this failure.
    fn of(failure: &Failure) -> Self {
        match failure {
            // It has the exit code of a fault.
            Failure::Ended {
                status: lab::trials::trial::Status::LinkLost,
                ..
            } => Self::LinkLost,
            failure => match failure.exit_code() {
                REFUSED => Self::Refused,
                STOPPED => Self::Stopped,
                FAULT => Self::Faulted,
                UNKNOWN => Self::Unknown,
                _ => Self::Failed,
            },
        }
    }
}

#[derive(Clone, Debug)]
pub struct RequestedAction {
    pub key: String,
    /// Hash of the request; shows when a key is reused for a different request.
    pub print: [u8; 32],
    pub machine: DeviceKind,
    pub kind: &'static str,
    pub requested: Value,
}

/// A command and its state.
#[derive(Clone, Debug)]
pub struct Action {
    pub number: u64,
    command: RequestedAction,
    pub status: ActionStatus,
    pub accepted: Value,
    pub progress: Value,
    pub result: Value,
    /// The failure as `--json` prints it, and its exit code.
    pub failure: Option<(u8, Value)>,
    pub files: Value,
    started: Timestamp,
    ended: Option<Timestamp>,
    /// Number in the order of ends. The computer's clock may be set back, so times do not give this order.
    ended_nth: u64,
}

/// Classifies an incoming request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// New; execute it under this number.
    New(u64),
    /// A repetition of the action with this number.
    Again(u64),
    /// The key is already used for a different request.
    Contradiction,
}

/// All actions that this server remembers.
#[derive(Debug)]
pub struct Actions {
    instance: String,
    list: Mutex<VecDeque<Action>>,
    /// Number of actions that have ended.
    ends: AtomicU64,
    changes: watch::Sender<u64>,
}

impl Actions {
    pub fn new(instance: String) -> Self {
        Self {
            instance,
            list: Mutex::default(),
            ends: AtomicU64::new(0),
            changes: watch::Sender::new(0),
        }
    }

    fn list(&self) -> MutexGuard<'_, VecDeque<Action>> {
        self.list.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Registers a request; a repetition does not create a new action.
    pub fn arrive(&self, command: RequestedAction, now: Timestamp) -> Arrival {
        let mut list = self.list();
        if let Some(known) = list.iter().find(|action| action.command.key == command.key) {
            return match known.command.print == command.print {
                true => Arrival::Again(known.number),
                false => Arrival::Contradiction,
            };
        }
        let number = list.back().map_or(1, |last| last.number + 1);
        if list.len() >= KEPT {
            // Keep actions in progress, because their results are still needed. They are few, so memory stays bounded.
            let oldest = list.iter().position(|action| action.status.is_over());
            oldest.and_then(|oldest| list.remove(oldest));
        }
        list.push_back(Action {
            number,
            command,
            status: ActionStatus::Starting,
            accepted: Value::Null,
            progress: Value::Null,
            result: Value::Null,
            failure: None,
            files: Value::Null,
            started: now,
            ended: None,
            ended_nth: 0,
        });
        Arrival::New(number)
    }

    pub fn get(&self, number: u64) -> Option<Action> {
        let list = self.list();
        list.iter().find(|action| action.number == number).cloned()
    }

    /// The action's number from an `id`.
    pub fn number(&self, id: &str) -> Option<u64> {
        let (instance, number) = id.rsplit_once('-')?;
        (instance == self.instance).then(|| number.parse().ok())?
    }

    /// Changes an action and wakes every request that waits for it.
    pub fn update(&self, number: u64, change: impl FnOnce(&mut Action)) -> Option<Action> {
        let mut list = self.list();
        let action = list.iter_mut().find(|action| action.number == number)?;
        change(action);
        let action = action.clone();
        drop(list);
        self.changes.send_modify(|count| *count += 1);
        Some(action)
    }

    /// Records the end of an action.
    pub fn end(
        &self,
        number: u64,
        result: Value,
        failure: Option<&Failure>,
        now: Timestamp,
    ) -> Option<Action> {
        let nth = 1 + self.ends.fetch_add(1, Ordering::Relaxed);
        self.update(number, |action| {
            action.status = failure.map_or(ActionStatus::Complete, ActionStatus::of);
            // The machine accepted the action and was lost afterwards, or while the order was being sent.
            let gone = failure.is_some_and(|failure| failure.exit_code() == NO_DEVICE);
            let cut = failure.is_some_and(Failure::is_cut);
            if gone && !action.accepted.is_null() || cut {
                action.status = ActionStatus::Unknown;
            }
            action.progress = Value::Null;
            action.result = result;
            action.failure =
                failure.map(|failure| (failure.exit_code(), failure.json()["error"].clone()));
            action.ended = Some(now);
            action.ended_nth = nth;
        })
    }

    /// Whether no action of this machine is in progress.
    pub fn are_over(&self, machine: DeviceKind) -> bool {
        let list = self.list();
        let mut ours = list
            .iter()
            .filter(|action| action.command.machine == machine);
        ours.all(|action| action.status.is_over())
    }

    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    pub fn json(&self, action: &Action) -> Value {
        json!({
            "id": format!("{}-{}", self.instance, action.number),
            "machine": kind_name(action.command.machine),
            "kind": action.command.kind,
            "state": action.status,
            "requested": action.command.requested,
            "accepted": action.accepted,
            "progress": action.progress,
            "result": action.result,
            "error": action.failure.as_ref().map(|(_, error)| error),
            "files": action.files,
            "started_utc": action.started,
            "ended_utc": action.ended,
        })
    }

    /// All remembered actions, oldest first.
    pub fn all(&self) -> Vec<Value> {
        let list = self.list().clone();
        list.iter().map(|action| self.json(action)).collect()
    }

    /// The action of this machine in progress, or else the one that ended last.
    pub fn latest(&self, machine: DeviceKind) -> Value {
        let list = self.list();
        let ours = || {
            list.iter()
                .rev()
                .filter(|action| action.command.machine == machine)
        };
        let under_way = ours().find(|action| action.status == ActionStatus::UnderWay);
        // A hold or a resume ends before its run, so it does not hide the run.
        let ended = ours().max_by_key(|action| action.ended_nth);
        let shown = under_way.or(ended).cloned();
        drop(list);
        shown.map_or(Value::Null, |action| self.json(&action))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn command(key: &str, print: u8) -> RequestedAction {
        RequestedAction {
            key: key.to_owned(),
            print: [print; 32],
            machine: DeviceKind::Rig,
            kind: "home",
            requested: Value::Null,
        }
    }

    #[test]
    fn a_request_is_one_action_however_often_it_comes() {
        let actions = Actions::new("i".to_owned());
        let arrive = |key, print| actions.arrive(command(key, print), Timestamp::UNIX_EPOCH);
        assert_eq!(arrive("a", 1), Arrival::New(1));
        assert_eq!(arrive("a", 1), Arrival::Again(1));
        assert_eq!(arrive("a", 2), Arrival::Contradiction);
        assert_eq!(arrive("b", 1), Arrival::New(2));
        actions.end(1, Value::Null, None, Timestamp::UNIX_EPOCH);
        assert_eq!(arrive("a", 1), Arrival::Again(1));
        assert_eq!(actions.number("i-2"), Some(2));
        assert_eq!(actions.number("j-2"), None);
    }

    #[test]
    fn memory_is_bounded_and_the_latest_are_kept() {
        let actions = Actions::new("i".to_owned());
        for number in 0..=KEPT {
            let key = number.to_string();
            let arrived = actions.arrive(command(&key, 0), Timestamp::UNIX_EPOCH);
            let Arrival::New(new) = arrived else {
                panic!("{arrived:?}");
            };
            // The first one goes on.
            if number > 0 {
                actions.end(new, Value::Null, None, Timestamp::UNIX_EPOCH);
            }
        }
        assert_eq!(actions.all().len(), KEPT);
        assert!(actions.get(1).is_some(), "it is under way");
        assert!(actions.get(2).is_none());
        let again = actions.arrive(command("2", 0), Timestamp::UNIX_EPOCH);
        assert_eq!(again, Arrival::Again(3));
    }

    #[test]
    fn an_accepted_action_whose_machine_is_lost_has_an_unknown_end() {
        let gone = Failure::Unreached {
            why: "it is away".to_owned(),
            help: "plug it in".to_owned(),
        };
        for (accepted, state) in [(json!({ "edges": 1 }), "unknown"), (Value::Null, "failed")] {
            let actions = Actions::new("i".to_owned());
            actions.arrive(command("a", 1), Timestamp::UNIX_EPOCH);
            actions.update(1, |action| action.accepted = accepted);
            let ended = actions.end(1, Value::Null, Some(&gone), Timestamp::UNIX_EPOCH);
            assert_eq!(actions.json(&ended.expect("there"))["state"], state);
        }
    }

    #[test]
    fn what_is_under_way_is_shown_before_what_has_ended() {
        let actions = Actions::new("i".to_owned());
        let now = Timestamp::UNIX_EPOCH;
        for key in ["run", "hold"] {
            actions.arrive(command(key, 0), now);
        }
        let changes = actions.changes();
        actions.update(1, |action| action.status = ActionStatus::UnderWay);
        assert!(changes.has_changed().expect("open"));
        actions.end(2, Value::Null, None, now);
        assert_eq!(actions.latest(DeviceKind::Rig)["id"], "i-1");
        assert!(!actions.are_over(DeviceKind::Rig));
        // The last to end is the latest, even if the clock was set back meanwhile.
        actions.end(1, Value::Null, None, Timestamp::MIN);
        assert_eq!(actions.latest(DeviceKind::Rig)["id"], "i-1");
        assert!(actions.are_over(DeviceKind::Rig));
    }

    #[test]
    fn an_action_that_failed_says_in_which_way() {
        use lab::trials::trial::Status;
        for (status, name) in [
            (Status::LinkLost, "link_lost"),
            (Status::Faulted, "faulted"),
            (Status::Stopped, "stopped"),
            (Status::Refused, "refused"),
            (Status::Unknown, "unknown"),
        ] {
            let failure = Failure::Ended {
                action: "the run",
                status,
                reason: None,
                help: String::new(),
            };
            assert_eq!(json!(ActionStatus::of(&failure)), name, "{failure}");
        }
        let input = Failure::input("no", "mend it");
        assert_eq!(json!(ActionStatus::of(&input)), "failed");
    }
}
