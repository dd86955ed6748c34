//! The colours of all charts.

use plotters::style::RGBColor;

/// Measurements; in a chart without measurements, the model.
pub(crate) const MEASURED: RGBColor = RGBColor(0x1f, 0x5a, 0xa8);
/// Plans; in a chart of two models, the second one.
pub(crate) const PLANNED: RGBColor = RGBColor(0xf0, 0xa0, 0x30);
/// Axes and text.
pub(crate) const INK: RGBColor = RGBColor(0x33, 0x33, 0x33);
/// Marks data that cannot be relied on.
pub(crate) const WARNING: RGBColor = RGBColor(0xb0, 0x1c, 0x1c);
/// The spread over several bodies.
pub(crate) const BAND: RGBColor = RGBColor(0x4a, 0x4a, 0x4a);
/// Values printed in the paper.
pub(crate) const PAPER: RGBColor = RGBColor(0xc2, 0x1f, 0x26);
/// Trials with dry walls.
pub(crate) const DRY: RGBColor = RGBColor(0xc0, 0x6a, 0x10);
/// A body that folds within its run.
pub(crate) const IN_RUN: RGBColor = RGBColor(0x3a, 0x8a, 0x4c);
