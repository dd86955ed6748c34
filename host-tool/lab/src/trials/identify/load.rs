//! The load of the motor: its own friction, and the pull of the thread on the origami.
//!
//! ```text
//! P = S (F(x) + q v)                      winding, once taut; F by the beam estimate, x travel, v speed
//! P = S ((1 - h) F(x) - q v), at least 0  paying out: a damped origami opens no faster than it can
//! ```
//! `q` is damping over stiffness. After an unfolding the origami has not quite opened when it is folded again, so the
//! thread becomes taut later than the slack alone tells. The hysteresis `h` and the worm's friction act alike while the
//! thread is paid out, so `h` is taken as known within a range; the range is a part of the uncertainty.

use std::sync::OnceLock;

use locomotion::kinematics::Design;

use super::squares::{self, inverse};
use super::{Block, COVERAGE, Estimate, GAIN, IdentifyError, OFFSET_MA, REST_S};

/// Torque of the motor per newton at the thread without friction in the worm, N m. The planetary gear has an
/// efficiency of 0.8 (data sheet).
const TORQUE_PER_N: f64 = 1.5e-3 / 120.0 / 0.8;
/// Lead angle of the worm, degrees (design).
const LEAD_DEG: f64 = 4.0;
/// Force per indentation by the beam estimate, N/mm; E = 50 MPa, b = 10 mm, t = 0.8 mm.
const BEAM_N_PER_MM: f64 = 0.2055;
/// Largest difference of a reading at 100 mA from the mean current, mA [assumed]: the amplifier's output follows the
/// bridge's pulses.
const RIPPLE_MA: f64 = 1.0;
/// Drift of the amplifier's zero from one end of a motion to the other, mA either way [assumed].
const DRIFT_MA: f64 = 0.5;
/// Share of the force that the origami lacks while it opens, and how far it may be from that [assumed]: 0.05 to 0.25 of
/// hysteresis, and a little that relaxes within the fold.
const HYSTERESIS: f64 = 0.17;
const HYSTERESIS_RANGE: f64 = 0.1;
/// Largest difference of the worm's friction paying out from that winding, as a share [assumed].
const DIRECTION: f64 = 0.1;
/// Share of the force by which a crescent that snaps through exceeds it, at most, and the travel over which it builds
/// up and is lost, mm [assumed].
const SNAP: f64 = 0.15;
const SNAP_MM: (f64, f64) = (0.6, 0.05);
/// Ranges of travel with one snap each, mm [assumed].
const SNAPS_MM: [(f64, f64); 3] = [(6.0, 13.0), (13.0, 18.0), (18.0, 21.0)];
/// Places that are tried in each.
const SNAP_PLACES: usize = 9;
/// Softening of the origami in its first cycles, and its relaxation within a fold, as a share [assumed].
const SOFTENING: f64 = 0.02;
/// Travel by which the thread may become taut later than a damped origami opens, mm: in a short recording a step at the
/// slack itself would fix it more narrowly than the zero is known.
const LATER_MM: f64 = 0.7;
/// Difference of the thread's zero from the end of the slack at which the firmware finds it, mm.
const ZERO_MM: f64 = 0.1;

/// Usual noise of a block's current, mA; it sets the weight of prior knowledge in the fit.
const NOISE_MA: f64 = 0.7;
/// Lower limit for the estimated noise of a fit, mA.
const LEAST_NOISE_MA: f64 = 0.5;
/// Ratio of the pull's current paying out to that winding, and its standard deviation: friction of 0.10 to 0.20.
const RATIO: (f64, f64) = (0.29, 0.06);
/// Standard deviation of the no-load current of one motion against that of the other, mA: the amplifier's offset is
/// measured again before each.
const OFFSETS_MA: f64 = 1.0;

/// Number of parameters of the fit.
const COUNT: usize = 7;
type Values = [f64; COUNT];
/// Indices of the parameters: no-load current folding and unfolding, mA; current of the pull winding, mA per newton of
/// the beam estimate; paying out over winding; slack, mm; damping over stiffness, N of the beam estimate per mm/s;
/// travel at which the thread becomes taut, over the most that is left of it after the rest.
const FOLDING: usize = 0;
const UNFOLDING: usize = 1;
const PULL: usize = 2;
const DOWN: usize = 3;
const SLACK: usize = 4;
const DAMPING: usize = 5;
const TAUT: usize = 6;
/// Least and largest values; a calibration leaves a slack of 0 to 3 mm.
const LEAST: Values = [0.0, 0.0, 0.1, 0.0, -0.15, 0.0, 0.0];
const MOST: Values = [60.0, 60.0, 400.0, 1.2, 3.15, 0.4, 1.3];
/// Parameters that a fit must find within their limits, and the meaning if one is at a limit.
const AT_AN_END: [(usize, &str); 4] = [
    (
        SLACK,
        "the thread would be slack by less than 0 or more than 3 mm",
    ),
    (PULL, "the force does not rise with the thread"),
    (
        FOLDING,
        "a motor without friction, or one that hardly turns",
    ),
    (
        UNFOLDING,
        "a motor without friction, or one that hardly turns",
    ),
];
/// Steps of the numerical derivatives.
const STEPS: Values = [0.1, 0.1, 0.1, 0.01, 0.01, 0.001, 0.02];
/// Where the fit starts: each slack with each damping and travel.
const SLACKS_MM: [f64; 4] = [0.2, 0.8, 1.4, 2.2];
const DAMPINGS: [f64; 8] = [0.002, 0.01, 0.02, 0.03, 0.045, 0.06, 0.085, 0.12];
const TAUTS: [f64; 2] = [0.2, 0.8];
/// Number of starts that are followed to their end.
const FOLLOWED: usize = 3;
/// Most steps of a fit.
const MOST_STEPS: usize = 40;

/// The blocks of both motions.
#[derive(Clone, Copy)]
struct Readings<'a> {
    folding: &'a [Block],
    unfolding: &'a [Block],
    hysteresis: f64,
}

/// A fit of the load.
pub(super) struct Load {
    values: Values,
    /// Expanded uncertainties without that of the hysteresis.
    uncertainties: Values,
    /// Values with the least and the largest hysteresis.
    with: [(f64, Values); 2],
}

/// Fits the load of both motions.
///
/// # Errors
/// [`IdentifyError::NoFit`].
pub(super) fn fit(folding: &[Block], unfolding: &[Block]) -> Result<Load, IdentifyError> {
    let readings = Readings {
        folding,
        unfolding,
        hysteresis: HYSTERESIS,
    };
    let no_fit = IdentifyError::NoFit("the force does not rise with the thread");
    let values = readings.best().ok_or(no_fit)?;
    for (index, why) in AT_AN_END {
        if values[index] <= LEAST[index] || values[index] >= MOST[index] {
            return Err(IdentifyError::NoFit(why));
        }
    }
    if values[DAMPING] >= MOST[DAMPING] {
        return Err(IdentifyError::NoFit("the origami would hardly open"));
    }
    let uncertainties = readings.uncertainties(&values).ok_or(no_fit)?;
    let with = [-HYSTERESIS_RANGE, HYSTERESIS_RANGE].map(|more| {
        let hysteresis = HYSTERESIS + more;
        let other = Readings {
            hysteresis,
            ..readings
        };
        (hysteresis, other.descend(values).0)
    });
    Ok(Load {
        values,
        uncertainties,
        with,
    })
}

/// Friction of the worm, and how far it may be from that for each reason.
pub(super) struct Friction {
    value: f64,
    fit: f64,
    direction: f64,
    /// With the least and the largest hysteresis.
    with: [f64; 2],
}

impl Friction {
    pub(super) fn estimate(&self) -> Estimate {
        Estimate {
            value: self.value,
            uncertainty: self.uncertainty(),
        }
    }

    /// Hysteresis and direction are ranges, not standard deviations: both may be at their ends, so they add up.
    fn uncertainty(&self) -> f64 {
        let hysteresis = self.with.map(|one| (one - self.value).abs());
        let ranges = hysteresis[0].max(hysteresis[1]) + self.direction;
        self.fit.hypot(ranges)
    }
}

impl Load {
    pub(super) fn no_load_ma(&self) -> Estimate {
        let value = f64::midpoint(self.values[FOLDING], self.values[UNFOLDING]);
        let fit = self.uncertainties[FOLDING].hypot(self.uncertainties[UNFOLDING]) / 2.0;
        Estimate {
            value,
            uncertainty: fit.hypot(OFFSET_MA) + GAIN * value,
        }
    }

    pub(super) fn slack_mm(&self) -> Estimate {
        let value = self.values[SLACK];
        let hysteresis = self.with.map(|(_, with)| (with[SLACK] - value).abs());
        Estimate {
            value,
            uncertainty: self.uncertainties[SLACK].hypot(hysteresis[0].max(hysteresis[1]))
                + ZERO_MM,
        }
    }

    /// # Errors
    /// [`IdentifyError::NoFit`] if it would be 1 or more.
    pub(super) fn worm_friction(&self) -> Result<Friction, IdentifyError> {
        let too_much = IdentifyError::NoFit("paying out takes nearly as much as winding");
        let of = |down: f64, hysteresis: f64, direction: f64| {
            friction(down.max(0.0) / (1.0 - hysteresis), direction)
        };
        // The interval of an estimate ends at 1, too.
        let end = |down, hysteresis, direction| of(down, hysteresis, direction).unwrap_or(1.0);
        let down = self.values[DOWN];
        let value = of(down, HYSTERESIS, 0.0).ok_or(too_much)?;
        let most_off = |of: [f64; 2]| (of[0] - value).abs().max((of[1] - value).abs());
        let fit = self.uncertainties[DOWN];
        Ok(Friction {
            value,
            fit: most_off([
                end(down - fit, HYSTERESIS, 0.0),
                end(down + fit, HYSTERESIS, 0.0),
            ]),
            direction: most_off([
                end(down, HYSTERESIS, -DIRECTION),
                end(down, HYSTERESIS, DIRECTION),
            ]),
            with: self
                .with
                .map(|(hysteresis, with)| end(with[DOWN], hysteresis, 0.0)),
        })
    }

    pub(super) fn stiffness(&self, constant_mvs: f64, friction: &Friction) -> Estimate {
        let raised = raising(friction.value);
        // mA mV s/rad is uN m.
        let value = self.values[PULL] * constant_mvs * 1e-6 / TORQUE_PER_N / raised;
        let of = |pull: f64, friction: f64| {
            (pull / self.values[PULL] * raised / raising(friction) - 1.0).abs()
        };
        let hysteresis = [0, 1].map(|end| of(self.with[end].1[PULL], friction.with[end]));
        let more = |friction_more: f64| raising(friction.value + friction_more) / raised - 1.0;
        let ranges = hysteresis[0].max(hysteresis[1]) + more(friction.direction);
        let share = (self.uncertainties[PULL] / self.values[PULL])
            .hypot(more(friction.fit))
            .hypot(ranges);
        Estimate {
            value,
            uncertainty: (share + GAIN + SOFTENING) * value,
        }
    }
}

impl<'a> Readings<'a> {
    fn all(&self) -> impl Iterator<Item = &'a Block> + use<'a> {
        self.folding.iter().chain(self.unfolding)
    }

    fn count(&self) -> usize {
        self.folding.len() + self.unfolding.len()
    }

    /// Currents that the parameters predict, mA: of the fold, then of the unfolding.
    fn predicted(&self, values: &Values) -> Vec<f64> {
        let [
            folding_ma,
            unfolding_ma,
            pull,
            down,
            slack_mm,
            damping,
            taut,
        ] = *values;
        let taut_mm = slack_mm + taut * (left_mm(damping) + LATER_MM);
        let wound = self.folding.iter().map(|block| {
            let way_mm = block.way_mm.abs();
            let taut = (block.thread_mm + way_mm / 2.0 - taut_mm) / way_mm;
            let force = mean(block, slack_mm, |force| force + damping * block.speed_mm_s);
            folding_ma + pull * taut.clamp(0.0, 1.0) * force
        });
        let paid_out = self.unfolding.iter().map(|block| {
            let lost = damping * block.speed_mm_s / (1.0 - self.hysteresis);
            let force = mean(block, slack_mm, |force| (force - lost).max(0.0));
            unfolding_ma + pull * down * force
        });
        wound.chain(paid_out).collect()
    }

    /// Differences from the prediction, mA; at the end those from what is known beforehand.
    fn residuals(&self, values: &Values) -> Vec<f64> {
        let measured = self
            .all()
            .map(|block| block.current_ma - block.accelerating_ma);
        let known = [
            (values[UNFOLDING] - values[FOLDING]) / OFFSETS_MA,
            (RATIO.0 - values[DOWN]) / RATIO.1,
        ];
        measured
            .zip(self.predicted(values))
            .map(|(measured, predicted)| measured - predicted)
            .chain(known.map(|off| off * NOISE_MA))
            .collect()
    }

    /// For each residual the change of its prediction with each parameter.
    fn slopes(&self, values: &Values) -> Vec<Values> {
        let mut slopes = vec![[0.0; COUNT]; self.count() + 2];
        for (index, step) in STEPS.into_iter().enumerate() {
            let moved = |by: f64| {
                let mut values = *values;
                values[index] += by;
                self.residuals(&values)
            };
            let (less, more) = (moved(-step), moved(step));
            for (row, (less, more)) in slopes.iter_mut().zip(less.iter().zip(more)) {
                row[index] = (less - more) / (2.0 * step);
            }
        }
        slopes
    }

    /// The best of the fits from several starts: the slack and the travel at which the thread is taut have several
    /// minima.
    fn best(&self) -> Option<Values> {
        let mut starts: Vec<(f64, Values)> = SLACKS_MM
            .iter()
            .flat_map(|slack_mm| DAMPINGS.map(|damping| (*slack_mm, damping)))
            .flat_map(|(slack_mm, damping)| TAUTS.map(|taut| [slack_mm, damping, taut]))
            .filter_map(|start| self.start(start))
            .map(|values| (squared(&self.residuals(&values)), values))
            .collect();
        starts.sort_by(|one, other| one.0.total_cmp(&other.0));
        starts
            .into_iter()
            .take(FOLLOWED)
            .map(|(_, values)| self.descend(values))
            .min_by(|one, other| one.1.total_cmp(&other.1))
            .map(|(values, _)| values)
    }

    /// The currents follow from the other parameters by linear least squares.
    fn start(&self, [slack_mm, damping, taut]: [f64; 3]) -> Option<Values> {
        let of = |pull: f64| self.predicted(&[0.0, 0.0, pull, RATIO.0, slack_mm, damping, taut]);
        let folds = self.folding.len();
        let rows: Vec<([f64; 3], f64)> = (self.all().zip(of(1.0)).enumerate())
            .map(|(place, (block, pull))| {
                let folds = f64::from(u8::from(place < folds));
                let steady_ma = block.current_ma - block.accelerating_ma;
                ([folds, 1.0 - folds, pull], steady_ma)
            })
            .collect();
        let [folding_ma, unfolding_ma, pull] = squares::fit(&rows)?.values;
        Some(within([
            folding_ma,
            unfolding_ma,
            pull,
            RATIO.0,
            slack_mm,
            damping,
            taut,
        ]))
    }

    /// Descends to the least sum of squares (Levenberg and Marquardt). Returns it, too.
    fn descend(&self, mut values: Values) -> (Values, f64) {
        let mut residuals = self.residuals(&values);
        let mut squares = squared(&residuals);
        let mut held_back = 1e-2;
        for _ in 0..MOST_STEPS {
            let slopes = self.slopes(&values);
            let (normal, right) = equations(&slopes, &residuals);
            let mut better = None;
            for _ in 0..8 {
                let mut damped = normal;
                for (index, row) in damped.iter_mut().enumerate() {
                    row[index] += held_back * (row[index] + 1e-9);
                }
                let next = inverse(damped).map(|inverse| {
                    let step = times(&inverse, &right);
                    within(std::array::from_fn(|index| values[index] + step[index]))
                });
                let found = next.map(|next| (next, self.residuals(&next)));
                better = found.filter(|(_, residuals)| squared(residuals) < squares);
                if better.is_some() {
                    break;
                }
                held_back *= 4.0;
            }
            let Some((next, found)) = better else { break };
            let gained = squares - squared(&found);
            (values, residuals, squares) = (next, found, squares - gained);
            held_back = (held_back / 6.0).max(1e-7);
            if gained < 1e-5 * squares {
                break;
            }
        }
        (values, squares)
    }

    /// Expanded uncertainties at the best values: those of the noise, with the likeness of neighbouring residuals, and
    /// those of what the model leaves out.
    fn uncertainties(&self, values: &Values) -> Option<Values> {
        let slopes = self.slopes(values);
        let residuals = self.residuals(values);
        let (mut normal, _) = equations(&slopes, &residuals);
        // Without damping, and if the origami had opened, the readings do not determine these two.
        normal[DAMPING][DAMPING] += 1e-6;
        normal[TAUT][TAUT] += 1e-6;
        let inverse = inverse(normal)?;
        let found = &residuals[..self.count()];
        let variance = (squared(found) / (found.len() - COUNT) as f64).max(LEAST_NOISE_MA.powi(2))
            * squares::likeness(found);
        let mut squares: Values =
            std::array::from_fn(|index| COVERAGE.powi(2) * variance * inverse[index][index]);
        let mut add = |pattern_ma: &[f64], weight: f64| {
            let (_, right) = equations(&slopes[..pattern_ma.len()], pattern_ma);
            for (sum, off) in squares.iter_mut().zip(times(&inverse, &right)) {
                *sum += weight * off * off;
            }
        };
        add(&self.ripple_ma(), 1.0);
        for drift_ma in self.drifts_ma() {
            add(&drift_ma, 1.0);
        }
        // Variance of a snap: half of the largest's square, averaged over its places. Sizes spread from 0 to the
        // largest would give a third, but a large snap recurs in every motion.
        let weight = COVERAGE.powi(2) / 2.0 / SNAP_PLACES as f64;
        for (from_mm, to_mm) in SNAPS_MM {
            for place in 0..SNAP_PLACES {
                let share = place as f64 / (SNAP_PLACES - 1) as f64;
                add(
                    &self.snap_ma(values, from_mm + (to_mm - from_mm) * share),
                    weight,
                );
            }
        }
        Some(squares.map(f64::sqrt))
    }

    /// Possible error of each block's current by the amplifier's ripple, mA.
    fn ripple_ma(&self) -> Vec<f64> {
        self.all()
            .map(|block| RIPPLE_MA * (block.current_ma / 100.0).powi(2))
            .collect()
    }

    /// Possible errors of the blocks' currents by a drift of the amplifier's zero in either motion, mA.
    fn drifts_ma(&self) -> [Vec<f64>; 2] {
        let (folds, all) = (self.folding.len(), self.count());
        [(0, folds), (folds, all)].map(|(from, to)| {
            let along = |place: usize| (place - from) as f64 / (to - from - 1) as f64;
            (0..all)
                .map(|place| match (from..to).contains(&place) {
                    true => DRIFT_MA * (2.0 * along(place) - 1.0),
                    false => 0.0,
                })
                .collect()
        })
    }

    /// Currents of the largest snap at a travel.
    fn snap_ma(&self, values: &Values, at_mm: f64) -> Vec<f64> {
        let slack_mm = values[SLACK];
        let (builds_mm, lost_mm) = SNAP_MM;
        let snap = |travel_mm: f64| {
            let past = travel_mm - at_mm;
            let share = if past < 0.0 {
                1.0 + past / builds_mm
            } else {
                1.0 - past / lost_mm
            };
            SNAP * share.max(0.0) * beam_n(travel_mm)
        };
        let folds = self.folding.len();
        (self.all().zip(self.predicted(values)).enumerate())
            .map(|(place, (block, predicted_ma))| {
                let pull = if place < folds {
                    values[PULL]
                } else if predicted_ma > values[UNFOLDING] {
                    values[PULL] * values[DOWN]
                } else {
                    0.0
                };
                let along = |part: i32| block.way_mm * f64::from(part) / 8.0;
                let places = (-4..=4).map(|part| snap(block.thread_mm - slack_mm + along(part)));
                pull * places.sum::<f64>() / 9.0
            })
            .collect()
    }
}

/// Normal equations of residuals.
fn equations(slopes: &[Values], residuals: &[f64]) -> ([Values; COUNT], Values) {
    let mut normal = [[0.0; COUNT]; COUNT];
    let mut right = [0.0; COUNT];
    for (slope, residual) in slopes.iter().zip(residuals) {
        for i in 0..COUNT {
            right[i] += slope[i] * residual;
            for j in 0..COUNT {
                normal[i][j] += slope[i] * slope[j];
            }
        }
    }
    (normal, right)
}

fn times(matrix: &[Values; COUNT], vector: &Values) -> Values {
    std::array::from_fn(|row| {
        (0..COUNT)
            .map(|column| matrix[row][column] * vector[column])
            .sum()
    })
}

fn squared(residuals: &[f64]) -> f64 {
    residuals.iter().map(|residual| residual * residual).sum()
}

fn within(values: Values) -> Values {
    std::array::from_fn(|index| values[index].clamp(LEAST[index], MOST[index]))
}

/// Mean over a block of a function of the force, by Simpson's rule: near the end the force is curved within a block.
fn mean(block: &Block, slack_mm: f64, of: impl Fn(f64) -> f64) -> f64 {
    let (middle, half) = (block.thread_mm - slack_mm, block.way_mm / 2.0);
    let at = |travel_mm: f64| of(beam_n(travel_mm));
    (at(middle - half) + 4.0 * at(middle) + at(middle + half)) / 6.0
}

/// Travel that is left of a whole fold after the rest, mm, with this damping over stiffness: `dx/dt = -(1 - h) F(x) / q`.
fn left_mm(damping: f64) -> f64 {
    /// Step of the travel, mm.
    const STEP_MM: f64 = 0.01;
    /// Time for which it opens, over damping, at each step from the folded end.
    static TABLE: OnceLock<Vec<f64>> = OnceLock::new();
    let table = TABLE.get_or_init(|| {
        let mut time = 0.0;
        (0..2_100)
            .map(|step| {
                time += STEP_MM / beam_n(21.0 - (f64::from(step) + 0.5) * STEP_MM);
                time
            })
            .collect()
    });
    let time = f64::from(REST_S) * (1.0 - HYSTERESIS) / damping.max(1e-6);
    let passed = table.partition_point(|one| *one < time);
    21.0 - passed as f64 * STEP_MM
}

/// Step of the table of the force, mm.
const TABLE_MM: f64 = 0.01;

/// Force of the origami at a travel by the beam estimate, N: `F = 0.2055 a / (d d0 / d a)` with the paper's Eqs. (2) to
/// (5), (7). Constant beyond the end of the kinematics, where no block enters a fit.
fn beam_n(travel_mm: f64) -> f64 {
    static TABLE: OnceLock<Vec<f64>> = OnceLock::new();
    let table = TABLE.get_or_init(|| {
        let design = Design::paper_ratios();
        let force = |travel_mm: f64| {
            let a_mm = design.indentation_for_thread_mm(travel_mm).ok()?;
            Some(BEAM_N_PER_MM * a_mm / design.slope_by_indentation(a_mm).ok()?)
        };
        (0..)
            .map_while(|step| force(f64::from(step) * TABLE_MM))
            .collect()
    });
    let place = travel_mm.max(0.0) / TABLE_MM;
    let below = (place as usize).min(table.len() - 2);
    let share = (place - below as f64).min(1.0);
    table[below] + (table[below + 1] - table[below]) * share
}

/// Torque of the motor, relative to a worm without friction, while the worm raises its load.
fn raising(friction: f64) -> f64 {
    let lead = LEAD_DEG.to_radians();
    (lead + friction.atan()).tan() / lead.tan()
}

/// Coefficient of friction for which lowering takes `ratio` of the torque of raising, with a friction while lowering
/// that differs by a share; none if it would be 1 or more.
fn friction(ratio: f64, direction: f64) -> Option<f64> {
    let lead = LEAD_DEG.to_radians();
    let share = |friction: f64| {
        let lowering = (friction * (1.0 + direction)).atan() - lead;
        lowering.tan() / (friction.atan() + lead).tan()
    };
    let (mut low, mut high) = (0.0, 1.0);
    if ratio >= share(high) {
        return None;
    }
    for _ in 0..60 {
        let middle = f64::midpoint(low, high);
        if share(middle) < ratio {
            low = middle;
        } else {
            high = middle;
        }
    }
    Some(low)
}

#[cfg(test)]
mod tests;
