//! A recorded motion of the capsule: `fold`, `unfold`, and those of `capsule`.

use std::path::Path;

use client::{Device, decimal};
use lab::operations::arguments::RecordArgs;
use lab::operations::connector::LinkPurpose;
use lab::operations::ending::completed;
use lab::operations::failure::{FIND_THREAD, Failure};
use lab::operations::finder::Finder;
use lab::operations::reached::reached;
use lab::trials::experiment::{self, Actuation};
use lab::trials::trial::Status;
use protocol::capsule::{ActuationKind, CapsuleState, GetCapsuleTotals};
use protocol::system::DeviceKind;
use report::html::section::actuation_rows;
use serde_json::{Value, json};

use crate::cli::fresh;
use crate::cli::screen::Screen;
use crate::cli::trace::TraceFile;

pub(crate) fn actuate(
    command: &'static str,
    motion: impl Into<Actuation>,
    args: &RecordArgs,
    trace: Option<&Path>,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let motion = motion.into();
    let kind = motion.kind;
    let (what, after) = words(kind);
    let mut capsule = finder.connect(DeviceKind::Capsule, LinkPurpose::Own(command))?;
    if matches!(
        kind,
        ActuationKind::Fold | ActuationKind::Unfold | ActuationKind::FoldTo
    ) {
        fresh::prepare(DeviceKind::Capsule, &mut capsule, finder, screen)?;
    }
    if let Some((status, name)) = reached(kind, &mut capsule)? {
        screen.say(&format!(
            "The capsule is {name} already; nothing moved and nothing was recorded."
        ));
        return Ok(json!({ "already": true, "status": status }));
    }
    screen.say(what);
    warn(kind, &mut capsule, screen)?;
    let now = finder.connector.now();
    let recording = args.recording(&args.out, experiment::stem(kind), now);
    let trace = trace.map(TraceFile::create).transpose()?;
    let trial = match experiment::actuate(&mut capsule, motion, &recording, &mut screen.live()) {
        Ok(trial) => trial,
        Err(error) => {
            if let Some(trace) = trace {
                trace.discard();
            }
            return Err(error.into());
        }
    };
    if trial.trial.status == Status::Complete {
        screen.say(&format!("  complete: {after}"));
    }
    for (name, value) in actuation_rows(kind, &trial.record) {
        screen.say(&format!("  {name}: {value}"));
    }
    screen.say(&format!(
        "  {}\n  {}",
        trial.csv.display(),
        trial.sidecar.display()
    ));
    let help = format!(
        "the data is in {}; `retrograde info` shows the capsule's state",
        trial.sidecar.display()
    );
    // Fetch the recording even after a fault, when it is most useful. If that fails, still report the fault.
    let traced = trace.map(|trace| trace.fill(&mut capsule, &trial.record));
    if let Some(Ok((path, readings))) = &traced {
        screen.say(&format!("  {}: {readings} ms", path.display()));
    }
    completed(experiment::doing(kind), &trial.trial, help)?;
    let traced = traced.transpose()?;
    let mut value = trial.json();
    value["trace"] = json!(traced.map(|(path, _)| path.display().to_string()));
    Ok(value)
}

/// Refuses unless the capsule is referenced, and folded or unfolded as `what` begins.
pub(crate) fn require(
    begins: CapsuleState,
    what: &str,
    capsule: &mut Device,
) -> Result<(), Failure> {
    let status = capsule.capsule_status()?;
    if status.state == begins && status.referenced {
        return Ok(());
    }
    Err(Failure::refused(
        format!(
            "the capsule has to be {begins:?} and referenced before {what}; it is {:?}, and nothing was begun",
            status.state
        ),
        match (status.state, begins) {
            (CapsuleState::Faulted, _) => "`retrograde info capsule` names the fault",
            _ if !status.referenced => FIND_THREAD,
            (_, CapsuleState::Folded) => "`retrograde fold`, then try again",
            _ => "`retrograde unfold`, then try again",
        },
    ))
}

/// Warns of the assumptions of a reference run or a calibration.
fn warn(kind: ActuationKind, capsule: &mut Device, screen: &mut Screen<'_>) -> Result<(), Failure> {
    match kind {
        ActuationKind::Reference if capsule.call(GetCapsuleTotals)?.calibration.is_none() => {
            screen.hint("there is no calibration, so this motion calibrates: is the origami unfolded, the thread slack?");
        }
        ActuationKind::Calibrate => {
            let remaining_um = capsule.capsule_status()?.remaining_um;
            if remaining_um > 0 {
                screen.hint(&format!(
                    "NOTE: {} mm of thread are left on the spool: unless the origami was unfolded by hand since then, they \
                     become permanent",
                    decimal::write(remaining_um.into(), 3)
                ));
            }
        }
        _ => {}
    }
    Ok(())
}

/// What a motion does, and the capsule after it is complete.
const fn words(kind: ActuationKind) -> (&'static str, &'static str) {
    match kind {
        ActuationKind::Reference => (
            "Reference: wind until the thread pulls as at the folded end, then pay out what is counted.",
            "it is unfolded",
        ),
        ActuationKind::Calibrate => (
            "Calibrate: what is now is unfolded. Wind slowly to the end force, feel the thread, fold once, pay out again.",
            "it is unfolded",
        ),
        ActuationKind::CheckFolded => (
            "Check: feel whether the thread pulls, and stay folded.",
            "it is folded, and the thread pulls",
        ),
        ActuationKind::Fold => (
            "Fold: wind the thread to the folded end by count, then feel whether it pulls.",
            "it is folded",
        ),
        ActuationKind::Unfold => ("Unfold: pay the thread out to its zero.", "it is unfolded"),
        ActuationKind::FoldTo => (
            "Partial fold: wind or pay out to a length of thread, and stay there.",
            "it is already at this length of thread",
        ),
    }
}
