//! Many synthetic data sets with true bodies from the prior, and the posterior's judgement of each.
//!
//! The model here is a table over the whole prior, for the data as well as for the fits: this tests prior, likelihood
//! and sampler. Other tests check the accuracy of a table.

use calibration::chance::{Random, stream};
use calibration::observation::{Case, Kind, conditions};
use calibration::prediction::Predictor;
use calibration::prior::{Point, UNKNOWNS, parts};
use calibration::sampler::{Effort, sample_from};
use calibration::synthetic::{Planned, observed};
use calibration::table::{Region, Table, distinct};
use calibration::target::Target;
use locomotion::model::Model;
use rayon::prelude::*;

/// For one data set, each unknown and the log-likelihood: the share of the draws below the true value.
#[derive(Clone, Debug)]
pub struct Judged(pub [f64; UNKNOWNS + 1]);

/// Isolated passes both ways at three depths, three times each.
#[allow(dead_code)]
pub fn passes() -> Vec<Planned> {
    let both = [Kind::AntegradePass, Kind::ReturningPass];
    let at = |a: f64| both.map(|kind| Planned::dry(kind, a, 3, 0.3));
    [1.5, 3.0, 5.05].into_iter().flat_map(at).collect()
}

/// Judges data sets `0..count` of a seed, of these trials and of true bodies by `truth`. Chains that end before they
/// have mixed make the ranks less uniform.
pub fn judged(
    seed: u64,
    count: u64,
    effort: Effort,
    planned: &[Planned],
    truth: impl Fn(&mut Random) -> Point + Sync,
) -> Vec<Judged> {
    let cases: Vec<Case> = planned.iter().map(|one| one.case).collect();
    let predictor = Predictor::new(&Model::ONE, &cases, 0.5).expect("covered");
    let table = Table::new(predictor, Region::WHOLE, [20, 20, 12]);
    let judge = |number: u64| {
        let mut random = stream(seed, number);
        let truth = truth(&mut random);
        let exact_mm = table
            .displacements_mm(&parts(&truth))
            .expect("within the prior");
        let trials = observed(&exact_mm, &truth, planned, &mut random);
        let conditions = conditions(&trials).expect("usable");
        let (sorted, places) = distinct(conditions.iter().map(|one| one.case));
        // The conditions are sorted, but the table's cases are in the planned order.
        let places: Vec<usize> = (places.iter())
            .map(|place| {
                cases
                    .iter()
                    .position(|case| *case == sorted[*place])
                    .expect("planned")
            })
            .collect();
        let target = Target {
            conditions: &conditions,
            places: &places,
            table: &table,
            table_errors_mm: &vec![0.0; cases.len()],
        };
        let draws =
            sample_from(&target, &effort, seed ^ ((number + 1) << 20), None).expect("a likelihood");
        let all: Vec<_> = draws.ensembles.iter().flatten().collect();
        let of_truth = target.log_likelihood(&truth);
        let below = |place: usize| {
            let below = (all.iter()).filter(|point| match place {
                UNKNOWNS => target.log_likelihood(point) < of_truth,
                unknown => point[unknown] < truth[unknown],
            });
            below.count() as f64 / all.len() as f64
        };
        Judged(std::array::from_fn(below))
    };
    (0..count).into_par_iter().map(judge).collect()
}

/// Chi-square of the ranks in sixteen equal bins, for each unknown and the log-likelihood.
pub fn chi_squares(judged: &[Judged]) -> [f64; UNKNOWNS + 1] {
    const BINS: usize = 16;
    std::array::from_fn(|unknown| {
        let mut bins = [0.0; BINS];
        for one in judged {
            bins[((one.0[unknown] * BINS as f64) as usize).min(BINS - 1)] += 1.0;
        }
        let expected = judged.len() as f64 / BINS as f64;
        bins.iter()
            .map(|count: &f64| (count - expected).powi(2) / expected)
            .sum()
    })
}

/// Share of the data sets whose 90 % interval contains the true value, for each unknown.
pub fn coverage(judged: &[Judged]) -> [f64; UNKNOWNS] {
    std::array::from_fn(|unknown| {
        let covered = judged
            .iter()
            .filter(|one| (0.05..0.95).contains(&one.0[unknown]))
            .count();
        covered as f64 / judged.len() as f64
    })
}
