//! The measures of a drawing, which its heading and its charts share.

/// Size of one chart in units of the drawing. The drawing library rounds to whole units, so charts are drawn large
/// and displayed small.
pub(super) const SIZE: (u32, u32) = (1_200, 760);
/// Font size for the drawing library, which writes 1 / 1.24 of it: a telephone shows the 1,200 units on 358 px.
pub(super) const LETTERS: i32 = 50;
