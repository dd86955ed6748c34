//! A seed means the same numbers in every version: those of small computations, as they stand here. Other tests say
//! that answers are right within the errors of chance; a changed step of a sampler that is right in another way, or
//! nearly, shows here. Whoever changes one on purpose puts in what the test prints.

use calibration::belief::Belief;
use calibration::chance::{normal, stream};
use calibration::design::{Effort as Histories, Estimate, choose, judge as value};
use calibration::fit::{Settings, fit};
use calibration::history::Trial;
use calibration::observation::{Case, Condition, Kind, Lubrication, Observation, conditions};
use calibration::prediction::Predictor;
use calibration::predictive::{Span, bands, checks};
use calibration::prior::{Parts, Point, Values, parts};
use calibration::replicated::{Predictions, of_prior, predicted};
use calibration::sampler::{Draws, Effort, sample_from};
use calibration::synthetic::{Planned, observations};
use calibration::table::{Region, Table, distinct};
use calibration::tabulated::Tabulated;
use calibration::target::Target;
use calibration::verdict::judge;
use locomotion::model::Model;

/// Numbers differ by rounding, at most, between computers.
fn same(found: &[f64], known: &[f64]) {
    let near = |(one, other): (&f64, &f64)| (one - other).abs() <= 1e-9 * other.abs().max(1e-3);
    let all = found.len() == known.len() && found.iter().zip(known).all(near);
    assert!(all, "{found:?}");
}

/// A sum in which every number and its place count.
fn sum(numbers: impl IntoIterator<Item = f64>) -> f64 {
    let weighted = (1..).zip(numbers).map(|(place, number)| {
        let weight = 1.0 + f64::from(place % 17);
        weight * number
    });
    weighted.sum()
}

fn estimates(all: &[Estimate]) -> f64 {
    sum(all.iter().flat_map(|one| [one.mean, one.error]))
}

/// Two displacements of the first two unknowns; no answer for bodies beyond a bound.
fn linear(point: &Point) -> Option<Vec<f64>> {
    (point[2] < 1.5).then(|| vec![3.0 * point[0], point[0] + point[1]])
}

fn trial(condition: usize, place: usize, error_mm: f64) -> Trial {
    Trial {
        condition,
        place,
        discrepancies: 2.0,
        error_mm,
    }
}

fn smoothed() -> Belief {
    let mut random = stream(7, 7);
    let samples: Vec<Point> = (0..60)
        .map(|_| {
            let [a, b, c, d]: Point = std::array::from_fn(|_| normal(&mut random));
            [0.5 + 0.1 * a, 0.2 * a + 0.05 * b, 0.5 * c - b, d]
        })
        .collect();
    Belief::smoothed(&samples).expect("extent")
}

#[test]
fn a_small_plan() {
    let few = Histories {
        histories: 5,
        draws: 48,
    };
    let trials = [trial(0, 0, 0.05), trial(1, 1, 0.3), trial(0, 0, 0.05)];
    let mut found = vec![];
    for belief in [Belief::Prior, smoothed()] {
        let judged = value(&belief, &linear, &trials, &few, 5).expect("covered");
        found.extend([
            estimates(&judged.gains),
            estimates(&judged.sums),
            judged.correction,
            estimates(&judged.before),
            estimates(&judged.after),
        ]);
        for step in choose(&belief, &linear, &trials[..2], 3, &few, 6).expect("covered") {
            found.push(estimates(&step.gains) + step.chosen as f64);
            found.push(step.ties.len() as f64);
        }
    }
    same(
        &found,
        &[
            8.65532217947378,
            36.02668994567753,
            0.22191396240384287,
            87.22829831759728,
            69.67856080717173,
            8.93783531967283,
            0.0,
            5.493632494525415,
            0.0,
            1.815426319521527,
            0.0,
            1.7852622191743799,
            7.119525249815579,
            0.01642389214859752,
            67.06436904272684,
            52.657239545290494,
            2.474918838606068,
            0.0,
            1.7556412891725368,
            1.0,
            1.1810509952096109,
            0.0,
        ],
    );
}

#[test]
fn a_smoothed_belief() {
    let belief = smoothed();
    let mut random = stream(3, 3);
    let points: Vec<Point> = (0..20).map(|_| belief.draw(&mut random)).collect();
    let densities = points.iter().map(|point| belief.log_density(point));
    let found = [
        sum(points.iter().flatten().copied()),
        sum(densities),
        belief.log_density(&[4.0, -3.0, 2.0, -1.0]),
    ];
    same(
        &found,
        &[107.75747829219924, 10.933416202699043, -230568.1423459631],
    );
}

/// A way in which trials are wrong.
type Wrong = fn(&mut Observation);

const RIGHT: Wrong = |_| {};

/// Trials of a body on both walls, each changed by `wrong`.
fn measured(wrong: Wrong) -> Vec<Observation> {
    let truth = Values([0.15, 40.0, 0.0007, 0.02]).point();
    let mut planned = vec![];
    for (lubrication, deeper_mm) in [(Lubrication::Dry, 0.0), (Lubrication::Lubricated, 0.01)] {
        for depth_mm in [1.0, 2.0, 3.5] {
            for kind in [
                Kind::AntegradePass,
                Kind::ReturningPass,
                Kind::Net { cycles: 1 },
                Kind::Stroke { number: 2 },
            ] {
                planned.push(Planned {
                    lubrication,
                    ..Planned::dry(kind, depth_mm + deeper_mm, 2, 0.2)
                });
            }
        }
    }
    let mut all = observations(&Model::ONE, &truth, &planned, &mut stream(4, 0)).expect("covered");
    all.iter_mut().for_each(wrong);
    all
}

/// A table of the model, and what was measured beside it.
struct Small {
    conditions: Vec<Condition>,
    places: Vec<usize>,
    table: Table,
    errors_mm: Vec<f64>,
}

impl Small {
    fn new(wrong: Wrong) -> Self {
        let conditions = conditions(&measured(wrong)).expect("usable");
        let (cases, places) = distinct(conditions.iter().map(|one| one.case));
        let predictor = Predictor::new(&Model::ONE, &cases, 0.5).expect("covered");
        let errors_mm = (0..cases.len()).map(|case| 0.01 * case as f64).collect();
        Self {
            conditions,
            places,
            table: Table::new(predictor, Region::WHOLE, [5, 4, 3]),
            errors_mm,
        }
    }

    fn target(&self) -> Target<'_> {
        Target {
            conditions: &self.conditions,
            places: &self.places,
            table: &self.table,
            table_errors_mm: &self.errors_mm,
        }
    }
}

const EFFORT: Effort = Effort {
    ensembles: 2,
    walkers: 8,
    starts: 40,
    stages: 2,
    stage_steps: 3,
    steps: 6,
    doublings: 1,
};

fn of_draws(draws: &Draws) -> [f64; 3] {
    let points = sum(draws.ensembles.iter().flatten().flatten().copied());
    [draws.count() as f64, draws.accepted, points]
}

fn of_predictions(all: &Predictions) -> [f64; 3] {
    let each = || all.iter().flat_map(|(_, each)| each);
    [
        sum(each().map(|one| one.model_mm)),
        sum(each().map(|one| one.replicated_mm)),
        sum(each().filter_map(|one| one.log_density)),
    ]
}

#[test]
fn a_small_posterior() {
    let small = Small::new(RIGHT);
    let draws = sample_from(&small.target(), &EFFORT, 9, None).expect("a posterior");
    let mut found = of_draws(&draws).to_vec();
    let again = sample_from(&small.target(), &EFFORT, 9, Some(&draws)).expect("a posterior");
    found.extend(of_draws(&again));
    for count in [1, 7, 50] {
        found.push(sum(draws.thinned(count).into_iter().flatten()));
    }
    let mixing = draws.mixing();
    found.push(sum(mixing
        .iter()
        .flat_map(|one| [one.r_hat, one.ess, one.tail_ess])));
    found.extend(of_predictions(&predicted(&small.target(), &draws, 9)));
    same(
        &found,
        &[
            192.0,
            0.140625,
            4765.517081176776,
            192.0,
            0.203125,
            -22.122025335247393,
            24.122465974335068,
            216.80019871747604,
            1119.2048303114461,
            7813.087004468072,
            109795.33405343477,
            112323.81241255696,
            -81245.84750105737,
        ],
    );
}

#[test]
fn predictions_by_the_model_itself() {
    let conditions = conditions(&measured(RIGHT)[..12]).expect("usable");
    let (draws, predicted) = of_prior(&Model::ONE, &conditions, 6, 0.5, 2).expect("covered");
    let mut found = of_draws(&draws).to_vec();
    found.extend(of_predictions(&predicted));
    let points = &draws.ensembles[0];
    let span = |of: &Span| [of.low, of.median, of.high];
    let checked = checks(&Model::ONE, &conditions, points, 2).expect("covered");
    found.push(sum(checked.iter().flat_map(|one| span(&one.replicated_mm))));
    found.push(sum(checked.iter().map(|one| one.p_mean)));
    found.push(sum(checked.iter().filter_map(|one| one.p_scatter)));
    let cases: Vec<Case> = conditions.iter().map(|one| one.case).collect();
    let bands = bands(&Model::ONE, points, &cases, 0.5, 2).expect("covered");
    found.push(sum(bands.iter().flat_map(|one| span(&one.model_mm))));
    found.push(sum(bands
        .iter()
        .flat_map(|one| span(&one.with_discrepancy_mm))));
    same(
        &found,
        &[
            6.0,
            1.0,
            -25.38288901072498,
            459.04048911924104,
            443.7464191377473,
            -0.0,
            148.7298666329103,
            23.146179401993358,
            13.041301442075977,
            192.3826518360317,
            191.5385234847712,
        ],
    );
}

/// All tables, from the prior's to that of the answer.
#[test]
fn a_small_fit() {
    let few = |all: &[Observation]| {
        let settings = Settings {
            seed: 3,
            effort: Effort {
                doublings: 2,
                ..EFFORT
            },
        };
        fit(&Model::ONE, all, &settings)
    };
    let fit = few(&measured(RIGHT)[..8]).expect("a posterior");
    let mut found = of_draws(&fit.draws).to_vec();
    found.extend(of_predictions(&fit.predicted));
    found.extend([fit.step_mm, fit.table_error, fit.nodes as f64]);
    found.extend([sum(fit.table_errors_mm.clone()), fit.quantile(1, 0.25)]);
    found.push(fit.verdict.reasons.len() as f64);
    same(
        &found,
        &[
            384.0,
            0.3333333333333333,
            -2916.270665233517,
            17473.753729051685,
            17642.09713831321,
            8569.852327045617,
            0.1,
            0.15421798121810953,
            814.0,
            0.47437581191899214,
            29.29695046614649,
            1.0,
        ],
    );
    for (wrong, what) in [
        ((|one| one.displacement_mm *= -1.0) as Wrong, "signs"),
        (
            |one| {
                one.displacement_mm /= 10.0;
                one.uncertainty_mm /= 10.0;
            },
            "centimetres",
        ),
        (
            |one| {
                one.displacement_mm *= 1e3;
                one.uncertainty_mm *= 1e3;
            },
            "micrometres",
        ),
    ] {
        let refused = few(&measured(wrong)[..16]).expect_err(what).to_string();
        assert!(refused.contains(what), "{refused}");
    }
}

#[test]
fn a_table_for_a_plan() {
    let case = Case {
        kind: Kind::ReturningPass,
        indentation_mm: 2.0,
    };
    let table = Tabulated::new(&Model::ONE, &[case], &Belief::Prior, 1).expect("covered");
    let read = table.at(&[0.3, -0.2, 0.1, 0.0]).expect("within");
    same(
        &[table.errors_mm[0], read[0], read.len() as f64],
        &[0.11770931219402166, -1.725969688650567, 1.0],
    );
}

/// The reasons for trials that are wrong in a way that one check or another sees.
fn reasons(wrong: Wrong) -> Vec<String> {
    let small = Small::new(wrong);
    let draws = sample_from(&small.target(), &EFFORT, 9, None).expect("a posterior");
    let exact = |body: &Parts, cases: &[Case]| {
        Predictor::new(&Model::ONE, cases, 0.25)?.displacements_mm(body)
    };
    let verdict = judge(&small.target(), &draws, &exact).expect("covered");
    let sentences = verdict.reasons.into_iter().map(|one| one.sentence);
    sentences.collect()
}

#[test]
fn reasons_where_the_walls_differ() {
    let wrong: Wrong = |one| {
        if one.lubrication == Lubrication::Lubricated {
            one.displacement_mm *= 1.05;
        }
    };
    assert_eq!(
        reasons(wrong),
        [
            "without tau the nearest body misses the displacements by a chi-square of 83.7 at 21 degrees of freedom, p 2e-9: tau absorbs what the model does not explain",
            "fit.discrepancy_mm has a median of 0.96 mm, beyond 95 % of its prior, 0.52 mm: the model is wrong by more than was thought possible",
            "the other conditions do not predict the stroke 2, lubricated, at 3.51 mm, p 2e-13 among 24 conditions: the readings there are wrong, or the model is",
            "body.preload_mm lies at the upper end of its prior, 0.2, with 31 % of the draws in the last twentieth of it: the prior decides, not the trials"
        ]
    );
}

#[test]
fn reasons_where_the_coupling_changes_with_the_indentation() {
    let wrong: Wrong = |one| one.displacement_mm *= 1.1 - 0.05 * one.indentation_mm;
    assert_eq!(
        reasons(wrong),
        [
            "without tau the nearest body misses the displacements by a chi-square of 138.1 at 21 degrees of freedom, p 3e-19: tau absorbs what the model does not explain",
            "body.preload_mm lies at the upper end of its prior, 0.2, with 29 % of the draws in the last twentieth of it: the prior decides, not the trials",
            "the other conditions do not predict the net of 1 cycle, lubricated, at 3.51 mm, p 0.0316 among 24 conditions: the readings there are wrong, or the model is"
        ]
    );
}

#[test]
fn reasons_where_a_net_is_that_of_three_cycles() {
    let wrong: Wrong = |one| {
        if one.kind == (Kind::Net { cycles: 1 }) && one.indentation_mm > 3.0 {
            one.displacement_mm *= 3.0;
        }
    };
    assert_eq!(
        reasons(wrong),
        [
            "without tau the nearest body misses the displacements by a chi-square of 14952.1 at 21 degrees of freedom, p 0e0: tau absorbs what the model does not explain",
            "fit.discrepancy_mm has a median of 4.37 mm, beyond 95 % of its prior, 0.52 mm: the model is wrong by more than was thought possible",
            "body.preload_mm lies at the upper end of its prior, 0.2, with 74 % of the draws in the last twentieth of it: the prior decides, not the trials",
            "without tau the residual of the net of 1 cycle, lubricated, rises with the indentation by 66.4 standard deviations, p 0e0 among 8 series: a parameter that the model keeps changes with the indentation",
            "the other conditions do not predict the net of 1 cycle, dry, at 3.5 mm, p 0e0 among 24 conditions: the readings there are wrong, or the model is",
            "the net of 1 cycle, dry, at 3.5 mm is 22.0 mm, and 1 times its antegrade and returning pass together 7.6 mm: signs, units or cycles of one of them are wrong",
            "body.friction_ratio lies at the lower end of its prior, 1.2, with 36 % of the draws in the last twentieth of it: the prior decides, not the trials"
        ]
    );
}

#[test]
fn a_sheared_table() {
    let small = Small::new(RIGHT);
    let draws = sample_from(&small.target(), &EFFORT, 9, None).expect("a posterior");
    let bodies: Vec<Parts> = draws.ensembles.iter().flatten().map(parts).collect();
    let region = Region::around(&bodies, 0.1).expect("bodies");
    let predictor = Predictor::new(
        &Model::ONE,
        &[Case {
            kind: Kind::AntegradePass,
            indentation_mm: 2.0,
        }],
        0.5,
    )
    .expect("covered");
    let table = Table::new(predictor, region, [4, 3, 2]);
    let read = |body: &Parts| table.displacements_mm(body).expect("within")[0];
    let found = [sum(bodies.iter().map(read)), table.worked_out().0 as f64];
    same(&found, &[6845.5098032576625, 24.0]);
}
