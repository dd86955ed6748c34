//! The colours of all charts.

use plotters::style::RGBColor;

/// What was measured, and what a model says in a chart without measurements.
pub(crate) const MEASURED: RGBColor = RGBColor(0x1f, 0x5a, 0xa8);
/// What was planned, and the second of two models.
pub(crate) const PLANNED: RGBColor = RGBColor(0xf0, 0xa0, 0x30);
/// Axes and letters.
pub(crate) const INK: RGBColor = RGBColor(0x33, 0x33, 0x33);
/// What cannot be relied on.
pub(crate) const WARNING: RGBColor = RGBColor(0xb0, 0x1c, 0x1c);
/// The band of several bodies.
pub(crate) const BAND: RGBColor = RGBColor(0x4a, 0x4a, 0x4a);
/// What the paper prints.
pub(crate) const PAPER: RGBColor = RGBColor(0xc2, 0x1f, 0x26);
/// Dry walls.
pub(crate) const DRY: RGBColor = RGBColor(0xc0, 0x6a, 0x10);
/// A body that folds within its run.
pub(crate) const IN_RUN: RGBColor = RGBColor(0x3a, 0x8a, 0x4c);
