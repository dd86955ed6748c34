//! Identification of known capsules, and the refusals of recordings that show nothing.

use capsule_plant::Parameters;
use lab::trials::identify::{IdentifyError, identify};
use protocol::capsule::TracePoint;

/// The first of those that the example `identify` of `simulated-machines` tries, of which 95 in 100 lie within. All
/// effects are on.
#[test]
fn lifelike_capsules_are_identified_within_the_stated_uncertainty() {
    let mut found = vec![];
    for seed in 0..10 {
        let one = simulated_machines::population::tried(seed).expect("a fit");
        let missed = simulated_machines::population::missed(&one);
        assert_eq!(missed, [""; 0], "seed {seed}: {one:?}");
        found.push(one);
    }
    // The uncertainty must be small enough to be useful, too: the median as a share of the value.
    let most = [0.07, 0.006, 0.12, 0.45, 0.5, 1.1];
    for (index, most) in most.into_iter().enumerate() {
        let share = |one: &Vec<_>| {
            let (_, truth, estimate): (_, f64, lab::trials::identify::Estimate) = one[index];
            estimate.uncertainty / truth
        };
        let mut shares: Vec<f64> = found.iter().map(share).collect();
        shares.sort_by(f64::total_cmp);
        let median = shares[shares.len() / 2];
        assert!(median < most, "{}: {median:.3}", found[0][index].0);
    }
}

/// If the best fit lies outside the searched range, its edge must not be returned as an estimate.
#[test]
fn slack_beyond_what_a_calibration_allows_is_no_fit() {
    let recorded = simulated_machines::population::recordings(Parameters::nominal(), 0);
    for (further_um, fits) in [(0, true), (1_500, true), (4_000, false), (-3_000, false)] {
        let [fold, unfold] = recorded.clone().map(|mut points| {
            for point in &mut points {
                point.thread_um += further_um;
            }
            points
        });
        let found = identify(&fold, &unfold);
        assert_eq!(found.is_ok(), fits, "{further_um} um: {found:?}");
        assert!(
            fits || matches!(found, Err(IdentifyError::NoFit(why)) if why.contains("slack")),
            "{further_um} um: {found:?}"
        );
    }
}

fn rest(readings: usize) -> Vec<TracePoint> {
    let point = TracePoint {
        thread_um: 0,
        current_ma: 0,
        battery_mv: 3_700,
        drive_mv: 0,
    };
    vec![point; readings]
}

#[test]
fn recordings_that_show_nothing_are_refused() {
    for readings in [0, 1, 20, 21, 2_000] {
        let fold = rest(readings);
        assert!(
            matches!(
                identify(&fold, &fold),
                Err(IdentifyError::TooShort {
                    motion: "fold",
                    blocks: 0
                })
            ),
            "{readings}"
        );
    }
    // A motor at one speed and one current reveals neither resistance nor motor constant.
    let turning = |sign: i16| -> Vec<TracePoint> {
        let points = rest(1_000).into_iter().zip(0..);
        let turned = points.map(|(point, ms)| TracePoint {
            thread_um: if sign > 0 { 13 * ms } else { 13_000 - 13 * ms },
            current_ma: 20,
            drive_mv: sign * 1_000,
            ..point
        });
        turned.collect()
    };
    let error = identify(&turning(1), &turning(-1)).expect_err("one speed");
    assert!(matches!(error, IdentifyError::NoFit(_)), "{error}");
    assert!(matches!(
        identify(&turning(1), &turning(1)),
        Err(IdentifyError::TooShort {
            motion: "unfolding",
            ..
        })
    ));
}
