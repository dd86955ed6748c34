//! The comparison as the Markdown table of `docs/paper-comparison.md`.

use core::fmt;

use crate::comparison::{Chosen, Evidence, Kind, Odds, ROWS, Row, Share};
use crate::prior;

/// All rows with their odds, printed as a Markdown table.
#[derive(Clone, Copy, Debug)]
pub struct Table<'a> {
    /// The rows.
    pub rows: &'a [Row; ROWS],
    /// The probability that each row is met.
    pub odds: &'a [Odds; ROWS],
    /// Number of bodies evaluated.
    pub bodies: Bodies,
}

/// Number of bodies evaluated, by origin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bodies {
    /// Draws of the prior.
    pub prior: usize,
    /// Draws that agree with the words on the rig.
    pub rig: usize,
    /// Draws that agree with the words on the tube.
    pub tube: usize,
    /// Draws of a posterior; 0 if there is none.
    pub posterior: usize,
}

impl fmt::Display for Table<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Bodies {
            prior,
            rig,
            tube,
            posterior,
        } = self.bodies;
        let fitted = posterior > 0;
        write!(
            f,
            "| section | the paper says | it asks | of | paper | model | unit | prior: {prior} bodies, seed {} | \
             words: {rig} bodies on the rig, {tube} in the tube ",
            prior::SEED
        )?;
        if fitted {
            write!(f, "| posterior: {posterior} bodies ")?;
        }
        writeln!(f, "| kind | remark |")?;
        writeln!(
            f,
            "|---|---|---|---|---|---|---|---|---|---|---|{}",
            if fitted { "---|" } else { "" }
        )?;
        for (row, odds) in self.rows.iter().zip(self.odds) {
            line(f, row, odds, fitted)?;
        }
        let kinds = || {
            self.rows
                .iter()
                .zip(self.odds)
                .map(|(row, odds)| Kind::of(row, odds))
        };
        let judged = kinds().filter(|kind| Kind::JUDGED.contains(kind)).count();
        write!(f, "\nOf {judged} rows with a condition:")?;
        for (place, kind) in Kind::JUDGED.into_iter().enumerate() {
            let count = kinds().filter(|of| *of == kind).count();
            write!(f, "{} {count} {kind}", if place == 0 { "" } else { "," })?;
        }
        writeln!(f, ".")
    }
}

fn line(f: &mut fmt::Formatter<'_>, row: &Row, odds: &Odds, fitted: bool) -> fmt::Result {
    let Row {
        section,
        sentence,
        quantity,
        paper,
        unit,
        evidence,
        remark,
        ..
    } = row;
    write!(f, "| {section} | {sentence} | ")?;
    match row.condition {
        Some(condition) => write!(f, "{condition}")?,
        None => write!(f, "-")?,
    }
    write!(f, " | {quantity} | {paper} | ")?;
    match row.model {
        // Adding zero turns -0 into 0.
        Some(value) => write!(f, "{}", Rounded(value + 0.0, *evidence))?,
        None => write!(f, "-")?,
    }
    write!(f, " | {unit} | ")?;
    match odds {
        Odds::Unstated => write!(f, "- | -{}", if fitted { " | -" } else { "" })?,
        Odds::AnyBody(met) => {
            let sure = if *met { "1, any body" } else { "0, any body" };
            write!(f, "{sure} | {sure}")?;
            if fitted {
                write!(f, " | {sure}")?;
            }
        }
        Odds::Shares {
            prior,
            words,
            posterior,
        } => {
            write!(f, "{} | ", Cell(*prior))?;
            match row.chosen {
                Some(Chosen::Wholly) => write!(f, "chosen by it")?,
                Some(Chosen::Partly) => write!(f, "{}, chosen by part of it", Cell(*words))?,
                None => write!(f, "{}", Cell(*words))?,
            }
            if fitted {
                write!(f, " | {}", Cell(*posterior))?;
            }
        }
    }
    writeln!(f, " | {} | {remark} |", Kind::of(row, odds))
}

/// A share and its interval, or a dash.
struct Cell(Option<Share>);

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(share) => {
                let (low, high) = share.interval;
                write!(f, "{:.2} ({low:.2} to {high:.2})", share.part())
            }
            None => write!(f, "-"),
        }
    }
}

/// Prints a whole number as such, an input with three decimals, a result with about three digits: no result is known
/// better.
struct Rounded(f64, Evidence);

impl fmt::Display for Rounded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let &Self(value, evidence) = self;
        let nearest = libm::round(value);
        let decimals = match libm::fabs(value) {
            _ if libm::fabs(value - nearest) < 1e-9 => 0,
            size if evidence == Evidence::Input || size < 1.0 => 3,
            size if size < 10.0 => 2,
            size if size < 100.0 => 1,
            _ => 0,
        };
        write!(f, "{value:.decimals$}")
    }
}
