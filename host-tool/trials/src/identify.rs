//! Identifies one capsule from the recordings of a fold and the unfolding after it: circuit, motor, friction, origami.
//!
//! ```text
//! D U       = R i + k w                      circuit: D share of the PWM period, U cell in the pulses, w speed
//! k i       = k I0 + J w' + g up(mu) P             winding the thread, P its pull
//! k |i|     = k I0 + J |w|' + g down(mu) P         paying it out: the worm locks, so this is driven, too
//! ```
//! The readings are averaged over blocks of 20 ms. Least squares give `R` and `k` from the first line; `load` finds
//! the rest. Gears, spool, lead angle and rotor are taken as designed: `docs/capsule.md`.

mod load;
mod squares;

use protocol::capsule::TracePoint;
use serde::Serialize;

use crate::force::UM_MS2_PER_MA;
use squares::fit;

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
/// Range before the folded end that is ignored, mm: there the thread may pull on something harder than the origami.
const BEFORE_END_MM: f64 = 0.7;
/// Half a step of the recorded drive and of the recorded voltage: both are rounded towards zero.
const HALF_DRIVE_STEP_MV: f64 = 20.0;
const HALF_BATTERY_STEP_MV: f64 = 5.0;

/// Time constant of the current amplifier's filter, ms [assumed].
const FILTER_MS: f64 = 0.16;

/// Thread per radian of the motor, mm: spool of 1.5 mm, gears of 4 and 30 (design).
const MM_PER_RAD: f64 = 1.5 / 120.0;

/// Uncertainty of the current amplifier's gain, as a share: its shunt and resistors [assumed]. It affects every value
/// that comes from a current.
const GAIN: f64 = 0.03;
/// `R T2 / 12 L2` of the bridge's slow decay, mA per volt: 6.2 ohm, 12.5 us, 53 uH (data sheet).
const RISE_MA_PER_V: f64 = 28.7;
/// Remaining offset of the amplifier, mA.
const OFFSET_MA: f64 = 1.0;
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
    /// Thread to wind until it is taut with an origami that has opened, mm.
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

/// Rest before the fold, s: a damped origami is still opening for so long after it was let go. It need not have come to
/// its end; an even longer rest does no harm.
pub const REST_S: u32 = 30;

/// Finds the capsule's parameters. Before the fold it has rested for [`REST_S`].
///
/// # Errors
/// [`IdentifyError`].
pub fn identify(fold: &[TracePoint], unfold: &[TracePoint]) -> Result<Identified, IdentifyError> {
    let folding = blocks("fold", fold, 1.0)?;
    let unfolding = blocks("unfolding", unfold, -1.0)?;
    let (circuit_ohm, constant) = circuit(&folding, &unfolding)?;
    let load = load::fit(&folding, &unfolding)?;
    let worm_friction = load.worm_friction()?;
    Ok(Identified {
        circuit_ohm,
        motor_constant_mvs: constant,
        no_load_ma: load.no_load_ma(),
        worm_friction: worm_friction.estimate(),
        stiffness: load.stiffness(constant.value, &worm_friction),
        slack_mm: load.slack_mm(),
    })
}

impl Block {
    /// Current of the cell: the motor's current in the pulses, and the ripple above its mean.
    fn drawn_ma(&self) -> f64 {
        let both = self.duty * (1.0 - self.duty);
        self.duty * self.current_ma + RISE_MA_PER_V * self.battery_mv * 1e-3 * both * both
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
