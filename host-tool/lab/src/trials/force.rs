//! The capsule's own recording of an actuation as a file, with the force against the thread, estimated from the
//! current.
//!
//! While the thread is wound, a force F at the thread adds `F * 1.5 mm / (120 * 0.8) * friction / 2.11 mNm/A` to the
//! no-load current. The worm's friction is unknown: a coefficient of 0.10 to 0.20 gives 18.1 to 29.0 mA per newton, so
//! a force is a range. While the thread is paid out, the worm holds most of the force and the current does not show it.

use std::io::Write;

use client::identity::Origin;
use protocol::capsule::TracePoint;
use serde::Serialize;

/// mA per newton with friction coefficients 0.10 and 0.20 in the worm.
const MA_PER_N: (f64, f64) = (18.1, 29.0);
/// Readings over which the current is averaged.
const AVERAGED: usize = 8;
/// Readings of uninterrupted drive after which the motor is back at speed.
const DRIVEN: usize = 40;
/// Readings over which a speed is measured.
const SPEED: usize = 12;
/// Change of speed per mA, um/ms per ms: friction without load over inertia.
pub(crate) const UM_MS2_PER_MA: f64 = 4_200.0 * 1.2272e-6;

/// A row of the file.
#[derive(Debug, Serialize)]
struct ForceRow {
    time_ms: u32,
    thread_um: i32,
    current_ma: u16,
    battery_mv: u16,
    drive_mv: i16,
    force_least_n: Option<String>,
    force_most_n: Option<String>,
    origin: Origin,
}

/// Least and greatest force at a reading, N, above the no-load current; none where the current does not show it.
#[must_use]
pub fn force_n(points: &[TracePoint], index: usize, no_load_ma: u16) -> Option<(f64, f64)> {
    let last = points.get((index + 1).checked_sub(DRIVEN)?..=index)?;
    if last.iter().any(|point| point.drive_mv <= 0) {
        return None;
    }
    let mean_ma = last[DRIVEN - AVERAGED..]
        .iter()
        .map(|point| f64::from(point.current_ma))
        .sum::<f64>()
        / AVERAGED as f64;
    let way_um = |from: usize, to: usize| {
        f64::from(last[DRIVEN - 1 - to].thread_um) - f64::from(last[DRIVEN - 1 - from].thread_um)
    };
    let gained = (way_um(SPEED, 0) - way_um(2 * SPEED, SPEED)) / SPEED as f64;
    let accelerating_ma = gained / SPEED as f64 / UM_MS2_PER_MA;
    let pull_ma = (mean_ma - f64::from(no_load_ma) - accelerating_ma).max(0.0);
    Some((pull_ma / MA_PER_N.1, pull_ma / MA_PER_N.0))
}

/// Writes a recording as CSV, with the force where the current shows it.
///
/// # Errors
/// Those of the file.
pub fn write(
    file: impl Write,
    points: &[TracePoint],
    no_load_ma: Option<u16>,
    origin: Origin,
) -> Result<(), csv::Error> {
    let mut csv = csv::Writer::from_writer(file);
    for (index, point) in points.iter().enumerate() {
        let force = no_load_ma.and_then(|no_load_ma| force_n(points, index, no_load_ma));
        csv.serialize(ForceRow {
            // Fits: a recording has at most 2800 readings.
            time_ms: index as u32,
            thread_um: point.thread_um,
            current_ma: point.current_ma,
            battery_mv: point.battery_mv,
            drive_mv: point.drive_mv,
            force_least_n: force.map(|(least, _)| format!("{least:.2}")),
            force_most_n: force.map(|(_, most)| format!("{most:.2}")),
            origin,
        })?;
    }
    csv.flush()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Winds at 10 mm/s, and accelerates by `faster` um/ms in each ms.
    fn winding(current_ma: u16, faster: f64) -> Vec<TracePoint> {
        (0..100)
            .map(|ms| {
                let ms = f64::from(ms);
                TracePoint {
                    thread_um: (10.0 * ms + faster * ms * ms / 2.0).round() as i32,
                    current_ma,
                    battery_mv: 3_600,
                    drive_mv: 1_500,
                }
            })
            .collect()
    }

    #[test]
    fn a_current_is_a_range_of_forces() {
        let (least, most) = force_n(&winding(16 + 141, 0.0), 99, 16).expect("it is wound");
        assert!((least - 4.86).abs() < 0.01 && (most - 7.79).abs() < 0.01);
        // An acceleration of 0.1 um/ms per ms takes 19.4 mA.
        let (_, most) = force_n(&winding(16 + 141, 0.1), 99, 16).expect("it is wound");
        assert!((most - 6.72).abs() < 0.15, "{most}");
        // One of 2 um/ms per ms takes 388 mA.
        let (_, most) = force_n(&winding(16 + 541, 2.0), 99, 16).expect("it is wound");
        assert!((most - (541.0 - 2.0 / UM_MS2_PER_MA) / 18.1).abs() < 1e-9);
        // The current is that of the last 8 readings, and the speeds those of the last 24.
        let mut points = winding(16 + 141, 0.0);
        for (index, point) in points.iter_mut().enumerate() {
            if index < 92 {
                point.current_ma = 16;
            }
            if index < 75 {
                point.thread_um -= 500;
            }
        }
        let (_, last) = force_n(&points, 99, 16).expect("it is wound");
        assert!((last - 141.0 / 18.1).abs() < 1e-9, "{last}");
    }

    #[test]
    fn there_is_no_force_where_the_current_does_not_tell_it() {
        let mut points = winding(100, 0.0);
        assert!(force_n(&points, 38, 16).is_none(), "too early");
        assert!(force_n(&points, 39, 16).is_some());
        assert!(force_n(&points, 100, 16).is_none(), "no such reading");
        points[60].drive_mv = 0;
        assert!(force_n(&points, 99, 16).is_none(), "braked 39 ms before");
        points[60].drive_mv = -500;
        assert!(force_n(&points, 99, 16).is_none(), "paid out");
    }
}
