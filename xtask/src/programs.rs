//! Runs test programs side by side. `cargo test` runs them one after the other, which leaves cores idle: many wait
//! for one long test, some for a clock.
//!
//! Cargo builds them and reports their paths. Each then runs as under cargo, in the folder of its package. Its output
//! goes to a file, which is printed if it fails.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use crate::process::{Failure, Result, host_cargo, lines_of, root, target};
use crate::steps::{Clock, Counts, Ran, Tests};

/// Package and name of the slowest programs, longest first: they start early, so that none is left at the end. The
/// order of the others does not matter.
const LONG: [(&str, &str); 13] = [
    ("host-tool", "models"),
    ("calibration", "verdict"),
    ("firmware-rig", "all"),
    ("firmware-capsule", "all"),
    ("calibration", "recovery"),
    ("calibration", "strokes"),
    ("calibration", "simulation_based"),
    ("host-tool", "commands"),
    ("calibration", "closed_loop"),
    ("host-tool", "campaigns"),
    ("locomotion", "all"),
    ("calibration", "closed_forms"),
    ("fuzz", "bounded"),
];

/// Programs that also run what plain `cargo test` leaves out: the slice of a long series.
const SLICES: [(&str, &str); 3] = [
    ("firmware-rig", "all"),
    ("firmware-capsule", "all"),
    ("protocol", "all"),
];

/// Programs that wait for a line in real time and compute little, longest first. One at a time runs beside those that
/// compute, and before them: a tool that gets no processor for seconds misses the deadlines of its line, rightly.
const WAITING: [(&str, &str); 5] = [
    ("host-tool", "faults"),
    ("host-tool", "lines"),
    ("host-tool", "terminals"),
    ("host-tool", "server"),
    ("host-tool", "signals"),
];

/// Programs that compute for the most part, with some tests that wait in real time.
const PARTLY_WAITING: [(&str, &str); 2] = [("host-tool", "commands"), ("host-tool", "campaigns")];

/// Number of waiting programs that run at a time.
const WAITING_LANES: usize = 1;

/// How much a computing program gives way to the others, in steps of `nice`: 5 leave it a quarter of a contested core.
const GIVES_WAY: &str = "5";

/// Interval of the message about what is still running.
const STILL: Duration = Duration::from_secs(60);

/// The programs to run, and how.
pub(crate) struct Selection {
    /// `cargo test` with packages and targets; without these, the default packages.
    pub(crate) cargo: Command,
    /// Whether the examples in the documentation run too.
    pub(crate) examples: bool,
    /// Number of computing programs that run at a time.
    pub(crate) lanes: usize,
}

/// Number of cores: one program for each.
pub(crate) fn cores() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Job {
    Program(Program),
    /// The examples in the documentation of the default packages.
    Examples,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Program {
    package: String,
    /// Name of the target. The names of a library and its package differ in `-` and `_` only.
    name: String,
    /// `lib`, `bin`, `test` or `example`.
    kind: String,
    manifest: PathBuf,
    executable: PathBuf,
    /// Arguments for it, as after `--`.
    arguments: Vec<String>,
}

impl Job {
    fn place_in(&self, list: &[(&str, &str)]) -> Option<usize> {
        let Self::Program(program) = self else {
            return None;
        };
        list.iter()
            .position(|(package, name)| program.package == *package && program.name == *name)
    }

    /// Name in the output: `calibration recovery`, `host-tool lib`.
    fn shown(&self) -> String {
        match self {
            Self::Program(Program {
                package,
                name,
                kind,
                ..
            }) => match kind.as_str() {
                "test" => format!("{package} {name}"),
                "lib" => format!("{package} lib"),
                kind => format!("{package} {kind} {name}"),
            },
            Self::Examples => "examples in the documentation".to_owned(),
        }
    }

    /// The command that runs one of its tests alone.
    fn alone(&self) -> String {
        let Self::Program(program) = self else {
            return "cargo test --doc NAME".to_owned();
        };
        let Program { package, name, .. } = program;
        let target = match program.kind.as_str() {
            "lib" => "--lib".to_owned(),
            kind => format!("--{kind} {name}"),
        };
        // The emulator may ask for a newer Rust than the rest.
        let rust = match package == "virtual-bench" {
            true => " --ignore-rust-version",
            false => "",
        };
        let mut words = vec![format!("cargo test -p {package}{rust} {target} NAME")];
        if !program.arguments.is_empty() {
            words.push("--".to_owned());
            words.extend_from_slice(&program.arguments);
        }
        words.join(" ")
    }

    fn command(&self) -> Command {
        match self {
            Self::Program(program) => {
                let folder = program.manifest.parent().unwrap_or(Path::new("."));
                // The environment already has the settings of `.cargo/config.toml`, among them the seed of the random
                // tests.
                let mut command = if cfg!(unix) && self.place_in(&WAITING).is_none() {
                    let mut nice = Command::new("nice");
                    nice.args(["-n", GIVES_WAY]).arg(&program.executable);
                    nice
                } else {
                    Command::new(&program.executable)
                };
                command.args(&program.arguments).current_dir(folder);
                command.env("CARGO_MANIFEST_DIR", folder);
                command.env("CARGO_PKG_NAME", &program.package);
                command
            }
            Self::Examples => {
                let mut cargo = host_cargo("test");
                cargo.args(["--doc", "--no-fail-fast"]);
                cargo
            }
        }
    }
}

/// A job that has ended.
struct Ended {
    job: Job,
    counts: Counts,
    /// Why it failed, in a word; none if it passed.
    wrong: Option<String>,
    took: Duration,
    output: String,
}

impl Ended {
    /// Takes over how its failed tests have ended alone.
    fn take(&mut self, alone: Self) {
        self.took += alone.took;
        self.counts.passed += alone.counts.passed;
        self.counts.failed = alone.counts.failed;
        self.wrong = alone.wrong;
    }
}

/// Builds the chosen programs and runs all of them, even after a failure. Those that wait in real time may fail once for
/// lack of processor time.
pub(crate) fn test(selection: Selection) -> Tests {
    let Selection {
        cargo,
        examples,
        lanes,
    } = selection;
    let begin = Instant::now();
    let mut jobs = match build(cargo) {
        Ok(programs) => programs,
        Err(failure) => return Tests::failed(failure),
    };
    println!("built in {}", Clock(begin.elapsed()));
    if examples {
        jobs.push(Job::Examples);
    }
    let folder = target().join("test-output");
    if let Err(error) = fs::create_dir_all(&folder) {
        let what = format!("{} cannot be made: {error}", folder.display());
        return Tests::failed(Failure::new(what, "make room, or set CARGO_TARGET_DIR"));
    }
    let begin = Instant::now();
    let mut ended = run_all(jobs, &folder, lanes);
    for one in &mut ended {
        if let Some(job) = to_repeat(one) {
            println!("{} once more, with nothing beside it", job.shown());
            let alone = carry_out(job, &folder);
            report(&alone, 1, 1);
            one.take(alone);
        }
    }
    let mut tests = Tests::default();
    for one in &ended {
        tests.counts.add(&one.counts);
        tests.programs.push(Ran {
            name: one.job.shown(),
            took: one.took,
        });
    }
    println!(
        "{} programs in {}: {}",
        ended.len(),
        Clock(begin.elapsed()),
        tests.counts
    );
    let failed: Vec<_> = ended.iter().filter(|one| one.wrong.is_some()).collect();
    if let Some(first) = failed.first() {
        let names: Vec<_> = failed.iter().map(|one| one.job.shown()).collect();
        tests.outcome = Err(Failure::new(
            format!(
                "{} of {} programs failed: {}",
                failed.len(),
                ended.len(),
                names.join(", ")
            ),
            format!("run the failing test alone: `{}`", first.job.alone()),
        ));
    }
    tests
}

/// The failed tests of a program that waits in real time, to be run alone: other work may have kept its tools from the
/// processor for too long. None of a program that only computes, and of one that died before it could name them.
fn to_repeat(ended: &Ended) -> Option<Job> {
    let Job::Program(program) = &ended.job else {
        return None;
    };
    let waits = [&WAITING[..], &PARTLY_WAITING].concat();
    if ended.wrong.is_none() || ended.job.place_in(&waits).is_none() {
        return None;
    }
    let failed: Vec<_> = failed_tests(&ended.output).map(str::to_owned).collect();
    if failed.is_empty() {
        return None;
    }
    let mut alone = program.clone();
    alone.arguments.push("--exact".to_owned());
    alone.arguments.extend(failed);
    Some(Job::Program(alone))
}

/// Names of the failed tests, from lines such as `test door::a_guest_waits ... FAILED`.
fn failed_tests(output: &str) -> impl Iterator<Item = &str> {
    let lines = output.lines();
    lines.filter_map(|line| line.strip_prefix("test ")?.strip_suffix(" ... FAILED"))
}

fn run_all(jobs: Vec<Job>, folder: &Path, lanes: usize) -> Vec<Ended> {
    let (mut waiting, mut computing): (Vec<_>, Vec<_>) = jobs
        .into_iter()
        .partition(|job| lanes > 1 && job.place_in(&WAITING).is_some());
    // A stable sort: programs that are not listed keep their order.
    computing.sort_by_key(|job| job.place_in(&LONG).unwrap_or(LONG.len()));
    waiting.sort_by_key(|job| job.place_in(&WAITING));
    let count = waiting.len() + computing.len();
    let queues = [
        (Mutex::new(VecDeque::from(computing)), lanes),
        (Mutex::new(VecDeque::from(waiting)), WAITING_LANES),
    ];
    let running = Mutex::new(BTreeMap::new());
    let (sender, receiver) = mpsc::channel::<Ended>();
    thread::scope(|scope| {
        for (queue, lanes) in &queues {
            for _ in 0..*lanes {
                let (sender, running) = (sender.clone(), &running);
                scope.spawn(move || {
                    while let Some(job) = { lock(queue).pop_front() } {
                        let shown = job.shown();
                        lock(running).insert(shown.clone(), Instant::now());
                        let ended = carry_out(job, folder);
                        lock(running).remove(&shown);
                        // Fails only if this program ends, and then the result is not needed.
                        let _ = sender.send(ended);
                    }
                });
            }
        }
        drop(sender);
        let mut ended: Vec<Ended> = Vec::with_capacity(count);
        loop {
            match receiver.recv_timeout(STILL) {
                Ok(one) => {
                    report(&one, ended.len() + 1, count);
                    ended.push(one);
                }
                Err(mpsc::RecvTimeoutError::Timeout) => {
                    let still = lock(&running);
                    let still = still
                        .iter()
                        .map(|(shown, since)| format!("{shown} ({})", Clock(since.elapsed())));
                    println!("still running: {}", still.collect::<Vec<_>>().join(", "));
                }
                Err(mpsc::RecvTimeoutError::Disconnected) => return ended,
            }
        }
    })
}

/// Ignores poisoning: a panic of another thread leaves queue and list intact.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn report(ended: &Ended, number: usize, of: usize) {
    let shown = ended.job.shown();
    let took = Clock(ended.took);
    match &ended.wrong {
        None => println!("({number}/{of}) {shown}: {}, {took}", ended.counts),
        Some(wrong) => println!(
            "{}\n({number}/{of}) {shown}: FAILED: {wrong}, {took}; all that it said is above",
            ended.output
        ),
    }
}

fn carry_out(job: Job, folder: &Path) -> Ended {
    let begin = Instant::now();
    // Use a file, not a pipe: a child process left behind by a test would hold a pipe open.
    let file = folder.join(format!("{}.txt", job.shown().replace(' ', "-")));
    let mut command = job.command();
    let status = File::create(&file).and_then(|output| {
        command.stdin(Stdio::null());
        command.stdout(output.try_clone()?).stderr(output);
        command.status()
    });
    let took = begin.elapsed();
    let output = fs::read(&file).unwrap_or_default();
    let output = String::from_utf8_lossy(&output).into_owned();
    let mut counts = counts(&output);
    let wrong = match status {
        Ok(status) if status.success() && !output.contains("test result: ") => {
            Some("it ended without a word on its tests".to_owned())
        }
        Ok(status) if status.success() => None,
        Ok(status) => Some(status.to_string()),
        Err(error) => Some(format!("it does not start: {error}")),
    };
    if wrong.is_some() && counts.failed == 0 {
        // It ended before it could report what failed.
        counts.failed = 1;
    }
    Ended {
        job,
        counts,
        wrong,
        took,
        output,
    }
}

/// Counts from the last lines of a program: `test result: ok. 12 passed; 0 failed; 1 ignored; ...`.
fn counts(output: &str) -> Counts {
    let mut sum = Counts::default();
    for line in output.lines() {
        let Some(result) = line.strip_prefix("test result: ") else {
            continue;
        };
        let result = result.split_once(". ").map_or(result, |(_, rest)| rest);
        let of = |what: &str| {
            let mut parts = result.split("; ");
            let number = parts.find_map(|part| part.strip_suffix(what)?.trim().parse().ok());
            number.unwrap_or(0)
        };
        sum.add(&Counts {
            passed: of(" passed"),
            failed: of(" failed"),
            ignored: of(" ignored"),
        });
    }
    sum
}

/// Builds test programs and finds their paths.
fn build(mut cargo: Command) -> Result<Vec<Job>> {
    cargo.args(["--no-run", "--message-format=json-render-diagnostics"]);
    let lines = lines_of(&mut cargo, "fix what the compiler reports above")?;
    let programs: Vec<_> = lines.iter().filter_map(|line| program(line)).collect();
    match programs.is_empty() {
        true => Err(Failure::new(
            "cargo has named no test program",
            "`cargo test --no-run` should list them; is this cargo much older or newer?",
        )),
        false => Ok(programs),
    }
}

/// The test program that a message of cargo reports.
fn program(message: &str) -> Option<Job> {
    if !message.contains(r#""reason":"compiler-artifact""#)
        || !message.contains(r#""test":true},"features""#)
    {
        return None;
    }
    let executable = text(message, r#""executable":"#)?;
    let manifest = PathBuf::from(text(message, r#""manifest_path":"#)?);
    let (_, target) = message.split_once(r#""target":{"#)?;
    let kind = text(target, r#""kind":["#)?;
    let folder = manifest.parent()?;
    // A package of ours has the name of its folder, even a nested one.
    let package = folder.strip_prefix(root()).ok()?.file_name()?;
    let (package, name) = (package.to_str()?, text(target, r#""name":"#)?);
    let has_slice = SLICES.contains(&(package, &name));
    Some(Job::Program(Program {
        package: package.to_owned(),
        name,
        kind,
        executable: PathBuf::from(executable),
        manifest,
        arguments: has_slice
            .then(|| "--include-ignored".to_owned())
            .into_iter()
            .collect(),
    }))
}

/// The JSON string right after the first `key`. A full JSON parser would have to be compiled before anything else.
fn text(json: &str, key: &str) -> Option<String> {
    let (_, rest) = json.split_once(key)?;
    let mut letters = rest.strip_prefix('"')?.chars();
    let mut text = String::new();
    loop {
        match letters.next()? {
            '"' => return Some(text),
            '\\' => match letters.next()? {
                letter @ ('"' | '\\' | '/') => text.push(letter),
                // A source path has no control characters.
                _ => return None,
            },
            letter => text.push(letter),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(profile: &str, executable: &str) -> String {
        let manifest = root().join("models/calibration/Cargo.toml");
        format!(
            r#"{{"reason":"compiler-artifact","package_id":"x","manifest_path":"{}","target":{{"kind":["test"],"crate_types":["bin"],"name":"recovery","src_path":"/a","edition":"2024","doc":false,"doctest":false,"test":true}},"profile":{{"opt_level":"3","debuginfo":1,"debug_assertions":true,"overflow_checks":true,{profile}}},"features":[],"filenames":["/t"],"executable":{executable},"fresh":true}}"#,
            manifest.display()
        )
    }

    #[test]
    fn a_message_of_cargo_names_a_program() {
        let job = program(&message(r#""test":true"#, r#""/a \"b\"/t""#)).expect("a program");
        assert_eq!(job.shown(), "calibration recovery");
        assert_eq!(
            job.alone(),
            "cargo test -p calibration --test recovery NAME"
        );
        let Job::Program(found) = &job else {
            panic!("{job:?}")
        };
        assert_eq!(found.executable, Path::new(r#"/a "b"/t"#));
        assert_eq!(found.manifest, root().join("models/calibration/Cargo.toml"));
        assert!(found.arguments.is_empty());
        assert_eq!(job.place_in(&[("motion", "recovery")]), None);
        assert_eq!(
            job.place_in(&[("motion", "x"), ("calibration", "recovery")]),
            Some(1)
        );
        // Libraries that a test links with, and targets that are not built for tests.
        assert_eq!(program(&message(r#""test":true"#, "null")), None);
        assert_eq!(program(&message(r#""test":false"#, r#""/t""#)), None);
        assert_eq!(
            program(r#"{"reason":"build-finished","success":true}"#),
            None
        );
    }

    #[test]
    fn results_are_summed() {
        let output = "\nrunning 3 tests\ntest a ... ok\n\n\
            test result: ok. 12 passed; 0 failed; 1 ignored; 0 measured; 3 filtered out; finished in 0.10s\n\
            test result: FAILED. 2 passed; 4 failed; 0 ignored; 0 measured; 0 filtered out; finished in 1.10s\n";
        let Counts {
            passed,
            failed,
            ignored,
        } = counts(output);
        assert_eq!((passed, failed, ignored), (14, 4, 1));
    }

    fn shell(script: &str) -> Ended {
        shell_as("sh", &script.replace('/', "_"), script)
    }

    fn shell_as(package: &str, name: &str, script: &str) -> Ended {
        let folder = target().join("test-output");
        fs::create_dir_all(&folder).expect("a folder");
        let job = Job::Program(Program {
            package: package.to_owned(),
            name: name.to_owned(),
            kind: "test".to_owned(),
            manifest: root().join("xtask/Cargo.toml"),
            executable: PathBuf::from("/bin/sh"),
            arguments: vec!["-c".to_owned(), script.to_owned()],
        });
        carry_out(job, &folder)
    }

    #[test]
    fn a_program_that_dies_counts_as_a_failure() {
        let ended = shell("echo said; echo thought >&2; kill -9 $$");
        assert!(ended.wrong.is_some());
        assert_eq!(ended.counts.failed, 1);
        assert_eq!(ended.output, "said\nthought\n");
    }

    #[test]
    fn only_tests_in_real_time_are_run_again_and_only_those_that_failed() {
        let script = "echo 'test door::a ... FAILED\ntest door::b ... ok\ntest c ... FAILED\n\
            test result: FAILED. 1 passed; 2 failed; 0 ignored'; exit 101";
        let mut ended = shell_as("host-tool", "signals", script);
        let Some(Job::Program(again)) = to_repeat(&ended) else {
            panic!("{:?}", ended.output)
        };
        assert_eq!(again.arguments[2..], ["--exact", "door::a", "c"]);
        let passes = "echo 'test result: ok. 2 passed; 0 failed; 0 ignored'";
        ended.take(shell_as("host-tool", "signals", passes));
        assert_eq!(ended.wrong, None);
        assert_eq!((ended.counts.passed, ended.counts.failed), (3, 0));
        assert_eq!(to_repeat(&ended), None);
        assert_eq!(to_repeat(&shell_as("motion", "all", script)), None);
        assert_eq!(
            to_repeat(&shell_as("host-tool", "signals", "exit 101")),
            None
        );
    }

    #[test]
    fn a_program_that_says_nothing_of_its_tests_counts_as_a_failure() {
        let ended = shell("true");
        assert!(ended.wrong.is_some());
        assert_eq!(ended.counts.failed, 1);
    }

    #[test]
    fn what_a_program_leaves_running_holds_nothing_up() {
        let ended = shell("sleep 60 & echo 'test result: ok. 1 passed; 0 failed; 0 ignored'");
        assert_eq!(ended.wrong, None);
        assert_eq!(ended.counts.passed, 1);
        assert!(ended.took < Duration::from_secs(60), "{:?}", ended.took);
    }
}
