//! The paper's science on any laptop: its design in numbers and drawings, its simulations and the rig's as series.
//!
//! * [`values`]: lists and ranges of numbers, exact.
//! * [`design`]: every number of one origami, and where the paper's requirements put it.
//! * [`series`]: the paper's series and free sweeps, in parallel, in order.
//! * [`snapshots`]: wall and body at several moments.
//! * [`charts`]: the series as figures, beside what the paper's text says.
//! * [`drawing`]: to scale, in millimetres.
//! * [`table`]: the same numbers as CSV.
//!
//! The models are those of `locomotion`; what they are worth is in `docs/science.md`.

pub mod charts;
pub mod design;
pub mod drawing;
pub mod series;
pub mod snapshots;
pub mod table;
pub mod values;
