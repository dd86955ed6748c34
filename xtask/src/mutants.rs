//! Mutation tests: cargo-mutants changes the code in many places, one at a time, and the tests have to notice.

use std::fs;
use std::path::Path;

use crate::process::{Failure, Result, host_cargo, installed, root, status_of};

/// The packages that decide what moves. `.cargo/mutants.toml` lists the code that is not mutated, with reasons.
const PACKAGES: [&str; 6] = [
    "protocol",
    "motion",
    "planning",
    "device",
    "firmware-rig",
    "firmware-capsule",
];

/// Files of a package that the tests of another package test: package, files, package with the tests.
const TESTED_ELSEWHERE: [(&str, &[&str], &str); 1] = [(
    "motion",
    // Their input is the rig's periods.
    &["motion/src/edge_timing.rs", "motion/src/timeline.rs"],
    "firmware-rig",
)];

/// Least share of the mutants that the tests of a package have to notice, percent.
const GOAL_PERCENT: usize = 95;

/// Exit codes of cargo-mutants for a complete run: all caught, some missed, some timed out.
const COMPLETE: [i32; 3] = [0, 2, 3];

/// Mutates the package that is the first argument, or all of [`PACKAGES`], and prints how many mutants its tests
/// notice. Further arguments go to cargo-mutants.
///
/// # Errors
/// No cargo-mutants, an incomplete run, nothing to change, or a package below [`GOAL_PERCENT`].
pub(crate) fn run(arguments: &[String]) -> Result<()> {
    if !installed("mutants") {
        return Err(Failure::new(
            "cargo-mutants is not installed",
            "`cargo install cargo-mutants --locked`",
        ));
    }
    let (packages, options) = match arguments.split_first() {
        Some((package, options)) => (vec![package.as_str()], options),
        None => (PACKAGES.to_vec(), &[][..]),
    };
    let mut counts = Vec::new();
    for package in packages {
        counts.push((package, mutate(package, options)?));
    }
    println!("\npackage            caught  timed out  missed  not built  noticed");
    let mut low = Vec::new();
    for (package, count) in &counts {
        println!("{package:<18} {count}");
        if !count.reaches(GOAL_PERCENT) {
            low.push(*package);
        }
    }
    if low.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        format!(
            "less than {GOAL_PERCENT} % noticed in {}",
            low.join(" and in ")
        ),
        "write tests for the mutants in target/mutants/PACKAGE/mutants.out/missed.txt, or name those that \
         change nothing, with the reason, in .cargo/mutants.toml",
    ))
}

/// Runs cargo-mutants on one package, and once more on those of its files that another package tests.
fn mutate(package: &str, options: &[String]) -> Result<Count> {
    let elsewhere = TESTED_ELSEWHERE
        .iter()
        .find(|(of, ..)| *of == package)
        // If the user names files, only those are meant.
        .filter(|_| !options.iter().any(|option| option.starts_with("--file")));
    let Some((_, files, tests)) = elsewhere else {
        return run_once(package, package, options);
    };
    let arguments = |name: &str| -> Vec<String> {
        let named = files.iter().flat_map(|file| [name, file]);
        named.map(str::to_owned).chain(options.to_vec()).collect()
    };
    let here = run_once(package, package, &arguments("--exclude"))?;
    let mut with_tests = arguments("--file");
    with_tests.extend(["--test-package".to_owned(), (*tests).to_owned()]);
    let there = run_once(package, &format!("{package}-by-{tests}"), &with_tests)?;
    Ok(here.plus(&there))
}

/// Runs cargo-mutants with its results in `target/mutants/FOLDER`.
fn run_once(package: &str, folder: &str, options: &[String]) -> Result<Count> {
    let remedy = "see what cargo-mutants says above; do the tests of this package pass unchanged?";
    let folder = root().join("target/mutants").join(folder);
    let unusable = |error: std::io::Error| {
        let what = format!("{} cannot be used: {error}", folder.display());
        Failure::new(what, remedy)
    };
    // Remove the results of an earlier run, so that they are not counted again.
    if folder.exists() {
        fs::remove_dir_all(&folder).map_err(unusable)?;
    }
    fs::create_dir_all(&folder).map_err(unusable)?;
    let mut cargo = host_cargo("mutants");
    cargo.args(["--package", package, "--output"]).arg(&folder);
    let status = status_of(cargo.args(options), remedy)?;
    if !status.code().is_some_and(|code| COMPLETE.contains(&code)) {
        let what = format!("cargo-mutants on {package} ended with {status}");
        return Err(Failure::new(what, remedy));
    }
    let count = Count::read(&folder.join("mutants.out")).map_err(unusable)?;
    if count == Count::default() {
        let what = format!("cargo-mutants found nothing to change in {package}");
        return Err(Failure::new(
            what,
            "is there a package of this name? `cargo mutants --package PACKAGE --list` lists the changes",
        ));
    }
    Ok(count)
}

/// Numbers of mutants of one package.
#[derive(Debug, Default, PartialEq, Eq)]
struct Count {
    /// A test failed.
    caught: usize,
    /// The tests did not end in time: also noticed.
    timed_out: usize,
    /// All tests passed.
    missed: usize,
    /// Did not compile: not counted.
    not_built: usize,
}

impl Count {
    /// Counts the lines of the lists that cargo-mutants writes.
    fn read(folder: &Path) -> std::io::Result<Self> {
        let lines =
            |name: &str| fs::read_to_string(folder.join(name)).map(|list| list.lines().count());
        Ok(Self {
            caught: lines("caught.txt")?,
            timed_out: lines("timeout.txt")?,
            missed: lines("missed.txt")?,
            not_built: lines("unviable.txt")?,
        })
    }

    fn plus(&self, other: &Self) -> Self {
        Self {
            caught: self.caught + other.caught,
            timed_out: self.timed_out + other.timed_out,
            missed: self.missed + other.missed,
            not_built: self.not_built + other.not_built,
        }
    }

    fn noticed(&self) -> usize {
        self.caught + self.timed_out
    }

    fn reaches(&self, percent: usize) -> bool {
        self.noticed() * 100 >= (self.noticed() + self.missed) * percent
    }
}

impl std::fmt::Display for Count {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            caught,
            timed_out,
            missed,
            not_built,
        } = self;
        write!(
            out,
            "{caught:>6} {timed_out:>10} {missed:>7} {not_built:>10}"
        )?;
        match self.noticed() + missed {
            0 => write!(out, "        -"),
            all => write!(out, "{:>7.1} %", self.noticed() as f64 * 100.0 / all as f64),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(caught: usize, timed_out: usize, missed: usize) -> Count {
        Count {
            caught,
            timed_out,
            missed,
            not_built: 7,
        }
    }

    #[test]
    fn the_goal_counts_what_was_noticed_of_what_was_built() {
        assert!(count(95, 0, 5).reaches(95));
        assert!(count(90, 5, 5).reaches(95));
        assert!(!count(94, 0, 5).reaches(95));
        assert!(!count(0, 0, 1).reaches(95));
        assert_eq!(count(3, 2, 1).plus(&count(10, 20, 30)).noticed(), 35);
        assert!(!count(95, 0, 5).plus(&count(0, 0, 1)).reaches(95));
    }

    #[test]
    fn a_row_shows_every_number() {
        let row = count(90, 5, 5).to_string();
        let words: Vec<&str> = row.split_whitespace().collect();
        assert_eq!(words, ["90", "5", "5", "7", "95.0", "%"]);
        assert!(count(0, 0, 0).to_string().ends_with(" -"));
    }

    #[test]
    fn the_lists_of_a_run_are_counted_and_must_all_be_there() {
        let folder =
            std::env::temp_dir().join(format!("retrograde-mutants-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        for (name, lines) in [("caught", "a\nb\nc\n"), ("timeout", ""), ("missed", "d\n")] {
            fs::write(folder.join(name).with_extension("txt"), lines).unwrap();
        }
        assert!(Count::read(&folder).is_err());
        fs::write(folder.join("unviable.txt"), "e\nf\n").unwrap();
        let read = Count::read(&folder).unwrap();
        fs::remove_dir_all(&folder).unwrap();
        let expected = Count {
            caught: 3,
            timed_out: 0,
            missed: 1,
            not_built: 2,
        };
        assert_eq!(read, expected);
    }
}
