//! The figures of a campaign: displacement against indentation (the paper's Fig. 7), folded against unfolded (its
//! Fig. 8), and each run against its plan.

use crate::figures::palette::{DRY, IN_RUN, MEASURED, MEASURED as WET, PLANNED};
use crate::figures::{
    Chart, Curve, FigureError, Heading, Mark, Source, Thin, curve, figure, figure_in, planned,
    sampled, since,
};
use crate::html::evaluation::{Evaluation, LINE, Part, deviation, run_of};
use lab::campaign::form::Form;
use lab::campaign::plan::{Lubrication, TrialPurpose};
use lab::trials::check;
use lab::trials::trial::{Action, RigSample};

/// Number of time intervals for which a run's figure shows the extremes.
const STRETCHES: usize = 250;

/// Mean with one standard deviation up and down, as segments: the bar, its two ends and its middle.
fn bar(x: f64, mean: f64, sd: f64, half_width: f64) -> [(f64, f64); 8] {
    let (low, high) = (mean - sd, mean + sd);
    [
        (x, low),
        (x, high),
        (x - half_width, low),
        (x + half_width, low),
        (x - half_width, high),
        (x + half_width, high),
        (x - 2.0 * half_width, mean),
        (x + 2.0 * half_width, mean),
    ]
}

/// A figure, 85 mm and 170 mm wide, with a caption that describes what was drawn.
pub struct Captioned {
    pub narrow: String,
    pub wide: String,
    pub caption: String,
}

impl Captioned {
    fn of(
        title: &str,
        evaluation: &Evaluation,
        charts: &[Chart],
        caption: String,
    ) -> Result<Self, FigureError> {
        let heading = Heading::new(title, Source::Records(evaluation.origin));
        Ok(Self {
            narrow: figure_in(1, &heading, charts)?,
            wide: figure_in(2, &heading, charts)?,
            caption,
        })
    }
}

/// Displacement against indentation; none without a trial that counts.
pub fn figure7(evaluation: &Evaluation) -> Result<Option<Captioned>, FigureError> {
    let looks = [
        (Lubrication::Lubricated, WET, Mark::Rings(13), 0.01),
        (Lubrication::Dry, DRY, Mark::Dots(7), 0.006),
    ];
    let of = |wall| evaluation.points(TrialPurpose::Series, wall);
    let all = || looks.iter().flat_map(|look| of(look.0));
    let ends = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        points.fold((f64::MAX, f64::MIN), |(a, b), (x, _)| (a.min(x), b.max(x)))
    };
    let (least, most) = ends(&mut all());
    let mut curves = vec![];
    let mut caption = "Each mark is a trial, dry filled and lubricated open, each bar the mean of a condition with one \
                       standard deviation up and down."
        .to_owned();
    for (wall, colour, mark, width) in looks {
        let points = of(wall);
        if points.is_empty() {
            continue;
        }
        if let Some((_, line)) = (evaluation.lines.iter()).find(|(row, _)| row.lubrication == wall)
        {
            let (from, to) = ends(&mut points.iter().copied());
            let through = vec![(from, line.at(from)), (to, line.at(to))];
            curves.push(curve("", colour, Mark::Line(3), through));
        }
        let rows = evaluation.conditions.iter().filter(|row| {
            row.purpose == TrialPurpose::Series && row.lubrication == wall && row.n > 0
        });
        let bars = rows.filter_map(|row| {
            let (a_mm, mean, sd) = (row.indentation_mm?.0, row.mean_mm?.0, row.sd_mm?.0);
            Some(bar(a_mm, mean, sd, width * (most - least).max(1.0)))
        });
        let bars = bars.flatten().collect();
        let label = format!("{}, n = {}", wall.name(), points.len());
        curves.push(curve(label, colour, mark, points));
        curves.push(curve("", colour, Mark::Segments(3), bars));
    }
    if curves.is_empty() {
        return Ok(None);
    }
    if curves
        .iter()
        .any(|curve| matches!(curve.mark, Mark::Line(_)))
    {
        caption.push_str(&format!(" {LINE}."));
    }
    let chart = Chart {
        x_label: "indentation a / mm",
        y_label: "displacement / mm".to_owned(),
        y_from_zero: true,
        curves,
    };
    let title = "Fig. 7: displacement over indentation";
    Captioned::of(title, evaluation, &[chart], caption).map(Some)
}

/// Folded against unfolded over time; none without a trial that counts. The displacement is known at the start, where
/// it is zero, and at the end; in between, the figure shows the carriage.
pub fn figure8(evaluation: &Evaluation) -> Result<Option<Captioned>, FigureError> {
    let shapes = [
        (Form::Unfolded, WET, Mark::Rings(12)),
        (Form::Folded, DRY, Mark::Dots(8)),
        (Form::Folding, IN_RUN, Mark::Rings(8)),
    ];
    let (mut displacements, mut carriages) = (vec![], vec![]);
    for (shape, colour, mark) in shapes {
        let rows = evaluation.trials.iter().zip(&evaluation.parts);
        let rows: Vec<_> = rows
            .filter(|(row, _)| {
                row.counts && row.purpose == TrialPurpose::FoldTest && row.shape == shape
            })
            .collect();
        let ends: Vec<(f64, f64)> = rows
            .iter()
            .filter_map(|(row, parts)| {
                let run = run_of(parts)?;
                let Action::Run { executed, .. } = &run.trial.action else {
                    return None;
                };
                let time_s = executed.as_ref()?.ticks as f64 * 1e-8;
                Some((time_s, row.displacement_mm?.mm()))
            })
            .collect();
        if ends.is_empty() {
            continue;
        }
        let name = match (shape, evaluation.campaign.plan.fold_at) {
            (Form::Folding, Some(cue)) => format!("folding at cycle {}", cue.cycle),
            _ => shape.name().to_owned(),
        };
        let label = format!("{name}, n = {}", ends.len());
        let from_zero = ends.iter().flat_map(|end| [(0.0, 0.0), *end]).collect();
        displacements.push(curve("", colour, Mark::Segments(2), from_zero));
        displacements.push(curve(label, colour, mark, ends));
        if let Some((_, parts)) = rows.first()
            && let Some(run) = run_of(parts)
            && let Some(points) = positions(run)
        {
            match carriages
                .iter_mut()
                .find(|other: &&mut Curve| coincide(&other.points, &points))
            {
                Some(other) => other.label = format!("{}, {name}", other.label),
                None => {
                    let width = if carriages.is_empty() { 9 } else { 3 };
                    carriages.push(curve(name, colour, Mark::Line(width), points));
                }
            }
        }
    }
    if displacements.is_empty() {
        return Ok(None);
    }
    for carriage in &mut carriages {
        if carriage.label.contains(", ") {
            carriage.label.push_str(": the same");
        }
    }
    let chart = |y_label: &str, y_from_zero, curves| Chart {
        x_label: "time / s",
        y_label: y_label.to_owned(),
        y_from_zero,
        curves,
    };
    let mut caption = "The displacement is read at the beginning, where it is zero, and at the end: the straight lines \
                       join the two and say nothing of the way between."
        .to_owned();
    let mut charts = vec![chart("displacement / mm", true, displacements)];
    if !carriages.is_empty() {
        charts.push(chart("carriage / mm", false, carriages));
        caption.push_str(" The other chart has the carriage in the first trial of each shape.");
    }
    let title = "Fig. 8: folded against unfolded";
    Captioned::of(title, evaluation, &charts, caption).map(Some)
}

/// Largest difference of curves drawn as one line, relative to their height: less than the width of the line.
const SAME: f64 = 0.01;

/// Whether two curves coincide, to less than the width of a line. Both go from left to right.
fn coincide(one: &[(f64, f64)], other: &[(f64, f64)]) -> bool {
    let heights = || one.iter().chain(other).map(|point| point.1);
    let most = heights().fold(f64::MIN, f64::max);
    let least = heights().fold(f64::MAX, f64::min);
    let lies_on = |points: &[(f64, f64)], line: &[(f64, f64)]| {
        points.iter().all(|(x, y)| {
            let next = line.partition_point(|point| point.0 < *x);
            let between = &line[next.saturating_sub(1)..line.len().min(next + 1)];
            let at = match between {
                [(x0, y0), (x1, y1)] if x1 > x0 => y0 + (y1 - y0) * ((x - x0) / (x1 - x0)).min(1.0),
                [.., (_, y)] => *y,
                [] => return false,
            };
            (y - at).abs() <= SAME * (most - least)
        })
    };
    lies_on(one, other) && lies_on(other, one)
}

/// Position over time, mm and s.
fn positions(run: &Part) -> Option<Vec<(f64, f64)>> {
    let Action::Run { screw, .. } = &run.trial.action else {
        return None;
    };
    let start_us = check::start_us(&run.trial)?;
    over_time(run, |sample| {
        let mm = screw.mm(sample.position_steps.into());
        (since(start_us, sample.time_us), mm)
    })
}

/// A curve of the run's telemetry; none without telemetry.
fn over_time(run: &Part, point: impl Fn(&RigSample) -> (f64, f64)) -> Option<Vec<(f64, f64)>> {
    let mut thin = Thin::new(STRETCHES);
    check::read(&run.sidecar, &run.trial, |sample| thin.push(point(&sample)));
    Some(thin.points()).filter(|points| !points.is_empty())
}

/// A run over its plan, and the difference; none without telemetry or plan.
pub fn run_over_plan(name: &str, run: &Part) -> Result<Option<String>, FigureError> {
    let Action::Run {
        screw,
        requested,
        achieved: Some(achieved),
        ..
    } = &run.trial.action
    else {
        return Ok(None);
    };
    let Some(positions) = positions(run) else {
        return Ok(None);
    };
    let measured = sampled(run.trial.device.origin);
    let plan = planned(screw, requested, achieved).position;
    let mut charts = vec![Chart {
        x_label: "time / s",
        y_label: "position / mm".to_owned(),
        y_from_zero: false,
        curves: vec![
            curve("planned", PLANNED, Mark::Line(9), plan),
            curve(measured, MEASURED, Mark::Line(3), positions),
        ],
    }];
    let residuals = deviation(&run.trial).and_then(|deviation| {
        over_time(run, |sample| {
            let (time_s, mm) = deviation(sample);
            (time_s, mm * 1e3)
        })
    });
    if let Some(residuals) = residuals {
        charts.push(Chart {
            x_label: "time / s",
            y_label: "residual / µm".to_owned(),
            y_from_zero: true,
            curves: vec![curve(
                format!("{measured} less planned"),
                MEASURED,
                Mark::Line(3),
                residuals,
            )],
        });
    }
    let heading = Heading::new(name, Source::Records(run.trial.device.origin));
    figure(&heading, charts).map(Some)
}
