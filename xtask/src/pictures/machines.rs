//! Both machines at work, drawn to one scale: the rig with its tube and body, and the attachment unfolded and folded.

use super::svg::{Anchor, Picture};

/// Scale, px per mm.
const PX: f64 = 3.0;
/// The paper's rig, mm: diameter of the rollers, width of the tube, stroke of the wave.
const ROLLER_MM: f64 = 40.0;
const TUBE_MM: f64 = 24.4;
const STROKE_MM: f64 = 130.0;
/// Indentation of each wall in the picture, mm: the deepest of the paper's five.
const INDENTATION_MM: f64 = 5.05;
/// The paper's attachment, mm, by `retrograde design`: crescents, distance between them, width of the core, and how far
/// the middle of a wing's two facets reaches along the core.
const CRESCENTS: i32 = 9;
const SPACING_MM: f64 = 4.34;
const CORE_MM: f64 = 4.88;
const REACH_MM: f64 = 4.34;
/// The same with 21 mm of thread wound up (`docs/science.md`): distance between crescents and width.
const FOLDED_SPACING_MM: f64 = 2.0;
const FOLDED_WIDTH_MM: f64 = 15.8;
/// The capsule that carries it, mm.
const CAPSULE_MM: (f64, f64) = (26.0, 11.0);

/// The middle of the tube, and of the rollers' stroke from `FAR` to `HOME`, px.
const MIDDLE_Y: i32 = 262;
const FAR: i32 = 210;
const HOME: i32 = FAR + (STROKE_MM * PX) as i32;
/// The rollers in the picture.
const ROLLERS: i32 = FAR + 128;

fn px(mm: f64) -> i32 {
    (mm * PX).round() as i32
}

pub(super) fn draw() -> String {
    let mut picture = Picture::new(960, 660);
    rig(&mut picture);
    capsule(&mut picture);
    picture.finish("The rig and the capsule", "crate `xtask`")
}

/// How far the wall is pushed in at a distance from the rollers, mm: their arc, as in the model.
fn pressed_mm(from_rollers_px: i32) -> f64 {
    let radius = ROLLER_MM / 2.0;
    let x = f64::from(from_rollers_px) / PX;
    let arc = (radius * radius - x * x).max(0.0).sqrt();
    (INDENTATION_MM - radius + arc).max(0.0)
}

fn rig(picture: &mut Picture) {
    picture.text((30, 34), Anchor::Start, "title", "The rig");
    picture.text(
        (112, 34),
        Anchor::Start,
        "note",
        "two rollers make a wave in a silicone intestine, 5 times there and back in 40 s",
    );
    // Motor, screw and carriage.
    picture.rect((60, 62), (70, 56), "box");
    picture.text((95, 94), Anchor::Middle, "name", "NEMA 17");
    picture.line(&[(130, 86), (790, 86)], "wire");
    picture.line(&[(130, 94), (790, 94)], "wire");
    for x in (138..786).step_by(12) {
        picture.line(&[(x, 94), (x + 6, 86)], "wire");
    }
    picture.rect((790, 72), (14, 36), "box");
    picture.text((812, 94), Anchor::Start, "note", "ball screw");
    picture.rect((ROLLERS - 34, 72), (68, 36), "part");
    picture.text((ROLLERS, 94), Anchor::Middle, "name", "carriage");
    let half = px(TUBE_MM / 2.0);
    let radius = px(ROLLER_MM / 2.0);
    let to_roller = half - px(INDENTATION_MM) + radius;
    let (above, below) = (MIDDLE_Y - to_roller, MIDDLE_Y + to_roller);
    picture.line(&[(ROLLERS, 108), (ROLLERS, above)], "wire");
    picture.line(
        &[
            (ROLLERS + 34, 100),
            (ROLLERS + 90, 100),
            (ROLLERS + 90, below),
            (ROLLERS, below),
        ],
        "wire",
    );
    // Tube, pressed in by the rollers; body inside.
    for side in [-1, 1] {
        let wall: Vec<_> = (FAR - 130..=HOME + 60)
            .step_by(5)
            .map(|x| {
                let y = half - px(pressed_mm(x - ROLLERS));
                (x, MIDDLE_Y + side * y)
            })
            .collect();
        picture.line(&wall, "wall");
    }
    for y in [above, below] {
        picture.circle((ROLLERS, y), radius, "part");
        picture.dot((ROLLERS, y), "dot");
    }
    picture.text(
        (ROLLERS - 110, above - 34),
        Anchor::Middle,
        "note",
        "40 mm roller",
    );
    let tail = FAR + 20;
    body(picture, (tail, MIDDLE_Y), SPACING_MM, &|x| {
        TUBE_MM / 2.0 - pressed_mm(x - ROLLERS)
    });
    picture.text(
        (tail - 4, MIDDLE_Y + half + 24),
        Anchor::Middle,
        "note",
        "tail",
    );
    picture.text(
        (120, MIDDLE_Y - half - 12),
        Anchor::Middle,
        "note",
        "intestine, 24.4 mm",
    );
    // The stroke.
    let y = below + radius + 22;
    picture.arrow((HOME, y), (FAR, y));
    picture.text((HOME + 14, y + 4), Anchor::Start, "note", "home, 0");
    picture.text((FAR - 14, y + 4), Anchor::End, "note", "far end, 130 mm");
    picture.text(
        ((FAR + HOME) / 2, y - 8),
        Anchor::Middle,
        "note",
        "antegrade wave: the unfolded body goes against it",
    );
}

/// The attachment from its tail headward: a core with crescents whose wings reach back to `half_mm` at their place.
fn body(
    picture: &mut Picture,
    (tail, y): (i32, i32),
    spacing_mm: f64,
    half_mm: &dyn Fn(i32) -> f64,
) {
    let (first, core) = (tail + px(REACH_MM), px(CORE_MM / 2.0));
    let last = first + px(spacing_mm * f64::from(CRESCENTS - 1));
    picture.rect((first, y - core), (last - first, 2 * core), "body");
    for crescent in 0..CRESCENTS {
        let root = first + px(spacing_mm * f64::from(crescent));
        let tip = root - px(REACH_MM);
        let reach = px(half_mm(tip));
        for side in [-1, 1] {
            picture.line(&[(root, y + side * core), (tip, y + side * reach)], "wing");
        }
    }
}

fn capsule(picture: &mut Picture) {
    const Y: i32 = 572;
    picture.text((30, 476), Anchor::Start, "title", "The capsule");
    picture.text(
        (166, 476),
        Anchor::Start,
        "note",
        "a motor with a worm gear winds a thread: it folds the attachment and holds it without power",
    );
    let folds = [
        (
            60,
            SPACING_MM,
            TUBE_MM,
            "unfolded: an antegrade wave carries it backwards",
        ),
        (
            520,
            FOLDED_SPACING_MM,
            FOLDED_WIDTH_MM,
            "folded, 21 mm of thread wound up: the wave pushes it forward",
        ),
    ];
    for (tail, spacing_mm, width_mm, says) in folds {
        body(picture, (tail, Y), spacing_mm, &|_| width_mm / 2.0);
        let head = tail + px(REACH_MM + spacing_mm * f64::from(CRESCENTS - 1)) + 14;
        let (length, height) = (px(CAPSULE_MM.0), px(CAPSULE_MM.1));
        picture.rounded((head, Y - height / 2), (length, height), height / 2, "part");
        // The thread, from the last crescent through the core to the spool.
        let spool = head + 26;
        picture.line(&[(tail + px(REACH_MM), Y), (spool, Y)], "thread");
        picture.circle((spool, Y), 9, "spool");
        picture.text((tail, Y + 60), Anchor::Start, "", says);
    }
    picture.text((60, 520), Anchor::Start, "note", "tail");
    picture.text((200, 540), Anchor::Start, "note", "spool of the thread");
}
