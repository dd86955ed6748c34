//! Warnings before a run, about the commissioning of its board.

use std::path::PathBuf;

use client::Device;
use client::error::ClientError;
use client::identity::Origin;
use client::subject::Subject;

use crate::commissioning::procedure::{self, StepStatus};
use crate::commissioning::record::Commissioning;
use crate::commissioning::step;

/// Why a rig should not be trusted with a run yet; none if its record in one of `folders` is complete and still counts.
pub fn of_record(rig: &mut Device, folders: &[PathBuf]) -> Result<Option<String>, ClientError> {
    let Some(identity) = rig.identity().copied() else {
        return Ok(None);
    };
    let name = Subject::of_identity(&identity).file_name();
    let paths = folders.iter().map(|folder| folder.join(&name));
    let found = paths.filter_map(|path| Commissioning::read(&path).transpose());
    let record = match found.into_iter().next() {
        // The bench's machines are not boards.
        None if rig.origin() == Origin::Virtual => return Ok(None),
        None => {
            return Ok(Some(
                "this board has no commissioning record: `retrograde commission rig` makes one"
                    .to_owned(),
            ));
        }
        Some(Err(error)) => {
            return Ok(Some(format!(
                "the commissioning record cannot be read: {error}"
            )));
        }
        Some(Ok(record)) => record,
    };
    let subject = Subject::of(rig)?;
    let open = procedure::open(step::steps(subject.machine), &record, &subject);
    let Some((step, status)) = open.first() else {
        return Ok(None);
    };
    let why = match status {
        StepStatus::OtherImage => format!(
            "the commissioning record is of image {}, this is {}",
            record
                .result(step.name)
                .and_then(|result| result.image.as_deref())
                .unwrap_or("?"),
            subject.image
        ),
        StepStatus::OtherSetting(name) => {
            format!("the commissioning record is older than the present {name}")
        }
        StepStatus::NotPassed | StepStatus::Holds => {
            format!("commissioning is not complete: {} is open", step.name)
        }
    };
    Ok(Some(format!(
        "{why}: `retrograde commission rig` shows what is left"
    )))
}
