//! Named steps: each describes itself in one line, is timed, and appears in a table at the end.

use std::fmt;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use crate::process::{Failure, Result};

/// The function of a step.
enum Act {
    Check(fn() -> Result<()>),
    Test(fn() -> Tests),
}

/// One step.
pub(crate) struct Step {
    name: &'static str,
    /// Description in one line.
    does: &'static str,
    act: Act,
    /// The name of an earlier step that has to pass before this one can run.
    after: Option<&'static str>,
}

impl Step {
    pub(crate) const fn new(
        name: &'static str,
        does: &'static str,
        act: fn() -> Result<()>,
    ) -> Self {
        Self {
            name,
            does,
            act: Act::Check(act),
            after: None,
        }
    }

    /// A step that counts tests.
    pub(crate) const fn tests(name: &'static str, does: &'static str, act: fn() -> Tests) -> Self {
        Self {
            name,
            does,
            act: Act::Test(act),
            after: None,
        }
    }

    /// The step runs only if the step `name` has passed.
    pub(crate) const fn after(self, name: &'static str) -> Self {
        Self {
            after: Some(name),
            ..self
        }
    }
}

/// Number of tests that passed, failed and were ignored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    pub(crate) passed: u32,
    pub(crate) failed: u32,
    pub(crate) ignored: u32,
}

impl Counts {
    pub(crate) fn add(&mut self, other: &Self) {
        self.passed += other.passed;
        self.failed += other.failed;
        self.ignored += other.ignored;
    }
}

impl fmt::Display for Counts {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            passed,
            failed,
            ignored,
        } = self;
        write!(out, "{passed} tests passed, {failed} failed")?;
        match ignored {
            0 => Ok(()),
            _ => write!(out, ", {ignored} left out"),
        }
    }
}

/// A test program and how long it ran.
pub(crate) struct Ran {
    pub(crate) name: String,
    pub(crate) took: Duration,
}

/// Result of tests.
pub(crate) struct Tests {
    pub(crate) counts: Counts,
    pub(crate) programs: Vec<Ran>,
    pub(crate) outcome: Result<()>,
}

impl Default for Tests {
    fn default() -> Self {
        Self {
            counts: Counts::default(),
            programs: vec![],
            outcome: Ok(()),
        }
    }
}

impl Tests {
    /// No test was run, for this reason.
    pub(crate) fn failed(failure: Failure) -> Self {
        Self {
            outcome: Err(failure),
            ..Self::default()
        }
    }

    /// These and others; the first failure is the one of both.
    pub(crate) fn and(mut self, others: Self) -> Self {
        self.counts.add(&others.counts);
        self.programs.extend(others.programs);
        self.outcome = self.outcome.and(others.outcome);
        self
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    Passed,
    Failed,
    /// A step that it depends on did not pass; counts as failed.
    NotRun,
}

impl fmt::Display for Outcome {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.pad(match self {
            Self::Passed => "passed",
            Self::Failed => "FAILED",
            Self::NotRun => "not run",
        })
    }
}

/// A finished step.
struct Done {
    name: &'static str,
    outcome: Outcome,
    took: Duration,
    /// None if the step counts no tests.
    counts: Option<Counts>,
    programs: Vec<Ran>,
}

/// Runs all steps, even after a failure, so that one run shows everything that is wrong. Prints a table and a line of
/// totals at the end.
pub(crate) fn run(steps: &[Step]) -> ExitCode {
    let start = Instant::now();
    let mut done: Vec<Done> = Vec::new();
    for (number, step) in (1..).zip(steps) {
        println!("\n[{number}/{}] {}: {}", steps.len(), step.name, step.does);
        let one = carry_out(step, &done);
        println!(
            "[{number}/{}] {}: {}, {}",
            steps.len(),
            step.name,
            one.outcome,
            Clock(one.took)
        );
        done.push(one);
    }

    println!("\n{}", table(&done, start.elapsed()));
    let passed = (done.iter())
        .filter(|step| step.outcome == Outcome::Passed)
        .count();
    let failed = done.len() - passed;
    println!("\n{passed} passed, {failed} failed");
    if failed == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

/// Number of slowest programs in the table.
const SLOWEST: usize = 10;

/// Table of the steps with their tests and times, and of the slowest test programs. The stable test harness does not
/// report the time of single tests.
fn table(done: &[Done], all: Duration) -> String {
    let seconds = |time: Duration| format!("{:.1}", time.as_secs_f64());
    let mut lines = vec![format!(
        "{:<14} {:<8} {:>7} {:>9}",
        "step", "outcome", "tests", "seconds"
    )];
    for step in done {
        let tests = step.counts.map(|counts| counts.passed + counts.failed);
        let mut line = format!(
            "{:<14} {:<8} {:>7} {:>9}",
            step.name,
            step.outcome,
            tests.map_or("-".to_owned(), |tests| tests.to_string()),
            seconds(step.took)
        );
        if let Some(counts) = step.counts.filter(|counts| counts.failed > 0) {
            line += &format!("  {} of them failed", counts.failed);
        }
        if let Some(counts) = step.counts.filter(|counts| counts.ignored > 0) {
            line += &format!("  {} left out", counts.ignored);
        }
        lines.push(line);
    }
    let tests: u32 = (done.iter().filter_map(|step| step.counts))
        .map(|counts| counts.passed + counts.failed)
        .sum();
    lines.push(format!(
        "{:<14} {:<8} {tests:>7} {:>9}  {}",
        "all",
        "",
        seconds(all),
        Clock(all)
    ));
    let mut slowest: Vec<_> = (done.iter())
        .flat_map(|step| step.programs.iter().map(|ran| (step.name, ran)))
        .collect();
    if !slowest.is_empty() {
        slowest.sort_by_key(|(_, ran)| std::cmp::Reverse(ran.took));
        lines.push("\nslowest test programs, seconds beside the others".to_owned());
        for (step, ran) in slowest.iter().take(SLOWEST) {
            lines.push(format!("{:>9}  {} ({step})", seconds(ran.took), ran.name));
        }
    }
    lines.join("\n")
}

fn carry_out(step: &Step, done: &[Done]) -> Done {
    let over = |outcome, took| Done {
        name: step.name,
        outcome,
        took,
        counts: None,
        programs: vec![],
    };
    if let Some(before) = step.after {
        let passed = |done: &Done| done.name == before && done.outcome == Outcome::Passed;
        if !done.iter().any(passed) {
            println!("error: this needs the step `{before}`, which did not pass");
            return over(Outcome::NotRun, Duration::ZERO);
        }
    }
    let start = Instant::now();
    let (ended, counts, programs) = match step.act {
        Act::Check(act) => (act(), None, vec![]),
        Act::Test(act) => {
            let tests = act();
            (tests.outcome, Some(tests.counts), tests.programs)
        }
    };
    let outcome = match ended {
        Ok(()) => Outcome::Passed,
        Err(failure) => {
            println!("{failure}");
            Outcome::Failed
        }
    };
    Done {
        counts,
        programs,
        ..over(outcome, start.elapsed())
    }
}

/// A duration for people: `12.3 s`, `3 min 05 s`.
pub(crate) struct Clock(pub(crate) Duration);

impl fmt::Display for Clock {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0.as_secs() {
            0..60 => write!(out, "{:.1} s", self.0.as_secs_f64()),
            seconds => write!(out, "{} min {:02} s", seconds / 60, seconds % 60),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DOES: &str = "a test's step";

    fn passes() -> Result<()> {
        Ok(())
    }

    fn fails() -> Result<()> {
        Err(Failure::new("on purpose", "none"))
    }

    fn panics() -> Result<()> {
        panic!("must not run")
    }

    fn images(outcome: Outcome) -> Vec<Done> {
        vec![Done {
            name: "images",
            outcome,
            took: Duration::ZERO,
            counts: None,
            programs: vec![],
        }]
    }

    fn outcome(step: &Step, done: &[Done]) -> Outcome {
        carry_out(step, done).outcome
    }

    #[test]
    fn a_step_runs_only_after_the_one_it_needs() {
        let failed = images(Outcome::Failed);
        let passed = images(Outcome::Passed);
        let must_not_run = Step::new("bench", DOES, panics).after("images");
        for done in [&failed[..], &[]] {
            assert_eq!(outcome(&must_not_run, done), Outcome::NotRun);
        }
        let bench = Step::new("bench", DOES, passes).after("images");
        assert_eq!(outcome(&bench, &passed), Outcome::Passed);
        let format = Step::new("format", DOES, fails);
        assert_eq!(outcome(&format, &failed), Outcome::Failed);
    }

    #[test]
    fn one_failure_fails_the_whole() {
        let good = || Step::new("good", DOES, passes);
        assert_eq!(run(&[good(), good()]), ExitCode::SUCCESS);
        let bad = Step::new("bad", DOES, fails);
        assert_eq!(run(&[good(), bad, good()]), ExitCode::FAILURE);
    }

    #[test]
    fn tests_and_slowest_programs_are_in_the_table() {
        let tests = || Tests {
            counts: Counts {
                passed: 40,
                failed: 2,
                ignored: 3,
            },
            programs: (1..=12)
                .map(|number| Ran {
                    name: format!("program {number}"),
                    took: Duration::from_secs(number),
                })
                .collect(),
            outcome: Err(Failure::new("on purpose", "none")),
        };
        let bad = carry_out(&Step::tests("host", DOES, tests), &[]);
        assert_eq!(bad.outcome, Outcome::Failed);
        let table = table(&[bad], Duration::from_secs(99));
        for line in [
            "host           FAILED        42       0.0  2 of them failed  3 left out",
            "all                          42      99.0  1 min 39 s",
            "     12.0  program 12 (host)",
            "      3.0  program 3 (host)",
        ] {
            assert!(table.lines().any(|other| other == line), "{line}\n{table}");
        }
        assert!(!table.contains("program 2 "), "{table}");
    }

    #[test]
    fn both_of_two_kinds_of_tests_have_to_pass() {
        let of = |passed, outcome| Tests {
            counts: Counts {
                passed,
                ..Counts::default()
            },
            outcome,
            ..Tests::default()
        };
        let bad = || Err(Failure::new("on purpose", "none"));
        let both = of(2, Ok(())).and(of(3, Ok(())));
        assert!(both.counts.passed == 5 && both.outcome.is_ok());
        for (one, other) in [(bad(), Ok(())), (Ok(()), bad())] {
            assert!(of(2, one).and(of(3, other)).outcome.is_err());
        }
    }

    #[test]
    fn durations_read_well() {
        assert_eq!(Clock(Duration::from_millis(12_345)).to_string(), "12.3 s");
        assert_eq!(Clock(Duration::from_secs(185)).to_string(), "3 min 05 s");
    }
}
