//! One possible course of a series of trials: a true body, its results, and draws of the posterior after each result.
//!
//! After each result the draws move to the new posterior. The likelihood enters in stages, each as large as possible
//! while half of the draws survive. After each stage the draws are resampled, then moved by differential evolution,
//! which leaves the posterior of the stage unchanged (a sequential Monte Carlo sampler, Del Moral, Doucet and Jasra,
//! Journal of the Royal Statistical Society B 68, 2006).

use std::collections::BTreeMap;

use crate::belief::Belief;
use crate::chance::{Random, normal, stream, unit};
use crate::information::{Information, Normal, concentric_entropy, entropy, information};
use crate::prior::{OF_BODY, Point, UNKNOWNS, discrepancy_mm};

/// The model: all displacements at a point, mm; none where the model gives no answer.
pub type Response<'a> = dyn Fn(&Point) -> Option<Vec<f64>> + Sync + 'a;

/// A possible trial: the mean of some repeats under one condition.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// Its condition. Trials of one condition share the model's error there.
    pub condition: usize,
    /// Index of the measured displacement in the response.
    pub place: usize,
    /// Number of the model's discrepancies that it contains: [`crate::observation::Kind::discrepancies`].
    pub discrepancies: f64,
    /// Standard deviation of the measurement error of its mean, mm.
    pub error_mm: f64,
}

/// Combined results of one condition.
#[derive(Clone, Copy, Debug)]
struct ConditionResult {
    place: usize,
    discrepancies: f64,
    /// 1/mm^2.
    precision: f64,
    mean_mm: f64,
}

impl ConditionResult {
    /// Adds one more result.
    fn with(before: Option<Self>, trial: &Trial, found_mm: f64) -> Self {
        let precision = 1.0 / (trial.error_mm * trial.error_mm);
        let (known, mean_mm) = before.map_or((0.0, 0.0), |one| (one.precision, one.mean_mm));
        Self {
            place: trial.place,
            discrepancies: trial.discrepancies,
            precision: known + precision,
            mean_mm: (known * mean_mm + precision * found_mm) / (known + precision),
        }
    }

    /// The likelihood of [`crate::target`], up to a constant, but for a discrepancy that each condition has to itself: there
    /// a net and the strokes of one notch share theirs.
    fn log_likelihood(&self, draw: &Draw) -> f64 {
        let reach_mm = self.discrepancies * draw.tau_mm;
        let variance = 1.0 / self.precision + reach_mm * reach_mm;
        let off = self.mean_mm - draw.found_mm[self.place];
        -0.5 * (off * off / variance + libm::log(variance))
    }
}

/// A draw and values derived from it.
#[derive(Clone, Debug)]
struct Draw {
    point: Point,
    tau_mm: f64,
    found_mm: Vec<f64>,
    /// Log density of the belief and of all results that stay, at this point.
    settled: f64,
    /// Log likelihood of the condition that is changing: before and after the new result.
    moving: [f64; 2],
}

impl Draw {
    fn at(point: Point, response: &Response<'_>) -> Option<Self> {
        let found_mm = response(&point)?;
        Some(Self {
            tau_mm: discrepancy_mm(&point),
            point,
            found_mm,
            settled: 0.0,
            moving: [0.0; 2],
        })
    }

    fn log_density(&self, part: f64) -> f64 {
        self.settled + (1.0 - part) * self.moving[0] + part * self.moving[1]
    }

    fn gained(&self) -> f64 {
        self.moving[1] - self.moving[0]
    }
}

/// Sweeps of moves after each stage.
const SWEEPS: usize = 8;
/// Share of the draws that has to survive a stage.
const SURVIVING: f64 = 0.5;
/// Smallest part of the likelihood that a stage brings in: guarantees an end.
const LEAST_STAGE: f64 = 1e-4;
/// Scales of a move, relative to the optimal step for a normal posterior.
const SCALES: [f64; 3] = [1.0, 0.4, 0.1];
/// Compute the entropy that remains once the body is known for one draw in this many.
const THINNED: usize = 8;
/// Grid of tau's coordinate: steps to each side of its prior's median, and their width. A posterior of tau is never
/// narrower than a step.
const TAU_PLACES: usize = 18;
const TAU_STEP: f64 = 0.3;
/// Ignore values of tau whose log density is this much below the greatest.
const TAU_LEAST: f64 = 9.0;
/// Attempts to find a draw that the model covers.
const TRIES: usize = 1_000;

/// One history: true body, results and draws.
pub struct History<'a> {
    belief: &'a Belief,
    response: &'a Response<'a>,
    random: Random,
    truth: Draw,
    /// The model's error in each condition, in multiples of its standard deviation there.
    wrong: BTreeMap<usize, f64>,
    results: BTreeMap<usize, ConditionResult>,
    draws: Vec<Draw>,
}

impl<'a> History<'a> {
    /// A history before any trial. None if belief and model hardly overlap.
    pub fn new(
        belief: &'a Belief,
        response: &'a Response<'a>,
        draws: usize,
        seed: u64,
        number: u64,
    ) -> Option<Self> {
        let mut random = stream(seed, number);
        let mut drawn = || (0..TRIES).find_map(|_| Draw::at(belief.draw(&mut random), response));
        let truth = drawn()?;
        let draws = (0..draws).map(|_| drawn()).collect::<Option<_>>()?;
        Some(Self {
            belief,
            response,
            random,
            truth,
            wrong: BTreeMap::new(),
            results: BTreeMap::new(),
            draws,
        })
    }

    /// Information of each trial about the body, given the results so far. Information about the discrepancy does not
    /// count: it is a nuisance parameter.
    #[must_use]
    pub fn information(&self, trials: &[Trial]) -> Vec<Information> {
        let asked: Vec<&Draw> = self.draws.iter().step_by(THINNED).collect();
        let taus: Vec<Vec<(f64, f64)>> = asked.iter().map(|draw| self.taus(draw)).collect();
        // Without earlier results the entropy does not depend on the displacement, so many trials share it.
        let mut fresh: Vec<((f64, f64), f64)> = vec![];
        // Without earlier results the state of the wall makes no difference.
        let mut told: Vec<((usize, f64, f64), Information)> = vec![];
        let mut one = |trial: &Trial| {
            let known = self.results.get(&trial.condition);
            let same = (trial.place, trial.discrepancies, trial.error_mm);
            if known.is_none()
                && let Some((_, found)) = told.iter().find(|(of, _)| *of == same)
            {
                return *found;
            }
            let left = |entropy: fn(&[Normal]) -> f64| {
                let of_draw = |(draw, taus): (&&Draw, &Vec<(f64, f64)>)| {
                    let of = |(weight, tau_mm): &(f64, f64)| Normal {
                        weight: *weight,
                        ..predicted(trial, known, draw.found_mm[trial.place], *tau_mm)
                    };
                    entropy(&taus.iter().map(of).collect::<Vec<_>>())
                };
                asked.iter().zip(&taus).map(of_draw).sum::<f64>() / asked.len() as f64
            };
            let alike = (trial.discrepancies, trial.error_mm);
            let left = if known.is_some() {
                left(entropy)
            } else if let Some((_, left)) = fresh.iter().find(|(of, _)| *of == alike) {
                *left
            } else {
                let left = left(concentric_entropy);
                fresh.push((alike, left));
                left
            };
            let of = |draw: &Draw| predicted(trial, known, draw.found_mm[trial.place], draw.tau_mm);
            let found = information(&self.draws.iter().map(of).collect::<Vec<_>>(), left);
            if known.is_none() {
                told.push((same, found));
            }
            found
        };
        trials.iter().map(&mut one).collect()
    }

    /// Posterior of the discrepancy if the body is that of a draw: weights, and values in mm.
    fn taus(&self, draw: &Draw) -> Vec<(f64, f64)> {
        let mut draw = draw.clone();
        let mut all = vec![];
        let mut greatest = f64::NEG_INFINITY;
        for place in 0..=2 * TAU_PLACES {
            draw.point[OF_BODY] = (place as f64 - TAU_PLACES as f64) * TAU_STEP;
            draw.tau_mm = discrepancy_mm(&draw.point);
            let results = self.results.values().map(|one| one.log_likelihood(&draw));
            let log = self.belief.log_density(&draw.point) + results.sum::<f64>();
            greatest = greatest.max(log);
            all.push((log, draw.tau_mm));
        }
        all.retain(|(log, _)| *log > greatest - TAU_LEAST);
        all.iter()
            .map(|(log, tau_mm)| (libm::exp(log - greatest), *tau_mm))
            .collect()
    }

    /// Makes a trial and moves the draws to the new posterior.
    pub fn measure(&mut self, trial: &Trial) {
        let random = &mut self.random;
        let wrong = *(self.wrong.entry(trial.condition)).or_insert_with(|| normal(random));
        let found_mm = self.truth.found_mm[trial.place]
            + trial.discrepancies * self.truth.tau_mm * wrong
            + trial.error_mm * normal(random);
        let before = self.results.remove(&trial.condition);
        let after = ConditionResult::with(before, trial, found_mm);
        self.bring_in(before, after);
        self.results.insert(trial.condition, after);
    }

    /// Updates the draw's densities: `self.results` stay, and the condition changes from `before` to `after`.
    fn weigh(&self, draw: &mut Draw, before: Option<ConditionResult>, after: ConditionResult) {
        draw.settled = self.belief.log_density(&draw.point);
        for result in self.results.values() {
            draw.settled += result.log_likelihood(draw);
        }
        draw.moving = [
            before.map_or(0.0, |one| one.log_likelihood(draw)),
            after.log_likelihood(draw),
        ];
    }

    fn bring_in(&mut self, before: Option<ConditionResult>, after: ConditionResult) {
        let mut draws = core::mem::take(&mut self.draws);
        for draw in &mut draws {
            self.weigh(draw, before, after);
        }
        let mut part = 0.0;
        while part < 1.0 {
            let stage = stage(&draws, 1.0 - part);
            part = if stage < 1.0 - part {
                part + stage
            } else {
                1.0
            };
            draws = resampled(&draws, stage, unit(&mut self.random));
            for _ in 0..SWEEPS {
                self.sweep(&mut draws, before, after, part);
            }
        }
        self.draws = draws;
    }

    /// Proposes one move of each draw, along the difference of two others.
    fn sweep(
        &mut self,
        draws: &mut [Draw],
        before: Option<ConditionResult>,
        after: ConditionResult,
        part: f64,
    ) {
        let stand: Vec<Point> = draws.iter().map(|draw| draw.point).collect();
        let best = 2.38 / libm::sqrt(2.0 * UNKNOWNS as f64);
        for draw in draws {
            let mut below = |count: usize| (unit(&mut self.random) * count as f64) as usize;
            let (one, other) = (stand[below(stand.len())], stand[below(stand.len())]);
            let far = best * SCALES[below(SCALES.len())];
            let chance = libm::log(unit(&mut self.random));
            if one == other {
                continue;
            }
            let point =
                core::array::from_fn(|axis| draw.point[axis] + far * (one[axis] - other[axis]));
            let Some(mut proposed) = Draw::at(point, self.response) else {
                continue;
            };
            self.weigh(&mut proposed, before, after);
            if proposed.log_density(part) - draw.log_density(part) > chance {
                *draw = proposed;
            }
        }
    }

    /// Values of an unknown's coordinate in all draws, sorted.
    #[must_use]
    pub fn sorted(&self, unknown: usize) -> Vec<f64> {
        let mut all: Vec<f64> = self.draws.iter().map(|draw| draw.point[unknown]).collect();
        all.sort_by(f64::total_cmp);
        all
    }
}

/// Predicted result of a trial with a body of displacement `model_mm`, after the results of its condition.
fn predicted(trial: &Trial, known: Option<&ConditionResult>, model_mm: f64, tau_mm: f64) -> Normal {
    let reach_mm = trial.discrepancies * tau_mm;
    let wrong = reach_mm * reach_mm;
    let (precision, mean_mm) = known.map_or((0.0, model_mm), |one| (one.precision, one.mean_mm));
    // Share of this condition's error so far that is due to the discrepancy.
    let share = wrong * precision / (1.0 + wrong * precision);
    Normal {
        weight: 1.0,
        mean_mm: model_mm + share * (mean_mm - model_mm),
        variance_mm2: wrong * (1.0 - share) + trial.error_mm * trial.error_mm,
    }
}

/// The greatest part of the likelihood, up to `left`, that leaves enough draws.
fn stage(draws: &[Draw], left: f64) -> f64 {
    let surviving = |part: f64| {
        let weights = weights(draws, part);
        let sum: f64 = weights.iter().sum();
        let squares: f64 = weights.iter().map(|weight| weight * weight).sum();
        sum * sum / squares / draws.len() as f64
    };
    if surviving(left) >= SURVIVING {
        return left;
    }
    let (mut low, mut high) = (0.0, left);
    for _ in 0..20 {
        let middle = 0.5 * (low + high);
        if surviving(middle) >= SURVIVING {
            low = middle;
        } else {
            high = middle;
        }
    }
    low.max(LEAST_STAGE).min(left)
}

/// Weights of the draws if `part` more of the likelihood comes in; the greatest is 1.
fn weights(draws: &[Draw], part: f64) -> Vec<f64> {
    let greatest = draws
        .iter()
        .map(Draw::gained)
        .fold(f64::NEG_INFINITY, f64::max);
    let weight = |draw: &Draw| libm::exp(part * (draw.gained() - greatest));
    draws.iter().map(weight).collect()
}

/// The same number of draws, each repeated in proportion to its weight: systematic resampling.
fn resampled(draws: &[Draw], part: f64, offset: f64) -> Vec<Draw> {
    let weights = weights(draws, part);
    let each = weights.iter().sum::<f64>() / draws.len() as f64;
    let mut kept = Vec::with_capacity(draws.len());
    let mut reached = 0.0;
    for (draw, weight) in draws.iter().zip(weights) {
        reached += weight;
        while kept.len() < draws.len() && (kept.len() as f64 + offset) * each < reached {
            kept.push(draw.clone());
        }
    }
    // Rounding may leave the last place empty.
    while let Some(last) = kept.last().cloned()
        && kept.len() < draws.len()
    {
        kept.push(last);
    }
    kept
}
