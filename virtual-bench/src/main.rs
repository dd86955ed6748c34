//! `virtual-bench`: the program.

use std::ffi::OsString;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use jiff::Timestamp;
use virtual_bench::connector::BenchPorts;
use virtual_bench::demo::{self, DemoOptions};
use virtual_bench::{figures, serve};

#[derive(Parser)]
#[command(about, version)]
struct Arguments {
    #[command(subcommand)]
    subcommand: Subcommand,
}

#[derive(clap::Subcommand)]
enum Subcommand {
    /// Executes the paper's experiment on both images and judges it from the pins.
    Demo {
        /// Folder for the records and the report.
        #[arg(long, value_name = "DIR", default_value = "demo-data")]
        out: PathBuf,
    },
    /// Measures load and sizes of the images, and the speed of the emulator.
    Bench,
    /// Serves the machines on local TCP ports in real time, until interrupted.
    Serve(serve::Options),
    /// Any command of the host tool, also behind the word `retrograde`, as its own `serve` has to be; which here also
    /// takes `--rig virtual` and `--capsule virtual`.
    #[command(external_subcommand)]
    Retrograde(Vec<OsString>),
}

fn main() -> ExitCode {
    let result = match Arguments::parse().subcommand {
        Subcommand::Demo { out } => {
            let now = Timestamp::now();
            host_tool::sign_records();
            demo::run(&DemoOptions { out, now }, std::io::stderr().is_terminal())
                .map_err(miette::Report::from)
        }
        Subcommand::Bench => figures::run(&mut |line| drop(writeln!(std::io::stdout(), "{line}")))
            .map_err(miette::Report::from),
        Subcommand::Serve(options) => serve::run(&options).map_err(miette::Report::from),
        Subcommand::Retrograde(arguments) => {
            let program = OsString::from("virtual-bench");
            // `serve` is this program's own; the tool's is `virtual-bench retrograde serve`.
            let own = arguments.first().is_some_and(|word| word == "retrograde");
            return host_tool::cli::run(
                [program]
                    .into_iter()
                    .chain(arguments.into_iter().skip(usize::from(own))),
                &BenchPorts::default(),
            );
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            eprintln!("{why:?}");
            ExitCode::FAILURE
        }
    }
}
