//! Drawings to scale: one unit of the SVG is one millimetre, in print too.

use std::fmt::{Display, Write};

use locomotion::body::Chain;
use locomotion::kinematics::Design;
use locomotion::range::OutOfRange;
use serde::Serialize;

use crate::figures::escaped::escaped;

/// Height of letters, mm.
const LETTER_MM: f64 = 2.4;
/// Length of a dimension's arrow heads, mm.
const ARROW_MM: f64 = 1.0;

const STYLE: &str = "\
text{font-family:sans-serif;font-size:2.4px;fill:#333}\
.core{fill:#1f5aa8}.crescent{fill:#8fb4de;stroke:#1f5aa8;stroke-width:.15}\
.wall{fill:none;stroke:#c2565b;stroke-width:.6}\
.axis{stroke:#999;stroke-width:.12;stroke-dasharray:2 .6 .4 .6}\
.ghost{fill:none;stroke:#888;stroke-width:.15;stroke-dasharray:.8 .6}\
.dimension{fill:none;stroke:#333;stroke-width:.15}.arrow{fill:#333}\
.start{stroke:#1f5aa8;stroke-width:.5}.end{stroke:#c21f26;stroke-width:.5}";

/// Origin line for drawings and maps of a design: they involve neither a body nor a fit.
pub const KINEMATICS: &str =
    "model: kinematics, Eqs. (1) to (7) of the paper, rigid sides; calculated, not a measurement";

/// A point, mm: x to the right, y downward.
pub type Point = (f64, f64);

pub struct Drawing {
    width_mm: f64,
    height_mm: f64,
    body: String,
}

impl Drawing {
    pub fn new(width_mm: f64, height_mm: f64) -> Self {
        Self {
            width_mm,
            height_mm,
            body: String::new(),
        }
    }

    /// The whole file, with a title and a line on the origin of its values.
    pub fn finish(self, title: &str, origin: &str) -> String {
        let (w, h, body) = (self.width_mm, self.height_mm, self.body);
        let (title, origin) = (escaped(title), escaped(origin));
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}mm\" height=\"{h}mm\" viewBox=\"0 0 {w} {h}\">\n\
             <title>{title}</title>\n<desc>Origin: {origin}</desc>\n<style>{STYLE}</style>\n\
             <rect width=\"{w}\" height=\"{h}\" fill=\"#fff\"/>\n{body}</svg>\n"
        )
    }

    fn put(&mut self, element: std::fmt::Arguments<'_>) {
        let _ = self.body.write_fmt(element);
        self.body.push('\n');
    }

    /// Begins a group with its own `origin`; [`Drawing::close`] ends it.
    pub fn open(&mut self, class: &str, (x, y): Point) {
        let (x, y) = (Mm(x), Mm(y));
        self.put(format_args!(
            "<g class=\"{class}\" transform=\"translate({x} {y})\">"
        ));
    }

    pub fn close(&mut self) {
        self.put(format_args!("</g>"));
    }

    pub fn line(&mut self, class: &str, (x1, y1): Point, (x2, y2): Point) {
        let [x1, y1, x2, y2] = [x1, y1, x2, y2].map(Mm);
        self.put(format_args!(
            "<line class=\"{class}\" x1=\"{x1}\" y1=\"{y1}\" x2=\"{x2}\" y2=\"{y2}\"/>"
        ));
    }

    pub fn polygon(&mut self, class: &str, points: &[Point]) {
        self.put(format_args!(
            "<polygon class=\"{class}\" points=\"{}\"/>",
            Points(points)
        ));
    }

    pub fn polyline(&mut self, class: &str, points: &[Point]) {
        self.put(format_args!(
            "<polyline class=\"{class}\" points=\"{}\"/>",
            Points(points)
        ));
    }

    /// Text; `anchor` is `start`, `middle` or `end`.
    pub fn text(&mut self, anchor: &str, (x, y): Point, text: &str) {
        let (x, y, text) = (Mm(x), Mm(y), escaped(text));
        self.put(format_args!(
            "<text text-anchor=\"{anchor}\" x=\"{x}\" y=\"{y}\">{text}</text>"
        ));
    }

    /// An arc about `centre`; angles count from straight down towards the right.
    fn arc(&mut self, centre: Point, radius: f64, from_deg: f64, to_deg: f64) {
        let at = |deg: f64| {
            let (sin, cos) = deg.to_radians().sin_cos();
            (Mm(centre.0 + radius * sin), Mm(centre.1 + radius * cos))
        };
        let ((x1, y1), (x2, y2), r) = (at(from_deg), at(to_deg), Mm(radius));
        self.put(format_args!(
            "<path class=\"dimension\" d=\"M{x1} {y1}A{r} {r} 0 0 0 {x2} {y2}\"/>"
        ));
    }

    /// A dimension's line from one end to the other; `turned` swaps its coordinates.
    fn dimension(&mut self, across: f64, ends: (f64, f64), turned: bool) {
        let at = |along: f64, across: f64| match turned {
            true => (across, along),
            false => (along, across),
        };
        self.line("dimension", at(ends.0, across), at(ends.1, across));
        for (along, inward) in [(ends.0, ARROW_MM), (ends.1, -ARROW_MM)] {
            let end = (at(along, across - 1.0), at(along, across + 1.0));
            self.line("dimension", end.0, end.1);
            let feet = [across - 0.3, across + 0.3].map(|across| at(along + inward, across));
            self.polygon("arrow", &[at(along, across), feet[0], feet[1]]);
        }
    }

    /// A horizontal dimension with its text at height `y`, from `x1` to `x2`.
    fn across(&mut self, y: f64, (x1, x2): (f64, f64), text: &str) {
        self.dimension(y, (x1, x2), false);
        self.text("middle", ((x1 + x2) / 2.0, y - 1.2), text);
    }

    /// A vertical dimension with its text at `x`, from `y1` to `y2`. The text is on its left where `x` is negative.
    fn upright(&mut self, x: f64, (y1, y2): (f64, f64), text: &str) {
        self.dimension(x, (y1, y2), true);
        let (anchor, aside) = if x < 0.0 {
            ("end", -1.4)
        } else {
            ("start", 1.4)
        };
        let middle = (y1 + y2) / 2.0 + LETTER_MM / 3.0;
        self.text(anchor, (x + aside, middle), text);
    }

    pub fn body(&mut self, body: &Body) {
        let root = body.core_mm / 2.0;
        for crescent in &body.crescents {
            for side in [-1.0, 1.0] {
                self.polygon(
                    "crescent",
                    &[
                        (crescent.tail_root_mm, side * root),
                        (crescent.tip_mm, side * crescent.reach_mm),
                        (crescent.head_root_mm, side * root),
                    ],
                );
            }
        }
        let (tail, head) = body.core_ends_mm();
        self.polygon(
            "core",
            &[(tail, -root), (head, -root), (head, root), (tail, root)],
        );
    }
}

/// Writes millimetres to the micrometre, without trailing zeros.
struct Mm(f64);

impl Display for Mm {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", (self.0 * 1e3).round() / 1e3 + 0.0)
    }
}

struct Points<'a>(&'a [Point]);

impl Display for Points<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (index, (x, y)) in self.0.iter().enumerate() {
            let gap = if index == 0 { "" } else { " " };
            write!(f, "{gap}{},{}", Mm(*x), Mm(*y))?;
        }
        Ok(())
    }
}

/// A crescent at its position: a triangle on either side of the core, with its tip towards the tail.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Crescent {
    /// Foot of the short side, mm along the axis, positive headward.
    pub tail_root_mm: f64,
    /// Foot of the long side, mm.
    pub head_root_mm: f64,
    /// Position of the tip along the axis, mm.
    pub tip_mm: f64,
    /// Distance of the tip from the axis, mm.
    #[serde(skip)]
    pub reach_mm: f64,
    pub indentation_mm: f64,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    core_mm: f64,
    /// The crescents, tail first.
    pub crescents: Vec<Crescent>,
}

impl Body {
    /// A body of crescents with these indentations, tail first.
    pub fn new(
        design: &Design<f64>,
        core_tail_mm: f64,
        indentations_mm: &[f64],
    ) -> Result<Self, OutOfRange> {
        let mut tail_root_mm = core_tail_mm;
        let mut crescents = vec![];
        for &indentation_mm in indentations_mm {
            let head_root_mm = tail_root_mm + design.squeezed_spacing_mm(indentation_mm)?;
            crescents.push(Crescent {
                tail_root_mm,
                head_root_mm,
                tip_mm: tail_root_mm - design.wing_reach_mm(indentation_mm)?,
                reach_mm: design.folded_width_mm(indentation_mm)? / 2.0,
                indentation_mm,
            });
            tail_root_mm = head_root_mm;
        }
        Ok(Self {
            core_mm: design.core_mm(),
            crescents,
        })
    }

    /// The body of a model's chain.
    pub fn of(design: &Design<f64>, chain: &Chain) -> Result<Self, OutOfRange> {
        Self::new(design, chain.core_tail_mm(), chain.indentations_mm())
    }

    /// Tail and head of the core, mm.
    pub fn core_ends_mm(&self) -> (f64, f64) {
        let end = |crescent: Option<&Crescent>, of: fn(&Crescent) -> f64| crescent.map_or(0.0, of);
        (
            end(self.crescents.first(), |c| c.tail_root_mm),
            end(self.crescents.last(), |c| c.head_root_mm),
        )
    }
}

/// The structure unsqueezed and squeezed by `a_mm`, side by side and to scale, as in the paper's Fig. 2, with the tail
/// at the left. The head of the core is at the same position in both halves.
///
/// # Errors
/// `a_mm` outside `0..=h`.
pub fn structure(design: &Design<f64>, a_mm: f64) -> Result<String, OutOfRange> {
    // Leave room for the text beside and below a small structure.
    const MARGIN: f64 = 18.0;
    const LEAST_PART: f64 = 70.0;
    let (length, half) = (design.length_mm(0.0)?, design.width_mm() / 2.0);
    let part = (length + 2.0 * MARGIN).max(LEAST_PART);
    let margin = (part - length) / 2.0;
    let middle = 10.0 + half;
    let mut drawing = Drawing::new((2.0 * part).ceil(), (middle + half + 26.0).ceil());

    drawing.open("unsqueezed", (margin, middle));
    let core = unsqueezed(&mut drawing, design, length)?;
    drawing.close();
    drawing.open("squeezed", (part + margin, middle));
    squeezed(&mut drawing, design, a_mm, core)?;
    drawing.close();
    drawing.text(
        "start",
        (4.0, middle + half + 24.0),
        "lengths in mm, drawn to scale; tail at the left, head at the right; model: kinematics, Eqs. (1) to (7)",
    );
    Ok(drawing.finish("The origami, not squeezed and squeezed", KINEMATICS))
}

/// The half of [`structure`] at rest. Returns where the core begins and ends.
fn unsqueezed(
    drawing: &mut Drawing,
    design: &Design<f64>,
    length: f64,
) -> Result<Point, OutOfRange> {
    let (m, half) = (usize::from(design.crescents()), design.width_mm() / 2.0);
    // The rearmost tip is at 0, so the core begins at s2(0).
    let free = Body::new(design, design.wing_reach_mm(0.0)?, &vec![0.0; m])?;
    let (tail, head) = free.core_ends_mm();
    drawing.text("middle", (length / 2.0, -half - 4.0), "(a) not squeezed");
    walls(drawing, length, half);
    drawing.body(&free);
    let width = format!("W = {:.2}", design.width_mm());
    drawing.upright(head + 4.0, (-half, half), &width);
    let root = design.core_mm() / 2.0;
    drawing.upright(-5.0, (-root, root), &format!("c = {:.2}", design.core_mm()));
    let (phi, core) = (design.spacing_mm(), head - tail);
    let spacings = format!("m ϕ = {m} x {phi:.3} = {core:.2}");
    drawing.across(half + 5.0, (tail, head), &spacings);
    drawing.across(half + 10.5, (0.0, length), &format!("L = {length:.2}"));
    // The angles at the tip of the foremost crescent, from the transverse axis.
    let crescent = free.crescents[m - 1];
    let tip = (crescent.tip_mm, -half);
    let [alpha, beta] = [design.tan_alpha(), design.tan_beta()].map(|tan| tan.atan().to_degrees());
    drawing.line("ghost", tip, (tip.0, -root));
    let radius = design.half_gap_mm() / 10.0;
    drawing.arc(tip, 4.0 * radius, 0.0, alpha);
    drawing.arc(tip, 6.0 * radius, 0.0, beta);
    let angles = format!("α = {alpha:.2}°, β = {beta:.2}° to the transverse axis");
    drawing.text("middle", (length / 2.0, half + 15.5), &angles);
    let (l1, l2) = (design.long_side_mm(), design.short_side_mm());
    let sides = format!("l1 = {l1:.3}, l2 = {l2:.3}");
    drawing.text("middle", (length / 2.0, half + 19.5), &sides);
    Ok((tail, head))
}

/// The squeezed half of [`structure`], beside the outline of the other.
fn squeezed(
    drawing: &mut Drawing,
    design: &Design<f64>,
    a_mm: f64,
    (tail, head): Point,
) -> Result<(), OutOfRange> {
    let (m, half) = (usize::from(design.crescents()), design.width_mm() / 2.0);
    let length = design.length_mm(0.0)?;
    let psi = design.squeezed_spacing_mm(a_mm)?;
    let d = design.shortening_mm(a_mm)?;
    let squeezed = Body::new(design, tail + d, &vec![a_mm; m])?;
    let reach = half - a_mm;
    let middle = length / 2.0;
    let title = format!("(b) squeezed by a = {a_mm:.2}");
    drawing.text("middle", (middle, -half - 4.0), &title);
    for side in [-1.0, 1.0] {
        drawing.line("ghost", (-3.0, side * half), (length + 3.0, side * half));
    }
    walls(drawing, length, reach);
    drawing.body(&squeezed);
    drawing.line("ghost", (tail, -half), (tail, half));
    drawing.upright(head + 4.0, (-half, -reach), &format!("a = {a_mm:.2}"));
    let total = format!("d = m d0 = {m} x {:.3} = {d:.2}", d / m as f64);
    drawing.across(half + 5.0, (tail, tail + d), &total);
    let back = squeezed.crescents[0].tip_mm;
    let overall = format!("L(a) = {:.2}", length - back);
    drawing.across(half + 10.5, (back, length), &overall);
    let spacing = format!("ψ = {psi:.3}, core m ψ = {:.2}", m as f64 * psi);
    drawing.text("middle", (middle, half + 15.5), &spacing);
    Ok(())
}

fn walls(drawing: &mut Drawing, length: f64, reach: f64) {
    for side in [-1.0, 1.0] {
        drawing.line("wall", (-3.0, side * reach), (length + 3.0, side * reach));
    }
    drawing.line("axis", (-3.0, 0.0), (length + 3.0, 0.0));
}
