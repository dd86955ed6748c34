//! The capsule's own recording of an actuation, as a file.

use std::fs;
use std::path::{Path, PathBuf};

use client::Recorded;
use client::identity::Origin;
use jiff::Timestamp;
use serde::Serialize;

use crate::trials::trial::{RecordError, create_new};

/// A row of a recording.
#[derive(Debug, Serialize)]
struct RecordedRow {
    time_ms: u32,
    thread_um: i32,
    current_ma: u16,
    battery_mv: u16,
    drive_mv: i16,
    origin: Origin,
}

/// Writes the recording of an actuation into a new CSV file of `folder`, and returns its path.
///
/// # Errors
/// It cannot be written.
pub fn write_recorded(
    folder: &Path,
    now: Timestamp,
    recorded: &Recorded,
    origin: Origin,
) -> Result<PathBuf, RecordError> {
    fs::create_dir_all(folder).map_err(|io| RecordError::write(folder, io))?;
    let stamp = now.strftime("%Y%m%dT%H%M%SZ");
    let name = format!("trace-{}-{stamp}", recorded.actuation);
    let (path, file) = create_new(folder, &name)?;
    let mut csv = csv::Writer::from_writer(file);
    for (time_ms, point) in (0..).zip(&recorded.points) {
        csv.serialize(RecordedRow {
            time_ms,
            thread_um: point.thread_um,
            current_ma: point.current_ma,
            battery_mv: point.battery_mv,
            drive_mv: point.drive_mv,
            origin,
        })
        .map_err(|error| RecordError::write(&path, error))?;
    }
    csv.flush().map_err(|io| RecordError::write(&path, io))?;
    Ok(path)
}
