//! `cargo xtask`: set-up, images, demo, tests, bench and CI, each from one command on a fresh machine.
#![forbid(unsafe_code)]
#![allow(
    clippy::print_stdout,
    reason = "a command line tool talks to its terminal"
)]

mod bench;
mod board;
mod checks;
mod images;
mod places;
mod process;
mod python;
mod release;
mod toolchain;

use std::process::ExitCode;

use process::Failure;

const HELP: &str = "\
cargo xtask <command>

  demo [OPTIONS]    build the images and run the paper's experiment on the virtual bench;
                    leaves data and a report (options go to the bench: `cargo xtask demo --help`)
  test              build the images, run the host tests, the tests of the images and Python's
  ci                everything that has to pass before a change is merged: the tests, format, clippy for host and chip,
                    documentation, licences, the demo
  python            only Python's tests

  images            build the images, check their vector tables, print their sizes
  flash MACHINE     build the images, flash `rig`, `capsule` or `board` with probe-rs, show its log
  board [--dry-run] measure on a board what the bench cannot show, over probe-rs
  where MACHINE WORD...
                    find the places in the source for the addresses in a machine's last words (just paste them)
  bench [OPTIONS]   measure the images on the virtual bench
  release           build everything that a lab without Rust needs, into target/retrograde-VERSION
  setup             find or install the compiler's ARM target, and nothing else
  help              this text

What has to be there: stable Rust and a C compiler; for `test` python3; for `ci` also rustfmt, clippy and Python's venv.
If the Rust in use has no ARM target, rustup adds it; each command says what it does.
";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (command, rest) = match arguments.split_first() {
        Some((command, rest)) => (command.as_str(), rest),
        None => ("help", &[][..]),
    };
    let outcome = match (command, rest) {
        ("demo" | "bench", options) => {
            images::build().and_then(|()| bench::run_command(command, options))
        }
        ("test", []) => checks::test(),
        ("ci", []) => checks::ci(),
        ("python", []) => bench::build().and_then(|()| python::test()),
        ("images", []) => images::build(),
        ("flash", [machine]) => images::flash(machine),
        ("board", options) => board::run(options),
        ("where", [machine, words @ ..]) if !words.is_empty() => {
            images::find(machine).and_then(|image| places::print(&image, words))
        }
        ("release", []) => release::make(),
        ("setup", []) => toolchain::ensure_target(),
        ("help" | "--help" | "-h", _) => {
            print!("{HELP}");
            Ok(())
        }
        _ => Err(Failure::new(
            format!("unknown command: {}", arguments.join(" ")),
            "`cargo xtask help` lists the commands",
        )),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("{failure}");
            ExitCode::FAILURE
        }
    }
}
