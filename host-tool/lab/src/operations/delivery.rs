//! Results of a stop, machine by machine.

use protocol::system::Urgent;
use serde::Serialize;
use serde_json::{Value, json};

/// The advice when a machine may still be moving.
pub const DO_NOW: &str = "press the emergency stop button or cut the motor supply NOW; or press Ctrl-C twice in the terminal whose `retrograde` moves the machine";

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Delivery {
    Stopped,
    /// It was sent, but the machine did not confirm it.
    NotConfirmed,
    NotDelivered,
}

#[derive(Clone, Debug)]
pub struct StopReport {
    /// The machine in the user's words: `rig at /dev/ttyACM0`.
    pub machine: String,
    pub delivery: Delivery,
    /// Why the machine is not known to have stopped; empty if it has.
    pub why: String,
}

impl StopReport {
    pub fn line(&self, urgent: Urgent) -> String {
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

    pub fn json(&self) -> Value {
        json!({
            "machine": self.machine,
            "outcome": self.delivery,
            "why": self.why,
        })
    }
}

/// Names the machines that did not confirm, in one sentence.
pub fn summary(reports: &[StopReport]) -> String {
    let of = |delivery, text: &str| {
        let machines: Vec<_> = reports
            .iter()
            .filter(|report| report.delivery == delivery)
            .map(|report| format!("{} ({})", report.machine, report.why))
            .collect();
        (!machines.is_empty()).then(|| format!("{text} {}", machines.join(", ")))
    };
    let parts = [
        of(Delivery::NotDelivered, "the stop was NOT DELIVERED to"),
        of(Delivery::NotConfirmed, "the stop was NOT CONFIRMED by"),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(machine: &str, delivery: Delivery) -> StopReport {
        StopReport {
            machine: machine.to_owned(),
            delivery,
            why: "why".to_owned(),
        }
    }

    #[test]
    fn the_summary_names_each_machine_that_may_move_and_no_other() {
        let all = [
            report("rig at a", Delivery::NotDelivered),
            report("capsule at b", Delivery::Stopped),
            report("rig at c", Delivery::NotConfirmed),
        ];
        assert_eq!(
            summary(&all),
            "the stop was NOT DELIVERED to rig at a (why); the stop was NOT CONFIRMED by rig at c (why)"
        );
    }
}
