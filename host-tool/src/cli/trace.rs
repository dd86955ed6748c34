//! `capsule trace`, and the file of `--trace`: the capsule's own recording.

use lab::trials::recorded::write_recorded;
use std::fs::{self, OpenOptions};
use std::path::{Path, PathBuf};

use clap::Args;
use client::{Device, Recorded};
use lab::operations::arguments::DATA_FOLDER;
use lab::operations::failure::Failure;
use lab::operations::places::{Need, Places};
use lab::trials::force;
use lab::trials::trial::RecordError;
use protocol::capsule::{ActuationRecord, GetCapsuleTotals};
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

/// Arguments of `capsule trace`.
#[derive(Debug, Args)]
pub struct TraceArgs {
    /// Folder of the records.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
}

pub(crate) fn trace(
    args: &TraceArgs,
    places: &Places<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut capsule = places.connect(DeviceKind::Capsule, Need::Own("capsule trace"))?;
    let recorded = capsule.trace()?;
    if recorded.points.is_empty() {
        screen.say("The capsule has not moved since its start: there is no recording.");
        return Ok(json!({ "actuation": null, "readings": 0, "csv": null }));
    }
    let csv = write_recorded(
        &args.out,
        places.connector.now(),
        &recorded,
        capsule.origin(),
    )?;
    screen.say(&format!(
        "Actuation {}, its last {} ms.\n  {}",
        recorded.actuation,
        recorded.points.len(),
        csv.display()
    ));
    Ok(json!({
        "actuation": recorded.actuation,
        "readings": recorded.points.len(),
        "csv": csv.display().to_string(),
    }))
}

/// The file that `--trace` names, created before anything moves.
pub(crate) struct TraceFile {
    path: PathBuf,
    file: fs::File,
}

impl TraceFile {
    /// Creates the file; never overwrites one.
    pub(crate) fn create(path: &Path) -> Result<Self, Failure> {
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(|io| RecordError::write(folder, io))?;
        }
        let opened = OpenOptions::new().write(true).create_new(true).open(path);
        Ok(Self {
            path: path.to_owned(),
            file: opened.map_err(|io| {
                Failure::input(
                    format!("--trace {}: {io}; nothing moved", path.display()),
                    "name a new file in a folder that can be written",
                )
            })?,
        })
    }

    /// Removes the file, which has no whole recording.
    pub(crate) fn discard(self) {
        // Ignore an error: a leftover file does no harm, except that its name cannot be used again.
        let _ = fs::remove_file(&self.path);
    }

    /// Fetches the recording of the motion that has just ended. Returns its path and the number of readings. Removes
    /// the file if there is no recording, or if it cannot be written whole.
    pub(crate) fn fill(
        self,
        capsule: &mut Device,
        record: &ActuationRecord,
    ) -> Result<(PathBuf, usize), Failure> {
        let fetched = fetch(capsule, record);
        let (recorded, no_load_ma) = match fetched {
            Ok(fetched) => fetched,
            Err(failure) => {
                self.discard();
                return Err(failure);
            }
        };
        let written = force::write(&self.file, &recorded.points, no_load_ma, capsule.origin());
        if let Err(error) = written {
            let failure = RecordError::write(&self.path, error);
            self.discard();
            return Err(failure.into());
        }
        Ok((self.path, recorded.points.len()))
    }
}

/// Fetches the recording and the calibration's no-load current.
pub(crate) fn fetch(
    capsule: &mut Device,
    record: &ActuationRecord,
) -> Result<(Recorded, Option<u16>), Failure> {
    let calibration = capsule.call(GetCapsuleTotals)?.calibration;
    let recorded = capsule.trace()?;
    if recorded.actuation != record.actuation {
        return Err(Failure::refused(
            format!(
                "the recording is that of actuation {}, not of {}: the capsule has moved since",
                recorded.actuation, record.actuation
            ),
            "the record of the motion itself is kept; only its recording is lost",
        ));
    }
    Ok((
        recorded,
        calibration.map(|calibration| calibration.no_load_ma),
    ))
}
