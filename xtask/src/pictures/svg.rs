//! The strokes that the manual's pictures are made of.

use std::fmt::Write as _;

/// A diagram in the making; lengths in px, y downwards.
pub(super) struct Picture {
    width: u32,
    height: u32,
    body: String,
}

/// Where a text is held.
#[derive(Clone, Copy)]
pub(super) enum Anchor {
    Start,
    Middle,
}

const STYLE: &str = "\
    text { font: 13px sans-serif; fill: #1d2433; }
    .title { font-size: 19px; font-weight: bold; }
    .head { font-size: 12px; fill: #55607a; }
    .name { font-weight: bold; }
    .note { font-size: 12px; fill: #55607a; }
    .box { fill: #f4f6fb; stroke: #1d2433; stroke-width: 1.5; }
    .part { fill: #ffffff; stroke: #1d2433; stroke-width: 1.5; }
    .wire { fill: none; stroke: #1d2433; stroke-width: 1.5; }
    .jumper { fill: none; stroke: #b3261e; stroke-width: 2.5; }
    .power { fill: none; stroke: #a05a00; stroke-width: 2; }
    .rule { stroke: #d5dae6; stroke-width: 1; }
    .dot { fill: #1d2433; }
    .joint { fill: #b3261e; }
    .terminal { fill: #14181f; }
    text.typed { font: 13px 'DejaVu Sans Mono', Menlo, Consolas, monospace; fill: #e6e9ef; }
";

impl Picture {
    pub(super) fn new(width: u32, height: u32) -> Self {
        Self {
            width,
            height,
            body: String::new(),
        }
    }

    fn push(&mut self, line: &str) {
        self.body.push_str("  ");
        self.body.push_str(line);
        self.body.push('\n');
    }

    pub(super) fn text(&mut self, (x, y): (i32, i32), anchor: Anchor, class: &str, text: &str) {
        let text = text.replace('&', "&amp;").replace('<', "&lt;");
        let held = match anchor {
            Anchor::Start => "",
            Anchor::Middle => " text-anchor=\"middle\"",
        };
        let class = match class {
            "" => String::new(),
            class => format!(" class=\"{class}\""),
        };
        self.push(&format!(
            "<text x=\"{x}\" y=\"{y}\"{held}{class}>{text}</text>"
        ));
    }

    /// A line of a terminal: each character as wide as the others, whatever font there is.
    pub(super) fn characters(&mut self, (x, y): (i32, i32), wide: i32, line: &str) {
        let text = line.replace('&', "&amp;").replace('<', "&lt;");
        let length = i32::try_from(line.chars().count()).unwrap_or(0) * wide;
        if length > 0 {
            self.push(&format!(
                "<text x=\"{x}\" y=\"{y}\" class=\"typed\" xml:space=\"preserve\" textLength=\"{length}\">{text}</text>"
            ));
        }
    }

    pub(super) fn rect(&mut self, place: (i32, i32), size: (i32, i32), class: &str) {
        self.rounded(place, size, 3, class);
    }

    pub(super) fn rounded(
        &mut self,
        (x, y): (i32, i32),
        (width, height): (i32, i32),
        radius: i32,
        class: &str,
    ) {
        self.push(&format!(
            "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" rx=\"{radius}\" class=\"{class}\"/>"
        ));
    }

    pub(super) fn line(&mut self, points: &[(i32, i32)], class: &str) {
        let mut list = String::new();
        for (x, y) in points {
            let _ = write!(list, "{x},{y} ");
        }
        self.push(&format!(
            "<polyline points=\"{}\" class=\"{class}\"/>",
            list.trim_end()
        ));
    }

    pub(super) fn dot(&mut self, (x, y): (i32, i32), class: &str) {
        self.push(&format!(
            "<circle cx=\"{x}\" cy=\"{y}\" r=\"4\" class=\"{class}\"/>"
        ));
    }

    /// The sign of ground, hanging from here.
    pub(super) fn ground(&mut self, (x, y): (i32, i32)) {
        self.line(&[(x, y), (x, y + 8)], "wire");
        for (half, down) in [(10, 8), (6, 12), (2, 16)] {
            self.line(&[(x - half, y + down), (x + half, y + down)], "wire");
        }
    }

    /// A resistor from a wire up to a supply.
    pub(super) fn pull_up(&mut self, (x, y): (i32, i32), value: &str, supply: &str) {
        self.dot((x, y), "dot");
        self.line(&[(x, y), (x, y - 10)], "wire");
        self.rect((x - 5, y - 32), (10, 22), "part");
        self.line(&[(x, y - 32), (x, y - 40)], "wire");
        self.text((x + 10, y - 24), Anchor::Start, "note", value);
        self.text((x + 10, y - 38), Anchor::Start, "note", supply);
    }

    /// A resistor from a wire down to ground.
    pub(super) fn pull_down(&mut self, (x, y): (i32, i32), value: &str) {
        self.dot((x, y), "dot");
        self.line(&[(x, y), (x, y + 5)], "wire");
        self.rect((x - 5, y + 5), (10, 16), "part");
        self.ground((x, y + 21));
        self.text((x + 10, y + 17), Anchor::Start, "note", value);
    }

    /// A capacitor from a wire down to ground.
    pub(super) fn capacitor(&mut self, (x, y): (i32, i32), value: &str) {
        self.dot((x, y), "dot");
        self.line(&[(x, y), (x, y + 8)], "wire");
        for down in [8, 13] {
            self.line(&[(x - 9, y + down), (x + 9, y + down)], "wire");
        }
        self.ground((x, y + 13));
        self.text((x + 13, y + 15), Anchor::Start, "note", value);
    }

    /// A contact that is closed until something opens it, 60 px along a wire from here.
    pub(super) fn closed_contact(&mut self, (x, y): (i32, i32), name: &str) {
        self.dot((x + 14, y), "dot");
        self.dot((x + 46, y), "dot");
        self.line(&[(x, y), (x + 14, y), (x + 46, y - 6)], "wire");
        self.line(&[(x + 46, y - 10), (x + 46, y), (x + 60, y)], "wire");
        self.text((x + 30, y - 15), Anchor::Middle, "note", name);
    }

    /// A contact that is open until something closes it, 60 px along a wire from here.
    pub(super) fn open_contact(&mut self, (x, y): (i32, i32)) {
        self.dot((x + 14, y), "dot");
        self.dot((x + 46, y), "dot");
        self.line(&[(x, y), (x + 14, y), (x + 44, y - 12)], "wire");
        self.line(&[(x + 46, y), (x + 60, y)], "wire");
    }

    /// The whole file; `source` is where a change belongs.
    pub(super) fn finish(self, title: &str, source: &str) -> String {
        let Self {
            width,
            height,
            body,
        } = self;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\">\n\
             <!-- Drawn by `cargo xtask pictures` from {source}: change it there. -->\n\
             <title>{title}</title>\n<style>\n{STYLE}</style>\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n{body}</svg>\n"
        )
    }
}

/// A row of a board.
pub(super) struct Row {
    pub(super) y: i32,
    pub(super) name: &'static str,
    pub(super) cells: Vec<(i32, String)>,
}

/// A board as a box with a row for each pin, and the pins at its right edge.
pub(super) fn board(
    picture: &mut Picture,
    (x, y): (i32, i32),
    (width, height): (i32, i32),
    heads: &[(i32, &str)],
    rows: &[Row],
) {
    picture.rect((x, y), (width, height), "box");
    for (at, head) in heads {
        picture.text((x + at, y + 20), Anchor::Start, "head", head);
    }
    for row in rows {
        picture.text((x + 14, row.y + 4), Anchor::Start, "name", row.name);
        for (at, cell) in &row.cells {
            picture.text((x + at, row.y + 4), Anchor::Start, "", cell);
        }
        picture.dot((x + width, row.y), "dot");
    }
}
