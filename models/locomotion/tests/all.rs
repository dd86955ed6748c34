//! All tests of the crate in one program: each program more takes seconds to build and link.

mod body;
mod folded;
mod kinematics;
mod model;
mod paper;
mod roller;
mod tube;
