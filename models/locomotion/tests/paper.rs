//! The table of docs/paper-comparison.md: the models' values, and whether they meet the paper's sentences.

use std::ops::RangeInclusive;

use locomotion::body::{Chain, FrictionRatio};
use locomotion::folded::FoldedBody;
use locomotion::kinematics::{Design, repaired_eq6_residual};
use locomotion::model::Model;
use locomotion::paper::{INDENTATIONS_MM, frictions, pressures_pa};
use locomotion::{roller, tube};

/// Quantity, the model's value, the decimals of the table, and the values that meet the sentence.
type Row = (&'static str, f64, usize, RangeInclusive<f64>);

const DEEPEST_MM: f64 = 5.05;
const MORE: RangeInclusive<f64> = f64::MIN_POSITIVE..=f64::INFINITY;
const LESS: RangeInclusive<f64> = f64::NEG_INFINITY..=-f64::MIN_POSITIVE;

const fn about(value: f64, within: f64) -> RangeInclusive<f64> {
    value - within..=value + within
}

/// The paper's body with other angles or another core.
fn design(alpha_deg: f64, beta_deg: f64, core_ratio: f64) -> Design<f64> {
    Design::new(24.40, core_ratio * 24.40, alpha_deg, beta_deg, 9).unwrap()
}

fn kinematics() -> Vec<Row> {
    let own = Design::paper_printed();
    let d0 = |of: Design<f64>| of.shortening_per_crescent_mm(3.0).unwrap();
    let length = |a| own.length_mm(a).unwrap();
    let facets = FrictionRatio::Facets.at(&own, 0.15).unwrap();
    let mut chain = Chain::new(roller::Params::PAPER.body).unwrap();
    chain.step(|_| DEEPEST_MM).unwrap();
    let (tail, head) = (chain.displacement_mm(), chain.head_displacement_mm());
    chain.step(|_| 0.0).unwrap();
    let released = chain.head_displacement_mm() - head;
    #[rustfmt::skip]
    let rows = vec![
        ("length at a = 5.05 mm over length at rest", length(5.05) / length(0.0), 3, 0.0..=0.99),
        ("friction ratio of facets at beta, mu = 0.15", facets, 2, 1.01..=f64::INFINITY),
        ("tail forward by an even squeeze of 5.05 mm", tail, 2, MORE),
        ("head forward by the release", released, 2, MORE),
        ("d d0/d alpha at a = 3 mm", own.slope_by_alpha_mm(3.0).unwrap(), 2, about(0.0, 0.5)),
        ("Eq. (6) at 12.53 deg, left less right side", repaired_eq6_residual(&own, 3.0), 3, about(0.0, 1e-9)),
        ("d0 at alpha = 20 deg less d0, a = 3 mm", d0(design(20.0, 33.69, 0.2)) - d0(own), 3, LESS),
        ("d d0/d beta at a = 3 mm", own.slope_by_beta_mm(3.0).unwrap(), 2, about(0.0, 0.5)),
        ("d0 at beta = 25 deg less d0, a = 3 mm", d0(design(12.53, 25.0, 0.2)) - d0(own), 3, LESS),
        ("phi at beta = 45 deg less phi", design(12.53, 45.0, 0.2).spacing_mm() - own.spacing_mm(), 2, MORE),
        ("d0 at c/W = 0.4 over d0, a = 3 mm", d0(design(12.53, 33.69, 0.4)) / d0(own), 3, 0.0..=0.5),
        ("tail forward by the same squeeze", tail, 2, about(21.7, 0.05)),
        ("overall shortening at a = 5.05 mm", length(0.0) - length(5.05), 1, about(21.7, 0.05)),
    ];
    rows
}

fn on_rig() -> Vec<Row> {
    let rig = Model::ONE.rig().unwrap();
    let own = rig.body.design;
    let run = |params, a| roller::run(params, a).unwrap();
    let deepest = run(rig, DEEPEST_MM);
    // The body with other long sides, or another number of crescents, less the paper's.
    let other = |tan_beta: f64, crescents: u8| {
        let mut params = rig;
        let (width, core, alpha) = (own.width_mm(), own.core_mm(), own.tan_alpha());
        params.body.design = Design::with_slopes(width, core, alpha, tan_beta, crescents).unwrap();
        run(params, DEEPEST_MM)
    };
    let thirteen = other(own.tan_beta(), 13);
    let per_crescent = thirteen / 13.0 - deepest / 9.0;
    let series = INDENTATIONS_MM.map(|a| run(rig, a));
    let points: Vec<_> = INDENTATIONS_MM.into_iter().zip(series).collect();
    let returning = INDENTATIONS_MM.map(|a| {
        let pass = roller::isolated_pass(rig, a).unwrap();
        pass.returning_mm.abs() / pass.antegrade_mm
    });
    let antegrade = roller::isolated_pass(rig, DEEPEST_MM).unwrap().antegrade_mm;
    let friction = |mu: f64| {
        let mut params = rig;
        params.body.friction = mu;
        run(params, DEEPEST_MM)
    };
    let mut block = FoldedBody::new(Model::ONE.folded(None).unwrap(), DEEPEST_MM).unwrap();
    block.carriage_to(130.0).unwrap();
    let pushed = block.displacement_mm();
    block.carriage_to(0.0).unwrap();
    #[rustfmt::skip]
    let rows = vec![
        ("beta = 45 deg less 33.69 deg, 9 crescents", other(1.0, 9) - deepest, 2, LESS),
        ("the same with as long a core, 5 crescents", other(1.0, 5) - deepest, 1, LESS),
        ("m = 5 less m = 9", other(own.tan_beta(), 5) - deepest, 1, LESS),
        ("m = 13 less m = 9", thirteen - deepest, 1, LESS),
        ("m = 13 less m = 9, per crescent", per_crescent, 3, LESS),
        ("greatest return pass over antegrade pass", returning.into_iter().fold(0.0, f64::max), 3, 0.0..=0.2),
        ("antegrade pass at 5.05 mm", antegrade, 2, MORE),
        ("R^2 of a line, 5 indentations", linearity(&points), 3, 0.95..=1.0),
        ("R^2 with the origin as a sixth point", linearity(&[&[(0.0, 0.0)], &points[..]].concat()), 3, 0.95..=1.0),
        ("rising steps of 4", rising(&series), 0, about(4.0, 0.0)),
        ("mu 0.20 less mu 0.08, 5.05 mm", friction(0.20) - friction(0.08), 0, about(0.0, 1.0)),
        ("folded: displacement in 40 s at 5.05 mm", pushed, 1, LESS),
        ("folded: displacement by the return stroke", block.displacement_mm() - pushed, 0, about(0.0, 1.0)),
    ];
    rows
}

fn in_tube() -> Vec<Row> {
    let pipe = Model::ONE.tube().unwrap();
    let at = |pressure_pa| tube::averaged(pipe, pressure_pa).unwrap().tail_mm;
    let over_frictions = |mut params: tube::Params| {
        let mm = frictions().map(|mu| {
            params.body.friction = mu;
            tube::averaged(params, 7000.0).unwrap().tail_mm
        });
        mm.fold((f64::INFINITY, 0.0_f64), |(low, high), mm| {
            (low.min(mm), high.max(mm))
        })
    };
    let (least, most) = over_frictions(pipe);
    let (facets_least, facets_most) = over_frictions(Model::TUBE.tube().unwrap());
    let tail: Vec<f64> = pressures_pa().map(at).collect();
    let bends: Vec<f64> = tail.windows(3).map(|w| w[2] - 2.0 * w[1] + w[0]).collect();
    let upward = bends.iter().filter(|bend| **bend > 0.0).count();
    let most_bent = (0..9)
        .max_by(|one, other| bends[*one].total_cmp(&bends[*other]))
        .unwrap();
    let faster = (tail[10] - tail[7]) / 3.0 / ((tail[7] - tail[0]) / 7.0);
    #[rustfmt::skip]
    let rows = vec![
        ("waves per minute in the tube", 60.0 / pipe.period_s, 0, 15.0..=18.0),
        ("wall at 3000 Pa", pipe.wall_mm(3000.0), 3, 0.0..=0.96),
        ("wall at 7000 Pa", pipe.wall_mm(7000.0), 2, 2.4..=9.6),
        ("least over mu 0.08 to 0.20, 7000 Pa", least, 1, about(14.0, 1.0)),
        ("greatest less least over mu, 7000 Pa", most - least, 0, about(0.0, 1.0)),
        ("body `tube`: least over mu, 7000 Pa", facets_least, 1, about(14.0, 1.0)),
        ("body `tube`: greatest over mu, 7000 Pa", facets_most, 1, about(14.0, 1.0)),
        ("displacement in 20 s at 3000 Pa", tail[0], 2, 0.5..=1.5),
        ("displacement in 20 s at 7000 Pa", tail[10], 1, about(15.0, 1.0)),
        ("upward bends of 9", upward as f64, 0, about(9.0, 0.0)),
        ("rising steps of 10", rising(&tail), 0, about(10.0, 0.0)),
        ("slope above 5800 Pa over slope below", faster, 1, 1.5..=f64::INFINITY),
        ("where the slope changes most", 3400.0 + 400.0 * most_bent as f64, 0, about(6000.0, 400.0)),
    ];
    rows
}

fn rising(series: &[f64]) -> f64 {
    series.windows(2).filter(|w| w[1] > w[0]).count() as f64
}

/// R^2 of the least-squares line.
fn linearity(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / n;
    let (mean_x, mean_y) = (mean(|point| point.0), mean(|point| point.1));
    let xy = mean(|(x, y)| x * y) - mean_x * mean_y;
    let (xx, yy) = (
        mean(|(x, _)| x * x) - mean_x * mean_x,
        mean(|(_, y)| y * y) - mean_y * mean_y,
    );
    xy * xy / (xx * yy)
}

#[test]
fn the_manual_has_these_values() {
    let manual = include_str!("../../../docs/paper-comparison.md");
    let rows: Vec<Vec<&str>> = (manual.lines().filter(|line| line.starts_with("| I")))
        .map(|line| line.split('|').map(str::trim).collect())
        .collect();
    let computed = [kinematics(), on_rig(), in_tube()].concat();
    for (quantity, value, decimals, wanted) in &computed {
        let mut found = rows.iter().filter(|row| row[3] == *quantity);
        let row = found
            .next()
            .unwrap_or_else(|| panic!("no row of {quantity}"));
        assert_eq!(found.next(), None, "{quantity}");
        let value_text = row[5].split(' ').next();
        assert_eq!(
            value_text,
            Some(format!("{value:.decimals$}").as_str()),
            "{quantity}"
        );
        let verdict = if wanted.contains(value) {
            "met"
        } else {
            "miss"
        };
        assert_eq!(row[6], verdict, "{quantity}: {value}");
    }
    assert!(
        rows.len() == computed.len() && rows.len() <= 40,
        "{}",
        rows.len()
    );
}
