//! Verdicts of a firmware on the seeded cases, and their table.

use crate::cases::Kind;
use std::collections::BTreeMap;
use std::fmt::Debug;

/// Verdict of the firmware on one capsule.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// The firmware's name for the outcome.
    pub name: String,
    /// Time from the defect to the fault, ms; none if the defect was there before the motion.
    pub took_ms: Option<u64>,
    /// Largest force after the defect, N.
    pub peak_n: f64,
    /// Missing travel at a reported fold, compared with a healthy end, mm; none if the firmware does not report
    /// folded.
    pub short_mm: Option<f64>,
}

/// Name of an outcome, a fault or a refusal, without its fields.
#[must_use]
pub fn name(of: &impl Debug) -> String {
    let text = format!("{of:?}");
    let end = text.find(|c: char| !c.is_alphanumeric());
    text[..end.unwrap_or(text.len())].to_owned()
}

/// Header of the table.
pub const HEAD: &str = "| defect | cases | named rightly | all names | latest, ms | largest force, N | `Folded`, short by at most, mm |
|---|---|---|---|---|---|---|";

/// Row of the table for one kind.
#[must_use]
pub fn row(kind: Kind, verdicts: &[Verdict]) -> String {
    let mut names = BTreeMap::new();
    for Verdict { name, .. } in verdicts {
        *names.entry(name).or_insert(0) += 1;
    }
    let names: Vec<_> = names
        .iter()
        .map(|(name, count)| format!("{name} {count}"))
        .collect();
    let wrong = wrong(kind, verdicts).count();
    let fraction = 100.0 * (1.0 - wrong as f64 / verdicts.len() as f64);
    let latest = verdicts.iter().filter_map(|verdict| verdict.took_ms).max();
    let peak_n = verdicts.iter().fold(0.0, |peak: f64, v| peak.max(v.peak_n));
    let short_mm = verdicts
        .iter()
        .filter_map(|verdict| verdict.short_mm)
        .max_by(f64::total_cmp);
    format!(
        "| {kind:?} | {} | {fraction:.1} % | {} | {} | {peak_n:.1} | {} |",
        verdicts.len(),
        names.join(", "),
        latest.map_or("-".to_owned(), |ms| ms.to_string()),
        short_mm.map_or("-".to_owned(), |mm| format!("{mm:.2}")),
    )
}

/// Seeds and names of wrong verdicts. `verdicts` belong to the seeds from 0 on.
pub fn wrong(kind: Kind, verdicts: &[Verdict]) -> impl Iterator<Item = (u64, &str)> {
    (0..)
        .zip(verdicts)
        .map(|(seed, verdict)| (seed, verdict.name.as_str()))
        .filter(move |(_, name)| !kind.right().contains(name))
}

/// Runs `of` for each seed below `count` on all processors. Returns the results in the order of the seeds.
///
/// # Panics
/// `of` panics.
pub fn all<T: Send>(count: u64, of: impl Fn(u64) -> T + Sync) -> Vec<T> {
    let workers = std::thread::available_parallelism().map_or(1, usize::from) as u64;
    std::thread::scope(|scope| {
        let of = &of;
        let running: Vec<_> = (0..workers)
            .map(|worker| {
                let seeds = (worker..count).step_by(workers as usize);
                scope.spawn(move || seeds.map(of).collect::<Vec<_>>())
            })
            .collect();
        let mut found: Vec<_> = running
            .into_iter()
            .map(|worker| worker.join().expect("it does not panic").into_iter())
            .collect();
        (0..count)
            .filter_map(|seed| found[(seed % workers) as usize].next())
            .collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_counts_what_is_right_and_keeps_the_worst() {
        let verdict = |name: &str, took_ms, peak_n, short_mm| Verdict {
            name: name.to_owned(),
            took_ms,
            peak_n,
            short_mm,
        };
        let verdicts = [
            verdict("Jam", None, 5.0, None),
            verdict("Complete", Some(7), 4.0, Some(1.5)),
            verdict("Jam", Some(40), 18.25, None),
            verdict("Jam", None, 5.0, None),
        ];
        assert_eq!(
            row(Kind::Jam, &verdicts),
            "| Jam | 4 | 75.0 % | Complete 1, Jam 3 | 40 | 18.2 | 1.50 |"
        );
        let wrong: Vec<_> = wrong(Kind::Jam, &verdicts).collect();
        assert_eq!(wrong, [(1, "Complete")]);
    }

    #[test]
    fn names_lose_their_fields() {
        #[derive(Debug)]
        #[allow(dead_code)] // Debug reads them
        enum Fault {
            Jam { thread_um: i32 },
            Timeout,
        }
        assert_eq!(name(&Fault::Jam { thread_um: 1 }), "Jam");
        assert_eq!(name(&Fault::Timeout), "Timeout");
    }

    #[test]
    fn all_seeds_are_tried_in_their_order() {
        assert_eq!(all(5, |seed| seed * seed), [0, 1, 4, 9, 16]);
    }
}
