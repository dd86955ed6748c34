//! Place of a motion's record, and the failure of a motion that did not end as planned.

use operations::arguments::RecordArgs;
use operations::failure::Failure;
use operations::places::Places;
use trials::trial::{Recording, Status};

pub(crate) fn recording(args: &RecordArgs, stem: &str, places: &Places<'_>) -> Recording {
    Recording {
        folder: args.out.clone(),
        stem: stem.to_owned(),
        now: places.connector.now(),
        note: args.note.clone(),
        telemetry_ms: args.telemetry_ms,
    }
}

pub(crate) fn completed(
    action: &'static str,
    status: Status,
    reason: Option<&String>,
    help: String,
) -> Result<(), Failure> {
    if status == Status::Complete {
        return Ok(());
    }
    Err(Failure::Ended {
        action,
        status,
        reason: reason.cloned(),
        help,
    })
}
