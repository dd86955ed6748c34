//! The record of an actuation: energy, currents, duration.

use super::*;
use crate::sense::Counts;

fn sample(current_ma: i32, battery_mv: u16) -> Sample {
    Sample {
        counts: Counts(0),
        current_ua: current_ma * 1_000,
        battery_mv,
        ..Sample::default()
    }
}

/// Energy of a second, mJ.
fn energy_mj(current_ma: i32, drive_mv: i16, battery_mv: u16, rest_mv: u16) -> u32 {
    let mut recorder = Recorder::default();
    for _ in 0..1_000 {
        recorder.add_energy(&sample(current_ma, battery_mv), drive_mv, rest_mv, 1_000);
    }
    recorder.record().energy_mj
}

/// Without pulses the battery gives the motor's current all the time.
#[test]
fn at_full_drive_the_energy_is_voltage_times_current_times_time() {
    assert_eq!(energy_mj(100, 3_700, 3_700, 3_700), 370);
    assert_eq!(energy_mj(-100, -3_700, 3_700, 3_700), 370, "paying out");
    assert_eq!(energy_mj(100, 0, 3_700, 3_700), 0, "without a drive");
    // More than the battery has is all of it.
    assert_eq!(energy_mj(100, 5_000, 3_700, 3_700), 370);
    // 100 mV of sag are part of what is measured.
    assert_eq!(energy_mj(100, 3_700, 3_700, 3_800), 370);
}

/// At half of the voltage the battery gives half of the current, and a sixteenth of what rises in the pulses at 26.3
/// mA per volt: 6.1 mA of 97.3. Over the pulses alone, half of the time, it sags twice as much.
#[test]
fn in_pulses_the_energy_counts_the_rise_of_the_current_and_the_sag() {
    assert_eq!(energy_mj(100, 1_850, 3_700, 3_700), 207);
    assert_eq!(energy_mj(100, 1_850, 3_700, 3_800), 202);
    // Half of the voltage at rest is the most that it can sag.
    assert_eq!(energy_mj(1_000, 37, 2_000, 3_700), 33);
    assert_eq!(energy_mj(0, 1_850, 3_700, 3_700), 22);
}

#[test]
fn a_motor_that_is_braked_feeds_energy_back_but_never_more_than_it_took() {
    let mut recorder = Recorder::default();
    let add = |recorder: &mut Recorder, current_ma, elapsed_us| {
        recorder.add_energy(&sample(current_ma, 3_700), 3_700, 3_700, elapsed_us);
        recorder.record().energy_mj
    };
    assert_eq!(add(&mut recorder, 100, 1_000_000), 370);
    assert_eq!(add(&mut recorder, -50, 1_000_000), 185);
    assert_eq!(add(&mut recorder, -50, 2_000_000), 0);
    assert_eq!(add(&mut recorder, 100, 1_000_000), 370);
    // Half a millijoule is rounded up.
    let mut recorder = Recorder::default();
    assert_eq!(add(&mut recorder, 100, 1_351), 0);
    assert_eq!(add(&mut recorder, 100, 1), 1);
}

#[test]
fn without_a_battery_reading_no_energy_is_counted() {
    assert_eq!(energy_mj(100, 3_700, 0, 3_700), 0);
}

#[test]
fn a_record_has_the_last_current_the_largest_one_and_the_lowest_voltage() {
    let mut recorder = Recorder::default();
    recorder.start(0, ActuationKind::Fold, Thread(250), 3_900);
    for (current_ma, battery_mv) in [(40, 3_850), (90, 3_600), (70, 3_700)] {
        recorder.current(current_ma, 0, 0, Thread(0));
        recorder.sample(
            1_234_999,
            &sample(current_ma.into(), battery_mv),
            None,
            3_900,
        );
    }
    let record = recorder.record();
    assert_eq!((record.end_current_ma, record.peak_current_ma), (70, 90));
    assert_eq!((record.min_battery_mv, record.duration_ms), (3_600, 1_234));
    recorder.start(2_000_000, ActuationKind::Unfold, Thread(0), 3_900);
    let next = recorder.record();
    assert_eq!((next.actuation, next.thread_um), (2, 0));
    assert_eq!((next.peak_current_ma, next.duration_ms), (0, 0));
    assert_eq!((next.energy_mj, next.min_battery_mv), (0, 3_900));
}

#[test]
fn the_first_engagement_counts() {
    let mut recorder = Recorder::default();
    for (excess_ma, winds_us, um) in [
        (7, 149_999, 1_000),
        (6, 150_000, 2_000),
        (7, 150_000, 3_000),
        (9, 200_000, 4_000),
    ] {
        recorder.current(40, excess_ma, winds_us, Thread(um));
    }
    assert_eq!(recorder.record().engaged_um, 3_000);
}
