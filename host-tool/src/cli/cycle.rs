//! `capsule cycle`: endurance, fold and unfold N times.

use std::path::PathBuf;

use clap::Args;
use client::{Unobserved, decimal};
use lab::operations::arguments::DATA_FOLDER;
use lab::operations::failure::Failure;
use lab::operations::places::{Need, Places};
use lab::trials::endurance::{Drift, Endurance, Run};
use lab::trials::trial::Status;
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::fresh;
use crate::cli::screen::Screen;
use crate::cli::study::begin_unfolded;

/// Arguments of `capsule cycle`.
#[derive(Debug, Args)]
pub struct CycleArgs {
    /// Pairs of a fold and an unfolding, 1 to 100000.
    #[arg(value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub pairs: u32,
    /// Folder of the two files.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
}

pub(crate) fn cycle(
    args: &CycleArgs,
    places: &Places<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut capsule = places.connect(DeviceKind::Capsule, Need::Own("capsule cycle"))?;
    fresh::prepare(DeviceKind::Capsule, &mut capsule, places, screen)?;
    begin_unfolded("an endurance run", &mut capsule)?;
    let mut run = Run::create(
        &args.out,
        places.connector.now(),
        args.pairs,
        capsule.origin(),
    )?;
    let (csv, summary) = (run.csv.clone(), run.summary.clone());
    screen.say(&format!(
        "{} folds and unfoldings. Ctrl-C ends them with a controlled stop.\n  {}\n  {}",
        args.pairs,
        csv.display(),
        summary.display()
    ));
    let result = run.carry_out(
        &mut capsule,
        &mut Unobserved,
        &mut |pair| {
            // Print a line for each of the first ten pairs, then for every tenth.
            if pair.pair <= 10 || pair.pair.is_multiple_of(10) || pair.pair == args.pairs {
                screen.say(&format!(
                    "  {} of {}: folded at {} mm in {} s with {} mJ, unfolded at {} mm in {} s with {} mJ",
                    pair.pair,
                    args.pairs,
                    decimal::fixed(pair.folded_um.into(), 3),
                    decimal::fixed(pair.fold_ms.into(), 3),
                    pair.fold_mj,
                    decimal::fixed(pair.unfolded_um.into(), 3),
                    decimal::fixed(pair.unfold_ms.into(), 3),
                    pair.unfold_mj,
                ));
            }
        },
    );
    let endurance = run.endurance;
    for line in text(&endurance) {
        screen.say(&line);
    }
    result?;
    let help = format!(
        "{} of {} pairs were done, they are in {}; `retrograde info` shows the capsule's state",
        endurance.done,
        endurance.asked,
        csv.display()
    );
    if endurance.status != Status::Complete {
        return Err(Failure::Ended {
            action: "the endurance run",
            status: endurance.status,
            reason: endurance.error,
            help,
        });
    }
    Ok(json!({
        "endurance": endurance,
        "csv": csv.display().to_string(),
        "summary": summary.display().to_string(),
    }))
}

/// The summary in lines.
fn text(endurance: &Endurance) -> Vec<String> {
    let mut lines = vec![format!("{} of {} pairs.", endurance.done, endurance.asked)];
    let drift = &endurance.drift;
    for (name, unit, drift) in [
        ("folded end", "um", drift.folded_um),
        ("unfolded end", "um", drift.unfolded_um),
        ("no-load current", "mA", drift.no_load_ma),
        ("energy of a pair", "mJ", drift.pair_mj),
        ("time of a fold", "ms", drift.fold_ms),
        ("time of an unfolding", "ms", drift.unfold_ms),
    ] {
        if let Some(drift) = drift {
            lines.push(format!("  {name}: {}", drift_text(&drift, unit)));
        }
    }
    lines
}

fn drift_text(drift: &Drift, unit: &str) -> String {
    let Drift {
        first,
        last,
        least,
        most,
        per_100_pairs,
    } = drift;
    let slope = per_100_pairs.map_or_else(String::new, |slope| {
        format!(", {slope:+.2} {unit} per 100 pairs")
    });
    format!("first {first} {unit}, last {last} {unit}, {least} to {most} {unit}{slope}")
}
