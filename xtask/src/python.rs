//! Tests the Python package against `retrograde serve` and the images on the virtual bench.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::bench;
use crate::process::{Failure, Result, host_cargo, root, run};

/// Its tests, with bluesky's where bluesky can be had.
///
/// # Errors
/// There is no Python, a program does not build, or a test fails.
pub(crate) fn test() -> Result<()> {
    let mut cargo = host_cargo("build");
    cargo.args(["--package", "host-tool", "--package", "virtual-bench"]);
    bench::accept_this_rust(&mut cargo);
    run(&mut cargo, "fix what the compiler reports above")?;
    let target =
        std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from);
    let python = with_bluesky(&target.join("python")).unwrap_or_else(|| {
        println!("bluesky cannot be installed here: its tests are skipped");
        PathBuf::from("python3")
    });
    if !answers(&python) {
        return Err(Failure::new(
            "there is no python3",
            "install Python 3.9 or newer: Debian's package is `python3`",
        ));
    }
    let mut tests = Command::new(python);
    tests.current_dir(root());
    tests.args(["-m", "unittest", "discover", "-s", "python/tests"]);
    tests.env("PYTHONPATH", root().join("python/src"));
    tests.env("RETROGRADE_PROGRAMS", target.join("debug"));
    run(
        &mut tests,
        "run the failing test alone: python/README.md says how",
    )
}

/// A Python with bluesky below `folder`; none where it cannot be installed.
fn with_bluesky(folder: &Path) -> Option<PathBuf> {
    let python = folder.join("bin/python");
    let quiet = |command: &mut Command| {
        let ended = command.stdout(Stdio::null()).stderr(Stdio::null()).status();
        ended.is_ok_and(|status| status.success())
    };
    let has = |python: &Path| quiet(Command::new(python).args(["-c", "import bluesky"]));
    if has(&python) {
        return Some(python);
    }
    let made = quiet(Command::new("python3").args(["-m", "venv"]).arg(folder));
    let install = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--retries",
        "1",
        "bluesky",
    ];
    (made && quiet(Command::new(&python).args(install)) && has(&python)).then_some(python)
}

fn answers(python: &Path) -> bool {
    let mut version = Command::new(python);
    version.arg("--version").stdout(Stdio::null());
    version.status().is_ok_and(|status| status.success())
}
