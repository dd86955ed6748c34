//! The quantities from which the measures of a fold are computed.

use super::*;

/// The force doubles with every rise: one rise further it is twice as large, one before half; to second order, and no
/// more than that.
#[test]
fn the_force_doubles_with_every_rise() {
    for (um, thousandths) in [
        (0, 1_000),
        (800, 1_406),
        (1_600, 1_933),
        (3_000, 1_933),
        (-800, 714),
        (-1_600, 547),
        (-3_000, 547),
    ] {
        assert_eq!(grows(um, 1_600), thousandths, "{um} um");
    }
    assert_eq!(grows(1, 0), 1_933, "a thread without a rise");
}

/// -ln(1 - x): a thread that has 90 % of its force lags by 0.105 of 1 / ln 2 rises.
#[test]
fn a_share_of_the_force_is_a_distance() {
    for (share, um) in [
        (1_000, 0),
        (900, 105),
        (700, 354),
        (600, 501),
        (500, 501),
        (0, 501),
        (1_100, -95),
        (1_400, -341),
        (3_000, -341),
    ] {
        assert_eq!(crept_by(share, 693), um, "{share} thousandths");
        assert_eq!(crept_by(share, 1_386), 2 * um, "{share} thousandths");
    }
}

#[test]
fn the_distance_is_that_over_which_the_force_grows() {
    for share in (600..=1_400).step_by(10) {
        let force = grows(-crept_by(share, 1_600), 1_600);
        assert!(force.abs_diff(share) <= 60, "{force} for {share}");
    }
}

/// The mean of the first four, and a quarter of the difference from then on.
#[test]
fn no_single_fold_decides_how_far_the_ends_have_wandered() {
    let mut drift = Drift::default();
    let mut wandered = |um| drift.add(Thread(um)).0;
    assert_eq!(wandered(20_000), 0);
    assert_eq!(wandered(20_100), 50);
    assert_eq!(wandered(20_200), 100);
    assert_eq!(wandered(20_300), 150);
    assert_eq!(wandered(20_350), 200);
    assert_eq!(wandered(20_200), 200);
    assert_eq!(wandered(19_800), 100);
}
