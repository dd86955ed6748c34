//! Starts the virtual bench: a host program that runs the images of `target/`.

use std::process::Command;

use crate::process::{Result, host_cargo, run};
use crate::version::{Version, host_rustc};

/// The Rust its emulator asks for. It builds and runs on older ones, which its own manifest rules
/// out; nothing but the flag on the command line lifts that.
const EMULATOR_ASKS_FOR: Version = Version(1, 98);

/// Runs one command of the bench, with options as the user typed them.
///
/// # Errors
/// It does not build, or its verdict is not a pass.
pub(crate) fn run_command(command: &str, options: &[String]) -> Result<()> {
    let mut cargo = host_cargo("run");
    // Only the program's own output is of interest here.
    cargo.args(["--quiet", "--release", "--package", "virtual-bench"]);
    accept_this_rust(&mut cargo);
    cargo.args(["--", command]).args(options);
    run(
        &mut cargo,
        "read the verdict above; it names the pin or the reply that was wrong",
    )
}

/// Measures what the models of the paper cost on this computer.
///
/// # Errors
/// It does not build.
pub(crate) fn models() -> Result<()> {
    let mut cargo = host_cargo("run");
    cargo.args(["--quiet", "--release", "--package", "locomotion"]);
    run(
        cargo.args(["--example", "cost"]),
        "mend what the compiler reports above",
    )
}

/// Tests the images: every test of the bench, in release because the emulator is slow without.
///
/// # Errors
/// A test fails.
pub(crate) fn test() -> Result<()> {
    let mut cargo = host_cargo("test");
    cargo.args(["--release", "--package", "virtual-bench", "--no-fail-fast"]);
    accept_this_rust(&mut cargo);
    run(
        &mut cargo,
        "the failing test prints the device's own log; start there",
    )
}

/// Adds `--ignore-rust-version` where the Rust in use is older than the emulator asks for.
pub(crate) fn accept_this_rust(cargo: &mut Command) {
    if Version::of(&mut host_rustc()).is_none_or(|version| version < EMULATOR_ASKS_FOR) {
        cargo.arg("--ignore-rust-version");
    }
}
