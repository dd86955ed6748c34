//! The recording of a motion: which readings it keeps, in which order, and counted from where.

use firmware_capsule::{
    known::Known,
    record::trace::Recording,
    sense::{Counts, Sample},
    speed::Drive,
    units::Thread,
};
use protocol::capsule::{GetTrace, KEPT_TRACE_POINTS, TracePoint};

/// The reading with this number: three counts of thread further than the one before.
fn take(recording: &mut Recording, actuation: u32, number: i32) {
    let sample = Sample {
        counts: Counts(1_000 + 3 * number),
        current_ua: -(number % 200) * 1_000,
        battery_mv: 3_000 + 10 * (number % 90) as u16,
        ..Sample::default()
    };
    let drive = match number % 3 {
        0 => Drive::Brake,
        _ => Drive::Millivolts(-42 * (number % 60) as i16),
    };
    recording.take(actuation, &sample, drive);
}

/// All points, asked for part by part.
fn points(recording: &Recording, known: &Known) -> Vec<TracePoint> {
    let mut points = Vec::new();
    loop {
        let from = points.len() as u32;
        let part = recording.part(&GetTrace { from }, known);
        if part.points.is_empty() {
            assert_eq!(usize::from(part.total), points.len());
            return points;
        }
        points.extend(part.points);
    }
}

#[test]
fn the_last_readings_are_kept_in_their_order_and_counted_from_zero() {
    let kept = KEPT_TRACE_POINTS as i32;
    for readings in [1, 50, kept - 1, kept, kept + 1, 2 * kept + 345] {
        let mut recording = Recording::default();
        for number in 0..readings {
            take(&mut recording, 7, number);
        }
        let mut known = Known::default();
        known.unfolded_here(Counts(-2_000));
        let points = points(&recording, &known);
        assert_eq!(points.len() as i32, readings.min(kept));
        for (number, point) in ((readings - kept).max(0)..readings).zip(&points) {
            let Thread(thread_um) = known.thread(Counts(1_000 + 3 * number));
            assert_eq!(point.thread_um, thread_um, "{number}");
            assert_eq!(i32::from(point.current_ma), number % 200);
            let off_mv = point.battery_mv.abs_diff(3_000 + 10 * (number % 90) as u16);
            assert!(off_mv < 10, "{point:?}");
            let drive_mv = if number % 3 == 0 {
                0
            } else {
                -42 * (number % 60)
            };
            let off_mv = i32::from(point.drive_mv).abs_diff(drive_mv);
            assert!(off_mv < 42, "{point:?}");
        }
        // Another motion begins anew.
        take(&mut recording, 8, 0);
        known.unfolded_here(Counts(1_000));
        let next = recording.part(&GetTrace { from: 0 }, &known);
        assert_eq!((next.actuation, next.total), (8, 1));
        assert_eq!(next.points[0].thread_um, 0);
    }
}

#[test]
fn nothing_is_beyond_the_last_reading() {
    let mut recording = Recording::default();
    take(&mut recording, 1, 0);
    for from in [1, 2, u32::MAX] {
        assert!(
            recording
                .part(&GetTrace { from }, &Known::default())
                .points
                .is_empty()
        );
    }
}
