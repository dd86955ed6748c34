//! Coverage-guided fuzzing: cargo-fuzz runs the targets of `fuzz/` under libFuzzer and looks for inputs that make
//! them panic.

use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::{env, fs};

use crate::process::{Failure, Result, host_cargo, installed, root};

/// The targets, files of `fuzz/src`.
const TARGETS: [&str; 9] = [
    "stream",
    "bodies",
    "host",
    "sidedoor",
    "http",
    "records",
    "documents",
    "folders",
    "together",
];

/// Longest input, bytes; must equal `MAX_LEN` in `fuzz/src/lib.rs`.
const MAX_LEN: u32 = 256;

/// Default number of runs of each target.
const RUNS: u64 = 1_000_000;

/// Seed of libFuzzer: fixed, so that the same code and corpus give the same inputs.
const SEED: u32 = 20_261_123;

/// A target fails at the first input that takes longer, s.
const TOO_LONG_S: u32 = 20;

/// Fuzzes the target named by the first argument, or all of [`TARGETS`]; the second argument is the number of runs.
///
/// # Errors
/// No cargo-fuzz, no such target or number, a build that fails, or a finding.
pub(crate) fn run(arguments: &[String]) -> Result<()> {
    let (targets, runs) = chosen(arguments)?;
    if !installed("fuzz") {
        return Err(Failure::new(
            "cargo-fuzz is not installed",
            "`cargo install cargo-fuzz --locked`, and a C++ compiler for libFuzzer (Debian: `apt install g++`); \
             stable Rust does, for nothing is built with a sanitizer",
        ));
    }
    let mut rows = Vec::new();
    for target in targets {
        rows.push((target, fuzz(target, runs)?));
    }
    println!("\nseed {SEED}, inputs of {MAX_LEN} bytes at most");
    println!("target          runs   edges  inputs kept  runs/s  found");
    for (target, tried) in &rows {
        println!("{target:<10} {tried}");
    }
    let found: Vec<_> = rows.iter().filter(|(_, tried)| tried.found).collect();
    let Some((target, _)) = found.first() else {
        return Ok(());
    };
    Err(Failure::new(
        format!("{} of {} targets found something", found.len(), rows.len()),
        format!(
            "the input is in target/fuzz/found: copy it to fuzz/corpus/{target}/found-NAME, see \
             `cargo test -p fuzz --test bounded` fail, and mend what it shows"
        ),
    ))
}

/// Targets and number of runs according to the command line.
fn chosen(arguments: &[String]) -> Result<(Vec<&'static str>, u64)> {
    let (name, runs) = match arguments {
        [] => (None, None),
        [one] if one.parse::<u64>().is_ok() => (None, Some(one)),
        [name] => (Some(name), None),
        [name, runs] => (Some(name), Some(runs)),
        _ => {
            let what = format!("too many arguments: {}", arguments.join(" "));
            return Err(Failure::new(what, "`cargo xtask fuzz [TARGET] [RUNS]`"));
        }
    };
    let targets = match name {
        None => TARGETS.to_vec(),
        Some(name) => {
            let found = TARGETS.into_iter().find(|target| target == name);
            let target = found.ok_or_else(|| {
                let what = format!("there is no target `{name}`");
                Failure::new(what, format!("the targets are {}", TARGETS.join(", ")))
            })?;
            vec![target]
        }
    };
    let runs = match runs {
        None => RUNS,
        Some(text) => text.parse().ok().filter(|runs| *runs > 0).ok_or_else(|| {
            let what = format!("`{text}` is no number of runs");
            Failure::new(what, "a whole number from 1, such as 10000000")
        })?,
    };
    Ok((targets, runs))
}

/// The cargo-fuzz command with the options common to all targets.
///
/// No sanitizer: our code has no `unsafe`, and the compiler's checks find overflows. No tracing of comparisons, which
/// takes half of the time: scripts contain few numbers that it could learn.
fn cargo_fuzz() -> Command {
    let mut cargo = host_cargo("fuzz");
    cargo.args(["run", "--fuzz-dir", "fuzz/libfuzzer"]);
    cargo.args(["--target-dir", "target/fuzz"]);
    cargo.args(["--sanitizer", "none", "--no-trace-compares"]);
    cargo
}

/// Makes the folder for the targets' files, in memory where the system has a place for that: `folders` writes and syncs
/// several files in a run, and a disk made it three times slower.
fn scratch() -> io::Result<PathBuf> {
    let memory = Path::new("/dev/shm");
    let place = match memory.is_dir() {
        true => memory.to_owned(),
        false => env::temp_dir(),
    };
    let scratch = place.join(format!("retrograde-fuzz-{}", std::process::id()));
    fs::create_dir_all(&scratch)?;
    Ok(scratch)
}

fn fuzz(target: &str, runs: u64) -> Result<Tried> {
    let remedy = "see what cargo-fuzz says above; does `cargo test -p fuzz` pass?";
    let failure = |error: io::Error| {
        let what = format!("{target} cannot be fuzzed: {error}");
        Failure::new(what, remedy)
    };
    let kept = root().join("target/fuzz/corpus").join(target);
    let found = root().join("target/fuzz/found");
    for folder in [&kept, &found] {
        fs::create_dir_all(folder).map_err(failure)?;
    }
    let scratch = scratch().map_err(failure)?;
    let mut cargo = cargo_fuzz();
    cargo.env("TMPDIR", &scratch);
    cargo.arg(target).arg(&kept);
    cargo.arg(root().join("fuzz/corpus").join(target));
    cargo.arg("--").args([
        format!("-runs={runs}"),
        format!("-seed={SEED}"),
        format!("-max_len={MAX_LEN}"),
        format!("-timeout={TOO_LONG_S}"),
        // Entropic scheduling takes more time than the larger targets themselves.
        "-entropic=0".to_owned(),
        // Stay ten times longer with short inputs than by default: they are cheaper, and longer ones grow from them.
        "-len_control=1000".to_owned(),
        // No reload: no other process writes to the corpus folder.
        "-reload=0".to_owned(),
        format!("-artifact_prefix={}/{target}-", found.display()),
        "-print_final_stats=1".to_owned(),
    ]);
    println!("\n{target}: {runs} runs");
    let mut child = cargo.stderr(Stdio::piped()).spawn().map_err(failure)?;
    let mut tried = Tried::default();
    if let Some(said) = child.stderr.take() {
        for line in BufReader::new(said).split(b'\n') {
            let line = line.map_err(failure)?;
            let line = String::from_utf8_lossy(&line);
            tried.read(&line);
            if is_for_people(&line) {
                println!("{line}");
            }
        }
    }
    let status = child.wait().map_err(failure)?;
    fs::remove_dir_all(&scratch).map_err(failure)?;
    if !status.success() && !tried.found {
        let what = format!("cargo-fuzz on {target} ended with {status}");
        return Err(Failure::new(what, remedy));
    }
    Ok(tried)
}

/// Whether a line is of interest to people: not one of the thousands of new inputs, nor libFuzzer's own messages.
fn is_for_people(line: &str) -> bool {
    let of_inputs = line.starts_with('#') && !line.contains("pulse");
    let of_itself = ["NEW_FUNC", "INFO:", "stat::", "\"", "#####", "NOTE:"];
    let text = line.trim_start();
    !of_inputs && !of_itself.iter().any(|begin| text.starts_with(begin))
}

/// Results that libFuzzer reports for a target.
#[derive(Debug, Default, PartialEq, Eq)]
struct Tried {
    runs: u64,
    /// Edges of the control flow that some input has reached.
    edges: u64,
    /// Inputs that reach something that no other input does.
    kept: u64,
    runs_per_s: u64,
    found: bool,
}

impl Tried {
    /// Reads a line of libFuzzer's output.
    fn read(&mut self, line: &str) {
        let after = |name: &str| {
            let (_, rest) = line.split_once(name)?;
            let digits = rest.trim_start();
            let end = digits.find(|char: char| !char.is_ascii_digit());
            digits[..end.unwrap_or(digits.len())].parse::<u64>().ok()
        };
        if line.starts_with('#') {
            self.edges = after(" cov:").unwrap_or(self.edges);
            self.kept = after(" corp:").unwrap_or(self.kept);
        }
        self.runs = after("stat::number_of_executed_units:").unwrap_or(self.runs);
        self.runs_per_s = after("stat::average_exec_per_sec:").unwrap_or(self.runs_per_s);
        self.found |= line.contains("ERROR: libFuzzer");
    }
}

impl std::fmt::Display for Tried {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let found = if self.found { "yes" } else { "no" };
        write!(
            out,
            "{:>9} {:>7} {:>12} {:>7}  {found}",
            self.runs, self.edges, self.kept, self.runs_per_s
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arguments(words: &[&str]) -> Vec<String> {
        words.iter().map(|word| (*word).to_owned()).collect()
    }

    #[test]
    fn target_and_runs_are_chosen_and_nothing_else_is_taken() {
        let all = |words: &[&str]| chosen(&arguments(words)).map_err(|failure| failure.to_string());
        assert_eq!(all(&[]), Ok((TARGETS.to_vec(), RUNS)));
        assert_eq!(all(&["http"]), Ok((vec!["http"], RUNS)));
        assert_eq!(all(&["5"]), Ok((TARGETS.to_vec(), 5)));
        assert_eq!(all(&["http", "5"]), Ok((vec!["http"], 5)));
        for (words, says) in [
            (&["htpp"][..], "the targets are stream, bodies"),
            (&["http", "many"], "`many` is no number"),
            (&["http", "0"], "`0` is no number"),
            (&["http", "1", "2"], "too many arguments"),
        ] {
            let said = all(words).unwrap_err();
            assert!(said.contains(says), "{said}");
        }
    }

    #[test]
    fn the_lines_of_libfuzzer_are_read() {
        let mut tried = Tried::default();
        for line in [
            "#8192\tpulse  cov: 900 ft: 3347 corp: 696/62Kb lim: 208 exec/s: 2385 rss: 29Mb",
            "#9000\tNEW    cov: 1200 ft: 3347 corp: 700/62Kb lim: 208 exec/s: 2385 rss: 29Mb",
            "stat::number_of_executed_units: 10000",
            "stat::average_exec_per_sec:     3819",
        ] {
            tried.read(line);
        }
        let expected = Tried {
            runs: 10_000,
            edges: 1_200,
            kept: 700,
            runs_per_s: 3_819,
            found: false,
        };
        assert_eq!(tried, expected);
        tried.read("==30496== ERROR: libFuzzer: deadly signal");
        assert!(tried.found && tried.to_string().ends_with("yes"));
    }

    /// The targets here equal those of the crate, of libFuzzer's entry points, and of the corpus.
    #[test]
    fn every_target_is_there() {
        let fuzz = root().join("fuzz");
        let text = fs::read_to_string(fuzz.join("src/lib.rs")).unwrap();
        assert!(text.contains(&format!("pub const MAX_LEN: usize = {MAX_LEN};")));
        let targets = format!("pub const TARGETS: [&str; {}]", TARGETS.len());
        assert!(text.contains(&targets));
        let entries = fs::read_dir(fuzz.join("libfuzzer/fuzz_targets")).unwrap();
        assert_eq!(entries.count(), TARGETS.len());
        for target in TARGETS {
            assert!(text.contains(&format!("    \"{target}\",\n")));
            assert!(fuzz.join("corpus").join(target).is_dir());
            let entry = fuzz.join("libfuzzer/fuzz_targets").join(target);
            assert!(entry.with_extension("rs").is_file());
        }
    }
}
