//! The figures of a campaign: displacement against indentation (the paper's Fig. 7), folded against unfolded (its
//! Fig. 8), and each run against its plan.

use lab::campaign::form::Form;
use lab::campaign::plan::{Lubrication, Purpose};
use lab::trials::check;
use lab::trials::trial::{Action, RigSample};
use plotters::style::RGBColor;

use crate::figures::palette::{DRY, IN_RUN, MEASURED, MEASURED as WET, PLANNED};
use crate::figures::{
    Chart, Curve, FigureError, Heading, Mark, Source, Thin, curve, figure, planned, sampled, since,
};
use crate::html::evaluation::{Evaluation, LINE, Part, deviation, run_of};

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

/// A figure with the caption that says what was drawn in it.
pub struct Captioned {
    pub svg: String,
    pub caption: String,
}

/// Explains the dots and bars of a condition.
const BARS: &str = "each bar the mean of a condition with one standard deviation up and down.";

/// Walls and purpose: what stands at an indentation in a colour of its own.
type Kind = (Purpose, Lubrication);

/// Places of dots over indentation. Those of two kinds that would lie on each other stand beside their indentation,
/// all others at theirs.
struct Places {
    dots: Vec<(Kind, f64)>,
    /// Distance between neighbours that stand beside their indentation, mm.
    room_mm: f64,
    /// Whether any dot stands beside its indentation.
    any_beside: bool,
}

impl Places {
    /// Share of the room within which dots of two kinds touch.
    const TOUCHING: f64 = 0.4;

    fn of(evaluation: &Evaluation, purposes: &[Purpose]) -> Self {
        let walls = [Lubrication::Dry, Lubrication::Lubricated];
        let kinds = purposes
            .iter()
            .flat_map(|purpose| walls.map(|wall| (*purpose, wall)));
        let of = |kind: Kind| {
            let points = evaluation.points(kind.0, kind.1).into_iter();
            points.map(move |(a_mm, _)| (kind, a_mm))
        };
        let dots: Vec<_> = kinds.flat_map(of).collect();
        let depths = dots.iter().map(|dot| dot.1);
        let (least, most) = depths.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
        let room_mm = if least < most {
            0.04 * (most - least)
        } else {
            0.08
        };
        let mut places = Self {
            dots,
            room_mm,
            any_beside: false,
        };
        places.any_beside = (places.dots.iter()).any(|(kind, a_mm)| places.is_shared(*kind, *a_mm));
        places
    }

    /// Whether a dot of another kind touches one of this kind at an indentation.
    fn is_shared(&self, kind: Kind, a_mm: f64) -> bool {
        let near = Self::TOUCHING * self.room_mm;
        let mut others = self.dots.iter().filter(|(other, _)| *other != kind);
        others.any(|(_, other_mm)| (other_mm - a_mm).abs() <= near)
    }

    /// Where a dot of a kind stands, if its kind steps aside by a number of rooms.
    fn x(&self, kind: Kind, a_mm: f64, aside: f64) -> f64 {
        match self.is_shared(kind, a_mm) {
            true => a_mm + aside * self.room_mm,
            false => a_mm,
        }
    }

    /// The sentence about them in a caption; none where each stands at its indentation.
    fn caption(&self) -> &'static str {
        match self.any_beside {
            true => {
                " Dots that would lie on each other stand beside their indentation, dry on the left."
            }
            false => "",
        }
    }
}

/// Dots and bars of a kind's trials, which steps aside by a number of rooms where it is not alone.
fn dots_and_bars(
    evaluation: &Evaluation,
    kind: Kind,
    (label, colour, size): (&str, RGBColor, i32),
    (places, aside): (&Places, f64),
) -> Option<[Curve; 2]> {
    let (purpose, lubrication) = kind;
    let points: Vec<_> = (evaluation.points(purpose, lubrication).into_iter())
        .map(|(a_mm, y)| (places.x(kind, a_mm, aside), y))
        .collect();
    if points.is_empty() {
        return None;
    }
    let rows = evaluation
        .conditions
        .iter()
        .filter(|row| row.purpose == purpose && row.lubrication == lubrication && row.n > 0);
    let label = format!("{label}, n = {}", points.len());
    let bars = rows.filter_map(|row| {
        let (a_mm, mean, sd) = (row.indentation_mm?.0, row.mean_mm?.0, row.sd_mm?.0);
        let x = places.x(kind, a_mm, aside);
        Some(bar(x, mean, sd, 0.2 * places.room_mm))
    });
    Some([
        curve(label, colour, Mark::Dots(size), points),
        curve("", colour, Mark::Segments(4), bars.flatten().collect()),
    ])
}

/// Displacement against indentation; none without a trial that counts.
pub fn figure7(evaluation: &Evaluation) -> Result<Option<Captioned>, FigureError> {
    let mut curves = vec![];
    let mut has_line = false;
    let places = Places::of(evaluation, &[Purpose::Series]);
    for (lubrication, colour) in [(Lubrication::Dry, DRY), (Lubrication::Lubricated, WET)] {
        let points = evaluation.points(Purpose::Series, lubrication);
        if points.is_empty() {
            continue;
        }
        let ends = points.iter().fold((f64::MAX, f64::MIN), |(a, b), (x, _)| {
            (a.min(*x), b.max(*x))
        });
        let line = evaluation
            .lines
            .iter()
            .find(|(row, _)| row.lubrication == lubrication)
            .map(|(_, line)| line);
        if let Some(line) = line {
            let through = vec![(ends.0, line.at(ends.0)), (ends.1, line.at(ends.1))];
            curves.push(curve("", colour, Mark::Line(3), through));
            has_line = true;
        }
        let aside = if lubrication == Lubrication::Dry {
            -0.5
        } else {
            0.5
        };
        let condition = (Purpose::Series, lubrication);
        let look = (lubrication.name(), colour, 7);
        curves.extend(
            dots_and_bars(evaluation, condition, look, (&places, aside))
                .into_iter()
                .flatten(),
        );
    }
    if curves.is_empty() {
        return Ok(None);
    }
    let mut caption = format!("Each dot is a trial, {BARS}");
    if has_line {
        caption.push_str(&format!(" {LINE}."));
    }
    caption.push_str(places.caption());
    let chart = Chart {
        x_label: "indentation a / mm",
        y_label: "displacement / mm".to_owned(),
        y_from_zero: true,
        curves,
    };
    let title = "Fig. 7: displacement over indentation";
    let heading = Heading::new(title, Source::Records(evaluation.origin));
    let svg = figure(&heading, vec![chart])?;
    Ok(Some(Captioned { svg, caption }))
}

/// Folded against unfolded over time; none without a trial that counts. The displacement is known at the beginning,
/// where it is zero, and at the end; between them the figure shows the carriage.
pub fn figure8(evaluation: &Evaluation) -> Result<Option<Captioned>, FigureError> {
    let shapes = [
        (Form::Unfolded, WET),
        (Form::Folded, DRY),
        (Form::Folding, IN_RUN),
    ];
    let (mut displacements, mut carriages) = (vec![], vec![]);
    for (shape, colour) in shapes {
        let rows = evaluation.trials.iter().zip(&evaluation.parts);
        let rows: Vec<_> = rows
            .filter(|(row, _)| row.counts && row.purpose == Purpose::FoldTest && row.shape == shape)
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
        displacements.push(curve(label, colour, Mark::Dots(9), ends));
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
    let heading = Heading::new(
        "Fig. 8: folded against unfolded",
        Source::Records(evaluation.origin),
    );
    let mut caption = "The displacement is read at the beginning, where it is zero, and at the end: the straight lines \
                       join the two and say nothing of the way between."
        .to_owned();
    let mut charts = vec![chart("displacement / mm", true, displacements)];
    if !carriages.is_empty() {
        charts.push(chart("carriage / mm", false, carriages));
        caption.push_str(" Below, the carriage in the first trial of each shape.");
    }
    let svg = figure(&heading, charts)?;
    Ok(Some(Captioned { svg, caption }))
}

/// Largest difference of curves that one line can stand for, relative to their height: less than the line is wide.
const SAME: f64 = 0.01;

/// Whether one curve lies on another, to less than the width of a line. Both go from left to right.
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

/// A curve of the run's telemetry; none without any.
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
