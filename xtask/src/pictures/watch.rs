//! The screen of `retrograde watch`, from the snapshot that its test keeps.

use super::svg::Picture;
use crate::process::root;

const SNAPSHOT: &str = "host-tool/tests/commands/snapshots/commands__watch_screen__work-80x24.snap";
/// Width and height of a character, px.
const CELL: (i32, i32) = (8, 17);
const MARGIN: i32 = 14;

pub(super) fn draw() -> String {
    let snapshot = std::fs::read_to_string(root().join(SNAPSHOT)).unwrap_or_default();
    // The screen stands below the snapshot's own heading.
    let screen = snapshot.splitn(3, "---\n").nth(2).unwrap_or_default();
    let (width, height) = (80 * CELL.0 + 2 * MARGIN, 24 * CELL.1 + 2 * MARGIN);
    let mut picture = Picture::new(width.unsigned_abs(), height.unsigned_abs());
    picture.rounded((0, 0), (width, height), 8, "terminal");
    for (row, line) in (1..).zip(screen.lines()) {
        picture.characters((MARGIN, MARGIN + row * CELL.1 - 4), CELL.0, line);
    }
    picture.finish("retrograde watch: both machines on one screen", SNAPSHOT)
}
