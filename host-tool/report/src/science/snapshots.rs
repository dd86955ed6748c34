//! Wall and body at several moments, as in the paper's Fig. 6: one column for each pressure or indentation, one row for
//! each moment. The blue line marks the head at the start of the run, the red one at its end.

use locomotion::model::Model;
use locomotion::range::OutOfRange;
use locomotion::{roller, tube};
use serde::Serialize;

use crate::science::drawing::{Body, Crescent, Drawing, Point};

/// Pressures of the tube's columns, Pa.
const PRESSURES_PA: [f64; 3] = [3000.0, 5000.0, 7000.0];
/// Moments of the tube's rows, s: the start, one wave at the peaks of single pulses, and the end.
const TUBE_S: [f64; 6] = [0.0, 4.5, 6.5, 8.5, 10.5, 20.0];
/// Indentations of the rig's columns, mm.
const INDENTATIONS_MM: [f64; 3] = [1.0, 3.0, 5.05];
/// Travel of the carriage at the rig's rows, in strokes: one antegrade wave, and the end.
const STROKES: [f64; 6] = [0.0, 0.25, 0.5, 0.75, 1.0, 10.0];

/// Distance between two points of a drawn wall, mm.
const WALL_STEP_MM: f64 = 0.5;

#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    /// Label of the column: pressure or indentation.
    pub case: String,
    /// Label of the row: time or travel.
    pub moment: String,
    /// Positions along the wall and its indentation there, mm.
    pub wall_mm: Vec<Point>,
    pub body: Body,
    /// Position of the rollers, mm, if there are any.
    pub roller_mm: Option<f64>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Strip {
    /// `tube` or `roller`.
    pub model: &'static str,
    /// chi: fraction of the wall's indentation that a crescent feels.
    pub coupling: f64,
    /// Half the width of the intestine at rest, mm.
    pub half_width_mm: f64,
    pub columns: Vec<Vec<Snapshot>>,
}

/// One crescent in one picture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SnapshotRow {
    /// `tube` or `roller`.
    pub model: &'static str,
    /// Label of the column: pressure or indentation.
    pub case: String,
    /// Label of the row: time or travel.
    pub moment: String,
    pub crescent: usize,
    #[serde(flatten)]
    pub place: Crescent,
}

/// The tube at three pressures.
///
/// # Errors
/// A model with a value outside its range.
pub fn tube(model: &Model) -> Result<Strip, OutOfRange> {
    // Show one starting position: the middle of those over which the series average.
    let mut params = model.tube()?;
    params.body.tail_mm += params.segment_mm / 2.0;
    let design = params.body.design;
    let length_mm = f64::from(params.segments) * params.segment_mm;
    let mut columns = vec![];
    for pressure_pa in PRESSURES_PA {
        let mut tube = tube::Tube::new(params, pressure_pa)?;
        let mut column = vec![];
        for time_s in TUBE_S {
            // Stop within half a step of the moment, because sums of steps are inexact.
            while tube.time_s() < time_s - params.step_s / 2.0 {
                tube.step()?;
            }
            column.push(Snapshot {
                case: format!("{pressure_pa} Pa"),
                moment: format!("{time_s} s"),
                wall_mm: wall(length_mm, |x| tube.wall_at_mm(x)),
                body: Body::of(&design, tube.body())?,
                roller_mm: None,
            });
        }
        columns.push(column);
    }
    Ok(Strip {
        model: "tube",
        coupling: params.body.coupling,
        half_width_mm: params.radius_mm,
        columns,
    })
}

/// The rig at three indentations.
///
/// # Errors
/// A model with a value outside its range.
pub fn roller(model: &Model) -> Result<Strip, OutOfRange> {
    let params = model.rig()?;
    let design = params.body.design;
    let mut columns = vec![];
    for indentation_mm in INDENTATIONS_MM {
        let mut bench = roller::UnfoldedBody::new(params, indentation_mm)?;
        let mut column = vec![];
        let mut done = 0;
        for strokes in STROKES {
            // Make whole strokes first, so that each reversal is at an end of the rail.
            while f64::from(done + 1) <= strokes {
                done += 1;
                bench.carriage_to(if done % 2 == 1 { params.stroke_mm } else { 0.0 })?;
            }
            let part = (strokes - f64::from(done)) * params.stroke_mm;
            let carriage_mm = if done % 2 == 0 {
                part
            } else {
                params.stroke_mm - part
            };
            bench.carriage_to(carriage_mm)?;
            let roller_mm = params.stroke_mm - carriage_mm;
            column.push(Snapshot {
                case: format!("a = {indentation_mm} mm"),
                moment: format!("{} mm of travel", strokes * params.stroke_mm),
                wall_mm: wall(params.stroke_mm, |x| {
                    roller::wall_mm(indentation_mm, params.radius_mm, x - roller_mm)
                }),
                body: Body::of(&design, bench.chain())?,
                roller_mm: Some(roller_mm),
            });
        }
        columns.push(column);
    }
    Ok(Strip {
        model: "roller",
        coupling: params.body.coupling,
        half_width_mm: design.width_mm() / 2.0,
        columns,
    })
}

fn wall(length_mm: f64, at: impl Fn(f64) -> f64) -> Vec<Point> {
    let points = (length_mm / WALL_STEP_MM).round() as u32;
    (0..=points)
        .map(|index| {
            let x = f64::from(index) * WALL_STEP_MM;
            (x, at(x))
        })
        .collect()
}

impl Strip {
    pub fn rows(&self) -> Vec<SnapshotRow> {
        let mut rows = vec![];
        for snapshot in self.columns.iter().flatten() {
            for (crescent, place) in (1..).zip(&snapshot.body.crescents) {
                rows.push(SnapshotRow {
                    model: self.model,
                    case: snapshot.case.clone(),
                    moment: snapshot.moment.clone(),
                    crescent,
                    place: *place,
                });
            }
        }
        rows
    }

    /// Draws the strip to scale; `origin` names the model.
    pub fn svg(&self, origin: &str) -> String {
        const GAP: f64 = 8.0;
        const LEFT: f64 = 30.0;
        let half = self.half_width_mm;
        let length = self.columns[0][0].wall_mm.last().map_or(0.0, |(x, _)| *x);
        let (width, height) = (length + GAP, 2.0 * half + GAP);
        let rows = self.columns[0].len();
        let mut drawing = Drawing::new(
            LEFT + width * self.columns.len() as f64,
            23.0 + height * rows as f64,
        );
        let head = |snapshot: &Snapshot| snapshot.body.core_ends_mm().1;
        for (index, column) in self.columns.iter().enumerate() {
            let x = LEFT + width * index as f64;
            drawing.text("middle", (x + length / 2.0, 7.0), &column[0].case);
            let (start, end) = (head(&column[0]), column.last().map_or(0.0, head));
            for (row, snapshot) in column.iter().enumerate() {
                let y = 12.0 + half + height * row as f64;
                if index == 0 {
                    drawing.text("start", (4.0, y), &snapshot.moment);
                }
                drawing.open("snapshot", (x, y));
                for side in [-1.0, 1.0] {
                    let points: Vec<_> = snapshot
                        .wall_mm
                        .iter()
                        .map(|(x, a)| (*x, side * (half - a)))
                        .collect();
                    drawing.polyline("wall", &points);
                }
                drawing.body(&snapshot.body);
                drawing.line("start", (start, -half), (start, half));
                drawing.line("end", (end, -half), (end, half));
                if let Some(roller) = snapshot.roller_mm {
                    for (side, base) in [(-1.0, -half - 2.5), (1.0, half + 2.5)] {
                        drawing.polygon(
                            "arrow",
                            &[
                                (roller, base - side * 2.0),
                                (roller - 1.5, base),
                                (roller + 1.5, base),
                            ],
                        );
                    }
                }
                drawing.close();
            }
        }
        drawing.text(
            "start",
            (LEFT, 12.0 + height * rows as f64 + 4.0),
            &format!(
                "to scale, tail at the left; blue: head at the start, red: head at the end; a crescent feels {} of the \
                 wall's indentation over its foot; parameters.csv says what is calibrated or assumed",
                self.coupling
            ),
        );
        drawing.text("start", (LEFT, 12.0 + height * rows as f64 + 7.5), origin);
        drawing.finish("Wall and body at several moments", origin)
    }
}
