//! Whether chains have mixed: rank-normalised split R-hat, bulk and tail effective sample size (Vehtari, Gelman, Simpson,
//! Carpenter and Bürkner, Bayesian Analysis 16, 2021), also for ensembles of walkers.
//!
//! An ensemble is one chain whose draws come in rows, one draw of each walker. R-hat needs only means and variances
//! of chains, so all walkers of an ensemble count as one chain. The walkers influence each other and are not
//! independent over time. So the effective sample size is that of the row means, times the number of draws that each
//! row mean is worth.

use statrs::function::erf::erf_inv;

/// Largest R-hat of chains that count as mixed.
pub const GREATEST_R_HAT: f64 = 1.01;
/// Least bulk and tail effective sample size for quantiles that are worth printing.
pub const LEAST_ESS: f64 = 400.0;

/// Chains split into halves; each half consists of rows with one draw of each walker.
struct Split {
    walkers: usize,
    halves: Vec<Vec<f64>>,
}

impl Split {
    /// None if the chains are too short to compare.
    fn of(chains: &[Vec<f64>], walkers: usize) -> Option<Self> {
        let rows = chains
            .iter()
            .map(|chain| chain.len() / walkers.max(1))
            .min()?;
        let half = rows / 2;
        if half < 4 || walkers == 0 {
            return None;
        }
        // Leave out the middle row of an odd number.
        let halves = chains.iter().flat_map(|chain| {
            let second = (rows - half) * walkers;
            [
                chain[..half * walkers].to_vec(),
                chain[second..second + half * walkers].to_vec(),
            ]
        });
        Some(Self {
            walkers,
            halves: halves.collect(),
        })
    }

    fn map(&self, of: impl Fn(f64) -> f64) -> Self {
        let halves = self.halves.iter();
        Self {
            walkers: self.walkers,
            halves: halves
                .map(|half| half.iter().map(|value| of(*value)).collect())
                .collect(),
        }
    }

    /// Replaces each value by the normal quantile of its rank among all.
    fn rank_normalised(&self) -> Self {
        let all: Vec<f64> = self.halves.concat();
        let mut order: Vec<usize> = (0..all.len()).collect();
        order.sort_by(|left, right| all[*left].total_cmp(&all[*right]));
        let mut normal = vec![0.0; all.len()];
        let mut from = 0;
        while from < order.len() {
            let mut to = from + 1;
            while to < order.len() && all[order[to]] == all[order[from]] {
                to += 1;
            }
            // Equal values share the mean of their ranks, counted from 1.
            let rank = (from + 1 + to) as f64 / 2.0;
            let part = (rank - 0.375) / (all.len() as f64 + 0.25);
            for place in &order[from..to] {
                normal[*place] = core::f64::consts::SQRT_2 * erf_inv(2.0 * part - 1.0);
            }
            from = to;
        }
        let length = self.halves[0].len();
        Self {
            walkers: self.walkers,
            halves: normal.chunks(length).map(<[f64]>::to_vec).collect(),
        }
    }

    /// Distance of each value from the median of all.
    fn folded(&self) -> Self {
        let median = median(&self.halves.concat());
        self.map(|value| (value - median).abs())
    }

    fn r_hat(&self) -> f64 {
        let (within, total) = variances(&self.halves);
        (total / within).sqrt()
    }

    /// The mean of each row.
    fn row_means(&self) -> Vec<Vec<f64>> {
        let mean_of = |row: &[f64]| mean(row);
        let halves = self.halves.iter();
        halves
            .map(|half| half.chunks(self.walkers).map(mean_of).collect())
            .collect()
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    if sorted.len().is_multiple_of(2) {
        f64::midpoint(sorted[middle - 1], sorted[middle])
    } else {
        sorted[middle]
    }
}

fn variance(values: &[f64]) -> f64 {
    let mean = mean(values);
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    squares / (values.len() - 1) as f64
}

/// W, and the estimate var+ that also counts the differences between chains.
fn variances(chains: &[Vec<f64>]) -> (f64, f64) {
    let length = chains[0].len() as f64;
    let within = mean(
        &chains
            .iter()
            .map(|chain| variance(chain))
            .collect::<Vec<_>>(),
    );
    let means: Vec<f64> = chains.iter().map(|chain| mean(chain)).collect();
    let total = within * (length - 1.0) / length + variance(&means);
    (within, total)
}

/// Effective number of values in chains, by Geyer's initial monotone sequence.
fn effective(chains: &[Vec<f64>]) -> f64 {
    let length = chains[0].len();
    let all = (chains.len() * length) as f64;
    let (within, total) = variances(chains);
    if total <= 0.0 || !total.is_finite() {
        return f64::NAN;
    }
    let means: Vec<f64> = chains.iter().map(|chain| mean(chain)).collect();
    // Covariance at a lag, averaged over the chains. Divided by the length, not by the number of pairs.
    let covariance = |lag: usize| {
        let of = |(chain, mean): (&Vec<f64>, &f64)| {
            let pairs = chain.iter().zip(&chain[lag..]);
            pairs
                .map(|(left, right)| (left - mean) * (right - mean))
                .sum::<f64>()
                / length as f64
        };
        chains.iter().zip(&means).map(of).sum::<f64>() / chains.len() as f64
    };
    let correlation = |lag: usize| 1.0 - (within - covariance(lag)) / total;
    // Sum neighbouring lags in pairs from lag 0 on, while the sums are not negative.
    let mut pairs = vec![(1.0, correlation(1))];
    let mut next = 2;
    let mut beyond = 0.0;
    while pairs[pairs.len() - 1].0 + pairs[pairs.len() - 1].1 > 0.0 && next + 2 < length {
        let pair = (correlation(next), correlation(next + 1));
        if pair.0 + pair.1 < 0.0 {
            // Count the even member of the first rejected pair once, if it is positive.
            beyond = pair.0.max(0.0);
            break;
        }
        pairs.push(pair);
        next += 2;
    }
    // If the chain ends before its correlation does, treat the last pair as the first rejected one.
    if next + 2 >= length && pairs.len() > 1 {
        beyond = pairs.pop().map_or(0.0, |pair| pair.0.max(0.0));
    }
    // The sums must not rise again: any rise is noise.
    let mut time = -1.0 + beyond;
    let mut least = f64::INFINITY;
    for (even, odd) in pairs {
        least = least.min(even + odd);
        time += 2.0 * least;
    }
    let time = time.max(1.0 / all.log10());
    all / time
}

/// Rank-normalised split R-hat: the larger one of two, of the values and of their distances from the median. `walkers`
/// is 1 for plain chains. NaN for chains that are too short or do not move.
#[must_use]
pub fn r_hat(chains: &[Vec<f64>], walkers: usize) -> f64 {
    let Some(split) = Split::of(chains, walkers) else {
        return f64::NAN;
    };
    let bulk = split.rank_normalised().r_hat();
    let tail = split.folded().rank_normalised().r_hat();
    // `max` would ignore a NaN.
    if tail.is_nan() { tail } else { bulk.max(tail) }
}

/// Bulk effective sample size. `walkers` is 1 for plain chains. NaN for chains that are too short or do not move.
#[must_use]
pub fn bulk_ess(chains: &[Vec<f64>], walkers: usize) -> f64 {
    let Some(split) = Split::of(chains, walkers) else {
        return f64::NAN;
    };
    let split = split.rank_normalised();
    let rows = split.row_means();
    let (_, of_draws) = variances(&split.halves);
    let (_, of_rows) = variances(&rows);
    effective(&rows) * of_draws / of_rows
}

/// Tail effective sample size: the smaller of those of the 5 % and of the 95 % quantile. `walkers` is 1 for plain
/// chains. NaN for chains that are too short or do not move.
#[must_use]
pub fn tail_ess(chains: &[Vec<f64>], walkers: usize) -> f64 {
    let Some(split) = Split::of(chains, walkers) else {
        return f64::NAN;
    };
    let mut sorted = chains.concat();
    sorted.sort_by(f64::total_cmp);
    let of = |part: f64| {
        let limit = quantile(&sorted, part);
        let below = split.map(|value| if value <= limit { 1.0 } else { 0.0 });
        let rows = below.row_means();
        let (_, of_draws) = variances(&below.halves);
        let (_, of_rows) = variances(&rows);
        effective(&rows) * of_draws / of_rows
    };
    let (low, high) = (of(0.05), of(0.95));
    // `min` would ignore a NaN.
    if low.is_nan() { low } else { high.min(low) }
}

/// A quantile of sorted values, between two of them by a straight line.
#[must_use]
pub fn quantile(sorted: &[f64], part: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else {
        return f64::NAN;
    };
    let place = part * last as f64;
    let below = (place as usize).min(last);
    let above = (below + 1).min(last);
    sorted[below] + (place - below as f64) * (sorted[above] - sorted[below])
}
