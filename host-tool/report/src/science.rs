//! The paper's calculations, without a machine: the design in numbers and drawings, the simulations as series.
//!
//! * [`values`]: lists and ranges of numbers, exact.
//! * [`design`]: every number of one origami, beside the paper's requirements.
//! * [`optimise`]: designs within limits that move farthest for their length.
//! * [`series`]: the paper's series and free sweeps, in parallel, in order.
//! * [`bands`]: displacements of the bodies that agree with the paper's words.
//! * [`model_file`]: reading and writing models, and their descriptions.
//! * [`odds`]: how probable it is that the paper's sentences are met.
//! * [`observations`]: displacements for a calibration, from folders and files.
//! * [`posterior`]: fitted bodies in a model file.
//! * [`draws`]: all draws of a fit, with their predictions.
//! * [`virtual_displacement`]: displacements of the virtual bench.
//! * [`trial_plan`]: which trials to make next.
//! * [`snapshots`]: wall and body at several moments.
//! * [`charts`]: the series as figures, beside the numbers in the paper's text.
//! * [`crescent`]: the crescent as a beam: forces, the least alpha, displacement over thread.
//! * [`drawing`]: drawings to scale, in millimetres.
//! * [`table`]: the same numbers as CSV.
//!
//! The models are those of `locomotion`; `docs/science.md` says how reliable they are.

pub mod bands;
pub mod charts;
pub mod crescent;
pub mod design;
pub mod drawing;
pub mod draws;
pub mod model_file;
pub mod observations;
pub mod odds;
pub mod optimise;
pub mod posterior;
pub mod series;
pub mod snapshots;
pub mod table;
pub mod trial_plan;
pub mod values;
pub mod virtual_displacement;
