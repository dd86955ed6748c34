//! The series as figures: the models' values, with the paper's where its text gives a number. The label of each curve
//! names the origin of its values.

use plotters::style::RGBColor;

use crate::report::figures::{Chart, Curve, FigureError, Heading, Mark, Source, figure};
use crate::science::design::{Curves, Maps};
use crate::science::series::{FoldTest, IsolatedRow, RollerRow, TubeRow, TubeRun};

const MODEL: RGBColor = RGBColor(0x1f, 0x5a, 0xa8);
const SECOND: RGBColor = RGBColor(0xf0, 0xa0, 0x30);
const PAPER: RGBColor = RGBColor(0xc2, 0x1f, 0x26);

/// Most entries in the legend of a family; of a larger family it names only the first and the last.
const LEGEND: usize = 12;

fn curve(label: &str, colour: RGBColor, mark: Mark, points: Vec<(f64, f64)>) -> Curve {
    Curve {
        label: label.to_owned(),
        colour,
        mark,
        points,
    }
}

/// Heading of a figure of model values.
fn model(title: &str) -> Heading {
    Heading::new(title, Source::Model)
}

/// A chart whose y axis includes 0.
fn chart(x_label: &'static str, y_label: &str, curves: Vec<Curve>) -> Chart {
    Chart {
        x_label,
        y_label: y_label.to_owned(),
        y_from_zero: true,
        curves,
    }
}

/// A figure of two curves of the model.
fn two_curves(
    title: &str,
    x_label: &'static str,
    y_label: &str,
    [first, second]: [(&str, Vec<(f64, f64)>); 2],
) -> Result<String, FigureError> {
    let curves = vec![
        curve(first.0, MODEL, Mark::Line(4), first.1),
        curve(second.0, SECOND, Mark::Line(4), second.1),
    ];
    figure(&model(title), vec![chart(x_label, y_label, curves)])
}

/// Colour of a curve in a family, from light to dark.
fn shade(index: usize, count: usize) -> RGBColor {
    let part = index as f64 / (count.max(2) - 1) as f64;
    let mix = |light: f64, dark: f64| (light + (dark - light) * part).round() as u8;
    RGBColor(mix(150.0, 10.0), mix(195.0, 45.0), mix(235.0, 110.0))
}

/// Curves of one family, from light to dark.
fn family(members: Vec<(String, Vec<(f64, f64)>)>, width: u32) -> Vec<Curve> {
    let count = members.len();
    members
        .into_iter()
        .enumerate()
        .map(|(index, (label, points))| Curve {
            label: if count <= LEGEND || index == 0 || index + 1 == count {
                label
            } else {
                String::new()
            },
            colour: shade(index, count),
            mark: Mark::Line(width),
            points,
        })
        .collect()
}

/// Like Fig. 4(a): displacement over time at each friction, and at the end over friction.
///
/// # Errors
/// If the drawing library fails.
pub fn friction(runs: &[TubeRun], rows: &[TubeRow]) -> Result<String, FigureError> {
    let courses = runs
        .iter()
        .map(|run| {
            (
                format!("friction {}", run.case.friction),
                run.course.clone(),
            )
        })
        .collect();
    let title = "Displacement in the tube over friction (Fig. 4a)";
    tube_figure(title, courses, "friction coefficient", rows, |row| {
        row.friction
    })
}

/// Like Fig. 4(b): displacement over time at each pressure, and at the end over pressure.
///
/// # Errors
/// If the drawing library fails.
pub fn pressure(runs: &[TubeRun], rows: &[TubeRow]) -> Result<String, FigureError> {
    let courses = runs
        .iter()
        .map(|run| (format!("{} Pa", run.case.pressure_pa), run.course.clone()))
        .collect();
    let title = "Displacement in the tube over pressure (Fig. 4b)";
    tube_figure(title, courses, "peristaltic pressure / Pa", rows, |row| {
        row.pressure_pa
    })
}

fn tube_figure(
    title: &str,
    courses: Vec<(String, Vec<(f64, f64)>)>,
    x_label: &'static str,
    rows: &[TubeRow],
    x: impl Fn(&TubeRow) -> f64,
) -> Result<String, FigureError> {
    let ours = rows
        .iter()
        .map(|row| (x(row), row.displacement_mm))
        .collect();
    let paper = rows
        .iter()
        .filter_map(|row| Some((x(row), row.paper_about_mm?)))
        .collect();
    let ends = vec![
        curve("model (calibrated)", MODEL, Mark::Line(4), ours),
        curve("paper's text (about)", PAPER, Mark::Dots(9), paper),
    ];
    figure(
        &model(title),
        vec![
            chart("time / s", "displacement / mm", family(courses, 3)),
            chart(x_label, "displacement in 20 s / mm", ends),
        ],
    )
}

/// Like Fig. 7: the rig's displacement over indentation, the tube's over pressure, each for two frictions.
///
/// # Errors
/// If the drawing library fails.
pub fn comparison(rig: &[RollerRow], tube: &[TubeRow]) -> Result<String, FigureError> {
    let rig_curve = |name: &str, label: &str, colour, width| {
        let points = rig
            .iter()
            .filter(|row| row.lubrication == name)
            .map(|row| (row.indentation_mm, row.displacement_mm))
            .collect();
        curve(label, colour, Mark::Line(width), points)
    };
    let tube_curve = |friction: f64, colour, width| {
        let points = tube
            .iter()
            .filter(|row| row.friction == friction)
            .map(|row| (row.pressure_pa, row.displacement_mm))
            .collect();
        let label = format!("friction {friction:.2} (model, calibrated)");
        curve(&label, colour, Mark::Line(width), points)
    };
    let paper = tube
        .iter()
        .filter_map(|row| Some((row.pressure_pa, row.paper_about_mm?)))
        .collect();
    // Wide below narrow, so that both can be seen: the model gives them the same values.
    let on_rig = vec![
        rig_curve("without", "not lubricated (model, prediction)", SECOND, 10),
        rig_curve("with", "lubricated (model, prediction)", MODEL, 3),
    ];
    let in_tube = vec![
        tube_curve(0.20, SECOND, 10),
        tube_curve(0.08, MODEL, 3),
        curve("paper's text (about)", PAPER, Mark::Dots(9), paper),
    ];
    let title = "Displacement over indentation and pressure (Fig. 7)";
    figure(
        &model(title),
        vec![
            chart(
                "peristaltic indentation / mm",
                "displacement in 40 s / mm",
                on_rig,
            ),
            chart(
                "peristaltic pressure / Pa",
                "displacement in 20 s / mm",
                in_tube,
            ),
        ],
    )
}

/// The fold test: displacement of both bodies over the carriage's travel.
///
/// # Errors
/// If the drawing library fails.
pub fn fold(test: &FoldTest) -> Result<String, FigureError> {
    let points = |value: fn(&crate::science::series::FoldRow) -> f64| {
        test.course
            .iter()
            .map(|row| (row.travel_mm, value(row)))
            .collect()
    };
    two_curves(
        "Folded and unfolded (Fig. 8)",
        "travel of the carriage / mm",
        "displacement / mm",
        [
            ("unfolded (model)", points(|row| row.unfolded_mm)),
            ("folded (model)", points(|row| row.folded_mm)),
        ],
    )
}

/// One pass in each direction over indentation.
///
/// # Errors
/// If the drawing library fails.
pub fn isolated(rows: &[IsolatedRow]) -> Result<String, FigureError> {
    let points = |value: fn(&IsolatedRow) -> f64| {
        rows.iter()
            .map(|row| (row.indentation_mm, value(row)))
            .collect()
    };
    two_curves(
        "One pass in each direction",
        "peristaltic indentation / mm",
        "displacement by one pass / mm",
        [
            ("antegrade (model)", points(|row| row.antegrade_mm)),
            ("returning (model)", points(|row| row.returning_mm)),
        ],
    )
}

/// A sweep: displacement over pressure or indentation, a curve for each friction.
///
/// # Errors
/// If the drawing library fails.
pub fn sweep(
    x_label: &'static str,
    y_label: &str,
    rows: &[(f64, f64, f64)],
) -> Result<String, FigureError> {
    let members = rows
        .chunk_by(|left, right| left.0 == right.0)
        .map(|part| {
            let points = part.iter().map(|(_, x, y)| (*x, *y)).collect();
            (format!("friction {} (model)", part[0].0), points)
        })
        .collect();
    let chart = chart(x_label, y_label, family(members, 4));
    figure(&model("Sweep"), vec![chart])
}

/// Shortening over each angle, with a dot for the design.
///
/// # Errors
/// If the drawing library fails.
pub fn maps(maps: &Maps) -> Result<String, FigureError> {
    let y_label = format!("d at a = {:.2} mm / mm", maps.indentation_mm);
    let over = |x_label, members: &Curves, design| {
        let mut curves = family(members.clone(), 4);
        curves.push(curve("this design", PAPER, Mark::Dots(9), vec![design]));
        chart(x_label, &y_label, curves)
    };
    let (over_alpha, over_beta) = (&maps.over_alpha, &maps.over_beta);
    figure(
        &model("Shortening over the angles"),
        vec![
            over(
                "alpha / deg",
                over_alpha,
                (maps.alpha_deg, maps.shortening_mm),
            ),
            over("beta / deg", over_beta, (maps.beta_deg, maps.shortening_mm)),
        ],
    )
}
