//! Ends the record of a process that was killed while it recorded, from what it left and what the device still knows.

use std::path::Path;

use client::plain::replace;
use protocol::capsule::CapsuleEvent;
use protocol::rig::RigEvent;
use protocol::system::{Event, What};
use serde::Deserialize;

use crate::trials::trial::{Action, Ending, RecordError, Trial, json, keep_whole_rows};

/// The part of a row that both machines have.
#[derive(Deserialize)]
struct Missed {
    missed: u16,
}

impl Trial {
    /// Ends the record. Counts the rows that the process left, except for an incomplete last one. The process wrote no
    /// events, so `kept` has those that the device still has since its start, and the number of dropped ones.
    ///
    /// # Errors
    /// The sidecar cannot be written.
    pub fn end_left(
        &mut self,
        sidecar: &Path,
        ending: Ending,
        kept: (Vec<Event>, u32),
    ) -> Result<(), RecordError> {
        let csv_path = sidecar.with_file_name(&self.telemetry);
        let whole = keep_whole_rows(&csv_path).map_err(|io| RecordError::write(&csv_path, io));
        let rows: Result<Vec<Missed>, _> = whole.and_then(|_| self.samples(sidecar));
        let unread = match rows {
            Ok(rows) => {
                self.samples = rows.len() as u64;
                self.missed_samples = rows.iter().map(|row| u64::from(row.missed)).sum();
                None
            }
            // The device's own record is still true.
            Err(error) => Some(format!("the telemetry cannot be read: {error}")),
        };
        let (mut events, mut lost_events) = kept;
        if let Some(start) = events
            .iter()
            .position(|event| self.is_begun_by(&event.what))
        {
            events.drain(..start);
            lost_events = 0;
        }
        (self.events, self.lost_events) = (events, lost_events);
        self.end(ending);
        self.error = self.error.take().or(unread);
        json(&self)
            .and_then(|bytes| replace(sidecar, &bytes))
            .map_err(|io| RecordError::write(sidecar, io))
    }

    /// Whether this event tells the beginning of the action.
    fn is_begun_by(&self, what: &What) -> bool {
        match (&self.action, what) {
            (
                Action::Run {
                    achieved: Some(achieved),
                    ..
                },
                What::Rig(RigEvent::RunStarted { run, .. }),
            ) => *run == achieved.run,
            (
                Action::Actuation {
                    accepted: Some(accepted),
                    ..
                },
                What::Capsule(CapsuleEvent::Started { actuation, .. }),
            ) => *actuation == accepted.actuation,
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trials::trial::tests::{device, fold_in};
    use protocol::capsule::{ActuationAccepted, ActuationKind};

    #[test]
    fn what_was_left_is_counted_from_the_start_of_the_action() {
        let folder = tempfile::tempdir().expect("a folder");
        let started = |index: u32, actuation| Event {
            index,
            time_us: index.into(),
            what: What::Capsule(CapsuleEvent::Started {
                actuation,
                kind: ActuationKind::Fold,
            }),
        };
        let events = vec![started(7, 2), started(8, 3), started(9, 4)];
        for (actuation, first, lost) in [(3, 8, 0), (5, 7, 4)] {
            let rows = "time_us,missed\n20000,0\n80000,2\n160000,3\n180000,";
            std::fs::write(folder.path().join("fold.csv"), rows).expect("written");
            let action = Action::Actuation {
                actuation: ActuationKind::Fold,
                accepted: Some(ActuationAccepted {
                    actuation,
                    timeout_ms: 6_000,
                }),
                record: None,
            };
            let mut trial = Trial::new(action, device(), &fold_in(folder.path()));
            trial.telemetry = "fold.csv".to_owned();
            let ending = Ending::Lost("gone".to_owned());
            trial
                .end_left(
                    &folder.path().join("fold.json"),
                    ending,
                    (events.clone(), 4),
                )
                .expect("written");
            assert_eq!((trial.samples, trial.missed_samples), (3, 5));
            assert_eq!((trial.events[0].index, trial.lost_events), (first, lost));
        }
    }
}
