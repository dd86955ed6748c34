//! The capsule's own commands.

use lab::operations::arguments::RecordArgs;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use protocol::capsule::ActuationKind;
use serde_json::Value;

use crate::cli::actuation::actuate;
use crate::cli::cycle::{CycleArgs, cycle};
use crate::cli::screen::Screen;
use crate::cli::trace::{TraceArgs, trace};

#[derive(Debug, clap::Subcommand)]
pub enum CapsuleSubcommand {
    /// Find the folded end when the count is uncertain, and unfold; recorded. Without a calibration it calibrates:
    /// begin unfolded.
    Reference(RecordArgs),
    /// "This is unfolded": measure the distance to the end force, and store it in the capsule's flash. Once per
    /// capsule.
    Calibrate(RecordArgs),
    /// Check whether the thread pulls, and stay folded: pays out 0.85 mm and winds it again. If not folded, it folds.
    Check(RecordArgs),
    /// Fetch the recording of the last actuation, one reading per millisecond, also after a fault: a CSV file.
    Trace(TraceArgs),
    /// Fold and unfold N times, each motion recorded, each cycle a row of a CSV file. The first fault ends it; Ctrl-C
    /// ends it with a controlled stop.
    Cycle(CycleArgs),
}

pub(crate) fn capsule(
    subcommand: &CapsuleSubcommand,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let (command, kind, args) = match subcommand {
        CapsuleSubcommand::Trace(args) => return trace(args, finder, screen),
        CapsuleSubcommand::Cycle(args) => return cycle(args, finder, screen),
        CapsuleSubcommand::Reference(args) => ("capsule reference", ActuationKind::Reference, args),
        CapsuleSubcommand::Calibrate(args) => ("capsule calibrate", ActuationKind::Calibrate, args),
        CapsuleSubcommand::Check(args) => ("capsule check", ActuationKind::CheckFolded, args),
    };
    actuate(command, kind, args, None, finder, screen)
}
