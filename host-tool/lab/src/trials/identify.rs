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

use crate::trials::force::UM_MS2_PER_MA;
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

/// Rest before the fold, s: a damped origami opens for this long after it was let go. It need not have opened
/// completely, and a longer rest does no harm.
pub const REST_S: u32 = 30;

/// Finds the capsule's parameters. Before the fold it has rested for [`REST_S`].
///
/// # Errors
/// [`IdentifyError`].
pub fn identify(fold: &[TracePoint], unfold: &[TracePoint]) -> Result<Identified, IdentifyError> {
    let folding = blocks("fold", once_wound(fold), 1.0)?;
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

/// The part of a fold up to its farthest point. A fold that feels its thread there pays out and winds again, and the
/// origami then pulls less.
fn once_wound(fold: &[TracePoint]) -> &[TracePoint] {
    let far_um = fold.iter().map(|point| point.thread_um).max();
    let far = fold
        .iter()
        .position(|point| Some(point.thread_um) == far_um);
    &fold[..far.map_or(0, |far| far + 1)]
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

#[cfg(test)]
mod tests {
    use super::*;

    fn point(thread_um: i32, current_ma: u16, drive_mv: i16) -> TracePoint {
        TracePoint {
            thread_um,
            current_ma,
            battery_mv: 2_995,
            drive_mv,
        }
    }

    /// Each reading shows the effect of the previous one's drive, half a period and the filter late.
    #[test]
    fn a_block_is_the_mean_of_20_driven_readings() {
        for sign in [1, -1] {
            let mut readings: Vec<_> = (0..=20_i16)
                .map(|ms| {
                    let current_ma = 10 * ms.unsigned_abs();
                    point(i32::from(sign * ms) * 10, current_ma, sign * 1_500 - 20)
                })
                .collect();
            readings[20].drive_mv = 0;
            let found = block(&readings, sign.into()).expect("driven");
            let sign = f64::from(sign);
            let near = |is: f64, expected: f64| assert!((is - expected).abs() < 1e-9, "{is}");
            near(found.way_mm, sign * 0.2);
            near(found.thread_mm, sign * (0.105 - 0.66 / 20.0 * 0.2));
            near(found.speed_mm_s, 10.0);
            near(found.current_ma, 105.0);
            near(found.battery_mv, 3_000.0);
            near(found.duty, if sign > 0.0 { 0.5 } else { 1_540.0 / 3_000.0 });
            readings[0].drive_mv = 0;
            assert!(block(&readings, sign).is_none(), "braked");
        }
    }

    /// Block by block, the thread that it winds, um.
    fn wound(blocks: impl IntoIterator<Item = i32>) -> Vec<TracePoint> {
        let mut from_um = 0;
        let mut points = vec![];
        for um in blocks {
            points.extend((0..20).map(|ms| point(from_um + um * ms / 20, 20, 1_480)));
            from_um += um;
        }
        points.push(point(from_um, 20, 1_480));
        points
    }

    #[test]
    fn of_a_fold_that_is_felt_the_first_way_counts() {
        let fold = wound([200; 20]);
        let mut felt = fold.clone();
        felt.extend((0..100).map(|ms| point(4_000 - 15 * ms, 20, -1_480)));
        felt.extend((0..=100).map(|ms| point(2_500 + 15 * ms, 20, 1_480)));
        assert_eq!(once_wound(&felt), fold);
        assert_eq!(once_wound(&fold), fold);
        assert!(once_wound(&[]).is_empty());
    }

    /// Of 20 blocks, the first and the last have one neighbour only, and those in the last 0.7 mm do not count.
    #[test]
    fn steady_blocks_with_neighbours_are_found_before_the_end() {
        let found = blocks("fold", &wound([200; 20]), 1.0).expect("enough");
        assert_eq!(found.len(), 16);
        assert!(found.iter().all(|block| block.accelerating_ma.abs() < 1e-9));
        // 0.2 mm/s more in each 20 ms are 0.01 um/ms in each ms.
        let faster = wound((0..20).map(|block| 100 + 4 * block));
        let found = blocks("fold", &faster, 1.0).expect("enough");
        let expected = 0.01 / UM_MS2_PER_MA;
        let off = |block: &Block| (block.accelerating_ma - expected).abs();
        assert!(found.iter().all(|block| off(block) < 1e-9), "{found:?}");
        let blocks = |wound_um: &[i32]| {
            blocks("fold", &wound(wound_um.iter().copied()), 1.0).map(|found| found.len())
        };
        // A change of speed takes out the blocks beside it: 0.4 mm/s bend more than 0.3.
        let mut bent = [200; 25];
        bent[10] = 208;
        assert_eq!(blocks(&bent), Ok(21 - 3));
        bent[10] = 203;
        assert_eq!(blocks(&bent), Ok(21));
        // 0.95 mm/s is too slow, and 2.1 mm/s faster in 40 ms takes more than 10 mA.
        let slow = Err(IdentifyError::TooShort {
            motion: "fold",
            blocks: 0,
        });
        assert_eq!(blocks(&[19; 60]), slow);
        assert_eq!(blocks(&[21; 60]), Ok(26));
        let steep: Vec<_> = (0..25).map(|block| 100 + 21 * block).collect();
        assert_eq!(blocks(&steep), slow);
        assert_eq!(
            blocks(&[200; 15]).map_err(|_| ()),
            Err(()),
            "11 are too few"
        );
        assert_eq!(blocks(&[200; 16]), Ok(12));
    }

    /// Half of the time 100 mA, and 28.7 mA/V * 3.7 V / 16 of ripple.
    #[test]
    fn the_cell_gives_the_current_of_the_pulses_and_their_ripple() {
        let block = turning(100.0, 10.0, 0.5, 3_700.0);
        assert!((block.drawn_ma() - 56.636_875).abs() < 1e-9);
    }

    fn turning(current_ma: f64, speed_mm_s: f64, duty: f64, battery_mv: f64) -> Block {
        Block {
            thread_mm: 5.0,
            way_mm: 0.2,
            speed_mm_s,
            current_ma,
            accelerating_ma: 0.0,
            duty,
            battery_mv,
        }
    }

    /// 6 ohm, 2.1 mV s/rad, and a cell of 3.9 V with 0.5 ohm; `off_mv` is the amplifier's offset as a voltage.
    fn driven(current_ma: f64, speed_mm_s: f64, off_mv: f64) -> Block {
        let mut block = turning(current_ma, speed_mm_s, 0.5, 3_800.0);
        for _ in 0..100 {
            let drawn_ma = block.drawn_ma();
            let motor_mv = 6.0 * current_ma + 2.1 * speed_mm_s / MM_PER_RAD + off_mv;
            block.duty = (motor_mv + 0.5 * drawn_ma) / 3_900.0;
            block.battery_mv = 3_900.0 - 0.5 * drawn_ma;
        }
        block
    }

    #[test]
    fn the_circuit_is_found_from_what_was_driven() {
        let folding: Vec<_> = (0..15)
            .map(f64::from)
            .map(|place| driven(20.0 + 8.0 * place, 12.0 - 0.03 * place * place, 4.0))
            .collect();
        let unfolding: Vec<_> = (0..15)
            .map(f64::from)
            .map(|place| driven(40.0 - 2.0 * place, 10.0 + (place * 2.0).sin(), -3.0))
            .collect();
        let (ohm, constant) = circuit(&folding, &unfolding).expect("it fits");
        assert!((ohm.value - 6.5).abs() < 1e-4, "{ohm:?}");
        assert!((constant.value - 2.1).abs() < 1e-4, "{constant:?}");
        // Exact readings leave the uncertainty of gain and voltage.
        assert!((ohm.uncertainty - 0.033 * 6.5).abs() < 1e-3, "{ohm:?}");
        assert!(
            (constant.uncertainty - 0.003 * 2.1).abs() < 1e-4,
            "{constant:?}"
        );
        // A motor that would drive itself the faster it turns is none.
        let mut driven = folding;
        for block in &mut driven {
            block.speed_mm_s *= -1.0;
        }
        let none = "a motor without resistance or back-EMF";
        let found = circuit(&driven, &driven).map(|_| ());
        assert_eq!(found, Err(IdentifyError::NoFit(none)));
    }
}
