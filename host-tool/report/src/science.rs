//! The paper's calculations, without a machine: the design in numbers and drawings, the simulations as series.
//!
//! * [`values`]: lists and ranges of numbers, exact.
//! * [`design`]: every number of one origami, beside the paper's requirements.
//! * [`series`]: the paper's series and free sweeps, in parallel, in order.
//! * [`model_file`]: reading and writing models, and their descriptions.
//! * [`snapshots`]: wall and body at several moments.
//! * [`charts`]: the series as figures, beside the numbers in the paper's text.
//! * [`drawing`]: drawings to scale, in millimetres.
//! * [`table`]: the same numbers as CSV.
//!
//! The models are those of `locomotion`; `docs/science.md` says how reliable they are.

pub mod charts;
pub mod design;
pub mod drawing;
pub mod model_file;
pub mod series;
pub mod snapshots;
pub mod table;
pub mod values;
