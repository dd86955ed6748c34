//! Named steps: each says in one line what it does, is timed, and is listed in a table at the end.

use std::fmt;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use crate::process::Result;

/// One thing to do.
pub(crate) struct Step {
    pub(crate) name: &'static str,
    /// What it does, in a line.
    pub(crate) does: &'static str,
    /// The name of an earlier step that has to pass before this one can run.
    pub(crate) after: Option<&'static str>,
    pub(crate) act: fn() -> Result<()>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    Passed,
    Failed,
    /// The step it depends on did not pass; counts as failed.
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
    let passed = done.iter().filter(|step| step.1 == Outcome::Passed).count();
    let failed = done.len() - passed;
    println!("\n{passed} passed, {failed} failed");
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

    const fn step(
        name: &'static str,
        after: Option<&'static str>,
        act: fn() -> Result<()>,
    ) -> Step {
        let does = "a test's step";
        Step {
            name,
            does,
            after,
            act,
        }
    }

    fn fails() -> Result<()> {
        Err(Failure::new("on purpose", "none"))
    }

    #[test]
    fn a_step_runs_only_after_the_one_it_needs() {
        let panics = || panic!("must not run");
        let failed = [("images", Outcome::Failed, Duration::ZERO)];
        let passed = [("images", Outcome::Passed, Duration::ZERO)];
        assert_eq!(
            carry_out(&step("bench", Some("images"), panics), &failed).0,
            Outcome::NotRun
        );
        assert_eq!(
            carry_out(&step("bench", Some("images"), panics), &[]).0,
            Outcome::NotRun
        );
        assert_eq!(
            carry_out(&step("bench", Some("images"), || Ok(())), &passed).0,
            Outcome::Passed
        );
        assert_eq!(
            carry_out(&step("format", None, fails), &failed).0,
            Outcome::Failed
        );
    }

    #[test]
    fn one_failure_fails_the_whole() {
        let good = || step("good", None, || Ok(()));
        assert_eq!(run(&[good(), good()]), ExitCode::SUCCESS);
        assert_eq!(
            run(&[good(), step("bad", None, fails), good()]),
            ExitCode::FAILURE
        );
    }

    #[test]
    fn durations_read_well() {
        assert_eq!(Clock(Duration::from_millis(12_345)).to_string(), "12.3 s");
        assert_eq!(Clock(Duration::from_secs(185)).to_string(), "3 min 05 s");
    }
}
