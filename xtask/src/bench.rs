//! Starts the virtual bench, a host program that runs the images in `target/`.

use std::process::Command;

use crate::process::{Result, host_cargo, run};
use crate::programs::{self, Selection};
use crate::steps::Tests;
use crate::version::{Version, host_rustc};

/// Rust version that the manifest of the emulator requires. It builds and runs with older versions, but cargo needs a
/// flag on the command line to allow that.
const EMULATOR_REQUIRES: Version = Version(1, 98);

/// Runs one command of the bench, with options as the user typed them.
///
/// # Errors
/// It does not build, or its verdict is not a pass.
pub(crate) fn run_command(command: &str, options: &[String]) -> Result<()> {
    let mut cargo = host_cargo("run");
    // Show only the output of the program itself.
    cargo.args(["--quiet", "--package", "virtual-bench"]);
    accept_this_rust(&mut cargo);
    cargo.args(["--", command]).args(options);
    run(
        &mut cargo,
        "read the verdict above; it names the pin or the reply that was wrong",
    )
}

/// Measures the computing time of the paper's models on this computer.
///
/// # Errors
/// It does not build.
pub(crate) fn models() -> Result<()> {
    let mut cargo = host_cargo("run");
    cargo.args(["--quiet", "--release", "--package", "locomotion"]);
    run(
        cargo.args(["--example", "cost"]),
        "fix what the compiler reports above",
    )
}

/// Tests the images: every test of the bench.
pub(crate) fn test() -> Tests {
    let mut cargo = host_cargo("test");
    cargo.args(["--package", "virtual-bench"]);
    accept_this_rust(&mut cargo);
    programs::test(Selection {
        cargo,
        examples: false,
        // One at a time: a bench uses all cores it can get.
        lanes: 1,
    })
}

/// Adds `--ignore-rust-version` if the Rust in use is older than the emulator requires.
pub(crate) fn accept_this_rust(cargo: &mut Command) {
    if Version::of(&mut host_rustc()).is_none_or(|version| version < EMULATOR_REQUIRES) {
        cargo.arg("--ignore-rust-version");
    }
}
