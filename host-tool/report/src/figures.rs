//! Figures as SVG: each states the origin of its values in words and in its description. Its title is for its caption.
//!
//! A figure is as wide as one column of a paper, 85 mm, or two, 170 mm, and its letters have 8 pt in both. The narrow one
//! has letters of 12 px on a telephone 390 px wide.

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

/// Size of one chart in units of the drawing, 85 mm wide. The drawing library rounds to whole units, so charts are drawn
/// large and displayed small.
const SIZE: (u32, u32) = (1_200, 780);
/// Height of the line above the charts.
const HEADING: u32 = 50;
/// Height of a chart that is alone on 170 mm.
const WIDE_HEIGHT: u32 = 1_000;
/// Units of the drawing for each millimetre.
const PER_MM: f64 = 1_200.0 / 85.0;
/// Font size for the drawing library, which writes 1 / 1.24 of it: 40 units, 8 pt.
const LETTERS: i32 = 50;
/// Mean width of a letter.
const LETTER_WIDTH: i32 = 21;
/// Room around the plot of a chart: at the left, right, top and bottom.
const ROOM: [i32; 4] = [156, 30, 10, 112];

#[derive(Debug, thiserror::Error)]
#[error("a figure could not be drawn: {0}")]
pub struct FigureError(String);

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mark {
    Line(u32),
    Dots(i32),
    /// Open dots: one that is filled can be seen within.
    Rings(i32),
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

/// A curve of any length in bounded memory: each section is reduced to its least and greatest point, so that the curve
/// looks the same.
pub(crate) struct Thin {
    /// Maximum sections.
    most: usize,
    /// Points of each section.
    per: usize,
    count: usize,
    /// The least and the greatest point of each section, with their numbers.
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

    /// Adds a point, if it can be drawn.
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

/// Sections of all curves on a page.
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

/// Both curves of a record against time, drawn over the plan if there is one.
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

/// Label of a machine's samples: those of a simulated machine are not measured.
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

/// Size of the plot within a chart.
const fn plot_of((width, height): (u32, u32)) -> (i32, i32) {
    let [left, right, top, below] = ROOM;
    (width as i32 - left - right, height as i32 - top - below)
}

/// Draws charts one below the other, as one SVG, 85 mm wide.
pub(crate) fn figure(heading: &Heading, charts: Vec<Chart>) -> Result<String, FigureError> {
    figure_in(1, heading, &charts)
}

/// Draws charts as one SVG, as wide as so many columns of a paper, and that many beside each other.
pub(crate) fn figure_in(
    columns: u32,
    heading: &Heading,
    charts: &[Chart],
) -> Result<String, FigureError> {
    let beside = columns.min(charts.len() as u32).max(1);
    let rows = (charts.len() as u32).div_ceil(beside);
    let row = if beside < columns {
        WIDE_HEIGHT
    } else {
        SIZE.1
    };
    // Half of a plot remains for the curves above which a legend stands.
    let plot = plot_of((SIZE.0, row));
    let more = charts
        .iter()
        .map(|chart| Legend::of(&chart.curves, plot).height() - plot.1 / 2);
    let row = row + more.max().unwrap_or(0).max(0) as u32;
    let size = (SIZE.0 * columns, HEADING + row * rows);
    let mut svg = String::new();
    let backend = SVGBackend::with_string(&mut svg, size);
    draw(backend, heading, charts, (rows, beside))
        .map_err(|error| FigureError(error.to_string()))?;
    described(&svg, size, heading).ok_or_else(|| FigureError("the drawing is no SVG".to_owned()))
}

/// Adds title and description, for screen readers and for a file that is passed on alone, and the size on paper.
fn described(svg: &str, (width, height): (u32, u32), heading: &Heading) -> Option<String> {
    let (_, rest) = svg.split_once("<svg")?.1.split_once('>')?;
    let mm = |units: u32| format!("{:.1}mm", f64::from(units) / PER_MM);
    let title = escaped(&heading.title);
    let source = escaped(heading.description());
    // A model's figure is a separate file. On a dark page its dark letters need a white background; a report's page
    // provides one.
    let paper = match heading.model {
        Some(_) => "\n<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>",
        None => "",
    };
    Some(format!(
        "<svg width=\"{}\" height=\"{}\" viewBox=\"0 0 {width} {height}\" xmlns=\"http://www.w3.org/2000/svg\" \
         role=\"img\">\n<title>{title}</title>\n<desc>Origin: {source}</desc>{paper}{rest}",
        mm(width),
        mm(height)
    ))
}

type Drawn = Result<(), Box<dyn std::error::Error>>;
type Sheet<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn draw(
    backend: SVGBackend<'_>,
    heading: &Heading,
    charts: &[Chart],
    (rows, beside): (u32, u32),
) -> Drawn {
    let root = backend.into_drawing_area();
    let (head, body) = root.split_vertically(HEADING);
    let style = ("sans-serif", LETTERS - 4).into_font();
    let style = style
        .color(&heading.source.colour())
        .pos(Pos::new(HPos::Left, VPos::Center));
    head.draw(&Text::new(
        heading.line().to_owned(),
        (24, HEADING as i32 / 2),
        style,
    ))?;
    let areas = body.split_evenly((rows as usize, beside as usize));
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
    let wide = |curve: &Curve| !matches!(curve.mark, Mark::Line(_));
    let x_margin = if curves.iter().any(wide) { 0.03 } else { 0.0 };
    let (x_low, x_high) = span(all().map(|point| point.0), x_margin);
    let zero = (*y_from_zero).then_some(0.0);
    let heights = || all().map(|point| point.1).chain(zero);
    let (mut y_low, mut y_high) = span(heights(), 0.06);
    if *y_from_zero && heights().all(|y| y >= 0.0) {
        y_low = 0.0;
    }
    let [left, right, top, below] = ROOM;
    let legend = Legend::of(curves, plot_of(root.dim_in_pixel()));
    let corner = legend.corner(curves, [(x_low, x_high), (y_low, y_high)]);
    if corner.is_none() {
        // Room above all curves.
        y_high = y_low + (y_high - y_low) / (1.0 - legend.part().1);
    }
    let text = |size: i32| ("sans-serif", size).into_font().color(&INK);
    let mut chart = ChartBuilder::on(root)
        .margin_left(10)
        .margin_top(top)
        .margin_right(right)
        .x_label_area_size(below)
        .y_label_area_size(left - 10)
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
    for (entry, curve) in labelled(curves).enumerate() {
        let (x, y) = legend.place(entry, corner.unwrap_or_default());
        draw_entry(root, (left + x, top + y), curve)?;
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
        Mark::Rings(radius) => root.draw(&Circle::new((x + 30, y), radius, ring(colour)))?,
    }
    let letters = ("sans-serif", LETTERS - 2).into_font().color(&INK);
    let anchored = letters.pos(Pos::new(HPos::Left, VPos::Center));
    root.draw(&Text::new(curve.label.clone(), (x + 76, y), anchored))?;
    Ok(())
}

/// The line of an open dot.
fn ring(colour: RGBColor) -> ShapeStyle {
    colour.stroke_width(4)
}

fn labelled(curves: &[Curve]) -> impl Iterator<Item = &Curve> {
    curves.iter().filter(|curve| !curve.label.is_empty())
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
        Mark::Rings(radius) => {
            let rings = points.into_iter();
            plot.draw_series(rings.map(|at| Circle::new(at, radius, ring(colour))))?;
        }
        Mark::Segments(width) => {
            let segments = points.chunks_exact(2);
            let style = colour.stroke_width(width);
            plot.draw_series(segments.map(|ends| PathElement::new(ends.to_vec(), style)))?;
        }
    }
    Ok(())
}

/// A legend in a corner of the plot: up to three entries below each other, more in rows over the whole width.
struct Legend {
    plot: (i32, i32),
    column: i32,
    columns: i32,
    rows: i32,
}

/// Whether a legend is at the right and at the bottom.
type Corner = [bool; 2];

impl Legend {
    const ROW: i32 = 54;
    const MARGIN: i32 = 14;

    fn of(curves: &[Curve], plot: (i32, i32)) -> Self {
        let entries = labelled(curves).count() as i32;
        let longest = labelled(curves)
            .map(|curve| curve.label.chars().count())
            .max();
        let column = 100 + LETTER_WIDTH * longest.unwrap_or(0) as i32;
        let columns = if entries <= 3 {
            1
        } else {
            (plot.0 / column).max(1)
        };
        let rows = (entries + columns - 1) / columns;
        Self {
            plot,
            column,
            columns,
            rows,
        }
    }

    fn height(&self) -> i32 {
        Self::ROW * self.rows + Self::MARGIN
    }

    /// The parts of the plot's width and height that it takes.
    fn part(&self) -> (f64, f64) {
        let width = self.column * self.columns + Self::MARGIN;
        let part = |of: i32, all: i32| f64::from(of) / f64::from(all);
        (part(width, self.plot.0), part(self.height(), self.plot.1))
    }

    /// A corner in which no curve runs.
    fn corner(&self, curves: &[Curve], [x, y]: [(f64, f64); 2]) -> Option<Corner> {
        let (width, height) = self.part();
        let within = |(low, high): (f64, f64), value: f64| (value - low) / (high - low);
        let is_free = |[right, bottom]: &Corner| {
            let is_in = |at: (f64, f64)| {
                let (x, y) = (within(x, at.0), within(y, at.1));
                (if *right { 1.0 - x } else { x }) < width
                    && (if *bottom { y } else { 1.0 - y }) < height
            };
            !curves.iter().flat_map(trace).any(is_in)
        };
        let corners = [[false, false], [true, false], [false, true], [true, true]];
        corners.into_iter().find(is_free)
    }

    /// Where an entry begins, from the upper left of the plot.
    fn place(&self, entry: usize, [right, bottom]: Corner) -> (i32, i32) {
        let entry = entry as i32;
        let x = if right {
            self.plot.0 - self.column * self.columns
        } else {
            Self::MARGIN
        };
        let y = if bottom {
            self.plot.1 - Self::ROW * self.rows
        } else {
            Self::MARGIN
        };
        let (row, column) = (entry / self.columns, entry % self.columns);
        (
            x + self.column * column,
            y + Self::ROW * row + Self::ROW / 2,
        )
    }
}

/// Points along a drawn curve, dense enough to represent all of it.
fn trace(curve: &Curve) -> Vec<(f64, f64)> {
    const STEPS: u32 = 24;
    let line = |ends: &[(f64, f64)]| {
        let (a, b) = (ends[0], ends[1]);
        (0..=STEPS).map(move |step| {
            let part = f64::from(step) / f64::from(STEPS);
            (a.0 + part * (b.0 - a.0), a.1 + part * (b.1 - a.1))
        })
    };
    match curve.mark {
        Mark::Line(_) => curve.points.windows(2).flat_map(line).collect(),
        Mark::Segments(_) => curve.points.chunks_exact(2).flat_map(line).collect(),
        Mark::Dots(_) | Mark::Rings(_) => curve.points.clone(),
    }
}

/// A number without trailing zeros.
fn tick_label(value: f64) -> String {
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0" } else { text }.to_owned()
}

/// Range of finite values with a margin, between round numbers; never empty.
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
    // Use round numbers, so that a label fits at each end of the axis.
    let unit = 10_f64.powf((high - low).log10().floor() - 1.0);
    (
        ((low - margin) / unit).floor() * unit,
        ((high + margin) / unit).ceil() * unit,
    )
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
