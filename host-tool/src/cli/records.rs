//! `records fetch`: saves a machine's own record of its last action.

use std::path::PathBuf;

use clap::Args;
use client::decimal;
use client::identity::kind_name;
use lab::operations::arguments::{DATA_FOLDER, Which};
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::trials::fetched::{self, Fetched, Kept, Nothing};
use serde_json::{Map, Value, json};

use crate::cli::screen::Screen;

/// Subcommands of `records`.
#[derive(Debug, clap::Subcommand)]
pub enum RecordsSubcommand {
    /// Write a machine's own record of its last run or actuation to a file, for example after the computer crashed or
    /// somebody pressed the start button. It has no telemetry. Changes nothing.
    Fetch(FetchArgs),
}

/// Arguments of `records fetch`.
#[derive(Debug, Args)]
pub struct FetchArgs {
    /// The machines.
    #[command(flatten)]
    pub which: Which,
    /// Folder of the file.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
}

pub(crate) fn records(
    subcommand: &RecordsSubcommand,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let RecordsSubcommand::Fetch(FetchArgs { which, out }) = subcommand;
    let mut files = Map::new();
    for kind in finder.machines(which)? {
        let machine = kind_name(kind);
        let mut device = finder.connect(kind, LinkPurpose::Observe)?;
        match fetched::fetch(&mut device, finder.connector.now())? {
            Ok(fetched) => {
                let path = fetched.write(out)?;
                screen.say(&format!("{machine}: {}", text(&fetched)));
                screen.say(&format!("  {}", path.display()));
                files.insert(machine.to_owned(), json!(path.display().to_string()));
            }
            Err(Nothing::Yet) => screen.say(&format!(
                "{machine}: nothing to fetch, it has done nothing since it was switched on or reset"
            )),
            Err(Nothing::Running) => {
                return Err(Failure::refused(
                    format!("the {machine} is still at it, and its record is not complete"),
                    "`retrograde watch` shows when it ends; then try again",
                ));
            }
        }
    }
    Ok(Value::Object(files))
}

fn text(fetched: &Fetched) -> String {
    let status = fetched.status.name();
    match &fetched.record {
        Kept::Run { number, executed } => format!(
            "run {number}: {status}, {} strokes, {} steps at the pin of {} commanded, {} s",
            executed.strokes,
            executed.counted_edges,
            executed.commanded_edges,
            decimal::fixed((executed.ticks / 100_000).cast_signed(), 3)
        ),
        Kept::Actuation(record) => format!(
            "actuation {}, {:?}: {status}, {} s, thread at {} mm",
            record.actuation,
            record.kind,
            decimal::fixed(record.duration_ms.into(), 3),
            decimal::fixed(record.thread_um.into(), 3)
        ),
    }
}
