//! All tests of the crate in one program: each program more takes seconds to build and link.

mod beam;
mod body;
mod comparison;
mod folded;
mod kinematics;
mod model;
mod prior;
mod roller;
mod tube;
