//! Whether a posterior may be believed, and each reason not to, in a sentence.
//!
//! The discrepancy tau absorbs what the model cannot explain, so a posterior-predictive check with tau always looks
//! good. These checks leave tau out, or ask what it had to absorb. They see that data and model disagree; they cannot
//! see a body that moves as another body of the model would at every indentation and speed of the trials.

use std::collections::BTreeMap;

use locomotion::range::OutOfRange;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::descent::{Place, lowest};
use crate::observation::{Case, Condition, Kind, Lubrication};
use crate::prior::{DISCREPANCY, OF_BODY, Parts, Point, UNKNOWNS, parts, unknowns};
use crate::sampler::Draws;
use crate::target::Target;

/// Probability by chance below which a check makes a posterior unreliable.
const UNRELIABLE: f64 = 1e-3;
/// Probability by chance below which a check is a doubt.
const DOUBTED: f64 = 0.05;
/// Part of the prior, at either end, in which draws count as lying at the bound.
const END: f64 = 0.05;
/// Share of the draws there above which the bound counts as a doubt: four times the prior's own share.
const AT_BOUND: f64 = 0.2;
/// Share above which the posterior is unreliable: most of it lies at the bound.
const MOSTLY_AT_BOUND: f64 = 0.5;
/// A net displacement this many times as far as its passes, or its passes as far as it, contradicts them. A run differs
/// from its passes by its ends only: the rollers stand over the body there.
const CONTRADICTION: f64 = 2.0;
/// Standard deviations that a contradiction has to exceed.
const CERTAIN: f64 = 4.0;
/// Standard deviation of a measured indentation, mm [assumed]: half the difference of two widths, each the mean of five
/// caliper readings that are off by 0.05 to 0.1 mm.
const CLAMPED_MM: f64 = 0.03;
/// Difference of indentation over which the model's slope is taken, mm: over less, the steps of its rollers show.
const SLOPE_MM: f64 = 0.1;
/// Draws that leave one condition out by their weights.
const WEIGHTED: usize = 4_000;

/// The subject of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Check {
    /// Whether the chains have mixed.
    Mixing,
    /// Whether the tables were fine enough.
    Table,
    /// Chi-square without tau.
    ChiSquare,
    /// tau beyond its prior.
    Discrepancy,
    /// An unknown at an end of its prior.
    Bound,
    /// Residuals over the indentation.
    Trend,
    /// One condition beside all others.
    LeftOut,
    /// Dry beside lubricated trials.
    Walls,
    /// Net displacements beside passes: sign and magnitude.
    NetAndPasses,
}

/// A reason not to believe a posterior.
#[derive(Clone, Debug, PartialEq)]
pub struct Reason {
    /// The check that gives it.
    pub check: Check,
    /// Whether it makes the posterior unreliable; otherwise it is a doubt.
    pub unreliable: bool,
    /// The reason, in a sentence.
    pub sentence: String,
}

/// Squared residuals without tau, at the body that lies nearest to the trials.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChiSquare {
    /// Sum of the squared residuals over their variances.
    pub value: f64,
    /// Conditions less unknowns of the body.
    pub degrees: usize,
    /// Probability that chance exceeds it.
    pub p: f64,
}

/// The verdict on a posterior.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verdict {
    /// None for too few conditions to leave anything over.
    pub chi_square: Option<ChiSquare>,
    /// The reasons, those that make it unreliable first.
    pub reasons: Vec<Reason>,
}

impl Verdict {
    /// Whether no reason makes the posterior unreliable.
    #[must_use]
    pub fn is_reliable(&self) -> bool {
        self.reasons.iter().all(|reason| !reason.unreliable)
    }

    /// Whether this check gives a reason, if only a doubt.
    #[must_use]
    pub fn says(&self, check: Check) -> bool {
        self.reasons.iter().any(|reason| reason.check == check)
    }

    /// Adds a reason in its place.
    pub fn add(&mut self, check: Check, unreliable: bool, sentence: String) {
        self.reasons.push(Reason {
            check,
            unreliable,
            sentence,
        });
        self.reasons.sort_by_key(|reason| !reason.unreliable);
    }

    /// Adds a reason if its probability by chance is small.
    fn weigh(&mut self, check: Check, p: f64, sentence: impl FnOnce() -> String) {
        if p < DOUBTED {
            self.add(check, p < UNRELIABLE, sentence());
        }
    }
}

/// The model's displacements of cases with a body, mm.
pub type Exact<'a> = dyn Fn(&Parts, &[Case]) -> Result<Vec<f64>, OutOfRange> + 'a;

/// Judges the draws of a posterior. `exact` is the model itself.
///
/// # Errors
/// A case or a body that the model does not cover.
pub fn judge(target: &Target<'_>, draws: &Draws, exact: &Exact<'_>) -> Result<Verdict, OutOfRange> {
    let mut verdict = Verdict::default();
    let body = nearest(target, draws);
    let cases: Vec<Case> = (target.conditions.iter())
        .map(|condition| condition.case)
        .collect();
    let residual = |(condition, found_mm): (&Condition, f64)| {
        (condition.mean_mm - found_mm) / condition.uncertainty_mm
    };
    let found_mm = exact(&body, &cases)?;
    let residuals: Vec<f64> = (target.conditions.iter())
        .zip(found_mm.iter().copied())
        .map(residual)
        .collect();
    chi_square(&mut verdict, &residuals);
    discrepancy(&mut verdict, draws);
    bounds(&mut verdict, draws);
    trends(&mut verdict, target.conditions, &residuals);
    left_out(&mut verdict, target, draws);
    let shifts_mm = shifts_mm(&body, &cases, &found_mm, exact)?;
    walls(&mut verdict, target.conditions, &residuals, &shifts_mm);
    net_and_passes(&mut verdict, target.conditions);
    Ok(verdict)
}

/// The body nearest to the trials without tau, found by a descent from the posterior's mean: the mean of a bent
/// posterior lies beside it.
fn nearest(target: &Target<'_>, draws: &Draws) -> Parts {
    let points = draws.thinned(WEIGHTED);
    let count = points.len() as f64;
    let mean: Place =
        core::array::from_fn(|axis| points.iter().map(|point| point[axis]).sum::<f64>() / count);
    let spread: Place = core::array::from_fn(|axis| {
        let square = |point: &Point| (point[axis] - mean[axis]).powi(2);
        libm::sqrt(points.iter().map(square).sum::<f64>() / count)
    });
    let body = |place: &Place| {
        let mut point = [0.0; UNKNOWNS];
        point[..OF_BODY].copy_from_slice(place);
        parts(&point)
    };
    let cost = |place: &Place| {
        let Some(found_mm) = target.table.displacements_mm(&body(place)) else {
            return f64::INFINITY;
        };
        let one = |(condition, place): (&Condition, &usize)| {
            ((condition.mean_mm - found_mm[*place]) / condition.uncertainty_mm).powi(2)
        };
        target.conditions.iter().zip(target.places).map(one).sum()
    };
    let of = |point: &Point| -> Place { core::array::from_fn(|axis| point[axis]) };
    let best = (points.iter().map(of))
        .map(|place| (cost(&place), place))
        .min_by(|one, other| one.0.total_cmp(&other.0));
    let found = core::iter::once(mean).chain(best.map(|(_, place)| place));
    let (place, _) = found
        .map(|start| lowest(&cost, &start, &spread))
        .min_by(|one, other| one.1.total_cmp(&other.1))
        .unwrap_or((mean, f64::INFINITY));
    body(&place)
}

/// Probability that chance exceeds a chi-square.
fn exceeded(value: f64, degrees: usize) -> f64 {
    ChiSquared::new(degrees as f64).map_or(f64::NAN, |chi| chi.sf(value))
}

/// Probability that chance is as far off to either side, in standard deviations.
fn two_sided(off: f64) -> f64 {
    libm::erfc(libm::fabs(off) / core::f64::consts::SQRT_2)
}

fn probability(p: f64) -> String {
    if p < 1e-4 {
        format!("{p:.0e}")
    } else {
        format!("{p:.4}")
    }
}

/// A condition in words: kind, wall and indentation.
#[must_use]
pub fn name(condition: &Condition) -> String {
    let Case {
        kind,
        indentation_mm,
    } = condition.case;
    format!("{kind}, {}, at {indentation_mm} mm", condition.lubrication)
}

fn chi_square(verdict: &mut Verdict, residuals: &[f64]) {
    let Some(degrees) = (residuals.len().checked_sub(OF_BODY)).filter(|degrees| *degrees > 0)
    else {
        return;
    };
    let value = residuals.iter().map(|off| off * off).sum();
    let p = exceeded(value, degrees);
    verdict.chi_square = Some(ChiSquare { value, degrees, p });
    verdict.weigh(Check::ChiSquare, p, || {
        format!(
            "without tau the nearest body misses the displacements by a chi-square of {value:.1} at {degrees} degrees of \
             freedom, p {}: tau absorbs what the model does not explain",
            probability(p)
        )
    });
}

fn discrepancy(verdict: &mut Verdict, draws: &Draws) {
    let unknown = unknowns()[OF_BODY];
    let sorted = draws.sorted(OF_BODY);
    let Some(median_mm) = sorted.get(sorted.len() / 2) else {
        return;
    };
    let limit_mm = unknown.shape.quantile(0.95);
    if *median_mm > limit_mm {
        let sentence = format!(
            "{DISCREPANCY} has a median of {median_mm:.2} mm, beyond 95 % of its prior, {limit_mm:.2} mm: the model is wrong \
             by more than was thought possible"
        );
        verdict.add(Check::Discrepancy, true, sentence);
    }
}

fn bounds(verdict: &mut Verdict, draws: &Draws) {
    let all = || draws.ensembles.iter().flatten();
    let count = all().count().max(1) as f64;
    for (axis, unknown) in unknowns()[..OF_BODY].iter().enumerate() {
        let share = |at_end: fn(f64) -> bool| {
            all().filter(|point| at_end(parts(point)[axis])).count() as f64 / count
        };
        let low = share(|part| part < END);
        let high = share(|part| part > 1.0 - END);
        let (end, share, bound) = if high > low {
            ("upper", high, unknown.shape.quantile(1.0))
        } else {
            ("lower", low, unknown.shape.quantile(0.0))
        };
        if share > AT_BOUND {
            // Rounding has taken something from a bound such as 0.2.
            let bound = (bound * 1e9).round() / 1e9;
            let sentence = format!(
                "{} lies at the {end} end of its prior, {bound}, with {:.0} % of the draws in the last twentieth of it: the \
                 prior decides, not the trials",
                unknown.key,
                100.0 * share
            );
            verdict.add(Check::Bound, share > MOSTLY_AT_BOUND, sentence);
        }
    }
}

/// The conditions of a kind on a wall, each with its residual in standard deviations.
type Series<'a> = (Kind, Lubrication, Vec<(&'a Condition, f64)>);

/// Fewest notches over which a trend is asked.
const LEAST_NOTCHES: usize = 3;

fn trends(verdict: &mut Verdict, conditions: &[Condition], residuals: &[f64]) {
    let mut series: Vec<Series<'_>> = vec![];
    for (condition, residual) in conditions.iter().zip(residuals) {
        let key = (condition.case.kind, condition.lubrication);
        let point = (condition, *residual);
        match series.iter_mut().find(|one| (one.0, one.1) == key) {
            Some(known) => known.2.push(point),
            None => series.push((key.0, key.1, vec![point])),
        }
    }
    // The conditions of a series are sorted by their indentation.
    series.retain(|(_, _, all)| {
        let notches = all.chunk_by(|(left, _), (right, _)| left.notch == right.notch);
        notches.count() >= LEAST_NOTCHES
    });
    let count = series.len() as f64;
    let slope = |conditions: &[(&Condition, f64)]| {
        let points = || (conditions.iter()).map(|(one, off)| (one.case.indentation_mm, off));
        let middle = points().map(|(a, _)| a).sum::<f64>() / conditions.len() as f64;
        let along: f64 = points().map(|(a, off)| (a - middle) * off).sum();
        let square: f64 = points().map(|(a, _)| (a - middle).powi(2)).sum();
        along / libm::sqrt(square)
    };
    let steepest = series
        .iter()
        .map(|one| (slope(&one.2), one))
        .max_by(|one, other| libm::fabs(one.0).total_cmp(&libm::fabs(other.0)));
    let Some((steep, (kind, lubrication, _))) = steepest else {
        return;
    };
    let p = (count * two_sided(steep)).min(1.0);
    verdict.weigh(Check::Trend, p, || {
        let rises = if steep > 0.0 { "rises" } else { "falls" };
        format!(
            "without tau the residual of the {kind}, {lubrication}, {rises} with the indentation by {:.1} standard deviations, \
             p {} among {count} series: a parameter that the model keeps changes with the indentation",
            libm::fabs(steep),
            probability(p)
        )
    });
}

/// Leaves each condition out in turn. The draws of the posterior stand for that of the other conditions by weights,
/// one over the condition's likelihood, cut off where few draws would decide (Ionides 2008).
fn left_out(verdict: &mut Verdict, target: &Target<'_>, draws: &Draws) {
    let count = target.conditions.len();
    if count < 2 {
        return;
    }
    let points = draws.thinned(WEIGHTED);
    let without: Vec<_> = (points.iter())
        .filter_map(|point| target.without(point))
        .collect();
    let p = |place: usize| {
        let least =
            (without.iter().map(|all| all[place].log_density)).fold(f64::INFINITY, f64::min);
        let weights: Vec<f64> = (without.iter())
            .map(|all| libm::exp(least - all[place].log_density))
            .collect();
        let most = weights.iter().sum::<f64>() / libm::sqrt(weights.len() as f64);
        let (mut sum, mut below) = (0.0, 0.0);
        for (weight, all) in weights.iter().zip(&without) {
            let weight = weight.min(most);
            sum += weight;
            below += weight * 0.5 * libm::erfc(-all[place].off / core::f64::consts::SQRT_2);
        }
        let part: f64 = below / sum;
        2.0 * part.min(1.0 - part)
    };
    let worst = (0..count)
        .map(|place| (p(place), place))
        .min_by(|one, other| one.0.total_cmp(&other.0));
    if let Some((p, place)) = worst {
        let among = (count as f64 * p).min(1.0);
        verdict.weigh(Check::LeftOut, among, || {
            format!(
                "the other conditions do not predict the {}, p {} among {count} conditions: the readings there are wrong, or the \
                 model is",
                name(&target.conditions[place]),
                probability(among)
            )
        });
    }
}

/// How far each case moves if its clamping is deeper by [`CLAMPED_MM`], mm: `found_mm` are its displacements as it is.
fn shifts_mm(
    body: &Parts,
    cases: &[Case],
    found_mm: &[f64],
    exact: &Exact<'_>,
) -> Result<Vec<f64>, OutOfRange> {
    // Shallower, because the model may not cover a deeper one.
    let less_mm = |case: &Case| SLOPE_MM.min(case.indentation_mm / 2.0);
    let shallower = |case: &Case| Case {
        indentation_mm: case.indentation_mm - less_mm(case),
        ..*case
    };
    let shallower_mm = exact(body, &cases.iter().map(shallower).collect::<Vec<_>>())?;
    let shift_mm = |((case, at_mm), shallower_mm): ((&Case, &f64), f64)| {
        (at_mm - shallower_mm) * CLAMPED_MM / less_mm(case)
    };
    let all = cases.iter().zip(found_mm).zip(shallower_mm);
    Ok(all.map(shift_mm).collect())
}

/// Compares the conditions of a kind and notch that were measured on both walls. The model predicts the same for both
/// but for the clamping, whose measured indentation the residuals leave out. Its error shifts all conditions of the
/// clamping together, however often they were repeated.
fn walls(verdict: &mut Verdict, conditions: &[Condition], residuals: &[f64], shifts_mm: &[f64]) {
    let mut sides: BTreeMap<(Kind, usize), [Vec<usize>; 2]> = BTreeMap::new();
    for (place, condition) in conditions.iter().enumerate() {
        let key = (condition.case.kind, condition.notch);
        let wet = usize::from(condition.lubrication == Lubrication::Lubricated);
        sides.entry(key).or_default()[wet].push(place);
    }
    sides.retain(|_, both| both.iter().all(|side| !side.is_empty()));
    if sides.is_empty() {
        return;
    }
    let precision =
        |place: &usize| libm::hypot(conditions[*place].uncertainty_mm, shifts_mm[*place]).powi(-2);
    // Dry less lubricated, with the variance by the readings, and the shift by each clamping that has a part in it.
    let difference = |[dry, wet]: &[Vec<usize>; 2]| {
        let (mut off_mm, mut variance, mut clampings) = (0.0, 0.0, BTreeMap::new());
        for (side, sign) in [(dry, 1.0), (wet, -1.0)] {
            let sum: f64 = side.iter().map(precision).sum();
            for place in side {
                let condition = &conditions[*place];
                let part = sign * precision(place) / sum;
                let clamping = (sign > 0.0, condition.case.indentation_mm.to_bits());
                off_mm += part * residuals[*place] * condition.uncertainty_mm;
                variance += (part * condition.uncertainty_mm).powi(2);
                *clampings.entry(clamping).or_insert(0.0) += part * shifts_mm[*place];
            }
        }
        (off_mm, variance, clampings)
    };
    let all: Vec<_> = sides.values().map(difference).collect();
    let covariance = |one: usize, other: usize| {
        let shared = (all[one].2.iter())
            .filter_map(|(clamping, shift_mm)| Some(shift_mm * all[other].2.get(clamping)?));
        let own = if one == other { all[one].1 } else { 0.0 };
        own + shared.sum::<f64>()
    };
    let degrees = all.len();
    let row = |one| (0..degrees).map(|other| covariance(one, other)).collect();
    let errors = all.iter().map(|(off_mm, ..)| *off_mm).collect();
    let value = chi_square_of((0..degrees).map(row).collect(), errors);
    let p = exceeded(value, degrees);
    verdict.weigh(Check::Walls, p, || {
        format!(
            "dry and lubricated trials differ by a chi-square of {value:.1} at {degrees} degrees of freedom, p {}: one \
             friction ratio does not hold for both walls; fit them apart",
            probability(p)
        )
    });
}

/// Chi-square of errors with these covariances: of each, what those before it do not predict.
fn chi_square_of(mut covariances: Vec<Vec<f64>>, mut errors: Vec<f64>) -> f64 {
    let mut sum = 0.0;
    for at in 0..errors.len() {
        let (row, error) = (covariances[at].clone(), errors[at]);
        sum += error * error / row[at];
        for later in at + 1..errors.len() {
            let share = row[later] / row[at];
            errors[later] -= share * error;
            for (covariance, one) in covariances[later].iter_mut().zip(&row) {
                *covariance -= share * one;
            }
        }
    }
    sum
}

/// Compares each net displacement with the isolated passes in its notch and at its wall.
fn net_and_passes(verdict: &mut Verdict, conditions: &[Condition]) {
    for net in conditions {
        let Kind::Net { cycles } = net.case.kind else {
            continue;
        };
        let off_mm =
            |other: &Condition| libm::fabs(other.case.indentation_mm - net.case.indentation_mm);
        // The pass that was clamped nearest.
        let pass = |kind: Kind| {
            let here = conditions.iter().filter(|other| {
                let place = (other.case.kind, other.notch, other.lubrication);
                place == (kind, net.notch, net.lubrication)
            });
            here.min_by(|one, other| off_mm(one).total_cmp(&off_mm(other)))
        };
        let (Some(antegrade), Some(returning)) =
            (pass(Kind::AntegradePass), pass(Kind::ReturningPass))
        else {
            continue;
        };
        let cycles = f64::from(cycles);
        let sum_mm = cycles * (antegrade.mean_mm + returning.mean_mm);
        let passes_mm = cycles * libm::hypot(antegrade.uncertainty_mm, returning.uncertainty_mm);
        // A discrepancy that is not surprising contradicts nothing.
        let usual_mm = net.case.kind.discrepancies() * unknowns()[OF_BODY].shape.quantile(0.95);
        let contradicts = |less: f64, of_less: f64, more: f64, of_more: f64| {
            // Written so that displacements of opposite signs contradict each other, too.
            let beyond = (more - CONTRADICTION * less) * more.signum();
            beyond > usual_mm + CERTAIN * libm::hypot(of_more, CONTRADICTION * of_less)
        };
        let (one, other) = (
            contradicts(net.mean_mm, net.uncertainty_mm, sum_mm, passes_mm),
            contradicts(sum_mm, passes_mm, net.mean_mm, net.uncertainty_mm),
        );
        if one || other {
            let sentence = format!(
                "the {} is {:.1} mm, and {cycles} times its antegrade and returning pass together {sum_mm:.1} mm: signs, units \
                 or cycles of one of them are wrong",
                name(net),
                net.mean_mm
            );
            verdict.add(Check::NetAndPasses, true, sentence);
            break;
        }
    }
}

/// The reasons of the sampling itself.
pub(crate) fn of_sampling(verdict: &mut Verdict, has_mixed: bool, table_error: f64, greatest: f64) {
    if !has_mixed {
        let sentence = "the chains have not mixed: R-hat above 1.01, or fewer than 400 effective draws in the bulk or in \
                        the tails";
        verdict.add(Check::Mixing, true, sentence.to_owned());
    }
    // NaN counts as an error.
    if table_error.partial_cmp(&greatest) == Some(core::cmp::Ordering::Greater)
        || table_error.is_nan()
    {
        let sentence = format!(
            "the model could not be tabulated finely enough: off by {table_error:.2} standard deviations"
        );
        verdict.add(Check::Table, true, sentence);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chance::{normal, stream};

    /// The readings of a run of ten strokes, which move by `slope` of their number per millimetre of indentation, in
    /// five notches on both walls; `wet_mm` is added to those of the lubricated wall, for each stroke.
    fn found(seed: u64, slope: f64, wet_mm: f64) -> Verdict {
        let mut random = stream(seed, 0);
        let (mut conditions, mut residuals, mut shifts_mm) = (vec![], vec![], vec![]);
        for lubrication in [Lubrication::Dry, Lubrication::Lubricated] {
            for notch in 0..5 {
                let deeper = normal(&mut random);
                for strokes in 1..=10 {
                    let (uncertainty_mm, times) = (0.06, f64::from(strokes));
                    let shift_mm = CLAMPED_MM * slope * times;
                    let is_wet = f64::from(u8::from(lubrication == Lubrication::Lubricated));
                    let off_mm = deeper * shift_mm + is_wet * wet_mm * times;
                    residuals.push(off_mm / uncertainty_mm + normal(&mut random));
                    shifts_mm.push(shift_mm);
                    conditions.push(Condition {
                        case: Case {
                            kind: Kind::after(strokes),
                            indentation_mm: 1.0 + notch as f64,
                        },
                        lubrication,
                        notch,
                        family: 0,
                        repeats: 10,
                        mean_mm: 0.0,
                        uncertainty_mm,
                        scatter: 9.0,
                    });
                }
            }
        }
        let mut verdict = Verdict::default();
        walls(&mut verdict, &conditions, &residuals, &shifts_mm);
        verdict
    }

    /// One clamping shifts all ten readings of a run: ten errors of their own would accuse a twelfth of them.
    #[test]
    fn clampings_off_their_caliper_are_doubted_as_often_as_chance_has_it() {
        const COUNT: u64 = 2_000;
        for slope in [0.0, 0.8] {
            let all = || (0..COUNT).map(|seed| found(seed, slope, 0.0));
            let doubted = all().filter(|one| one.says(Check::Walls)).count();
            let accused = all().filter(|one| !one.is_reliable()).count();
            assert!((60..=140).contains(&doubted), "{slope}: {doubted}");
            assert!(accused <= 8, "{slope}: {accused}");
        }
    }

    /// Beside an error of 0.024 mm per stroke by the clamping, the walls differ by 0.2 mm.
    #[test]
    fn walls_that_differ_by_more_than_their_clampings_are_accused() {
        assert!((0..20).all(|seed| !found(seed, 0.8, 0.2).is_reliable()));
    }

    #[test]
    fn a_posterior_that_was_badly_sampled_is_unreliable() {
        for (has_mixed, table_error, wanted) in [
            (true, 0.5, &[][..]),
            (true, 0.501, &[Check::Table]),
            (true, f64::INFINITY, &[Check::Table]),
            (true, f64::NAN, &[Check::Table]),
            (false, 0.1, &[Check::Mixing]),
        ] {
            let mut verdict = Verdict::default();
            of_sampling(&mut verdict, has_mixed, table_error, 0.5);
            let found: Vec<_> = verdict.reasons.iter().map(|one| one.check).collect();
            assert_eq!(found, wanted, "{table_error}");
            assert_eq!(verdict.is_reliable(), wanted.is_empty());
        }
    }

    #[test]
    fn draws_at_an_end_of_their_prior_are_told() {
        for axis in 0..OF_BODY {
            for (z, end) in [(-2.0, "lower"), (2.0, "upper")] {
                for (there, told) in [
                    (20, None),
                    (21, Some(false)),
                    (50, Some(false)),
                    (51, Some(true)),
                ] {
                    let point = |number: usize| {
                        let mut point = [0.0; UNKNOWNS];
                        if number < there {
                            point[axis] = z;
                        }
                        point
                    };
                    let draws = Draws {
                        walkers: 1,
                        ensembles: vec![(0..100).map(point).collect()],
                        accepted: 1.0,
                    };
                    let mut verdict = Verdict::default();
                    bounds(&mut verdict, &draws);
                    let found = verdict.reasons.first();
                    let unreliable = found.map(|one| one.unreliable);
                    assert_eq!(unreliable, told, "{axis} {z} {there}");
                    assert!(found.is_none_or(|one| one.sentence.contains(end)));
                }
            }
        }
    }

    #[test]
    fn a_net_too_far_from_its_passes_is_named_either_way() {
        for (net_mm, named) in [
            (40.0, true),
            (30.0, false),
            (16.0, false),
            (9.0, false),
            (5.0, true),
            (-16.0, true),
        ] {
            let condition = |kind, mean_mm| Condition {
                case: Case {
                    kind,
                    indentation_mm: 5.0,
                },
                lubrication: Lubrication::Dry,
                notch: 0,
                family: 0,
                repeats: 10,
                mean_mm,
                uncertainty_mm: 0.06,
                scatter: 9.0,
            };
            let conditions = [
                condition(Kind::Net { cycles: 2 }, net_mm),
                condition(Kind::AntegradePass, 10.0),
                condition(Kind::ReturningPass, -2.0),
            ];
            let mut verdict = Verdict::default();
            net_and_passes(&mut verdict, &conditions);
            assert_eq!(verdict.says(Check::NetAndPasses), named, "{net_mm}");
        }
    }
}
