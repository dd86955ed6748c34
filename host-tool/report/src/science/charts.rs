//! The series as figures: the models' values, and the paper's where its text gives a number. The label of each curve
//! names the origin of its values.

pub mod trial_plan;

use calibration::observation::{Condition, Lubrication};
use calibration::predictive::{Band, Check, Span};
use locomotion::beam::Validation;
use plotters::style::RGBColor;

use crate::figures::palette::{BAND, MEASURED as MODEL, PAPER, PLANNED as SECOND};
use crate::figures::{Chart, Curve, FigureError, Heading, Mark, ModelName, curve, figure};
use crate::science::bands::Bands;
use crate::science::crescent::{ForceRow, ThreadRow};
use crate::science::design::{Curves, Maps};
use crate::science::drawing::KINEMATICS;
use crate::science::optimise::DesignRow;
use crate::science::optimise::bodies::Per;
use crate::science::series::{
    FRICTION_SERIES_PA, FoldTest, IsolatedRow, PAPER_ON_FRICTION_MM, RollerRow, TubeRow, TubeRun,
};

/// Most entries in the legend of a family; of a larger family it names only the first and the last.
const LEGEND: usize = 12;

/// The prior band as an area, if it is known.
fn band(points: Vec<(f64, f64)>) -> Option<Curve> {
    band_of(points, false)
}

/// As [`band`], for a posterior instead of the prior if `fitted`.
fn band_of(points: Vec<(f64, f64)>, fitted: bool) -> Option<Curve> {
    let label = if fitted {
        "posterior band: 90 %, with discrepancy"
    } else {
        "prior band: 90 % of bodies that fit the words"
    };
    (!points.is_empty()).then(|| curve(label, BAND, Mark::Area, points))
}

/// The outline of the bands of rows: (place, 5 %, 95 %).
fn outline(
    rows: impl DoubleEndedIterator<Item = (f64, Option<f64>, Option<f64>)> + Clone,
) -> Vec<(f64, f64)> {
    let low = rows.clone().filter_map(|(x, low, _)| Some((x, low?)));
    let high = rows.rev().filter_map(|(x, _, high)| Some((x, high?)));
    low.chain(high).collect()
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

/// A figure with two curves of the model.
fn two_curves(
    heading: &Heading,
    x_label: &'static str,
    y_label: &str,
    [first, second]: [(&str, Vec<(f64, f64)>); 2],
) -> Result<String, FigureError> {
    let curves = vec![
        curve(first.0, MODEL, Mark::Line(4), first.1),
        curve(second.0, SECOND, Mark::Line(4), second.1),
    ];
    figure(heading, vec![chart(x_label, y_label, curves)])
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

/// The course of each run over time, with a label.
fn courses(runs: &[TubeRun], label: impl Fn(&TubeRun) -> String) -> Vec<(String, Vec<(f64, f64)>)> {
    let course = |run: &TubeRun| {
        let points = run.course.iter().map(|at| (at.time_s, at.tail_mm));
        (label(run), points.collect())
    };
    runs.iter().map(course).collect()
}

/// Displacement of tail and head at the end of each run.
fn ends(rows: &[TubeRow], x: impl Fn(&TubeRow) -> f64) -> [Curve; 2] {
    let of = |value: fn(&TubeRow) -> f64| rows.iter().map(|row| (x(row), value(row))).collect();
    [
        curve(
            "tail (model)",
            MODEL,
            Mark::Line(5),
            of(|row| row.displacement_mm),
        ),
        curve(
            "head (model)",
            SECOND,
            Mark::Line(3),
            of(|row| row.head_displacement_mm),
        ),
    ]
}

/// Like Fig. 4(a): displacement over time at each friction, and at the end over friction. The paper's sentence is
/// drawn as a line, because it has no values for single frictions.
///
/// # Errors
/// If the drawing library fails.
pub fn friction(
    model: ModelName,
    runs: &[TubeRun],
    rows: &[TubeRow],
) -> Result<String, FigureError> {
    let courses = courses(runs, |run| format!("friction {}", run.case.friction));
    let at = |row: &TubeRow| row.friction;
    let sentence = [rows.first(), rows.last()].into_iter().flatten();
    let sentence = sentence
        .map(|row| (at(row), PAPER_ON_FRICTION_MM))
        .collect();
    let outline = outline(
        rows.iter()
            .map(|row| (at(row), row.prior_5_mm, row.prior_95_mm)),
    );
    let ends = band(outline)
        .into_iter()
        .chain(ends(rows, at))
        .chain([curve(
            "paper's sentence (about 14 mm)",
            PAPER,
            Mark::Line(3),
            sentence,
        )])
        .collect();
    let title =
        format!("Displacement in the tube over friction, {FRICTION_SERIES_PA} Pa (Fig. 4a)");
    figure(
        &Heading::of_model(title, model),
        vec![
            chart(
                "time / s",
                "displacement of the tail / mm",
                family(courses, 3),
            ),
            chart("friction coefficient", "displacement at the end / mm", ends),
        ],
    )
}

/// Like Fig. 4(b): displacement over time at each pressure, and at the end over pressure.
///
/// # Errors
/// If the drawing library fails.
pub fn pressure(
    model: ModelName,
    runs: &[TubeRun],
    rows: &[TubeRow],
) -> Result<String, FigureError> {
    let courses = courses(runs, |run| format!("{} Pa", run.case.pressure_pa));
    let at = |row: &TubeRow| row.pressure_pa;
    let outline = outline(
        rows.iter()
            .map(|row| (at(row), row.prior_5_mm, row.prior_95_mm)),
    );
    let ends = band(outline)
        .into_iter()
        .chain(ends(rows, at))
        .chain([curve(
            "paper's text (about)",
            PAPER,
            Mark::Dots(9),
            about(rows),
        )])
        .collect();
    figure(
        &Heading::of_model("Displacement in the tube over pressure (Fig. 4b)", model),
        vec![
            chart(
                "time / s",
                "displacement of the tail / mm",
                family(courses, 3),
            ),
            chart(
                "peristaltic pressure / Pa",
                "displacement at the end / mm",
                ends,
            ),
        ],
    )
}

/// The points for which the paper's text has a number.
fn about(rows: &[TubeRow]) -> Vec<(f64, f64)> {
    let about = |row: &TubeRow| Some((row.pressure_pa, row.paper_about_mm?));
    let mut points: Vec<_> = rows.iter().filter_map(about).collect();
    points.dedup();
    points
}

/// Like Fig. 7: the rig's displacement over indentation, the tube's over pressure, each for two frictions.
///
/// # Errors
/// If the drawing library fails.
pub fn comparison(
    model: ModelName,
    rig: &[RollerRow],
    tube: &[TubeRow],
) -> Result<String, FigureError> {
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
        let label = format!("friction {friction:.2} (model)");
        curve(label, colour, Mark::Line(width), points)
    };
    // Draw the wide curve below the narrow one, so that both are visible: with a fixed friction ratio their values
    // are equal.
    let fitted = rig.iter().any(|row| row.posterior_5_mm.is_some());
    let lubricated = rig.iter().filter(|row| row.lubrication == "with");
    let ends = lubricated.map(|row| {
        let (low, high) = row.band_mm();
        (row.indentation_mm, low, high)
    });
    let on_rig = band_of(outline(ends), fitted)
        .into_iter()
        .chain([
            rig_curve("without", "not lubricated (model)", SECOND, 10),
            rig_curve("with", "lubricated (model)", MODEL, 3),
        ])
        .collect();
    let in_tube =
        band(outline(tube.iter().filter(|row| row.friction == 0.08).map(
            |row| (row.pressure_pa, row.prior_5_mm, row.prior_95_mm),
        )))
        .into_iter()
        .chain([
            tube_curve(0.20, SECOND, 10),
            tube_curve(0.08, MODEL, 3),
            curve("paper's text (about)", PAPER, Mark::Dots(9), about(tube)),
        ])
        .collect();
    let title = "Displacement over indentation and pressure (Fig. 7)";
    figure(
        &Heading::of_model(title, model),
        vec![
            chart(
                "peristaltic indentation / mm",
                "displacement at the end / mm",
                on_rig,
            ),
            chart(
                "peristaltic pressure / Pa",
                "displacement at the end / mm",
                in_tube,
            ),
        ],
    )
}

/// The fold test: displacement of both bodies over the carriage's travel.
///
/// # Errors
/// If the drawing library fails.
pub fn fold(model: ModelName, test: &FoldTest) -> Result<String, FigureError> {
    let points = |value: fn(&crate::science::series::FoldRow) -> f64| {
        test.course
            .iter()
            .map(|row| (row.travel_mm, value(row)))
            .collect()
    };
    two_curves(
        &Heading::of_model("Declared folded, and unfolded (Fig. 8)", model),
        "travel of the carriage / mm",
        "displacement / mm",
        [
            ("unfolded (model)", points(|row| row.unfolded_mm)),
            ("declared folded (model)", points(|row| row.folded_mm)),
        ],
    )
}

/// One pass in each direction over indentation.
///
/// # Errors
/// If the drawing library fails.
pub fn isolated(model: ModelName, rows: &[IsolatedRow]) -> Result<String, FigureError> {
    let points = |value: fn(&IsolatedRow) -> f64| {
        rows.iter()
            .map(|row| (row.indentation_mm, value(row)))
            .collect()
    };
    two_curves(
        &Heading::of_model("One pass in each direction", model),
        "peristaltic indentation / mm",
        "displacement by one pass / mm",
        [
            ("antegrade (model)", points(|row| row.antegrade_mm)),
            ("returning (model)", points(|row| row.returning_mm)),
        ],
    )
}

/// The crescent as a beam: force over indentation, displacement over thread with its band, share that reverses.
/// `drawn` describes the draws.
///
/// # Errors
/// If the drawing library fails.
pub fn crescent(
    drawn: &str,
    forces: &[ForceRow],
    threads: &[ThreadRow],
) -> Result<String, FigureError> {
    let force = |label: &str, colour, value: fn(&ForceRow) -> f64| {
        let points = forces
            .iter()
            .map(|row| (row.indentation_mm, value(row)))
            .collect();
        curve(label, colour, Mark::Line(4), points)
    };
    let over_thread = |value: fn(&ThreadRow) -> f64| -> Vec<(f64, f64)> {
        threads
            .iter()
            .map(|row| (row.thread_mm, value(row)))
            .collect()
    };
    let low = over_thread(|row| row.low_mm);
    let high = over_thread(|row| row.high_mm).into_iter().rev();
    let outline = low.into_iter().chain(high).collect();
    let validation = Validation::NotAgainstARig;
    let model = ModelName {
        short: validation.to_string(),
        full: format!(
            "{validation}; calculated, not a measurement; {drawn}; kept is what moves headward unfolded and hardly by \
             returning strokes"
        ),
    };
    figure(
        &Heading::of_model("The crescent as a beam", model),
        vec![
            chart(
                "indentation of the wing / mm",
                "force on one wing / N",
                vec![
                    force("body moves tailward, friction 0.15 (model)", PAPER, |row| {
                        row.hard_n
                    }),
                    force("no friction (model)", BAND, |row| row.force_n),
                    force("body moves headward, friction 0.15 (model)", MODEL, |row| {
                        row.easy_n
                    }),
                ],
            ),
            chart(
                "thread drawn in / mm",
                "displacement in 40 s / mm",
                vec![
                    curve(
                        "5 to 95 % of the kept draws (model)",
                        BAND,
                        Mark::Area,
                        outline,
                    ),
                    curve(
                        "median (model)",
                        MODEL,
                        Mark::Line(5),
                        over_thread(|row| row.median_mm),
                    ),
                ],
            ),
            chart(
                "thread drawn in / mm",
                "share that goes tailward",
                vec![curve(
                    "share of the kept draws (model)",
                    MODEL,
                    Mark::Line(5),
                    over_thread(|row| row.reversed),
                )],
            ),
        ],
    )
}

/// Predictions of a posterior over the indentation, one chart for each kind of displacement, with the measurements: their
/// means with 95 % of their stated errors, the number of repeats, and the least probable of them.
///
/// # Errors
/// If the drawing library fails.
pub fn posterior(
    model: ModelName,
    bands: &[Band],
    checks: &[Check],
) -> Result<String, FigureError> {
    let of_kind = |bands: &[Band]| {
        let kind = bands[0].case.kind;
        let outline = |span: fn(&Band) -> Span| {
            let low = bands
                .iter()
                .map(move |band| (band.case.indentation_mm, span(band).low));
            let high =
                (bands.iter().rev()).map(move |band| (band.case.indentation_mm, span(band).high));
            low.chain(high).collect()
        };
        let medians = bands
            .iter()
            .map(|band| (band.case.indentation_mm, band.model_mm.median));
        let mut curves = vec![
            curve(
                "posterior, 5 to 95 %, with discrepancy",
                BAND,
                Mark::Area,
                outline(|band| band.with_discrepancy_mm),
            ),
            curve(
                "posterior, 5 to 95 %, model alone",
                MODEL,
                Mark::Area,
                outline(|band| band.model_mm),
            ),
            curve("posterior, median", MODEL, Mark::Line(4), medians.collect()),
        ];
        for (lubrication, colour) in [(Lubrication::Dry, PAPER), (Lubrication::Lubricated, SECOND)]
        {
            let of = |one: &&Check| {
                one.condition.case.kind == kind && one.condition.lubrication == lubrication
            };
            let checks: Vec<_> = checks.iter().filter(of).collect();
            let repeats = checks.iter().map(|one| one.condition.repeats);
            let (Some(least), Some(most)) = (repeats.clone().min(), repeats.max()) else {
                continue;
            };
            let number = match least == most {
                true => least.to_string(),
                false => format!("{least} to {most}"),
            };
            let p = checks.iter().map(|one| one.p_mean).fold(1.0, f64::min);
            let label =
                format!("trials, {lubrication}: means of {number}, bars 95 %, p from {p:.2}");
            let at = |one: &Condition, deviations: f64| {
                let mm = one.mean_mm + deviations * one.uncertainty_mm;
                (one.case.indentation_mm, mm)
            };
            let means = checks.iter().map(|one| at(&one.condition, 0.0));
            let ends = |one: &&Check| [-1.96, 1.96].map(|part| at(&one.condition, part));
            curves.push(curve(label, colour, Mark::Dots(7), means.collect()));
            let bars = checks.iter().flat_map(ends).collect();
            curves.push(curve("", colour, Mark::Segments(2), bars));
        }
        chart(
            "peristaltic indentation / mm",
            &format!("{kind} / mm"),
            curves,
        )
    };
    let charts = bands
        .chunk_by(|one, other| one.case.kind == other.case.kind)
        .map(of_kind)
        .collect();
    figure(&Heading::of_model("Posterior and trials", model), charts)
}

/// A sweep: displacement over pressure or indentation, a curve for each friction.
///
/// # Errors
/// If the drawing library fails.
pub fn sweep(
    model: ModelName,
    x_label: &'static str,
    y_label: &str,
    rows: &[(f64, f64, f64)],
    bands: &Bands,
) -> Result<String, FigureError> {
    let members = rows
        .chunk_by(|left, right| left.0 == right.0)
        .map(|part| {
            let points = part.iter().map(|(_, x, y)| (*x, *y)).collect();
            (format!("friction {} (model)", part[0].0), points)
        })
        .collect();
    let curves = band_of(bands.outline(), bands.fitted)
        .into_iter()
        .chain(family(members, 4))
        .collect();
    let heading = Heading::of_model("Sweep", model);
    figure(&heading, vec![chart(x_label, y_label, curves)])
}

/// Designs of a search: displacement over length with its band, and the share of bodies with which each beats the
/// compared one.
///
/// # Errors
/// If the drawing library fails.
pub fn designs(model: ModelName, per: Per, rows: &[DesignRow]) -> Result<String, FigureError> {
    let Some((own, front)) = rows.split_last() else {
        return figure(&Heading::of_model("Designs", model), vec![]);
    };
    let bands = rows.iter().flat_map(|row| {
        let (low, high) = row.band_mm();
        low.zip(high).map_or(vec![], |(low, high)| {
            vec![(row.length_mm, low), (row.length_mm, high)]
        })
    });
    let band_name = if own.posterior_5_mm.is_some() {
        "5 to 95 % of the posterior's bodies (model)"
    } else {
        "5 to 95 % of the bodies (model)"
    };
    let own_place = vec![(own.length_mm, own.displacement_mm)];
    let own_name = match own.design {
        "paper" => "the paper's design",
        _ => "your design",
    };
    let means = front
        .iter()
        .map(|row| (row.length_mm, row.displacement_mm))
        .collect();
    let beats = front
        .iter()
        .filter_map(|row| Some((row.length_mm, 100.0 * row.beats?)));
    figure(
        &Heading::of_model(
            format!("Designs: how far for their length, {}", per.text()),
            model,
        ),
        vec![
            chart(
                "overall length / mm",
                "displacement / mm",
                vec![
                    curve(band_name, BAND, Mark::Segments(2), bands.collect()),
                    curve(
                        "no other is shorter and farther (model)",
                        MODEL,
                        Mark::Dots(8),
                        means,
                    ),
                    curve(
                        format!("{own_name} (model)"),
                        PAPER,
                        Mark::Dots(10),
                        own_place,
                    ),
                ],
            ),
            chart(
                "overall length / mm",
                "farther / % of bodies",
                vec![curve(
                    format!("farther than {own_name} (model)"),
                    MODEL,
                    Mark::Dots(8),
                    beats.collect(),
                )],
            ),
        ],
    )
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
    let model = ModelName {
        short: "model: kinematics, Eq. (7), no measurement".to_owned(),
        full: KINEMATICS.to_owned(),
    };
    figure(
        &Heading::of_model("Shortening over the angles", model),
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
