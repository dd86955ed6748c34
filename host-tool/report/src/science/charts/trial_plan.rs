//! A plan of trials as a figure: the joint information of the trials, and that of a first trial of each kind.

use plotters::style::RGBColor;

use crate::figures::{Curve, FigureError, Heading, Mark, ModelName, figure};
use crate::science::charts::{BAND, MODEL, PAPER, chart, curve, family};
use crate::science::trial_plan::{Series, TrialPlan};

/// Joint information over the number of displacements, from zero, with its standard errors.
fn sums(series: &Series) -> Vec<(f64, f64, f64)> {
    let mut made = 0;
    let mut points = vec![(0.0, 0.0, 0.0)];
    for (planned, sum) in series.trials.iter().zip(&series.judged.sums) {
        made += planned.repeats;
        points.push((made as f64, sum.mean, sum.error));
    }
    points
}

fn line(series: &Series, label: &str, colour: RGBColor) -> Curve {
    let points = sums(series).iter().map(|(x, y, _)| (*x, *y)).collect();
    curve(label, colour, Mark::Line(4), points)
}

/// The figure of a plan.
///
/// # Errors
/// If the drawing library fails.
pub fn trial_plan(model: ModelName, plan: &TrialPlan) -> Result<String, FigureError> {
    let [recommended, as_many, _] = &plan.series;
    let ends = sums(recommended);
    let low = ends.iter().map(|(x, y, error)| (*x, y - 2.0 * error));
    let high = ends.iter().rev().map(|(x, y, error)| (*x, y + 2.0 * error));
    let together = vec![
        curve(
            "two standard errors (model)",
            BAND,
            Mark::Area,
            low.chain(high).collect(),
        ),
        line(recommended, "recommended trials (model)", MODEL),
        line(as_many, "the paper's procedure (model)", PAPER),
    ];
    // Before any measurement both walls give the same information.
    let wall = plan.candidates[0].lubrication;
    let first = (plan.candidates.iter().zip(&plan.steps[0].gains))
        .filter(|(candidate, _)| candidate.lubrication == wall);
    let mut members: Vec<(String, Vec<(f64, f64)>)> = vec![];
    for (candidate, gain) in first {
        let label = format!("{} (model)", candidate.case.kind);
        let point = (candidate.case.indentation_mm, gain.mean);
        match members.last_mut() {
            Some((name, points)) if *name == label => points.push(point),
            _ => members.push((label, vec![point])),
        }
    }
    figure(
        &Heading::of_model("What trials tell of the body", model),
        vec![
            chart("displacements measured", "joint gain / nats", together),
            chart(
                "peristaltic indentation / mm",
                "gain of a first trial / nats",
                family(members, 4),
            ),
        ],
    )
}
