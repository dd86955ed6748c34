//! Identifies one capsule from the recordings of a fold and the unfolding after it: circuit, motor, friction, origami.
//!
//! ```text
//! D U       = R i + k w                      circuit: D share of the PWM period, U cell in the pulses, w speed
//! k i       = k I0 + J w' + S g up(mu) F(x)        winding the thread; F by the beam estimate, x travel
//! k |i|     = k I0 + J |w|' + S g down(mu) F(x)    paying it out: the worm locks, so this is driven, too
//! ```
//! The readings are averaged over blocks of 20 ms. Least squares give `R` and `k` from the first line; no-load
//! current, slack and the two slopes from the others. The ratio of the slopes gives the friction of the worm, their
//! size the stiffness. Gears, spool, lead angle and rotor are taken as designed: `docs/capsule.md`.

use locomotion::kinematics::Design;
use protocol::capsule::TracePoint;
use serde::Serialize;

use crate::force::UM_MS2_PER_MA;

/// Readings per block, 1 ms apart.
const BLOCK: usize = 20;
/// Fewest blocks of a fold, and of an unfolding.
const LEAST_BLOCKS: usize = 12;
/// Least speed of a block, mm/s: below it the motor may stop within a period.
const LEAST_SPEED_MM_S: f64 = 1.0;
/// Greatest accelerating current of a block, mA: above it the speed changes too fast for its estimate.
const MOST_ACCELERATING_MA: f64 = 10.0;
/// Greatest difference between two successive changes of speed, mm/s, for the same reason.
const MOST_BENT_MM_S: f64 = 0.3;
/// Range of the search for the slack, in hundredths of a millimetre: a calibration leaves 0 to 3 mm.
const SLACK_HUNDREDTHS: (i32, i32) = (-15, 315);
/// Range before the folded end that is ignored, mm: there the thread may pull on something harder than the origami.
const BEFORE_END_MM: f64 = 0.7;
/// Half a step of the recorded drive and of the recorded voltage: both are rounded towards zero.
const HALF_DRIVE_STEP_MV: f64 = 20.0;
const HALF_BATTERY_STEP_MV: f64 = 5.0;

/// Time constant of the current amplifier's filter, ms [assumed].
const FILTER_MS: f64 = 0.16;

/// Thread per radian of the motor, mm: spool of 1.5 mm, gears of 4 and 30 (design).
const MM_PER_RAD: f64 = 1.5 / 120.0;
/// Torque of the motor per newton at the thread without friction in the worm, N m. The planetary gear has an
/// efficiency of 0.8 (data sheet).
const TORQUE_PER_N: f64 = 1.5e-3 / 120.0 / 0.8;
/// Lead angle of the worm, degrees (design).
const LEAD_DEG: f64 = 4.0;
/// Force per indentation by the beam estimate, N/mm; E = 50 MPa, b = 10 mm, t = 0.8 mm.
const BEAM_N_PER_MM: f64 = 0.2055;

/// Uncertainty of the current amplifier's gain, as a share: its shunt and resistors [assumed]. It affects every value
/// that comes from a current.
const GAIN: f64 = 0.03;
/// `R T2 / 12 L2` of the bridge's slow decay, mA per volt: 6.2 ohm, 12.5 us, 53 uH (data sheet).
const RISE_MA_PER_V: f64 = 28.7;
/// Remaining offset of the amplifier, mA.
const OFFSET_MA: f64 = 1.0;
/// Largest difference of a reading at 100 mA from the mean current, mA [assumed]: the amplifier's output follows the
/// bridge's pulses.
const RIPPLE_MA: f64 = 1.0;
/// Uncertainty of the cell's voltage against the converter's reference, as a share.
const VOLTAGE: f64 = 0.003;
/// Expanded uncertainty in standard deviations.
const COVERAGE: f64 = 2.0;

/// A value with its expanded uncertainty (k = 2): the true value is within `uncertainty` of it in 95 of 100 cases.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// Best value.
    pub value: f64,
    /// Half the width of its interval.
    pub uncertainty: f64,
}

/// Parameters of a capsule, from a fold and an unfolding.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Identified {
    /// Winding, bridge and cell in series, ohm.
    pub circuit_ohm: Estimate,
    /// Motor constant, mV s/rad; the torque constant in mN m/A is the same number.
    pub motor_constant_mvs: Estimate,
    /// No-load current of motor and gears, mA.
    pub no_load_ma: Estimate,
    /// Coefficient of friction in the worm.
    pub worm_friction: Estimate,
    /// Force of the origami over its beam estimate.
    pub stiffness: Estimate,
    /// Thread to wind until it is taut, mm.
    pub slack_mm: Estimate,
}

/// Why a capsule could not be identified.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IdentifyError {
    /// The motor did not run steadily for long enough.
    #[error("the {motion} has {blocks} steady stretches of {BLOCK} ms, {LEAST_BLOCKS} are needed")]
    TooShort {
        /// Fold or unfolding.
        motion: &'static str,
        /// Number of usable blocks.
        blocks: usize,
    },
    /// The readings contradict the model.
    #[error("the readings fit no capsule of this design: {0}")]
    NoFit(&'static str),
}

/// Averages over readings in which the motor is driven steadily.
#[derive(Clone, Copy, Debug)]
struct Block {
    /// Mean of the thread on the spool, mm.
    thread_mm: f64,
    /// Change of the thread during the block, mm.
    way_mm: f64,
    /// Speed in the direction of the drive, mm/s.
    speed_mm_s: f64,
    /// Mean current of a period, mA.
    current_ma: f64,
    /// Part of it that accelerates the motor, mA.
    accelerating_ma: f64,
    /// Mean driven share of the period.
    duty: f64,
    /// Voltage of the cell under this load, mV.
    battery_mv: f64,
}

/// Finds the capsule's parameters.
///
/// # Errors
/// [`IdentifyError`].
pub fn identify(fold: &[TracePoint], unfold: &[TracePoint]) -> Result<Identified, IdentifyError> {
    let folding = blocks("fold", fold, 1.0)?;
    let unfolding = blocks("unfolding", unfold, -1.0)?;
    let (circuit_ohm, constant) = circuit(&folding, &unfolding)?;
    let found = mechanics(&folding, &unfolding, constant.value)?;
    // The same fit with the amplifier's ripple added: the difference is its uncertainty. Without such a fit there is
    // no result.
    let rippled = |blocks: &[Block]| -> Vec<Block> { blocks.iter().map(Block::rippled).collect() };
    let other = mechanics(&rippled(&folding), &rippled(&unfolding), constant.value)?;
    let estimate = |index: usize, otherwise: f64| {
        let (value, deviation) = found[index];
        Estimate {
            value,
            uncertainty: COVERAGE * deviation + (other[index].0 - value).abs() + otherwise,
        }
    };
    Ok(Identified {
        circuit_ohm,
        motor_constant_mvs: constant,
        no_load_ma: estimate(0, GAIN * found[0].0 + OFFSET_MA),
        worm_friction: estimate(1, 0.0),
        stiffness: estimate(2, GAIN * found[2].0),
        slack_mm: estimate(3, 0.0),
    })
}

/// No-load current in mA, friction of the worm, stiffness, slack in mm, each with its standard deviation.
fn mechanics(
    folding: &[Block],
    unfolding: &[Block],
    constant_mvs: f64,
) -> Result<[(f64, f64); 4], IdentifyError> {
    let Fit {
        // The amplifier's offset is measured again before each motion, so each has its own no-load current.
        values: [folding_ma, unfolding_ma, up, down, slack_mm],
        deviations,
        ..
    } = load(folding, unfolding)?;
    if up <= 0.0 || down < 0.0 || down >= up {
        return Err(IdentifyError::NoFit("paying out takes more than winding"));
    }
    let up_share = deviations[2] / up;
    let ratio = down / up;
    let ratio_deviation = ratio * up_share.hypot(deviations[3] / down.max(deviations[3]));
    let too_much = IdentifyError::NoFit("paying out takes nearly as much as winding");
    let (friction, most) = friction(ratio)
        .zip(friction(ratio + ratio_deviation))
        .ok_or(too_much)?;
    // mA mV s/rad is uN m.
    let stiffness = up * constant_mvs * 1e-6 / TORQUE_PER_N / raising(friction);
    let share = up_share.hypot(raising(most) / raising(friction) - 1.0);
    Ok([
        (
            f64::midpoint(folding_ma, unfolding_ma),
            deviations[0].hypot(deviations[1]) / 2.0,
        ),
        (friction, most - friction),
        (stiffness, stiffness * share),
        (slack_mm, deviations[4]),
    ])
}

impl Block {
    /// Current of the cell: the motor's current in the pulses, and the ripple above its mean.
    fn drawn_ma(&self) -> f64 {
        let both = self.duty * (1.0 - self.duty);
        self.duty * self.current_ma + RISE_MA_PER_V * self.battery_mv * 1e-3 * both * both
    }

    /// The block with the amplifier's ripple added.
    fn rippled(&self) -> Self {
        let share = self.current_ma / 100.0;
        Self {
            current_ma: self.current_ma + RIPPLE_MA * share * share,
            ..*self
        }
    }
}

/// The steady blocks of a recording; `sign` is that of the drive.
fn blocks(
    motion: &'static str,
    points: &[TracePoint],
    sign: f64,
) -> Result<Vec<Block>, IdentifyError> {
    let far_mm = points.iter().map(thread_mm).fold(f64::MIN, f64::max) - BEFORE_END_MM;
    let all: Vec<Option<Block>> = points
        .windows(BLOCK + 1)
        .step_by(BLOCK)
        .map(|readings| block(readings, sign))
        .collect();
    let found: Vec<Block> = all
        .windows(3)
        .filter_map(|of| match of {
            [Some(before), Some(this), Some(after)] => {
                let bent_mm_s = before.speed_mm_s - 2.0 * this.speed_mm_s + after.speed_mm_s;
                if bent_mm_s.abs() > MOST_BENT_MM_S {
                    return None;
                }
                // um/ms is mm/s.
                let gained = (after.speed_mm_s - before.speed_mm_s) / (2 * BLOCK) as f64;
                Some(Block {
                    accelerating_ma: gained / UM_MS2_PER_MA,
                    ..*this
                })
            }
            _ => None,
        })
        .filter(|block| {
            block.thread_mm < far_mm
                && block.speed_mm_s > LEAST_SPEED_MM_S
                && block.accelerating_ma.abs() < MOST_ACCELERATING_MA
        })
        .collect();
    if found.len() < LEAST_BLOCKS {
        return Err(IdentifyError::TooShort {
            motion,
            blocks: found.len(),
        });
    }
    Ok(found)
}

fn thread_mm(point: &TracePoint) -> f64 {
    f64::from(point.thread_um) * 1e-3
}

/// Averages of a block; none if the motor is not driven throughout. Each reading shows the effect of the previous
/// reading's drive.
fn block(readings: &[TracePoint], sign: f64) -> Option<Block> {
    let (driven, shown) = (&readings[..BLOCK], &readings[1..]);
    let mean = |points: &[TracePoint], of: &dyn Fn(&TracePoint) -> f64| {
        points.iter().map(of).sum::<f64>() / BLOCK as f64
    };
    let battery_mv = |point: &TracePoint| f64::from(point.battery_mv) + HALF_BATTERY_STEP_MV;
    let is_driven = |point: &TracePoint| f64::from(point.drive_mv) * sign > 0.0;
    let way_mm = thread_mm(&readings[BLOCK]) - thread_mm(&readings[0]);
    // A current reading is that of the preceding millisecond, and the amplifier's filter delays it further.
    let late = (0.5 + FILTER_MS) / BLOCK as f64;
    driven.iter().all(is_driven).then(|| Block {
        thread_mm: mean(shown, &thread_mm) - late * way_mm,
        way_mm,
        speed_mm_s: way_mm * sign / (BLOCK as f64 * 1e-3),
        current_ma: mean(shown, &|point| f64::from(point.current_ma)),
        accelerating_ma: 0.0,
        duty: mean(driven, &|point| {
            let drive_mv = f64::from(point.drive_mv) * sign + HALF_DRIVE_STEP_MV;
            (drive_mv / battery_mv(point)).min(1.0)
        }),
        battery_mv: mean(shown, &battery_mv),
    })
}

/// Resistance in ohm and motor constant in mV s/rad.
fn circuit(folding: &[Block], unfolding: &[Block]) -> Result<(Estimate, Estimate), IdentifyError> {
    let blocks = || folding.iter().chain(unfolding);
    let sagging: Vec<_> = blocks()
        .map(|block| ([1.0, -block.drawn_ma()], block.battery_mv))
        .collect();
    let cell = fit(&sagging).ok_or(IdentifyError::NoFit("the current never changes"))?;
    let [open_mv, cell_ohm] = cell.values;
    let row = |block: &Block, folds: f64| {
        // The amplifier's offset acts as an extra voltage in each motion. The cell delivers all of its current in the
        // pulses.
        let speed = block.speed_mm_s / MM_PER_RAD;
        (
            [block.current_ma, speed, folds, 1.0 - folds],
            block.duty * open_mv - cell_ohm * block.drawn_ma(),
        )
    };
    let folded = folding.iter().map(|block| row(block, 1.0));
    let unfolded = unfolding.iter().map(|block| row(block, 0.0));
    let mut rows: Vec<_> = folded.chain(unfolded).collect();
    let together = IdentifyError::NoFit("speed and current change together");
    let unbound = fit(&rows).ok_or(together)?;
    // If the speed hardly varies, the back-EMF cannot be told from the offsets, and noise in the speed pulls the
    // constant down. Add the known size of the offset as a reading.
    let noise_mv = (unbound.squares / rows.len() as f64).sqrt();
    let weight = noise_mv / (OFFSET_MA / COVERAGE * unbound.values[0].abs());
    rows.push(([0.0, 0.0, weight, 0.0], 0.0));
    rows.push(([0.0, 0.0, 0.0, weight], 0.0));
    let fit = fit(&rows).ok_or(together)?;
    let [ohm, constant, ..] = fit.values;
    let ohm = ohm + cell_ohm;
    if ohm <= 0.0 || constant <= 0.0 {
        return Err(IdentifyError::NoFit(
            "a motor without resistance or back-EMF",
        ));
    }
    Ok((
        Estimate {
            value: ohm,
            uncertainty: COVERAGE * fit.deviations[0].hypot(cell.deviations[1])
                + (GAIN + VOLTAGE) * ohm,
        },
        Estimate {
            value: constant,
            uncertainty: COVERAGE * fit.deviations[1] + VOLTAGE * constant,
        },
    ))
}

/// Fits no-load current folding and unfolding in mA, mA per newton of the beam estimate folding and unfolding, slack
/// in mm.
fn load(folding: &[Block], unfolding: &[Block]) -> Result<Fit<5>, IdentifyError> {
    let steady = |block: &Block| block.current_ma - block.accelerating_ma;
    let rows = |slack_mm: f64| -> Vec<([f64; 4], f64)> {
        let force = |block: &Block| mean_n(block, slack_mm);
        let folded = folding
            .iter()
            .map(|block| ([1.0, 0.0, force(block), 0.0], steady(block)));
        let unfolded = unfolding
            .iter()
            .map(|block| ([0.0, 1.0, 0.0, force(block)], steady(block)));
        folded.chain(unfolded).collect()
    };
    let no_fit = IdentifyError::NoFit("the force does not rise with the thread");
    let best = |hundredths: &mut dyn Iterator<Item = i32>| {
        hundredths
            .filter_map(|slack| {
                let fit = fit(&rows(f64::from(slack) * 0.01))?;
                Some((slack, fit))
            })
            .min_by(|(_, one), (_, other)| one.squares.total_cmp(&other.squares))
            .ok_or(no_fit)
    };
    // Search the range of a calibration, and one step more at either end. The sum of squares has a single minimum.
    let (least, most) = SLACK_HUNDREDTHS;
    let (near, _) = best(&mut (least..=most).step_by(15))?;
    let (slack, coarse) = best(&mut (near - 15..=near + 15).step_by(2))?;
    if slack <= least || slack >= most {
        return Err(IdentifyError::NoFit(
            "the thread would be slack by less than 0 or more than 3 mm",
        ));
    }
    let slack_mm = f64::from(slack) * 0.01;
    // Take one Gauss-Newton step from there: it gives the slack's remaining share, and the covariance of all five
    // values.
    let [.., up, down] = coarse.values;
    const STEP_MM: f64 = 0.01;
    let bent: Vec<([f64; 5], f64)> = rows(slack_mm)
        .into_iter()
        .zip(folding.iter().chain(unfolding))
        .map(|(([fold, unfold, winding, paying], current_ma), block)| {
            let slope = (mean_n(block, slack_mm - STEP_MM) - mean_n(block, slack_mm + STEP_MM))
                / (2.0 * STEP_MM);
            let pull = if winding > 0.0 {
                up
            } else if paying > 0.0 {
                down
            } else {
                0.0
            };
            ([fold, unfold, winding, paying, -pull * slope], current_ma)
        })
        .collect();
    let mut fine = fit(&bent).ok_or(no_fit)?;
    fine.values[4] += slack_mm;
    Ok(fine)
}

/// Mean force over a block by Simpson's rule, because near the end it bends upwards within a block.
fn mean_n(block: &Block, slack_mm: f64) -> f64 {
    let (middle, half) = (block.thread_mm - slack_mm, block.way_mm / 2.0);
    (beam_n(middle - half) + 4.0 * beam_n(middle) + beam_n(middle + half)) / 6.0
}

/// Force of the origami at a travel by the beam estimate, N: `F = 0.2055 a / (d d0 / d a)` with the paper's Eqs. (2)
/// to (5), (7).
fn beam_n(travel_mm: f64) -> f64 {
    let design = Design::paper_ratios();
    // Beyond the end of the kinematics there is no origami left to fold; no block there enters a fit.
    let indentation = design.indentation_for_thread_mm(travel_mm.max(0.0));
    let slope = |a_mm: f64| design.slope_by_indentation(a_mm).ok();
    indentation
        .ok()
        .and_then(|a_mm| Some(BEAM_N_PER_MM * a_mm / slope(a_mm)?))
        .unwrap_or(f64::MAX)
}

/// Torque of the motor, relative to a worm without friction, while the worm raises its load.
fn raising(friction: f64) -> f64 {
    let lead = LEAD_DEG.to_radians();
    (lead + friction.atan()).tan() / lead.tan()
}

/// Coefficient of friction for which lowering takes `ratio` of the torque of raising; none if it would be 1 or more.
fn friction(ratio: f64) -> Option<f64> {
    let lead = LEAD_DEG.to_radians();
    let share = |angle: f64| (angle - lead).tan() / (angle + lead).tan();
    let (mut low, mut high) = (lead, 45_f64.to_radians());
    if ratio >= share(high) {
        return None;
    }
    for _ in 0..60 {
        let angle = f64::midpoint(low, high);
        if share(angle) < ratio {
            low = angle;
        } else {
            high = angle;
        }
    }
    Some(low.tan())
}

/// A fit by least squares.
#[derive(Clone, Copy, Debug)]
struct Fit<const N: usize> {
    values: [f64; N],
    /// Standard deviations, corrected for correlated residuals.
    deviations: [f64; N],
    /// Sum of squared residuals.
    squares: f64,
}

/// Least squares for `rows` of factors and results; none if they do not determine the values.
fn fit<const N: usize>(rows: &[([f64; N], f64)]) -> Option<Fit<N>> {
    let mut normal = [[0.0; N]; N];
    let mut right = [0.0; N];
    for (factors, result) in rows {
        for i in 0..N {
            right[i] += factors[i] * result;
            for j in 0..N {
                normal[i][j] += factors[i] * factors[j];
            }
        }
    }
    let inverse = inverse(normal)?;
    let values: [f64; N] = std::array::from_fn(|i| (0..N).map(|j| inverse[i][j] * right[j]).sum());
    let residuals: Vec<f64> = rows
        .iter()
        .map(|(factors, result)| {
            let given: f64 = (0..N).map(|i| factors[i] * values[i]).sum();
            result - given
        })
        .collect();
    let squares: f64 = residuals.iter().map(|residual| residual * residual).sum();
    let free = rows.len().checked_sub(N).filter(|free| *free > 0)? as f64;
    let products: f64 = residuals.windows(2).map(|pair| pair[0] * pair[1]).sum();
    // Limit the correlation: above 0.9 the variance would depend on its estimate alone.
    let alike = if squares > 0.0 {
        (products / squares).clamp(0.0, 0.9)
    } else {
        0.0
    };
    let variance = squares / free * (1.0 + alike) / (1.0 - alike);
    Some(Fit {
        values,
        deviations: std::array::from_fn(|i| (variance * inverse[i][i].max(0.0)).sqrt()),
        squares,
    })
}

/// Inverse by Gauss-Jordan elimination with the largest pivot; none if the matrix is singular.
fn inverse<const N: usize>(mut matrix: [[f64; N]; N]) -> Option<[[f64; N]; N]> {
    let mut result = [[0.0; N]; N];
    for (i, row) in result.iter_mut().enumerate() {
        row[i] = 1.0;
    }
    for column in 0..N {
        let pivot = (column..N).max_by(|one, other| {
            matrix[*one][column]
                .abs()
                .total_cmp(&matrix[*other][column].abs())
        })?;
        matrix.swap(column, pivot);
        result.swap(column, pivot);
        let by = matrix[column][column];
        if by.abs() < 1e-12 {
            return None;
        }
        for j in 0..N {
            matrix[column][j] /= by;
            result[column][j] /= by;
        }
        for row in (0..N).filter(|row| *row != column) {
            let by = matrix[row][column];
            for j in 0..N {
                matrix[row][j] -= by * matrix[column][j];
                result[row][j] -= by * result[column][j];
            }
        }
    }
    Some(result)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fit_finds_a_line_and_says_how_well() {
        // 3 + 2 x, with alternating deviations of equal size.
        let rows = |scatter: f64| -> Vec<([f64; 2], f64)> {
            (0..100)
                .map(|x| (f64::from(x), if x % 2 == 0 { scatter } else { -scatter }))
                .map(|(x, error)| ([1.0, x], 3.0 + 2.0 * x + error))
                .collect()
        };
        let exact = fit(&rows(0.0)).expect("determined");
        assert!((exact.values[0] - 3.0).abs() < 1e-9 && (exact.values[1] - 2.0).abs() < 1e-12);
        assert!(exact.deviations[0] < 1e-6);
        let loose = fit(&rows(1.0)).expect("determined");
        // Standard deviation of the mean of 100 values with deviation 1, at the end of a line: 0.2.
        assert!((0.1..0.3).contains(&loose.deviations[0]), "{loose:?}");
        let errors = [loose.values[0] - 3.0, loose.values[1] - 2.0];
        assert!(errors[0].abs() < 0.1 && errors[1].abs() < 0.01, "{loose:?}");
    }

    #[test]
    fn neighbours_that_err_alike_count_as_one() {
        let rows = |length: i32| -> Vec<([f64; 1], f64)> {
            let error = |x: i32| if x / length % 2 == 0 { 1.0 } else { -1.0 };
            (0..400).map(|x| ([1.0], error(x))).collect()
        };
        let (each, tens) = (fit(&rows(1)).expect("one"), fit(&rows(10)).expect("one"));
        assert!(
            tens.deviations[0] > 2.5 * each.deviations[0],
            "{each:?} {tens:?}"
        );
    }

    #[test]
    fn what_is_not_determined_is_not_told() {
        let same: Vec<_> = (0..10).map(|_| ([1.0, 5.0], 2.0)).collect();
        assert!(fit(&same).is_none());
        assert!(fit::<2>(&[]).is_none());
        // With as many values as rows, nothing is left to judge them by.
        assert!(fit(&[([1.0, 0.0], 1.0), ([0.0, 1.0], 2.0)]).is_none());
    }

    #[test]
    fn friction_is_found_from_the_two_slopes() {
        for truth in [0.08, 0.10, 0.15, 0.20, 0.30_f64] {
            let lead = LEAD_DEG.to_radians();
            let down = (truth.atan() - lead).tan() / lead.tan();
            let found = friction(down / raising(truth)).expect("a worm");
            assert!((found - truth).abs() < 1e-6, "{truth}: {found}");
        }
        // No worm has a coefficient above 1, and the result is not clamped to 1.
        assert_eq!(friction(0.8), None);
    }

    #[test]
    fn the_beam_gives_the_forces_of_the_design() {
        for (travel_mm, newton) in [
            (0.0, 0.0),
            (16.6, 1.2),
            (19.0, 2.9),
            (20.6, 5.8),
            (21.7, 10.8),
        ] {
            let found = beam_n(travel_mm);
            assert!(
                (found - newton).abs() <= 0.04 * newton + 0.01,
                "{travel_mm} mm: {found} N"
            );
        }
    }
}
