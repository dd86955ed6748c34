//! The way of a command from the terminal to an edge of the STEP pin, and of the edges back to the data.

use super::svg::{Anchor, Picture};

/// The three columns: computer, board, machine. Place and width, px.
const COLUMNS: [(i32, i32, &str); 3] = [
    (30, 300, "Computer"),
    (390, 330, "Board, STM32F411"),
    (780, 190, "Rig"),
];
const TOP: i32 = 60;
const HEIGHT: i32 = 430;

/// A box: column, place from the top, height, name and what it does.
type Station = (usize, i32, i32, &'static str, &'static [&'static str]);

const STATIONS: [Station; 10] = [
    (
        0,
        40,
        62,
        "retrograde",
        &["terminal, page, Python:", "a request, checked first"],
    ),
    (
        0,
        126,
        62,
        "client",
        &["numbers it, frames it, repeats it", "until it is answered"],
    ),
    (
        0,
        262,
        62,
        "client",
        &["sorts replies, events", "and samples"],
    ),
    (
        0,
        348,
        62,
        "records",
        &["CSV and JSON of each trial,", "report and figures"],
    ),
    (
        1,
        40,
        62,
        "session",
        &["executes it once, answers", "a repetition from its cache"],
    ),
    (
        1,
        126,
        62,
        "motion",
        &[
            "path, then periods: each edge on",
            "its nearest tick of 10 ns",
        ],
    ),
    (
        1,
        212,
        46,
        "ring of slots",
        &["8 ms of periods, by DMA into TIM1"],
    ),
    (
        1,
        282,
        46,
        "captures",
        &["TIM2 counts, TIM5 times each edge"],
    ),
    (
        1,
        352,
        62,
        "control",
        &[
            "compares them with the plan,",
            "keeps position, record and faults",
        ],
    ),
    (2, 212, 46, "STEP pin", &["driver, motor, screw"]),
];

pub(super) fn draw() -> String {
    let mut picture = Picture::new(1_000, 510);
    let title = "From a command to an edge, and back";
    picture.text((30, 34), Anchor::Start, "title", title);
    for (x, width, name) in COLUMNS {
        picture.rect((x, TOP), (width, HEIGHT), "box");
        picture.text((x + 14, TOP + 24), Anchor::Start, "head", name);
    }
    for (column, down, height, name, lines) in STATIONS {
        let (x, width, _) = COLUMNS[column];
        picture.rect((x + 20, TOP + down), (width - 40, height), "part");
        picture.text((x + 32, TOP + down + 19), Anchor::Start, "name", name);
        for (line, at) in lines.iter().zip((0..).map(|n| 36 + 16 * n)) {
            picture.text((x + 32, TOP + down + at), Anchor::Start, "note", line);
        }
    }
    arrows(&mut picture);
    picture.finish(title, "crate `xtask`")
}

fn arrows(picture: &mut Picture) {
    let y = |down: i32| TOP + down;
    let [left, middle, right] = COLUMNS.map(|(x, width, _)| (x + 20, x + width - 20));
    // Down on the left, over to the board, down to the ring.
    picture.arrow((left.0 + 130, y(102)), (left.0 + 130, y(126)));
    picture.line(&[(left.1, y(157)), (360, y(157)), (360, y(71))], "wire");
    picture.arrow((360, y(71)), (middle.0, y(71)));
    picture.text((354, y(60)), Anchor::Middle, "note", "frames");
    for (from, to) in [(102, 126), (188, 212)] {
        picture.arrow((middle.0 + 140, y(from)), (middle.0 + 140, y(to)));
    }
    // To the pin and back from it.
    picture.arrow((middle.1, y(235)), (right.0, y(235)));
    picture.text((750, y(225)), Anchor::Middle, "note", "edges");
    picture.line(&[(right.0 + 75, y(258)), (right.0 + 75, y(305))], "jumper");
    picture.line(&[(right.0 + 75, y(305)), (middle.1, y(305))], "jumper");
    picture.text((right.0 + 82, y(290)), Anchor::Start, "note", "two jumpers");
    picture.arrow((middle.0 + 140, y(328)), (middle.0 + 140, y(352)));
    // Up to the data.
    picture.line(&[(middle.0, y(383)), (360, y(383)), (360, y(293))], "wire");
    picture.arrow((360, y(293)), (left.1, y(293)));
    picture.arrow((left.0 + 130, y(324)), (left.0 + 130, y(348)));
    // Stops without an instruction.
    picture.text(
        (right.0, y(150)),
        Anchor::Start,
        "note",
        "E-stop loop, far limit:",
    );
    picture.text((right.0, y(166)), Anchor::Start, "note", "no further edge");
    picture.arrow((right.0 + 20, y(174)), (right.0 + 20, y(212)));
}
