//! `commission`: the steps from a new board to a machine that may run.

mod terminal;

use std::path::PathBuf;

use clap::Args;
use client::Device;
use client::error::ClientError;
use client::identity::kind_name;
use client::subject::Subject;
use lab::commissioning::operator::{NoOperator, Operator, RemoteFixture};
use lab::commissioning::record::Commissioning;
use lab::commissioning::session::{self, Broken, Ending};
use lab::commissioning::work::{Options, Work};
use lab::commissioning::{procedure, step};
use lab::operations::arguments::{DATA_FOLDER, MachineKind};
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::{FAULT, Failure, REFUSED, STOPPED};
use lab::operations::finder::Finder;
use lab::operations::interrupt;
use protocol::system::{DeviceKind, Urgent};
use serde_json::{Value, json};
use terminal::Terminal;

use crate::cli::screen::Screen;

/// Arguments of `commission`.
#[derive(Debug, Args)]
pub struct CommissionArgs {
    /// The machine.
    pub machine: MachineKind,
    /// Ask nobody. What needs an operator is recorded as not shown, unless the virtual bench has a fixture.
    #[arg(long)]
    pub yes: bool,
    /// Where the virtual bench's fixture listens, as `virtual-bench serve` prints.
    #[arg(long, value_name = "HOST:PORT", requires = "yes")]
    pub fixture: Option<String>,
    /// Folder of the record.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
    /// File of the record, instead of one named after the board in the folder.
    #[arg(long, value_name = "FILE", conflicts_with = "out")]
    pub record: Option<PathBuf>,
    /// The image (ELF) that should be on the rig; by default the one built in this workspace.
    #[arg(long, value_name = "ELF")]
    pub image: Option<PathBuf>,
    /// Strokes of the read-back test without motor power: an even number, 2 to 20000. The test of edge timing makes as
    /// many, 200 at most.
    #[arg(long, value_name = "N", default_value = "10000", value_parser = strokes)]
    pub strokes: u16,
    /// Cycles of the run at the end.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=100))]
    pub cycles: u16,
    /// Duration of the comparison of the board's clock with the host's, in s.
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..=3600))]
    pub clock_s: u16,
}

/// Parses an even number: only whole cycles count, and no number is changed silently.
fn strokes(text: &str) -> Result<u16, String> {
    let value = text.parse::<u16>().ok();
    value
        .filter(|strokes| (2..=20_000).contains(strokes) && strokes.is_multiple_of(2))
        .ok_or_else(|| "use an even number from 2 to 20000, for a cycle is two strokes".to_owned())
}

pub(crate) fn commission(
    args: &CommissionArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let kind = args.machine.into();
    let mut operator = operator(args, kind, finder, screen)?;
    let mut device = finder.connect(kind, LinkPurpose::Own("commission"))?;
    let subject = Subject::of(&mut device)?;
    let path = args
        .record
        .clone()
        .unwrap_or_else(|| args.out.join(subject.file_name()));
    let mut record = Commissioning::resume(&path, &subject, finder.connector.now())?;
    let all = step::steps(kind);
    let open = procedure::open(all, &record, &subject);
    screen.say(&format!(
        "{} {}, image {}: {} of {} steps hold.",
        kind_name(kind),
        subject.uid,
        subject.image,
        all.len() - open.len(),
        all.len()
    ));
    screen.say(&format!("Record: {}", path.display()));
    for (step, status) in &open {
        let why = match status {
            procedure::StepStatus::OtherImage => "the image is another one".to_owned(),
            procedure::StepStatus::OtherSetting(name) => format!("{name} has changed"),
            procedure::StepStatus::NotPassed | procedure::StepStatus::Holds => continue,
        };
        screen.say(&format!("{} is due again: {why}", step.name));
    }
    if kind == DeviceKind::Rig && operator.present() && !open.is_empty() {
        screen.say("No certified safety function: the motor supply needs a hard-wired switch.");
    }
    let options = Options {
        read_back_cycles: args.strokes / 2,
        cycles: args.cycles,
        clock_us: u64::from(args.clock_s) * 1_000_000,
        image: image(args, kind),
    };
    let reopen = || {
        finder
            .connect(kind, LinkPurpose::Own("commission"))
            .map_err(|failure| failure.to_string())
    };
    let mut say = |text: &str| screen.say(text);
    let mut work = Work::new(device, subject, options, &mut *operator, &mut say, &reopen);
    let now = || finder.connector.now();
    let ended = session::carry_out(&mut work, &mut record, &path, &now);
    let stopped = match &ended {
        Ok(Ending::Aborted(_)) => stop(&mut work.device),
        _ => Ok(()),
    };
    let off = work.supply_is_off();
    let subject = work.subject;
    if off {
        screen.say("The motor supply is off.");
    }
    stopped?;
    ended_as(ended, &path)?;
    let open = procedure::open(all, &record, &subject);
    if open.is_empty() {
        screen.say(&format!("All {} steps hold: {}", all.len(), path.display()));
        return Ok(json!({ "record": path.display().to_string(), "commissioning": record }));
    }
    let names: Vec<_> = open.iter().map(|(step, _)| step.name).collect();
    Err(unfinished(
        REFUSED,
        format!(
            "commissioning is not complete: {} of {} steps were not shown: {}",
            names.len(),
            all.len(),
            names.join(", ")
        ),
        format!(
            "the reasons are in {}; the same command goes on where it is open",
            path.display()
        ),
    ))
}

fn unfinished(exit_code: u8, why: String, help: String) -> Failure {
    Failure::new("retrograde::commission", exit_code, why, help)
}

/// Stops a motion when the operator quits, and waits for the confirmation.
fn stop(device: &mut Device) -> Result<(), ClientError> {
    match device.interrupted() {
        None => device.urgent(Urgent::Stop),
        // Ctrl-C has already sent the stop. Ignore a link error: the line may have been closed to find a board after
        // its reset.
        Some(_) => match device.settle() {
            Err(ClientError::Link(_)) => Ok(()),
            settled => settled,
        },
    }
}

/// The operator of the machine: a person, or the virtual bench's fixture.
fn operator(
    args: &CommissionArgs,
    kind: DeviceKind,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Box<dyn Operator>, Failure> {
    if let Some(place) = &args.fixture {
        let bench = RemoteFixture::connect(place).map_err(|io| Failure::input(
            format!("no fixture at {place}: {io}"),
            "`virtual-bench serve` prints the address of its fixture; without a fixture leave the option out",
        ))?;
        return Ok(Box::new(bench));
    }
    if args.yes {
        return Ok(finder
            .connector
            .fixture(kind, finder.address(kind))
            .unwrap_or_else(|| Box::new(NoOperator)));
    }
    match screen.keyboard.take() {
        Some(keyboard) => Ok(Box::new(Terminal::new(
            keyboard,
            screen.single_keys,
            interrupt::install(),
        ))),
        None => Err(Failure::refused(
            "commissioning needs somebody at a terminal, and there is none",
            "at a terminal, without `--json`; or `--yes`, which asks nobody and shows what needs no hand",
        )),
    }
}

/// Image that should be on the board: the named one, or else the one that `cargo xtask images` has built here.
fn image(args: &CommissionArgs, kind: DeviceKind) -> Option<PathBuf> {
    let built = format!(
        "target/thumbv7em-none-eabihf/firmware/firmware-{}",
        kind_name(kind)
    );
    args.image
        .clone()
        .or_else(|| Some(PathBuf::from(built)).filter(|image| image.is_file()))
}

fn ended_as(ended: Result<Ending, Broken>, path: &std::path::Path) -> Result<(), Failure> {
    let help = format!(
        "the results so far are in {}; the same command goes on from there",
        path.display()
    );
    match ended {
        Ok(Ending::Through) => Ok(()),
        Ok(Ending::Defect(step, why)) => Err(unfinished(
            FAULT,
            format!("{step}: {why}"),
            format!("mend it; {help}"),
        )),
        Ok(Ending::Aborted(step)) => {
            let why = match step {
                Some(step) => format!("quit at the step {step}, which has no result"),
                None => "quit between two steps".to_owned(),
            };
            Err(unfinished(STOPPED, why, help))
        }
        Err(Broken::Client(error)) => Err(error.into()),
        Err(Broken::Record(error)) => Err(error.into()),
        Err(Broken::FixtureLost(why)) => Err(unfinished(STOPPED, why, help)),
    }
}
