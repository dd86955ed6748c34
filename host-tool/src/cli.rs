//! The command line tool, a thin layer over the library. A program with another [`Connector`] can call [`run`], too.

mod ack;
mod actuation;
mod calculation;
mod campaign;
mod capsule;
mod commission;
mod cycle;
mod design;
mod doctor;
mod failure;
mod fold;
mod fresh;
mod health;
mod hold;
mod home;
mod info;
mod jog;
mod keyboard;
mod man;
mod model;
mod move_to;
mod plan;
mod records;
mod report;
mod run;
mod science;
pub mod screen;
mod serve;
mod settings;
mod stops;
mod trace;
mod verify;
mod watch;

use std::ffi::OsString;
use std::io::{self, IsTerminal, Write};
use std::process::ExitCode;

use clap::builder::{OsStr, Resettable};
use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{CommandFactory, FromArgMatches, Parser};
use client::address::{Address, Given};
use client::link::serial::DEFAULT_BAUD;
use client::{identity, visible};
use lab::operations::arguments::{
    FoldArgs, JogArgs, MachineKind, MoveArgs, PartialArgs, RunArgs, Which,
};
use lab::operations::connector::Connector;
use lab::operations::delivery::{Delivery, StopReport};
use lab::operations::failure::{DONE, Failure, USAGE, usage, usage_text};
use lab::operations::finder::{Beginning, Finder};
use lab::operations::output::Stream;
use protocol::capsule::ActuationKind;
use protocol::system::{DeviceKind, Urgent};
use serde_json::Value;

use crate::cli::campaign::CampaignSubcommand;
use crate::cli::capsule::CapsuleSubcommand;
use crate::cli::commission::CommissionArgs;
use crate::cli::design::DesignArgs;
use crate::cli::plan::PlanArgs;
use crate::cli::records::RecordsSubcommand;
use crate::cli::report::ReportArgs;
use crate::cli::science::SimulateArgs;
use crate::cli::screen::{Keyboard, Screen};
use crate::cli::serve::ServeArgs;
use crate::cli::settings::SettingsSubcommand;
use crate::cli::verify::VerifyArgs;
use crate::cli::watch::WatchArgs;

const EXAMPLES: &str = "\
Examples:
  retrograde doctor                             which machines are there, and what is wrong
  retrograde --rig /dev/ttyACM0 info            how the rig is, also while it runs
  retrograde home                               find the position, before a run
  retrograde run --cycles 5 --duration-s 40     the paper's run, recorded in retrograde-data
  retrograde watch                              see it run, from another terminal
  retrograde serve                              the same on a page, with buttons, and for programs
  retrograde run --stroke-mm 60 --speed-mm-s 10 --note 'second body'
  retrograde campaign run examples/paper.toml   the paper's trials, step by step
  retrograde plan --duration-s 40 --plot run.svg   the same without a rig
  retrograde stop                               stop all machines, from any terminal
  retrograde report retrograde-data --out report.html

`retrograde man run | man -l -` shows the manual page of a subcommand.";

/// Global options for the addresses of machines.
const PLACES: [&str; 3] = ["rig", "capsule", "baud"];
/// Subcommands that reach no machine, so that their help does not show these options.
const WITHOUT_MACHINES: [&str; 7] = [
    "verify",
    "report",
    "plan",
    "design",
    "simulate",
    "completions",
    "man",
];

/// Peristaltic waves on the rig, a folding capsule, and the data of both.
///
/// Ctrl-C stops in a controlled way and keeps the position; twice is the emergency stop. This is not a certified
/// safety function: a hard-wired switch in the motor supply is required.
#[derive(Debug, Parser)]
#[command(name = "retrograde", version = crate::VERSION, arg_required_else_help = true, after_help = EXAMPLES)]
pub struct Cli {
    /// The rig: `auto`, a serial port, `tcp:HOST:PORT` or `virtual`.
    #[arg(long, global = true, env = "RETROGRADE_RIG", value_name = "WHERE")]
    pub rig: Option<Given>,
    /// The capsule: `auto`, a serial port, `tcp:HOST:PORT` or `virtual`.
    #[arg(long, global = true, env = "RETROGRADE_CAPSULE", value_name = "WHERE")]
    pub capsule: Option<Given>,
    /// Baud rate of serial ports.
    #[arg(long, global = true, default_value_t = DEFAULT_BAUD, value_parser = clap::value_parser!(u32).range(300..=4_000_000))]
    pub baud: u32,
    /// Print one JSON object on standard output; everything else goes to standard error.
    #[arg(long, global = true)]
    pub json: bool,
    #[command(subcommand)]
    pub subcommand: Subcommand,
}

#[derive(Debug, clap::Subcommand)]
pub enum Subcommand {
    /// List ports and the machines at them, and find out what is wrong. Moves nothing.
    ///
    /// Takes a second or so. Each problem comes with its remedy.
    Doctor(Which),
    /// Show identity, state and last fault of the machines. Moves nothing.
    Info(Which),
    /// Find the rig's position: two passes over the home flag, then to 0.
    Home,
    /// Run the waves: cycles away from home and back, recorded.
    ///
    /// The rig must be homed. At a terminal, the key h holds the run, r resumes it, s stops it.
    Run(Box<RunArgs>),
    /// A campaign: a plan of trials with readings, displacements and records.
    ///
    /// It can be interrupted and resumed at any time.
    Campaign {
        /// The step of the campaign.
        #[command(subcommand)]
        subcommand: CampaignSubcommand,
    },
    /// Save the machines' own record of their last action.
    Records {
        /// What to do with the record.
        #[command(subcommand)]
        subcommand: RecordsSubcommand,
    },
    /// Find every change of a campaign's folder since it was written.
    ///
    /// Finds changed bits, lines and files. Changes nothing.
    Verify(VerifyArgs),
    /// Commission a new board, step by step.
    ///
    /// Switches, pulses, travel and stops are measured and recorded. You can quit at any time; the same command
    /// continues with the next open step.
    Commission(Box<CommissionArgs>),
    /// Stop: the rig decelerates and keeps its position, the capsule's motor stops.
    ///
    /// Its worm gear holds it.
    Stop(Which),
    /// Emergency stop: cut pulses and motor current at once.
    ///
    /// It is latched, and the rig's position is lost.
    Estop(Which),
    /// Acknowledge a latched fault after its cause was removed. Moves nothing.
    Ack(Which),
    /// The capsule's own commands.
    Capsule {
        /// The capsule's command.
        #[command(subcommand)]
        subcommand: CapsuleSubcommand,
    },
    /// Fold the capsule's origami, or fold or unfold it partly, recorded.
    Fold(PartialArgs),
    /// Unfold the capsule's origami, recorded.
    Unfold(FoldArgs),
    /// Hold a run: decelerate, keep the position, ready to resume.
    ///
    /// For a run that continues without its host.
    Hold,
    /// Resume a held run, exactly as planned.
    Resume,
    /// Move the rig while this command runs; it stops at the ends of the stroke.
    Jog(JogArgs),
    /// Move the rig to a position.
    Move(MoveArgs),
    /// Print the state of the machines every second, until Ctrl-C. Moves nothing.
    ///
    /// It works beside another `retrograde` that owns the machines. With `--json` each line is an object.
    Watch(WatchArgs),
    /// Serve both machines to browsers and programs: a page, and HTTP with JSON.
    ///
    /// Listens on this computer only, by default. Other commands keep working beside it.
    Serve(ServeArgs),
    /// Show the rig's counters: false pulses, serial errors, stack use, underruns.
    Health,
    /// Settings and name of a machine.
    Settings {
        /// The machine: the rig, unless only the capsule has the setting.
        #[arg(long, value_enum, value_name = "MACHINE", global = true)]
        of: Option<MachineKind>,
        /// What to do with the settings.
        #[command(subcommand)]
        subcommand: SettingsSubcommand,
    },
    /// Calculate a run without a rig: durations, speeds, edges as CSV, plot as SVG.
    Plan(Box<PlanArgs>),
    /// Calculate an origami design: lengths, shortening, requirements, drawings.
    ///
    /// The requirements are the paper's, the drawings SVG.
    Design(Box<DesignArgs>),
    /// Simulate the paper's series and free sweeps: CSV and SVG.
    Simulate(Box<SimulateArgs>),
    /// Write an HTML report of recorded trials or of a campaign.
    ///
    /// A campaign's report has figures and tables.
    Report(ReportArgs),
    /// Print a completion script for a shell.
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
    /// Print the manual page (roff) of the program, or of a subcommand.
    Man {
        /// The subcommand, such as `run` or `settings set`.
        subcommand: Vec<String>,
    },
}

impl Subcommand {
    const fn is_stop(&self) -> bool {
        matches!(self, Self::Stop(_) | Self::Estop(_))
    }
}

/// Runs one command line, program name first, on the process's streams.
pub fn run(args: impl IntoIterator<Item = OsString>, connector: &dyn Connector) -> ExitCode {
    let (mut out, mut err) = (Stream::Out, Stream::Err);
    let terminal = io::stderr().is_terminal();
    let at = At {
        terminal,
        is_process: true,
        keyboard: keyboard::standard(),
    };
    let code = run_in(args, connector, &mut out, &mut err, at);
    // Flush the last text of an error.
    let _ = out.flush();
    ExitCode::from(code)
}

/// Whether a command line, with its environment, is meant for a virtual machine.
pub fn is_virtual(args: &[OsString]) -> bool {
    let is_virtual = |given: &Given| given.address == Ok(Address::Virtual);
    parsed(args, true).is_ok_and(|cli| [cli.rig, cli.capsule].iter().flatten().any(is_virtual))
}

/// Runs one command line on these streams, which are not a terminal; a person at `keyboard` answers questions and may
/// hold and resume a run. Ignores environment variables that name machines: a test must not reach the rig of the person
/// who runs it. Returns the exit code.
pub fn run_on(
    args: impl IntoIterator<Item = OsString>,
    connector: &dyn Connector,
    out: &mut dyn Write,
    err: &mut dyn Write,
    keyboard: Option<Keyboard>,
) -> u8 {
    let at = At {
        terminal: false,
        is_process: false,
        keyboard,
    };
    run_in(args, connector, out, err, at)
}

/// The terminal of a command line, if there is one.
struct At {
    /// Standard error is a terminal.
    terminal: bool,
    /// Variables may name machines, and the keyboard is that of the process's terminal, so single keys can be read.
    is_process: bool,
    keyboard: Option<Keyboard>,
}

/// Takes a negative number as a value and not as an option, so that the refusal names the range.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    command
        .mut_args(|argument| match argument.get_action().takes_values() {
            true => argument.allow_negative_numbers(true),
            false => argument,
        })
        .mut_subcommands(with_negative_numbers)
}

fn command() -> clap::Command {
    let command = with_negative_numbers(Cli::command());
    // Hidden, but still accepted: a script may pass them to all commands.
    let hidden: Vec<_> = command
        .get_arguments()
        .filter(|argument| PLACES.contains(&argument.get_id().as_str()))
        .map(|argument| argument.clone().hide(true))
        .collect();
    WITHOUT_MACHINES.iter().fold(command, |command, name| {
        command.mut_subcommand(name, |of| of.args(&hidden))
    })
}

fn run_in(
    args: impl IntoIterator<Item = OsString>,
    connector: &dyn Connector,
    out: &mut dyn Write,
    err: &mut dyn Write,
    at: At,
) -> u8 {
    let beginning = Beginning::now();
    crate::sign_records();
    let args: Vec<OsString> = args.into_iter().collect();
    let cli = match parsed(&args, at.is_process) {
        Ok(cli) => cli,
        Err(error) => {
            let error = without_variables(error, &args);
            let text = usage_text(&error);
            let text = visible::lines(&text);
            let wanted = !error.use_stderr();
            let _ = if wanted {
                out.write_all(text.as_bytes())
            } else {
                if args.iter().any(|arg| arg == "--json") {
                    let _ = writeln!(out, "{:#}", usage(&text));
                }
                err.write_all(text.as_bytes())
            };
            return if wanted { DONE } else { USAGE };
        }
    };
    let mut screen = Screen {
        out,
        err,
        json: cli.json,
        terminal: at.terminal,
        single_keys: at.is_process,
        keyboard: at.keyboard.filter(|_| !cli.json),
        failed: None,
    };
    let found = Addressed::of(&cli);
    let finder = Finder {
        rig: found.rig,
        capsule: found.capsule,
        baud: cli.baud,
        connector,
        beginning,
    };
    let result = carry_out(&cli.subcommand, &finder, found.unread, &mut screen);
    screen.finish(result)
}

/// Parses a command line. An empty variable counts as not set. An unreadable address is an error, except for a stop,
/// which still goes to the other machine.
fn parsed(args: &[OsString], environment: bool) -> Result<Cli, clap::Error> {
    let command = match environment {
        true => command(),
        false => without_environment(command()),
    };
    let matches = command.try_get_matches_from(args)?;
    let mut cli = Cli::from_arg_matches(&matches)?;
    for (name, given) in [("rig", &mut cli.rig), ("capsule", &mut cli.capsule)] {
        let by_variable = matches.value_source(name) == Some(ValueSource::EnvVariable);
        given.take_if(|given| by_variable && given.text.is_empty());
        if let Some(Given {
            text,
            address: Err(why),
        }) = given
            && !cli.subcommand.is_stop()
        {
            let why = format!(
                "invalid value '{text}' for '--{name} <WHERE>': {why}\n\nFor more information, try '--help'.\n"
            );
            return Err(clap::Error::raw(ErrorKind::ValueValidation, why));
        }
    }
    Ok(cli)
}

/// The command line without its environment variables.
fn without_environment(command: clap::Command) -> clap::Command {
    command
        .mut_args(|argument| argument.env(Resettable::<OsStr>::Reset))
        .mut_subcommands(without_environment)
}

/// Rebuilds a usage error so that arguments given by the environment are not shown as required.
fn without_variables(error: clap::Error, args: &[OsString]) -> clap::Error {
    if error.kind() != ErrorKind::MissingRequiredArgument {
        return error;
    }
    let again = without_environment(command()).try_get_matches_from(args);
    again.err().unwrap_or(error)
}

/// Machines whose addresses cannot be parsed, so that no stop reaches them.
type Unread = Vec<(DeviceKind, StopReport)>;

/// The addresses of a command line.
struct Addressed {
    rig: Option<Address>,
    capsule: Option<Address>,
    /// Empty unless the command is a stop.
    unread: Unread,
}

impl Addressed {
    fn of(cli: &Cli) -> Self {
        let mut unread = vec![];
        let mut address = |kind, given: &Option<Given>| match &given.as_ref()?.address {
            Ok(address) => Some(address.clone()),
            Err(why) => {
                let report = StopReport {
                    machine: format!("{} at {}", identity::kind_name(kind), given.as_ref()?.text),
                    delivery: Delivery::NotDelivered,
                    why: why.to_string(),
                };
                unread.push((kind, report));
                None
            }
        };
        Self {
            rig: address(DeviceKind::Rig, &cli.rig),
            capsule: address(DeviceKind::Capsule, &cli.capsule),
            unread,
        }
    }
}

/// Stops the machines whose addresses can be parsed, and reports the others as not delivered.
fn stop(
    urgent: Urgent,
    which: &Which,
    finder: &Finder<'_>,
    mut unread: Unread,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let machine = which.machine.map(DeviceKind::from);
    unread.retain(|(kind, _)| machine.is_none_or(|machine| machine == *kind));
    if unread.is_empty() {
        return stops::stop(urgent, which, finder, screen);
    }
    // Report this at once: the other machine's answer may take seconds.
    for (_, unread) in &unread {
        screen.say(&unread.line(urgent));
    }
    let is_another = machine.is_none() && (finder.rig.is_some() || finder.capsule.is_some());
    let mut reports = match is_another.then(|| stops::stop(urgent, which, finder, screen)) {
        None => vec![],
        Some(Err(Failure::Stops { reports })) => reports,
        Some(Err(failure)) => return Err(failure),
        Some(Ok(value)) => {
            let stopped = value["stopped"].as_array().into_iter().flatten();
            let stopped = stopped.filter_map(Value::as_str).map(|machine| StopReport {
                machine: machine.to_owned(),
                delivery: Delivery::Stopped,
                why: String::new(),
            });
            stopped.collect()
        }
    };
    reports.extend(unread.into_iter().map(|(_, unread)| unread));
    Err(Failure::Stops { reports })
}

fn carry_out(
    subcommand: &Subcommand,
    finder: &Finder<'_>,
    unread: Unread,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    match subcommand {
        Subcommand::Doctor(which) => doctor::doctor(which, finder, screen),
        Subcommand::Info(which) => info::info(which, finder, screen),
        Subcommand::Home => home::home(finder, screen),
        Subcommand::Run(args) => run::run(args, finder, screen),
        Subcommand::Campaign { subcommand } => campaign::campaign(subcommand, finder, screen),
        Subcommand::Verify(args) => verify::verify(args, screen),
        Subcommand::Records { subcommand } => records::records(subcommand, finder, screen),
        Subcommand::Commission(args) => commission::commission(args, finder, screen),
        Subcommand::Stop(which) => stop(Urgent::Stop, which, finder, unread, screen),
        Subcommand::Estop(which) => stop(Urgent::EStop, which, finder, unread, screen),
        Subcommand::Ack(which) => ack::acknowledge(which, finder, screen),
        Subcommand::Capsule { subcommand } => capsule::capsule(subcommand, finder, screen),
        Subcommand::Fold(args) => fold::fold(args, finder, screen),
        Subcommand::Unfold(FoldArgs { record, trace }) => {
            let (kind, trace) = (ActuationKind::Unfold, trace.as_deref());
            actuation::actuate("unfold", kind, record, trace, finder, screen)
        }
        Subcommand::Hold => hold::hold(finder, screen),
        Subcommand::Resume => hold::resume(finder, screen),
        Subcommand::Jog(args) => jog::jog(args, finder, screen),
        Subcommand::Move(args) => move_to::move_to(args, finder, screen),
        Subcommand::Serve(args) => serve::serve(args, finder, screen),
        Subcommand::Watch(args) => watch::watch(args, finder, screen),
        Subcommand::Health => health::health(finder, screen),
        Subcommand::Settings { of, subcommand } => {
            settings::settings(*of, subcommand, finder, screen)
        }
        Subcommand::Plan(args) => plan::plan(args, screen),
        Subcommand::Design(args) => design::design(args, screen),
        Subcommand::Simulate(args) => science::simulate(args, screen),
        Subcommand::Report(args) => report::report(args, screen),
        Subcommand::Completions { shell } => man::completions(command(), *shell, screen),
        Subcommand::Man { subcommand } => man::man(command(), subcommand, screen),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_without_a_machine_takes_its_places_and_does_not_show_them() {
        for words in [
            &["retrograde", "simulate", "roller"][..],
            &["retrograde", "verify", "folder"],
        ] {
            let mut line = words.to_vec();
            line.extend(["--rig", "tcp:127.0.0.1:1", "--baud", "9600"]);
            let matches = command().try_get_matches_from(line).expect("taken");
            let cli = Cli::from_arg_matches(&matches).expect("read");
            assert_eq!((cli.rig.is_some(), cli.baud), (true, 9_600), "{words:?}");
            let mut line = words.to_vec();
            line.push("--help");
            let help = command().try_get_matches_from(line).expect_err("help");
            let help = help.to_string();
            assert!(
                help.contains("--json") && !help.contains("--rig <"),
                "{help}"
            );
        }
        let known: Vec<_> = command()
            .get_subcommands()
            .map(|of| of.get_name().to_owned())
            .collect();
        for name in WITHOUT_MACHINES {
            assert!(known.iter().any(|known| known == name), "{name}");
        }
    }
}
