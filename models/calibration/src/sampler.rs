//! Draws from the posterior: independent ensembles of walkers under affine-invariant moves.
//!
//! The model has kinks where contacts switch, so there are no gradients to follow. The moves are Goodman and Weare's
//! stretch and differential evolution (ter Braak), from `hammer-and-sample`. They need no tuning, because the other
//! walkers show scale and direction. Each ensemble starts on its own: it draws points from the prior, weights them by
//! the likelihood to a small power, and raises the power to 1 in stages. This finds a narrow posterior from
//! everywhere, and R-hat reveals ensembles that end in different places. With a finer table of the same model, an
//! ensemble starts from its own draws with the coarser one.

use hammer_and_sample::{DifferentialEvolution, MinChainLen, Mixture, Serial, Stretch, sample};
use rayon::prelude::*;

use crate::chance::{self, stream};
use crate::diagnostics::{GREATEST_R_HAT, LEAST_ESS, bulk_ess, r_hat, tail_ess};
use crate::prior::{Point, UNKNOWNS, draw, unknowns};
use crate::target::{Target, Tempered};

/// Amount of sampling.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Effort {
    /// Independent ensembles.
    pub ensembles: usize,
    /// Walkers of each; even, and at least twice the unknowns.
    pub walkers: usize,
    /// Points of the prior from which an ensemble starts.
    pub starts: usize,
    /// Stages in which the likelihood enters.
    pub stages: usize,
    /// Steps of each walker in a stage.
    pub stage_steps: usize,
    /// Steps of each walker that are kept, before any doubling. As many before them are discarded.
    pub steps: usize,
    /// Everything is discarded and as many steps as before are kept, until the chains have mixed and were long enough
    /// to forget their start; at most this many times.
    pub doublings: usize,
}

impl Effort {
    /// For a final answer.
    pub const FULL: Self = Self {
        ensembles: 4,
        walkers: 24,
        starts: 256,
        stages: 6,
        stage_steps: 20,
        steps: 500,
        doublings: 5,
    };

    /// For locating the posterior.
    #[must_use]
    pub const fn quick(self) -> Self {
        Self {
            steps: if self.steps < 500 { self.steps } else { 500 },
            doublings: 0,
            ..self
        }
    }

    /// Description for a record.
    #[must_use]
    pub fn text(&self) -> String {
        format!(
            "{} ensembles of {} walkers, stretch and differential-evolution moves (hammer-and-sample), likelihood \
             brought in over {} stages of {} steps from {} points of the prior each, as many steps thrown away as kept",
            self.ensembles, self.walkers, self.stages, self.stage_steps, self.starts
        )
    }
}

/// The kept draws: for each ensemble, step by step, one point of each walker.
#[derive(Clone, Debug, PartialEq)]
pub struct Draws {
    /// Walkers of an ensemble.
    pub walkers: usize,
    /// Points of each ensemble.
    pub ensembles: Vec<Vec<Point>>,
    /// Share of accepted proposals.
    pub accepted: f64,
}

/// Least length of the discarded part of the chains, in autocorrelation times of the slowest unknown. The kept part is
/// as long, so it is the number of effective draws of each walker.
const LEAST_TIMES: f64 = 20.0;

/// How well an unknown is sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mixing {
    /// Rank-normalised split R-hat.
    pub r_hat: f64,
    /// Bulk effective sample size.
    pub ess: f64,
    /// Tail effective sample size: that of the 5 % or of the 95 % quantile.
    pub tail_ess: f64,
}

impl Mixing {
    /// Whether quantiles are reliable. NaN means no.
    #[must_use]
    pub fn is_enough(&self) -> bool {
        self.r_hat <= GREATEST_R_HAT && self.ess >= LEAST_ESS && self.tail_ess >= LEAST_ESS
    }

    /// Whether chains that discarded as much as they kept have forgotten their start.
    fn has_forgotten(&self, chains: usize) -> bool {
        self.ess >= LEAST_TIMES * chains as f64
    }
}

/// Position of a draw, each number from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    /// Its ensemble.
    pub ensemble: usize,
    /// Its walker, counted through all ensembles.
    pub chain: usize,
    /// The step of its walker.
    pub draw: usize,
}

impl Draws {
    /// Number of draws.
    #[must_use]
    pub fn count(&self) -> usize {
        self.ensembles.iter().map(Vec::len).sum()
    }

    /// All draws, by ensemble, step and walker.
    pub fn all(&self) -> impl Iterator<Item = (Place, &Point)> {
        let of = move |(ensemble, points): (usize, &'_ Vec<Point>)| {
            (0..points.len()).map(move |number| Place {
                ensemble,
                chain: ensemble * self.walkers + number % self.walkers,
                draw: number / self.walkers,
            })
        };
        let places = self.ensembles.iter().enumerate().flat_map(of);
        places.zip(self.ensembles.iter().flatten())
    }

    /// How well each unknown is sampled. R-hat is that of the values, which a program that reads the draws finds again:
    /// distances from the median, unlike ranks, depend on the coordinate.
    #[must_use]
    pub fn mixing(&self) -> [Mixing; UNKNOWNS] {
        core::array::from_fn(|unknown| {
            let shape = unknowns()[unknown].shape;
            let value = |point: &Point| shape.value(point[unknown]);
            let one = |ensemble: &Vec<Point>| ensemble.iter().map(value).collect();
            let chains: Vec<Vec<f64>> = self.ensembles.iter().map(one).collect();
            Mixing {
                r_hat: r_hat(&chains, self.walkers),
                ess: bulk_ess(&chains, self.walkers),
                tail_ess: tail_ess(&chains, self.walkers),
            }
        })
    }

    /// At most `count` draws, evenly spread over ensembles, time and walkers: those of one walker depend on each other more
    /// than those of several.
    #[must_use]
    pub fn thinned(&self, count: usize) -> Vec<Point> {
        let all: Vec<&Point> = self.ensembles.iter().flatten().collect();
        let count = count.min(all.len());
        let of = |part: usize| {
            let even = (2 * part + 1) * all.len() / (2 * count);
            let step = even - even % self.walkers;
            all.get(step + part % self.walkers).unwrap_or(&all[even])
        };
        (0..count).map(|part| **of(part)).collect()
    }

    /// Values of an unknown in all draws, sorted.
    #[must_use]
    pub fn sorted(&self, unknown: usize) -> Vec<f64> {
        let all = self.ensembles.iter().flatten();
        let shape = unknowns()[unknown].shape;
        let mut values: Vec<f64> = all.map(|point| shape.value(point[unknown])).collect();
        values.sort_by(f64::total_cmp);
        values
    }
}

/// Number of a random stream: each ensemble, each round of it and each walker in it has its own.
fn number(ensemble: usize, round: usize, walker: usize) -> u64 {
    (ensemble as u64) << 40 | (round as u64) << 20 | walker as u64
}

/// Round of an ensemble's starting points; stages and kept rounds follow.
const START: usize = 0;

fn advance(
    target: &Target<'_>,
    power: f64,
    seed: u64,
    (ensemble, round): (usize, usize),
    from: &[Point],
    steps: usize,
) -> (Vec<Point>, usize) {
    // Optimal for a round posterior of this many unknowns. Use the whole difference now and then: it leads from mode
    // to mode.
    let best = 2.38 / libm::sqrt(2.0 * UNKNOWNS as f64);
    let moves = Mixture::from((
        (Stretch::default(), 3u32),
        (DifferentialEvolution::new(best, 0.3 * best), 5),
        (DifferentialEvolution::new(1.0, 1e-3), 2),
    ));
    let walkers = (0..).zip(from).map(|(walker, point)| {
        let random = stream(seed, number(ensemble, round, walker + 1));
        (*point, random)
    });
    let length = MinChainLen(steps * from.len());
    let (chain, accepted) = sample(
        &Tempered {
            target: *target,
            power,
        },
        &moves,
        walkers,
        length,
        Serial,
    );
    (chain, accepted)
}

/// The walkers after the last step.
fn last(chain: &[Point], walkers: usize) -> Vec<Point> {
    chain[chain.len() - walkers..].to_vec()
}

/// Effective number of weighted points.
fn worth(weights: &[f64]) -> f64 {
    let sum: f64 = weights.iter().sum();
    let squares: f64 = weights.iter().map(|weight| weight * weight).sum();
    sum * sum / squares
}

fn weights(logs: &[f64], power: f64) -> Vec<f64> {
    let greatest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    logs.iter()
        .map(|log| libm::exp(power * (log - greatest)))
        .collect()
}

/// Moves ensembles from their start to the posterior.
struct WarmUp<'a> {
    target: &'a Target<'a>,
    effort: &'a Effort,
    seed: u64,
    /// Their draws with another table of the same model.
    before: Option<&'a Draws>,
}

impl WarmUp<'_> {
    /// Starting points of an ensemble: draws of the prior, or its own draws with the previous table.
    fn starts(&self, ensemble: usize) -> Vec<Point> {
        let mut random = stream(self.seed, number(ensemble, START, 0));
        let effort = self.effort;
        match self.before.and_then(|draws| draws.ensembles.get(ensemble)) {
            Some(found) if !found.is_empty() => (0..effort.starts)
                .map(|part| found[part * found.len() / effort.starts])
                .collect(),
            _ => (0..effort.starts).map(|_| draw(&mut random)).collect(),
        }
    }

    /// Chooses the walkers of an ensemble among its starting points. Returns the power of the likelihood used: the
    /// largest at which the effective number of points is at least the number of walkers.
    fn begin(&self, ensemble: usize) -> Option<(Vec<Point>, f64)> {
        let points = self.starts(ensemble);
        let mut random = stream(self.seed, number(ensemble, START, 1));
        let walkers = self.effort.walkers;
        let logs: Vec<f64> = (points.iter())
            .map(|point| self.target.log_likelihood(point))
            .collect();
        if logs.iter().all(|log| !log.is_finite()) {
            return None;
        }
        let count = points.len() as f64;
        let spreads: Point = core::array::from_fn(|axis| {
            let mean = points.iter().map(|point| point[axis]).sum::<f64>() / count;
            let square = |point: &Point| (point[axis] - mean).powi(2);
            (points.iter().map(square).sum::<f64>() / count).sqrt()
        });
        let enough = walkers as f64;
        let (mut low, mut high) = (0.0, 1.0);
        if worth(&weights(&logs, high)) < enough {
            for _ in 0..60 {
                let middle = f64::midpoint(low, high);
                if worth(&weights(&logs, middle)) < enough {
                    high = middle;
                } else {
                    low = middle;
                }
            }
        } else {
            low = 1.0;
        }
        let weights = weights(&logs, low);
        let sum: f64 = weights.iter().sum();
        let mut chosen = Vec::with_capacity(walkers);
        let offset = chance::unit(&mut random);
        let (mut place, mut reached) = (0, weights[0]);
        for walker in 0..walkers {
            let wanted = sum * (walker as f64 + offset) / walkers as f64;
            while reached < wanted && place + 1 < points.len() {
                place += 1;
                reached += weights[place];
            }
            // Spread the walkers: from one common place, moves along differences could not leave it.
            let mut point = points[place];
            for (z, spread) in point.iter_mut().zip(spreads) {
                *z += 0.01 * spread * chance::normal(&mut random);
            }
            chosen.push(point);
        }
        Some((chosen, low))
    }

    /// Moves an ensemble to the posterior, where it begins to forget its start.
    fn walkers(&self, ensemble: usize) -> Option<Vec<Point>> {
        let Self {
            target,
            effort,
            seed,
            ..
        } = *self;
        let (mut walkers, power) = self.begin(ensemble)?;
        for stage in 1..=effort.stages {
            let part = stage as f64 / effort.stages as f64;
            let power = libm::pow(power, 1.0 - part);
            let at = (ensemble, stage);
            let (chain, _) = advance(target, power, seed, at, &walkers, effort.stage_steps);
            walkers = last(&chain, effort.walkers);
        }
        let at = (ensemble, effort.stages + 1);
        let (chain, _) = advance(target, 1.0, seed, at, &walkers, effort.steps);
        Some(last(&chain, effort.walkers))
    }
}

/// Samples until the chains have mixed or the effort is spent. Starts from the prior, or from each ensemble's earlier
/// draws. None if no point of the prior has a likelihood. The result does not depend on the number of threads.
#[must_use]
pub fn sample_from(
    target: &Target<'_>,
    effort: &Effort,
    seed: u64,
    before: Option<&Draws>,
) -> Option<Draws> {
    let warm_up = WarmUp {
        target,
        effort,
        seed,
        before,
    };
    let mut stand: Vec<Vec<Point>> = (0..effort.ensembles)
        .into_par_iter()
        .map(|ensemble| warm_up.walkers(ensemble))
        .collect::<Option<_>>()?;
    let mut draws = Draws {
        walkers: effort.walkers,
        ensembles: vec![],
        accepted: 0.0,
    };
    for doubling in 0..=effort.doublings {
        let round = effort.stages + 2 + doubling;
        // A round is as long as all rounds before it, and these are what it discards.
        let steps = effort.steps << doubling;
        let more: Vec<(Vec<Point>, usize)> = (stand.par_iter().enumerate())
            .map(|(ensemble, from)| advance(target, 1.0, seed, (ensemble, round), from, steps))
            .collect();
        let accepted: usize = more.iter().map(|(_, count)| count).sum();
        draws.ensembles = more.into_iter().map(|(chain, _)| chain).collect();
        draws.accepted = accepted as f64 / draws.count() as f64;
        for (from, chain) in stand.iter_mut().zip(&draws.ensembles) {
            *from = last(chain, effort.walkers);
        }
        let chains = effort.ensembles * effort.walkers;
        let done = |one: &Mixing| one.is_enough() && one.has_forgotten(chains);
        if doubling < effort.doublings && draws.mixing().iter().all(done) {
            break;
        }
    }
    Some(draws)
}
