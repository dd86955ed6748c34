//! `cargo xtask`: set-up, images, demo, tests, bench and CI, each from one command on a fresh machine.
#![forbid(unsafe_code)]
#![allow(
    clippy::print_stdout,
    reason = "a command line tool talks to its terminal"
)]

mod bench;
mod board;
mod book;
mod checks;
mod comments;
mod debian;
mod dependencies;
mod fuzz;
mod images;
mod layout;
mod manual;
mod mutants;
mod pictures;
mod places;
mod process;
mod programs;
mod python;
mod steps;
mod structure;
mod toolchain;
mod version;

use std::path::Path;
use std::process::ExitCode;

use process::Failure;

const HELP: &str = "\
cargo xtask <command>

  demo [OPTIONS]    build the images and run the paper's experiment on the virtual bench;
                    leaves data and a report (options go to the bench: `cargo xtask demo --help`)
  test [host]       build the images, run the host tests with slices of the long series, and the tests of the images
                    (host: only what needs no image); ends with a table of steps, tests, seconds and the
                    slowest test programs
  lint [structure|comments|manual]
                    format, structure, comments, manual, licences, clippy for host and chip, documentation; no warning
                    allowed (structure, comments, manual: only that, in a second; comments: how they begin; manual:
                    links, length and width of pages)
  book              make a book of the manual in target/book, to browse and search; no server and no network needed
                    to read it, no warning allowed
  ci                everything that has to pass before a change is merged
  mutants [PACKAGE [OPTIONS]]
                    change the code with cargo-mutants and count what the tests notice, in PACKAGE or
                    in all that decide what moves (options go to cargo-mutants)
  fuzz [TARGET] [RUNS]
                    look with cargo-fuzz for bytes at which firmware, tool or server do what they must not,
                    in TARGET or in all, RUNS times each; prints what was reached and found

  torture --seed S [--minutes N]
                    both images in random scenarios from this seed on, for N minutes of virtual time, judged by
                    plant and pins; ends with the first broken rule, the seed that repeats it, and what it needs

  images [--check]  build the images, check their layout and sizes (--check: only check them)
  flash MACHINE     build the images, flash `rig` or `capsule` with probe-rs, show its log
  board [--dry-run] measure on a board what the bench cannot show, over probe-rs; prints the table for
                    docs/first-board.md and leaves a file to send (--dry-run: what would be measured, and its wires)
  where MACHINE WORD...
                    find the places in the source for the addresses in a machine's last words
                    (just paste them)
  pictures          draw the manual's pictures: wiring from the pins of the images, a terminal's screen, figures;
                    with --browser CHROMIUM also those of the page and of a report
  bench [OPTIONS]   measure the images on the virtual bench, the step generator beside its peers in one table,
                    and the computing time of the paper's models
  setup             find or install a compiler for the STM32, and nothing else
  help              this text

What has to be there: stable Rust and a C compiler; for `test` python3; for `lint` and `ci` also rustfmt, clippy, git and
Python's venv; what `mutants` and `fuzz` need they say. If the Rust in use has no ARM target, it is added with rustup or
taken from Debian packages; each command says what it does.
";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (command, rest) = match arguments.split_first() {
        Some((command, rest)) => (command.as_str(), rest),
        None => ("help", &[][..]),
    };
    let outcome = match (command, rest) {
        ("demo", options) => images::build().and_then(|()| bench::run_command("demo", options)),
        ("bench", options) => images::build()
            .and_then(|()| images::build_peers())
            .and_then(|()| bench::run_command("bench", options))
            .and_then(|()| bench::models()),
        ("torture", options) => {
            images::build().and_then(|()| bench::run_command("torture", options))
        }
        ("test", []) => return checks::test(),
        ("test", [which]) if which == "host" => return checks::test_host(),
        ("lint", []) => return checks::lint(),
        ("lint", [which]) if which == "structure" => structure::check(),
        ("lint", [which]) if which == "comments" => comments::check(),
        ("lint", [which]) if which == "manual" => manual::check(),
        ("book", []) => book::build(),
        ("ci", []) => return checks::ci(),
        ("mutants", arguments) => mutants::run(arguments),
        ("fuzz", arguments) => fuzz::run(arguments),
        ("images", []) => images::build(),
        ("images", [flag]) if flag == "--check" => images::check(),
        ("flash", [machine]) => images::flash(machine),
        ("board", options) => board::run(options),
        ("where", [machine, words @ ..]) if !words.is_empty() => {
            images::find(machine).and_then(|image| places::print(&image, words))
        }
        ("pictures", []) => pictures::draw(None),
        ("pictures", [flag, browser]) if flag == "--browser" => {
            pictures::draw(Some(Path::new(browser)))
        }
        ("setup", []) => toolchain::find().map(|found| println!("Ready: {found}")),
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
