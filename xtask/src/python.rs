//! An environment of Python below `target`, and in it the tests of the Python package, against `retrograde serve` and
//! the images on the virtual bench.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use crate::bench;
use crate::process::{Failure, Result, errors_of, host_cargo, root, run, target};
use crate::steps::{Counts, Ran, Tests};

/// Packages that some tests need: the modules, and what pip installs for them.
const WANTED: [(&str, &[&str]); 2] = [
    ("bluesky", &["bluesky"]),
    ("arviz, h5netcdf, h5py", &["arviz", "h5netcdf", "h5py"]),
];

/// Runs its tests, including those with bluesky and ArviZ where these can be installed.
pub(crate) fn test() -> Tests {
    let mut tests = match prepared() {
        Ok(tests) => tests,
        Err(failure) => return Tests::failed(failure),
    };
    let begin = Instant::now();
    let remedy = "run the failing test alone: python/README.md says how";
    let (lines, outcome) = errors_of(&mut tests, remedy);
    Tests {
        counts: counts(&lines),
        programs: vec![Ran {
            name: "python".to_owned(),
            took: begin.elapsed(),
        }],
        outcome,
    }
}

/// Reads unittest's last lines: `Ran 12 tests in 3.4s` and `FAILED (failures=1, errors=2, skipped=3)`.
fn counts(lines: &[String]) -> Counts {
    let said = |words: &[&str]| -> u32 {
        let number = |line: &String| {
            let (_, rest) = words.iter().find_map(|word| line.split_once(word))?;
            let digits = rest.split(|letter: char| !letter.is_ascii_digit()).next()?;
            digits.parse::<u32>().ok()
        };
        lines.iter().rev().take(4).filter_map(number).sum()
    };
    let failed = said(&["failures="]) + said(&["errors="]);
    let ignored = said(&["skipped="]);
    Counts {
        passed: said(&["Ran "]).saturating_sub(failed + ignored),
        failed,
        ignored,
    }
}

/// The command that runs the tests. Builds the programs first, and installs the packages if it can.
fn prepared() -> Result<Command> {
    let mut cargo = host_cargo("build");
    cargo.args(["--package", "host-tool", "--package", "virtual-bench"]);
    bench::accept_this_rust(&mut cargo);
    run(&mut cargo, "fix what the compiler reports above")?;
    let python = with_packages();
    if !quiet(Command::new(&python).arg("--version")) {
        return Err(Failure::new(
            "there is no python3",
            "install Python 3.9 or newer: Debian's package is `python3`",
        ));
    }
    let mut tests = Command::new(python);
    tests.current_dir(root());
    tests.args(["-m", "unittest", "discover", "-s", "python/tests"]);
    tests.env("PYTHONPATH", root().join("python/src"));
    tests.env("RETROGRADE_PROGRAMS", target().join("debug"));
    Ok(tests)
}

/// Python of the environment with all packages that can be installed; the system's Python if there can be no
/// environment.
fn with_packages() -> PathBuf {
    let Some(python) = environment() else {
        println!(
            "there can be no Python environment here: tests with bluesky and ArviZ are skipped"
        );
        return PathBuf::from("python3");
    };
    for (modules, packages) in WANTED {
        if !provides(&python, &format!("import {modules}"), packages) {
            println!(
                "{} cannot be installed here: its tests are skipped",
                packages[0]
            );
        }
    }
    python
}

/// The Python of the environment in `target/python`, made if need be; `None` if there can be none here.
pub(crate) fn environment() -> Option<PathBuf> {
    environment_in(&target().join("python"))
}

/// The same in this folder. An environment left half made, because a system package was missing, is made anew.
fn environment_in(folder: &Path) -> Option<PathBuf> {
    let python = folder.join("bin/python");
    let is_whole = || quiet(Command::new(&python).args(["-m", "pip", "--version"]));
    let made = || {
        succeeds(
            Command::new("python3")
                .args(["-m", "venv", "--clear"])
                .arg(folder),
        )
    };
    (is_whole() || made()).then_some(python)
}

/// Whether this Python executes a statement, if necessary after these packages were installed.
pub(crate) fn provides(python: &Path, statement: &str, packages: &[impl AsRef<OsStr>]) -> bool {
    let has = || quiet(Command::new(python).args(["-c", statement]));
    let install = ["-m", "pip", "install", "--quiet", "--retries", "1"];
    let installs = || succeeds(Command::new(python).args(install).args(packages));
    has() || (installs() && has())
}

fn quiet(command: &mut Command) -> bool {
    succeeds(command.stdout(Stdio::null()).stderr(Stdio::null()))
}

fn succeeds(command: &mut Command) -> bool {
    command.status().is_ok_and(|status| status.success())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As `python3 -m venv` leaves it where Debian's python3-venv is not installed.
    #[cfg(unix)]
    #[test]
    fn an_environment_that_was_left_half_made_is_made_anew() {
        use std::os::unix::fs::PermissionsExt;
        let folder = target().join("test-output/half-made");
        let _ = std::fs::remove_dir_all(&folder);
        let bin = folder.join("bin");
        std::fs::create_dir_all(&bin).expect("made");
        let python = bin.join("python");
        std::fs::write(&python, "#!/bin/sh\n[ \"$1\" = --version ]\n").expect("written");
        std::fs::set_permissions(&python, PermissionsExt::from_mode(0o755)).expect("set");
        assert!(quiet(Command::new(&python).arg("--version")));
        // None where there can be none.
        let made = environment_in(&folder);
        assert!(made.is_none_or(|python| quiet(Command::new(python).args(["-c", "import venv"]))));
    }

    #[test]
    fn the_words_of_unittest_are_counted() {
        let lines = |text: &str| text.lines().map(str::to_owned).collect::<Vec<_>>();
        let of = |text| {
            let counts = counts(&lines(text));
            (counts.passed, counts.failed, counts.ignored)
        };
        assert_eq!(of("..\nRan 28 tests in 61.2s\n\nOK\n"), (28, 0, 0));
        let bad = "Ran 28 tests in 61.2s\n\nFAILED (failures=1, errors=2, skipped=3)\n";
        assert_eq!(of(bad), (22, 3, 3));
        assert_eq!(of("Ran 1 test in 0.1s\n\nOK (skipped=1)\n"), (0, 0, 1));
    }
}
