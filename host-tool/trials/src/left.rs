//! Ends the record of a process that was killed while it recorded, from what it left and what the device still knows.

use std::path::Path;

use client::plain::replace;
use protocol::capsule::CapsuleEvent;
use protocol::rig::RigEvent;
use protocol::system::{Event, What};
use serde::Deserialize;

use crate::trial::{Action, Ending, RecordError, Trial, json, keep_whole_rows};

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
