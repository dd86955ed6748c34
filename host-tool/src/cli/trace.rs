//! `capsule trace`, and the file of `--trace`: the capsule's own recording.

use std::fs::{self, OpenOptions};
use std::path::{Path, PathBuf};

use clap::Args;
use client::named;
use client::{Device, Recorded};
use lab::operations::arguments::DATA_FOLDER;
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::trials::force;
use lab::trials::trial::{RecordError, create_new};
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
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut capsule = finder.connect(DeviceKind::Capsule, LinkPurpose::Own("capsule trace"))?;
    let (recorded, no_load_ma) = fetch(&mut capsule)?;
    if recorded.points.is_empty() {
        screen.say("The capsule has not moved since its start: there is no recording.");
        return Ok(json!({ "actuation": null, "readings": 0, "csv": null }));
    }
    let stamp = finder.connector.now().strftime("%Y%m%dT%H%M%SZ");
    let (csv, file) = create_new(&args.out, &format!("trace-{}-{stamp}", recorded.actuation))?;
    force::write(file, &recorded.points, no_load_ma, capsule.origin())
        .map_err(|error| RecordError::rows(&csv, error))?;
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
                    format!("{}, or name a new file", named::remedy(&io)),
                )
            })?,
        })
    }

    /// Removes the file, because its recording is incomplete.
    pub(crate) fn discard(self) {
        // Ignore an error: a leftover file does no harm, except that its name cannot be used again.
        let _ = fs::remove_file(&self.path);
    }

    /// Fetches the recording of the motion that has just ended. Returns its path and the number of readings. Removes
    /// the file if there is no recording, or if it cannot be written completely.
    pub(crate) fn fill(
        self,
        capsule: &mut Device,
        record: &ActuationRecord,
    ) -> Result<(PathBuf, usize), Failure> {
        let path = self.path.clone();
        let filled = self.written(capsule, record);
        if filled.is_err() {
            self.discard();
        }
        Ok((path, filled?))
    }

    fn written(&self, capsule: &mut Device, record: &ActuationRecord) -> Result<usize, Failure> {
        let (recorded, no_load_ma) = fetch(capsule)?;
        if recorded.actuation != record.actuation {
            return Err(Failure::refused(
                format!(
                    "the recording is that of actuation {}, not of {}: the capsule has moved since",
                    recorded.actuation, record.actuation
                ),
                "the record of the motion itself is kept; only its recording is lost",
            ));
        }
        force::write(&self.file, &recorded.points, no_load_ma, capsule.origin())
            .map_err(|error| RecordError::rows(&self.path, error))?;
        Ok(recorded.points.len())
    }
}

/// Fetches the recording and the calibration's no-load current.
fn fetch(capsule: &mut Device) -> Result<(Recorded, Option<u16>), Failure> {
    let calibration = capsule.call(GetCapsuleTotals)?.calibration;
    let no_load_ma = calibration.map(|calibration| calibration.no_load_ma);
    Ok((capsule.trace()?, no_load_ma))
}
