//! Simulation-based calibration (Talts et al. 2018): if the true bodies come from the prior, their ranks among draws
//! of their posteriors are uniform. 500 data sets with `RETROGRADE_CAMPAIGN=full`, otherwise the first of them.

mod population;

use calibration::sampler::Effort;
use population::{chi_squares, coverage, judged};

/// Seed of the data sets.
const SEED: u64 = 2_022;
/// Chi-square with 15 degrees of freedom that uniform ranks exceed once in 4,000 times; for one of four unknowns,
/// once in 1,000.
const GREATEST: f64 = 41.3;

#[test]
fn ranks_are_uniform_and_intervals_cover() {
    let full = std::env::var("RETROGRADE_CAMPAIGN").is_ok_and(|what| what == "full");
    let short = Effort {
        doublings: 2,
        ..Effort::FULL
    };
    let (count, effort) = if full {
        (500, Effort::FULL)
    } else {
        (60, short)
    };
    let judged = judged(SEED, count, effort);
    let chi_squares = chi_squares(&judged);
    let coverage = coverage(&judged[..judged.len().min(200)]);
    eprintln!(
        "{count} data sets: chi-squares {chi_squares:.1?}; coverage of the first 200 {coverage:?}"
    );
    for chi_square in chi_squares {
        assert!(chi_square < GREATEST, "{chi_squares:?}");
    }
    // For 60 intervals, chance leads outside this range once in 1,000 times.
    let usual = if full { 0.85..=0.95 } else { 0.77..=1.0 };
    for share in coverage {
        assert!(usual.contains(&share), "{coverage:?}");
    }
}
