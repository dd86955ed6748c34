//! The record of a commissioning: one JSON file per board. It is replaced as a whole after each step, so that a session
//! can end at any instant.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use crate::trials::trial::{RecordError, json};
use client::identity::{Origin, kind_name, tool};
use client::named;
use client::plain::{self, replace};
use client::subject::Subject;
use client::{limited, wording};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Version of the format; incremented when a field changes its meaning.
pub const FORMAT: u32 = 1;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StepOutcome {
    Passed,
    Failed,
    NotShown,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StepResult {
    pub step: String,
    /// What a pass proves, in words.
    pub shows: String,
    #[serde(rename = "result")]
    pub outcome: StepOutcome,
    /// The defect, or why nothing was shown; none if it passed.
    pub reason: Option<String>,
    /// The measured numbers, with the unit in their names.
    pub measured: Map<String, Value>,
    pub date_utc: Timestamp,
    /// The tested image; none if the result does not depend on the image.
    pub image: Option<String>,
    pub settings: BTreeMap<String, u32>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Commissioning {
    pub format: u32,
    pub machine: String,
    /// Unique number of the board, 24 hex digits.
    pub board_uid: String,
    #[serde(default)]
    pub origin: Origin,
    /// Name and version of the host tool that last wrote the record.
    pub tool: String,
    /// The image at the last session, as in [`Subject::image`].
    pub image: String,
    pub firmware: String,
    pub protocol: String,
    /// All settings at the last session.
    pub settings: BTreeMap<String, u32>,
    pub begun_utc: Timestamp,
    pub changed_utc: Timestamp,
    /// Whether all steps have passed with this image and these settings.
    pub complete: bool,
    pub steps: Vec<StepResult>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    pub outcome: StepOutcome,
    /// The defect, or why nothing was shown.
    pub reason: Option<String>,
    pub measured: Map<String, Value>,
}

impl Commissioning {
    /// The record of a new board.
    pub fn new(subject: &Subject, now: Timestamp) -> Self {
        Self {
            format: FORMAT,
            machine: kind_name(subject.machine).to_owned(),
            board_uid: subject.uid.clone(),
            origin: subject.origin,
            tool: tool(),
            image: subject.image.clone(),
            firmware: subject.firmware.clone(),
            protocol: subject.protocol.clone(),
            settings: subject.settings.clone(),
            begun_utc: now,
            changed_utc: now,
            complete: false,
            steps: vec![],
        }
    }

    pub fn read(path: &Path) -> Result<Option<Self>, RecordError> {
        let error = |why: String| {
            let remedy = "give the file that `retrograde commission` wrote for this board, or another name: `--record FILE`";
            RecordError::new(path, why, remedy)
        };
        let text = match plain::read_text(path, limited::RECORD) {
            Ok(text) => text,
            Err(io) if io.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(io) => return Err(error(io.to_string())),
        };
        let record: Self =
            serde_json::from_str(&text).map_err(|json| error(wording::unreadable(&json)))?;
        if record.format != FORMAT {
            return Err(error(format!(
                "format {}, this tool reads {FORMAT}",
                record.format
            )));
        }
        Ok(Some(record))
    }

    pub fn resume(path: &Path, subject: &Subject, now: Timestamp) -> Result<Self, RecordError> {
        let Some(record) = Self::read(path)? else {
            return Ok(Self::new(subject, now));
        };
        if record.board_uid != subject.uid || record.machine != kind_name(subject.machine) {
            let why = format!(
                "this is the record of the {} with board {}, not of the {} with board {}",
                record.machine,
                record.board_uid,
                kind_name(subject.machine),
                subject.uid
            );
            let remedy = "each board has its own record: omit `--record`, or name another file";
            return Err(RecordError::new(path, why, remedy));
        }
        Ok(record)
    }

    pub fn result(&self, step: &str) -> Option<&StepResult> {
        self.steps.iter().find(|result| result.step == step)
    }

    /// Replaces the file by renaming: a reader finds the old record or the new one, never a part of it.
    pub fn write(&self, path: &Path) -> Result<(), RecordError> {
        let folder = path.parent().filter(|folder| *folder != Path::new(""));
        folder
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| json(self))
            .and_then(|bytes| replace(path, &bytes))
            .map_err(|io| {
                let other = ", or choose another file: `--record FILE`";
                RecordError::new(path, &io, format!("{}{other}", named::remedy(&io)))
            })
    }
}
