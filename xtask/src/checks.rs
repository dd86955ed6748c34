//! The steps of `cargo xtask test`, `lint` and `ci`.
//!
//! Everything is compiled as rarely as possible: once for the host tests, the bench and the demo, in the dev profile
//! with an optimised emulator; once as metadata for the linter and the documentation; once for the chip.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::thread;
use std::time::SystemTime;

use crate::process::{Failure, Result, host_cargo, root, run};
use crate::programs::Selection;
use crate::steps::{self, Step, Tests};
use crate::{bench, book, comments, dependencies, images, manual, programs, python, structure};

const HOST_TESTS: Step = Step::tests(
    "host tests",
    "the programs of plain `cargo test`, which needs nothing installed, side by side, with slices of the long series",
    host_tests,
);
const IMAGES: Step = Step::new(
    "images",
    "builds the ARM images, and checks their addresses and sizes",
    images::build,
);
const BENCH_TESTS: Step = Step::tests(
    "bench tests",
    "boots the images on the virtual bench and judges them from their pins; beside it, the Python package and them",
    bench_tests,
)
.after("images");

const FORMAT: Step = Step::new("format", "every file is formatted by rustfmt", format);
const STRUCTURE: Step = Step::new(
    "structure",
    "no imports in circles or upwards, no crate and no file too large",
    structure::check,
);
const COMMENTS: Step = Step::new(
    "comments",
    "no comment begins with a word that keeps it from saying the thing itself",
    comments::check,
);
const MANUAL: Step = Step::new(
    "manual",
    "every link in Markdown leads somewhere, no page of docs/ too long, no line too wide",
    manual::check,
);
const BOOK: Step = Step::new(
    "book",
    "the book of the manual is built, each page in its navigation, no warning allowed",
    book::build,
);
const LINT_HOST: Step = Step::new(
    "lint host",
    "clippy on every package and target of the host, no warning allowed",
    lint_host,
);
const LINT_IMAGES: Step = Step::new(
    "lint images",
    "clippy on all images as compiled for their chips, no warning allowed",
    images::lint,
);
const DOCS: Step = Step::new(
    "docs",
    "the documentation of every package, no warning allowed",
    docs,
);
const DEPENDENCIES: Step = Step::new(
    "dependencies",
    "licences and sources of other people's crates are those allowed",
    dependencies::check,
);
const DEMO: Step = Step::new(
    "demo",
    "`cargo xtask demo`, which must leave data and a report",
    demo,
)
.after("images");

/// Runs every test, with all set-up.
pub(crate) fn test() -> ExitCode {
    steps::run(&[IMAGES, HOST_TESTS, BENCH_TESTS])
}

/// Runs the tests that need no image.
pub(crate) fn test_host() -> ExitCode {
    steps::run(&[HOST_TESTS])
}

/// Runs the checks that execute no code of ours.
pub(crate) fn lint() -> ExitCode {
    steps::run(&[
        FORMAT,
        STRUCTURE,
        COMMENTS,
        MANUAL,
        DEPENDENCIES,
        LINT_HOST,
        DOCS,
        LINT_IMAGES,
    ])
}

/// Runs every test and every other check that has to pass before a change is merged. The host tests come
/// before anything is installed, which shows that they need nothing.
pub(crate) fn ci() -> ExitCode {
    steps::run(&[
        FORMAT,
        STRUCTURE,
        COMMENTS,
        MANUAL,
        HOST_TESTS,
        LINT_HOST,
        DOCS,
        BOOK,
        DEPENDENCIES,
        IMAGES,
        LINT_IMAGES,
        BENCH_TESTS,
        DEMO,
    ])
}

fn host_tests() -> Tests {
    programs::test(Selection {
        cargo: host_cargo("test"),
        examples: true,
        lanes: programs::cores(),
    })
}

/// Run both at once: the Python tests mostly wait for their machines in real time, and the bench computes.
fn bench_tests() -> Tests {
    thread::scope(|scope| {
        let python = scope.spawn(python::test);
        let bench = bench::test();
        let python = python.join().unwrap_or_else(|_| {
            Tests::failed(Failure::new("the Python step panicked", "see above"))
        });
        bench.and(python)
    })
}

fn format() -> Result<()> {
    let mut cargo = host_cargo("fmt");
    run(
        cargo.args(["--all", "--check"]),
        "`cargo fmt --all`; if there is no such command, `rustup component add rustfmt`",
    )
}

fn lint_host() -> Result<()> {
    let mut cargo = host_cargo("clippy");
    // `--locked`: a change of dependencies has to include Cargo.lock.
    cargo.args(["--locked", "--workspace", "--all-targets"]);
    bench::accept_this_rust(&mut cargo);
    run(
        cargo.args(["--", "-D", "warnings"]),
        "fix what clippy reports above; if there is no such command, `rustup component add clippy`",
    )
}

fn docs() -> Result<()> {
    let mut cargo = host_cargo("doc");
    cargo.args(["--workspace", "--no-deps"]);
    bench::accept_this_rust(&mut cargo);
    run(
        cargo.env("RUSTDOCFLAGS", "-D warnings"),
        "fix what rustdoc reports above",
    )
}

/// The folder that the demo writes to by default.
const DEMO_DATA: &str = "demo-data";

fn demo() -> Result<()> {
    let start = SystemTime::now();
    bench::run_command("demo", &[])?;
    let written = written_since(start, &root().join(DEMO_DATA));
    for (what, ending) in [("telemetry", "csv"), ("record", "json"), ("report", "html")] {
        let found = written
            .iter()
            .find(|path| path.extension().is_some_and(|end| end == ending));
        match found {
            Some(path) => println!(
                "{what}: {}",
                path.strip_prefix(root()).unwrap_or(path).display()
            ),
            None => {
                let what = format!("the demo left no {what} (.{ending}) in {DEMO_DATA}");
                return Err(Failure::new(
                    what,
                    "the demo says above where it has written to",
                ));
            }
        }
    }
    Ok(())
}

/// Non-empty files below a folder that were written after `start`.
fn written_since(start: SystemTime, folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let Ok(about) = entry.metadata() else {
            continue;
        };
        if about.is_dir() {
            found.extend(written_since(start, &entry.path()));
        } else if about.len() > 0 && about.modified().is_ok_and(|when| when >= start) {
            found.push(entry.path());
        }
    }
    found
}
