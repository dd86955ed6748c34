//! Records and models as figures, tables and pages; needs no machine.
//!
//! * [`science`]: the paper's design, simulations and series.
//! * [`report`]: recorded trials as one HTML file.
#![forbid(unsafe_code)]

pub mod report;
pub mod science;
