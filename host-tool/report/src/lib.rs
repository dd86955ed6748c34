//! Records and models as figures, tables and pages; needs no machine.
//!
//! * [`figures`]: charts, their colours and their files.
//! * [`science`]: the paper's design, simulations and series.
//! * [`html`]: recorded trials as one HTML file.
#![forbid(unsafe_code)]

pub mod figures;
pub mod html;
pub mod science;
