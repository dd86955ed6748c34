//! Figures as SVG and PDF: each has a title, and states the origin of its values in words and in its description.
//!
//! The size of a chart makes its letters 12 px high on a telephone 390 px wide, and lets two charts fit beside each
//! other on a desktop screen.

pub(crate) mod escaped;
pub(crate) mod palette;
mod pdf;

use client::identity::Origin;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use protocol::rig::{Run, Stroke};
use trials::trial::{Achieved, CapsuleSample, RigSample, Screw};

use crate::figures::escaped::escaped;
use crate::figures::palette::{INK, MEASURED, PLANNED, WARNING};
use crate::figures::pdf::{Drawn, Page};

/// Size of one chart in units of the drawing. The drawing library rounds to whole units, so charts are drawn large
/// and displayed small.
const SIZE: (u32, u32) = (1_200, 760);
/// Height of the title and of the line below it.
const HEAD: u32 = 116;
/// Font size for the drawing library, which writes 1 / 1.24 of it: a telephone shows the 1,200 units on 358 px.
const LETTERS: i32 = 50;
/// Mean width of a letter.
const LETTER_WIDTH: i32 = 22;

/// Opacity of an area.
const PALE: f64 = 0.16;

/// Points of the planned profile per ramp.
const RAMP_POINTS: u32 = 24;

/// Why a figure could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("a figure could not be drawn: {0}")]
pub struct FigureError(String);

/// Origin of a figure's values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// From records of this origin.
    Records(Origin),
    /// Calculated by a model.
    Model,
    /// Calculated from a plan for a rig.
    Plan,
}

impl Source {
    /// The origin in words, for the figure.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::Records(origin) => origin.meaning(),
            Self::Model => "model: calculated, not a measurement",
            Self::Plan => "plan: calculated, not a measurement",
        }
    }

    const fn colour(self) -> RGBColor {
        match self {
            Self::Records(Origin::Virtual | Origin::Unknown) => WARNING,
            Self::Records(Origin::Board) | Self::Model | Self::Plan => INK,
        }
    }
}

/// Title of a figure and origin of its values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Heading {
    /// Its title.
    pub title: String,
    /// Where its values come from.
    pub source: Source,
    /// For a model's figure: which model.
    pub model: Option<ModelName>,
}

/// Name of the model in a figure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelName {
    /// For the line below the title: at most about 55 letters.
    pub short: String,
    /// For the description of the file, at any length.
    pub full: String,
}

impl Heading {
    /// Heading for a figure of a model's values.
    pub fn of_model(title: impl Into<String>, model: ModelName) -> Self {
        Self {
            title: title.into(),
            source: Source::Model,
            model: Some(model),
        }
    }

    /// The origin of the values in words, for the figure.
    fn line(&self) -> &str {
        match &self.model {
            Some(model) => &model.short,
            None => self.source.text(),
        }
    }

    /// The origin of the values, in full.
    fn description(&self) -> &str {
        match &self.model {
            Some(model) => &model.full,
            None => self.source.text(),
        }
    }

    /// Heading with this title.
    pub fn new(title: impl Into<String>, source: Source) -> Self {
        Self {
            title: title.into(),
            source,
            model: None,
        }
    }
}

/// How a curve is drawn.
#[derive(Clone, Copy)]
pub(crate) enum Mark {
    /// A line of this width.
    Line(u32),
    /// Dots of this radius.
    Dots(i32),
    /// Each pair of points is a line of this width.
    Segments(u32),
    /// The points are the outline of a pale area.
    Area,
}

/// One curve. Without a label it has no entry in the legend.
pub(crate) struct Curve {
    pub(crate) label: String,
    pub(crate) colour: RGBColor,
    pub(crate) mark: Mark,
    pub(crate) points: Vec<(f64, f64)>,
}

/// One chart of a figure.
pub(crate) struct Chart {
    pub(crate) x_label: &'static str,
    pub(crate) y_label: String,
    /// The y axis includes 0, so that differences appear in proportion.
    pub(crate) y_from_zero: bool,
    pub(crate) curves: Vec<Curve>,
}

/// Position and velocity of a plan over time: (s, mm) and (s, mm/s).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planned {
    /// (s, mm).
    pub position: Vec<(f64, f64)>,
    /// (s, mm/s).
    pub velocity: Vec<(f64, f64)>,
}

/// The exact continuous profile of a run, sampled finely enough to draw. Time 0 is the run's start.
#[must_use]
pub fn planned(screw: &Screw, run: &Run, achieved: &Achieved) -> Planned {
    let seconds = |ticks: u64| ticks as f64 * 1e-8;
    let (far, home) = (
        f64::from(run.far_dwell_us) * 1e-6,
        f64::from(run.home_dwell_us) * 1e-6,
    );
    let mut planned = Planned::default();
    let mut start = f64::from(run.start_delay_us) * 1e-6;
    for cycle in 0..run.cycles {
        stroke(&mut planned, screw, &achieved.forward, start, false);
        start += seconds(achieved.forward.duration_ticks) + far;
        if cycle + 1 == run.cycles {
            // The last dwell absorbs the remainder from the division of the total.
            start = seconds(achieved.total_ticks) - seconds(achieved.back.duration_ticks);
        }
        stroke(&mut planned, screw, &achieved.back, start, true);
        start += seconds(achieved.back.duration_ticks) + home;
    }
    planned
}

/// The exact position of a plan at `time_s` after the run's start, mm.
#[must_use]
pub fn position_at(screw: &Screw, run: &Run, achieved: &Achieved, time_s: f64) -> f64 {
    let seconds = |ticks: u64| ticks as f64 * 1e-8;
    let (far, home) = (
        f64::from(run.far_dwell_us) * 1e-6,
        f64::from(run.home_dwell_us) * 1e-6,
    );
    let mut start = f64::from(run.start_delay_us) * 1e-6;
    for cycle in 0..run.cycles {
        if time_s < start + seconds(achieved.forward.duration_ticks) + far {
            return way(screw, &achieved.forward, time_s - start);
        }
        start += seconds(achieved.forward.duration_ticks) + far;
        if cycle + 1 == run.cycles {
            start = seconds(achieved.total_ticks) - seconds(achieved.back.duration_ticks);
        }
        if time_s < start + seconds(achieved.back.duration_ticks) + home {
            let length = screw.mm(f64::from(achieved.back.steps));
            return length - way(screw, &achieved.back, time_s - start);
        }
        start += seconds(achieved.back.duration_ticks) + home;
    }
    0.0
}

/// Distance since the beginning of a stroke, mm; constant before and after it.
fn way(screw: &Screw, stroke: &Stroke, time_s: f64) -> f64 {
    let (t, r) = (
        stroke.duration_ticks as f64 * 1e-8,
        stroke.ramp_ticks as f64 * 1e-8,
    );
    let length = screw.mm(f64::from(stroke.steps));
    let speed = length / (t - r);
    match time_s {
        time if time <= 0.0 => 0.0,
        time if time >= t => length,
        time if time < r => speed / r * time * time / 2.0,
        time if time <= t - r => speed * (time - r / 2.0),
        time => length - speed / r * (t - time) * (t - time) / 2.0,
    }
}

/// Keeps, for each of `stretches` equal stretches, the points with the least and the greatest value: the curve looks
/// the same.
pub(crate) fn thinned(points: &[(f64, f64)], stretches: usize) -> Vec<(f64, f64)> {
    if points.len() <= stretches * 2 {
        return points.to_vec();
    }
    let mut thin = vec![];
    for part in points.chunks(points.len().div_ceil(stretches)) {
        let of = |worse: fn(&f64, &f64) -> bool| {
            let better = |a: usize, b: usize| if worse(&part[a].1, &part[b].1) { b } else { a };
            (0..part.len()).reduce(better)
        };
        let (Some(least), Some(most)) = (of(|a, b| b < a), of(|a, b| b > a)) else {
            continue;
        };
        thin.push(part[least.min(most)]);
        if least != most {
            thin.push(part[least.max(most)]);
        }
    }
    thin
}

fn stroke(planned: &mut Planned, screw: &Screw, stroke: &Stroke, start: f64, back: bool) {
    let steps = f64::from(stroke.steps);
    let (t, r) = (
        stroke.duration_ticks as f64 * 1e-8,
        stroke.ramp_ticks as f64 * 1e-8,
    );
    let length = screw.mm(steps);
    let (speed, acceleration) = (length / (t - r), length / (t - r) / r);
    let mut point = |time: f64, way: f64, speed: f64| {
        let (position, velocity) = if back {
            (length - way, -speed)
        } else {
            (way, speed)
        };
        planned.position.push((start + time, position));
        planned.velocity.push((start + time, velocity));
    };
    for index in 0..=RAMP_POINTS {
        let time = r * f64::from(index) / f64::from(RAMP_POINTS);
        point(time, acceleration * time * time / 2.0, acceleration * time);
    }
    point(t - r, length - speed * r / 2.0, speed);
    for index in (0..RAMP_POINTS).rev() {
        let left = r * f64::from(index) / f64::from(RAMP_POINTS);
        point(
            t - left,
            length - acceleration * left * left / 2.0,
            acceleration * left,
        );
    }
}

/// Position and velocity against time, measured over planned.
///
/// # Errors
/// If the drawing library fails.
pub fn run_figures(
    name: &str,
    origin: Origin,
    planned: Planned,
    samples: &[RigSample],
    start_us: u64,
) -> Result<[String; 2], FigureError> {
    let heading = |what| Heading::new(format!("{name}: {what}"), Source::Records(origin));
    let number = |text: &str| text.parse::<f64>().unwrap_or(f64::NAN);
    let measured = |value: &dyn Fn(&RigSample) -> f64| {
        samples
            .iter()
            .map(|sample| (since(start_us, sample.time_us), value(sample)))
            .collect::<Vec<_>>()
    };
    Ok([
        over_time(
            &heading("position"),
            "position / mm",
            vec![
                plan_curve(planned.position),
                measured_curve(origin, measured(&|sample| number(&sample.position_mm))),
            ],
        )?,
        over_time(
            &heading("velocity"),
            "velocity / (mm/s)",
            vec![
                plan_curve(planned.velocity),
                measured_curve(origin, measured(&|sample| number(&sample.speed_mm_s))),
            ],
        )?,
    ])
}

/// Thread and motor current against time.
///
/// # Errors
/// If the drawing library fails.
pub fn actuation_figures(
    name: &str,
    origin: Origin,
    samples: &[CapsuleSample],
    start_us: u64,
) -> Result<[String; 2], FigureError> {
    let heading = |what| Heading::new(format!("{name}: {what}"), Source::Records(origin));
    let curve = |value: &dyn Fn(&CapsuleSample) -> f64| {
        measured_curve(
            origin,
            samples
                .iter()
                .map(|sample| (since(start_us, sample.time_us), value(sample)))
                .collect(),
        )
    };
    Ok([
        over_time(
            &heading("thread"),
            "thread wound / mm",
            vec![curve(&|sample| f64::from(sample.thread_um) / 1e3)],
        )?,
        over_time(
            &heading("motor current"),
            "motor current / mA",
            vec![curve(&|sample| f64::from(sample.current_ma))],
        )?,
    ])
}

/// Position of a plan alone.
///
/// # Errors
/// If the drawing library fails.
pub fn plan_figure(planned: Planned) -> Result<String, FigureError> {
    over_time(
        &Heading::new("Planned position", Source::Plan),
        "position / mm",
        vec![plan_curve(planned.position)],
    )
}

fn plan_curve(points: Vec<(f64, f64)>) -> Curve {
    Curve {
        label: "planned".to_owned(),
        colour: PLANNED,
        mark: Mark::Line(8),
        points,
    }
}

/// Label of a machine's samples: those of a simulated one are not measured.
pub(crate) const fn sampled(origin: Origin) -> &'static str {
    match origin {
        Origin::Board => "measured",
        Origin::Unknown => "recorded",
        Origin::Virtual => "simulated",
    }
}

fn measured_curve(origin: Origin, points: Vec<(f64, f64)>) -> Curve {
    Curve {
        label: sampled(origin).to_owned(),
        colour: MEASURED,
        mark: Mark::Line(3),
        points,
    }
}

/// Seconds from `start_us`, negative before it.
fn since(start_us: u64, time_us: u64) -> f64 {
    let us = i128::from(time_us) - i128::from(start_us);
    us as f64 * 1e-6
}

fn over_time(heading: &Heading, y_label: &str, curves: Vec<Curve>) -> Result<String, FigureError> {
    let chart = Chart {
        x_label: "time / s",
        y_label: y_label.to_owned(),
        y_from_zero: false,
        curves,
    };
    figure(heading, vec![chart])
}

/// Draws charts one below the other, as one SVG.
///
/// # Errors
/// If the drawing library fails.
pub(crate) fn figure(heading: &Heading, charts: Vec<Chart>) -> Result<String, FigureError> {
    Figure::new(heading.clone(), charts).svg()
}

/// A figure in a file of its own: charts one below the other.
pub struct Figure {
    heading: Heading,
    charts: Vec<Chart>,
}

impl Figure {
    pub(crate) fn new(heading: Heading, charts: Vec<Chart>) -> Self {
        Self { heading, charts }
    }

    fn size(&self) -> (u32, u32) {
        let (width, height) = SIZE;
        (width, HEAD + height * self.charts.len() as u32)
    }

    /// Draws it as SVG, for a page and for drawing programs.
    ///
    /// # Errors
    /// If the drawing library fails.
    pub fn svg(&self) -> Result<String, FigureError> {
        let mut svg = String::new();
        draw(SVGBackend::with_string(&mut svg, self.size()), self)
            .map_err(|error| FigureError(error.to_string()))?;
        described(&svg, &self.heading)
            .ok_or_else(|| FigureError("the drawing is no SVG".to_owned()))
    }

    /// Draws it as PDF, for a manuscript.
    ///
    /// # Errors
    /// If the drawing library fails.
    pub fn pdf(&self) -> Result<Vec<u8>, FigureError> {
        let (mut drawn, size) = (Drawn::new(), self.size());
        let page = Page {
            drawn: &mut drawn,
            size,
        };
        draw(page, self).map_err(|error| FigureError(error.to_string()))?;
        let source = format!("Origin: {}", self.heading.description());
        Ok(drawn.into_pdf(size, &self.heading.title, &source))
    }
}

/// Adds title and description, for screen readers and for a file that is passed on alone.
fn described(svg: &str, heading: &Heading) -> Option<String> {
    let body = svg.find("<svg")?;
    let (opening, rest) = svg[body..].split_once('>')?;
    let title = escaped(&heading.title);
    let source = escaped(heading.description());
    // A model's figure is a file of its own. On a dark page its dark letters need a white background; a report's page
    // has its own.
    let paper = match heading.model {
        Some(_) => "\n<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>",
        None => "",
    };
    Some(format!(
        "{opening} role=\"img\">\n<title>{title}</title>\n<desc>Origin: {source}</desc>{paper}{rest}"
    ))
}

fn draw<B: DrawingBackend>(backend: B, figure: &Figure) -> Result<(), Box<dyn std::error::Error>>
where
    B::ErrorType: 'static,
{
    let Figure { heading, charts } = figure;
    let root = backend.into_drawing_area();
    let (head, body) = root.split_vertically(HEAD);
    let line = |size: i32, colour: &RGBColor| {
        let style = ("sans-serif", size).into_font().color(colour);
        style.pos(Pos::new(HPos::Left, VPos::Center))
    };
    head.draw(&Text::new(
        heading.title.clone(),
        (24, 34),
        line(LETTERS + 4, &INK),
    ))?;
    let source = heading.line().to_owned();
    let colour = heading.source.colour();
    head.draw(&Text::new(source, (24, 88), line(LETTERS - 4, &colour)))?;
    let areas = body.split_evenly((charts.len(), 1));
    for (chart, area) in charts.iter().zip(&areas) {
        draw_chart(area, chart)?;
    }
    root.present()?;
    Ok(())
}

fn draw_chart<B: DrawingBackend>(
    root: &DrawingArea<B, plotters::coord::Shift>,
    chart: &Chart,
) -> Result<(), Box<dyn std::error::Error>>
where
    B::ErrorType: 'static,
{
    let Chart {
        x_label,
        y_label,
        y_from_zero,
        curves,
    } = chart;
    let all = || curves.iter().flat_map(|curve| &curve.points);
    // Leave room for dots and bars at the ends.
    let wide = |curve: &Curve| matches!(curve.mark, Mark::Dots(_) | Mark::Segments(_));
    let x_margin = if curves.iter().any(wide) { 0.03 } else { 0.0 };
    let (x_low, x_high) = span(all().map(|point| point.0), x_margin);
    let zero = (*y_from_zero).then_some(0.0);
    let (y_low, y_high) = span(all().map(|point| point.1).chain(zero), 0.06);
    let legend = Legend::of(curves);
    let text = |size: i32| ("sans-serif", size).into_font().color(&INK);
    let mut chart = ChartBuilder::on(root)
        .margin(16)
        .margin_top(legend.height())
        .margin_right(44)
        .x_label_area_size(124)
        .y_label_area_size(176)
        .build_cartesian_2d(x_low..x_high, y_low..y_high)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(INK.mix(0.12).stroke_width(2))
        .axis_style(INK.stroke_width(2))
        .x_labels(8)
        .y_labels(7)
        .label_style(text(LETTERS - 2))
        .axis_desc_style(text(LETTERS))
        .x_label_formatter(&|value| tick_label(*value))
        .y_label_formatter(&|value| tick_label(*value))
        .x_desc(*x_label)
        .y_desc(y_label)
        .draw()?;
    // Put the legend above the plot, where no curve runs.
    let mut entry = 0;
    for Curve {
        label,
        colour,
        mark,
        points,
    } in curves
    {
        if !label.is_empty() {
            let (x, y) = legend.place(entry);
            entry += 1;
            match mark {
                &(Mark::Line(width) | Mark::Segments(width)) => root.draw(&PathElement::new(
                    [(x, y), (x + 60, y)],
                    colour.stroke_width(width),
                ))?,
                Mark::Area => root.draw(&Rectangle::new(
                    [(x, y - 14), (x + 60, y + 14)],
                    colour.mix(PALE).filled(),
                ))?,
                &Mark::Dots(radius) => {
                    root.draw(&Circle::new((x + 30, y), radius, colour.filled()))?;
                }
            }
            let anchored = text(LETTERS - 2).pos(Pos::new(HPos::Left, VPos::Center));
            root.draw(&Text::new(label.clone(), (x + 76, y), anchored))?;
        }
        let finite = points
            .iter()
            .copied()
            .filter(|point| point.0.is_finite() && point.1.is_finite());
        match *mark {
            Mark::Line(width) => {
                chart.draw_series(LineSeries::new(finite, colour.stroke_width(width)))?;
            }
            Mark::Dots(radius) => {
                chart.draw_series(finite.map(|at| Circle::new(at, radius, colour.filled())))?;
            }
            Mark::Segments(width) => {
                let points: Vec<_> = finite.collect();
                let segments = points.chunks_exact(2);
                let style = colour.stroke_width(width);
                chart.draw_series(segments.map(|ends| PathElement::new(ends.to_vec(), style)))?;
            }
            Mark::Area => {
                let points: Vec<_> = finite.collect();
                chart.draw_series([Polygon::new(points, colour.mix(PALE).filled())])?;
            }
        }
    }
    Ok(())
}

/// Left edge of the legend, units of the drawing.
const LEFT: i32 = 60;

/// Layout of a legend: rows of entries above the plot.
struct Legend {
    entries: usize,
    column: i32,
    columns: usize,
}

impl Legend {
    const ROW: i32 = 56;

    fn of(curves: &[Curve]) -> Self {
        let labels = || curves.iter().filter(|curve| !curve.label.is_empty());
        let longest = labels().map(|curve| curve.label.chars().count()).max();
        let column = (110 + LETTER_WIDTH * longest.unwrap_or(0) as i32).max(300);
        Self {
            entries: labels().count(),
            column,
            columns: usize::max(1, ((SIZE.0 as i32 - LEFT) / column) as usize),
        }
    }

    fn height(&self) -> i32 {
        16 + Self::ROW * self.entries.div_ceil(self.columns).max(1) as i32
    }

    fn place(&self, entry: usize) -> (i32, i32) {
        let (row, column) = (entry / self.columns, entry % self.columns);
        (
            LEFT + self.column * column as i32,
            30 + Self::ROW * row as i32,
        )
    }
}

/// A number without trailing zeros.
fn tick_label(value: f64) -> String {
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0" } else { text }.to_owned()
}

/// Range of finite values with a margin; never empty.
fn span(values: impl Iterator<Item = f64>, margin: f64) -> (f64, f64) {
    let (low, high) = values
        .filter(|value| value.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
    if low >= high {
        let middle = if low.is_finite() { low } else { 0.0 };
        return (middle - 1.0, middle + 1.0);
    }
    let margin = (high - low) * margin;
    (low - margin, high + margin)
}

#[cfg(test)]
mod tests {
    use trials::experiment::PAPER_RUN;
    use trials::plan::{REFERENCE_LIMITS, summary};

    use super::*;
    use motion::axis::Axis;
    use planning::solve;

    #[test]
    fn the_planned_curve_goes_out_and_home_and_ends_with_the_run() {
        let plan = solve(&PAPER_RUN, &Axis::REFERENCE, &REFERENCE_LIMITS).expect("feasible");
        let summary = summary(&PAPER_RUN, &Axis::REFERENCE, &plan);
        let planned = planned(&summary.screw, &PAPER_RUN, &summary.achieved);
        let highest = planned
            .position
            .iter()
            .map(|point| point.1)
            .fold(0.0, f64::max);
        assert!((highest - 130.0).abs() < 1e-9, "{highest}");
        let (time, position) = planned.position.last().copied().expect("points");
        assert!(
            (time - 40.0).abs() < 1e-9 && position.abs() < 1e-9,
            "{time} {position}"
        );
        assert!(
            planned.position.is_sorted_by(|a, b| a.0 <= b.0),
            "time never steps back"
        );
        let fastest = planned
            .velocity
            .iter()
            .map(|point| point.1)
            .fold(0.0, f64::max);
        let peak = f64::from(summary.achieved.forward.peak_um_s) / 1e3;
        assert!((fastest - peak).abs() < 1e-3, "{fastest} {peak}");
    }

    #[test]
    fn the_position_of_a_plan_is_on_its_curve() {
        let run = Run {
            far_dwell_us: 300_000,
            home_dwell_us: 200_000,
            start_delay_us: 500_000,
            ..PAPER_RUN
        };
        let plan = solve(&run, &Axis::REFERENCE, &REFERENCE_LIMITS).expect("feasible");
        let summary = summary(&run, &Axis::REFERENCE, &plan);
        let curve = planned(&summary.screw, &run, &summary.achieved).position;
        for (time, position) in &curve {
            let at = position_at(&summary.screw, &run, &summary.achieved, *time);
            assert!((at - position).abs() < 1e-6, "{time}: {at} {position}");
        }
        for (pair, at) in curve
            .windows(2)
            .filter(|pair| pair[1].0 - pair[0].0 > 0.1)
            .map(|pair| {
                let middle = (pair[0].0 + pair[1].0) / 2.0;
                (
                    pair,
                    position_at(&summary.screw, &run, &summary.achieved, middle),
                )
            })
        {
            let straight = (pair[0].1 + pair[1].1) / 2.0;
            assert!((at - straight).abs() < 1e-6, "{pair:?}: {at}");
        }
        for time in [-1.0, 0.2, 41.0] {
            let at = position_at(&summary.screw, &run, &summary.achieved, time);
            assert_eq!(at, 0.0, "{time}");
        }
    }

    #[test]
    fn a_thinned_curve_keeps_its_extremes_and_its_order() {
        let points: Vec<_> = (0..10_000)
            .map(|index| (f64::from(index), (f64::from(index) / 37.0).sin()))
            .chain([(10_000.0, 5.0), (10_001.0, -7.0)])
            .collect();
        let thin = thinned(&points, 200);
        assert!(thin.len() <= 400 && thin.is_sorted_by(|a, b| a.0 < b.0));
        for wanted in [5.0, -7.0] {
            assert!(thin.iter().any(|point| point.1 == wanted), "{wanted}");
        }
        assert_eq!(thinned(&points[..300], 200), points[..300]);
    }

    #[test]
    fn a_figure_without_data_is_still_a_figure() {
        let heading = Heading::new("a < b", Source::Records(Origin::Virtual));
        let curve = measured_curve(Origin::Virtual, vec![(f64::NAN, 1.0)]);
        let svg = over_time(&heading, "y", vec![curve]).expect("drawn");
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
        assert!(svg.contains("<title>a &lt; b</title>"), "{svg}");
        let said = svg.matches("virtual: simulated, not a measurement").count();
        assert_eq!(said, 2, "in the description and in the picture: {svg}");
    }

    #[test]
    fn a_pdf_says_all_that_the_svg_says() {
        let heading = Heading::new("Fig. 9: a test", Source::Records(Origin::Board));
        let curves =
            [Mark::Line(3), Mark::Dots(7), Mark::Segments(2), Mark::Area].map(|mark| Curve {
                label: "a label".to_owned(),
                colour: MEASURED,
                mark,
                points: vec![(0.0, 1.0), (1.0, -2.5), (2.0, 3.0)],
            });
        let chart = Chart {
            x_label: "time / s",
            y_label: "way / mm".to_owned(),
            y_from_zero: true,
            curves: curves.into(),
        };
        let figure = Figure::new(heading, vec![chart]);
        let (svg, pdf) = (figure.svg().expect("drawn"), figure.pdf().expect("drawn"));
        assert_eq!(pdf, figure.pdf().expect("drawn"), "the same each time");
        let pdf = String::from_utf8_lossy(&pdf).into_owned();
        assert!(pdf.starts_with("%PDF-1.") && pdf.trim_end().ends_with("%%EOF"));
        let texts: Vec<_> = svg
            .split("<text")
            .skip(1)
            .filter_map(|text| Some(text.split_once('>')?.1.split_once('<')?.0.trim()))
            .collect();
        assert!(texts.len() > 15, "{svg}");
        for text in texts {
            assert!(pdf.contains(&format!("({text}) Tj")), "{text}");
        }
        assert!(pdf.contains("/Title (Fig. 9: a test)"), "{pdf}");
    }
}
