//! The series as figures: the models' values, and the paper's where its text gives a number. The label of each curve
//! names the origin of its values.

use plotters::style::RGBColor;

use crate::figures::palette::{MEASURED as MODEL, PAPER, PLANNED as SECOND};
use crate::figures::{Chart, Curve, FigureError, Heading, Mark, ModelName, curve, figure};
use crate::science::design::{Curves, Maps};
use crate::science::drawing::KINEMATICS;
use crate::science::series::{
    FRICTION_SERIES_PA, FoldRow, FoldTest, PAPER_ON_FRICTION_MM, RollerRow, SweepRow, TubeRow,
    TubeRun,
};

/// Maximum entries in the legend of a family; for a larger family it names only the first and the last.
const LEGEND: usize = 12;

const TIME: &str = "time / s";
const PRESSURE: &str = "peristaltic pressure / Pa";
const INDENTATION: &str = "peristaltic indentation / mm";
const AT_THE_END: &str = "displacement at the end / mm";

/// A chart whose y axis includes 0.
fn chart(x_label: &'static str, y_label: &str, curves: Vec<Curve>) -> Chart {
    Chart {
        x_label,
        y_label: y_label.to_owned(),
        y_from_zero: true,
        curves,
    }
}

/// A curve through the points of some rows.
fn line<R>(
    label: impl Into<String>,
    colour: RGBColor,
    width: u32,
    rows: &[R],
    at: impl Fn(&R) -> (f64, f64),
) -> Curve {
    let points = rows.iter().map(at).collect();
    curve(label, colour, Mark::Line(width), points)
}

fn shade(index: usize, count: usize) -> RGBColor {
    let part = index as f64 / (count.max(2) - 1) as f64;
    let mix = |light: f64, dark: f64| (light + (dark - light) * part).round() as u8;
    RGBColor(mix(150.0, 10.0), mix(195.0, 45.0), mix(235.0, 110.0))
}

/// Curves of one family, from light to dark.
fn family(members: Curves, width: u32) -> Vec<Curve> {
    let count = members.len();
    let members = members.into_iter().enumerate();
    members
        .map(|(index, (label, points))| {
            let named = count <= LEGEND || index == 0 || index + 1 == count;
            let label = if named { label } else { String::new() };
            curve(label, shade(index, count), Mark::Line(width), points)
        })
        .collect()
}

/// Each run over time, with a label.
fn courses(runs: &[TubeRun], label: impl Fn(&TubeRow) -> String) -> Chart {
    let course = |run: &TubeRun| {
        let points = run.course.iter().map(|at| (at.time_s, at.displacement_mm));
        (label(&run.end), points.collect())
    };
    let members = runs.iter().map(course).collect();
    chart(TIME, "displacement of the tail / mm", family(members, 3))
}

/// Displacement of tail and head at the end of each run.
fn ends(rows: &[TubeRow], x: impl Fn(&TubeRow) -> f64) -> [Curve; 2] {
    let tail = |row: &TubeRow| (x(row), row.displacement_mm);
    let head = |row: &TubeRow| (x(row), row.head_displacement_mm);
    [
        line("tail (model)", MODEL, 5, rows, tail),
        line("head (model)", SECOND, 3, rows, head),
    ]
}

/// Like Fig. 4(a): displacement over time at each friction, and at the end over friction. The paper's sentence is drawn
/// as a line, because it has no values for single frictions.
pub fn friction(
    model: ModelName,
    runs: &[TubeRun],
    rows: &[TubeRow],
) -> Result<String, FigureError> {
    let at = |row: &TubeRow| row.friction;
    let sentence = line("paper's sentence (about 14 mm)", PAPER, 3, rows, |row| {
        (at(row), PAPER_ON_FRICTION_MM)
    });
    let ends = ends(rows, at).into_iter().chain([sentence]).collect();
    let title =
        format!("Displacement in the tube over friction, {FRICTION_SERIES_PA} Pa (Fig. 4a)");
    figure(
        &Heading::of_model(title, model),
        vec![
            courses(runs, |row| format!("friction {}", row.friction)),
            chart("friction coefficient", AT_THE_END, ends),
        ],
    )
}

/// Like Fig. 4(b): displacement over time at each pressure, and at the end over pressure.
pub fn pressure(
    model: ModelName,
    runs: &[TubeRun],
    rows: &[TubeRow],
) -> Result<String, FigureError> {
    let ends = ends(rows, |row| row.pressure_pa);
    let ends = ends.into_iter().chain([about(rows)]).collect();
    figure(
        &Heading::of_model("Displacement in the tube over pressure (Fig. 4b)", model),
        vec![
            courses(runs, |row| format!("{} Pa", row.pressure_pa)),
            chart(PRESSURE, AT_THE_END, ends),
        ],
    )
}

/// The points for which the paper's text has a number.
fn about(rows: &[TubeRow]) -> Curve {
    let about = |row: &TubeRow| Some((row.pressure_pa, row.paper_about_mm?));
    let mut points: Vec<_> = rows.iter().filter_map(about).collect();
    points.dedup();
    curve("paper's text (about)", PAPER, Mark::Dots(9), points)
}

/// Like Fig. 7: the rig's displacement over indentation, the tube's over pressure, each for two frictions.
pub fn comparison(
    model: ModelName,
    rig: &[RollerRow],
    tube: &[TubeRow],
) -> Result<String, FigureError> {
    let rig_curve = |name: &str, label: &str, colour, width| {
        let rows: Vec<_> = (rig.iter().filter(|row| row.lubrication == name)).collect();
        line(label, colour, width, &rows, |row| {
            (row.indentation_mm, row.displacement_mm)
        })
    };
    let tube_curve = |friction: f64, colour, width| {
        let rows: Vec<_> = (tube.iter().filter(|row| row.friction == friction)).collect();
        let label = format!("friction {friction:.2} (model)");
        line(label, colour, width, &rows, |row| {
            (row.pressure_pa, row.displacement_mm)
        })
    };
    // Draw the wide curve below the narrow one, so that both are visible: with a fixed friction ratio their values are
    // equal.
    let on_rig = vec![
        rig_curve("without", "not lubricated (model)", SECOND, 10),
        rig_curve("with", "lubricated (model)", MODEL, 3),
    ];
    let in_tube = vec![
        tube_curve(0.20, SECOND, 10),
        tube_curve(0.08, MODEL, 3),
        about(tube),
    ];
    let title = "Displacement over indentation and pressure (Fig. 7)";
    figure(
        &Heading::of_model(title, model),
        vec![
            chart(INDENTATION, AT_THE_END, on_rig),
            chart(PRESSURE, AT_THE_END, in_tube),
        ],
    )
}

/// The fold test: displacement of both bodies over the carriage's travel.
pub fn fold(model: ModelName, test: &FoldTest) -> Result<String, FigureError> {
    let unfolded = |row: &FoldRow| (row.travel_mm, row.unfolded_mm);
    let folded = |row: &FoldRow| (row.travel_mm, row.folded_mm);
    let curves = vec![
        line("unfolded (model)", MODEL, 4, &test.course, unfolded),
        line("declared folded (model)", SECOND, 4, &test.course, folded),
    ];
    let heading = Heading::of_model("Declared folded, and unfolded (Fig. 8)", model);
    let x_label = "travel of the carriage / mm";
    figure(&heading, vec![chart(x_label, "displacement / mm", curves)])
}

/// A sweep: displacement over pressure or indentation, a curve for each combination of the axes.
pub fn sweep<R>(
    model: ModelName,
    in_tube: bool,
    rows: &[SweepRow<R>],
) -> Result<String, FigureError> {
    let x_label = if in_tube { PRESSURE } else { INDENTATION };
    let members = rows.chunk_by(|one, other| one.axes == other.axes);
    let member = |part: &[SweepRow<R>]| {
        let axes = part[0].axes.iter();
        let axes: Vec<_> = axes.map(|(key, value)| format!("{key} {value}")).collect();
        let points = part.iter().map(|row| (row.load, row.mm)).collect();
        (
            format!("{} (model)", axes.join(", "))
                .trim_start()
                .to_owned(),
            points,
        )
    };
    let curves = family(members.map(member).collect(), 4);
    let heading = Heading::of_model("Sweep", model);
    figure(&heading, vec![chart(x_label, "displacement / mm", curves)])
}

/// Shortening over each angle, with a dot for the design.
pub fn maps(maps: &Maps) -> Result<String, FigureError> {
    let y_label = format!("d at a = {:.2} mm / mm", maps.indentation_mm);
    let over = |x_label, members: &Curves, own_deg| {
        let mut curves = family(members.clone(), 4);
        let own = vec![(own_deg, maps.shortening_mm)];
        curves.push(curve("this design", PAPER, Mark::Dots(9), own));
        chart(x_label, &y_label, curves)
    };
    let model = ModelName {
        short: "model: kinematics, Eq. (7), no measurement".to_owned(),
        full: KINEMATICS.to_owned(),
    };
    figure(
        &Heading::of_model("Shortening over the angles", model),
        vec![
            over("alpha / deg", &maps.over_alpha, maps.alpha_deg),
            over("beta / deg", &maps.over_beta, maps.beta_deg),
        ],
    )
}
