//! Fetches a machine's own record of its last action: after the host has crashed, or after a run that the start button
//! began.
//!
//! It has no telemetry and no plan, because the machine keeps neither.

use std::io;
use std::path::{Path, PathBuf};

use client::Device;
use client::error::ClientError;
use client::identity::{IdentityRecord, Origin, kind_name};
use client::plain::create;
use client::subject::Subject;
use jiff::Timestamp;
use protocol::capsule::{ActuationOutcome, ActuationRecord};
use protocol::rig::RunOutcome;
use protocol::system::{DeviceKind, Event};
use serde::Serialize;

use crate::trials::trial::{Executed, RecordError, Status, json};

/// Version of the format; incremented when a field changes its meaning or its name.
pub const FORMAT: u32 = 2;

/// The record of an action, as the machine keeps it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kept {
    /// A run of the rig.
    Run {
        /// Its number since the start of the rig.
        number: u32,
        executed: Box<Executed>,
    },
    /// An actuation of the capsule.
    Actuation(ActuationRecord),
}

/// A machine's last action, as fetched.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fetched {
    /// [`FORMAT`].
    pub format: u32,
    pub kind: &'static str,
    pub origin: Origin,
    /// Time of the request, by the computer's clock.
    pub fetched_utc: Timestamp,
    /// The same instant by the machine's clock, us since its start. The events below use that clock.
    pub fetched_device_us: u64,
    pub device: IdentityRecord,
    /// Its image at the time of the request.
    pub image: String,
    /// Settings of a rig by name; those of a capsule are not read.
    pub settings: std::collections::BTreeMap<String, u32>,
    pub status: Status,
    pub record: Kept,
    /// Events since the start of the machine, the oldest of which may be lost.
    pub events: Vec<Event>,
    /// Number of events lost before these.
    pub lost_events: u32,
}

/// Why there is nothing to fetch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Nothing {
    /// No action since the machine's start.
    Yet,
    /// The action is in progress.
    Running,
}

/// Fetches a machine's last action. Changes nothing on the machine.
///
/// # Errors
/// As [`Device::call`].
pub fn fetch(device: &mut Device, now: Timestamp) -> Result<Result<Fetched, Nothing>, ClientError> {
    let subject = Subject::of(device)?;
    let place = device.place();
    let (device_us, status, record) = match subject.machine {
        DeviceKind::Rig => {
            let record = device.run_record()?;
            match record.outcome {
                RunOutcome::None => return Ok(Err(Nothing::Yet)),
                RunOutcome::Running => return Ok(Err(Nothing::Running)),
                _ => {}
            }
            let kept = Kept::Run {
                number: record.run,
                executed: Box::new(Executed::from(&record)),
            };
            (device.rig_status()?.time_us, record.outcome.into(), kept)
        }
        DeviceKind::Capsule => {
            let record = device.actuation_record()?;
            match record.outcome {
                ActuationOutcome::None => return Ok(Err(Nothing::Yet)),
                ActuationOutcome::Running => return Ok(Err(Nothing::Running)),
                _ => {}
            }
            let time_us = device.capsule_status()?.time_us;
            (time_us, record.outcome.into(), Kept::Actuation(record))
        }
    };
    let (events, lost_events) = device.kept_events()?;
    let identity = device.identity().copied();
    let Some(identity) = identity else {
        unreachable!("`Subject::of` has asked for it");
    };
    Ok(Ok(Fetched {
        format: FORMAT,
        kind: "fetched",
        origin: device.origin(),
        fetched_utc: now,
        fetched_device_us: device_us,
        device: IdentityRecord::new(&identity, &place),
        image: subject.image,
        settings: subject.settings,
        status,
        record,
        events,
        lost_events,
    }))
}

impl Fetched {
    /// Writes the record to a new file in `folder`, which is created if it is missing. Overwrites nothing.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<PathBuf, RecordError> {
        let failed = |io: io::Error| RecordError::write(folder, io);
        std::fs::create_dir_all(folder).map_err(failed)?;
        let bytes = json(self).map_err(failed)?;
        let stamp = self.fetched_utc.strftime("%Y%m%dT%H%M%SZ");
        let machine = match self.record {
            Kept::Run { .. } => kind_name(DeviceKind::Rig),
            Kept::Actuation(_) => kind_name(DeviceKind::Capsule),
        };
        for number in 1.. {
            let suffix = match number {
                1 => String::new(),
                number => format!("-{number}"),
            };
            let path = folder.join(format!("fetched-{machine}-{stamp}{suffix}.json"));
            match create(&path, &bytes) {
                Ok(()) => return Ok(path),
                Err(io) if io.kind() == io::ErrorKind::AlreadyExists => {}
                Err(io) => return Err(RecordError::write(&path, io)),
            }
        }
        unreachable!("some number is free")
    }
}
