//! `retrograde`: the command line tool of both machines.
#![forbid(unsafe_code)]

use std::process::ExitCode;

use host_tool::cli;
use operations::connector::Ports;

fn main() -> ExitCode {
    cli::run(std::env::args_os(), &Ports)
}
