//! Named steps: each says in one line what it does, is timed, and is listed in a table at the end.

use std::fmt;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use crate::process::{Result, installed};

/// One thing to do.
pub(crate) struct Step {
    name: &'static str,
    /// What it does, in a line.
    does: &'static str,
    act: fn() -> Result<()>,
    /// The name of an earlier step that has to pass before this one can run.
    after: Option<&'static str>,
    /// The cargo subcommand that it runs, if that has to be installed by hand.
    needs: Option<&'static str>,
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
            act,
            after: None,
            needs: None,
        }
    }

    /// The step runs only if the step `name` has passed.
    pub(crate) const fn after(self, name: &'static str) -> Self {
        Self {
            after: Some(name),
            ..self
        }
    }

    /// The step is skipped unless `cargo SUBCOMMAND` is installed.
    pub(crate) const fn needs(self, subcommand: &'static str) -> Self {
        Self {
            needs: Some(subcommand),
            ..self
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    Passed,
    Failed,
    /// The step it depends on did not pass; counts as failed.
    NotRun,
    /// What it needs is not installed; counts neither as passed nor as failed.
    Skipped,
}

impl fmt::Display for Outcome {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.pad(match self {
            Self::Passed => "passed",
            Self::Failed => "FAILED",
            Self::NotRun => "not run",
            Self::Skipped => "skipped",
        })
    }
}

/// Runs all steps, also after a failure, so that one run shows everything that is wrong. Prints a table
/// and a line of totals at the end.
pub(crate) fn run(steps: &[Step]) -> ExitCode {
    let start = Instant::now();
    let mut done: Vec<(&str, Outcome, Duration)> = Vec::new();
    for (number, step) in (1..).zip(steps) {
        println!("\n[{number}/{}] {}: {}", steps.len(), step.name, step.does);
        let (outcome, took) = carry_out(step, &done);
        println!(
            "[{number}/{}] {}: {outcome}, {}",
            steps.len(),
            step.name,
            Clock(took)
        );
        done.push((step.name, outcome, took));
    }

    println!();
    for (name, outcome, took) in &done {
        println!("{name:<14} {outcome:<8} {:>12}", Clock(*took).to_string());
    }
    println!(
        "{:<14} {:<8} {:>12}",
        "all",
        "",
        Clock(start.elapsed()).to_string()
    );
    let count = |outcome| done.iter().filter(|step| step.1 == outcome).count();
    let (passed, skipped) = (count(Outcome::Passed), count(Outcome::Skipped));
    let failed = done.len() - passed - skipped;
    print!("\n{passed} passed, {failed} failed");
    match skipped {
        0 => println!(),
        _ => println!(", {skipped} skipped"),
    }
    if failed == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

fn carry_out(step: &Step, done: &[(&str, Outcome, Duration)]) -> (Outcome, Duration) {
    if let Some(before) = step.after {
        let passed =
            |done: &(&str, Outcome, Duration)| done.0 == before && done.1 == Outcome::Passed;
        if !done.iter().any(passed) {
            println!("error: this needs the step `{before}`, which did not pass");
            return (Outcome::NotRun, Duration::ZERO);
        }
    }
    if let Some(subcommand) = step.needs
        && !installed(subcommand)
    {
        println!("skipped: cargo-{subcommand} is not installed");
        println!("to install it: `cargo install cargo-{subcommand} --locked`");
        return (Outcome::Skipped, Duration::ZERO);
    }
    let start = Instant::now();
    let outcome = match (step.act)() {
        Ok(()) => Outcome::Passed,
        Err(failure) => {
            println!("{failure}");
            Outcome::Failed
        }
    };
    (outcome, start.elapsed())
}

/// A duration for people: `12.3 s`, `3 min 05 s`.
struct Clock(Duration);

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
    use crate::process::Failure;

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

    fn outcome(step: &Step, done: &[(&str, Outcome, Duration)]) -> Outcome {
        carry_out(step, done).0
    }

    #[test]
    fn a_step_runs_only_after_the_one_it_needs() {
        let failed = [("images", Outcome::Failed, Duration::ZERO)];
        let skipped = [("images", Outcome::Skipped, Duration::ZERO)];
        let passed = [("images", Outcome::Passed, Duration::ZERO)];
        let must_not_run = Step::new("bench", DOES, panics).after("images");
        for done in [&failed[..], &skipped, &[]] {
            assert_eq!(outcome(&must_not_run, done), Outcome::NotRun);
        }
        let bench = Step::new("bench", DOES, passes).after("images");
        assert_eq!(outcome(&bench, &passed), Outcome::Passed);
        let format = Step::new("format", DOES, fails);
        assert_eq!(outcome(&format, &failed), Outcome::Failed);
    }

    #[test]
    fn a_step_is_skipped_without_the_subcommand_it_needs() {
        let without = Step::new("without", DOES, panics).needs("no-such-subcommand");
        assert_eq!(outcome(&without, &[]), Outcome::Skipped);
        let with = Step::new("with", DOES, passes).needs("build");
        assert_eq!(outcome(&with, &[]), Outcome::Passed);
    }

    #[test]
    fn one_failure_fails_the_whole_and_a_skipped_step_does_not() {
        let good = || Step::new("good", DOES, passes);
        let skipped = || Step::new("skipped", DOES, panics).needs("no-such-subcommand");
        assert_eq!(run(&[good(), skipped(), good()]), ExitCode::SUCCESS);
        let bad = Step::new("bad", DOES, fails);
        assert_eq!(run(&[good(), bad, good()]), ExitCode::FAILURE);
        let late = Step::new("late", DOES, panics).after("skipped");
        assert_eq!(run(&[skipped(), late]), ExitCode::FAILURE);
    }

    #[test]
    fn durations_read_well() {
        assert_eq!(Clock(Duration::from_millis(12_345)).to_string(), "12.3 s");
        assert_eq!(Clock(Duration::from_secs(185)).to_string(), "3 min 05 s");
    }
}
