//! All tests of the crate in one program: each program more takes seconds to build and link.

mod client;
mod frame;
mod fuzz;
mod link;
mod names;
mod parties;
mod session;
mod texts;
mod wire;
