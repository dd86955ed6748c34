//! Starts the virtual bench, a host program that runs the images in `target/`.

use crate::process::{Result, host_cargo, run};

/// The manifest of the emulator requires a newer Rust than the code needs; with this cargo builds it with ours.
pub(crate) const ANY_RUST: &str = "--ignore-rust-version";

const COMPILER: &str = "fix what the compiler reports above";

/// Runs one command of the bench, with options as the user typed them.
///
/// # Errors
/// It does not build, or its verdict is a failure.
pub(crate) fn run_command(command: &str, options: &[String]) -> Result<()> {
    let mut cargo = host_cargo("run");
    // Show only the output of the program itself.
    cargo.args(["--quiet", "--package", "virtual-bench", ANY_RUST]);
    cargo.args(["--", command]).args(options);
    run(
        &mut cargo,
        "read the verdict above; it names the pin or the reply that was wrong",
    )
}

/// Builds the programs that Python's tests start.
///
/// # Errors
/// They do not compile.
pub(crate) fn build() -> Result<()> {
    let mut cargo = host_cargo("build");
    cargo.args(["--package", "host-tool", "--package", "virtual-bench"]);
    run(cargo.arg(ANY_RUST), COMPILER)
}

/// Tests the images: every test of the bench.
///
/// # Errors
/// One of them failed.
pub(crate) fn test() -> Result<()> {
    let mut cargo = host_cargo("test");
    cargo.args(["--package", "virtual-bench", "--no-fail-fast", ANY_RUST]);
    run(
        &mut cargo,
        "run the failing test alone: virtual-bench/README.md says how",
    )
}
