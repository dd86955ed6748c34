//! Figures of a trial as SVG: measured values over planned ones.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use protocol::rig::{Run, Stroke};

use crate::trial::{Achieved, CapsuleSample, RigSample, Screw};

/// Size of one chart in units of the drawing. The drawing library rounds to whole units, so charts are drawn large and
/// displayed small.
const SIZE: (u32, u32) = (1_760, 640);
const MEASURED: RGBColor = RGBColor(0x1f, 0x5a, 0xa8);
const PLANNED: RGBColor = RGBColor(0xf0, 0xa0, 0x30);
const INK: RGBColor = RGBColor(0x33, 0x33, 0x33);

/// Points of the planned profile per ramp.
const RAMP_POINTS: u32 = 24;

/// Why a figure could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("a figure could not be drawn: {0}")]
pub struct FigureError(String);

/// How a curve is drawn.
#[derive(Clone, Copy)]
pub(crate) enum Mark {
    /// A line of this width.
    Line(u32),
    /// Dots of this radius.
    Dots(i32),
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
            // The last dwell takes up what the division of the total left over.
            start = seconds(achieved.total_ticks) - seconds(achieved.back.duration_ticks);
        }
        stroke(&mut planned, screw, &achieved.back, start, true);
        start += seconds(achieved.back.duration_ticks) + home;
    }
    planned
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
    planned: Planned,
    samples: &[RigSample],
    start_us: u64,
) -> Result<[String; 2], FigureError> {
    let number = |text: &str| text.parse::<f64>().unwrap_or(f64::NAN);
    let measured = |value: &dyn Fn(&RigSample) -> f64| {
        samples
            .iter()
            .map(|sample| (since(start_us, sample.time_us), value(sample)))
            .collect::<Vec<_>>()
    };
    Ok([
        over_time(
            "position / mm",
            vec![
                plan_curve(planned.position),
                measured_curve(measured(&|sample| number(&sample.position_mm))),
            ],
        )?,
        over_time(
            "velocity / (mm/s)",
            vec![
                plan_curve(planned.velocity),
                measured_curve(measured(&|sample| number(&sample.speed_mm_s))),
            ],
        )?,
    ])
}

/// Thread and motor current against time.
///
/// # Errors
/// If the drawing library fails.
pub fn actuation_figures(
    samples: &[CapsuleSample],
    start_us: u64,
) -> Result<[String; 2], FigureError> {
    let curve = |value: &dyn Fn(&CapsuleSample) -> f64| {
        measured_curve(
            samples
                .iter()
                .map(|sample| (since(start_us, sample.time_us), value(sample)))
                .collect(),
        )
    };
    Ok([
        over_time(
            "thread wound / mm",
            vec![curve(&|sample| f64::from(sample.thread_um) / 1e3)],
        )?,
        over_time(
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
    over_time("position / mm", vec![plan_curve(planned.position)])
}

fn plan_curve(points: Vec<(f64, f64)>) -> Curve {
    Curve {
        label: "planned".to_owned(),
        colour: PLANNED,
        mark: Mark::Line(8),
        points,
    }
}

fn measured_curve(points: Vec<(f64, f64)>) -> Curve {
    Curve {
        label: "measured".to_owned(),
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

fn over_time(y_label: &str, curves: Vec<Curve>) -> Result<String, FigureError> {
    figure(vec![Chart {
        x_label: "time / s",
        y_label: y_label.to_owned(),
        y_from_zero: false,
        curves,
    }])
}

/// Charts one below the other, as one SVG.
///
/// # Errors
/// If the drawing library fails.
pub(crate) fn figure(charts: Vec<Chart>) -> Result<String, FigureError> {
    let mut svg = String::new();
    draw(&mut svg, charts).map_err(|error| FigureError(error.to_string()))?;
    Ok(svg)
}

fn draw(svg: &mut String, charts: Vec<Chart>) -> Result<(), Box<dyn std::error::Error>> {
    let (width, height) = SIZE;
    let size = (width, height * charts.len() as u32);
    let root = SVGBackend::with_string(svg, size).into_drawing_area();
    let areas = root.split_evenly((charts.len(), 1));
    for (chart, area) in charts.into_iter().zip(&areas) {
        draw_chart(area, chart)?;
    }
    root.present()?;
    Ok(())
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

fn draw_chart(root: &Area<'_>, chart: Chart) -> Result<(), Box<dyn std::error::Error>> {
    let Chart {
        x_label,
        y_label,
        y_from_zero,
        curves,
    } = chart;
    let all = || curves.iter().flat_map(|curve| &curve.points);
    let (x_low, x_high) = span(all().map(|point| point.0), 0.0);
    let zero = y_from_zero.then_some(0.0);
    let (y_low, y_high) = span(all().map(|point| point.1).chain(zero), 0.06);
    let legend = Legend::of(&curves);
    let text = |size: i32| ("sans-serif", size).into_font().color(&INK);
    let mut chart = ChartBuilder::on(root)
        .margin(16)
        .margin_top(legend.height())
        .margin_right(40)
        .x_label_area_size(84)
        .y_label_area_size(124)
        .build_cartesian_2d(x_low..x_high, y_low..y_high)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(INK.mix(0.12).stroke_width(2))
        .axis_style(INK.stroke_width(2))
        .label_style(text(27))
        .axis_desc_style(text(30))
        .x_label_formatter(&|value| tick_label(*value))
        .y_label_formatter(&|value| tick_label(*value))
        .x_desc(x_label)
        .y_desc(y_label)
        .draw()?;
    // The legend goes above the plot, where no curve runs.
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
                Mark::Line(width) => root.draw(&PathElement::new(
                    [(x, y), (x + 48, y)],
                    colour.stroke_width(width),
                ))?,
                Mark::Dots(radius) => {
                    root.draw(&Circle::new((x + 24, y), radius, colour.filled()))?;
                }
            }
            let anchored = text(27).pos(Pos::new(HPos::Left, VPos::Center));
            root.draw(&Text::new(label, (x + 60, y), anchored))?;
        }
        let finite = points
            .into_iter()
            .filter(|point| point.0.is_finite() && point.1.is_finite());
        match mark {
            Mark::Line(width) => {
                chart.draw_series(LineSeries::new(finite, colour.stroke_width(width)))?;
            }
            Mark::Dots(radius) => {
                chart.draw_series(finite.map(|at| Circle::new(at, radius, colour.filled())))?;
            }
        }
    }
    Ok(())
}

/// Layout of a legend: rows of entries above the plot.
struct Legend {
    entries: usize,
    column: i32,
    columns: usize,
}

impl Legend {
    const ROW: i32 = 40;

    fn of(curves: &[Curve]) -> Self {
        let labels = || curves.iter().filter(|curve| !curve.label.is_empty());
        let longest = labels().map(|curve| curve.label.chars().count()).max();
        // Letters of height 27 are about 14 wide.
        let column = (90 + 14 * longest.unwrap_or(0) as i32).max(240);
        Self {
            entries: labels().count(),
            column,
            columns: usize::max(1, ((SIZE.0 as i32 - 150) / column) as usize),
        }
    }

    fn height(&self) -> i32 {
        16 + Self::ROW * self.entries.div_ceil(self.columns).max(1) as i32
    }

    fn place(&self, entry: usize) -> (i32, i32) {
        let (row, column) = (entry / self.columns, entry % self.columns);
        (
            150 + self.column * column as i32,
            32 + Self::ROW * row as i32,
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
    use super::*;
    use crate::experiment::PAPER_RUN;
    use crate::plan::{REFERENCE_LIMITS, summary};
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
    fn a_figure_without_data_is_still_a_figure() {
        let svg = over_time("y", vec![measured_curve(vec![(f64::NAN, 1.0)])]).expect("drawn");
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
    }
}
