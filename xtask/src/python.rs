//! Environments of Python below `target`: for the tests of the Python package against `retrograde serve` and the images
//! on the virtual bench, and for tools that come as wheels.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::process::{Failure, Result, root, run, target};

/// What the package's extras need: a module that shows that it is there, the packages, and what is skipped without them.
const EXTRAS: [(&str, &[&str], &str); 2] = [
    ("bluesky", &["bluesky"], "bluesky's tests"),
    (
        "emcee, arviz_stats, corner, h5netcdf, h5py",
        &[
            "emcee",
            "arviz-base",
            "arviz-stats[xarray]",
            "corner",
            "h5netcdf",
            "h5py",
        ],
        "the tests of the fit",
    ),
];

/// Runs the tests of the package, with those of its extras if they can be installed.
///
/// # Errors
/// There is no python3, or a test failed.
pub(crate) fn test() -> Result<()> {
    tests(&["-m", "unittest", "discover", "-s", "python/tests"])
}

/// Holds the records in a folder against the schema in the manual.
///
/// # Errors
/// There is none, or one does not fit.
pub(crate) fn hold(folder: &Path) -> Result<()> {
    tests(&["python/tests/test_records.py", &folder.to_string_lossy()])
}

fn tests(arguments: &[&str]) -> Result<()> {
    let python = environment("python").unwrap_or_else(|_| PathBuf::from("python3"));
    for (modules, packages, tests) in EXTRAS {
        let imports = format!("import {modules}");
        if !(quiet(Command::new(&python).args(["-c", &imports])) || installs(&python, packages)) {
            println!(
                "{} cannot be installed here: {tests} are skipped",
                packages.join(", ")
            );
        }
    }
    let mut tests = Command::new(python);
    tests.current_dir(root());
    tests.args(arguments);
    tests.env("PYTHONPATH", root().join("python/src"));
    tests.env("RETROGRADE_PROGRAMS", target().join("debug"));
    run(
        &mut tests,
        "install Python 3.9 or newer, or run the failing test alone: docs/python.md says how",
    )
}

/// Installs a program from its wheel into a separate environment.
///
/// # Errors
/// The environment cannot be created, or the wheel cannot be installed.
pub(crate) fn tool(package: &str, version: &str, program: &str) -> Result<PathBuf> {
    let python = environment(program)?;
    let path = python.with_file_name(program);
    let has = || {
        let output = Command::new(&path).arg("--version").output();
        output.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains(version))
    };
    if has() || (installs(&python, &[&format!("{package}=={version}")]) && has()) {
        return Ok(path);
    }
    Err(Failure::new(
        format!("{package} {version} cannot be installed"),
        "check whether pip reaches its index here",
    ))
}

/// The Python of the environment in `target/NAME`, created if necessary. An incomplete one, because a system package
/// was missing, is created again.
fn environment(name: &str) -> Result<PathBuf> {
    let folder = target().join(name);
    let python = folder.join("bin/python");
    let whole = quiet(Command::new(&python).args(["-m", "pip", "--version"]));
    if whole || makes(&folder) {
        return Ok(python);
    }
    Err(Failure::new(
        "Python makes no environment",
        "install python3 with its venv: Debian's packages are `python3` and `python3-venv`",
    ))
}

fn makes(folder: &Path) -> bool {
    let mut venv = Command::new("python3");
    venv.args(["-m", "venv", "--clear"]).arg(folder);
    venv.status().is_ok_and(|status| status.success())
}

fn installs(python: &Path, packages: &[&str]) -> bool {
    let mut pip = Command::new(python);
    pip.args(["-m", "pip", "install", "--quiet", "--retries", "1"])
        .args(packages);
    pip.status().is_ok_and(|status| status.success())
}

fn quiet(command: &mut Command) -> bool {
    let command = command.stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}
