//! `retrograde`: the command line tool of both machines.
#![forbid(unsafe_code)]

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use host_tool::cli;
use lab::operations::connector::Ports;

fn main() -> ExitCode {
    let args: Vec<OsString> = std::env::args_os().collect();
    match bench() {
        Some(bench) if cli::is_virtual(&args) => on(&bench, &args),
        // After a panic, too, the exit code is one of the table.
        _ => catch_unwind(|| cli::run(args, &Ports)).unwrap_or(ExitCode::FAILURE),
    }
}

/// Path of the virtual bench's program, if it exists beside this one.
fn bench() -> Option<PathBuf> {
    let own = std::env::current_exe().ok()?;
    let bench = own.with_file_name("virtual-bench");
    bench.is_file().then_some(bench)
}

/// Runs the same command line in the virtual bench's program, which has the virtual machines.
fn on(bench: &Path, args: &[OsString]) -> ExitCode {
    let mut command = Command::new(bench);
    // The bench has its own `serve`, so this word selects the tool's commands.
    command.arg("retrograde").args(args.iter().skip(1));
    // Replace this process, so that signals and exit code are the bench's.
    let why = command.exec();
    eprintln!("{}: {why}", bench.display());
    ExitCode::FAILURE
}
