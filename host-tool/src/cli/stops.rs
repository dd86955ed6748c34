//! `stop` and `estop`: to every machine at once, and what became of each.

use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use client::error::ClientError;
use client::identity;
use protocol::system::Urgent;
use serde_json::{Value, json};

use crate::cli::args::{Subcommand, Which};
use crate::cli::failure::Failure;
use crate::cli::finding::{Finder, Target};
use crate::cli::screen::Screen;

/// After this time the operator is told which machines have not confirmed, while the attempt goes on.
const PATIENCE: Duration = Duration::from_secs(2);

/// What to do when a machine may not have been stopped.
pub(crate) const DO_NOW: &str = "press the emergency stop button or cut the motor supply NOW; or press Ctrl-C twice in the terminal whose `retrograde` moves the machine";

/// What became of a stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The machine has confirmed it.
    Stopped,
    /// It was sent, and the machine did not confirm it.
    NotConfirmed,
    /// It was not sent.
    NotDelivered,
}

impl Delivery {
    fn name(self) -> &'static str {
        match self {
            Self::Stopped => "stopped",
            Self::NotConfirmed => "not_confirmed",
            Self::NotDelivered => "not_delivered",
        }
    }
}

/// What became of the stop of one machine.
#[derive(Clone, Debug)]
pub struct Told {
    /// The machine, as the user would name it: `rig at /dev/ttyACM0`.
    pub machine: String,
    /// What became of the stop.
    pub delivery: Delivery,
    /// Why it is not known to stand; empty if it is.
    pub why: String,
}

impl Told {
    pub(crate) fn new(target: &Target, result: Result<String, Failure>) -> Self {
        let (delivery, why) = match &result {
            Ok(_) => (Delivery::Stopped, String::new()),
            Err(failure) => (delivery(failure), failure.to_string()),
        };
        let machine = match (&result, &target.address) {
            (Ok(place), _) => place.clone(),
            (Err(_), Some(address)) => format!("{} at {address}", target.name()),
            (Err(_), None) => target.name().to_owned(),
        };
        Self {
            machine,
            delivery,
            why,
        }
    }

    fn line(&self, urgent: Urgent) -> String {
        let machine = &self.machine;
        match (self.delivery, urgent) {
            (Delivery::Stopped, Urgent::Stop) => format!("{machine}: stopped"),
            (Delivery::Stopped, Urgent::EStop) => format!(
                "{machine}: emergency stop latched; acknowledge before anything moves again"
            ),
            (Delivery::NotConfirmed, _) => {
                format!("{machine}: sent, NOT CONFIRMED: {}", self.why)
            }
            (Delivery::NotDelivered, _) => format!("{machine}: NOT DELIVERED: {}", self.why),
        }
    }

    /// For `--json`.
    #[must_use]
    pub fn json(&self) -> Value {
        json!({
            "machine": self.machine,
            "outcome": self.delivery.name(),
            "why": self.why,
        })
    }
}

impl Target {
    fn name(&self) -> &'static str {
        self.kind.map_or("machine", identity::kind_name)
    }
}

/// What a failure leaves of a stop. A link that breaks may have carried it: that counts as not confirmed.
fn delivery(failure: &Failure) -> Delivery {
    match failure {
        Failure::Client(ClientError::StopUnconfirmed { .. } | ClientError::Link(_)) => {
            Delivery::NotConfirmed
        }
        _ => Delivery::NotDelivered,
    }
}

/// Which machines did not confirm, in one sentence.
#[must_use]
pub fn summary(told: &[Told]) -> String {
    let of = |delivery, text: &str| {
        let machines: Vec<_> = told
            .iter()
            .filter(|told| told.delivery == delivery)
            .map(|told| format!("{} ({})", told.machine, told.why))
            .collect();
        (!machines.is_empty()).then(|| format!("{text} {}", machines.join(", ")))
    };
    let parts = [
        of(Delivery::NotDelivered, "the stop was NOT DELIVERED to"),
        of(Delivery::NotConfirmed, "the stop was NOT CONFIRMED by"),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join("; ")
}

/// What a failure before a stop could be sent means for it.
pub(crate) fn undelivered(subcommand: &Subcommand, failure: Failure) -> Failure {
    if !matches!(subcommand, Subcommand::Stop(_) | Subcommand::Estop(_)) {
        return failure;
    }
    let told = Told {
        machine: "the machine of this name".to_owned(),
        delivery: Delivery::NotDelivered,
        why: failure.to_string(),
    };
    Failure::Stops { told: vec![told] }
}

/// The results in the order of the targets, each shown as soon as it is there.
fn tell(
    urgent: Urgent,
    targets: &[Target],
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Vec<Told> {
    let (results, arriving) = mpsc::channel();
    let begin = Instant::now();
    let mut told: Vec<Option<Told>> = targets.iter().map(|_| None).collect();
    thread::scope(|scope| {
        for (index, target) in targets.iter().enumerate() {
            let results = results.clone();
            scope.spawn(move || {
                let told = Told::new(target, finder.urgent(target, urgent));
                // The receiver lives as long as the scope.
                let _ = results.send((index, told));
            });
        }
        drop(results);
        let mut warned = false;
        loop {
            let left = match warned {
                false => PATIENCE.saturating_sub(begin.elapsed()),
                true => Duration::from_secs(3_600),
            };
            match arriving.recv_timeout(left) {
                Ok((index, result)) => {
                    screen.say(&result.line(urgent));
                    told[index] = Some(result);
                }
                Err(mpsc::RecvTimeoutError::Timeout) => {
                    warned = true;
                    for (target, told) in targets.iter().zip(&told) {
                        if told.is_none() {
                            screen.say(&format!("{target}: NOT YET CONFIRMED: {DO_NOW}"));
                        }
                    }
                }
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
            }
        }
    });
    told.into_iter().flatten().collect()
}

pub(crate) fn stop(
    urgent: Urgent,
    which: &Which,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let targets = finder.targets_to_stop(which);
    if targets.is_empty() {
        return Err(Failure::Stops {
            told: vec![Told {
                machine: "any machine".to_owned(),
                delivery: Delivery::NotDelivered,
                why: "no address was given, and there is no port with an ST-LINK".to_owned(),
            }],
        });
    }
    let told = tell(urgent, &targets, finder, screen);
    if told.iter().any(|told| told.delivery != Delivery::Stopped) {
        return Err(Failure::Stops { told });
    }
    let stopped: Vec<_> = told.iter().map(|told| told.machine.clone()).collect();
    let machines: Vec<_> = told.iter().map(Told::json).collect();
    Ok(json!({ "stopped": stopped, "machines": machines }))
}

/// As the user would name it.
impl std::fmt::Display for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.address {
            Some(address) => write!(f, "{} at {address}", self.name()),
            None => f.write_str(self.name()),
        }
    }
}

#[cfg(test)]
mod tests {
    use protocol::system::DeviceKind;

    use super::*;

    fn told(machine: &str, delivery: Delivery) -> Told {
        Told {
            machine: machine.to_owned(),
            delivery,
            why: "why".to_owned(),
        }
    }

    #[test]
    fn the_summary_names_each_machine_that_may_move_and_no_other() {
        let all = [
            told("rig at a", Delivery::NotDelivered),
            told("capsule at b", Delivery::Stopped),
            told("rig at c", Delivery::NotConfirmed),
        ];
        assert_eq!(
            summary(&all),
            "the stop was NOT DELIVERED to rig at a (why); the stop was NOT CONFIRMED by rig at c (why)"
        );
    }

    #[test]
    fn an_unknown_kind_is_called_a_machine() {
        let target = |kind| Target {
            kind,
            address: Some("COM3".parse().expect("an address")),
        };
        assert_eq!(target(None).to_string(), "machine at COM3");
        let rig = Some(DeviceKind::Rig);
        assert_eq!(target(rig).to_string(), "rig at COM3");
    }
}
