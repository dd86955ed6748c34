//! `capsule cycle`: folds and unfolds N times, each motion recorded, each cycle a row of a CSV file.

use std::fs::File;

use clap::Args;
use client::identity::Origin;
use client::{Device, decimal};
use lab::operations::arguments::RecordArgs;
use lab::operations::connector::LinkPurpose;
use lab::operations::ending::completed;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::trials::experiment::{self, ActuationTrial};
use lab::trials::trial::{RecordError, create_new};
use protocol::capsule::{ActuationKind, CapsuleState};
use protocol::system::DeviceKind;
use serde::Serialize;
use serde_json::{Value, json};

use crate::cli::actuation::require;
use crate::cli::fresh;
use crate::cli::screen::Screen;

/// Arguments of `capsule cycle`.
#[derive(Debug, Args)]
pub struct CycleArgs {
    /// Cycles of a fold and an unfolding, 1 to 100000.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub count: u32,
    /// The records.
    #[command(flatten)]
    pub record: RecordArgs,
}

/// A fold and the unfolding after it. Lengths are thread from zero, as the capsule counts it.
#[derive(Debug, Serialize)]
struct Cycle {
    cycle: u32,
    fold_ms: u32,
    folded_um: i32,
    /// Thread at which the load first rose; 0: never.
    engaged_um: i32,
    fold_end_ma: u16,
    fold_mj: u32,
    unfold_ms: u32,
    unfolded_um: i32,
    unfold_mj: u32,
    min_battery_mv: u16,
    origin: Origin,
}

impl Cycle {
    fn of(cycle: u32, fold: &ActuationTrial, unfold: &ActuationTrial) -> Self {
        let origin = fold.trial.device.origin;
        let (fold, unfold) = (&fold.record, &unfold.record);
        Self {
            cycle,
            fold_ms: fold.duration_ms,
            folded_um: fold.thread_um,
            engaged_um: fold.engaged_um,
            fold_end_ma: fold.end_current_ma,
            fold_mj: fold.energy_mj,
            unfold_ms: unfold.duration_ms,
            unfolded_um: unfold.thread_um,
            unfold_mj: unfold.energy_mj,
            min_battery_mv: fold.min_battery_mv.min(unfold.min_battery_mv),
            origin,
        }
    }
}

pub(crate) fn cycle(
    args: &CycleArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut capsule = finder.connect(DeviceKind::Capsule, LinkPurpose::Own("capsule cycle"))?;
    fresh::prepare(DeviceKind::Capsule, &mut capsule, finder, screen)?;
    require(CapsuleState::Unfolded, "a cycle", &mut capsule)?;
    let folder = &args.record.out;
    let now = finder.connector.now();
    let (path, file) = create_new(folder, &format!("cycle-{}", now.strftime("%Y%m%dT%H%M%SZ")))?;
    let mut rows = csv::Writer::from_writer(file);
    screen.say(&format!(
        "{} folds and unfoldings. Ctrl-C ends them with a controlled stop.\n  {}",
        args.count,
        path.display()
    ));
    for number in 1..=args.count {
        let mut motion = |kind, capsule: &mut Device| {
            let stem = experiment::stem(kind);
            let recording = args.record.recording(folder, stem, finder.connector.now());
            let trial = experiment::actuate(capsule, kind, &recording, &mut screen.live())?;
            let help = format!(
                "{} of {} cycles were done, they are in {}; `retrograde info` shows the capsule's state",
                number - 1,
                args.count,
                path.display()
            );
            completed(experiment::doing(kind), &trial.trial, help)?;
            Ok::<_, Failure>(trial)
        };
        let fold = motion(ActuationKind::Fold, &mut capsule)?;
        let unfold = motion(ActuationKind::Unfold, &mut capsule)?;
        let row = Cycle::of(number, &fold, &unfold);
        write(&mut rows, &row).map_err(|error| RecordError::rows(&path, error))?;
        screen.say(&text(&row, args.count));
    }
    Ok(json!({ "cycles": args.count, "csv": path.display().to_string() }))
}

/// Writes a row to the disk, so that a power cut loses no finished cycle.
fn write(rows: &mut csv::Writer<File>, row: &Cycle) -> Result<(), csv::Error> {
    rows.serialize(row)?;
    rows.flush()?;
    Ok(rows.get_ref().sync_data()?)
}

fn text(row: &Cycle, count: u32) -> String {
    format!(
        "  {} of {count}: folded at {} mm in {} s with {} mJ, unfolded at {} mm in {} s with {} mJ",
        row.cycle,
        decimal::fixed(row.folded_um.into(), 3),
        decimal::fixed(row.fold_ms.into(), 3),
        row.fold_mj,
        decimal::fixed(row.unfolded_um.into(), 3),
        decimal::fixed(row.unfold_ms.into(), 3),
        row.unfold_mj,
    )
}
