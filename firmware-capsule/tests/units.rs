//! Counts and thread.

use firmware_capsule::sense::Counts;
use firmware_capsule::units::Thread;

/// Thread per count: the spool's circumference over gears and encoder edges.
const UM_PER_COUNT: f64 = 2.0 * core::f64::consts::PI * 1_500.0 / (4.0 * 30.0) / 64.0;

#[test]
fn a_motor_revolution_winds_the_spool_by_its_share() {
    assert_eq!(Counts(64).thread(), Thread(79)); // 78.54 um
    assert_eq!(Counts(-64).thread(), Thread(-79));
    let exact_um = 64_000.0 * UM_PER_COUNT;
    assert!((f64::from(Counts(64_000).thread().0) - exact_um).abs() < 1.0);
}

#[test]
fn lengths_and_counts_are_rounded_to_the_nearest() {
    // Over the travel of the thread both ways; 355/113 for pi is 3 nm off there.
    for value in -30_000..=30_000 {
        let um = f64::from(value) * UM_PER_COUNT;
        let error = f64::from(Counts(value).thread().0) - um;
        assert!(error.abs() < 0.504, "{value} counts: {error} um");
        let counts = f64::from(value) / UM_PER_COUNT;
        let error = f64::from(Thread(value).counts().0) - counts;
        assert!(error.abs() < 0.504, "{value} um: {error} counts");
    }
}

/// Beyond 200,000 the division has 64 bits; 3 nm become 20.
#[test]
fn long_lengths_are_rounded_to_the_nearest_too() {
    for value in (-200_100..-199_900).chain(199_900..200_100) {
        let um = f64::from(value) * UM_PER_COUNT;
        let error = f64::from(Counts(value).thread().0) - um;
        assert!(error.abs() < 0.525, "{value} counts: {error} um");
    }
}

#[test]
fn the_ends_of_the_counter_saturate() {
    assert_eq!(Counts(i32::MIN).thread(), Thread(i32::MIN));
    assert_eq!(Counts(i32::MAX).thread(), Thread(i32::MAX));
    // The counter covers more than any length in um.
    assert_eq!(Thread(i32::MAX).counts(), Counts(1_749_926_956));
    assert_eq!(Thread(i32::MIN).counts(), Counts(-1_749_926_957));
}

#[test]
fn distances_survive_the_wrap_of_the_counter() {
    assert_eq!(Counts(i32::MIN + 4) - Counts(i32::MAX - 5), Counts(10));
    assert_eq!(Counts(i32::MAX - 5) + Counts(10), Counts(i32::MIN + 4));
    assert_eq!(Counts(7) - Counts(-3), Counts(10));
}
