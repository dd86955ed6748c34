//! The command line tool, a thin layer over the library. A program that has a [`Connector`] of its own can call [`run`],
//! too.

pub(crate) mod already;
pub mod args;
mod calculation;
mod campaign;
mod commission;
mod compare;
pub mod configured;
mod crescent;
pub mod design;
pub mod doctor;
pub mod failure;
pub(crate) mod finding;
pub mod fit;
mod flash;
mod fresh;
pub(crate) mod interrupt;
mod keyboard;
pub mod machines;
pub mod model;
pub(crate) mod motion;
mod offline;
pub mod optimise;
pub(crate) mod partial;
pub mod plan_experiment;
mod records;
mod run;
pub mod science;
mod screen;
mod serve;
mod settings;
pub mod stops;
mod study;
pub mod watch;
mod windows;

use std::ffi::OsString;
use std::io::{self, BufRead, IsTerminal, Write};
use std::process::ExitCode;
use std::sync::LazyLock;

use clap::builder::{OsStr, Resettable};
use clap::error::ErrorKind;
use clap::{CommandFactory, Parser};
use protocol::capsule::ActuationKind;
use protocol::system::Urgent;
use serde_json::Value;

use crate::cli::args::{CapsuleSubcommand, Cli, FoldArgs, Subcommand};
use crate::cli::failure::{DONE, Failure, USAGE};
use crate::cli::finding::Finder;
use crate::cli::screen::Screen;
use crate::connector::Connector;

/// Runs one command line, program name first, on the process's streams.
pub fn run(args: impl IntoIterator<Item = OsString>, connector: &dyn Connector) -> ExitCode {
    LazyLock::force(&finding::BEGAN);
    let (mut out, mut err) = (io::stdout(), io::stderr());
    let terminal = err.is_terminal();
    let at = At {
        terminal,
        single_keys: true,
        keyboard: keyboard::standard(),
    };
    ExitCode::from(run_in(args, connector, &mut out, &mut err, at))
}

/// Runs one command line on other streams, without a keyboard; `terminal` allows a progress bar on standard error.
/// Returns the exit code.
pub fn run_on(
    args: impl IntoIterator<Item = OsString>,
    connector: &dyn Connector,
    out: &mut dyn Write,
    err: &mut dyn Write,
    terminal: bool,
) -> u8 {
    run_at(args, connector, out, err, terminal, None)
}

/// What a person types, line by line.
pub type Keyboard = Box<dyn BufRead + Send>;

/// As [`run_on`], with a person at `keyboard` who answers questions and may hold and resume a run.
pub fn run_at(
    args: impl IntoIterator<Item = OsString>,
    connector: &dyn Connector,
    out: &mut dyn Write,
    err: &mut dyn Write,
    terminal: bool,
    keyboard: Option<Keyboard>,
) -> u8 {
    let at = At {
        terminal,
        single_keys: false,
        keyboard,
    };
    run_in(args, connector, out, err, at)
}

/// Where a command line was typed.
struct At {
    /// Standard error is a terminal.
    terminal: bool,
    /// The keyboard is that of the process's terminal, which can give single keys.
    single_keys: bool,
    keyboard: Option<Keyboard>,
}

fn run_in(
    args: impl IntoIterator<Item = OsString>,
    connector: &dyn Connector,
    out: &mut dyn Write,
    err: &mut dyn Write,
    at: At,
) -> u8 {
    let args: Vec<OsString> = args.into_iter().collect();
    let mut cli = match Cli::try_parse_from(&args) {
        Ok(cli) => cli,
        Err(error) => {
            let error = without_environment(error, &args);
            let text = error.render().to_string();
            let wanted = !error.use_stderr();
            let _ = if wanted {
                out.write_all(text.as_bytes())
            } else {
                if args.iter().any(|arg| arg == "--json") {
                    let _ = writeln!(out, "{:#}", failure::usage(&text));
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
        single_keys: at.single_keys,
        keyboard: at.keyboard.filter(|_| !cli.json),
        failed: None,
    };
    let result = match configured::resolve(&mut cli) {
        Ok(()) => carry_out(&cli, connector, &mut screen),
        Err(failure) => Err(stops::undelivered(&cli.subcommand, failure)),
    };
    screen.finish(result)
}

/// The same error of the command line; what the environment gives is not shown as required.
fn without_environment(error: clap::Error, args: &[OsString]) -> clap::Error {
    if error.kind() != ErrorKind::MissingRequiredArgument {
        return error;
    }
    let mut command = Cli::command();
    for place in ["rig", "capsule"] {
        let reset = Resettable::<OsStr>::Reset;
        command = command.mut_arg(place, |arg| arg.env(reset));
    }
    command.try_get_matches_from(args).err().unwrap_or(error)
}

fn carry_out(
    cli: &Cli,
    connector: &dyn Connector,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let finder = &Finder { cli, connector };
    match &cli.subcommand {
        Subcommand::Devices => machines::devices(finder, screen),
        Subcommand::Doctor(which) => doctor::doctor(which, finder, screen),
        Subcommand::Info(which) => machines::info(which, finder, screen),
        Subcommand::Home => machines::home(finder, screen),
        Subcommand::Run(args) => run::run(args, finder, screen),
        Subcommand::Campaign { subcommand } => campaign::campaign(subcommand, finder, screen),
        Subcommand::Verify(args) => campaign::verify(args, screen),
        Subcommand::Records { subcommand } => records::records(subcommand, finder, screen),
        Subcommand::Commission(args) => commission::commission(args, finder, screen),
        Subcommand::Stop(which) => stops::stop(Urgent::Stop, which, finder, screen),
        Subcommand::Estop(which) => stops::stop(Urgent::EStop, which, finder, screen),
        Subcommand::Ack(which) => machines::acknowledge(which, finder, screen),
        Subcommand::Capsule { subcommand } => {
            let (kind, args) = match subcommand {
                CapsuleSubcommand::Trace(args) => return study::trace(args, finder, screen),
                CapsuleSubcommand::Cycle(args) => return study::cycle(args, finder, screen),
                CapsuleSubcommand::Identify(args) => return study::identify(args, finder, screen),
                CapsuleSubcommand::Reference(args) => (ActuationKind::Reference, args),
                CapsuleSubcommand::Calibrate(args) => (ActuationKind::Calibrate, args),
                CapsuleSubcommand::Check(args) => (ActuationKind::CheckFolded, args),
            };
            machines::actuate(kind, args, None, finder, screen)
        }
        Subcommand::Fold(args) => partial::fold(args, finder, screen),
        Subcommand::Unfold(FoldArgs { record, trace }) => {
            let trace = trace.as_deref();
            machines::actuate(ActuationKind::Unfold, record, trace, finder, screen)
        }
        Subcommand::Hold => motion::hold(finder, screen),
        Subcommand::Resume => motion::resume(finder, screen),
        Subcommand::Jog(args) => motion::jog(args, finder, screen),
        Subcommand::Move(args) => motion::move_to(args, finder, screen),
        Subcommand::Serve(args) => serve::serve(args, finder, screen),
        Subcommand::Watch(args) => watch::watch(args, finder, screen),
        Subcommand::Health => motion::health(finder, screen),
        Subcommand::Settings { of, subcommand } => {
            settings::settings(*of, subcommand, finder, screen)
        }
        Subcommand::Plan(args) => offline::plan(args, screen),
        Subcommand::Design(args) => design::design(args, screen),
        Subcommand::Simulate(args) => science::simulate(args, screen),
        Subcommand::Fit(args) => fit::fit(args, screen),
        Subcommand::PlanExperiment(args) => plan_experiment::plan_experiment(args, screen),
        Subcommand::List(args) => offline::list(args, screen),
        Subcommand::Report(args) => offline::report(args, screen),
        Subcommand::Flash(args) => flash::flash(args, finder, screen),
        Subcommand::Completions { shell } => offline::completions(*shell, screen),
        Subcommand::Man { subcommand } => offline::man(subcommand, screen),
    }
}
