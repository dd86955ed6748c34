//! Endurance: repeated folds and unfoldings. Each pair is a row of a CSV file, written before the next one begins.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use client::error::ClientError;
use client::identity::Origin;
use client::plain::replace;
use client::{Device, Observer};
use jiff::Timestamp;
use protocol::capsule::{ActuationOutcome, ActuationRecord, GetTrace, KEPT_TRACE_POINTS};
use serde::Serialize;

use crate::trials::experiment::ExperimentError;
use crate::trials::force::UM_MS2_PER_MA;
use crate::trials::trial::{RecordError, Status, create_new, json};

/// Range of a fold in which the thread is slack and the motor is at speed, um; the firmware measures in the same
/// range.
const SLACK_UM: std::ops::Range<i32> = 800..2_200;

/// One fold and unfolding. Lengths are thread from the zero, as the capsule counts it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Pair {
    /// Number of the pair, from 1.
    pub pair: u32,
    /// Duration of the fold.
    pub fold_ms: u32,
    /// Thread at its end.
    pub folded_um: i32,
    /// Thread at which the load first rose; 0: never.
    pub engaged_um: i32,
    /// Current at its end.
    pub fold_end_ma: u16,
    /// Mean current over the slack, minus the part that accelerates the motor; empty with too few readings there.
    pub no_load_ma: Option<f64>,
    /// Energy of the fold.
    pub fold_mj: u32,
    /// Lowest battery voltage during the fold.
    pub fold_battery_mv: u16,
    /// Duration of the unfolding.
    pub unfold_ms: u32,
    /// Thread at its end.
    pub unfolded_um: i32,
    /// Energy of the unfolding.
    pub unfold_mj: u32,
    /// Lowest battery voltage during the unfolding.
    pub unfold_battery_mv: u16,
    /// Whether the capsule is real.
    pub origin: Origin,
}

/// Change of one quantity over the pairs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Drift {
    /// Value of the first pair.
    pub first: f64,
    /// Value of the last pair.
    pub last: f64,
    /// Least value.
    pub least: f64,
    /// Greatest value.
    pub most: f64,
    /// Slope of the straight line through all values, per 100 pairs; none for fewer than three.
    pub per_100_pairs: Option<f64>,
}

impl Drift {
    /// From values with the number of their pair; none without values.
    #[must_use]
    pub fn of(figures: &[(f64, f64)]) -> Option<Self> {
        let ((_, first), (_, last)) = (*figures.first()?, *figures.last()?);
        let values = || figures.iter().map(|(_, value)| *value);
        let count = figures.len() as f64;
        let mean_x = figures.iter().map(|(x, _)| x).sum::<f64>() / count;
        let mean_y = values().sum::<f64>() / count;
        let (mut products, mut squares) = (0.0, 0.0);
        for (x, y) in figures {
            products += (x - mean_x) * (y - mean_y);
            squares += (x - mean_x) * (x - mean_x);
        }
        Some(Self {
            first,
            last,
            least: values().fold(f64::INFINITY, f64::min),
            most: values().fold(f64::NEG_INFINITY, f64::max),
            per_100_pairs: (figures.len() > 2).then(|| 100.0 * products / squares),
        })
    }
}

/// The drift of each quantity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Drifts {
    /// Folded end.
    pub folded_um: Option<Drift>,
    /// Unfolded end.
    pub unfolded_um: Option<Drift>,
    /// No-load current.
    pub no_load_ma: Option<Drift>,
    /// Energy of a pair.
    pub pair_mj: Option<Drift>,
    /// Duration of a fold.
    pub fold_ms: Option<Drift>,
    /// Duration of an unfolding.
    pub unfold_ms: Option<Drift>,
}

impl Drifts {
    fn of(pairs: &[Pair]) -> Self {
        let drift = |figure: &dyn Fn(&Pair) -> Option<f64>| {
            let figures: Vec<_> = pairs
                .iter()
                .filter_map(|pair| Some((pair.pair.into(), figure(pair)?)))
                .collect();
            Drift::of(&figures)
        };
        Self {
            folded_um: drift(&|pair| Some(pair.folded_um.into())),
            unfolded_um: drift(&|pair| Some(pair.unfolded_um.into())),
            no_load_ma: drift(&|pair| pair.no_load_ma),
            pair_mj: drift(&|pair| Some((pair.fold_mj + pair.unfold_mj).into())),
            fold_ms: drift(&|pair| Some(pair.fold_ms.into())),
            unfold_ms: drift(&|pair| Some(pair.unfold_ms.into())),
        }
    }
}

/// Summary of an endurance run, also while it runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Endurance {
    /// How it ended.
    pub status: Status,
    /// Why, unless it is complete.
    pub error: Option<String>,
    /// Whether the capsule is real.
    pub origin: Origin,
    /// Its start.
    pub started_utc: Timestamp,
    /// Number of requested pairs.
    pub asked: u32,
    /// Number of complete pairs.
    pub done: u32,
    /// Drift over the complete pairs.
    pub drift: Drifts,
}

/// An endurance run and its two files.
#[derive(Debug)]
pub struct Run {
    /// Summary so far.
    pub endurance: Endurance,
    /// The pairs.
    pub csv: PathBuf,
    /// The summary.
    pub summary: PathBuf,
    writer: csv::Writer<File>,
    pairs: Vec<Pair>,
}

impl Run {
    /// Creates both files; overwrites none.
    ///
    /// # Errors
    /// They cannot be created.
    pub fn create(
        folder: &Path,
        now: Timestamp,
        asked: u32,
        origin: Origin,
    ) -> Result<Self, RecordError> {
        fs::create_dir_all(folder).map_err(|io| RecordError::write(folder, io))?;
        let name = format!("cycle-{}", now.strftime("%Y%m%dT%H%M%SZ"));
        let (csv, file) = create_new(folder, &name)?;
        let run = Self {
            endurance: Endurance {
                status: Status::Running,
                error: None,
                origin,
                started_utc: now,
                asked,
                done: 0,
                drift: Drifts::default(),
            },
            summary: csv.with_extension("json"),
            writer: csv::Writer::from_writer(file),
            csv,
            pairs: vec![],
        };
        run.write_summary()?;
        Ok(run)
    }

    /// Folds and unfolds until all pairs are done, a motion fails, or the operator stops it. Calls `tell` after each
    /// pair.
    ///
    /// # Errors
    /// The capsule refused or was lost, or a file could not be written. The summary shows the progress even then.
    pub fn carry_out(
        &mut self,
        capsule: &mut Device,
        observer: &mut dyn Observer,
        tell: &mut dyn FnMut(&Pair),
    ) -> Result<(), ExperimentError> {
        let result = self.all_pairs(capsule, observer, tell);
        if let Err(error) = &result {
            self.endurance.status = match error {
                ExperimentError::Client(ClientError::Interrupted { .. }) => Status::Stopped,
                // Refused before anything moved. A later refusal ends a series that was partly carried out.
                ExperimentError::Client(ClientError::Refused {
                    request: "Fold", ..
                }) if self.endurance.done == 0 => Status::Refused,
                ExperimentError::Client(ClientError::Refused { .. }) => Status::Stopped,
                _ => Status::Unknown,
            };
            self.endurance.error = Some(error.to_string());
        }
        let written = self.write_summary();
        match result {
            // A stop between two motions is a normal end, not a failure.
            Ok(()) | Err(ExperimentError::Client(ClientError::Interrupted { .. })) => {
                written.map_err(Into::into)
            }
            // More urgent than a summary that could not be written.
            Err(error) => Err(error),
        }
    }

    fn all_pairs(
        &mut self,
        capsule: &mut Device,
        observer: &mut dyn Observer,
        tell: &mut dyn FnMut(&Pair),
    ) -> Result<(), ExperimentError> {
        for pair in 1..=self.endurance.asked {
            let accepted = capsule.fold()?;
            let fold = capsule.wait_actuation(&accepted, observer)?;
            if !self.goes_on(&fold) {
                return Ok(());
            }
            let no_load_ma = no_load_ma(&over_the_slack(capsule, fold.actuation)?);
            let accepted = capsule.unfold()?;
            let unfold = capsule.wait_actuation(&accepted, observer)?;
            if !self.goes_on(&unfold) {
                return Ok(());
            }
            let row = Pair {
                pair,
                fold_ms: fold.duration_ms,
                folded_um: fold.thread_um,
                engaged_um: fold.engaged_um,
                fold_end_ma: fold.end_current_ma,
                no_load_ma,
                fold_mj: fold.energy_mj,
                fold_battery_mv: fold.min_battery_mv,
                unfold_ms: unfold.duration_ms,
                unfolded_um: unfold.thread_um,
                unfold_mj: unfold.energy_mj,
                unfold_battery_mv: unfold.min_battery_mv,
                origin: self.endurance.origin,
            };
            self.keep(row)?;
            tell(&row);
        }
        self.endurance.status = Status::Complete;
        Ok(())
    }

    /// Whether the motion ended normally; otherwise notes how it ended.
    fn goes_on(&mut self, record: &ActuationRecord) -> bool {
        if record.outcome == ActuationOutcome::Complete {
            return true;
        }
        self.endurance.status = record.outcome.into();
        self.endurance.error = match record.outcome {
            ActuationOutcome::Faulted(fault) => Some(fault.to_string()),
            _ => None,
        };
        false
    }

    fn keep(&mut self, row: Pair) -> Result<(), RecordError> {
        let failed = |error: &dyn ToString| RecordError::write(&self.csv, error.to_string());
        self.writer.serialize(row).map_err(|error| failed(&error))?;
        self.writer.flush().map_err(|error| failed(&error))?;
        // The summary must not count a pair that a power cut takes.
        let synced = self.writer.get_ref().sync_data();
        synced.map_err(|error| failed(&error))?;
        self.pairs.push(row);
        self.endurance.done = row.pair;
        self.endurance.drift = Drifts::of(&self.pairs);
        self.write_summary()
    }

    fn write_summary(&self) -> Result<(), RecordError> {
        json(&self.endurance)
            .and_then(|bytes| replace(&self.summary, &bytes))
            .map_err(|io| RecordError::write(&self.summary, io))
    }
}

/// Readings over the slack, from the capsule's recording of the fold that has just ended: time, ms; thread, um;
/// current, mA. Fetches the first part of the recording only. Empty if the recording has lost its beginning.
fn over_the_slack(capsule: &mut Device, actuation: u32) -> Result<Vec<[f64; 3]>, ClientError> {
    let mut readings = vec![];
    let mut from = 0;
    loop {
        let part = capsule.call(GetTrace { from })?;
        // A device that says no end keeps nobody here.
        let is_endless = from as usize > KEPT_TRACE_POINTS;
        if part.actuation != actuation || usize::from(part.total) >= KEPT_TRACE_POINTS || is_endless
        {
            return Ok(vec![]);
        }
        for (time_ms, point) in (from..).zip(&part.points) {
            if point.thread_um >= SLACK_UM.end {
                return Ok(readings);
            }
            if point.drive_mv <= 0 {
                // The motor was braked: start over after it.
                readings.clear();
            } else if point.thread_um >= SLACK_UM.start {
                readings.push([
                    time_ms.into(),
                    point.thread_um.into(),
                    point.current_ma.into(),
                ]);
            }
        }
        if part.points.is_empty() {
            return Ok(readings);
        }
        // Fits: a recording has at most 2800 readings.
        from += part.points.len() as u32;
    }
}

/// Number of readings over which a speed is taken, at both ends.
const SPEED: usize = 12;
/// Fewest readings for a mean current.
const LEAST_READINGS: usize = 40;

/// Mean current minus the part that accelerates the motor, to 0.01 mA.
fn no_load_ma(readings: &[[f64; 3]]) -> Option<f64> {
    if readings.len() < LEAST_READINGS {
        return None;
    }
    let speed = |part: &[[f64; 3]]| {
        let ([t0, x0, _], [t1, x1, _]) = (part.first()?, part.last()?);
        Some(((x1 - x0) / (t1 - t0), (t0 + t1) / 2.0))
    };
    let (before, at) = speed(&readings[..=SPEED])?;
    let (after, later) = speed(&readings[readings.len() - SPEED - 1..])?;
    let accelerating_ma = (after - before) / (later - at) / UM_MS2_PER_MA;
    // Average between the middles of the two speed measurements.
    let between = &readings[SPEED / 2 + 1..readings.len() - SPEED / 2];
    let mean_ma = between.iter().map(|[.., ma]| ma).sum::<f64>() / between.len() as f64;
    let no_load_ma = mean_ma - accelerating_ma;
    no_load_ma
        .is_finite()
        .then(|| (no_load_ma * 100.0).round() / 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_no_load_current_is_without_what_makes_the_motor_faster() {
        let readings = |faster: f64| -> Vec<_> {
            (0..100)
                .map(|index| {
                    let ms = f64::from(index);
                    [ms, 10.0 * ms + faster * ms * ms / 2.0, 20.0]
                })
                .collect()
        };
        assert_eq!(no_load_ma(&readings(0.0)), Some(20.0));
        // An acceleration of 0.02 um/ms per ms takes 3.88 mA.
        assert_eq!(no_load_ma(&readings(0.02)), Some(16.12));
        // Only between the middles of the two measurements of the speed.
        let mut ends = readings(0.0);
        for reading in ends.iter_mut().take(7) {
            reading[2] = 90.0;
        }
        for reading in ends.iter_mut().skip(94) {
            reading[2] = 90.0;
        }
        assert_eq!(no_load_ma(&ends), Some(20.0));
        (ends[7][2], ends[93][2]) = (63.5, 63.5);
        assert_eq!(no_load_ma(&ends), Some(21.0));
        // A speed that rises by 1 mm/s for the last 12 ms only, 87 ms after the first ones: 2.23 mA.
        let mut late = readings(0.0);
        for (index, reading) in late.iter_mut().enumerate().skip(88) {
            reading[1] += (index - 87) as f64;
        }
        assert_eq!(no_load_ma(&late), Some(17.77));
        assert_eq!(no_load_ma(&readings(0.0)[..40]), Some(20.0));
        assert_eq!(no_load_ma(&readings(0.0)[..39]), None);
        assert_eq!(no_load_ma(&[[1.0, 1.0, 16.0]; 40]), None, "at one instant");
    }

    #[test]
    fn drift_is_the_slope_of_all_and_not_of_two() {
        let figures = [(1.0, 10.0), (2.0, 12.0), (3.0, 11.0), (4.0, 13.0)];
        assert_eq!(
            Drift::of(&figures),
            Some(Drift {
                first: 10.0,
                last: 13.0,
                least: 10.0,
                most: 13.0,
                per_100_pairs: Some(80.0),
            })
        );
        let two = Drift::of(&figures[..2]).expect("two");
        assert_eq!((two.last, two.per_100_pairs), (12.0, None));
        assert_eq!(Drift::of(&[]), None);
    }

    #[test]
    fn each_quantity_has_its_drift() {
        let pair = |number: u32| Pair {
            pair: number,
            fold_ms: 1_900 + number,
            folded_um: 21_000 + 2 * number as i32,
            engaged_um: 1_200,
            fold_end_ma: 150,
            no_load_ma: (number != 2).then(|| f64::from(number)),
            fold_mj: 240,
            fold_battery_mv: 3_700,
            unfold_ms: 1_300 - number,
            unfolded_um: 40,
            unfold_mj: 60 * number,
            unfold_battery_mv: 3_750,
            origin: Origin::Virtual,
        };
        let drifts = Drifts::of(&[pair(1), pair(2), pair(3)]);
        let of = |drift: Option<Drift>| {
            let drift = drift.expect("pairs");
            (drift.first, drift.last, drift.per_100_pairs)
        };
        assert_eq!(of(drifts.folded_um), (21_002.0, 21_006.0, Some(200.0)));
        assert_eq!(of(drifts.unfolded_um), (40.0, 40.0, Some(0.0)));
        assert_eq!(of(drifts.no_load_ma), (1.0, 3.0, None));
        assert_eq!(of(drifts.pair_mj), (300.0, 420.0, Some(6_000.0)));
        assert_eq!(of(drifts.fold_ms), (1_901.0, 1_903.0, Some(100.0)));
        assert_eq!(of(drifts.unfold_ms), (1_299.0, 1_297.0, Some(-100.0)));
    }
}
