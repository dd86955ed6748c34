//! Figures as SVG: each has a title, and states the origin of its values in words and in its description.
//!
//! The size of a chart makes its letters 12 px high on a telephone 390 px wide, and lets two charts fit beside each
//! other on a desktop screen.

pub(crate) mod escaped;
mod heading;
pub(crate) mod palette;
mod profile;

use client::identity::Origin;
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::figures::escaped::escaped;
pub use crate::figures::heading::{Heading, ModelName, Source};
use crate::figures::palette::{INK, MEASURED, PLANNED};
pub use crate::figures::profile::{Planned, planned, position_at};

/// Size of one chart in units of the drawing. The drawing library rounds to whole units, so charts are drawn large
/// and displayed small.
const SIZE: (u32, u32) = (1_200, 760);
/// Font size for the drawing library, which writes 1 / 1.24 of it: a telephone shows the 1,200 units on 358 px.
const LETTERS: i32 = 50;
/// Mean width of a letter.
const LETTER_WIDTH: i32 = 22;

#[derive(Debug, thiserror::Error)]
#[error("a figure could not be drawn: {0}")]
pub struct FigureError(String);

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mark {
    Line(u32),
    Dots(i32),
    /// Each pair of points is a line of this width.
    Segments(u32),
}

/// One curve. Without a label it has no entry in the legend.
pub(crate) struct Curve {
    pub(crate) label: String,
    pub(crate) colour: RGBColor,
    pub(crate) mark: Mark,
    pub(crate) points: Vec<(f64, f64)>,
}

pub(crate) fn curve(
    label: impl Into<String>,
    colour: RGBColor,
    mark: Mark,
    points: Vec<(f64, f64)>,
) -> Curve {
    Curve {
        label: label.into(),
        colour,
        mark,
        points,
    }
}

pub(crate) struct Chart {
    pub(crate) x_label: &'static str,
    pub(crate) y_label: String,
    /// The y axis includes 0, so that differences appear in proportion.
    pub(crate) y_from_zero: bool,
    pub(crate) curves: Vec<Curve>,
}

/// A curve of any length in bounded memory: the points with the least and the greatest value of each stretch of it, so
/// that it looks the same.
pub(crate) struct Thin {
    /// Most stretches.
    most: usize,
    /// Points of each stretch.
    per: usize,
    count: usize,
    /// The least and the greatest point of each, with their numbers.
    stretches: Vec<[(usize, (f64, f64)); 2]>,
}

impl Thin {
    pub(crate) const fn new(most: usize) -> Self {
        Self {
            most,
            per: 1,
            count: 0,
            stretches: vec![],
        }
    }

    /// Adds a point, unless it cannot be drawn.
    pub(crate) fn push(&mut self, point: (f64, f64)) {
        if !(point.0.is_finite() && point.1.is_finite()) {
            return;
        }
        let wider = |[least, most]: &mut [(usize, (f64, f64)); 2], other: (usize, (f64, f64))| {
            if other.1.1 < least.1.1 {
                *least = other;
            }
            if other.1.1 > most.1.1 {
                *most = other;
            }
        };
        if self.count == self.most * self.per {
            let pairs = self.stretches.chunks(2).map(|pair| {
                let mut both = pair[0];
                pair.iter().flatten().for_each(|end| wider(&mut both, *end));
                both
            });
            self.stretches = pairs.collect();
            self.per *= 2;
        }
        let numbered = (self.count, point);
        match self.stretches.last_mut() {
            Some(last) if !self.count.is_multiple_of(self.per) => wider(last, numbered),
            _ => self.stretches.push([numbered; 2]),
        }
        self.count += 1;
    }

    pub(crate) fn points(&self) -> Vec<(f64, f64)> {
        let mut points: Vec<_> = self.stretches.iter().flatten().copied().collect();
        points.sort_by_key(|(number, _)| *number);
        points.dedup_by_key(|(number, _)| *number);
        points.into_iter().map(|(_, point)| point).collect()
    }
}

/// Number of stretches of the curves of a whole page.
const STRETCHES: usize = 2_000;

fn thinned(points: impl IntoIterator<Item = (f64, f64)>, most: usize) -> Vec<(f64, f64)> {
    let mut thin = Thin::new(most);
    points.into_iter().for_each(|point| thin.push(point));
    thin.points()
}

/// Two curves of a record over its time.
pub struct Curves {
    start_us: Option<u64>,
    of: [Thin; 2],
}

impl Curves {
    /// Without a start, time 0 is the first sample.
    pub const fn since(start_us: Option<u64>) -> Self {
        let of = [Thin::new(STRETCHES), Thin::new(STRETCHES)];
        Self { start_us, of }
    }

    pub fn push(&mut self, time_us: u64, values: [f64; 2]) {
        let time_s = since(*self.start_us.get_or_insert(time_us), time_us);
        for (thin, value) in self.of.iter_mut().zip(values) {
            thin.push((time_s, value));
        }
    }

    pub fn is_empty(&self) -> bool {
        self.of[0].count == 0
    }
}

/// What a figure of a record shows, the label of its axis, and the plan.
pub type Shown = (&'static str, &'static str, Option<Vec<(f64, f64)>>);

/// Both curves of a record against time, over the plan if there is one.
pub fn record_figures(
    name: &str,
    origin: Origin,
    curves: &Curves,
    [one, other]: [Shown; 2],
) -> Result<[String; 2], FigureError> {
    let figure = |(what, y_label, plan): Shown, thin: &Thin| {
        let heading = Heading::new(format!("{name}: {what}"), Source::Records(origin));
        let plan = plan.map(plan_curve).into_iter();
        let measured = measured_curve(origin, thin.points());
        over_time(&heading, y_label, plan.chain([measured]).collect())
    };
    Ok([figure(one, &curves.of[0])?, figure(other, &curves.of[1])?])
}

pub fn plan_figure(planned: Planned) -> Result<String, FigureError> {
    over_time(
        &Heading::new("Planned position", Source::Plan),
        "position / mm",
        vec![plan_curve(planned.position)],
    )
}

fn plan_curve(points: Vec<(f64, f64)>) -> Curve {
    curve("planned", PLANNED, Mark::Line(8), points)
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
    curve(sampled(origin), MEASURED, Mark::Line(3), points)
}

/// Seconds from `start_us`, negative before it.
pub(crate) fn since(start_us: u64, time_us: u64) -> f64 {
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
pub(crate) fn figure(heading: &Heading, charts: Vec<Chart>) -> Result<String, FigureError> {
    let (width, height) = SIZE;
    let height = heading.height() + height * charts.len() as u32;
    let mut svg = String::new();
    let backend = SVGBackend::with_string(&mut svg, (width, height));
    draw(backend, heading, &charts).map_err(|error| FigureError(error.to_string()))?;
    described(&svg, heading).ok_or_else(|| FigureError("the drawing is no SVG".to_owned()))
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

type Drawn = Result<(), Box<dyn std::error::Error>>;
type Sheet<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn draw(backend: SVGBackend<'_>, heading: &Heading, charts: &[Chart]) -> Drawn {
    let root = backend.into_drawing_area();
    let (head, body) = root.split_vertically(heading.height());
    for line in heading.lines() {
        let style = ("sans-serif", line.size).into_font().color(&line.colour);
        let style = style.pos(Pos::new(HPos::Left, VPos::Center));
        head.draw(&Text::new(line.text, line.at, style))?;
    }
    let areas = body.split_evenly((charts.len(), 1));
    for (chart, area) in charts.iter().zip(&areas) {
        draw_chart(area, chart)?;
    }
    root.present()?;
    Ok(())
}

fn draw_chart(root: &Sheet<'_>, chart: &Chart) -> Drawn {
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
    let heights = all().map(|point| point.1);
    let (y_low, y_high) = span(heights.chain(zero), 0.06);
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
    let labelled = curves.iter().filter(|curve| !curve.label.is_empty());
    for (entry, curve) in labelled.enumerate() {
        draw_entry(root, legend.place(entry), curve)?;
    }
    for curve in curves {
        draw_curve(&mut chart, curve)?;
    }
    Ok(())
}

fn draw_entry(root: &Sheet<'_>, (x, y): (i32, i32), curve: &Curve) -> Drawn {
    let colour = curve.colour;
    let line = |y: i32, style: ShapeStyle| PathElement::new([(x, y), (x + 60, y)], style);
    match curve.mark {
        Mark::Line(width) | Mark::Segments(width) => {
            root.draw(&line(y, colour.stroke_width(width)))?;
        }
        Mark::Dots(radius) => root.draw(&Circle::new((x + 30, y), radius, colour.filled()))?,
    }
    let letters = ("sans-serif", LETTERS - 2).into_font().color(&INK);
    let anchored = letters.pos(Pos::new(HPos::Left, VPos::Center));
    root.draw(&Text::new(curve.label.clone(), (x + 76, y), anchored))?;
    Ok(())
}

type Plot<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

fn draw_curve(plot: &mut Plot<'_, '_>, curve: &Curve) -> Drawn {
    let colour = curve.colour;
    let is_finite = |point: &&(f64, f64)| point.0.is_finite() && point.1.is_finite();
    let points: Vec<_> = curve.points.iter().filter(is_finite).copied().collect();
    match curve.mark {
        Mark::Line(width) => {
            let points = thinned(points, STRETCHES);
            plot.draw_series(LineSeries::new(points, colour.stroke_width(width)))?;
        }
        Mark::Dots(radius) => {
            let dots = points.into_iter();
            plot.draw_series(dots.map(|at| Circle::new(at, radius, colour.filled())))?;
        }
        Mark::Segments(width) => {
            let segments = points.chunks_exact(2);
            let style = colour.stroke_width(width);
            plot.draw_series(segments.map(|ends| PathElement::new(ends.to_vec(), style)))?;
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
    use super::*;

    #[test]
    fn a_thinned_curve_keeps_its_extremes_and_its_order() {
        let points: Vec<_> = (0..10_000)
            .map(|index| (f64::from(index), (f64::from(index) / 37.0).sin()))
            .chain([(10_000.0, 5.0), (10_001.0, -7.0)])
            .collect();
        let thin = thinned(points.iter().copied(), 200);
        assert!(thin.len() <= 400 && thin.is_sorted_by(|a, b| a.0 < b.0));
        for wanted in [5.0, -7.0] {
            assert!(thin.iter().any(|point| point.1 == wanted), "{wanted}");
        }
        assert_eq!(thinned(points[..300].to_vec(), 200), points[..300]);
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
}
